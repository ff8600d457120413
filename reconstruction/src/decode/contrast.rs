//! Contrast of the paper's Eq. 8, of raw frames and of their degree of linear polarization.
//!
//! `C` is the mean over all pairs of a pixel and one of its four neighbours of the squared grey difference, edges
//! replicated (a missing neighbour differs by 0 and counts). Both pictures are on the same scale, 0..=255 of full
//! scale, DOLP clipped to [0, 1].

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{sample::Sample, types::Plane};
use crate::grid::Grid;

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

/// Sums of squared differences of one row and the next.
#[derive(Default, Clone, Copy)]
struct Sums {
    raw: f64,
    dolp: f64,
    raw_lit: f64,
    dolp_lit: f64,
    lit_pairs: u64,
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
    let (width, height) = (lit.width(), lit.height());
    let scale = 255.0 / ((1u32 << bit_depth) - 1) as f32;
    let black = black_level_dn as f32;
    // Grey levels of one row of one frame: raw, DOLP.
    let grey_row = |frame: &[T], dark_dn: &[f32], y: usize, raw: &mut [f32], dolp: &mut [f32]| {
        let frame = &frame[y * width..][..width];
        let (dark_dn, raw, dolp) = (&dark_dn[..width], &mut raw[..width], &mut dolp[..width]);
        for x in 0..width {
            let (dn, dark_dn) = (frame[x].dn() as f32, dark_dn[x]);
            let sum = dn + dark_dn - 2.0 * black;
            let degree = if sum > 0.0 { (dn - dark_dn) / sum } else { 0.0 };
            raw[x] = dn * scale;
            dolp[x] = degree.clamp(0.0, 1.0) * 255.0;
        }
    };
    // The mean dark level of a row, the same for all frames.
    let dark_row = |y: usize, mean: &mut [f32]| {
        for (x, mean) in mean.iter_mut().enumerate() {
            let at = y * width + x;
            *mean = dark.iter().map(|plane| plane[at].dn()).sum::<i32>() as f32 / dark.len() as f32;
        }
    };
    let rows: Vec<Sums> = (0..height)
        .into_par_iter()
        .map_init(
            || [0; 6].map(|_| vec![0.0f32; width]),
            |[raw, dolp, raw_below, dolp_below, dark, dark_below], y| {
                let mut sums = Sums::default();
                let has_below = y + 1 < height;
                dark_row(y, dark);
                if has_below {
                    dark_row(y + 1, dark_below);
                }
                for frame in &code {
                    grey_row(frame, dark, y, raw, dolp);
                    if has_below {
                        grey_row(frame, dark_below, y + 1, raw_below, dolp_below);
                    }
                    let mut add = |one: (f32, f32), other: (f32, f32), both_lit: bool| {
                        let raw = f64::from((one.0 - other.0) * (one.0 - other.0));
                        let dolp = f64::from((one.1 - other.1) * (one.1 - other.1));
                        sums.raw += raw;
                        sums.dolp += dolp;
                        if both_lit {
                            sums.raw_lit += raw;
                            sums.dolp_lit += dolp;
                            sums.lit_pairs += 1;
                        }
                    };
                    for x in 0..width {
                        let here = (raw[x], dolp[x]);
                        if x + 1 < width {
                            add(here, (raw[x + 1], dolp[x + 1]), lit.at(x, y) && lit.at(x + 1, y));
                        }
                        if has_below {
                            add(here, (raw_below[x], dolp_below[x]), lit.at(x, y) && lit.at(x, y + 1));
                        }
                    }
                }
                sums
            },
        )
        .collect();
    let total = rows.iter().fold(Sums::default(), |a, b| Sums {
        raw: a.raw + b.raw,
        dolp: a.dolp + b.dolp,
        raw_lit: a.raw_lit + b.raw_lit,
        dolp_lit: a.dolp_lit + b.dolp_lit,
        lit_pairs: a.lit_pairs + b.lit_pairs,
    });
    // Each unordered pair is two ordered ones of the four that every pixel has.
    let pairs = 2.0 * (lit.len() * code.len()) as f64;
    let lit_pairs = total.lit_pairs as f64;
    Some(Contrast {
        raw: total.raw / pairs,
        dolp: total.dolp / pairs,
        ratio: total.dolp / total.raw,
        raw_lit: total.raw_lit / lit_pairs,
        dolp_lit: total.dolp_lit / lit_pairs,
        ratio_lit: total.dolp_lit / total.raw_lit,
    })
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
    fn agrees_to_the_bit_with_a_direct_sum_on_one_thread_and_on_two() {
        let (width, height) = (13, 9);
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
        let code: Vec<_> = code.iter().map(|plane| Plane::U16(plane)).collect();
        let dark: Vec<_> = dark.iter().map(|plane| Plane::U16(plane)).collect();
        for threads in [1, 2] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let found = pool.install(|| contrast(&code, &dark, 12, 41.5, &lit)).unwrap();
            let found = [found.raw, found.dolp, found.raw_lit, found.dolp_lit];
            assert_eq!(
                found.map(f64::to_bits),
                expected.map(f64::to_bits),
                "{threads} threads: {found:?} {expected:?}"
            );
        }
    }
}
