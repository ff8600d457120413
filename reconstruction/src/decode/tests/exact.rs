//! The fast path against the oracle, on random pixels of every kind; order of frames and number of threads.

use std::sync::Arc;

use polscan_patterns::{AxisCode, Mode, ProjectorSize, Role, Sequence};
use proptest::prelude::*;

use crate::decode::synth::{normal, random, uniform};
use crate::{
    decode::{
        Accumulator, CameraResponse, Class, DecodeSettings, NoiseModel, SharedPlane, Thresholds,
        limits::Gates,
        oracle::decode_pixel,
        plan::plan,
        sample::Sample,
        words::{PixelMaps, decode_pixels},
    },
    simd::InstructionSet,
};

const WIDTH: usize = 16;
const HEIGHT: usize = 4;

/// Frames of pixels that have nothing to do with each other: random words (legal or not), levels from dark to
/// saturated, both polarities, noise from none to more than the modulation.
fn random_frames(sequence: &Sequence, bit_depth: u8, seed: u64) -> Vec<(Role, Vec<u16>)> {
    let full = f64::from((1u32 << bit_depth) - 1);
    let frame = |number: usize, role: Role| -> Vec<u16> {
        (0..WIDTH * HEIGHT)
            .map(|at| {
                let key = |salt: u64| random(seed ^ random(at as u64 ^ (salt << 20)));
                let glare = if key(11) % 6 == 0 { 0.9 } else { 0.0 };
                let ambient = (uniform(key(1)).powi(3) * 0.7 + glare) * full;
                let modulation = uniform(key(2)).powi(3) * full * 0.8;
                let noise = uniform(key(3)).powi(3) * full * 0.02;
                let inverted = key(4) % 5 == 0;
                let share = match role {
                    Role::ReferenceH | Role::White => 1.0,
                    Role::ReferenceV | Role::Black => 0.0,
                    Role::Code { axis, bit, inverse } => {
                        let code = sequence.code(axis);
                        // Gray words of indices and of what lies beside the projector.
                        let word = key(5 + axis as u64) % (1 << code.bits());
                        let set = (word >> (code.bits() - 1 - bit)) & 1 == 1;
                        // One bit in some is weak.
                        let weak = key(9) % 3 == 0
                            && key(10 + axis as u64) % u64::from(code.bits()) == u64::from(bit);
                        let amplitude = if weak { 0.05 } else { 1.0 };
                        0.5 + if set != inverse { 0.5 } else { -0.5 } * amplitude
                    }
                };
                let share = if inverted { 1.0 - share } else { share };
                let dn = ambient
                    + modulation * share
                    + noise * normal(seed ^ random(at as u64) ^ random(1000 + number as u64));
                dn.round().clamp(0.0, full) as u16
            })
            .collect()
    };
    sequence.roles.iter().enumerate().map(|(number, &role)| (role, frame(number, role))).collect()
}

fn shared<T>(frames: &[(Role, Vec<u16>)]) -> Vec<(Role, SharedPlane)>
where
    T: Sample + TryFrom<u16>,
    Vec<T>: crate::decode::PlaneSource,
{
    frames
        .iter()
        .map(|(role, frame)| {
            let typed: Vec<T> = frame.iter().filter_map(|&sample| T::try_from(sample).ok()).collect();
            (*role, Arc::new(typed) as SharedPlane)
        })
        .collect()
}

fn compare<T>(
    settings: &DecodeSettings,
    noise: NoiseModel,
    frames: &[(Role, Vec<u16>)],
) -> Result<[u64; 12], String>
where
    T: Sample + TryFrom<u16>,
    Vec<T>: crate::decode::PlaneSource,
{
    let planes = shared::<T>(frames);
    let plan = plan::<T>(settings, &planes).map_err(|error| error.to_string())?;
    let mut maps = PixelMaps::new(WIDTH * HEIGHT, plan.axes.len());
    decode_pixels(&plan, &Gates::new(settings, noise), InstructionSet::widest(), &mut maps);
    let mut seen = [0; 12];
    for at in 0..WIDTH * HEIGHT {
        let samples: Vec<(Role, u16)> = frames.iter().map(|(role, frame)| (*role, frame[at])).collect();
        let expected = decode_pixel(settings, noise, &samples);
        // Single precision may decide a comparison otherwise that is this near.
        if expected.margin < 1e-5 {
            continue;
        }
        seen[expected.class as usize] += 1;
        let mut codes = [-1; 2];
        for (slot, axis) in plan.axes.iter().enumerate() {
            let value = maps.values[slot][at];
            if value >= 0 {
                let (first, last) = axis.code.span(value).ok_or("a value without a span")?;
                codes[axis.axis as usize] = (first + last) / 2;
            }
        }
        if maps.class[at] != expected.class || codes != expected.codes {
            return Err(format!(
                "pixel {at}: {:?} {codes:?}, expected {expected:?}; samples {samples:?}",
                maps.class[at]
            ));
        }
    }
    Ok(seen)
}

