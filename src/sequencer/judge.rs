//! Whether captured frames show what they should: the decision, given the statistics.
//!
//! The causes named here are the likely ones, as far as the statistics of one pair can tell; the evidence is written
//! out beside each, so that a person can judge again.

use polscan_drivers::frame::{Frame, Pixels};
use polscan_patterns::{Axis, Role};
use serde::{Deserialize, Serialize};

use crate::decode::{CameraResponse, NoiseModel, PairResidual};

/// What made a pair or reference suspicious.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Suspicion {
    /// Slug of the likely cause.
    pub reason: String,
    /// Evidence in words, with its figures.
    pub evidence: String,
    /// Spread of the residual in units of its noise.
    pub sigma: f64,
}

/// What becomes of a pair, or of a reference compared with the one before it.
#[derive(Debug, Clone, PartialEq)]
pub enum PairVerdict {
    /// It shows what it should.
    Accept,
    /// It decodes, but not as on a healthy rig, and taking it again would not help.
    Degraded(Suspicion),
    /// It does not show what it should: take it again.
    Retake(Suspicion),
}

/// Looks at frames as they arrive. Called from the capture's thread while the next slide's light is under way.
pub trait Judge {
    /// An accepted frame of a reference: of the first set before any pair that is judged against it, and of the last
    /// set. One of the first set may be taken again; a later frame of a role takes the place of the earlier. Quick:
    /// an exposure may be waiting.
    fn reference(&mut self, role: Role, frame: &Frame);

    /// The frame and the inverse of one bit.
    fn pair(&mut self, axis: Axis, bit: u8, frame: &Frame, inverse: &Frame) -> PairVerdict;

    /// A reference of the last set against the same of the first. [`compare_references`] and [`drift_rule`] are the
    /// ready answer where the camera's noise is known.
    fn drift(&mut self, role: Role, first: &Frame, last: &Frame) -> PairVerdict;
}

/// Limits of [`judge_rule`], on robust statistics in units of noise.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PairThresholds {
    /// Below this number of pixels nothing is concluded.
    pub pixels: u64,
    /// Share of flat pixels beyond 5 sigma that asks for a re-take. Gaussian noise gives 6e-7; dust, hot pixels and
    /// a noise model that is a fifth too small stay below 1e-3.
    pub flat_outliers: f64,
    /// From this share on the frame is called stale rather than torn: two bits differ on half of all columns, and a
    /// torn frame shows the old one on a part of the rows only.
    pub stale_share: f64,
    /// Below this share of outliers something small moved.
    pub motion_share: f64,
    /// From this change of brightness between two frames of one reference on, as a share of their mean, they show
    /// different pictures: 1.4 is a factor of 5.7, more than automatic exposure changes and less than lies between the two
    /// references of a rig with an extinction of 10:1.
    pub stale_gain: f64,
    /// Share of edge pixels beyond 5 sigma that is called a non-linear response.
    pub edge_outliers: f64,
    /// How many times more outliers at edges than on flat areas speak of the response rather than of a change: blur
    /// carries what happens at an edge a little beyond the pixels that count as near it.
    pub edge_ratio: f64,
    /// Common brightness change that is reported.
    pub median_degraded: f64,
    /// Common brightness change that asks for a re-take.
    pub median_retake: f64,
    /// Spread that is reported though nothing stands out: the noise is not the one assumed.
    pub sigma: f64,
    /// How many of the finest bits may have flat outliers from panel crosstalk.
    pub fine_bits: u8,
}

impl Default for PairThresholds {
    fn default() -> Self {
        Self {
            pixels: 100,
            flat_outliers: 0.005,
            stale_share: 0.2,
            motion_share: 0.02,
            stale_gain: 1.4,
            edge_outliers: 0.02,
            edge_ratio: 10.0,
            median_degraded: 1.0,
            median_retake: 3.0,
            sigma: 1.5,
            fine_bits: 2,
        }
    }
}

