//! What a capture does next: events in, actions out. No device, no clock, no thread; time is an argument.
//!
//! The file is long because diagram, states and transitions are read together.
//!
//! ```text
//!                                   verdict on the pair before
//!                                        ^          |
//!                                        |          v
//! Idle --start--> Showing --presented--> Shown (still being judged)
//!                  ^   |                            |
//!                  |   +--presented, nothing to judge--> Exposing --triggered--> Awaiting --+
//!                  |                                                              ^    |    |
//!                  |                                      foreign frame, discarded+----+    | frame
//!                  |                                                                        v
//!                  +--next step, or the group again (lost frame, wrong slide)-----------  (kept)
//!                  |                                                                        |
//!                  +--suspicious, taken again-- Judging <--nothing left to show-------------+
//!                                                  |
//!                                                  v
//! any of them --cancelled, failed, complete--> [Black, Finish] --> Ended
//! ```
//!
//! Invariants: a slide is shown only when no exposure is under way; an exposure starts only on a slide whose receipt
//! holds; a frame is kept only where its stamp lies in the stable window of the slide on the glass; `Black` and `Finish`
//! come once, together, last. Re-takes and discarded frames are bounded, so the number of actions is.

mod types;

use std::collections::VecDeque;

use polscan_drivers::{
    clock::Timestamp,
    error::DeviceError,
    frame::FrameStamp,
    projector::{PresentReceipt, ReceiptMethod},
};
use polscan_patterns::Role;

use super::{
    judge::{PairVerdict, Suspicion},
    ledger::{Exposures, Flips, Refusal, Window},
    plan::{self, Group, Plan, Timing},
    record::Finding,
};

pub use types::{Action, Device, Diagnosis, Event, GroupRetake, Outcome, Subject};

/// Frames that may be discarded while one is awaited.
pub const MAX_DISCARDED: u32 = 8;

/// Refused pairs, with none accepted, that put the references they were judged against in doubt.
const DOUBTFUL_REFERENCES: u32 = 2;

#[derive(Debug, Clone, PartialEq)]
enum Phase {
    Idle,
    Showing { asked: Timestamp },
    Shown { flip: Timestamp },
    Exposing { at: Timestamp },
    Awaiting(Wait),
    Judging,
    Ended,
}

#[derive(Debug, Clone, PartialEq)]
struct Wait {
    window: Window,
    deadline: Timestamp,
    discarded: u32,
    last: Option<Refusal>,
}

/// State of one capture. See the module for the diagram.
#[derive(Debug, Clone)]
pub struct Machine {
    timing: Timing,
    roles: Vec<Role>,
    groups: Vec<Group>,
    retakes_each: u32,
    retakes_total: u32,
    phase: Phase,
    /// Group being captured and its step on the glass.
    current: Option<(usize, usize)>,
    queue: VecDeque<usize>,
    judging: Option<Subject>,
    attempts: Vec<u32>,
    retaken: Vec<GroupRetake>,
    findings: Vec<Finding>,
    discarded: Vec<Finding>,
    flips: Flips,
    exposures: Exposures,
    exposed: Timestamp,
    /// Whether a pair has agreed with the references.
    references_hold: bool,
    refused_pairs: u32,
    references_repeated: bool,
    /// Reasons for which a pair has been taken again in vain.
    lasting: Vec<String>,
}

impl Machine {
    /// A machine for `plan` and a camera whose triggers start exactly one exposure each (`triggered`), or not.
    pub fn new(plan: &Plan, triggered: bool) -> Self {
        Self {
            timing: plan.timing,
            roles: plan.sequence.roles.clone(),
            groups: plan.groups.clone(),
            retakes_each: plan.retakes_each,
            retakes_total: plan.retakes_total,
            phase: Phase::Idle,
            current: None,
            queue: (0..plan.groups.len()).collect(),
            judging: None,
            attempts: vec![0; plan.groups.len()],
            retaken: Vec::new(),
            findings: Vec::new(),
            discarded: Vec::new(),
            flips: Flips::default(),
            exposures: Exposures::new(triggered),
            exposed: Timestamp(0),
            references_hold: false,
            refused_pairs: 0,
            references_repeated: false,
            lasting: Vec::new(),
        }
    }

