//! What the nodes of an OpenCV FileStorage mean: the names that calibration tools give them.

use super::{
    ReadHints,
    value::{Array, Draft, Node, Nodes, side},
};
use crate::geometry::{Calibration, Lens};

// Names are compared without case, '_' and '-'. Sources: OpenCV's calibration and stereo samples, the projector-camera
// tools that write cam_int/proj_int or cam_K/proj_K, ROS camera_info.
const CAMERA_MATRIX: &[&str] = &[
    "camint",
    "camk",
    "cammatrix",
    "camintrinsics",
    "cameraintrinsics",
    "k1",
    "m1",
    "cameramatrix1",
    "cameramatrixl",
    "cameramatrixleft",
    "leftcameramatrix",
    "cameramatrix",
    "intrinsicmatrix",
    "intrinsics",
    "k",
];
const CAMERA_DISTORTION: &[&str] = &[
    "camdist",
    "camkc",
    "camdistortion",
    "cameradistortion",
    "d1",
    "distcoeffs1",
    "distcoeffsl",
    "distcoeffsleft",
    "distortioncoefficients1",
    "leftdistcoeffs",
    "distortioncoefficients",
    "distcoeffs",
    "distortion",
    "d",
];
const PROJECTOR_MATRIX: &[&str] = &[
    "projint",
    "projk",
    "projmatrix",
    "projintrinsics",
    "projectorintrinsics",
    "projectormatrix",
    "k2",
    "m2",
    "cameramatrix2",
    "cameramatrixr",
    "cameramatrixright",
    "rightcameramatrix",
];
const PROJECTOR_DISTORTION: &[&str] = &[
    "projdist",
    "projkc",
    "projdistortion",
    "projectordistortion",
    "d2",
    "distcoeffs2",
    "distcoeffsr",
    "distcoeffsright",
    "distortioncoefficients2",
    "rightdistcoeffs",
];
const ROTATION: &[&str] = &["rotation", "r", "rotationmatrix", "stereorotation"];
const TRANSLATION: &[&str] = &["translation", "t", "translationvector", "stereotranslation"];
/// (width, height).
const CAMERA_SIZE: &[&str] = &["camsize", "camerasize", "imagesize", "camresolution", "imagesize1", "size"];
const PROJECTOR_SIZE: &[&str] = &["projsize", "projectorsize", "projresolution", "imagesize2"];
/// (rows, columns), as arrays have it.
const CAMERA_SHAPE: &[&str] = &["imgshape", "camshape", "camerashape", "imageshape"];
const PROJECTOR_SHAPE: &[&str] = &["projshape", "projectorshape"];
const CAMERA_SIDES: [&[&str]; 2] = [
    &["imagewidth", "camwidth", "camerawidth", "width"],
    &["imageheight", "camheight", "cameraheight", "height"],
];
const PROJECTOR_SIDES: [&[&str]; 2] = [&["projwidth", "projectorwidth"], &["projheight", "projectorheight"]];

/// Puts a calibration together.
pub(super) fn interpret(nodes: &Nodes, hints: &ReadHints) -> Result<Calibration, Vec<String>> {
    let mut reader = Reader {
        nodes: nodes.iter().map(|(k, n)| (plain(k), k.as_str(), n)).collect(),
        draft: Draft::default(),
    };
    let stereo = [PROJECTOR_MATRIX, ROTATION, TRANSLATION].iter().any(|names| reader.find(names).is_some());
    let (first, second) = if hints.swap { ("projector", "camera") } else { ("camera", "projector") };
    let (first_hint, second_hint) = if hints.swap {
        (hints.projector_size, hints.camera_size)
    } else {
        (hints.camera_size, hints.projector_size)
    };
    let sizes = [
        reader.file_size(CAMERA_SIZE, CAMERA_SHAPE, CAMERA_SIDES),
        reader.file_size(PROJECTOR_SIZE, PROJECTOR_SHAPE, PROJECTOR_SIDES),
    ];
    let one = reader.lens(first, CAMERA_MATRIX, CAMERA_DISTORTION, sizes[0], first_hint);
    let mut two = None;
    if stereo {
        two = reader.lens(second, PROJECTOR_MATRIX, PROJECTOR_DISTORTION, sizes[1], second_hint);
        let rotation = reader.numbers(ROTATION, "rotation", &[9]);
        let translation = reader.numbers(TRANSLATION, "translation", &[3]);
        let pose = rotation.zip(translation).and_then(|(r, t)| reader.draft.foreign_pose(&r, &t, hints));
        reader.draft.projector_from_camera = pose;
    } else if hints.swap {
        reader.draft.fault("it holds one device only, there is nothing to swap");
    }
    let (camera, projector) = if hints.swap { (two, one) } else { (one, two) };
    (reader.draft.camera, reader.draft.projector) = (camera, projector);
    reader.quality(stereo, hints.swap);
    reader.draft.finish()
}

