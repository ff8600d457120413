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
        let found = survey(decoded, &disturbed);
        reasons.push(disturbance(&disturbed, coarse.len(), found));
    }
    match lone(&fine, modulation) {
        Some(view) if disturbed.is_empty() => {
            let found = survey(decoded, &[view]);
            reasons.push(one_frame(&[view], found));
        }
        Some(_) => {}
        // With most pairs disturbed, what happens at edges is no evidence of its own.
        None if 3 * sound.len() >= coarse.len() => {
            // Light that changes shifts fine pairs as it does coarse ones.
            let fine = if shifted.is_empty() { &fine[..] } else { &[] };
            reasons.extend(nonlinear(&sound, fine));
        }
        None => {}
    }
    reasons
}

fn survey(decoded: &Decoded, disturbed: &[View]) -> Field {
    let striped = disturbed.iter().all(|view| view.pair.axis == Axis::Row);
    field::survey(decoded, disturbed.len(), striped)
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
    let by_modulation = found.relative.is_none_or(|relative| relative >= STALE_SHARE);
    if let Some(row) = found.torn_at.filter(|_| by_modulation) {
        return Reason::failed(
            Diagnosis::TornFrame,
            format!(
                "in {names} the image is sound on one side of row {row} and wrong on the other; the frame was exposed \
                 while the picture changed: switch vertical sync on, run `polscan calibrate sync`, and scan again"
            ),
            evidence,
        );
    }
    if share < WHOLE_FRAME || !by_modulation {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::{Verdict, testing};

    /// A sound decode, spoilt; then the diagnoses with their severities.
    fn found(spoil: impl FnOnce(&mut Decoded)) -> Vec<(Diagnosis, Verdict)> {
        found_with(None, spoil)
    }

    fn found_with(
        modulation_drift: Option<f64>,
        spoil: impl FnOnce(&mut Decoded),
    ) -> Vec<(Diagnosis, Verdict)> {
        let mut decoded = testing::decoded(64, 48);
        spoil(&mut decoded);
        let reasons = diagnose(&decoded, modulation_drift);
        for reason in &reasons {
            assert!(reason.message.len() > 60 && reason.evidence.is_object(), "{reason:?}");
        }
        reasons.into_iter().map(|reason| (reason.diagnosis, reason.severity)).collect()
    }

    const PAIRS: f64 = 20.0;

    /// Root mean square over all pairs of a residual of `share` of the modulation in `bad` pairs and noise in all.
    fn residual(decoded: &Decoded, share: f64, bad: f64) -> f32 {
        let amplitude = share * field::modulation_sigma(decoded).unwrap();
        ((bad * amplitude * amplitude + PAIRS) / PAIRS).sqrt() as f32
    }

    /// Sets the residual where `place` says so.
    fn spread(decoded: &mut Decoded, value: f32, place: impl Fn(usize, usize) -> bool) {
        let width = decoded.residual.width();
        for (index, residual) in decoded.residual.data_mut().iter_mut().enumerate() {
            if place(index % width, index / width) {
                *residual = value;
            }
        }
    }

    #[test]
    fn noise_is_no_reason() {
        assert_eq!(found(|_| {}), []);
    }

    #[test]
    fn what_sound_captures_of_real_cameras_show_is_no_reason() {
        // 8-bit frames round all pairs down alike by half a sigma, a few pixels glitter.
        let medians = [0.0, -0.26, -0.27, -0.29, -0.36, -0.5, -0.53, -0.56, -0.56, -0.85];
        assert_eq!(
            found(|decoded| for pair in &mut decoded.pairs {
                pair.median = medians[usize::from(pair.bit)];
                pair.sigma = 0.9;
                pair.flat_outliers = 0.0002;
                pair.edge_outliers = 0.0005;
            }),
            []
        );
    }

    #[test]
    fn no_pairs_give_no_reasons() {
        assert_eq!(found(|decoded| decoded.pairs.clear()), []);
        assert_eq!(
            found(|decoded| for pair in &mut decoded.pairs {
                (pair.sigma, pair.median) = (f64::NAN, f64::NAN);
                (pair.flat_outliers, pair.edge_outliers, pair.pixels) = (f64::NAN, f64::NAN, 0);
            }),
            []
        );
    }

    /// Shares of pixels at edges beyond 5 sigma, and medians, as a real projector with a gamma showed them.
    #[test]
    fn a_gamma_is_a_nonlinear_response() {
        let edges = [0.07, 0.08, 0.21, 0.06, 0.08, 0.12, 0.13, 0.17, 0.43, 0.90];
        let gamma = |decoded: &mut Decoded| {
            for pair in &mut decoded.pairs {
                pair.edge_outliers = edges[usize::from(pair.bit)];
                if pair.bit == 9 {
                    (pair.sigma, pair.median, pair.flat_outliers) = (3.1, -15.4, 0.28);
                }
                if pair.bit == 8 {
                    (pair.sigma, pair.median, pair.flat_outliers) = (3.2, -4.1, 0.01);
                }
            }
        };
        assert_eq!(found(gamma), [(Diagnosis::NonlinearResponse, Verdict::Degraded)]);
        assert_eq!(
            found(|decoded| {
                gamma(decoded);
                decoded.pairs.retain(|pair| pair.axis == Axis::Column);
            }),
            [(Diagnosis::NonlinearResponse, Verdict::Degraded)]
        );
    }

    #[test]
    fn crosstalk_of_the_finest_stripes_alone_is_a_nonlinear_response() {
        let crosstalk = |decoded: &mut Decoded| {
            for pair in decoded.pairs.iter_mut().filter(|pair| pair.bit == 9) {
                (pair.median, pair.edge_outliers) = (-6.0, 0.6);
            }
        };
        assert_eq!(found(crosstalk), [(Diagnosis::NonlinearResponse, Verdict::Degraded)]);
    }

    /// An inverse that shows its own pattern again: the sum is off by the whole modulation, up or down.
    fn repeat(decoded: &mut Decoded, bit: usize) {
        let modulation = field::modulation_sigma(decoded).unwrap();
        let pair = &mut decoded.pairs[bit];
        (pair.sigma, pair.median, pair.flat_outliers) = (1.48 * modulation, 0.9 * modulation, 1.0);
        pair.edge_outliers = 0.9;
        let value = residual(decoded, 1.0, 1.0);
        spread(decoded, value, |_, _| true);
    }

    #[test]
    fn a_frame_of_another_picture_is_stale() {
        for bit in 0..10 {
            assert_eq!(
                found(|decoded| repeat(decoded, bit)),
                [(Diagnosis::StaleFrame, Verdict::Failed)],
                "{bit}"
            );
        }
        // The inverse of the bit before: half of the pixels agree by chance, the others are off either way.
        for bit in 1..10 {
            let half = |decoded: &mut Decoded| {
                let pair = &mut decoded.pairs[bit];
                (pair.sigma, pair.flat_outliers, pair.edge_outliers) = (1.4, 0.5, 0.5);
                let value = residual(decoded, 1.0, 1.0);
                spread(decoded, value, |x, _| x % 4 < 2);
            };
            assert_eq!(found(half), [(Diagnosis::StaleFrame, Verdict::Failed)], "{bit}");
        }
    }

    #[test]
    fn a_shift_as_large_as_the_modulation_is_no_flicker() {
        // Where the pattern is nearly uniform over what the camera sees, a stale frame moves all pixels one way.
        let uniform = |decoded: &mut Decoded| {
            repeat(decoded, 0);
            decoded.pairs[0].sigma = 1.2;
        };
        assert_eq!(found(uniform), [(Diagnosis::StaleFrame, Verdict::Failed)]);
    }

    #[test]
    fn a_whole_sequence_one_frame_late_is_stale() {
        let late = |decoded: &mut Decoded| {
            for pair in &mut decoded.pairs {
                (pair.sigma, pair.flat_outliers, pair.edge_outliers) = (1.4, 0.5, 0.5);
            }
            let value = residual(decoded, 1.0, PAIRS / 2.0);
            spread(decoded, value, |_, _| true);
        };
        assert_eq!(found(late), [(Diagnosis::StaleFrame, Verdict::Failed)]);
    }

    #[test]
    fn a_rest_of_the_picture_before_is_an_unsettled_display() {
        let unsettled = |decoded: &mut Decoded| {
            for pair in &mut decoded.pairs {
                (pair.sigma, pair.flat_outliers, pair.edge_outliers) = (1.4, 0.4, 0.4);
            }
            let value = residual(decoded, 0.2, PAIRS / 2.0);
            spread(decoded, value, |_, _| true);
        };
        assert_eq!(found(unsettled), [(Diagnosis::UnsettledDisplay, Verdict::Degraded)]);
    }

    #[test]
    fn a_frame_of_two_pictures_is_torn() {
        for bit in [2, 8] {
            let torn = |decoded: &mut Decoded| {
                let pair = &mut decoded.pairs[bit];
                (pair.flat_outliers, pair.edge_outliers) = (0.35, 0.35);
                let value = residual(decoded, 1.0, 1.0);
                spread(decoded, value, |_, y| y >= 31);
            };
            assert_eq!(found(torn), [(Diagnosis::TornFrame, Verdict::Failed)], "{bit}");
        }
    }

    #[test]
    fn a_part_of_the_image_that_fails_in_many_pairs_moved() {
        let moved = |share: f64| {
            found(move |decoded| {
                for pair in decoded.pairs.iter_mut().filter(|pair| pair.axis == Axis::Row) {
                    (pair.flat_outliers, pair.edge_outliers) = (share, share);
                }
                let value = residual(decoded, 0.6, 10.0);
                spread(decoded, value, |x, y| (10..30).contains(&x) && (10..30).contains(&y));
            })
        };
        assert_eq!(moved(0.13), [(Diagnosis::Motion, Verdict::Degraded)]);
        assert_eq!(moved(0.6), [(Diagnosis::Motion, Verdict::Failed)]);
        assert_eq!(moved(0.0015), []);
    }

    #[test]
    fn a_part_of_the_image_that_fails_in_one_pair_moved_through() {
        let passed = |decoded: &mut Decoded| {
            decoded.pairs[3].flat_outliers = 0.1;
            let value = residual(decoded, 0.6, 1.0);
            spread(decoded, value, |x, y| (10..30).contains(&x) && (10..30).contains(&y));
        };
        assert_eq!(found(passed), [(Diagnosis::Motion, Verdict::Degraded)]);
    }

    #[test]
    fn a_handful_of_pixels_is_no_evidence() {
        assert_eq!(
            found(|decoded| {
                decoded.pairs[3].flat_outliers = 0.01;
                decoded.pairs[3].pixels = 1900;
            }),
            []
        );
    }

    #[test]
    fn brightness_to_and_fro_is_flicker() {
        let flicker = |decoded: &mut Decoded| {
            for (index, pair) in decoded.pairs.iter_mut().enumerate() {
                pair.median = [0.0, 2.0, -1.5, 0.3, 1.9, -2.2][index % 6];
            }
        };
        assert_eq!(found(flicker), [(Diagnosis::Flicker, Verdict::Degraded)]);
        // So strong that all pixels are outliers, at edges as well; still one common shift.
        let strong = |decoded: &mut Decoded| {
            for (index, pair) in decoded.pairs.iter_mut().enumerate() {
                pair.median = if index % 3 == 1 { 12.0 } else { 0.0 };
                if index % 3 == 1 {
                    (pair.sigma, pair.flat_outliers, pair.edge_outliers) = (4.0, 0.97, 0.97);
                }
            }
        };
        assert_eq!(found(strong), [(Diagnosis::Flicker, Verdict::Degraded)]);
    }

    #[test]
    fn brightness_that_goes_one_way_is_drift() {
        let steady = |decoded: &mut Decoded| {
            for (index, pair) in decoded.pairs.iter_mut().enumerate() {
                pair.median = 0.3 * index as f64 - 3.0;
            }
            decoded.drift = None;
        };
        assert_eq!(found(steady), [(Diagnosis::ExposureDrift, Verdict::Degraded)]);
    }

    #[test]
    fn references_that_differ_are_drift_of_lamp_or_room() {
        let drifted = |decoded: &mut Decoded| decoded.drift = Some(-0.05);
        assert_eq!(found(drifted), [(Diagnosis::ExposureDrift, Verdict::Degraded)]);
        assert_eq!(found_with(Some(-0.048), drifted), [(Diagnosis::ExposureDrift, Verdict::Degraded)]);
        assert_eq!(found_with(Some(0.001), drifted), [(Diagnosis::AmbientDrift, Verdict::Degraded)]);
        assert_eq!(found(|decoded| decoded.drift = Some(0.01)), []);
    }
}
