//! A rig on which pictures are held and frames are taken at chosen times, outside any sequence.

use std::time::Duration;

use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraSettings},
    clock::Timestamp,
    error::DeviceError,
    frame::{Frame, Pixels},
    projector::{PresentReceipt, ProjectorInfo, Slide},
};

use crate::{app::Rig, decode::NoiseModel, engine::Failure, sequencer::CancelFlag};

/// From flip to steady light of a projector that was not measured: slower ones have not been seen.
const UNMEASURED: Duration = Duration::from_millis(300);

/// How much later than computed a frame may come.
const SLACK: Duration = Duration::from_millis(500);

/// Time that a camera needs between readout and the next exposure, generously.
const TURNAROUND: Duration = Duration::from_millis(1);

/// Electrons of a full pixel of a common sensor.
const USUAL_FULL_WELL_E: f64 = 10_000.0;

/// Rig in use for a measurement. Dropping it stops the camera and leaves the projector black.
pub struct Bench<'a> {
    rig: &'a mut Rig,
    operation: &'static str,
    cancel: &'a CancelFlag,
    applied: Option<AppliedSettings>,
    armed: bool,
    /// Flip of the picture that is shown.
    shown: Option<PresentReceipt>,
}

impl<'a> Bench<'a> {
    /// Takes the rig for `operation`, a phrase that follows "cannot", until `cancel` asks to stop.
    pub fn new(rig: &'a mut Rig, operation: &'static str, cancel: &'a CancelFlag) -> Self {
        Self { rig, operation, cancel, applied: None, armed: false, shown: None }
    }

    fn failed(&self, source: DeviceError) -> Failure {
        Failure::Device { operation: self.operation, source }
    }

    fn check_cancelled(&self) -> Result<(), Failure> {
        match self.cancel.is_cancelled() {
            true => {
                Err(Failure::NoDevice { operation: self.operation, message: "stopped before its end".into() })
            }
            false => Ok(()),
        }
    }

    /// Camera of the rig.
    pub fn camera(&self) -> &CameraInfo {
        self.rig.camera.info()
    }

    /// Projector of the rig.
    pub fn projector(&self) -> &ProjectorInfo {
        self.rig.projector.info()
    }

    /// Replaces the set of pictures.
    pub fn load(&mut self, slides: &[Slide]) -> Result<(), Failure> {
        self.rig.projector.load(slides).map_err(|error| self.failed(error))
    }

    /// Shows picture `index` and returns when it was flipped, before its light has settled.
    pub fn show(&mut self, index: u32) -> Result<PresentReceipt, Failure> {
        self.check_cancelled()?;
        let receipt = self.rig.projector.show(index).map_err(|error| self.failed(error))?;
        self.shown = Some(receipt);
        Ok(receipt)
    }

    /// Shows picture `index` and waits until its light is steady for certain.
    pub fn hold(&mut self, index: u32) -> Result<(), Failure> {
        let receipt = self.show(index)?;
        let info = self.projector();
        let settled = info.timing.map_or(UNMEASURED, |timing| timing.latency + timing.settling);
        let until = receipt.flipped + settled + info.refresh_period * 2;
        self.rig.clock.sleep_until(until);
        Ok(())
    }

    /// Time on the rig's clock.
    pub fn now(&self) -> Timestamp {
        self.rig.clock.now()
    }

    /// Least time from one exposure to the next.
    pub fn frame_interval(&self) -> Duration {
        let frame_us =
            self.applied.as_ref().map_or(0.0, |applied| applied.settings.exposure_us + applied.readout_us);
        Duration::from_secs_f64(1e-6 * frame_us) + TURNAROUND
    }

