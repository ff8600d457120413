use std::sync::Arc;

use polscan_drivers::{
    clock::Timestamp,
    frame::{FrameStamp, PixelStore},
};

use super::*;

/// The splitmix64 generator.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn residual() -> PairResidual {
    PairResidual {
        axis: Axis::Column,
        bit: 3,
        sigma: 1.0,
        median: 0.01,
        flat_outliers: 1e-6,
        edge_outliers: 1e-4,
        pixels: 500_000,
    }
}

fn ruled(residual: PairResidual) -> String {
    name(judge_rule(&residual, 10, &PairThresholds::default()))
}

fn name(verdict: PairVerdict) -> String {
    match verdict {
        PairVerdict::Accept => "accept".to_string(),
        PairVerdict::Degraded(suspicion) => format!("degraded {}", suspicion.reason),
        PairVerdict::Retake(suspicion) => format!("retake {}", suspicion.reason),
    }
}

#[test]
fn the_rule_names_what_the_statistics_support() {
    let base = residual();
    let check =
        |residual: PairResidual, expected: &str| assert_eq!(ruled(residual), expected, "{residual:?}");
    check(base, "accept");
    check(PairResidual { sigma: 1.3, ..base }, "accept");
    check(PairResidual { flat_outliers: 0.35, sigma: 8.0, ..base }, "retake stale-frame");
    check(PairResidual { flat_outliers: 0.08, sigma: 1.1, ..base }, "retake torn-frame");
    check(PairResidual { flat_outliers: 0.008, ..base }, "retake motion");
    check(PairResidual { median: -6.0, flat_outliers: 0.9, ..base }, "retake flicker");
    check(PairResidual { median: 1.4, ..base }, "degraded exposure-drift");
    check(PairResidual { edge_outliers: 0.3, ..base }, "degraded nonlinear-response");
    check(PairResidual { sigma: 2.0, ..base }, "degraded noise-model");
}

#[test]
fn the_finest_bits_may_be_nonlinear_everywhere_but_not_stale() {
    let base = residual();
    for (bit, expected) in
        [(7, "retake torn-frame"), (8, "degraded nonlinear-response"), (9, "degraded nonlinear-response")]
    {
        assert_eq!(
            ruled(PairResidual { bit, flat_outliers: 0.1, sigma: 3.0, ..base }),
            expected,
            "bit {bit}"
        );
    }
    assert_eq!(ruled(PairResidual { bit: 9, flat_outliers: 0.4, ..base }), "retake stale-frame");
    // No pixel of the finest bit is flat: its share is not a number.
    assert_eq!(ruled(PairResidual { bit: 9, flat_outliers: f64::NAN, ..base }), "accept");
}

#[test]
fn what_cannot_be_judged_is_not_called_good() {
    let base = residual();
    assert_eq!(ruled(PairResidual { pixels: 99, ..base }), "degraded unverified-pair");
    assert_eq!(
        ruled(PairResidual { pixels: 0, sigma: f64::NAN, median: f64::NAN, ..base }),
        "degraded unverified-pair"
    );
    assert_eq!(ruled(PairResidual { sigma: f64::NAN, ..base }), "degraded unverified-pair");
}

#[test]
fn evidence_carries_its_figures() {
    let PairVerdict::Retake(suspicion) = judge_rule(
        &PairResidual { flat_outliers: 0.25, sigma: 3.25, ..residual() },
        10,
        &PairThresholds::default(),
    ) else {
        panic!("not a re-take")
    };
    assert_eq!(suspicion.sigma, 3.25);
    for figure in ["column bit 3", "25.00 % of flat", "sigma 3.25", "median +0.01", "500000 pixels"] {
        assert!(suspicion.evidence.contains(figure), "{}", suspicion.evidence);
    }
}

const SIDE: u32 = 200;
const BLACK_DN: f64 = 40.0;
const NOISE: NoiseModel = NoiseModel { gain_dn_per_electron: 0.4, read_noise_dn: 1.0 };

/// A frame of levels (DN above black) with noise.
fn frame(rng: &mut Random, level: impl Fn(u32, u32) -> f64) -> Frame {
    let mut samples = Vec::new();
    for y in 0..SIDE {
        for x in 0..SIDE {
            let level = level(x, y);
            // Twelve uniform variables make a normal one of unit variance.
            let normal = (0..12).map(|_| rng.uniform()).sum::<f64>() - 6.0;
            let spread = (NOISE.variance(level) - 1.0 / 12.0).sqrt();
            samples.push((BLACK_DN + level + normal * spread).round().clamp(0.0, 4095.0) as u16);
        }
    }
    let stamp = FrameStamp {
        frame_id: 0,
        trigger: 0,
        exposure_start: Timestamp(0),
        received: Timestamp(0),
        device_time_ns: None,
    };
    let store: Arc<dyn PixelStore> = Arc::new(samples);
    Frame { width: SIDE, height: SIDE, bit_depth: 12, stamp, store }
}

