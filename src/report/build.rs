//! From results to the report. Pure.

use nalgebra::Vector3;
use polscan_patterns::Mode;

use super::{
    CaptureSummary, NamedRegion, Reason,
    accuracy::{self, Measured},
    diagnosis, plane,
    region::{self, NOTHING},
    statistics,
    types::{
        CalibrationReport, CaptureReport, Contrast, NoiseReport, PairName, PairReport, PairResidualReport,
        PixelCounts, PlaneReport, Report, RowCheckReport, SCHEMA, Size, Timings,
    },
};
use crate::{
    cloud::{Reconstruction, RowCheck},
    decode::{Class, DecodeSettings, Decoded, PairResidual},
    geometry::Quality,
    grid::Grid,
    truth::Truth,
};

/// Everything a report is made of. What is not known is `None`, and the report leaves it out.
#[derive(Clone)]
pub struct ReportInput<'a> {
    /// Mode of the scan.
    pub mode: Mode,
    /// Frames that went into the decode, or that were captured where nothing was decoded.
    pub frames: usize,
    /// Size of the frames.
    pub size: Size,
    /// How the frames were decoded.
    pub settings: Option<&'a DecodeSettings>,
    /// What the decoder made of them.
    pub decoded: Option<&'a Decoded>,
    /// Points, where there is a calibration.
    pub reconstruction: Option<&'a Reconstruction>,
    /// Truth, on the simulated rig.
    pub truth: Option<&'a Truth>,
    /// Capture, where this program made it.
    pub capture: Option<&'a CaptureSummary>,
    /// What the capture itself found wrong.
    pub found: &'a [Reason],
    /// Contrast of the frames.
    pub contrast: Option<Contrast>,
    /// Regions whose flatness is wanted.
    pub regions: &'a [NamedRegion],
    /// Calibration that was used.
    pub calibration: Option<CalibrationReport>,
    /// Last minus first modulation as a share of the modulation, median over lit pixels, where both are known: lamp and
    /// exposure change it, other light in the room does not.
    pub modulation_drift: Option<f64>,
    /// Where the time went.
    pub timings: Timings,
    /// Threads of the compute pool.
    pub threads: usize,
    /// Whether the frames come from the simulated rig.
    pub simulated: bool,
}

impl<'a> ReportInput<'a> {
    /// A scan of which nothing but its mode, its size and the number of its frames is known.
    pub fn new(mode: Mode, size: Size, frames: usize) -> Self {
        Self {
            mode,
            frames,
            size,
            settings: None,
            decoded: None,
            reconstruction: None,
            truth: None,
            capture: None,
            found: &[],
            contrast: None,
            regions: &[],
            calibration: None,
            modulation_drift: None,
            timings: Timings::default(),
            threads: 1,
            simulated: false,
        }
    }

    /// Class of each pixel after all gates.
    pub(super) fn class(&self) -> Option<&'a Grid<Class>> {
        self.reconstruction.map(|made| &made.class).or(self.decoded.map(|decoded| &decoded.class))
    }

    fn measured(&self) -> Option<Measured<'a>> {
        Some(Measured {
            decoded: self.decoded?,
            class: self.class()?,
            cloud: self.reconstruction.map(|made| &made.cloud),
        })
    }
}

impl CalibrationReport {
    /// From what a calibration says of itself.
    pub fn new(id: Option<String>, quality: &Quality) -> Self {
        let rms = |value: Option<f64>| value.and_then(statistics::finite);
        Self {
            id,
            camera_rms_px: rms(quality.camera_rms_px),
            projector_rms_px: rms(quality.projector_rms_px),
            views: quality.views,
            date: quality.date.clone(),
            method: quality.method.clone(),
        }
    }
}

