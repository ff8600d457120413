//! The scanner: from pattern to point cloud. Data flows one way:
//! `patterns -> sequencer(projector, camera) -> frames -> decode -> geometry -> cloud -> report, store`.

pub mod api;
pub mod app;
pub mod calibrate;
pub mod cli;
pub mod commands;
pub mod compare;
pub mod config;
pub mod doctor;
pub mod engine;
mod evidence;
pub mod export;
pub mod measure;
pub mod pipeline;
pub mod report;
pub mod scanner;
pub mod sequencer;
pub mod store;
pub mod truth;
pub mod verify;

pub use polscan_calibration as calibration;
pub use polscan_reconstruction::{cloud, decode, geometry, grid};
