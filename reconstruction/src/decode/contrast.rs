//! Contrast of the paper's Eq. 8, of raw frames and of their degree of linear polarization.
//!
//! `C` is the mean over all pairs of a pixel and one of its four neighbours of the squared grey difference, edges
//! replicated (a missing neighbour differs by 0 and counts). Both pictures are on the same scale, 0..=255 of full
//! scale, DOLP clipped to [0, 1].

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{sample::Sample, types::Plane};
use crate::{
    grid::Grid,
    simd::{InstructionSet, Work},
};

/// Contrast as mean squared grey difference, grey levels 0..=255, mean over the code frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Contrast {
    /// Raw frames, whole image.
    pub raw: f64,
    /// DOLP, whole image. Unlit pixels make noise that a squared difference loves.
    pub dolp: f64,
    /// `dolp / raw`; NaN where there is no raw contrast.
    pub ratio: f64,
    /// Raw frames, between lit pixels.
    pub raw_lit: f64,
    /// DOLP, between lit pixels.
    pub dolp_lit: f64,
    /// `dolp_lit / raw_lit`.
    pub ratio_lit: f64,
}

/// Contrast of `code` (the non-inverse code frames) against `dark`, the frames under uniform V (mode gray: black),
/// which are averaged. All planes have the size of `lit`; over lit pixels a pair counts where both pixels are lit.
/// `None` without a code frame, without a dark frame, or where planes differ in type or size.
pub fn contrast(
    code: &[Plane<'_>],
    dark: &[Plane<'_>],
    bit_depth: u8,
    black_level_dn: f64,
    lit: &Grid<bool>,
) -> Option<Contrast> {
    match code.first()? {
        Plane::U8(_) => typed::<u8>(code, dark, bit_depth, black_level_dn, lit),
        Plane::U16(_) => typed::<u16>(code, dark, bit_depth, black_level_dn, lit),
    }
}

/// Pairs that are summed side by side, each kind of sum in as many parts.
const LANES: usize = 16;
type Parts = [f64; LANES];

/// Sums of squared grey differences of one row and the next.
#[derive(Clone, Copy)]
struct Sums {
    raw: Parts,
    dolp: Parts,
    raw_lit: Parts,
    dolp_lit: Parts,
}

impl Sums {
    const NONE: Self =
        Self { raw: [0.0; LANES], dolp: [0.0; LANES], raw_lit: [0.0; LANES], dolp_lit: [0.0; LANES] };

    /// Adds the pairs of equal index; `both_lit` is 1 for pairs of lit pixels and else 0.
    #[inline(always)]
    fn add(&mut self, one: &Greys, other: [&[f32]; 2], both_lit: &[f32]) {
        let count = both_lit.len();
        let [raw, dolp] = [&one.raw[..count], &one.dolp[..count]];
        let [other_raw, other_dolp] = [&other[0][..count], &other[1][..count]];
        let mut sums = *self;
        for from in (0..count).step_by(LANES) {
            let read = |values: &[f32]| {
                let mut lanes = [0.0f32; LANES];
                match values[from..].first_chunk::<LANES>() {
                    Some(whole) => lanes = *whole,
                    None => lanes.iter_mut().zip(&values[from..]).for_each(|(lane, value)| *lane = *value),
                }
                lanes
            };
            let (raw, dolp, lit) = (read(raw), read(dolp), read(both_lit));
            let (other_raw, other_dolp) = (read(other_raw), read(other_dolp));
            for l in 0..LANES {
                let (of_raw, of_dolp) = (raw[l] - other_raw[l], dolp[l] - other_dolp[l]);
                let (of_raw, of_dolp) = (of_raw * of_raw, of_dolp * of_dolp);
                sums.raw[l] += f64::from(of_raw);
                sums.dolp[l] += f64::from(of_dolp);
                sums.raw_lit[l] += f64::from(of_raw * lit[l]);
                sums.dolp_lit[l] += f64::from(of_dolp * lit[l]);
            }
        }
        *self = sums;
    }
}

/// Grey levels of a row: raw, and DOLP.
struct Greys {
    raw: Vec<f32>,
    dolp: Vec<f32>,
}

/// What turns samples into grey levels.
#[derive(Clone, Copy)]
struct Scale {
    per_dn: f32,
    black_dn: f32,
}

impl Greys {
    #[inline(always)]
    fn fill<T: Sample>(&mut self, frame: &[T], dark_dn: &[f32], scale: Scale) {
        let width = frame.len();
        let (dark_dn, raw, dolp) = (&dark_dn[..width], &mut self.raw[..width], &mut self.dolp[..width]);
        for x in 0..width {
            let (dn, dark_dn) = (frame[x].dn() as f32, dark_dn[x]);
            let sum = dn + dark_dn - 2.0 * scale.black_dn;
            let degree = if sum > 0.0 { (dn - dark_dn) / sum } else { 0.0 };
            raw[x] = dn * scale.per_dn;
            dolp[x] = degree.clamp(0.0, 1.0) * 255.0;
        }
    }
}

/// Rows at hand on one thread.
struct Scratch {
    here: Greys,
    below: Greys,
    dark: [Vec<f32>; 2],
    /// 1 where a pixel and its neighbour, to the right and below, are lit.
    lit: [Vec<f32>; 2],
}

impl Scratch {
    fn new(width: usize) -> Self {
        let row = || vec![0.0; width];
        let greys = || Greys { raw: row(), dolp: row() };
        Self { here: greys(), below: greys(), dark: [row(), row()], lit: [row(), row()] }
    }
}

/// The pairs of row `y` with their neighbours to the right and below, over all code frames.
struct Row<'a, T> {
    code: &'a [&'a [T]],
    dark: &'a [&'a [T]],
    lit: &'a Grid<bool>,
    scale: Scale,
    y: usize,
    scratch: &'a mut Scratch,
}

