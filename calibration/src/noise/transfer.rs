//! From levels to the figures of a camera.

use serde::Serialize;
use thiserror::Error;

use super::Level;
use crate::fit::{Fit, linear};

/// Variance of a value that is rounded to whole numbers.
const ROUNDING_DN2: f64 = 1.0 / 12.0;
/// Temporal variance without rounding from which on rounded samples have the mean and, but for 1/12, the variance of the
/// unrounded ones: at sigma 0.5 the mean is off by at most 0.32 exp(-2 pi^2 / 4) = 0.002 DN.
const DITHERED_DN2: f64 = 0.25;
/// Levels that a fit needs.
const FEWEST_LEVELS: usize = 4;
/// The brightest level must be this many times as far from black as the darkest.
const LEAST_RANGE: f64 = 4.0;
/// Deviation of the exponent from 1 that no decoder notices.
const HARMLESS_EXPONENT: f64 = 0.01;
/// Rounds of the fit of the exponent.
const ROUNDS: usize = 60;

/// Why the levels give no figures.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum NoiseError {
    /// Too few levels that are neither clipped nor too quiet.
    #[error(
        "only {usable} of {levels} levels can be used ({clipped} are clipped, {quiet} have too little noise for the steps \
         of the format): change the exposure, or use a format with more bits"
    )]
    Levels {
        /// Levels that can be used.
        usable: usize,
        /// Levels that were measured.
        levels: usize,
        /// Levels with clipped samples.
        clipped: usize,
        /// Levels on which rounding hides the noise.
        quiet: usize,
    },
    /// The levels lie too close together.
    #[error(
        "the light of the levels spans {from_dn:.1} to {to_dn:.1} DN only: the camera's picture hardly changes with its \
         exposure time; switch on the projector, and shade the scene"
    )]
    Range {
        /// Darkest usable level.
        from_dn: f64,
        /// Brightest usable level.
        to_dn: f64,
    },
    /// Noise does not grow with light.
    #[error(
        "the noise does not grow with the light (K = {gain:.4} +- {sigma:.4} DN per electron): the camera filters its \
         frames; switch noise reduction, sharpening and compression off"
    )]
    NoGain {
        /// Fitted gain.
        gain: f64,
        /// Its sigma.
        sigma: f64,
    },
}

/// How straight the response is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Linearity {
    /// Exponent of `level - black ~ exposure ^ exponent`.
    pub exponent: f64,
    /// Its sigma.
    pub exponent_sigma: f64,
    /// Largest distance of a level from the straight line, as a share of the brightest level above black.
    pub largest_residual_share: f64,
    /// Levels less the straight line in DN, in order of the levels that were used.
    pub residuals_dn: Vec<f64>,
    /// Whether the exponent is 1, within three sigma or within what no decoder notices.
    pub linear: bool,
}

/// A camera's figures; each with its sigma.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Noise {
    /// System gain K in DN per electron.
    pub gain_dn_per_electron: f64,
    /// Its sigma.
    pub gain_sigma: f64,
    /// Temporal dark noise in DN.
    pub read_noise_dn: f64,
    /// Its sigma in DN; where it is as large as the noise, the format's steps hide the noise.
    pub read_noise_sigma_dn: f64,
    /// Level of no light in DN.
    pub black_level_dn: f64,
    /// Its sigma in DN.
    pub black_level_sigma_dn: f64,
    /// How straight the response is.
    pub linearity: Linearity,
    /// Which of the levels the fits used, by index.
    pub used: Vec<usize>,
    /// Scatter of the variances about their line, in their own sigmas, squared.
    pub variance_reduced_chi2: f64,
}

