//! What a manifest may say. Pure: nothing is looked up on disk.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Component, Path};

use polscan_patterns::{Axis, AxisCode, Mode, Role};

use super::{FrameFiles, Manifest};
use crate::store::{
    error::{Fault, Faults},
    source::Policy,
};

/// Longest word that any projector needs.
const MAX_BITS: u8 = 16;

impl Manifest {
    /// Every contradiction of the manifest with itself, its schema or `policy`, and whatever keeps its frames from
    /// being decoded. `mode` comes before the manifest's own.
    pub fn check(&self, policy: Policy, mode: Option<Mode>) -> Result<(), Faults> {
        let mut faults = self.form_faults(policy, mode);
        self.check_decodable(&mut faults);
        if faults.is_empty() { Ok(()) } else { Err(Faults(faults)) }
    }

    /// As [`Manifest::check`], but frames that nothing can be decoded from pass, as those of a capture that was cut
    /// short.
    pub fn check_form(&self, policy: Policy) -> Result<(), Faults> {
        let faults = self.form_faults(policy, None);
        if faults.is_empty() { Ok(()) } else { Err(Faults(faults)) }
    }

    fn form_faults(&self, policy: Policy, mode: Option<Mode>) -> Vec<Fault> {
        let mut faults = Vec::new();
        self.check_codes(&mut faults);
        self.check_sequence(&mut faults);
        if let Some(mode) = mode.or(self.mode) {
            self.check_roles(mode, &mut faults);
        }
        self.check_frames(policy, &mut faults);
        self.check_camera(&mut faults);
        self.check_own(&mut faults);
        faults
    }

    /// Code of `axis` for a side of `size` pixels.
    pub(super) fn axis_code(&self, axis: Axis, size: u32) -> Result<AxisCode, Fault> {
        let offset = self.code_offset.of(axis).unwrap_or(0);
        let bits = match self.code_bits.of(axis) {
            Some(bits) => Ok(bits),
            None => AxisCode::shortest(size),
        };
        let key = match (self.code_bits.of(axis), self.code_offset.of(axis)) {
            (Some(_), _) => format!("code_bits.{axis}"),
            (None, Some(_)) => format!("code_offset.{axis}"),
            (None, None) => format!("projector.{}", if axis == Axis::Column { "width" } else { "height" }),
        };
        bits.and_then(|bits| AxisCode::new(size, bits, offset))
            .map_err(|error| Fault::new(key, error.to_string()))
    }

    fn check_codes(&self, faults: &mut Vec<Fault>) {
        let Some(projector) = self.projector else { return };
        for (axis, size) in [(Axis::Column, projector.width), (Axis::Row, projector.height)] {
            faults.extend(self.axis_code(axis, size).err());
        }
    }

    fn bits(&self, axis: Axis) -> u8 {
        let side = self.projector.map(|size| if axis == Axis::Column { size.width } else { size.height });
        let shortest = side.and_then(|side| AxisCode::shortest(side).ok());
        self.code_bits.of(axis).or(shortest).unwrap_or(MAX_BITS)
    }

    fn check_sequence(&self, faults: &mut Vec<Fault>) {
        let mut first_seen = BTreeMap::new();
        for (index, &role) in self.sequence.iter().enumerate() {
            let Role::Code { axis, bit, .. } = role else { continue };
            let bits = self.bits(axis);
            if bit >= bits {
                let message =
                    format!("the {axis} code has {bits} bits, so bits go from 0 to {}", i16::from(bits) - 1);
                faults.push(Fault::new(format!("sequence[{index}].bit"), message));
            }
            if let Some(first) = first_seen.insert(role, index) {
                let message = format!("{role} is at {first} already: only references may occur again");
                faults.push(Fault::new(format!("sequence[{index}]"), message));
                first_seen.insert(role, first);
            }
        }
    }

