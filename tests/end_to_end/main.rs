//! The program from outside: commands in, folders and exit codes out, on a small copy of the paper's rig.

mod acceptance;
mod bad_input;
mod calibrate;
mod captures_of_the_twin;
#[path = "../faults/cases.rs"]
#[allow(dead_code, reason = "the suite of faults needs more of it")]
mod cases;
mod compare;
mod devices;
mod export;
mod faults;
mod patterns;
mod projection;
mod refusals;
#[allow(dead_code, reason = "the closed loop needs more of it")]
mod rig;
mod rig_calibration;
