//! The scanner as a service: one owner of its state, one thread that owns the rig, one that finishes captures.
//!
//! ```text
//!            admit                rig free             last frame            finisher free          verdict
//!  POST ---------------> queued ----------> projecting ----------> acquired ---------------> decoding -------> done
//!    |  409 busy           |                    |                      |                         |
//!    |  429 queue full     |  reprocess: from queued straight to decoding                        +----------> failed
//!    |  503 cannot scan    |                    |                      |                         |
//!                          +---- cancel --------+----------------------+-------------------------+----------> cancelled
//!                          +---- storage, device, diagnosis -----------+-------------------------+----------> failed
//!                                +---- crash, end of the service ------+-------------------------+----------> interrupted
//!
//!  requests --\                         /--> rig thread: devices ----\
//!  (any task)  >-- Message --> owner --<---> finisher: own pool ------>-- Message --> owner
//!  news ------/       |                 \--> disk thread: spools
//!                     +--> index, snapshot (watch), events
//! ```
//!
//! A terminal state never changes. While one scan is decoded the next may be captured; frames of at most
//! [`MOST_FINISHING`] captures are in memory besides those that are being taken.

mod admission;
mod calibration;
mod disk;
mod events;
mod finish;
mod heartbeat;
mod metrics;
mod owner;
mod prepared;
mod preview;
mod record;
mod rig;
mod service;
mod snapshot;
mod state;

pub use admission::{
    Ask, Decision, Holder, MOST_FINISHING, MOST_REPEATS, Obstacle, Refusal, Situation, admit,
};
pub use calibration::{CalibrationKind, CalibrationRecord, CalibrationState, LiveValue};
pub use events::EventLog;
pub use heartbeat::Heartbeat;
pub use metrics::Metrics;
pub use owner::{CalibrationAsk, Change, Denied, SessionAsk, Submit};
pub use preview::{Exposure, Picture, Preview};
pub use record::{Cause, Progress, Record, Series, is_id};
pub use service::{Scanner, Threads, start};
pub use snapshot::{RigState, RigStatus, Snapshot, StorageStatus};
pub use state::State;
