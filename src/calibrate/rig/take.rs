//! One view, taken with the rig.

use std::{path::Path, thread, time::Duration};

use polscan_drivers::error::DeviceError;
use polscan_patterns::Mode;

use super::views::{Views, white_picture};
use crate::{
    app::Rig,
    calibration::boards::{Board, DetectSettings},
    config::Settings,
    engine::{Failure, Label, Results, Scan, new_id},
    pipeline::PipelineError,
    report::Diagnosis,
    sequencer::{CancelFlag, Progress},
    store::BundleWriter,
};

/// Time between two signs of life of a thread that computes.
const PULSE: Duration = Duration::from_millis(50);

/// What is to be taken.
#[derive(Debug, Clone, Copy)]
pub struct Shot<'a> {
    /// Name of the view, and of its folder.
    pub name: &'a str,
    /// Board that stands there.
    pub board: &'a Board,
    /// Settings of the rig.
    pub settings: &'a Settings,
    /// Folder of the session that keeps its frames.
    pub keep: Option<&'a Path>,
}

/// Scans the board once with intensities, and adds what is seen to `views`.
///
/// # Errors
/// Devices, a scan that failed, the disk, or `cancel`. A picture without the board is a view of no use, no error.
pub fn take(
    shot: &Shot<'_>,
    rig: &mut Rig,
    views: &mut Views,
    progress: &mut dyn FnMut(Progress<'_>),
    cancel: &CancelFlag,
) -> Result<(), Failure> {
    let Shot { name, board, .. } = *shot;
    // A calibration that there may be already is what is to be found anew; boards scatter light, so that only intensities
    // decode.
    let settings = Settings { calibration: None, mode: Mode::Gray, ..shot.settings.clone() };
    let scan = Scan::prepare(&settings, &[], rig)?;
    let taken = scan.capture(rig, progress, cancel);
    if let Some(reason) = taken.failure() {
        // A camera that stopped sending may be helped by being opened again.
        if matches!(reason.diagnosis, Diagnosis::DeviceFault | Diagnosis::LostFrame) {
            let device = rig.camera.info().serial.clone();
            let source = DeviceError::Unavailable { device, detail: reason.message.clone() };
            return Err(Failure::Device { operation: "take a view", source });
        }
        return Err(Failure::data(format!("take the view {name}"), reason.message.clone()));
    }
    let failed = |error: PipelineError| Failure::data(format!("decode the view {name}"), error);
    let look = |results: &Results| {
        let (job, decoded) = (results.job, &results.outcome.decoded);
        views.set_projector(name, (job.decode.column.size(), job.decode.row.size()))?;
        let size = (job.decode.width, job.decode.height);
        let Some(picture) = white_picture(job.roles, job.planes, size) else {
            return Err(Failure::data(format!("use the view {name}"), "it has no white frame"));
        };
        views.add(name, board, &picture, Some(decoded), DetectSettings::default())
    };
    alive(cancel, || {
        scan.examine(&taken, look).map_err(failed)??;
        if cancel.is_cancelled() {
            return Err(Failure::data(format!("take the view {name}"), "it was cancelled"));
        }
        let Some(folder) = shot.keep else { return Ok(()) };
        let failed = |error| Failure::storage(format!("keep the view {name}"), error);
        let writer = BundleWriter::create(&folder.join(name), None, scan.bytes()).map_err(failed)?;
        let label = Label { id: new_id(), label: Some(name.into()), ..Label::default() };
        // A view is kept as a whole or not at all.
        scan.finish(&taken, label, writer, &CancelFlag::default()).map(drop)
    })
}

/// Computes what takes long, while whoever watches `cancel` sees that somebody is alive.
pub(super) fn alive<T: Send>(cancel: &CancelFlag, work: impl FnOnce() -> T + Send) -> T {
    thread::scope(|scope| {
        let work = scope.spawn(work);
        while !work.is_finished() {
            cancel.is_cancelled();
            thread::sleep(PULSE);
        }
        work.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
    })
}