    fn check_decodable(&self, faults: &mut Vec<Fault>) {
        if !self.sequence.iter().any(|role| matches!(role, Role::Code { .. })) {
            faults.push(Fault::new(
                "sequence",
                "has no code frames (role \"code\"): nothing can be decoded; capture the scene again",
            ));
        }
        for axis in [Axis::Column, Axis::Row] {
            faults.extend(self.missing_bits(axis));
        }
    }

    /// Only the finest bits may be missing: without a coarser one no word can be read.
    fn missing_bits(&self, axis: Axis) -> Option<Fault> {
        let present: BTreeSet<u8> = self
            .sequence
            .iter()
            .filter_map(|role| match role {
                Role::Code { axis: of, bit, .. } if *of == axis => Some(*bit),
                _ => None,
            })
            .collect();
        let finest = *present.last()?;
        let missing: Vec<String> =
            (0..finest).filter(|bit| !present.contains(bit)).map(|bit| bit.to_string()).collect();
        (!missing.is_empty()).then(|| {
            let list = missing.join(", ");
            Fault::new(
                "sequence",
                format!("{axis} bits {list} are missing while bit {finest} is there: only the finest may be missing"),
            )
        })
    }

    /// Roles that do not belong to `mode`.
    pub(super) fn check_roles(&self, mode: Mode, faults: &mut Vec<Fault>) {
        for (index, role) in self.sequence.iter().enumerate() {
            let belongs = match role {
                Role::ReferenceV | Role::ReferenceH => mode.is_polarized(),
                Role::White | Role::Black => !mode.is_polarized(),
                Role::Code { .. } => true,
            };
            if !belongs {
                let own = if mode.is_polarized() { "reference-v and reference-h" } else { "white and black" };
                let message = format!("{role} does not belong to mode {mode}, whose references are {own}");
                faults.push(Fault::new(format!("sequence[{index}].role"), message));
            }
        }
    }

    fn check_frames(&self, policy: Policy, faults: &mut Vec<Fault>) {
        match &self.frames {
            FrameFiles::Npy(name) if !has_extension(name, "npy") => faults.push(Fault::new(
                "frames",
                format!("{name:?} is not a .npy: give the name of one .npy or a list of images"),
            )),
            FrameFiles::Images(paths) if paths.len() != self.sequence.len() => faults.push(Fault::new(
                "frames",
                format!("has {} images for the {} entries of `sequence`", paths.len(), self.sequence.len()),
            )),
            _ => {}
        }
        for (index, path) in self.frames.paths().iter().enumerate() {
            let key = match self.frames {
                FrameFiles::Npy(_) => "frames".to_owned(),
                FrameFiles::Images(_) => format!("frames[{index}]"),
            };
            if matches!(self.frames, FrameFiles::Images(_)) && has_extension(path, "npy") {
                faults.push(Fault::new(key.clone(), "a .npy holds all frames: give its name without a list"));
            }
            faults
                .extend(path_fault(path, policy).map(|reason| Fault::new(key, format!("{path:?} {reason}"))));
        }
        if let Some(path) = &self.calibration {
            faults.extend(
                path_fault(path, policy)
                    .map(|reason| Fault::new("calibration", format!("{path:?} {reason}"))),
            );
        }
    }

