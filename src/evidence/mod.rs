//! What one pair of frames shows, and what that is called: the one place of these rules. The judge of a live capture asks
//! it of a pair that does not add up, and the report asks it again of all pairs of a scan.

pub mod exposure;
mod look;
pub mod settling;
mod unfinished;

use crate::{
    decode::{NoiseModel, PairResidual, Plane},
    report::statistics,
};

pub use look::{Frames, Look, Pair, sample};
pub use unfinished::worst_residual;

/// Share of flat pixels beyond 5 sigma that disturbs a pair. Real captures that are sound stay below 0.0002, and noise
/// alone below 0.000001; 0.002 of 1 MP is an area of 45 x 45 px.
pub const FLAT_OUTLIERS: f64 = 0.002;
/// Change of the light of single frames that is a reason: it moves a stripe edge by about a third of the 0.05 px that an
/// edge should be good for.
pub const CHANGE: f64 = 0.02;
/// Share of the pixels at stripe edges beyond 5 sigma that shows a response that is not linear. A linear projector and
/// camera stay below 0.0002; those with a gamma lie at 0.04 and above.
pub const EDGE_OUTLIERS: f64 = 0.01;
/// Residual as a share of the modulation from which on a frame shows another picture (1 is the ideal), not a rest of it.
pub const STALE_SHARE: f64 = 0.5;
/// The same for a reference, beside which other pictures may be the finest stripes, blurred to a part of it.
const ANOTHER_REFERENCE: f64 = 0.35;
/// Range of the same within which it is the modulation itself.
const ANOTHER: [f64; 2] = [0.75, 1.3];
/// Strength that no rest has, the references being too dark for the frames.
const ABSURD: f64 = 2.5;
/// Share of the outliers with one sign from which on they are one-sided.
const ONE_SIDED: f64 = 0.9;
/// Outliers of a pair from which on a whole frame is wrong. A frame that shows another pattern is wrong on a half of
/// the pixels or more.
pub const WHOLE_FRAME: f64 = 0.15;
/// Spread of the residuals of the outliers, as a share of their median, up to which they are one rest of one picture;
/// what moves leaves all sizes.
const ONE_REST: f64 = 0.35;

/// The pair that adds up least, where any is conspicuous.
pub fn worst_pair(pairs: &[PairResidual]) -> Option<&PairResidual> {
    let odd = |pair: &PairResidual| {
        let [flat, edge] = [pair.flat_outliers, pair.edge_outliers].map(|share| share.max(0.0));
        let spread = if pair.sigma.is_finite() { pair.sigma - 1.0 } else { 0.0 };
        let shift = if pair.median.is_finite() { pair.median.abs() } else { 0.0 };
        // Each in units of what is conspicuous.
        (flat / FLAT_OUTLIERS).max(edge / EDGE_OUTLIERS).max(spread / 0.25).max(shift)
    };
    pairs.iter().filter(|pair| odd(pair) > 1.0).max_by(|a, b| odd(a).total_cmp(&odd(b)))
}

/// Whether the change from one frame of a reference to another is as large as between different pictures: the median of
/// what changed beyond 5 sigma, as a share of the modulation. A display that has not settled leaves less.
pub fn is_another_picture(
    [first, last]: [Plane<'_>; 2],
    modulation: impl Fn(usize) -> f64,
    noise: NoiseModel,
    black_dn: f64,
) -> bool {
    let step = (first.len() / 50_000).max(1);
    let mut shares: Vec<f64> = (0..first.len().min(last.len()))
        .step_by(step)
        .filter_map(|at| {
            let [before, after] = [sample(first, at) - black_dn, sample(last, at) - black_dn];
            let sigma = (2.0 * noise.variance(before.max(after))).sqrt();
            let modulation = modulation(at).abs();
            let seen = (after - before).abs() > 5.0 * sigma && modulation > 8.0 * sigma;
            seen.then(|| (after - before).abs() / modulation)
        })
        .collect();
    statistics::median(&mut shares).is_none_or(|share| share >= ANOTHER_REFERENCE)
}

/// What is wrong with one pair, as far as the pair alone can tell.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Cause {
    /// Nothing: what looked like it was noise, or happens at stripe edges only.
    Nothing,
    /// The projector's light was brighter or darker.
    Lamp,
    /// Light was added or taken away alike everywhere.
    Room,
    /// A frame shows another picture.
    OtherPicture,
    /// A frame shows another picture on one side of this image row.
    Torn(usize),
    /// A frame carries a rest of this share of another picture.
    Rest(f64),
    /// A part of the image changed.
    Local,
}

impl Cause {
    /// Slug of the diagnosis that it is for a single pair; `None` for nothing.
    pub fn slug(self) -> Option<&'static str> {
        Some(match self {
            Self::Nothing => return None,
            Self::Lamp => "flicker",
            Self::Room => "ambient-drift",
            Self::OtherPicture => "stale-frame",
            Self::Torn(_) => "torn-frame",
            Self::Rest(_) => "unsettled-display",
            Self::Local => "motion",
        })
    }

    /// What was seen, in words.
    pub fn words(self) -> String {
        match self {
            Self::Nothing => "nothing but noise is left".to_owned(),
            Self::Lamp => "the projector's light changed".to_owned(),
            Self::Room => "the light in the room changed".to_owned(),
            Self::OtherPicture => "a frame shows another picture".to_owned(),
            Self::Torn(row) => format!("a frame shows another picture on one side of row {row}"),
            Self::Rest(share) => {
                format!("a rest of about {:.0} % of the picture before is still on the glass", 100.0 * share)
            }
            Self::Local => "a part of the image changed".to_owned(),
        }
    }
}

impl Look {
    /// What is wrong with the pair.
    pub fn cause(&self) -> Cause {
        if self.is_brightness() {
            return match (self.change.abs() > CHANGE, self.is_offset) {
                (false, _) => Cause::Nothing,
                (true, false) => Cause::Lamp,
                (true, true) => Cause::Room,
            };
        }
        if self.disturbed() <= FLAT_OUTLIERS {
            return Cause::Nothing;
        }
        let strength = self.strength.unwrap_or(1.0);
        let spread = self.strength_spread.unwrap_or(0.0);
        // Where the references carry a rest, too, it comes once or twice, and always brightens.
        let rests = self.one_sided >= ONE_SIDED && spread > ONE_REST && strength < ABSURD;
        // Another picture is off by the whole modulation; by more where the references are other pictures, too.
        let is_another = !rests && (strength > ANOTHER[1] || (strength >= ANOTHER[0] && spread <= ONE_REST));
        // Beside a picture of fine stripes, blurred to a part of their modulation, a tear leaves less.
        if let Some(row) = self.torn_at.filter(|_| is_another || strength >= STALE_SHARE) {
            return Cause::Torn(row);
        }
        if self.disturbed() < WHOLE_FRAME {
            return Cause::Local;
        }
        match is_another {
            true => Cause::OtherPicture,
            false if rests || spread <= ONE_REST => Cause::Rest(strength),
            false => Cause::Local,
        }
    }
}