fn settings_of(sequence: &Sequence, bit_depth: u8, black: f64) -> DecodeSettings {
    DecodeSettings {
        mode: sequence.mode,
        column: sequence.column,
        row: sequence.row,
        width: WIDTH,
        height: HEIGHT,
        camera: CameraResponse {
            bit_depth,
            black_level_dn: Some(black),
            saturation_dn: ((1u32 << bit_depth) - 1) as u16,
            noise: None,
        },
        thresholds: Thresholds::default(),
    }
}

/// What a foreign capture may lack.
fn without(frames: &mut Vec<(Role, Vec<u16>)>, lacking: u8, column: AxisCode) {
    frames.retain(|(role, _)| match (lacking, *role) {
        (1, Role::Code { inverse, .. }) => !inverse,
        (2, Role::Code { axis: polscan_patterns::Axis::Column, bit, .. }) => bit + 2 < column.bits(),
        (3, Role::ReferenceH | Role::White) => false,
        (4, Role::ReferenceV | Role::Black) => false,
        (5, Role::ReferenceH | Role::White | Role::ReferenceV | Role::Black) => false,
        (6, Role::Code { axis: polscan_patterns::Axis::Row, .. }) => false,
        (7, Role::Code { bit, inverse, .. }) => bit % 3 != 0 || inverse,
        _ => true,
    });
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn equals_the_oracle(
        seed: u64,
        mode in prop::sample::select(Mode::ALL.to_vec()),
        bit_depth in prop::sample::select(vec![8u8, 10, 12, 16]),
        size in prop::sample::select(vec![(1024u32, 768u32), (24, 17), (64, 1), (100, 3)]),
        lacking in 0u8..8,
        black_share in 0.0..0.03f64,
    ) {
        let sequence = Sequence::new(mode, ProjectorSize { width: size.0, height: size.1 }).unwrap();
        let full = f64::from((1u32 << bit_depth) - 1);
        let settings = settings_of(&sequence, bit_depth, (full * black_share).round());
        let noise = NoiseModel { gain_dn_per_electron: full / 1e4, read_noise_dn: full / 1e3 };
        let mut frames = random_frames(&sequence, bit_depth, seed);
        without(&mut frames, lacking, sequence.column);
        let result = if bit_depth <= 8 {
            compare::<u8>(&settings, noise, &frames)
        } else {
            compare::<u16>(&settings, noise, &frames)
        };
        let undecodable = mode == Mode::Paper && [1, 4, 5, 7].contains(&lacking);
        match result {
            Ok(_) => prop_assert!(!undecodable),
            Err(message) => prop_assert!(undecodable && message.contains("cannot decode without"), "{}", message),
        }
    }
}

#[test]
fn random_pixels_cover_every_class_of_the_oracle() {
    let sequence = Sequence::new(Mode::Pse, ProjectorSize { width: 1024, height: 768 }).unwrap();
    let noise = NoiseModel { gain_dn_per_electron: 0.4, read_noise_dn: 1.0 };
    let mut seen = [0u64; 12];
    for seed in 0..60 {
        let frames = random_frames(&sequence, 12, seed);
        let counts = compare::<u16>(&settings_of(&sequence, 12, 0.0), noise, &frames).unwrap();
        seen.iter_mut().zip(counts).for_each(|(sum, count)| *sum += count);
    }
    for class in [
        Class::Unlit,
        Class::Valid,
        Class::Edge,
        Class::Inverted,
        Class::Saturated,
        Class::Ambiguous,
        Class::OutOfProjector,
    ] {
        assert!(seen[class as usize] >= 20, "{class:?}: {seen:?}");
    }
}

#[test]
fn result_is_the_same_to_the_bit_for_any_threads_and_order() {
    let rig = crate::decode::synth::Rig { width: 150, height: 70, ..Default::default() };
    let scene = |x: f64, y: f64| crate::decode::synth::Spot {
        u: 300.0 + 0.34 * x + if x > 70.0 { 9.3 } else { 0.0 },
        v: 100.0 + 0.33 * y,
        reflectance: 0.1 + 0.05 * (x / 20.0).sin(),
        surface: u32::from(x > 70.0),
        ..Default::default()
    };
    let sequence = crate::decode::synth::sequence(Mode::Pse);
    let frames = rig.scan(&scene, &sequence);
    let settings =
        DecodeSettings { camera: CameraResponse { noise: None, ..rig.camera() }, ..rig.settings(&sequence) };
    let decode = |threads: usize, shuffle: u64| {
        let mut order: Vec<usize> = (0..frames.len()).collect();
        order.sort_by_key(|&index| if shuffle == 0 { index as u64 } else { random(index as u64 ^ shuffle) });
        let mut accumulator = Accumulator::new(settings.clone()).unwrap();
        for index in order {
            let (role, frame) = &frames[index];
            accumulator.push(*role, Arc::new(frame.clone())).unwrap();
        }
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        // The drift alone knows an order.
        let decoded =
            crate::decode::Decoded { drift: None, ..pool.install(|| accumulator.finish().unwrap()) };
        format!("{decoded:?}")
    };
    let expected = decode(1, 0);
    for (threads, shuffle) in [(2, 0), (3, 1), (7, 2), (1, 3)] {
        assert!(decode(threads, shuffle) == expected, "{threads} threads, order {shuffle}");
    }
}
