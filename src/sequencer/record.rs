//! What a capture leaves behind.

use polscan_drivers::{
    camera::{AppliedSettings, StreamStatistics},
    clock::Timestamp,
    frame::Frame,
    projector::PresentReceipt,
};
use polscan_patterns::{Axis, Role};
use serde::{Deserialize, Serialize};

use super::synchrony::Synchrony;

/// One frame with the evidence of what was on the glass.
#[derive(Debug, Clone)]
pub struct CapturedFrame {
    /// What it shows.
    pub role: Role,
    /// Receipt of the slide.
    pub receipt: PresentReceipt,
    /// When its exposure was asked for.
    pub triggered: Timestamp,
    /// Pixels and stamp.
    pub frame: Frame,
}

/// A pair that was captured again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Retake {
    /// Axis of the pair.
    pub axis: Axis,
    /// Bit of the pair.
    pub bit: u8,
    /// Slug of the diagnosis that asked for it.
    pub reason: String,
    /// Evidence in words.
    pub evidence: String,
    /// Which try failed, from 1.
    pub attempt: u32,
}

/// A reference that was captured again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ReferenceRetake {
    /// What it shows.
    #[serde(flatten)]
    pub role: Role,
    /// Slug of the diagnosis that asked for it.
    pub reason: String,
    /// Evidence in words.
    pub evidence: String,
    /// Which try failed, from 1.
    pub attempt: u32,
}

/// Something that was noticed and did not stop the capture.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Finding {
    /// Slug of the diagnosis.
    pub reason: String,
    /// What was shown, where it concerns one picture; the first frame of a pair stands for both.
    pub role: Option<Role>,
    /// Evidence in words.
    pub evidence: String,
    /// Spread of the residual in units of noise, where it was judged by that.
    pub sigma: Option<f64>,
}

/// What a capture noticed besides its frames.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct CaptureNotes {
    /// Findings that degrade the scan though its frames stand.
    pub findings: Vec<Finding>,
    /// Frames that arrived, were not the ones awaited and were dropped: harmless, each is proof that the check works.
    pub discarded: Vec<Finding>,
    /// References that were captured again.
    pub references_retaken: Vec<ReferenceRetake>,
}

/// A finished capture.
#[derive(Debug, Clone)]
pub struct CaptureRecord {
    /// Frames in the order of the sequence, the accepted take of each.
    pub frames: Vec<CapturedFrame>,
    /// Pairs that were captured again.
    pub retaken: Vec<Retake>,
    /// From the first flip to the last frame, in seconds of the rig's clock.
    pub seconds: f64,
    /// Frames x hold / refresh rate: the least that the display allows, in seconds.
    pub limit_seconds: f64,
    /// From flip to trigger, in ms.
    pub latency_ms: f64,
    /// Refreshes that each slide was held.
    pub hold_refreshes: u32,
    /// Whether latency and settling were measured (rather than conservative defaults).
    pub timing_measured: bool,
    /// How flips and exposures kept step.
    pub synchrony: Synchrony,
    /// Camera settings in effect.
    pub applied: AppliedSettings,
    /// Counters of the camera's stream.
    pub statistics: StreamStatistics,
    /// What was noticed.
    pub notes: CaptureNotes,
}
