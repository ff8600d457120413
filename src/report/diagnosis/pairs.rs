//! What the residuals of the pair sums mean: see the table of `docs/diagnoses.md`.
//!
//! The pair sum `P + Q = R_H + R_V` holds at each pixel for linear light, whatever the pattern. It can fail
//! - on flat areas: frame and reference do not belong together (stale, torn, motion, flicker, drift, unsettled), or
//! - at stripe edges only, where alone P and Q take values that the references do not: the response is not linear.

use polscan_patterns::Axis;
use serde_json::{Value, json};

use super::{
    Diagnosis, Reason,
    look::{Frames, Look},
};
use crate::{
    decode::{Decoded, PairResidual},
    report::statistics,
};

/// Share of flat pixels beyond 5 sigma that disturbs a pair. Real captures that are sound stay below 0.0002, and noise
/// alone below 0.000001; 0.002 of 1 MP is an area of 45 x 45 px.
const FLAT_OUTLIERS: f64 = 0.002;
/// Fewer outliers than this are no evidence of anything.
const LEAST_OUTLIERS: f64 = 20.0;
/// Common shift of a pair against the other pairs, in sigma of a pixel. Rounding to 8 bits shifts real captures by up to
/// 0.9, all pairs alike within 0.6.
const SHIFT_SIGMA: f64 = 1.0;
/// Share of the pixels at stripe edges beyond 5 sigma that shows a response that is not linear. A linear projector and
/// camera stay below 0.0002; those with a gamma lie at 0.04 and above.
const EDGE_OUTLIERS: f64 = 0.01;
/// Shift or spread of the two finest pairs that shows crosstalk between neighbouring pixels of the panel.
const FINE_SIGMA: f64 = 3.0;
/// Bits with stripes of up to this power of two of projector pixels have no flat areas on all rigs.
const FINE_RANKS: u8 = 3;
/// Outliers of a fine pair that stands alone among sound ones.
const LONE_OUTLIERS: f64 = 0.2;
/// Outliers of a fine pair that is sound beside it.
const SOUND_OUTLIERS: f64 = 0.05;
/// Residual as a share of the modulation from which on a frame shows another picture (1 is the ideal), not a rest of it.
const STALE_SHARE: f64 = 0.5;
/// Outliers of a pair from which on a whole frame is wrong. A frame that shows another pattern is wrong on a half of
/// the pixels or more.
const WHOLE_FRAME: f64 = 0.15;
/// Share of the coarse pairs up to which a disturbance came and went.
const FEW_PAIRS: f64 = 0.15;
/// Share of a pair's bad pixels that are bad in the next pair as well, from which on something moved. Of pixels that are
/// bad because a frame shows another pattern, a half is bad in another pair.
const SAME_PIXELS: f64 = 0.7;
/// Correlation of the shifts with the order of the pairs from which on they are a drift rather than a flicker.
const TREND: f64 = 0.8;
/// Difference of first and last references, as a share of the modulation, from which on it is a reason: it moves a stripe
/// edge by about a third of the 0.05 px that an edge should be good for.
const DRIFT: f64 = 0.02;
/// Share of the drift that the modulation must take part in for lamp or exposure to be its cause.
const LAMP_SHARE: f64 = 0.5;

/// A pair with what the rules ask of it.
#[derive(Clone, Copy)]
struct View<'a> {
    pair: &'a PairResidual,
    /// Bits below it: stripes are `2^(rank + 1)` projector pixels wide.
    rank: u8,
    /// Median less that of the coarse pairs.
    shift: f64,
    flat: f64,
    edge: f64,
}

impl View<'_> {
    fn sigma(&self) -> f64 {
        statistics::finite(self.pair.sigma).unwrap_or(0.0)
    }

    fn outliers(&self) -> f64 {
        self.flat.max(self.edge)
    }

    fn name(&self) -> String {
        format!("{} bit {}", self.pair.axis, self.pair.bit)
    }

    fn evidence(&self) -> Value {
        json!({
            "axis": self.pair.axis, "bit": self.pair.bit, "sigma": self.pair.sigma, "median": self.pair.median,
            "flat_outliers": self.pair.flat_outliers, "edge_outliers": self.pair.edge_outliers,
        })
    }

    /// Whether the pixels moved as one, by the statistics of the pair alone.
    fn is_shifted(&self) -> bool {
        let precise = 5.0 * 1.2533 * self.sigma().max(1.0) / (self.pair.pixels.max(1) as f64).sqrt();
        self.shift.abs() > SHIFT_SIGMA.max(precise)
            && (!self.is_disturbed() || self.shift.abs() >= self.sigma())
    }

    fn is_disturbed(&self) -> bool {
        self.flat > FLAT_OUTLIERS && self.flat * self.pair.pixels as f64 >= LEAST_OUTLIERS
    }
}

