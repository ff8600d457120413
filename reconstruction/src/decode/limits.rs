//! Levels and thresholds of a decode in the form that the pixel loops want.

use polscan_patterns::Mode;

use super::types::{CameraResponse, DecodeSettings, NoiseModel};

/// Everything that is fixed for a decode.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Gates {
    pub mode: Mode,
    pub noise: NoiseModel,
    pub black_dn: f32,
    pub saturation_dn: i32,
    pub lit_sigma: f32,
    pub soft_sigma: f32,
    pub full_scale_dn: f32,
}

impl Gates {
    pub fn new(settings: &DecodeSettings, noise: NoiseModel) -> Self {
        Self {
            mode: settings.mode,
            noise,
            black_dn: settings.camera.black_level_dn.unwrap_or(0.0) as f32,
            saturation_dn: i32::from(settings.camera.saturation_dn),
            lit_sigma: settings.thresholds.lit_sigma as f32,
            soft_sigma: settings.thresholds.soft_bit_sigma as f32,
            full_scale_dn: ((1u32 << settings.camera.bit_depth) - 1) as f32,
        }
    }

    /// What a check of a single pair needs.
    pub fn for_check(camera: CameraResponse, noise: NoiseModel, lit_sigma: f64) -> Self {
        Self {
            mode: Mode::Pse,
            noise,
            black_dn: camera.black_level_dn.unwrap_or(0.0) as f32,
            saturation_dn: i32::from(camera.saturation_dn),
            lit_sigma: lit_sigma as f32,
            soft_sigma: 0.0,
            full_scale_dn: 1.0,
        }
    }

    /// Variance of one sample at `dn`.
    #[inline(always)]
    pub fn variance(&self, dn: f32) -> f32 {
        self.fixed_variance() + self.noise.gain_dn_per_electron as f32 * (dn - self.black_dn).max(0.0)
    }

    #[inline(always)]
    fn fixed_variance(&self) -> f32 {
        (self.noise.read_noise_dn * self.noise.read_noise_dn + 1.0 / 12.0) as f32
    }

    /// Degree of linear polarization of a sample against the dark reference, both in DN (Eq. 5): 0 where their sum is
    /// not positive after dark subtraction.
    #[inline(always)]
    pub fn dolp(&self, dn: f32, dark_dn: f32) -> f32 {
        let sum = dn + dark_dn - 2.0 * self.black_dn;
        if sum > 0.0 { (dn - dark_dn) / sum } else { 0.0 }
    }
}
