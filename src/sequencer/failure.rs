//! What an unfinished capture says and leaves.

use polscan_drivers::{camera::StreamStatistics, error::DeviceError};
use polscan_patterns::Role;
use thiserror::Error;

use super::{
    machine::{Device, Diagnosis},
    record::{CaptureNotes, CapturedFrame, Retake},
};

/// Why a capture is not complete.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum CaptureError {
    /// The projector does not take the pictures.
    #[error("loading {slides} pictures into the projector failed")]
    Load {
        /// Number of pictures.
        slides: usize,
        /// Cause.
        #[source]
        source: DeviceError,
    },
    /// The camera does not start.
    #[error("arming the camera for {frames} frames failed")]
    Arm {
        /// Number of frames.
        frames: usize,
        /// Cause.
        #[source]
        source: DeviceError,
    },
    /// The user asked for it.
    #[error("the capture was cancelled")]
    Cancelled,
    /// A device failed for good.
    #[error("capture failed ({reason}) at {}: {evidence}", at(*role))]
    Device {
        /// Which device.
        device: Device,
        /// Slug.
        reason: String,
        /// What was being captured.
        role: Option<Role>,
        /// Evidence in words.
        evidence: String,
        /// Cause.
        #[source]
        source: DeviceError,
    },
    /// Frames are not what was projected, however often they are taken.
    #[error("capture failed ({reason}) at {}: {evidence}", at(*role))]
    Diagnosed {
        /// Slug.
        reason: String,
        /// What was being captured.
        role: Option<Role>,
        /// Evidence in words.
        evidence: String,
    },
}

fn at(role: Option<Role>) -> String {
    role.map_or("its end".to_string(), |role| role.to_string())
}

impl CaptureError {
    /// Slug of the diagnosis.
    pub fn reason(&self) -> &str {
        match self {
            Self::Load { .. } => "projector-failed",
            Self::Arm { .. } => "camera-failed",
            Self::Cancelled => "cancelled",
            Self::Device { reason, .. } | Self::Diagnosed { reason, .. } => reason,
        }
    }
}

/// What an unfinished capture leaves.
#[derive(Debug, Clone, Default)]
pub struct PartialCapture {
    /// The last take of each frame in the order of the sequence, judged or not, without those that never came.
    pub frames: Vec<CapturedFrame>,
    /// Pairs that were captured again.
    pub retaken: Vec<Retake>,
    /// From the first flip to the last frame, in seconds of the rig's clock.
    pub seconds: f64,
    /// Counters of the camera's stream, where it could be stopped.
    pub statistics: Option<StreamStatistics>,
    /// What was noticed.
    pub notes: CaptureNotes,
}

/// An unfinished capture.
#[derive(Debug, Clone, Error)]
#[error("the capture is not complete: {} frames were kept", partial.frames.len())]
pub struct CaptureFailure {
    /// Why.
    #[source]
    pub error: Box<CaptureError>,
    /// What there is.
    pub partial: Box<PartialCapture>,
}

impl From<Diagnosis> for CaptureError {
    fn from(diagnosis: Diagnosis) -> Self {
        let Diagnosis { reason, role, evidence, source } = diagnosis;
        match source {
            Some((device, source)) => Self::Device { device, reason, role, evidence, source },
            None => Self::Diagnosed { reason, role, evidence },
        }
    }
}