    /// Groups taken again so far.
    pub fn retaken(&self) -> &[GroupRetake] {
        &self.retaken
    }

    /// What was noticed so far and did not stop the capture.
    pub fn findings(&self) -> &[Finding] {
        &self.findings
    }

    /// Frames that arrived and were not the ones awaited.
    pub fn discarded(&self) -> &[Finding] {
        &self.discarded
    }

    /// Triggers that the camera has taken.
    pub fn triggers(&self) -> u64 {
        self.exposures.triggers()
    }

    /// Whether the capture is over.
    pub fn ended(&self) -> bool {
        self.phase == Phase::Ended
    }

    /// What to do about `event` at `now`. After the end every event is met with nothing; an event that cannot happen
    /// in this state ends the capture.
    pub fn handle(&mut self, now: Timestamp, event: Event) -> Vec<Action> {
        let phase = std::mem::replace(&mut self.phase, Phase::Idle);
        match (phase, event) {
            (Phase::Ended, _) => {
                self.phase = Phase::Ended;
                Vec::new()
            }
            (_, Event::CancelRequested) => self.finish(Outcome::Cancelled),
            (Phase::Idle, Event::Start) => self.advance(now),
            (Phase::Showing { asked }, Event::Presented(receipt)) => self.presented(now, asked, receipt),
            (Phase::Exposing { at }, Event::Triggered(started)) => self.triggered(at, started),
            (Phase::Awaiting(wait), Event::FrameArrived(stamp)) => self.arrived(now, wait, &stamp),
            (Phase::Awaiting(wait), Event::TimedOut) => self.timed_out(now, wait),
            (phase, Event::Judged(subject, verdict)) if self.judging == Some(subject) => {
                self.judged(now, phase, subject, verdict)
            }
            (phase, Event::DeviceFailed(device, error)) => self.device_failed(now, &phase, device, error),
            (phase, event) => {
                let evidence = format!("event {event:?} in state {phase:?}: a defect of the capture itself");
                self.fail("out-of-order", evidence, None)
            }
        }
    }

    /// Shows the next step there is, waits for the last verdict, or completes.
    fn advance(&mut self, now: Timestamp) -> Vec<Action> {
        match self.queue.pop_front() {
            Some(group) => {
                let step = self.groups[group].steps().start;
                vec![self.show(now, group, step)]
            }
            None if self.judging.is_some() => {
                self.current = None;
                self.phase = Phase::Judging;
                Vec::new()
            }
            None => self.finish(Outcome::Complete),
        }
    }

    /// Shows `step` when the slide before has been held as planned.
    fn show(&mut self, now: Timestamp, group: usize, step: usize) -> Action {
        let due = self.flips.last().map(|receipt| self.timing.next_show(self.timing.latest_flip(receipt)));
        self.show_from(due.unwrap_or(now).max(now), group, step)
    }

    fn show_from(&mut self, not_before: Timestamp, group: usize, step: usize) -> Action {
        // Also where nobody waits for its frame any more, an exposure is not disturbed.
        let not_before = not_before.max(self.exposed);
        self.current = Some((group, step));
        self.phase = Phase::Showing { asked: not_before };
        Action::Show { step, not_before }
    }

