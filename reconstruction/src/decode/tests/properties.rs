//! What must hold for every projector and whatever the light.

use std::sync::Arc;

use polscan_patterns::{Axis, Mode, Polarization, ProjectorSize, Sequence};
use proptest::prelude::*;
use rayon::prelude::*;

use crate::decode::{
    Accumulator, CameraResponse, DecodeSettings, Decoded, SharedPlane, Thresholds,
    synth::{Rig, Spot, sequence},
};

/// Decodes what a camera would see whose pixels are those of the projector, without noise or blur.
fn decode_itself(sequence: &Sequence) -> Decoded {
    let ProjectorSize { width, height } = sequence.size();
    let settings = DecodeSettings {
        mode: sequence.mode,
        column: sequence.column,
        row: sequence.row,
        width: width as usize,
        height: height as usize,
        camera: CameraResponse { bit_depth: 8, black_level_dn: Some(0.0), saturation_dn: 255, noise: None },
        thresholds: Thresholds::default(),
    };
    let mut accumulator = Accumulator::new(settings).unwrap();
    for &role in &sequence.roles {
        let raster = sequence.raster(role, Polarization::green_horizontal());
        // Green is horizontal, and so is the polarizer of the camera.
        let seen: Vec<u8> =
            raster.to_rgb(sequence.size()).chunks_exact(3).map(|rgb| 20 + rgb[1] / 2).collect();
        let plane: SharedPlane = Arc::new(seen);
        accumulator.push(role, plane).unwrap();
    }
    accumulator.finish().unwrap()
}

/// Pixels that do not carry their own place.
fn astray(sequence: &Sequence) -> Vec<(usize, usize)> {
    let decoded = decode_itself(sequence);
    let ProjectorSize { width, height } = sequence.size();
    let places = (0..height as usize).flat_map(|y| (0..width as usize).map(move |x| (x, y)));
    let at_home = |&(x, y): &(usize, usize)| {
        let row = decoded.row.as_ref().is_none_or(|row| row.code.at(x, y) == y as i32);
        decoded.class.at(x, y).is_valid() && decoded.column.code.at(x, y) == x as i32 && row
    };
    places.filter(|place| !at_home(place)).collect()
}

#[test]
fn every_projector_from_one_pixel_to_4096_decodes_to_itself() {
    // Columns alone: rows are coded the same way, and sizes of both are drawn below. A pixel without any neighbour has
    // nobody to vote for it, so one column needs two lines.
    let wrong: Vec<_> = (1u32..=4096)
        .into_par_iter()
        .map(|width| ProjectorSize { width, height: if width == 1 { 2 } else { 1 } })
        .map(|size| (size, astray(&Sequence::new(Mode::Fast, size).unwrap())))
        .filter(|(_, astray)| !astray.is_empty())
        .collect();
    let shown: Vec<_> =
        wrong.iter().take(5).map(|(size, astray)| (size, &astray[..astray.len().min(5)])).collect();
    assert!(wrong.is_empty(), "{} sizes, among them {shown:?}", wrong.len());
}

/// A slanted plane under some light; `light` is the level of reflectance 1 as a share of full well.
fn scan(light: f64, reflectance: f64, ambient_electrons: f64, seed: u64) -> (Rig, Decoded) {
    let rig = Rig { width: 160, height: 32, level: light, ambient_electrons, seed, ..Rig::default() };
    let scene = move |x: f64, y: f64| Spot {
        u: 300.2 + 0.331 * x + 0.011 * y,
        v: 200.4 + 0.333 * y - 0.008 * x,
        reflectance,
        ..Spot::default()
    };
    let decoded = rig.decode(&scene, &sequence(Mode::Pse));
    (rig, decoded)
}

/// Largest share of pixels whose two readings differ by more than they should: five sigma happen to 6 in 10 million
/// normal numbers, and sigma is itself an estimate.
const BEYOND_FIVE_SIGMA: f64 = 2e-3;

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn every_mode_decodes_to_itself(width in 1u32..300, height in 2u32..120, mode in 0usize..4) {
        let mode = [Mode::Pse, Mode::Fast, Mode::Gray, Mode::Paper][mode];
        let sequence = Sequence::new(mode, ProjectorSize { width, height }).unwrap();
        let astray = astray(&sequence);
        prop_assert!(astray.is_empty(), "{} of {}: {:?}", astray.len(), width * height, &astray[..astray.len().min(5)]);
    }
}

proptest! {
    // Each case renders and decodes two whole scans.
    #![proptest_config(ProptestConfig::with_cases(4))]

    /// Light, reflectance and ambient change what is precise, never where a point is.
    #[test]
    fn columns_and_rows_do_not_depend_on_the_light(
        light in 0.3f64..0.9, exposure in 0.5f64..1.0, reflectance in 0.4f64..1.0, ambient in 0.0f64..800.0, seed in 1u64..1000,
    ) {
        let (rig, plain) = scan(light, 1.0, 20.0, seed);
        let (_, changed) = scan(light * exposure, reflectance, ambient, seed + 1000);
        for axis in [Axis::Column, Axis::Row] {
            let map = |decoded: &Decoded| match axis {
                Axis::Column => decoded.column.clone(),
                Axis::Row => decoded.row.clone().unwrap(),
            };
            let (one, other) = (map(&plain), map(&changed));
            let (mut both, mut beyond) = (0u32, 0u32);
            for y in 0..rig.height {
                for x in 0..rig.width {
                    let valid = |decoded: &Decoded| decoded.class.at(x, y).is_valid();
                    if !valid(&plain) || !valid(&changed) {
                        continue;
                    }
                    both += 1;
                    let apart = (one.coordinate.at(x, y) - other.coordinate.at(x, y)).abs();
                    beyond += u32::from(apart > 5.0 * one.sigma.at(x, y).hypot(other.sigma.at(x, y)));
                    prop_assert!(apart <= 1.0, "{axis:?} at ({x}, {y}): apart by {apart}");
                }
            }
            prop_assert!(f64::from(both) > 0.99 * (rig.width * rig.height) as f64, "{both} decoded");
            prop_assert!(f64::from(beyond) <= BEYOND_FIVE_SIGMA * f64::from(both), "{axis:?}: {beyond} of {both}");
        }
    }
}
