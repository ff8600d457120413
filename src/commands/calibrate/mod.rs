//! `polscan calibrate`: one file for each subcommand.

mod noise;
mod output;

use clap::Subcommand;

use crate::{
    config::{ConfigError, Settings},
    engine::Failure,
};

/// What to calibrate.
#[derive(Debug, Subcommand)]
pub enum Calibrate {
    /// Gain, read noise, black level, linearity and saturation of the camera, by photon transfer.
    Noise(noise::Args),
}

/// Runs a calibration; `load` reads the settings from the configuration file that its arguments name.
pub fn calibrate(
    what: &Calibrate,
    load: impl Fn(Option<&std::path::Path>) -> Result<Settings, ConfigError>,
    json: bool,
) -> Result<u8, Failure> {
    match what {
        Calibrate::Noise(args) => noise::run(args, &load(args.config.as_deref())?, json),
    }
}
