//! Light that changed between frames, steadily or to and fro.

use polscan_patterns::Role;
use serde_json::json;

use super::{Case, View, all_evidence, names};
use crate::{
    decode::Decoded,
    evidence::{
        CHANGE, Frames,
        exposure::{self, Exposure, Gauge},
    },
    report::{
        diagnosis::{Diagnosis, Reason},
        statistics,
    },
};

/// Whether the brightness of each frame answers to the frame before, as automatic exposure does: see [`exposure`]. The
/// gains are those of bright pixels against the first bright reference, so that neither the other frame of a pair nor what
/// the references were exposed like enters; steps within pairs alone are tried, too, for pairs that were taken again.
pub(in crate::report::diagnosis) fn is_automatic(frames: Frames) -> bool {
    let Some([bright, _]) = frames.all_references() else { return false };
    let Some(&reference) = bright.first() else { return false };
    let class = frames.decoded.class.data();
    let gauge = Gauge {
        reference,
        black_dn: frames.decoded.black_level_dn,
        saturation_dn: frames.settings.camera.saturation_dn,
    };
    // Per frame: its place in the scan, its brightness, and whether it is the first of a pair.
    let mut found: Vec<(usize, Exposure, bool)> = Vec::new();
    for view in super::views(&frames.decoded.pairs).iter().filter(|view| view.rank >= super::FINE_RANKS) {
        let role = Role::Code { axis: view.pair.axis, bit: view.pair.bit, inverse: false };
        let Some(place) = frames.all.iter().position(|(other, _)| *other == role) else { continue };
        let Some((_, inverse)) = frames.all.get(place + 1) else { continue };
        let pair = [frames.all[place].1, *inverse];
        for which in 0..2 {
            let exposure = gauge.exposure(pair[which], pair[1 - which], |at| class[at].is_lit());
            found.extend(exposure.map(|exposure| (place + which, exposure, which == 0)));
        }
    }
    found.sort_by_key(|(place, ..)| *place);
    if !exposure::swings(found.iter().map(|(_, exposure, _)| *exposure)) {
        return false;
    }
    let answers = |within_pairs: bool| {
        let next = found.windows(2).filter(|two| two[1].0 == two[0].0 + 1 && (!within_pairs || two[0].2));
        let steps: Vec<[f64; 2]> = next.map(|two| two[0].1.step_to(two[1].1)).collect();
        steps.len() >= LEAST_STEPS && exposure::answers(&steps)
    };
    answers(false) || answers(true)
}

/// Whether the light of the frames goes up and down more than once over, or a few frames stand out from the rest. A lamp
/// that warms up and automatic exposure go one way; where the references were exposed otherwise than all pairs, as
/// automatic exposure does, no few frames stand out; nor are those the ones of a flicker that are the last of all, where the
/// light stayed as they have it (`drifted`).
fn is_to_and_fro(coarse: &[View], shifted: &[Case], drifted: bool) -> bool {
    if shifted.iter().all(|case| case.look.is_none()) {
        return true;
    }
    let mut changes = Vec::new();
    for view in coarse {
        let case = shifted.iter().find(|case| std::ptr::eq(case.view.pair, view.pair));
        match case.and_then(|case| case.look.as_ref()) {
            Some(look) if look.is_offset => changes.extend([look.change; 2]),
            Some(look) => changes.extend(look.gains),
            // One that changed by just too little to be a case did not go back to nothing.
            None if view.is_shifted() => {}
            None => changes.extend([0.0; 2]),
        }
    }
    if shifted.iter().any(|case| !coarse.iter().any(|view| std::ptr::eq(case.view.pair, view.pair))) {
        // A single fine pair.
        return !drifted;
    }
    let (low, high) = changes.iter().fold((f64::MAX, f64::MIN), |(l, h), &c| (l.min(c), h.max(c)));
    let range = high - low;
    // Pairs that agree with each other went nowhere: it is the references that were taken in other light.
    if range < STEADY {
        return false;
    }
    let travel: f64 = changes.windows(2).map(|two| (two[1] - two[0]).abs()).sum();
    let middle = statistics::median(&mut changes.clone()).unwrap_or(0.0);
    let is_odd = |change: &&f64| (*change - middle).abs() > 0.5 * range;
    let odd = changes.iter().filter(is_odd).count();
    let stays = drifted && changes.iter().rev().take_while(is_odd).count() == odd;
    let few = odd as f64 <= FEW_FRAMES * changes.len() as f64 && middle.abs() < 0.3 * range && !stays;
    travel >= TRAVEL * range || few
}

/// Correlation of the shifts with the order of the pairs from which on they are a drift rather than a flicker.
const TREND: f64 = 0.8;
/// Difference of first and last references, as a share of the modulation, from which on it is a reason: it moves a stripe
/// edge by about a third of the 0.05 px that an edge should be good for.
const DRIFT: f64 = 0.02;
/// How many times its range the light must travel from frame to frame for going to and fro: once over is 1, up and down
/// again 2.
const TRAVEL: f64 = 2.5;
/// Steps from frame to frame that automatic exposure is told by.
const LEAST_STEPS: usize = 8;
/// Range of the changes of all frames below which they are one and the same.
const STEADY: f64 = 0.5 * CHANGE;
/// Share of the frames that are few.
const FEW_FRAMES: f64 = 0.15;
/// Share of the drift that the modulation must take part in for lamp or exposure to be its cause.
const LAMP_SHARE: f64 = 0.5;

