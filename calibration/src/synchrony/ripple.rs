//! Ripple of the lamp: the strongest sine in readings at uneven times (Lomb 1976, as a least-squares fit for each
//! frequency).

use serde::{Deserialize, Serialize};

use crate::fit::linear;

const FEWEST_READINGS: usize = 32;
const LOWEST_HZ: f64 = 5.0;
/// Mains, its harmonics and the pulses of lamp ballasts lie below.
const HIGHEST_HZ: f64 = 1000.0;
/// Steps of frequency per inverse of the duration.
const OVERSAMPLING: f64 = 5.0;
/// Chance at which noise alone may pass for ripple.
const FALSE_ALARM: f64 = 1e-4;

/// Light of one exposure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reading {
    /// Middle of the exposure in s.
    pub time_s: f64,
    /// Mean level, in any unit.
    pub light: f64,
}

/// What the lamp does.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ripple {
    /// Frequency of the strongest sine, where it stands out of the noise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hz: Option<f64>,
    /// Its amplitude as a share of the mean, undone of the exposure's averaging; where none stands out, the amplitude that
    /// would.
    pub share: f64,
    /// Scatter of the readings that is left, as a share of the mean.
    pub rest_share: f64,
}

/// Finds ripple in readings that each lasted `exposure_s`; `None` for too few or dark readings.
pub fn ripple(readings: &[Reading], exposure_s: f64) -> Option<Ripple> {
    let count = readings.len() as f64;
    let mean = readings.iter().map(|reading| reading.light).sum::<f64>() / count;
    let begin = readings.iter().map(|reading| reading.time_s).reduce(f64::min)?;
    let duration = readings.iter().map(|reading| reading.time_s).reduce(f64::max)? - begin;
    if readings.len() < FEWEST_READINGS || mean <= 0.0 || duration <= 0.0 {
        return None;
    }
    // A lamp also drifts.
    let rows: Vec<[f64; 2]> =
        readings.iter().map(|reading| [1.0, (reading.time_s - begin) / duration]).collect();
    let shares: Vec<f64> = readings.iter().map(|reading| reading.light / mean).collect();
    let drift = linear(&rows, &shares, &vec![1.0; shares.len()])?;
    let left: Vec<f64> = rows
        .iter()
        .zip(&shares)
        .map(|(row, share)| share - drift.parameters[0] - drift.parameters[1] * row[1])
        .collect();
    let times: Vec<f64> = readings.iter().map(|reading| reading.time_s - begin).collect();
    let step = 1.0 / (OVERSAMPLING * duration);
    let steps = ((HIGHEST_HZ - LOWEST_HZ) / step) as usize;
    let strength = |hz: f64| sine(&times, &left, hz).map_or(0.0, |[cosine, sine]| cosine.hypot(sine));
    let coarse = (0..steps).map(|number| LOWEST_HZ + step * number as f64);
    let best = coarse.map(|hz| (hz, strength(hz))).max_by(|a, b| a.1.total_cmp(&b.1))?.0;
    let hz = climb(best - step, best + step, strength);
    let found = sine(&times, &left, hz)?;
    let amplitude = found[0].hypot(found[1]);
    let rest: f64 = times
        .iter()
        .zip(&left)
        .map(|(time, left)| {
            let (sin, cos) = (std::f64::consts::TAU * hz * time).sin_cos();
            (left - found[0] * cos - found[1] * sin).powi(2)
        })
        .sum();
    let rest_share = (rest / (count - 5.0)).sqrt();
    // Power of noise is exponentially distributed at each of duration x bandwidth independent frequencies.
    let threshold = (duration * HIGHEST_HZ / FALSE_ALARM).ln();
    let least = rest_share * (4.0 * threshold / count).sqrt();
    let phase = std::f64::consts::PI * hz * exposure_s;
    let passed = if phase.abs() < 1e-9 { 1.0 } else { (phase.sin() / phase).abs().max(0.05) };
    Some(match amplitude > least {
        true => Ripple { hz: Some(hz), share: amplitude / passed, rest_share },
        false => Ripple { hz: None, share: least, rest_share },
    })
}

/// Amplitudes of cosine and sine at a frequency, by least squares.
fn sine(times: &[f64], values: &[f64], hz: f64) -> Option<[f64; 2]> {
    let (mut cc, mut cs, mut ss, mut cv, mut sv) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (time, value) in times.iter().zip(values) {
        let (s, c) = (std::f64::consts::TAU * hz * time).sin_cos();
        cc += c * c;
        cs += c * s;
        ss += s * s;
        cv += c * value;
        sv += s * value;
    }
    let determinant = cc * ss - cs * cs;
    let sound = determinant > 1e-6 * (cc + ss) * (cc + ss);
    sound.then(|| [(ss * cv - cs * sv) / determinant, (cc * sv - cs * cv) / determinant])
}

/// The highest point between two places of a function with one peak there: golden section.
fn climb(mut low: f64, mut high: f64, value: impl Fn(f64) -> f64) -> f64 {
    let golden = 0.5 * (5f64.sqrt() - 1.0);
    for _ in 0..60 {
        let (a, b) = (high - golden * (high - low), low + golden * (high - low));
        if value(a) > value(b) { high = b } else { low = a }
    }
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    const EXPOSURE_S: f64 = 1e-3;

    fn readings(hz: f64, share: f64, noise: f64, seed: u64) -> Vec<Reading> {
        let mut random = StdRng::seed_from_u64(seed);
        let mut time_s = 3.0;
        (0..240)
            .map(|_| {
                time_s += 8.5e-3 + 7e-3 * random.random::<f64>();
                // Mean of the sine over the exposure, in closed form.
                let (from, to) = (time_s - 0.5 * EXPOSURE_S, time_s + 0.5 * EXPOSURE_S);
                let omega = std::f64::consts::TAU * hz;
                let mean = ((omega * from).cos() - (omega * to).cos()) / (omega * EXPOSURE_S);
                let scatter = (0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0;
                Reading { time_s, light: 700.0 * (1.0 + 0.002 * time_s + share * mean + noise * scatter) }
            })
            .collect()
    }

    #[test]
    fn ripple_is_found_far_above_the_rate_of_the_camera() {
        for (hz, share) in [(100.0, 0.02), (120.0, 0.002), (487.0, 0.01), (50.3, 0.05)] {
            let found = ripple(&readings(hz, share, 3e-4, 1), EXPOSURE_S).unwrap();
            assert!((found.hz.unwrap() - hz).abs() < 0.1, "{hz}: {found:?}");
            assert!((found.share / share - 1.0).abs() < 0.06, "{hz}: {found:?}");
        }
    }

    #[test]
    fn noise_is_no_ripple() {
        for seed in 0..20 {
            let found = ripple(&readings(100.0, 0.0, 1e-3, seed), EXPOSURE_S).unwrap();
            assert!(found.hz.is_none() && (1e-4..1e-3).contains(&found.share), "{found:?}");
        }
        assert_eq!(ripple(&readings(100.0, 0.1, 0.0, 1)[..10], EXPOSURE_S), None);
    }
}
