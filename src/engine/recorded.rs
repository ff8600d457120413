//! Decoding recorded frames, ours or foreign, to maps, cloud and report.

use std::{path::Path, time::Instant};

use polscan_patterns::{Mode, ProjectorSize, Role, Sequence};

use super::{Failure, Label, Results, results};
use crate::{
    cloud::ReconstructSettings,
    geometry::{Calibration, ReadHints},
    pipeline::{self, Context, Job, PipelineError},
    report::{CaptureSummary, NamedRegion, Reason, Report, Timings, check_regions},
    store::{
        Bundle, BundleWriter, FrameSet, Limits, Manifest, Policy,
        manifest::{Capture, Processing, Volume},
        source::read_calibration,
    },
};

/// Volume of a capture that states none: no limit but that points lie in front of the camera.
const UNBOUNDED: Volume = Volume { near_mm: 1e-3, far_mm: 1e9 };

/// A bundle to decode, and what comes before the bundle's own settings.
pub struct Recorded<'a> {
    /// Folder with manifest.json, or the manifest itself.
    pub bundle: &'a Path,
    /// Calibration that comes before the bundle's own.
    pub calibration: Option<&'a Path>,
    /// Whether the first device of a stereo result is the projector.
    pub projector_left: bool,
    /// Millimetres per unit of length of another tool's calibration.
    pub calibration_unit_mm: f64,
    /// Mode that comes before the bundle's own.
    pub mode: Option<Mode>,
    /// Regions to measure; those of the bundle where there are none.
    pub regions: &'a [NamedRegion],
}

/// Decodes what was recorded and writes the result into the folder `out`, which must be absent or empty. Where `label`
/// has no name or tags, those of the recording are kept.
///
/// # Errors
/// Bad data and storage; unlike a scan, a decode without a result leaves nothing, since the frames lie where they were.
pub fn decode(args: &Recorded, label: Label, out: &Path) -> Result<Report, Failure> {
    let start = Instant::now();
    let operation = || format!("decode {}", args.bundle.display());
    let bundle =
        Bundle::open(args.bundle, Policy::Local, args.mode).map_err(|e| Failure::data(operation(), e))?;
    // Refused before the work rather than after it.
    let writer = BundleWriter::create(out, Some(bundle.folder()), 0)
        .map_err(|error| Failure::storage("write the result", error))?;
    let frames = bundle.frames(&Limits::default()).map_err(|e| Failure::data(operation(), e))?;
    let unlike = bundle.verify(&frames).map_err(|e| Failure::data(operation(), e))?;
    let load_ms = start.elapsed().as_secs_f64() * 1e3;

    let (sequence, calibration) =
        resolve(args, &bundle, &frames).map_err(|e| Failure::data(operation(), e))?;
    let manifest = bundle.manifest();
    let processing = manifest.processing.clone().unwrap_or_default();
    let regions = if args.regions.is_empty() { processing.regions.clone() } else { args.regions.to_vec() };
    check_regions(&regions, (frames.width, frames.height)).map_err(|e| Failure::data(operation(), e))?;
    let volume = processing.volume.unwrap_or(UNBOUNDED);
    let job = Job {
        roles: &sequence.roles,
        planes: &frames.planes,
        decode: manifest.decode_settings(&sequence, (frames.width, frames.height), frames.sample_bits),
        calibration: calibration.as_ref(),
        reconstruct: ReconstructSettings {
            near_mm: volume.near_mm,
            far_mm: volume.far_mm,
            row_gate_px: processing.row_gate_px,
        },
    };
    let outcome = pipeline::run(&job).map_err(|error: PipelineError| Failure::data(operation(), error))?;

    let truth = bundle.truth((frames.width, frames.height)).map_err(|e| Failure::data(operation(), e))?;
    let capture = manifest.capture.as_ref().map(|capture| summary(&manifest.sequence, capture));
    let notes: Vec<String> = bundle.notes().iter().chain(&frames.notes).chain(&unlike).cloned().collect();
    let found: Vec<Reason> = manifest.capture.iter().flat_map(found).collect();
    let context = Context {
        truth: truth.as_ref(),
        capture: capture.as_ref(),
        found: &found,
        regions: &regions,
        simulated: truth.is_some() || manifest.rig.as_ref().is_some_and(|rig| rig.camera.driver == "sim"),
        notes: &notes,
    };
    let results = Results {
        job: &job,
        outcome: &outcome,
        context: &context,
        timings: Timings { load: Some(load_ms), ..outcome.timings },
        frames: None,
    };
    let mut result = Manifest::new(&sequence, bundle.absolute_frames());
    result.id = Some(label.id);
    result.label = label.label.or_else(|| manifest.label.clone());
    result.tags = if label.tags.is_empty() { manifest.tags.clone() } else { label.tags };
    result.rig = manifest.rig.clone();
    if let Some(rig) = &mut result.rig {
        rig.calibration_id = calibration.as_ref().map(Calibration::id);
    }
    result.settings = manifest.settings.clone();
    result.capture = manifest.capture.clone();
    result.source = Some(bundle.origin(&frames));
    result.processing = Some(Processing { regions: regions.clone(), ..processing });
    results::write(writer, result, &results)
}

/// What the sequencer found when the frames were captured.
fn found(capture: &Capture) -> Vec<Reason> {
    capture.failure.iter().cloned().chain(capture.notes.findings.iter().map(Reason::from)).collect()
}

/// What a recorded capture says of itself.
fn summary(sequence: &[Role], capture: &Capture) -> CaptureSummary {
    let evidence: Vec<_> = sequence
        .iter()
        .zip(&capture.frames)
        .map(|(role, evidence)| (*role, evidence.receipt, evidence.stamp))
        .collect();
    CaptureSummary {
        seconds: capture.seconds,
        limit_seconds: capture.limit_seconds,
        latency_ms: capture.latency_ms,
        hold_frames: capture.hold_refreshes,
        timing_measured: capture.timing_measured,
        retaken: capture.retaken.clone(),
        statistics: capture.statistics,
        ..CaptureSummary::default()
    }
    .with_evidence(&evidence)
}

/// Sequence and calibration; each may know the projector's size when the other does not.
fn resolve(
    args: &Recorded,
    bundle: &Bundle,
    frames: &FrameSet,
) -> Result<(Sequence, Option<Calibration>), Box<dyn std::error::Error + Send + Sync>> {
    let manifest = bundle.manifest();
    let mut hints = ReadHints {
        camera_size: Some((frames.width as u32, frames.height as u32)),
        swap: args.projector_left,
        unit_mm: args.calibration_unit_mm,
        ..ReadHints::default()
    };
    hints.projector_size = manifest.projector.map(|size| (size.width, size.height));
    let calibration = match args.calibration {
        Some(path) => Some(read_calibration(path, &hints)?),
        None => match bundle.calibration()? {
            Some((path, bytes)) => {
                let name = path.display().to_string();
                Some(Calibration::from_bytes(&bytes, &name, &hints)?)
            }
            None => None,
        },
    };
    let size_of = |calibrated: &Calibration| {
        let (width, height) = calibrated.projector.as_ref()?.lens.size();
        Some(ProjectorSize { width, height })
    };
    let sequence = manifest.resolve_sequence(args.mode, calibration.as_ref().and_then(size_of))?;
    if let Some(calibrated) = &calibration {
        let camera = (frames.width as u32, frames.height as u32);
        let size = sequence.size();
        calibrated.check_sizes(camera, (size.width, size.height))?;
    }
    Ok((sequence, calibration))
}
