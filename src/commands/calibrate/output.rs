//! What every calibration of the command line needs: a rig, a place for the result, and a few lines for a person.

use std::path::{Path, PathBuf};

use crate::{
    app::Rig,
    calibrate::Outcome,
    commands::{failure::FAILED, progress::Bar, say, scan::cancel_on_interrupt},
    config::Settings,
    engine::{Failure, rig_failure},
    sequencer::CancelFlag,
};

/// Arguments of a calibration: what rig, and where the result goes.
#[derive(Debug, clap::Args)]
pub struct Place {
    /// Configuration file; what it leaves out is as in config/default.toml.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Folder for the result; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// Opens the rig for a measurement that an interrupt ends, and says what is being done on a terminal.
pub fn with_rig<T>(
    settings: &Settings,
    measure: impl FnOnce(&mut Rig, &CancelFlag, &mut dyn FnMut(&str)) -> Result<T, Failure>,
) -> Result<T, Failure> {
    let mut rig = Rig::open(settings).map_err(rig_failure)?;
    let cancel = CancelFlag::default();
    cancel_on_interrupt(&cancel);
    let bar = Bar::new(1);
    measure(&mut rig, &cancel, &mut |what| bar.say(what.to_owned()))
}

/// Prints what came of a calibration and returns the exit code.
pub fn print(out: &Path, outcome: &Outcome, json: bool) -> u8 {
    let Outcome { files, report, lines, refused, .. } = outcome;
    if json {
        let reason = (!refused.is_empty()).then(|| refused.join("; "));
        let mut answer =
            serde_json::json!({ "out": out, "files": files, "refused": reason, "report": report });
        // Only optics are accepted as a whole: the first angle of a polarizer is neither accepted nor refused.
        if let Some(accepted) = report.get("accepted") {
            answer["accepted"] = accepted.clone();
        }
        say(answer);
    } else {
        lines.iter().for_each(say);
        refused.iter().for_each(|refused| say(format_args!("refused: {refused}")));
        say(format_args!("{} in {}", files.join(", "), out.display()));
    }
    if refused.is_empty() { 0 } else { FAILED }
}
