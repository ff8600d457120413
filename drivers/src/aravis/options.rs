//! What a user can say about a camera beyond the settings that every camera has.

use std::time::Duration;

/// How bulk data of a USB camera is received.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum UsbMode {
    /// By one call after the other: what the library of Debian 12 does well.
    #[default]
    Sync,
    /// By many transfers at once, from library version 0.8.29 on; before that it is refused.
    Async,
}

/// Options of the driver.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Options {
    /// Settings that the camera may have otherwise, by name, such as `gamma`.
    pub allow: Vec<String>,
    /// Value of the camera's own gain that stands for `gain_db`, for cameras whose gain is not in decibel.
    pub gain_raw: Option<f64>,
    /// Black level in the camera's own unit; `None` leaves it as it is.
    pub black_level: Option<f64>,
    /// How USB cameras send.
    pub usb_mode: UsbMode,
    /// How much later than its trigger command an exposure starts at the most, where it was measured.
    pub trigger_latency: Option<Duration>,
    /// Whether frames of GigE cameras are taken by a packet socket where the process may open one. It loses less, but
    /// until the library has set its filter it sees what passes on any network: such a packet is then taken for a frame
    /// whose number all frames of the stream are too old for.
    pub packet_socket: bool,
}
