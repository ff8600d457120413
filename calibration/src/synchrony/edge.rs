//! One change of light, sampled by exposures.

use serde::{Deserialize, Serialize};

use super::{SETTLED, SyncError};
use crate::fit::linear;

/// Share of the sweep, at its end, on which the new light is taken as settled.
const PLATEAU_SHARE: f64 = 0.2;
const FEWEST_SAMPLES: usize = 30;
/// Light counts as light above this share of the change, and above this many sigma.
const LIGHT_SHARE: f64 = 5e-3;
const LIGHT_SIGMA: f64 = 5.0;
/// The tail that is extrapolated begins where this much is left.
const TAIL_SHARE: f64 = 0.3;
/// Time constants that are tried for it, in ms.
const SHORTEST_TAIL_MS: f64 = 0.05;
const LONGEST_TAIL_MS: f64 = 200.0;
const TAIL_STEPS: usize = 400;
/// Reduced chi-square above which a tail is not exponential.
const WORST_TAIL_CHI2: f64 = 9.0;

/// Mean light of one exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sample {
    /// Start of the exposure after the flip, in ms.
    pub start_ms: f64,
    /// Mean level, in any unit.
    pub light: f64,
    /// Its sigma.
    pub sigma: f64,
}

/// How a change went.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Edge {
    /// First sign of the change.
    pub first_light_ms: f64,
    /// From 10 % to 90 % of it.
    pub t10_90_ms: f64,
    /// A thousandth is left of it.
    pub settled_ms: f64,
    /// Sigma of that.
    pub settled_sigma_ms: f64,
}

/// Samples as progress of the change, from 0 to 1, at the middle of each exposure.
struct Progress {
    time_ms: Vec<f64>,
    done: Vec<f64>,
    sigma: Vec<f64>,
    exposure_ms: f64,
}

/// Light at the end of a sweep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plateau {
    /// Its mean.
    pub light: f64,
    /// What it varies by beyond the noise of the samples: the lamp.
    pub lamp: f64,
}

/// Light at the end of a sweep; dark for no samples.
pub fn plateau(samples: &[Sample]) -> Plateau {
    let last = samples.iter().map(|sample| sample.start_ms).fold(0.0, f64::max);
    let late = || samples.iter().filter(|sample| sample.start_ms >= (1.0 - PLATEAU_SHARE) * last);
    let count = late().count().max(1) as f64;
    let light = late().map(|sample| sample.light).sum::<f64>() / count;
    let scatter =
        late().map(|sample| (sample.light - light).powi(2) - sample.sigma.powi(2)).sum::<f64>() / count;
    Plateau { light, lamp: scatter.max(0.0).sqrt() }
}

/// Timing of a change from its samples; `from` is what was before it, `exposure_ms` how long each sample lasted.
///
/// # Errors
/// Where the samples do not show a whole change.
pub fn edge(samples: &[Sample], from: Plateau, exposure_ms: f64) -> Result<Edge, SyncError> {
    if samples.len() < FEWEST_SAMPLES {
        return Err(SyncError::Samples(samples.len(), FEWEST_SAMPLES));
    }
    let progress = Progress::new(samples, from, exposure_ms)?;
    let (settled_ms, settled_sigma_ms, begun_ms) = progress.settled()?;
    let first_light_ms = progress.first_light(begun_ms)?;
    Ok(Edge {
        first_light_ms,
        t10_90_ms: progress.crossing(0.9) - progress.crossing(0.1),
        settled_ms: settled_ms.max(first_light_ms),
        settled_sigma_ms,
    })
}

