//! The pair sums of a whole scan at once, one block of a sampled row at a time over all pairs.

use std::ops::Range;

use rayon::prelude::*;

use super::{DITHER_VARIANCE, NEAR_EDGE, OUTLIER_SIGMA, ROWS, Tally, dither, sampled_rows};
use crate::{
    decode::{
        limits::Gates,
        plan::{Frames, Levels, axis_position},
        sample::Sample,
        types::{Class, PairResidual},
        whole::whole_part,
        words::{BLOCK, PixelMaps, levels::means},
    },
    simd::{InstructionSet, Work},
};

/// Residuals of all pairs of a scan, in order of axis and bit.
pub(crate) fn of_scan<T: Sample>(
    frames: &Frames<'_, T>,
    maps: &PixelMaps,
    gates: &Gates,
    set: InstructionSet,
) -> Vec<PairResidual> {
    let pairs: Vec<_> = frames.pairs().map(|(axis, bit, ..)| (axis, bit)).collect();
    let rows: Vec<usize> = sampled_rows(frames.height, ROWS).collect();
    let share = rows.len().div_ceil(2 * rayon::current_num_threads()).max(1);
    let fresh = || pairs.iter().map(|_| Tally::new()).collect::<Vec<_>>();
    let tallies = rows
        .par_chunks(share)
        .map(|rows| {
            let mut tallies = fresh();
            let mut block = Block::new();
            for &y in rows {
                set.run(TallyRow { block: &mut block, tallies: &mut tallies, frames, maps, gates, y });
            }
            tallies
        })
        .reduce(fresh, |mut sum, more| {
            sum.iter_mut().zip(&more).for_each(|(sum, more)| sum.join(more));
            sum
        });
    pairs.iter().zip(tallies).map(|(&(axis, bit), tally)| tally.finish(axis, bit)).collect()
}

/// What is the same for all pairs of a block of pixels.
struct Block {
    high: [f32; BLOCK],
    low: [f32; BLOCK],
    high_full: [u8; BLOCK],
    low_full: [u8; BLOCK],
    /// Expected pair sum in DN.
    sum: [f32; BLOCK],
    /// Inverse sigma of the residual; 0 where a pixel is not looked at.
    per_sigma: [f32; BLOCK],
    dither: [f32; BLOCK],
    /// Bits of the word that change nearby, per axis.
    changed: [[u16; BLOCK]; 2],
    /// Bins of one pair's residuals.
    bins: [u16; BLOCK],
}

impl Block {
    fn new() -> Self {
        let zeros = [0.0; BLOCK];
        Self {
            high: zeros,
            low: zeros,
            high_full: [0; BLOCK],
            low_full: [0; BLOCK],
            sum: zeros,
            per_sigma: zeros,
            dither: zeros,
            changed: [[0; BLOCK]; 2],
            bins: [0; BLOCK],
        }
    }
}

/// One sampled row.
struct TallyRow<'a, T> {
    block: &'a mut Block,
    tallies: &'a mut [Tally],
    frames: &'a Frames<'a, T>,
    maps: &'a PixelMaps,
    gates: &'a Gates,
    y: usize,
}

impl<T: Sample> Work for TallyRow<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { block, tallies, frames, maps, gates, y } = self;
        let (width, full) = (frames.width, gates.saturation_dn);
        for start in (0..width).step_by(BLOCK) {
            let at = y * width + start..y * width + (start + BLOCK).min(width);
            block.expect(frames, maps, gates, &at);
            for (changed, words) in block.changed.iter_mut().zip(&maps.words) {
                if !words.is_empty() {
                    find_changes(words, [width, frames.height], [start, y], &mut changed[..at.len()]);
                }
            }
            for ((axis, bit, p, q), tally) in frames.pairs().zip(&mut *tallies) {
                let index = axis_position(frames, axis);
                let place = frames.axes[index].code.bits - 1 - bit;
                block.tally(&p[at.clone()], &q[at.clone()], full, (index, place), tally);
            }
        }
    }
}

impl Block {
    /// Expected pair sums of the pixels `at`.
    #[inline(always)]
    fn expect<T: Sample>(
        &mut self,
        frames: &Frames<'_, T>,
        maps: &PixelMaps,
        gates: &Gates,
        at: &Range<usize>,
    ) {
        let len = at.len();
        for (x, dither_at) in self.dither[..len].iter_mut().enumerate() {
            *dither_at = dither(at.start + x);
        }
        let class = &maps.class[at.clone()];
        if frames.levels == Levels::References {
            (self.high_full, self.low_full) = ([0; BLOCK], [0; BLOCK]);
            means(&frames.high, at, gates.saturation_dn, &mut self.high, &mut self.high_full);
            means(&frames.low, at, gates.saturation_dn, &mut self.low, &mut self.low_full);
            let counts = [frames.high.len() as f32, frames.low.len() as f32];
            let free = |x: usize| looked_at(class[x]) & (self.high_full[x] | self.low_full[x] == 0);
            let (high, low) = (&self.high[..len], &self.low[..len]);
            from_references(high, low, counts, free, gates, &mut self.sum[..len], &mut self.per_sigma[..len]);
            return;
        }
        let pair_count = frames.pair_count();
        let kept = 1.0 - 1.0 / pair_count as f32;
        for (x, &class) in class.iter().enumerate() {
            let here = at.start + x;
            let sum: i32 = frames.pairs().map(|(_, _, p, q)| p[here].dn() + q[here].dn()).sum();
            let variance = maps.sigma[here] * maps.sigma[here] * kept + DITHER_VARIANCE;
            let usable = looked_at(class) && pair_count > 1;
            self.sum[x] = sum as f32 / pair_count as f32;
            self.per_sigma[x] = if usable { variance.sqrt().recip() } else { 0.0 };
        }
    }

