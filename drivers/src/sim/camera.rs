//! The simulated camera.

use std::{collections::VecDeque, sync::Arc, time::Duration};

use super::{
    description::{CameraDescription, Pacing},
    rehearsal,
    render::{Exposure, Response, full_scale_dn},
    rig::{Device, Shared, Taken},
    script::Delivered,
    timeline::Timeline,
    worker::{Delivery, Job, Worker},
};
use crate::{
    camera::{
        AppliedSettings, Camera, CameraDriver, CameraInfo, CameraNoise, CameraSettings, Listing, Overlap,
        PixelFormat, Region, Schedule, StreamStatistics, TriggerSource,
    },
    clock::Timestamp,
    error::DeviceError,
    frame::{Frame, FrameStamp, PixelStore, Pixels},
};

const SERIAL: &str = "sim-camera-0";
const MODEL: &str = "simulated monochrome camera";
const SHORTEST_EXPOSURE_US: f64 = 1.0;
const LONGEST_EXPOSURE_US: f64 = 30e6;
/// A clipped pixel reads this many sigma of read noise low once in some million samples.
const SATURATION_MARGIN_SIGMA: f64 = 5.0;
/// Exposure times are whole multiples of this.
const EXPOSURE_STEP_US: f64 = 1.0;
const HIGHEST_GAIN_DB: f64 = 48.0;

/// Driver of a simulated rig's camera.
#[derive(Debug, Clone)]
pub struct SimCameras {
    shared: Arc<Shared>,
}

impl SimCameras {
    pub(crate) fn new(shared: Arc<Shared>) -> Self {
        Self { shared }
    }
}

impl CameraDriver for SimCameras {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(vec![Listing {
            driver: "sim".to_owned(),
            model: MODEL.to_owned(),
            serial: SERIAL.to_owned(),
            unusable: None,
        }])
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Camera>, DeviceError> {
        let taken = self.shared.take(Device::Camera, SERIAL, serial)?;
        let [sensor_width, sensor_height] = self.shared.description.camera.size;
        let info = CameraInfo {
            driver: "sim".to_owned(),
            model: MODEL.to_owned(),
            serial: SERIAL.to_owned(),
            sensor_width,
            sensor_height,
            triggered: true,
            overlap: Some(Overlap { latency: Duration::ZERO, stamped: true }),
        };
        Ok(Box::new(SimCamera { taken, info, applied: None, stream: None }))
    }
}

struct SimCamera {
    taken: Taken,
    info: CameraInfo,
    applied: Option<(AppliedSettings, Response)>,
    stream: Option<Stream>,
}

/// A stream between `arm` and `disarm`.
struct Stream {
    response: Response,
    statistics: StreamStatistics,
    /// End of the latest exposure.
    busy_until: Option<Timestamp>,
    pending: Pending,
    /// Pixels of the latest exposure that was read out, whatever became of it.
    before: Option<Arc<dyn PixelStore>>,
    /// A frame that will be delivered again.
    again: Option<Frame>,
}

/// Exposures that have not been delivered.
enum Pending {
    /// Rendered when asked for: the clock waits for nobody.
    Virtual(VecDeque<Job>),
    /// Rendered on a thread of their own while time goes on.
    Real(Worker),
}

impl Stream {
    /// The frame of an exposure that was read out; `None` where it is lost on the way.
    fn deliver(&mut self, delivery: Delivery, shared: &Shared) -> Option<Frame> {
        let Delivery { job, received, store } = delivery;
        let fate = shared.script.delivered(job.trigger);
        let before = self.before.replace(store.clone()).unwrap_or_else(|| store.clone());
        let store = match fate {
            Delivered::Never => return None,
            Delivered::Whole | Delivered::Twice => store,
            Delivered::Stale => before,
            Delivered::Torn(row) => {
                torn(&*store, &*before, row as usize * self.response.region.width as usize)
            }
        };
        self.statistics.frames += 1;
        let frame = Frame {
            width: self.response.region.width,
            height: self.response.region.height,
            bit_depth: self.response.bits,
            stamp: FrameStamp {
                frame_id: job.trigger,
                trigger: job.trigger,
                exposure_start: job.start,
                received,
                device_time_ns: Some(job.start.0),
            },
            store,
        };
        if fate == Delivered::Twice {
            self.again = Some(frame.clone());
        }
        Some(frame)
    }
}

