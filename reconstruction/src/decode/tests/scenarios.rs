//! Classes, gates, missing frames, pair sums and contrast on small scenes made to show them.

use std::sync::Arc;

use polscan_patterns::{Axis, AxisCode, Mode, ProjectorSize, Role, Sequence};

use crate::decode::synth::{Rig, Spot, accuracy, decode, normal, sequence};
use crate::{
    decode::{
        Accumulator, Class, Contrast, DecodeError, DecodeSettings, Decoded, PairContext, Plane, Thresholds,
        contrast, estimate_noise, pair_residual,
    },
    grid::Grid,
};

type Frames = Vec<(Role, Vec<u16>)>;

fn rig() -> Rig {
    Rig { width: 160, height: 60, ..Rig::default() }
}

fn plane(x: f64, y: f64) -> Spot {
    Spot { u: 300.2 + 0.331 * x + 0.004 * y, v: 200.4 + 0.333 * y, ..Spot::default() }
}

fn code(axis: Axis, bit: u8, inverse: bool) -> Role {
    Role::Code { axis, bit, inverse }
}

fn frame_of(frames: &mut Frames, wanted: Role) -> &mut Vec<u16> {
    &mut frames.iter_mut().find(|(role, _)| *role == wanted).unwrap().1
}

fn count(decoded: &Decoded, class: Class) -> usize {
    decoded.class.data().iter().filter(|found| **found == class).count()
}

/// Share of the pixels whose column is valid and within one of the truth.
fn right(decoded: &Decoded, rig: &Rig, scene: impl Fn(f64, f64) -> Spot) -> f64 {
    let mut right = 0;
    for y in 0..rig.height {
        for x in 0..rig.width {
            let off = f64::from(decoded.column.coordinate.at(x, y)) - scene(x as f64, y as f64).u;
            right += u32::from(decoded.class.at(x, y).is_valid() && off.abs() <= 1.0);
        }
    }
    f64::from(right) / (rig.width * rig.height) as f64
}

#[test]
fn depolarising_patch_is_inverted_and_right() {
    // V is brighter than H on the right half; a weak patch there stays below twice the lit gate.
    let scene = |x: f64, y: f64| match x {
        _ if x < 80.0 => plane(x, y),
        _ if y < 45.0 => Spot { reflectance: 0.2, leak: 1.6, surface: 1, ..plane(x, y) },
        _ => Spot { reflectance: 0.02, leak: 1.06, surface: 2, ..plane(x, y) },
    };
    let decoded = rig().decode(&scene, &sequence(Mode::Pse));
    for y in 0..60 {
        for x in (0..78).chain(83..160) {
            let class = decoded.class.at(x, y);
            match (x < 80, y) {
                (true, _) => assert!(matches!(class, Class::Valid | Class::Edge), "{x} {y} {class:?}"),
                (false, 0..43) => assert_eq!(class, Class::Inverted, "{x} {y}"),
                (false, 47..) => assert_eq!(class, Class::Unlit, "{x} {y}"),
                _ => {}
            }
        }
    }
    let upper = |x: usize, y: usize| x > 83 && y < 43;
    let a = accuracy(&rig(), &scene, &decoded, Axis::Column, upper);
    assert!(a.rms < 0.03 && a.wrong == 0.0 && (0.8..1.25).contains(&a.normalised), "{a:?}");
}

#[test]
fn saturation_of_both_frames_loses_the_bit_and_of_one_only_flags() {
    let scene = |x: f64, y: f64| match x {
        _ if x < 50.0 => Spot { reflectance: 0.5, ..plane(x, y) },
        // Bright state beyond full scale.
        _ if x < 100.0 => Spot { reflectance: 1.6, surface: 1, ..plane(x, y) },
        // Dark state too.
        _ => Spot { reflectance: 3.0, leak: 0.9, surface: 2, ..plane(x, y) },
    };
    let decoded = rig().decode(&scene, &sequence(Mode::Pse));
    for y in 0..60 {
        for x in (0..48).chain(53..98).chain(103..160) {
            let (class, half) = (decoded.class.at(x, y), decoded.half_saturated.at(x, y));
            match x {
                0..48 => assert!(class.is_valid() && !half, "{x} {y}: {class:?}"),
                53..98 => {
                    assert!(class.is_valid() && half, "{x} {y}: {class:?}");
                    let off = f64::from(decoded.column.coordinate.at(x, y)) - scene(x as f64, y as f64).u;
                    assert!(off.abs() < 0.6, "{x} {y}: {off}");
                }
                _ => assert_eq!(class, Class::Saturated, "{x} {y}"),
            }
        }
    }
}