/// Makes the report.
pub fn build(input: &ReportInput) -> Report {
    let pixels = input.decoded.zip(input.class()).map(|(decoded, class)| count(decoded, class));
    let (planes, truth) = figures(input);
    let reasons = diagnosis::diagnose(input, pixels.as_ref());
    Report {
        schema: SCHEMA.to_owned(),
        software: concat!("polscan ", env!("CARGO_PKG_VERSION")).to_owned(),
        mode: input.mode,
        frames: input.frames,
        size: input.size,
        verdict: super::verdict(&reasons),
        notes: diagnosis::notes(input, pixels.as_ref()),
        reasons,
        simulated: input.simulated,
        pixels,
        points: input.reconstruction.map(|made| points(made, |_| true).count() as u64),
        capture: capture(input),
        contrast: input.contrast,
        planes,
        truth,
        row_check: input.reconstruction.and_then(|made| made.row_check).map(RowCheckReport::from),
        noise: input.decoded.map(|decoded| NoiseReport {
            model: decoded.noise,
            estimated: decoded.noise_estimated,
            black_level_dn: decoded.black_level_dn,
        }),
        losses: input.decoded.map(|decoded| decoded.losses.clone()).unwrap_or_default(),
        calibration: input.calibration.clone(),
        timings_ms: input.timings.finite(),
        threads: input.threads,
    }
}

/// Pixels by class.
fn count(decoded: &Decoded, class: &Grid<Class>) -> PixelCounts {
    let mut of = [0u64; Class::ALL.len()];
    for &class in class.data() {
        of[class as usize] += 1;
    }
    let of = |class: Class| of[class as usize];
    let total = class.len() as u64;
    PixelCounts {
        total,
        lit: total - of(Class::Unlit),
        valid: of(Class::Valid) + of(Class::Edge) + of(Class::Inverted),
        plain: of(Class::Valid),
        edge: of(Class::Edge),
        inverted: of(Class::Inverted),
        unlit: of(Class::Unlit),
        saturated: of(Class::Saturated),
        ambiguous: of(Class::Ambiguous),
        off_boundary: of(Class::OffBoundary),
        out_of_projector: of(Class::OutOfProjector),
        out_of_volume: of(Class::OutOfVolume),
        rejected_by_row: of(Class::RowGate),
        rejected_by_vote: of(Class::Vote),
        interreflection: of(Class::Interreflection),
        half_saturated: decoded.half_saturated.data().iter().filter(|&&half| half).count() as u64,
    }
}

/// Points of the valid pixels that `belongs` picks.
fn points(made: &Reconstruction, belongs: impl Fn(usize) -> bool) -> impl Iterator<Item = Vector3<f64>> {
    let pixels = made.class.data().iter().zip(made.cloud.point_mm.data()).enumerate();
    pixels
        .filter(move |(index, (class, _))| class.is_valid() && belongs(*index))
        .map(|(_, (_, point))| Vector3::from(point.map(f64::from)))
        .filter(|point| point.iter().all(|value| value.is_finite()))
}

/// Flatness of all regions, and agreement with the truth where there is one.
fn figures(input: &ReportInput) -> (Vec<PlaneReport>, Option<super::TruthReport>) {
    let Some(measured) = input.measured() else { return (Vec::new(), None) };
    let truth = input.truth.map(|truth| (truth, accuracy::interior(truth)));
    let mut planes = match &truth {
        Some((truth, interior)) => objects(input, measured, truth, interior),
        None => Vec::new(),
    };
    planes.extend(input.regions.iter().map(|named| region_plane(input, measured, named)));
    (planes, truth.map(|(truth, interior)| accuracy::against_truth(measured, truth, &interior)))
}

/// The planar objects of a simulated scene that the camera sees.
fn objects(input: &ReportInput, measured: Measured, truth: &Truth, interior: &Grid<u8>) -> Vec<PlaneReport> {
    let clear = region::off_borders(&truth.object);
    let planar = truth.objects.iter().enumerate().filter(|(label, object)| {
        object.planar && *label < usize::from(NOTHING) && truth.object.data().contains(&(*label as u8))
    });
    planar
        .map(|(label, object)| {
            let label = label as u8;
            let lit = |index: usize| clear.data()[index] == label && truth.column.data()[index].is_finite();
            let off_shadow = |index: usize| interior.data()[index] == label;
            PlaneReport {
                truth: Some(accuracy::accuracy(measured, truth, off_shadow)),
                rmse_off_shadow_mm: input.reconstruction.and_then(|made| {
                    let points: Vec<_> = points(made, off_shadow).collect();
                    plane::fit_plane(&points).map(|fit| fit.rmse_mm)
                }),
                ..plane_of(&object.name, input, measured, |index| clear.data()[index] == label, lit)
            }
        })
        .collect()
}

