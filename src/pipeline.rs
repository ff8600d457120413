//! Joins the pure parts: frames and a calibration in, maps, cloud and report out. A scan and a decode of its bundle
//! both come through here, which is why they agree bit for bit.

mod ahead;
mod background;

use std::time::Instant;

use polscan_patterns::Role;
use thiserror::Error;

pub use self::{ahead::Ahead, background::background_pool};
use crate::{
    cloud::{ReconstructError, ReconstructSettings, Reconstruction, reconstruct, reconstruct_with},
    decode::{self, Accumulator, DecodeError, DecodeSettings, Decoded, SharedPlane},
    geometry::Calibration,
    grid::Grid,
    report::{
        CalibrationReport, CaptureSummary, Contrast, NamedRegion, Reason, Report, ReportInput, Size, Timings,
    },
    truth::Truth,
};

/// Everything that is known before the first pixel is looked at.
pub struct Job<'a> {
    /// What each frame shows.
    pub roles: &'a [Role],
    /// The frames, in the order of `roles`.
    pub planes: &'a [SharedPlane],
    /// How to decode them.
    pub decode: DecodeSettings,
    /// Calibration of the rig.
    pub calibration: Option<&'a Calibration>,
    /// What was prepared for it already.
    pub ahead: Option<&'a Ahead>,
    /// Gates of the reconstruction.
    pub reconstruct: ReconstructSettings,
}

/// What came of a job.
pub struct Outcome {
    /// Maps before the gates that need a calibration.
    pub decoded: Decoded,
    /// Points, with a calibration.
    pub reconstruction: Option<Reconstruction>,
    /// Contrast of raw and DOLP frames.
    pub contrast: Option<Contrast>,
    /// Times of the steps done here.
    pub timings: Timings,
}

/// Why a job has no outcome.
#[derive(Debug, Error)]
pub enum PipelineError {
    /// The frames cannot be decoded.
    #[error(transparent)]
    Decode(#[from] DecodeError),
    /// Maps and calibration do not go together.
    #[error(transparent)]
    Reconstruct(#[from] ReconstructError),
}

/// Decodes and reconstructs.
pub fn run(job: &Job) -> Result<Outcome, PipelineError> {
    let start = Instant::now();
    let mut accumulator = Accumulator::new(job.decode.clone())?;
    for (role, plane) in job.roles.iter().zip(job.planes) {
        accumulator.push(*role, plane.clone())?;
    }
    let mut codes_done = start;
    let decoded = accumulator.finish_telling(|| codes_done = Instant::now())?;
    let start_triangulate = Instant::now();
    let reconstruction = match job.calibration {
        Some(calibration) if calibration.projector.is_some() => {
            Some(match job.ahead.and_then(|ahead| ahead.triangulator(Some(calibration))) {
                Some(triangulator) => reconstruct_with(triangulator, &decoded, &job.reconstruct)?,
                None => reconstruct(&decoded, calibration, &job.reconstruct)?,
            })
        }
        _ => None,
    };
    let triangulate_ms = reconstruction.is_some().then(|| milliseconds(start_triangulate));
    let after_last_frame = Some(milliseconds(start));
    let contrast = contrast(job, &decoded);
    let timings = Timings {
        decode: Some(1e3 * codes_done.duration_since(start).as_secs_f64()),
        subpixel: Some(1e3 * start_triangulate.duration_since(codes_done).as_secs_f64()),
        triangulate: triangulate_ms,
        after_last_frame,
        ..Timings::default()
    };
    Ok(Outcome { decoded, reconstruction, contrast, timings })
}

/// Time since then in ms.
pub fn milliseconds(since: Instant) -> f64 {
    since.elapsed().as_secs_f64() * 1e3
}

/// Contrast of Eq. 8 over the non-inverse code frames.
fn contrast(job: &Job, decoded: &Decoded) -> Option<Contrast> {
    let planes = |wanted: fn(&Role) -> bool| -> Vec<_> {
        let roles = job.roles.iter().zip(job.planes);
        roles.filter(|(role, _)| wanted(role)).map(|(_, plane)| plane.plane()).collect()
    };
    let code = planes(|role| matches!(role, Role::Code { inverse: false, .. }));
    let dark = planes(|role| matches!(role, Role::ReferenceV | Role::Black));
    let lit = decoded.class.map(|class| class.is_lit());
    let camera = &job.decode.camera;
    let found = decode::contrast(&code, &dark, camera.bit_depth, camera.black_level_dn.unwrap_or(0.0), &lit)?;
    Some(Contrast::new(found.raw, found.dolp, found.raw_lit, found.dolp_lit))
}

impl Outcome {
    /// Final class of each pixel.
    pub fn class(&self) -> &Grid<decode::Class> {
        match &self.reconstruction {
            Some(reconstruction) => &reconstruction.class,
            None => &self.decoded.class,
        }
    }

    /// Projector row of each pixel: measured, or else what column and calibration predict.
    pub fn row(&self) -> Option<&Grid<f32>> {
        let predicted = || self.reconstruction.as_ref()?.predicted_row.as_ref();
        self.decoded.row.as_ref().map(|row| &row.coordinate).or_else(predicted)
    }

    /// z in the camera frame in mm, with a calibration.
    pub fn depth_mm(&self) -> Option<Grid<f32>> {
        Some(self.reconstruction.as_ref()?.cloud.point_mm.map(|point| point[2]))
    }
}

/// What a report says besides what the job itself came to.
#[derive(Default)]
pub struct Context<'a> {
    /// Truth of a simulated rig.
    pub truth: Option<&'a Truth>,
    /// How the capture went.
    pub capture: Option<&'a CaptureSummary>,
    /// What the capture found wrong.
    pub found: &'a [Reason],
    /// Regions whose flatness is wanted.
    pub regions: &'a [NamedRegion],
    /// H over V that the rig shows on metal, where it is known.
    pub extinction_ratio: Option<f64>,
    /// Whether the frames come from a simulated rig.
    pub simulated: bool,
    /// Remarks on the input, such as how colour images were read.
    pub notes: &'a [String],
}

/// The report of an outcome; `timings` adds what was measured outside.
pub fn report(job: &Job, outcome: &Outcome, context: &Context, timings: Timings) -> Report {
    let size = Size { width: job.decode.width, height: job.decode.height };
    let planes: Vec<_> =
        job.roles.iter().copied().zip(job.planes.iter().map(|plane| plane.plane())).collect();
    let mut report = crate::report::build(&ReportInput {
        settings: Some(&job.decode),
        decoded: Some(&outcome.decoded),
        planes: &planes,
        reconstruction: outcome.reconstruction.as_ref(),
        truth: context.truth,
        capture: context.capture,
        found: context.found,
        contrast: outcome.contrast,
        regions: context.regions,
        calibration: job
            .calibration
            .map(|calibration| CalibrationReport::new(Some(calibration.id()), &calibration.quality)),
        timings,
        threads: rayon::current_num_threads(),
        simulated: context.simulated,
        extinction_ratio: context.extinction_ratio,
        ..ReportInput::new(job.decode.mode, size, job.planes.len())
    });
    report.notes.extend_from_slice(context.notes);
    report
}
