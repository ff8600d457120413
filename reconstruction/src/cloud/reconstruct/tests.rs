//! Synthetic maps of scenes with known points, and captures where a folder of them is at hand.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use super::*;
use crate::{
    cloud::{CloudFrame, fit_plane, write_ply},
    decode::{AxisMap, NoiseModel},
    geometry::{
        Lens, Pose, Projector, ReadHints,
        fixtures::{rig, two_axis_rig},
    },
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
                        check.median_px.abs() < 1e-3 && check.sigma_px < 1e-3 && check.rejected_share == 0.0
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
            assert!(flagged == (distance <= 2) || distance.abs_diff(2) <= 1, "{x} {y} {distance} {flagged}");
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
        assert!(result.cloud.point_mm.data()[i][2].is_nan() && result.cloud.sigma_z_mm.data()[i].is_nan());
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
        assert!(class.iter().step_by(7).all(|c| *c == if catches { Class::RowGate } else { Class::Valid }));
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
        let error = reconstruct(&decoded, &calibration, &ReconstructSettings::new(near, far)).unwrap_err();
        assert!(matches!(error, ReconstructError::Volume { .. }));
    }
    let error = reconstruct(&decoded, &calibration, &ReconstructSettings { row_gate_px: 0.0, ..settings });
    assert!(matches!(error, Err(ReconstructError::RowGate { .. })));
}

#[test]
fn the_world_frame_moves_points_and_turns_normals() {
    let calibration = rig(16.0);
    let (decoded, _) = decode(&calibration, &plane([0.0, 0.0, -1.0], 1000.0), false);
    let cloud = run(&calibration, &decoded).cloud;
    // x up, y right, z towards the camera.
    let pose = Pose {
        rotation: Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
        translation_mm: Vector3::new(1.0, 2.0, -1000.0),
    };
    let world = cloud.transformed(&pose);
    let (from, to) = (cloud.point_mm.at(30, 20), world.point_mm.at(30, 20));
    assert!((to[0] - (1.0 - from[1])).abs() < 1e-3 && (to[1] - (2.0 + from[0])).abs() < 1e-3);
    assert!(to[2].abs() < 2e-3);
    assert!(angle_degrees(world.normal.at(30, 20), [0.0, 0.0, -1.0]) < 0.5);
    assert_eq!(cloud.points(), world.points());
}

/// The folder of captures.
fn captures() -> PathBuf {
    std::env::var_os("POLSCAN_CAPTURES")
        .map(PathBuf::from)
        .expect("POLSCAN_CAPTURES names the folder of captures")
}

/// A reference map of integer codes, 65535 where there is none, as decoded columns or rows.
fn reference_map(path: &Path) -> AxisMap {
    let image = image::open(path).unwrap().into_luma16();
    let (width, height) = (image.width() as usize, image.height() as usize);
    let code = Grid::from_vec(width, height, image.into_vec())
        .map(|&v| if v == u16::MAX { -1 } else { i32::from(v) });
    AxisMap {
        coordinate: code.map(|&c| if c < 0 { f32::NAN } else { c as f32 }),
        sigma: code.map(|_| 1.0 / 12.0_f32.sqrt()),
        code,
    }
}

/// A decode that holds nothing but these maps.
fn decoded_maps(column: AxisMap, row: AxisMap) -> Decoded {
    let (width, height) = (column.code.width(), column.code.height());
    let class = column.code.data().iter().zip(row.code.data());
    let class = class.map(|(c, r)| if *c >= 0 && *r >= 0 { Class::Valid } else { Class::Unlit }).collect();
    let (mut decoded, _) = decode(&rig(200.0), &|_| None, false);
    decoded.class = Grid::from_vec(width, height, class);
    (decoded.column, decoded.row) = (column, Some(row));
    decoded.half_saturated = Grid::filled(width, height, false);
    decoded.interpolated = Grid::filled(width, height, false);
    decoded
}

fn numbers<const N: usize>(value: &serde_json::Value) -> [f64; N] {
    std::array::from_fn(|k| value[k].as_f64().unwrap())
}

fn steve_lens(value: &serde_json::Value) -> Lens {
    let ([height, width], k) = (numbers(&value["resolution"]), numbers::<9>(&value["intrinsic"]));
    let (width, height) = (width as u32, height as u32);
    Lens { width, height, fx: k[0], fy: k[4], cx: k[2], cy: k[5], distortion: numbers(&value["distortion"]) }
}

fn steve_rig(folder: &Path) -> Calibration {
    let read = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&std::fs::read(folder.join("params").join(name)).unwrap()).unwrap()
    };
    let (camera, projector) = (read("camera000.json"), read("projector000_camera000.json"));
    let projector_from_camera = Pose {
        rotation: Matrix3::from_row_slice(&numbers::<9>(&projector["R"])),
        translation_mm: Vector3::from(numbers::<3>(&projector["T"])),
    };
    Calibration {
        camera: steve_lens(&camera),
        projector: Some(Projector { lens: steve_lens(&projector), projector_from_camera }),
        world_from_camera: None,
        quality: crate::geometry::Quality::default(),
    }
}

