//! Corners to a part of a pixel, with the standard deviation of each, and how sharp edges are.

use nalgebra::Matrix2;

use super::picture::Picture;

/// A corner to a part of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Refined {
    pub(super) at: [f64; 2],
    /// Standard deviation along the worse direction that the picture's noise causes, in px.
    pub(super) sigma_px: f64,
    /// How far edges miss the point, in px, weighted by their gradients. Their width makes it some tenths; where
    /// something else reaches into the window it is more.
    pub(super) misfit_px: f64,
    /// What of the window changes by half a turn about the point, as a share of what does not. Squares that meet look the
    /// same after half a turn, what hides some of them does not.
    pub(super) lopsided: f64,
}

/// Steps of the iteration at most.
const STEPS: usize = 20;
/// It ends where a step is shorter than this, in px.
const STILL: f64 = 1e-4;

/// The point that all gradients in a window of half-width `reach` px stand across to: every vector from it to a pixel of
/// an edge is orthogonal to the gradient there (Förstner and Gülch 1987). `None` where it leaves the window or the
/// gradients do not fix a point.
pub(super) fn refine(picture: &Picture, from: [f64; 2], reach: f64, noise: f64) -> Option<Refined> {
    let mut at = from;
    for _ in 0..STEPS {
        let refined = step(picture, at, reach, noise)?;
        let moved_to = refined.at;
        let moved = (moved_to[0] - at[0]).hypot(moved_to[1] - at[1]);
        at = moved_to;
        if (at[0] - from[0]).hypot(at[1] - from[1]) > 0.6 * reach {
            return None;
        }
        if moved < STILL {
            return Some(refined);
        }
    }
    None
}

fn step(picture: &Picture, at: [f64; 2], reach: f64, noise: f64) -> Option<Refined> {
    if !picture.holds(at, reach + 1.0) {
        return None;
    }
    let side = reach.ceil() as i64;
    let mut cells = Vec::with_capacity(((2 * side + 1) * (2 * side + 1)) as usize);
    for (v, u) in (-side..=side).flat_map(|v| (-side..=side).map(move |u| (v as f64, u as f64))) {
        let here = [at[0] + u, at[1] + v];
        let difference = |dx: f64, dy: f64| {
            0.5 * (picture.sample([here[0] + dx, here[1] + dy])
                - picture.sample([here[0] - dx, here[1] - dy]))
        };
        let weight = (-(u * u + v * v) / (reach * reach)).exp();
        cells.push(([difference(1.0, 0.0), difference(0.0, 1.0)], [u, v], weight));
    }
    let (mut xx, mut xy, mut yy, mut bx, mut by) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for &([gx, gy], [u, v], weight) in &cells {
        xx += weight * gx * gx;
        xy += weight * gx * gy;
        yy += weight * gy * gy;
        bx += weight * gx * (gx * u + gy * v);
        by += weight * gy * (gx * u + gy * v);
    }
    let determinant = xx * yy - xy * xy;
    // Gradients of one direction, as along a lone edge, fix no point.
    if determinant.is_nan() || determinant <= 1e-3 * (xx + yy).powi(2) {
        return None;
    }
    let move_by = [(yy * bx - xy * by) / determinant, (xx * by - xy * bx) / determinant];
    // Noise of a difference of two pixels through the solution: each gradient errs, times how far it is from the point.
    let variance = 0.5 * noise * noise;
    let (mut sum_xx, mut sum_xy, mut sum_yy, mut misfit) = (0.0, 0.0, 0.0, 0.0);
    for &([gx, gy], [u, v], weight) in &cells {
        let [dx, dy] = [u - move_by[0], v - move_by[1]];
        let miss = gx * dx + gy * dy;
        misfit += weight * miss * miss;
        let (plain, along) = (weight * weight * variance * miss * miss, dx * dx + dy * dy);
        let along = weight * weight * variance * along;
        sum_xx += plain + along * gx * gx;
        sum_xy += along * gx * gy;
        sum_yy += plain + along * gy * gy;
    }
    let inverse = Matrix2::new(yy, -xy, -xy, xx) / determinant;
    let covariance = inverse * Matrix2::new(sum_xx, sum_xy, sum_xy, sum_yy) * inverse;
    let worse = covariance.symmetric_eigenvalues().max().max(0.0);
    Some(Refined {
        at: [at[0] + move_by[0], at[1] + move_by[1]],
        sigma_px: worse.sqrt(),
        misfit_px: (misfit / (xx + yy)).sqrt(),
        lopsided: lopsided(picture, at, side),
    })
}

