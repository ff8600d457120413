//! Light that changed between frames, steadily or to and fro.

use serde_json::json;

use super::{Case, View, all_evidence, names};
use crate::{
    decode::Decoded,
    report::{
        diagnosis::{Diagnosis, Reason, look::Frames},
        statistics,
    },
};

/// Correlation of the shifts with the order of the pairs from which on they are a drift rather than a flicker.
const TREND: f64 = 0.8;
/// Difference of first and last references, as a share of the modulation, from which on it is a reason: it moves a stripe
/// edge by about a third of the 0.05 px that an edge should be good for.
const DRIFT: f64 = 0.02;
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
    if drifted || (!shifted.is_empty() && trend.abs() >= TREND) {
        let modulation = frames.and_then(|frames| frames.modulation_drift());
        return Some(drift_reason(drift, modulation, trend, shifted));
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

fn drift_reason(drift: Option<f64>, modulation: Option<f64>, trend: f64, shifted: &[Case]) -> Reason {
    let seen = match drift {
        Some(drift) => {
            format!("the last references differ from the first by {:+.1} % of the modulation", 100.0 * drift)
        }
        None => format!("the light changed steadily over {}", names(shifted)),
    };
    let mut evidence = all_evidence(shifted);
    evidence["drift"] = json!(drift);
    evidence["modulation_drift"] = json!(modulation);
    evidence["trend"] = json!(trend);
    let lamp = drift.zip(modulation).map(|(drift, modulation)| modulation.abs() >= LAMP_SHARE * drift.abs());
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
