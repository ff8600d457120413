//! The same, pixel by pixel: what the fast loops are tested against.

use super::*;

/// Sums of a linear fit of inverse depth over offsets in strides.
#[derive(Default)]
struct Sums {
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

impl Sums {
    /// Value at the centre and slopes per stride along x and y. `None` when the samples do not span a plane.
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
        if determinant < 0.05 * (0.5 * (ii + jj)).powi(2) || determinant < 1e-3 {
            return None;
        }
        let along_x = (iw * jj - jw * ij) / determinant;
        let along_y = (jw * ii - iw * ij) / determinant;
        Some([mw - along_x * mi - along_y * mj, along_x, along_y])
    }
}

/// Inverse depth and sigma at a pixel that may lie beside the image.
fn at(surface: &Surface<'_>, x: i64, y: i64) -> (f32, f32) {
    let (width, height) = surface.size();
    if !(0..width as i64).contains(&x) || !(0..height as i64).contains(&y) {
        return (f32::NAN, f32::NAN);
    }
    let [w, sigma] = surface.row(y as usize);
    (w[x as usize + MARGIN], sigma[x as usize + MARGIN])
}

/// Normal at (x, y).
pub(super) fn normal_at(surface: &Surface<'_>, x: usize, y: usize) -> Option<[f32; 3]> {
    let (here, here_sigma) = at(surface, x as i64, y as i64);
    if !here.is_finite() {
        return None;
    }
    let noise = here_sigma / (here * surface.pitch * WINDOW_GAIN);
    let stride: i64 = if noise <= WANTED_SLOPE_SIGMA {
        1
    } else if noise <= 2.0 * WANTED_SLOPE_SIGMA {
        2
    } else {
        3
    };
    let half = HALF as i64;
    let mut sums = Sums::default();
    for di in -half..=half {
        // Each column of the window by itself: sums of f32 depend on their order.
        let (mut n, mut w, mut jn, mut jw, mut jjn) = (0.0, 0.0, 0.0, 0.0, 0.0);
        for dj in -half..=half {
            let (value, sigma) = at(surface, x as i64 + di * stride, y as i64 + dj * stride);
            let distance = di.abs().max(dj.abs()) as f32;
            let rise = value - here;
            let reach = here * surface.pitch * STEEPEST * stride as f32;
            if rise.abs() <= reach * distance + JUMP_SIGMAS * (sigma + here_sigma) {
                let dj = dj as f32;
                n += 1.0;
                w += rise;
                jn += dj;
                jw += rise * dj;
                jjn += dj * dj;
            }
        }
        let di = di as f32;
        sums.n += n;
        sums.i += n * di;
        sums.ii += n * di * di;
        sums.j += jn;
        sums.ij += jn * di;
        sums.jj += jjn;
        sums.w += w;
        sums.iw += w * di;
        sums.jw += jw;
    }
    let [rise, per_i, per_j] = sums.fit()?;
    let stride = stride as f64;
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
    (value > 0.0 && norm.is_finite() && norm > 0.0)
        .then(|| [-(a / norm) as f32, -(b / norm) as f32, -(c / norm) as f32])
}
