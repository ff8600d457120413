//! Camera noise from the frames of a scan.
//!
//! The pair sums of two pairs of one axis differ by noise alone: `S_k - S_(k+1)` has the variance of four frames.
//! Three things must not pass for noise. Stripe edges and the finest bits of a non-linear projector: only the coarse
//! half of the bits is used. Slow differences of stray light between patterns: the difference at one pixel is
//! compared with that a few pixels on. Outliers: spread is read from quantiles. The line `read^2 + K * level` is then
//! fitted over bins of level.

use rayon::prelude::*;

use super::{plan::Frames, sample::Sample, types::NoiseModel};

/// Distance in px over which slow differences are cancelled; a multiple of the common block of image compression.
const PARTNER: usize = 8;
/// Rows that are looked at.
const ROWS: usize = 160;
const LEVEL_BINS: usize = 48;
/// Parts of the sources that are looked at side by side.
const PARTS: usize = 4;
/// Fewer samples in a bin say nothing.
const MIN_SAMPLES: u64 = 400;

/// Two planes per source whose sum is free of the pattern (pattern and inverse), or one that was shot twice.
struct Source<'a, T> {
    first: [&'a [T]; 2],
    second: [&'a [T]; 2],
}

/// Spread of differences in bins of level.
struct Spread {
    step: i32,
    half: usize,
    counts: Vec<u32>,
    level_sums: Vec<f64>,
    totals: Vec<u64>,
}

impl Spread {
    fn new(bit_depth: u8) -> Self {
        let step = 1i32 << u32::from(bit_depth).saturating_sub(13);
        let half = 4096;
        Self {
            step,
            half,
            counts: vec![0; LEVEL_BINS * (2 * half + 1)],
            level_sums: vec![0.0; LEVEL_BINS],
            totals: vec![0; LEVEL_BINS],
        }
    }

    /// `difference` of two sums of two frames each pair; `level` of one frame above black, and its bin.
    fn add(&mut self, (bin, level): (usize, f64), difference: i32) {
        let half = self.half as i32;
        let at = (difference.div_euclid(self.step)).clamp(-half, half) + half;
        self.counts[bin * (2 * self.half + 1) + at as usize] += 1;
        self.level_sums[bin] += level;
        self.totals[bin] += 1;
    }

    fn join(mut self, other: Self) -> Self {
        self.counts.iter_mut().zip(other.counts).for_each(|(sum, more)| *sum += more);
        self.level_sums.iter_mut().zip(other.level_sums).for_each(|(sum, more)| *sum += more);
        self.totals.iter_mut().zip(other.totals).for_each(|(sum, more)| *sum += more);
        self
    }

    /// Level, variance of one frame and its relative accuracy for each bin that has enough samples.
    fn variances(&self, frames_per_difference: f64) -> Vec<(f64, f64, f64)> {
        let width = 2 * self.half + 1;
        (0..LEVEL_BINS)
            .filter(|&bin| self.totals[bin] >= MIN_SAMPLES)
            .map(|bin| {
                let counts = &self.counts[bin * width..][..width];
                let total = self.totals[bin] as f64;
                let spread =
                    (quantile(counts, 0.841_344_7 * total) - quantile(counts, 0.158_655_3 * total)) / 2.0;
                // Counts are spread evenly over their step, which adds the variance of that step.
                let variance = (spread * spread - 1.0 / 12.0).max(0.0) * f64::from(self.step * self.step);
                // Quantiles of N samples are about 1.9 times noisier than a standard deviation; 2 % is the floor
                // that non-linearities leave.
                (self.level_sums[bin] / total, variance / frames_per_difference, 3.6 / total + 4e-4)
            })
            .collect()
    }
}

/// Bin and level above black of a sum of eight samples.
struct Levels {
    black_level_dn: f64,
    bins: Vec<u8>,
}

impl Levels {
    fn new(bit_depth: u8, black_level_dn: f64) -> Self {
        let full_scale = f64::from(1u32 << bit_depth);
        let bin = |sum: u32| {
            let level = f64::from(sum) / 8.0 - black_level_dn;
            // Square root spacing: shot noise makes dark bins the informative ones.
            let share = (level.max(0.0) / full_scale).min(1.0).sqrt();
            ((share * LEVEL_BINS as f64) as usize).min(LEVEL_BINS - 1) as u8
        };
        Self { black_level_dn, bins: (0..8u32 << bit_depth).map(bin).collect() }
    }

    /// `None` for a sum of what the bit depth does not allow.
    fn of(&self, sum: i32) -> Option<(usize, f64)> {
        let bin = *self.bins.get(usize::try_from(sum).ok()?)?;
        Some((usize::from(bin), (f64::from(sum) / 8.0 - self.black_level_dn).max(0.0)))
    }
}

/// Position in steps below which `rank` of the counts lie, each count spread evenly over its step.
fn quantile(counts: &[u32], rank: f64) -> f64 {
    let mut below = 0.0;
    for (index, &count) in counts.iter().enumerate() {
        let count = f64::from(count);
        if below + count >= rank && count > 0.0 {
            return index as f64 + (rank - below) / count;
        }
        below += count;
    }
    counts.len() as f64
}

/// Noise of the camera from the frames, or `None` where they hold no two exposures of the same light.
pub(crate) fn estimate<T: Sample>(
    frames: &Frames<'_, T>,
    bit_depth: u8,
    black_level_dn: f64,
    saturation_dn: u16,
) -> Option<NoiseModel> {
    let mut sources = Vec::new();
    for axis in &frames.axes {
        let coarse = axis.code.code.bits().div_ceil(2);
        let pairs: Vec<_> = frames
            .pairs()
            .filter(|&(a, bit, ..)| a == axis.axis && bit < coarse)
            .map(|(.., p, q)| [p, q])
            .collect();
        sources.extend(pairs.windows(2).map(|two| Source { first: two[0], second: two[1] }));
    }
    if sources.is_empty() {
        for role in [&frames.low, &frames.high] {
            sources.extend(role.windows(2).map(|two| Source { first: [two[0]; 2], second: [two[1]; 2] }));
        }
    }
    from_sources(&sources, frames.width, bit_depth, black_level_dn, saturation_dn)
}

/// Noise from pairs of pattern and inverse alone, for a check during capture.
pub(crate) fn from_pairs<T: Sample>(
    pairs: &[[&[T]; 2]],
    width: usize,
    bit_depth: u8,
    black_level_dn: f64,
    saturation_dn: u16,
) -> Option<NoiseModel> {
    let sources: Vec<_> = pairs.windows(2).map(|two| Source { first: two[0], second: two[1] }).collect();
    from_sources(&sources, width, bit_depth, black_level_dn, saturation_dn)
}

fn from_sources<T: Sample>(
    sources: &[Source<'_, T>],
    width: usize,
    bit_depth: u8,
    black_level_dn: f64,
    saturation_dn: u16,
) -> Option<NoiseModel> {
    let height = sources.first()?.first[0].len().checked_div(width)?;
    // A repeated reference is handed in as both planes of its source: its difference counts twice, its variance four times.
    let twice = std::ptr::eq(sources[0].first[0], sources[0].first[1]);
    let levels = Levels::new(bit_depth, black_level_dn);
    // Parts that do not depend on the number of threads are added in their order: so the sums do not either.
    let parts: Vec<Spread> = sources
        .par_chunks(sources.len().div_ceil(PARTS))
        .map(|sources| {
            let mut spread = Spread::new(bit_depth);
            for source in sources {
                add_source(&mut spread, source, (width, height), &levels, i32::from(saturation_dn));
            }
            spread
        })
        .collect();
    let spread = parts.into_iter().reduce(Spread::join)?;
    fit(&spread.variances(if twice { 16.0 } else { 8.0 }))
}

fn add_source<T: Sample>(
    spread: &mut Spread,
    source: &Source<'_, T>,
    (width, height): (usize, usize),
    levels: &Levels,
    saturation: i32,
) {
    let stride = (height / ROWS).max(1);
    for y in (stride / 2..height).step_by(stride) {
        let row =
            |plane: &'_ [T]| -> Vec<i32> { plane[y * width..][..width].iter().map(|s| s.dn()).collect() };
        let planes = [source.first[0], source.first[1], source.second[0], source.second[1]].map(row);
        let sums = |x: usize| {
            let values = [0, 1, 2, 3].map(|plane: usize| planes[plane][x]);
            let clipped = values.iter().any(|&value| value >= saturation || value <= 0);
            (!clipped).then_some((values[0] + values[1], values[2] + values[3]))
        };
        for x in 0..width.saturating_sub(PARTNER) {
            let (Some(here), Some(there)) = (sums(x), sums(x + PARTNER)) else { continue };
            let sums = [here.0 + here.1, there.0 + there.1];
            // Very different levels carry their stray light differently and belong into no common bin.
            if (sums[0] - sums[1]).abs() > (sums[0] + sums[1]) / 8 {
                continue;
            }
            if let Some(level) = levels.of(sums[0] + sums[1]) {
                spread.add(level, (here.0 - here.1) - (there.0 - there.1));
            }
        }
    }
}

/// `read^2 + 1/12 + K * level` by weighted least squares, both terms kept from going negative.
fn fit(points: &[(f64, f64, f64)]) -> Option<NoiseModel> {
    if points.is_empty() {
        return None;
    }
    let (mut offset, mut slope) = (0.0f64, 0.0f64);
    for round in 0..4 {
        let weighted = points.iter().map(|&(level, variance, relative)| {
            let scale = if round == 0 { variance } else { offset + slope * level };
            (level, variance, 1.0 / (scale.max(1.0 / 12.0).powi(2) * relative))
        });
        let (mut w, mut wl, mut wv, mut wll, mut wlv) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for (level, variance, weight) in weighted {
            w += weight;
            wl += weight * level;
            wv += weight * variance;
            wll += weight * level * level;
            wlv += weight * level * variance;
        }
        let determinant = w * wll - wl * wl;
        // Levels that differ by less than about 5 % cannot tell read noise from shot noise.
        (offset, slope) = if determinant > 0.003 * w * wll {
            ((wll * wv - wl * wlv) / determinant, (w * wlv - wl * wv) / determinant)
        } else {
            (wv / w, 0.0)
        };
        if slope < 0.0 {
            (offset, slope) = (wv / w, 0.0);
        } else if offset < 1.0 / 12.0 && wll > 0.0 {
            offset = 1.0 / 12.0;
            slope = ((wlv - offset * wl) / wll).max(0.0);
        }
    }
    Some(NoiseModel { gain_dn_per_electron: slope, read_noise_dn: (offset - 1.0 / 12.0).max(0.0).sqrt() })
}

/// What is assumed where nothing can be measured: a full well of 10 000 electrons and a read noise of 1/1000 of it.
pub(crate) fn assumed(bit_depth: u8) -> NoiseModel {
    let full_scale = f64::from((1u32 << bit_depth) - 1);
    NoiseModel { gain_dn_per_electron: full_scale / 10_000.0, read_noise_dn: full_scale / 1000.0 }
}
