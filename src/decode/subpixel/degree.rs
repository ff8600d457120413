//! Edges of mode paper: on images of the degree of linear polarization, by the partial-area method.
//!
//! The degree `(I - r) / (I + r)` is no linear measure of light: where r is small against the bright level it saturates
//! early, and an edge in it lies on the dark side of the true one. The degrees of pattern and inverse are displaced to
//! opposite sides, so their difference is not: it is what edges are measured in.

use super::{
    area::{self, Form, MAX_REACH, Order},
    edges::{EdgeFinder, Line},
};
use crate::decode::{plan::BitFrames, sample::Sample};

/// A degree lies in 0..=1, so its variance cannot exceed that of a fair coin.
const MAX_VARIANCE: f64 = 0.25;
/// Height of an edge in the difference of two degrees below which it is not told from noise.
const MIN_STEP: f64 = 0.2;
/// The edge counts as curved where the two orders differ by more than this many variances of the second: two sigma.
const CURVED_CHI2: f64 = 4.0;
/// How far from the middle of its window an edge may be found, in px.
const MAX_OFFSET: f64 = 1.0;

impl<T: Sample> EdgeFinder<'_, T> {
    /// Difference of the degrees of linear polarization of pattern and inverse, each in 0..=1 as in the paper's images,
    /// and its variance.
    pub(super) fn degree_fringe(&self, p: f32, q: f32, at: usize) -> (f64, f64) {
        let dark = self.mean(&self.frames.low, at) as f32;
        let degree = |dn: f32| f64::from(self.gates.dolp(dn, dark).clamp(0.0, 1.0));
        let of_dark = f64::from(self.gates.variance(dark)) / self.frames.low.len().max(1) as f64;
        let above_black = |dn: f32| f64::from(dn - self.gates.black_dn).max(0.0);
        let r = above_black(dark);
        let variance = |dn: f32| {
            let i = above_black(dn);
            let sum = i + r;
            if sum <= 0.0 {
                return MAX_VARIANCE;
            }
            // d/dI (I - r) / (I + r) = 2 r / (I + r)^2, and -2 I / (I + r)^2 by r.
            let scale = 4.0 / sum.powi(4);
            let variance = scale * (r * r * f64::from(self.gates.variance(dn)) + i * i * of_dark);
            variance.min(MAX_VARIANCE)
        };
        (degree(p) - degree(q), (variance(p) + variance(q)).max(1e-9))
    }

    /// Position on the line and variance of the edge of `bit` behind `value` near `estimate`, by the method's form for
    /// noisy images (smoothed), of second order where the edge is significantly curved. The window reaches to the middle of the stripes on both sides, which the code
    /// tells, up to the method's longest reach. `None` where it leaves the surface or the image, where a frame is
    /// saturated, and where what is found is not this edge.
    pub(super) fn three_lines(
        &self,
        line: Line,
        position: usize,
        estimate: f64,
        (value, bit): (i32, u8),
    ) -> Option<(f64, f64)> {
        let BitFrames::Pair(p, q) = self.bits[usize::from(bit)] else { return None };
        let middle = (estimate.round().max(0.0) as usize).clamp(position, position + 1);
        let stripe = 1i32 << (self.code.bits - 1 - bit);
        // Twice the distance from the boundary, so that it is whole.
        let off = |at: usize| Some((2 * self.value(at)? - 2 * value - 1).abs());
        let free = |t: i32| {
            let at = |t: i32| off(line.beside(middle, 0, t)?);
            at(t).zip(at(-t)).is_some_and(|(a, b)| a.max(b) <= 2 * stripe)
        };
        let reach = (1..=MAX_REACH).take_while(|&t| free(t as i32)).last().filter(|&reach| reach > 1)?;
        let full = self.gates.saturation_dn;
        let mut sample = |y: i32, t: i32| {
            let at = line.beside(middle, y, t)?;
            let (p, q) = (p[at].dn(), q[at].dn());
            // Smoothing reads one pixel more, which may lie just beyond the middle of the stripe.
            let inside = off(at)? <= 2 * stripe + 4;
            (inside && p < full && q < full).then(|| self.degree_fringe(p as f32, q as f32, at))
        };
        let mut of =
            |order| area::locate(Form { order, smoothed: true, reach: [[reach; 2]; 3] }, &mut sample);
        let (straight, curved) = (of(Order::First)?, of(Order::Second)?);
        // A curvature that noise explains costs precision and explains nothing.
        let off = (curved.position - straight.position).powi(2);
        let found = if off > CURVED_CHI2 * curved.variance { curved } else { straight };
        let is_edge = found.before * found.after < 0.0
            && (found.before - found.after).abs() >= MIN_STEP
            && found.position.abs() <= MAX_OFFSET
            && found.variance > 0.0;
        is_edge.then_some((middle as f64 + found.position, found.variance))
    }
}
