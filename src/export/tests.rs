//! Every file is read back with a reader that is not its writer's twin where there is one, and compared with what went in.

use std::io::Cursor;

use nalgebra::{Rotation3, Vector3};
use proptest::prelude::*;

use super::*;
use crate::{cloud::PlyPoint, geometry::Pose, grid::Grid};

/// Camera pixels with what a plane at 500 mm, tilted by `slope`, would give; `depth` may change it.
fn cloud(
    (width, height): (usize, usize),
    measured: impl Fn(usize, usize) -> bool,
    depth: impl Fn(usize, usize) -> f32,
    sigma_z_mm: f32,
) -> Organised {
    let mask = Grid::from_vec(
        width,
        height,
        (0..width * height).map(|at| measured(at % width, at / width)).collect::<Vec<_>>(),
    );
    let point = |at: usize| {
        let (x, y) = (at % width, at / width);
        let z = depth(x, y);
        PlyPoint {
            point_mm: [z * x as f32 / 1000.0, z * y as f32 / 1000.0, z],
            normal: if (x + y) % 3 == 0 { [0.0; 3] } else { [0.0, 0.6, -0.8] },
            intensity: (at % 256) as u8,
            sigma_z_mm,
            flags: (at % 32) as u8,
        }
    };
    let points = (0..mask.len()).filter(|at| mask.data()[*at]).map(point).collect();
    Organised::new(&mask, points, None).expect("as many points as pixels")
}

fn in_world(mut cloud: Organised) -> Organised {
    let pose = Pose {
        rotation: *Rotation3::from_euler_angles(0.3, -0.2, 2.9).matrix(),
        translation_mm: Vector3::new(100.0, -200.0, 300.0),
    };
    for point in &mut cloud.points {
        let world = pose.transform(&point.point_mm.map(f64::from).into());
        point.point_mm = [world.x as f32, world.y as f32, world.z as f32];
        let turned = pose.rotation * Vector3::from(point.normal.map(f64::from));
        point.normal = [turned.x as f32, turned.y as f32, turned.z as f32];
    }
    Organised { world_from_camera: Some(pose), ..cloud }
}

fn origin() -> Origin {
    Origin {
        id: "01a2-b3".into(),
        label: Some("a ]]> <label>\nof two lines".into()),
        created: Some("2024-02-29T12:34:56.500Z".into()),
        software: Some("polscan 0.1.0".into()),
        camera_model: Some("model & maker".into()),
        camera_serial: None,
    }
}

fn e57_bytes(cloud: &Organised) -> Vec<u8> {
    let mut bytes = Vec::new();
    write_cloud(PointFormat::E57, cloud, &origin(), &mut bytes).expect("memory takes all");
    bytes
}

#[test]
fn e57_holds_points_in_the_camera_frame_and_its_pose() {
    let camera = cloud((7, 5), |x, y| (x, y) != (3, 2), |x, _| 500.0 + x as f32, 0.1);
    let world = in_world(camera.clone());
    let bytes = e57_bytes(&world);
    assert_eq!(bytes, e57_bytes(&world), "equal scans give equal files");
    let mut reader = ::e57::E57Reader::new(Cursor::new(bytes)).expect("an E57");
    assert_eq!(reader.creation().map(|date| date.gps_time), Some(1_709_210_096.5 - 315_964_800.0 + 18.0));
    let scans = reader.pointclouds();
    let [scan] = scans.as_slice() else { panic!("one scan") };
    assert_eq!(scan.name.as_deref(), Some("a ]] > <label> of two lines"));
    assert_eq!(scan.sensor_model.as_deref(), Some("model & maker"));
    let limits = scan.intensity_limits.clone().expect("limits of the intensity");
    assert_eq!(limits.intensity_min, Some(::e57::RecordValue::Integer(0)));
    assert_eq!(limits.intensity_max, Some(::e57::RecordValue::Integer(255)));
    let pose = scan.transform.clone().expect("a pose");
    let moved = [pose.translation.x, pose.translation.y, pose.translation.z];
    assert_eq!(moved, [0.1, -0.2, 0.3], "metres");
    let turn = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(
        pose.rotation.w,
        pose.rotation.x,
        pose.rotation.y,
        pose.rotation.z,
    ));
    let expected = world.world_from_camera.expect("a world").rotation;
    assert!((turn.to_rotation_matrix().matrix() - expected).abs().max() < 1e-12);
    assert!(pose.rotation.w >= 0.0);
    let names: Vec<_> = scan.prototype.iter().map(|record| record.name.clone()).collect();
    let at = |wanted: &str| {
        let found = names.iter().position(|name| format!("{name:?}").contains(wanted));
        found.unwrap_or_else(|| panic!("no {wanted} in {names:?}"))
    };
    let rows: Vec<_> =
        reader.pointcloud_raw(scan).expect("points").collect::<Result<_, _>>().expect("points");
    assert_eq!(rows.len(), camera.points.len());
    for (row, (pixel, point)) in rows.iter().zip(camera.pixels.iter().zip(&camera.points)) {
        let single = |name| match row[at(name)] {
            ::e57::RecordValue::Single(value) => f64::from(value),
            ref other => panic!("{name}: {other:?}"),
        };
        let whole = |name| match row[at(name)] {
            ::e57::RecordValue::Integer(value) => value,
            ref other => panic!("{name}: {other:?}"),
        };
        assert_eq!((whole("ColumnIndex"), whole("RowIndex")), ((pixel % 7) as i64, (pixel / 7) as i64));
        assert_eq!(whole("Intensity"), i64::from(point.intensity));
        for (axis, name) in ["CartesianX", "CartesianY", "CartesianZ"].into_iter().enumerate() {
            // Points went through floats in the world, 700 mm from its origin.
            assert!((single(name) - f64::from(point.point_mm[axis]) / 1000.0).abs() < 2e-7, "{name}");
        }
        for (axis, name) in ["normalX", "normalY", "normalZ"].into_iter().enumerate() {
            assert!((single(name) - f64::from(point.normal[axis])).abs() < 2e-7, "{name}");
        }
    }
}

