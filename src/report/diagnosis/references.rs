//! First and last references against each other, by the rule of the live capture.

use serde_json::json;

use super::{Diagnosis, Reason};
use crate::{
    decode::Plane,
    evidence::{Frames, is_another_picture},
    sequencer::{PairThresholds, PairVerdict, compare_pixels, drift_rule},
};
use polscan_drivers::frame::Pixels;
use polscan_patterns::Role;

fn pixels(plane: Plane<'_>) -> Pixels<'_> {
    match plane {
        Plane::U8(samples) => Pixels::U8(samples),
        Plane::U16(samples) => Pixels::U16(samples),
    }
}

/// Whether a first reference shows the picture of the other one: then all pairs disagree with it, and nothing moved.
pub fn is_repeated(frames: Frames) -> bool {
    frames.all_references().is_some_and(|[bright, dark]| match (&bright[..], &dark[..]) {
        ([first_bright, .., last_bright], [first_dark, .., last_dark]) => {
            frames.are_alike(*first_bright, *first_dark) && !frames.are_alike(*last_bright, *last_dark)
        }
        _ => false,
    })
}

/// The reason where a last reference shows another picture than the first. What moved between them shows in the pairs.
pub fn disagree(frames: Frames) -> Option<Reason> {
    let roles = [Role::ReferenceV, Role::ReferenceH, Role::Black, Role::White];
    roles.into_iter().find_map(|role| {
        let planes = frames.of(role);
        let [first, .., last] = &planes[..] else { return None };
        let first = *first;
        let camera = &frames.settings.camera;
        let camera = crate::decode::CameraResponse {
            black_level_dn: Some(frames.decoded.black_level_dn),
            ..*camera
        };
        let change = compare_pixels(pixels(first), pixels(*last), &camera, frames.decoded.noise)?;
        match drift_rule(role, &change, &PairThresholds::default()) {
            PairVerdict::Retake(suspicion)
                if suspicion.reason == Diagnosis::StaleFrame.slug()
                    && is_another_picture(
                        [first, *last],
                        |at| f64::from(frames.decoded.modulation.data()[at]),
                        frames.decoded.noise,
                        frames.decoded.black_level_dn,
                    ) =>
            {
                Some(Reason::failed(
                    Diagnosis::StaleFrame,
                    format!(
                        "{}; a reference shows another picture than its name says, as when pictures come late or frames \
                         are missing: run `polscan calibrate sync`, and scan again",
                        suspicion.evidence
                    ),
                    json!({
                        "role": role.to_string(), "outliers": change.outliers, "brightness": change.gain,
                        "offset_dn": change.offset_dn, "sigma": change.sigma,
                    }),
                ))
            }
            _ => None,
        }
    })
}
