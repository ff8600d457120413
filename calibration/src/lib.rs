//! What a scanner must know of its rig, measured instead of guessed.
//!
//! Slices and structs in, values out: nothing here knows files, clocks, loggers, devices or a runtime. What shows
//! pictures, takes frames and writes files is the program's.

pub mod artefact;
pub mod boards;
pub mod fit;
pub mod noise;
pub mod observation;
pub mod planner;
pub mod polarization;
pub mod rig;
pub mod synchrony;
