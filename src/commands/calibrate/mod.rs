//! `polscan calibrate`: one file for each subcommand.

mod board;
mod camera;
mod pictures;
mod result;
mod rig;
mod session;
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
    }
}