#[test]
fn dark_surroundings_are_unlit_and_their_border_harmless() {
    let lit = |x: f64, y: f64| (x - 80.0).hypot(2.0 * (y - 30.0)) < 50.0;
    let scene = |x: f64, y: f64| {
        let inside = lit(x, y);
        Spot { reflectance: if inside { 0.3 } else { 0.0 }, surface: u32::from(inside), ..plane(x, y) }
    };
    let decoded = rig().decode(&scene, &sequence(Mode::Pse));
    for y in 0..60 {
        for x in 0..160 {
            let around = [(-1.0, 0.0), (1.0, 0.0), (0.0, 0.0), (0.0, 1.0), (0.0, -1.0)];
            let inside = around.map(|(dx, dy)| lit(x as f64 + dx, y as f64 + dy));
            if inside == [true; 5] {
                assert!(decoded.class.at(x, y).is_valid(), "{x} {y} {:?}", decoded.class.at(x, y));
            } else if inside == [false; 5] {
                assert_eq!(decoded.class.at(x, y), Class::Unlit, "{x} {y}");
                assert!(decoded.column.coordinate.at(x, y).is_nan() && decoded.column.code.at(x, y) == -1);
            }
        }
    }
}

#[test]
fn thin_structures_survive_and_lone_pixels_do_not() {
    let line = |x: f64, _: f64| (x - 60.0).abs() < 0.5;
    let scene = |x: f64, y: f64| {
        let wire = line(x, y);
        let spot = plane(x, y);
        Spot { u: spot.u - if wire { 31.7 } else { 0.0 }, surface: u32::from(wire), ..spot }
    };
    let sequence = sequence(Mode::Pse);
    let mut frames = rig().scan(&scene, &sequence);
    // A pixel of other words among its neighbours, and one that has no valid neighbour.
    let (stranger, hermit) = (30 * 160 + 110, 30 * 160 + 140);
    let source = frames.clone();
    for ((_, frame), (_, from)) in frames.iter_mut().zip(&source) {
        frame[stranger] = from[10 * 160 + 20];
        for (dx, dy) in (-1..=1).flat_map(|dx| (-1..=1).map(move |dy| (dx, dy))) {
            if (dx, dy) != (0, 0) {
                frame[(hermit as isize + dy * 160 + dx) as usize] = 41;
            }
        }
    }
    let decoded = decode(rig().settings(&sequence), frames).unwrap();
    for y in 1..59 {
        assert!(decoded.class.at(60, y).is_valid(), "{y} {:?}", decoded.class.at(60, y));
        let off_code = f64::from(decoded.column.code.at(60, y)) - (plane(60.0, y as f64).u - 31.7);
        assert!(off_code.abs() < 0.7, "the wire keeps its own code: {off_code}");
        let off = f64::from(decoded.column.coordinate.at(60, y)) - (plane(60.0, y as f64).u - 31.7);
        assert!(off.abs() < 1.0, "the wire keeps its own coordinate: {off}");
    }
    assert_eq!(decoded.class.data()[stranger], Class::Vote);
    assert_eq!(decoded.class.data()[hermit], Class::Vote);
    assert!(decoded.column.code.data()[stranger] >= 0, "rejected pixels keep their word");
    assert!(decoded.column.coordinate.data()[stranger].is_nan());
    assert_eq!(count(&decoded, Class::Vote), 2);
}

