//! Where surfaces face: a linear fit of inverse depth over a window of the pixel grid, which gives an unbiased normal
//! because a plane's inverse depth is affine in the normalised coordinates.
//!
//! Neighbouring pixels of a row are handled together, one to a lane of vector registers. Each lane does what
//! `plain::normal_at` does, in the same order.

#![allow(clippy::needless_range_loop, reason = "one index counts the lanes of several arrays")]

use rayon::prelude::*;

use super::surface::{BLOCK, JUMP_SIGMAS, MARGIN, STEEPEST, Surface};
use crate::{
    grid::Grid,
    simd::{InstructionSet, Work},
};

#[cfg(test)]
mod plain;
#[cfg(test)]
mod tests;

/// A window has (2 * HALF + 1)^2 samples, 1 to 3 pixels apart.
const HALF: usize = 3;
const SPAN: usize = 2 * HALF + 1;
/// Root of the sum of squared offsets over a full window: noise of a slope is sigma over this many pitches.
const WINDOW_GAIN: f32 = 14.0;
/// Slope noise that windows are widened for, in radians.
const WANTED_SLOPE_SIGMA: f32 = 0.03;
/// Fewer samples make no normal.
const MIN_SAMPLES: f32 = 6.0;
/// Widest distance of samples in px.
const MAX_STRIDE: u8 = 3;

const _: () = assert!(MARGIN >= HALF * MAX_STRIDE as usize, "windows must stay within the margin");

/// Unit normals towards the camera, (0, 0, 0) where the neighbours do not make one.
pub(super) fn normals(set: InstructionSet, surface: &Surface<'_>) -> Grid<[f32; 3]> {
    let (width, height) = surface.size();
    let mut normals = Grid::filled(width, height, [0.0; 3]);
    normals
        .data_mut()
        .par_chunks_mut(width.max(1))
        .enumerate()
        .for_each(|(y, row)| set.run(RowNormals { surface, y, row }));
    normals
}

/// One value of each pixel of a block.
type Lanes = [f32; BLOCK];
type Wide = [f64; BLOCK];

/// Distance of the samples that a normal is made from, in px; 0 where there is no point.
#[inline(always)]
fn strides(surface: &Surface<'_>, here: &Lanes, sigma: &Lanes) -> [u8; BLOCK] {
    let mut strides = [0; BLOCK];
    for l in 0..BLOCK {
        // Slope noise of a window of stride 1 is sigma_z / (z * pitch * gain) = sigma_w / (w * pitch * gain).
        let noise = sigma[l] / (here[l] * surface.pitch * WINDOW_GAIN);
        // Noise that is no number asks for the widest.
        let narrower = u8::from(noise <= WANTED_SLOPE_SIGMA) + u8::from(noise <= 2.0 * WANTED_SLOPE_SIGMA);
        strides[l] = if here[l].is_finite() { MAX_STRIDE - narrower } else { 0 };
    }
    strides
}

/// Sums of a linear fit of inverse depth over offsets in strides, of the samples that lie on the pixel's surface.
#[derive(Clone, Copy)]
struct Moments {
    n: Lanes,
    i: Lanes,
    j: Lanes,
    ii: Lanes,
    ij: Lanes,
    jj: Lanes,
    w: Lanes,
    iw: Lanes,
    jw: Lanes,
}

impl Moments {
    const NONE: Self = {
        let zero = [0.0; BLOCK];
        Self { n: zero, i: zero, j: zero, ii: zero, ij: zero, jj: zero, w: zero, iw: zero, jw: zero }
    };

    /// Takes over the lanes for which `take` says so.
    #[inline(always)]
    fn select(&mut self, from: &Self, take: &[bool; BLOCK]) {
        choose(&mut self.n, &from.n, take);
        choose(&mut self.i, &from.i, take);
        choose(&mut self.j, &from.j, take);
        choose(&mut self.ii, &from.ii, take);
        choose(&mut self.ij, &from.ij, take);
        choose(&mut self.jj, &from.jj, take);
        choose(&mut self.w, &from.w, take);
        choose(&mut self.iw, &from.iw, take);
        choose(&mut self.jw, &from.jw, take);
    }
}

