//! Calibrations of the rig: measured, written into a folder, accepted or refused. No terminal: command line and service
//! come through here.

pub mod noise;
pub mod output;
pub mod polarization;
pub mod rig;
pub mod sync;

use std::{
    path::Path,
    time::{Duration, Instant},
};

use polscan_calibration::polarization::Turning;

pub use output::{Outcome, Output, Summary};

use crate::{
    app::Rig, config::Settings, engine::Failure, measure::polarization::watch, report::NamedRegion,
    sequencer::CancelFlag,
};

/// What is to be done with the rig.
#[derive(Debug, Clone)]
pub enum Task {
    /// Noise of the camera.
    Noise,
    /// Timing of the projector.
    Sync,
    /// A step of a session with a board.
    Rig(rig::Task),
    /// Polarization, at one angle.
    Polarization(polarization::Task),
    /// Watch H and V while somebody turns the polarizer; writes nothing.
    Watch {
        /// Bare metal in the camera's image; what is evenly lit where there is none.
        coupon: Option<NamedRegion>,
        /// When it ends if nobody ends it.
        limit: Duration,
    },
}

/// H and V as the polarizer stands, above no light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Light {
    /// Light of H in DN.
    pub h_dn: f64,
    /// Light of V in DN.
    pub v_dn: f64,
    /// Degrees off the darkest V that was seen, once enough of a turn has been.
    pub off_deg: Option<f64>,
}

/// What a calibration tells while it runs.
#[derive(Debug, Clone, Copy)]
pub enum Progress<'a> {
    /// What is being done.
    Doing(&'a str),
    /// A value of a watch.
    Watched(Light),
}

/// Carries `task` out and writes the result into the folder `out`, which must be absent or empty.
///
/// # Errors
/// Devices, regions, a picture without light, the disk, or `cancel`; a watch only ends by `cancel`.
pub fn run(
    task: &Task,
    out: &Path,
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(Progress<'_>),
) -> Result<Outcome, Failure> {
    let mut doing = |what: &str| progress(Progress::Doing(what));
    match task {
        Task::Noise => noise::run(Output::create(out)?, rig, settings, cancel, &mut doing),
        Task::Sync => sync::run(Output::create(out)?, rig, settings, cancel, &mut doing),
        Task::Polarization(task) => {
            polarization::run(Output::create(out)?, rig, settings, task, cancel, &mut doing)
        }
        Task::Rig(task) => rig::run(task, out, rig, settings, cancel, &mut doing),
        Task::Watch { coupon, limit } => {
            doing("watching H and V");
            let (mut turning, begun) = (Turning::default(), Instant::now());
            watch(rig, settings, coupon.as_ref(), cancel, &mut |h_dn, v_dn| {
                progress(Progress::Watched(Light { h_dn, v_dn, off_deg: turning.add(v_dn) }));
                begun.elapsed() < *limit
            })?;
            Ok(Outcome::default())
        }
    }
}