#[test]
fn exchanged_frames_of_a_pair_are_off_boundary() {
    let rig = Rig { width: 320, height: 80, ..Rig::default() };
    // Few columns, so that the image holds boundaries of every bit.
    let coarse = Sequence::new(Mode::Pse, ProjectorSize { width: 64, height: 768 }).unwrap();
    let gentle = |x: f64, y: f64| Spot { u: 0.2 + 0.19 * x, v: 200.4 + 0.333 * y, ..Spot::default() };
    for bit in 1..6 {
        let mut frames = rig.scan(&gentle, &coarse);
        let p = frame_of(&mut frames, code(Axis::Column, bit, false)).clone();
        let q = std::mem::replace(frame_of(&mut frames, code(Axis::Column, bit, true)), p);
        *frame_of(&mut frames, code(Axis::Column, bit, false)) = q;
        let decoded = decode(rig.settings(&coarse), frames).unwrap();
        let suspect: Vec<_> = decoded.boundaries.iter().filter(|check| check.is_suspect()).collect();
        assert!(!suspect.is_empty(), "bit {bit}: {:?}", decoded.boundaries);
        assert!(suspect.iter().all(|check| check.axis == Axis::Column), "{suspect:?}");
        // Exchanging the finest pair moves codes by one column, which is within `snap_px`: reported, not rejected.
        assert!(
            bit == 5 || count(&decoded, Class::OffBoundary) > 60,
            "bit {bit}: {}",
            count(&decoded, Class::OffBoundary)
        );
    }
    let decoded = rig.decode(&gentle, &coarse);
    for check in &decoded.boundaries {
        assert!(check.illegal == 0 && 10 * check.against <= check.legal && !check.is_suspect(), "{check:?}");
    }
}

#[test]
fn a_region_with_a_wrong_bit_is_rejected_at_its_rim_and_its_neighbours_hold() {
    let sequence = sequence(Mode::Pse);
    let mut frames = rig().scan(&plane, &sequence);
    let inside = |x: usize, y: usize| (60..100).contains(&x) && (20..40).contains(&y);
    // Bit 6 (stripes of 16 columns, 48 px) with exchanged frames inside.
    let p = frame_of(&mut frames, code(Axis::Column, 6, false)).clone();
    let q = frame_of(&mut frames, code(Axis::Column, 6, true)).clone();
    for y in 0..60 {
        for x in (0..160).filter(|&x| inside(x, y)) {
            frame_of(&mut frames, code(Axis::Column, 6, false))[y * 160 + x] = q[y * 160 + x];
            frame_of(&mut frames, code(Axis::Column, 6, true))[y * 160 + x] = p[y * 160 + x];
        }
    }
    let decoded = decode(rig().settings(&sequence), frames).unwrap();
    let mut rim = 0;
    for y in 0..60 {
        for x in 0..160 {
            let class = decoded.class.at(x, y);
            let far_outside = !inside(x, y) && !(58..102).contains(&x) || !(18..42).contains(&y);
            if far_outside {
                assert!(class.is_valid(), "{x} {y} {class:?}");
                let off = f64::from(decoded.column.coordinate.at(x, y)) - plane(x as f64, y as f64).u;
                assert!(off.abs() < 0.1, "{x} {y} {off}");
            }
            rim += u32::from(class == Class::OffBoundary);
        }
    }
    assert!(rim >= 40, "{rim} pixels of the rim");
}

#[test]
fn light_of_a_coarse_bit_from_elsewhere_is_interreflection() {
    let sequence = sequence(Mode::Pse);
    let mut frames = rig().scan(&plane, &sequence);
    // Bits 0 and 1 have no boundary near the patch; there they lose most of their modulation.
    for bit in [1] {
        let p = frame_of(&mut frames, code(Axis::Column, bit, false)).clone();
        let q = frame_of(&mut frames, code(Axis::Column, bit, true)).clone();
        for at in (20..40).flat_map(|y| (60..100).map(move |x| y * 160 + x)) {
            let (sum, difference) =
                (f64::from(p[at]) + f64::from(q[at]), f64::from(p[at]) - f64::from(q[at]));
            frame_of(&mut frames, code(Axis::Column, bit, false))[at] =
                ((sum + 0.2 * difference) / 2.0) as u16;
            frame_of(&mut frames, code(Axis::Column, bit, true))[at] =
                ((sum - 0.2 * difference) / 2.0) as u16;
        }
    }
    let decoded = decode(rig().settings(&sequence), frames).unwrap();
    for y in 0..60 {
        for x in 0..160 {
            let inside = (60..100).contains(&x) && (20..40).contains(&y);
            let class = decoded.class.at(x, y);
            assert_eq!(class == Class::Interreflection, inside, "{x} {y} {class:?}");
        }
    }
}

