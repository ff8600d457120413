//! Fits through windows that begin at neighbouring edges, one to a lane of vector registers. Each lane does what the
//! functions for one window do, in the same order, so that results are equal to the bit.

#![allow(clippy::needless_range_loop, reason = "one index counts the lanes of several arrays")]

use super::{BEYOND, Edge, Fit, JUMP_EDGES, JUMP_SIGMA, MIN_JUMP, MISFIT};
use crate::simd::Work;

/// Windows that are fitted together.
const LANES: usize = 8;
type Lane = [f64; LANES];

const _: () = assert!(BEYOND >= LANES, "the last lanes must find something to read");

/// Edges by property, and more at the end than there are, for lanes that have no window.
#[derive(Debug, Default)]
pub(super) struct Columns {
    position: Vec<f64>,
    weight: Vec<f64>,
    u: Vec<f64>,
}

impl Columns {
    /// Takes over the edges of a run.
    pub fn fill(&mut self, edges: &[Edge]) {
        let take = |to: &mut Vec<f64>, of: fn(&Edge) -> f64| {
            to.clear();
            to.extend(edges.iter().map(of));
            to.resize(edges.len() + BEYOND, 0.0);
        };
        take(&mut self.position, |edge| edge.position);
        take(&mut self.weight, |edge| edge.weight);
        take(&mut self.u, |edge| edge.u);
    }

    /// Number of edges.
    fn len(&self) -> usize {
        self.position.len() - BEYOND
    }
}

#[inline(always)]
fn lane(values: &[f64], from: usize) -> Lane {
    let mut lane = [0.0; LANES];
    lane.copy_from_slice(&values[from..from + LANES]);
    lane
}

/// Weighted sums about an origin, as `Sums` has them.
struct LaneSums {
    origin: Lane,
    base: Lane,
    t: [Lane; 5],
    u: [Lane; 3],
}

/// Sums over the windows of `count` edges from `first`, `first + 1`, ... on.
#[inline(always)]
fn sums(edges: &Columns, first: usize, count: usize) -> LaneSums {
    let zero = [0.0; LANES];
    let (origin, base) = (lane(&edges.position, first + count / 2), lane(&edges.u, first + count / 2));
    let mut sums = LaneSums { origin, base, t: [zero; 5], u: [zero; 3] };
    let (mut s0, mut s1, mut s2, mut s3, mut s4) = (zero, zero, zero, zero, zero);
    let (mut u0, mut u1, mut u2) = (zero, zero, zero);
    for edge in first..first + count {
        let (position, weight, value) =
            (lane(&edges.position, edge), lane(&edges.weight, edge), lane(&edges.u, edge));
        for l in 0..LANES {
            let (t, u, w) = (position[l] - origin[l], value[l] - base[l], weight[l]);
            let tt = t * t;
            let (wt, wtt) = (w * t, w * tt);
            s0[l] += w;
            s1[l] += wt;
            s2[l] += wtt;
            s3[l] += w * (tt * t);
            s4[l] += w * (tt * tt);
            u0[l] += w * u;
            u1[l] += wt * u;
            u2[l] += wtt * u;
        }
    }
    (sums.t, sums.u) = ([s0, s1, s2, s3, s4], [u0, u1, u2]);
    sums
}

/// Parabolas through all windows of `count` edges, of those that are made from `first..end` alone; `None` where there is
/// none, or where it does not fit.
pub(super) struct Parabolas<'a> {
    pub edges: &'a Columns,
    pub first: usize,
    pub end: usize,
    pub count: usize,
    /// By the first edge of the window.
    pub out: &'a mut [Option<Fit>],
}

impl Work for Parabolas<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { edges, first, end, count, out } = self;
        let windows = (end - first + 1).saturating_sub(count);
        for block in (first..first + windows).step_by(LANES) {
            let (fits, fitting) = parabolas(edges, block, count);
            let lanes = LANES.min(first + windows - block);
            for (l, out) in out[block..block + lanes].iter_mut().enumerate() {
                *out = fitting[l].then(|| Fit {
                    origin: fits.origin[l],
                    coefficients: fits.coefficients.map(|lane| lane[l]),
                    covariance: fits.covariance.map(|lane| lane[l]),
                });
            }
        }
    }
}

/// [`Fit`] by lane.
struct Fits {
    origin: Lane,
    coefficients: [Lane; 3],
    covariance: [Lane; 6],
}