impl Progress {
    fn new(samples: &[Sample], from: Plateau, exposure_ms: f64) -> Result<Self, SyncError> {
        let mut sorted = samples.to_vec();
        sorted.sort_unstable_by(|a, b| a.start_ms.total_cmp(&b.start_ms));
        let count = sorted.len() as f64;
        let to = plateau(&sorted);
        let sigma = sorted.iter().map(|sample| sample.sigma).sum::<f64>() / count;
        // What the lamp does belongs to the noise as well.
        let lamp = to.lamp.max(from.lamp);
        let change = to.light - from.light;
        let progress = Self {
            time_ms: sorted.iter().map(|sample| sample.start_ms + 0.5 * exposure_ms).collect(),
            done: sorted.iter().map(|sample| (sample.light - from.light) / change).collect(),
            sigma: sorted.iter().map(|sample| sample.sigma.hypot(lamp) / change.abs()).collect(),
            exposure_ms,
        };
        // Not `<`: a NaN is no light either.
        if !matches!((change.abs() / (10.0 * sigma)).partial_cmp(&1.0), Some(std::cmp::Ordering::Greater)) {
            return Err(SyncError::NoLight { change, sigma });
        }
        Ok(progress)
    }

    /// Index of the first of two samples in a row with light.
    fn first_lit(&self) -> Option<usize> {
        let lit = |at: usize| self.done[at] > LIGHT_SHARE.max(LIGHT_SIGMA * self.sigma[at]);
        (0..self.done.len() - 1).find(|&at| lit(at) && lit(at + 1))
    }

    /// Light comes between the ends of the last dark exposure and of the first lit one. Where in between, an exponential
    /// says, or else the two samples after them.
    fn first_light(&self, begun_ms: Option<f64>) -> Result<f64, SyncError> {
        let end = |at: usize| self.time_ms[at] + 0.5 * self.exposure_ms;
        let lit = self.first_lit().filter(|&at| at + 2 < self.done.len());
        let Some(lit) = lit else { return Err(SyncError::Unsettled(end(self.done.len() - 1))) };
        // No light comes before the flip.
        let dark = if lit > 0 { end(lit - 1) } else { 0.0 };
        let (a, b) = (lit + 1, lit + 2);
        let slope = (self.done[b] - self.done[a]) / (self.time_ms[b] - self.time_ms[a]);
        let back = if slope > 0.0 { self.time_ms[a] - self.done[a] / slope } else { dark };
        Ok(begun_ms.unwrap_or(back).clamp(dark, end(lit).max(dark)))
    }

    /// When `share` of the change is done.
    fn crossing(&self, share: f64) -> f64 {
        let at = (1..self.done.len()).find(|&at| self.done[at] >= share).unwrap_or(self.done.len() - 1);
        let (low, high) = (self.done[at - 1], self.done[at]);
        let part = if high > low { ((share - low) / (high - low)).clamp(0.0, 1.0) } else { 1.0 };
        self.time_ms[at - 1] + part * (self.time_ms[at] - self.time_ms[at - 1])
    }

    /// When [`SETTLED`] is left: an exponential tail extrapolates below the noise of single samples; where the samples
    /// contradict it they are believed. Returns its sigma too, and where the exponential begins, if it is one.
    fn settled(&self) -> Result<(f64, f64, Option<f64>), SyncError> {
        let last = self.done.len() - 1;
        let begin = (0..=last).rev().find(|&at| 1.0 - self.done[at] > TAIL_SHARE).map_or(0, |at| at + 1);
        let tail = begin..last + 1;
        if tail.len() < FEWEST_SAMPLES / 3 {
            return Err(SyncError::Unsettled(self.time_ms[last]));
        }
        let fitted = self.fit_tail(tail.clone());
        let rest = fitted.map_or(0.0, |tail| tail.rest);
        let unsettled = |at: &usize| (1.0 - self.done[*at] - rest).abs() > SETTLED + 4.0 * self.sigma[*at];
        let seen = tail.rev().find(unsettled);
        if seen == Some(last) {
            return Err(SyncError::Unsettled(self.time_ms[last]));
        }
        let step = (self.time_ms[last] - self.time_ms[0]) / last as f64;
        // An exposure that is still off the end may have been so in its first part only.
        let seen_ms = match seen {
            Some(at) => self.time_ms[at] + 0.5 * self.exposure_ms,
            None => self.time_ms[begin] - 0.5 * self.exposure_ms,
        };
        // A curve that contradicts the tail by more than a step is no exponential.
        Ok(match fitted.filter(|tail| seen_ms <= tail.settled_ms + 2.0 * step) {
            Some(tail) => (tail.settled_ms, tail.sigma_ms, Some(tail.begun_ms)),
            None => (seen_ms, step, None),
        })
    }