/// Figures of a camera from its levels.
///
/// # Errors
/// Where the levels say too little, with what to change.
pub fn solve(levels: &[Level]) -> Result<Noise, NoiseError> {
    let clipped = levels.iter().filter(|level| level.clipped_share > 0.0).count();
    let dithered = |level: &Level| level.variance_dn2 - ROUNDING_DN2 >= DITHERED_DN2;
    let quiet = levels.iter().filter(|level| level.clipped_share == 0.0 && !dithered(level)).count();
    let used: Vec<usize> = (0..levels.len())
        .filter(|&index| levels[index].clipped_share == 0.0 && dithered(&levels[index]))
        .collect();
    let chosen: Vec<&Level> = used.iter().map(|&index| &levels[index]).collect();
    if chosen.len() < FEWEST_LEVELS {
        return Err(NoiseError::Levels { usable: chosen.len(), levels: levels.len(), clipped, quiet });
    }
    let line = straight_line(&chosen);
    let ends = |of: fn(&Level) -> f64| {
        chosen
            .iter()
            .map(|level| of(level))
            .fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)))
    };
    let (from_dn, to_dn) = ends(|level| level.mean_dn);
    let black = line.as_ref().map_or(from_dn, |line| line.parameters[0]);
    let Some(line) = line.filter(|_| to_dn - black >= LEAST_RANGE * (from_dn - black) && to_dn > from_dn)
    else {
        return Err(NoiseError::Range { from_dn, to_dn });
    };
    let transfer = transfer_line(&chosen, black).ok_or(NoiseError::Range { from_dn, to_dn })?;
    let (gain, gain_sigma) = (transfer.parameters[1], transfer.sigma(1));
    if gain <= 3.0 * gain_sigma || gain.is_nan() {
        return Err(NoiseError::NoGain { gain, sigma: gain_sigma });
    }
    // The variance at the level of black, with what is not known of black.
    let read_dn2 = transfer.parameters[0] - ROUNDING_DN2;
    let read_sigma_dn2 = (transfer.sigma(0).powi(2) + (gain * line.sigma(0)).powi(2)).sqrt();
    let read_noise_dn = read_dn2.max(0.0).sqrt();
    Ok(Noise {
        gain_dn_per_electron: gain,
        gain_sigma,
        read_noise_dn,
        // d sqrt(v) = dv / (2 sqrt(v)), and no more than sqrt(dv) where v is hidden in dv.
        read_noise_sigma_dn: (0.5 * read_sigma_dn2 / read_noise_dn.max(1e-12)).min(read_sigma_dn2.sqrt()),
        black_level_dn: black,
        black_level_sigma_dn: line.sigma(0),
        linearity: linearity(&chosen, &line),
        used,
        variance_reduced_chi2: transfer.reduced_chi2,
    })
}

/// `level = black + rate * exposure`.
fn straight_line(levels: &[&Level]) -> Option<Fit> {
    let rows: Vec<[f64; 2]> = levels.iter().map(|level| [1.0, level.exposure_us]).collect();
    let means: Vec<f64> = levels.iter().map(|level| level.mean_dn).collect();
    let sigmas: Vec<f64> = levels.iter().map(|level| level.mean_sigma_dn.max(1e-3)).collect();
    linear(&rows, &means, &sigmas)
}

/// `variance = at_black + K * (level - black)`.
fn transfer_line(levels: &[&Level], black_dn: f64) -> Option<Fit> {
    let rows: Vec<[f64; 2]> = levels.iter().map(|level| [1.0, level.mean_dn - black_dn]).collect();
    let variances: Vec<f64> = levels.iter().map(|level| level.variance_dn2).collect();
    let sigmas: Vec<f64> = levels.iter().map(|level| level.variance_sigma_dn2).collect();
    linear(&rows, &variances, &sigmas)
}

/// Fits the exponent: Gauss-Newton on `black + rate * t^exponent`, t as a share of the longest exposure.
fn linearity(levels: &[&Level], line: &Fit) -> Linearity {
    let longest = levels.iter().map(|level| level.exposure_us).fold(0.0, f64::max);
    let times: Vec<f64> = levels.iter().map(|level| level.exposure_us / longest).collect();
    let sigmas: Vec<f64> = levels.iter().map(|level| level.mean_sigma_dn.max(1e-3)).collect();
    let (mut black, mut rate, mut exponent) = (line.parameters[0], line.parameters[1] * longest, 1.0);
    let mut exponent_sigma = f64::INFINITY;
    for _ in 0..ROUNDS {
        let powers: Vec<f64> = times.iter().map(|time| time.powf(exponent)).collect();
        let rows: Vec<[f64; 3]> =
            times.iter().zip(&powers).map(|(time, power)| [1.0, *power, rate * power * time.ln()]).collect();
        let left: Vec<f64> =
            levels.iter().zip(&powers).map(|(level, power)| level.mean_dn - black - rate * power).collect();
        let Some(step) = linear(&rows, &left, &sigmas) else { break };
        black += step.parameters[0];
        rate += step.parameters[1];
        let change = step.parameters[2].clamp(-0.2, 0.2);
        exponent = (exponent + change).clamp(0.1, 10.0);
        exponent_sigma = step.sigma(2);
        if change.abs() < 1e-10 {
            break;
        }
    }
    let straight = |level: &Level| line.parameters[0] + line.parameters[1] * level.exposure_us;
    let residuals_dn: Vec<f64> = levels.iter().map(|level| level.mean_dn - straight(level)).collect();
    let brightest = line.parameters[1] * longest;
    let largest = residuals_dn.iter().map(|residual| residual.abs()).fold(0.0, f64::max);
    Linearity {
        exponent,
        exponent_sigma,
        largest_residual_share: largest / brightest,
        residuals_dn,
        linear: (exponent - 1.0).abs() <= (3.0 * exponent_sigma).max(HARMLESS_EXPONENT),
    }
}