#[test]
fn paper_mode_decodes_bright_surfaces_and_says_what_it_cannot_see() {
    let scene = |x: f64, y: f64| Spot { reflectance: 0.5, ..plane(x, y) };
    let decoded = rig().decode(&scene, &sequence(Mode::Paper));
    let a = accuracy(&rig(), &scene, &decoded, Axis::Column, |_, _| true);
    assert!(a.coverage > 0.999 && a.wrong == 0.0 && a.rms < 0.06, "{a:?}");
    assert!(decoded.losses.iter().any(|loss| loss.contains("polarity")), "{:?}", decoded.losses);
    // Unlit ones are not decoded.
    let dark = |x: f64, y: f64| Spot { reflectance: 0.0, ..plane(x, y) };
    let decoded = rig().decode(&dark, &sequence(Mode::Paper));
    assert!(count(&decoded, Class::Unlit) == 160 * 60);
    // Where the dark reference reads black, every degree is 1 and the bits are lost.
    let no_leak = |x: f64, y: f64| Spot { reflectance: 0.02, leak: 0.0, ..plane(x, y) };
    let quiet = Rig { ambient_electrons: 0.0, read_electrons: 0.1, ..rig() };
    let paper = quiet.decode(&no_leak, &sequence(Mode::Paper));
    let pse = quiet.decode(&no_leak, &sequence(Mode::Pse));
    assert!(right(&pse, &quiet, no_leak) > 0.99 && right(&paper, &quiet, no_leak) < 0.5);
}

#[test]
fn a_plane_on_a_paper_scan_decodes_alike_in_pse_without_its_references() {
    // The frames of mode paper, decoded as pse: R_H is the mean pair sum less R_V.
    let paper = sequence(Mode::Paper);
    let frames = rig().scan(&plane, &paper);
    let settings = DecodeSettings { mode: Mode::Pse, ..rig().settings(&paper) };
    let decoded = decode(settings, frames).unwrap();
    assert!(right(&decoded, &rig(), plane) > 0.999);
    assert!(decoded.losses.iter().any(|loss| loss.contains("reference-h")), "{:?}", decoded.losses);
}

fn gray_frames() -> (Sequence, Frames) {
    let gray = sequence(Mode::Gray);
    let frames = rig().scan(&plane, &gray);
    (gray, frames)
}

#[test]
fn gray_without_references_is_decoded_by_its_pairs() {
    let (gray, mut frames) = gray_frames();
    frames.retain(|(role, _)| matches!(role, Role::Code { .. }));
    let decoded = decode(rig().settings(&gray), frames).unwrap();
    assert!(right(&decoded, &rig(), plane) > 0.999);
    assert!(decoded.losses.iter().any(|loss| loss.contains("pair differences")), "{:?}", decoded.losses);
    assert!(decoded.drift.is_none());
}

#[test]
fn missing_inverses_are_replaced_by_the_middle_of_the_references() {
    let (gray, mut frames) = gray_frames();
    frames.retain(|(role, _)| !matches!(role, Role::Code { inverse: true, .. }));
    let decoded = decode(rig().settings(&gray), frames.clone()).unwrap();
    let a = accuracy(&rig(), &plane, &decoded, Axis::Column, |_, _| true);
    assert!(a.coverage > 0.99 && a.wrong == 0.0 && a.rms < 0.03, "{a:?}");
    assert!(
        decoded.pairs.is_empty()
            && decoded.losses.iter().any(|loss| loss.contains("one frame of their pair"))
    );
    frames.retain(|(role, _)| matches!(role, Role::Code { .. }));
    let error = decode(rig().settings(&gray), frames).unwrap_err();
    assert!(matches!(&error, DecodeError::Missing { missing, .. } if missing.contains("inverse")), "{error}");
}