    /// What is left, as `amplitude exp(-(t - t0) / tau) + rest`; `None` where the change is over within a few samples.
    fn fit_tail(&self, tail: std::ops::Range<usize>) -> Option<Tail> {
        let visible =
            tail.clone().filter(|&at| 1.0 - self.done[at] > 2.0 * SETTLED.max(2.0 * self.sigma[at])).count();
        if visible < 3 {
            return None;
        }
        let begin_ms = self.time_ms[tail.start];
        let left: Vec<f64> = tail.clone().map(|at| 1.0 - self.done[at]).collect();
        let sigmas: Vec<f64> = tail.clone().map(|at| self.sigma[at].max(1e-9)).collect();
        let attempt = |tau: f64| {
            let decay = |at: usize| (-(self.time_ms[at] - begin_ms) / tau).exp();
            let rows: Vec<[f64; 2]> = tail.clone().map(|at| [decay(at), 1.0]).collect();
            linear(&rows, &left, &sigmas)
        };
        let ratio = (LONGEST_TAIL_MS / SHORTEST_TAIL_MS).powf(1.0 / TAIL_STEPS as f64);
        let taus = (0..=TAIL_STEPS).map(|step| SHORTEST_TAIL_MS * ratio.powi(step as i32));
        let fits = taus.filter_map(|tau| Some((tau, attempt(tau)?)));
        let (tau, fit) = fits
            .filter(|(_, fit)| fit.parameters[0] > SETTLED)
            .min_by(|a, b| a.1.reduced_chi2.total_cmp(&b.1.reduced_chi2))?;
        // Off the best time constant by so much that the sum of squares grows by one.
        let degrees = (left.len() - 3).max(1) as f64;
        let limit = fit.reduced_chi2 + fit.reduced_chi2.max(1.0) / degrees;
        let mut wide = tau;
        while wide < LONGEST_TAIL_MS && attempt(wide).is_some_and(|fit| fit.reduced_chi2 < limit) {
            wide *= ratio.sqrt();
        }
        let settled_after = |tau: f64, amplitude: f64| tau * (amplitude / SETTLED).ln();
        let settled_ms = begin_ms + settled_after(tau, fit.parameters[0]);
        let wide_ms = attempt(wide).map_or(0.0, |fit| settled_after(wide, fit.parameters[0].max(SETTLED)));
        let sigma_ms = (wide_ms - settled_after(tau, fit.parameters[0])).abs();
        // A curve of another shape has no such tail.
        if fit.reduced_chi2 > WORST_TAIL_CHI2 {
            return None;
        }
        let begun_ms = begin_ms + tau * fit.parameters[0].ln();
        Some(Tail { settled_ms, sigma_ms, begun_ms, rest: fit.parameters[1] })
    }
}

/// The end of a change.
#[derive(Debug, Clone, Copy)]
struct Tail {
    settled_ms: f64,
    sigma_ms: f64,
    /// Where the whole change would be left.
    begun_ms: f64,
    /// What was taken as settled is this share off.
    rest: f64,
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    const EXPOSURE_MS: f64 = 1.0;

    fn dark(light: f64) -> Plateau {
        Plateau { light, lamp: 0.0 }
    }

