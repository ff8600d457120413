//! What neighbours on the pixel grid say of the surface: where it breaks, and where it faces.
//!
//! All in inverse depth `w = 1/z`: a plane `n . X = c` seen along `d = (X, Y, 1)` has `w = (n . d) / c`, exactly
//! affine in the normalised coordinates, so that a linear fit of `w` over a window gives an unbiased normal.

use rayon::prelude::*;

use crate::{geometry::RayTable, grid::Grid};

/// Neighbours belong to one surface up to this many sigma of each (5 of the difference, where both are equal).
const JUMP_SIGMAS: f32 = 3.5;
/// ... plus the depth that a surface seen at 75 degrees rises between them.
const STEEPEST: f32 = 3.732;
/// A window has (2 * HALF + 1)^2 samples, 1 to 3 pixels apart.
const HALF: i32 = 3;
/// Root of the sum of squared offsets over a full window: noise of a slope is sigma over this many pitches.
const WINDOW_GAIN: f32 = 14.0;
/// Slope noise that windows are widened for, in radians.
const WANTED_SLOPE_SIGMA: f32 = 0.03;
/// Fewer samples make no normal.
const MIN_SAMPLES: f32 = 6.0;

/// Inverse depths of a cloud and their noise; NaN where there is no point.
pub(super) struct Surface<'a> {
    inverse_depth: Grid<f32>,
    sigma: Grid<f32>,
    rays: &'a RayTable,
    /// Angle between neighbouring pixels in radians, in the middle of the image.
    pitch: f32,
}

impl<'a> Surface<'a> {
    pub(super) fn new(point_mm: &Grid<[f32; 3]>, sigma_z_mm: &Grid<f32>, rays: &'a RayTable) -> Self {
        let (width, height) = (point_mm.width(), point_mm.height());
        let directions = rays.directions();
        let middle = directions.at(width / 2, height / 2);
        let beside = directions.at((width / 2).saturating_sub(1), (height / 2).saturating_sub(1));
        let pitch = ((middle[0] - beside[0]).abs().max((middle[1] - beside[1]).abs())).max(f64::MIN_POSITIVE);
        let sigma = point_mm
            .data()
            .iter()
            .zip(sigma_z_mm.data())
            .map(|(point, sigma)| sigma / (point[2] * point[2]))
            .collect();
        Self {
            inverse_depth: point_mm.map(|point| 1.0 / point[2]),
            sigma: Grid::from_vec(width, height, sigma),
            rays,
            pitch: pitch as f32,
        }
    }

    fn size(&self) -> (usize, usize) {
        (self.inverse_depth.width(), self.inverse_depth.height())
    }

    /// Whether two pixels `distance` px apart lie on one surface. False where either has no point.
    #[inline]
    fn connected(&self, a: usize, b: usize, distance: f32) -> bool {
        let (w, sigma) = (self.inverse_depth.data(), self.sigma.data());
        (w[a] - w[b]).abs() <= w[a] * self.pitch * STEEPEST * distance + JUMP_SIGMAS * (sigma[a] + sigma[b])
    }
}

/// Points within 2 px of a depth jump or of the border of the mask. The image's own border is none.
pub(super) fn silhouettes(surface: &Surface<'_>) -> Grid<bool> {
    let (width, height) = surface.size();
    let mut border = Grid::filled(width, height, false);
    border.data_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, border) in row.iter_mut().enumerate() {
            let centre = y * width + x;
            *border = surface.inverse_depth.data()[centre].is_finite()
                && neighbours(x, y, width, height).any(|other| !surface.connected(centre, other, 1.5));
        }
    });
    let mut near = Grid::filled(width, height, false);
    near.data_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        // Rows above and below are or-ed first, so that each pixel looks at three values instead of nine.
        let mut column: Vec<bool> = border.row(y).to_vec();
        for other in [y.checked_sub(1), Some(y + 1).filter(|&below| below < height)].into_iter().flatten() {
            column.iter_mut().zip(border.row(other)).for_each(|(near, border)| *near |= border);
        }
        for (x, near) in row.iter_mut().enumerate() {
            let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
            *near =
                (column[left] || column[x] || column[right]) && surface.inverse_depth.at(x, y).is_finite();
        }
    });
    near
}

