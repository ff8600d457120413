//! The states of a scan and the only ways between them.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

/// Where a scan is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum State {
    /// Accepted, and waits for the rig.
    Queued,
    /// Patterns are projected and frames taken.
    Projecting,
    /// All frames are in memory: the object may move.
    Acquired,
    /// The result is computed and written.
    Decoding,
    /// The result can be used; the verdict is `ok` or `degraded`.
    Done,
    /// No result that can be used; what there is is kept.
    Failed,
    /// Somebody asked to stop.
    Cancelled,
    /// The daemon ended before the scan did.
    Interrupted,
}

impl State {
    /// All states.
    pub const ALL: [Self; 8] = [
        Self::Queued,
        Self::Projecting,
        Self::Acquired,
        Self::Decoding,
        Self::Done,
        Self::Failed,
        Self::Cancelled,
        Self::Interrupted,
    ];

    /// Name in requests and answers.
    pub fn name(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Projecting => "projecting",
            Self::Acquired => "acquired",
            Self::Decoding => "decoding",
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
            Self::Interrupted => "interrupted",
        }
    }

    /// The state of a name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.name() == name)
    }

    /// Whether nothing comes after it.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Done | Self::Failed | Self::Cancelled | Self::Interrupted)
    }

    /// Whether the frames are in hand, or will never be.
    pub fn is_acquired(self) -> bool {
        !matches!(self, Self::Queued | Self::Projecting)
    }

    /// Whether a scan may go from here to `next`.
    pub fn may_become(self, next: Self) -> bool {
        use State::{Acquired, Cancelled, Decoding, Done, Failed, Interrupted, Projecting, Queued};
        match self {
            // A scan that is decoded again has its frames already.
            Queued => matches!(next, Projecting | Decoding | Failed | Cancelled | Interrupted),
            Projecting => matches!(next, Acquired | Failed | Cancelled | Interrupted),
            Acquired => matches!(next, Decoding | Failed | Cancelled | Interrupted),
            Decoding => matches!(next, Done | Failed | Cancelled | Interrupted),
            Done | Failed | Cancelled | Interrupted => false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_in_json() {
        for state in State::ALL {
            assert_eq!(serde_json::to_value(state).unwrap(), state.name());
            assert_eq!(State::from_name(state.name()), Some(state));
        }
    }

    #[test]
    fn terminal_states_are_final_and_every_other_leads_to_one() {
        for state in State::ALL {
            let next: Vec<_> = State::ALL.into_iter().filter(|next| state.may_become(*next)).collect();
            assert_eq!(next.is_empty(), state.is_terminal(), "{state:?}");
            if !state.is_terminal() {
                for end in [State::Failed, State::Cancelled, State::Interrupted] {
                    assert!(next.contains(&end), "{state:?} to {end:?}");
                }
            }
            assert!(!next.contains(&state));
        }
    }
}
