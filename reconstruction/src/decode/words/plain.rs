//! The pixel loops as the text has them, one pixel after the other: what the blocks are held against, to the bit.

use polscan_patterns::Mode;

use super::{
    PixelMaps, WEAK_SCALE, WEAK_UNKNOWN, is_coarse,
    resolve::{AMBIGUOUS, CLEAR, EDGE, OUTSIDE, boundary_distance},
};
use crate::decode::{
    limits::Gates,
    plan::{AxisFrames, BitFrames, Frames, Levels, binary_of_gray},
    sample::Sample,
    types::Class,
};

/// As [`super::decode_pixels`].
pub(crate) fn decode_pixels<T: Sample>(frames: &Frames<'_, T>, gates: &Gates, maps: &mut PixelMaps) {
    for at in 0..frames.width * frames.height {
        decode_pixel(frames, gates, at, maps);
    }
}

/// What is known of a pixel before its bits are read.
struct Known {
    sum: f32,
    variance: f32,
    sigma: f32,
    modulation: f32,
}

fn decode_pixel<T: Sample>(frames: &Frames<'_, T>, gates: &Gates, at: usize, maps: &mut PixelMaps) {
    let full = gates.saturation_dn;
    let known = levels(frames, gates, at, maps);
    let (mut one, mut both) = (false, false);
    let (mut squares, mut pairs) = (0.0f32, 0u16);
    for (_, _, p, q) in frames.pairs() {
        let (p, q) = (p[at].dn(), q[at].dn());
        one |= p >= full || q >= full;
        both |= p >= full && q >= full;
        if p < full && q < full {
            let residual = (p + q) as f32 - known.sum;
            squares += residual * residual;
            pairs += 1;
        }
    }
    let (mut weak, mut status) = (None::<i32>, CLEAR);
    for (index, axis) in frames.axes.iter().enumerate() {
        let (read, soft, single_saturated) = read_word(frames, axis, gates, &known, at);
        one |= single_saturated;
        let word = if known.modulation < 0.0 { !read } else { read } & ((1u32 << axis.code.bits) - 1) as u16;
        let inside = |word: u16| {
            let value = i32::from(binary_of_gray(word));
            axis.code.span(value).map(|_| value)
        };
        let (value, says) = match soft.count_ones() {
            0 => inside(word).map_or((-1, OUTSIDE), |value| (value, CLEAR)),
            1 => match inside(word).or(inside(word ^ soft)) {
                None => (-1, OUTSIDE),
                Some(value) if binary_of_gray(word).abs_diff(binary_of_gray(word ^ soft)) == 1 => {
                    (value, EDGE)
                }
                Some(_) => (-1, AMBIGUOUS),
            },
            _ => (-1, AMBIGUOUS),
        };
        (maps.words[index][at], maps.values[index][at]) = (word, value);
        status = status.max(says);
        let least = weakest_coarse(axis, value, at).filter(|_| value >= 0);
        weak = weak.into_iter().chain(least).min();
    }
    let saturated = |planes: &[&[T]]| planes.iter().any(|plane| plane[at].dn() >= full);
    let (high_full, low_full) = (saturated(&frames.high), saturated(&frames.low));
    one |= high_full || low_full;
    both |= high_full && low_full;
    let inverted = known.modulation < 0.0;
    let gate = if inverted { 2.0 * gates.lit_sigma } else { gates.lit_sigma };
    let modulation = known.modulation.abs();
    let class = match status {
        _ if both => Class::Saturated,
        _ if modulation < gate * known.variance.sqrt() => Class::Unlit,
        AMBIGUOUS => Class::Ambiguous,
        OUTSIDE => Class::OutOfProjector,
        _ if inverted => Class::Inverted,
        EDGE => Class::Edge,
        _ => Class::Valid,
    };
    maps.class[at] = class;
    maps.half_saturated[at] = one;
    if !class.is_valid() {
        maps.values.iter_mut().filter_map(|values| values.get_mut(at)).for_each(|value| *value = -1);
    }
    maps.weakest[at] = match weak {
        Some(weak) if class.is_valid() && !one && modulation >= 9.0 * known.sigma => {
            (weak as f32 / modulation * WEAK_SCALE).min(254.0) as u8
        }
        _ => WEAK_UNKNOWN,
    };
    let variance = match frames.levels {
        Levels::References => known.sigma * known.sigma + known.variance,
        _ => known.sigma * known.sigma * (1.0 - 1.0 / frames.pair_count() as f32),
    };
    let judged = pairs > 0 && !high_full && !low_full;
    maps.residual[at] = if judged { (squares / (f32::from(pairs) * variance)).sqrt() } else { f32::NAN };
}