/// Indices of the up to eight neighbours inside the image.
fn neighbours(x: usize, y: usize, width: usize, height: usize) -> impl Iterator<Item = usize> {
    let (x0, x1) = (x.saturating_sub(1), (x + 1).min(width - 1));
    let (y0, y1) = (y.saturating_sub(1), (y + 1).min(height - 1));
    (y0..=y1)
        .flat_map(move |j| (x0..=x1).map(move |i| (i, j)))
        .filter(move |&at| at != (x, y))
        .map(move |(i, j)| j * width + i)
}

/// Unit normals towards the camera, (0, 0, 0) where the neighbours do not make one.
pub(super) fn normals(surface: &Surface<'_>) -> Grid<[f32; 3]> {
    let (width, height) = surface.size();
    let mut normals = Grid::filled(width, height, [0.0; 3]);
    normals.data_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, normal) in row.iter_mut().enumerate() {
            if let Some(found) = normal_at(surface, x, y) {
                *normal = found;
            }
        }
    });
    normals
}

/// Sums of a linear fit of inverse depth over pixel offsets.
#[derive(Default)]
struct Moments {
    n: f32,
    i: f32,
    j: f32,
    ii: f32,
    ij: f32,
    jj: f32,
    w: f32,
    iw: f32,
    jw: f32,
}

impl Moments {
    /// Value at the centre and slopes per pixel along x and y. `None` when the samples do not span a plane.
    fn fit(&self) -> Option<[f64; 3]> {
        if self.n < MIN_SAMPLES {
            return None;
        }
        let per = 1.0 / f64::from(self.n);
        let (mi, mj, mw) = (f64::from(self.i) * per, f64::from(self.j) * per, f64::from(self.w) * per);
        let ii = f64::from(self.ii) * per - mi * mi;
        let ij = f64::from(self.ij) * per - mi * mj;
        let jj = f64::from(self.jj) * per - mj * mj;
        let (iw, jw) = (f64::from(self.iw) * per - mi * mw, f64::from(self.jw) * per - mj * mw);
        let determinant = ii * jj - ij * ij;
        // Samples nearly on a line fix the slope along it only.
        if determinant < 0.05 * (0.5 * (ii + jj)).powi(2) || determinant < 1e-3 {
            return None;
        }
        let along_x = (iw * jj - jw * ij) / determinant;
        let along_y = (jw * ii - iw * ij) / determinant;
        Some([mw - along_x * mi - along_y * mj, along_x, along_y])
    }
}

/// Samples of one row of a window, one lane per column and one to spare: lanes are what the compiler vectorises.
const LANES: usize = 8;

