//! Pattern sequences of the scanner: which pictures a projector of a given size shows for each mode, in which
//! order, and what word every projector column and row carries.
//!
//! The crate is a leaf: it knows no device, no file and no clock. Bits are numbered as in the paper: bit 0 is
//! the most significant one ("pattern 1").

mod code;
mod raster;
mod sequence;

pub use code::{AxisCode, CodeError, MAX_BITS, MAX_SIDE};
pub use raster::{ChannelSet, Picture, Polarization, PolarizationError, Raster, Rgb};
pub use sequence::{Axis, Mode, ProjectorSize, Role, Sequence};
