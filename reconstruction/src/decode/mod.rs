//! From frames to projector coordinates. Pure: planes and settings in, maps out; no files, clocks or logs.
//!
//! [`Accumulator`] takes frames in any order as they arrive and keeps handles to them, so that memory holds each
//! frame once; [`Accumulator::finish`] walks the image in bands of rows and touches each band of all planes once.

mod accumulate;
mod contrast;
mod edge_image;
mod gates;
mod limits;
mod noise;
#[cfg(test)]
mod oracle;
mod pair_sum;
mod plan;
mod sample;
#[cfg(feature = "synthetic")]
mod stages;
mod subpixel;
#[cfg(any(test, feature = "synthetic"))]
pub mod synth;
mod types;
mod whole;
mod words;

pub use accumulate::Accumulator;
pub use contrast::{Contrast, contrast};
pub use edge_image::{ImageEdge, edges_of_image};
pub use gates::BoundaryCheck;
pub use pair_sum::{PairContext, estimate_noise, pair_residual};
#[cfg(feature = "synthetic")]
pub use stages::each_stage;
pub use types::{
    AxisMap, CameraResponse, Class, DecodeError, DecodeSettings, Decoded, NoiseModel, PairResidual, Plane,
    PlaneSource, SharedPlane, Thresholds,
};

#[cfg(test)]
mod tests;
