//! The replay of a recorded scan as a camera and a projector.
//!
//! Frame `i` of a [`Recording`] is what the camera saw while slide `i` was on the glass: an exposure is answered with the
//! frame of the slide that the replaying projector showed when it started, so that takes can be repeated in any order.
//! Nothing is known here of files: the caller brings the pixels.

use std::{
    collections::VecDeque,
    fmt,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use crate::{
    camera::{
        AppliedSettings, Camera, CameraDriver, CameraInfo, CameraSettings, Listing, Region, StreamStatistics,
    },
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::{Frame, FrameStamp, PixelStore, Pixels},
    projector::{
        PresentReceipt, Projector, ProjectorDriver, ProjectorInfo, ProjectorTiming, ReceiptMethod, Slide,
    },
};

const CAMERA: &str = "replay-camera-0";
const PROJECTOR: &str = "replay-projector-0";
const MODEL: &str = "recording";
/// Flips that are remembered for exposures that have not been asked for yet.
const REMEMBERED_FLIPS: usize = 4096;

/// Frames of one scan, all of one size.
#[derive(Clone)]
pub struct Recording {
    /// Width of the frames in pixels.
    pub width: u32,
    /// Height of the frames in pixels.
    pub height: u32,
    /// Significant bits of a sample.
    pub bit_depth: u8,
    /// Row-major samples; frame `i` was taken under slide `i`.
    pub frames: Vec<Arc<dyn PixelStore>>,
    /// Camera settings in effect. Only these can be applied again.
    pub applied: AppliedSettings,
    /// Columns and rows of the projector.
    pub projector_size: [u32; 2],
    /// Time between the projector's refreshes.
    pub refresh_period: Duration,
}

impl fmt::Debug for Recording {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Recording")
            .field("width", &self.width)
            .field("height", &self.height)
            .field("bit_depth", &self.bit_depth)
            .field("frames", &self.frames.len())
            .finish_non_exhaustive()
    }
}

/// A recording as a rig. Its devices run by `clock`, at the pace of the refresh period.
#[derive(Debug, Clone)]
pub struct ReplayRig {
    shared: Arc<Shared>,
}

#[derive(Debug)]
struct Shared {
    recording: Recording,
    clock: Arc<dyn Clock>,
    /// When which slide was flipped, in order.
    flips: Mutex<VecDeque<(Timestamp, Option<u32>)>>,
    camera_open: AtomicBool,
    projector_open: AtomicBool,
}

impl Shared {
    fn flips(&self) -> MutexGuard<'_, VecDeque<(Timestamp, Option<u32>)>> {
        self.flips.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Slide on the glass at a time.
    fn slide_at(&self, at: Timestamp) -> Option<u32> {
        self.flips().iter().rev().find(|(flipped, _)| *flipped <= at).and_then(|(_, slide)| *slide)
    }
}

fn bad_data(device: &str, detail: String) -> DeviceError {
    DeviceError::BadData { device: device.to_owned(), detail }
}

/// Why frame `number` does not belong to a recording.
fn check_frame(recording: &Recording, number: usize, pixels: Pixels<'_>) -> Result<(), DeviceError> {
    let expected = recording.width as usize * recording.height as usize;
    if pixels.len() != expected {
        let (width, height) = (recording.width, recording.height);
        let detail = format!("frame {number} has {} samples, {width} x {height} was recorded", pixels.len());
        return Err(bad_data(CAMERA, detail));
    }
    let wide = matches!(pixels, Pixels::U16(_));
    if wide != (recording.bit_depth > 8) {
        let samples = if wide { "16-bit" } else { "8-bit" };
        let detail =
            format!("frame {number} has {samples} samples, {} bits were recorded", recording.bit_depth);
        return Err(bad_data(CAMERA, detail));
    }
    Ok(())
}

