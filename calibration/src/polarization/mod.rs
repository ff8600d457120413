//! Extinction, azimuth of the analyser, channels, drive levels and misregistration.
//!
//! The camera looks at metal, which keeps polarization, with its polarizer at several angles. What each channel sends
//! through it goes as `A + R cos 2 (angle - axis)` (Malus), so that three angles give the extinction `(A + R) / (A - R)` and
//! the axis of each channel without any assumption on which channel carries what.

mod edges;
mod field;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::fit::linear;

pub use edges::{EdgeShift, edge_shift};
pub use field::{Field, misregistration};

/// Angles that the fit needs, apart by [`LEAST_APART_DEG`] at least.
const FEWEST_TURNS: usize = 3;
const LEAST_APART_DEG: f64 = 10.0;
/// Below this extinction a channel counts as unpolarized.
const UNPOLARIZED: f64 = 1.5;
/// Axes of one state may lie apart by this much.
const AXIS_TOLERANCE_DEG: f64 = 15.0;

/// What the camera gets from metal with its polarizer at one angle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Turn {
    /// Reading of the polarizer's mount, counter-clockwise as the camera sees it; 0 is where H should pass.
    pub angle_deg: f64,
    /// Light of the red, green and blue picture, each less the black one, in DN.
    pub light: [f64; 3],
    /// Its sigma.
    pub sigma: [f64; 3],
}

/// State of polarization that a channel carries.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// Along the camera's rows.
    Horizontal,
    /// Along its columns.
    Vertical,
    /// Neither: the channel cannot carry a code.
    None,
}

/// One channel of the projector.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Channel {
    /// What it carries.
    pub state: State,
    /// Most over least light as the polarizer is turned.
    pub extinction: f64,
    /// Its sigma.
    pub extinction_sigma: f64,
    /// Reading of the mount at which most light passes, in (-90, 90].
    pub axis_deg: f64,
    /// Its sigma.
    pub axis_sigma_deg: f64,
}

/// All channels, and where the polarizer stands.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Found {
    /// Red, green, blue.
    pub channels: [Channel; 3],
    /// How far the polarizer's axis stands from H where its mount reads 0, counter-clockwise as the camera sees it.
    pub azimuth_error_deg: f64,
    /// Its sigma.
    pub azimuth_sigma_deg: f64,
}

/// Why the turns tell nothing.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PolarizationError {
    /// Too few angles.
    #[error(
        "{0} angles of the polarizer are too few: measure at three or more that lie 10 degrees or more apart, such as 0, 45 \
         and 90"
    )]
    Turns(usize),
    /// A channel is dark at all angles.
    #[error(
        "the camera sees nothing of the {0} channel at any angle: check the projector's picture and lengthen the exposure"
    )]
    Dark(&'static str),
    /// No channel is polarized.
    #[error(
        "no channel changes as the polarizer is turned: the region scatters (it must be bare metal), the projector's light is \
         not polarized, or the polarizer was not turned"
    )]
    Unpolarized,
    /// Channels that are not at right angles.
    #[error(
        "the axes of the channels lie at {0:.0}, {1:.0} and {2:.0} degrees, neither along nor across each other"
    )]
    Skewed(f64, f64, f64),
}

/// Names of the channels in messages.
pub const CHANNEL_NAMES: [&str; 3] = ["red", "green", "blue"];

/// The angle in (-90, 90] that is the same line.
fn line_deg(angle_deg: f64) -> f64 {
    let angle = angle_deg.rem_euclid(180.0);
    if angle > 90.0 { angle - 180.0 } else { angle }
}

/// Extinctions, axes and states of the channels.
///
/// # Errors
/// Where the turns do not tell, with what to do.
pub fn solve(turns: &[Turn]) -> Result<Found, PolarizationError> {
    let mut angles: Vec<f64> = turns.iter().map(|turn| turn.angle_deg.rem_euclid(180.0)).collect();
    angles.sort_by(f64::total_cmp);
    angles.dedup_by(|a, b| (*a - *b).abs() < LEAST_APART_DEG);
    let wraps = angles.len() > 1 && angles[0] + 180.0 - angles[angles.len() - 1] < LEAST_APART_DEG;
    let distinct = angles.len() - usize::from(wraps);
    if distinct < FEWEST_TURNS {
        return Err(PolarizationError::Turns(distinct));
    }
    let mut channels = [None; 3];
    for (index, channel) in channels.iter_mut().enumerate() {
        let light = |turn: &Turn| turn.light[index] > 5.0 * turn.sigma[index];
        if !turns.iter().any(light) {
            return Err(PolarizationError::Dark(CHANNEL_NAMES[index]));
        }
        *channel = Some(fit_channel(turns, index).ok_or(PolarizationError::Turns(distinct))?);
    }
    let channels = channels.map(|channel| channel.expect("every channel was fitted above"));
    states(channels)
}

