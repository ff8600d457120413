//! The shape of report.json. Its keys are public: add freely, rename nothing.
//!
//! Every key is always present. A figure that could not be computed is `null`, never a number that means nothing; a
//! list of things that there are none of is empty. JSON has neither NaN nor infinity, so no field holds one.

use polscan_patterns::{Axis, Mode};
use serde::{Deserialize, Serialize};

use super::{Accuracy, Reason, Verdict};
use crate::{
    decode::{NoiseModel, PairResidual},
    sequencer::{Finding, ReferenceRetake, Retake, Synchrony},
};

/// Schema of the report.
pub const SCHEMA: &str = "polscan.report/1";

/// What a scan came to: report.json.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// [`SCHEMA`].
    pub schema: String,
    /// Program and version that made the report.
    pub software: String,
    /// How the scan coded and was decoded.
    pub mode: Mode,
    /// Frames that went into the decode.
    pub frames: usize,
    /// Size of the frames.
    pub size: Size,
    /// Whether the result can be used.
    pub verdict: Verdict,
    /// Why the verdict is not `ok`; empty if and only if it is.
    pub reasons: Vec<Reason>,
    /// What is worth knowing and no reason to doubt the result.
    pub notes: Vec<String>,
    /// Whether the frames come from the simulated rig: then no figure here is a measurement of anything real.
    pub simulated: bool,
    /// What became of the pixels. `null` where nothing was decoded.
    pub pixels: Option<PixelCounts>,
    /// Points of the cloud. `null` without a calibration.
    pub points: Option<u64>,
    /// What is known of the capture.
    pub capture: CaptureReport,
    /// Contrast of raw frames and of the degree of linear polarization. `null` where it was not computed.
    pub contrast: Option<Contrast>,
    /// Flatness of the named regions, and of the planar objects of a simulated scene.
    pub planes: Vec<PlaneReport>,
    /// Agreement with the truth of the simulated rig; `null` on every other.
    pub truth: Option<TruthReport>,
    /// Agreement of rows with the calibration; `null` without rows or calibration.
    pub row_check: Option<RowCheckReport>,
    /// Degree of linear polarization of the lit pixels, weighed by brightness: `(r - 1) / (r + 1)` for an extinction ratio
    /// r. `null` in mode gray, and where nothing was lit.
    #[serde(default)]
    pub degree_of_polarization: Option<f64>,
    /// Noise of the camera as it was used; `null` where nothing was decoded.
    pub noise: Option<NoiseReport>,
    /// What missing frames cost, in words.
    pub losses: Vec<String>,
    /// The calibration used and how good it said it was; `null` without one.
    pub calibration: Option<CalibrationReport>,
    /// Where the time went.
    pub timings_ms: Timings,
    /// Threads of the compute pool.
    pub threads: usize,
}

/// Size of an image in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Size {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Pixels by what became of them, after all gates. `unlit + plain + edge + inverted + saturated + ambiguous +
/// off_boundary + out_of_projector + out_of_volume + rejected_by_row + rejected_by_vote + interreflection = total`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PixelCounts {
    /// All pixels.
    pub total: u64,
    /// Pixels that saw projector light: all but `unlit`.
    pub lit: u64,
    /// Pixels with a measurement: `plain + edge + inverted`.
    pub valid: u64,
    /// Decoded, off every stripe boundary.
    pub plain: u64,
    /// Decoded on a stripe boundary.
    pub edge: u64,
    /// Decoded with the polarity exchanged.
    pub inverted: u64,
    /// No projector light.
    pub unlit: u64,
    /// Both frames of a pair saturated.
    pub saturated: u64,
    /// Two or more soft bits, or two words that are not neighbours.
    pub ambiguous: u64,
    /// A zero crossing where its bit has no boundary.
    pub off_boundary: u64,
    /// A word outside the projector.
    pub out_of_projector: u64,
    /// A depth outside the working volume.
    pub out_of_volume: u64,
    /// Rejected by the row gate.
    pub rejected_by_row: u64,
    /// Rejected by their neighbourhood.
    pub rejected_by_vote: u64,
    /// Rejected as light that came by way of another surface.
    pub interreflection: u64,
    /// Of all pixels, those where one frame of some pair was saturated.
    pub half_saturated: u64,
}

