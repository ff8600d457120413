use polscan_drivers::{clock::Timestamp, frame::FrameStamp};
use polscan_patterns::{Mode, ProjectorSize};

use super::*;
use crate::decode::synth::{normal, random};

const WIDTH: usize = 400;
const HEIGHT: usize = 60;
const NOISE: NoiseModel = NoiseModel { gain_dn_per_electron: 0.4, read_noise_dn: 2.0 };

fn judge(mode: Mode, noise: Option<NoiseModel>) -> PairSumJudge {
    let camera = CameraResponse { bit_depth: 12, black_level_dn: None, saturation_dn: 4095, noise };
    let sequence = Sequence::new(mode, ProjectorSize { width: 1024, height: 768 }).unwrap();
    PairSumJudge::new(sequence, camera, Thresholds::default())
}

/// A frame of 100 DN, 1100 DN where `lit`, with the noise of the camera.
fn shot(seed: u64, lit: impl Fn(usize) -> bool) -> Frame {
    levels(seed, |x| if lit(x) { 1100.0 } else { 100.0 })
}

/// A frame of these levels in DN by column, with the noise of the camera.
fn levels(seed: u64, level: impl Fn(usize) -> f64) -> Frame {
    let samples: Vec<u16> = (0..WIDTH * HEIGHT)
        .map(|at| {
            let level = level(at % WIDTH);
            let sigma = (NOISE.variance(level) - 1.0 / 12.0).sqrt();
            (level + sigma * normal(random(seed) ^ random(at as u64 + 77))).round() as u16
        })
        .collect();
    let (received, exposure_start) = (Timestamp(0), Timestamp(0));
    let stamp = FrameStamp { frame_id: seed, trigger: seed, exposure_start, received, device_time_ns: None };
    Frame { width: WIDTH as u32, height: HEIGHT as u32, bit_depth: 12, stamp, store: Arc::new(samples) }
}

fn set(bit: u8, x: usize) -> bool {
    let index = x * 1024 / WIDTH;
    ((index ^ (index >> 1)) >> (9 - bit)) & 1 == 1
}

fn good(bit: u8, seed: u64) -> [Frame; 2] {
    [shot(seed, |x| set(bit, x)), shot(seed + 1, |x| !set(bit, x))]
}

/// The frame still shows the slide before it: the inverse of the bit before, or the dark reference.
fn stale_direct(bit: u8, seed: u64) -> [Frame; 2] {
    [shot(seed, |x| bit > 0 && !set(bit - 1, x)), shot(seed + 1, |x| !set(bit, x))]
}

/// The inverse still shows the frame.
fn stale_inverse(bit: u8, seed: u64) -> [Frame; 2] {
    [shot(seed, |x| set(bit, x)), shot(seed + 1, |x| set(bit, x))]
}

type Make = fn(u8, u64) -> [Frame; 2];

/// Verdicts on pairs one after the other, as `accept` or reason.
fn verdicts(judge: &mut PairSumJudge, pairs: &[(u8, Make)]) -> Vec<String> {
    let mut seed = 1000;
    let mut all = Vec::new();
    for (bit, make) in pairs {
        seed += 10;
        let [frame, inverse] = make(*bit, seed);
        all.push(match judge.pair(Axis::Column, *bit, &frame, &inverse) {
            PairVerdict::Accept => "accept".into(),
            PairVerdict::Degraded(found) if found.reason == "unverified-pair" => found.evidence,
            PairVerdict::Degraded(found) => found.reason,
            PairVerdict::Retake(_) => "retake".into(),
        });
    }
    all
}

const NOISES: [Option<NoiseModel>; 2] = [Some(NOISE), None];

#[test]
fn stale_frames_of_coarse_bits_are_taken_again() {
    for stale in [stale_direct as Make, stale_inverse] {
        let mut judge = judge(Mode::Pse, Some(NOISE));
        judge.reference(Role::ReferenceV, &shot(1, |_| false));
        judge.reference(Role::ReferenceH, &shot(2, |_| true));
        for bit in 0..7 {
            assert_eq!(verdicts(&mut judge, &[(bit, stale)]), ["retake"], "bit {bit}");
            assert_eq!(verdicts(&mut judge, &[(bit, good)]), ["accept"], "bit {bit}");
        }
    }
}

#[test]
fn without_references_good_pairs_are_accepted() {
    for noise in NOISES {
        let pairs: Vec<(u8, Make)> = (0..7).map(|bit| (bit, good as Make)).collect();
        assert_eq!(verdicts(&mut judge(Mode::Paper, noise), &pairs), ["accept"; 7]);
    }
}

#[test]
fn a_wrong_first_pair_is_displaced_and_named() {
    for noise in NOISES {
        for stale in [stale_direct as Make, stale_inverse] {
            let mut judge = judge(Mode::Paper, noise);
            let pairs: Vec<(u8, Make)> =
                [(0, stale), (1, good), (2, good), (1, good), (3, good), (4, good), (5, good)].into();
            let found = verdicts(&mut judge, &pairs);
            assert_eq!(found[..2], ["accept", "retake"], "{found:?}");
            assert!(found[2].starts_with("column bit 0: the first pair"), "{found:?}");
            assert_eq!(found[3..], ["accept"; 4], "{found:?}");
            assert_eq!(verdicts(&mut judge, &[(6, stale_inverse)]), ["retake"]);
        }
    }
}

#[test]
fn a_second_pair_that_disagrees_twice_displaces_the_first() {
    let pairs: [(u8, Make); 4] = [(0, stale_inverse), (1, good), (1, good), (2, good)];
    let found = verdicts(&mut judge(Mode::Paper, Some(NOISE)), &pairs);
    assert_eq!(found[1], "retake");
    assert!(found[2].starts_with("column bit 0: the first pair"), "{found:?}");
    assert_eq!(found[3], "accept");
}