#[test]
fn missing_low_bits_give_the_centre_of_the_span() {
    let plain = Sequence { column: AxisCode::plain(1024).unwrap(), ..sequence(Mode::Gray) };
    let mut frames = rig().scan(&plane, &plain);
    frames.retain(|(role, _)| !matches!(role, Role::Code { axis: Axis::Column, bit: 8.., .. }));
    let decoded = decode(rig().settings(&plain), frames).unwrap();
    assert!(decoded.losses.iter().any(|loss| loss.contains("spans 4 projector px")), "{:?}", decoded.losses);
    for (x, y) in (0..60).flat_map(|y| (0..160).map(move |x| (x, y))) {
        if decoded.class.at(x, y).is_valid() {
            let span = (decoded.column.code.at(x, y) / 4) * 4;
            assert_eq!(decoded.column.coordinate.at(x, y), span as f32 + 1.5);
            let off = f64::from(decoded.column.coordinate.at(x, y)) - plane(x as f64, y as f64).u;
            assert!(off.abs() < 2.6, "{off}");
        }
    }
    assert!(count(&decoded, Class::Valid) + count(&decoded, Class::Edge) > 9000);
}

#[test]
fn a_missing_axis_is_told_and_columns_cannot_be_missed() {
    let (gray, frames) = gray_frames();
    let keep = |wanted: Axis| -> Frames {
        let keeps = |role: &Role| !matches!(role, Role::Code { axis, .. } if *axis != wanted);
        frames.iter().filter(|(role, _)| keeps(role)).cloned().collect()
    };
    let decoded = decode(rig().settings(&gray), keep(Axis::Column)).unwrap();
    assert!(decoded.row.is_none() && decoded.losses.iter().any(|loss| loss.contains("row")));
    let error = decode(rig().settings(&gray), keep(Axis::Row)).unwrap_err();
    assert!(matches!(error, DecodeError::Missing { mode: Mode::Gray, .. }), "{error}");
    let empty = Accumulator::new(rig().settings(&gray)).unwrap().finish().unwrap_err();
    assert!(matches!(empty, DecodeError::Missing { .. }), "{empty}");
}

#[test]
fn frames_that_do_not_belong_are_refused() {
    let gray = sequence(Mode::Gray);
    let settings = rig().settings(&gray);
    let mut accumulator = Accumulator::new(settings.clone()).unwrap();
    let len = 160 * 60;
    let role = code(Axis::Column, 0, false);
    assert!(matches!(
        accumulator.push(role, Arc::new(vec![0u16; 5])),
        Err(DecodeError::Size { found: 5, .. })
    ));
    accumulator.push(role, Arc::new(vec![0u16; len])).unwrap();
    assert!(matches!(accumulator.push(role, Arc::new(vec![0u16; len])), Err(DecodeError::Repeated { .. })));
    assert!(matches!(
        accumulator.push(Role::White, Arc::new(vec![0u8; len])),
        Err(DecodeError::Mixed { .. })
    ));
    let deep = code(Axis::Row, 10, true);
    assert!(matches!(
        accumulator.push(deep, Arc::new(vec![0u16; len])),
        Err(DecodeError::UnknownBit { bits: 10, .. })
    ));
    accumulator.push(Role::White, Arc::new(vec![0u16; len])).unwrap();
    accumulator.push(Role::White, Arc::new(vec![0u16; len])).unwrap();
    assert_eq!(accumulator.len(), 3);
    for broken in [
        DecodeSettings { width: 0, ..settings.clone() },
        DecodeSettings {
            camera: crate::decode::CameraResponse { bit_depth: 17, ..settings.camera },
            ..settings.clone()
        },
    ] {
        assert!(matches!(Accumulator::new(broken), Err(DecodeError::Settings { .. })));
    }
}

