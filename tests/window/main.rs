//! The real window under Xvfb, with a GPU that is a processor (Mesa's lavapipe): what is on the screen, what becomes of
//! it when things die, and what is said of it.

mod commands;
mod deaths;
mod pixels;
mod socket;
mod xvfb;

use std::{path::PathBuf, sync::Arc, time::Duration};

use polscan_drivers::{
    clock::{Clock, MonotonicClock},
    error::DeviceError,
    projector::{Projector, ProjectorDriver, Slide},
    window::{Patience, WindowOptions, WindowProjectors},
};
use xvfb::Xvfb;

/// The program under test.
const PROGRAM: &str = env!("CARGO_BIN_EXE_polscan");

/// A driver of windows on `xvfb`.
fn options(xvfb: &Xvfb) -> WindowOptions {
    WindowOptions {
        program: PathBuf::from(PROGRAM),
        x11_display: Some(xvfb.display()),
        patience: Patience { show: Duration::from_secs(2), ..Patience::default() },
        ..WindowOptions::default()
    }
}

fn clock() -> Arc<dyn Clock> {
    Arc::new(MonotonicClock::start())
}

fn try_open(options: WindowOptions) -> Result<Box<dyn Projector>, DeviceError> {
    WindowProjectors::new(options, clock()).open(None)
}

fn open(xvfb: &Xvfb) -> Box<dyn Projector> {
    try_open(options(xvfb)).expect("a window")
}

/// A slide of one colour, and the screen that it makes.
fn uniform(xvfb: &Xvfb, value: [u8; 3]) -> (Slide, Vec<u8>) {
    let (x, root) = xvfb.connect();
    use x11rb::protocol::xproto::ConnectionExt as _;
    let size = x.get_geometry(root).expect("a request").reply().expect("a size");
    (Slide::Uniform(value), value.repeat(usize::from(size.width) * usize::from(size.height)))
}