#[inline(always)]
fn choose(own: &mut Lanes, other: &Lanes, take: &[bool; BLOCK]) {
    let mut chosen = *own;
    for l in 0..BLOCK {
        let (own, other) = (own[l], other[l]);
        chosen[l] = if take[l] { other } else { own };
    }
    *own = chosen;
}

/// Lanes of a row that begin at `from`.
#[inline(always)]
fn lanes(row: &[f32], from: usize) -> Lanes {
    let mut lanes = [0.0; BLOCK];
    lanes.copy_from_slice(&row[from..from + BLOCK]);
    lanes
}

/// Sums over the windows around the block at `x` of row `y`.
#[inline(always)]
fn gather(
    surface: &Surface<'_>,
    (x, y): (usize, usize),
    stride: usize,
    here: &Lanes,
    here_sigma: &Lanes,
) -> Moments {
    let (_, height) = surface.size();
    let mut reach = [0.0; BLOCK];
    for l in 0..BLOCK {
        reach[l] = here[l] * surface.pitch * STEEPEST * stride as f32;
    }
    let mut sums = Moments::NONE;
    for column in 0..SPAN {
        let di = column as f32 - HALF as f32;
        let from = x + MARGIN + column * stride - HALF * stride;
        let (mut n, mut w, mut jn, mut jw, mut jjn) =
            ([0.0f32; BLOCK], [0.0f32; BLOCK], [0.0f32; BLOCK], [0.0f32; BLOCK], [0.0f32; BLOCK]);
        for step in 0..SPAN {
            let Some(j) = (y + step * stride).checked_sub(HALF * stride).filter(|&j| j < height) else {
                continue;
            };
            let [row, row_sigma] = surface.row(j);
            let (values, sigmas) = (lanes(row, from), lanes(row_sigma, from));
            let dj = step as f32 - HALF as f32;
            let distance = di.abs().max(dj.abs());
            for l in 0..BLOCK {
                let rise = values[l] - here[l];
                let same = rise.abs() <= reach[l] * distance + JUMP_SIGMAS * (sigmas[l] + here_sigma[l]);
                let (m, rise) = if same { (1.0, rise) } else { (0.0, 0.0) };
                n[l] += m;
                w[l] += rise;
                jn[l] += m * dj;
                jw[l] += rise * dj;
                jjn[l] += m * dj * dj;
            }
        }
        for l in 0..BLOCK {
            sums.n[l] += n[l];
            sums.i[l] += n[l] * di;
            sums.ii[l] += n[l] * di * di;
            sums.j[l] += jn[l];
            sums.ij[l] += jn[l] * di;
            sums.jj[l] += jjn[l];
            sums.w[l] += w[l];
            sums.iw[l] += w[l] * di;
            sums.jw[l] += jw[l];
        }
    }
    sums
}

/// A plane of inverse depth for each pixel: its value there, and its rise per px along x and y.
struct Planes {
    found: [bool; BLOCK],
    value: Wide,
    along_x: Wide,
    along_y: Wide,
}

/// Fits planes; those whose samples do not span one are not found.
#[inline(always)]
fn fit(sums: &Moments, here: &Lanes, stride: &[u8; BLOCK]) -> Planes {
    let mut planes =
        Planes { found: [false; BLOCK], value: [0.0; BLOCK], along_x: [0.0; BLOCK], along_y: [0.0; BLOCK] };
    for l in 0..BLOCK {
        let per = 1.0 / f64::from(sums.n[l]);
        let (mi, mj, mw) =
            (f64::from(sums.i[l]) * per, f64::from(sums.j[l]) * per, f64::from(sums.w[l]) * per);
        let ii = f64::from(sums.ii[l]) * per - mi * mi;
        let ij = f64::from(sums.ij[l]) * per - mi * mj;
        let jj = f64::from(sums.jj[l]) * per - mj * mj;
        let (iw, jw) = (f64::from(sums.iw[l]) * per - mi * mw, f64::from(sums.jw[l]) * per - mj * mw);
        let determinant = ii * jj - ij * ij;
        let mean = 0.5 * (ii + jj);
        // Samples nearly on a line fix the slope along it only.
        let spans = (determinant >= 0.05 * (mean * mean)) & (determinant >= 1e-3);
        planes.found[l] = (sums.n[l] >= MIN_SAMPLES) & spans;
        let along_x = (iw * jj - jw * ij) / determinant;
        let along_y = (jw * ii - iw * ij) / determinant;
        planes.value[l] = f64::from(here[l]) + (mw - along_x * mi - along_y * mj);
        planes.along_x[l] = along_x / f64::from(stride[l]);
        planes.along_y[l] = along_y / f64::from(stride[l]);
    }
    planes
}

