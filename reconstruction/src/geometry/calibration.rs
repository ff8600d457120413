//! The calibration of a rig: what it holds, and whether it can be used.

use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

use super::Lens;

/// A rigid transform `y = rotation * x + translation_mm`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pose {
    /// Orthonormal, determinant 1.
    pub rotation: Matrix3<f64>,
    /// In mm.
    pub translation_mm: Vector3<f64>,
}

/// How far an element of `R^T R` may lie from the identity: numbers printed with six digits pass.
const ROTATION_TOLERANCE: f64 = 1e-5;
/// A shorter baseline is a translation in metres, or none at all.
const MIN_BASELINE_MM: f64 = 1.0;
/// A longer translation is diverged or in another unit.
const MAX_TRANSLATION_MM: f64 = 1e6;

impl Pose {
    /// `rotation * point + translation_mm`.
    pub fn transform(&self, point_mm: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point_mm + self.translation_mm
    }

    /// The pose that undoes this one.
    pub fn inverse(&self) -> Self {
        let back = self.rotation.transpose();
        Self { rotation: back, translation_mm: -(back * self.translation_mm) }
    }

    /// Everything that makes the pose unusable; `name` as in files, such as `projector_from_camera`.
    pub fn faults(&self, name: &str) -> Vec<String> {
        let mut faults = Vec::new();
        if let Some(value) = self.rotation.iter().find(|v| !v.is_finite()) {
            faults.push(format!("{name} rotation holds {value}, not a finite number"));
        } else {
            let error = (self.rotation.transpose() * self.rotation - Matrix3::identity()).abs().max();
            let determinant = self.rotation.determinant();
            if error > ROTATION_TOLERANCE {
                faults.push(format!(
                    "{name} rotation is not orthonormal: R^T R is off the identity by {error:.2e}, \
                     allowed {ROTATION_TOLERANCE:.0e}"
                ));
            } else if determinant < 0.0 {
                faults.push(format!(
                    "{name} rotation has determinant {determinant:.3}: it mirrors, an axis is flipped"
                ));
            }
        }
        let length = self.translation_mm.norm();
        if let Some(value) = self.translation_mm.iter().find(|v| !v.is_finite()) {
            faults.push(format!("{name} translation holds {value}, not a finite number"));
        } else if length > MAX_TRANSLATION_MM {
            faults.push(format!(
                "{name} translation is {length:.3e} mm long, expected at most {MAX_TRANSLATION_MM:.0e}"
            ));
        }
        faults
    }
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

impl Calibration {
    /// Everything that makes the calibration unusable; empty when it can be used.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = self.camera.faults("camera");
        if let Some(projector) = &self.projector {
            faults.extend(projector.lens.faults("projector"));
            let pose = &projector.projector_from_camera;
            faults.extend(pose.faults("projector_from_camera"));
            let baseline = pose.translation_mm.norm();
            if baseline < MIN_BASELINE_MM {
                faults.push(format!(
                    "projector_from_camera translation is {baseline:.4} mm long: without a baseline there is no depth \
                     (is it in metres?)"
                ));
            }
        }
        if let Some(world) = &self.world_from_camera {
            faults.extend(world.faults("world_from_camera"));
        }
        faults
    }

    /// The calibration for frames that are a region of the camera's image: `size` (width, height) from pixel `origin` on.
    pub fn cropped(&self, origin: (u32, u32), size: (u32, u32)) -> Self {
        Self { camera: self.camera.cropped(origin, size), ..self.clone() }
    }

    /// Whether the calibration is of these image sizes, each (width, height). Every disagreement is named.
    ///
    /// # Errors
    /// [`SizeError`] when a size differs; it says so when width and height are exchanged.
    pub fn check_sizes(&self, camera: (u32, u32), projector: (u32, u32)) -> Result<(), SizeError> {
        let sizes = [
            ("camera", Some(self.camera.size()), camera),
            ("projector", self.projector.map(|p| p.lens.size()), projector),
        ];
        let faults: Vec<String> = sizes
            .into_iter()
            .filter_map(|(who, calibrated, found)| {
                let calibrated = calibrated.filter(|&size| size != found)?;
                let hint =
                    if calibrated == (found.1, found.0) { ": width and height are exchanged" } else { "" };
                Some(format!(
                    "the calibration is of a {who} of {}x{} px, the scan of {}x{} px{hint}",
                    calibrated.0, calibrated.1, found.0, found.1
                ))
            })
            .collect();
        if faults.is_empty() { Ok(()) } else { Err(SizeError { faults }) }
    }
}

/// A calibration of other image sizes than the scan's.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("cannot use this calibration here: {}; calibrate at the sizes of the scan", faults.join("; "))]
pub struct SizeError {
    /// Each disagreement.
    pub faults: Vec<String>,
}