#[test]
fn thresholds_that_nothing_can_be_decoded_with_are_refused() {
    let settings = rig().settings(&sequence(Mode::Pse));
    let accepts = |change: &dyn Fn(&mut Thresholds)| {
        let mut settings = settings.clone();
        change(&mut settings.thresholds);
        match Accumulator::new(settings) {
            Ok(_) => true,
            Err(DecodeError::Settings { .. }) => false,
            Err(other) => panic!("{other}"),
        }
    };
    for (edges, usable) in
        [(0, false), (1, false), (2, true), (8, true), (64, true), (65, false), (usize::MAX, false)]
    {
        assert_eq!(accepts(&|thresholds| thresholds.fit_edges = edges), usable, "{edges}");
    }
    for value in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        assert!(!accepts(&|thresholds| thresholds.lit_sigma = value), "{value}");
        assert!(!accepts(&|thresholds| thresholds.soft_bit_sigma = value), "{value}");
        assert!(!accepts(&|thresholds| thresholds.snap_px = value), "{value}");
    }
}

#[test]
fn pair_sums_are_noise_when_all_is_well_and_name_what_is_not() {
    let scene = |x: f64, y: f64| Spot { reflectance: 0.4, ..plane(x, y) };
    let pse = sequence(Mode::Pse);
    let frames = rig().scan(&scene, &pse);
    let well = decode(rig().settings(&pse), frames.clone()).unwrap();
    assert_eq!(well.pairs.len(), 20);
    for pair in &well.pairs {
        assert!((pair.sigma - 1.0).abs() < 0.06 && pair.median.abs() < 0.1 && pair.pixels > 9000, "{pair:?}");
        assert!(pair.flat_outliers < 1e-3 && pair.edge_outliers < 1e-3, "{pair:?}");
    }
    let residual: f32 = well.residual.data().iter().sum::<f32>() / well.residual.len() as f32;
    assert!((residual - 1.0).abs() < 0.05, "{residual}");
    assert!(well.drift.unwrap().abs() < 2e-3);

    // A stale frame: bit 7 still shows what was before it. One brighter pair. A bent response at edges only.
    let mut bad = frames.clone();
    *frame_of(&mut bad, code(Axis::Column, 7, false)) =
        frame_of(&mut bad, code(Axis::Column, 6, true)).clone();
    for sample in frame_of(&mut bad, code(Axis::Row, 2, false)) {
        *sample = (f64::from(*sample) * 1.03).round() as u16;
    }
    let decoded = decode(rig().settings(&pse), bad.clone()).unwrap();
    let of = |axis, bit| *decoded.pairs.iter().find(|pair| (pair.axis, pair.bit) == (axis, bit)).unwrap();
    assert!(of(Axis::Column, 7).flat_outliers > 0.2, "{:?}", of(Axis::Column, 7));
    assert!(of(Axis::Row, 2).median > 1.0, "{:?}", of(Axis::Row, 2));
    assert!(of(Axis::Column, 5).sigma < 1.06);

    // The same from one pair at a time, as during capture, with the first references only.
    let first = |role: Role| Plane::U16(&bad.iter().find(|(r, _)| *r == role).unwrap().1);
    let single = |axis, bit| {
        let context = PairContext {
            axis,
            bit,
            width: 160,
            high: &[first(Role::ReferenceH)],
            low: &[first(Role::ReferenceV)],
            camera: rig().camera(),
            noise: rig().noise(),
            lit_sigma: 4.0,
        };
        pair_residual(first(code(axis, bit, false)), first(code(axis, bit, true)), &context).unwrap()
    };
    assert!((single(Axis::Column, 5).sigma - 1.0).abs() < 0.06, "{:?}", single(Axis::Column, 5));
    assert!(single(Axis::Column, 7).flat_outliers > 0.2);
    assert!(single(Axis::Row, 2).median > 1.0);
    let pairs = [
        [first(Role::ReferenceH), first(Role::ReferenceV)],
        [first(code(Axis::Column, 0, false)), first(code(Axis::Column, 0, true))],
    ];
    let estimated = estimate_noise(&pairs, 160, &rig().camera()).unwrap();
    // One reflectance shows the noise at its own level only: the mean of bright and dark.
    let level = 0.4 * 0.9 * 4095.0 * 1.02 / 2.0;
    let ratio = estimated.variance(level) / rig().noise().variance(level);
    assert!((0.8..1.25).contains(&ratio), "{ratio}");
}