impl<T: Sample> Work for Row<'_, T> {
    type Output = Sums;

    #[inline(always)]
    fn run(self) -> Sums {
        let Self { code, dark, lit, scale, y, scratch } = self;
        let (width, has_below) = (lit.width(), y + 1 < lit.height());
        let of_row = |y: usize| y * width..(y + 1) * width;
        // The mean dark level of a row is the same for all frames.
        for (y, mean) in (y..).zip(&mut scratch.dark).take(1 + usize::from(has_below)) {
            mean.fill(0.0);
            for plane in dark {
                mean.iter_mut().zip(&plane[of_row(y)]).for_each(|(sum, sample)| *sum += sample.dn() as f32);
            }
            mean.iter_mut().for_each(|sum| *sum /= dark.len() as f32);
        }
        let both = |one: bool, other: bool| if one && other { 1.0 } else { 0.0 };
        let [right, down] = &mut scratch.lit;
        let lit_here = lit.row(y);
        right.iter_mut().zip(lit_here.windows(2)).for_each(|(out, pair)| *out = both(pair[0], pair[1]));
        if has_below {
            let pairs = lit_here.iter().zip(lit.row(y + 1));
            down.iter_mut().zip(pairs).for_each(|(out, (one, other))| *out = both(*one, *other));
        }
        let mut sums = Sums::NONE;
        for frame in code {
            scratch.here.fill(&frame[of_row(y)], &scratch.dark[0], scale);
            let here = &scratch.here;
            sums.add(here, [&here.raw[1..], &here.dolp[1..]], &scratch.lit[0][..width - 1]);
            if has_below {
                scratch.below.fill(&frame[of_row(y + 1)], &scratch.dark[1], scale);
                sums.add(here, [&scratch.below.raw, &scratch.below.dolp], &scratch.lit[1]);
            }
        }
        sums
    }
}

/// Pairs of neighbouring pixels that are both lit.
fn lit_pairs(lit: &Grid<bool>) -> u64 {
    let count =
        |pairs: &mut dyn Iterator<Item = (&bool, &bool)>| pairs.filter(|(a, b)| **a && **b).count() as u64;
    let rows = 0..lit.height();
    rows.map(|y| {
        let here = lit.row(y);
        let right = count(&mut here.iter().zip(&here[1..]));
        let below = if y + 1 < lit.height() { count(&mut here.iter().zip(lit.row(y + 1))) } else { 0 };
        right + below
    })
    .sum()
}