/// Light that changed.
pub(super) fn brightness(
    decoded: &Decoded,
    frames: Option<Frames>,
    coarse: &[View],
    shifted: &[Case],
) -> Option<Reason> {
    let trend = trend(coarse);
    let drift = decoded.drift.and_then(statistics::finite);
    let drifted = drift.is_some_and(|drift| drift.abs() > DRIFT);
    let automatic = frames.is_some_and(|frames| frames.adjusts);
    let to_and_fro =
        !shifted.is_empty() && !automatic && trend.abs() < TREND && is_to_and_fro(coarse, shifted, drifted);
    let one_way = !shifted.is_empty() && (frames.is_some() || trend.abs() >= TREND);
    if !to_and_fro && (drifted || one_way || automatic) {
        let modulation = frames.and_then(|frames| frames.modulation_drift());
        return Some(drift_reason(drift, modulation, trend, shifted, automatic));
    }
    if shifted.is_empty() {
        return None;
    }
    let change = |case: &Case| case.look.as_ref().map(|look| look.change.abs());
    let by = match shifted.iter().filter_map(change).max_by(f64::total_cmp) {
        Some(change) => format!("{:.1} %", 100.0 * change),
        None => {
            let shifts = shifted.iter().map(|case| case.view.shift.abs());
            format!("{:.1} times the noise", shifts.fold(0.0, f64::max))
        }
    };
    let mut evidence = all_evidence(shifted);
    evidence["trend"] = json!(trend);
    Some(Reason::degraded(
        Diagnosis::Flicker,
        format!(
            "the light of {} differs from that of the other frames by up to {by}, to and fro rather than steadily; the \
             lamp or the room's light flickers faster than a scan takes: choose an exposure of whole periods of the mains \
             (10 or 20 ms at 50 Hz) or of the projector's refresh, and shade the scene",
            names(shifted),
        ),
        evidence,
    ))
}

fn drift_reason(
    drift: Option<f64>,
    modulation: Option<f64>,
    trend: f64,
    shifted: &[Case],
    automatic: bool,
) -> Reason {
    let seen = match drift {
        Some(drift) => {
            format!("the last references differ from the first by {:+.1} % of the modulation", 100.0 * drift)
        }
        None => format!("the light changed over {}", names(shifted)),
    };
    let mut evidence = all_evidence(shifted);
    evidence["drift"] = json!(drift);
    evidence["modulation_drift"] = json!(modulation);
    evidence["trend"] = json!(trend);
    evidence["follows_the_frame_before"] = json!(automatic);
    if automatic {
        return Reason::degraded(
            Diagnosis::ExposureDrift,
            format!(
                "{seen}, and each frame is the darker, the brighter the one before it was: the camera adjusts itself; switch \
                 automatic exposure and gain off, and scan again"
            ),
            evidence,
        );
    }
    let offsets = shifted.iter().filter_map(|case| case.look.as_ref()).filter(|look| look.is_offset).count();
    let lamp = match drift.zip(modulation).filter(|(drift, _)| drift.abs() > DRIFT) {
        Some((drift, modulation)) => Some(modulation.abs() >= LAMP_SHARE * drift.abs()),
        None if shifted.iter().all(|case| case.look.is_none()) => None,
        // First and last references agree: what lies between them tells.
        None => Some(2 * offsets < shifted.len()),
    };
    if lamp == Some(false) {
        return Reason::degraded(
            Diagnosis::AmbientDrift,
            format!(
                "{seen}, while the projector's own light stayed the same; daylight or a lamp in the room changed: shade \
                 the scene or switch the room's light off, and scan again"
            ),
            evidence,
        );
    }
    let cause = match lamp {
        Some(_) => "the projector's lamp warms up or the camera adjusts itself",
        None => "the projector's lamp warms up, the camera adjusts itself, or the light in the room changed",
    };
    Reason::degraded(
        Diagnosis::ExposureDrift,
        format!(
            "{seen}; {cause}: let the lamp warm up for 20 minutes, switch automatic exposure, gain and the projector's \
             eco mode off, and scan again"
        ),
        evidence,
    )
}

/// Correlation of the shifts with the order in which the pairs were captured; 0 for fewer than four.
fn trend(coarse: &[View]) -> f64 {
    if coarse.len() < 4 {
        return 0.0;
    }
    let middle = (coarse.len() - 1) as f64 / 2.0;
    let mean = coarse.iter().map(|view| view.shift).sum::<f64>() / coarse.len() as f64;
    let (mut cross, mut places, mut shifts) = (0.0, 0.0, 0.0);
    for (place, view) in coarse.iter().enumerate() {
        let (place, shift) = (place as f64 - middle, view.shift - mean);
        cross += place * shift;
        places += place * place;
        shifts += shift * shift;
    }
    statistics::finite(cross / (places * shifts).sqrt()).unwrap_or(0.0)
}