/// The samples of `new` up to `from`, of `old` from there on.
fn torn(new: &dyn PixelStore, old: &dyn PixelStore, from: usize) -> Arc<dyn PixelStore> {
    match (new.pixels(), old.pixels()) {
        (Pixels::U8(new), Pixels::U8(old)) => {
            let from = from.min(new.len());
            Arc::new([&new[..from], &old[from..]].concat())
        }
        (Pixels::U16(new), Pixels::U16(old)) => {
            let from = from.min(new.len());
            Arc::new([&new[..from], &old[from..]].concat())
        }
        _ => unreachable!("frames of one stream have one sample type"),
    }
}

impl SimCamera {
    fn shared(&self) -> &Arc<Shared> {
        &self.taken.shared
    }

    fn out_of_order(&self, operation: &'static str, state: &'static str) -> DeviceError {
        DeviceError::OutOfOrder { device: self.info.serial.clone(), operation, state }
    }

    fn refused(
        &self,
        setting: &'static str,
        requested: impl ToString,
        offered: impl ToString,
    ) -> DeviceError {
        DeviceError::Refused {
            device: self.info.serial.clone(),
            setting,
            requested: requested.to_string(),
            offered: offered.to_string(),
        }
    }

    fn region(&self, asked: Option<Region>) -> Result<Region, DeviceError> {
        let (width, height) = (self.info.sensor_width, self.info.sensor_height);
        let Some(region) = asked else { return Ok(Region { x: 0, y: 0, width, height }) };
        let fits = |start: u32, size: u32, sensor: u32| size > 0 && start < sensor && size <= sensor - start;
        if fits(region.x, region.width, width) && fits(region.y, region.height, height) {
            return Ok(region);
        }
        let Region { x, y, width: w, height: h } = region;
        Err(self.refused(
            "region",
            format!("{w} x {h} at ({x}, {y})"),
            format!("a sensor of {width} x {height}"),
        ))
    }
}

/// Black level and system gain of a format.
fn response(
    camera: &CameraDescription,
    settings: &CameraSettings,
    region: Region,
    exposure_us: f64,
    hidden_gamma: f64,
) -> Response {
    let bits = settings.format.bit_depth();
    let full_scale = f64::from(full_scale_dn(bits));
    let black_dn = camera.black_level_share * full_scale;
    // At 0 dB the full well just fills the converter.
    let dn_per_electron = (full_scale - black_dn) / camera.full_well_e * 10f64.powf(settings.gain_db / 20.0);
    Response { region, bits, dn_per_electron, black_dn, gamma: camera.gamma * hidden_gamma, exposure_us }
}

/// Least value of a sample whose pixel may have been full. Read noise comes after the pixel is full, so that a clipped
/// pixel reads a few sigma below the level of the full well.
fn saturation_dn(camera: &CameraDescription, response: &Response) -> u16 {
    let noise_dn = camera.read_noise_e * response.dn_per_electron;
    let full_dn = f64::from(response.full_scale_dn());
    (full_dn - (SATURATION_MARGIN_SIGMA * noise_dn).ceil()).max(1.0) as u16
}

