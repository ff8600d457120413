//! The configuration file as it is written: a plain mirror for serde.

use polscan_drivers::{
    camera::{PixelFormat, TriggerSource},
    sim::RigDescription,
};
use polscan_patterns::Mode;
use serde::{Deserialize, Serialize};

/// All tables of the file. `config/default.toml` documents and fills every key but `[sim]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Raw {
    /// `[api]`
    pub api: Api,
    /// `[store]`
    pub store: Store,
    /// `[scan]`
    pub scan: Scan,
    /// `[rig]`
    pub rig: Rig,
    /// `[volume]`
    pub volume: Volume,
    /// `[camera]`
    pub camera: Camera,
    /// `[projector]`
    pub projector: Projector,
    /// `[capture]`
    pub capture: Capture,
    /// `[decode]`
    pub decode: Decode,
    /// `[replay]`
    pub replay: Replay,
    /// `[sim]`: the simulated rig, needed by the `sim` drivers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sim: Option<RigDescription>,
}

/// `[api]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Api {
    /// Address and port.
    pub listen: String,
    /// File of tokens, relative to the configuration file; empty for none.
    pub tokens: String,
    /// Certificate in PEM form, relative to the configuration file; empty for none.
    pub tls_certificate: String,
    /// Its key, likewise.
    pub tls_key: String,
    /// Requests at once.
    pub concurrency: usize,
    /// Streams at once.
    pub streams: usize,
    /// Longest wait for a scan in seconds.
    pub wait_limit_s: f64,
    /// Seconds that the running scan has to come to its end when the service is stopped.
    pub stop_grace_s: f64,
    /// How long idempotency keys are kept, in hours.
    pub idempotency_hours: f64,
}

/// `[store]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Store {
    /// Folder of the scans.
    pub dir: String,
    /// Most that the scans may take in GiB, 0 = no limit.
    pub quota_gib: f64,
    /// Space to leave free in GiB.
    pub min_free_gib: f64,
    /// Days to keep a scan, 0 = for ever.
    pub keep_days: f64,
    /// Whether the oldest scans make room for new ones.
    pub delete_oldest: bool,
}

/// `[scan]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scan {
    /// Mode where none is asked for.
    pub mode: Mode,
    /// Scans that may wait.
    pub queue_capacity: usize,
    /// Whether scans queued before a restart run by themselves.
    pub resume_queue: bool,
}

/// `[rig]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rig {
    /// Name.
    pub name: String,
    /// Path, relative to the configuration file.
    pub calibration: String,
    /// Stereo results of other tools: whether the first (left) device is the projector.
    pub calibration_projector_left: bool,
    /// Millimetres per unit of length in the calibrations of other tools.
    pub calibration_unit_mm: f64,
    /// H over V that the rig shows on metal; 0 is unknown.
    pub extinction_ratio: f64,
    /// File of the camera's measured noise, relative to the configuration file; empty for none.
    pub noise: String,
    /// File of the projector's measured timing, likewise.
    pub sync: String,
    /// File of the measured polarization, likewise.
    pub polarization: String,
}

/// `[volume]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// Nearest z in mm.
    pub near_mm: f64,
    /// Farthest z in mm.
    pub far_mm: f64,
}

/// Family of devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DeviceDriver {
    /// No device.
    None,
    /// The simulated rig.
    Sim,
    /// A recorded bundle, given again.
    Replay,
    /// GenICam cameras by the Aravis library.
    Aravis,
    /// Cameras of the kernel's video interface.
    V4l2,
    /// A full-screen window; projectors only.
    Window,
}

impl DeviceDriver {
    /// Name in the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Sim => "sim",
            Self::Replay => "replay",
            Self::Aravis => "aravis",
            Self::V4l2 => "v4l2",
            Self::Window => "window",
        }
    }
}

/// How USB cameras of the driver `aravis` send.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum UsbMode {
    /// One transfer after the other.
    Sync,
    /// Many transfers at once.
    Async,
}

/// `[replay]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Replay {
    /// Bundle, relative to the configuration file.
    pub bundle: String,
}

/// `[camera]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Camera {
    /// Driver.
    pub driver: DeviceDriver,
    /// Serial number, empty for the only one.
    pub serial: String,
    /// Exposure time in microseconds.
    pub exposure_us: f64,
    /// Gain in decibel.
    pub gain_db: f64,
    /// Exponent of the response.
    pub gamma: f64,
    /// Sample format.
    pub format: PixelFormat,
    /// Part of the sensor; empty is all of it.
    pub region: RegionTable,
    /// What starts an exposure.
    pub trigger: TriggerSource,
    /// Settings that the camera may have otherwise.
    pub allow: Vec<String>,
    /// The camera's own value for `gain_db`, where its unit is another.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gain_raw: Option<f64>,
    /// Black level in the camera's own unit, where it is to be set.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub black_level: Option<f64>,
    /// How USB cameras send.
    pub usb_mode: UsbMode,
    /// How much later than its trigger an exposure starts at the most, where it was measured.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub trigger_latency_ms: Option<f64>,
    /// Exposure time of a camera without a control for it, in microseconds.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub fixed_exposure_us: Option<f64>,
    /// Columns and rows of the frames of a V4L2 camera, empty = the most.
    pub frame_size: Vec<u32>,
    /// Frames of a V4L2 camera to skip.
    pub skip_frames: u32,
}

/// `region` of `[camera]`: all four keys or none.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RegionTable {
    /// First column.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub x: Option<u32>,
    /// First row.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub y: Option<u32>,
    /// Columns.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width: Option<u32>,
    /// Rows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<u32>,
}

/// `[projector]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Projector {
    /// Driver.
    pub driver: DeviceDriver,
    /// Serial number, empty for the only one.
    pub serial: String,
    /// Letters of the horizontally polarized channels.
    pub horizontal: String,
    /// Letters of the vertically polarized channels.
    pub vertical: String,
    /// Refreshes per pattern, 0 = least.
    pub hold_refreshes: u32,
    /// Flip to trigger in ms, 0 = as timing demands.
    pub trigger_delay_ms: f64,
    /// Columns and rows of the display's mode, empty = any.
    pub size: Vec<u32>,
    /// Its refreshes per second, 0 = any.
    pub refresh_hz: f64,
    /// X server of the window, empty = that of DISPLAY.
    pub x11_display: String,
    /// Socket of a projector process that runs already, empty = start one.
    pub socket: String,
}

/// `[capture]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Capture {
    /// Most re-takes of one pair.
    pub retakes_per_pair: u32,
    /// Most re-takes of a scan.
    pub retakes_per_scan: u32,
}

/// `[decode]`
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Decode {
    /// Lit gate in sigma.
    pub lit_sigma: f64,
    /// Soft-bit gate in sigma.
    pub soft_bit_sigma: f64,
    /// Edge snap in projector px.
    pub snap_px: f64,
    /// Edges in a local fit.
    pub fit_edges: usize,
    /// Row gate in projector px.
    pub row_gate_px: f64,
}
