//! Classes of pixels from all that was found of them.

use super::{
    RowMaps, Scratch, WEAK_SCALE, WEAK_UNKNOWN,
    resolve::{AMBIGUOUS, EDGE, OUTSIDE},
};
use crate::decode::{
    limits::Gates,
    plan::{Frames, Levels},
    sample::Sample,
    types::Class,
    whole::whole_part,
};

/// Weakness is judged where |C| is at least this many sigma of P - Q.
const WEAK_JUDGED: f32 = 9.0;

impl<T: Sample> Scratch<T> {
    /// Classes, the residual of the pair sums and the weakness of coarse bits.
    #[inline(always)]
    pub(super) fn classify(&mut self, frames: &Frames<'_, T>, gates: &Gates, row: &mut RowMaps<'_>) {
        let len = row.class.len();
        let full = gates.saturation_dn;
        let variance = &self.levels.variance[..len];
        let references = &self.reference_saturated[..len];
        let (one, both) = (&self.peaks.one[..len], &self.peaks.both[..len]);
        let (status, inverted) = (&self.status[..len], &self.inverted[..len]);
        let lit = &mut self.lit[..len];
        find_lit(row.modulation, variance, inverted, gates.lit_sigma, lit);
        saturations(one, references, full, row.half_saturated);
        for x in 0..len {
            let saturated = (both[x].dn() >= full) | (references[x] & 2 != 0);
            row.class[x] = class_of(saturated, lit[x], inverted[x] != 0, status[x]);
        }
        let level = (&*row.modulation, &*row.sigma);
        weakness(&self.weak[..len], level, row.class, row.half_saturated, row.weakest);
        for values in row.values.iter_mut().filter(|values| !values.is_empty()) {
            clear_invalid(row.class, values);
        }
        // Where the mean pair sum stands in for the references it holds the pair itself.
        let kept = 1.0 - 1.0 / frames.pair_count() as f32;
        let of_pair = &mut self.pair_variance[..len];
        if frames.levels == Levels::References {
            for ((of_pair, sigma), variance) in of_pair.iter_mut().zip(&*row.sigma).zip(variance) {
                *of_pair = sigma * sigma + variance;
            }
        } else {
            for (of_pair, sigma) in of_pair.iter_mut().zip(&*row.sigma) {
                *of_pair = sigma * sigma * kept;
            }
        }
        residuals((&self.squares[..len], &self.pairs[..len]), of_pair, references, row.residual);
    }
}

#[inline(always)]
fn find_lit(modulation: &[f32], variance: &[f32], inverted: &[u16], lit_sigma: f32, lit: &mut [bool]) {
    let len = modulation.len();
    let (variance, inverted, lit) = (&variance[..len], &inverted[..len], &mut lit[..len]);
    for x in 0..len {
        let gate = if inverted[x] != 0 { 2.0 * lit_sigma } else { lit_sigma };
        lit[x] = modulation[x].abs() >= gate * variance[x].sqrt();
    }
}

#[inline(always)]
fn saturations<T: Sample>(one: &[T], references: &[u8], full: i32, saturated: &mut [bool]) {
    let len = one.len();
    let (references, saturated) = (&references[..len], &mut saturated[..len]);
    for x in 0..len {
        saturated[x] = (one[x].dn() >= full) | (references[x] != 0);
    }
}

#[inline(always)]
fn weakness(
    weak: &[i32],
    (modulation, sigma): (&[f32], &[f32]),
    class: &[Class],
    saturated: &[bool],
    weakest: &mut [u8],
) {
    let len = weak.len();
    let (modulation, sigma) = (&modulation[..len], &sigma[..len]);
    let (class, saturated, weakest) = (&class[..len], &saturated[..len], &mut weakest[..len]);
    for x in 0..len {
        let modulation = modulation[x].abs();
        let judged = class[x].is_valid()
            & (weak[x] != i32::MAX)
            & !saturated[x]
            & (modulation >= WEAK_JUDGED * sigma[x]);
        let level = whole_part((weak[x] as f32 / modulation * WEAK_SCALE).min(254.0)) as u8;
        weakest[x] = if judged { level } else { WEAK_UNKNOWN };
    }
}

#[inline(always)]
fn clear_invalid(class: &[Class], values: &mut [i32]) {
    for (value, class) in values.iter_mut().zip(class) {
        *value = if class.is_valid() { *value } else { -1 };
    }
}

#[inline(always)]
fn residuals(
    (squares, pairs): (&[f32], &[u16]),
    variance: &[f32],
    references_saturated: &[u8],
    residual: &mut [f32],
) {
    let len = squares.len();
    let (pairs, variance) = (&pairs[..len], &variance[..len]);
    let (references_saturated, residual) = (&references_saturated[..len], &mut residual[..len]);
    for x in 0..len {
        let found = (squares[x] / (f32::from(pairs[x]) * variance[x])).sqrt();
        let known = (pairs[x] > 0) & (references_saturated[x] == 0);
        residual[x] = if known { found } else { f32::NAN };
    }
}

#[inline(always)]
fn class_of(both_saturated: bool, lit: bool, inverted: bool, status: u16) -> Class {
    let class = if status == EDGE { Class::Edge } else { Class::Valid };
    let class = if inverted { Class::Inverted } else { class };
    let class = if status == OUTSIDE { Class::OutOfProjector } else { class };
    let class = if status == AMBIGUOUS { Class::Ambiguous } else { class };
    let class = if lit { class } else { Class::Unlit };
    if both_saturated { Class::Saturated } else { class }
}
