//! What is asked of the owner, and what it answers.

use std::{sync::Arc, time::Duration};

use polscan_patterns::Mode;
use tokio::sync::oneshot;

use super::{CalibrationAsk, SessionAsk};
use crate::{
    calibrate::rig::Step,
    engine::Shown,
    scanner::{
        admission::Refusal,
        calibration::{CalibrationRecord, CalibrationState},
        finish,
        record::Record,
        rig,
        state::State,
    },
};

/// A request for scans.
#[derive(Debug, Clone)]
pub struct Submit {
    /// Mode; the configured one where there is none.
    pub mode: Option<Mode>,
    /// Exposure in microseconds; the configured one where there is none.
    pub exposure_us: Option<f64>,
    /// Name for a person.
    pub label: Option<String>,
    /// Tags.
    pub tags: Vec<String>,
    /// Number of scans.
    pub repeat: usize,
    /// Whether they may wait.
    pub queue: bool,
    /// Frames of this scan are decoded again, without the rig.
    pub source: Option<String>,
    /// Key of the client and digest of its request.
    pub key: Option<(String, String)>,
}

/// Why a request was not carried out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Denied {
    /// By the rules of admission.
    Refused(Refusal),
    /// The key was used for another request.
    KeyReused,
    /// There is no such scan.
    Unknown,
    /// The scan is in a state that does not allow it.
    State(State),
    /// It is pinned.
    Pinned,
    /// Another scan was decoded from its frames.
    InUse,
    /// It has no bundle.
    NoBundle,
    /// There is no such calibration.
    UnknownCalibration,
    /// The session has no such view.
    UnknownView,
    /// The calibration takes no views.
    NoSession,
    /// Another session is open.
    SessionOpen(String),
    /// The calibration has come to its end.
    CalibrationEnded(CalibrationState),
    /// The disk says no.
    Storage(String),
    /// The projector has no such picture.
    NoSuchPicture(String),
    /// The rig says no.
    Rig(String),
}

/// A change of what a person may change.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Change {
    /// New name; `Some(None)` removes it.
    pub label: Option<Option<String>>,
    /// New tags.
    pub tags: Option<Vec<String>>,
    /// Whether retention leaves it alone.
    pub pinned: Option<bool>,
}

/// An answer to whoever asked.
pub type Reply<T> = oneshot::Sender<Result<T, Denied>>;

/// Gives an answer.
pub(super) type Answer = Box<dyn FnOnce()>;

pub(super) fn answer<T: 'static>(result: Result<T, Denied>, reply: Reply<T>) -> Answer {
    Box::new(move || drop(reply.send(result)))
}

/// What comes in.
#[derive(Debug)]
pub enum Message {
    /// A request for scans; answered with all of them, and whether the answer is an earlier one's.
    Submit(Box<Submit>, Reply<(Vec<Arc<Record>>, bool)>),
    /// Stop a scan.
    Cancel(String, Reply<Arc<Record>>),
    /// Delete a scan.
    Delete(String, Reply<()>),
    /// Change label, tags or pin.
    Change(String, Change, Reply<Arc<Record>>),
    /// Hold all queued scans back, or release them.
    Hold(bool, Reply<usize>),
    /// Calibrate.
    Calibrate(Box<CalibrationAsk>, Reply<Arc<CalibrationRecord>>),
    /// Open a session with a board.
    OpenSession(Box<SessionAsk>, Reply<Arc<CalibrationRecord>>),
    /// Go on with a session.
    SessionStep(String, Step, Reply<Arc<CalibrationRecord>>),
    /// Delete a calibration.
    DeleteCalibration(String, Reply<()>),
    /// Stop a calibration.
    CancelCalibration(String, Reply<Arc<CalibrationRecord>>),
    /// Hold a picture.
    Show(Shown, String, Reply<()>),
    /// Take a frame for the preview, if that disturbs nobody.
    Preview,
    /// End, after the scan that is running or this time.
    Stop(Duration),
    /// From the rig.
    Rig(rig::News),
    /// From the finisher.
    Finish(finish::News),
}