#[test]
fn pcd_has_a_place_for_each_pixel() {
    let cloud = in_world(cloud((6, 4), |x, y| x != y, |_, y| 500.0 + y as f32, 0.25));
    let mut bytes = Vec::new();
    write_cloud(PointFormat::Pcd, &cloud, &origin(), &mut bytes).expect("memory takes all");
    let marker = b"DATA binary\n";
    let end =
        bytes.windows(marker.len()).position(|part| part == marker).expect("the header's end") + marker.len();
    let header = std::str::from_utf8(&bytes[..end]).expect("text");
    for line in ["WIDTH 6\n", "HEIGHT 4\n", "POINTS 24\n", "VIEWPOINT 100 -200 300 "] {
        assert!(header.contains(line), "{line} in {header}");
    }
    let places: Vec<&[u8]> = bytes[end..].chunks_exact(33).collect();
    assert_eq!((places.len(), bytes[end..].len() % 33), (24, 0));
    let mut points = cloud.points.iter();
    for (pixel, place) in places.into_iter().enumerate() {
        let floats: Vec<f32> = place[..32]
            .chunks_exact(4)
            .map(|four| f32::from_le_bytes(four.try_into().expect("four bytes")))
            .collect();
        if pixel % 6 == pixel / 6 {
            assert!(floats.iter().all(|value| value.is_nan()) && place[32] == 0, "{pixel}: {floats:?}");
        } else {
            let point = points.next().expect("a point for each other pixel");
            let expected = [&point.point_mm[..], &point.normal, &[f32::from(point.intensity), 0.25]].concat();
            assert_eq!((floats, place[32]), (expected, point.flags), "{pixel}");
        }
    }
}

#[test]
fn xyz_loses_nothing() {
    let cloud = cloud((5, 5), |x, _| x > 0, |x, y| 500.0 + (x * y) as f32 / 7.0, 1e-3);
    let mut bytes = Vec::new();
    write_cloud(PointFormat::Xyz, &cloud, &origin(), &mut bytes).expect("memory takes all");
    let text = String::from_utf8(bytes).expect("text");
    assert_eq!(text.lines().count(), cloud.points.len());
    for (line, point) in text.lines().zip(&cloud.points) {
        let numbers: Vec<f32> = line.split(' ').map(|number| number.parse().expect("a number")).collect();
        let rest = [f32::from(point.intensity), point.sigma_z_mm];
        assert_eq!(numbers, [&point.point_mm[..], &point.normal, &rest].concat());
    }
}

