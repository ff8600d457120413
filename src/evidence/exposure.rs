//! Automatic exposure, told by how the brightness of each frame answers to the frame before: the step from one gain to the
//! next falls in proportion to the logarithm of the mean of the former, `e' = e - s (ln mean - c)`, by less than it rises.
//!
//! A lamp knows nothing of the pictures. One that beats by the angle `w` per frame has steps that correlate with its own
//! brightness by `-sqrt((1 - cos w) / 2)` along a slope of `cos w - 1`: where the slope is that of a correction, short of
//! -1.1, the correlation is short of -0.75. What the pictures themselves change of the mean weakens both, among few frames
//! not always alike, so that more is asked for: a camera that adjusts itself follows its rule closely.

use super::look::sample;
use crate::{decode::Plane, report::statistics};

/// How far steps must go with the mean of the frame before, and the range of corrections: all of the error, and so little
/// that it does not show within a scan.
const ANSWERS: f64 = 0.95;
const SLOPE: f64 = 1.1;
const LEAST_SLOPE: f64 = 0.01;
/// Least swing of the gains, as a logarithm: less is no reason.
const LEAST_SWING: f64 = 0.02;
/// About so many pixels are looked at for the gain of a frame, and so many must show it.
const GAIN_PIXELS: usize = 40_000;
const LEAST_GAINS: usize = 100;
/// Least level of a bright pixel in DN.
const BRIGHT_DN: f64 = 8.0;

/// How bright a frame is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Exposure {
    /// Logarithm of its bright pixels against those of the bright reference.
    pub gain: f64,
    /// Logarithm of its mean above black, in DN.
    pub mean: f64,
}

impl Exposure {
    /// What is fitted: the mean of this frame, and the step from its gain to that of the next.
    pub fn step_to(self, next: Self) -> [f64; 2] {
        [self.mean, next.gain - self.gain]
    }
}

/// What gains are measured against.
#[derive(Clone, Copy)]
pub struct Gauge<'a> {
    /// The bright reference.
    pub reference: Plane<'a>,
    /// Dark level in DN.
    pub black_dn: f64,
    /// Least value of a saturated sample.
    pub saturation_dn: u16,
}

impl Gauge<'_> {
    /// Brightness of a frame whose pair has the frame `other`, from pixels that are `lit` and show the bright light in it.
    pub fn exposure(
        &self,
        frame: Plane<'_>,
        other: Plane<'_>,
        lit: impl Fn(usize) -> bool,
    ) -> Option<Exposure> {
        let saturation = f64::from(self.saturation_dn);
        let len = frame.len().min(other.len()).min(self.reference.len());
        let mut gains: Vec<f64> = (0..len)
            .step_by((len / GAIN_PIXELS).max(1))
            .filter(|&at| lit(at))
            .map(|at| [frame, other, self.reference].map(|plane| sample(plane, at)))
            .filter(|samples| samples.iter().all(|&dn| dn < saturation))
            .map(|samples| samples.map(|dn| dn - self.black_dn))
            // Noise of a bright pixel is small beside this.
            .filter(|&[here, other, reference]| here > 2.0 * other.max(BRIGHT_DN) && reference > BRIGHT_DN)
            .map(|[here, _, reference]| (here / reference).ln())
            .collect();
        if gains.len() < LEAST_GAINS {
            return None;
        }
        let gain = statistics::median(&mut gains).and_then(statistics::finite)?;
        let places = (0..frame.len()).step_by((frame.len() / 10_000).max(1));
        let count = places.len().max(1) as f64;
        let mean = (places.map(|at| sample(frame, at)).sum::<f64>() / count - self.black_dn).max(1.0).ln();
        Some(Exposure { gain, mean })
    }
}

/// Whether the gains of frames differ by enough to be a reason for anything.
pub fn swings(exposures: impl Iterator<Item = Exposure> + Clone) -> bool {
    let gains = exposures.map(|exposure| exposure.gain);
    gains.clone().fold(f64::MIN, f64::max) - gains.fold(f64::MAX, f64::min) >= LEAST_SWING
}

/// Whether steps answer to the frame before as those of automatic exposure do.
pub fn answers(steps: &[[f64; 2]]) -> bool {
    let (correlation, slope) = correlation(steps);
    correlation < -ANSWERS && (-SLOPE..-LEAST_SLOPE).contains(&slope)
}

/// Correlation of the second values with the first, and the slope of their line.
fn correlation(steps: &[[f64; 2]]) -> (f64, f64) {
    let count = steps.len() as f64;
    let middle = |index: usize| steps.iter().map(|step| step[index]).sum::<f64>() / count;
    let (x, y) = (middle(0), middle(1));
    let sum = |of: fn(f64, f64) -> f64| steps.iter().map(|step| of(step[0] - x, step[1] - y)).sum::<f64>();
    let (xx, yy, xy) = (sum(|a, _| a * a), sum(|_, b| b * b), sum(|a, b| a * b));
    (statistics::finite(xy / (xx * yy).sqrt()).unwrap_or(0.0), statistics::finite(xy / xx).unwrap_or(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Frames whose bare pictures have these means, under gains that follow `next(gain, mean)`.
    fn steps(next: impl Fn(usize, f64, f64) -> f64) -> Vec<[f64; 2]> {
        let mut gain = 0.0;
        let all: Vec<Exposure> = (0..30)
            .map(|place| {
                let mean = gain + 5.0 + 0.1 * (place as f64 * 2.3).sin();
                let exposure = Exposure { gain, mean };
                gain = next(place, gain, mean);
                exposure
            })
            .collect();
        all.windows(2).map(|two| two[0].step_to(two[1])).collect()
    }

    #[test]
    fn a_camera_that_adjusts_itself_answers_at_any_speed() {
        for speed in [0.05, 0.2, 0.5, 1.0] {
            for target in [4.5, 5.5, 6.5] {
                assert!(answers(&steps(|_, gain, mean| gain - speed * (mean - target))), "{speed} {target}");
            }
        }
    }

    #[test]
    fn a_lamp_does_not() {
        for beat in [0.2, 0.9, 1.6, 2.4, 3.0] {
            assert!(!answers(&steps(|place, _, _| 0.1 * (beat * (place + 1) as f64).sin())), "{beat}");
        }
        assert!(!answers(&steps(|_, gain, _| gain + 0.01)), "one that warms up");
    }
}
