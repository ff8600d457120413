//! The stages of a scan.

use polscan_drivers::camera::{AppliedSettings, StreamStatistics};
use polscan_patterns::{Mode, ProjectorSize, Role, Sequence};

use super::{
    Failure,
    results::{self, Results},
    setup::{calibration, plan, response, setup},
};
use crate::{
    app::{Rig, RigError},
    cloud::ReconstructSettings,
    config::Settings,
    decode::{Accumulator, DecodeSettings, SharedPlane},
    geometry::Calibration,
    pipeline::{self, Ahead, Context, Job, PipelineError},
    report::{
        self, CaptureSummary, Diagnosis, NamedRegion, Reason, Report, ReportInput, Size, check_regions,
    },
    sequencer::{
        CancelFlag, CaptureFailure, CaptureRecord, PartialCapture, Plan, Progress, Synchrony, capture,
    },
    store::{
        BundleWriter, Manifest,
        bundle::FRAMES_FILE_NAME,
        manifest::{self, FrameFiles, Processing, Volume},
    },
    truth::Truth,
    verify::{PairSumJudge, shared_plane},
};

/// Bytes of maps, cloud and pictures per camera pixel, generously: five float maps, a cloud of 30 bytes a point, truth.
const RESULT_BYTES_PER_PIXEL: u64 = 90;

/// A scan that can begin: the camera has its settings, and everything that can be refused has been checked.
#[derive(Debug)]
pub struct Scan {
    plan: Plan,
    decode: DecodeSettings,
    calibration: Option<Calibration>,
    ahead: Ahead,
    reconstruct: ReconstructSettings,
    regions: Vec<NamedRegion>,
    rig: manifest::Rig,
    settings: Settings,
    simulated: bool,
}

/// What a capture left in memory, complete or not. The object may move from here on.
#[derive(Debug)]
pub struct Taken {
    record: CaptureRecord,
    /// Why the capture did not come to its end.
    failure: Option<Reason>,
    truth: Option<Truth>,
}

/// How a scan is called.
#[derive(Debug, Clone, Default)]
pub struct Label {
    /// Unique identifier.
    pub id: String,
    /// Name for a person.
    pub label: Option<String>,
    /// For sorting and searching.
    pub tags: Vec<String>,
}

impl Taken {
    /// Why the capture did not come to its end; its frames are kept all the same.
    pub fn failure(&self) -> Option<&Reason> {
        self.failure.as_ref()
    }

    /// What the camera's stream counted.
    pub fn statistics(&self) -> &StreamStatistics {
        &self.record.statistics
    }

    /// What the rig knows of its scene, for a simulated one.
    pub fn truth(&self) -> Option<&Truth> {
        self.truth.as_ref()
    }

    /// How the capture went.
    pub fn record(&self) -> &CaptureRecord {
        &self.record
    }
}

/// The frames of a capture as the decoder takes them, and what the capture says of itself.
struct TakenFrames {
    roles: Vec<Role>,
    planes: Vec<SharedPlane>,
    summary: CaptureSummary,
    found: Vec<Reason>,
}

impl TakenFrames {
    fn new(taken: &Taken) -> Self {
        let frames = &taken.record.frames;
        Self {
            roles: frames.iter().map(|captured| captured.role).collect(),
            planes: frames.iter().map(|captured| shared_plane(&captured.frame)).collect(),
            summary: CaptureSummary::from(&taken.record),
            found: taken.record.notes.findings.iter().map(Reason::from).collect(),
        }
    }

    fn context<'a>(&'a self, scan: &'a Scan, taken: &'a Taken) -> Context<'a> {
        Context {
            truth: taken.truth.as_ref(),
            capture: Some(&self.summary),
            found: &self.found,
            regions: &scan.regions,
            extinction_ratio: scan.settings.extinction_ratio(),
            simulated: scan.simulated,
            notes: &[],
        }
    }
}

