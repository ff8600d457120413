//! `polscan doctor`: what is wrong with this machine for the configured rig, and what to do.

use std::path::Path;

use super::{failure::FAILED, say};
use crate::{
    config::Settings,
    doctor::{Level, Machine, examine},
    engine::{Failure, rig_failure},
};

/// Looks at everything that a scan needs; ends with 1 where something keeps scans from working.
pub fn doctor(settings: &Settings, json: bool) -> Result<u8, Failure> {
    let findings = examine(settings, &Machine::new(Path::new("/"))).map_err(rig_failure)?;
    let passed = findings.iter().all(|finding| finding.level < Level::Bad);
    if json {
        say(serde_json::json!({ "passed": passed, "findings": findings }));
    } else {
        for finding in &findings {
            say(format_args!("{:<8} {:<15} {}", finding.level.name(), finding.check, finding.message));
        }
    }
    Ok(if passed { 0 } else { FAILED })
}
