//! `polscan calibrate`: one file for each subcommand.

mod board;
mod camera;
mod noise;
mod output;
mod pictures;
mod polarization;
mod result;
mod rig;
mod session;
mod sync;
mod views;

use clap::Subcommand;

use crate::{
    config::{ConfigError, Settings},
    engine::Failure,
};

/// What to calibrate.
#[derive(Debug, Subcommand)]
pub enum Calibrate {
    /// Make a board to print, with the file that describes it.
    Board(board::Args),
    /// Optics of the camera alone, from pictures of a board.
    Camera(camera::Args),
    /// Optics of camera and projector and the pose between them, from scans of a board.
    Rig(rig::Args),
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
        Calibrate::Board(args) => board::run(args, json),
        Calibrate::Camera(args) => camera::run(args, json),
        Calibrate::Rig(args) => rig::run(args, load, json),
        Calibrate::Noise(args) => noise::run(args, &load(args.config.as_deref())?, json),
        Calibrate::Polarization(args) => polarization::run(args, &load(args.config())?, json),
        Calibrate::Sync(args) => sync::run(args, &load(args.config.as_deref())?, json),
    }
}
