//! From samples to words and classes, one block of a row at a time over all planes, so that each byte is fetched once
//! and what lives only within a block stays in the nearest cache.
//!
//! Gates are in units of noise. With references of `n` frames each, `sigma(C)^2 = var(R_H)/n_H + var(R_V)/n_V`. A pair
//! sums to the references' sum, so `sigma(P - Q)` is the same for all pairs of a pixel:
//! `2 read^2 + 1/6 + K * (level of R_H + level of R_V)`. One comparison with an integer per pair is left.
//!
//! Where references are missing the mean pair sum stands in for `R_H + R_V`. Without any, the modulation is the mean
//! of |P - Q| over all pairs: on a lit pixel all but the pairs at an edge differ by |C|. On an unlit one that mean is
//! 0.80 sigma(P - Q) and, with at least eight pairs, hardly ever over 1.5, so that the gate of
//! `lit_sigma * sigma(P - Q) / sqrt(2)` (2.8 sigma; the same gate that references of two frames give) passes none.

mod classes;
mod kernels;
pub(crate) mod levels;
#[cfg(test)]
pub(crate) mod plain;
mod resolve;

use std::ops::Range;

use polscan_patterns::Mode;
use rayon::prelude::*;

use self::{
    kernels::{Bits, Peaks, Weakest},
    levels::BlockLevels,
};
use super::{
    limits::Gates,
    plan::{AxisFrames, BitFrames, Frames, PrefixCode},
    sample::Sample,
    types::Class,
};
use crate::simd::{InstructionSet, Work};

/// Bits whose boundaries lie at least this far apart (in values) are coarse: the pattern is flat between them.
const COARSE_SPACING: u32 = 16;
/// Scale of the stored weakness; `WEAK_UNKNOWN` where it is not judged.
pub(crate) const WEAK_SCALE: f32 = 128.0;
pub(crate) const WEAK_UNKNOWN: u8 = u8::MAX;
/// Pixels of a block: what is kept of each during a decode (about 50 bytes) and their samples of one pair fit into the
/// nearest cache together.
pub(crate) const BLOCK: usize = 512;

/// One image of every per-pixel result.
#[derive(Debug, Clone)]
pub(crate) struct PixelMaps {
    pub class: Vec<Class>,
    /// Words as read (bits without meaning where the class is unlit), per axis of the plan.
    pub words: [Vec<u16>; 2],
    /// Binary value of the known bits, -1 where there is none.
    pub values: [Vec<i32>; 2],
    pub half_saturated: Vec<bool>,
    pub modulation: Vec<f32>,
    /// Standard deviation of P - Q.
    pub sigma: Vec<f32>,
    pub residual: Vec<f32>,
    pub dolp: Vec<f32>,
    pub intensity: Vec<u8>,
    /// Smallest |P - Q| / |C| of the coarse bits away from their own edges, times `WEAK_SCALE`.
    pub weakest: Vec<u8>,
}

/// The same for one row, or for a part of one.
struct RowMaps<'a> {
    class: &'a mut [Class],
    words: [&'a mut [u16]; 2],
    values: [&'a mut [i32]; 2],
    half_saturated: &'a mut [bool],
    modulation: &'a mut [f32],
    sigma: &'a mut [f32],
    residual: &'a mut [f32],
    dolp: &'a mut [f32],
    intensity: &'a mut [u8],
    weakest: &'a mut [u8],
}

impl RowMaps<'_> {
    #[inline(always)]
    fn part(&mut self, at: Range<usize>) -> RowMaps<'_> {
        let [words_0, words_1] = &mut self.words;
        let [values_0, values_1] = &mut self.values;
        // The second axis may be missing; its maps are then empty.
        let second = if words_1.is_empty() { 0..0 } else { at.clone() };
        RowMaps {
            class: &mut self.class[at.clone()],
            words: [&mut words_0[at.clone()], &mut words_1[second.clone()]],
            values: [&mut values_0[at.clone()], &mut values_1[second]],
            half_saturated: &mut self.half_saturated[at.clone()],
            modulation: &mut self.modulation[at.clone()],
            sigma: &mut self.sigma[at.clone()],
            residual: &mut self.residual[at.clone()],
            dolp: &mut self.dolp[at.clone()],
            intensity: &mut self.intensity[at.clone()],
            weakest: &mut self.weakest[at],
        }
    }
}

impl PixelMaps {
    /// Maps of `len` pixels and `axes` axes, in memory that has been written to: the system hands out a page when it is
    /// first touched, which takes longer than the decode itself and is better done before the last frame is there.
    pub fn new(len: usize, axes: usize) -> Self {
        let axis_len = |index: usize| if axes > index { len } else { 0 };
        Self {
            class: vec![Class::Unlit; len],
            words: [0, 1].map(|axis| vec![u16::MAX; axis_len(axis)]),
            values: [0, 1].map(|axis| vec![-1; axis_len(axis)]),
            half_saturated: vec![true; len],
            modulation: vec![f32::NAN; len],
            sigma: vec![f32::NAN; len],
            residual: vec![f32::NAN; len],
            dolp: vec![f32::NAN; len],
            intensity: vec![u8::MAX; len],
            weakest: vec![WEAK_UNKNOWN; len],
        }
    }
}