#[test]
fn a_surface_is_closed_and_faces_the_camera() {
    for slope in [0.0, 0.5, 1.5] {
        // Depth rises by `slope` footprints of 0.5 mm from column to column.
        let cloud = in_world(cloud((6, 5), |_, _| true, |x, _| 500.0 + 0.5 * slope * x as f32, 1e-4));
        let mesh = mesh(&cloud);
        assert_eq!(mesh.triangles.len(), 2 * 5 * 4, "slope {slope}");
        let camera: Vec<Vector3<f64>> = cloud.in_camera().map(|(point, _)| point.into()).collect();
        for corners in &mesh.triangles {
            let [a, b, c] = corners.map(|corner| camera[corner as usize]);
            let normal = (b - a).cross(&(c - a));
            assert!(normal.dot(&a) < 0.0, "slope {slope}: {corners:?} faces away from the camera");
        }
        for (normal, point) in mesh.normals.iter().zip(&cloud.points) {
            let length = normal.iter().map(|part| part * part).sum::<f32>();
            assert!((length - 1.0).abs() < 1e-5, "{normal:?}");
            assert!(point.normal == [0.0; 3] || *normal == point.normal);
        }
    }
}

#[test]
fn no_triangle_crosses_a_jump() {
    // 10 mm, over pixels of 0.5 mm: far beyond 75 degrees, and beyond the noise.
    let step = |sigma_mm| {
        let cloud = cloud((8, 4), |_, _| true, |x, _| if x < 4 { 500.0 } else { 510.0 }, sigma_mm);
        let bridged = |corners: &&[u32; 3]| {
            let near = corners.iter().filter(|corner| **corner % 8 < 4).count();
            near != 0 && near != 3
        };
        let mesh = mesh(&cloud);
        (mesh.triangles.len(), mesh.triangles.iter().filter(bridged).count())
    };
    assert_eq!(step(0.01), (2 * (7 - 1) * 3, 0));
    // What noise alone explains is no jump.
    assert_eq!(step(2.0).0, 2 * 7 * 3);
}

#[test]
fn three_of_four_pixels_make_one_triangle() {
    for missing in 0..4 {
        let cloud = cloud((2, 2), |x, y| 2 * y + x != missing, |_, _| 500.0, 0.01);
        assert_eq!(mesh(&cloud).triangles.len(), 1, "without pixel {missing}");
    }
    assert_eq!(mesh(&cloud((2, 2), |x, y| x == y, |_, _| 500.0, 0.01)).triangles, Vec::<[u32; 3]>::new());
}

fn maps() -> Maps {
    let grid = |values: [f32; 6]| Grid::from_vec(3, 2, values.to_vec());
    let nan = f32::NAN;
    Maps {
        column: grid([nan, 10.25, 11.5, 12.75, nan, 13.0]),
        row: grid([nan; 6]),
        depth_mm: grid([nan, 958.995, 1011.639, 1000.0, nan, 990.125]),
        modulation: grid([0.0, 1.0, 4095.0, nan, f32::INFINITY, 7.0]),
        residual: grid([-1.0, 0.5, 1.0, nan, nan, 2.0]),
        class: Grid::from_vec(3, 2, vec![0, 1, 2, 3, 11, 1]),
        mask: Grid::from_vec(3, 2, vec![false, true, true, true, false, true]),
    }
}

fn scan() -> Scan {
    Scan { origin: origin(), maps: maps(), cloud: None }
}

/// Samples of a picture as doubles, as the library `image` reads them.
fn read_back(bytes: &[u8], format: PictureFormat) -> Vec<f64> {
    let kind = match format {
        PictureFormat::Png => image::ImageFormat::Png,
        _ => image::ImageFormat::Tiff,
    };
    match image::load_from_memory_with_format(bytes, kind).expect("a picture") {
        image::DynamicImage::ImageLuma8(picture) => picture.into_raw().into_iter().map(f64::from).collect(),
        image::DynamicImage::ImageLuma16(picture) => picture.into_raw().into_iter().map(f64::from).collect(),
        // The library widens floats of one channel to three.
        image::DynamicImage::ImageRgb32F(picture) => {
            picture.into_raw().into_iter().step_by(3).map(f64::from).collect()
        }
        other => panic!("{:?}", other.color()),
    }
}

