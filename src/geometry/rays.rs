//! The direction of every pixel of a lens, computed once per calibration.

use rayon::prelude::*;

use super::Lens;
use crate::grid::Grid;

/// Undistorted normalised coordinates of every pixel: pixel (x, y) looks along `(X, Y, 1)`.
#[derive(Debug, Clone, PartialEq)]
pub struct RayTable {
    directions: Grid<[f64; 2]>,
}

impl RayTable {
    /// Undistorts all pixel centres of `lens`. Rows are independent: equal on any number of threads.
    /// A pixel whose distortion has no inverse gets NaN; a lens without [faults](Lens::faults) has none.
    pub fn new(lens: &Lens) -> Self {
        let (width, height) = (lens.width as usize, lens.height as usize);
        let mut data = vec![[f64::NAN; 2]; width * height];
        data.par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
            for (x, ray) in row.iter_mut().enumerate() {
                if let Some(direction) = lens.ray([x as f64, y as f64]) {
                    *ray = [direction.x, direction.y];
                }
            }
        });
        Self { directions: Grid::from_vec(width, height, data) }
    }

    /// All directions, row-major.
    pub fn directions(&self) -> &Grid<[f64; 2]> {
        &self.directions
    }
}
