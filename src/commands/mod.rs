//! What each command of the program does: reads, calls the pure parts, writes, prints.

mod admin;
mod calibrate;
mod check_config;
mod compare;
mod decode;
mod devices;
mod doctor;
mod export;
mod failure;
mod notify;
mod patterns;
mod plan;
mod progress;
mod scan;
mod serve;
mod show;
mod verify;

use std::{io::Write, path::Path};

use crate::report::{self, Outputs, Report, Verdict};

pub use admin::{add_token, list_tokens, openapi, reindex, revoke_token};
pub use calibrate::{Calibrate, calibrate};
pub use check_config::check_config;
pub use compare::{CompareArgs, compare};
pub use decode::decode;
pub use devices::devices;
pub use doctor::doctor;
pub use export::{ExportArgs, export};
pub use failure::{USAGE, exit_code, print_failure, print_usage};
pub use patterns::{Size, patterns};
pub use plan::{PlanArgs, plan};
pub use scan::scan;
pub use serve::serve;
pub use show::{projector, show};
pub use verify::{VerifyArgs, verify};

/// Prints a line to stdout. A reader that has gone away is no error of ours.
fn say(text: impl std::fmt::Display) {
    let _ = writeln!(std::io::stdout().lock(), "{text}");
}

/// Prints the report of a result for a person, or as JSON for a script; returns the exit code.
fn print_result(report: &Report, out: &Path, json: bool) -> u8 {
    if json {
        say(serde_json::json!({ "out": out, "verdict": report.verdict, "report": report }));
    } else {
        let named =
            ["cloud.ply", "cloud.png", "overview.png", "report.json", "maps.npz", "maps/", "frames.npy"];
        let files: Vec<&str> = named.into_iter().filter(|name| out.join(name).exists()).collect();
        say(report::summary(report, Some(Outputs { directory: out, files: &files })).trim_end());
    }
    if report.verdict == Verdict::Failed { failure::FAILED } else { 0 }
}
