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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::fixtures::rig;

    #[test]
    fn each_ray_projects_back_to_its_pixel() {
        let lens = rig(16.0).camera;
        let table = RayTable::new(&lens);
        for y in 0..lens.height as usize {
            for x in 0..lens.width as usize {
                let [dx, dy] = table.directions().at(x, y);
                let [u, v] = lens.project(&nalgebra::Vector3::new(dx, dy, 1.0)).unwrap();
                assert!((u - x as f64).abs() < 1e-9 && (v - y as f64).abs() < 1e-9);
            }
        }
    }
}
