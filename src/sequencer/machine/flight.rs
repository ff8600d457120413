//! What becomes of the frame that is under way.

use polscan_drivers::{clock::Timestamp, frame::FrameStamp};

use super::{
    super::{
        ledger::{Refusal, Window},
        plan::Group,
        record::Finding,
    },
    MAX_DISCARDED, Machine, Phase, Place, Trouble,
    types::{Action, Subject},
};

/// A frame that is under way.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Flight {
    pub place: Place,
    pub window: Window,
    pub deadline: Timestamp,
    pub discarded: u32,
    pub last: Option<Refusal>,
}

impl Machine {
    pub(super) fn arrived(
        &mut self,
        now: Timestamp,
        phase: Phase,
        mut flight: Flight,
        stamp: &FrameStamp,
    ) -> Vec<Action> {
        let Err(refusal) = self.exposures.enter(&self.timing, flight.window, stamp) else {
            return self.keep(now, phase, flight.place);
        };
        self.discarded.push(Finding {
            reason: refusal.reason.to_string(),
            role: Some(self.roles[flight.place.1]),
            evidence: refusal.evidence.clone(),
            sigma: None,
        });
        flight.discarded += 1;
        if !refusal.may_come || flight.discarded >= MAX_DISCARDED {
            self.exposures.unanswered(refusal.may_come);
            return self.lose(now, phase, flight.place, refusal.reason, refusal.evidence);
        }
        flight.last = Some(refusal);
        let deadline = flight.deadline;
        (self.phase, self.flight) = (phase, Some(flight));
        vec![Action::AwaitFrame { deadline }]
    }

    pub(super) fn timed_out(&mut self, now: Timestamp, phase: Phase, flight: Flight) -> Vec<Action> {
        self.exposures.unanswered(true);
        let late = now.since(flight.window.started);
        let (reason, rest) = match flight.last {
            Some(refusal) => (refusal.reason, format!("; instead, {}", refusal.evidence)),
            None => ("lost-frame", String::new()),
        };
        let evidence = format!("no frame {late:.1?} after the trigger{rest}");
        self.lose(now, phase, flight.place, reason, evidence)
    }

    /// Gives up the frame of `place`, whose group comes before the slide that may be on the glass already.
    pub(super) fn lose(
        &mut self,
        now: Timestamp,
        phase: Phase,
        place: Place,
        reason: &str,
        evidence: String,
    ) -> Vec<Action> {
        if let Phase::Refused(Trouble { reason, evidence, fatal: fatal @ Some(_) }) = phase {
            return self.fail(reason, evidence, self.current, fatal);
        }
        if let Some((group, _)) = self.current.filter(|(group, _)| *group != place.0) {
            self.queue.push_front(group);
        }
        self.repeat(now, Some(place), reason, evidence)
    }

    /// The frame in hand is the one of `place`.
    fn keep(&mut self, now: Timestamp, phase: Phase, place: Place) -> Vec<Action> {
        let (group, step) = place;
        let mut actions = vec![Action::Keep { step }];
        let settle = (step + 1 == self.groups[group].steps().end).then(|| {
            self.judging = match self.groups[group] {
                Group::Pair { .. } => Some(Subject::Pair { group }),
                Group::Again { .. } => Some(Subject::Drift { group }),
                Group::Single { .. } => None,
            };
            self.judging.map_or(Action::Accept { group }, Action::Judge)
        });
        match phase {
            Phase::Shown { flip } => {
                actions.extend(settle);
                actions.extend(self.expose_when_judged(now, flip));
            }
            Phase::Refused(trouble) => {
                let next = self.shown_again(now, trouble);
                actions.extend(settle.filter(|_| !self.ended()));
                actions.extend(next);
            }
            _ => {
                let next = match settle {
                    None => vec![self.show(now, (group, step + 1))],
                    Some(_) => self.advance(now),
                };
                // The next slide is asked for first, so that judging overlaps its latency.
                let at = if self.ended() { 0 } else { next.len() };
                let (before, after) = next.split_at(at);
                actions.extend(before.iter().cloned().chain(settle).chain(after.iter().cloned()));
            }
        }
        actions
    }
}
