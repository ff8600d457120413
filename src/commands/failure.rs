//! How a command that failed says so, and with which exit code.

use super::say;
use crate::engine::{Failure, Kind};

/// Exit code: done, but the result is a failure that the report names.
pub const FAILED: u8 = 1;
/// Exit code: wrong usage of the command line.
pub const USAGE: u8 = 2;

/// Documented exit code of a failure.
pub fn exit_code(failure: &Failure) -> u8 {
    match failure.kind() {
        Kind::Config => 64,
        Kind::Data => 65,
        Kind::Unavailable => 69,
        Kind::Storage => 74,
    }
}

/// Says on stderr what went wrong, and on stdout as JSON where that was asked for.
pub fn print_failure(failure: &Failure, json: bool) {
    eprintln!("polscan: {}", failure.chain());
    if json {
        let mut error = serde_json::json!({ "type": failure.kind().slug(), "message": failure.chain() });
        if let Failure::Config(config) = failure {
            error["faults"] = config
                .faults
                .iter()
                .map(|fault| serde_json::json!({ "key": fault.key, "message": fault.message, "origin": fault.origin }))
                .collect();
        }
        say(serde_json::json!({ "error": error, "exit_code": exit_code(failure) }));
    }
}

/// Says on stderr what is wrong with the command line, and on stdout as JSON where that was asked for.
pub fn print_usage(message: &str, json: bool) {
    eprint!("{message}");
    if json {
        let error = serde_json::json!({ "type": "usage", "message": message.trim_end() });
        say(serde_json::json!({ "error": error, "exit_code": USAGE }));
    }
}
