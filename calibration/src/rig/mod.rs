//! Both intrinsics, distortions and the pose between camera and projector, from views of a board.
//!
//! [`calibrate`] takes what was found in the pictures ([`View`](crate::observation::View)) and a [`Setup`], and gives
//! either a [`Calibrated`] with its [`Report`], or a [`Refused`] that names every reason. There is nothing in between:
//! a solution that did not come to rest, or that a gate refused, never becomes a calibration. [`guidance`] says while
//! views are taken what is still missing.

mod adjust;
mod calibrate;
mod coverage;
mod estimate;
mod homography;
mod initial;
mod judge;
mod model;
mod precheck;
mod report;
mod sample;
mod setup;

pub use calibrate::calibrate;
pub use coverage::{Cells, Coverage, Guidance, guidance};
pub use report::{
    Calibrated, Check, Correlation, Flatness, HeldOut, Parameter, Refusal, Refused, Report, ViewReport,
};
pub use setup::{Gates, LensSetup, PrincipalPrior, Setup};

#[cfg(test)]
mod tests;