#[inline(always)]
fn parabolas(edges: &Columns, first: usize, count: usize) -> (Fits, [bool; LANES]) {
    let sums = sums(edges, first, count);
    let zero = [0.0; LANES];
    let mut fits = Fits { origin: sums.origin, coefficients: [zero; 3], covariance: [zero; 6] };
    let mut found = [false; LANES];
    for l in 0..LANES {
        let (s0, s1, s2, s3, s4) = (sums.t[0][l], sums.t[1][l], sums.t[2][l], sums.t[3][l], sums.t[4][l]);
        let (m00, m01, m02) = (s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2);
        let (m11, m12, m22) = (s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1);
        let determinant = s0 * m00 + s1 * m01 + s2 * m02;
        found[l] = determinant > 1e-12 * s0 * s2 * s4;
        let (i00, i01, i02) = (m00 / determinant, m01 / determinant, m02 / determinant);
        let (i11, i12, i22) = (m11 / determinant, m12 / determinant, m22 / determinant);
        let (u0, u1, u2) = (sums.u[0][l], sums.u[1][l], sums.u[2][l]);
        fits.coefficients[0][l] = sums.base[l] + i00 * u0 + i01 * u1 + i02 * u2;
        fits.coefficients[1][l] = i01 * u0 + i11 * u1 + i12 * u2;
        fits.coefficients[2][l] = i02 * u0 + i12 * u1 + i22 * u2;
        fits.covariance[0][l] = i00;
        fits.covariance[1][l] = i01;
        fits.covariance[2][l] = i02;
        fits.covariance[3][l] = i11;
        fits.covariance[4][l] = i12;
        fits.covariance[5][l] = i22;
    }
    let [c0, c1, c2] = fits.coefficients;
    let mut squares = zero;
    for edge in first..first + count {
        let (position, weight, u) =
            (lane(&edges.position, edge), lane(&edges.weight, edge), lane(&edges.u, edge));
        for l in 0..LANES {
            let t = position[l] - sums.origin[l];
            let off = u[l] - (c0[l] + t * (c1[l] + t * c2[l]));
            squares[l] += off * off * weight[l];
        }
    }
    let freedom = (count - 3) as f64;
    let (begin, end) = (lane(&edges.position, first), lane(&edges.position, first + count - 1));
    let limit = freedom + MISFIT * (2.0 * freedom).sqrt();
    let mut scale = zero;
    for l in 0..LANES {
        let middle = (begin[l] + end[l]) / 2.0 - sums.origin[l];
        let slope = c1[l] + 2.0 * c2[l] * middle;
        let chi2 = squares[l] * (1.0 / (slope * slope));
        let share = chi2 / freedom;
        let excess = if share > 1.0 { share } else { 1.0 };
        scale[l] = slope * slope * excess;
        found[l] &= (chi2 <= limit) | chi2.is_nan();
    }
    for entry in 0..6 {
        for l in 0..LANES {
            fits.covariance[entry][l] *= scale[l];
        }
    }
    (fits, found)
}

/// What the edges on both sides of a gap say of it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) enum Gap {
    /// Three edges on a side do not make a line, or there are not as many.
    #[default]
    Unknown,
    /// The surface goes on.
    Even,
    /// It jumps.
    Jump,
}

/// Gaps before each edge that has [`JUMP_EDGES`] before it and as many from it on.
pub(super) struct Gaps<'a> {
    pub edges: &'a Columns,
    pub out: &'a mut [Gap],
}

impl Work for Gaps<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { edges, out } = self;
        let last = (edges.len() + 1).saturating_sub(JUMP_EDGES);
        for block in (JUMP_EDGES..last).step_by(LANES) {
            let (before, behind) = (lane(&edges.position, block - 1), lane(&edges.position, block));
            let mut middle = [0.0; LANES];
            for l in 0..LANES {
                middle[l] = (before[l] + behind[l]) / 2.0;
            }
            let (left, right) = (lines(edges, block - JUMP_EDGES, &middle), lines(edges, block, &middle));
            let (mut known, mut jump) = ([false; LANES], [false; LANES]);
            for l in 0..LANES {
                let off = (left.value[l] - right.value[l]).abs();
                known[l] = left.found[l] & right.found[l];
                jump[l] =
                    (off > MIN_JUMP) & (off > JUMP_SIGMA * (left.variance[l] + right.variance[l]).sqrt());
            }
            let lanes = LANES.min(last - block);
            for (l, out) in out[block..block + lanes].iter_mut().enumerate() {
                *out = match (known[l], jump[l]) {
                    (false, _) => Gap::Unknown,
                    (true, false) => Gap::Even,
                    (true, true) => Gap::Jump,
                };
            }
        }
    }
}

/// Lines at a place.
struct Lines {
    found: [bool; LANES],
    value: Lane,
    variance: Lane,
}

/// Lines through [`JUMP_EDGES`] edges from `first` on, at `place`.
#[inline(always)]
fn lines(edges: &Columns, first: usize, place: &Lane) -> Lines {
    let sums = sums(edges, first, JUMP_EDGES);
    let mut lines = Lines { found: [false; LANES], value: [0.0; LANES], variance: [0.0; LANES] };
    for l in 0..LANES {
        let (s0, s1, s2) = (sums.t[0][l], sums.t[1][l], sums.t[2][l]);
        let determinant = s0 * s2 - s1 * s1;
        lines.found[l] = determinant > 1e-12 * s0 * s2;
        let slope = (s0 * sums.u[1][l] - s1 * sums.u[0][l]) / determinant;
        let level = (s2 * sums.u[0][l] - s1 * sums.u[1][l]) / determinant;
        let scale = slope * slope;
        let (v00, v01, v11) = (s2 / determinant * scale, -s1 / determinant * scale, s0 / determinant * scale);
        let t = place[l] - sums.origin[l];
        lines.value[l] = sums.base[l] + level + t * slope;
        lines.variance[l] = v00 + t * (2.0 * v01 + t * v11);
    }
    lines
}
