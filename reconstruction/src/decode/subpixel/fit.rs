//! Local fits of the projector coordinate through the edges of one surface.

use std::{borrow::Cow, ops::Range};

mod lanes;
#[cfg(test)]
mod tests;

use self::lanes::{Columns, Gap, Gaps, Parabolas};
use super::edges::Edge;
use crate::simd::InstructionSet;

/// A depth jump: the lines of both sides disagree between two edges by more than this many projector px ...
const MIN_JUMP: f64 = 0.6;
/// ... and by more than this many sigma.
const JUMP_SIGMA: f64 = 6.0;
/// Edges on each side that a jump is looked for with.
const JUMP_EDGES: usize = 3;
/// A fit is refused where its chi-square is this many standard deviations too large.
const MISFIT: f64 = 2.5;
/// A parabola takes this many times the edges of a line.
const WIDE: usize = 2;
/// Gain in chi-square that makes a parabola out of a line.
const BEND_CHI2: f64 = 4.0;
/// Edges of the line that is left where not even a parabola fits.
const SHORT: usize = 4;
/// Fewest edges of a wide parabola.
const FEWEST_WIDE: usize = 5;
/// What arrays of edges hold beyond their end.
const BEYOND: usize = 8;

/// `u(x) = c0 + c1 t + c2 t^2`, `t = x - origin`, with the covariance of the coefficients.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Fit {
    origin: f64,
    coefficients: [f64; 3],
    /// Upper triangle by rows: 00 01 02 11 12 22.
    covariance: [f64; 6],
}

impl Fit {
    fn value(&self, position: f64) -> f64 {
        let t = position - self.origin;
        let [c0, c1, c2] = self.coefficients;
        c0 + t * (c1 + t * c2)
    }

    /// Coordinate and its variance at a position.
    pub fn at(&self, position: f64) -> (f64, f64) {
        let t = position - self.origin;
        let [v00, v01, v02, v11, v12, v22] = self.covariance;
        let variance = v00 + t * (2.0 * v01 + t * (v11 + 2.0 * v02 + t * (2.0 * v12 + t * v22)));
        (self.value(position), variance)
    }
}

/// Weighted sums of edges about an origin.
struct Sums {
    origin: f64,
    base: f64,
    /// Sums of w t^i.
    t: [f64; 5],
    /// Sums of w t^i u.
    u: [f64; 3],
}

impl Sums {
    fn of(edges: &[Edge]) -> Self {
        let (origin, base) = (edges[edges.len() / 2].position, edges[edges.len() / 2].u);
        let mut sums = Self { origin, base, t: [0.0; 5], u: [0.0; 3] };
        for edge in edges {
            let (t, u, w) = (edge.position - origin, edge.u - base, edge.weight);
            let tt = t * t;
            for (sum, power) in sums.t.iter_mut().zip([1.0, t, tt, tt * t, tt * tt]) {
                *sum += w * power;
            }
            for (sum, power) in sums.u.iter_mut().zip([1.0, t, tt]) {
                *sum += w * power * u;
            }
        }
        sums
    }

    /// Straight line: coefficients and covariance for weights that are 1/variance of u.
    fn line(&self) -> Option<Fit> {
        let [s0, s1, s2, ..] = self.t;
        let determinant = s0 * s2 - s1 * s1;
        (determinant > 1e-12 * s0 * s2).then(|| {
            let slope = (s0 * self.u[1] - s1 * self.u[0]) / determinant;
            let level = (s2 * self.u[0] - s1 * self.u[1]) / determinant;
            let covariance = [s2 / determinant, -s1 / determinant, 0.0, s0 / determinant, 0.0, 0.0];
            Fit { origin: self.origin, coefficients: [self.base + level, slope, 0.0], covariance }
        })
    }

    /// Parabola, by the inverse of the symmetric 3x3 normal matrix.
    fn parabola(&self) -> Option<Fit> {
        let [s0, s1, s2, s3, s4] = self.t;
        let (m00, m01, m02) = (s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2);
        let (m11, m12, m22) = (s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1);
        let determinant = s0 * m00 + s1 * m01 + s2 * m02;
        (determinant > 1e-12 * s0 * s2 * s4).then(|| {
            let covariance = [m00, m01, m02, m11, m12, m22].map(|minor| minor / determinant);
            let [i00, i01, i02, i11, i12, i22] = covariance;
            let [u0, u1, u2] = self.u;
            let coefficients = [
                self.base + i00 * u0 + i01 * u1 + i02 * u2,
                i01 * u0 + i11 * u1 + i12 * u2,
                i02 * u0 + i12 * u1 + i22 * u2,
            ];
            Fit { origin: self.origin, coefficients, covariance }
        })
    }
}