    fn presented(&mut self, now: Timestamp, asked: Timestamp, receipt: PresentReceipt) -> Vec<Action> {
        let slide = self.current.map_or(0, |(_, step)| step as u32);
        if let Err(refusal) = self.flips.enter(&self.timing, slide, asked, now, receipt) {
            return self.repeat(now, refusal.reason, refusal.evidence);
        }
        if receipt.method == ReceiptMethod::Guessed
            && !self.findings.iter().any(|f| f.reason == "guessed-flips")
        {
            self.findings.push(Finding {
                reason: "guessed-flips".to_string(),
                role: None,
                evidence: format!(
                    "the display does not tell when it flips; {} refreshes are allowed for it",
                    plan::GUESSED_FLIP_REFRESHES
                ),
                sigma: None,
            });
        }
        let flip = self.timing.latest_flip(&receipt);
        if self.judging.is_some() {
            self.phase = Phase::Shown { flip };
            return Vec::new();
        }
        vec![self.expose(now, flip)]
    }

    fn expose(&mut self, now: Timestamp, flip: Timestamp) -> Action {
        let at = self.timing.trigger_at(flip, now);
        self.phase = Phase::Exposing { at };
        Action::Trigger { at }
    }

    fn triggered(&mut self, at: Timestamp, started: Timestamp) -> Vec<Action> {
        self.exposures.trigger();
        self.exposed = at.max(started) + self.timing.exposure;
        let deadline = self.timing.frame_deadline(at.max(started));
        self.phase =
            Phase::Awaiting(Wait { window: Window { at, started }, deadline, discarded: 0, last: None });
        vec![Action::AwaitFrame { deadline }]
    }

    fn arrived(&mut self, now: Timestamp, mut wait: Wait, stamp: &FrameStamp) -> Vec<Action> {
        let Err(refusal) = self.exposures.enter(&self.timing, wait.window, stamp) else {
            return self.keep(now);
        };
        self.discarded.push(Finding {
            reason: refusal.reason.to_string(),
            role: self.role(),
            evidence: refusal.evidence.clone(),
            sigma: None,
        });
        wait.discarded += 1;
        if !refusal.may_come || wait.discarded >= MAX_DISCARDED {
            self.exposures.unanswered(refusal.may_come);
            return self.repeat(now, refusal.reason, refusal.evidence);
        }
        wait.last = Some(refusal);
        let deadline = wait.deadline;
        self.phase = Phase::Awaiting(wait);
        vec![Action::AwaitFrame { deadline }]
    }

    fn timed_out(&mut self, now: Timestamp, wait: Wait) -> Vec<Action> {
        self.exposures.unanswered(true);
        let late = now.since(wait.window.started);
        let (reason, rest) = match wait.last {
            Some(refusal) => (refusal.reason, format!("; instead, {}", refusal.evidence)),
            None => ("lost-frame", String::new()),
        };
        self.repeat(now, reason, format!("no frame {late:.1?} after the trigger{rest}"))
    }

    /// The frame in hand is the one of the current step.
    fn keep(&mut self, now: Timestamp) -> Vec<Action> {
        let Some((group, step)) = self.current else {
            return self.fail("out-of-order", "a frame arrived for no step".to_string(), None);
        };
        let mut actions = vec![Action::Keep { step }];
        if step + 1 < self.groups[group].steps().end {
            actions.push(self.show(now, group, step + 1));
            return actions;
        }
        let subject = match self.groups[group] {
            Group::Pair { .. } => Some(Subject::Pair { group }),
            Group::Again { .. } => Some(Subject::Drift { group }),
            Group::Single { .. } => None,
        };
        self.judging = subject;
        let next = self.advance(now);
        let settle = subject.map_or(Action::Accept { group }, Action::Judge);
        // The next slide is asked for first, so that judging overlaps its latency.
        let at = if self.ended() { 1 } else { 1 + next.len() };
        actions.extend(next);
        actions.insert(at, settle);
        actions
    }

