//! The closed loop: the ordinary service shows patterns in the real window on an X server, the ordinary camera driver
//! takes frames from a GigE Vision camera over the loopback network, and that camera sees what the twin's optics make of
//! the pixels on the screen at the moment of each exposure.

#[path = "../service/client.rs"]
#[allow(dead_code, reason = "the service's own suite needs more of it")]
mod client;
#[path = "../service/daemon.rs"]
#[allow(dead_code, reason = "the service's own suite needs more of it")]
mod daemon;
mod deaths;
mod measure;
#[path = "../end_to_end/rig.rs"]
#[allow(dead_code, reason = "the other suite needs more of it")]
mod rig;
mod scans;
mod set_up;
mod soak;
mod stage;
#[path = "../window/xvfb.rs"]
#[allow(dead_code, reason = "the window's own suite needs more of it")]
mod xvfb;