#[test]
fn a_wrong_later_pair_leaves_a_good_first_one_in_place() {
    for noise in NOISES {
        let pairs: [(u8, Make); 6] =
            [(0, good), (1, stale_inverse), (2, good), (1, good), (3, stale_direct), (3, good)];
        let found = verdicts(&mut judge(Mode::Paper, noise), &pairs);
        assert_eq!(found, ["accept", "retake", "accept", "accept", "retake", "accept"]);
        // Two wrong ones at once, which agree neither with the first nor with each other.
        let pairs: [(u8, Make); 5] =
            [(0, good), (1, stale_inverse), (2, stale_inverse), (1, good), (2, good)];
        let found = verdicts(&mut judge(Mode::Paper, noise), &pairs);
        assert_eq!(found, ["accept", "retake", "retake", "accept", "accept"]);
    }
}

#[test]
fn noise_is_the_smallest_of_four_pairs() {
    // Fine stripes in the sum of the pair, faint enough to pass for one level, feign noise.
    let wild: Make =
        |_, seed| [levels(seed, |x| if x % 6 < 3 { 800.0 } else { 400.0 }), levels(seed + 1, |_| 600.0)];
    let mut judge = judge(Mode::Paper, None);
    let ratio = |judge: &PairSumJudge| judge.noise.unwrap().variance(600.0) / NOISE.variance(600.0);
    verdicts(&mut judge, &[(0, wild), (1, good)]);
    assert!(ratio(&judge) > 10.0, "{}", ratio(&judge));
    verdicts(&mut judge, &[(2, good)]);
    assert!((0.7..1.3).contains(&ratio(&judge)), "{}", ratio(&judge));
    verdicts(&mut judge, &[(3, good), (4, good)]);
    let settled = judge.noise;
    assert!(judge.noise_settled() && judge.last_pair.is_none());
    verdicts(&mut judge, &[(5, good), (6, wild)]);
    assert_eq!(judge.noise, settled);
}

/// Reasons of the verdicts on the pairs of bits 0 to 6, the frames being what `expose` makes of each picture (levels in DN
/// by column) and of the levels of the frame before; the references come first.
fn reasons_in_a_row(mut expose: impl FnMut(&[f64], &[f64]) -> Vec<f64>) -> Vec<String> {
    let mut judge = judge(Mode::Pse, Some(NOISE));
    let (mut before, mut taken) = (vec![0.0; WIDTH], 0);
    let mut take = |lit: &dyn Fn(usize) -> bool| {
        let picture: Vec<f64> = (0..WIDTH).map(|x| if lit(x) { 1100.0 } else { 100.0 }).collect();
        before = expose(&picture, &before);
        taken += 1;
        levels(taken, |x| before[x])
    };
    judge.reference(Role::ReferenceV, &take(&|_| false));
    judge.reference(Role::ReferenceH, &take(&|_| true));
    let pairs = (0..7).map(|bit| {
        let [frame, inverse] = [take(&|x| set(bit, x)), take(&|x| !set(bit, x))];
        match judge.pair(Axis::Column, bit, &frame, &inverse) {
            PairVerdict::Accept => "accept".to_owned(),
            PairVerdict::Degraded(found) => found.reason,
            PairVerdict::Retake(found) => format!("again: {}", found.reason),
        }
    });
    pairs.collect()
}

#[test]
fn a_display_that_does_not_settle_is_named_from_the_second_pair_on() {
    for rest in [0.3, 0.6] {
        let mix = |own: f64, before: f64| (1.0 - rest) * own + rest * before;
        let found = reasons_in_a_row(|picture, before| {
            picture.iter().zip(before).map(|(own, before)| mix(*own, *before)).collect()
        });
        let others = found[1..].iter().filter(|reason| *reason != "unsettled-display" && *reason != "accept");
        assert_eq!(others.count(), 0, "{rest}: {found:?}");
        assert!(found[1..].iter().any(|reason| reason == "unsettled-display"), "{rest}: {found:?}");
    }
}

#[test]
fn a_camera_that_adjusts_itself_is_named_once_enough_frames_answer_to_those_before() {
    let mut gain = 0.0_f64;
    let found = reasons_in_a_row(|picture, _| {
        let seen: Vec<f64> = picture.iter().map(|level| level * gain.exp()).collect();
        let mean = seen.iter().sum::<f64>() / WIDTH as f64;
        gain -= 0.15 * (mean / 1300.0).ln();
        seen
    });
    assert!(found[4..].iter().all(|reason| reason == "exposure-drift" || reason == "accept"), "{found:?}");
    assert!(found.iter().any(|reason| reason == "exposure-drift"), "{found:?}");
}

#[test]
fn a_camera_that_adjusts_itself_is_not_forgotten_where_it_breaks_its_rule() {
    let (mut gain, mut taken) = (0.0_f64, 0);
    let found = reasons_in_a_row(|picture, _| {
        let seen: Vec<f64> = picture.iter().map(|level| level * gain.exp()).collect();
        let mean = seen.iter().sum::<f64>() / WIDTH as f64;
        gain -= 0.15 * (mean / 1300.0).ln();
        taken += 1;
        // Two references and five pairs, then one frame much darker than the rule says.
        gain -= if taken == 13 { 1.0 } else { 0.0 };
        seen
    });
    assert!(found[..5].iter().any(|reason| reason == "exposure-drift"), "{found:?}");
    assert!(found[5..].iter().all(|reason| reason == "exposure-drift"), "{found:?}");
}
