//! Light that is there and too weak to be measured.

use serde_json::json;

use super::{Diagnosis, Reason};
use crate::{
    decode::{Class, Plane},
    evidence::Frames,
    report::PixelCounts,
};

/// Side of the blocks over which faint light is summed up, in px.
const BLOCK: usize = 16;
/// Mean modulation of a block, in units of one pixel's noise, that shows light: eight times what chance makes of 256 pixels.
const SEEN: f64 = 0.5;
/// Pixels of a block that must be unlit.
const LEAST: u32 = 64;
/// Share of all pixels that carry the projector's light which may be too dark: shadows catch stray light.
const TOO_DARK: f64 = 0.15;

/// The reason where a large part of the image carries projector light that single pixels do not show.
pub fn too_dark(frames: Frames, pixels: &PixelCounts) -> Option<Reason> {
    // Estimated noise is not known well enough to call an average of it light.
    if frames.decoded.noise_estimated {
        return None;
    }
    let [bright, dark] = frames.references()?;
    let class = &frames.decoded.class;
    let (width, height) = (class.width(), class.height());
    let mut faint = 0u64;
    for top in (0..height).step_by(BLOCK) {
        for left in (0..width).step_by(BLOCK) {
            let (mut sum, mut count) = (0.0, 0u32);
            for y in top..(top + BLOCK).min(height) {
                for x in left..(left + BLOCK).min(width) {
                    let at = y * width + x;
                    if class.data()[at] == Class::Unlit {
                        sum += modulation(frames, &bright, &dark, at);
                        count += 1;
                    }
                }
            }
            if count >= LEAST && (sum / f64::from(count)).abs() > SEEN {
                faint += u64::from(count);
            }
        }
    }
    let share = faint as f64 / (faint + pixels.lit).max(1) as f64;
    (share > TOO_DARK).then(|| {
        Reason::degraded(
            Diagnosis::LowCoverage,
            format!(
                "{:.0} % of the pixels that the projector lights are too dark to be measured one by one, though together \
                 they show its light; something dark is missing from the result: expose longer, or open the lens",
                100.0 * share,
            ),
            json!({ "too_dark": share, "pixels": faint, "mostly": "unlit" }),
        )
    })
}

/// Modulation of a pixel in units of its noise.
fn modulation(frames: Frames, bright: &[Plane<'_>], dark: &[Plane<'_>], at: usize) -> f64 {
    let black = frames.decoded.black_level_dn;
    let mean = |planes: &[Plane<'_>]| {
        let sum: f64 = planes.iter().map(|plane| crate::evidence::sample(*plane, at) - black).sum();
        (
            sum / planes.len() as f64,
            frames.decoded.noise.variance(sum / planes.len() as f64) / planes.len() as f64,
        )
    };
    let ((high, of_high), (low, of_low)) = (mean(bright), mean(dark));
    (high - low) / (of_high + of_low).sqrt()
}
