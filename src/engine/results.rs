//! What scan and decode write alike: maps, pictures, cloud, calibration, report.

use std::time::Instant;

use super::{Failure, pictures};
use crate::{
    cloud::{CloudFrame, write_ply},
    decode::{DecodeSettings, SharedPlane},
    geometry::Calibration,
    pipeline::{self, Context, Job, Outcome, milliseconds},
    report::{Report, Timings},
    store::{BundleWriter, Manifest, bundle, error::StorageError, maps::Maps},
};

/// Everything that a result is written from.
pub struct Results<'a> {
    /// What was asked.
    pub job: &'a Job<'a>,
    /// What came of it.
    pub outcome: &'a Outcome,
    /// What the report says besides.
    pub context: &'a Context<'a>,
    /// Times known before writing.
    pub timings: Timings,
    /// Frames to store; `None` where the manifest names another bundle's.
    pub frames: Option<&'a [SharedPlane]>,
}

/// Writes all files, the report last, and gives the bundle its name. The manifest is completed on the way.
pub fn write(writer: BundleWriter, mut manifest: Manifest, results: &Results) -> Result<Report, Failure> {
    let start = Instant::now();
    let failed = |error: StorageError| Failure::storage("write the result", error);
    let Results { job, outcome, context, .. } = results;
    let depth_mm = outcome.depth_mm();
    let maps =
        Maps::new(&outcome.decoded, outcome.class(), outcome.row(), depth_mm.as_ref()).map_err(failed)?;
    let frames = || results.frames.map_or(Ok(()), |frames| write_frames(&writer, &job.decode, frames));
    let data = || writer.maps(&maps).and_then(|()| write_cloud(&writer, results));
    let (frames, (data, pictures)) =
        rayon::join(frames, || rayon::join(data, || pictures::write(&writer, results, &maps)));
    frames.and(data).and(pictures).map_err(failed)?;
    if let Some(truth) = context.truth {
        writer.truth(truth).map_err(failed)?;
        manifest.truth_objects = Some(truth.objects.clone());
    }
    write_calibration(&writer, &mut manifest, job.calibration).map_err(failed)?;
    manifest.record_decode(&job.decode);
    manifest.stamp(std::time::SystemTime::now());
    let timings = Timings { write: Some(milliseconds(start)), ..results.timings };
    let report = pipeline::report(job, outcome, context, timings);
    write_report(&writer, &report)?;
    writer.finish(manifest).map_err(failed)?;
    Ok(report)
}

/// Writes the frames of a capture that did not end well, and a report that says why.
pub fn write_unfinished(
    writer: BundleWriter,
    mut manifest: Manifest,
    decode: &DecodeSettings,
    frames: &[SharedPlane],
    calibration: Option<&Calibration>,
    report: impl FnOnce(Timings) -> Report,
) -> Result<Report, Failure> {
    let start = Instant::now();
    let failed = |error: StorageError| Failure::storage("write what was captured", error);
    write_frames(&writer, decode, frames).map_err(failed)?;
    pictures::write_unfinished(&writer, &manifest.sequence, frames, decode).map_err(failed)?;
    write_calibration(&writer, &mut manifest, calibration).map_err(failed)?;
    manifest.record_decode(decode);
    manifest.stamp(std::time::SystemTime::now());
    let report = report(Timings { write: Some(milliseconds(start)), ..Timings::default() });
    write_report(&writer, &report)?;
    writer.finish(manifest).map_err(failed)?;
    Ok(report)
}

fn write_calibration(
    writer: &BundleWriter,
    manifest: &mut Manifest,
    calibration: Option<&Calibration>,
) -> Result<(), StorageError> {
    let Some(calibration) = calibration else { return Ok(()) };
    manifest.calibration = Some(bundle::CALIBRATION_FILE_NAME.into());
    writer.bytes(bundle::CALIBRATION_FILE_NAME, calibration.to_toml().as_bytes())
}

fn write_report(writer: &BundleWriter, report: &Report) -> Result<(), Failure> {
    let json = serde_json::to_vec_pretty(report).map_err(|e| Failure::storage("write report.json", e))?;
    writer.bytes("report.json", &json).map_err(|e| Failure::storage("write the result", e))
}

fn write_frames(
    writer: &BundleWriter,
    decode: &DecodeSettings,
    frames: &[SharedPlane],
) -> Result<(), StorageError> {
    let mut out = writer.frames(frames.len(), (decode.width, decode.height), decode.camera.bit_depth)?;
    for frame in frames {
        out.push(frame.plane())?;
    }
    out.finish()
}

fn write_cloud(writer: &BundleWriter, results: &Results) -> Result<(), StorageError> {
    let Some(reconstruction) = &results.outcome.reconstruction else { return Ok(()) };
    let world = results.job.calibration.and_then(|calibration| calibration.world_from_camera.as_ref());
    let intensity = &results.outcome.decoded.intensity;
    writer.write_with("cloud.ply", |out| {
        match world {
            Some(pose) => {
                write_ply(out, &reconstruction.cloud.transformed(pose), intensity, CloudFrame::World)
            }
            None => write_ply(out, &reconstruction.cloud, intensity, CloudFrame::Camera),
        }
        .map(|_| ())
    })
}

/// Time in milliseconds and the process: unique on a machine, and sorted by time.
pub fn new_id() -> String {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).unwrap_or_default();
    format!("{:012x}-{:x}", since.as_millis(), std::process::id())
}
