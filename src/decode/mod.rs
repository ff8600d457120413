//! From frames to projector coordinates. Pure: planes and settings in, maps out; no files, clocks or logs.
//!
//! [`Accumulator`] takes frames in any order as they arrive and keeps handles to them, so that memory holds each
//! frame once; [`Accumulator::finish`] walks the image in bands of rows and touches each band of all planes once.

mod types;

pub use types::{
    AxisMap, CameraResponse, Class, DecodeError, DecodeSettings, Decoded, NoiseModel, PairResidual, Plane,
    PlaneSource, SharedPlane, Thresholds,
};