/// What is known of the capture; keys that only a capture by this program knows are `null` for foreign frames.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CaptureReport {
    /// From the first flip to the last frame, in seconds.
    pub seconds: Option<f64>,
    /// The least that the display allows, in seconds.
    pub limit_seconds: Option<f64>,
    /// From flip to trigger, in ms.
    pub latency_ms: Option<f64>,
    /// Refreshes that each slide was held.
    pub hold_frames: Option<u32>,
    /// Whether latency and settling were measured on this projector rather than assumed.
    pub timing_measured: Option<bool>,
    /// How flips and exposures kept step.
    #[serde(default)]
    pub synchrony: Option<Synchrony>,
    /// Pairs that were captured again.
    pub retaken: Vec<Retake>,
    /// References that were captured again.
    #[serde(default)]
    pub references_retaken: Vec<ReferenceRetake>,
    /// Frames that arrived, were not the ones awaited, and were dropped.
    #[serde(default)]
    pub discarded: Vec<Finding>,
    /// Residual of the pair sums. `null` where there was no pair to sum.
    pub pair_residual_sigma: Option<PairResidualReport>,
    /// Last minus first reference, as a share of the modulation. `null` where there is one reference only.
    pub drift: Option<f64>,
}

/// Spread of `P + Q - (R_H + R_V)` in units of its noise over the unsaturated lit pixels: 1.00 when all is well.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PairResidualReport {
    /// Median over the pairs.
    pub median: f64,
    /// Largest of the pairs.
    pub worst: f64,
    /// Which pair that is.
    pub worst_pair: PairName,
    /// Every pair.
    pub per_pair: Vec<PairReport>,
}

/// One pair of frames. See [`PairResidual`]; `null` where a pair had no such pixel.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairReport {
    /// Axis that the pair codes.
    pub axis: Axis,
    /// Its bit, 0 = most significant.
    pub bit: u8,
    /// Robust standard deviation in units of the noise.
    pub sigma: Option<f64>,
    /// Median in units of the noise, signed.
    pub median: Option<f64>,
    /// Share of the flat pixels beyond 5 sigma.
    pub flat_outliers: Option<f64>,
    /// Share of the pixels near a stripe edge beyond 5 sigma.
    pub edge_outliers: Option<f64>,
    /// Pixels looked at.
    pub pixels: u64,
}

impl From<&PairResidual> for PairReport {
    fn from(pair: &PairResidual) -> Self {
        use super::statistics::finite;
        Self {
            axis: pair.axis,
            bit: pair.bit,
            sigma: finite(pair.sigma),
            median: finite(pair.median),
            flat_outliers: finite(pair.flat_outliers),
            edge_outliers: finite(pair.edge_outliers),
            pixels: pair.pixels,
        }
    }
}

/// Names a pair of frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct PairName {
    /// Axis that the pair codes.
    pub axis: Axis,
    /// Its bit, 0 = most significant.
    pub bit: u8,
}

/// Contrast: mean over 4-neighbour pixel pairs of the squared grey difference, 0..255 of full scale (the paper's
/// Eq. 8), mean over the non-inverse code frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Contrast {
    /// Of the raw frames, whole image.
    pub raw: Option<f64>,
    /// Of the degree of linear polarization, whole image.
    pub dolp: Option<f64>,
    /// `dolp / raw`.
    pub ratio: Option<f64>,
    /// Of the raw frames, lit pixels.
    pub raw_lit: Option<f64>,
    /// Of the degree of linear polarization, lit pixels.
    pub dolp_lit: Option<f64>,
    /// `dolp_lit / raw_lit`.
    pub ratio_lit: Option<f64>,
}

