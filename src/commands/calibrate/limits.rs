//! When a calibration of optics is accepted, as the command line is told.

use std::path::PathBuf;

use crate::{calibration::rig::Gates, engine::Failure};

/// When a calibration is accepted.
#[derive(Debug, clap::Args)]
pub struct Limits {
    /// File of limits that a calibration must keep, TOML; those it leaves out are the usual ones.
    #[arg(long, value_name = "FILE")]
    gates: Option<PathBuf>,
    /// Distance between camera and projector as measured with a ruler: shows a board of another size.
    #[arg(long, value_name = "MM")]
    pub baseline_mm: Option<f64>,
}

impl Limits {
    /// The limits; `None` where no file names any.
    pub fn given(&self) -> Result<Option<Gates>, Failure> {
        let Some(path) = &self.gates else { return Ok(None) };
        let operation = format!("read the limits {}", path.display());
        let text = std::fs::read_to_string(path).map_err(|error| Failure::data(operation.clone(), error))?;
        toml::from_str(&text).map(Some).map_err(|error| Failure::data(operation, error))
    }
}
