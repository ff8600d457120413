//! The fast loops against the plain ones, to the bit, with every set of vector instructions that this machine has.

use std::sync::Arc;

use polscan_patterns::{Axis, Mode, Role};
use proptest::prelude::*;

use crate::{
    decode::{
        CameraResponse, DecodeSettings, NoiseModel, PlaneSource, SharedPlane, gates,
        limits::Gates,
        pair_sum,
        plan::{Frames, plan},
        sample::Sample,
        synth::{Rig, Spot, random, sequence, uniform},
        words::{self, PixelMaps, decode_pixels},
    },
    simd::InstructionSet,
};

/// Frames of two surfaces with a jump between them, and of what breaks scans: a saturated patch, a dark one, inverted
/// polarity, a pair of another bit, words that are plainly wrong.
fn frames_of(mode: Mode, [width, height]: [usize; 2], seed: u64) -> (Vec<(Role, Vec<u16>)>, Rig) {
    let rig = Rig { width, height, ..Rig::default() };
    let jump = uniform(random(seed)) * width as f64;
    // All of it within the projector.
    let slope = (0.3 + uniform(random(seed ^ 1))).min(700.0 / width as f64);
    let scene = |x: f64, y: f64| {
        let behind = x > jump;
        Spot {
            u: 200.0 + slope * x + if behind { 37.0 } else { 0.0 },
            v: 100.0 + 0.8 * y - if behind { 21.0 } else { 0.0 },
            reflectance: if y < height as f64 * 0.3 && behind { 0.01 } else { 0.3 + 0.2 * (x / 9.0).sin() },
            surface: u32::from(behind),
            ..Spot::default()
        }
    };
    let mut frames = rig.scan(&scene, &sequence(mode));
    let full = rig.camera().saturation_dn;
    let count = frames.len();
    for (number, (_, frame)) in frames.iter_mut().enumerate() {
        for (at, sample) in frame.iter_mut().enumerate() {
            let pixel = random(seed ^ random(at as u64));
            // Full in all frames, in some frames, and noise in some.
            match pixel % 97 {
                0 => *sample = full,
                1 if random(pixel ^ number as u64).is_multiple_of(8) => *sample = full,
                2 => *sample = (random(pixel ^ number as u64) % u64::from(full)) as u16,
                _ => {}
            }
        }
    }
    if seed.is_multiple_of(3) {
        let (one, other) = (seed as usize % count, (seed / 7) as usize % count);
        let copy = frames[one].1.clone();
        frames[other].1 = copy;
    }
    (frames, rig)
}

fn same_bits(a: &[f32], b: &[f32]) -> bool {
    a.iter().zip(b).all(|(a, b)| a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()))
}

fn assert_same(fast: &PixelMaps, plain: &PixelMaps, what: &str) {
    assert!(fast.class == plain.class, "{what}: classes");
    assert!(fast.words == plain.words, "{what}: words");
    assert!(fast.values == plain.values, "{what}: values");
    assert!(fast.half_saturated == plain.half_saturated, "{what}: saturation");
    assert!(fast.weakest == plain.weakest, "{what}: weakness");
    assert!(fast.intensity == plain.intensity, "{what}: intensity");
    for (name, a, b) in [
        ("modulation", &fast.modulation, &plain.modulation),
        ("sigma", &fast.sigma, &plain.sigma),
        ("residual", &fast.residual, &plain.residual),
        ("dolp", &fast.dolp, &plain.dolp),
    ] {
        assert!(same_bits(a, b), "{what}: {name}");
    }
}

fn check<T: Sample>(settings: &DecodeSettings, frames: &[(Role, SharedPlane)]) {
    let Ok(plan): Result<Frames<'_, T>, _> = plan(settings, frames) else { return };
    let noise = NoiseModel { gain_dn_per_electron: 0.02, read_noise_dn: 0.8 };
    let limits = Gates::new(settings, settings.camera.noise.unwrap_or(noise));
    let fresh = || PixelMaps::new(settings.width * settings.height, plan.axes.len());
    let mut plain = fresh();
    words::plain::decode_pixels(&plan, &limits, &mut plain);
    let mut plain_gated = plain.clone();
    let plain_found = gates::plain::apply(&plan, &mut plain_gated, &settings.thresholds);
    let plain_pairs = pair_sum::plain::of_scan(&plan, &plain, &limits);
    for set in InstructionSet::available() {
        let mut fast = fresh();
        decode_pixels(&plan, &limits, set, &mut fast);
        assert_same(&fast, &plain, &format!("{set:?}"));
        assert_eq!(
            format!("{:?}", pair_sum::of_scan(&plan, &fast, &limits, set)),
            format!("{plain_pairs:?}"),
            "{set:?}"
        );
        let found = gates::apply(&plan, &mut fast, &settings.thresholds, set);
        assert_eq!(found, plain_found, "{set:?}");
        assert!(fast.class == plain_gated.class, "{set:?}: classes after the gates");
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    #[test]
    fn blocks_equal_single_pixels(
        seed: u64,
        mode in prop::sample::select(Mode::ALL.to_vec()),
        size in prop::sample::select(vec![[1usize, 5usize], [2, 2], [37, 40], [511, 8], [512, 9], [513, 7], [1100, 6]]),
        bytes: bool,
        lacking in 0u8..5,
    ) {
        let (mut frames, rig) = frames_of(mode, size, seed);
        frames.retain(|(role, _)| match (lacking, *role) {
            (1, Role::ReferenceH | Role::White) => false,
            (2, Role::ReferenceV | Role::Black) => false,
            (3, Role::Code { axis: Axis::Row, .. }) => false,
            (4, Role::Code { bit, inverse, .. }) => bit % 3 != 0 || inverse,
            _ => true,
        });
        let mut settings = rig.settings(&sequence(mode));
        if bytes {
            settings.camera = CameraResponse {
                bit_depth: 8,
                saturation_dn: 255,
                black_level_dn: settings.camera.black_level_dn.map(|level| level / 16.0),
                noise: None,
            };
            let planes: Vec<_> = frames
                .iter()
                .map(|(role, frame)| (*role, shared(frame.iter().map(|&dn| (dn >> 4) as u8).collect::<Vec<_>>())))
                .collect();
            check::<u8>(&settings, &planes);
        } else {
            let planes: Vec<_> =
                frames.into_iter().map(|(role, frame)| (role, shared(frame))).collect();
            check::<u16>(&settings, &planes);
        }
    }
}

fn shared(plane: impl PlaneSource + 'static) -> SharedPlane {
    Arc::new(plane)
}
