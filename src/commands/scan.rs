//! `polscan scan`: one scan on the configured rig.

use std::{path::Path, time::Duration};

use polscan_patterns::{ProjectorSize, Sequence};

use super::{
    Failure,
    failure::FAILED,
    progress::Bar,
    results::{self, Results},
};
use crate::{
    app::{Rig, RigError},
    cloud::ReconstructSettings,
    config::Settings,
    decode::{Accumulator, CameraResponse, DecodeSettings, NoiseModel, SharedPlane},
    geometry::{Calibration, ReadHints},
    pipeline::{self, Context, Job},
    report::{self, CaptureSummary, Diagnosis, NamedRegion, Reason, Report, ReportInput, Size, Verdict},
    sequencer::{
        CancelFlag, CaptureFailure, CaptureRecord, PartialCapture, Plan, PlanError, PlanOptions, Progress,
        capture,
    },
    store::{
        BundleWriter, Manifest,
        bundle::FRAMES_FILE_NAME,
        manifest::{self, FrameFiles, Processing, Volume},
        source::read_calibration,
    },
    verify::{PairSumJudge, shared_plane},
};

/// Bytes of maps, cloud and pictures per camera pixel, generously: five float maps, a cloud of 30 bytes a point, truth.
const RESULT_BYTES_PER_PIXEL: u64 = 90;

/// Scans and writes; returns the exit code.
pub fn scan(settings: &Settings, regions: &[NamedRegion], out: &Path, json: bool) -> Result<u8, Failure> {
    // Checked again with the size of the scan, but an occupied folder is refused before the rig is touched.
    drop(create_writer(out, 0)?);
    let mut rig = Rig::open(settings).map_err(rig_failure)?;
    let applied = device("apply the camera settings", rig.camera.apply(&settings.camera))?;
    let info = rig.projector.info().clone();
    let size = ProjectorSize { width: info.width, height: info.height };
    let sequence = Sequence::new(settings.mode, size).map_err(|e| Failure::data("make the patterns", e))?;
    let calibration = calibration(settings, (applied.width, applied.height), size)?;
    for region in regions {
        region
            .check(applied.width as usize, applied.height as usize)
            .map_err(|e| Failure::data("measure a region", e))?;
    }
    let pixels = u64::from(applied.width) * u64::from(applied.height);
    let sample_bytes = if applied.settings.format.bit_depth() > 8 { 2 } else { 1 };
    let writer =
        create_writer(out, pixels * (sequence.roles.len() as u64 * sample_bytes + RESULT_BYTES_PER_PIXEL))?;

    let camera = CameraResponse {
        bit_depth: applied.settings.format.bit_depth(),
        black_level_dn: applied.black_level_dn,
        saturation_dn: applied.saturation_dn,
        noise: applied.noise.map(|noise| NoiseModel {
            gain_dn_per_electron: noise.gain_dn_per_electron,
            read_noise_dn: noise.read_noise_dn,
        }),
    };
    let decode = DecodeSettings {
        mode: settings.mode,
        column: sequence.column,
        row: sequence.row,
        width: applied.width as usize,
        height: applied.height as usize,
        camera,
        thresholds: settings.thresholds,
    };
    let plan = Plan::new(sequence.clone(), settings.polarization, &info, applied, &plan_options(settings))
        .map_err(|error: PlanError| setup("plan the capture", error))?;
    // What no frames can be decoded with is refused before any is captured.
    Accumulator::new(decode.clone()).map_err(|error| setup("decode with these settings", error))?;
    let bar = Bar::new(sequence.roles.len() as u64);
    let taken = take(&mut rig, &plan, PairSumJudge::new(sequence.clone(), camera, settings.thresholds), &bar);
    bar.say("decoding");

    let mut manifest = Manifest::new(&sequence, FrameFiles::Npy(FRAMES_FILE_NAME.into()));
    manifest.id = Some(results::new_id());
    manifest.rig = Some(manifest::Rig {
        name: settings.raw.rig.name.clone(),
        camera: rig.camera.info().clone(),
        projector: info,
        polarization: settings.polarization,
        calibration_id: calibration.as_ref().map(Calibration::id),
    });
    let volume = Volume { near_mm: settings.raw.volume.near_mm, far_mm: settings.raw.volume.far_mm };
    manifest.processing = Some(Processing {
        thresholds: settings.thresholds,
        volume: Some(volume),
        row_gate_px: settings.raw.decode.row_gate_px,
        regions: regions.to_vec(),
    });
    let setup = Setup { settings, rig: &rig, decode, calibration: calibration.as_ref(), volume, regions };
    let report = match taken {
        Ok(record) => finish(&setup, &record, manifest, writer)?,
        Err(CaptureFailure { error, partial }) => {
            keep(&setup, &partial_record(&plan, *partial), Reason::from(&*error), manifest, writer)?
        }
    };
    drop(bar);
    results::print(&report, out, json);
    Ok(if report.verdict == Verdict::Failed { FAILED } else { 0 })
}

