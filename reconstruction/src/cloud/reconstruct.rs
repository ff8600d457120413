//! Decoded maps and a calibration in, points out.

use rayon::prelude::*;
use thiserror::Error;

use super::{
    Cloud, Reconstruction, RowCheck, flag, normals,
    surface::{self, Surface},
};
use crate::{
    decode::{AxisMap, Class, Decoded},
    geometry::{Calibration, Measurement, Solution, TriangulateError, Triangulator},
    grid::Grid,
    simd::InstructionSet,
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
    class
        .data_mut()
        .par_chunks_mut(width)
        .zip(point_mm.data_mut().par_chunks_mut(width))
        .zip(sigma_z_mm.data_mut().par_chunks_mut(width))
        .zip(row.data_mut().par_chunks_mut(width))
        .enumerate()
        .for_each(|(y, (((class, point), sigma), row))| {
            for x in (0..width).filter(|&x| decoded.class.at(x, y).is_valid()) {
                let (verdict, solution) = judge(triangulator, decoded, settings, x, y);
                if let Some(solution) = &solution {
                    let value = if coded { solution.row_error_px } else { solution.projector_px[1] };
                    row[x] = value as f32;
                }
                match (verdict, solution) {
                    (None, Some(solution)) => {
                        point[x] = solution.point_mm.map(|v| v as f32);
                        sigma[x] = solution.sigma_z_mm as f32;
                    }
                    (verdict, _) => class[x] = verdict.unwrap_or(Class::OutOfVolume),
                }
            }
        });
    let row_check =
        coded.then(|| check_rows(&row, &class, settings.row_gate_px, triangulator.rows_per_column()));
    let surface = Surface::new(&point_mm, &sigma_z_mm, triangulator.rays());
    let set = InstructionSet::widest();
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

/// Measurement of one pixel; NaN for axes that were not coded.
fn measurement(decoded: &Decoded, x: usize, y: usize) -> Measurement {
    let read = |map: &AxisMap| (f64::from(map.coordinate.at(x, y)), f64::from(map.sigma.at(x, y)));
    let (column, sigma_column) = read(&decoded.column);
    let (row, sigma_row) = decoded.row.as_ref().map_or((f64::NAN, f64::NAN), read);
    Measurement { column, sigma_column, row, sigma_row }
}

/// Solves one pixel. A class is why it is rejected; the solution is kept for the row statistics if it lies in the
/// volume.
fn judge(
    triangulator: &Triangulator,
    decoded: &Decoded,
    settings: &ReconstructSettings,
    x: usize,
    y: usize,
) -> (Option<Class>, Option<Solution>) {
    let Some(solution) = triangulator.solve(x, y, &measurement(decoded, x, y)) else {
        return (Some(Class::OutOfVolume), None);
    };
    let z = solution.point_mm[2];
    // A ray nearly in the light plane meets it anywhere: such a depth says nothing of the volume.
    let blind = solution.sigma_z_mm > 0.5 * (settings.far_mm - settings.near_mm);
    if blind || !(settings.near_mm..=settings.far_mm).contains(&z) {
        return (Some(Class::OutOfVolume), None);
    }
    let gate = settings.row_gate_px.max(GATE_SIGMAS * solution.row_error_sigma_px);
    // Not measured is NaN, which no comparison holds for: no row, no gate.
    let rejected = solution.row_error_px.abs() > gate;
    (rejected.then_some(Class::RowGate), Some(solution))
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
