//! Calibration files: our own `calibration.toml`, and those of OpenCV and of Bouguet's toolbox.
//!
//! All readers are bounded: a file above [`MAX_BYTES`] is refused, nesting and element counts are limited, and no
//! bytes make them panic. A refusal lists every fault that was found, not the first one.

mod bouguet;
mod canonical;
mod mat;
mod matlab;
mod opencv;
mod storage;
mod value;
mod xml;
mod yaml;

use std::path::Path;

use thiserror::Error;

use super::Calibration;

/// Largest calibration file that is read; board images stored in a `.mat` stay well below.
pub const MAX_BYTES: u64 = 64 << 20;

/// What a foreign calibration file may leave out. Ignored for `calibration.toml`, which says everything itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReadHints {
    /// (width, height) of the camera's frames, for files without sizes; must agree with files that have one.
    pub camera_size: Option<(u32, u32)>,
    /// (width, height) of the projector. Stereo files know only the size of the first device, if any.
    pub projector_size: Option<(u32, u32)>,
    /// Takes the right (second) device for the camera and the left (first) one for the projector.
    pub swap: bool,
    /// Millimetres per unit of the file's translation: 1000 for files in metres.
    pub unit_mm: f64,
}

impl Default for ReadHints {
    fn default() -> Self {
        Self { camera_size: None, projector_size: None, swap: false, unit_mm: 1.0 }
    }
}

/// Everything that is wrong with the content of a calibration file.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("cannot use calibration {name}: {}", faults.join("; "))]
pub struct CalibrationError {
    /// File.
    pub name: String,
    /// Each fault.
    pub faults: Vec<String>,
}

/// Formats, told apart by content first: names of calibration files are rarely right.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Format {
    Toml,
    OpencvYaml,
    OpencvXml,
    BouguetMat,
    BouguetScript,
}

impl Calibration {
    /// Reads a calibration file of any known format: `calibration.toml`, OpenCV FileStorage (YAML, XML), Bouguet's
    /// `Calib_Results*.mat` or `.m`. `name` is the file's name, for messages and as a last resort to tell the format;
    /// `hints` fill in what the file leaves out.
    ///
    /// # Errors
    /// Everything that is missing or wrong in it.
    pub fn from_bytes(bytes: &[u8], name: &str, hints: &ReadHints) -> Result<Self, CalibrationError> {
        parse(bytes, name, hints)
            .and_then(|calibration| {
                let faults = calibration.faults();
                if faults.is_empty() { Ok(calibration) } else { Err(faults) }
            })
            .map_err(|faults| CalibrationError { name: name.to_owned(), faults })
    }
}

fn parse(bytes: &[u8], name: &str, hints: &ReadHints) -> Result<Calibration, Vec<String>> {
    let one = |fault: String| vec![fault];
    if bytes.len() as u64 > MAX_BYTES {
        return Err(one(format!("it is longer than {MAX_BYTES} bytes, which no calibration is")));
    }
    let format = recognise(bytes, name).ok_or_else(|| {
        one("its format is not known: expected calibration.toml, OpenCV YAML or XML, or Bouguet's .mat or .m".into())
    })?;
    let text = || {
        std::str::from_utf8(bytes)
            .map_err(|error| one(format!("it is not UTF-8 text from byte {} on", error.valid_up_to())))
    };
    match format {
        Format::Toml if hints.swap || hints.unit_mm != 1.0 => Err(one(
            "it names its camera and its projector and is in millimetres; exchanged devices and another unit are for \
             the files of other tools"
                .into(),
        )),
        Format::Toml => canonical::read(text()?),
        Format::OpencvYaml => storage::interpret(&yaml::read(text()?).map_err(one)?, hints),
        Format::OpencvXml => storage::interpret(&xml::read(text()?).map_err(one)?, hints),
        Format::BouguetMat => bouguet::interpret(&mat::read(bytes).map_err(one)?, hints),
        // Scripts are written in the code page of their machine; their numbers are ASCII all the same.
        Format::BouguetScript => {
            bouguet::interpret(&matlab::read(&String::from_utf8_lossy(bytes)).map_err(one)?, hints)
        }
    }
}

fn recognise(bytes: &[u8], name: &str) -> Option<Format> {
    let head = String::from_utf8_lossy(&bytes[..bytes.len().min(4096)]);
    let head = head.trim_start_matches('\u{feff}').trim_start();
    if head.starts_with("MATLAB 5.0 MAT-file") {
        return Some(Format::BouguetMat);
    }
    if head.starts_with("%YAML") || head.starts_with("---") || head.contains("!!opencv-matrix") {
        return Some(Format::OpencvYaml);
    }
    if head.starts_with('<') {
        return Some(Format::OpencvXml);
    }
    let extension =
        Path::new(name).extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    match extension.as_str() {
        "toml" => Some(Format::Toml),
        "yml" | "yaml" => Some(Format::OpencvYaml),
        "xml" => Some(Format::OpencvXml),
        "mat" => Some(Format::BouguetMat),
        "m" => Some(Format::BouguetScript),
        _ if head.starts_with('%') => Some(Format::BouguetScript),
        _ if head.contains("polscan.calibration") => Some(Format::Toml),
        _ => None,
    }
}

#[cfg(test)]
mod tests;