    /// Noise of the camera as it says, else that of a good one: for weights only.
    pub fn noise(&self) -> NoiseModel {
        let applied = self.applied.as_ref();
        let said = applied.and_then(|applied| applied.noise);
        let full_dn = applied.map_or(255.0, |applied| f64::from(applied.saturation_dn));
        NoiseModel {
            gain_dn_per_electron: said
                .map_or(full_dn / USUAL_FULL_WELL_E, |noise| noise.gain_dn_per_electron),
            read_noise_dn: said.map_or(1.0, |noise| noise.read_noise_dn),
        }
    }

    /// Waits until `time` on the rig's clock.
    pub fn wait_until(&self, time: Timestamp) {
        self.rig.clock.sleep_until(time);
    }

    /// Stops the camera, sets it anew and arms it.
    pub fn set(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, Failure> {
        self.disarm()?;
        let applied = self.rig.camera.apply(settings).map_err(|error| self.failed(error))?;
        self.rig.camera.arm(1).map_err(|error| self.failed(error))?;
        self.armed = true;
        self.applied = Some(applied.clone());
        Ok(applied)
    }

    /// One frame, exposed at `at` or as soon after it as can be.
    pub fn take(&mut self, at: Timestamp) -> Result<Frame, Failure> {
        self.check_cancelled()?;
        let frame = self.frame_interval();
        self.rig.camera.trigger(at).map_err(|error| self.failed(error))?;
        let timeout = at.since(self.rig.clock.now()) + frame + SLACK;
        self.rig.camera.next_frame(timeout).map_err(|error| self.failed(error))
    }

    /// `count` frames of the picture that is shown, all at one phase of the refresh: a pulsed lamp then gives each the
    /// same light.
    pub fn frames(&mut self, count: usize) -> Result<Vec<Frame>, Failure> {
        (0..count).map(|_| self.take(self.next_refresh())).collect()
    }

    /// The next time that lies whole refreshes after the last flip.
    fn next_refresh(&self) -> Timestamp {
        let now = self.rig.clock.now();
        let period = self.projector().refresh_period.as_nanos() as u64;
        match &self.shown {
            Some(shown) => {
                let refreshes = (now.since(shown.flipped).as_nanos() as u64).div_ceil(period.max(1));
                Timestamp(shown.flipped.0 + refreshes * period)
            }
            None => now,
        }
    }

    fn disarm(&mut self) -> Result<(), Failure> {
        if std::mem::take(&mut self.armed) {
            self.rig.camera.disarm().map_err(|error| self.failed(error))?;
        }
        Ok(())
    }
}

impl Drop for Bench<'_> {
    fn drop(&mut self) {
        if let Err(error) = self.disarm() {
            tracing::warn!(error = error.chain(), "the camera was not stopped");
        }
        if let Err(error) = self.rig.projector.black() {
            tracing::warn!(%error, "the projector may not be black");
        }
    }
}

/// Samples of a frame.
pub fn samples(frame: &Frame) -> Vec<u16> {
    match frame.pixels() {
        Pixels::U8(samples) => samples.iter().map(|&sample| u16::from(sample)).collect(),
        Pixels::U16(samples) => samples.to_vec(),
    }
}

/// Mean of frames of one size, per pixel.
pub fn mean(frames: &[Frame]) -> Vec<f32> {
    let mut sums = vec![0.0f32; frames.first().map_or(0, |frame| frame.pixels().len())];
    for frame in frames {
        let pixels = frame.pixels();
        sums.iter_mut().enumerate().for_each(|(at, sum)| *sum += f32::from(pixels.get(at)));
    }
    let count = frames.len().max(1) as f32;
    sums.iter_mut().for_each(|sum| *sum /= count);
    sums
}

/// The value that a share of the values does not exceed; 0 for none.
pub fn quantile(values: &[f32], share: f64) -> f64 {
    let mut values = values.to_vec();
    if values.is_empty() {
        return 0.0;
    }
    let rank = ((values.len() - 1) as f64 * share) as usize;
    f64::from(*values.select_nth_unstable_by(rank, f32::total_cmp).1)
}