/// Malus' law for one channel, its state still open.
fn fit_channel(turns: &[Turn], index: usize) -> Option<Channel> {
    let rows: Vec<[f64; 3]> = turns
        .iter()
        .map(|turn| {
            let (sin, cos) = (2.0 * turn.angle_deg.to_radians()).sin_cos();
            [1.0, cos, sin]
        })
        .collect();
    let light: Vec<f64> = turns.iter().map(|turn| turn.light[index]).collect();
    let sigmas: Vec<f64> = turns.iter().map(|turn| turn.sigma[index].max(1e-9)).collect();
    let fit = linear(&rows, &light, &sigmas)?;
    let (mean, cosine, sine) = (fit.parameters[0], fit.parameters[1], fit.parameters[2]);
    let swing = cosine.hypot(sine);
    let (c, s) = (cosine / swing.max(1e-12), sine / swing.max(1e-12));
    // Variance of `weights * parameters`.
    let variance = |weights: [f64; 3]| -> f64 {
        let pairs = (0..3).flat_map(|a| (0..3).map(move |b| (a, b)));
        pairs.map(|(a, b)| weights[a] * weights[b] * fit.covariance(a, b)).sum()
    };
    let (most, least) = (mean + swing, mean - swing);
    let least_sigma = variance([1.0, -c, -s]).sqrt();
    // Less light than noise: all that is known is a bound.
    let least = least.max(least_sigma);
    let relative = (variance([1.0, c, s]) / (most * most) + (least_sigma / least).powi(2)).sqrt();
    Some(Channel {
        state: State::None,
        extinction: most / least,
        extinction_sigma: most / least * relative,
        axis_deg: line_deg(0.5 * sine.atan2(cosine).to_degrees()),
        axis_sigma_deg: (0.5 * variance([0.0, -s, c]).sqrt() / swing.max(1e-12)).to_degrees(),
    })
}

/// Sorts the channels by their axes: those nearer to the mount's 0 carry H.
fn states(mut channels: [Channel; 3]) -> Result<Found, PolarizationError> {
    let (mut sum, mut weights) = (0.0, 0.0);
    let polarized: Vec<usize> = (0..3).filter(|&index| channels[index].extinction >= UNPOLARIZED).collect();
    for &index in &polarized {
        let channel = &mut channels[index];
        channel.state = if channel.axis_deg.abs() <= 45.0 { State::Horizontal } else { State::Vertical };
    }
    let off_axis = |channel: &Channel| match channel.state {
        State::Vertical => line_deg(channel.axis_deg - 90.0),
        _ => channel.axis_deg,
    };
    for &index in &polarized {
        let weight = channels[index].axis_sigma_deg.max(1e-4).powi(-2);
        sum += weight * off_axis(&channels[index]);
        weights += weight;
    }
    if polarized.is_empty() {
        return Err(PolarizationError::Unpolarized);
    }
    let axis = sum / weights;
    if polarized.iter().any(|&index| (off_axis(&channels[index]) - axis).abs() > AXIS_TOLERANCE_DEG) {
        let [red, green, blue] = channels.map(|channel| channel.axis_deg);
        return Err(PolarizationError::Skewed(red, green, blue));
    }
    Ok(Found { channels, azimuth_error_deg: -axis, azimuth_sigma_deg: weights.powf(-0.5) })
}

/// Follows the light of V while somebody turns the polarizer: how far it stands from the darkest position seen.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Turning {
    darkest: Option<f64>,
    brightest: f64,
}