/// A real rig with a baseline along both axes: the wall of the capture, in the projector's frame, against the plane
/// published with it (rms 0.80 mm at z 478.4 mm, from both axes by ray intersection).
#[test]
#[ignore = "needs the captures of `make captures`"]
fn captured_two_axis_rig() {
    let folder = captures();
    let folder = folder.join("steve-cam0");
    let calibration = steve_rig(&folder);
    assert_eq!(calibration.faults(), Vec::<String>::new());
    let map = |name: &str| reference_map(&folder.join("reference").join(name));
    let decoded = decoded_maps(map("cam000_col_u16.png"), map("cam000_row_u16.png"));
    let settings = ReconstructSettings::new(200.0, 1500.0);
    let wall = |decoded: &Decoded| {
        let result = reconstruct(decoded, &calibration, &settings).unwrap();
        let pose = calibration.projector.unwrap().projector_from_camera;
        let points = result.cloud.transformed(&pose).point_mm;
        let (normal, at) = (
            Vector3::new(0.001_729_749, 0.005_650_880, -0.999_982_538),
            Vector3::new(-10.757_438, -157.089_629, 478.392_920),
        );
        let near: Vec<[f64; 3]> = points
            .data()
            .iter()
            .map(|p| p.map(f64::from))
            .filter(|p| normal.dot(&(Vector3::from(*p) - at)).abs() < 5.0)
            .collect();
        let valid = result.class.data().iter().filter(|c| c.is_valid()).count();
        (fit_plane(&near).unwrap(), valid, result)
    };
    let lit = decoded.class.data().iter().filter(|c| c.is_valid()).count();
    let (fit, valid, result) = wall(&decoded);
    let check = result.row_check.unwrap();
    eprintln!("steve: {fit:?} {check:?}, {valid} of {lit} valid");
    assert!(check.rows_per_column > 0.5, "{check:?}");
    // A search of 4001 depths per pixel with `cv2.projectPoints` (opencv-python-headless 5.0.0) on 20000 pixels finds
    // 6.5 % of them more than 1.5 px off their epipolar curve, in the outer fifth of the projector.
    assert!((check.rejected_share - 0.065).abs() < 0.005, "{check:?}");
    assert!(fit.rmse_mm < 1.2, "{fit:?}");
    assert!(fit.points as f64 > 0.8 * lit as f64);
    let published = Vector3::new(0.001_729_749, 0.005_650_880, -0.999_982_538);
    assert!(Vector3::from(fit.normal).angle(&published).to_degrees() < 0.3, "{fit:?}");
    let z_on_axis = Vector3::from(fit.normal).dot(&Vector3::from(fit.centroid_mm)) / fit.normal[2];
    assert!((z_on_axis - 478.4).abs() < 2.0, "{z_on_axis}");
    // Rows add information: the wall is no flatter without them.
    let columns = Decoded { row: None, ..decoded };
    let (alone, _, _) = wall(&columns);
    eprintln!("steve, columns alone: {alone:?}");
    assert!(fit.rmse_mm < alone.rmse_mm, "{} {}", fit.rmse_mm, alone.rmse_mm);
}

/// A real rig with a nearly vertical baseline, where the rows carry the depth.
#[test]
#[ignore = "needs the captures of `make captures`"]
fn captured_vertical_baseline() {
    let folder = captures();
    let folder = folder.join("procam-chess/reference");
    let hints = ReadHints { projector_size: Some((1024, 768)), ..ReadHints::default() };
    let name = "calibration_result_opencv4.11.xml";
    let calibration =
        Calibration::from_bytes(&std::fs::read(folder.join(name)).unwrap(), name, &hints).unwrap();
    let map = |name: &str| reference_map(&folder.join(name));
    let decoded = decoded_maps(map("capture_0_col_u16.png"), map("capture_0_row_u16.png"));
    let settings = ReconstructSettings::new(1500.0, 6000.0);
    let result = reconstruct(&decoded, &calibration, &settings).unwrap();
    let check = result.row_check.unwrap();
    eprintln!("procam: {check:?}");
    assert!(check.rows_per_column > 3.0, "{check:?}");
    // The same search with `cv2.projectPoints`: 26.5 % beyond 1.5 px, none of them in the middle of the projector,
    // where the boards were that this calibration was fitted to.
    assert!((check.rejected_share - 0.265).abs() < 0.01, "{check:?}");
    let columns = Decoded { row: None, ..decoded };
    let alone = reconstruct(&columns, &calibration, &settings).unwrap();
    let sigma = |r: &Reconstruction| {
        let mut sigma: Vec<f32> =
            r.cloud.sigma_z_mm.data().iter().copied().filter(|s| s.is_finite()).collect();
        median(&mut sigma)
    };
    assert!(sigma(&alone) > 5.0 * sigma(&result), "{} {}", sigma(&alone), sigma(&result));
}

/// Writes a cloud of a full frame to the folder named in POLSCAN_PLY_OUT, for readers that are not ours
/// (tests/python/check_ply.py), and prints how long each step takes.
#[test]
#[ignore = "writes a file and measures: run with --ignored and POLSCAN_PLY_OUT"]
fn full_frame_timings_and_file() {
    let calibration = rig(1.0);
    let scene = sphere([0.0, 0.0, 1100.0], 140.0);
    let back = plane([0.05, 0.02, -1.0], 1000.0);
    let (decoded, _) = decode(&calibration, &move |ray| scene(ray).or_else(|| back(ray)), true);
    let settings = ReconstructSettings::new(VOLUME.0, VOLUME.1);
    let clock = std::time::Instant::now();
    let triangulator = Triangulator::new(&calibration).unwrap();
    let prepared = clock.elapsed();
    for _ in 0..3 {
        let clock = std::time::Instant::now();
        let result = reconstruct_with(&triangulator, &decoded, &settings).unwrap();
        let done = clock.elapsed();
        let mut bytes = Vec::new();
        let points = write_ply(&mut bytes, &result.cloud, &decoded.intensity, CloudFrame::Camera).unwrap();
        eprintln!(
            "prepare {prepared:?}, reconstruct {done:?}, write {:?}, {points} points",
            clock.elapsed() - done
        );
        if let Some(folder) = std::env::var_os("POLSCAN_PLY_OUT") {
            std::fs::write(Path::new(&folder).join("cloud.ply"), &bytes).unwrap();
        }
    }
}
