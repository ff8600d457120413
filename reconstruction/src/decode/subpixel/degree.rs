//! Edges of mode paper: on images of the degree of linear polarization, by the partial-area method.
//!
//! The degree `(I - r) / (I + r)` is no linear measure of light: where r is small against the bright level it saturates
//! early, and an edge in it lies on the dark side of the true one, by pixels where the picture is blurred. The images of
//! pattern and inverse are displaced to opposite sides by as much, so an edge is measured in both, and their mean counts.

use super::{
    area::{self, Form, MAX_REACH, Order},
    edges::{EdgeFinder, Line},
};
use crate::decode::{plan::BitFrames, sample::Sample};

/// A degree lies in 0..=1, so its variance cannot exceed that of a fair coin.
const MAX_VARIANCE: f64 = 0.25;
/// Change over two pixels below which an edge is not told from noise: 25 of 255 grey levels, the threshold of images.
const MIN_CHANGE: f64 = 25.0 / 255.0;
/// How far from the crossing an edge of one of the two images is looked for, in px.
const SEARCH: i32 = 4;
/// How far from the crossing the mean of the two may lie, in px.
const MAX_OFFSET: f64 = 1.0;
/// The edge counts as curved where the two orders differ by more than this many variances of the second: two sigma.
const CURVED_CHI2: f64 = 4.0;

/// Reach of a patch along the line: what is searched, the window there, and a pixel more for smoothing.
const ALONG: i32 = SEARCH + MAX_REACH as i32 + 2;
/// Lines of a patch on either side: those of a window, and one for smoothing.
const ACROSS: i32 = 2;
const WIDTH: usize = (2 * ALONG + 1) as usize;
const LINES: usize = (2 * ACROSS + 1) as usize;

/// Degrees around a crossing, and their means over 3x3 pixels; NaN where there is none.
struct Patch {
    values: [[f64; WIDTH]; LINES],
    smooth: [[f64; WIDTH]; LINES],
}

/// Index of a line or of a place along it.
fn index(offset: i32, reach: i32) -> usize {
    (offset + reach) as usize
}

impl Patch {
    /// `sample(y, t)` is the degree `y` lines and `t` pixels from the middle.
    fn new(sample: impl Fn(i32, i32) -> Option<f64>) -> Self {
        let mut patch = Self { values: [[f64::NAN; WIDTH]; LINES], smooth: [[f64::NAN; WIDTH]; LINES] };
        for y in -ACROSS..=ACROSS {
            for t in -ALONG..=ALONG {
                patch.values[index(y, ACROSS)][index(t, ALONG)] = sample(y, t).unwrap_or(f64::NAN);
            }
        }
        for line in 1..LINES - 1 {
            let sum: [f64; WIDTH] =
                std::array::from_fn(|at| (line - 1..=line + 1).map(|line| patch.values[line][at]).sum());
            for at in 1..WIDTH - 1 {
                patch.smooth[line][at] = (sum[at - 1] + sum[at] + sum[at + 1]) / 9.0;
            }
        }
        patch
    }

    /// The edge whose bright side lies `way` along the line, nearest to the middle: position from the middle and
    /// variance. Its form is the method's for noisy images, of second order where the edge is significantly curved.
    fn edge(&self, way: f64, variance: impl Fn(i32, i32) -> f64) -> Option<(f64, f64)> {
        let smooth = |y: i32, t: i32| self.smooth[index(y, ACROSS)][index(t, ALONG)];
        // A comparison with NaN does not hold.
        let change = |t: i32| way * (smooth(0, t + 1) - smooth(0, t - 1));
        let is_edge = |&t: &i32| {
            let here = change(t);
            here >= MIN_CHANGE && change(t - 1) <= here && change(t + 1) <= here
        };
        let middle = (-SEARCH..=SEARCH).filter(is_edge).min_by_key(|t| t.abs())?;
        let there = |value: f64| (!value.is_nan()).then_some(value);
        let reach = area::reach(|y, t| there(smooth(y, middle + t)))?;
        let sample = |y: i32, t: i32| {
            let value = there(self.values[index(y, ACROSS)][index(middle + t, ALONG)])?;
            Some((value, variance(y, middle + t)))
        };
        let of = |order| area::locate(Form { order, smoothed: true, reach }, sample);
        let curved = of(Order::Second)?;
        // A curvature that noise explains costs precision and explains nothing.
        let off = (curved.of_first_order - curved.position).powi(2);
        let found = if off > CURVED_CHI2 * curved.variance { curved } else { of(Order::First)? };
        let is_here = found.position.abs() <= MAX_OFFSET && found.variance > 0.0;
        is_here.then_some((f64::from(middle) + found.position, found.variance))
    }
}

impl<T: Sample> EdgeFinder<'_, T> {
    /// Degree of linear polarization, 0..=1 as in the paper's images.
    fn degree(&self, dn: f32, at: usize) -> f64 {
        f64::from(self.gates.dolp(dn, self.mean(&self.frames.low, at) as f32).clamp(0.0, 1.0))
    }

    /// Its variance.
    fn degree_variance(&self, dn: f32, at: usize) -> f64 {
        let dark = self.mean(&self.frames.low, at) as f32;
        let of_dark = f64::from(self.gates.variance(dark)) / self.frames.low.len().max(1) as f64;
        let above_black = |dn: f32| f64::from(dn - self.gates.black_dn).max(0.0);
        let (i, r) = (above_black(dn), above_black(dark));
        if i + r <= 0.0 {
            return MAX_VARIANCE;
        }
        // d/dI (I - r) / (I + r) = 2 r / (I + r)^2, and -2 I / (I + r)^2 by r.
        let squares = r * r * f64::from(self.gates.variance(dn)) + i * i * of_dark;
        (4.0 * squares / (i + r).powi(4)).min(MAX_VARIANCE)
    }

    /// Difference of the degrees of linear polarization of pattern and inverse, and its variance.
    pub(super) fn degree_fringe(&self, p: f32, q: f32, at: usize) -> (f64, f64) {
        let variance = self.degree_variance(p, at) + self.degree_variance(q, at);
        (self.degree(p, at) - self.degree(q, at), variance.max(1e-9))
    }

    /// Position on the line and variance of the edge of `bit` behind `value` near `estimate`. `None` where its windows
    /// leave the surface or the image, where a frame is saturated, and where the degrees of pattern and inverse do not
    /// both have their edge.
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
        let full = self.gates.saturation_dn;
        let edge = |plane: &[T], way: f64| {
            let patch = Patch::new(|y, t| {
                let at = line.beside(middle, y, t)?;
                // Twice the distance from the boundary, so that it is whole: up to the next edges of this bit.
                let off = (2 * self.value(at)? - 2 * value - 1).abs();
                let dn = plane[at].dn();
                (off <= 4 * stripe && dn < full).then(|| self.degree(dn as f32, at))
            });
            patch.edge(way, |y, t| {
                let at = line.beside(middle, y, t);
                at.map_or(MAX_VARIANCE, |at| self.degree_variance(plane[at].dn() as f32, at))
            })
        };
        let at = line.at(position);
        let way = if p[at].dn() < q[at].dn() { 1.0 } else { -1.0 };
        let (of_p, of_q) = (edge(p, way)?, edge(q, -way)?);
        let found = middle as f64 + (of_p.0 + of_q.0) / 2.0;
        ((found - estimate).abs() <= MAX_OFFSET).then_some((found, (of_p.1 + of_q.1) / 4.0))
    }
}
