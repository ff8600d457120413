//! Decoded maps and a calibration in, points out.

use rayon::prelude::*;
use thiserror::Error;

use super::{
    Cloud, Reconstruction, RowCheck, flag, normals,
    surface::{self, Surface},
};
use crate::{
    decode::{Class, Decoded},
    geometry::{Calibration, LANES, Lane, Measurements, Solutions, TriangulateError, Triangulator},
    grid::Grid,
    simd::{InstructionSet, Work},
};

/// Row gate in projector px unless the configuration says otherwise.
pub const DEFAULT_ROW_GATE_PX: f64 = 1.5;
/// The gate never cuts into the noise that the decoder states, so that codes with missing low bits survive it.
const GATE_SIGMAS: f64 = 3.0;
/// Row statistics are taken over at most about this many pixels, evenly spread.
const STATISTICS_PIXELS: usize = 1 << 18;

/// What a reconstruction needs besides maps and calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ReconstructSettings {
    /// Nearest z of the working volume in the camera frame, in mm.
    pub near_mm: f64,
    /// Farthest z of the working volume, in mm.
    pub far_mm: f64,
    /// Largest distance of a measured row from the predicted one, in projector px.
    pub row_gate_px: f64,
}

impl ReconstructSettings {
    /// The volume with the default row gate.
    pub fn new(near_mm: f64, far_mm: f64) -> Self {
        Self { near_mm, far_mm, row_gate_px: DEFAULT_ROW_GATE_PX }
    }
}

/// Why maps cannot become a cloud.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum ReconstructError {
    /// The calibration cannot triangulate.
    #[error("cannot reconstruct")]
    Calibration(#[from] TriangulateError),
    /// Maps and calibration are of different cameras.
    #[error(
        "cannot reconstruct: the maps are {}x{} px, the calibrated camera is {}x{} px; use the calibration of this \
         region of the sensor", maps.0, maps.1, camera.0, camera.1
    )]
    Size {
        /// (width, height) of the maps.
        maps: (usize, usize),
        /// (width, height) of the calibrated camera.
        camera: (usize, usize),
    },
    /// A volume that holds nothing.
    #[error(
        "cannot reconstruct: the working volume {near_mm} to {far_mm} mm is empty; set near_mm below far_mm"
    )]
    Volume {
        /// Near end in mm.
        near_mm: f64,
        /// Far end in mm.
        far_mm: f64,
    },
    /// A gate that rejects everything, or is no number.
    #[error("cannot reconstruct: the row gate is {row_gate_px} px; set row_gate_px above 0")]
    RowGate {
        /// Gate in projector px.
        row_gate_px: f64,
    },
}

/// Reconstructs one scan. For several scans with one calibration prepare a [`Triangulator`] and use
/// [`reconstruct_with`].
///
/// # Errors
/// As [`reconstruct_with`], and for a calibration that cannot triangulate.
pub fn reconstruct(
    decoded: &Decoded,
    calibration: &Calibration,
    settings: &ReconstructSettings,
) -> Result<Reconstruction, ReconstructError> {
    reconstruct_with(&Triangulator::new(calibration)?, decoded, settings)
}

/// Triangulates every valid pixel, applies the gates of volume and row, and derives normals and flags. Rows of the
/// image are independent of each other: the result is bit-identical on any number of threads.
///
/// # Errors
/// [`ReconstructError`] for maps of another size, or settings that leave no volume or gate.
pub fn reconstruct_with(
    triangulator: &Triangulator,
    decoded: &Decoded,
    settings: &ReconstructSettings,
) -> Result<Reconstruction, ReconstructError> {
    check(triangulator, decoded, settings)?;
    let (width, height) = (decoded.class.width(), decoded.class.height());
    let mut class = decoded.class.clone();
    let mut point_mm = Grid::filled(width, height, [f32::NAN; 3]);
    let mut sigma_z_mm = Grid::filled(width, height, f32::NAN);
    // Error of the measured row where rows were coded, else the predicted row.
    let coded = decoded.row.is_some();
    let mut row = Grid::filled(width, height, f32::NAN);
    let set = InstructionSet::widest();
    class
        .data_mut()
        .par_chunks_mut(width)
        .zip(point_mm.data_mut().par_chunks_mut(width))
        .zip(sigma_z_mm.data_mut().par_chunks_mut(width))
        .zip(row.data_mut().par_chunks_mut(width))
        .enumerate()
        .for_each(|(y, (((class, point_mm), sigma_z_mm), row))| {
            set.run(Points { triangulator, decoded, settings, y, class, point_mm, sigma_z_mm, row });
        });
    let row_check =
        coded.then(|| check_rows(&row, &class, settings.row_gate_px, triangulator.rows_per_column()));
    let surface = Surface::new(&point_mm, &sigma_z_mm, triangulator.rays());
    let normal = normals::normals(set, &surface);
    let flags = flags(decoded, &class, &surface::silhouettes(set, &surface));
    Ok(Reconstruction {
        cloud: Cloud { point_mm, normal, sigma_z_mm, flags },
        class,
        predicted_row: (!coded).then_some(row),
        row_check,
    })
}

fn check(
    triangulator: &Triangulator,
    decoded: &Decoded,
    settings: &ReconstructSettings,
) -> Result<(), ReconstructError> {
    let rays = triangulator.rays().directions();
    let (maps, camera) = ((decoded.class.width(), decoded.class.height()), (rays.width(), rays.height()));
    if maps != camera {
        return Err(ReconstructError::Size { maps, camera });
    }
    let ReconstructSettings { near_mm, far_mm, row_gate_px } = *settings;
    if !(near_mm >= 0.0 && far_mm > near_mm) {
        return Err(ReconstructError::Volume { near_mm, far_mm });
    }
    if row_gate_px.is_nan() || row_gate_px <= 0.0 {
        return Err(ReconstructError::RowGate { row_gate_px });
    }
    Ok(())
}