#[test]
fn pictures_are_read_back() {
    let scan = scan();
    let mut seen = 0;
    for item in Item::all() {
        let Item::Map(map, format) = item else { continue };
        if scan.lacks(item).is_some() {
            assert_eq!(map, MapName::Row, "rows have no value here");
            continue;
        }
        let mut bytes = Vec::new();
        let key = scan.write(item, &mut bytes).expect("memory takes all").map.expect("a key");
        if format == PictureFormat::TiffF32 {
            let mut decoder = tiff::decoder::Decoder::new(Cursor::new(&bytes)).expect("a TIFF");
            let tiff::decoder::DecodingResult::F32(read) = decoder.read_image().expect("samples") else {
                panic!("floats")
            };
            let values = map.values(&scan.maps).expect("values").data();
            assert!(read.iter().zip(values).all(|(a, b)| a.to_bits() == b.to_bits()), "{map:?}");
        } else {
            let samples = read_back(&bytes, format);
            match map.values(&scan.maps) {
                None if map == MapName::Class => assert_eq!(samples, [0.0, 1.0, 2.0, 3.0, 11.0, 1.0]),
                None => assert_eq!(samples, [0.0, 255.0, 255.0, 255.0, 0.0, 255.0]),
                Some(values) => {
                    for (sample, value) in samples.iter().zip(values.data()) {
                        assert_eq!(*sample == 0.0, !value.is_finite(), "{map:?} {value}");
                        let read = key.scale.offset + key.scale.scale * sample;
                        let off = (read - f64::from(*value)).abs();
                        assert!(
                            !value.is_finite() || off <= 0.5001 * key.scale.scale,
                            "{map:?} {value} {read}"
                        );
                    }
                }
            }
        }
        // What the file says of itself is what the caller is told.
        let text = bytes.windows(8).any(|part| part == b"\"scale\":");
        assert!(text, "{item:?} says how it is read");
        seen += 1;
    }
    assert_eq!(seen, 4 + 2 + 4 + 4 + 2);
}

#[test]
fn a_scan_without_cloud_says_so_by_name() {
    let scan = scan();
    let item = Item::Cloud(PointFormat::E57);
    assert!(
        scan.lacks(item).is_some_and(|reason| reason.contains("cloud.ply") && reason.contains("calibration"))
    );
    assert!(scan.write(item, &mut Vec::new()).is_err());
}

#[test]
fn names_and_files_belong_together() {
    let names: std::collections::BTreeSet<String> = Item::all().map(Item::file_name).collect();
    assert_eq!(names.len(), Item::all().count());
    for item in Item::all() {
        assert_eq!(Item::from_file_name(&item.file_name()), Some(item));
    }
    for other in ["", "cloud.ply", "mask.f32.tiff", "../cloud.e57", "depth.tif"] {
        assert_eq!(Item::from_file_name(other), None, "{other}");
    }
}

proptest! {
    #[test]
    fn samples_hold_all_values(
        values in prop::collection::vec(prop_oneof![-1e3_f32..1e5, Just(f32::NAN), 900.0_f32..901.0, any::<f32>()], 1..50),
    ) {
        let finite = || values.iter().copied().filter(|value| value.is_finite());
        let (low, high) = finite().fold((f32::MAX, f32::MIN), |(low, high), value| (low.min(value), high.max(value)));
        let scale = Scale::of(&values);
        prop_assert!(scale.scale > 0.0 && scale.scale.is_finite() && scale.offset.is_finite());
        for value in &values {
            let sample = scale.sample(*value);
            prop_assert_eq!(sample == 0, !value.is_finite());
            if value.is_finite() {
                let off = (scale.offset + scale.scale * f64::from(sample) - f64::from(*value)).abs();
                prop_assert!(off <= 0.501 * scale.scale, "{} is off by {} of {:?}", value, off, scale);
            }
        }
        // Not coarser than a step of 1, 2 or 5 allows.
        if finite().count() > 0 {
            let span = (f64::from(high) - f64::from(low)).max(1e-6 * f64::from(low.abs().max(high.abs()))).max(1e-30);
            prop_assert!(scale.scale <= 2.6 * span / 65_530.0, "{:?} for a span of {}", scale, span);
        }
    }

    #[test]
    fn pixels_and_points_agree(
        measured in prop::collection::vec(any::<bool>(), 30),
        extra in 0_usize..3,
    ) {
        let mask = Grid::from_vec(6, 5, measured.clone());
        let count = measured.iter().filter(|set| **set).count();
        let point = PlyPoint { point_mm: [0.0, 0.0, 1.0], normal: [0.0; 3], intensity: 0, sigma_z_mm: 1.0, flags: 0 };
        let organised = Organised::new(&mask, vec![point; count + extra], None);
        prop_assert_eq!(organised.is_ok(), extra == 0);
        if let Ok(organised) = organised {
            prop_assert!(organised.pixels.iter().all(|pixel| measured[*pixel]));
            prop_assert!(organised.pixels.is_sorted());
        }
    }
}