/// A coarse pair that does not add up, with a closer look at it where there are frames to look at.
struct Case<'a> {
    view: View<'a>,
    look: Option<Look>,
}

impl Case<'_> {
    fn share(&self) -> f64 {
        self.look.as_ref().map_or(self.view.outliers(), |look| look.unexplained)
    }

    fn strength(&self) -> Option<f64> {
        self.look.as_ref().and_then(|look| look.strength)
    }

    fn evidence(&self) -> Value {
        let mut evidence = self.view.evidence();
        if let Some(look) = &self.look {
            evidence["look"] = json!({
                "outliers": look.outliers, "unexplained_by_brightness": look.unexplained,
                "brightness_change": look.change, "residual_share_of_modulation": look.strength,
                "torn_at_row": look.torn_at,
            });
        }
        evidence
    }
}

/// The coarse pairs by what is wrong with them.
#[derive(Default)]
struct Sorted<'a> {
    sound: Vec<View<'a>>,
    /// Another brightness, and nothing else.
    shifted: Vec<Case<'a>>,
    disturbed: Vec<Case<'a>>,
}

fn sort<'a>(coarse: &[View<'a>], frames: Option<Frames>) -> Sorted<'a> {
    let mut sorted = Sorted::default();
    for &view in coarse {
        let close = |frames: Frames| frames.look(view.pair.axis, view.pair.bit, true);
        let look = view.is_disturbed().then(|| frames.and_then(close)).flatten();
        let (brightness, disturbed) = match &look {
            // What a statistic against bad references or bad other pairs made look bad.
            Some(look) if look.outliers <= FLAT_OUTLIERS => (view.is_shifted(), false),
            Some(look) => (look.is_brightness(), true),
            None => (view.is_shifted(), view.is_disturbed()),
        };
        match (brightness, disturbed) {
            (true, _) => sorted.shifted.push(Case { view, look }),
            (_, true) => sorted.disturbed.push(Case { view, look }),
            (false, false) => sorted.sound.push(view),
        }
    }
    sorted
}

/// All reasons that the pair sums give. `frames` allow a closer look at pairs that fail.
pub fn diagnose(decoded: &Decoded, frames: Option<Frames>) -> Vec<Reason> {
    let views = views(&decoded.pairs);
    let (fine, mut coarse): (Vec<View>, Vec<View>) = views.iter().partition(|view| view.rank < FINE_RANKS);
    if coarse.is_empty() {
        coarse.clone_from(&views);
    }
    let Sorted { sound, shifted, disturbed } = sort(&coarse, frames);

    let mut reasons = Vec::new();
    reasons.extend(brightness(decoded, frames, &coarse, &shifted));
    if !disturbed.is_empty() {
        reasons.push(disturbance(&disturbed, coarse.len()));
        // With pairs disturbed, what happens at edges and in fine stripes is no evidence of its own.
        if 3 * sound.len() < coarse.len() {
            return reasons;
        }
    }
    match lone(&fine) {
        Some(view) if disturbed.is_empty() => {
            let look = frames.and_then(|frames| frames.look(view.pair.axis, view.pair.bit, false));
            reasons.push(fine_frame(&Case { view, look }));
        }
        Some(_) => {}
        None => {
            // Light that changes shifts fine pairs as it does coarse ones.
            let fine = if shifted.is_empty() { &fine[..] } else { &[] };
            reasons.extend(nonlinear(&sound, fine));
        }
    }
    reasons
}

fn views(pairs: &[PairResidual]) -> Vec<View<'_>> {
    let bits = |axis: Axis| {
        pairs.iter().filter(|pair| pair.axis == axis).map(|pair| pair.bit + 1).max().unwrap_or(0)
    };
    let bits = [bits(Axis::Column), bits(Axis::Row)];
    let number = |value: f64| statistics::finite(value).unwrap_or(0.0);
    let mut views: Vec<View> = pairs
        .iter()
        .map(|pair| View {
            pair,
            rank: bits[usize::from(pair.axis == Axis::Row)] - 1 - pair.bit,
            shift: number(pair.median),
            flat: number(pair.flat_outliers),
            edge: number(pair.edge_outliers),
        })
        .collect();
    let mut medians: Vec<f64> =
        views.iter().filter(|view| view.rank >= FINE_RANKS).map(|view| view.shift).collect();
    let common = statistics::median(&mut medians).unwrap_or(0.0);
    views.iter_mut().for_each(|view| view.shift -= common);
    views
}

fn names(cases: &[Case]) -> String {
    match cases {
        [one] => format!("pair {}", one.view.name()),
        [one, other] => format!("pairs {} and {}", one.view.name(), other.view.name()),
        [one, .., last] => {
            format!("{} pairs from {} to {}", cases.len(), one.view.name(), last.view.name())
        }
        [] => "no pair".to_owned(),
    }
}