#[cfg(test)]
mod tests {
    use super::{
        super::{Meter, level::testing::Camera},
        *,
    };

    const EXPOSURES_US: [f64; 12] =
        [20.0, 40.0, 80.0, 150.0, 300.0, 500.0, 750.0, 1000.0, 1250.0, 1500.0, 1750.0, 2000.0];

    fn levels(camera: &mut Camera) -> Vec<Level> {
        // Up to four fifths of the full well, with the pattern of a scene.
        let rates: Vec<f64> = (0..8000).map(|pixel| 4.2 * (0.5 + f64::from(pixel % 50) / 100.0)).collect();
        let pixels: Vec<u32> = (0..8000).collect();
        EXPOSURES_US
            .iter()
            .map(|&exposure| {
                let mut meter = Meter::new(exposure, &pixels, camera.black_dn, camera.full_dn as u16);
                (0..6).for_each(|_| meter.add(&camera.frame(&rates, exposure)));
                meter.finish().unwrap()
            })
            .collect()
    }

    #[test]
    fn figures_of_a_camera_are_found_at_every_bit_depth() {
        for bits in [8, 10, 12, 16] {
            for seed in 0..3 {
                let mut camera = Camera::new(bits, 10_500.0, 2.3, seed);
                let (gain, black) = (camera.gain, camera.black_dn);
                let found = solve(&levels(&mut camera)).unwrap();
                let context = format!("{bits} bits, seed {seed}: {found:?}");
                assert!((found.gain_dn_per_electron / gain - 1.0).abs() < 0.02, "{context}");
                let black_error = (found.black_level_dn - black).abs();
                assert!(black_error < 5.0 * found.black_level_sigma_dn.max(0.003), "{context}");
                if bits <= 12 {
                    assert!(black_error < 0.2, "{context}");
                }
                assert!(
                    found.linearity.linear && found.linearity.largest_residual_share < 0.002,
                    "{context}"
                );
                let read_error = (found.read_noise_dn - 2.3 * gain).abs();
                assert!(read_error < 4.0 * found.read_noise_sigma_dn.max(0.002), "{context}");
                if bits >= 12 {
                    assert!(found.read_noise_sigma_dn < 0.08 * 2.3 * gain, "{context}");
                }
            }
        }
    }

    #[test]
    fn a_bent_response_is_told_with_its_exponent() {
        for gamma in [0.8, 0.95, 1.1] {
            let mut camera = Camera::new(12, 10_500.0, 2.3, 5);
            camera.gamma = gamma;
            let found = solve(&levels(&mut camera)).unwrap().linearity;
            assert!(!found.linear, "{gamma}: {found:?}");
            let tolerance = (4.0 * found.exponent_sigma).max(0.004);
            assert!((found.exponent - gamma).abs() < tolerance, "{gamma}: {found:?}");
        }
    }

    #[test]
    fn what_says_too_little_is_refused_by_name() {
        let level = |exposure_us: f64, mean_dn: f64, variance_dn2: f64| Level {
            exposure_us,
            mean_dn,
            mean_sigma_dn: 0.1,
            variance_dn2,
            variance_sigma_dn2: 0.01 * variance_dn2,
            clipped_share: 0.0,
        };
        let even: Vec<Level> = (1..9).map(|n| level(100.0 * f64::from(n), 500.0, 30.0)).collect();
        assert!(matches!(solve(&even), Err(NoiseError::Range { .. })), "{:?}", solve(&even));
        let quiet: Vec<Level> =
            (1..9).map(|n| level(100.0 * f64::from(n), 100.0 * f64::from(n), 0.1)).collect();
        assert!(matches!(solve(&quiet), Err(NoiseError::Levels { usable: 0, quiet: 8, .. })));
        let filtered: Vec<Level> =
            (1..9).map(|n| level(100.0 * f64::from(n), 50.0 + 100.0 * f64::from(n), 3.0)).collect();
        assert!(matches!(solve(&filtered), Err(NoiseError::NoGain { .. })));
        let mut clipped = even;
        clipped.iter_mut().for_each(|level| level.clipped_share = 0.1);
        assert!(matches!(solve(&clipped), Err(NoiseError::Levels { clipped: 8, .. })));
    }
}
