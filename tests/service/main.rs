//! The service from outside: a real process on a small twin, spoken to over its socket.

mod calibrations;
mod client;
mod daemon;
mod endings;
mod exports;
mod kills;
mod lifecycle;
#[allow(dead_code, reason = "the long runs print what is measured here")]
mod listing;
mod recovery;
mod refusals;
#[path = "../end_to_end/rig.rs"]
#[allow(dead_code, reason = "the other suite needs more of it")]
mod rig;
mod scans;
mod sessions;
#[allow(dead_code, reason = "the long runs print what is measured here")]
mod soak;
mod storage;
mod streams;
mod tls;