impl Scan {
    /// Applies the settings to the camera and checks all that can be checked before the first picture.
    pub fn prepare(settings: &Settings, regions: &[NamedRegion], rig: &mut Rig) -> Result<Self, Failure> {
        let device = |source| Failure::Device { operation: "apply the camera settings", source };
        let applied = rig.camera.apply(&settings.camera).map_err(device)?;
        let (camera, projector) = (rig.camera.info().clone(), rig.projector.info().clone());
        let applied = settings
            .measured
            .camera(&camera, applied)
            .map_err(|stale| setup("use the measured noise", stale))?;
        let projector = settings
            .measured
            .projector(projector)
            .map_err(|stale| setup("use the measured timing", stale))?;
        if let Some(polarization) = &settings.measured.polarization {
            let channels = [settings.raw.projector.horizontal.as_str(), &settings.raw.projector.vertical];
            polarization
                .check(&camera, &projector, channels)
                .map_err(|stale| setup("use the measured polarization", stale))?;
        }
        let size = ProjectorSize { width: projector.width, height: projector.height };
        let sequence =
            Sequence::new(settings.mode, size).map_err(|e| Failure::data("make the patterns", e))?;
        let calibration = calibration(settings, &applied, &camera, size)?;
        let (width, height) = (applied.width as usize, applied.height as usize);
        check_regions(regions, (width, height)).map_err(|e| Failure::data("measure a region", e))?;
        let decode = DecodeSettings {
            mode: settings.mode,
            column: sequence.column,
            row: sequence.row,
            width,
            height,
            camera: response(&applied),
            thresholds: settings.thresholds,
        };
        let plan = plan(settings, sequence, &projector, &camera, applied)?;
        // What no frames can be decoded with is refused before any is captured.
        Accumulator::new(decode.clone()).map_err(|error| setup("decode with these settings", error))?;
        let described = manifest::Rig {
            name: settings.raw.rig.name.clone(),
            camera,
            projector,
            polarization: settings.polarization,
            calibration_id: calibration.as_ref().map(Calibration::id),
        };
        Ok(Self {
            plan,
            decode,
            calibration,
            ahead: Ahead::default(),
            reconstruct: ReconstructSettings {
                near_mm: settings.raw.volume.near_mm,
                far_mm: settings.raw.volume.far_mm,
                row_gate_px: settings.raw.decode.row_gate_px,
            },
            regions: regions.to_vec(),
            rig: described,
            settings: settings.clone(),
            simulated: rig.is_simulated(),
        })
    }

    /// Number of frames that the capture takes.
    pub fn frames(&self) -> usize {
        self.plan.sequence.roles.len()
    }

    /// Mode of the sequence.
    pub fn mode(&self) -> Mode {
        self.decode.mode
    }

    /// What the camera was set to.
    pub fn applied(&self) -> &AppliedSettings {
        &self.plan.applied
    }

    /// Bytes of all its frames.
    pub fn frame_bytes(&self) -> u64 {
        let pixels = self.decode.width as u64 * self.decode.height as u64;
        let sample_bytes = if self.decode.camera.bit_depth > 8 { 2 } else { 1 };
        pixels * self.frames() as u64 * sample_bytes
    }

    /// What a spool of this scan begins with: the manifest as far as it is known before the first frame, and the
    /// calibration.
    pub fn preface(&self, label: Label) -> Result<(Vec<u8>, Option<String>), Failure> {
        let mut manifest = self.manifest(label);
        manifest.record_decode(&self.decode);
        let nothing = partial_record(&self.plan, PartialCapture::default());
        manifest.record_capture(&nothing, self.settings.camera.clone());
        let json = manifest.to_json().map_err(|error| Failure::storage("spool the scan", error))?;
        Ok((json, self.calibration.as_ref().map(Calibration::to_toml)))
    }

    /// Bytes that the result may need on the disk, generously.
    pub fn bytes(&self) -> u64 {
        let pixels = self.decode.width as u64 * self.decode.height as u64;
        self.frame_bytes() + pixels * RESULT_BYTES_PER_PIXEL
    }

