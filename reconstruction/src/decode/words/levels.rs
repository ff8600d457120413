//! Levels of the two states of the code at each pixel, and what follows from them before a bit is read.

use std::ops::Range;

use polscan_patterns::Mode;

use super::{BLOCK, RowMaps, Scratch};
use crate::decode::{
    limits::Gates,
    plan::{Frames, Levels},
    sample::Sample,
    whole::{LARGEST, whole_part},
};

/// Levels of the pixels of a block, in DN.
pub(super) struct BlockLevels {
    /// Bright state.
    high: [f32; BLOCK],
    /// Dark state.
    low: [f32; BLOCK],
    /// Their difference C.
    modulation: [f32; BLOCK],
    /// Variance of C from the references' own noise.
    pub variance: [f32; BLOCK],
    /// What the degree of polarization is taken against.
    dark: [f32; BLOCK],
}

impl BlockLevels {
    pub fn new() -> Self {
        let zeros = [0.0; BLOCK];
        Self { high: zeros, low: zeros, modulation: zeros, variance: zeros, dark: zeros }
    }
}

impl<T: Sample> Scratch<T> {
    /// Reference levels, modulation, thresholds and pictures of the block.
    #[inline(always)]
    pub(super) fn find_levels(
        &mut self,
        frames: &Frames<'_, T>,
        gates: &Gates,
        at: &Range<usize>,
        row: &mut RowMaps<'_>,
    ) {
        let len = at.len();
        let levels = &mut self.levels;
        let (mut high_full, mut low_full) = ([0; BLOCK], [0; BLOCK]);
        means(&frames.high, at, gates.saturation_dn, &mut levels.high, &mut high_full);
        means(&frames.low, at, gates.saturation_dn, &mut levels.low, &mut low_full);
        for (saturated, (high, low)) in
            self.reference_saturated[..len].iter_mut().zip(high_full.iter().zip(&low_full))
        {
            *saturated = (high | low) | ((high & low) << 1);
        }
        if frames.levels == Levels::References {
            let counts = [frames.high.len() as f32, frames.low.len() as f32];
            of_references(levels, counts, gates, len);
        } else {
            without_a_reference(levels, frames, gates, at);
        }
        let BlockLevels { high, low, modulation, dark, .. } = &self.levels;
        let (high, low, dark) = (&high[..len], &low[..len], &dark[..len]);
        row.modulation.copy_from_slice(&modulation[..len]);
        signs(row.modulation, &mut self.inverted[..len]);
        sums_and_sigmas(high, low, gates, &mut self.level_sum[..len], row.sigma);
        soft_limits(row.sigma, gates.soft_sigma, &mut self.soft_at[..len]);
        degrees(&self.level_sum[..len], dark, gates, row.dolp);
        brightness(high, low, 255.0 / gates.full_scale_dn, row.intensity);
    }
}

/// Modulation and its variance from both references.
#[inline(always)]
fn of_references(levels: &mut BlockLevels, [high_count, low_count]: [f32; 2], gates: &Gates, len: usize) {
    let BlockLevels { high, low, modulation, variance, dark } = levels;
    let (high, low, dark) = (&high[..len], &low[..len], &mut dark[..len]);
    let (modulation, variance) = (&mut modulation[..len], &mut variance[..len]);
    for x in 0..len {
        variance[x] = gates.variance(high[x]) / high_count + gates.variance(low[x]) / low_count;
        modulation[x] = high[x] - low[x];
        dark[x] = low[x];
    }
}

