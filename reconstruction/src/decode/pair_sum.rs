//! The pair sum: a scan's proof that the frames show what was projected (method, section 5).
//!
//! Pattern and inverse together light each projector pixel as the two references together do, so
//! `P + Q - (R_H + R_V)` is noise: `variance = var(P) + var(Q) + var(R_H)/n_H + var(R_V)/n_V`. Where references are
//! missing, and in mode paper, the mean of all pair sums takes their place; it contains the pair itself, which leaves
//! `(1 - 1/pairs)` of a pair's variance.
//!
//! Looked at are lit pixels without a saturated frame, on rows spread over the image. With few bits the residual
//! takes few values, on which a median absolute deviation would jump; each is therefore moved by a fixed pseudo-random
//! part of a step within +-1/2 DN, whose variance of 1/12 DN^2 is counted.

#[cfg(test)]
pub(crate) mod plain;
mod scan;

use polscan_patterns::Axis;

use self::scan::Counts;
pub(crate) use self::scan::of_scan;
use super::{
    limits::Gates,
    noise,
    sample::Sample,
    types::{CameraResponse, NoiseModel, PairResidual, Plane},
};

/// Rows that are looked at after a scan, and for a single pair while the next ones are waiting.
const ROWS: usize = 300;
const ROWS_OF_CHECK: usize = 100;
/// A pixel with a stripe edge within these steps (in px, along x and y) is not flat: three sigma of the blur of a usual
/// chain of projector and camera, as far as a response that is not linear spoils the sum.
const NEAR_EDGE: [usize; 4] = [1, 2, 4, 6];
/// Steps of a smaller neighbourhood.
const BESIDE: [usize; 2] = [1, 2];
/// Below this many sigma of P - Q it is open which of the two is the brighter.
const OPEN_SIGMA: f32 = 3.0;
/// Open pixels, of the nine looked at for an edge, that are no stripe edge: both frames show the same there.
const OPEN_PIXELS: usize = 6;
const OUTLIER_SIGMA: f32 = 5.0;
const BINS_PER_SIGMA: f32 = 64.0;
const RANGE_SIGMA: f32 = 64.0;

/// What a single pair is checked against, during capture.
#[derive(Debug, Clone, Copy)]
pub struct PairContext<'a> {
    /// Axis of the pair, copied to the result.
    pub axis: Axis,
    /// Bit of the pair, copied to the result.
    pub bit: u8,
    /// Frame width in pixels.
    pub width: usize,
    /// Bright references taken so far (H, white).
    pub high: &'a [Plane<'a>],
    /// Dark references taken so far (V, black).
    pub low: &'a [Plane<'a>],
    /// Camera; its noise model is not looked at.
    pub camera: CameraResponse,
    /// Noise: calibrated, or from [`estimate_noise`].
    pub noise: NoiseModel,
    /// Lit gate in sigma of the modulation, as in the decode.
    pub lit_sigma: f64,
}

/// Residual of one pair against the references taken so far. `None` where a reference is missing, or frames differ in
/// type or size. Costs about 0.1 us for each of the pixels on some 100 to 200 sampled rows, whatever the height.
pub fn pair_residual(p: Plane<'_>, q: Plane<'_>, context: &PairContext<'_>) -> Option<PairResidual> {
    match p {
        Plane::U8(_) => typed_residual::<u8>(p, q, context),
        Plane::U16(_) => typed_residual::<u16>(p, q, context),
    }
}