impl Camera for SimCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        if self.stream.is_some() {
            return Err(self.out_of_order("apply", "armed"));
        }
        let camera = &self.shared().description.camera;
        let exposure = settings.exposure_us;
        if !(SHORTEST_EXPOSURE_US..=LONGEST_EXPOSURE_US).contains(&exposure) {
            let range = format!("{SHORTEST_EXPOSURE_US} to {LONGEST_EXPOSURE_US}");
            return Err(self.refused("exposure_us", exposure, range));
        }
        if !(0.0..=HIGHEST_GAIN_DB).contains(&settings.gain_db) {
            return Err(self.refused("gain_db", settings.gain_db, format!("0 to {HIGHEST_GAIN_DB}")));
        }
        if settings.gamma != camera.gamma {
            return Err(self.refused("gamma", settings.gamma, camera.gamma));
        }
        if settings.format.bit_depth() > camera.bits {
            let offered: Vec<String> =
                [PixelFormat::Mono8, PixelFormat::Mono10, PixelFormat::Mono12, PixelFormat::Mono16]
                    .iter()
                    .filter(|format| format.bit_depth() <= camera.bits)
                    .map(|format| format!("{format:?}"))
                    .collect();
            return Err(self.refused("format", format!("{:?}", settings.format), offered.join(", ")));
        }
        if settings.trigger != TriggerSource::Software {
            return Err(self.refused("trigger", "line0", "software: a simulated camera has no lines"));
        }
        let region = self.region(settings.region)?;
        let exposure_us = (exposure / EXPOSURE_STEP_US).round() * EXPOSURE_STEP_US;
        let hidden_gamma = self.shared().script.hidden_gamma();
        let response = response(camera, settings, region, exposure_us, hidden_gamma);
        let noise = (camera.gamma == 1.0).then_some(CameraNoise {
            gain_dn_per_electron: response.dn_per_electron,
            read_noise_dn: camera.read_noise_e * response.dn_per_electron,
        });
        let applied = AppliedSettings {
            settings: CameraSettings { exposure_us, ..settings.clone() },
            width: region.width,
            height: region.height,
            black_level_dn: Some(response.black_dn),
            saturation_dn: saturation_dn(camera, &response),
            readout_us: camera.readout_us,
            noise,
        };
        self.shared().set_region(region);
        self.applied = Some((applied.clone(), response));
        Ok(applied)
    }

    fn rehearse(&mut self, schedule: &Schedule) -> Result<usize, DeviceError> {
        if self.stream.is_some() {
            return Err(self.out_of_order("rehearse", "armed"));
        }
        let Some((_, response)) = &self.applied else {
            return Err(self.out_of_order("rehearse", "no settings are applied"));
        };
        // A virtual clock waits for each frame.
        if self.shared().description.pacing == Pacing::Fast {
            return Ok(0);
        }
        Ok(rehearsal::step(self.shared(), response, schedule))
    }

    fn arm(&mut self, _frames: usize) -> Result<(), DeviceError> {
        if self.stream.is_some() {
            return Err(self.out_of_order("arm", "armed"));
        }
        let Some((_, response)) = &self.applied else {
            return Err(self.out_of_order("arm", "no settings are applied"));
        };
        let response = response.clone();
        let pending = match self.shared().description.pacing {
            Pacing::Fast => Pending::Virtual(VecDeque::new()),
            Pacing::RealTime => Pending::Real(Worker::start(self.shared().clone(), response.clone())?),
        };
        self.shared().arm();
        self.stream = Some(Stream {
            response,
            statistics: StreamStatistics::default(),
            busy_until: None,
            pending,
            before: None,
            again: None,
        });
        Ok(())
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        let shared = self.taken.shared.clone();
        let Some(stream) = &mut self.stream else {
            return Err(self.out_of_order("trigger", "not armed"));
        };
        let exposure =
            Duration::from_secs_f64(1e-6 * stream.response.exposure_us * shared.automatic_factor());
        let readout = Duration::from_secs_f64(1e-6 * shared.description.camera.readout_us);
        let mut timeline = shared.timeline();
        // The sensor reads one frame out while it exposes the next, but not two at once.
        let free = stream.busy_until.map_or(Timestamp(0), |end| {
            end.max(Timestamp((end + readout).0.saturating_sub(exposure.as_nanos() as u64)))
        });
        let start = at.max(shared.clock.now()).max(free);
        let number = shared.next_exposure();
        timeline.expect(number, start);
        drop(timeline);
        let end = start + exposure;
        let trigger = stream.statistics.triggers;
        stream.statistics.triggers += 1;
        stream.busy_until = Some(end);
        let arrives = end + readout + Duration::from_secs_f64(shared.script.delay_s(trigger));
        let job = Job { number, trigger, start, end, arrives };
        match &mut stream.pending {
            Pending::Virtual(jobs) => jobs.push_back(job),
            Pending::Real(worker) => worker.send(job)?,
        }
        Ok(start)
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let shared = self.taken.shared.clone();
        let Some(stream) = &mut self.stream else {
            return Err(self.out_of_order("next_frame", "not armed"));
        };
        if let Some(frame) = stream.again.take() {
            stream.statistics.frames += 1;
            return Ok(frame);
        }
        let deadline = shared.clock.now() + timeout;
        loop {
            let left = deadline.since(shared.clock.now());
            let delivery = match &mut stream.pending {
                Pending::Virtual(jobs) => next_virtual(&shared, &stream.response, jobs, left),
                Pending::Real(worker) => worker.next(&shared, left),
            };
            let Some(delivery) = delivery? else {
                return Err(DeviceError::Timeout {
                    device: self.info.serial.clone(),
                    awaited: "frame",
                    timeout_ms: timeout.as_millis() as u64,
                });
            };
            if let Some(frame) = stream.deliver(delivery, &shared) {
                return Ok(frame);
            }
        }
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        let rehearsal = self.taken.shared.rehearsed().take();
        let Some(mut stream) = self.stream.take() else {
            return Err(self.out_of_order("disarm", "not armed"));
        };
        let left = match stream.pending {
            Pending::Virtual(jobs) => jobs.into_iter().collect(),
            Pending::Real(worker) => worker.stop(),
        };
        let mut timeline = self.taken.shared.timeline();
        left.iter().for_each(|job| timeline.dismiss(job.number));
        if let Some(rehearsal) = rehearsal {
            stream.statistics.counters.insert("rehearsed_frames".to_owned(), rehearsal.used());
        }
        Ok(stream.statistics)
    }
}

