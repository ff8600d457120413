//! What foreign files boil down to: named arrays and texts, and the calibration that is being put together from them.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, SVD, Vector3};

use super::ReadHints;
use crate::geometry::{Calibration, Lens, Pose, Projector, Quality};

/// Larger arrays are corners, images and covariances: nothing that is needed here.
pub(super) const MAX_ELEMENTS: usize = 256;
/// Results of a hundred views have a few thousand variables.
pub(super) const MAX_VARIABLES: usize = 20_000;
/// Rotations printed with few digits are brought back to the nearest rotation, up to this error.
const PRINTED_ROTATION: f64 = 1e-3;

/// A named value.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Node {
    /// Numbers in row-major order.
    Array(Array),
    /// Anything else that is short.
    Text(String),
}

/// Numbers in row-major order; a scalar is 1x1.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Array {
    pub(super) rows: usize,
    pub(super) columns: usize,
    pub(super) data: Vec<f64>,
}

impl Array {
    pub(super) fn scalar(value: f64) -> Self {
        Self { rows: 1, columns: 1, data: vec![value] }
    }

    pub(super) fn column(data: Vec<f64>) -> Self {
        Self { rows: data.len(), columns: 1, data }
    }

    pub(super) fn shape(&self) -> String {
        format!("{}x{}", self.rows, self.columns)
    }
}

/// All values of a file.
pub(super) type Nodes = BTreeMap<String, Node>;

/// A calibration in the making: what could be read, and everything that was wrong.
#[derive(Debug, Default)]
pub(super) struct Draft {
    pub(super) faults: Vec<String>,
    pub(super) camera: Option<Lens>,
    pub(super) projector: Option<Lens>,
    pub(super) projector_from_camera: Option<Pose>,
    pub(super) world_from_camera: Option<Pose>,
    pub(super) quality: Quality,
}

impl Draft {
    pub(super) fn fault(&mut self, fault: impl Into<String>) {
        self.faults.push(fault.into());
    }

    /// The calibration, or the faults of its form together with those of all numbers that could be read.
    pub(super) fn finish(mut self) -> Result<Calibration, Vec<String>> {
        if self.faults.is_empty()
            && let Some(camera) = self.camera
        {
            let projector = self
                .projector
                .zip(self.projector_from_camera)
                .map(|(lens, projector_from_camera)| Projector { lens, projector_from_camera });
            let world_from_camera = self.world_from_camera;
            return Ok(Calibration { camera, projector, world_from_camera, quality: self.quality });
        }
        for (who, lens) in [("camera", self.camera), ("projector", self.projector)] {
            self.faults.extend(lens.iter().flat_map(|lens| lens.faults(who)));
        }
        let poses = [
            ("projector_from_camera", self.projector_from_camera),
            ("world_from_camera", self.world_from_camera),
        ];
        for (name, pose) in poses {
            self.faults.extend(pose.iter().flat_map(|pose| pose.faults(name)));
        }
        Err(self.faults)
    }

    /// The pose of a foreign file, `R` already row-major, `t` in its own unit.
    pub(super) fn foreign_pose(
        &mut self,
        rotation: &[f64],
        translation: &[f64],
        hints: &ReadHints,
    ) -> Option<Pose> {
        if !(hints.unit_mm.is_finite() && hints.unit_mm > 0.0) {
            self.fault(format!("the unit given is {} mm, expected a positive number", hints.unit_mm));
            return None;
        }
        if rotation.len() != 9 || translation.len() != 3 {
            return None;
        }
        let rotation = nearest_rotation(Matrix3::from_row_slice(rotation));
        let translation_mm = Vector3::from_column_slice(translation) * hints.unit_mm;
        let pose = Pose { rotation, translation_mm };
        Some(if hints.swap { pose.inverse() } else { pose })
    }

    /// Chooses between the size in the file and the one given; they must agree where both are there.
    pub(super) fn size(
        &mut self,
        who: &str,
        file: Option<(u32, u32)>,
        hint: Option<(u32, u32)>,
    ) -> Option<(u32, u32)> {
        match (file, hint) {
            (Some(file), Some(hint)) if file != hint => {
                let exchanged =
                    if file == (hint.1, hint.0) { ": width and height are exchanged" } else { "" };
                self.fault(format!(
                    "the file is of a {who} of {}x{} px, but {}x{} px was given{exchanged}",
                    file.0, file.1, hint.0, hint.1
                ));
                None
            }
            (None, None) => {
                self.fault(format!("the {who} size (width, height) is missing: this file has none, give it"));
                None
            }
            (file, hint) => file.or(hint),
        }
    }
}

/// A whole number of pixels.
pub(super) fn side(value: f64) -> Option<u32> {
    (value.fract() == 0.0 && (1.0..=1e6).contains(&value)).then_some(value as u32)
}

/// The nearest rotation (polar decomposition) when `m` is one but for printed digits; otherwise `m` itself, for the
/// checks to refuse.
fn nearest_rotation(m: Matrix3<f64>) -> Matrix3<f64> {
    let error = (m.transpose() * m - Matrix3::identity()).abs().max();
    if !(1e-14..=PRINTED_ROTATION).contains(&error) {
        return m;
    }
    let svd = SVD::new(m, true, true);
    match (svd.u, svd.v_t) {
        (Some(u), Some(v_t)) => u * v_t,
        _ => m,
    }
}