/// What the end of a scan needs from its beginning.
struct Setup<'a> {
    settings: &'a Settings,
    rig: &'a Rig,
    decode: DecodeSettings,
    calibration: Option<&'a Calibration>,
    volume: Volume,
    regions: &'a [NamedRegion],
}

/// Decodes a complete capture and writes everything.
fn finish(
    setup: &Setup,
    record: &CaptureRecord,
    mut manifest: Manifest,
    writer: BundleWriter,
) -> Result<Report, Failure> {
    let roles: Vec<_> = record.frames.iter().map(|captured| captured.role).collect();
    let planes: Vec<SharedPlane> =
        record.frames.iter().map(|captured| shared_plane(&captured.frame)).collect();
    let job = Job {
        roles: &roles,
        planes: &planes,
        decode: setup.decode.clone(),
        calibration: setup.calibration,
        reconstruct: ReconstructSettings {
            near_mm: setup.volume.near_mm,
            far_mm: setup.volume.far_mm,
            row_gate_px: setup.settings.raw.decode.row_gate_px,
        },
    };
    manifest.record_capture(record, setup.settings.camera.clone());
    let outcome = match pipeline::run(&job) {
        Ok(outcome) => outcome,
        Err(error) => {
            let message = format!("the frames were captured but cannot be decoded: {error}");
            let reason = Reason::failed(Diagnosis::DecodeFailed, message, serde_json::Value::Null);
            return keep(setup, record, reason, manifest, writer);
        }
    };
    let truth = setup.rig.truth();
    let summary = CaptureSummary::from(record);
    let found: Vec<Reason> = record.notes.findings.iter().map(Reason::from).collect();
    let context = Context {
        truth: truth.as_ref(),
        capture: Some(&summary),
        found: &found,
        regions: setup.regions,
        simulated: setup.rig.is_simulated(),
        notes: &[],
    };
    let results = Results {
        job: &job,
        outcome: &outcome,
        context: &context,
        timings: outcome.timings,
        frames: Some(&planes),
    };
    results::write(writer, manifest, &results)
}

/// Keeps the frames of a capture that came to no result, with a report that says why.
fn keep(
    setup: &Setup,
    record: &CaptureRecord,
    reason: Reason,
    mut manifest: Manifest,
    writer: BundleWriter,
) -> Result<Report, Failure> {
    manifest.sequence = record.frames.iter().map(|captured| captured.role).collect();
    manifest.record_capture(record, setup.settings.camera.clone());
    if let Some(capture) = &mut manifest.capture {
        capture.failure = Some(reason.clone());
    }
    let planes: Vec<SharedPlane> =
        record.frames.iter().map(|captured| shared_plane(&captured.frame)).collect();
    let summary = CaptureSummary::from(record);
    let found: Vec<Reason> =
        std::iter::once(reason).chain(record.notes.findings.iter().map(Reason::from)).collect();
    let simulated = setup.rig.is_simulated();
    results::write_unfinished(writer, manifest, &setup.decode, &planes, setup.calibration, |timings| {
        let size = Size { width: setup.decode.width, height: setup.decode.height };
        report::build(&ReportInput {
            capture: Some(&summary),
            found: &found,
            timings,
            simulated,
            threads: rayon::current_num_threads(),
            ..ReportInput::new(setup.decode.mode, size, planes.len())
        })
    })
}

