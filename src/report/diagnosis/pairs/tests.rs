//! Statistics with known meaning, then whole scans of a simulated scene in which one thing goes wrong.

use polscan_patterns::{Mode, ProjectorSize, Role, Sequence};

use super::*;
use crate::{
    decode::{
        DecodeSettings, Plane,
        synth::{self, Rig, Spot},
    },
    report::{Report, ReportInput, Size, Verdict, build, testing},
};

const DEGRADED: Verdict = Verdict::Degraded;
const FAILED: Verdict = Verdict::Failed;

/// A sound decode, spoilt in its statistics; then the diagnoses with their severities.
fn found(spoil: impl FnOnce(&mut Decoded)) -> Vec<(Diagnosis, Verdict)> {
    let mut decoded = testing::decoded(64, 48);
    spoil(&mut decoded);
    let reasons = diagnose(&decoded, None);
    for reason in &reasons {
        assert!(reason.message.len() > 60 && reason.evidence.is_object(), "{reason:?}");
    }
    reasons.into_iter().map(|reason| (reason.diagnosis, reason.severity)).collect()
}

#[test]
fn noise_is_no_reason() {
    assert_eq!(found(|_| {}), []);
}

#[test]
fn what_sound_captures_of_real_cameras_show_is_no_reason() {
    // 8-bit frames round all pairs down alike by half a sigma, a few pixels glitter.
    let medians = [0.0, -0.26, -0.27, -0.29, -0.36, -0.5, -0.53, -0.56, -0.56, -0.85];
    assert_eq!(
        found(|decoded| for pair in &mut decoded.pairs {
            pair.median = medians[usize::from(pair.bit)];
            pair.sigma = 0.9;
            pair.flat_outliers = 0.0002;
            pair.edge_outliers = 0.0005;
        }),
        []
    );
}

#[test]
fn no_pairs_give_no_reasons() {
    assert_eq!(found(|decoded| decoded.pairs.clear()), []);
    assert_eq!(
        found(|decoded| for pair in &mut decoded.pairs {
            (pair.sigma, pair.median) = (f64::NAN, f64::NAN);
            (pair.flat_outliers, pair.edge_outliers, pair.pixels) = (f64::NAN, f64::NAN, 0);
        }),
        []
    );
}

/// Shares of pixels at edges beyond 5 sigma, and medians, as a real projector with a gamma showed them.
#[test]
fn a_gamma_is_a_nonlinear_response() {
    let edges = [0.07, 0.08, 0.21, 0.06, 0.08, 0.12, 0.13, 0.17, 0.43, 0.90];
    let gamma = |decoded: &mut Decoded| {
        for pair in &mut decoded.pairs {
            pair.edge_outliers = edges[usize::from(pair.bit)];
            if pair.bit == 9 {
                (pair.sigma, pair.median, pair.flat_outliers) = (3.1, -15.4, 0.28);
            }
            if pair.bit == 8 {
                (pair.sigma, pair.median, pair.flat_outliers) = (3.2, -4.1, 0.01);
            }
        }
    };
    assert_eq!(found(gamma), [(Diagnosis::NonlinearResponse, DEGRADED)]);
    let columns_only = |decoded: &mut Decoded| {
        gamma(decoded);
        decoded.pairs.retain(|pair| pair.axis == Axis::Column);
    };
    assert_eq!(found(columns_only), [(Diagnosis::NonlinearResponse, DEGRADED)]);
}

#[test]
fn crosstalk_of_the_finest_stripes_alone_is_a_nonlinear_response() {
    let crosstalk = |decoded: &mut Decoded| {
        for pair in decoded.pairs.iter_mut().filter(|pair| pair.bit == 9) {
            (pair.median, pair.edge_outliers) = (-6.0, 0.6);
        }
    };
    assert_eq!(found(crosstalk), [(Diagnosis::NonlinearResponse, DEGRADED)]);
    let columns_only = |decoded: &mut Decoded| {
        crosstalk(decoded);
        decoded.pairs.retain(|pair| pair.axis == Axis::Column);
    };
    assert_eq!(found(columns_only), [(Diagnosis::NonlinearResponse, DEGRADED)]);
}

