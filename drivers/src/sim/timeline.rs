//! What was on the glass when: flips, the projector's latency, liquid crystals and the lamp.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

use super::{
    description::{FlickerDescription, RigDescription},
    panel::Mixture,
};
use crate::{clock::Timestamp, projector::Slide};

/// Slides with less than this share of an exposure are left out, so that a settled picture is exact.
const NEGLIGIBLE_SHARE: f64 = 1e-9;

/// One change of the picture.
#[derive(Debug, Clone)]
struct Change {
    /// First light, in ns.
    at_ns: u64,
    slide: Arc<Slide>,
}

/// The pictures of a projector over time.
#[derive(Debug)]
pub(crate) struct Timeline {
    /// Time between refreshes: whole nanoseconds, so that a timeline can be shifted by refreshes without any change.
    period_ns: u64,
    latency_ns: u64,
    /// Time constant of the liquid crystals in s.
    lcd_s: f64,
    flicker: Option<FlickerDescription>,
    /// Before the first of them the glass is black.
    changes: VecDeque<Change>,
    black: Arc<Slide>,
    /// Starts of exposures that have not been looked up yet, by number.
    awaited: BTreeMap<u64, u64>,
}

impl Timeline {
    pub(crate) fn new(description: &RigDescription) -> Self {
        let projector = &description.projector;
        let period_ns = (1e9 / projector.refresh_hz).round() as u64;
        Self {
            period_ns,
            latency_ns: u64::from(projector.latency_refreshes) * period_ns,
            // From 10 % to 90 % an exponential takes ln 9 time constants.
            lcd_s: 1e-3 * projector.lcd_10_90_ms / 9f64.ln(),
            flicker: description.flicker.clone(),
            changes: VecDeque::new(),
            black: Arc::new(Slide::Uniform([0; 3])),
            awaited: BTreeMap::new(),
        }
    }

    /// Time between refreshes in ns.
    pub(crate) fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// From flip to first light in ns.
    pub(crate) fn latency_ns(&self) -> u64 {
        self.latency_ns
    }

    /// From first light until less than `share` of the previous picture is left, in s.
    pub(crate) fn settling_s(&self, share: f64) -> f64 {
        self.lcd_s * (1.0 / share).ln()
    }

    /// Flips to `slide` (black for `None`) at the first refresh after `now`; its number and time.
    pub(crate) fn flip(&mut self, now: Timestamp, slide: Option<Arc<Slide>>) -> (u64, Timestamp) {
        let refresh = now.0 / self.period_ns + 1;
        let flipped = refresh * self.period_ns;
        let slide = slide.unwrap_or_else(|| self.black.clone());
        self.changes.push_back(Change { at_ns: flipped + self.latency_ns, slide });
        self.forget(now.0);
        (refresh, Timestamp(flipped))
    }

    /// Announces an exposure, so that what it will need is kept.
    pub(crate) fn expect(&mut self, exposure: u64, start: Timestamp) {
        self.awaited.insert(exposure, start.0);
    }

    /// Takes an announcement back.
    pub(crate) fn dismiss(&mut self, exposure: u64) {
        self.awaited.remove(&exposure);
    }

    /// Drops changes that no exposure from now on, nor an announced one, can see.
    fn forget(&mut self, now_ns: u64) {
        let earliest = self.awaited.values().copied().min().unwrap_or(now_ns).min(now_ns);
        // Far beyond the negligible share even if many pictures add up.
        let memory_ns = (1e9 * self.settling_s(1e-15)) as u64;
        let horizon = earliest.saturating_sub(memory_ns);
        while self.changes.get(1).is_some_and(|next| next.at_ns <= horizon) {
            self.changes.pop_front();
        }
    }