fn plain(name: &str) -> String {
    name.chars().filter(|c| !matches!(c, '_' | '-')).flat_map(char::to_lowercase).collect()
}

struct Reader<'a> {
    /// Plain name, name in the file, value.
    nodes: Vec<(String, &'a str, &'a Node)>,
    draft: Draft,
}

impl<'a> Reader<'a> {
    /// First node that bears one of the names.
    fn find(&self, names: &[&str]) -> Option<(&'a str, &'a Node)> {
        names.iter().find_map(|name| {
            self.nodes.iter().find(|(plain, _, _)| plain == name).map(|&(_, name, node)| (name, node))
        })
    }

    fn array(&self, names: &[&str]) -> Option<(&'a str, &'a Array)> {
        match self.find(names)? {
            (name, Node::Array(array)) => Some((name, array)),
            _ => None,
        }
    }

    /// Numbers of a node whose count must be one of `counts`.
    fn numbers(&mut self, names: &[&str], what: &str, counts: &[usize]) -> Option<Vec<f64>> {
        match self.find(names) {
            None => {
                self.draft.fault(format!("{what} is missing (looked for {} and the like)", names[0]));
                None
            }
            Some((_, Node::Array(array))) if counts.contains(&array.data.len()) => Some(array.data.clone()),
            Some((name, Node::Array(array))) => {
                self.draft.fault(format!("{name} is {}, expected {counts:?} numbers", array.shape()));
                None
            }
            Some((name, Node::Text(_))) => {
                self.draft.fault(format!("{name} is a text, expected {counts:?} numbers"));
                None
            }
        }
    }

    fn file_size(&mut self, size: &[&str], shape: &[&str], sides: [&[&str]; 2]) -> Option<(u32, u32)> {
        let sides = [self.array(sides[0]), self.array(sides[1])];
        let (name, width, height) = if let [Some((name, width)), Some((_, height))] = sides {
            (name, width.data.first().copied(), height.data.first().copied())
        } else if let Some((name, array)) = self.array(size) {
            (name, array.data.first().copied(), array.data.get(1).copied())
        } else if let Some((name, array)) = self.array(shape) {
            (name, array.data.get(1).copied(), array.data.first().copied())
        } else {
            return None;
        };
        let found = width.and_then(side).zip(height.and_then(side));
        if found.is_none() {
            self.draft.fault(format!("{name} is not a size: expected two positive whole numbers"));
        }
        found
    }

    fn lens(
        &mut self,
        who: &str,
        matrix: &[&str],
        distortion: &[&str],
        file: Option<(u32, u32)>,
        hint: Option<(u32, u32)>,
    ) -> Option<Lens> {
        let size = self.draft.size(who, file, hint);
        let m = self.numbers(matrix, &format!("{who} matrix"), &[9]);
        let coefficients = match self.array(distortion) {
            // OpenCV's 8 and more coefficients are the rational, thin-prism and tilted models.
            Some((name, array)) if array.data.len() > 5 && array.data[5..].iter().any(|&v| v != 0.0) => {
                self.draft.fault(format!(
                    "{name} has {} coefficients; k1 k2 p1 p2 k3 is the model here, calibrate again with 5",
                    array.data.len()
                ));
                None
            }
            Some((_, array)) if array.data.len() >= 4 => Some(array.data.clone()),
            _ => self.numbers(distortion, &format!("{who} distortion"), &[4, 5]),
        };
        let m = m.filter(|m| {
            let scale = m[0].abs().max(1.0);
            let form = [m[1], m[3], m[6], m[7], m[8] - 1.0].iter().all(|v| v.abs() <= 1e-9 * scale || v.is_nan());
            if !form {
                self.draft.fault(format!(
                    "{who} matrix is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] (skew cannot be used)"
                ));
            }
            form
        });
        let (((width, height), m), coefficients) = size.zip(m).zip(coefficients)?;
        let mut five = [0.0; 5];
        for (place, value) in five.iter_mut().zip(&coefficients) {
            *place = *value;
        }
        Some(Lens { width, height, fx: m[0], fy: m[4], cx: m[2], cy: m[5], distortion: five })
    }

    fn quality(&mut self, stereo: bool, swap: bool) {
        let number = |names: &[&str]| self.array(names).and_then(|(_, a)| a.data.first().copied());
        let first = number(if stereo { &["camerror", "camrms"] } else { &["avgreprojectionerror", "rms"] });
        let second = number(&["projerror", "projrms"]);
        let views = number(&["nframes", "nviews", "views"]).and_then(side);
        let date = match self.find(&["calibrationtime", "calibrationdate", "date"]) {
            Some((_, Node::Text(text))) => Some(text.clone()),
            _ => None,
        };
        let quality = &mut self.draft.quality;
        (quality.camera_rms_px, quality.projector_rms_px) =
            if swap { (second, first) } else { (first, second) };
        quality.views = views;
        quality.date = date;
        quality.method = Some("OpenCV FileStorage".to_owned());
    }
}