/// Directions of the pixels of a block and their differences per px along x and y, by coordinate.
struct Rays {
    centre: [Wide; 2],
    along_x: [Wide; 2],
    along_y: [Wide; 2],
}

#[inline(always)]
fn rays(surface: &Surface<'_>, x: usize, y: usize, pixels: usize) -> Rays {
    let (width, height) = surface.size();
    let directions = surface.rays.directions();
    let (y0, y1) = (y.saturating_sub(1), (y + 1).min(height - 1));
    let (above, here, below) = (directions.row(y0), directions.row(y), directions.row(y1));
    let per_y = 1.0 / (y1 - y0) as f64;
    let none = [[0.0; BLOCK]; 2];
    let mut rays = Rays { centre: none, along_x: none, along_y: none };
    for l in 0..pixels {
        let at = x + l;
        let (x0, x1) = (at.saturating_sub(1), (at + 1).min(width - 1));
        let per_x = 1.0 / (x1 - x0) as f64;
        for axis in 0..2 {
            rays.centre[axis][l] = here[at][axis];
            rays.along_x[axis][l] = (here[x1][axis] - here[x0][axis]) * per_x;
            rays.along_y[axis][l] = (below[at][axis] - above[at][axis]) * per_y;
        }
    }
    rays
}

/// Normals of the planes, (0, 0, 0) where there is none.
#[inline(always)]
fn orient(planes: &Planes, rays: &Rays) -> [Lanes; 3] {
    let mut normals = [[0.0; BLOCK]; 3];
    for l in 0..BLOCK {
        let [xx, xy] = [rays.along_x[0][l], rays.along_x[1][l]];
        let [yx, yy] = [rays.along_y[0][l], rays.along_y[1][l]];
        let (slope_x, slope_y, value) = (planes.along_x[l], planes.along_y[l], planes.value[l]);
        let determinant = xx * yy - xy * yx;
        let a = (slope_x * yy - slope_y * xy) / determinant;
        let b = (slope_y * xx - slope_x * yx) / determinant;
        let c = value - a * rays.centre[0][l] - b * rays.centre[1][l];
        let norm = (a * a + b * b + c * c).sqrt();
        // The inverse depth is (a, b, c) . d > 0, so the opposite direction faces the camera.
        let faces = planes.found[l] & (value > 0.0) & norm.is_finite() & (norm > 0.0);
        let keep = |v: f64| if faces { -(v / norm) as f32 } else { 0.0 };
        normals[0][l] = keep(a);
        normals[1][l] = keep(b);
        normals[2][l] = keep(c);
    }
    normals
}

/// The normals of one row.
struct RowNormals<'a> {
    surface: &'a Surface<'a>,
    y: usize,
    row: &'a mut [[f32; 3]],
}

impl Work for RowNormals<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { surface, y, row } = self;
        let [inverse_depth, sigma] = surface.row(y);
        for (block, out) in row.chunks_mut(BLOCK).enumerate() {
            let x = block * BLOCK;
            let (here, here_sigma) = (lanes(inverse_depth, x + MARGIN), lanes(sigma, x + MARGIN));
            let stride = strides(surface, &here, &here_sigma);
            let mut sums = Moments::NONE;
            for one in 1..=MAX_STRIDE {
                let take = stride.map(|stride| stride == one);
                if take.contains(&true) {
                    sums.select(&gather(surface, (x, y), usize::from(one), &here, &here_sigma), &take);
                }
            }
            if stride == [0; BLOCK] {
                continue;
            }
            let planes = fit(&sums, &here, &stride);
            let [nx, ny, nz] = orient(&planes, &rays(surface, x, y, out.len()));
            for (l, normal) in out.iter_mut().enumerate() {
                *normal = [nx[l], ny[l], nz[l]];
            }
        }
    }
}