/// Noise of the camera from two or more pairs of frames that sum to the same light (pattern and inverse of coarse
/// bits; both references are such a pair too), each pair compared with the next. `None` where there is too little.
pub fn estimate_noise(pairs: &[[Plane<'_>; 2]], width: usize, camera: &CameraResponse) -> Option<NoiseModel> {
    fn typed<T: Sample>(
        pairs: &[[Plane<'_>; 2]],
        width: usize,
        camera: &CameraResponse,
    ) -> Option<NoiseModel> {
        let len = pairs.first()?[0].len();
        let pairs: Vec<[&[T]; 2]> = pairs
            .iter()
            .map(|pair| {
                Some([T::of(pair[0])?, T::of(pair[1])?]).filter(|pair| pair.iter().all(|p| p.len() == len))
            })
            .collect::<Option<_>>()?;
        noise::from_pairs(
            &pairs,
            width,
            camera.bit_depth,
            camera.black_level_dn.unwrap_or(0.0),
            camera.saturation_dn,
        )
    }
    match pairs.first()?[0] {
        Plane::U8(_) => typed::<u8>(pairs, width, camera),
        Plane::U16(_) => typed::<u16>(pairs, width, camera),
    }
}

/// Counts of residuals.
struct Tally {
    bins: Vec<u64>,
    flat: [u64; 2],
    edge: [u64; 2],
}

impl Tally {
    /// Number of bins.
    const BINS: usize = (2.0 * RANGE_SIGMA * BINS_PER_SIGMA) as usize;
    /// Bin of what is not counted.
    const NOWHERE: u16 = Self::BINS as u16;

    fn new() -> Self {
        Self { bins: vec![0; Self::BINS + 1], flat: [0; 2], edge: [0; 2] }
    }

    /// Place of a residual among the bins; its whole part is the bin.
    #[inline(always)]
    fn place(residual: f32) -> f32 {
        ((residual + RANGE_SIGMA) * BINS_PER_SIGMA).max(0.0).min((Self::BINS - 1) as f32)
    }

    fn add(&mut self, residual: f32, flat: bool) {
        self.bins[Self::place(residual) as usize] += 1;
        let kind = if flat { &mut self.flat } else { &mut self.edge };
        kind[0] += 1;
        kind[1] += u64::from(residual.abs() > OUTLIER_SIGMA);
    }

    /// Adds many residuals by their bins.
    fn count(&mut self, bins: &[u16], Counts { edge, all }: Counts) {
        // A length that the compiler knows spares it the check of each index.
        if let Some(all_bins) = self.bins.first_chunk_mut::<{ Self::BINS + 1 }>() {
            for &bin in bins {
                all_bins[usize::from(bin.min(Self::NOWHERE))] += 1;
            }
        }
        for kind in 0..2 {
            self.edge[kind] += edge[kind];
            self.flat[kind] += all[kind] - edge[kind];
        }
    }

    fn join(&mut self, other: &Self) {
        self.bins.iter_mut().zip(&other.bins).for_each(|(sum, more)| *sum += more);
        for kind in 0..2 {
            self.edge[kind] += other.edge[kind];
            self.flat[kind] += other.flat[kind];
        }
    }

    fn finish(&self, axis: Axis, bit: u8) -> PairResidual {
        let bins = &self.bins[..Self::BINS];
        let total: u64 = bins.iter().sum();
        let share = |[all, beyond]: [u64; 2]| if all == 0 { 0.0 } else { beyond as f64 / all as f64 };
        if total == 0 {
            let nothing = f64::NAN;
            return PairResidual {
                axis,
                bit,
                sigma: nothing,
                median: nothing,
                flat_outliers: 0.0,
                edge_outliers: 0.0,
                pixels: 0,
            };
        }
        let half = total as f64 / 2.0;
        let mut below = 0.0;
        let mut median = 0.0;
        for (index, &count) in bins.iter().enumerate() {
            if below + count as f64 >= half {
                median = index as f64 + (half - below) / count as f64;
                break;
            }
            below += count as f64;
        }
        // Median absolute deviation in bins: the distance that holds half of the counts.
        let cumulative: Vec<f64> = std::iter::once(0.0)
            .chain(bins.iter().scan(0.0, |sum, &count| {
                *sum += count as f64;
                Some(*sum)
            }))
            .collect();
        let rank = |position: f64| {
            let position = position.clamp(0.0, bins.len() as f64);
            let index = (position as usize).min(bins.len() - 1);
            cumulative[index] + (cumulative[index + 1] - cumulative[index]) * (position - index as f64)
        };
        let (mut near, mut far) = (0.0, bins.len() as f64);
        for _ in 0..48 {
            let middle = (near + far) / 2.0;
            if rank(median + middle) - rank(median - middle) < half {
                near = middle;
            } else {
                far = middle;
            }
        }
        PairResidual {
            axis,
            bit,
            sigma: 1.4826 * far / f64::from(BINS_PER_SIGMA),
            median: median / f64::from(BINS_PER_SIGMA) - f64::from(RANGE_SIGMA),
            flat_outliers: share(self.flat),
            edge_outliers: share(self.edge),
            pixels: total,
        }
    }
}

/// Sampled rows of an image of `height` rows.
fn sampled_rows(height: usize, rows: usize) -> impl Iterator<Item = usize> + Clone {
    let stride = (height / rows).max(1);
    (stride / 2..height).step_by(stride)
}

/// A fixed pseudo-random number in [-1/2, 1/2) for pixel `at` (a multiplicative hash).
fn dither(at: usize) -> f32 {
    let mut hash = (at as u32).wrapping_mul(0x9E37_79B9);
    hash = (hash ^ (hash >> 15)).wrapping_mul(0x85EB_CA6B);
    (hash >> 8) as f32 / (1u32 << 24) as f32 - 0.5
}

const DITHER_VARIANCE: f32 = 1.0 / 12.0;

/// Expected pair sum and 1/sigma of the residual at a pixel; `None` where the pixel is not looked at.
struct Expected {
    sum: f32,
    per_sigma: f32,
}

fn from_references<T: Sample>(high: &[&[T]], low: &[&[T]], at: usize, gates: &Gates) -> Option<Expected> {
    let mean = |planes: &[&[T]]| {
        let mut sum = 0i64;
        for plane in planes {
            let dn = plane[at].dn();
            if dn >= gates.saturation_dn {
                return None;
            }
            sum += i64::from(dn);
        }
        Some(sum as f32 / planes.len() as f32)
    };
    let (high_dn, low_dn) = (mean(high)?, mean(low)?);
    let (of_high, of_low) = (gates.variance(high_dn), gates.variance(low_dn));
    let of_references = of_high / high.len() as f32 + of_low / low.len() as f32;
    let variance = of_high + of_low + of_references + DITHER_VARIANCE;
    let lit = (high_dn - low_dn).abs() >= gates.lit_sigma * of_references.sqrt();
    lit.then(|| Expected { sum: high_dn + low_dn, per_sigma: variance.sqrt().recip() })
}

fn typed_residual<T: Sample>(p: Plane<'_>, q: Plane<'_>, context: &PairContext<'_>) -> Option<PairResidual> {
    let (p, q) = (T::of(p)?, T::of(q)?);
    let typed =
        |planes: &[Plane<'_>]| planes.iter().all(|plane| T::of(*plane).is_some_and(|s| s.len() == p.len()));
    let whole = context.width > 0 && p.len() == q.len() && p.len().is_multiple_of(context.width);
    if !whole
        || context.high.is_empty()
        || context.low.is_empty()
        || !typed(context.high)
        || !typed(context.low)
    {
        return None;
    }
    let high: Vec<&[T]> = context.high.iter().filter_map(|&plane| T::of(plane)).collect();
    let low: Vec<&[T]> = context.low.iter().filter_map(|&plane| T::of(plane)).collect();
    let gates = Gates::for_check(context.camera, context.noise, context.lit_sigma);
    let (width, height) = (context.width, p.len() / context.width);
    let mut tally = Tally::new();
    let above = |at: usize| p[at].dn() > q[at].dn();
    // Where a stale frame equals its partner noise alone decides which is above, and would feign edges everywhere.
    let open = |at: usize| {
        let (p, q) = (p[at].dn() as f32, q[at].dn() as f32);
        (p - q).powi(2) < OPEN_SIGMA * OPEN_SIGMA * (gates.variance(p) + gates.variance(q))
    };
    for y in sampled_rows(height, ROWS_OF_CHECK) {
        for x in 0..width {
            let at = y * width + x;
            let (dn_p, dn_q) = (p[at].dn(), q[at].dn());
            if dn_p >= gates.saturation_dn || dn_q >= gates.saturation_dn {
                continue;
            }
            let Some(expected) = from_references(&high, &low, at, &gates) else { continue };
            let here = above(at);
            let flat = neighbours(NEAR_EDGE, [x, y], [width, height]).all(|other| above(other) == here)
                || neighbours(BESIDE, [x, y], [width, height]).chain([at]).filter(|&at| open(at)).count()
                    >= OPEN_PIXELS;
            let residual = (dn_p + dn_q) as f32 - expected.sum + dither(at);
            tally.add(residual * expected.per_sigma, flat);
        }
    }
    Some(tally.finish(context.axis, context.bit))
}

/// Pixels `steps` away along x and y.
fn neighbours<const N: usize>(
    steps: [usize; N],
    [x, y]: [usize; 2],
    [width, height]: [usize; 2],
) -> impl Iterator<Item = usize> {
    let at = y * width + x;
    steps.into_iter().flat_map(move |step| {
        [
            (x >= step).then(|| at - step),
            (x + step < width).then(|| at + step),
            (y >= step).then(|| at - step * width),
            (y + step < height).then(|| at + step * width),
        ]
        .into_iter()
        .flatten()
    })
}
