//! Whether a scan is accepted, and why not. Pure: the situation in, a decision out.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{calibration::CalibrationKind, state::State};

/// Captures whose frames may be in memory while the next scan is captured: one being decoded, one waiting for it.
pub const MOST_FINISHING: usize = 2;

/// Most scans that one request may ask for.
pub const MOST_REPEATS: usize = 1000;

/// One reason why the rig cannot scan.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Obstacle {
    /// Stable slug: `camera`, `projector`, `rig`, `storage`, `stopping`.
    #[serde(rename = "type")]
    pub kind: String,
    /// What is wrong and what to do.
    pub message: String,
}

impl Obstacle {
    /// An obstacle.
    pub fn new(kind: &str, message: impl Into<String>) -> Self {
        Self { kind: kind.to_owned(), message: message.into() }
    }
}

/// Who has the rig.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct Holder {
    /// The scan, or the calibration.
    pub id: String,
    /// Where it is; a calibration is always `projecting`.
    pub state: State,
    /// Its name for a person.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
    /// When it was accepted, RFC 3339.
    pub created: String,
    /// What is calibrated, where it is no scan.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibration: Option<CalibrationKind>,
}

/// What admission looks at.
#[derive(Debug, Clone, Default)]
pub struct Situation {
    /// Whatever keeps the rig from scanning; empty while it is only being opened.
    pub obstacles: Vec<Obstacle>,
    /// The scan that is captured, or will be next without anybody's doing.
    pub holder: Option<Holder>,
    /// Scans that have their frames and no result; the oldest of them.
    pub finishing: usize,
    /// The oldest of those.
    pub oldest_finishing: Option<Holder>,
    /// Scans that wait and will run by themselves.
    pub runnable: usize,
    /// Scans that wait and are held back.
    pub held: usize,
    /// Scans that may wait.
    pub capacity: usize,
}

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Ask {
    /// Number of scans, one after the other.
    pub scans: usize,
    /// Whether they may wait for others.
    pub queue: bool,
}

/// What becomes of a request.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Decision {
    /// It has the rig.
    Start,
    /// It waits behind so many others.
    Queue(usize),
    /// It is refused.
    Refuse(Refusal),
}

/// Why a request is refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Refusal {
    /// The rig cannot scan.
    NotReady(Vec<Obstacle>),
    /// Somebody else has the rig.
    Busy(Holder),
    /// Too many wait already.
    QueueFull {
        /// Scans that may wait.
        capacity: usize,
    },
}

/// Decides. What cannot be helped by waiting comes first, so that a client learns the gravest reason.
pub fn admit(situation: &Situation, ask: Ask) -> Decision {
    if !situation.obstacles.is_empty() {
        return Decision::Refuse(Refusal::NotReady(situation.obstacles.clone()));
    }
    let crowded =
        (situation.finishing >= MOST_FINISHING).then(|| situation.oldest_finishing.clone()).flatten();
    let holder = situation.holder.clone().or(crowded);
    let waiting = situation.runnable + situation.held;
    let room = situation.capacity.saturating_sub(waiting);
    let full = Decision::Refuse(Refusal::QueueFull { capacity: situation.capacity });
    match holder {
        None if ask.scans.saturating_sub(1) <= room => Decision::Start,
        None => full,
        Some(holder) if !ask.queue => Decision::Refuse(Refusal::Busy(holder)),
        Some(_) if ask.scans <= room => Decision::Queue(situation.runnable),
        Some(_) => full,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn holder(id: &str) -> Holder {
        Holder {
            id: id.to_owned(),
            state: State::Projecting,
            label: None,
            created: String::new(),
            calibration: None,
        }
    }

    prop_compose! {
        fn situations()(
            blocked in any::<bool>(),
            held_by in any::<bool>(),
            finishing in 0usize..4,
            runnable in 0usize..6,
            held in 0usize..6,
            capacity in 0usize..8,
        ) -> Situation {
            Situation {
                obstacles: blocked.then(|| Obstacle::new("camera", "gone")).into_iter().collect(),
                holder: held_by.then(|| holder("a")),
                finishing,
                oldest_finishing: (finishing > 0).then(|| holder("f")),
                runnable: if held_by { runnable } else { 0 },
                held,
                capacity,
            }
        }
    }

    proptest! {
        #[test]
        fn rules(situation in situations(), scans in 1usize..8, queue: bool) {
            let decision = admit(&situation, Ask { scans, queue });
            let idle = situation.holder.is_none() && situation.finishing < MOST_FINISHING;
            let room = situation.capacity as i64 - (situation.runnable + situation.held) as i64;
            // Each outcome if and only if its own rule holds.
            let blocked = !situation.obstacles.is_empty();
            let not_ready = matches!(decision, Decision::Refuse(Refusal::NotReady(_)));
            let busy = matches!(decision, Decision::Refuse(Refusal::Busy(_)));
            let full = matches!(decision, Decision::Refuse(Refusal::QueueFull { .. }));
            let start = decision == Decision::Start;
            let queued = matches!(decision, Decision::Queue(_));
            prop_assert_eq!(not_ready, blocked);
            prop_assert_eq!(busy, !blocked && !idle && !queue);
            prop_assert_eq!(start, !blocked && idle && (scans == 1 || scans as i64 - 1 <= room));
            prop_assert_eq!(queued, !blocked && !idle && queue && scans as i64 <= room);
            prop_assert_eq!(full, !(not_ready || busy || start || queued));
            // Who only may wait is never better off than who need not, and never worse.
            let other = admit(&situation, Ask { scans, queue: !queue });
            prop_assert_eq!(start, other == Decision::Start);
            if let Decision::Refuse(Refusal::Busy(named)) = decision {
                prop_assert!(named.id == "a" || named.id == "f");
            }
        }

        #[test]
        fn held_scans_never_stop_a_new_one_on_an_idle_rig(held in 0usize..100, capacity in 0usize..8) {
            let situation = Situation { held, capacity, ..Situation::default() };
            prop_assert_eq!(admit(&situation, Ask { scans: 1, queue: false }), Decision::Start);
        }

        #[test]
        fn accepting_keeps_the_queue_within_its_capacity(mut situation in situations(), scans in 1usize..8) {
            let before = situation.runnable + situation.held;
            match admit(&situation, Ask { scans, queue: true }) {
                Decision::Start => situation.runnable += scans - 1,
                Decision::Queue(_) => situation.runnable += scans,
                Decision::Refuse(_) => {}
            }
            let after = situation.runnable + situation.held;
            prop_assert!(after <= situation.capacity.max(before));
        }
    }
}