    fn check_camera(&self, faults: &mut Vec<Fault>) {
        let Some(camera) = self.camera else { return };
        let mut fault =
            |key: &str, message: String| faults.push(Fault::new(format!("camera.{key}"), message));
        for (key, side) in [("width", camera.width), ("height", camera.height)] {
            if side == Some(0) {
                fault(key, "must be at least 1 px".to_owned());
            }
        }
        let bit_depth = camera.bit_depth.filter(|bits| (1..=16).contains(bits));
        if let (Some(given), None) = (camera.bit_depth, bit_depth) {
            fault("bit_depth", format!("is {given}, expected 1 to 16 significant bits"));
        }
        let full_scale = bit_depth.map_or(u16::MAX, full_scale);
        if let Some(saturation) = camera.saturation.filter(|&level| level == 0 || level > full_scale) {
            fault("saturation", format!("is {saturation} DN, expected 1 to {full_scale}"));
        }
        let limit = f64::from(camera.saturation.unwrap_or(full_scale));
        if let Some(black) = camera.black_level.filter(|black| !(0.0..limit).contains(black)) {
            fault(
                "black_level",
                format!("is {black} DN, expected at least 0 and less than the saturation {limit}"),
            );
        }
        if let Some(gain) = camera.gain_dn_per_electron.filter(|gain| !(gain.is_finite() && *gain > 0.0)) {
            fault("gain_dn_per_electron", format!("is {gain}, expected a positive number"));
        }
        if let Some(noise) = camera.read_noise_dn.filter(|noise| !(noise.is_finite() && *noise >= 0.0)) {
            fault("read_noise_dn", format!("is {noise}, expected a number that is not negative"));
        }
        if camera.gain_dn_per_electron.is_some() != camera.read_noise_dn.is_some() {
            let (given, missing) = match camera.read_noise_dn {
                None => ("gain_dn_per_electron", "read_noise_dn"),
                Some(_) => ("read_noise_dn", "gain_dn_per_electron"),
            };
            fault(
                missing,
                format!("is missing while {given} is given: give both, or neither to have them estimated"),
            );
        }
    }

    fn check_own(&self, faults: &mut Vec<Fault>) {
        if let Some(capture) = &self.capture
            && capture.frames.len() != self.sequence.len()
        {
            let message = format!(
                "has {} records for {} entries of `sequence`",
                capture.frames.len(),
                self.sequence.len()
            );
            faults.push(Fault::new("capture.frames", message));
        }
        if let Some(processing) = &self.processing {
            if let Some(volume) = processing.volume
                && !(volume.near_mm > 0.0 && volume.near_mm < volume.far_mm && volume.far_mm.is_finite())
            {
                let message = format!("from {} to {} mm is no range", volume.near_mm, volume.far_mm);
                faults.push(Fault::new("processing.volume", message));
            }
            for (index, region) in processing.regions.iter().enumerate() {
                if region.width == 0 || region.height == 0 {
                    faults.push(Fault::new(format!("processing.regions[{index}]"), "is empty"));
                }
            }
            if !(processing.row_gate_px.is_finite() && processing.row_gate_px > 0.0) {
                let message = format!("is {} px, expected a positive number", processing.row_gate_px);
                faults.push(Fault::new("processing.row_gate_px", message));
            }
            let gates = processing.thresholds.faults().into_iter();
            faults.extend(
                gates.map(|(key, message)| Fault::new(format!("processing.thresholds.{key}"), message)),
            );
        }
        for (name, entry) in &self.files {
            if entry.sha256.len() != 64 || !entry.sha256.bytes().all(|digit| digit.is_ascii_hexdigit()) {
                faults.push(Fault::new(
                    format!("files.{name}.sha256"),
                    "is not a SHA-256 of 64 hexadecimal digits",
                ));
            }
            if let Some(reason) = path_fault(name, Policy::Upload) {
                faults.push(Fault::new(format!("files.{name}"), reason));
            }
        }
    }
}

/// Largest sample of `bits` significant bits.
pub(crate) fn full_scale(bits: u8) -> u16 {
    ((1u32 << bits.min(16)) - 1) as u16
}

fn has_extension(path: &str, extension: &str) -> bool {
    Path::new(path).extension().is_some_and(|found| found.eq_ignore_ascii_case(extension))
}

/// Why `path` must not be followed under `policy`.
pub(crate) fn path_fault(path: &str, policy: Policy) -> Option<&'static str> {
    if path.is_empty() {
        return Some("is an empty path");
    }
    if path.contains('\0') {
        return Some("holds a NUL byte");
    }
    if policy == Policy::Local {
        return None;
    }
    // A backslash separates on other systems, where the upload may have been packed to escape.
    let escapes = path.contains('\\')
        || Path::new(path).components().any(|part| !matches!(part, Component::Normal(_) | Component::CurDir));
    escapes.then_some("leads out of the bundle: give a path inside it")
}
