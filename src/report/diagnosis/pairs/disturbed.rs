//! Frames that do not show what they should, or not all of it.

use serde_json::{Value, json};

use super::{Case, all_evidence, names};
use crate::report::{
    diagnosis::{Diagnosis, Reason, look::Look},
    statistics,
};

/// Residual as a share of the modulation from which on a frame shows another picture (1 is the ideal), not a rest of it.
const STALE_SHARE: f64 = 0.5;
/// Outliers of a pair from which on a whole frame is wrong. A frame that shows another pattern is wrong on a half of
/// the pixels or more.
const WHOLE_FRAME: f64 = 0.15;
/// Share of the coarse pairs up to which a disturbance came and went.
const FEW_PAIRS: f64 = 0.15;
/// How far the bad pixels of one pair are those of the next as well, 0 by chance and 1 for all, from which on something
/// moved. Where frames show other patterns it is chance.
const SAME_PIXELS: f64 = 0.4;

/// Pixels that do not fit together on flat areas.
pub(super) fn disturbance(disturbed: &[Case], coarse: usize) -> Reason {
    if disturbed.len() as f64 <= (FEW_PAIRS * coarse as f64).max(2.0) {
        return one_frame(disturbed);
    }
    let share = disturbed.iter().map(Case::share).fold(0.0, f64::max);
    let looks: Vec<&Look> = disturbed.iter().filter_map(|case| case.look.as_ref()).collect();
    let mut same: Vec<f64> = looks.windows(2).filter_map(|pair| pair[0].same_pixels(pair[1])).collect();
    let same = statistics::median(&mut same);
    let mut strengths: Vec<f64> = disturbed.iter().filter_map(Case::strength).collect();
    let strength = statistics::median(&mut strengths);
    let mut evidence = all_evidence(disturbed);
    evidence["same_pixels"] = json!(same);
    let moved = same.map_or(share < WHOLE_FRAME, |same| same >= SAME_PIXELS);
    match strength {
        _ if moved => motion(disturbed, share, evidence),
        Some(rest) if rest < STALE_SHARE => Reason::degraded(
            Diagnosis::UnsettledDisplay,
            format!(
                "in {} the frames do not add up to the references: a rest of about {:.0} % of the picture before is \
                 still on the glass; the display had not settled: run `polscan calibrate sync`, or hold each picture \
                 for one refresh more",
                names(disturbed),
                100.0 * rest,
            ),
            evidence,
        ),
        _ => Reason::failed(
            Diagnosis::StaleFrame,
            format!(
                "in {} up to {:.0} % of the flat pixels do not add up to the references; the frames show other \
                 pictures than they should, as when each is captured one picture too early: run \
                 `polscan calibrate sync`, and scan again",
                names(disturbed),
                100.0 * share,
            ),
            evidence,
        ),
    }
}

/// A disturbance of one pair or two.
fn one_frame(disturbed: &[Case]) -> Reason {
    let share = disturbed.iter().map(Case::share).fold(0.0, f64::max);
    let worst = disturbed.iter().max_by(|a, b| a.share().total_cmp(&b.share()));
    let by_modulation = worst.and_then(Case::strength).is_none_or(|strength| strength >= STALE_SHARE);
    if let Some(row) = worst.and_then(|case| case.look.as_ref()?.torn_at).filter(|_| by_modulation) {
        return torn(disturbed, row);
    }
    match share >= WHOLE_FRAME && by_modulation {
        true => stale(disturbed, share),
        false => motion(disturbed, share, all_evidence(disturbed)),
    }
}

/// A disturbance of a fine pair alone: blur takes its residual's strength, and motion would not spare the others.
pub(super) fn fine_frame(case: &Case) -> Reason {
    match case.look.as_ref().and_then(|look| look.torn_at) {
        Some(row) => torn(std::slice::from_ref(case), row),
        None => stale(std::slice::from_ref(case), case.view.outliers()),
    }
}

fn torn(disturbed: &[Case], row: usize) -> Reason {
    Reason::failed(
        Diagnosis::TornFrame,
        format!(
            "in {} the image is sound on one side of row {row} and wrong on the other; the frame was exposed while the \
             picture changed: switch vertical sync on, run `polscan calibrate sync`, and scan again",
            names(disturbed),
        ),
        all_evidence(disturbed),
    )
}

fn stale(disturbed: &[Case], share: f64) -> Reason {
    Reason::failed(
        Diagnosis::StaleFrame,
        format!(
            "in {} {:.0} % of the pixels do not add up to the references, by as much as another picture would make; one \
             of its frames shows the picture before: run `polscan calibrate sync`, or raise the delay from flip to \
             trigger, and scan again",
            names(disturbed),
            100.0 * share,
        ),
        all_evidence(disturbed),
    )
}

fn motion(disturbed: &[Case], share: f64, evidence: Value) -> Reason {
    let message = format!(
        "in {} up to {:.1} % of the flat pixels do not add up to the references, in a part of the image; something \
         moved there during the capture: hold object, camera and projector still, and scan again",
        names(disturbed),
        100.0 * share,
    );
    // Where most of the image moved, no part of it can be trusted.
    match share > 0.5 {
        true => Reason::failed(Diagnosis::Motion, message, evidence),
        false => Reason::degraded(Diagnosis::Motion, message, evidence),
    }
}