impl ReplayRig {
    /// Checks that all frames are of the recorded size and depth; `BadData` names the first that is not.
    pub fn new(recording: Recording, clock: Arc<dyn Clock>) -> Result<Self, DeviceError> {
        if !(1..=16).contains(&recording.bit_depth) {
            return Err(bad_data(
                CAMERA,
                format!("{} bits were recorded, must be 1 to 16", recording.bit_depth),
            ));
        }
        if recording.refresh_period.is_zero() {
            return Err(bad_data(
                PROJECTOR,
                "the recorded refresh period is zero; give that of the display".into(),
            ));
        }
        if (recording.applied.width, recording.applied.height) != (recording.width, recording.height) {
            let AppliedSettings { width, height, .. } = recording.applied;
            let detail = format!(
                "the recorded settings say {width} x {height}, the frames are {} x {}",
                recording.width, recording.height
            );
            return Err(bad_data(CAMERA, detail));
        }
        for (number, frame) in recording.frames.iter().enumerate() {
            check_frame(&recording, number, frame.pixels())?;
        }
        let shared = Shared {
            recording,
            clock,
            flips: Mutex::default(),
            camera_open: AtomicBool::new(false),
            projector_open: AtomicBool::new(false),
        };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// Driver of the replaying camera.
    pub fn cameras(&self) -> ReplayCameras {
        ReplayCameras { shared: self.shared.clone() }
    }

    /// Driver of the replaying projector.
    pub fn projectors(&self) -> ReplayProjectors {
        ReplayProjectors { shared: self.shared.clone() }
    }
}

/// Takes a device, which only one may have.
fn take(flag: &AtomicBool, serial: &str, asked: Option<&str>) -> Result<(), DeviceError> {
    let unavailable =
        |device: &str, detail: String| Err(DeviceError::Unavailable { device: device.to_owned(), detail });
    match asked {
        Some(asked) if asked != serial => {
            unavailable(asked, format!("the recording has only {serial}; select that or nothing"))
        }
        _ if flag.swap(true, Ordering::AcqRel) => {
            unavailable(serial, "is open already; close it first".to_owned())
        }
        _ => Ok(()),
    }
}

fn listing(serial: &str) -> Vec<Listing> {
    vec![Listing {
        driver: "replay".to_owned(),
        model: MODEL.to_owned(),
        serial: serial.to_owned(),
        unusable: None,
    }]
}

/// Driver of a recording's camera.
#[derive(Debug, Clone)]
pub struct ReplayCameras {
    shared: Arc<Shared>,
}

impl CameraDriver for ReplayCameras {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(listing(CAMERA))
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Camera>, DeviceError> {
        take(&self.shared.camera_open, CAMERA, serial)?;
        let recording = &self.shared.recording;
        // The recorded region is all that is known of the sensor.
        let whole = Region { x: 0, y: 0, width: recording.width, height: recording.height };
        let region = recording.applied.settings.region.unwrap_or(whole);
        let info = CameraInfo {
            driver: "replay".to_owned(),
            model: MODEL.to_owned(),
            serial: CAMERA.to_owned(),
            sensor_width: region.x + region.width,
            sensor_height: region.y + region.height,
            triggered: true,
        };
        Ok(Box::new(ReplayCamera { shared: self.shared.clone(), info, applied: false, stream: None }))
    }
}

struct ReplayCamera {
    shared: Arc<Shared>,
    info: CameraInfo,
    applied: bool,
    stream: Option<Stream>,
}

#[derive(Default)]
struct Stream {
    statistics: StreamStatistics,
    pending: VecDeque<(u64, Timestamp)>,
    busy_until: Timestamp,
}

impl ReplayCamera {
    fn out_of_order(operation: &'static str, state: &'static str) -> DeviceError {
        DeviceError::OutOfOrder { device: CAMERA.to_owned(), operation, state }
    }
}

/// The first setting that differs from the recorded ones.
fn first_difference(asked: &CameraSettings, recorded: &CameraSettings) -> Option<DeviceError> {
    let settings = [
        ("exposure_us", asked.exposure_us.to_string(), recorded.exposure_us.to_string()),
        ("gain_db", asked.gain_db.to_string(), recorded.gain_db.to_string()),
        ("gamma", asked.gamma.to_string(), recorded.gamma.to_string()),
        ("region", format!("{:?}", asked.region), format!("{:?}", recorded.region)),
        ("format", format!("{:?}", asked.format), format!("{:?}", recorded.format)),
        ("trigger", format!("{:?}", asked.trigger), format!("{:?}", recorded.trigger)),
    ];
    settings.into_iter().find(|(_, asked, recorded)| asked != recorded).map(
        |(setting, requested, offered)| DeviceError::Refused {
            device: CAMERA.to_owned(),
            setting,
            requested,
            offered: format!("{offered}, as recorded"),
        },
    )
}

impl Camera for ReplayCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        if self.stream.is_some() {
            return Err(Self::out_of_order("apply", "armed"));
        }
        let recorded = &self.shared.recording.applied;
        if let Some(refusal) = first_difference(settings, &recorded.settings) {
            return Err(refusal);
        }
        self.applied = true;
        Ok(recorded.clone())
    }

    fn arm(&mut self, _frames: usize) -> Result<(), DeviceError> {
        if self.stream.is_some() {
            return Err(Self::out_of_order("arm", "armed"));
        }
        if !self.applied {
            return Err(Self::out_of_order("arm", "no settings are applied"));
        }
        self.stream = Some(Stream::default());
        Ok(())
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        let exposure = Duration::from_secs_f64(1e-6 * self.shared.recording.applied.settings.exposure_us);
        let now = self.shared.clock.now();
        let Some(stream) = &mut self.stream else {
            return Err(Self::out_of_order("trigger", "not armed"));
        };
        let start = at.max(now).max(stream.busy_until);
        stream.busy_until = start + exposure;
        stream.pending.push_back((stream.statistics.triggers, start));
        stream.statistics.triggers += 1;
        Ok(start)
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let shared = self.shared.clone();
        let Recording { width, height, bit_depth, frames, applied, .. } = &shared.recording;
        let Some(stream) = &mut self.stream else {
            return Err(Self::out_of_order("next_frame", "not armed"));
        };
        let deadline = shared.clock.now() + timeout;
        let taken = Duration::from_secs_f64(1e-6 * (applied.settings.exposure_us + applied.readout_us));
        let Some(&(trigger, start)) = stream.pending.front().filter(|(_, start)| *start + taken <= deadline)
        else {
            shared.clock.sleep_until(deadline);
            return Err(DeviceError::Timeout {
                device: CAMERA.to_owned(),
                awaited: "frame",
                timeout_ms: timeout.as_millis() as u64,
            });
        };
        stream.pending.pop_front();
        shared.clock.sleep_until(start + taken);
        let slide = shared.slide_at(start);
        let Some(store) = slide.and_then(|slide| frames.get(slide as usize)) else {
            stream.statistics.failed += 1;
            let glass = slide.map_or("black".to_owned(), |slide| format!("slide {slide}"));
            let detail = format!(
                "exposure {trigger} started under {glass}, of which there is no recorded frame; show one of the {} recorded slides",
                frames.len()
            );
            return Err(bad_data(CAMERA, detail));
        };
        stream.statistics.frames += 1;
        Ok(Frame {
            width: *width,
            height: *height,
            bit_depth: *bit_depth,
            stamp: FrameStamp {
                frame_id: trigger,
                trigger,
                exposure_start: start,
                received: start + taken,
                device_time_ns: None,
            },
            store: store.clone(),
        })
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        let stream = self.stream.take().ok_or_else(|| Self::out_of_order("disarm", "not armed"))?;
        Ok(stream.statistics)
    }
}