/// The decision on one pair of an axis of `code_bits` bits from its pair sum.
pub fn judge_rule(residual: &PairResidual, code_bits: u8, thresholds: &PairThresholds) -> PairVerdict {
    let PairResidual { axis, bit, sigma, median, flat_outliers, edge_outliers, pixels } = *residual;
    let suspicion = |reason: &str, cause: &str| Suspicion {
        reason: reason.to_string(),
        evidence: format!(
            "{axis} bit {bit}: {cause}; {:.2} % of flat and {:.2} % of edge pixels beyond 5 sigma, residual sigma \
             {sigma:.2}, median {median:+.2}, {pixels} pixels",
            flat_outliers * 100.0,
            edge_outliers * 100.0
        ),
        sigma,
    };
    if pixels < thresholds.pixels || !(sigma.is_finite() && median.is_finite()) {
        return PairVerdict::Degraded(suspicion("unverified-pair", "too few pixels to judge the pair"));
    }
    // The finest bits have hardly a flat pixel: NaN, no share of nothing, counts as none.
    let (flat, edge) = (flat_outliers.max(0.0), edge_outliers.max(0.0));
    let fine = bit + thresholds.fine_bits >= code_bits;
    // Edges cover most of the image in the fine bits, so that a curved response shifts their median too.
    if median.abs() >= thresholds.median_retake && !(fine && edge >= thresholds.edge_outliers) {
        let cause = "the whole image changed its brightness";
        return PairVerdict::Retake(suspicion("flicker", cause));
    }
    if flat >= thresholds.stale_share {
        let cause = "a large part of the image shows another picture";
        return PairVerdict::Retake(suspicion("stale-frame", cause));
    }
    // Light that changed in a part of the image changed at stripe edges and off them alike.
    let at_edges_only = edge >= thresholds.edge_outliers && flat * thresholds.edge_ratio <= edge;
    if flat >= thresholds.flat_outliers && !fine && !at_edges_only {
        return PairVerdict::Retake(match flat < thresholds.motion_share {
            true => suspicion("motion", "a small part of the image changed between the frames"),
            false => suspicion("torn-frame", "a part of the image shows another picture"),
        });
    }
    if edge >= thresholds.edge_outliers
        || (fine && (flat >= thresholds.flat_outliers || sigma >= thresholds.sigma))
    {
        let cause = "light of neighbouring stripes does not add up";
        return PairVerdict::Degraded(suspicion("nonlinear-response", cause));
    }
    if median.abs() >= thresholds.median_degraded {
        return PairVerdict::Degraded(suspicion(
            "exposure-drift",
            "the whole image changed its brightness a little",
        ));
    }
    if sigma >= thresholds.sigma {
        let cause = "the spread is larger than the assumed noise";
        return PairVerdict::Degraded(suspicion("noise-model", cause));
    }
    PairVerdict::Accept
}

/// How the last frame of a reference differs from the first, over unsaturated pixels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ReferenceChange {
    /// Median of the difference, in units of its noise.
    pub median: f64,
    /// Median level, in DN above black.
    pub level_dn: f64,
    /// Change of brightness in proportion: the bright quarter against the dark quarter; NaN where all is equally bright.
    pub gain: f64,
    /// Change of brightness that remains at level 0, in DN.
    pub offset_dn: f64,
    /// 1.4826 times the median absolute deviation of what gain and offset leave, in units of its noise.
    pub sigma: f64,
    /// Share of pixels that differ, together with the pixel beside them, by more than 5 sigma from what gain and offset say.
    pub outliers: f64,
    /// Number of pixels looked at.
    pub pixels: u64,
}

/// Compares two frames of one reference, `None` where their shapes differ. `noise` is that of `camera` or a better one.
pub fn compare_references(
    first: &Frame,
    last: &Frame,
    camera: &CameraResponse,
    noise: NoiseModel,
) -> Option<ReferenceChange> {
    let same = (first.width, first.height) == (last.width, last.height);
    same.then(|| compare_pixels(first.pixels(), last.pixels(), camera, noise)).flatten()
}

/// The same for bare pixels.
pub(crate) fn compare_pixels(
    before: Pixels<'_>,
    after: Pixels<'_>,
    camera: &CameraResponse,
    noise: NoiseModel,
) -> Option<ReferenceChange> {
    if before.len() != after.len() {
        return None;
    }
    let black = camera.black_level_dn.unwrap_or(0.0);
    // A quarter of a million pixels, evenly spread, fix the median to a thousandth of a sigma.
    let stride = (before.len() / 250_000).max(1);
    let sample = |index: usize| {
        let (a, b) = (before.get(index), after.get(index));
        (a < camera.saturation_dn && b < camera.saturation_dn).then(|| {
            let (a, b) = (f64::from(a) - black, f64::from(b) - black);
            // One level for both keeps the noise of the difference free of its sign.
            let level = (a + b) / 2.0;
            Sample { level, change: b - a, noise: (2.0 * noise.variance(level)).sqrt() }
        })
    };
    let mut samples: Vec<Change> = (0..before.len())
        .step_by(stride)
        .filter_map(|index| {
            let Sample { level, change, noise } = sample(index)?;
            // The last pixel of a row has the first of the next beside it: as good as any.
            let beside = if index + 1 < before.len() { index + 1 } else { index.saturating_sub(1) };
            Some(Change { level, change, noise, beside: sample(beside)? })
        })
        .collect();
    if samples.is_empty() {
        let nan = f64::NAN;
        let (median, level_dn, gain, offset_dn, sigma) = (nan, nan, nan, nan, nan);
        return Some(ReferenceChange { median, level_dn, gain, offset_dn, sigma, outliers: 0.0, pixels: 0 });
    }
    let count = samples.len() as f64;
    let median =
        median_of(&mut samples.iter().map(|sample| sample.change / sample.noise).collect::<Vec<_>>());
    let level_dn = median_of(&mut samples.iter().map(|sample| sample.level).collect::<Vec<_>>());
    let (gain, offset_dn) = gain_and_offset(&mut samples);
    let slope = if gain.is_nan() { 0.0 } else { gain };
    let left = |s: &Sample| (s.change - slope * s.level - offset_dn) / s.noise;
    // What moves or shows another picture changes neighbours alike; noise that is larger than assumed does not.
    let is_outlier = |s: &&Change| {
        let (here, beside) = (left(&s.here()), left(&s.beside));
        here.abs() > 5.0 && beside.abs() > 5.0 && here * beside > 0.0
    };
    let outliers = samples.iter().filter(is_outlier).count() as f64 / count;
    let mut rest: Vec<f64> = samples.iter().map(|s| left(&s.here()).abs()).collect();
    let sigma = 1.4826 * median_of(&mut rest);
    Some(ReferenceChange { median, level_dn, gain, offset_dn, sigma, outliers, pixels: samples.len() as u64 })
}