    /// Captures all frames. Blocks until the last one has come, or something stands in the way, or `cancel` asks to stop;
    /// the projector is black afterwards.
    pub fn capture(
        &self,
        rig: &mut Rig,
        progress: &mut dyn FnMut(Progress<'_>),
        cancel: &CancelFlag,
    ) -> Taken {
        self.ahead.begin(self.calibration.as_ref());
        let DecodeSettings { camera, thresholds, .. } = self.decode;
        let mut judge = PairSumJudge::new(self.plan.sequence.clone(), camera, thresholds);
        let Rig { projector, camera, clock, .. } = rig;
        let taken =
            capture(&mut **projector, &mut **camera, &**clock, &self.plan, &mut judge, progress, cancel);
        let truth = rig.truth();
        match taken {
            Ok(record) => Taken { record, failure: None, truth },
            Err(CaptureFailure { error, partial }) => Taken {
                record: partial_record(&self.plan, *partial),
                failure: Some(Reason::from(&*error)),
                truth,
            },
        }
    }

    /// Decodes what was taken and writes everything; where that cannot be, or `cancel` asks to stop before it is written,
    /// keeps the frames with a report that says why.
    ///
    /// # Errors
    /// Only storage: whatever is wrong with the frames is a verdict of the report.
    pub fn finish(
        &self,
        taken: &Taken,
        label: Label,
        writer: BundleWriter,
        cancel: &CancelFlag,
    ) -> Result<Report, Failure> {
        let given_up = || {
            let message =
                "it was cancelled after the frames had come; decode them if they are wanted after all";
            Reason::failed(Diagnosis::Cancelled, message, serde_json::Value::Null)
        };
        let mut manifest = self.manifest(label);
        manifest.record_capture(&taken.record, self.settings.camera.clone());
        if let Some(reason) = &taken.failure {
            return self.keep(taken, reason.clone(), manifest, writer);
        }
        if cancel.is_cancelled() {
            return self.keep(taken, given_up(), manifest, writer);
        }
        let frames = TakenFrames::new(taken);
        let job = self.job(&frames);
        let outcome = match pipeline::run(&job) {
            Ok(outcome) => outcome,
            Err(error) => {
                let message = format!("the frames were captured but cannot be decoded: {error}");
                let reason = Reason::failed(Diagnosis::DecodeFailed, message, serde_json::Value::Null);
                return self.keep(taken, reason, manifest, writer);
            }
        };
        if cancel.is_cancelled() {
            return self.keep(taken, given_up(), manifest, writer);
        }
        let context = frames.context(self, taken);
        let results = Results {
            job: &job,
            outcome: &outcome,
            context: &context,
            timings: outcome.timings,
            frames: Some(&frames.planes),
        };
        results::write(writer, manifest, &results)
    }

    /// Decodes what was taken and looks at it, without writing anything.
    ///
    /// # Errors
    /// Where the frames cannot be decoded.
    pub fn examine<R>(&self, taken: &Taken, look: impl FnOnce(&Results) -> R) -> Result<R, PipelineError> {
        let frames = TakenFrames::new(taken);
        let job = self.job(&frames);
        let outcome = pipeline::run(&job)?;
        let context = frames.context(self, taken);
        let (timings, frames) = (outcome.timings, Some(&frames.planes[..]));
        Ok(look(&Results { job: &job, outcome: &outcome, context: &context, timings, frames }))
    }

    fn job<'a>(&'a self, frames: &'a TakenFrames) -> Job<'a> {
        Job {
            roles: &frames.roles,
            planes: &frames.planes,
            decode: self.decode.clone(),
            calibration: self.calibration.as_ref(),
            ahead: Some(&self.ahead),
            reconstruct: self.reconstruct,
        }
    }

    fn manifest(&self, label: Label) -> Manifest {
        let mut manifest = Manifest::new(&self.plan.sequence, FrameFiles::Npy(FRAMES_FILE_NAME.into()));
        manifest.id = Some(label.id);
        manifest.label = label.label;
        manifest.tags = label.tags;
        manifest.rig = Some(self.rig.clone());
        let ReconstructSettings { near_mm, far_mm, row_gate_px } = self.reconstruct;
        manifest.processing = Some(Processing {
            thresholds: self.settings.thresholds,
            volume: Some(Volume { near_mm, far_mm }),
            row_gate_px,
            regions: self.regions.clone(),
            extinction_ratio: self.settings.extinction_ratio(),
        });
        manifest
    }

    /// Keeps the frames of a capture that came to no result, with a report that says why.
    fn keep(
        &self,
        taken: &Taken,
        reason: Reason,
        mut manifest: Manifest,
        writer: BundleWriter,
    ) -> Result<Report, Failure> {
        let record = &taken.record;
        manifest.sequence = record.frames.iter().map(|captured| captured.role).collect();
        if let Some(capture) = &mut manifest.capture {
            // What became of a complete capture is no fault of its frames, which may be decoded again.
            capture.failure.clone_from(&taken.failure);
        }
        let planes: Vec<SharedPlane> =
            record.frames.iter().map(|captured| shared_plane(&captured.frame)).collect();
        let summary = CaptureSummary::from(record);
        let found: Vec<Reason> =
            std::iter::once(reason).chain(record.notes.findings.iter().map(Reason::from)).collect();
        results::write_unfinished(
            writer,
            manifest,
            &self.decode,
            &planes,
            self.calibration.as_ref(),
            |timings| {
                let size = Size { width: self.decode.width, height: self.decode.height };
                report::build(&ReportInput {
                    capture: Some(&summary),
                    found: &found,
                    timings,
                    simulated: self.simulated,
                    threads: rayon::current_num_threads(),
                    ..ReportInput::new(self.decode.mode, size, planes.len())
                })
            },
        )
    }
}

/// What an unfinished capture left, in the form of a finished one.
fn partial_record(plan: &Plan, partial: PartialCapture) -> CaptureRecord {
    CaptureRecord {
        retaken: partial.retaken,
        seconds: partial.seconds,
        limit_seconds: plan.limit().as_secs_f64(),
        latency_ms: plan.timing.trigger_delay.as_secs_f64() * 1e3,
        hold_refreshes: plan.timing.hold_refreshes,
        timing_measured: plan.timing.measured,
        synchrony: Synchrony::planned(&plan.timing).measured(plan.timing.hold_refreshes, &partial.frames),
        frames: partial.frames,
        applied: plan.applied.clone(),
        statistics: partial.statistics.unwrap_or_default(),
        notes: partial.notes,
    }
}

/// A rig that cannot be opened, as a failure.
pub fn rig_failure(error: RigError) -> Failure {
    match error {
        error @ RigError::Sim(_) => setup("set up the rig", error),
        error @ RigError::Replay { .. } => Failure::data("open the devices", error),
        RigError::Device(source) => Failure::Device { operation: "open the devices", source },
        other => Failure::NoDevice { operation: "open the devices", message: other.to_string() },
    }
}