/// What an unfinished capture left, in the form of a finished one.
fn partial_record(plan: &Plan, partial: PartialCapture) -> CaptureRecord {
    CaptureRecord {
        frames: partial.frames,
        retaken: partial.retaken,
        seconds: partial.seconds,
        limit_seconds: plan.limit().as_secs_f64(),
        latency_ms: plan.timing.trigger_delay.as_secs_f64() * 1e3,
        hold_refreshes: plan.timing.hold_refreshes,
        timing_measured: plan.timing.measured,
        applied: plan.applied.clone(),
        statistics: partial.statistics.unwrap_or_default(),
        notes: partial.notes,
    }
}

fn take(
    rig: &mut Rig,
    plan: &Plan,
    mut judge: PairSumJudge,
    bar: &Bar,
) -> Result<CaptureRecord, CaptureFailure> {
    let cancel = CancelFlag::default();
    cancel_on_interrupt(&cancel);
    let mut progress = |progress: Progress<'_>| match progress {
        Progress::Started { .. } => bar.say("projecting"),
        Progress::Captured { done, .. } => bar.frames(done as u64),
        Progress::Accepted(_) => {}
        Progress::Retaking { roles, .. } => {
            let names: Vec<String> = roles.iter().map(ToString::to_string).collect();
            bar.say(format!("again: {}", names.join(", ")));
        }
    };
    capture(&mut *rig.projector, &mut *rig.camera, &*rig.clock, plan, &mut judge, &mut progress, &cancel)
}

/// An interrupt from the terminal cancels the capture, which leaves the projector black. A second one ends the program.
fn cancel_on_interrupt(cancel: &CancelFlag) {
    let cancel = cancel.clone();
    let installed = ctrlc::set_handler(move || {
        if cancel.is_cancelled() {
            std::process::exit(130);
        }
        cancel.cancel();
        eprintln!("polscan: stopping; interrupt again to end at once");
    });
    if let Err(error) = installed {
        tracing::warn!(%error, "an interrupt will end the program without a black projector");
    }
}

fn create_writer(out: &Path, bytes: u64) -> Result<BundleWriter, Failure> {
    BundleWriter::create(out, None, bytes).map_err(|error| Failure::storage("write the result", error))
}

fn plan_options(settings: &Settings) -> PlanOptions {
    let (projector, limits) = (&settings.raw.projector, &settings.raw.capture);
    PlanOptions {
        hold_refreshes: (projector.hold_refreshes > 0).then_some(projector.hold_refreshes),
        trigger_delay: (projector.trigger_delay_ms > 0.0)
            .then(|| Duration::from_secs_f64(projector.trigger_delay_ms * 1e-3)),
        retakes_each: limits.retakes_per_pair,
        retakes_total: limits.retakes_per_scan,
        ..PlanOptions::default()
    }
}

fn calibration(
    settings: &Settings,
    camera: (u32, u32),
    projector: ProjectorSize,
) -> Result<Option<Calibration>, Failure> {
    let Some(path) = settings.calibration.as_ref().map(|calibration| &calibration.path) else {
        return Ok(None);
    };
    let projector = (projector.width, projector.height);
    let hints =
        ReadHints { camera_size: Some(camera), projector_size: Some(projector), ..ReadHints::default() };
    let operation = || format!("use the calibration {}", path.display());
    let calibrated = read_calibration(path, &hints).map_err(|error| Failure::data(operation(), error))?;
    calibrated.check_sizes(camera, projector).map_err(|error| Failure::data(operation(), error))?;
    Ok(Some(calibrated))
}

fn device<T>(
    operation: &'static str,
    result: Result<T, polscan_drivers::error::DeviceError>,
) -> Result<T, Failure> {
    result.map_err(|source| Failure::Device { operation, source })
}

/// Settings that do not go together.
fn setup(operation: &'static str, error: impl std::error::Error + Send + Sync + 'static) -> Failure {
    Failure::Setup { operation, source: Box::new(error) }
}

/// A rig that cannot be opened, as a failure of the command.
pub fn rig_failure(error: RigError) -> Failure {
    match error {
        error @ RigError::Sim(_) => setup("set up the rig", error),
        RigError::Device(source) => Failure::Device { operation: "open the devices", source },
        other => Failure::NoDevice { operation: "open the devices", message: other.to_string() },
    }
}
