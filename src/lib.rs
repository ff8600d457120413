//! The scanner: from pattern to point cloud. Data flows one way:
//! `patterns -> sequencer(projector, camera) -> frames -> decode -> geometry -> cloud -> report, store`.

pub mod cloud;
pub mod decode;
pub mod geometry;
pub mod grid;
pub mod report;
pub mod sequencer;
pub mod store;
pub mod truth;