#[test]
fn without_frames_to_look_at_the_share_decides() {
    let one = |share: f64| found(move |decoded| decoded.pairs[3].flat_outliers = share);
    assert_eq!(one(0.5), [(Diagnosis::StaleFrame, FAILED)]);
    assert_eq!(one(0.1), [(Diagnosis::Motion, DEGRADED)]);
    assert_eq!(one(0.0015), []);
    let many = |share: f64| {
        found(move |decoded| {
            for pair in decoded.pairs.iter_mut().filter(|pair| pair.axis == Axis::Row) {
                (pair.flat_outliers, pair.edge_outliers) = (share, share);
            }
        })
    };
    assert_eq!(many(0.5), [(Diagnosis::StaleFrame, FAILED)]);
    assert_eq!(many(0.1), [(Diagnosis::Motion, DEGRADED)]);
    assert_eq!(many(0.0015), []);
}

#[test]
fn a_handful_of_pixels_is_no_evidence() {
    let few = |decoded: &mut Decoded| {
        decoded.pairs[3].flat_outliers = 0.01;
        decoded.pairs[3].pixels = 1900;
    };
    assert_eq!(found(few), []);
}

#[test]
fn brightness_to_and_fro_is_flicker() {
    let flicker = |decoded: &mut Decoded| {
        for (index, pair) in decoded.pairs.iter_mut().enumerate() {
            pair.median = [0.0, 2.0, -1.5, 0.3, 1.9, -2.2][index % 6];
        }
    };
    assert_eq!(found(flicker), [(Diagnosis::Flicker, DEGRADED)]);
    // So strong that all pixels are outliers, at edges as well; still one common shift.
    let strong = |decoded: &mut Decoded| {
        for pair in decoded.pairs.iter_mut().skip(1).step_by(3) {
            (pair.median, pair.sigma, pair.flat_outliers, pair.edge_outliers) = (12.0, 4.0, 0.97, 0.97);
        }
    };
    assert_eq!(found(strong), [(Diagnosis::Flicker, DEGRADED)]);
}

#[test]
fn brightness_that_goes_one_way_is_drift() {
    let steady = |decoded: &mut Decoded| {
        for (index, pair) in decoded.pairs.iter_mut().enumerate() {
            pair.median = 0.3 * index as f64 - 3.0;
        }
        decoded.drift = None;
    };
    assert_eq!(found(steady), [(Diagnosis::ExposureDrift, DEGRADED)]);
    assert_eq!(found(|decoded| decoded.drift = Some(-0.05)), [(Diagnosis::ExposureDrift, DEGRADED)]);
    assert_eq!(found(|decoded| decoded.drift = Some(0.01)), []);
}

/// A scan in memory, to be spoilt frame by frame.
struct Scan {
    rig: Rig,
    /// Whether the camera's noise is unknown.
    estimate_noise: bool,
    sequence: Sequence,
    frames: Vec<(Role, Vec<u16>)>,
}

const SIZE: [usize; 2] = [384, 288];

/// A textured plate that fills the image; projector pixels are three camera pixels wide, as on the rig.
fn plate(x: f64, y: f64) -> Spot {
    let texture = 0.75 + 0.2 * (x / 17.0).sin() * (y / 23.0).cos();
    let dark = if (200.0..300.0).contains(&x) && (100.0..200.0).contains(&y) { 0.1 } else { 1.0 };
    Spot { u: 1.0 + x / 3.1, v: 1.0 + y / 3.1, reflectance: texture * dark, ..Spot::default() }
}

impl Scan {
    fn new(mode: Mode) -> Self {
        let rig = Rig { width: SIZE[0], height: SIZE[1], ..Rig::default() };
        let sequence = Sequence::new(mode, ProjectorSize { width: 128, height: 96 }).unwrap();
        let frames = rig.scan(&plate, &sequence);
        Self { rig, estimate_noise: false, sequence, frames }
    }

