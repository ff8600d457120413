//! Decoded maps and a calibration in, points out.

use rayon::prelude::*;
use thiserror::Error;

use super::{
    Cloud, Reconstruction, RowCheck, flag,
    surface::{self, Surface},
};
use crate::{
    decode::{AxisMap, Class, Decoded},
    geometry::{Calibration, Measurement, Solution, TriangulateError, Triangulator},
    grid::Grid,
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
    let mut row_error = Grid::filled(width, height, f32::NAN);
    class
        .data_mut()
        .par_chunks_mut(width)
        .zip(point_mm.data_mut().par_chunks_mut(width))
        .zip(sigma_z_mm.data_mut().par_chunks_mut(width))
        .zip(row_error.data_mut().par_chunks_mut(width))
        .enumerate()
        .for_each(|(y, (((class, point), sigma), row_error))| {
            for x in (0..width).filter(|&x| decoded.class.at(x, y).is_valid()) {
                let (verdict, solution) = judge(triangulator, decoded, settings, x, y);
                if let Some(solution) = &solution {
                    row_error[x] = solution.row_error_px as f32;
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
    let row_check = decoded
        .row
        .is_some()
        .then(|| check_rows(&row_error, &class, settings.row_gate_px, triangulator.rows_per_column()));
    let surface = Surface::new(&point_mm, &sigma_z_mm, triangulator.rays());
    let normal = surface::normals(&surface);
    let flags = flags(decoded, &class, &surface::silhouettes(&surface));
    Ok(Reconstruction { cloud: Cloud { point_mm, normal, sigma_z_mm, flags }, class, row_check })
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
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::{
        cloud::fit_plane,
        decode::NoiseModel,
        geometry::fixtures::{rig, two_axis_rig},
    };

    /// Where a ray from the origin meets something.
    type Scene = dyn Fn(Vector3<f64>) -> Option<f64>;

    fn plane(normal: [f64; 3], through_z: f64) -> impl Fn(Vector3<f64>) -> Option<f64> {
        let normal = Vector3::from(normal);
        move |ray| Some(normal.z * through_z / normal.dot(&ray))
    }

    fn sphere(centre: [f64; 3], radius: f64) -> impl Fn(Vector3<f64>) -> Option<f64> {
        let centre = Vector3::from(centre);
        move |ray| {
            // |ray t - c|^2 = r^2, nearer root.
            let (a, b, c) = (ray.dot(&ray), ray.dot(&centre), centre.dot(&centre) - radius * radius);
            let root = b * b - a * c;
            (root > 0.0).then(|| (b - root.sqrt()) / a)
        }
    }

    /// Decoded maps of a scene as a perfect decoder would give them, and the true points.
    fn decode(calibration: &Calibration, scene: &Scene, rows: bool) -> (Decoded, Grid<[f64; 3]>) {
        let projector = calibration.projector.unwrap();
        let (width, height) = (calibration.camera.width as usize, calibration.camera.height as usize);
        let map = || AxisMap {
            code: Grid::filled(width, height, -1),
            coordinate: Grid::filled(width, height, f32::NAN),
            sigma: Grid::filled(width, height, f32::NAN),
        };
        let (mut column, mut row) = (map(), map());
        let mut class = Grid::filled(width, height, Class::Unlit);
        let mut truth = Grid::filled(width, height, [f64::NAN; 3]);
        for i in 0..width * height {
            let ray = calibration.camera.ray([(i % width) as f64, (i / width) as f64]).unwrap();
            let Some(point) = scene(ray).map(|z| ray * z) else { continue };
            let seen = projector.projector_from_camera.transform(&point);
            let Some([u, v]) = projector.lens.project(&seen) else { continue };
            for (map, value) in [(&mut column, u), (&mut row, v)] {
                map.code.data_mut()[i] = value.round() as i32;
                map.coordinate.data_mut()[i] = value as f32;
                map.sigma.data_mut()[i] = 0.03;
            }
            class.data_mut()[i] = Class::Valid;
            truth.data_mut()[i] = point.into();
        }
        let floats = || Grid::filled(width, height, 0.0);
        let decoded = Decoded {
            column,
            row: rows.then_some(row),
            class,
            half_saturated: Grid::filled(width, height, false),
            interpolated: Grid::filled(width, height, false),
            modulation: floats(),
            residual: floats(),
            dolp: floats(),
            intensity: Grid::filled(width, height, 128),
            noise: NoiseModel { gain_dn_per_electron: 0.4, read_noise_dn: 1.0 },
            noise_estimated: false,
            black_level_dn: 0.0,
            pairs: Vec::new(),
            boundaries: Vec::new(),
            drift: None,
            losses: Vec::new(),
        };
        (decoded, truth)
    }

    const VOLUME: (f64, f64) = (700.0, 1300.0);

    fn run(calibration: &Calibration, decoded: &Decoded) -> Reconstruction {
        reconstruct(decoded, calibration, &ReconstructSettings::new(VOLUME.0, VOLUME.1)).unwrap()
    }

    fn angle_degrees(a: [f32; 3], b: [f64; 3]) -> f64 {
        let a = Vector3::new(f64::from(a[0]), f64::from(a[1]), f64::from(a[2]));
        a.angle(&Vector3::from(b)).to_degrees()
    }

    /// Columns are stored as f32 (3e-5 px), which is 4e-4 mm at 12 mm per column.
    #[test]
    fn recovers_a_plane_and_a_sphere() {
        let scenes: [&Scene; 2] = [&plane([0.05, 0.02, -1.0], 1000.0), &sphere([10.0, 5.0, 1100.0], 150.0)];
        for calibration in [rig(8.0), two_axis_rig(8.0)] {
            for scene in scenes {
                for rows in [true, false] {
                    let (decoded, truth) = decode(&calibration, scene, rows);
                    let result = run(&calibration, &decoded);
                    assert_eq!(result.class, decoded.class, "nothing is rejected");
                    assert_eq!(result.row_check.is_some(), rows);
                    for (found, truth) in result.cloud.point_mm.data().iter().zip(truth.data()) {
                        for k in 0..3 {
                            let error = (f64::from(found[k]) - truth[k]).abs();
                            assert!(
                                error < 1.5e-3 || (found[k].is_nan() && truth[k].is_nan()),
                                "{found:?} {truth:?}"
                            );
                        }
                    }
                    if let Some(check) = result.row_check {
                        assert!(
                            check.median_px.abs() < 1e-3
                                && check.sigma_px < 1e-3
                                && check.rejected_share == 0.0
                        );
                        assert_eq!(check.gate_px, 1.5);
                    }
                }
            }
        }
    }

    #[test]
    fn normals_of_a_noisy_plate_scatter_little() {
        let calibration = rig(2.0);
        let scene = plane([0.3, -0.2, -1.0], 1000.0);
        let (mut decoded, _) = decode(&calibration, &scene, false);
        let mut noise = noise(7);
        for column in decoded.column.coordinate.data_mut() {
            *column += 0.03 * noise() as f32;
        }
        let result = run(&calibration, &decoded);
        let length = (0.09_f64 + 0.04 + 1.0).sqrt();
        let expected = [0.3 / length, -0.2 / length, -1.0 / length];
        let mut angles: Vec<f64> =
            result.cloud.normal.data().iter().map(|&n| angle_degrees(n, expected)).collect();
        assert!(angles.iter().all(|a| a.is_finite()), "every point of the plate has a normal");
        angles.sort_by(f64::total_cmp);
        let (median, p95) = (angles[angles.len() / 2], angles[angles.len() * 95 / 100]);
        assert!(median < 2.5 && p95 < 5.0, "median {median}, 95 % {p95} degrees");
        // Noise of depth is what sigma says it is.
        let points: Vec<[f64; 3]> = result.cloud.point_mm.data().iter().map(|p| p.map(f64::from)).collect();
        let mean_sigma =
            result.cloud.sigma_z_mm.data().iter().map(|s| f64::from(*s)).sum::<f64>() / points.len() as f64;
        let rmse_z = fit_plane(&points).unwrap().rmse_mm * length;
        assert!((rmse_z / mean_sigma - 1.0).abs() < 0.05, "{rmse_z} {mean_sigma}");
    }

    /// Standard normal numbers by Box and Muller on a multiplicative generator.
    fn noise(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        let mut uniform = move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            ((state >> 11) as f64 + 0.5) / (1_u64 << 53) as f64
        };
        move || (-2.0 * uniform().ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos()
    }

    #[test]
    fn normals_of_a_sphere_point_outwards() {
        let calibration = rig(4.0);
        let centre = [0.0, 0.0, 1050.0];
        let (decoded, truth) = decode(&calibration, &sphere(centre, 120.0), false);
        let result = run(&calibration, &decoded);
        let mut checked = 0;
        for (i, point) in truth.data().iter().enumerate().filter(|(_, p)| p[2].is_finite()) {
            let outward = [point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]];
            let facing = Vector3::from(outward).angle(&-Vector3::from(*point)).to_degrees();
            let normal = result.cloud.normal.data()[i];
            if facing < 60.0 {
                assert!(angle_degrees(normal, outward) < 2.0, "{normal:?} {outward:?}");
                checked += 1;
            }
            let towards = Vector3::from(normal.map(f64::from)).dot(&Vector3::from(*point));
            assert!(towards <= 0.0, "no normal faces away");
        }
        assert!(checked > 5000, "{checked}");
    }

    /// A plate in front of another: normals of both stay true up to the edge, and only a band of 2 px is flagged.
    #[test]
    fn a_depth_jump_breaks_normals_and_is_flagged() {
        let calibration = rig(4.0);
        let (back, front) = (plane([0.0, 0.0, -1.0], 1000.0), plane([-0.1, 0.05, -1.0], 940.0));
        let scene = move |ray: Vector3<f64>| if ray.x < -0.01 { front(ray) } else { back(ray) };
        let (decoded, truth) = decode(&calibration, &scene, false);
        let result = run(&calibration, &decoded);
        let width = truth.width();
        for y in 0..truth.height() {
            let edge = (0..width).find(|&x| truth.at(x, y)[2] > 980.0).unwrap();
            for x in 0..width {
                let flagged = result.cloud.flags.at(x, y) & flag::SILHOUETTE != 0;
                let distance = if x >= edge { x - edge + 1 } else { edge - x };
                // The edge leans by under a pixel between rows.
                assert!(
                    flagged == (distance <= 2) || distance.abs_diff(2) <= 1,
                    "{x} {y} {distance} {flagged}"
                );
                let expected = if x >= edge { [0.0, 0.0, -1.0] } else { [-0.1, 0.05, -1.0] };
                assert!(angle_degrees(result.cloud.normal.at(x, y), expected) < 0.5, "{x} {y}");
            }
        }
    }

    #[test]
    fn the_border_of_the_mask_is_a_silhouette_and_the_image_is_not() {
        let calibration = rig(16.0);
        let (mut decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), false);
        let width = decoded.class.width();
        decoded.class.data_mut()[40 * width + 50] = Class::Ambiguous;
        let flags = run(&calibration, &decoded).cloud.flags;
        for y in 0..flags.height() {
            for x in 0..width {
                let near = x.abs_diff(50).max(y.abs_diff(40));
                assert_eq!(flags.at(x, y) & flag::SILHOUETTE != 0, (1..=2).contains(&near), "{x} {y}");
            }
        }
    }

    #[test]
    fn gates_set_their_classes_and_leave_no_point() {
        let calibration = rig(16.0);
        let (mut decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), true);
        decoded.column.coordinate.data_mut()[10] += 64.0;
        decoded.row.as_mut().unwrap().coordinate.data_mut()[20] += 2.0;
        decoded.row.as_mut().unwrap().coordinate.data_mut()[30] = f32::NAN;
        decoded.class.data_mut()[40] = Class::Vote;
        decoded.class.data_mut()[50] = Class::Edge;
        decoded.class.data_mut()[60] = Class::Inverted;
        decoded.half_saturated.data_mut()[50] = true;
        decoded.interpolated.data_mut()[60] = true;
        decoded.column.coordinate.data_mut()[70] = f32::NAN;
        decoded.row.as_mut().unwrap().coordinate.data_mut()[70] = f32::NAN;
        let result = run(&calibration, &decoded);
        let class = result.class.data();
        assert_eq!(class[10], Class::OutOfVolume);
        assert_eq!(class[20], Class::RowGate);
        assert_eq!(class[30], Class::Valid, "a missing row gates nothing");
        assert_eq!(class[40], Class::Vote);
        assert_eq!(class[70], Class::OutOfVolume);
        for i in [10, 20, 40, 70] {
            assert!(
                result.cloud.point_mm.data()[i][2].is_nan() && result.cloud.sigma_z_mm.data()[i].is_nan()
            );
            assert_eq!((result.cloud.normal.data()[i], result.cloud.flags.data()[i]), ([0.0; 3], 0));
        }
        let limits = flag::EDGE | flag::HALF_SATURATED | flag::INVERTED | flag::INTERPOLATED;
        assert_eq!(result.cloud.flags.data()[50] & limits, flag::EDGE | flag::HALF_SATURATED);
        assert_eq!(result.cloud.flags.data()[60] & limits, flag::INVERTED | flag::INTERPOLATED);
        let check = result.row_check.unwrap();
        assert!((check.rejected_share - 1.0 / (class.len() - 4) as f64).abs() < 1e-12, "{check:?}");
        assert!(check.rows_per_column < 0.01);
    }

    #[test]
    fn a_wrong_calibration_shows_in_the_rows() {
        let calibration = rig(16.0);
        let (decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), true);
        let mut stale = calibration.clone();
        stale.projector.as_mut().unwrap().lens.cy -= 4.0;
        let result = run(&stale, &decoded);
        let check = result.row_check.unwrap();
        assert!((check.median_px - 4.0).abs() < 0.05 && check.rejected_share > 0.99, "{check:?}");
        assert!(result.class.data().iter().all(|c| *c == Class::RowGate));
    }

    /// Rows that span 8 px each (missing low bits) are not cut by a gate of 1.5 px.
    #[test]
    fn coarse_rows_survive_the_gate() {
        let calibration = rig(16.0);
        let (mut decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), true);
        let row = decoded.row.as_mut().unwrap();
        for value in row.coordinate.data_mut() {
            *value = (*value / 8.0).floor() * 8.0 + 3.5;
        }
        row.sigma = Grid::filled(decoded.class.width(), decoded.class.height(), 8.0 / 12.0_f32.sqrt());
        let result = run(&calibration, &decoded);
        assert_eq!(result.row_check.unwrap().rejected_share, 0.0);
    }

    /// On a baseline along both axes the row gate catches wrong columns, which no horizontal one can.
    #[test]
    fn a_two_axis_rig_catches_wrong_columns() {
        for (calibration, catches) in [(rig(16.0), false), (two_axis_rig(16.0), true)] {
            let (mut decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), true);
            for column in decoded.column.coordinate.data_mut().iter_mut().step_by(7) {
                *column += 4.0;
            }
            let result = run(&calibration, &decoded);
            let class = result.class.data();
            assert!(
                class.iter().step_by(7).all(|c| *c == if catches { Class::RowGate } else { Class::Valid })
            );
        }
    }

    #[test]
    fn equal_on_any_number_of_threads() {
        let calibration = two_axis_rig(8.0);
        let (mut decoded, _) = decode(&calibration, &sphere([0.0, 0.0, 1100.0], 140.0), true);
        let mut noise = noise(3);
        for column in decoded.column.coordinate.data_mut() {
            *column += 0.3 * noise() as f32;
        }
        let on = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            let result = pool.install(|| run(&calibration, &decoded));
            let bits = |values: &[[f32; 3]]| values.iter().flatten().map(|v| v.to_bits()).collect::<Vec<_>>();
            let cloud = &result.cloud;
            let sigma: Vec<u32> = cloud.sigma_z_mm.data().iter().map(|v| v.to_bits()).collect();
            (
                bits(cloud.point_mm.data()),
                bits(cloud.normal.data()),
                sigma,
                cloud.flags.clone(),
                result.class,
                result.row_check,
            )
        };
        let one = on(1);
        for threads in [2, 3, 7] {
            assert!(on(threads) == one, "{threads} threads");
        }
    }

    #[test]
    fn refuses_maps_and_settings_that_do_not_fit() {
        let calibration = rig(16.0);
        let (decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), false);
        let settings = ReconstructSettings::new(700.0, 1300.0);
        let error = reconstruct(&decoded, &rig(8.0), &settings).unwrap_err();
        assert!(error.to_string().contains("the maps are 100x75 px, the calibrated camera is 200x150 px"));
        for (near, far) in [(1300.0, 700.0), (f64::NAN, 1.0), (0.0, f64::NAN)] {
            let error =
                reconstruct(&decoded, &calibration, &ReconstructSettings::new(near, far)).unwrap_err();
            assert!(matches!(error, ReconstructError::Volume { .. }));
        }
        let error =
            reconstruct(&decoded, &calibration, &ReconstructSettings { row_gate_px: 0.0, ..settings });
        assert!(matches!(error, Err(ReconstructError::RowGate { .. })));
    }

    #[test]
    fn the_world_frame_moves_points_and_turns_normals() {
        let calibration = rig(16.0);
        let (decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), false);
        let cloud = run(&calibration, &decoded).cloud;
        // x up, y right, z towards the camera.
        let pose = crate::geometry::Pose {
            rotation: nalgebra::Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
            translation_mm: Vector3::new(1.0, 2.0, -1000.0),
        };
        let world = cloud.transformed(&pose);
        let (from, to) = (cloud.point_mm.at(30, 20), world.point_mm.at(30, 20));
        assert!((to[0] - (1.0 - from[1])).abs() < 1e-3 && (to[1] - (2.0 + from[0])).abs() < 1e-3);
        assert!(to[2].abs() < 2e-3);
        assert!(angle_degrees(world.normal.at(30, 20), [0.0, 0.0, -1.0]) < 0.5);
        assert_eq!(cloud.points(), world.points());
    }
}
