//! What a capture does next: events in, actions out. No device, no clock, no thread; time is an argument.
//!
//! Two things are under way: the slide on the glass (its `Phase`) and at most one frame (its `Flight`), which belongs
//! to that slide or to the one before.
//!
//! ```text
//!                                  frame awaited, verdict on the pair before
//!                                        ^          |
//!                                        |          v
//! Idle --start--> Showing --presented--> Shown (frame or verdict outstanding)
//!                  ^   |                            |
//!                  |   +--presented, nothing outstanding--> Exposing --triggered--> (flight begins)
//!                  |                                                                 |    |
//!                  +--next slide at the end of the exposure (overlapped)-------------+    |
//!                  |                                                                      v
//!                  +--next slide, or the group again------------------ frame <--------- Bare (one by one, or the last)
//!                  |                                                     |
//!                  +--suspicious, taken again-- Judging <--nothing left to show
//!                                                  |
//!                                                  v
//! any of them --cancelled, failed, complete--> [Black, Finish] --> Ended
//! ```
//!
//! A slide that could not be shown while a frame is under way waits in `Refused` until that has come: what was exposed is
//! kept. Where the frame does not come, its own group is taken again first.
//!
//! Invariants: a slide is asked for only when no exposure is under way; an exposure starts only on a slide whose receipt
//! holds, when the frame before is in hand or given up; a frame is kept only where its stamp lies in the stable window of
//! its own slide; `Black` and `Finish` come once, together, last. Re-takes and discarded frames are bounded, so the number
//! of actions is.

mod flight;
mod types;
mod verdicts;

use std::collections::VecDeque;

use polscan_drivers::{
    clock::Timestamp,
    error::DeviceError,
    projector::{PresentReceipt, ReceiptMethod},
};
use polscan_patterns::Role;

use super::{
    ledger::{Exposures, Flips, Refusal, Window},
    plan::{self, Group, Order, Plan, Timing},
    record::Finding,
};

use flight::Flight;
pub use types::{Action, Device, Diagnosis, Event, GroupRetake, Outcome, Subject};

/// Frames that may be discarded while one is awaited.
pub const MAX_DISCARDED: u32 = 8;

/// A group and one of its steps.
type Place = (usize, usize);

#[derive(Debug, Clone, PartialEq)]
enum Phase {
    Idle,
    Showing { asked: Timestamp },
    Shown { flip: Timestamp },
    Refused(Trouble),
    Exposing { at: Timestamp },
    Bare,
    Judging,
    Ended,
}