/// Sums over the samples of the window around (x, y) that lie on its surface.
fn gather(surface: &Surface<'_>, x: usize, y: usize, stride: usize) -> Moments {
    let (width, height) = surface.size();
    let (half, span) = (HALF as usize, 2 * HALF as usize + 1);
    let (here, here_sigma) = (surface.inverse_depth.at(x, y), surface.sigma.at(x, y));
    let reach = here * surface.pitch * STEEPEST * stride as f32;
    let offset = |lane: usize| lane as f32 - HALF as f32;
    let (mut n, mut w, mut jn, mut jw, mut jjn) =
        ([0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES]);
    let inside = x >= half * stride && x + half * stride < width;
    for step in 0..span {
        let Some(j) = (y + step * stride).checked_sub(half * stride).filter(|&j| j < height) else {
            continue;
        };
        let (row, row_sigma) = (surface.inverse_depth.row(j), surface.sigma.row(j));
        // Lanes outside the image hold NaN, which no comparison accepts.
        let (mut values, mut sigmas) = ([f32::NAN; LANES], [f32::NAN; LANES]);
        if inside {
            let from = x - half * stride;
            for (value, found) in values[..span].iter_mut().zip(row[from..].iter().step_by(stride)) {
                *value = *found;
            }
            for (sigma, found) in sigmas[..span].iter_mut().zip(row_sigma[from..].iter().step_by(stride)) {
                *sigma = *found;
            }
        } else {
            for lane in 0..span {
                let i = (x + lane * stride).checked_sub(half * stride).filter(|&i| i < width);
                if let Some(i) = i {
                    (values[lane], sigmas[lane]) = (row[i], row_sigma[i]);
                }
            }
        }
        let dj = offset(step);
        for lane in 0..LANES {
            let distance = offset(lane).abs().max(dj.abs());
            let rise = values[lane] - here;
            let same = rise.abs() <= reach * distance + JUMP_SIGMAS * (sigmas[lane] + here_sigma);
            let (m, rise) = if same { (1.0, rise) } else { (0.0, 0.0) };
            n[lane] += m;
            w[lane] += rise;
            jn[lane] += m * dj;
            jw[lane] += rise * dj;
            jjn[lane] += m * dj * dj;
        }
    }
    let mut sums = Moments::default();
    for lane in 0..LANES {
        let di = offset(lane);
        sums.n += n[lane];
        sums.i += n[lane] * di;
        sums.ii += n[lane] * di * di;
        sums.j += jn[lane];
        sums.ij += jn[lane] * di;
        sums.jj += jjn[lane];
        sums.w += w[lane];
        sums.iw += w[lane] * di;
        sums.jw += jw[lane];
    }
    sums
}

fn normal_at(surface: &Surface<'_>, x: usize, y: usize) -> Option<[f32; 3]> {
    let here = surface.inverse_depth.at(x, y);
    if !here.is_finite() {
        return None;
    }
    // Slope noise of a window of stride 1 is sigma_z / (z * pitch * gain) = sigma_w / (w * pitch * gain).
    let noise = surface.sigma.at(x, y) / (here * surface.pitch * WINDOW_GAIN);
    let stride = if noise <= WANTED_SLOPE_SIGMA {
        1
    } else if noise <= 2.0 * WANTED_SLOPE_SIGMA {
        2
    } else {
        3
    };
    let sums = gather(surface, x, y, stride as usize);
    let [rise, per_i, per_j] = sums.fit()?;
    let stride = f64::from(stride);
    orient(surface, x, y, f64::from(here) + rise, [per_i / stride, per_j / stride])
}

/// Normal of the plane whose inverse depth is `value` at the pixel and rises by `slope` per pixel along x and y.
fn orient(surface: &Surface<'_>, x: usize, y: usize, value: f64, slope: [f64; 2]) -> Option<[f32; 3]> {
    let (width, height) = surface.size();
    let rays = surface.rays.directions();
    let (x0, x1) = (x.saturating_sub(1), (x + 1).min(width - 1));
    let (y0, y1) = (y.saturating_sub(1), (y + 1).min(height - 1));
    let difference = |a: [f64; 2], b: [f64; 2], pixels: usize| {
        let per = 1.0 / pixels as f64;
        [(b[0] - a[0]) * per, (b[1] - a[1]) * per]
    };
    // Columns of the local map from pixel offsets to normalised coordinates.
    let along_x = difference(rays.at(x0, y), rays.at(x1, y), x1 - x0);
    let along_y = difference(rays.at(x, y0), rays.at(x, y1), y1 - y0);
    let determinant = along_x[0] * along_y[1] - along_x[1] * along_y[0];
    let a = (slope[0] * along_y[1] - slope[1] * along_x[1]) / determinant;
    let b = (slope[1] * along_x[0] - slope[0] * along_y[0]) / determinant;
    let centre = rays.at(x, y);
    let c = value - a * centre[0] - b * centre[1];
    let norm = (a * a + b * b + c * c).sqrt();
    // The inverse depth is (a, b, c) . d > 0, so the opposite direction faces the camera.
    (value > 0.0 && norm.is_finite() && norm > 0.0)
        .then(|| [-(a / norm) as f32, -(b / norm) as f32, -(c / norm) as f32])
}
