//! The twin and the scanner's geometry share no code; here they are held against each other.

use std::{
    fs,
    path::{Path, PathBuf},
    sync::LazyLock,
};

use nalgebra::{Matrix3, Rotation3, Vector3};
use polscan::geometry::{Calibration, Lens, Pose, ReadHints};
use polscan_drivers::sim::{PoseDescription, Projection, RigDescription};
use proptest::prelude::*;

/// Largest distance of what should be one pixel.
const SAME_PX: f64 = 1e-6;

/// Lenses as they are sold, from a wide angle to a long lens, with their axis anywhere near the picture.
fn lenses() -> impl Strategy<Value = Lens> {
    let size = (320u32..4096, 240u32..3000);
    let shape = (0.8f64..6.0, 0.3f64..0.7, 0.1f64..0.99);
    let distortion = (-0.12f64..0.12, -0.04f64..0.04, -2e-3f64..2e-3, -2e-3f64..2e-3, -0.02f64..0.02)
        .prop_map(<[f64; 5]>::from);
    (size, shape, distortion).prop_map(|((width, height), (long, across, down), distortion)| {
        let focal = long * f64::from(width.max(height));
        let (cx, cy) = (across * f64::from(width), down * f64::from(height));
        Lens { width, height, fx: focal, fy: focal, cx, cy, distortion }
    })
}

fn poses() -> impl Strategy<Value = Pose> {
    let turn = [-0.6f64..0.6, -0.6f64..0.6, -3.0f64..3.0];
    let way = [-500.0f64..500.0, -500.0f64..500.0, -300.0f64..300.0];
    (turn, way).prop_map(|([x, y, z], way)| Pose {
        rotation: Rotation3::from_euler_angles(x, y, z).into_inner(),
        translation_mm: Vector3::from(way),
    })
}

/// The paper's rig as the twin reads it.
static PAPER: LazyLock<RigDescription> = LazyLock::new(|| {
    let text = fs::read_to_string(config("sim.toml")).expect("the rig");
    let table: toml::Table = text.parse().expect("the rig is TOML");
    table["sim"].clone().try_into().expect("a rig")
});

/// Its calibration as the scanner reads it.
static CALIBRATION: LazyLock<Calibration> = LazyLock::new(|| {
    let name = "sim-calibration.toml";
    let bytes = fs::read(config(name)).expect("the calibration");
    Calibration::from_bytes(&bytes, name, &ReadHints::default()).expect("a calibration")
});

fn config(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("config").join(name)
}

/// The twin of a rig with these lenses and this pose.
fn twin(camera: &Lens, projector: &Lens, pose: &Pose) -> Projection {
    let mut rig = PAPER.clone();
    let focal_and_centre = |lens: &Lens| ([lens.width, lens.height], lens.fx, Some([lens.cx, lens.cy]));
    (rig.camera.size, rig.camera.focal_px, rig.camera.principal_point_px) = focal_and_centre(camera);
    (rig.projector.size, rig.projector.focal_px, rig.projector.principal_point_px) =
        focal_and_centre(projector);
    let [k1, k2, p1, p2, k3] = camera.distortion;
    (rig.camera.k1, rig.camera.k2, rig.camera.p1, rig.camera.p2, rig.camera.k3) = (k1, k2, p1, p2, k3);
    let [k1, k2, p1, p2, k3] = projector.distortion;
    (rig.projector.k1, rig.projector.k2, rig.projector.p1, rig.projector.p2, rig.projector.k3) =
        (k1, k2, p1, p2, k3);
    rig.pose = PoseDescription {
        rotation: Some(std::array::from_fn(|row| std::array::from_fn(|column| pose.rotation[(row, column)]))),
        translation_mm: Some(pose.translation_mm.into()),
        ..PoseDescription::default()
    };
    Projection::new(&rig).expect("a pose that is given fits")
}

fn apart_px(one: [f64; 2], other: [f64; 2]) -> f64 {
    (one[0] - other[0]).hypot(one[1] - other[1])
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn the_twin_sees_a_point_where_the_geometry_does(
        camera in lenses(), projector in lenses(), pose in poses(),
        (across, down, distance_mm) in (-0.05f64..1.05, -0.05f64..1.05, 50.0f64..5000.0),
    ) {
        prop_assume!(camera.faults("camera").is_empty());
        let twin = twin(&camera, &projector, &pose);
        // A point that the camera sees, in or just outside of its picture.
        let pixel = [across * f64::from(camera.width), down * f64::from(camera.height)];
        let ray = camera.ray(pixel);
        prop_assume!(ray.is_some());
        let point = ray.unwrap() * distance_mm;
        let seen = twin.camera_pixel(point.into());
        prop_assume!(seen.is_some());
        prop_assert!(apart_px(seen.unwrap(), pixel) < SAME_PX, "{seen:?} {pixel:?}");
        prop_assert!(apart_px(seen.unwrap(), camera.project(&point).unwrap()) < SAME_PX);

        let in_projector = pose.transform(&point);
        match twin.projector_pixel(point.into()) {
            // Far outside of the picture, pixels are so large numbers that they have no millionths.
            Some(lit) if lit.iter().all(|at| at.abs() < 1e5) => {
                let expected = projector.project(&in_projector).unwrap();
                prop_assert!(apart_px(lit, expected) < SAME_PX, "{lit:?} {expected:?}");
            }
            Some(_) => {}
            // Behind the projector, or farther aside than where the first of these lenses folds over.
            None => prop_assert!(
                in_projector.z <= 0.0 || in_projector.xy().norm() > in_projector.z,
                "{in_projector:?}"
            ),
        }
    }

    /// The calibration of the paper's rig was worked out by hand; the twin aims its projector by itself.
    #[test]
    fn the_calibration_of_the_paper_s_rig_is_the_twin_s(
        x in -200.0f64..200.0, y in -150.0f64..150.0, z in 700.0f64..1400.0,
    ) {
        let twin = Projection::new(&PAPER).unwrap();
        let projector = CALIBRATION.projector.unwrap();
        let point = Vector3::new(x, y, z);
        let seen = twin.camera_pixel(point.into()).unwrap();
        prop_assert!(apart_px(seen, CALIBRATION.camera.project(&point).unwrap()) < SAME_PX);
        let lit = twin.projector_pixel(point.into()).unwrap();
        let expected = projector.lens.project(&projector.projector_from_camera.transform(&point)).unwrap();
        prop_assert!(apart_px(lit, expected) < SAME_PX, "{lit:?} {expected:?}");
    }
}

#[test]
fn a_projector_in_the_camera_s_place_sees_what_the_camera_sees() {
    let (camera, pose) = (&*PAPER, Pose { rotation: Matrix3::identity(), translation_mm: Vector3::zeros() });
    let lens = Lens {
        width: camera.camera.size[0],
        height: camera.camera.size[1],
        fx: camera.camera.focal_px,
        fy: camera.camera.focal_px,
        cx: 799.5,
        cy: 599.5,
        distortion: [-0.11, 0.15, 4e-4, -3e-4, 0.0],
    };
    let twin = twin(&lens, &lens, &pose);
    for (x, y) in [(0.0, 0.0), (100.0, 0.0), (0.0, -80.0), (150.0, 110.0)] {
        let (seen, lit) =
            (twin.camera_pixel([x, y, 1000.0]).unwrap(), twin.projector_pixel([x, y, 1000.0]).unwrap());
        assert!(apart_px(seen, lit) < SAME_PX, "a projector in the camera's place sees what the camera sees");
    }
}
