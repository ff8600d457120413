//! Frames of analytic scenes with known projector coordinates: stripes blurred by a Gaussian and averaged over the
//! pixel in closed form, shot and read noise, rounding. Knows nothing of the decoder.

use std::sync::Arc;

use polscan_patterns::{Axis, AxisCode, Mode, ProjectorSize, Role, Sequence};

use crate::decode::{
    Accumulator, CameraResponse, DecodeError, DecodeSettings, Decoded, NoiseModel, SharedPlane, Thresholds,
};

/// What a camera pixel sees.
#[derive(Debug, Clone, Copy)]
pub struct Spot {
    /// Projector column.
    pub u: f64,
    /// Projector row.
    pub v: f64,
    /// Bright level as a share of the rig's full level; 0 where no projector light falls.
    pub reflectance: f64,
    /// Share of the bright level that the dark state has; above 1 the polarity is inverted.
    pub leak: f64,
    /// Which surface it is on.
    pub surface: u32,
}

impl Default for Spot {
    fn default() -> Self {
        Self { u: 0.0, v: 0.0, reflectance: 1.0, leak: 0.02, surface: 0 }
    }
}

/// A camera with its noise, and the blur of the whole chain.
#[derive(Debug, Clone, Copy)]
pub struct Rig {
    /// Pixels of a row.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Bits of a sample.
    pub bit_depth: u8,
    /// Electrons at which a pixel is full.
    pub full_well: f64,
    /// Read noise in electrons, standard deviation.
    pub read_electrons: f64,
    /// Level without light.
    pub black_dn: f64,
    /// Electrons of light that does not come from the projector.
    pub ambient_electrons: f64,
    /// Level of reflectance 1 as a share of full well.
    pub level: f64,
    /// Blur in camera px, standard deviation.
    pub blur_px: f64,
    /// Frames of equal seeds are equal.
    pub seed: u64,
}

impl Default for Rig {
    fn default() -> Self {
        Self {
            width: 320,
            height: 96,
            bit_depth: 12,
            full_well: 10_500.0,
            read_electrons: 2.3,
            black_dn: 41.0,
            ambient_electrons: 20.0,
            level: 0.9,
            blur_px: 1.9,
            seed: 1,
        }
    }
}

/// A fixed pseudo-random 64-bit number (splitmix64).
pub fn random(key: u64) -> u64 {
    let mut z = key.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    z ^ (z >> 31)
}

/// Uniform in (0, 1).
pub fn uniform(key: u64) -> f64 {
    ((random(key) >> 11) as f64 + 0.5) / (1u64 << 53) as f64
}

/// Standard normal (Box-Muller).
pub fn normal(key: u64) -> f64 {
    let (a, b) = (uniform(key.wrapping_mul(2)), uniform(key.wrapping_mul(2).wrapping_add(1)));
    (-2.0 * a.ln()).sqrt() * (2.0 * std::f64::consts::PI * b).cos()
}

/// Error function to 1.2e-7 (Chebyshev fit of erfc, as in the usual numerical handbooks).
pub fn erf(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.5 * x.abs());
    let poly = [
        -1.26551223,
        1.00002368,
        0.37409196,
        0.09678418,
        -0.18628806,
        0.27886807,
        -1.13520398,
        1.48851587,
        -0.82215223,
        0.17087277,
    ];
    let sum = poly.iter().rev().fold(0.0, |sum, c| sum * t + c);
    let erfc = t * (-x * x + sum).exp();
    if x >= 0.0 { 1.0 - erfc } else { erfc - 1.0 }
}