fn worst<'a>(views: &[View<'a>], by: impl Fn(&View) -> f64) -> Option<View<'a>> {
    views.iter().copied().max_by(|a, b| by(a).total_cmp(&by(b)))
}

fn all_evidence(cases: &[Case]) -> Value {
    json!({ "pairs": cases.iter().map(Case::evidence).collect::<Vec<_>>() })
}

/// Light that changed.
fn brightness(
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
    let change = |case: &Case| case.look.as_ref().map(|look| look.change[0].abs().max(look.change[1].abs()));
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

/// Pixels that do not fit together on flat areas.
fn disturbance(disturbed: &[Case], coarse: usize) -> Reason {
    if disturbed.len() as f64 <= (FEW_PAIRS * coarse as f64).max(2.0) {
        return one_frame(disturbed);
    }
    let share = disturbed.iter().map(Case::share).fold(0.0, f64::max);
    let looks: Vec<&Look> = disturbed.iter().filter_map(|case| case.look.as_ref()).collect();
    let mut overlaps: Vec<f64> = looks.windows(2).filter_map(|pair| pair[0].overlap(pair[1])).collect();
    let overlap = statistics::median(&mut overlaps);
    let mut strengths: Vec<f64> = disturbed.iter().filter_map(Case::strength).collect();
    let strength = statistics::median(&mut strengths);
    let mut evidence = all_evidence(disturbed);
    evidence["same_pixels"] = json!(overlap);
    let moved = overlap.map_or(share < WHOLE_FRAME, |overlap| overlap >= SAME_PIXELS);
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
    if let Some(row) = worst.and_then(|case| case.look.as_ref()?.torn_at) {
        return torn(disturbed, row);
    }
    let by_modulation = worst.and_then(Case::strength).is_none_or(|strength| strength >= STALE_SHARE);
    match share >= WHOLE_FRAME && by_modulation {
        true => stale(disturbed, share),
        false => motion(disturbed, share, all_evidence(disturbed)),
    }
}

/// A disturbance of a fine pair alone: blur takes its residual's strength, and motion would not spare the others.
fn fine_frame(case: &Case) -> Reason {
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

/// A fine pair that is bad while all other fine ones are sound: no matter of the response, which spoils all of them.
fn lone<'a>(fine: &[View<'a>]) -> Option<View<'a>> {
    let bad = worst(fine, |view| view.outliers()).filter(|view| view.outliers() > LONE_OUTLIERS)?;
    let mut others = fine.iter().filter(|view| !std::ptr::eq(view.pair, bad.pair));
    // Of one axis alone the finest pair may be the only one that crosstalk spoils so much.
    let comparable = fine.iter().any(|view| view.pair.axis != bad.pair.axis) || bad.rank > 0;
    (comparable && others.all(|view| view.outliers() < SOUND_OUTLIERS)).then_some(bad)
}

/// A response that is not linear shows at stripe edges, or in the finest stripes, which have nothing else.
fn nonlinear(sound: &[View], fine: &[View]) -> Option<Reason> {
    let mut edges: Vec<f64> = sound.iter().map(|view| view.edge).collect();
    let edges = statistics::median(&mut edges).unwrap_or(0.0);
    let finest: Vec<View> = fine.iter().filter(|view| view.rank <= 1).copied().collect();
    let worst_fine = worst(&finest, |view| view.shift.abs().max(view.sigma()))
        .filter(|view| view.shift.abs().max(view.sigma()) > FINE_SIGMA);
    if edges <= EDGE_OUTLIERS && worst_fine.is_none() {
        return None;
    }
    let mut seen = Vec::new();
    if edges > EDGE_OUTLIERS {
        seen.push(format!(
            "{:.0} % of the pixels at stripe edges do not add up to the references",
            100.0 * edges
        ));
    }
    if let Some(view) = worst_fine {
        seen.push(format!(
            "the finest stripes ({}) are off by {:.1} times the noise",
            view.name(),
            view.shift.abs().max(view.sigma())
        ));
    }
    Some(Reason::degraded(
        Diagnosis::NonlinearResponse,
        format!(
            "{}, while flat areas do; the projector's or the camera's response is not linear, or neighbouring pixels of \
             the panel affect each other; the decode stands, with slightly biased edges: set the camera's gamma to \
             1 and the projector to native resolution without sharpening or picture enhancement",
            seen.join(" and "),
        ),
        json!({
            "edge_outliers": edges, "flat_outliers": worst(sound, |view| view.flat).map(|view| view.flat),
            "finest_pairs": finest.iter().map(View::evidence).collect::<Vec<_>>(),
        }),
    ))
}
#[cfg(test)]
mod tests;
