//! From a manifest to what the decoder needs, with the defaults of the schema filled in.

use polscan_patterns::{Axis, Mode, ProjectorSize, Role, Sequence};

use super::{Manifest, check::full_scale};
use crate::{
    decode::{CameraResponse, DecodeSettings, NoiseModel},
    store::error::{Fault, Faults},
};

impl Manifest {
    /// The sequence of the frames. `mode` comes before the manifest's own; `projector` is used where the manifest
    /// gives no size, as a calibration may know it.
    pub fn resolve_sequence(
        &self,
        mode: Option<Mode>,
        projector: Option<ProjectorSize>,
    ) -> Result<Sequence, Faults> {
        let mut faults = Vec::new();
        let mode = mode.or(self.mode).or_else(|| self.mode_of_references());
        match mode {
            Some(mode) => self.check_roles(mode, &mut faults),
            None => faults.push(Fault::new(
                "mode",
                "is missing and the references leave it open: give paper, pse, fast or gray",
            )),
        }
        let projector = self.projector.or(projector);
        if projector.is_none() {
            faults.push(Fault::new(
                "projector",
                "is missing: give its width and height, or a calibration that does",
            ));
        }
        let code =
            |axis, side: fn(ProjectorSize) -> u32| projector.map(|size| self.axis_code(axis, side(size)));
        let mut keep = |code: Option<Result<_, Fault>>| match code? {
            Ok(code) => Some(code),
            Err(fault) => {
                faults.push(fault);
                None
            }
        };
        let column = keep(code(Axis::Column, |size| size.width));
        let row = keep(code(Axis::Row, |size| size.height));
        match (mode, column, row) {
            (Some(mode), Some(column), Some(row)) if faults.is_empty() => {
                Ok(Sequence { mode, column, row, roles: self.sequence.clone() })
            }
            _ => Err(Faults(faults)),
        }
    }

    /// The only mode that has these references, if there is one.
    fn mode_of_references(&self) -> Option<Mode> {
        let has = |wanted: Role| self.sequence.contains(&wanted);
        match (has(Role::ReferenceH), has(Role::White) || has(Role::Black)) {
            (true, false) => Some(Mode::Pse),
            (false, true) => Some(Mode::Gray),
            _ => None,
        }
    }

    /// Significant bits of a sample stored in `sample_bits` (8 or 16).
    pub fn bit_depth(&self, sample_bits: u8) -> u8 {
        self.camera.and_then(|camera| camera.bit_depth).unwrap_or(sample_bits)
    }

    /// Everything that fixes a decode of frames of `width` x `height` samples of `sample_bits`, coded as `sequence`.
    pub fn decode_settings(
        &self,
        sequence: &Sequence,
        (width, height): (usize, usize),
        sample_bits: u8,
    ) -> DecodeSettings {
        let camera = self.camera.unwrap_or_default();
        let bit_depth = self.bit_depth(sample_bits);
        let noise = camera
            .gain_dn_per_electron
            .zip(camera.read_noise_dn)
            .map(|(gain_dn_per_electron, read_noise_dn)| NoiseModel { gain_dn_per_electron, read_noise_dn });
        DecodeSettings {
            mode: sequence.mode,
            column: sequence.column,
            row: sequence.row,
            width,
            height,
            camera: CameraResponse {
                bit_depth,
                black_level_dn: camera.black_level,
                saturation_dn: camera.saturation.unwrap_or(full_scale(bit_depth)),
                noise,
            },
            thresholds: self.processing.as_ref().map(|processing| processing.thresholds).unwrap_or_default(),
        }
    }
}