/// Three materials under light of one polarization.
fn scene(x: u32, y: u32) -> f64 {
    [300.0, 1200.0, 2500.0][((x / 40 + y / 25) % 3) as usize]
}

fn compare(after: impl Fn(u32, u32) -> f64) -> ReferenceChange {
    let mut rng = Random(7);
    let first = frame(&mut rng, scene);
    let last = frame(&mut rng, after);
    let camera = CameraResponse {
        bit_depth: 12,
        black_level_dn: Some(BLACK_DN),
        saturation_dn: 4095,
        noise: Some(NOISE),
    };
    compare_references(&first, &last, &camera, NOISE).unwrap()
}

fn drift(after: impl Fn(u32, u32) -> f64) -> String {
    name(drift_rule(Role::ReferenceH, &compare(after), &PairThresholds::default()))
}

#[test]
fn equal_references_differ_by_their_noise_only() {
    let change = compare(scene);
    assert!((change.sigma - 1.0).abs() < 0.03, "{change:?}");
    assert!(
        change.median.abs() < 0.05 && change.gain.abs() < 1e-3 && change.offset_dn.abs() < 1.0,
        "{change:?}"
    );
    assert!(change.outliers < 1e-3);
    assert_eq!(change.pixels, u64::from(SIDE * SIDE));
    assert_eq!(drift(scene), "accept");
}

#[test]
fn changes_of_light_are_measured_and_named() {
    let lamp = compare(|x, y| scene(x, y) * 0.93);
    assert!((lamp.gain + 0.0725).abs() < 0.003, "{lamp:?}");
    assert!((lamp.sigma - 1.0).abs() < 0.1, "gain and offset explain it: {lamp:?}");
    assert_eq!(drift(|x, y| scene(x, y) * 0.93), "degraded exposure-drift");
    let ambient = compare(|x, y| scene(x, y) + 60.0);
    assert!((ambient.offset_dn - 60.0).abs() < 2.0 && ambient.gain.abs() < 0.003, "{ambient:?}");
    assert_eq!(drift(|x, y| scene(x, y) + 60.0), "degraded ambient-drift");
}

#[test]
fn changes_of_the_picture_are_told_from_changes_of_light() {
    let moved = |x: u32, y: u32| if x < 20 && y < 60 { 2000.0 } else { scene(x, y) };
    assert_eq!(drift(moved), "retake motion");
    assert_eq!(drift(|x, y| scene(x, y) / 40.0), "retake stale-frame");
    assert_eq!(drift(|x, y| if y < 90 { scene(x, y) / 40.0 } else { scene(x, y) }), "retake stale-frame");
}

#[test]
fn frames_that_cannot_be_compared_say_so() {
    let mut rng = Random(7);
    let white = frame(&mut rng, |_, _| 5000.0);
    let camera = CameraResponse { bit_depth: 12, black_level_dn: None, saturation_dn: 4095, noise: None };
    let saturated = compare_references(&white, &white, &camera, NOISE).unwrap();
    assert_eq!(saturated.pixels, 0);
    let verdict = drift_rule(Role::White, &saturated, &PairThresholds::default());
    assert_eq!(name(verdict), "degraded unverified-reference");
    let smaller = Frame { width: 10, ..white.clone() };
    assert_eq!(compare_references(&white, &smaller, &camera, NOISE), None);
}

#[test]
fn a_uniform_scene_has_no_gain_to_tell() {
    let camera = CameraResponse { bit_depth: 12, black_level_dn: None, saturation_dn: 4095, noise: None };
    let uniform = |level: u16| {
        let store: Arc<dyn PixelStore> = Arc::new(vec![level; 400]);
        Frame { width: 20, height: 20, store, ..frame(&mut Random(3), scene) }
    };
    let check = |last: u16, expected: &str| {
        let change = compare_references(&uniform(500), &uniform(last), &camera, NOISE).unwrap();
        assert!(change.gain.is_nan() && change.offset_dn == f64::from(last) - 500.0, "{change:?}");
        assert_eq!(name(drift_rule(Role::Black, &change, &PairThresholds::default())), expected);
    };
    check(500, "accept");
    check(560, "degraded ambient-drift");
}
