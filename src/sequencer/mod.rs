//! Synchronous capture: from a sequence of roles to frames that are proven to show them.

mod record;

pub use record::{CaptureRecord, CapturedFrame, Retake};
