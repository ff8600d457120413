//! Rigs for tests, written out by hand.

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::{Calibration, Lens, Pose, Projector, Quality};

/// Projector pose at `centre_mm` in the camera frame, its axis through `target_mm`, rolled by `roll` radians.
pub(crate) fn looking_at(centre_mm: Vector3<f64>, target_mm: Vector3<f64>, roll: f64) -> Pose {
    let forward = (target_mm - centre_mm).normalize();
    let right = Vector3::new(0.0, 1.0, 0.0).cross(&forward).normalize();
    let down = forward.cross(&right);
    let axes = Matrix3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]);
    let rotation = Rotation3::from_axis_angle(&Vector3::z_axis(), roll).into_inner() * axes;
    Pose { rotation, translation_mm: -(rotation * centre_mm) }
}

/// The rig of the method's pinned scene, `scale` times smaller in pixels.
pub(crate) fn rig(scale: f64) -> Calibration {
    let camera = Lens {
        width: (1600.0 / scale) as u32,
        height: (1200.0 / scale) as u32,
        fx: 4638.0 / scale,
        fy: 4638.0 / scale,
        cx: 799.5 / scale,
        cy: 599.5 / scale,
        distortion: [-0.11, 0.15, 4e-4, -3e-4, 0.0],
    };
    let projector = Lens {
        width: 1024,
        height: 768,
        fx: 1540.0,
        fy: 1540.0,
        cx: 511.5,
        cy: 745.0,
        distortion: [0.02, -0.03, 0.0, 0.0, 0.0],
    };
    let pose = looking_at(Vector3::new(52.4, 0.0, 0.0), Vector3::new(0.0, 0.0, 1000.0), 0.0);
    Calibration {
        camera,
        projector: Some(Projector { lens: projector, projector_from_camera: pose }),
        world_from_camera: None,
        quality: Quality::default(),
    }
}

/// A rig whose baseline has a part along both axes, with strong distortion.
pub(crate) fn two_axis_rig(scale: f64) -> Calibration {
    let mut calibration = rig(scale);
    let lens = Lens {
        cy: 500.0,
        distortion: [-0.08, 0.05, 1e-3, -2e-3, 0.01],
        ..calibration.projector.unwrap().lens
    };
    let pose = looking_at(Vector3::new(-64.0, 78.0, -49.0), Vector3::new(10.0, -5.0, 1000.0), 0.03);
    calibration.projector = Some(Projector { lens, projector_from_camera: pose });
    calibration
}