    fn at(&self, axis: Axis, bit: u8, inverse: bool) -> usize {
        self.frames.iter().position(|(role, _)| *role == Role::Code { axis, bit, inverse }).unwrap()
    }

    /// Brightness of a frame, everywhere or in some pixels.
    fn scale(&mut self, frame: usize, gain: f64, place: impl Fn(usize, usize) -> bool) {
        let black = self.rig.black_dn;
        for (index, value) in self.frames[frame].1.iter_mut().enumerate() {
            if place(index % SIZE[0], index / SIZE[0]) {
                *value = (black + (f64::from(*value) - black) * gain).round().clamp(0.0, 4095.0) as u16;
            }
        }
    }

    /// Mixes a share of frame `from` into frame `into`, in some rows.
    fn mix(&mut self, into: usize, from: usize, share: f64, rows: std::ops::Range<usize>) {
        let source = self.frames[from].1.clone();
        let target = &mut self.frames[into].1;
        for index in rows.start * SIZE[0]..rows.end * SIZE[0] {
            let mixed = (1.0 - share) * f64::from(target[index]) + share * f64::from(source[index]);
            target[index] = mixed.round() as u16;
        }
    }

    fn report(&self) -> Report {
        let mut settings: DecodeSettings = self.rig.settings(&self.sequence);
        if self.estimate_noise {
            settings.camera.noise = None;
        }
        let decoded = synth::decode(settings.clone(), self.frames.clone()).unwrap();
        let planes: Vec<_> = self.frames.iter().map(|(role, frame)| (*role, Plane::U16(frame))).collect();
        let size = Size { width: SIZE[0], height: SIZE[1] };
        build(&ReportInput {
            settings: Some(&settings),
            decoded: Some(&decoded),
            planes: &planes,
            ..ReportInput::new(self.sequence.mode, size, planes.len())
        })
    }
}

/// Diagnoses of a scan that was spoilt.
fn scanned(mode: Mode, spoil: impl FnOnce(&mut Scan)) -> Vec<(Diagnosis, Verdict)> {
    let mut scan = Scan::new(mode);
    spoil(&mut scan);
    let report = scan.report();
    println!("{:#?}", report.reasons);
    report.reasons.iter().map(|reason| (reason.diagnosis, reason.severity)).collect()
}

const ALL: fn(usize, usize) -> bool = |_, _| true;

#[test]
fn sound_scans_are_ok_in_every_mode() {
    for mode in Mode::ALL {
        let report = Scan::new(mode).report();
        assert_eq!((report.verdict, &report.reasons[..]), (Verdict::Ok, &[][..]), "{mode}");
        let sigma = report.capture.pair_residual_sigma.unwrap().median;
        assert!((sigma - 1.0).abs() < 0.05, "{mode}: {sigma}");
    }
}

#[test]
fn a_frame_that_shows_the_picture_before_is_stale() {
    for (axis, bit) in
        [(Axis::Column, 0), (Axis::Column, 2), (Axis::Column, 5), (Axis::Row, 1), (Axis::Row, 4)]
    {
        for inverse in [false, true] {
            let stale = |scan: &mut Scan| {
                let at = scan.at(axis, bit, inverse);
                scan.mix(at, at - 1, 1.0, 0..SIZE[1]);
            };
            assert_eq!(
                scanned(Mode::Pse, stale),
                [(Diagnosis::StaleFrame, FAILED)],
                "{axis} bit {bit} {inverse}"
            );
        }
    }
}

#[test]
fn a_frame_that_shows_the_picture_before_is_stale_in_mode_paper() {
    let stale = |scan: &mut Scan| {
        let at = scan.at(Axis::Column, 2, true);
        scan.mix(at, at - 1, 1.0, 0..SIZE[1]);
    };
    assert_eq!(scanned(Mode::Paper, stale), [(Diagnosis::StaleFrame, FAILED)]);
}