/// Triangulates and judges the pixels of row `y`.
struct Points<'a> {
    triangulator: &'a Triangulator,
    decoded: &'a Decoded,
    settings: &'a ReconstructSettings,
    y: usize,
    class: &'a mut [Class],
    point_mm: &'a mut [[f32; 3]],
    sigma_z_mm: &'a mut [f32],
    /// Error of the measured row where rows were coded, else the predicted row.
    row: &'a mut [f32],
}

impl Work for Points<'_> {
    type Output = ();

    #[inline(always)]
    fn run(mut self) {
        for x in (0..self.class.len()).step_by(LANES) {
            let lanes = LANES.min(self.class.len() - x);
            let valid: [bool; LANES] = std::array::from_fn(|l| {
                self.class[x..][..lanes].get(l).is_some_and(|class| class.is_valid())
            });
            if valid == [false; LANES] {
                continue;
            }
            let solutions = self.triangulator.solve_lanes(x, self.y, &measurements(self.decoded, x, self.y));
            for l in (0..lanes).filter(|&l| valid[l]) {
                self.judge(x + l, l, &solutions);
            }
        }
    }
}

impl Points<'_> {
    /// Keeps the point of one pixel or classes it by why it is rejected. What was measured of the row is kept for the
    /// statistics if the point lies in the volume.
    #[inline(always)]
    fn judge(&mut self, x: usize, l: usize, solutions: &Solutions) {
        let Self { settings, decoded, .. } = *self;
        let (z, sigma_z_mm) = (solutions.point_mm[2][l], solutions.sigma_z_mm[l]);
        // A ray nearly in the light plane meets it anywhere: such a depth says nothing of the volume.
        let blind = sigma_z_mm > 0.5 * (settings.far_mm - settings.near_mm);
        if !solutions.found[l] || blind || !(settings.near_mm..=settings.far_mm).contains(&z) {
            self.class[x] = Class::OutOfVolume;
            return;
        }
        let error_px = solutions.row_error_px[l];
        self.row[x] = if decoded.row.is_some() { error_px } else { solutions.projector_px[1][l] } as f32;
        let gate = settings.row_gate_px.max(GATE_SIGMAS * solutions.row_error_sigma_px[l]);
        // Not measured is NaN, which no comparison holds for: no row, no gate.
        if error_px.abs() > gate {
            self.class[x] = Class::RowGate;
            return;
        }
        self.point_mm[x] = [0, 1, 2].map(|axis| solutions.point_mm[axis][l] as f32);
        self.sigma_z_mm[x] = sigma_z_mm as f32;
    }
}

/// Measurements of the pixels from (x, y) on; NaN for axes that were not coded and beyond the row's end.
#[inline(always)]
fn measurements(decoded: &Decoded, x: usize, y: usize) -> Measurements {
    let read = |map: Option<&Grid<f32>>| -> Lane {
        let mut lane = [f64::NAN; LANES];
        if let Some(map) = map {
            lane.iter_mut().zip(&map.row(y)[x..]).for_each(|(lane, value)| *lane = f64::from(*value));
        }
        lane
    };
    let (column, row) = (&decoded.column, decoded.row.as_ref());
    Measurements {
        pixel: [read(Some(&column.coordinate)), read(row.map(|row| &row.coordinate))],
        sigma: [read(Some(&column.sigma)), read(row.map(|row| &row.sigma))],
    }
}

/// Median, spread and rejections over the pixels that were measured in both axes and lie in the volume.
fn check_rows(row_error: &Grid<f32>, class: &Grid<Class>, gate_px: f64, rows_per_column: f64) -> RowCheck {
    let measured = row_error.data().iter().filter(|e| e.is_finite()).count();
    let rejected = class
        .data()
        .iter()
        .zip(row_error.data())
        .filter(|(class, error)| **class == Class::RowGate && error.is_finite())
        .count();
    let step = measured.div_ceil(STATISTICS_PIXELS).max(1);
    let mut errors: Vec<f32> =
        row_error.data().iter().copied().filter(|e| e.is_finite()).step_by(step).collect();
    let median_px = median(&mut errors);
    for error in &mut errors {
        *error = (*error - median_px).abs();
    }
    RowCheck {
        median_px: f64::from(median_px),
        sigma_px: 1.4826 * f64::from(median(&mut errors)),
        gate_px,
        rejected_share: if measured == 0 { 0.0 } else { rejected as f64 / measured as f64 },
        rows_per_column,
    }
}

/// Upper median; NaN of nothing.
fn median(values: &mut [f32]) -> f32 {
    if values.is_empty() {
        return f32::NAN;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f32::total_cmp).1
}

fn flags(decoded: &Decoded, class: &Grid<Class>, silhouette: &Grid<bool>) -> Grid<u8> {
    let set = |on: bool, bit: u8| if on { bit } else { 0 };
    let data = class
        .data()
        .par_iter()
        .enumerate()
        .with_min_len(1 << 14)
        .map(|(i, class)| {
            if !class.is_valid() {
                return 0;
            }
            set(*class == Class::Edge, flag::EDGE)
                | set(decoded.half_saturated.data()[i], flag::HALF_SATURATED)
                | set(*class == Class::Inverted, flag::INVERTED)
                | set(decoded.interpolated.data()[i], flag::INTERPOLATED)
                | set(silhouette.data()[i], flag::SILHOUETTE)
        })
        .collect();
    Grid::from_vec(class.width(), class.height(), data)
}

#[cfg(test)]
mod tests;