/// Decodes all pixels, each on its own, into maps of the frames' size and axes. Every element is written.
pub(crate) fn decode_pixels<T: Sample>(
    frames: &Frames<'_, T>,
    gates: &Gates,
    set: InstructionSet,
    maps: &mut PixelMaps,
) {
    split_rows(maps, frames.width).into_par_iter().enumerate().for_each_init(
        Scratch::new,
        |scratch, (y, row)| {
            set.run(DecodeRow { scratch, frames, gates, y, row });
        },
    );
}

fn split_rows(maps: &mut PixelMaps, width: usize) -> Vec<RowMaps<'_>> {
    let [words_0, words_1] = &mut maps.words;
    let [values_0, values_1] = &mut maps.values;
    let (mut words_0, mut words_1) = (words_0.chunks_mut(width), words_1.chunks_mut(width));
    let (mut values_0, mut values_1) = (values_0.chunks_mut(width), values_1.chunks_mut(width));
    let mut half_saturated = maps.half_saturated.chunks_mut(width);
    let mut modulation = maps.modulation.chunks_mut(width);
    let mut sigma = maps.sigma.chunks_mut(width);
    let mut residual = maps.residual.chunks_mut(width);
    let mut dolp = maps.dolp.chunks_mut(width);
    let mut intensity = maps.intensity.chunks_mut(width);
    let mut weakest = maps.weakest.chunks_mut(width);
    maps.class
        .chunks_mut(width)
        .map(|class| RowMaps {
            class,
            words: [words_0.next().unwrap_or_default(), words_1.next().unwrap_or_default()],
            values: [values_0.next().unwrap_or_default(), values_1.next().unwrap_or_default()],
            half_saturated: half_saturated.next().unwrap_or_default(),
            modulation: modulation.next().unwrap_or_default(),
            sigma: sigma.next().unwrap_or_default(),
            residual: residual.next().unwrap_or_default(),
            dolp: dolp.next().unwrap_or_default(),
            intensity: intensity.next().unwrap_or_default(),
            weakest: weakest.next().unwrap_or_default(),
        })
        .collect()
}

/// Working memory of one thread: one block of everything that lives only within a block.
struct Scratch<T> {
    /// R_H + R_V or what stands in for it, in DN.
    level_sum: [f32; BLOCK],
    levels: BlockLevels,
    /// A bit is soft where |P - Q| is at most this.
    soft_at: [T; BLOCK],
    /// All ones where the polarity is exchanged.
    inverted: [u16; BLOCK],
    /// Bit 0: some reference saturated; bit 1: one of either kind.
    reference_saturated: [u8; BLOCK],
    bits: Bits<T>,
    peaks: Peaks<T>,
    weakest: Weakest<T>,
    /// Smallest difference of a coarse bit away from its edges, over the axes so far; `i32::MAX` where none is known.
    weak: [i32; BLOCK],
    soft: [u16; BLOCK],
    status: [u16; BLOCK],
    squares: [f32; BLOCK],
    pairs: [u16; BLOCK],
    /// Variance of a pair sum's residual.
    pair_variance: [f32; BLOCK],
    lit: [bool; BLOCK],
}

impl<T: Sample> Scratch<T> {
    fn new() -> Self {
        Self {
            level_sum: [0.0; BLOCK],
            levels: BlockLevels::new(),
            soft_at: [T::default(); BLOCK],
            inverted: [0; BLOCK],
            reference_saturated: [0; BLOCK],
            bits: Bits::new(),
            peaks: Peaks::new(),
            weakest: Weakest::new(),
            weak: [0; BLOCK],
            soft: [0; BLOCK],
            status: [0; BLOCK],
            squares: [0.0; BLOCK],
            pairs: [0; BLOCK],
            pair_variance: [0.0; BLOCK],
            lit: [false; BLOCK],
        }
    }
}

/// One row of the image.
struct DecodeRow<'a, T> {
    scratch: &'a mut Scratch<T>,
    frames: &'a Frames<'a, T>,
    gates: &'a Gates,
    y: usize,
    row: RowMaps<'a>,
}

impl<T: Sample> Work for DecodeRow<'_, T> {
    type Output = ();

    #[inline(always)]
    fn run(mut self) {
        let width = self.frames.width;
        for start in (0..width).step_by(BLOCK) {
            let end = (start + BLOCK).min(width);
            let at = self.y * width + start..self.y * width + end;
            self.scratch.decode_block(self.frames, self.gates, at, self.row.part(start..end));
        }
    }
}