    /// Mean over exposures of a change that begins at `first` and goes as `done(ms since then)`; integrated in small
    /// steps.
    fn sweep(first: f64, sigma: f64, seed: u64, done: impl Fn(f64) -> f64) -> Vec<Sample> {
        let mut random = StdRng::seed_from_u64(seed);
        (0..167)
            .map(|step| {
                let start_ms = f64::from(step);
                let parts = 200;
                let sum: f64 = (0..parts)
                    .map(|part| {
                        let at = start_ms + EXPOSURE_MS * (f64::from(part) + 0.5) / f64::from(parts) - first;
                        if at > 0.0 { done(at) } else { 0.0 }
                    })
                    .sum();
                let noise = (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
                Sample {
                    start_ms,
                    light: 50.0 + 900.0 * (sum / f64::from(parts) + sigma * noise),
                    sigma: 900.0 * sigma,
                }
            })
            .collect()
    }

    #[test]
    fn exponential_changes_are_found() {
        for (number, (t10_90, first)) in
            [(6.0, 33.333), (2.0, 16.667), (12.0, 50.0), (20.0, 33.333), (6.0, 20.4), (6.0, 0.0)]
                .into_iter()
                .enumerate()
        {
            let tau = t10_90 / 9f64.ln();
            let samples = sweep(first, 1e-4, number as u64, |ms| 1.0 - (-ms / tau).exp());
            let found = edge(&samples, dark(50.0), EXPOSURE_MS).unwrap();
            let settled = first + tau * 1000f64.ln();
            let context = format!("{t10_90} ms from {first} ms: {found:?}, settled {settled}");
            assert!((found.first_light_ms - first).abs() <= 1.0, "{context}");
            assert!((found.t10_90_ms - t10_90).abs() < 0.5, "{context}");
            assert!((found.settled_ms - settled).abs() < 1.0, "{context}");
            assert!(found.settled_sigma_ms < 1.0, "{context}");
        }
    }

    #[test]
    fn falls_are_rises_upside_down() {
        let samples = sweep(33.0, 1e-4, 3, |ms| 1.0 - (-ms / 2.7).exp());
        let upside_down: Vec<Sample> =
            samples.iter().map(|sample| Sample { light: 1000.0 - sample.light, ..*sample }).collect();
        let (a, b) = (
            edge(&samples, dark(50.0), EXPOSURE_MS).unwrap(),
            edge(&upside_down, dark(950.0), EXPOSURE_MS).unwrap(),
        );
        assert!((a.settled_ms - b.settled_ms).abs() < 1e-6 && (a.t10_90_ms - b.t10_90_ms).abs() < 1e-6);
    }

    #[test]
    fn a_change_that_is_no_exponential_is_believed_as_seen() {
        // Two thirds at once; the rest creeps linearly for 40 ms.
        let samples = sweep(20.0, 5e-5, 1, |ms| (0.7 + 0.3 * ms / 40.0).min(1.0));
        let found = edge(&samples, dark(50.0), EXPOSURE_MS).unwrap();
        assert!((59.0..62.0).contains(&found.settled_ms), "{found:?}");
        // And a display without any lag.
        let found = edge(&sweep(20.0, 5e-5, 1, |_| 1.0), dark(50.0), EXPOSURE_MS).unwrap();
        assert!((found.settled_ms - 20.0).abs() <= 1.0 && found.t10_90_ms <= 1.01, "{found:?}");
    }

    #[test]
    fn what_is_no_change_is_refused() {
        let flat = sweep(20.0, 1e-3, 1, |_| 0.0);
        assert!(matches!(edge(&flat, dark(50.0), EXPOSURE_MS), Err(SyncError::NoLight { .. })));
        let slow = sweep(20.0, 1e-4, 1, |ms| 1.0 - (-ms / 90.0).exp());
        assert!(matches!(edge(&slow, dark(50.0), EXPOSURE_MS), Err(SyncError::Unsettled(_))));
        assert!(matches!(edge(&flat[..5], dark(50.0), EXPOSURE_MS), Err(SyncError::Samples(5, _))));
    }
}