    /// Counts the residuals of one pair, whose axis has an index and whose bit a place in the word.
    #[inline(always)]
    fn tally<T: Sample>(
        &mut self,
        p: &[T],
        q: &[T],
        full: i32,
        (index, place): (usize, u8),
        tally: &mut Tally,
    ) {
        let len = p.len();
        let expected = (&self.sum[..len], &self.per_sigma[..len], &self.dither[..len]);
        let counts =
            bins_of(p, q, full, expected, (&self.changed[index][..len], place), &mut self.bins[..len]);
        tally.count(&self.bins[..len], counts);
    }
}

#[inline(always)]
fn looked_at(class: Class) -> bool {
    class.is_lit() & (class != Class::Saturated)
}

/// Expected sum and inverse sigma from the references' means, where the pixel is `free` and lit.
#[inline(always)]
fn from_references(
    high: &[f32],
    low: &[f32],
    [high_count, low_count]: [f32; 2],
    free: impl Fn(usize) -> bool,
    gates: &Gates,
    sum: &mut [f32],
    per_sigma: &mut [f32],
) {
    let len = high.len();
    let (low, sum, per_sigma) = (&low[..len], &mut sum[..len], &mut per_sigma[..len]);
    for x in 0..len {
        let (of_high, of_low) = (gates.variance(high[x]), gates.variance(low[x]));
        let of_references = of_high / high_count + of_low / low_count;
        let variance = of_high + of_low + of_references + DITHER_VARIANCE;
        let lit = (high[x] - low[x]).abs() >= gates.lit_sigma * of_references.sqrt();
        sum[x] = high[x] + low[x];
        per_sigma[x] = if lit & free(x) { variance.sqrt().recip() } else { 0.0 };
    }
}

/// Bits of the words that differ from those of a pixel nearby, for a block of the row `y` from column `start` on.
#[inline(always)]
fn find_changes(words: &[u16], [width, height]: [usize; 2], [start, y]: [usize; 2], changed: &mut [u16]) {
    let len = changed.len();
    let at = y * width + start;
    let here = &words[at..at + len];
    changed.fill(0);
    for step in NEAR_EDGE {
        if y >= step {
            differences(here, &words[at - step * width..][..len], changed);
        }
        if y + step < height {
            differences(here, &words[at + step * width..][..len], changed);
        }
        // Along the row the first or the last pixels of the image may have no neighbour that far.
        let first = step.saturating_sub(start).min(len);
        differences(&here[first..], &words[at + first - step.min(at + first)..], &mut changed[first..]);
        let last = len.min((width - start).saturating_sub(step));
        differences(&here[..last], &words[(at + step).min(words.len())..], &mut changed[..last]);
    }
}

#[inline(always)]
fn differences(here: &[u16], there: &[u16], changed: &mut [u16]) {
    for ((changed, here), there) in changed.iter_mut().zip(here).zip(there) {
        *changed |= here ^ there;
    }
}

/// Numbers of pixels looked at and of outliers among them: where the bit changes nearby, and in all.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Counts {
    pub edge: [u64; 2],
    pub all: [u64; 2],
}

/// Bin of the residual of each pixel, [`Tally::NOWHERE`] where it is not looked at.
#[inline(always)]
fn bins_of<T: Sample>(
    p: &[T],
    q: &[T],
    full: i32,
    (sum, per_sigma, dither): (&[f32], &[f32], &[f32]),
    (changed, place): (&[u16], u8),
    bins: &mut [u16],
) -> Counts {
    let len = p.len();
    let (q, sum, per_sigma, dither) = (&q[..len], &sum[..len], &per_sigma[..len], &dither[..len]);
    let (changed, bins) = (&changed[..len], &mut bins[..len]);
    let (mut all, mut beyond, mut edge, mut edge_beyond) = (0u32, 0u32, 0u32, 0u32);
    for x in 0..len {
        let (p, q) = (p[x].dn(), q[x].dn());
        let looked = (per_sigma[x] != 0.0) & (p < full) & (q < full);
        let residual = ((p + q) as f32 - sum[x] + dither[x]) * per_sigma[x];
        let bin = whole_part(Tally::place(residual)) as u16;
        bins[x] = if looked { bin } else { Tally::NOWHERE };
        let far = u32::from(looked & (residual.abs() > OUTLIER_SIGMA));
        let near_edge = u32::from(changed[x] >> place) & 1;
        all += u32::from(looked);
        beyond += far;
        edge += u32::from(looked) & near_edge;
        edge_beyond += far & near_edge;
    }
    Counts { edge: [edge.into(), edge_beyond.into()], all: [all.into(), beyond.into()] }
}
