//! What the machine is told and what it answers.

use polscan_drivers::{clock::Timestamp, error::DeviceError, frame::FrameStamp, projector::PresentReceipt};
use polscan_patterns::Role;

use super::super::judge::PairVerdict;

/// Which device failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Device {
    /// While showing a slide.
    Projector,
    /// While triggering or delivering.
    Camera,
}

/// What the judge looks at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Subject {
    /// The two frames of a pair, of group `group`.
    Pair {
        /// Index into the plan's groups.
        group: usize,
    },
    /// The last frame of a reference against the first, of group `group`.
    Drift {
        /// Index into the plan's groups.
        group: usize,
    },
}

impl Subject {
    /// Group that is judged.
    pub fn group(self) -> usize {
        match self {
            Self::Pair { group } | Self::Drift { group } => group,
        }
    }
}

/// What happened.
#[derive(Debug, Clone, PartialEq)]
pub enum Event {
    /// Begin.
    Start,
    /// The slide asked for was flipped.
    Presented(PresentReceipt),
    /// The exposure asked for starts, or has started, at this time.
    Triggered(Timestamp),
    /// A frame arrived.
    FrameArrived(FrameStamp),
    /// The judge has spoken.
    Judged(Subject, PairVerdict),
    /// No frame arrived by the deadline.
    TimedOut,
    /// A device failed at the action asked for.
    DeviceFailed(Device, DeviceError),
    /// The user wants no more of it.
    CancelRequested,
}

/// What to do, in this order.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    /// Show the slide of `step`, not before a time.
    Show {
        /// Step and slide.
        step: usize,
        /// Earliest time to ask for it.
        not_before: Timestamp,
    },
    /// Start one exposure.
    Trigger {
        /// When.
        at: Timestamp,
    },
    /// Wait for a frame.
    AwaitFrame {
        /// Until when.
        deadline: Timestamp,
    },
    /// The frame that has just arrived is the one of `step`. One that arrived without this is to be dropped.
    Keep {
        /// Step that it shows.
        step: usize,
    },
    /// Judge, and answer with [`Event::Judged`].
    Judge(Subject),
    /// The frames of this group are final.
    Accept {
        /// Index into the plan's groups.
        group: usize,
    },
    /// The group will be taken again: a notice, [`Machine::retaken`](super::Machine::retaken) has it.
    Retake(GroupRetake),
    /// Leave the projector black.
    Black,
    /// The capture is over.
    Finish(Outcome),
}

/// A group that is taken again.
#[derive(Debug, Clone, PartialEq)]
pub struct GroupRetake {
    /// Index into the plan's groups.
    pub group: usize,
    /// Slug of the diagnosis.
    pub reason: String,
    /// Evidence in words.
    pub evidence: String,
    /// Which try failed, from 1.
    pub attempt: u32,
}

/// How a capture ended.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// All frames are proven.
    Complete,
    /// Cancelled by the user.
    Cancelled,
    /// Given up.
    Failed(Diagnosis),
}

/// Why a capture was given up.
#[derive(Debug, Clone, PartialEq)]
pub struct Diagnosis {
    /// Slug.
    pub reason: String,
    /// What was being captured.
    pub role: Option<Role>,
    /// Evidence in words.
    pub evidence: String,
    /// Failure of a device, where that is the cause.
    pub source: Option<(Device, DeviceError)>,
}
