//! From coded frames to a calibrated point cloud: `decode -> geometry -> cloud`.
//!
//! Slices and structs in, values out: nothing here knows files, clocks, loggers, devices or a runtime.

pub mod cloud;
pub mod decode;
pub mod geometry;
pub mod grid;
mod simd;
