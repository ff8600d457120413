//! The organised cloud thinned to what a picture can show.

use rayon::prelude::*;

use super::Vector;
use crate::grid::Grid;

/// Pairs of neighbours that the step between them is estimated from, at most.
const SAMPLES: usize = 200_000;

/// Share of the points beyond the box at each of its sides.
const TAIL: f64 = 0.001;

/// Half the side of the window that normals are smoothed over, in vertices.
const SMOOTHING: isize = 3;

/// Vertices in rows and columns; NaN where there is none.
#[derive(Debug, Clone)]
pub(super) struct Mesh {
    pub points: Grid<Vector>,
    /// Towards the eye of the camera; 0 where there is none.
    pub normals: Grid<Vector>,
    /// Largest difference of depth between neighbours of one surface, in mm.
    pub jump_mm: f32,
}

pub(super) fn is_there(point: Vector) -> bool {
    point.iter().all(|value| value.is_finite())
}

impl Mesh {
    /// Thins `cloud` to at most about `columns` vertices a row, each the mean of its block's points of one surface.
    pub fn new(cloud: &Grid<Vector>, columns: usize) -> Self {
        let block = cloud.width().max(cloud.height()).div_ceil(columns.max(1)).max(1);
        let (step_mm, spacing_mm) = steps(cloud);
        let jump_mm = (12.0 * step_mm).max(3.0 * spacing_mm * block as f32);
        let (width, height) = (cloud.width().div_ceil(block), cloud.height().div_ceil(block));
        let points: Vec<Vector> = (0..width * height)
            .into_par_iter()
            .map(|index| mean(cloud, (index % width * block, index / width * block), block, jump_mm))
            .collect();
        let points = Grid::from_vec(width, height, points);
        let normals = normals(&points, jump_mm);
        Self { points, normals, jump_mm }
    }

    /// Corners of a box around all but a few stray points.
    pub fn bounds(&self) -> Option<(Vector, Vector)> {
        let there: Vec<Vector> =
            self.points.data().iter().copied().filter(|&point| is_there(point)).collect();
        let last = there.len().checked_sub(1)?;
        let cut = (last as f64 * TAIL) as usize;
        let (mut low, mut high) = ([0.0; 3], [0.0; 3]);
        for axis in 0..3 {
            let mut values: Vec<f32> = there.iter().map(|point| point[axis]).collect();
            low[axis] = *values.select_nth_unstable_by(cut, f32::total_cmp).1;
            high[axis] = *values.select_nth_unstable_by(last - cut, f32::total_cmp).1;
            // A margin keeps flat scenes apart from no scene.
            let margin = (0.02 * (high[axis] - low[axis])).max(0.5);
            low[axis] -= margin;
            high[axis] += margin;
        }
        Some((low, high))
    }
}

/// Medians over neighbours in a row: difference of depth, and distance across, in mm.
fn steps(cloud: &Grid<Vector>) -> (f32, f32) {
    let stride = (cloud.len() / SAMPLES).max(1);
    let pairs =
        || cloud.data().windows(2).step_by(stride).filter(|pair| is_there(pair[0]) && is_there(pair[1]));
    let median = |mut values: Vec<f32>| match values.len() {
        0 => 0.0,
        count => *values.select_nth_unstable_by(count / 2, f32::total_cmp).1,
    };
    let depth = median(pairs().map(|pair| (pair[1][2] - pair[0][2]).abs()).collect());
    let across =
        median(pairs().map(|pair| (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1])).collect());
    (depth, across)
}

/// Mean of the points of a block that lie near its median depth.
fn mean(cloud: &Grid<Vector>, (x, y): (usize, usize), block: usize, jump_mm: f32) -> Vector {
    let (right, bottom) = ((x + block).min(cloud.width()), (y + block).min(cloud.height()));
    let points =
        || (y..bottom).flat_map(|row| &cloud.row(row)[x..right]).copied().filter(|&point| is_there(point));
    let mut depths: Vec<f32> = points().map(|point| point[2]).collect();
    if depths.is_empty() {
        return [f32::NAN; 3];
    }
    let middle = depths.len() / 2;
    let median = *depths.select_nth_unstable_by(middle, f32::total_cmp).1;
    let (mut sum, mut count) = ([0.0f64; 3], 0.0);
    for point in points().filter(|point| (point[2] - median).abs() <= jump_mm) {
        for (sum, value) in sum.iter_mut().zip(point) {
            *sum += f64::from(value);
        }
        count += 1.0;
    }
    sum.map(|sum| (sum / count) as f32)
}

/// Normals of planes through the neighbourhood of each vertex, so that noise does not sparkle.
fn normals(points: &Grid<Vector>, jump_mm: f32) -> Grid<Vector> {
    let (width, height) = (points.width(), points.height());
    let normal = |index: usize| {
        let center = points.data()[index];
        if !is_there(center) {
            return [0.0; 3];
        }
        let (x, y) = ((index % width) as isize, (index / width) as isize);
        // Least squares of z over x and y, about the vertex.
        let mut sums = [0.0f64; 9];
        for row in (y - SMOOTHING).max(0)..=(y + SMOOTHING).min(height as isize - 1) {
            for column in (x - SMOOTHING).max(0)..=(x + SMOOTHING).min(width as isize - 1) {
                let point = points.at(column as usize, row as usize);
                if is_there(point) && (point[2] - center[2]).abs() <= jump_mm * (1 + SMOOTHING) as f32 {
                    let [x, y, z]: [f64; 3] =
                        std::array::from_fn(|axis| f64::from(point[axis] - center[axis]));
                    for (sum, term) in sums.iter_mut().zip([1.0, x, y, z, x * x, x * y, y * y, x * z, y * z])
                    {
                        *sum += term;
                    }
                }
            }
        }
        let [n, x, y, z, xx, xy, yy, xz, yz] = sums;
        let (xx, xy, yy) = (xx - x * x / n, xy - x * y / n, yy - y * y / n);
        let (xz, yz) = (xz - x * z / n, yz - y * z / n);
        let determinant = xx * yy - xy * xy;
        if determinant <= 1e-9 * (xx + yy).powi(2) {
            return [0.0, 0.0, -1.0];
        }
        let slope = [(xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant];
        let length = (slope[0].powi(2) + slope[1].powi(2) + 1.0).sqrt();
        [slope[0] / length, slope[1] / length, -1.0 / length].map(|value| value as f32)
    };
    Grid::from_vec(width, height, (0..width * height).into_par_iter().map(normal).collect())
}
