//! What was on the glass when: flips, the projector's latency, liquid crystals and the lamp.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

use super::{
    description::{FlickerDescription, RigDescription},
    panel::Mixture,
    script::{Script, since_ns},
};
use crate::{clock::Timestamp, projector::Slide};

/// Slides with less than this share of an exposure are left out, so that a settled picture is exact.
pub(crate) const NEGLIGIBLE_SHARE: f64 = 1e-9;

/// One change of the picture.
#[derive(Debug, Clone)]
struct Change {
    /// First light, in ns.
    at_ns: u64,
    slide: Arc<Slide>,
}

/// The pictures of a projector over time.
#[derive(Debug, Clone)]
pub(crate) struct Timeline {
    /// Time between refreshes: whole nanoseconds, so that a timeline can be shifted by refreshes without any change.
    period_ns: u64,
    latency_ns: u64,
    /// Time constant of the liquid crystals in s.
    lcd_s: f64,
    flicker: Option<FlickerDescription>,
    script: Script,
    /// When the camera was armed: from then on the script counts.
    armed: Timestamp,
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
        let script = Script::new(&description.faults);
        let latency_refreshes = projector.latency_refreshes + script.extra_latency_refreshes();
        Self {
            period_ns,
            latency_ns: u64::from(latency_refreshes) * period_ns,
            lcd_s: lcd_s(script.lcd_10_90_ms(projector.lcd_10_90_ms)),
            flicker: description.flicker.clone(),
            script,
            armed: Timestamp(0),
            changes: VecDeque::new(),
            black: Arc::new(Slide::Uniform([0; 3])),
            awaited: BTreeMap::new(),
        }
    }

    /// Time between refreshes in ns.
    pub(crate) fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// The script counts from `now` on.
    pub(crate) fn arm(&mut self, now: Timestamp) {
        self.armed = now;
    }

    /// Time after arming, negative before, in ns.
    pub(crate) fn since_armed_ns(&self, time: Timestamp) -> f64 {
        since_ns(time, self.armed)
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
        let memory_ns = (1e9 * self.lcd_s * 1e15f64.ln()) as u64;
        let horizon = earliest.saturating_sub(memory_ns);
        while self.changes.get(1).is_some_and(|next| next.at_ns <= horizon) {
            self.changes.pop_front();
        }
    }

    /// Light of an exposure: slides and their weights, in seconds of the mean lamp. Exact for the past of the clock.
    pub(crate) fn mixture(&self, start: Timestamp, end: Timestamp) -> Mixture {
        let mut weights = Mixture::new();
        let mut from = start;
        for until in self.lamp_jumps(start, end).into_iter().chain([end]) {
            // Between jumps the script's lamp changes slowly and evenly, so that its middle stands for all.
            let middle = 0.5 * (self.since_armed_ns(from) + self.since_armed_ns(until));
            let lamp = self.script.lamp(middle);
            for (slide, weight) in self.steady_mixture(from, until) {
                add(&mut weights, &slide, lamp * weight);
            }
            from = until;
        }
        without_negligible(weights)
    }

    /// Jumps of the lamp within an exposure, in order.
    fn lamp_jumps(&self, start: Timestamp, end: Timestamp) -> Vec<Timestamp> {
        let jumps =
            self.script.lamp_jumps_ns().into_iter().map(|ns| Timestamp(self.armed.0.saturating_add(ns)));
        let mut within: Vec<Timestamp> = jumps.filter(|jump| (start..end).contains(jump)).collect();
        within.sort_unstable();
        within
    }

    /// The same for a lamp that does nothing but flicker.
    fn steady_mixture(&self, start: Timestamp, end: Timestamp) -> Mixture {
        let mut weights = Mixture::new();
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
        weights
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

/// Time constant of liquid crystals: from 10 % to 90 % an exponential takes ln 9 of them.
fn lcd_s(lcd_10_90_ms: f64) -> f64 {
    1e-3 * lcd_10_90_ms / 9f64.ln()
}

/// From first light until less than `share` of the previous picture is left, in s.
pub(crate) fn settling_s(lcd_10_90_ms: f64, share: f64) -> f64 {
    lcd_s(lcd_10_90_ms) * (1.0 / share).ln()
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::testing::small_rig;
    use proptest::prelude::*;

    fn timeline(lcd_ms: f64, flicker: Option<FlickerDescription>) -> Timeline {
        let mut description = small_rig();
        description.projector.lcd_10_90_ms = lcd_ms;
        description.projector.latency_refreshes = 2;
        description.flicker = flicker;
        Timeline::new(&description)
    }

    fn slide(number: u8) -> Arc<Slide> {
        Arc::new(Slide::Uniform([number, 0, 0]))
    }

    fn weight(mixture: &Mixture, number: u8) -> f64 {
        let of = Slide::Uniform([number, 0, 0]);
        mixture.iter().filter(|(slide, _)| **slide == of).map(|(_, weight)| weight).sum()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        /// Against the differential equation, solved in small steps.
        #[test]
        fn weights_agree_with_integration(
            gaps in proptest::collection::vec(0u64..40_000_000, 1..5),
            offset in 0u64..80_000_000, length in 100_000u64..30_000_000,
            lcd_ms in 0.5f64..20.0, share in 0.0f64..0.5, hz in 20.0f64..200.0,
        ) {
            let mut timeline = timeline(lcd_ms, Some(FlickerDescription { share, hz }));
            let (start, end) = (30_000_000 + offset, 30_000_000 + offset + length);
            timeline.expect(0, Timestamp(start));
            let mut now = 1_000_000;
            let mut changes = vec![];
            for (number, gap) in gaps.iter().enumerate() {
                let (_, flipped) = timeline.flip(Timestamp(now), Some(slide(number as u8 + 1)));
                changes.push((flipped.0 + timeline.latency_ns, number as u8 + 1));
                now = flipped.0 + gap;
            }
            let ours = timeline.mixture(Timestamp(start), Timestamp(end));

            let step_ns = 1_000u64;
            let mut state = vec![0.0; gaps.len() + 1];
            state[0] = 1.0;
            let mut sums = vec![0.0; gaps.len() + 1];
            let tau = lcd_ms * 1e-3 / 9f64.ln();
            let fade = (-1e-9 * step_ns as f64 / tau).exp();
            let mut time = 0;
            while time < end {
                let middle = time + step_ns / 2;
                let current = changes.iter().rev().find(|(at, _)| *at <= middle).map_or(0, |(_, n)| *n) as usize;
                let old = state.clone();
                for (number, value) in state.iter_mut().enumerate() {
                    let target = f64::from(u8::from(number == current));
                    *value = target + (*value - target) * fade;
                }
                if middle >= start {
                    let lamp = 1.0 + share * (std::f64::consts::TAU * hz * 1e-9 * middle as f64).sin();
                    for (sum, (a, b)) in sums.iter_mut().zip(old.iter().zip(&state)) {
                        *sum += 1e-9 * step_ns as f64 * lamp * 0.5 * (a + b);
                    }
                }
                time += step_ns;
            }
            let seconds = 1e-9 * length as f64;
            for (number, sum) in sums.iter().enumerate() {
                // The steps are coarse at the ends and where the picture changes.
                prop_assert!((weight(&ours, number as u8) - sum).abs() < 2e-3 * seconds + 3e-6, "{number}: {ours:?} {sums:?}");
            }
        }
    }

    #[test]
    fn the_residue_is_the_textbook_one() {
        let mut timeline = timeline(6.0, None);
        let (_, first) = timeline.flip(Timestamp(0), Some(slide(1)));
        let (_, second) = timeline.flip(Timestamp(first.0 + 300_000_000), Some(slide(2)));
        let light = second.0 + timeline.latency_ns;
        let (delay, exposure) = (10e-3, 2e-3);
        let start = Timestamp(light + (delay * 1e9) as u64);
        let mixture = timeline.mixture(start, Timestamp(start.0 + 2_000_000));
        let tau = 6e-3 / 9f64.ln();
        let expected = tau * ((-delay / tau).exp() - (-(delay + exposure) / tau).exp());
        assert!((weight(&mixture, 1) - expected).abs() < 1e-12);
        assert!((weight(&mixture, 2) - (exposure - expected)).abs() < 1e-12);
        // 10 % to 90 %: the time between the two shares is the one of the description.
        let time_of = |share: f64| -tau * (1.0 - share).ln();
        assert!((time_of(0.9) - time_of(0.1) - 6e-3).abs() < 1e-12);
    }

    #[test]
    fn a_settled_picture_is_exact_and_so_is_one_that_is_shown_again() {
        let mut timeline = timeline(6.0, None);
        timeline.flip(Timestamp(0), Some(slide(1)));
        let (_, flipped) = timeline.flip(Timestamp(100_000_000), Some(slide(2)));
        let start = Timestamp(flipped.0 + 200_000_000);
        let mixture = timeline.mixture(start, Timestamp(start.0 + 2_000_000));
        assert_eq!(mixture.len(), 1);
        assert!((mixture[0].1 - 2e-3).abs() < 1e-15);
        let (_, flipped) = timeline.flip(Timestamp(start.0), Some(slide(2)));
        let start = Timestamp(flipped.0 + timeline.latency_ns);
        assert_eq!(timeline.mixture(start, Timestamp(start.0 + 2_000_000)).len(), 1);
    }

    #[test]
    fn flips_come_at_refreshes_and_light_after_the_latency() {
        let mut timeline = timeline(0.0, None);
        let period = timeline.period_ns();
        assert_eq!(period, 16_666_667);
        assert_eq!(timeline.flip(Timestamp(0), Some(slide(1))), (1, Timestamp(period)));
        assert_eq!(timeline.flip(Timestamp(period), Some(slide(2))), (2, Timestamp(2 * period)));
        assert_eq!(timeline.flip(Timestamp(2 * period + 1), None).0, 3);
        let light = |at: u64| timeline.mixture(Timestamp(at), Timestamp(at + 1000))[0].0.clone();
        assert_eq!(*light(3 * period - 1000), Slide::Uniform([0; 3]));
        assert_eq!(*light(3 * period), *slide(1));
        assert_eq!(*light(4 * period), *slide(2));
        assert_eq!(*light(5 * period), Slide::Uniform([0; 3]));
    }

    #[test]
    fn the_past_is_forgotten_but_not_what_is_awaited() {
        let mut timeline = timeline(6.0, None);
        let mut now = 0;
        for number in 0..200 {
            now = timeline.flip(Timestamp(now), Some(slide(number))).1.0;
        }
        assert!(timeline.changes.len() < 20, "{}", timeline.changes.len());
        timeline.expect(7, Timestamp(now));
        let before = timeline.mixture(Timestamp(now), Timestamp(now + 2_000_000));
        let mut later = now;
        for number in 0..200 {
            later = timeline.flip(Timestamp(later), Some(slide(number))).1.0;
        }
        assert_eq!(timeline.mixture(Timestamp(now), Timestamp(now + 2_000_000)), before);
        timeline.dismiss(7);
        timeline.flip(Timestamp(later), None);
        assert!(timeline.changes.len() < 20);
    }
}
