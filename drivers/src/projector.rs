//! The projector seam.

use std::{sync::Arc, time::Duration};

use serde::{Deserialize, Serialize};

use crate::{camera::Listing, clock::Timestamp, error::DeviceError};

/// Code values of one pixel: red, green, blue.
pub type Rgb = [u8; 3];

/// One picture of the projector's native size, in its most compact form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Slide {
    /// One value everywhere.
    Uniform(Rgb),
    /// One value per column.
    Columns(Arc<[Rgb]>),
    /// One value per row.
    Rows(Arc<[Rgb]>),
    /// Row-major values of all pixels.
    Full(Arc<[Rgb]>),
}

/// How the time of a receipt is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ReceiptMethod {
    /// By the simulated rig, which is its own truth.
    Simulated,
    /// By the X server's Present extension.
    X11Present,
    /// By Wayland presentation feedback.
    WaylandPresentation,
    /// Not known: the call returned, no more.
    Guessed,
    /// Read from a recording.
    Recorded,
}

/// Evidence of what was sent to the glass and when.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PresentReceipt {
    /// Index of the slide in the loaded set, `None` for black.
    pub slide: Option<u32>,
    /// When the picture was flipped to scan-out, on the rig's clock. Light follows after the projector's latency.
    #[serde(rename = "flipped_ns")]
    pub flipped: Timestamp,
    /// Number of the refresh at which it was flipped, where it is known.
    pub refresh: Option<u64>,
    /// How the above is known.
    pub method: ReceiptMethod,
}

/// Who a projector is and how it behaves in time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProjectorInfo {
    /// Driver that opened it.
    pub driver: String,
    /// Maker and model.
    pub model: String,
    /// Serial number, or what identifies it among its kind.
    pub serial: String,
    /// Native columns.
    pub width: u32,
    /// Native rows.
    pub height: u32,
    /// Time between refreshes.
    #[serde(rename = "refresh_period_ms", with = "milliseconds")]
    pub refresh_period: Duration,
    /// From flip to first light, and until the picture has settled, where it has been measured or is known.
    pub timing: Option<ProjectorTiming>,
    /// What is known of the way to a real display.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub display: Option<DisplayState>,
}

/// The way of a picture to a real display.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct DisplayState {
    /// GPU and its driver.
    pub adapter: String,
    /// Format of the surface.
    pub format: String,
    /// By what flips are known.
    pub receipts: ReceiptMethod,
    /// What a person should know: why flips are only guessed, what bends code values.
    pub findings: Vec<String>,
    /// The process that owns the window.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub process: Option<WindowProcess>,
}

/// The process that owns a projector's window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WindowProcess {
    /// Its number; `None` where it was not started by this program but runs in the seat's session.
    pub pid: Option<u32>,
    /// How often it ended and was started again since the projector was opened.
    pub restarts: u32,
}

/// Durations in files: milliseconds as a number.
pub(crate) mod milliseconds {
    use std::time::Duration;

    use serde::{Deserialize, Deserializer, Serializer, de::Error};

    pub(crate) fn serialize<S: Serializer>(duration: &Duration, out: S) -> Result<S::Ok, S::Error> {
        out.serialize_f64(duration.as_secs_f64() * 1e3)
    }

    pub(crate) fn deserialize<'de, D: Deserializer<'de>>(input: D) -> Result<Duration, D::Error> {
        let ms = f64::deserialize(input)?;
        Duration::try_from_secs_f64(ms * 1e-3).map_err(|error| D::Error::custom(format!("{ms} ms: {error}")))
    }
}

/// Measured delays of a projector.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ProjectorTiming {
    /// From flip to first light.
    #[serde(rename = "latency_ms", with = "milliseconds")]
    pub latency: Duration,
    /// From first light until the residue of the previous picture is below 0.1 % of full scale.
    #[serde(rename = "settling_ms", with = "milliseconds")]
    pub settling: Duration,
}

/// A projector, driven from one thread.
pub trait Projector: Send {
    /// Identity, native size and timing.
    fn info(&self) -> &ProjectorInfo;

    /// Whether it is still there, as far as is known without asking it anything.
    fn alive(&mut self) -> Result<(), DeviceError> {
        Ok(())
    }

    /// Replaces the set of slides. Refuses slides that are not of the native size.
    fn load(&mut self, slides: &[Slide]) -> Result<(), DeviceError>;

    /// Shows slide `index` of the loaded set from the next refresh on. Returns when the flip is done or certain, with
    /// its receipt; waits at most a few refreshes.
    fn show(&mut self, index: u32) -> Result<PresentReceipt, DeviceError>;

    /// Shows black. Works with nothing loaded, and after errors: it is what a cancelled scan leaves behind.
    fn black(&mut self) -> Result<PresentReceipt, DeviceError>;
}

/// Finds and opens projectors of one family.
pub trait ProjectorDriver {
    /// All projectors of the family, usable or not.
    fn list(&self) -> Result<Vec<Listing>, DeviceError>;

    /// Opens the projector with `serial`, or the only one there is.
    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Projector>, DeviceError>;
}

/// Refuses a slide that is not of the projector's native size.
pub(crate) fn check_slide(info: &ProjectorInfo, number: usize, slide: &Slide) -> Result<(), DeviceError> {
    let (width, height) = (info.width as usize, info.height as usize);
    let (kind, has, needs) = match slide {
        Slide::Uniform(_) => return Ok(()),
        Slide::Columns(values) => ("columns", values.len(), width),
        Slide::Rows(values) => ("rows", values.len(), height),
        Slide::Full(values) => ("pixels", values.len(), width * height),
    };
    if has == needs {
        return Ok(());
    }
    Err(DeviceError::Refused {
        device: info.serial.clone(),
        setting: "slide size",
        requested: format!("{has} {kind} in slide {number}"),
        offered: format!("{needs} ({width} x {height})"),
    })
}

/// The refusal of a slide number that is not loaded.
pub(crate) fn no_such_slide(info: &ProjectorInfo, index: u32, loaded: usize) -> DeviceError {
    DeviceError::Refused {
        device: info.serial.clone(),
        setting: "slide number",
        requested: index.to_string(),
        offered: format!("{loaded} slides, numbered from 0"),
    }
}
