//! `polscan calibrate`: one file for each subcommand.

mod noise;
mod output;
mod polarization;
mod sync;

use clap::Subcommand;

use crate::{
    config::{ConfigError, Settings},
    engine::Failure,
};

/// What to calibrate.
#[derive(Debug, Subcommand)]
pub enum Calibrate {
    /// Gain, read noise, black level, linearity and saturation of the camera, by photon transfer.
    Noise(output::Place),
    /// Extinction and channels, azimuth of the polarizer, misregistration and drive levels, on bare metal.
    Polarization(polarization::Args),
    /// Latency, rise and fall of the projector, and ripple of its lamp, from flashes.
    Sync(output::Place),
}

/// Runs a calibration; `load` reads the settings from the configuration file that its arguments name.
pub fn calibrate(
    what: &Calibrate,
    load: impl Fn(Option<&std::path::Path>) -> Result<Settings, ConfigError>,
    json: bool,
) -> Result<u8, Failure> {
    match what {
        Calibrate::Noise(args) => noise::run(args, &load(args.config.as_deref())?, json),
        Calibrate::Polarization(args) => polarization::run(args, &load(args.config())?, json),
        Calibrate::Sync(args) => sync::run(args, &load(args.config.as_deref())?, json),
    }
}