/// A rectangle that the user named.
fn region_plane(input: &ReportInput, measured: Measured, named: &NamedRegion) -> PlaneReport {
    let width = input.size.width.max(1);
    let inside = |index: usize| named.contains(index % width, index / width);
    let lit = |index: usize| inside(index) && measured.class.data()[index].is_lit();
    plane_of(&named.name, input, measured, inside, lit)
}

fn plane_of(
    name: &str,
    input: &ReportInput,
    measured: Measured,
    inside: impl Fn(usize) -> bool,
    lit: impl Fn(usize) -> bool,
) -> PlaneReport {
    let (mut lit_pixels, mut valid) = (0, 0);
    for (index, class) in measured.class.data().iter().enumerate() {
        if lit(index) {
            lit_pixels += 1;
            valid += u64::from(class.is_valid());
        }
    }
    let points: Vec<_> = input.reconstruction.map(|made| points(made, inside).collect()).unwrap_or_default();
    let fit = plane::fit_plane(&points);
    PlaneReport {
        name: name.to_owned(),
        points: points.len() as u64,
        coverage: statistics::share(valid, lit_pixels),
        rmse_mm: fit.map(|fit| fit.rmse_mm),
        bow_mm: fit.and_then(|fit| fit.bow_mm),
        p95_mm: fit.map(|fit| fit.p95_mm),
        lit: lit_pixels,
        rmse_off_shadow_mm: None,
        truth: None,
    }
}

fn capture(input: &ReportInput) -> CaptureReport {
    let known = input.capture;
    let seconds = |of: fn(&CaptureSummary) -> f64| known.map(of).and_then(statistics::finite);
    CaptureReport {
        seconds: seconds(|capture| capture.seconds),
        limit_seconds: seconds(|capture| capture.limit_seconds),
        latency_ms: seconds(|capture| capture.latency_ms),
        hold_frames: known.map(|capture| capture.hold_frames),
        timing_measured: known.map(|capture| capture.timing_measured),
        retaken: known.map(|capture| capture.retaken.clone()).unwrap_or_default(),
        pair_residual_sigma: input.decoded.and_then(|decoded| pair_residual(&decoded.pairs)),
        drift: input.decoded.and_then(|decoded| decoded.drift).and_then(statistics::finite),
    }
}

fn pair_residual(pairs: &[PairResidual]) -> Option<PairResidualReport> {
    let worst =
        pairs.iter().filter(|pair| pair.sigma.is_finite()).max_by(|a, b| a.sigma.total_cmp(&b.sigma))?;
    let mut sigmas: Vec<f64> = pairs.iter().filter_map(|pair| statistics::finite(pair.sigma)).collect();
    Some(PairResidualReport {
        median: statistics::median(&mut sigmas)?,
        worst: worst.sigma,
        worst_pair: PairName { axis: worst.axis, bit: worst.bit },
        per_pair: pairs.iter().map(PairReport::from).collect(),
    })
}

impl From<RowCheck> for RowCheckReport {
    fn from(check: RowCheck) -> Self {
        Self {
            median_px: statistics::finite(check.median_px),
            sigma_px: statistics::finite(check.sigma_px),
            gate_px: statistics::finite(check.gate_px),
            rejected_share: statistics::finite(check.rejected_share),
            rows_per_column: statistics::finite(check.rows_per_column),
        }
    }
}

impl Timings {
    fn finite(self) -> Self {
        let keep = |value: Option<f64>| value.and_then(statistics::finite);
        Self {
            load: keep(self.load),
            decode: keep(self.decode),
            subpixel: keep(self.subpixel),
            triangulate: keep(self.triangulate),
            write: keep(self.write),
            after_last_frame: keep(self.after_last_frame),
        }
    }
}
