//! Calibrations of the rig that need no board: measured, written into a folder, accepted or refused. No terminal: command
//! line and service come through here.

pub mod noise;
pub mod output;
pub mod polarization;
pub mod sync;

pub use output::{Outcome, Output, Summary};
