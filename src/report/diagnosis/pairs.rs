//! What the residuals of the pair sums mean: see the table of `docs/diagnoses.md`.
//!
//! The pair sum `P + Q = R_H + R_V` holds at each pixel for linear light, whatever the pattern. It can fail
//! - on flat areas: frame and reference do not belong together (stale, torn, motion, flicker, drift, unsettled), or
//! - at stripe edges only, where alone P and Q take values that the references do not: the response is not linear.

mod disturbed;
mod light;

use polscan_patterns::Axis;
use serde_json::{Value, json};

pub(super) use self::light::is_automatic;
use super::{Diagnosis, Reason};
use crate::{
    decode::{Decoded, PairResidual},
    evidence::{Cause, EDGE_OUTLIERS, FLAT_OUTLIERS, Frames, Look, STALE_SHARE, WHOLE_FRAME},
    report::statistics,
};

/// Fewer outliers than this are no evidence of anything.
const LEAST_OUTLIERS: f64 = 20.0;
/// Common shift of a pair against the other pairs, in sigma of a pixel. Rounding to 8 bits shifts real captures by up to
/// 0.9, all pairs alike within 0.6.
const SHIFT_SIGMA: f64 = 1.0;
/// Shift or spread of the two finest pairs that shows crosstalk between neighbouring pixels of the panel.
const FINE_SIGMA: f64 = 3.0;
/// Bits with stripes of up to this power of two of projector pixels have no flat areas on all rigs.
const FINE_RANKS: u8 = 3;
/// Outliers of a fine pair that stands alone among sound ones.
const LONE_OUTLIERS: f64 = 0.2;
/// Outliers of a fine pair that is sound beside it.
const SOUND_OUTLIERS: f64 = 0.05;
/// Difference of the gains of P and Q, as a share of the larger, from which on it is the light and not the response.
const UNEQUAL: f64 = 0.5;
/// Shift and spread of a pair that call for a closer look, in units of noise that was measured: where it was estimated,
/// from 8-bit frames in particular, sound pairs reach them.
const LOOK_SHIFT: f64 = 0.5;
const LOOK_SIGMA: f64 = 1.25;

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
        self.look.as_ref().map_or(self.view.outliers(), Look::disturbed)
    }

    fn strength(&self) -> Option<f64> {
        self.look.as_ref().and_then(|look| look.strength)
    }

    fn evidence(&self) -> Value {
        let mut evidence = self.view.evidence();
        if let Some(look) = &self.look {
            evidence["look"] = json!({
                "outliers": look.outliers, "brightness_change": look.change,
                "unexplained_by_brightness": look.unexplained, "spread_unexplained": look.spread,
                "residual_share_of_modulation": look.strength, "torn_at_row": look.torn_at,
                "noise_of_assumed": look.noise,
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

fn sort<'a>(coarse: &[View<'a>], frames: Option<Frames>, measured_noise: bool) -> Sorted<'a> {
    let mut sorted = Sorted::default();
    for &view in coarse {
        let odd = view.shift.abs() > LOOK_SHIFT || view.sigma() > LOOK_SIGMA;
        let conspicuous = view.is_disturbed() || view.is_shifted() || (measured_noise && odd);
        let close = |frames: Frames| frames.look(view.pair.axis, view.pair.bit, true);
        let look = conspicuous.then(|| frames.and_then(close)).flatten();
        let (brightness, disturbed) = match &look {
            Some(look) => match look.cause() {
                Cause::Nothing => (false, false),
                Cause::Lamp | Cause::Room => (true, false),
                _ => (false, true),
            },
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
    let (mut fine, mut coarse): (Vec<View>, Vec<View>) =
        views.iter().partition(|view| view.rank < FINE_RANKS);
    // Compared with the mean of all pairs, every pair shows what is wrong with one of them; the median does not.
    if let Some(frames) = frames.filter(|frames| !frames.has_references())
        && fine.iter().any(|view| view.outliers() > SOUND_OUTLIERS)
    {
        for view in &mut fine {
            if let Some(look) = frames.look(view.pair.axis, view.pair.bit, false) {
                (view.flat, view.edge) = (look.disturbed(), look.disturbed());
            }
        }
    }
    if coarse.is_empty() {
        coarse.clone_from(&views);
    }
    let Sorted { sound, mut shifted, mut disturbed } = sort(&coarse, frames, !decoded.noise_estimated);
    if let Some(rest) = frames.and_then(|frames| frames.rest)
        && !(shifted.is_empty() && disturbed.is_empty())
    {
        disturbed.append(&mut shifted);
        return vec![disturbed::unsettled(&disturbed, rest)];
    }
    if frames.is_some_and(|frames| frames.adjusts) {
        // Where both references were exposed otherwise than the pairs, dark pixels keep a rest that no gain of the pair
        // explains; another picture is off on a large part of the image, whatever the exposure.
        disturbed
            .retain(|case| case.share() >= WHOLE_FRAME && case.strength().is_some_and(|s| s >= STALE_SHARE));
    }

    let mut lone_fine = lone(&fine).map(|view| {
        let look = frames.and_then(|frames| frames.look(view.pair.axis, view.pair.bit, false));
        Case { view, look }
    });
    let light = |case: &Case| {
        case.look.as_ref().is_some_and(|look| matches!(look.cause(), Cause::Lamp | Cause::Room))
    };
    if lone_fine.as_ref().is_some_and(light) {
        shifted.extend(lone_fine.take());
    }
    // A lamp that dips in between fine pairs: unlike any response, it changes the frames of a pair unequally.
    shifted.extend(frames.map(|frames| flickering(&fine, frames)).unwrap_or_default());

    let mut reasons = Vec::new();
    reasons.extend(light::brightness(decoded, frames, &coarse, &shifted));
    if !disturbed.is_empty() {
        reasons.push(disturbed::disturbance(&disturbed, &fine, coarse.len(), frames));
        // With pairs disturbed, what happens at edges and in fine stripes is no evidence of its own; nor where pairs are
        // compared with each other for want of references.
        let compared = frames.is_some_and(|frames| !frames.has_references());
        if compared || 3 * sound.len() < coarse.len() {
            return reasons;
        }
    }
    match lone_fine {
        Some(case) if disturbed.is_empty() => reasons.push(disturbed::fine_frame(&case)),
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

/// A fine pair that is bad while all other fine ones are sound: no matter of the response, which spoils all of them.
fn lone<'a>(fine: &[View<'a>]) -> Option<View<'a>> {
    let bad = worst(fine, |view| view.outliers()).filter(|view| view.outliers() > LONE_OUTLIERS)?;
    let mut others = fine.iter().filter(|view| !std::ptr::eq(view.pair, bad.pair));
    // Of one axis alone the finest pair may be the only one that crosstalk spoils so much.
    let comparable = fine.iter().any(|view| view.pair.axis != bad.pair.axis) || bad.rank > 0;
    (comparable && others.all(|view| view.outliers() < SOUND_OUTLIERS)).then_some(bad)
}

/// Two fine pairs, the others being sound, between which the light was another for a frame or two.
fn flickering<'a>(fine: &[View<'a>], frames: Frames) -> Vec<Case<'a>> {
    let (bad, others): (Vec<View>, Vec<View>) = fine.iter().partition(|view| view.outliers() > LONE_OUTLIERS);
    if bad.len() != 2 || others.is_empty() || others.iter().any(|view| view.outliers() > SOUND_OUTLIERS) {
        return Vec::new();
    }
    let cases: Vec<Case> = bad
        .into_iter()
        .map(|view| Case { view, look: frames.look(view.pair.axis, view.pair.bit, false) })
        .collect();
    let unequal = |case: &Case| {
        case.look.as_ref().is_some_and(|look| {
            look.cause() == Cause::Lamp && (look.gains[0] - look.gains[1]).abs() > UNEQUAL * look.change.abs()
        })
    };
    if cases.iter().all(unequal) { cases } else { Vec::new() }
}

/// A response that is not linear shows at stripe edges, or in the finest stripes, which have nothing else.
fn nonlinear(sound: &[View], fine: &[View]) -> Option<Reason> {
    // Where as many flat pixels are off, too, it is not the edges.
    let mut edges: Vec<f64> = sound.iter().map(|view| (view.edge - 2.0 * view.flat).max(0.0)).collect();
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
