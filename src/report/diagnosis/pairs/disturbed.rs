//! Frames that do not show what they should, or not all of it.

use polscan_patterns::Role;
use serde_json::{Value, json};

use super::{Case, View, all_evidence, names};
use crate::{
    decode::PairResidual,
    evidence::{Cause, Frames, Look, STALE_SHARE, WHOLE_FRAME},
    report::{
        diagnosis::{Diagnosis, Reason},
        statistics,
    },
};

/// Outliers of a pair that is sound when its frames are looked for elsewhere, the share of the disturbed pairs for which
/// that must hold, and the least number of them: fewer may fit by chance.
const SOUND: f64 = 0.01;
const FITTING: f64 = 0.7;
const LEAST_FITTING: usize = 3;
/// Share of the image that moved from which on the camera did, or the object as a whole.
const MOVED: f64 = 0.25;
/// Share of the coarse pairs up to which a disturbance came and went.
const FEW_PAIRS: f64 = 0.15;
/// How far the bad pixels of one pair are those of the next as well, 0 by chance and 1 for all, from which on something
/// moved. Where frames show other patterns it is chance.
const SAME_PIXELS: f64 = 0.4;

/// Pixels that do not fit together on flat areas.
/// `fine` are the fine pairs, which only tell where a lost frame was.
pub(super) fn disturbance(
    disturbed: &[Case],
    fine: &[View],
    coarse: usize,
    frames: Option<Frames>,
) -> Reason {
    if let Some(reason) = frames.and_then(|frames| arrival(disturbed, fine, frames)) {
        return reason;
    }
    if disturbed.len() as f64 <= (FEW_PAIRS * coarse as f64).max(2.0) {
        return one_frame(disturbed);
    }
    let rests: Vec<f64> = disturbed
        .iter()
        .filter_map(|case| match case.look.as_ref()?.cause() {
            Cause::Rest(rest) => Some(rest),
            _ => None,
        })
        .collect();
    if 2 * rests.len() > disturbed.len() {
        let rest = statistics::median(&mut rests.clone()).unwrap_or(0.0);
        return unsettled(disturbed, rest);
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
        Some(rest) if rest < STALE_SHARE => unsettled(disturbed, rest),
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

pub(super) fn unsettled(disturbed: &[Case], rest: f64) -> Reason {
    Reason::degraded(
        Diagnosis::UnsettledDisplay,
        format!(
            "in {} the frames do not add up to the references: a rest of about {:.0} % of the picture before is still on \
             the glass; the display had not settled: run `polscan calibrate sync`, or hold each picture for one refresh \
             more",
            names(disturbed),
            100.0 * rest,
        ),
        all_evidence(disturbed),
    )
}

/// Frames that fit when those of the place before or behind are taken for them: one was lost, or came twice. Both fit at
/// once, as the pair before and the pair behind; what stands in the places of the last references tells which it is.
fn arrival(disturbed: &[Case], fine: &[View], frames: Frames) -> Option<Reason> {
    let place = |pair: &PairResidual| {
        let role = Role::Code { axis: pair.axis, bit: pair.bit, inverse: false };
        frames.all.iter().position(|(other, _)| *other == role)
    };
    // A lost frame displaces all that come behind it, the fine pairs as well.
    let first = disturbed.iter().filter_map(|case| place(case.view.pair)).min()?;
    let behind = fine.iter().filter(|view| place(view.pair).is_some_and(|place| place > first));
    let coarse = disturbed.iter().map(|case| (case.view.pair, true));
    let pairs: Vec<_> = coarse.chain(behind.map(|view| (view.pair, false))).collect();
    let fits = |from: isize| {
        let sound = pairs.iter().filter(|(pair, flat_only)| {
            let place = place(pair);
            let planes = place.and_then(|place| {
                let first = place.checked_add_signed(from)?;
                Some([frames.all.get(first)?.1, frames.all.get(first + 1)?.1])
            });
            let look = planes.and_then(|planes| frames.look_at(planes, *flat_only));
            look.is_some_and(|look| look.unexplained < SOUND)
        });
        sound.count() as f64 >= FITTING * pairs.len() as f64
    };
    if pairs.len() < LEAST_FITTING || !(fits(-1) || fits(1)) {
        return None;
    }
    let [bright, dark] = frames.all_references()?;
    let ([first_bright, .., last_bright], [first_dark, .., last_dark]) = (&bright[..], &dark[..]) else {
        return None;
    };
    let early = frames.are_alike(*last_dark, *first_bright);
    let late = frames.are_alike(*last_bright, *first_dark);
    let mut evidence = all_evidence(disturbed);
    if early && !late {
        evidence["off_by_frames"] = json!(1);
        return Some(Reason::failed(
            Diagnosis::LostFrame,
            format!(
                "{} fit when the frame before is taken for each; a frame was lost before them, and all that follow stand \
                 one place too early: check cable and load of the camera, and scan again",
                names(disturbed),
            ),
            evidence,
        ));
    }
    late.then(|| {
        evidence["off_by_frames"] = json!(-1);
        Reason::failed(
            Diagnosis::StaleFrame,
            format!(
                "{} fit when the frame behind is taken for each; a frame came twice or one picture too late, and all that \
                 follow show the picture before: run `polscan calibrate sync`, and scan again",
                names(disturbed),
            ),
            evidence,
        )
    })
}

/// A disturbance of one pair or two.
fn one_frame(disturbed: &[Case]) -> Reason {
    let share = disturbed.iter().map(Case::share).fold(0.0, f64::max);
    let worst = disturbed.iter().max_by(|a, b| a.share().total_cmp(&b.share()));
    match worst.and_then(|case| case.look.as_ref()).map(Look::cause) {
        Some(Cause::Torn(row)) => torn(disturbed, row),
        Some(Cause::OtherPicture) => stale(disturbed, share),
        None if share >= WHOLE_FRAME => stale(disturbed, share),
        Some(Cause::Rest(rest)) => unsettled(disturbed, rest),
        _ => motion(disturbed, share, all_evidence(disturbed)),
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
    // Where much of the image moved, no part of it can be trusted.
    match share > MOVED {
        true => Reason::failed(Diagnosis::Motion, message, evidence),
        false => Reason::degraded(Diagnosis::Motion, message, evidence),
    }
}