impl Drop for SimCamera {
    fn drop(&mut self) {
        // A camera that is not armed has nothing to stop, which is what the error would say.
        let _ = self.disarm();
    }
}

/// Waits on the clock for the next frame and renders it.
fn next_virtual(
    shared: &Shared,
    response: &Response,
    jobs: &mut VecDeque<Job>,
    timeout: Duration,
) -> Result<Option<Delivery>, DeviceError> {
    let deadline = shared.clock.now() + timeout;
    let Some(job) = jobs.front().filter(|job| job.arrives <= deadline).cloned() else {
        shared.clock.sleep_until(deadline);
        return Ok(None);
    };
    jobs.pop_front();
    shared.clock.sleep_until(job.arrives);
    let store = expose(shared, response, &job);
    // The virtual clock does not move while a frame is computed.
    Ok(Some(Delivery { received: job.arrives, job, store }))
}

/// Renders an exposure that lies in the past.
pub(crate) fn expose(shared: &Shared, response: &Response, job: &Job) -> Arc<dyn PixelStore> {
    let exposure = {
        let mut timeline = shared.timeline();
        let exposure = light(shared, &timeline, job.number, [job.start, job.end]);
        timeline.dismiss(job.number);
        exposure
    };
    if shared.script.auto_exposure().is_none() {
        let rehearsed = shared.rehearsed().as_mut().and_then(|rehearsal| rehearsal.take(&exposure, response));
        return rehearsed.unwrap_or_else(|| shared.renderer.render(&exposure, response));
    }
    let exposure_us = 1e6 * job.end.since(job.start).as_secs_f64();
    let store = shared.renderer.render(&exposure, &Response { exposure_us, ..response.clone() });
    let full_scale = f64::from(response.full_scale_dn());
    shared.meter((mean_dn(store.pixels()) - response.black_dn) / (full_scale - response.black_dn));
    store
}

/// What reaches the sensor in the exposure `number` from one time to the other.
pub(crate) fn light(
    shared: &Shared,
    timeline: &Timeline,
    number: u64,
    [start, end]: [Timestamp; 2],
) -> Exposure {
    let middle = Timestamp(start.0 + (end.0 - start.0) / 2);
    let since_ns = timeline.since_armed_ns(middle);
    Exposure {
        number,
        light: timeline.mixture(start, end),
        ambient_e: shared.script.ambient_e(since_ns, shared.description.ambient.electrons),
        bumped: shared.script.bump().is_some_and(|(at_ns, _)| since_ns >= at_ns as f64),
    }
}

/// Mean of some ten thousand samples.
fn mean_dn(pixels: Pixels<'_>) -> f64 {
    let step = (pixels.len() / 10_000).max(1);
    let samples = (0..pixels.len()).step_by(step).map(|index| f64::from(pixels.get(index)));
    samples.sum::<f64>() / pixels.len().div_ceil(step).max(1) as f64
}