    fn judged(
        &mut self,
        now: Timestamp,
        phase: Phase,
        subject: Subject,
        verdict: PairVerdict,
    ) -> Vec<Action> {
        self.judging = None;
        let group = subject.group();
        let role = self.roles[self.groups[group].steps().start];
        let finding = |suspicion: Suspicion| Finding {
            reason: suspicion.reason,
            role: Some(role),
            evidence: suspicion.evidence,
            sigma: Some(suspicion.sigma),
        };
        let refused = matches!(verdict, PairVerdict::Retake(_));
        self.references_hold |= matches!(subject, Subject::Pair { .. }) && !refused;
        let mut actions = match verdict {
            PairVerdict::Accept => vec![Action::Accept { group }],
            PairVerdict::Degraded(suspicion) => {
                self.findings.push(finding(suspicion));
                vec![Action::Accept { group }]
            }
            // Light that stays changed: another try would show the same, and the decode stands.
            PairVerdict::Retake(suspicion)
                if is_of_the_light(&suspicion.reason) && !self.may_help(group, &suspicion) =>
            {
                self.findings.push(finding(suspicion));
                vec![Action::Accept { group }]
            }
            PairVerdict::Retake(suspicion) if self.may_repeat(group) => {
                self.repeat_judged(subject, suspicion)
            }
            // What has changed since the first references stays changed: the scan says so and stands.
            PairVerdict::Retake(suspicion)
                if matches!(subject, Subject::Drift { .. }) && !shows_another_picture(&suspicion) =>
            {
                self.findings.push(finding(suspicion));
                vec![Action::Accept { group }]
            }
            PairVerdict::Retake(suspicion) => {
                let evidence = self.with_tries(group, suspicion.evidence);
                let Some(light) = self.changed_light(subject) else {
                    let reason = suspicion.reason;
                    let diagnosis = Diagnosis { reason, role: Some(role), evidence, source: None };
                    return self.finish(Outcome::Failed(diagnosis));
                };
                // In light that changes from take to take one pair cannot tell; all of them together can.
                let evidence = format!("{evidence}; the light changed between the takes");
                self.findings.push(finding(Suspicion { reason: light, evidence, ..suspicion }));
                vec![Action::Accept { group }]
            }
        };
        match phase {
            Phase::Shown { flip } => actions.push(self.expose(now, flip)),
            Phase::Judging => actions.extend(self.advance(now)),
            phase => self.phase = phase,
        }
        actions
    }

    /// Takes what was judged again, when the group under way is complete; the first references too where no pair
    /// so far agrees with them.
    fn repeat_judged(&mut self, subject: Subject, suspicion: Suspicion) -> Vec<Action> {
        let group = subject.group();
        let mut actions = vec![self.enter_retake(group, suspicion.reason.clone(), suspicion.evidence)];
        let is_reference = |machine: &Self, group: usize| {
            let role = machine.roles[machine.groups[group].steps().start];
            matches!(machine.groups[group], Group::Single { .. }) && !matches!(role, Role::Code { .. })
        };
        // Behind references that are to be repeated: it is judged against them.
        let place = self.queue.iter().take_while(|&&queued| is_reference(self, queued)).count();
        self.queue.insert(place, group);
        self.refused_pairs += u32::from(matches!(subject, Subject::Pair { .. }));
        if self.refused_pairs < DOUBTFUL_REFERENCES || self.references_hold || self.references_repeated {
            return actions;
        }
        self.references_repeated = true;
        for reference in (0..self.groups.len()).rev() {
            if is_reference(self, reference) && self.may_repeat(reference) {
                self.queue.push_front(reference);
                let evidence = format!("the first {} pairs do not agree with it", self.refused_pairs);
                actions.push(self.enter_retake(reference, suspicion.reason.clone(), evidence));
            }
        }
        actions
    }