impl<T: Sample> Scratch<T> {
    /// Decodes the pixels `at`, all of one row, into their part of the maps.
    #[inline(always)]
    fn decode_block(
        &mut self,
        frames: &Frames<'_, T>,
        gates: &Gates,
        at: Range<usize>,
        mut row: RowMaps<'_>,
    ) {
        let len = at.len();
        self.peaks.clear(len);
        self.weak[..len].fill(i32::MAX);
        self.status[..len].fill(resolve::CLEAR);
        self.find_levels(frames, gates, &at, &mut row);
        for (index, axis) in frames.axes.iter().enumerate() {
            self.read_bits(frames, axis, gates, &at);
            self.resolve(axis, index, &mut row);
        }
        self.residuals(frames, gates, &at);
        self.classify(frames, gates, &mut row);
    }

    /// Words of one axis, its soft bits and its weakest coarse bits.
    #[inline(always)]
    fn read_bits(
        &mut self,
        frames: &Frames<'_, T>,
        axis: &AxisFrames<'_, T>,
        gates: &Gates,
        at: &Range<usize>,
    ) {
        let len = at.len();
        self.bits.clear(len);
        self.weakest.clear(len);
        for (bit, bit_frames) in axis.bits.iter().enumerate() {
            let place = axis.code.bits - 1 - bit as u8;
            match *bit_frames {
                BitFrames::Pair(p, q) => {
                    let (p, q) = (&p[at.clone()], &q[at.clone()]);
                    if gates.mode == Mode::Paper {
                        self.paper_bit(p, q, &frames.low, at, gates, place);
                        self.peaks.add(p, q);
                    } else {
                        kernels::pair_bit(p, q, &self.soft_at, self.bits.place(place), &mut self.peaks);
                    }
                    if is_coarse(axis.code, bit as u8) {
                        self.weakest.track(p, q, place);
                    }
                }
                BitFrames::Single(plane, inverse) => {
                    self.single_bit(&plane[at.clone()], inverse, gates, place);
                }
            }
        }
    }

    /// Squares of the pair sums' residuals, and of how many pairs: of those without a saturated frame.
    #[inline(always)]
    fn residuals(&mut self, frames: &Frames<'_, T>, gates: &Gates, at: &Range<usize>) {
        let len = at.len();
        self.squares[..len].fill(0.0);
        let saturated = self.peaks.any_above(gates.saturation_dn - 1, len);
        let (sums, squares) = (&self.level_sum[..len], &mut self.squares[..len]);
        if saturated {
            self.pairs[..len].fill(0);
            for (_, _, p, q) in frames.pairs() {
                let (p, q) = (&p[at.clone()], &q[at.clone()]);
                kernels::pair_sum_unsaturated(p, q, gates.saturation_dn, sums, squares, &mut self.pairs);
            }
        } else {
            let mut count = 0;
            for axis in &frames.axes {
                for two in axis.bits.chunks(2) {
                    count += kernels::pair_sums(two, at, sums, squares);
                }
            }
            self.pairs[..len].fill(count);
        }
    }

    /// Bit of a pair by its degrees of linear polarization (method, section 3). Where these are equal the bit is lost.
    #[inline(always)]
    fn paper_bit(&mut self, p: &[T], q: &[T], dark: &[&[T]], at: &Range<usize>, gates: &Gates, place: u8) {
        let (word, soft) = self.bits.place(place);
        for x in 0..p.len() {
            let dark_sum: i64 = dark.iter().map(|plane| i64::from(plane[at.start + x].dn())).sum();
            let dark_dn = dark_sum as f32 / dark.len() as f32;
            let difference = gates.dolp(p[x].dn() as f32, dark_dn) - gates.dolp(q[x].dn() as f32, dark_dn);
            let near = p[x].max(q[x]).above(p[x].min(q[x])) <= self.soft_at[x];
            word[x] = word[x].shifted_in(difference > 0.0);
            soft[x] = soft[x].shifted_in(near || difference == 0.0);
        }
    }

    /// Bit of a frame without its partner, against the middle of the references.
    #[inline(always)]
    fn single_bit(&mut self, plane: &[T], inverse: bool, gates: &Gates, place: u8) {
        let (word, soft) = self.bits.place(place);
        for (x, sample) in plane.iter().enumerate() {
            let dn = sample.dn() as f32;
            let above = 2.0 * dn - self.level_sum[x];
            let variance = 4.0 * gates.variance(dn) + self.levels.variance[x];
            word[x] = word[x].shifted_in((above > 0.0) != inverse);
            soft[x] = soft[x].shifted_in(above * above < gates.soft_sigma * gates.soft_sigma * variance);
        }
        // A frame without a partner saturates no pair as a whole.
        self.peaks.add_single(plane);
    }
}

/// Whether the known boundaries down to this bit lie far apart.
fn is_coarse(code: PrefixCode, bit: u8) -> bool {
    u32::from(bit) < u32::from(code.bits) && (1u32 << (code.bits - 1 - bit)) >= COARSE_SPACING
}
