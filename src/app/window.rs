//! A window on a display as the projector.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use polscan_drivers::{
    clock::Clock,
    projector::ProjectorDriver,
    window::{self, WindowOptions, WindowProjectors},
};

pub use polscan_drivers::window::ChildError as WindowError;

use crate::config::{DeviceDriver, Settings};

/// The driver of windows, where the settings ask for one.
pub(super) fn projectors(settings: &Settings, clock: &Arc<dyn Clock>) -> Option<Box<dyn ProjectorDriver>> {
    let raw = &settings.raw.projector;
    if raw.driver != DeviceDriver::Window {
        return None;
    }
    let options = WindowOptions {
        socket: (!raw.socket.is_empty()).then(|| PathBuf::from(&raw.socket)),
        x11_display: (!raw.x11_display.is_empty()).then(|| raw.x11_display.clone()),
        size: <[u32; 2]>::try_from(raw.size.as_slice()).ok(),
        refresh_hz: (raw.refresh_hz > 0.0).then_some(raw.refresh_hz),
        ..WindowOptions::default()
    };
    Some(Box::new(WindowProjectors::new(options, clock.clone())))
}

/// Owns the projector's window in this process, for the program that started it or for those who connect to `listen`.
pub fn serve_projector(listen: Option<&Path>) -> Result<(), WindowError> {
    window::run(listen)
}