#[test]
fn drift_of_the_last_reference_is_measured() {
    let pse = sequence(Mode::Pse);
    let mut frames = rig().scan(&plane, &pse);
    let last = frames.iter().rposition(|(role, _)| *role == Role::ReferenceH).unwrap();
    for sample in &mut frames[last].1 {
        *sample = (41.0 + (f64::from(*sample) - 41.0) * 0.97).round() as u16;
    }
    let drift = decode(rig().settings(&pse), frames).unwrap().drift.unwrap();
    assert!((drift + 0.03).abs() < 0.002, "{drift}");
}

#[test]
fn contrast_equals_its_definition() {
    let (width, height) = (13, 7);
    let picture = |salt: u64| -> Vec<u16> {
        (0..width * height)
            .map(|at| (600.0 + 200.0 * normal(salt * 1000 + at as u64)).clamp(0.0, 1023.0) as u16)
            .collect()
    };
    let (one, two, dark) = (picture(1), picture(2), picture(3));
    let lit = Grid::from_vec(width, height, (0..width * height).map(|at| at % 5 != 0).collect());
    let (depth, black) = (10, 20.0);
    let fast =
        contrast(&[Plane::U16(&one), Plane::U16(&two)], &[Plane::U16(&dark)], depth, black, &lit).unwrap();
    let mut slow = [0.0f64; 4];
    for frame in [&one, &two] {
        let raw = |at: usize| f64::from(frame[at]) * 255.0 / 1023.0;
        let dolp = |at: usize| {
            let (i, v) = (f64::from(frame[at]) - black, f64::from(dark[at]) - black);
            if i + v > 0.0 { ((i - v) / (i + v)).clamp(0.0, 1.0) * 255.0 } else { 0.0 }
        };
        let (mut sums, mut pairs, mut lit_pairs) = ([0.0f64; 4], 0.0, 0.0);
        for (x, y) in (0..height).flat_map(|y| (0..width).map(move |x| (x, y))) {
            for (dx, dy) in [(-1i32, 0i32), (1, 0), (0, -1), (0, 1)] {
                let other_x = (x as i32 + dx).clamp(0, width as i32 - 1) as usize;
                let other_y = (y as i32 + dy).clamp(0, height as i32 - 1) as usize;
                let (at, other) = (y * width + x, other_y * width + other_x);
                pairs += 1.0;
                sums[0] += (raw(at) - raw(other)).powi(2);
                sums[1] += (dolp(at) - dolp(other)).powi(2);
                if at != other && lit.at(x, y) && lit.at(other_x, other_y) {
                    lit_pairs += 1.0;
                    sums[2] += (raw(at) - raw(other)).powi(2);
                    sums[3] += (dolp(at) - dolp(other)).powi(2);
                }
            }
        }
        let counts = [pairs, pairs, lit_pairs, lit_pairs];
        slow.iter_mut().zip(sums).zip(counts).for_each(|((slow, sum), count)| *slow += sum / count / 2.0);
    }
    let Contrast { raw, dolp, raw_lit, dolp_lit, ratio, ratio_lit } = fast;
    for (fast, slow) in [raw, dolp, raw_lit, dolp_lit].into_iter().zip(slow) {
        assert!((fast / slow - 1.0).abs() < 1e-5, "{fast} {slow}");
    }
    assert!((ratio * raw / dolp - 1.0).abs() < 1e-12 && (ratio_lit * raw_lit / dolp_lit - 1.0).abs() < 1e-12);
    assert!(contrast(&[], &[Plane::U16(&dark)], depth, black, &lit).is_none());
    assert!(contrast(&[Plane::U16(&one)], &[Plane::U8(&[0; 91])], depth, black, &lit).is_none());
}
