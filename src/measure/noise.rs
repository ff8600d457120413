//! Photon transfer on the rig: a white picture at many exposure times.

use polscan_calibration::noise::{
    BadPixels, Level, Meter, Noise, bad_pixels, clip_level_dn, evenly_lit, solve,
};
use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraSettings},
    projector::Slide,
};

use super::{
    Bench,
    bench::{mean, quantile, samples},
};
use crate::{app::Rig, config::Settings, engine::Failure, sequencer::CancelFlag};

const OPERATION: &str = "measure the noise";

/// Exposure times as shares of the longest. The short ones give black level and read noise, the long ones the gain.
const EXPOSURES: [f64; 14] =
    [1.0 / 128.0, 1.0 / 64.0, 1.0 / 32.0, 1.0 / 16.0, 0.125, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0];
/// Frames of each; half as many pairs.
const FRAMES: usize = 8;
/// Brightest chosen pixels at the longest exposure, as a share of the range.
const TOP_SHARE: f64 = 0.8;
/// Longer than the longest exposure by this factor, every chosen pixel is full: the darkest gets 0.4 of [`TOP_SHARE`].
const OVER: f64 = 5.0;
/// Shortest and longest exposure that are tried, in microseconds.
const SHORTEST_US: f64 = 10.0;
const LONGEST_US: f64 = 2e6;
/// Pixels that take part: more would not tell more.
const PIXELS: usize = 100_000;
/// Fewer are not enough for a gain within a percent.
const FEWEST_PIXELS: usize = 2000;

/// What was measured.
#[derive(Debug, Clone)]
pub struct Measured {
    /// Camera.
    pub camera: CameraInfo,
    /// Its settings at the longest exposure.
    pub applied: AppliedSettings,
    /// Figures.
    pub noise: Noise,
    /// What they come from.
    pub levels: Vec<Level>,
    /// Level at which samples end, and the least that such a sample reads, in DN; `None` where no light got that far.
    pub clip_dn: Option<(f64, u16)>,
    /// Ill pixels of the region that the camera is set to.
    pub bad: BadPixels,
    /// Pixels that took part.
    pub pixels: usize,
}

impl Measured {
    /// Electrons from black to where samples end.
    pub fn full_well_e(&self) -> Option<f64> {
        let (level, _) = self.clip_dn?;
        Some((level - self.noise.black_level_dn) / self.noise.gain_dn_per_electron)
    }
}

/// Measures the camera of `rig` at the gain and format of `settings`. `progress` hears what is being done.
///
/// # Errors
/// Devices; or data that say too little, with what to change.
pub fn measure(
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(&str),
) -> Result<Measured, Failure> {
    let mut bench = Bench::new(rig, OPERATION, cancel);
    let camera = bench.camera().clone();
    bench.load(&[Slide::Uniform([0; 3]), Slide::Uniform([255; 3])])?;
    progress("dark frames");
    bench.hold(0)?;
    bench.set(&exposed(settings, SHORTEST_US))?;
    let rough_black = quantile(&mean(&bench.frames(2)?), 0.5);
    bench.set(&settings.camera)?;
    let dark = mean(&bench.frames(FRAMES)?);
    progress("finding the range");
    bench.hold(1)?;
    let longest_us = longest(&mut bench, settings, rough_black)?;
    let applied = bench.set(&exposed(settings, longest_us))?;
    let reference = mean(&bench.frames(2)?);
    let pixels = evenly_lit(&reference, rough_black, PIXELS);
    if pixels.len() < FEWEST_PIXELS {
        return Err(Failure::data(
            OPERATION,
            format!(
                "only {} pixels see the picture evenly lit, {FEWEST_PIXELS} are needed: put a plate or a card before the rig",
                pixels.len()
            ),
        ));
    }
    let mut levels = Vec::new();
    let mut bright = Vec::new();
    for (number, exposure_us) in exposures(longest_us).into_iter().enumerate() {
        progress(&format!("level {}", number + 1));
        let applied = bench.set(&exposed(settings, exposure_us))?;
        let exposure_us = applied.settings.exposure_us;
        let mut meter = Meter::new(exposure_us, &pixels, rough_black, applied.saturation_dn);
        let frames = bench.frames(FRAMES)?;
        frames.iter().for_each(|frame| meter.add(&samples(frame)));
        levels.extend(meter.finish());
        bright = mean(&frames);
    }
    progress("saturation");
    bench.set(&exposed(settings, (OVER * longest_us).round()))?;
    let mut clipped = Vec::new();
    for frame in bench.frames(2)? {
        let samples = samples(&frame);
        clipped.extend(pixels.iter().map(|&pixel| samples[pixel as usize]));
    }
    drop(bench);
    let noise = solve(&levels).map_err(|error| Failure::data(OPERATION, error))?;
    let bad = bad_pixels(applied.width as usize, &dark, &bright, noise.black_level_dn);
    let clip_dn = clip_level_dn(&clipped);
    Ok(Measured { camera, applied, noise, levels, clip_dn, bad, pixels: pixels.len() })
}

fn exposed(settings: &Settings, exposure_us: f64) -> CameraSettings {
    CameraSettings { exposure_us, ..settings.camera.clone() }
}

/// Exposure times in whole microseconds, each once, ascending.
fn exposures(longest_us: f64) -> Vec<f64> {
    let mut times: Vec<f64> =
        EXPOSURES.iter().map(|share| (share * longest_us).round().max(SHORTEST_US)).collect();
    times.dedup();
    times
}

/// Exposure time at which the brightest pixels reach [`TOP_SHARE`] of the range.
fn longest(bench: &mut Bench, settings: &Settings, black_dn: f64) -> Result<f64, Failure> {
    let mut exposure_us = settings.camera.exposure_us;
    // Halving from far over, then two steps by what is seen: the second corrects for what noise and clipping hid.
    for _ in 0..16 {
        let applied = bench.set(&exposed(settings, exposure_us))?;
        let range = f64::from(applied.saturation_dn) - black_dn;
        let share = (quantile(&mean(&bench.frames(2)?), 0.99) - black_dn) / range;
        let factor = if share > 0.95 { 0.5 } else { TOP_SHARE / share.max(0.01) };
        let next_us = (factor * exposure_us).round().clamp(100.0 * SHORTEST_US, LONGEST_US);
        if (factor - 1.0).abs() < 0.03 || next_us == exposure_us {
            break;
        }
        exposure_us = next_us;
    }
    Ok(exposure_us)
}
