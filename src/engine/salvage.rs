//! Making a bundle of what an interrupted scan left on the disk.

use polscan_drivers::camera::StreamStatistics;

use super::{Failure, results};
use crate::{
    decode::SharedPlane,
    geometry::{Calibration, ReadHints},
    report::{self, CaptureSummary, Reason, ReportInput, Size},
    sequencer::CaptureRecord,
    store::{
        BundleWriter, Manifest,
        manifest::{Capture, Settings},
        spool::Spooled,
    },
    verify::shared_plane,
};

/// Writes the frames of `spooled` with a report that says `reason`.
///
/// # Errors
/// `Data` where the spool holds no frame or none that can be used, `Storage` where the bundle cannot be written.
pub fn salvage(spooled: Spooled, reason: Reason, writer: BundleWriter) -> Result<report::Report, Failure> {
    let fail = |error: Box<dyn std::error::Error + Send + Sync>| {
        Failure::data("use what an interrupted scan left", error)
    };
    let mut manifest = Manifest::parse(&spooled.manifest).map_err(|error| fail(error.into()))?.manifest;
    let frames = spooled.frames;
    let Some(first) = frames.first() else { return Err(fail("it took no frame".into())) };
    let (width, height) = (first.frame.width as usize, first.frame.height as usize);
    let (Some(Settings { requested, applied }), Some(capture)) =
        (manifest.settings.clone(), manifest.capture.clone())
    else {
        return Err(fail("its manifest lacks the camera's settings".into()));
    };
    let sequence = manifest.resolve_sequence(None, None).map_err(|error| fail(error.into()))?;
    let sample_bits = if first.frame.bit_depth > 8 { 16 } else { 8 };
    let decode = manifest.decode_settings(&sequence, (width, height), sample_bits);
    let calibration = match &spooled.calibration {
        Some(bytes) => Some(
            Calibration::from_bytes(bytes, "calibration.toml", &ReadHints::default())
                .map_err(|error| fail(error.into()))?,
        ),
        None => None,
    };
    let seconds = frames
        .iter()
        .map(|captured| captured.frame.stamp.received.since(first.receipt.flipped).as_secs_f64())
        .fold(0.0, f64::max);
    let Capture { limit_seconds, latency_ms, hold_refreshes, timing_measured, synchrony, .. } = capture;
    let planes: Vec<SharedPlane> = frames.iter().map(|captured| shared_plane(&captured.frame)).collect();
    let count = planes.len() as u64;
    let record = CaptureRecord {
        synchrony: synchrony.unwrap_or_default().measured(hold_refreshes, &frames),
        frames,
        retaken: Vec::new(),
        seconds,
        limit_seconds,
        latency_ms,
        hold_refreshes,
        timing_measured,
        applied,
        // Its own counters died with the process.
        statistics: StreamStatistics { triggers: count, frames: count, ..StreamStatistics::default() },
        notes: capture.notes,
    };
    manifest.sequence = record.frames.iter().map(|captured| captured.role).collect();
    manifest.record_capture(&record, requested);
    if let Some(capture) = &mut manifest.capture {
        capture.failure = Some(reason.clone());
    }
    let summary = CaptureSummary::from(&record);
    let simulated = manifest.rig.as_ref().is_some_and(|rig| rig.camera.driver == "sim");
    let (found, mode) = ([reason], decode.mode);
    results::write_unfinished(writer, manifest, &decode, &planes, calibration.as_ref(), |timings| {
        report::build(&ReportInput {
            capture: Some(&summary),
            found: &found,
            timings,
            simulated,
            threads: rayon::current_num_threads(),
            ..ReportInput::new(mode, Size { width, height }, planes.len())
        })
    })
}
