//! Synchrony on the rig: flashes of each channel, sampled by exposures at swept delays.

use std::time::Duration;

use polscan_calibration::synchrony::{
    BandTiming, Reading, Ripple, Sample, SyncError, Timing as Measured, combine, edge, plateau, ripple,
};
use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraSettings},
    clock::Timestamp,
    projector::{ProjectorInfo, ProjectorTiming, Slide},
};

use super::{
    Bench,
    bench::{mean, quantile},
};
use crate::{
    app::Rig,
    config::Settings,
    engine::Failure,
    sequencer::{CancelFlag, PlanOptions, plan::Timing},
};

const OPERATION: &str = "measure the synchrony";

/// Step of the sweep.
const STEP: Duration = Duration::from_millis(1);
/// Exposure of the sweep: no longer than a step, so that each sample is a moment.
const SWEEP_US: f64 = 1000.0;
/// From a flip until the light has settled, at most.
const SWEEP_REFRESHES: u32 = 10;
const LEAST_SWEEP: Duration = Duration::from_millis(150);
/// Bands of the picture's height.
const BANDS: usize = 4;
/// Frames of steady light for the lamp's ripple, and the most by which the times between them differ.
const RIPPLE_FRAMES: usize = 240;
const RIPPLE_JITTER_NS: f64 = 7e6;
/// Pixels of a band see at least this share of what the brightest do, and at least this share of white in its band alone.
const LIT_SHARE: f64 = 0.2;
const OWN_SHARE: f64 = 0.7;
/// Most pixels of a band that are averaged, and the fewest that will do.
const PIXELS: usize = 25_000;
const FEWEST_PIXELS: usize = 100;

/// Channels that flash, with the picture of each.
const CHANNELS: [(&str, [u8; 3]); 4] =
    [("white", [255; 3]), ("red", [255, 0, 0]), ("green", [0, 255, 0]), ("blue", [0, 0, 255])];

/// Samples of one channel in one band.
#[derive(Debug, Clone)]
pub struct Curve {
    /// Name of the channel.
    pub channel: &'static str,
    /// First row of the band and the row after its last, in projector px.
    pub rows: [u32; 2],
    /// Black to the channel.
    pub rise: Vec<Sample>,
    /// The channel to black.
    pub fall: Vec<Sample>,
}