impl Contrast {
    /// Adds the ratios. Numbers that are not finite count as not computed.
    pub fn new(raw: f64, dolp: f64, raw_lit: f64, dolp_lit: f64) -> Self {
        use super::statistics::finite;
        Self {
            raw: finite(raw),
            dolp: finite(dolp),
            ratio: finite(dolp / raw),
            raw_lit: finite(raw_lit),
            dolp_lit: finite(dolp_lit),
            ratio_lit: finite(dolp_lit / raw_lit),
        }
    }
}

/// Flatness of one region: total least squares over all valid points, no outlier removed, 2 px off its silhouette.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlaneReport {
    /// Name of the region or of the object of a simulated scene.
    pub name: String,
    /// Points in the fit.
    pub points: u64,
    /// Valid share of the lit pixels. Lit by the truth for an object of a simulated scene, else by the decoder.
    pub coverage: Option<f64>,
    /// Root mean square distance in mm; `null` with the two below without a calibration, or without six points that span a plane.
    pub rmse_mm: Option<f64>,
    /// Peak to valley over the points of the quadratic that fits the distances best, in mm.
    pub bow_mm: Option<f64>,
    /// 95th percentile of the absolute distance in mm.
    pub p95_mm: Option<f64>,
    /// Lit pixels of the region, as `coverage` counts them.
    pub lit: u64,
    /// As `rmse_mm`, but also 2 px off shadow borders. Objects of a simulated scene only.
    pub rmse_off_shadow_mm: Option<f64>,
    /// Agreement with the truth. Objects of a simulated scene only.
    pub truth: Option<Accuracy>,
}

/// Agreement with the truth of a simulated scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TruthReport {
    /// Over the pixels whose 5x5 neighbourhood sees one surface, wholly lit.
    #[serde(flatten)]
    pub interior: Accuracy,
    /// Over the other pixels.
    pub border: BorderReport,
}

/// Pixels at silhouettes, shadow borders and the edge of the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct BorderReport {
    /// Pixels that projector light reaches by the truth.
    pub pixels: u64,
    /// Of those, pixels with a measurement.
    pub valid: u64,
    /// Of the valid ones, those whose column is off by more than 1.5.
    pub wrong: u64,
    /// Pixels with a measurement where no projector light reaches by the truth; not in the counts above.
    pub valid_in_shadow: u64,
}

/// Agreement of measured rows with those that columns and calibration predict.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RowCheckReport {
    /// Median of measured minus predicted row, in projector px.
    pub median_px: Option<f64>,
    /// Robust standard deviation of the same, in projector px.
    pub sigma_px: Option<f64>,
    /// Gate that was applied, in projector px.
    pub gate_px: Option<f64>,
    /// Share of the otherwise valid pixels that the gate rejected.
    pub rejected_share: Option<f64>,
    /// How far the predicted row moves per column of error: how well rows check columns on this rig.
    pub rows_per_column: Option<f64>,
}

/// Noise of the camera as it was used.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NoiseReport {
    /// The model.
    #[serde(flatten)]
    pub model: NoiseModel,
    /// Whether it was estimated from these very frames.
    pub estimated: bool,
    /// Black level that was subtracted, in DN.
    pub black_level_dn: f64,
}

/// The calibration used and how good it said it was.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CalibrationReport {
    /// What names the calibration.
    pub id: Option<String>,
    /// Reprojection rms of the camera in px.
    pub camera_rms_px: Option<f64>,
    /// Reprojection rms of the projector in px.
    pub projector_rms_px: Option<f64>,
    /// Number of board views.
    pub views: Option<u32>,
    /// When it was made.
    pub date: Option<String>,
    /// How it was made.
    pub method: Option<String>,
}

/// Where the time went, in ms; `null` where a step was not done or not timed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Timings {
    /// Frames into memory.
    pub load: Option<f64>,
    /// Columns, rows and quality, from frames in memory to codes in memory.
    pub decode: Option<f64>,
    /// Sub-pixel coordinates.
    pub subpixel: Option<f64>,
    /// Points from coordinates, with the gates that need a calibration.
    pub triangulate: Option<f64>,
    /// Results written, before fsync and hashing.
    pub write: Option<f64>,
    /// From the last frame in memory to the result.
    pub after_last_frame: Option<f64>,
}
