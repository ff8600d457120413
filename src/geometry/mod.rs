//! Cameras, projectors and calibrations. Pure, but for [`Calibration`] files, which are read from bytes.

mod calibration;
mod lens;

pub use calibration::{Calibration, Pose, Projector, Quality};
pub use lens::Lens;