fn levels<T: Sample>(frames: &Frames<'_, T>, gates: &Gates, at: usize, maps: &mut PixelMaps) -> Known {
    let mean = |planes: &[&[T]]| {
        planes.iter().map(|plane| i64::from(plane[at].dn())).sum::<i64>() as f32 / planes.len().max(1) as f32
    };
    let count = frames.pair_count() as f32;
    let mean_sum = frames.pairs().map(|(_, _, p, q)| p[at].dn() + q[at].dn()).sum::<i32>() as f32 / count;
    let mean_difference =
        frames.pairs().map(|(_, _, p, q)| (p[at].dn() - q[at].dn()).abs()).sum::<i32>() as f32 / count;
    let (white, black) = (mean(&frames.high), mean(&frames.low));
    let (high, low) = match frames.levels {
        Levels::References => (white, black),
        Levels::HighOnly => (white, mean_sum - white),
        Levels::LowOnly => (mean_sum - black, black),
        Levels::Pairs => ((mean_sum + mean_difference) / 2.0, (mean_sum - mean_difference) / 2.0),
    };
    let both = gates.variance(high) + gates.variance(low);
    let (highs, lows) = (frames.high.len() as f32, frames.low.len() as f32);
    let variance = match frames.levels {
        Levels::References => gates.variance(high) / highs + gates.variance(low) / lows,
        Levels::HighOnly => 4.0 * gates.variance(high) / highs + both / count,
        Levels::LowOnly => 4.0 * gates.variance(low) / lows + both / count,
        Levels::Pairs => both / 2.0,
    };
    let modulation = if frames.levels == Levels::Pairs { mean_difference } else { high - low };
    let dark = if gates.mode == Mode::Paper { black } else { low };
    maps.modulation[at] = modulation;
    maps.sigma[at] = both.sqrt();
    maps.dolp[at] = gates.dolp(high + low - dark, dark).clamp(0.0, 1.0);
    maps.intensity[at] = (high.max(low) * (255.0 / gates.full_scale_dn) + 0.5).clamp(0.0, 255.0) as u8;
    Known { sum: high + low, variance, sigma: both.sqrt(), modulation }
}

/// Word, soft bits, and whether a frame without a partner is saturated.
fn read_word<T: Sample>(
    frames: &Frames<'_, T>,
    axis: &AxisFrames<'_, T>,
    gates: &Gates,
    known: &Known,
    at: usize,
) -> (u16, u16, bool) {
    let soft_at = (gates.soft_sigma * known.sigma).ceil() as i32 - 1;
    let (mut word, mut soft, mut saturated) = (0, 0, false);
    for bit in &axis.bits {
        let (set, is_soft) = match *bit {
            BitFrames::Pair(p, q) => {
                let (p, q) = (p[at].dn(), q[at].dn());
                let near = (p - q).abs() <= soft_at;
                if gates.mode == Mode::Paper {
                    let sum: i64 = frames.low.iter().map(|plane| i64::from(plane[at].dn())).sum();
                    let dark = sum as f32 / frames.low.len() as f32;
                    let difference = gates.dolp(p as f32, dark) - gates.dolp(q as f32, dark);
                    (difference > 0.0, near || difference == 0.0)
                } else {
                    (p > q, near)
                }
            }
            BitFrames::Single(plane, inverse) => {
                let dn = plane[at].dn();
                saturated |= dn >= gates.saturation_dn;
                let above = 2.0 * dn as f32 - known.sum;
                let variance = 4.0 * gates.variance(dn as f32) + known.variance;
                ((above > 0.0) != inverse, above * above < gates.soft_sigma * gates.soft_sigma * variance)
            }
        };
        word = (word << 1) | u16::from(set);
        soft = (soft << 1) | u16::from(is_soft);
    }
    (word, soft, saturated)
}

/// Smallest |P - Q| of the coarse pairs, but for the very smallest where it is near its own edge.
fn weakest_coarse<T: Sample>(axis: &AxisFrames<'_, T>, value: i32, at: usize) -> Option<i32> {
    let mut coarse = Vec::new();
    for (bit, frames) in axis.bits.iter().enumerate() {
        if let BitFrames::Pair(p, q) = frames
            && is_coarse(axis.code, bit as u8)
        {
            coarse.push(((p[at].dn() - q[at].dn()).abs(), bit as u8));
        }
    }
    coarse.sort_unstable();
    let (least, bit) = *coarse.first()?;
    let near = boundary_distance(i32::from(axis.code.bits - 1 - bit), value) <= 7;
    if near { coarse.get(1).map(|second| second.0) } else { Some(least) }
}
