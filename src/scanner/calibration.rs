//! What is known of one calibration: the same in memory, on the disk and over the wire.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::record::Cause;
use crate::calibrate::{Light, Outcome, polarization::turning_advice, rig::SessionState};

/// What is calibrated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum CalibrationKind {
    /// Timing of the projector and ripple of its lamp.
    Sync,
    /// Noise of the camera.
    Noise,
    /// Polarization of projector and polarizer.
    Polarization,
    /// Optics of camera and projector and the pose between them.
    Rig,
}

impl CalibrationKind {
    /// Name in requests and answers.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sync => "sync",
            Self::Noise => "noise",
            Self::Polarization => "polarization",
            Self::Rig => "rig",
        }
    }
}

/// Where a calibration is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum CalibrationState {
    /// A session waits for its next step; others may use the rig.
    Open,
    /// It has the rig.
    Running,
    /// It came to its end, accepted or refused.
    Done,
    /// It could not be measured.
    Failed,
    /// Somebody asked to stop.
    Cancelled,
    /// The daemon ended before the calibration did.
    Interrupted,
}

impl CalibrationState {
    /// Name in answers.
    pub fn name(self) -> &'static str {
        match self {
            Self::Open => "open",
            Self::Running => "running",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Interrupted => "interrupted",
        }
    }

    /// Whether nothing comes after it.
    pub fn is_terminal(self) -> bool {
        !matches!(self, Self::Open | Self::Running)
    }
}

/// H and V while somebody turns the polarizer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct LiveValue {
    /// Light of H above no light, in DN.
    pub h_dn: f64,
    /// Light of V above no light, in DN.
    pub v_dn: f64,
    /// Degrees off the darkest V that was seen; `null` until enough of a turn has been.
    pub off_deg: Option<f64>,
    /// What to do.
    pub advice: String,
    /// Number of values so far.
    pub values: u64,
}

/// One calibration.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct CalibrationRecord {
    /// Identity, unique for ever; sorts by time.
    pub id: String,
    /// What is calibrated.
    pub kind: CalibrationKind,
    /// Where it is.
    pub state: CalibrationState,
    /// Number of the event that last changed it.
    pub revision: u64,
    /// When it was accepted, RFC 3339, UTC.
    pub created: String,
    /// When it came to its end.
    pub finished: Option<String>,
    /// What is being done, in words.
    pub doing: Option<String>,
    /// Steps that were begun.
    pub steps: usize,
    /// Reading of the polarizer's mount in degrees, of a polarization.
    pub angle_deg: Option<f64>,
    /// Calibrations at other angles that it was joined with.
    #[serde(default)]
    pub with: Vec<String>,
    /// Whether it only watches H and V; it then ends by `POST .../cancel`, as `done`.
    pub watch: bool,
    /// The latest value of a watch.
    pub live: Option<LiveValue>,
    /// Of a rig: the board, its views, and what is still missing.
    #[serde(default)]
    pub session: Option<SessionState>,
    /// Whether it can be trusted; `null` before its end, and where more angles have to be measured first.
    pub accepted: Option<bool>,
    /// Why it is not accepted.
    #[serde(default)]
    pub refused: Vec<String>,
    /// Why there is no result.
    pub error: Option<Cause>,
    /// What was found, in words.
    #[serde(default)]
    pub summary: Vec<String>,
    /// Names of its files.
    #[serde(default)]
    pub files: Vec<String>,
}

impl CalibrationRecord {
    /// A calibration that was just accepted.
    pub fn new(id: String, kind: CalibrationKind, created: String) -> Self {
        Self {
            id,
            kind,
            state: CalibrationState::Running,
            revision: 0,
            created,
            finished: None,
            doing: None,
            steps: 0,
            angle_deg: None,
            with: Vec::new(),
            watch: false,
            live: None,
            session: None,
            accepted: None,
            refused: Vec::new(),
            error: None,
            summary: Vec::new(),
            files: Vec::new(),
        }
    }

    /// Notes a value of a watch.
    pub fn seen(&mut self, light: Light) {
        let values = self.live.as_ref().map_or(0, |live| live.values) + 1;
        let Light { h_dn, v_dn, off_deg } = light;
        self.live = Some(LiveValue { h_dn, v_dn, off_deg, advice: turning_advice(off_deg), values });
    }

    /// Takes over what was found.
    pub fn adopt(&mut self, outcome: Outcome) {
        let Outcome { files, lines, refused, accepted, session, .. } = outcome;
        if session.is_some() {
            self.session = session;
            self.error = None;
        }
        (self.files, self.summary, self.refused) = (files, lines, refused);
        self.accepted = accepted.filter(|_| !self.watch);
    }

    /// Brings it to its end; an end never changes.
    pub fn end(&mut self, state: CalibrationState, now: String) {
        if !self.state.is_terminal() {
            self.state = state;
            self.finished = Some(now);
            self.doing = None;
        }
    }

    /// Notes why there is no result.
    pub fn blame(&mut self, kind: &str, message: impl Into<String>) {
        self.error = Some(Cause { kind: kind.to_owned(), message: message.into() });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_in_json_and_ends_never_change() {
        use CalibrationKind::{Noise, Polarization, Rig, Sync};
        use CalibrationState::{Cancelled, Done, Failed, Interrupted, Open, Running};
        for kind in [Noise, Sync, Polarization, Rig] {
            assert_eq!(serde_json::to_value(kind).unwrap(), kind.name());
        }
        let states = [Running, Done, Failed, Cancelled, Interrupted];
        for state in states {
            assert_eq!(serde_json::to_value(state).unwrap(), state.name());
        }
        assert_eq!(serde_json::to_value(Open).unwrap(), Open.name());
        assert!(!Open.is_terminal() && !Running.is_terminal());
        for first in &states[1..] {
            for second in states {
                let mut record = CalibrationRecord::new("a".into(), Noise, "t".into());
                record.end(*first, "then".into());
                record.end(second, "later".into());
                assert_eq!((record.state, record.finished.as_deref()), (*first, Some("then")));
            }
        }
    }
}
