//! The judge of a live capture: each pair is checked by its pair sum the moment it is complete, against the
//! references taken first.

mod history;

use std::sync::Arc;

use polscan_drivers::frame::{Frame, PixelStore, Pixels};
use polscan_patterns::{Axis, Role, Sequence};

use self::history::{History, lasting};
use crate::{
    decode::{
        CameraResponse, NoiseModel, PairContext, Plane, PlaneSource, SharedPlane, Thresholds, estimate_noise,
        pair_residual,
    },
    evidence::{self, Cause},
    sequencer::{Judge, PairThresholds, PairVerdict, Suspicion, compare_references, drift_rule, judge_rule},
};

/// A frame as the decoder takes it, without a copy.
struct FramePlane(Arc<dyn PixelStore>);

impl PlaneSource for FramePlane {
    fn plane(&self) -> Plane<'_> {
        plane(self.0.pixels())
    }
}

fn plane(pixels: Pixels<'_>) -> Plane<'_> {
    match pixels {
        Pixels::U8(samples) => Plane::U8(samples),
        Pixels::U16(samples) => Plane::U16(samples),
    }
}

/// The pixels of a captured frame for the decoder; shares them.
pub fn shared_plane(frame: &Frame) -> SharedPlane {
    Arc::new(FramePlane(frame.store.clone()))
}

/// Pairs that a noise model is estimated from, one after the other.
const NOISE_PAIRS: u32 = 4;
/// Slug of a response that is not linear.
const NONLINEAR: &str = "nonlinear-response";
/// Finest bits, which have no flat areas on all rigs.
const FINE_BITS: u8 = 3;
/// Noise in units of that assumed, from which on the model does not hold.
const NOISY: f64 = 1.5;
/// Pairs that are kept to tell which of two that disagree is the wrong one.
const WITNESSES: usize = 4;

/// A pair, the frame first and its inverse second.
#[derive(Clone)]
struct Pair {
    axis: Axis,
    bit: u8,
    frames: [Frame; 2],
}

/// Judges pairs by their pair sum and last references by the first ones.
///
/// Where there are no two references, as in mode paper, the first pair takes their place, since any pair sums to the
/// same light. It is provisional until another agrees with it; pairs that contradict it but agree with each other
/// displace it.
pub struct PairSumJudge {
    sequence: Sequence,
    camera: CameraResponse,
    thresholds: Thresholds,
    limits: PairThresholds,
    high: Option<Frame>,
    low: Option<Frame>,
    first_pair: Option<Pair>,
    /// Whether a pair has agreed with the first one, the noise being known.
    first_holds: bool,
    /// Pairs since the first one, as long as that is provisional.
    witnesses: Vec<Pair>,
    noise: Option<NoiseModel>,
    /// Pairs that the noise has been estimated from.
    noise_pairs: u32,
    /// The pair before, as long as noise is estimated.
    last_pair: Option<Pair>,
    history: History,
}

impl PairSumJudge {
    /// A judge for one capture of `sequence`.
    pub fn new(sequence: Sequence, camera: CameraResponse, thresholds: Thresholds) -> Self {
        Self {
            sequence,
            noise: camera.noise,
            camera,
            thresholds,
            limits: PairThresholds::default(),
            high: None,
            low: None,
            first_pair: None,
            first_holds: false,
            witnesses: Vec::new(),
            noise_pairs: 0,
            last_pair: None,
            history: History::default(),
        }
    }

    /// Whether the noise is calibrated or no longer estimated anew.
    fn noise_settled(&self) -> bool {
        self.camera.noise.is_some() || self.noise_pairs >= NOISE_PAIRS
    }

    /// Frames that sum to the light of every pair.
    fn levels(&self) -> Option<[&Frame; 2]> {
        match (&self.high, &self.low, &self.first_pair) {
            (Some(high), Some(low), _) => Some([high, low]),
            (_, _, Some(first)) => Some(first.frames.each_ref()),
            _ => None,
        }
    }

    /// Estimates the noise from `pair` too and keeps the smallest: a frame that shows another picture only inflates it.
    fn learn_noise(&mut self, pair: &Pair) {
        if self.noise_settled() {
            return;
        }
        let Some(levels) = self.levels() else { return };
        let light = brightness(pair.frames.each_ref()) - self.camera.black_level_dn.unwrap_or(0.0);
        let earlier = [Some(levels), self.last_pair.as_ref().map(|last| last.frames.each_ref())];
        let smallest = earlier
            .into_iter()
            .flatten()
            .filter_map(|earlier| {
                let pairs = [earlier, pair.frames.each_ref()].map(|two| two.map(|f| plane(f.pixels())));
                estimate_noise(&pairs, pair.frames[0].width as usize, &self.camera)
            })
            .min_by(|one, other| one.variance(light).total_cmp(&other.variance(light)));
        self.last_pair = Some(pair.clone());
        if let Some(found) = smallest {
            self.noise_pairs += 1;
            let smaller = |known: NoiseModel| found.variance(light) < known.variance(light);
            if self.noise.is_none_or(smaller) {
                self.noise = Some(found);
            }
        }
        if self.noise_settled() {
            self.last_pair = None;
        }
    }

    /// Verdict on two frames of `axis` and `bit` by the light of `levels`, `None` where there is no telling.
    fn judge(&self, axis: Axis, bit: u8, frames: [&Frame; 2], levels: [&Frame; 2]) -> Option<PairVerdict> {
        let [high, low] = levels.map(|frame| plane(frame.pixels()));
        let context = PairContext {
            axis,
            bit,
            width: frames[0].width as usize,
            high: &[high],
            low: &[low],
            camera: self.camera,
            noise: self.noise?,
            lit_sigma: self.thresholds.lit_sigma,
        };
        let [frame, inverse] = frames.map(|frame| plane(frame.pixels()));
        let residual = pair_residual(frame, inverse, &context)?;
        let bits = self.sequence.code(axis).bits();
        let verdict = judge_rule(&residual, bits, &self.limits);
        let pair = evidence::Pair {
            frames: [frame, inverse],
            references: [high, low],
            width: context.width,
            saturation_dn: self.camera.saturation_dn,
            black_dn: self.camera.black_level_dn.unwrap_or(0.0),
            noise: context.noise,
        };
        Some(match verdict {
            PairVerdict::Accept => PairVerdict::Accept,
            PairVerdict::Degraded(suspicion) if suspicion.reason == "unverified-pair" => {
                PairVerdict::Degraded(suspicion)
            }
            // A statistic that stands out is looked at where it does: see there for what it is called.
            PairVerdict::Degraded(suspicion) => named(suspicion, false, &pair, self.is_fine(axis, bit)),
            PairVerdict::Retake(suspicion) => named(suspicion, true, &pair, self.is_fine(axis, bit)),
        })
    }

    /// Whether stripes are too narrow for flat areas.
    fn is_fine(&self, axis: Axis, bit: u8) -> bool {
        bit + FINE_BITS >= self.sequence.code(axis).bits()
    }

    /// Verdict on `pair` by `other` where either may be the wrong one.
    fn compare(&self, pair: &Pair, other: &Pair) -> Option<PairVerdict> {
        let (frames, others) = (pair.frames.each_ref(), other.frames.each_ref());
        let verdict = self.judge(pair.axis, pair.bit, frames, others)?;
        if matches!(verdict, PairVerdict::Retake(_)) {
            return Some(verdict);
        }
        // Two frames of one picture light no pixel in their difference: only the other way round is that seen.
        match self.judge(pair.axis, pair.bit, others, frames)? {
            PairVerdict::Retake(suspicion) => Some(PairVerdict::Retake(suspicion)),
            _ => Some(verdict),
        }
    }

    /// Whether two frames of a reference are as far apart as different pictures.
    fn is_another(&self, first: &Frame, last: &Frame) -> bool {
        let (Some([high, low]), Some(noise)) = (self.levels(), self.noise) else { return true };
        let modulation = |at: usize| f64::from(high.pixels().get(at)) - f64::from(low.pixels().get(at));
        let planes = [first, last].map(|frame| plane(frame.pixels()));
        evidence::is_another_picture(planes, modulation, noise, self.camera.black_level_dn.unwrap_or(0.0))
    }

    fn agree(&self, pair: &Pair, other: &Pair) -> bool {
        self.compare(pair, other).is_some_and(|verdict| verified(&verdict))
    }

    /// Verdict on `pair` by the first pair, which it may displace.
    fn against_first(&mut self, pair: Pair) -> Option<PairVerdict> {
        let Some(first) = &self.first_pair else {
            self.first_pair = Some(pair);
            return Some(PairVerdict::Accept);
        };
        if self.first_holds {
            return self.judge(pair.axis, pair.bit, pair.frames.each_ref(), first.frames.each_ref());
        }
        let verdict = self.compare(&pair, first)?;
        let mut holds = verified(&verdict);
        let verdict = match verdict {
            PairVerdict::Retake(suspicion) => {
                let votes = |side: &Pair| self.witnesses.iter().filter(|w| self.agree(side, w)).count();
                if votes(&pair) > votes(first) {
                    let evidence = format!(
                        "{} bit {}: the first pair, which nothing had verified, is contradicted by pairs that agree \
                         with each other; {}",
                        first.axis, first.bit, suspicion.evidence
                    );
                    self.first_pair = Some(pair.clone());
                    holds = true;
                    let reason = "unverified-pair".into();
                    PairVerdict::Degraded(Suspicion { reason, evidence, sigma: suspicion.sigma })
                } else {
                    PairVerdict::Retake(suspicion)
                }
            }
            verdict => verdict,
        };
        self.first_holds = holds && self.noise_settled();
        if self.first_holds {
            self.witnesses.clear();
        } else {
            if self.witnesses.len() == WITNESSES {
                self.witnesses.remove(0);
            }
            self.witnesses.push(pair);
        }
        Some(verdict)
    }
}

/// The verdict on a suspicious pair after a closer look. `grave`: its statistics alone ask for another take.
fn named(suspicion: Suspicion, grave: bool, pair: &evidence::Pair<'_>, fine: bool) -> PairVerdict {
    let verdict = |suspicion| match grave {
        true => PairVerdict::Retake(suspicion),
        false => PairVerdict::Degraded(suspicion),
    };
    let Some(look) = pair.look(!fine) else { return verdict(suspicion) };
    let cause = look.cause();
    // Fine stripes are nowhere flat, so that a response that is not linear spoils all of them; as much as another
    // picture does it does not.
    let cause = match cause {
        Cause::Rest(_) | Cause::Local if fine => Cause::Nothing,
        cause => cause,
    };
    let evidence = format!(
        "{}; {}: {:.2} % of the pixels, {:+.1} % brightness, {:.2} times the assumed noise from pixel to pixel",
        suspicion.evidence,
        cause.words(),
        100.0 * look.unexplained,
        100.0 * look.change,
        look.noise
    );
    let named = |reason: &str| Suspicion { reason: reason.into(), evidence: evidence.clone(), ..suspicion };
    match cause {
        Cause::Nothing if suspicion.reason == NONLINEAR => PairVerdict::Degraded(suspicion),
        Cause::Nothing if look.noise >= NOISY => PairVerdict::Degraded(named("noise-model")),
        Cause::Nothing if grave => PairVerdict::Degraded(named(NONLINEAR)),
        Cause::Nothing => PairVerdict::Degraded(suspicion),
        // The next picture would carry the same rest.
        Cause::Rest(_) => PairVerdict::Degraded(named("unsettled-display")),
        Cause::Lamp | Cause::Room | Cause::OtherPicture | Cause::Torn(_) | Cause::Local => {
            PairVerdict::Retake(named(cause.slug().unwrap_or("motion")))
        }
    }
}

/// Whether a verdict says that the frames show what they should, if not perfectly.
fn verified(verdict: &PairVerdict) -> bool {
    match verdict {
        PairVerdict::Accept => true,
        PairVerdict::Degraded(suspicion) => suspicion.reason != "unverified-pair",
        PairVerdict::Retake(_) => false,
    }
}

/// Mean of about ten thousand samples of each frame, in DN.
fn brightness(frames: [&Frame; 2]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for pixels in frames.map(Frame::pixels) {
        for index in (0..pixels.len()).step_by((pixels.len() / 10_000).max(1)) {
            sum += f64::from(pixels.get(index));
            count += 1.0;
        }
    }
    if count > 0.0 { sum / count } else { 0.0 }
}

impl Judge for PairSumJudge {
    fn reference(&mut self, role: Role, frame: &Frame) {
        match role {
            Role::ReferenceH | Role::White => self.high = Some(frame.clone()),
            Role::ReferenceV | Role::Black => self.low = Some(frame.clone()),
            Role::Code { .. } => {}
        }
        self.history.reference(frame, matches!(role, Role::ReferenceH | Role::White));
    }

    fn pair(&mut self, axis: Axis, bit: u8, frame: &Frame, inverse: &Frame) -> PairVerdict {
        let pair = Pair { axis, bit, frames: [frame.clone(), inverse.clone()] };
        self.learn_noise(&pair);
        let known = self.history.pair([frame, inverse], &self.camera, self.noise);
        let verdict = match (&self.high, &self.low) {
            (Some(high), Some(low)) => self.judge(axis, bit, [frame, inverse], [high, low]),
            _ => self.against_first(pair),
        };
        let verdict = match known {
            Some(known) => verdict.map(|verdict| lasting(verdict, known)),
            None => verdict,
        };
        verdict.unwrap_or_else(|| {
            PairVerdict::Degraded(Suspicion {
                reason: "unverified-pair".into(),
                evidence: format!("{axis} bit {bit}: too little light to judge the pair"),
                sigma: 0.0,
            })
        })
    }

    fn drift(&mut self, role: Role, first: &Frame, last: &Frame) -> PairVerdict {
        let change = self.noise.and_then(|noise| compare_references(first, last, &self.camera, noise));
        match change {
            Some(change) => match drift_rule(role, &change, &self.limits) {
                PairVerdict::Retake(suspicion)
                    if suspicion.reason == "stale-frame"
                        && (self.history.is_unsettled() || !self.is_another(first, last)) =>
                {
                    // The next picture would carry the same rest.
                    PairVerdict::Degraded(Suspicion { reason: "unsettled-display".into(), ..suspicion })
                }
                verdict => verdict,
            },
            None => PairVerdict::Degraded(Suspicion {
                reason: "unverified-reference".into(),
                evidence: format!("{role}: too little light to compare it with the first"),
                sigma: 0.0,
            }),
        }
    }
}

#[cfg(test)]
mod tests;
