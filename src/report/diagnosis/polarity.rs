//! H and V exchanged where only one of them was shown: mode paper.

use polscan_patterns::{Axis, Role};
use serde_json::json;

use super::{Diagnosis, Reason};
use crate::{
    decode::Class,
    evidence::{Frames, sample},
    report::statistics,
};

/// About so many pixels are looked at.
const PIXELS: usize = 50_000;
/// Least number of them.
const LEAST_PIXELS: usize = 200;

/// The vertical reference must be as dark as the darker frame of each pair. Where it is as bright as the brighter one,
/// the rig is exchanged, and without a horizontal reference no polarity of the words can be told: they are all inverted.
pub fn reference_exchanged(frames: Frames) -> Option<Reason> {
    if !frames.settings.mode.is_polarized() || frames.has_references() {
        return None;
    }
    let reference = *frames.of(Role::ReferenceV).first()?;
    let frame = |inverse| frames.of(Role::Code { axis: Axis::Column, bit: 0, inverse }).first().copied();
    let (one, other) = (frame(false)?, frame(true)?);
    let class = frames.decoded.class.data();
    let mut places: Vec<f64> = (0..class.len())
        .step_by((class.len() / PIXELS).max(1))
        .filter(|&at| class[at].is_lit() && class[at] != Class::Saturated)
        .filter_map(|at| {
            let (one, other) = (sample(one, at), sample(other, at));
            statistics::finite((sample(reference, at) - one.min(other)) / (one - other).abs())
        })
        .collect();
    if places.len() < LEAST_PIXELS {
        return None;
    }
    let place = statistics::median(&mut places)?;
    (place > 0.5).then(|| {
        Reason::failed(
            Diagnosis::PolarizationInverted,
            "the frame under the uniform vertical pattern is as bright as the brighter frame of a pair; H and V are \
             exchanged, and mode paper has no second reference to decode with all the same: turn the polarizer in front of \
             the camera by 90 degrees, or exchange the projector's channels in the configuration"
                .to_owned(),
            json!({ "reference_between_frames": place }),
        )
    })
}
