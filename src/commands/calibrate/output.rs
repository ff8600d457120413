//! Where a calibration goes: a folder with a file for scans, a report and plots, and a few lines for a person.

use std::path::{Path, PathBuf};

use serde_json::Value;

use crate::{
    app::Rig,
    commands::{failure::FAILED, progress::Bar, say, scan::cancel_on_interrupt},
    compare::plot::{Plot, Series},
    config::Settings,
    engine::{Failure, rig_failure},
    measure::files::Document,
    sequencer::CancelFlag,
    store::{BundleWriter, StorageError},
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

/// The folder that a calibration is written to.
pub struct Output {
    writer: BundleWriter,
    files: Vec<String>,
}

/// What a calibration came to, in words.
pub struct Summary {
    /// Lines for a person.
    pub lines: Vec<String>,
    /// Why no file for scans was written; empty where one was.
    pub refused: Vec<String>,
}

impl Output {
    /// Claims the folder, before the rig is touched.
    pub fn create(out: &Path) -> Result<Self, Failure> {
        let writer = BundleWriter::create(out, None, 0).map_err(failed)?;
        Ok(Self { writer, files: Vec::new() })
    }

    /// Adds a file.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), Failure> {
        self.writer.bytes(name, bytes).map_err(failed)?;
        self.files.push(name.into());
        Ok(())
    }

    /// Adds the file that scans use.
    pub fn document<T: Document>(&mut self, file: &T) -> Result<(), Failure> {
        self.add(T::FILE_NAME, file.to_toml().as_bytes())
    }

    /// Adds a picture.
    pub fn png(&mut self, name: &str, picture: &image::RgbImage) -> Result<(), Failure> {
        self.writer.png(name, picture).map_err(failed)?;
        self.files.push(name.into());
        Ok(())
    }

    /// Adds a plot.
    pub fn plot(&mut self, name: &str, plot: &Plot) -> Result<(), Failure> {
        self.add(name, plot.file().as_bytes())
    }

    /// Adds report.json, closes the folder, prints, and returns the exit code.
    pub fn finish(
        mut self,
        out: &Path,
        report: &Value,
        summary: &Summary,
        json: bool,
    ) -> Result<u8, Failure> {
        let accepted = summary.refused.is_empty();
        let text = serde_json::to_vec_pretty(report).expect("numbers and text are JSON");
        self.add("report.json", &text)?;
        self.writer.finish_plain().map_err(failed)?;
        if json {
            let refused = (!accepted).then(|| summary.refused.join("; "));
            let mut answer =
                serde_json::json!({ "out": out, "files": self.files, "refused": refused, "report": report });
            // Only optics are accepted as a whole: the first angle of a polarizer is neither accepted nor refused.
            if let Some(accepted) = report.get("accepted") {
                answer["accepted"] = accepted.clone();
            }
            say(answer);
        } else {
            summary.lines.iter().for_each(say);
            summary.refused.iter().for_each(|refused| say(format_args!("refused: {refused}")));
            say(format_args!("{} in {}", self.files.join(", "), out.display()));
        }
        Ok(if accepted { 0 } else { FAILED })
    }
}

fn failed(error: StorageError) -> Failure {
    Failure::storage("write the calibration", error)
}

/// A named line or set of dots of a plot.
pub fn series(name: &str, class: &'static str, joined: bool, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.into(), class, points, joined }
}
