//! Measuring what a rig is like: shows pictures, takes frames and hands them to the parts of `calibration` that compute.
//! No terminal and no files: commands and service come through here.

mod bench;
pub mod files;
pub mod noise;
pub mod polarization;
pub mod sync;

pub use bench::Bench;
