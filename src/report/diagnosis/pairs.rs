//! What the residuals of the pair sums mean: see the table of `docs/diagnoses.md`.
//!
//! The pair sum `P + Q = R_H + R_V` holds at each pixel for linear light, whatever the pattern. It can fail
//! - on flat areas: frame and reference do not belong together (stale, torn, motion, flicker, drift, unsettled), or
//! - at stripe edges only, where alone P and Q take values that the references do not: the response is not linear.

use polscan_patterns::Axis;
use serde_json::{Value, json};

use super::{Diagnosis, Reason, field, field::Field};
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
/// Share of the lit pixels from which on a disturbance of many pairs is everywhere rather than somewhere.
const EVERYWHERE: f64 = 0.3;
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

    /// Whether all pixels moved alike, as when the light changes, and by less than another picture would do.
    fn is_shifted(&self, modulation: Option<f64>) -> bool {
        let precise = 5.0 * 1.2533 * self.sigma().max(1.0) / (self.pair.pixels.max(1) as f64).sqrt();
        self.shift.abs() > SHIFT_SIGMA.max(precise)
            && modulation.is_none_or(|modulation| self.shift.abs() < STALE_SHARE * modulation)
            && (!self.is_disturbed() || self.shift.abs() >= self.sigma())
    }

    fn is_disturbed(&self) -> bool {
        self.flat > FLAT_OUTLIERS && self.flat * self.pair.pixels as f64 >= LEAST_OUTLIERS
    }
}

/// All reasons that the pair sums give.
pub fn diagnose(decoded: &Decoded, modulation_drift: Option<f64>) -> Vec<Reason> {
    let views = views(&decoded.pairs);
    let (fine, mut coarse): (Vec<View>, Vec<View>) = views.iter().partition(|view| view.rank < FINE_RANKS);
    if coarse.is_empty() {
        coarse.clone_from(&views);
    }
    let modulation = field::modulation_sigma(decoded);
    let (shifted, rest): (Vec<View>, Vec<View>) = coarse.iter().partition(|view| view.is_shifted(modulation));
    let (disturbed, sound): (Vec<View>, Vec<View>) = rest.iter().partition(|view| view.is_disturbed());

    let mut reasons = Vec::new();
    reasons.extend(brightness(decoded, modulation_drift, &coarse, &shifted));
    if !disturbed.is_empty() {
        let found = field::survey(decoded, disturbed.len());
        reasons.push(disturbance(&disturbed, coarse.len(), found));
    }
    match lone(&fine, modulation) {
        Some(view) if disturbed.is_empty() => {
            let found = field::survey(decoded, 1);
            reasons.push(one_frame(&[view], found));
        }
        Some(_) => {}
        // With most pairs disturbed, what happens at edges is no evidence of its own.
        None if 3 * sound.len() >= coarse.len() => reasons.extend(nonlinear(&sound, &fine)),
        None => {}
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

fn names(views: &[View]) -> String {
    match views {
        [one] => format!("pair {}", one.name()),
        [one, other] => format!("pairs {} and {}", one.name(), other.name()),
        [one, .., last] => format!("{} pairs from {} to {}", views.len(), one.name(), last.name()),
        [] => "no pair".to_owned(),
    }
}

fn worst<'a>(views: &[View<'a>], by: impl Fn(&View) -> f64) -> Option<View<'a>> {
    views.iter().copied().max_by(|a, b| by(a).total_cmp(&by(b)))
}

fn all_evidence(views: &[View]) -> Vec<Value> {
    views.iter().map(View::evidence).collect()
}

/// Light that changed for all pixels alike.
fn brightness(
    decoded: &Decoded,
    modulation_drift: Option<f64>,
    coarse: &[View],
    shifted: &[View],
) -> Option<Reason> {
    let trend = trend(coarse);
    let drift = decoded.drift.and_then(statistics::finite);
    let drifted = drift.is_some_and(|drift| drift.abs() > DRIFT);
    if drifted || (!shifted.is_empty() && trend.abs() >= TREND) {
        return Some(drift_reason(drift, modulation_drift, trend, shifted));
    }
    let largest = worst(shifted, |view| view.shift.abs())?;
    Some(Reason::degraded(
        Diagnosis::Flicker,
        format!(
            "the light of {} differs from that of the other frames by up to {:.1} times the noise, to and fro rather \
             than steadily; the lamp or the room's light flickers faster than a scan takes: choose an exposure of \
             whole periods of the mains (10 or 20 ms at 50 Hz) or of the projector's refresh, and shade the scene",
            names(shifted),
            largest.shift.abs(),
        ),
        json!({ "pairs": all_evidence(shifted), "largest_shift_sigma": largest.shift, "trend": trend }),
    ))
}