/// Levels where at least one reference is missing: the mean pair sum stands in for both together.
#[inline(always)]
fn without_a_reference<T: Sample>(
    levels: &mut BlockLevels,
    frames: &Frames<'_, T>,
    gates: &Gates,
    at: &Range<usize>,
) {
    let (mut sums, mut differences) = ([0i32; BLOCK], [0i32; BLOCK]);
    for (_, _, p, q) in frames.pairs() {
        let (p, q) = (&p[at.clone()], &q[at.clone()]);
        for (x, (sum, difference)) in sums.iter_mut().zip(&mut differences).take(p.len()).enumerate() {
            *sum += p[x].dn() + q[x].dn();
            *difference += (p[x].dn() - q[x].dn()).abs();
        }
    }
    let pair_count = frames.pair_count() as f32;
    let (high_count, low_count) = (frames.high.len() as f32, frames.low.len() as f32);
    for x in 0..at.len() {
        let (known_high, known_low) = (levels.high[x], levels.low[x]);
        let mean_sum = sums[x] as f32 / pair_count;
        let mean_difference = differences[x] as f32 / pair_count;
        let (high, low) = match frames.levels {
            Levels::HighOnly => (known_high, mean_sum - known_high),
            Levels::LowOnly => (mean_sum - known_low, known_low),
            _ => ((mean_sum + mean_difference) / 2.0, (mean_sum - mean_difference) / 2.0),
        };
        let both = gates.variance(high) + gates.variance(low);
        // C = +-(2 R - mean sum): the known reference counts twice.
        levels.variance[x] = match frames.levels {
            Levels::HighOnly => 4.0 * gates.variance(high) / high_count + both / pair_count,
            Levels::LowOnly => 4.0 * gates.variance(low) / low_count + both / pair_count,
            _ => both / 2.0,
        };
        // Mode paper knows R_V; its R_H is the mean pair sum less R_V.
        levels.dark[x] = if gates.mode == Mode::Paper { known_low } else { low };
        levels.modulation[x] = if frames.levels == Levels::Pairs { mean_difference } else { high - low };
        (levels.high[x], levels.low[x]) = (high, low);
    }
}

/// Means of the planes, and 1 where one of them is saturated.
#[inline(always)]
pub(crate) fn means<T: Sample>(
    planes: &[&[T]],
    at: &Range<usize>,
    full: i32,
    means: &mut [f32; BLOCK],
    saturated: &mut [u8; BLOCK],
) {
    let len = at.len();
    let mut sums = [0u32; BLOCK];
    for plane in planes {
        add_plane(&plane[at.clone()], full, &mut sums[..len], &mut saturated[..len]);
    }
    let count = planes.len().max(1) as f32;
    for (mean, sum) in means[..len].iter_mut().zip(&sums) {
        *mean = *sum as f32 / count;
    }
}

#[inline(always)]
fn add_plane<T: Sample>(plane: &[T], full: i32, sums: &mut [u32], saturated: &mut [u8]) {
    let len = plane.len();
    let (sums, saturated) = (&mut sums[..len], &mut saturated[..len]);
    for x in 0..len {
        let dn = plane[x].dn();
        sums[x] += dn as u32;
        saturated[x] |= u8::from(dn >= full);
    }
}

#[inline(always)]
fn signs(modulation: &[f32], inverted: &mut [u16]) {
    for (inverted, modulation) in inverted.iter_mut().zip(modulation) {
        *inverted = if *modulation < 0.0 { u16::MAX } else { 0 };
    }
}

#[inline(always)]
fn sums_and_sigmas(high: &[f32], low: &[f32], gates: &Gates, sums: &mut [f32], sigmas: &mut [f32]) {
    let len = high.len();
    let (low, sums, sigmas) = (&low[..len], &mut sums[..len], &mut sigmas[..len]);
    for x in 0..len {
        sums[x] = high[x] + low[x];
        sigmas[x] = (gates.variance(high[x]) + gates.variance(low[x])).sqrt();
    }
}

/// The largest |P - Q| that is soft: the last whole number below `soft_sigma` times sigma.
#[inline(always)]
fn soft_limits<T: Sample>(sigmas: &[f32], soft_sigma: f32, soft_at: &mut [T]) {
    for (soft_at, sigma) in soft_at.iter_mut().zip(sigmas) {
        let limit = (soft_sigma * sigma).min(LARGEST);
        let down = whole_part(limit);
        *soft_at = T::nearest(down - i32::from(down as f32 >= limit));
    }
}

#[inline(always)]
fn degrees(sums: &[f32], dark: &[f32], gates: &Gates, dolp: &mut [f32]) {
    let len = sums.len();
    let (dark, dolp) = (&dark[..len], &mut dolp[..len]);
    for x in 0..len {
        dolp[x] = gates.dolp(sums[x] - dark[x], dark[x]).clamp(0.0, 1.0);
    }
}

#[inline(always)]
fn brightness(high: &[f32], low: &[f32], scale: f32, intensity: &mut [u8]) {
    let len = high.len();
    let (low, intensity) = (&low[..len], &mut intensity[..len]);
    for x in 0..len {
        let share = (high[x].max(low[x]) * scale + 0.5).clamp(0.0, 255.0);
        intensity[x] = whole_part(share) as u8;
    }
}