    fn device_failed(
        &mut self,
        now: Timestamp,
        phase: &Phase,
        device: Device,
        error: DeviceError,
    ) -> Vec<Action> {
        let passing = matches!(error, DeviceError::Timeout { .. } | DeviceError::BadData { .. });
        let reason = match (phase, device) {
            (Phase::Showing { .. }, Device::Projector) if passing => "missed-flip",
            (Phase::Exposing { .. }, Device::Camera) if passing => {
                self.exposures.trigger_failed();
                "lost-frame"
            }
            (Phase::Awaiting(_), Device::Camera) if passing => {
                self.exposures.unanswered(true);
                "damaged-frame"
            }
            (_, Device::Projector) => {
                let evidence = "the projector gave up".to_string();
                return self.fail("projector-failed", evidence, Some((device, error)));
            }
            (_, Device::Camera) => {
                let evidence = "the camera gave up".to_string();
                return self.fail("camera-failed", evidence, Some((device, error)));
            }
        };
        self.repeat(now, reason, error.to_string())
    }

    /// Takes the current group again from its first step, at once, or gives up.
    fn repeat(&mut self, now: Timestamp, reason: &str, evidence: String) -> Vec<Action> {
        match self.current {
            Some((group, step)) if self.may_repeat(group) => {
                let evidence = format!("{}: {evidence}", self.roles[step]);
                let notice = self.enter_retake(group, reason.to_string(), evidence);
                let step = self.groups[group].steps().start;
                vec![notice, self.show_from(now, group, step)]
            }
            Some((group, _)) => {
                let evidence = self.with_tries(group, evidence);
                self.fail(reason, evidence, None)
            }
            None => self.fail(reason, evidence, None),
        }
    }

    /// Whether another try may bring a picture in better light. Notes where one was in vain.
    fn may_help(&mut self, group: usize, suspicion: &Suspicion) -> bool {
        let in_vain = self.retaken.iter().any(|take| take.group == group && take.reason == suspicion.reason);
        if in_vain && !self.lasting.contains(&suspicion.reason) {
            self.lasting.push(suspicion.reason.clone());
        }
        self.may_repeat(group) && !self.lasting.contains(&suspicion.reason)
    }

    /// Slug of the change of the light that a pair was taken again for, or any other pair in vain.
    fn changed_light(&self, subject: Subject) -> Option<String> {
        let Subject::Pair { group } = subject else { return None };
        let own = self.retaken.iter().filter(|take| take.group == group).map(|take| &take.reason);
        own.chain(&self.lasting).find(|reason| is_of_the_light(reason)).cloned()
    }

    fn may_repeat(&self, group: usize) -> bool {
        self.attempts[group] < self.retakes_each && self.retaken.len() < self.retakes_total as usize
    }

    fn enter_retake(&mut self, group: usize, reason: String, evidence: String) -> Action {
        self.attempts[group] += 1;
        let retake = GroupRetake { group, reason, evidence, attempt: self.attempts[group] };
        self.retaken.push(retake.clone());
        Action::Retake(retake)
    }

    fn with_tries(&self, group: usize, evidence: String) -> String {
        let (tries, repeated) = (self.attempts[group] + 1, self.retaken.len());
        format!("{evidence} (try {tries} of this picture, {repeated} repeated in this scan)")
    }

    fn role(&self) -> Option<Role> {
        self.current.map(|(_, step)| self.roles[step])
    }

    fn fail(&mut self, reason: &str, evidence: String, source: Option<(Device, DeviceError)>) -> Vec<Action> {
        let diagnosis = Diagnosis { reason: reason.to_string(), role: self.role(), evidence, source };
        self.finish(Outcome::Failed(diagnosis))
    }

    fn finish(&mut self, outcome: Outcome) -> Vec<Action> {
        self.phase = Phase::Ended;
        vec![Action::Black, Action::Finish(outcome)]
    }
}

/// Whether frames of this reason show what was asked for in another light.
fn is_of_the_light(reason: &str) -> bool {
    matches!(reason, "flicker" | "ambient-drift" | "exposure-drift")
}

/// Whether a frame is not the one that was asked for: as a reference it would spoil the mean of the good ones.
fn shows_another_picture(suspicion: &Suspicion) -> bool {
    matches!(suspicion.reason.as_str(), "stale-frame" | "torn-frame")
}

#[cfg(test)]
mod tests;