/// One pixel of two frames, in DN.
struct Sample {
    level: f64,
    change: f64,
    noise: f64,
}

/// The same with the pixel beside it.
struct Change {
    level: f64,
    change: f64,
    noise: f64,
    beside: Sample,
}

impl Change {
    fn here(&self) -> Sample {
        Sample { level: self.level, change: self.change, noise: self.noise }
    }
}

/// Line through the medians of level and change of the darkest and the brightest quarter. Sorts the samples.
fn gain_and_offset(samples: &mut [Change]) -> (f64, f64) {
    samples.sort_unstable_by(|a, b| a.level.total_cmp(&b.level));
    let quarter = samples.len().div_ceil(4);
    let medians = |part: &[Change]| {
        let mut levels: Vec<f64> = part.iter().map(|sample| sample.level).collect();
        let mut changes: Vec<f64> = part.iter().map(|sample| sample.change).collect();
        (median_of(&mut levels), median_of(&mut changes))
    };
    let (dark_level, dark_change) = medians(&samples[..quarter]);
    let (bright_level, bright_change) = medians(&samples[samples.len() - quarter..]);
    let gain = match bright_level > dark_level {
        true => (bright_change - dark_change) / (bright_level - dark_level),
        false => f64::NAN,
    };
    (gain, if gain.is_nan() { dark_change } else { dark_change - gain * dark_level })
}

/// The lower median. `values` is not empty and holds no NaN; it is reordered.
fn median_of(values: &mut [f64]) -> f64 {
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// The decision on the last frame of a reference. Only a local change asks for a re-take; a change of the light, in
/// proportion or by an offset, stays for the rest of the scan and is reported.
pub fn drift_rule(role: Role, change: &ReferenceChange, thresholds: &PairThresholds) -> PairVerdict {
    let suspicion = |reason: &str, cause: &str| Suspicion {
        reason: reason.to_string(),
        evidence: format!(
            "{role}, last against first: {cause}; brightness {:+.2} % and {:+.1} DN, {:.2} % of pixels beyond 5 sigma, \
             sigma {:.2}, median {:+.2}, {} pixels",
            change.gain * 100.0,
            change.offset_dn,
            change.outliers * 100.0,
            change.sigma,
            change.median,
            change.pixels
        ),
        sigma: change.sigma,
    };
    if change.pixels < thresholds.pixels {
        return PairVerdict::Degraded(suspicion(
            "unverified-reference",
            "too few unsaturated pixels to compare",
        ));
    }
    if change.outliers >= thresholds.stale_share || change.gain.abs() >= thresholds.stale_gain {
        return PairVerdict::Retake(suspicion(
            "stale-frame",
            "a large part of the image shows another picture",
        ));
    }
    if change.outliers >= thresholds.flat_outliers {
        return PairVerdict::Retake(suspicion("motion", "a part of the image changed during the scan"));
    }
    if change.median.abs() >= thresholds.median_degraded {
        let by_gain = (change.gain * change.level_dn).abs() >= change.offset_dn.abs();
        return PairVerdict::Degraded(match by_gain {
            true => suspicion("exposure-drift", "the light of the projector changed"),
            false => suspicion("ambient-drift", "the ambient light changed"),
        });
    }
    PairVerdict::Accept
}

#[cfg(test)]
mod tests;