impl Drop for ReplayCamera {
    fn drop(&mut self) {
        self.shared.camera_open.store(false, Ordering::Release);
    }
}

/// Driver of a recording's projector.
#[derive(Debug, Clone)]
pub struct ReplayProjectors {
    shared: Arc<Shared>,
}

impl ProjectorDriver for ReplayProjectors {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        Ok(listing(PROJECTOR))
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Projector>, DeviceError> {
        take(&self.shared.projector_open, PROJECTOR, serial)?;
        let recording = &self.shared.recording;
        let info = ProjectorInfo {
            driver: "replay".to_owned(),
            model: MODEL.to_owned(),
            serial: PROJECTOR.to_owned(),
            width: recording.projector_size[0],
            height: recording.projector_size[1],
            refresh_period: recording.refresh_period,
            // A recording answers at once and completely.
            timing: Some(ProjectorTiming { latency: Duration::ZERO, settling: Duration::ZERO }),
        };
        Ok(Box::new(ReplayProjector { shared: self.shared.clone(), info, loaded: None }))
    }
}

struct ReplayProjector {
    shared: Arc<Shared>,
    info: ProjectorInfo,
    /// Number of slides.
    loaded: Option<usize>,
}

impl ReplayProjector {
    fn flip(&self, slide: Option<u32>) -> PresentReceipt {
        let period = self.info.refresh_period.as_nanos() as u64;
        let (refresh, flipped) = {
            let mut flips = self.shared.flips();
            let refresh = self.shared.clock.now().0 / period + 1;
            let flipped = Timestamp(refresh * period);
            flips.push_back((flipped, slide));
            if flips.len() > REMEMBERED_FLIPS {
                flips.pop_front();
            }
            (refresh, flipped)
        };
        self.shared.clock.sleep_until(flipped);
        PresentReceipt { slide, flipped, refresh: Some(refresh), method: ReceiptMethod::Recorded }
    }
}

impl Projector for ReplayProjector {
    fn info(&self) -> &ProjectorInfo {
        &self.info
    }

    fn load(&mut self, slides: &[Slide]) -> Result<(), DeviceError> {
        for (number, slide) in slides.iter().enumerate() {
            crate::projector::check_slide(&self.info, number, slide)?;
        }
        let recorded = self.shared.recording.frames.len();
        if slides.len() > recorded {
            return Err(DeviceError::Refused {
                device: PROJECTOR.to_owned(),
                setting: "number of slides",
                requested: slides.len().to_string(),
                offered: format!("{recorded} recorded frames"),
            });
        }
        self.loaded = Some(slides.len());
        Ok(())
    }

    fn show(&mut self, index: u32) -> Result<PresentReceipt, DeviceError> {
        let Some(loaded) = self.loaded else {
            return Err(DeviceError::OutOfOrder {
                device: PROJECTOR.to_owned(),
                operation: "show",
                state: "no slides are loaded",
            });
        };
        if index as usize >= loaded {
            return Err(crate::projector::no_such_slide(&self.info, index, loaded));
        }
        Ok(self.flip(Some(index)))
    }

    fn black(&mut self) -> Result<PresentReceipt, DeviceError> {
        Ok(self.flip(None))
    }
}

impl Drop for ReplayProjector {
    fn drop(&mut self) {
        self.shared.projector_open.store(false, Ordering::Release);
    }
}