impl Turning {
    /// Takes the light of V now; the angle in degrees off the darkest position, once enough of a turn has been seen.
    pub fn add(&mut self, light: f64) -> Option<f64> {
        let darkest = self.darkest.map_or(light, |darkest| darkest.min(light));
        self.darkest = Some(darkest);
        self.brightest = self.brightest.max(light);
        // Half of a quarter turn at least.
        let seen = self.brightest > 3.0 * darkest;
        let share = ((light - darkest) / (self.brightest - darkest)).clamp(0.0, 1.0);
        seen.then(|| share.sqrt().asin().to_degrees())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    /// Malus with an imperfect polarizer, by intensities along and across.
    fn turn(angle_deg: f64, error_deg: f64, vertical: [bool; 3], extinction: [f64; 3]) -> Turn {
        let axis = (angle_deg + error_deg).to_radians();
        let response = [0.35, 1.0, 0.45];
        let light = std::array::from_fn(|index| {
            let (along, across) = (extinction[index], 1.0);
            let own = if vertical[index] { axis.sin().powi(2) } else { axis.cos().powi(2) };
            1000.0 * response[index] * (along * own + across * (1.0 - own)) / (along + across)
        });
        Turn { angle_deg, light, sigma: [0.01; 3] }
    }

    #[test]
    fn channels_axes_and_extinctions_are_found() {
        let mut random = StdRng::seed_from_u64(3);
        for vertical in [[true, false, true], [false, true, false], [true, true, false]] {
            let error = 20.0 * random.random::<f64>() - 10.0;
            let extinction: [f64; 3] = std::array::from_fn(|_| 20.0 + 60.0 * random.random::<f64>());
            let turns: Vec<Turn> =
                [0.0, 45.0, 90.0, 135.0].map(|angle| turn(angle, error, vertical, extinction)).to_vec();
            let found = solve(&turns).unwrap();
            assert!((found.azimuth_error_deg - error).abs() < 0.01, "{error}: {found:?}");
            for index in 0..3 {
                let channel = found.channels[index];
                let state = if vertical[index] { State::Vertical } else { State::Horizontal };
                assert_eq!(channel.state, state, "{vertical:?}: {found:?}");
                assert!(
                    (channel.extinction / extinction[index] - 1.0).abs() < 0.01,
                    "{extinction:?}: {found:?}"
                );
            }
        }
    }

    #[test]
    fn sigmas_are_honest() {
        let mut random = StdRng::seed_from_u64(9);
        let (mut azimuth, mut extinction) = (0.0, 0.0);
        for _ in 0..200 {
            let mut turns: Vec<Turn> =
                [0.0, 40.0, 85.0].map(|angle| turn(angle, 2.0, [true, false, true], [40.0; 3])).to_vec();
            for turn in &mut turns {
                turn.sigma = [0.5; 3];
                turn.light.iter_mut().for_each(|light| {
                    *light += 0.5 * ((0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0);
                });
            }
            let found = solve(&turns).unwrap();
            azimuth += ((found.azimuth_error_deg - 2.0) / found.azimuth_sigma_deg).powi(2) / 200.0;
            let green = found.channels[1];
            extinction += ((green.extinction - 40.0) / green.extinction_sigma).powi(2) / 200.0;
        }
        assert!((0.7..1.4).contains(&azimuth) && (0.7..1.4).contains(&extinction), "{azimuth} {extinction}");
    }

    #[test]
    fn what_does_not_tell_is_refused_by_name() {
        let at = |angle| turn(angle, 0.0, [true, false, true], [50.0; 3]);
        assert_eq!(solve(&[at(0.0), at(90.0)]), Err(PolarizationError::Turns(2)));
        assert_eq!(solve(&[at(0.0), at(90.0), at(180.0)]), Err(PolarizationError::Turns(2)));
        let flat = [0.0, 45.0, 90.0].map(|angle| turn(angle, 0.0, [true, false, true], [1.0; 3]));
        assert_eq!(solve(&flat), Err(PolarizationError::Unpolarized));
        let mut dark = [at(0.0), at(45.0), at(90.0)];
        dark.iter_mut().for_each(|turn| turn.light[2] = 0.01);
        assert_eq!(solve(&dark), Err(PolarizationError::Dark("blue")));
        let mut skewed = [at(0.0), at(45.0), at(90.0)];
        let other = [0.0, 45.0, 90.0].map(|angle| turn(angle, 30.0, [true, false, true], [50.0; 3]));
        skewed.iter_mut().zip(other).for_each(|(turn, other)| turn.light[0] = other.light[0]);
        assert!(matches!(solve(&skewed), Err(PolarizationError::Skewed(..))), "{:?}", solve(&skewed));
    }

    #[test]
    fn a_turn_by_hand_is_followed() {
        let mut turning = Turning::default();
        let light = |angle: f64| 2.0 + 100.0 * angle.to_radians().sin().powi(2);
        assert_eq!(turning.add(light(0.0)), None);
        for angle in 0..=90 {
            turning.add(light(f64::from(angle)));
        }
        for angle in [3.0, 20.0, 60.0] {
            assert!((turning.add(light(angle)).unwrap() - angle).abs() < 0.1);
        }
    }
}
