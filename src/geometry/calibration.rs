//! The calibration of a rig.

use nalgebra::{Matrix3, Vector3};

use super::Lens;

/// A rigid transform `y = rotation * x + translation_mm`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Orthonormal, determinant 1.
    pub rotation: Matrix3<f64>,
    /// In mm.
    pub translation_mm: Vector3<f64>,
}

/// How good a calibration said it was when it was made. All optional.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Quality {
    /// Reprojection rms of the camera in px.
    pub camera_rms_px: Option<f64>,
    /// Reprojection rms of the projector in px.
    pub projector_rms_px: Option<f64>,
    /// Number of board views.
    pub views: Option<u32>,
    /// When it was made.
    pub date: Option<String>,
    /// How it was made.
    pub method: Option<String>,
}

/// Camera, projector and the pose between them. World frame = camera frame unless `world_from_camera` is given.
#[derive(Debug, Clone, PartialEq)]
pub struct Calibration {
    /// Camera.
    pub camera: Lens,
    /// Projector. `None` for a file that holds a camera alone.
    pub projector: Option<Projector>,
    /// Bench or stage frame in which clouds are wanted.
    pub world_from_camera: Option<Pose>,
    /// What is known of its making.
    pub quality: Quality,
}

/// The projector half of a calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Projector {
    /// Intrinsics.
    pub lens: Lens,
    /// `x_p = R x_c + t`.
    pub projector_from_camera: Pose,
}
