//! Where a calibration goes: a folder with a file for scans, a report and plots.

use std::path::Path;

use serde_json::Value;

use crate::{
    compare::plot::{Plot, Series},
    engine::Failure,
    measure::files::Document,
    store::{BundleWriter, StorageError},
};

/// The folder that a calibration is written to.
pub struct Output {
    writer: BundleWriter,
    files: Vec<String>,
}

/// What a calibration came to, in words.
#[derive(Debug, Clone, Default)]
pub struct Summary {
    /// Lines for a person.
    pub lines: Vec<String>,
    /// Why no file for scans was written; empty where one was, or where more has to be measured first.
    pub refused: Vec<String>,
    /// Whether more has to be measured before there is anything to accept or refuse.
    pub unfinished: bool,
}

/// What a calibration came to, all of it written.
#[derive(Debug, Clone, Default)]
pub struct Outcome {
    /// Names of the files in its folder.
    pub files: Vec<String>,
    /// The report, as in report.json.
    pub report: Value,
    /// Lines for a person.
    pub lines: Vec<String>,
    /// Why no file for scans was written.
    pub refused: Vec<String>,
    /// Whether there is a file for scans; `None` where more has to be measured before there is anything to judge.
    pub accepted: Option<bool>,
    /// The session that it is a step of, as it stands now.
    pub session: Option<super::rig::SessionState>,
}

impl Output {
    /// Claims the folder, before the rig is touched.
    ///
    /// # Errors
    /// The folder is neither absent nor empty, or the disk says no.
    pub fn create(out: &Path) -> Result<Self, Failure> {
        let writer = BundleWriter::create(out, None, 0).map_err(failed)?;
        Ok(Self { writer, files: Vec::new() })
    }

    /// Adds a file.
    ///
    /// # Errors
    /// The disk says no.
    pub fn add(&mut self, name: &str, bytes: &[u8]) -> Result<(), Failure> {
        self.writer.bytes(name, bytes).map_err(failed)?;
        self.files.push(name.into());
        Ok(())
    }

    /// Adds the file that scans use.
    ///
    /// # Errors
    /// The disk says no.
    pub fn document<T: Document>(&mut self, file: &T) -> Result<(), Failure> {
        self.add(T::FILE_NAME, file.to_toml().as_bytes())
    }

    /// Adds a picture.
    ///
    /// # Errors
    /// The disk says no.
    pub fn png(&mut self, name: &str, picture: &image::RgbImage) -> Result<(), Failure> {
        self.writer.png(name, picture).map_err(failed)?;
        self.files.push(name.into());
        Ok(())
    }

    /// Adds a plot.
    ///
    /// # Errors
    /// The disk says no.
    pub fn plot(&mut self, name: &str, plot: &Plot) -> Result<(), Failure> {
        self.add(name, plot.file().as_bytes())
    }

    /// Adds report.json and closes the folder.
    ///
    /// # Errors
    /// The disk says no.
    pub fn finish(mut self, report: Value, summary: Summary) -> Result<Outcome, Failure> {
        let text = serde_json::to_vec_pretty(&report).expect("numbers and text are JSON");
        self.add("report.json", &text)?;
        self.writer.finish_plain().map_err(failed)?;
        let Summary { lines, refused, unfinished } = summary;
        let accepted = (!unfinished || !refused.is_empty()).then_some(refused.is_empty());
        Ok(Outcome { files: self.files, report, lines, refused, accepted, session: None })
    }
}

fn failed(error: StorageError) -> Failure {
    Failure::storage("write the calibration", error)
}

/// A named line or set of dots of a plot.
pub(super) fn series(name: &str, class: &'static str, joined: bool, points: Vec<(f64, f64)>) -> Series {
    Series { name: name.into(), class, points, joined }
}