#[test]
fn a_sequence_that_is_one_frame_late_is_stale() {
    let late = |scan: &mut Scan| {
        for at in (1..scan.frames.len()).rev() {
            scan.mix(at, at - 1, 1.0, 0..SIZE[1]);
        }
    };
    assert!(scanned(Mode::Pse, late).contains(&(Diagnosis::StaleFrame, FAILED)));
}

#[test]
fn a_frame_of_two_pictures_is_torn() {
    for (axis, bit) in [(Axis::Column, 2), (Axis::Column, 3), (Axis::Row, 3)] {
        let torn = |scan: &mut Scan| {
            let at = scan.at(axis, bit, true);
            scan.mix(at, at - 1, 1.0, 170..SIZE[1]);
        };
        assert_eq!(scanned(Mode::Pse, torn), [(Diagnosis::TornFrame, FAILED)], "{axis} bit {bit}");
    }
}

#[test]
fn a_rest_of_the_picture_before_is_an_unsettled_display() {
    let unsettled = |scan: &mut Scan| {
        for at in (1..scan.frames.len()).rev() {
            scan.mix(at, at - 1, 0.12, 0..SIZE[1]);
        }
    };
    assert_eq!(scanned(Mode::Pse, unsettled), [(Diagnosis::UnsettledDisplay, DEGRADED)]);
}

#[test]
fn a_part_of_the_image_that_changes_moved() {
    let hand = |x: usize, y: usize| (60..140).contains(&x) && (80..180).contains(&y);
    let through = |scan: &mut Scan| {
        let at = scan.at(Axis::Column, 3, false);
        scan.scale(at, 0.4, hand);
        scan.scale(at + 1, 0.4, hand);
    };
    assert_eq!(scanned(Mode::Pse, through), [(Diagnosis::Motion, DEGRADED)]);
    let for_good = |scan: &mut Scan| {
        for at in scan.at(Axis::Column, 2, false)..scan.frames.len() {
            scan.scale(at, 0.6, hand);
        }
    };
    assert_eq!(scanned(Mode::Pse, for_good), [(Diagnosis::Motion, DEGRADED)]);
}

#[test]
fn a_frame_of_another_brightness_is_flicker() {
    for gain in [0.9, 0.97, 1.04] {
        let dimmer = |scan: &mut Scan| {
            let at = scan.at(Axis::Column, 2, true);
            scan.scale(at, gain, ALL);
        };
        assert_eq!(scanned(Mode::Pse, dimmer), [(Diagnosis::Flicker, DEGRADED)], "{gain}");
    }
    let to_and_fro = |scan: &mut Scan| {
        for at in 0..scan.frames.len() {
            scan.scale(at, 1.0 + 0.04 * (1.9 * at as f64).sin(), ALL);
        }
    };
    assert!(scanned(Mode::Pse, to_and_fro).contains(&(Diagnosis::Flicker, DEGRADED)));
}

#[test]
fn an_exposure_that_answers_to_the_pictures_is_automatic() {
    for (target, speed) in [(0.25, 0.5), (0.25, 0.1), (0.15, 0.3)] {
        let adjusting = |scan: &mut Scan| {
            let (black, mut exposure) = (scan.rig.black_dn, 1.0);
            for at in 0..scan.frames.len() {
                scan.scale(at, exposure, ALL);
                let frame = &scan.frames[at].1;
                let sum: f64 = frame.iter().map(|&dn| f64::from(dn) - black).sum();
                let mean = (sum / frame.len() as f64).max(1.0);
                exposure *= (target * 4095.0 / mean).powf(speed);
            }
        };
        let found = scanned(Mode::Pse, adjusting);
        assert_eq!(found.first(), Some(&(Diagnosis::ExposureDrift, DEGRADED)), "{target} {speed}: {found:?}");
        let names: Vec<_> = found.iter().map(|(name, _)| *name).collect();
        assert!(!names.contains(&Diagnosis::Flicker) && !names.contains(&Diagnosis::StaleFrame), "{names:?}");
    }
}

