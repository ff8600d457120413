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
        source::{SensorPart, read_calibration_for},
    },
    truth::Truth,
};

/// Volume of a capture that states none: no limit but that points lie in front of the camera.
const UNBOUNDED: Volume = Volume { near_mm: 1e-3, far_mm: 1e9 };

/// A bundle to decode, and what comes before the bundle's own settings.
#[derive(Debug, Clone, Copy)]
pub struct DecodeRequest<'a> {
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

/// A recorded bundle, read and checked.
pub struct Recorded {
    /// Manifest and folder.
    pub bundle: Bundle,
    /// Frames, in the order of the sequence.
    pub frames: FrameSet,
    sequence: Sequence,
    calibration: Option<Calibration>,
    regions: Vec<NamedRegion>,
    processing: Processing,
    /// Truth of a simulated rig.
    pub truth: Option<Truth>,
    capture: Option<CaptureSummary>,
    found: Vec<Reason>,
    notes: Vec<String>,
}

impl Recorded {
    /// Reads frames, calibration and truth of `bundle`; regions of the command line come before the bundle's.
    pub fn read(args: &DecodeRequest, bundle: Bundle) -> Result<Self, Failure> {
        let failed = |error: Box<dyn std::error::Error + Send + Sync>| Failure::data(operation(args), error);
        let frames = bundle.frames(&Limits::default()).map_err(|e| failed(e.into()))?;
        let unlike = bundle.verify(&frames).map_err(|e| failed(e.into()))?;
        let (sequence, calibration) = resolve(args, &bundle, &frames).map_err(failed)?;
        let manifest = bundle.manifest();
        let processing = manifest.processing.clone().unwrap_or_default();
        let regions =
            if args.regions.is_empty() { processing.regions.clone() } else { args.regions.to_vec() };
        check_regions(&regions, (frames.width, frames.height)).map_err(|e| failed(e.into()))?;
        let truth = bundle.truth((frames.width, frames.height)).map_err(|e| failed(e.into()))?;
        let capture = manifest.capture.as_ref().map(|capture| summary(&manifest.sequence, capture));
        let notes = bundle.notes().iter().chain(&frames.notes).chain(&unlike).cloned().collect();
        let found = manifest.capture.iter().flat_map(found).collect();
        Ok(Self { frames, sequence, calibration, regions, processing, truth, capture, found, notes, bundle })
    }

    /// What is decoded, and how.
    pub fn job(&self) -> Job<'_> {
        let volume = self.processing.volume.unwrap_or(UNBOUNDED);
        let size = (self.frames.width, self.frames.height);
        Job {
            roles: &self.sequence.roles,
            planes: &self.frames.planes,
            decode: self.bundle.manifest().decode_settings(&self.sequence, size, self.frames.sample_bits),
            calibration: self.calibration.as_ref(),
            ahead: None,
            reconstruct: ReconstructSettings {
                near_mm: volume.near_mm,
                far_mm: volume.far_mm,
                row_gate_px: self.processing.row_gate_px,
            },
        }
    }

    /// What the report says besides.
    pub fn context(&self) -> Context<'_> {
        let rig = self.bundle.manifest().rig.as_ref();
        Context {
            truth: self.truth.as_ref(),
            capture: self.capture.as_ref(),
            found: &self.found,
            regions: &self.regions,
            extinction_ratio: self.processing.extinction_ratio,
            simulated: self.truth.is_some() || rig.is_some_and(|rig| rig.camera.driver == "sim"),
            notes: &self.notes,
        }
    }
}

fn operation(args: &DecodeRequest) -> String {
    format!("decode {}", args.bundle.display())
}

/// Decodes what was recorded and writes the result into the folder `out`, which must be absent or empty. Where `label`
/// has no name or tags, those of the recording are kept.
///
/// # Errors
/// Bad data and storage; unlike a scan, a decode without a result leaves nothing, since the frames lie where they were.
pub fn decode(args: &DecodeRequest, label: Label, out: &Path) -> Result<Report, Failure> {
    let start = Instant::now();
    let bundle =
        Bundle::open(args.bundle, Policy::Local, args.mode).map_err(|e| Failure::data(operation(args), e))?;
    // Refused before the work rather than after it.
    let writer = BundleWriter::create(out, Some(bundle.folder()), 0)
        .map_err(|error| Failure::storage("write the result", error))?;
    let recorded = Recorded::read(args, bundle)?;
    let load_ms = start.elapsed().as_secs_f64() * 1e3;
    let (job, context) = (recorded.job(), recorded.context());
    let outcome =
        pipeline::run(&job).map_err(|error: PipelineError| Failure::data(operation(args), error))?;
    let results = Results {
        job: &job,
        outcome: &outcome,
        context: &context,
        timings: Timings { load: Some(load_ms), ..outcome.timings },
        frames: None,
    };
    let (bundle, manifest) = (&recorded.bundle, recorded.bundle.manifest());
    let mut result = Manifest::new(&recorded.sequence, bundle.absolute_frames());
    result.id = Some(label.id);
    result.label = label.label.or_else(|| manifest.label.clone());
    result.tags = if label.tags.is_empty() { manifest.tags.clone() } else { label.tags };
    result.rig = manifest.rig.clone();
    if let Some(rig) = &mut result.rig {
        rig.calibration_id = recorded.calibration.as_ref().map(Calibration::id);
    }
    result.settings = manifest.settings.clone();
    result.capture = manifest.capture.clone();
    result.source = Some(bundle.origin(&recorded.frames));
    let regions = recorded.regions.clone();
    result.processing = Some(Processing { regions, ..recorded.processing.clone() });
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
        synchrony: capture.synchrony.clone(),
        retaken: capture.retaken.clone(),
        references_retaken: capture.notes.references_retaken.clone(),
        discarded: capture.notes.discarded.clone(),
        statistics: capture.statistics.clone(),
        ..CaptureSummary::default()
    }
    .with_evidence(&evidence)
}

/// The part of the sensor that the frames were taken of, where that is recorded.
fn part(manifest: &Manifest) -> Option<SensorPart> {
    let camera = &manifest.rig.as_ref()?.camera;
    let region = manifest.settings.as_ref()?.applied.settings.region?;
    Some(SensorPart { sensor: (camera.sensor_width, camera.sensor_height), origin: (region.x, region.y) })
}

/// Sequence and calibration; each may know the projector's size when the other does not.
fn resolve(
    args: &DecodeRequest,
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
        Some(path) => Some(read_calibration_for(path, &hints, part(manifest))?),
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
