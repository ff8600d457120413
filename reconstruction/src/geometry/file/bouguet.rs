//! What the variables of Bouguet's camera calibration toolbox mean. Its `kc` has OpenCV's order and its pixels count
//! from 0 at their centres; `XR = R XL + T` with `R` from the rotation vector `om`.

use nalgebra::{Rotation3, Vector3};

use super::{
    ReadHints,
    value::{Draft, Node, Nodes, side},
};
use crate::geometry::{Calibration, Lens};

/// Puts a calibration together from `Calib_Results` (camera) or `Calib_Results_stereo` (left = camera).
pub(super) fn interpret(nodes: &Nodes, hints: &ReadHints) -> Result<Calibration, Vec<String>> {
    let mut reader = Reader { nodes, draft: Draft::default() };
    // The toolbox saves one size, that of the left or only camera.
    let file_size = reader.optional("nx").and_then(side).zip(reader.optional("ny").and_then(side));
    let stereo = ["fc_left", "fc_right", "om", "T"].iter().any(|name| nodes.contains_key(*name));
    if !stereo {
        if hints.swap {
            reader.draft.fault("it holds one camera only, there is nothing to swap");
        }
        reader.draft.camera = reader.lens("camera", "", file_size, hints.camera_size);
    } else {
        let right_size =
            reader.optional("nx_right").and_then(side).zip(reader.optional("ny_right").and_then(side));
        let (left, right) = if hints.swap {
            let projector = reader.lens("projector", "_left", file_size, hints.projector_size);
            (projector, reader.lens("camera", "_right", right_size, hints.camera_size))
        } else {
            let camera = reader.lens("camera", "_left", file_size, hints.camera_size);
            (camera, reader.lens("projector", "_right", right_size, hints.projector_size))
        };
        let (camera, projector) = if hints.swap { (right, left) } else { (left, right) };
        (reader.draft.camera, reader.draft.projector) = (camera, projector);
        let rotation = if nodes.contains_key("om") || !nodes.contains_key("R") {
            reader.numbers("om", &[3]).map(|om| rodrigues(&om))
        } else {
            reader.numbers("R", &[9])
        };
        let translation = reader.numbers("T", &[3]);
        let pose = rotation.zip(translation).and_then(|(r, t)| reader.draft.foreign_pose(&r, &t, hints));
        reader.draft.projector_from_camera = pose;
    }
    reader.quality();
    reader.draft.finish()
}

/// Rotation matrix of a rotation vector, row-major; NaN stays NaN.
fn rodrigues(om: &[f64]) -> Vec<f64> {
    let vector = Vector3::from_column_slice(om);
    if !vector.iter().all(|v| v.is_finite()) {
        return vec![f64::NAN; 9];
    }
    Rotation3::new(vector).into_inner().transpose().iter().copied().collect()
}

struct Reader<'a> {
    nodes: &'a Nodes,
    draft: Draft,
}

impl Reader<'_> {
    fn optional(&self, name: &str) -> Option<f64> {
        match self.nodes.get(name)? {
            Node::Array(array) if array.data.len() == 1 => array.data.first().copied(),
            _ => None,
        }
    }

    fn numbers(&mut self, name: &str, counts: &[usize]) -> Option<Vec<f64>> {
        let fault = match self.nodes.get(name) {
            Some(Node::Array(array)) if counts.contains(&array.data.len()) => {
                return Some(array.data.clone());
            }
            Some(Node::Array(array)) => format!("{name} is {}, expected {counts:?} numbers", array.shape()),
            Some(Node::Text(_)) => format!("{name} is a text, expected {counts:?} numbers"),
            None => format!("{name} is missing"),
        };
        self.draft.fault(fault);
        None
    }

    fn lens(
        &mut self,
        who: &str,
        suffix: &str,
        file: Option<(u32, u32)>,
        hint: Option<(u32, u32)>,
    ) -> Option<Lens> {
        let size = self.draft.size(who, file, hint);
        let focal = self.numbers(&format!("fc{suffix}"), &[2]);
        let centre = self.numbers(&format!("cc{suffix}"), &[2]);
        let kc = self.numbers(&format!("kc{suffix}"), &[4, 5]);
        let skew = format!("alpha_c{suffix}");
        if let Some(alpha) = self.optional(&skew)
            && alpha != 0.0
        {
            self.draft
                .fault(format!("{skew} is {alpha}: skew cannot be used, calibrate again with est_alpha = 0"));
        }
        let (((width, height), focal), (centre, kc)) = size.zip(focal).zip(centre.zip(kc))?;
        let mut distortion = [0.0; 5];
        for (place, value) in distortion.iter_mut().zip(&kc) {
            *place = *value;
        }
        Some(Lens { width, height, fx: focal[0], fy: focal[1], cx: centre[0], cy: centre[1], distortion })
    }

    fn quality(&mut self) {
        // err_std is per coordinate; the rms of OpenCV is of both.
        if let Some(Node::Array(array)) = self.nodes.get("err_std")
            && let [x, y] = array.data[..]
            && x.is_finite()
            && y.is_finite()
        {
            self.draft.quality.camera_rms_px = Some(x.hypot(y));
        }
        self.draft.quality.views = self.optional("n_ima").and_then(side);
        self.draft.quality.method = Some("Bouguet's camera calibration toolbox".to_owned());
    }
}
