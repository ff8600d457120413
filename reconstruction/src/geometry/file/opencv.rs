//! Writing OpenCV's FileStorage, for other tools.

use std::fmt::Write;

use crate::geometry::{Calibration, Lens};

impl Calibration {
    /// The calibration as OpenCV FileStorage (YAML), under the names of OpenCV's own samples: `camera_matrix` and
    /// `distortion_coefficients` of a camera alone; `M1`, `D1` (camera), `M2`, `D2` (projector), `R`, `T` of a rig, with
    /// `T` in mm. [`Calibration::from_bytes`] reads the same numbers back, to the last bit. What that format has no name
    /// for is left out: the pose of the camera in the world, and the method.
    pub fn to_opencv_yaml(&self) -> String {
        let mut out = "%YAML:1.0\n---\n".to_owned();
        let quality = &self.quality;
        if let Some(date) = &quality.date {
            let _ = writeln!(out, "calibration_time: \"{}\"", date.replace(['"', '\\', '\n', '\r'], " "));
        }
        if let Some(views) = quality.views {
            let _ = writeln!(out, "nframes: {views}");
        }
        let Some(projector) = &self.projector else {
            let _ = writeln!(out, "image_width: {}\nimage_height: {}", self.camera.width, self.camera.height);
            lens(&mut out, &self.camera, "camera_matrix", "distortion_coefficients");
            number(&mut out, "avg_reprojection_error", quality.camera_rms_px);
            return out;
        };
        for (name, lens) in [("image_size_1", &self.camera), ("image_size_2", &projector.lens)] {
            let _ = writeln!(out, "{name}: [ {}, {} ]", lens.width, lens.height);
        }
        lens(&mut out, &self.camera, "M1", "D1");
        lens(&mut out, &projector.lens, "M2", "D2");
        let pose = &projector.projector_from_camera;
        matrix(&mut out, "R", [3, 3], pose.rotation.transpose().as_slice());
        matrix(&mut out, "T", [3, 1], pose.translation_mm.as_slice());
        number(&mut out, "cam_error", quality.camera_rms_px);
        number(&mut out, "proj_error", quality.projector_rms_px);
        out
    }
}

fn number(out: &mut String, name: &str, value: Option<f64>) {
    if let Some(value) = value {
        let _ = writeln!(out, "{name}: {value:?}");
    }
}

fn lens(out: &mut String, lens: &Lens, matrix_name: &str, distortion_name: &str) {
    matrix(out, matrix_name, [3, 3], lens.matrix().transpose().as_slice());
    matrix(out, distortion_name, [5, 1], &lens.distortion);
}

/// `values` row by row. The shortest decimals that read back as the same numbers.
fn matrix(out: &mut String, name: &str, [rows, columns]: [usize; 2], values: &[f64]) {
    let values: Vec<String> = values.iter().map(|v| format!("{v:?}")).collect();
    let _ = writeln!(
        out,
        "{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {} ]",
        values.join(",\n       ")
    );
}