/// What became of a slide that could not be shown.
#[derive(Debug, Clone, PartialEq)]
struct Trouble {
    reason: &'static str,
    evidence: String,
    /// The device that failed for good; a slide whose flip only went wrong is shown again.
    fatal: Option<(Device, DeviceError)>,
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
    /// Group and step of the slide that is shown or asked for.
    current: Option<Place>,
    flight: Option<Flight>,
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
            flight: None,
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
        let awaited = matches!(phase, Phase::Shown { .. } | Phase::Refused(_) | Phase::Bare);
        match (phase, event) {
            (Phase::Ended, _) => {
                self.phase = Phase::Ended;
                Vec::new()
            }
            (_, Event::CancelRequested) => self.finish(Outcome::Cancelled),
            (Phase::Idle, Event::Start) => self.advance(now),
            (Phase::Showing { asked }, Event::Presented(receipt)) => self.presented(now, asked, receipt),
            (Phase::Exposing { at }, Event::Triggered(started)) => self.triggered(now, at, started),
            (phase, Event::Judged(subject, verdict)) if self.judging == Some(subject) => {
                self.judged(now, phase, subject, verdict)
            }
            (phase, Event::DeviceFailed(device, error)) => self.device_failed(now, phase, device, error),
            (phase, event @ (Event::FrameArrived(_) | Event::TimedOut)) if awaited => {
                match (self.flight.take(), event) {
                    (Some(flight), Event::FrameArrived(stamp)) => self.arrived(now, phase, flight, &stamp),
                    (Some(flight), _) => self.timed_out(now, phase, flight),
                    (None, event) => self.defect(&event, &phase),
                }
            }
            (phase, event) => self.defect(&event, &phase),
        }
    }

    fn defect(&mut self, event: &Event, phase: &Phase) -> Vec<Action> {
        let evidence = format!("event {event:?} in state {phase:?}: a defect of the capture itself");
        self.fail("out-of-order", evidence, self.current, None)
    }

    /// The step after `(group, step)` in its group, else the first one of the next group, which leaves the queue.
    fn following(&mut self, (group, step): Place) -> Option<Place> {
        if step + 1 < self.groups[group].steps().end {
            return Some((group, step + 1));
        }
        self.queue.pop_front().map(|next| (next, self.groups[next].steps().start))
    }

    /// Shows the next step there is, waits for the last verdict, or completes.
    fn advance(&mut self, now: Timestamp) -> Vec<Action> {
        match self.queue.pop_front() {
            Some(group) => vec![self.show(now, (group, self.groups[group].steps().start))],
            None if self.judging.is_some() => {
                self.current = None;
                self.phase = Phase::Judging;
                Vec::new()
            }
            None => self.finish(Outcome::Complete),
        }
    }

    /// Shows a step when the slide before has been held as planned.
    fn show(&mut self, now: Timestamp, place: Place) -> Action {
        let due = self.flips.last().map(|receipt| self.timing.next_show(self.timing.latest_flip(receipt)));
        self.show_from(due.unwrap_or(now).max(now), place)
    }

    fn show_from(&mut self, not_before: Timestamp, place: Place) -> Action {
        // Also where nobody waits for its frame any more, an exposure is not disturbed.
        let not_before = not_before.max(self.exposed);
        self.current = Some(place);
        self.phase = Phase::Showing { asked: not_before };
        Action::Show { step: place.1, not_before }
    }

    fn presented(&mut self, now: Timestamp, asked: Timestamp, receipt: PresentReceipt) -> Vec<Action> {
        let slide = self.current.map_or(0, |(_, step)| step as u32);
        if let Err(Refusal { reason, evidence, .. }) =
            self.flips.enter(&self.timing, slide, asked, now, receipt)
        {
            return self.not_shown(now, Trouble { reason, evidence, fatal: None });
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
        if let Some(flight) = &mut self.flight {
            self.phase = Phase::Shown { flip };
            if receipt.method != ReceiptMethod::Guessed {
                flight.window.next_light = Some(self.timing.light_after(receipt.flipped));
            }
            return vec![Action::AwaitFrame { deadline: flight.deadline }];
        }
        self.expose_when_judged(now, flip)
    }

    /// The slide on the glass is not the one asked for: it is shown again when the frame under way has come.
    fn not_shown(&mut self, now: Timestamp, trouble: Trouble) -> Vec<Action> {
        match &self.flight {
            Some(flight) => {
                let deadline = flight.deadline;
                self.phase = Phase::Refused(trouble);
                vec![Action::AwaitFrame { deadline }]
            }
            None => self.shown_again(now, trouble),
        }
    }

    fn shown_again(&mut self, now: Timestamp, trouble: Trouble) -> Vec<Action> {
        let Trouble { reason, evidence, fatal } = trouble;
        match fatal {
            Some(_) => self.fail(reason, evidence, self.current, fatal),
            None => self.repeat(now, self.current, reason, evidence),
        }
    }

    fn expose_when_judged(&mut self, now: Timestamp, flip: Timestamp) -> Vec<Action> {
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

    fn triggered(&mut self, now: Timestamp, at: Timestamp, started: Timestamp) -> Vec<Action> {
        self.exposures.trigger();
        let began = at.max(started);
        self.exposed = self.timing.exposed(began);
        let deadline = self.timing.frame_deadline(began);
        let Some(place) = self.current else {
            return self.fail("out-of-order", "an exposure of no step".to_string(), None, None);
        };
        let mut window = Window { at, started, next_light: None };
        let overlapped = self.timing.order == Order::Overlapped;
        let next = if overlapped { self.following(place) } else { None };
        let action = match next {
            Some(next) => self.show(now, next),
            None => {
                self.phase = Phase::Bare;
                Action::AwaitFrame { deadline }
            }
        };
        if let Phase::Showing { asked } = self.phase {
            window.next_light = Some(self.timing.light_after(asked));
        }
        self.flight = Some(Flight { place, window, deadline, discarded: 0, last: None });
        vec![action]
    }

    fn device_failed(
        &mut self,
        now: Timestamp,
        phase: Phase,
        device: Device,
        error: DeviceError,
    ) -> Vec<Action> {
        let passing = matches!(error, DeviceError::Timeout { .. } | DeviceError::BadData { .. });
        match (&phase, device, self.flight.take()) {
            (Phase::Showing { .. }, Device::Projector, flight) => {
                self.flight = flight;
                let trouble = match passing {
                    true => Trouble { reason: "missed-flip", evidence: error.to_string(), fatal: None },
                    false => gone(device, error),
                };
                self.not_shown(now, trouble)
            }
            (Phase::Exposing { .. }, Device::Camera, _) if passing => {
                self.exposures.trigger_failed();
                self.repeat(now, self.current, "lost-frame", error.to_string())
            }
            (Phase::Shown { .. } | Phase::Refused(_) | Phase::Bare, Device::Camera, Some(flight))
                if passing =>
            {
                self.exposures.unanswered(true);
                self.lose(now, phase, flight.place, "damaged-frame", error.to_string())
            }
            (_, _, flight) => {
                let Trouble { reason, evidence, fatal } = gone(device, error);
                let place = flight.map_or(self.current, |flight| Some(flight.place));
                self.fail(reason, evidence, place, fatal)
            }
        }
    }

    /// Takes the group of `place` again from its first step, at once, or gives up.
    fn repeat(
        &mut self,
        now: Timestamp,
        place: Option<Place>,
        reason: &str,
        evidence: String,
    ) -> Vec<Action> {
        match place {
            Some((group, step)) if self.may_repeat(group) => {
                let evidence = format!("{}: {evidence}", self.roles[step]);
                let notice = self.enter_retake(group, reason.to_string(), evidence);
                let step = self.groups[group].steps().start;
                vec![notice, self.show_from(now, (group, step))]
            }
            Some((group, _)) => {
                let evidence = self.with_tries(group, evidence);
                self.fail(reason, evidence, place, None)
            }
            None => self.fail(reason, evidence, None, None),
        }
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

    fn fail(
        &mut self,
        reason: &str,
        evidence: String,
        place: Option<Place>,
        source: Option<(Device, DeviceError)>,
    ) -> Vec<Action> {
        let role = place.map(|(_, step)| self.roles[step]);
        self.finish(Outcome::Failed(Diagnosis { reason: reason.to_string(), role, evidence, source }))
    }

    fn finish(&mut self, outcome: Outcome) -> Vec<Action> {
        self.phase = Phase::Ended;
        vec![Action::Black, Action::Finish(outcome)]
    }
}

/// A device that failed for good.
fn gone(device: Device, error: DeviceError) -> Trouble {
    let (reason, evidence) = match device {
        Device::Projector => ("projector-failed", "the projector gave up"),
        Device::Camera => ("camera-failed", "the camera gave up"),
    };
    Trouble { reason, evidence: evidence.to_string(), fatal: Some((device, error)) }
}

#[cfg(test)]
mod tests;