/// What was measured.
#[derive(Debug, Clone)]
pub struct Synchrony {
    /// Projector.
    pub projector: ProjectorInfo,
    /// What a scan needs.
    pub timing: Measured,
    /// Timing of each channel and band.
    pub bands: Vec<BandTiming>,
    /// Channels of which the camera sees too little, and why.
    pub unseen: Vec<(&'static str, SyncError)>,
    /// What they come from.
    pub curves: Vec<Curve>,
    /// The lamp; `None` where it was too dark to tell.
    pub ripple: Option<Ripple>,
    /// Exposure of the samples, in ms.
    pub exposure_ms: f64,
    /// Timetable of a scan with the configured exposure.
    pub chosen: Timing,
}

/// Pixels that see one band of the picture.
struct Band {
    rows: [u32; 2],
    pixels: Vec<u32>,
}

/// Measures display and lamp of `rig`. `progress` hears what is being done.
///
/// # Errors
/// Devices; or light that shows no timing, with what to change.
pub fn measure(
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(&str),
) -> Result<Synchrony, Failure> {
    let mut bench = Bench::new(rig, OPERATION, cancel);
    refuse_free_running(bench.camera())?;
    let projector = bench.projector().clone();
    bench.load(&slides(&projector))?;
    progress("finding the picture");
    let exposure_us = sweep_exposure(&mut bench, settings)?;
    let bands = find_bands(&mut bench, &projector)?;
    let mut curves = Vec::new();
    for (number, (channel, _)) in CHANNELS.iter().enumerate() {
        progress(channel);
        curves.extend(sweep(&mut bench, channel, number as u32 + 1, &bands)?);
    }
    progress("lamp");
    let ripple = lamp(&mut bench, &bands, exposure_us)?;
    let applied = bench.set(&settings.camera)?;
    let camera = bench.camera().clone();
    drop(bench);
    let exposure_ms = 1e-3 * exposure_us;
    let (mut timings, mut unseen) = (Vec::new(), Vec::new());
    for curve in &curves {
        let (black, lit) = (plateau(&curve.fall), plateau(&curve.rise));
        match (edge(&curve.rise, black, exposure_ms), edge(&curve.fall, lit, exposure_ms)) {
            (Ok(rise), Ok(fall)) => timings.push(BandTiming {
                channel: curve.channel.into(),
                first_row: curve.rows[0],
                end_row: curve.rows[1],
                rise,
                fall,
            }),
            (Err(error), _) | (_, Err(error)) => unseen.push((curve.channel, error)),
        }
    }
    let period_ms = 1e3 * projector.refresh_period.as_secs_f64();
    // Channels that the polarizer holds back say little; white is what must be seen.
    if let Some((_, error)) = unseen.iter().find(|(channel, _)| *channel == CHANNELS[0].0) {
        return Err(Failure::data(OPERATION, error.clone()));
    }
    let timing = combine(&timings, period_ms)
        .ok_or_else(|| Failure::data(OPERATION, "no part of the picture is seen".to_owned()))?;
    let chosen = choose(&projector, &camera, &timing, &applied)?;
    Ok(Synchrony { projector, timing, bands: timings, unseen, curves, ripple, exposure_ms, chosen })
}

/// A camera that exposes when it likes says when by its frames' arrival, less well than the display is to be known.
fn refuse_free_running(camera: &CameraInfo) -> Result<(), Failure> {
    if camera.triggered {
        return Ok(());
    }
    let message = format!(
        "camera {} of driver {} has no trigger, so that the start of an exposure is not known to the millisecond; measure \
         this projector with a camera that has one and name the file in rig.sync",
        camera.serial, camera.driver
    );
    Err(Failure::NoDevice { operation: OPERATION, message })
}

/// Black, the channels, and white in each band alone.
fn slides(projector: &ProjectorInfo) -> Vec<Slide> {
    let mut slides = vec![Slide::Uniform([0; 3])];
    slides.extend(CHANNELS.map(|(_, rgb)| Slide::Uniform(rgb)));
    for [first, end] in band_rows(projector.height) {
        slides.push(Slide::Rows(
            (0..projector.height)
                .map(|row| if (first..end).contains(&row) { [255; 3] } else { [0; 3] })
                .collect(),
        ));
    }
    slides
}

fn band_rows(height: u32) -> [[u32; 2]; BANDS] {
    std::array::from_fn(|band| [band, band + 1].map(|edge| (edge as u32 * height) / BANDS as u32))
}

/// Sets the camera for the sweep: as bright as a step allows without clipping.
fn sweep_exposure(bench: &mut Bench, settings: &Settings) -> Result<f64, Failure> {
    let mut exposure_us = SWEEP_US;
    bench.hold(1)?;
    loop {
        let applied = bench.set(&CameraSettings { exposure_us, ..settings.camera.clone() })?;
        let top = quantile(&mean(&bench.frames(1)?), 0.995);
        if top < 0.95 * f64::from(applied.saturation_dn) || exposure_us < 40.0 {
            return Ok(applied.settings.exposure_us);
        }
        exposure_us = (0.5 * exposure_us).round();
    }
}

/// Which pixels see which band, from white in each band alone.
fn find_bands(bench: &mut Bench, projector: &ProjectorInfo) -> Result<Vec<Band>, Failure> {
    let mut level = |slide: u32| -> Result<Vec<f32>, Failure> {
        bench.hold(slide)?;
        Ok(mean(&bench.frames(4)?))
    };
    let (black, white) = (level(0)?, level(1)?);
    let light: Vec<f32> = white.iter().zip(&black).map(|(white, black)| white - black).collect();
    let least = (LIT_SHARE * quantile(&light, 0.99)) as f32;
    let mut bands = Vec::new();
    for (number, rows) in (0u32..).zip(band_rows(projector.height)) {
        let own = level(1 + CHANNELS.len() as u32 + number)?;
        let pixels: Vec<u32> = (0u32..)
            .zip(own.iter().zip(&black).zip(&light))
            .filter(|(_, ((own, black), light))| {
                **light > least && *own - *black > OWN_SHARE as f32 * **light
            })
            .map(|(pixel, _)| pixel)
            .collect();
        let step = pixels.len().div_ceil(PIXELS).max(1);
        bands.push(Band { rows, pixels: pixels.into_iter().step_by(step).collect() });
    }
    bands.retain(|band| band.pixels.len() >= FEWEST_PIXELS);
    if bands.is_empty() {
        return Err(Failure::data(
            OPERATION,
            "the camera sees nothing of the projected picture: put a plate or a card before the rig"
                .to_owned(),
        ));
    }
    Ok(bands)
}

/// Mean and sigma of the pixels of each band in one frame taken at `at`, with its start.
fn read(bench: &mut Bench, at: Timestamp, bands: &[Band]) -> Result<(Timestamp, Vec<[f64; 2]>), Failure> {
    let frame = bench.take(at)?;
    let pixels = frame.pixels();
    let noise = bench.noise();
    let lights = bands.iter().map(|band| {
        let count = band.pixels.len() as f64;
        let sum: f64 = band.pixels.iter().map(|&pixel| f64::from(pixels.get(pixel as usize))).sum();
        [sum / count, (noise.variance(sum / count) / count).sqrt()]
    });
    Ok((frame.stamp.exposure_start, lights.collect()))
}

/// Flashes a picture until its rise and its fall have been sampled at every step.
fn sweep(
    bench: &mut Bench,
    channel: &'static str,
    slide: u32,
    bands: &[Band],
) -> Result<Vec<Curve>, Failure> {
    let window = (bench.projector().refresh_period * SWEEP_REFRESHES).max(LEAST_SWEEP);
    // The camera needs so many steps between exposures: as many flashes sample every step.
    let flashes = bench.frame_interval().as_nanos().div_ceil(STEP.as_nanos()).max(1) as u32;
    let new = |band: &Band| Curve { channel, rows: band.rows, rise: Vec::new(), fall: Vec::new() };
    let mut curves: Vec<Curve> = bands.iter().map(new).collect();
    bench.hold(0)?;
    for flash in 0..flashes {
        for (index, rising) in [(slide, true), (0, false)] {
            let receipt = bench.show(index)?;
            let mut delay = STEP * flash;
            while delay < window {
                let (started, lights) = read(bench, receipt.flipped + delay, bands)?;
                let start_ms = 1e3 * started.since(receipt.flipped).as_secs_f64();
                for (curve, [light, sigma]) in curves.iter_mut().zip(lights) {
                    let samples = if rising { &mut curve.rise } else { &mut curve.fall };
                    samples.push(Sample { start_ms, light, sigma });
                }
                delay += STEP * flashes;
            }
            bench.wait_until(receipt.flipped + window);
        }
    }
    Ok(curves)
}

/// Steady white at uneven times.
fn lamp(bench: &mut Bench, bands: &[Band], exposure_us: f64) -> Result<Option<Ripple>, Failure> {
    bench.hold(0)?;
    let (mut at, black) = read(bench, bench.now(), bands)?;
    bench.hold(1)?;
    let mut readings = Vec::new();
    for number in 0..RIPPLE_FRAMES {
        // Multiples of the golden ratio are spread evenly and never repeat.
        let uneven = (number as f64 * 0.618_033_988_749_895).fract() * RIPPLE_JITTER_NS;
        at = at.max(bench.now()) + bench.frame_interval() + Duration::from_nanos(uneven as u64);
        let (started, lights) = read(bench, at, bands)?;
        let light = lights.iter().zip(&black).map(|([light, _], [black, _])| light - black).sum::<f64>();
        readings.push(Reading { time_s: started.seconds() + 0.5e-6 * exposure_us, light });
    }
    Ok(ripple(&readings, 1e-6 * exposure_us))
}

/// The least delay and hold that are safe with the measured timing.
fn choose(
    projector: &ProjectorInfo,
    camera: &CameraInfo,
    timing: &Measured,
    applied: &AppliedSettings,
) -> Result<Timing, Failure> {
    let measured = ProjectorInfo { timing: Some(projector_timing(timing)), ..projector.clone() };
    let (exposure_us, readout_us) = (applied.settings.exposure_us, applied.readout_us);
    Timing::new(&measured, camera, exposure_us, readout_us, &PlanOptions::default())
        .map_err(|error| Failure::Setup { operation: "choose the trigger delay", source: Box::new(error) })
}

/// Measured timing in the form of the seam.
fn projector_timing(timing: &Measured) -> ProjectorTiming {
    let duration = |ms: f64| Duration::from_secs_f64(1e-3 * ms.max(0.0));
    ProjectorTiming { latency: duration(timing.latency_ms), settling: duration(timing.settling_ms) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_without_a_trigger_is_refused_by_name() {
        let camera = |triggered| CameraInfo {
            driver: "v4l2".into(),
            model: "Webcam".into(),
            serial: "usb-1".into(),
            sensor_width: 640,
            sensor_height: 480,
            triggered,
            overlap: None,
        };
        assert!(refuse_free_running(&camera(true)).is_ok());
        let refused = refuse_free_running(&camera(false)).unwrap_err().to_string();
        assert!(refused.contains("usb-1") && refused.contains("rig.sync"), "{refused}");
    }
}