fn typed<T: Sample>(
    code: &[Plane<'_>],
    dark: &[Plane<'_>],
    bit_depth: u8,
    black_level_dn: f64,
    lit: &Grid<bool>,
) -> Option<Contrast> {
    let slices = |planes: &[Plane<'_>]| planes.iter().all(|plane| plane.len() == lit.len());
    if dark.is_empty() || lit.is_empty() || !slices(code) || !slices(dark) {
        return None;
    }
    let code: Vec<&[T]> = code.iter().map(|&plane| T::of(plane)).collect::<Option<_>>()?;
    let dark: Vec<&[T]> = dark.iter().map(|&plane| T::of(plane)).collect::<Option<_>>()?;
    let scale = Scale { per_dn: 255.0 / ((1u32 << bit_depth) - 1) as f32, black_dn: black_level_dn as f32 };
    let sums = sums_of(InstructionSet::widest(), &code, &dark, lit, scale);
    let [raw, dolp, raw_lit, dolp_lit] = sums;
    // Each unordered pair is two ordered ones of the four that every pixel has.
    let pairs = 2.0 * (lit.len() * code.len()) as f64;
    let lit_pairs = (lit_pairs(lit) * code.len() as u64) as f64;
    Some(Contrast {
        raw: raw / pairs,
        dolp: dolp / pairs,
        ratio: dolp / raw,
        raw_lit: raw_lit / lit_pairs,
        dolp_lit: dolp_lit / lit_pairs,
        ratio_lit: dolp_lit / raw_lit,
    })
}

/// Sums over all pairs: raw, DOLP, and both between lit pixels. Parts and rows are added in their order, on any number
/// of threads.
fn sums_of<T: Sample>(
    set: InstructionSet,
    code: &[&[T]],
    dark: &[&[T]],
    lit: &Grid<bool>,
    scale: Scale,
) -> [f64; 4] {
    let rows: Vec<[f64; 4]> = (0..lit.height())
        .into_par_iter()
        .map_init(
            || Scratch::new(lit.width()),
            |scratch, y| {
                let sums = set.run(Row { code, dark, lit, scale, y, scratch });
                [sums.raw, sums.dolp, sums.raw_lit, sums.dolp_lit].map(|parts| parts.iter().sum())
            },
        )
        .collect();
    rows.iter().fold([0.0; 4], |sums, row| std::array::from_fn(|kind| sums[kind] + row[kind]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::synth::random;

    /// Grey level and DOLP of one pixel of one frame, straight from the samples.
    fn grey(frame: &[u16], dark: &[Vec<u16>], at: usize) -> (f32, f32) {
        let (dn, black) = (f32::from(frame[at]), 41.5f32);
        let dark = dark.iter().map(|plane| i32::from(plane[at])).sum::<i32>() as f32 / dark.len() as f32;
        let sum = dn + dark - 2.0 * black;
        let degree = if sum > 0.0 { (dn - dark) / sum } else { 0.0 };
        (dn * (255.0 / 4095.0f32), degree.clamp(0.0, 1.0) * 255.0)
    }

    #[test]
    fn agrees_with_a_direct_sum_and_to_the_bit_between_threads_and_instruction_sets() {
        let (width, height) = (53, 9);
        let frame = |seed: u64| -> Vec<u16> {
            (0..width * height).map(|at| (random(seed << 32 | at as u64) & 0xfff) as u16).collect()
        };
        let (code, dark): (Vec<_>, Vec<_>) = ((1..5).map(frame).collect(), (10..13).map(frame).collect());
        let lit = Grid::from_vec(
            width,
            height,
            (0..width * height).map(|at| !random(99 + at as u64).is_multiple_of(3)).collect(),
        );
        // Sums of [raw, DOLP, raw between lit pixels, DOLP between lit pixels] by row, then over rows.
        let (mut total, mut lit_pairs) = ([0.0f64; 4], 0u32);
        for y in 0..height {
            let mut row = [0.0f64; 4];
            for frame in &code {
                for x in 0..width {
                    let at = y * width + x;
                    let here = grey(frame, &dark, at);
                    let right = (x + 1 < width).then_some(at + 1);
                    let below = (y + 1 < height).then_some(at + width);
                    for other in right.into_iter().chain(below) {
                        let there = grey(frame, &dark, other);
                        let both = lit.data()[at] && lit.data()[other];
                        let squares = [(here.0 - there.0).powi(2), (here.1 - there.1).powi(2)].map(f64::from);
                        for (index, square) in squares.into_iter().enumerate() {
                            row[index] += square;
                            row[index + 2] += if both { square } else { 0.0 };
                        }
                        lit_pairs += u32::from(both);
                    }
                }
            }
            for (total, row) in total.iter_mut().zip(row) {
                *total += row;
            }
        }
        let pairs = 2.0 * (lit.len() * code.len()) as f64;
        let of_lit = f64::from(lit_pairs);
        let expected = [total[0] / pairs, total[1] / pairs, total[2] / of_lit, total[3] / of_lit];
        let planes: Vec<Plane<'_>> = code.iter().map(|plane| Plane::U16(plane)).collect();
        let darks: Vec<Plane<'_>> = dark.iter().map(|plane| Plane::U16(plane)).collect();
        let found = [1, 2].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let found = pool.install(|| contrast(&planes, &darks, 12, 41.5, &lit)).unwrap();
            [found.raw, found.dolp, found.raw_lit, found.dolp_lit]
        });
        assert_eq!(found[0].map(f64::to_bits), found[1].map(f64::to_bits));
        for (found, expected) in found[0].iter().zip(expected) {
            assert!((found - expected).abs() <= 1e-12 * expected, "{found} {expected}");
        }
        let code: Vec<&[u16]> = code.iter().map(Vec::as_slice).collect();
        let dark: Vec<&[u16]> = dark.iter().map(Vec::as_slice).collect();
        let scale = Scale { per_dn: 255.0 / 4095.0, black_dn: 41.5 };
        let sums = |set| sums_of(set, &code, &dark, &lit, scale).map(f64::to_bits);
        for set in InstructionSet::available() {
            assert_eq!(sums(set), sums(InstructionSet::Portable), "{set:?}");
        }
    }
}