#[test]
fn a_lamp_that_beats_at_any_rate_is_not_automatic_exposure() {
    for step in (1..16).step_by(2) {
        let angle = std::f64::consts::PI * f64::from(step) / 16.0;
        let mut scan = Scan::new(Mode::Pse);
        for at in 0..scan.frames.len() {
            scan.scale(at, 1.0 + 0.08 * (angle * at as f64 + 0.4).sin(), ALL);
        }
        for reason in scan.report().reasons {
            assert_ne!(reason.evidence["follows_the_frame_before"], json!(true), "{angle}");
        }
    }
}

#[test]
fn light_that_fades_is_drift_of_the_lamp_or_of_the_room() {
    let lamp = |scan: &mut Scan| {
        let count = scan.frames.len();
        for at in 0..count {
            scan.scale(at, 1.0 - 0.1 * at as f64 / count as f64, ALL);
        }
    };
    assert_eq!(scanned(Mode::Pse, lamp), [(Diagnosis::ExposureDrift, DEGRADED)]);
    let room = |scan: &mut Scan| {
        for (at, (_, frame)) in scan.frames.iter_mut().enumerate() {
            frame.iter_mut().for_each(|value| *value = (*value + 8 * at as u16).min(4095));
        }
    };
    assert_eq!(scanned(Mode::Pse, room), [(Diagnosis::AmbientDrift, DEGRADED)]);
}

#[test]
fn a_camera_with_a_gamma_is_a_nonlinear_response() {
    for mode in [Mode::Pse, Mode::Fast] {
        let gamma = |scan: &mut Scan| {
            for (_, frame) in &mut scan.frames {
                frame.iter_mut().for_each(|value| {
                    *value = (4095.0 * (f64::from(*value) / 4095.0).powf(0.6)).round() as u16;
                });
            }
            scan.estimate_noise = true;
            scan.rig.black_dn = 4095.0 * (41.0f64 / 4095.0).powf(0.6);
        };
        assert_eq!(scanned(mode, gamma), [(Diagnosis::NonlinearResponse, DEGRADED)], "{mode}");
    }
}

#[test]
fn exchanged_frames_are_swapped() {
    for bit in 0..3 {
        let swapped = |scan: &mut Scan| {
            let at = scan.at(Axis::Column, bit, false);
            let other = scan.frames[at].1.clone();
            scan.frames[at].1 = std::mem::replace(&mut scan.frames[at + 1].1, other);
        };
        assert_eq!(scanned(Mode::Pse, swapped), [(Diagnosis::SwappedFrames, FAILED)], "{bit}");
    }
}

#[test]
fn a_frame_lost_among_the_last_pairs_is_told_by_the_fine_ones_behind_it() {
    let lost = |scan: &mut Scan| {
        for at in scan.at(Axis::Row, 3, false)..scan.frames.len() - 1 {
            scan.frames[at].1 = scan.frames[at + 1].1.clone();
        }
    };
    assert_eq!(scanned(Mode::Pse, lost), [(Diagnosis::LostFrame, FAILED)]);
}

#[test]
fn a_lamp_that_dips_between_two_fine_pairs_is_flicker() {
    let dip = |scan: &mut Scan| {
        let at = scan.at(Axis::Column, 5, true);
        scan.scale(at, 0.8, ALL);
        scan.scale(at + 1, 0.8, ALL);
    };
    assert_eq!(scanned(Mode::Pse, dip), [(Diagnosis::Flicker, DEGRADED)]);
}

#[test]
fn a_room_light_switched_on_behind_all_coarse_pairs_is_no_flicker() {
    let switched_on = |scan: &mut Scan| {
        for at in scan.at(Axis::Row, 4, false)..scan.frames.len() {
            scan.frames[at].1.iter_mut().for_each(|value| *value = (*value + 60).min(4095));
        }
    };
    assert_eq!(scanned(Mode::Pse, switched_on), [(Diagnosis::AmbientDrift, DEGRADED)]);
}
