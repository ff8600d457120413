//! The camera seam.

use std::{collections::BTreeMap, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{clock::Timestamp, error::DeviceError, frame::Frame};

/// Rectangle of the sensor in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Region {
    /// First column.
    pub x: u32,
    /// First row.
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// Sample format on the wire; frames always hold unpacked samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PixelFormat {
    /// 8 bits.
    Mono8,
    /// 10 bits, unpacked.
    Mono10,
    /// 12 bits, unpacked or packed as the camera prefers.
    Mono12,
    /// 16 bits.
    Mono16,
}

impl PixelFormat {
    /// Significant bits of a sample.
    pub fn bit_depth(self) -> u8 {
        match self {
            Self::Mono8 => 8,
            Self::Mono10 => 10,
            Self::Mono12 => 12,
            Self::Mono16 => 16,
        }
    }
}

/// What starts an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TriggerSource {
    /// [`Camera::trigger`].
    Software,
    /// An electrical edge on the camera's line 0; [`Camera::trigger`] only announces that it will come.
    Line0,
}

/// Settings that a user may let a camera have otherwise than asked, by the names that refusals give them. Format, region,
/// exposure and trigger are not among them: without these there is no scan.
pub const ALLOWABLE: [&str; 20] = [
    "gain_db",
    "gamma",
    "black_level",
    "black_level_auto",
    "exposure_auto",
    "gain_auto",
    "exposure_mode",
    "frame_rate",
    "acquisition_mode",
    "trigger_overlap",
    "trigger_delay",
    "binning",
    "decimation",
    "isp",
    "sharpening",
    "sharpening_auto",
    "saturation",
    "lut",
    "reverse_x",
    "reverse_y",
];

/// What the scanner wants of a camera. Everything that would bend a linear response is off and has no setting.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraSettings {
    /// Exposure time in microseconds.
    pub exposure_us: f64,
    /// Gain in decibel; 0 is a factor of 1.
    pub gain_db: f64,
    /// Exponent of the response; 1 is linear.
    pub gamma: f64,
    /// Region of the sensor; `None` is the whole sensor.
    pub region: Option<Region>,
    /// Sample format.
    pub format: PixelFormat,
    /// What starts an exposure.
    pub trigger: TriggerSource,
}

/// What the camera has after [`Camera::apply`], read back from it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AppliedSettings {
    /// Settings as the camera reports them.
    #[serde(flatten)]
    pub settings: CameraSettings,
    /// Width of the frames in pixels.
    pub width: u32,
    /// Height of the frames in pixels.
    pub height: u32,
    /// Level of a dark pixel in DN, where the camera knows it.
    pub black_level_dn: Option<f64>,
    /// Largest value a sample can have, in DN.
    pub saturation_dn: u16,
    /// Time from the end of exposure until the frame has arrived, in microseconds, as far as it is known.
    pub readout_us: f64,
    /// Noise of the camera where the driver knows it.
    pub noise: Option<CameraNoise>,
}

/// Noise of a linear camera: `var(I) = read_noise_dn^2 + gain_dn_per_electron * I + 1/12` with I in DN above black.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct CameraNoise {
    /// System gain K in DN per electron.
    pub gain_dn_per_electron: f64,
    /// Temporal dark noise in DN.
    pub read_noise_dn: f64,
}

/// Who a camera is and what it can do.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraInfo {
    /// Driver that opened it: `sim`, `replay`, ...
    pub driver: String,
    /// Maker and model.
    pub model: String,
    /// Serial number, or what identifies it among its kind.
    pub serial: String,
    /// Columns of the whole sensor.
    pub sensor_width: u32,
    /// Rows of the whole sensor.
    pub sensor_height: u32,
    /// Whether [`Camera::trigger`] starts exactly one exposure. A free-running camera answers with the first frame that
    /// was exposed wholly after the call.
    pub triggered: bool,
    /// Whether the next picture may be flipped while a frame is read out: `None` where the end of an exposure is known
    /// by the arrival of its frame only.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub overlap: Option<Overlap>,
}

/// What a camera promises that takes a trigger while it reads out the frame before.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Overlap {
    /// How much later than [`Camera::trigger`] says an exposure may start.
    #[serde(rename = "latency_ms", with = "crate::projector::milliseconds")]
    pub latency: Duration,
    /// Whether the stamps of frames say when their exposures really began, rather than when they were asked for.
    pub stamped: bool,
}

/// The exposures that a capture means to take: the loaded slides from the first to the last, each once.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Schedule {
    /// Number of slides.
    pub slides: usize,
    /// Refreshes from one flip to the next.
    pub hold_refreshes: u32,
    /// From flip to the start of exposure.
    pub trigger_delay: Duration,
}

/// Counters of a stream since it was armed.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct StreamStatistics {
    /// Triggers sent.
    pub triggers: u64,
    /// Whole frames delivered.
    pub frames: u64,
    /// Frames that arrived damaged or not at all.
    pub failed: u64,
    /// Counters of the driver's own, by name.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub counters: BTreeMap<String, u64>,
}

/// A camera. Calls come in this order, from one thread: `apply`, then any number of rounds of `rehearse`, `arm`, pairs of `trigger`
/// and `next_frame`, `disarm`. All calls may block up to a stated time; none is called from an async task.
pub trait Camera: Send {
    /// Identity and abilities.
    fn info(&self) -> &CameraInfo;

    /// Whether it is still there, as far as is known without asking it: what is lost while nobody uses it is opened again
    /// before somebody does.
    fn alive(&self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Applies all settings and reads each back. Refuses, with all differences, what it cannot honour exactly
    /// (exposure within the camera's own step). Only while disarmed.
    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError>;

    /// Gets ready for the frames of `schedule`, one by one: called before `arm`, after the slides were loaded, until it
    /// says that none is left. A device that has nothing to get ready says so at once. What comes otherwise than
    /// scheduled is delivered all the same.
    fn rehearse(&mut self, schedule: &Schedule) -> Result<usize, DeviceError> {
        let _ = schedule;
        Ok(0)
    }

    /// Prepares buffers and starts the stream; `frames` is how many will be asked for, a hint.
    fn arm(&mut self, frames: usize) -> Result<(), DeviceError>;

    /// Starts one exposure at `at` or as soon after it as the device can, and returns when it starts (started). Waits
    /// on the rig's clock where the device cannot schedule.
    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError>;

    /// The next frame in order of exposure. `Timeout` leaves the stream usable; a frame that arrives later is still
    /// delivered by the next call, with its own stamp.
    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError>;

    /// Stops the stream, discards what is still under way, and returns the counters since `arm`.
    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError>;
}

/// A camera or display that was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Listing {
    /// Driver that found it.
    pub driver: String,
    /// Maker and model.
    pub model: String,
    /// Serial number or the like, to select it by.
    pub serial: String,
    /// `None` where it can be used, else why not and what to do.
    pub unusable: Option<String>,
}

/// Finds and opens cameras of one family.
pub trait CameraDriver {
    /// All cameras of the family, usable or not.
    fn list(&self) -> Result<Vec<Listing>, DeviceError>;

    /// Opens the camera with `serial`, or the only one there is.
    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Camera>, DeviceError>;
}