/// Sets the scale of the covariance: edges are exact in u and noisy in x, which the slope turns into u. Returns the
/// chi-square; where it is larger than its degrees of freedom the covariance grows with it.
fn scale(fit: &mut Fit, edges: &[Edge], parameters: usize) -> f64 {
    let middle = (edges[0].position + edges[edges.len() - 1].position) / 2.0 - fit.origin;
    let slope = fit.coefficients[1] + 2.0 * fit.coefficients[2] * middle;
    let per_slope = 1.0 / (slope * slope);
    let chi2 = edges
        .iter()
        .map(|edge| {
            let off = edge.u - fit.value(edge.position);
            off * off * edge.weight
        })
        .sum::<f64>()
        * per_slope;
    let freedom = edges.len() - parameters;
    let excess = if freedom > 0 { (chi2 / freedom as f64).max(1.0) } else { 1.0 };
    for entry in &mut fit.covariance {
        *entry *= slope * slope * excess;
    }
    chi2
}

fn fits_badly(chi2: f64, freedom: usize) -> bool {
    let freedom = freedom as f64;
    chi2 > freedom + MISFIT * (2.0 * freedom).sqrt()
}

/// Ranges of edges that models around an interval are fitted to.
struct Windows {
    /// Twice as many edges as the line takes.
    wide: Range<usize>,
    line: Range<usize>,
    short: Range<usize>,
}

impl Windows {
    /// Those for the interval before edge `passed` in the segment `start..end`.
    fn around(start: usize, end: usize, passed: usize, fit_edges: usize) -> Self {
        let of = |count| window(start, end, passed, count);
        Self { wide: of(WIDE.saturating_mul(fit_edges)), line: of(fit_edges), short: of(SHORT) }
    }
}

/// The best description of the edges around an interval. A parabola through twice as many edges is as precise as the
/// line (its variance in the middle is 9/4 of that of a line through the same edges) and has no bias on curved
/// surfaces, so it comes first where there are enough edges: `known` for windows of full length, which are fitted
/// together. Where its residuals exceed noise the window shrinks: line, parabola through the edges of the line, and
/// where not even that fits, a short line.
fn fit_windows<'a>(
    edges: &[Edge],
    windows: &Windows,
    known: impl FnOnce() -> Option<&'a Option<Fit>>,
) -> Option<Cow<'a, Fit>> {
    let wide = &edges[windows.wide.clone()];
    let middle = &edges[windows.line.clone()];
    if middle.len() < 2 {
        return None;
    }
    if 4 * wide.len() >= 3 * WIDE * middle.len() && wide.len() >= FEWEST_WIDE {
        let parabola = match known() {
            Some(known) => known.as_ref().map(Cow::Borrowed),
            None => fitting_parabola(wide).map(Cow::Owned),
        };
        if parabola.is_some() {
            return parabola;
        }
    }
    fit_closely(edges, windows).map(Cow::Owned)
}

/// A line, or what comes after it.
fn fit_closely(edges: &[Edge], windows: &Windows) -> Option<Fit> {
    let middle = &edges[windows.line.clone()];
    let sums = Sums::of(middle);
    let mut line = sums.line()?;
    let of_line = scale(&mut line, middle, 2);
    if middle.len() > 4
        && let Some(mut parabola) = sums.parabola()
    {
        let of_parabola = scale(&mut parabola, middle, 3);
        let bends = of_line - of_parabola > BEND_CHI2 * (of_parabola / (middle.len() - 3) as f64).max(1.0);
        match (fits_badly(of_line, middle.len() - 2), fits_badly(of_parabola, middle.len() - 3)) {
            (false, _) if !bends => return Some(line),
            (_, false) => return Some(parabola),
            _ => {}
        }
    } else if middle.len() < 4 || !fits_badly(of_line, middle.len() - 2) {
        return Some(line);
    }
    let near = &edges[windows.short.clone()];
    let mut nearer = Sums::of(near).line().filter(|_| near.len() < middle.len());
    if let Some(fit) = &mut nearer {
        scale(fit, near, 2);
    }
    nearer.or(Some(line))
}

/// Parabola through all `edges`, unless its residuals exceed noise.
fn fitting_parabola(edges: &[Edge]) -> Option<Fit> {
    let mut fit = Sums::of(edges).parabola()?;
    let chi2 = scale(&mut fit, edges, 3);
    (!fits_badly(chi2, edges.len() - 3)).then_some(fit)
}

/// Edges of one run, split where the surface jumps.
#[derive(Debug, Default)]
pub(super) struct Segments {
    /// Segment of each edge, as its range of edges.
    of_edge: Vec<(usize, usize)>,
    starts: Vec<usize>,
    columns: Columns,
    gaps: Vec<Gap>,
    /// Parabola through a window of full length, by its first edge.
    wide: Vec<Option<Fit>>,
    /// Edges of that window; 0 where there is none.
    wide_edges: usize,
    /// Edges of a line.
    fit_edges: usize,
}

