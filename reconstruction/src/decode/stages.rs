//! The stages of a decode one at a time, for whoever measures them. A decode comes through the same functions in the
//! same order.

use std::hint::black_box;

use polscan_patterns::Role;

use super::{
    gates,
    limits::Gates,
    noise, pair_sum,
    plan::plan,
    sample::Sample,
    subpixel,
    types::{DecodeError, DecodeSettings, Plane, SharedPlane},
    words::{PixelMaps, decode_pixels},
};
use crate::simd::InstructionSet;

/// Calls `visit` with the name of each stage and with what does the stage's work once each time that it is called.
///
/// # Errors
/// As [`finish`](super::Accumulator::finish).
pub fn each_stage(
    settings: &DecodeSettings,
    frames: &[(Role, SharedPlane)],
    visit: &mut dyn FnMut(&'static str, &mut dyn FnMut()),
) -> Result<(), DecodeError> {
    match frames.first().map(|(_, plane)| plane.plane()) {
        Some(Plane::U16(_)) => typed::<u16>(settings, frames, visit),
        _ => typed::<u8>(settings, frames, visit),
    }
}

fn typed<T: Sample>(
    settings: &DecodeSettings,
    pushed: &[(Role, SharedPlane)],
    visit: &mut dyn FnMut(&'static str, &mut dyn FnMut()),
) -> Result<(), DecodeError> {
    let frames = plan::<T>(settings, pushed)?;
    let camera = settings.camera;
    let black_level_dn = camera.black_level_dn.unwrap_or(0.0);
    visit("noise", &mut || {
        black_box(noise::estimate(&frames, camera.bit_depth, black_level_dn, camera.saturation_dn));
    });
    let gates = Gates::new(settings, camera.noise.unwrap_or_else(|| noise::assumed(camera.bit_depth)));
    let set = InstructionSet::widest();
    let mut maps = PixelMaps::new(frames.width * frames.height, frames.axes.len());
    visit("words", &mut || decode_pixels(&frames, &gates, set, black_box(&mut maps)));
    // Whoever measures a later stage alone does not call the work of this one.
    decode_pixels(&frames, &gates, set, &mut maps);
    visit("pair-sums", &mut || {
        black_box(pair_sum::of_scan(&frames, &maps, &gates, set));
    });
    let before = maps.class.clone();
    visit("gates", &mut || {
        maps.class.clone_from(&before);
        black_box(gates::apply(&frames, &mut maps, &settings.thresholds, set));
    });
    maps.class = before;
    let (_, shapes) = gates::apply(&frames, &mut maps, &settings.thresholds, set);
    for (index, shape) in shapes.iter().enumerate() {
        visit(if index == 0 { "subpixel-first-axis" } else { "subpixel-second-axis" }, &mut || {
            black_box(subpixel::refine(&frames, &maps, &gates, &settings.thresholds, (index, *shape), set));
        });
    }
    Ok(())
}
