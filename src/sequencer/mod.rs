//! Synchronous capture: from a sequence of roles to frames that are proven to show them.
//!
//! [`Plan`] is the timetable, [`Machine`](machine::Machine) decides, [`capture`] does; [`Judge`] looks at the pixels.

mod capture;
mod failure;
mod judge;
mod ledger;
pub mod machine;
pub mod plan;
mod record;
mod synchrony;

pub use capture::{CancelFlag, Progress, capture, slide};
pub use failure::{CaptureError, CaptureFailure, PartialCapture};
pub(crate) use judge::compare_pixels;
pub use judge::{
    Judge, PairThresholds, PairVerdict, ReferenceChange, Suspicion, compare_references, drift_rule,
    judge_rule,
};
pub use plan::{Plan, PlanError, PlanOptions};
pub use record::{CaptureNotes, CaptureRecord, CapturedFrame, Finding, ReferenceRetake, Retake};
pub use synchrony::{PhaseError, Synchrony};
