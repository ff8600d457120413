//! `polscan calibrate`: one file for each subcommand.

mod board;
mod camera;
mod limits;
mod output;
mod polarization;
mod rig;

use clap::Subcommand;

use crate::{
    app::Rig,
    calibrate::{Outcome, Output, noise, sync},
    config::{ConfigError, Settings},
    engine::Failure,
    sequencer::CancelFlag,
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
        Calibrate::Noise(args) => plain(args, &load(args.config.as_deref())?, json, noise::run),
        Calibrate::Polarization(args) => polarization::run(args, &load(args.config())?, json),
        Calibrate::Sync(args) => plain(args, &load(args.config.as_deref())?, json, sync::run),
    }
}

/// A calibration that needs no arguments of its own.
type Plain = fn(Output, &mut Rig, &Settings, &CancelFlag, &mut dyn FnMut(&str)) -> Result<Outcome, Failure>;

/// Runs it; returns the exit code.
fn plain(place: &output::Place, settings: &Settings, json: bool, run: Plain) -> Result<u8, Failure> {
    let folder = Output::create(&place.out)?;
    let outcome =
        output::with_rig(settings, |rig, cancel, progress| run(folder, rig, settings, cancel, progress))?;
    Ok(output::print(&place.out, &outcome, json))
}
