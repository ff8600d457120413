//! The replay of a recorded scan as a camera and a projector.
//!
//! Frame `i` of a [`Recording`] is what the camera saw while picture `i` was on the glass: an exposure is answered with
//! the frame of the picture that the replaying projector showed when it started. Slides are known by their content, so
//! that takes can be repeated, and a part of the recording shown, in any order.
//! Nothing is known here of files: the caller brings the pixels.

mod camera;
mod projector;

use std::{
    collections::VecDeque,
    fmt,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

pub use camera::ReplayCameras;
pub use projector::ReplayProjectors;

use crate::{
    camera::{AppliedSettings, Listing},
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::{PixelStore, Pixels},
    projector::Slide,
};

const CAMERA: &str = "replay-camera-0";
const PROJECTOR: &str = "replay-projector-0";
const MODEL: &str = "recording";
/// Flips that are remembered for exposures that have not been asked for yet.
const REMEMBERED_FLIPS: usize = 4096;
/// No camera exposes for an hour.
const LONGEST_US: f64 = 3.6e9;

/// Frames of one scan, all of one size.
#[derive(Clone)]
pub struct Recording {
    /// Width of the frames in pixels.
    pub width: u32,
    /// Height of the frames in pixels.
    pub height: u32,
    /// Significant bits of a sample.
    pub bit_depth: u8,
    /// Row-major samples; frame `i` was taken under picture `i`.
    pub frames: Vec<Arc<dyn PixelStore>>,
    /// Pictures, as many as frames. Of equal ones the first to be loaded is the first that was recorded.
    pub pictures: Vec<Slide>,
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
    /// When which recorded picture was flipped, in order.
    flips: Mutex<VecDeque<(Timestamp, Option<u32>)>>,
    camera_open: AtomicBool,
    projector_open: AtomicBool,
}

impl Shared {
    fn flips(&self) -> MutexGuard<'_, VecDeque<(Timestamp, Option<u32>)>> {
        self.flips.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Recorded picture on the glass at a time.
    fn slide_at(&self, at: Timestamp) -> Option<u32> {
        self.flips().iter().rev().find(|(flipped, _)| *flipped <= at).and_then(|(_, slide)| *slide)
    }
}

/// A duration that was checked to be one.
fn microseconds(us: f64) -> Duration {
    Duration::try_from_secs_f64(1e-6 * us).unwrap_or_default()
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
        if recording.pictures.len() != recording.frames.len() {
            let (pictures, frames) = (recording.pictures.len(), recording.frames.len());
            return Err(bad_data(CAMERA, format!("there are {frames} frames of {pictures} pictures")));
        }
        for (name, us) in [
            ("exposure_us", recording.applied.settings.exposure_us),
            ("readout_us", recording.applied.readout_us),
        ] {
            if !(0.0..=LONGEST_US).contains(&us) {
                return Err(bad_data(
                    CAMERA,
                    format!("the recorded {name} is {us}, must be 0 to {LONGEST_US}"),
                ));
            }
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
