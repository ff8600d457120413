//! Cameras and projectors: the seam that the scanner is written against, and the drivers behind it.
//!
//! A *driver* finds and opens devices, a *device* operates. The crate knows neither patterns nor the scanner: a
//! projector is given slides, a camera returns frames, and each carries the evidence of when it happened.

pub mod aravis;
pub mod camera;
pub mod clock;
pub mod error;
pub mod frame;
pub mod projector;
pub mod replay;
pub mod sim;
pub mod v4l2;
pub mod window;
