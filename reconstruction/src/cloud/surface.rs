//! What neighbours on the pixel grid say of the surface: which of them lie on one, and where it breaks.
//!
//! All in inverse depth `w = 1/z`: a plane `n . X = c` seen along `d = (X, Y, 1)` has `w = (n . d) / c`, exactly
//! affine in the normalised coordinates.

use rayon::prelude::*;

use crate::{
    geometry::RayTable,
    grid::Grid,
    simd::{InstructionSet, Work},
};

/// Neighbours belong to one surface up to this many sigma of each (5 of the difference, where both are equal).
pub(super) const JUMP_SIGMAS: f32 = 3.5;
/// ... plus the depth that a surface seen at 75 degrees rises between them.
pub(super) const STEEPEST: f32 = 3.732;
/// Columns without a point beside the image, so that windows need not ask where it ends: what the widest one reaches,
/// and on the right what is left of a block.
pub(super) const MARGIN: usize = 9;
/// Pixels that are looked at together.
pub(super) const BLOCK: usize = 16;
/// Distance in px that neighbours, those across corners too, count as.
const NEIGHBOUR: f32 = 1.5;

/// Inverse depths of a cloud and their noise; NaN where there is no point.
pub(super) struct Surface<'a> {
    width: usize,
    height: usize,
    inverse_depth: Vec<f32>,
    sigma: Vec<f32>,
    pub rays: &'a RayTable,
    /// Angle between neighbouring pixels in radians, in the middle of the image.
    pub pitch: f32,
}

impl<'a> Surface<'a> {
    pub fn new(point_mm: &Grid<[f32; 3]>, sigma_z_mm: &Grid<f32>, rays: &'a RayTable) -> Self {
        let (width, height) = (point_mm.width(), point_mm.height());
        let directions = rays.directions();
        let middle = directions.at(width / 2, height / 2);
        let beside = directions.at((width / 2).saturating_sub(1), (height / 2).saturating_sub(1));
        let pitch = ((middle[0] - beside[0]).abs().max((middle[1] - beside[1]).abs())).max(f64::MIN_POSITIVE);
        let stride = stride(width);
        let (mut inverse_depth, mut sigma) =
            (vec![f32::NAN; stride * height], vec![f32::NAN; stride * height]);
        inverse_depth.par_chunks_mut(stride).zip(sigma.par_chunks_mut(stride)).enumerate().for_each(
            |(y, (inverse_depth, sigma))| {
                let points = point_mm.row(y).iter().zip(sigma_z_mm.row(y));
                let out = inverse_depth[MARGIN..].iter_mut().zip(&mut sigma[MARGIN..]);
                for ((point, sigma_z), (inverse_depth, sigma)) in points.zip(out) {
                    *inverse_depth = 1.0 / point[2];
                    *sigma = sigma_z / (point[2] * point[2]);
                }
            },
        );
        Self { width, height, inverse_depth, sigma, rays, pitch: pitch as f32 }
    }

    /// (width, height) of the image.
    pub fn size(&self) -> (usize, usize) {
        (self.width, self.height)
    }

    /// Inverse depths and their sigma of row `y` with the margins: pixel x is at `x + MARGIN`.
    #[inline(always)]
    pub fn row(&self, y: usize) -> [&[f32]; 2] {
        let row = y * stride(self.width)..(y + 1) * stride(self.width);
        [&self.inverse_depth[row.clone()], &self.sigma[row]]
    }
}

fn stride(width: usize) -> usize {
    MARGIN + width + MARGIN + BLOCK
}

/// Points within 2 px of a depth jump or of the border of the mask. The image's own border is none.
pub(super) fn silhouettes(set: InstructionSet, surface: &Surface<'_>) -> Grid<bool> {
    let (width, height) = surface.size();
    let mut border = Grid::filled(width, height, false);
    border
        .data_mut()
        .par_chunks_mut(width.max(1))
        .enumerate()
        .for_each(|(y, row)| set.run(Borders { surface, y, row }));
    let mut near = Grid::filled(width, height, false);
    near.data_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        // Rows above and below are or-ed first, so that each pixel looks at three values instead of nine.
        let mut column: Vec<bool> = border.row(y).to_vec();
        for other in [y.checked_sub(1), Some(y + 1).filter(|&below| below < height)].into_iter().flatten() {
            column.iter_mut().zip(border.row(other)).for_each(|(near, border)| *near |= border);
        }
        let [inverse_depth, _] = surface.row(y);
        for (x, near) in row.iter_mut().enumerate() {
            let (left, right) = (x.saturating_sub(1), (x + 1).min(width - 1));
            *near = (column[left] || column[x] || column[right]) && inverse_depth[x + MARGIN].is_finite();
        }
    });
    near
}

/// Finds the points of a row of which a neighbour lies on no common surface.
struct Borders<'a> {
    surface: &'a Surface<'a>,
    y: usize,
    row: &'a mut [bool],
}

impl Work for Borders<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { surface, y, row } = self;
        let (width, height) = surface.size();
        let [here, here_sigma] = surface.row(y);
        for other in
            [y.checked_sub(1), Some(y), Some(y + 1).filter(|&below| below < height)].into_iter().flatten()
        {
            let [there, there_sigma] = surface.row(other);
            for beside in [MARGIN - 1, MARGIN, MARGIN + 1] {
                // What lies beside the image is no neighbour.
                let first = usize::from(beside < MARGIN).min(width);
                let last = if beside > MARGIN { width - 1 } else { width };
                let pixels = last.saturating_sub(first);
                let row = &mut row[first..][..pixels];
                let (here, here_sigma) =
                    (&here[first + MARGIN..][..pixels], &here_sigma[first + MARGIN..][..pixels]);
                let (there, there_sigma) =
                    (&there[first + beside..][..pixels], &there_sigma[first + beside..][..pixels]);
                for x in 0..pixels {
                    let reach = here[x] * surface.pitch * STEEPEST * NEIGHBOUR;
                    let connected =
                        (here[x] - there[x]).abs() <= reach + JUMP_SIGMAS * (here_sigma[x] + there_sigma[x]);
                    row[x] |= !connected;
                }
            }
        }
        // Without a point nothing is connected, not even with itself.
        for (border, here) in row.iter_mut().zip(&here[MARGIN..]) {
            *border &= here.is_finite();
        }
    }
}
