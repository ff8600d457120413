//! Output latency, rise and fall of the display, ripple of its lamp, and when it is safe to expose.
//!
//! The display flashes; exposures at many delays after the flip sample how its light comes and goes. All times are in
//! ms after the flip.

mod edge;
mod ripple;

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use edge::{Edge, Plateau, Sample, edge, plateau};
pub use ripple::{Reading, Ripple, ripple};

/// What is left of a change when it counts as settled, as a share of the change.
pub const SETTLED: f64 = 1e-3;

/// Settling times with a larger sigma are not taken at their value.
const CERTAIN_MS: f64 = 0.5;

/// Why samples show no timing.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum SyncError {
    /// Too few samples.
    #[error("{0} samples of the change are too few, {1} are needed: lengthen the sweep or shorten its steps")]
    Samples(usize, usize),
    /// The light does not change.
    #[error(
        "the light changes by {change:.4} only, with a noise of {sigma:.4}: the camera does not see this picture; check that \
         it looks at the projected picture and that its polarizer lets this channel through"
    )]
    NoLight {
        /// Change from the first to the last samples.
        change: f64,
        /// Its sigma.
        sigma: f64,
    },
    /// The light already changes in the first sample, or never comes to rest.
    #[error("the light has not settled {0:.0} ms after the flip: the sweep is too short for this projector")]
    Unsettled(f64),
}

/// Timing of one channel in one band of the picture's height.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BandTiming {
    /// `white`, `red`, `green` or `blue`.
    pub channel: String,
    /// First row of the band in projector px.
    pub first_row: u32,
    /// Row after its last.
    pub end_row: u32,
    /// Black to the channel.
    pub rise: Edge,
    /// The channel to black.
    pub fall: Edge,
}

/// What a scan needs of all bands and channels.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Timing {
    /// From flip to first light, of the earliest.
    pub latency_ms: f64,
    /// The same in refreshes, to the nearest.
    pub latency_refreshes: u32,
    /// From there until a thousandth of the change is left, of the latest.
    pub settling_ms: f64,
    /// Between the first light of the band that is lit first and that which is lit last.
    pub scan_out_ms: f64,
}

/// Joins what bands and channels need; `None` for none of them.
pub fn combine(bands: &[BandTiming], period_ms: f64) -> Option<Timing> {
    let edges = || bands.iter().flat_map(|band| [&band.rise, &band.fall]);
    let latency_ms = edges().map(|edge| edge.first_light_ms).reduce(f64::min)?;
    // The largest of many uncertain values is mostly uncertain: a channel that the camera hardly sees counts for what it
    // proves.
    let best_ms = edges().map(|edge| edge.settled_sigma_ms).reduce(f64::min)?;
    // A lamp that ripples makes all of them uncertain: then they count as they are.
    let certain_ms = CERTAIN_MS.max(2.0 * best_ms);
    let proven = |edge: &Edge| match edge.settled_sigma_ms <= certain_ms {
        true => edge.settled_ms,
        false => edge.settled_ms - 3.0 * edge.settled_sigma_ms,
    };
    let settled_ms = edges().map(proven).reduce(f64::max)?;
    // Noise moves the first light of one channel or another: bands are compared within each.
    let spread = |channel: &str| {
        let firsts =
            || bands.iter().filter(|band| band.channel == channel).map(|band| band.rise.first_light_ms);
        firsts().fold(f64::MIN, f64::max) - firsts().fold(f64::MAX, f64::min)
    };
    let scan_out_ms = bands.iter().map(|band| spread(&band.channel)).fold(0.0, f64::max);
    Some(Timing {
        latency_ms,
        latency_refreshes: (latency_ms / period_ms).round() as u32,
        settling_ms: settled_ms - latency_ms,
        scan_out_ms,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_uncertain_channel_counts_for_what_it_proves() {
        let edge = |settled_ms, settled_sigma_ms| Edge {
            first_light_ms: 33.0,
            settled_ms,
            settled_sigma_ms,
            t10_90_ms: 6.0,
        };
        let band = |rise| BandTiming {
            channel: "blue".into(),
            first_row: 0,
            end_row: 9,
            rise,
            fall: edge(52.0, 0.1),
        };
        let settling = |rise| combine(&[band(rise)], 16.7).unwrap().settling_ms;
        assert_eq!(settling(edge(54.0, 1.0)), 19.0);
        assert_eq!(settling(edge(64.0, 1.0)), 28.0);
        assert_eq!(settling(edge(54.0, 0.2)), 21.0);
        let all = BandTiming { fall: edge(52.0, 1.0), ..band(edge(54.0, 1.5)) };
        assert_eq!(combine(&[all], 16.7).unwrap().settling_ms, 21.0);
    }

    #[test]
    fn the_earliest_and_the_latest_band_decide() {
        let edge = |first_light_ms, settled_ms| Edge {
            first_light_ms,
            settled_ms,
            settled_sigma_ms: 0.1,
            t10_90_ms: 6.0,
        };
        let band = |channel: &str, first_row, rise, fall| BandTiming {
            channel: channel.into(),
            first_row,
            end_row: first_row + 192,
            rise,
            fall,
        };
        let bands = [
            band("green", 0, edge(33.5, 52.0), edge(33.4, 51.0)),
            band("green", 576, edge(45.5, 64.0), edge(45.4, 63.0)),
            band("red", 0, edge(34.0, 70.0), edge(34.0, 60.0)),
        ];
        let timing = combine(&bands, 1000.0 / 60.0).unwrap();
        assert_eq!((timing.latency_ms, timing.latency_refreshes), (33.4, 2));
        assert!((timing.settling_ms - 36.6).abs() < 1e-9 && (timing.scan_out_ms - 12.0).abs() < 1e-9);
        assert_eq!(combine(&[], 16.7), None);
    }
}