    /// Light of an exposure: slides and their weights, in seconds of the mean lamp. Exact for the past of the clock.
    pub(crate) fn mixture(&self, start: Timestamp, end: Timestamp) -> Mixture {
        let mut weights: Vec<(Arc<Slide>, f64)> = Vec::new();
        // Shares of the pictures at the latest change, whatever came before it taken as settled.
        let mut shares: Vec<(Arc<Slide>, f64)> = vec![(self.black.clone(), 1.0)];
        let mut from_ns = 0;
        for next in 0..=self.changes.len() {
            let until_ns = self.changes.get(next).map_or(end.0, |change| change.at_ns.min(end.0));
            let since = from_ns.max(start.0);
            let (newest, older) = shares.split_last().expect("there is always a newest picture");
            if until_ns > since {
                let (lamp, decaying) = self.integrals(from_ns, since, until_ns);
                let mut left = 0.0;
                for (slide, share) in older {
                    add(&mut weights, slide, share * decaying);
                    left += share * decaying;
                }
                add(&mut weights, &newest.0, lamp - left);
            }
            let Some(change) = self.changes.get(next).filter(|change| change.at_ns < end.0) else { break };
            let decay = self.decay(change.at_ns - from_ns);
            let mut total = 0.0;
            let (last, older) = shares.split_last_mut().expect("there is always a newest picture");
            for (_, share) in older {
                *share *= decay;
                total += *share;
            }
            last.1 = 1.0 - total;
            shares.retain(|(_, share)| *share > 1e-15);
            shares.push((change.slide.clone(), 0.0));
            from_ns = change.at_ns;
        }
        without_negligible(weights)
    }

    /// Share of an old picture left `ns` after a change.
    fn decay(&self, ns: u64) -> f64 {
        if self.lcd_s > 0.0 { (-1e-9 * ns as f64 / self.lcd_s).exp() } else { 0.0 }
    }

    /// Integrals over [since, until] of the lamp, and of the lamp times the decay since `from`, in s.
    fn integrals(&self, from_ns: u64, since_ns: u64, until_ns: u64) -> (f64, f64) {
        let duration = 1e-9 * (until_ns - since_ns) as f64;
        let (near, far) = (1e-9 * (since_ns - from_ns) as f64, 1e-9 * (until_ns - from_ns) as f64);
        let tau = self.lcd_s;
        let decay = |t: f64| if tau > 0.0 { (-t / tau).exp() } else { 0.0 };
        let mut lamp = duration;
        let mut decaying = tau * (decay(near) - decay(far));
        if let Some(FlickerDescription { share, hz }) = self.flicker {
            let omega = std::f64::consts::TAU * hz;
            // Phase in turns at the two ends, reduced before the sine so that a long uptime costs no precision.
            let turns = |ns: u64| (hz * 1e-9 * ns as f64).fract() * std::f64::consts::TAU;
            let (a, b) = (turns(since_ns), turns(until_ns));
            lamp += share * (a.cos() - b.cos()) / omega;
            if tau > 0.0 {
                // Integral of exp(-t / tau) sin(omega t): exp(-t / tau) (-sin / tau - omega cos) / (1 / tau^2 + omega^2).
                let rate = 1.0 / tau;
                let primitive = |t: f64, phase: f64| decay(t) * (-rate * phase.sin() - omega * phase.cos());
                decaying += share * (primitive(far, b) - primitive(near, a)) / (rate * rate + omega * omega);
            }
        }
        (lamp, decaying)
    }
}

/// Adds to the weight of an equal slide.
fn add(weights: &mut Mixture, slide: &Arc<Slide>, weight: f64) {
    match weights.iter_mut().find(|(other, _)| Arc::ptr_eq(other, slide) || other == slide) {
        Some((_, sum)) => *sum += weight,
        None => weights.push((slide.clone(), weight)),
    }
}

/// Gives negligible weights to the largest.
fn without_negligible(mut weights: Mixture) -> Mixture {
    let total: f64 = weights.iter().map(|(_, weight)| weight).sum();
    let mut dropped = 0.0;
    weights.retain(|(_, weight)| {
        let keep = *weight > NEGLIGIBLE_SHARE * total;
        dropped += if keep { 0.0 } else { *weight };
        keep
    });
    if let Some((_, largest)) = weights.iter_mut().max_by(|a, b| a.1.total_cmp(&b.1)) {
        *largest += dropped;
    }
    weights
}
