//! Cameras, projectors and calibrations. Pure, but for [`Calibration`] files, which are read from bytes.

mod calibration;
mod file;
mod lens;
mod rays;
mod triangulate;

pub use calibration::{Calibration, Pose, Projector, Quality, SizeError};
pub use file::{CalibrationError, MAX_BYTES, ReadHints};
pub use lens::Lens;
pub use rays::RayTable;
pub(crate) use triangulate::{LANES, Lane, Measurements, Solutions};
pub use triangulate::{Measurement, Solution, TriangulateError, Triangulator};

#[cfg(test)]
pub(crate) mod fixtures;