impl Segments {
    /// Splits `edges` at jumps, and fits what can be fitted together for lines of `fit_edges` edges.
    pub fn split(&mut self, edges: &[Edge], fit_edges: usize, set: InstructionSet) {
        self.starts.clear();
        self.of_edge.clear();
        self.columns.fill(edges);
        self.gaps.clear();
        self.gaps.resize(edges.len(), Gap::Unknown);
        set.run(Gaps { edges: &self.columns, out: &mut self.gaps });
        let mut start = 0;
        for next in 1..edges.len() {
            let jumps = match self.gaps[next] {
                Gap::Even if next - start >= JUMP_EDGES => false,
                Gap::Jump if next - start >= JUMP_EDGES => true,
                _ => jumps(edges, start, next),
            };
            if jumps {
                self.starts.push(start);
                start = next;
            }
        }
        if !edges.is_empty() {
            self.starts.push(start);
        }
        for (index, &start) in self.starts.iter().enumerate() {
            let end = self.starts.get(index + 1).copied().unwrap_or(edges.len());
            self.of_edge.extend((start..end).map(|_| (start, end)));
        }
        self.fit_edges = fit_edges;
        self.fit_wide(edges, set);
    }

    /// Fits the parabolas through windows of full length.
    fn fit_wide(&mut self, edges: &[Edge], set: InstructionSet) {
        let count = WIDE.saturating_mul(self.fit_edges);
        self.wide_edges = if (FEWEST_WIDE..=edges.len()).contains(&count) { count } else { 0 };
        if self.wide_edges == 0 {
            return;
        }
        self.wide.resize(edges.len(), None);
        for (index, &first) in self.starts.iter().enumerate() {
            let end = self.starts.get(index + 1).copied().unwrap_or(edges.len());
            set.run(Parabolas { edges: &self.columns, first, end, count, out: &mut self.wide });
        }
    }

    /// The parabola through a window, if windows like it were fitted together.
    fn known(&self, window: &Range<usize>) -> Option<&Option<Fit>> {
        if window.len() == self.wide_edges { self.wide.get(window.start) } else { None }
    }

    /// Fits for pixels after `passed` of the `edges` that were split: one where both neighbouring edges belong to one segment, else one of
    /// each side.
    pub fn fits(&self, edges: &[Edge], passed: usize) -> [Option<Cow<'_, Fit>>; 2] {
        let before = passed.checked_sub(1).and_then(|edge| self.of_edge.get(edge)).copied();
        let after = self.of_edge.get(passed).copied();
        let fit = |(start, end): (usize, usize)| {
            let windows = Windows::around(start, end, passed, self.fit_edges);
            fit_windows(edges, &windows, || self.known(&windows.wide))
        };
        match (before, after) {
            (Some(before), Some(after)) if before == after => [fit(before), None],
            _ => [before.and_then(fit), after.and_then(fit)],
        }
    }
}

/// Up to `count` edges of `start..end` around the interval before edge `passed`.
fn window(start: usize, end: usize, passed: usize, count: usize) -> Range<usize> {
    let first = passed.saturating_sub(count / 2).min(end.saturating_sub(count)).max(start);
    first..first.saturating_add(count).min(end)
}

/// Whether the surface jumps between edges `next - 1` and `next`: the lines through the edges of either side
/// disagree in the middle.
fn jumps(edges: &[Edge], start: usize, next: usize) -> bool {
    let left = &edges[next.saturating_sub(JUMP_EDGES).max(start)..next];
    let right = &edges[next..(next + JUMP_EDGES).min(edges.len())];
    let middle = (edges[next - 1].position + edges[next].position) / 2.0;
    let line = |side: &[Edge]| {
        if side.len() < 2 {
            return None;
        }
        let mut fit = Sums::of(side).line()?;
        let slope = fit.coefficients[1];
        for entry in &mut fit.covariance {
            *entry *= slope * slope;
        }
        Some(fit)
    };
    let disagree = |one: (f64, f64), other: (f64, f64)| {
        let off = (one.0 - other.0).abs();
        off > MIN_JUMP && off > JUMP_SIGMA * (one.1 + other.1).sqrt()
    };
    match (line(left), line(right)) {
        (Some(left), Some(right)) => disagree(left.at(middle), right.at(middle)),
        // A single edge: the other side's line must meet it.
        (Some(left), None) => disagree(left.at(edges[next].position), (edges[next].u, 0.0)),
        (None, Some(right)) => disagree(right.at(edges[next - 1].position), (edges[next - 1].u, 0.0)),
        (None, None) => false,
    }
}
