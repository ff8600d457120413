//! What is known of one scan: the same in memory, in the index, beside the bundle and over the wire.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::state::State;
use crate::report::Report;

/// Why a scan has no result that can be used, or a doubtful one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Cause {
    /// Stable slug: of a diagnosis, or `storage`, `config`, `data`, `unavailable`, `interrupted`, `internal`.
    #[serde(rename = "type")]
    pub kind: String,
    /// What was seen and what to do.
    pub message: String,
}

/// How far a capture is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Progress {
    /// Frames in hand.
    pub frames: usize,
    /// Frames of the sequence; 0 before the capture has begun.
    pub of: usize,
    /// Pairs and references that were taken again.
    pub retaken: usize,
}

/// Place of a scan among those of one request.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Series {
    /// Place, from 0.
    pub index: usize,
    /// Number of scans of the request.
    pub of: usize,
    /// Its first scan.
    pub first: String,
}

/// One scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Record {
    /// Identity, unique for ever; sorts by time.
    pub id: String,
    /// Where it is.
    pub state: State,
    /// Number of the event that last changed this scan: it only grows, over restarts as well.
    pub revision: u64,
    /// How the patterns are coded.
    pub mode: String,
    /// Name for a person.
    pub label: Option<String>,
    /// For sorting and searching.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Whether retention leaves it alone.
    #[serde(default)]
    pub pinned: bool,
    /// Exposure that was asked for, in microseconds; `null` for the configured one.
    pub exposure_us: Option<f64>,
    /// When it was accepted, RFC 3339, UTC.
    pub created: String,
    /// When the first pattern was due.
    pub started: Option<String>,
    /// When the last frame was in memory.
    pub acquired: Option<String>,
    /// When it came to its end.
    pub finished: Option<String>,
    /// How far the capture is.
    #[serde(default)]
    pub progress: Progress,
    /// Scans before it in the queue, while it is queued; `null` for the one that takes the rig next, which may still be
    /// opened.
    #[serde(default)]
    pub queue_position: Option<usize>,
    /// Whether it is queued and waits to be released by `POST /v1/queue/resume`.
    #[serde(default)]
    pub held: bool,
    /// `ok`, `degraded` or `failed`, once there is a report.
    pub verdict: Option<String>,
    /// Why the verdict is not `ok`, or why there is none.
    #[serde(default)]
    pub reasons: Vec<Cause>,
    /// The gravest of the reasons of a scan that is not `done`.
    pub error: Option<Cause>,
    /// The scan whose frames this one was decoded from.
    #[serde(default)]
    pub source: Option<String>,
    /// Its place among the scans of one request.
    #[serde(default)]
    pub series: Option<Series>,
    /// Number of points of the cloud.
    #[serde(default)]
    pub points: Option<u64>,
    /// Bytes of its bundle; `null` where there is none.
    #[serde(default)]
    pub bytes: Option<u64>,
}

impl Record {
    /// A scan that was just accepted.
    pub fn new(id: String, mode: String, created: String) -> Self {
        Self {
            id,
            state: State::Queued,
            revision: 0,
            mode,
            label: None,
            tags: Vec::new(),
            pinned: false,
            exposure_us: None,
            created,
            started: None,
            acquired: None,
            finished: None,
            progress: Progress::default(),
            queue_position: None,
            held: false,
            verdict: None,
            reasons: Vec::new(),
            error: None,
            source: None,
            series: None,
            points: None,
            bytes: None,
        }
    }

    /// Goes to `next` if the state machine lets it, and says whether it did. A terminal state never changes.
    pub fn advance(&mut self, next: State, now: String) -> bool {
        if !self.state.may_become(next) {
            return false;
        }
        self.state = next;
        self.queue_position = None;
        self.held = false;
        match next {
            State::Projecting => self.started = Some(now),
            State::Acquired => self.acquired = Some(now),
            _ if next.is_terminal() => self.finished = Some(now),
            _ => {}
        }
        true
    }

    /// Takes over what a report says.
    pub fn adopt(&mut self, report: &Report) {
        self.verdict = Some(report.verdict.to_string());
        self.points = report.points;
        self.reasons = report
            .reasons
            .iter()
            .map(|reason| Cause { kind: reason.diagnosis.slug().to_owned(), message: reason.message.clone() })
            .collect();
        let gravest = report.reasons.iter().position(|reason| reason.severity == report.verdict);
        self.error = match report.verdict {
            crate::report::Verdict::Failed => gravest.map(|at| self.reasons[at].clone()),
            _ => None,
        };
    }

    /// Notes why there is no result.
    pub fn blame(&mut self, kind: &str, message: impl Into<String>) {
        let cause = Cause { kind: kind.to_owned(), message: message.into() };
        self.reasons.retain(|other| *other != cause);
        self.reasons.insert(0, cause.clone());
        self.error = Some(cause);
    }
}

/// Whether `id` can name a scan, and so a folder: letters of our own only, no separators, no dots.
pub fn is_id(id: &str) -> bool {
    (1..=64).contains(&id.len())
        && id.bytes().all(|byte| byte.is_ascii_lowercase() || byte.is_ascii_digit() || byte == b'-')
        && !id.starts_with('-')
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_terminal_state_never_changes(steps in prop::collection::vec(0usize..State::ALL.len(), 0..20)) {
            let mut record = Record::new("a".into(), "pse".into(), "t".into());
            let mut end = None;
            for step in steps {
                let next = State::ALL[step];
                let before = record.clone();
                let moved = record.advance(next, "later".into());
                prop_assert_eq!(moved, before.state.may_become(next));
                if !moved {
                    prop_assert_eq!(&before, &record);
                }
                if let Some(end) = end {
                    prop_assert_eq!(record.state, end);
                }
                if record.state.is_terminal() {
                    prop_assert!(record.finished.is_some());
                    end = Some(record.state);
                }
            }
        }

        #[test]
        fn ids_lead_nowhere(text in "\\PC{0,70}") {
            if is_id(&text) {
                prop_assert_eq!(std::path::Path::new(&text).components().count(), 1);
                prop_assert!(!text.contains(['/', '.', '\\', '\0']));
            }
        }
    }

    #[test]
    fn our_own_ids_are_ids() {
        assert!(is_id(&uuid::Uuid::now_v7().to_string()));
        assert!(is_id(&crate::engine::new_id()));
        for bad in ["", "..", ".", "a/b", "../a", "A", "-rf", "a.b", "%2e"] {
            assert!(!is_id(bad), "{bad}");
        }
    }
}
