//! The pair sums of a scan as the text has them, pixel by pixel: what the blocks are held against.

use super::{DITHER_VARIANCE, NEAR_EDGE, ROWS, Tally, dither, from_references, neighbours, sampled_rows};
use crate::decode::{
    limits::Gates,
    plan::{Frames, Levels, axis_position},
    sample::Sample,
    types::{Class, PairResidual},
    words::PixelMaps,
};

/// As [`super::of_scan`].
pub(crate) fn of_scan<T: Sample>(
    frames: &Frames<'_, T>,
    maps: &PixelMaps,
    gates: &Gates,
) -> Vec<PairResidual> {
    let (width, height) = (frames.width, frames.height);
    let pair_count = frames.pair_count() as f32;
    let expected = |at: usize| {
        if !maps.class[at].is_lit() || maps.class[at] == Class::Saturated {
            return None;
        }
        if frames.levels == Levels::References {
            let found = from_references(&frames.high, &frames.low, at, gates)?;
            return Some((found.sum, found.per_sigma));
        }
        let sum: i32 = frames.pairs().map(|(_, _, p, q)| p[at].dn() + q[at].dn()).sum();
        let variance = maps.sigma[at] * maps.sigma[at] * (1.0 - 1.0 / pair_count) + DITHER_VARIANCE;
        (pair_count > 1.0).then(|| (sum as f32 / pair_count, variance.sqrt().recip()))
    };
    let of_pair = |(axis, bit, p, q): (_, u8, &[T], &[T])| {
        let mut tally = Tally::new();
        let index = axis_position(frames, axis);
        let place = frames.axes[index].code.bits - 1 - bit;
        let words = &maps.words[index];
        for (y, x) in sampled_rows(height, ROWS).flat_map(|y| (0..width).map(move |x| (y, x))) {
            let at = y * width + x;
            let (p, q) = (p[at].dn(), q[at].dn());
            if p >= gates.saturation_dn || q >= gates.saturation_dn {
                continue;
            }
            let Some((sum, per_sigma)) = expected(at) else { continue };
            let flat = neighbours(NEAR_EDGE, [x, y], [width, height])
                .all(|other| ((words[other] ^ words[at]) >> place) & 1 == 0);
            tally.add(((p + q) as f32 - sum + dither(at)) * per_sigma, flat);
        }
        tally.finish(axis, bit)
    };
    frames.pairs().map(of_pair).collect()
}
