//! A real projector: a full-screen window in a process of its own.
//!
//! X server, GPU driver and window may die at any moment, and a GPU driver must not take cameras and interface with it.
//! So the window belongs to another process, `polscan projector` ([`run`]), to which this one speaks over a Unix socket
//! ([`protocol`]). [`WindowProjectors`] starts that process, or connects to one that a unit of the seat's session
//! started, and starts it again after it ended.
//!
//! What must hold for stripes to be what the code says is checked when the window opens, and again before a set of
//! slides: the size of the display's mode, of the window and of the surface are one and the same, nothing scales,
//! rotates or covers it, and the surface passes on code values as they are.

use std::{path::PathBuf, sync::Arc, time::Duration};

use crate::{
    camera::Listing,
    clock::Clock,
    error::DeviceError,
    projector::{Projector, ProjectorDriver},
};

mod child;
mod client;
mod displays;
mod edid;
mod process;
pub mod protocol;
mod supervise;
mod wire;

pub use child::{ChildError, run};

use client::WindowProjector;

/// Name of the driver.
const DRIVER: &str = "window";

/// How to get at the window.
#[derive(Debug, Clone, PartialEq)]
pub struct WindowOptions {
    /// Socket of a process that runs already; `None` to start one.
    pub socket: Option<PathBuf>,
    /// Program to start, which must know the command `projector`.
    pub program: PathBuf,
    /// X server, as in DISPLAY; `None` for the one that DISPLAY names.
    pub x11_display: Option<String>,
    /// Mode that the display must have, columns and rows; `None` for any.
    pub size: Option<[u32; 2]>,
    /// Refresh rate that it must have in Hz; `None` for any.
    pub refresh_hz: Option<f64>,
    /// How long its answers are waited for.
    pub patience: Patience,
}

impl Default for WindowOptions {
    fn default() -> Self {
        Self {
            socket: None,
            // The very program that runs, even where another version has taken its place since.
            program: PathBuf::from("/proc/self/exe"),
            x11_display: None,
            size: None,
            refresh_hz: None,
            patience: Patience::default(),
        }
    }
}

/// Longest waits for answers of the process with the window. One that is late is ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Patience {
    /// From its start to the open window.
    pub open: Duration,
    /// For a set of slides.
    pub load: Duration,
    /// For a picture.
    pub show: Duration,
}

impl Default for Patience {
    fn default() -> Self {
        let seconds = Duration::from_secs;
        Self { open: seconds(20), load: seconds(10), show: seconds(5) }
    }
}

/// Driver of full-screen windows.
#[derive(Debug, Clone)]
pub struct WindowProjectors {
    options: WindowOptions,
    clock: Arc<dyn Clock>,
}

impl WindowProjectors {
    /// A driver whose receipts are in the time of `clock`, which must be monotonic.
    pub fn new(options: WindowOptions, clock: Arc<dyn Clock>) -> Self {
        Self { options, clock }
    }
}

impl ProjectorDriver for WindowProjectors {
    fn list(&self) -> Result<Vec<Listing>, DeviceError> {
        let lines = match &self.options.socket {
            None => displays::list(self.options.x11_display.as_deref())
                .map_err(|fault| client::error("X server", fault)),
            Some(_) => client::list(&self.options),
        };
        Ok(lines?
            .into_iter()
            .map(|line| Listing {
                driver: DRIVER.to_owned(),
                model: line.model,
                serial: line.connector,
                unusable: Some(line.unusable).filter(|reason| !reason.is_empty()),
            })
            .collect())
    }

    fn open(&self, serial: Option<&str>) -> Result<Box<dyn Projector>, DeviceError> {
        let projector = WindowProjector::open(self.options.clone(), self.clock.clone(), serial)?;
        Ok(Box::new(projector))
    }
}