/// A unit step at 0, blurred by `sigma` and averaged over `width`, at `x`.
fn soft_step(x: f64, sigma: f64, width: f64) -> f64 {
    let sigma = sigma.max(1e-6);
    let integral = |x: f64| {
        let z = x / sigma;
        let density = (-z * z / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt();
        x * (1.0 + erf(z / std::f64::consts::SQRT_2)) / 2.0 + sigma * density
    };
    let half = width.max(1e-6) / 2.0;
    (integral(x + half) - integral(x - half)) / (2.0 * half)
}

/// Share of the bright state of pattern `bit` around `u`, blurred by `sigma` and averaged over `width`, both in
/// projector px. Outside the projector it is dark.
fn stripe(code: AxisCode, bit: u8, inverse: bool, u: f64, sigma: f64, width: f64) -> f64 {
    let reach = 5.0 * sigma + width + 1.0;
    let first = (u - reach).floor().max(0.0) as u32;
    let last = ((u + reach).ceil().max(0.0) as u32).min(code.size() - 1);
    let level = |index: u32| f64::from(u8::from(code.bit(index, bit) != inverse));
    let mut value = 0.0;
    let mut before = if first == 0 { 0.0 } else { level(first) };
    value += before;
    for index in first..=last {
        let here = level(index);
        if here != before {
            value += (here - before) * soft_step(u - (f64::from(index) - 0.5), sigma, width);
        }
        before = here;
    }
    if last == code.size() - 1 {
        value -= before * soft_step(u - (f64::from(last) + 0.5), sigma, width);
    }
    value
}

/// A scene: what pixel (x, y) sees, at fractional positions too.
pub trait Scene: Fn(f64, f64) -> Spot + Sync {}
impl<F: Fn(f64, f64) -> Spot + Sync> Scene for F {}

impl Rig {
    /// The noise that this camera has.
    pub fn noise(&self) -> NoiseModel {
        let gain = f64::from((1u32 << self.bit_depth) - 1) / self.full_well;
        NoiseModel { gain_dn_per_electron: gain, read_noise_dn: gain * self.read_electrons }
    }

    /// What a decoder is told of this camera.
    pub fn camera(&self) -> CameraResponse {
        CameraResponse {
            bit_depth: self.bit_depth,
            black_level_dn: Some(self.black_dn),
            saturation_dn: ((1u32 << self.bit_depth) - 1) as u16,
            noise: Some(self.noise()),
        }
    }

    /// Frame `number` of a scan, showing `role`.
    pub fn frame(&self, scene: &impl Scene, sequence: &Sequence, role: Role, number: u64) -> Vec<u16> {
        let gain = self.noise().gain_dn_per_electron;
        let full = f64::from((1u32 << self.bit_depth) - 1);
        let mut out = Vec::with_capacity(self.width * self.height);
        for y in 0..self.height {
            for x in 0..self.width {
                let (fx, fy) = (x as f64, y as f64);
                // Pixels across the border of two surfaces see a part of each.
                let spots = [-0.375, -0.125, 0.125, 0.375].map(|off| scene(fx + off, fy));
                let mixed = spots.iter().any(|spot| spot.surface != spots[0].surface);
                let light = if mixed {
                    [-0.375, -0.125, 0.125, 0.375]
                        .map(|off| self.light(scene, sequence, role, fx + off, fy, 0.25))
                        .iter()
                        .sum::<f64>()
                        / 4.0
                } else {
                    self.light(scene, sequence, role, fx, fy, 1.0)
                };
                let electrons = light + self.ambient_electrons;
                let key = (self.seed << 48) ^ (number << 32) ^ ((y * self.width + x) as u64);
                let noisy =
                    electrons + normal(key) * (electrons + self.read_electrons * self.read_electrons).sqrt();
                let dn = self.black_dn + gain * noisy.min(self.full_well * 1.2);
                out.push(dn.round().clamp(0.0, full) as u16);
            }
        }
        out
    }

    /// Electrons of projector light at a place.
    fn light(&self, scene: &impl Scene, sequence: &Sequence, role: Role, x: f64, y: f64, size: f64) -> f64 {
        let spot = scene(x, y);
        let bright = spot.reflectance * self.level * self.full_well;
        let share = match role {
            Role::ReferenceH | Role::White => 1.0,
            Role::ReferenceV | Role::Black => 0.0,
            Role::Code { axis, bit, inverse } => {
                let along = |spot: Spot| if axis == Axis::Column { spot.u } else { spot.v };
                let slope = |dx: f64, dy: f64| {
                    let other = scene(x + dx, y + dy);
                    if other.surface == spot.surface { (along(other) - along(spot)) / 0.01 } else { 0.0 }
                };
                let (sx, sy) = (slope(0.01, 0.0), slope(0.0, 0.01));
                let sigma = self.blur_px * sx.hypot(sy);
                stripe(sequence.code(axis), bit, inverse, along(spot), sigma, size * sx.abs().max(sy.abs()))
            }
        };
        bright * (spot.leak + (1.0 - spot.leak) * share)
    }

    /// All frames of a sequence.
    pub fn scan(&self, scene: &impl Scene, sequence: &Sequence) -> Vec<(Role, Vec<u16>)> {
        use rayon::prelude::*;
        let numbered: Vec<_> = sequence.roles.iter().copied().enumerate().collect();
        numbered
            .into_par_iter()
            .map(|(number, role)| (role, self.frame(scene, sequence, role, number as u64)))
            .collect()
    }

    /// Settings of a decode of its frames.
    pub fn settings(&self, sequence: &Sequence) -> DecodeSettings {
        DecodeSettings {
            mode: sequence.mode,
            column: sequence.column,
            row: sequence.row,
            width: self.width,
            height: self.height,
            camera: self.camera(),
            thresholds: Thresholds::default(),
        }
    }

    /// What the decoder makes of a scan of a scene.
    ///
    /// # Panics
    /// If the decoder refuses it.
    pub fn decode(&self, scene: &impl Scene, sequence: &Sequence) -> Decoded {
        decode(self.settings(sequence), self.scan(scene, sequence))
            .expect("a scan of a known sequence decodes")
    }
}

/// Decodes frames; those of at most 8 bits as bytes.
///
/// # Errors
/// As [`Accumulator::finish`].
pub fn decode(settings: DecodeSettings, frames: Vec<(Role, Vec<u16>)>) -> Result<Decoded, DecodeError> {
    let bytes = settings.camera.bit_depth <= 8;
    let mut accumulator = Accumulator::new(settings)?;
    for (role, frame) in frames {
        let plane: SharedPlane = if bytes {
            Arc::new(frame.iter().map(|&s| s as u8).collect::<Vec<u8>>())
        } else {
            Arc::new(frame)
        };
        accumulator.push(role, plane)?;
    }
    accumulator.finish()
}

/// The sequence of a mode on the projector of the paper.
pub fn sequence(mode: Mode) -> Sequence {
    Sequence::new(mode, ProjectorSize { width: 1024, height: 768 }).expect("sizes in range")
}

/// Comparison of the columns with the truth over pixels away from surface borders.
#[derive(Debug, Clone, Copy)]
pub struct Accuracy {
    /// Share of the lit pixels that are valid.
    pub coverage: f64,
    /// Share of the valid pixels off by more than 1.5.
    pub wrong: f64,
    /// Root mean square of the error.
    pub rms: f64,
    /// Mean of the error.
    pub bias: f64,
    /// 1.4826 MAD of error / sigma.
    pub normalised: f64,
    /// Root mean square of error / sigma.
    pub normalised_rms: f64,
    /// Median of the sigma that the decoder states.
    pub median_sigma: f64,
    /// Share of the valid pixels without a sub-pixel position.
    pub fallback: f64,
}

/// Compares a decode with the truth in a region.
///
/// # Panics
/// Where a valid pixel has no number, or the decode lacks the axis.
pub fn accuracy(
    rig: &Rig,
    scene: &impl Scene,
    decoded: &Decoded,
    axis: Axis,
    region: impl Fn(usize, usize) -> bool,
) -> Accuracy {
    let map =
        if axis == Axis::Column { &decoded.column } else { decoded.row.as_ref().expect("the mode has rows") };
    let (mut lit, mut wrong) = (0u64, 0u64);
    let (mut errors, mut normalised, mut sigmas) = (Vec::new(), Vec::new(), Vec::new());
    let mut fallback = 0u64;
    for y in 0..rig.height {
        for x in 0..rig.width {
            let spot = scene(x as f64, y as f64);
            if !region(x, y) || spot.reflectance == 0.0 {
                continue;
            }
            let alone = (-2..=2).all(|dy| {
                (-2..=2).all(|dx| {
                    scene(x as f64 + f64::from(dx), y as f64 + f64::from(dy)).surface == spot.surface
                })
            });
            if !alone {
                continue;
            }
            lit += 1;
            if !decoded.class.at(x, y).is_valid() {
                continue;
            }
            let truth = if axis == Axis::Column { spot.u } else { spot.v };
            let error = f64::from(map.coordinate.at(x, y)) - truth;
            let sigma = f64::from(map.sigma.at(x, y));
            assert!(error.is_finite() && sigma.is_finite() && sigma > 0.0, "({x}, {y}): {error} {sigma}");
            wrong += u64::from(error.abs() > 1.5);
            fallback += u64::from(sigma == f64::from(1.0 / 12f32.sqrt()));
            errors.push(error);
            normalised.push(error / sigma);
            sigmas.push(sigma);
        }
    }
    let n = errors.len() as f64;
    let mean_square = |values: &[f64]| (values.iter().map(|e| e * e).sum::<f64>() / n).sqrt();
    let median = |values: &[f64]| {
        let mut sorted = values.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
    };
    let centre = median(&normalised);
    let spread: Vec<f64> = normalised.iter().map(|e| (e - centre).abs()).collect();
    Accuracy {
        coverage: n / lit as f64,
        wrong: wrong as f64 / n,
        rms: mean_square(&errors),
        bias: errors.iter().sum::<f64>() / n,
        normalised: 1.4826 * median(&spread),
        normalised_rms: mean_square(&normalised),
        median_sigma: median(&sigmas),
        fallback: fallback as f64 / n,
    }
}