/// Odd part of the square of half-width `side` about a place, over its even part.
fn lopsided(picture: &Picture, at: [f64; 2], side: i64) -> f64 {
    let places = (-side..=side).flat_map(|v| (-side..=side).map(move |u| (u as f64, v as f64)));
    let pairs: Vec<(f64, f64)> = places
        .map(|(u, v)| {
            let here = picture.sample([at[0] + u, at[1] + v]);
            let opposite = picture.sample([at[0] - u, at[1] - v]);
            (here - opposite, here + opposite)
        })
        .collect();
    let mean = pairs.iter().map(|(_, sum)| sum).sum::<f64>() / pairs.len() as f64;
    let odd: f64 = pairs.iter().map(|(difference, _)| difference * difference).sum();
    let even: f64 = pairs.iter().map(|(_, sum)| (sum - mean).powi(2)).sum();
    (odd / even).sqrt()
}

/// Standard deviation of a picture's noise, from how neighbours differ (Immerkaer 1996), by the median: edges are few.
/// At least that of rounding to whole numbers.
pub(super) fn noise(picture: &Picture) -> f64 {
    let (width, height) = (picture.width(), picture.height());
    let mut found = Vec::new();
    for y in (1..height.saturating_sub(1)).step_by(3) {
        for x in (1..width.saturating_sub(1)).step_by(3) {
            let at = |dx: usize, dy: usize| f64::from(picture.at(x + dx - 1, y + dy - 1));
            let corners = at(0, 0) + at(2, 0) + at(0, 2) + at(2, 2);
            let sides = at(1, 0) + at(0, 1) + at(2, 1) + at(1, 2);
            found.push((corners - 2.0 * sides + 4.0 * at(1, 1)).abs());
        }
    }
    found.sort_by(f64::total_cmp);
    let median = found.get(found.len() / 2).copied().unwrap_or(0.0);
    // The mask's weights have squares that add up to 36.
    (1.4826 * median / 6.0).max(1.0 / 12f64.sqrt())
}

/// Width of the edge between two corners in px: its contrast over its steepest slope, which is 2.5 standard deviations of
/// a Gaussian blur. `None` where it is no edge.
pub(super) fn edge_width(picture: &Picture, from: [f64; 2], to: [f64; 2]) -> Option<f64> {
    let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
    let length = dx.hypot(dy);
    let across = [-dy / length, dx / length];
    let reach = (0.35 * length).min(20.0);
    let count = (4.0 * reach) as i64;
    // A few places along the edge, aside of its middle where a neighbour's blur meets least.
    let profile: Vec<f64> = (-count..=count)
        .map(|at| {
            let away = 0.25 * at as f64;
            let value = |share: f64| {
                picture.sample([
                    from[0] + share * dx + away * across[0],
                    from[1] + share * dy + away * across[1],
                ])
            };
            [0.4, 0.45, 0.5, 0.55, 0.6].map(value).iter().sum::<f64>() / 5.0
        })
        .collect();
    let (low, high) = profile.iter().fold((f64::MAX, f64::MIN), |(low, high), &v| (low.min(v), high.max(v)));
    let steepest = profile.windows(5).map(|five| (five[4] - five[0]).abs()).fold(0.0, f64::max);
    (steepest > 0.0).then(|| (high - low) / steepest)
}