fn drift_reason(drift: Option<f64>, modulation: Option<f64>, trend: f64, shifted: &[View]) -> Reason {
    let seen = match drift {
        Some(drift) => {
            format!("the last references differ from the first by {:+.1} % of the modulation", 100.0 * drift)
        }
        None => format!("the light changed steadily over {}", names(shifted)),
    };
    let evidence = json!({ "drift": drift, "modulation_drift": modulation, "trend": trend, "pairs": all_evidence(shifted) });
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
fn disturbance(disturbed: &[View], coarse: usize, found: Field) -> Reason {
    if disturbed.len() as f64 <= (FEW_PAIRS * coarse as f64).max(2.0) {
        return one_frame(disturbed, found);
    }
    let share = worst(disturbed, |view| view.flat).map_or(0.0, |view| view.flat);
    let evidence = evidence_of(disturbed, found);
    if found.affected < EVERYWHERE {
        return motion(disturbed, share, evidence);
    }
    match found.relative {
        Some(relative) if relative < STALE_SHARE => Reason::degraded(
            Diagnosis::UnsettledDisplay,
            format!(
                "in {} the frames do not add up to the references: a rest of about {:.0} % of the picture before is \
                 still on the glass; the display had not settled: run `polscan calibrate sync`, or hold each picture \
                 for one refresh more",
                names(disturbed),
                // A pixel differs from the picture before in a half of the pairs.
                100.0 * relative * std::f64::consts::SQRT_2,
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

fn evidence_of(views: &[View], found: Field) -> Value {
    json!({
        "pairs": all_evidence(views), "affected_share": found.affected,
        "residual_share_of_modulation": found.relative, "torn_at_row": found.torn_at,
    })
}

/// A disturbance of one pair or two.
fn one_frame(disturbed: &[View], found: Field) -> Reason {
    let share = worst(disturbed, |view| view.outliers()).map_or(0.0, |view| view.outliers());
    let evidence = evidence_of(disturbed, found);
    let names = names(disturbed);
    if let Some(row) = found.torn_at {
        return Reason::failed(
            Diagnosis::TornFrame,
            format!(
                "in {names} the image is sound on one side of row {row} and wrong on the other; the frame was exposed \
                 while the picture changed: switch vertical sync on, run `polscan calibrate sync`, and scan again"
            ),
            evidence,
        );
    }
    let whole = share >= WHOLE_FRAME && found.relative.is_none_or(|relative| relative >= STALE_SHARE);
    if !whole {
        return motion(disturbed, share, evidence);
    }
    Reason::failed(
        Diagnosis::StaleFrame,
        format!(
            "in {names} {:.0} % of the pixels do not add up to the references, by as much as another picture would \
             make; one of its frames shows the picture before: run `polscan calibrate sync`, or raise \
             the delay from flip to trigger, and scan again",
            100.0 * share,
        ),
        evidence,
    )
}

fn motion(disturbed: &[View], share: f64, evidence: Value) -> Reason {
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
fn lone<'a>(fine: &[View<'a>], modulation: Option<f64>) -> Option<View<'a>> {
    let bad = worst(fine, |view| view.outliers()).filter(|view| view.outliers() > LONE_OUTLIERS)?;
    let others = fine.iter().filter(|view| !std::ptr::eq(view.pair, bad.pair));
    let alone = fine.len() > 1 && others.clone().all(|view| view.outliers() < SOUND_OUTLIERS);
    let strong = modulation
        .is_none_or(|modulation| bad.sigma().max(bad.shift.abs()) >= 0.5 * STALE_SHARE * modulation);
    // A stale frame may be off by the modulation both ways and not at all on half of the pixels.
    (alone && (strong || bad.shift.abs() < SHIFT_SIGMA)).then_some(bad)
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
            "finest_pairs": all_evidence(&finest),
        }),
    ))
}
