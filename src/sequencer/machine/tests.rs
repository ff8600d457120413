use std::time::Duration;

use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraSettings, Overlap, PixelFormat, TriggerSource},
    frame::FrameStamp,
    projector::{ProjectorInfo, ProjectorTiming},
};
use polscan_patterns::{Mode, Polarization, ProjectorSize, Sequence};
use proptest::prelude::*;

use super::*;
use crate::sequencer::{
    judge::{PairVerdict, Suspicion},
    plan::PlanOptions,
};

mod pace;

fn plan(mode: Mode) -> Plan {
    plan_for(mode, None)
}

fn projector() -> ProjectorInfo {
    ProjectorInfo {
        driver: "test".into(),
        model: "panel".into(),
        serial: "1".into(),
        width: 4,
        height: 2,
        refresh_period: Duration::from_millis(10),
        display: None,
        timing: Some(ProjectorTiming {
            latency: Duration::from_millis(20),
            settling: Duration::from_millis(10),
        }),
    }
}

fn camera(overlap: Option<Overlap>) -> CameraInfo {
    CameraInfo {
        driver: "test".into(),
        model: "eye".into(),
        serial: "1".into(),
        sensor_width: 2,
        sensor_height: 1,
        triggered: true,
        overlap,
    }
}

fn plan_for(mode: Mode, overlap: Option<Overlap>) -> Plan {
    let settings = CameraSettings {
        exposure_us: 2000.0,
        gain_db: 0.0,
        gamma: 1.0,
        region: None,
        format: PixelFormat::Mono12,
        trigger: TriggerSource::Software,
    };
    let applied = AppliedSettings {
        settings,
        width: 2,
        height: 1,
        black_level_dn: None,
        saturation_dn: 4095,
        readout_us: 5000.0,
        noise: None,
    };
    let sequence = Sequence::new(mode, ProjectorSize { width: 4, height: 2 }).unwrap();
    let (projector, camera) = (projector(), camera(overlap));
    let polarization = Polarization::green_horizontal();
    Plan::new(sequence, polarization, &projector, &camera, applied, &PlanOptions::default()).unwrap()
}

fn after(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

/// A machine, the time, and a healthy rig that answers its actions where the story does not.
struct Story {
    machine: Machine,
    now: Timestamp,
    actions: VecDeque<Action>,
    trace: Vec<Action>,
    frames: u64,
    triggered: Timestamp,
}

impl Story {
    fn begin(mode: Mode) -> Self {
        Self::of(&plan(mode))
    }

    /// With a camera that takes triggers while it reads out.
    fn overlapped(mode: Mode) -> Self {
        Self::of(&plan_for(mode, Some(Overlap { latency: Duration::ZERO, stamped: true })))
    }

    fn of(plan: &Plan) -> Self {
        let machine = Machine::new(plan, true);
        let mut story = Self {
            machine,
            now: Timestamp(1_000_000_000),
            actions: VecDeque::new(),
            trace: Vec::new(),
            frames: 0,
            triggered: Timestamp(0),
        };
        story.tell(Event::Start);
        story
    }

    fn tell(&mut self, event: Event) {
        let actions = self.machine.handle(self.now, event);
        if self.machine.ended() {
            self.actions.clear();
        }
        self.trace.extend(actions.iter().cloned());
        self.actions.extend(actions);
    }

    /// What a healthy rig answers to `action`, with the time it takes.
    fn answer(&mut self, action: &Action) -> Option<Event> {
        match action {
            Action::Show { step, not_before } => {
                let refresh = self.now.max(*not_before).0 / 10_000_000 + 1;
                self.now = Timestamp(refresh * 10_000_000);
                Some(Event::Presented(self.receipt(*step as u32)))
            }
            Action::Trigger { at } => {
                self.now = self.now.max(*at);
                self.triggered = self.now;
                Some(Event::Triggered(self.now))
            }
            Action::AwaitFrame { .. } => {
                self.now = self.now.max(self.triggered + after(7));
                let stamp = self.stamp(self.frames, self.triggered);
                self.frames += 1;
                Some(Event::FrameArrived(stamp))
            }
            Action::Judge(subject) => Some(Event::Judged(*subject, PairVerdict::Accept)),
            _ => None,
        }
    }

    fn receipt(&self, slide: u32) -> PresentReceipt {
        PresentReceipt {
            slide: Some(slide),
            flipped: self.now,
            refresh: Some(self.now.0 / 10_000_000),
            method: ReceiptMethod::Simulated,
        }
    }

    fn stamp(&self, frame_id: u64, exposure_start: Timestamp) -> FrameStamp {
        FrameStamp { frame_id, trigger: frame_id, exposure_start, received: self.now, device_time_ns: None }
    }

    /// Lets the healthy rig work until the next action is one that `stop` names, which is taken off.
    fn until(&mut self, stop: impl Fn(&Action) -> bool) -> Action {
        while let Some(action) = self.actions.pop_front() {
            if stop(&action) {
                return action;
            }
            if let Some(event) = self.answer(&action) {
                self.tell(event);
            }
        }
        panic!("the story ended before: {:?}", self.trace);
    }

    fn until_shown(&mut self, wanted: usize) {
        self.until(|action| matches!(action, Action::Show { step, .. } if *step == wanted));
    }

    fn until_awaited(&mut self, wanted: usize) -> Timestamp {
        self.until_shown(wanted);
        let flip = self.now.0 / 10_000_000 + 1;
        self.now = Timestamp(flip * 10_000_000);
        self.tell(Event::Presented(self.receipt(wanted as u32)));
        match self.until(|action| matches!(action, Action::AwaitFrame { .. })) {
            Action::AwaitFrame { deadline } => deadline,
            _ => unreachable!("stopped at another action"),
        }
    }

    fn lose_frame(&mut self, step: usize) {
        self.now = self.until_awaited(step);
        self.frames += 1;
        self.tell(Event::TimedOut);
    }

    fn outcome(&mut self) -> Outcome {
        match self.until(|action| matches!(action, Action::Finish(_))) {
            Action::Finish(outcome) => outcome,
            _ => unreachable!("stopped at another action"),
        }
    }

    fn failure(&mut self) -> Diagnosis {
        match self.outcome() {
            Outcome::Failed(diagnosis) => diagnosis,
            outcome => panic!("ended as {outcome:?}"),
        }
    }

    fn shown(&self) -> Vec<usize> {
        let step = |action: &Action| match action {
            Action::Show { step, .. } => Some(*step),
            _ => None,
        };
        self.trace.iter().filter_map(step).collect()
    }

    fn retakes(&self) -> Vec<(usize, &str, u32)> {
        self.machine
            .retaken()
            .iter()
            .map(|retake| (retake.group, retake.reason.as_str(), retake.attempt))
            .collect()
    }
}

fn suspicious(reason: &str) -> PairVerdict {
    PairVerdict::Retake(Suspicion { reason: reason.into(), evidence: "seen".into(), sigma: 9.0 })
}

// Mode `pse` on 4x2 pixels: steps 0-1 references (groups 0-1), 2-7 pairs (groups 2-4), 8-9 references (groups 5-6).

#[test]
fn a_healthy_scan_shows_each_slide_once_and_ends_black() {
    let mut story = Story::begin(Mode::Pse);
    let begun = story.now;
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), (0..10).collect::<Vec<_>>());
    assert_eq!(story.trace[story.trace.len() - 2], Action::Black);
    assert!(story.machine.retaken().is_empty() && story.machine.findings().is_empty());
    let accepted = story.trace.iter().filter(|action| matches!(action, Action::Accept { .. })).count();
    assert_eq!(accepted, 7);
    assert_eq!(story.machine.triggers(), 10);
    // Delay 31 ms, exposure 2, readout 5, lead 2: four refreshes a slide, one refresh before the first.
    assert_eq!(story.now.since(begun), after(10 + 9 * 40 + 31 + 7));
}

#[test]
fn references_are_accepted_before_the_first_pair_is_judged() {
    let mut story = Story::begin(Mode::Pse);
    story.outcome();
    let index = |wanted: &dyn Fn(&Action) -> bool| story.trace.iter().position(wanted).unwrap();
    let first_pair = index(&|action| matches!(action, Action::Judge(_)));
    assert!(index(&|action| *action == Action::Accept { group: 0 }) < first_pair);
    assert!(index(&|action| *action == Action::Accept { group: 1 }) < first_pair);
}

#[test]
fn judging_overlaps_the_next_slide_and_holds_its_exposure() {
    let mut story = Story::begin(Mode::Pse);
    let judged = story.until(|action| matches!(action, Action::Judge(_)));
    assert_eq!(judged, Action::Judge(Subject::Pair { group: 2 }));
    // The next slide is on the glass, and nothing is exposed until the verdict is there.
    assert_eq!(story.shown().last(), Some(&4));
    assert!(story.actions.is_empty());
    let flip = story.now;
    story.now = flip + after(45);
    story.tell(Event::Judged(Subject::Pair { group: 2 }, PairVerdict::Accept));
    // 31 ms have passed: two refreshes later, in the same phase.
    assert_eq!(story.actions[1], Action::Trigger { at: flip + after(51) });
    assert_eq!(story.outcome(), Outcome::Complete);
}

#[test]
fn a_lost_frame_repeats_its_pair() {
    let mut story = Story::begin(Mode::Pse);
    story.lose_frame(5);
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 2, 3, 4, 5, 4, 5, 6, 7, 8, 9]);
    assert_eq!(story.retakes(), [(3, "lost-frame", 1)]);
}

#[test]
fn a_lost_reference_repeats_the_reference_alone() {
    let mut story = Story::begin(Mode::Pse);
    story.lose_frame(1);
    story.lose_frame(9);
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9]);
}

#[test]
fn a_camera_that_stays_silent_ends_the_scan_after_three_tries() {
    let mut story = Story::begin(Mode::Pse);
    for _ in 0..3 {
        story.lose_frame(2);
    }
    let diagnosis = story.failure();
    assert_eq!(diagnosis.reason, "lost-frame");
    assert_eq!(diagnosis.role.unwrap().to_string(), "column bit 0");
    assert!(diagnosis.evidence.contains("try 3 of this picture"), "{}", diagnosis.evidence);
}

#[test]
fn repeats_are_bounded_in_all() {
    let mut story = Story::begin(Mode::Pse);
    for step in [2, 2, 4, 4, 6, 6, 8] {
        story.lose_frame(step);
    }
    let diagnosis = story.failure();
    assert!(diagnosis.evidence.contains("try 1 of this picture, 6 repeated"), "{}", diagnosis.evidence);
}

#[test]
fn a_suspicious_pair_is_repeated_after_the_one_under_way() {
    let mut story = Story::begin(Mode::Pse);
    story.until(|action| matches!(action, Action::Judge(_)));
    story.tell(Event::Judged(Subject::Pair { group: 2 }, suspicious("torn-frame")));
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 2, 3, 4, 5, 2, 3, 6, 7, 8, 9]);
    assert_eq!(story.retakes(), [(2, "torn-frame", 1)]);
}

#[test]
fn references_that_no_pair_agrees_with_are_repeated() {
    let mut story = Story::begin(Mode::Pse);
    let refuse = |story: &mut Story, group: usize| {
        story.until(|action| *action == Action::Judge(Subject::Pair { group }));
        story.tell(Event::Judged(Subject::Pair { group }, suspicious("torn-frame")));
    };
    refuse(&mut story, 2);
    refuse(&mut story, 3);
    // Pair 2 was under way for the second time, against the old references.
    refuse(&mut story, 2);
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 2, 3, 4, 5, 2, 3, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
    let groups: Vec<usize> = story.retakes().iter().map(|retake| retake.0).collect();
    assert_eq!(groups, [2, 3, 1, 0, 2]);
}

#[test]
fn references_that_a_pair_agreed_with_are_not_doubted() {
    let mut story = Story::begin(Mode::Pse);
    for group in [3, 4] {
        story.until(|action| *action == Action::Judge(Subject::Pair { group }));
        story.tell(Event::Judged(Subject::Pair { group }, suspicious("motion")));
    }
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.retakes().len(), 2);
}

#[test]
fn the_last_pair_is_repeated_before_the_scan_completes() {
    let mut story = Story::begin(Mode::Paper);
    story.until(|action| *action == Action::Judge(Subject::Pair { group: 3 }));
    story.tell(Event::Judged(Subject::Pair { group: 3 }, suspicious("motion")));
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 2, 3, 4, 5, 6, 5, 6]);
}

#[test]
fn a_pair_that_stays_suspicious_fails_the_scan_by_name() {
    let mut story = Story::begin(Mode::Pse);
    for _ in 0..3 {
        story.until(|action| *action == Action::Judge(Subject::Pair { group: 2 }));
        story.tell(Event::Judged(Subject::Pair { group: 2 }, suspicious("torn-frame")));
    }
    let diagnosis = story.failure();
    assert_eq!(
        (diagnosis.reason.as_str(), diagnosis.role.unwrap().to_string()),
        ("torn-frame", "column bit 0".into())
    );
    assert_eq!(story.retakes(), [(2, "torn-frame", 1), (2, "torn-frame", 2)]);
}

#[test]
fn light_that_stays_changed_is_noted_after_one_try_and_the_scan_goes_on() {
    let mut story = Story::begin(Mode::Pse);
    // Group 3 was under way when 2 was refused; by the time of 4 it is known that another try does not help.
    for group in [2, 3, 2, 3, 4] {
        story.until(|action| *action == Action::Judge(Subject::Pair { group }));
        story.tell(Event::Judged(Subject::Pair { group }, suspicious("flicker")));
    }
    assert_eq!(story.outcome(), Outcome::Complete);
    // With the first two pairs refused the references are in doubt, and taken again once as well.
    let flicker = |group| (group, "flicker", 1);
    assert_eq!(story.retakes(), [flicker(2), flicker(3), flicker(1), flicker(0)]);
    let findings: Vec<_> = story.machine.findings().iter().map(|finding| finding.reason.as_str()).collect();
    assert_eq!(findings, ["flicker"; 3]);
}

#[test]
fn a_pair_that_cannot_be_told_in_changing_light_is_left_to_the_whole_scan() {
    let mut story = Story::begin(Mode::Pse);
    for reason in ["torn-frame", "ambient-drift", "torn-frame"] {
        story.until(|action| *action == Action::Judge(Subject::Pair { group: 2 }));
        story.tell(Event::Judged(Subject::Pair { group: 2 }, suspicious(reason)));
    }
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.retakes(), [(2, "torn-frame", 1), (2, "ambient-drift", 2)]);
    let [finding] = story.machine.findings() else { panic!("{:?}", story.machine.findings()) };
    assert_eq!(finding.reason, "ambient-drift");
    assert!(finding.evidence.contains("the light changed between the takes"), "{}", finding.evidence);
}

#[test]
fn a_dip_of_the_lamp_costs_one_try() {
    let mut story = Story::begin(Mode::Pse);
    story.until(|action| *action == Action::Judge(Subject::Pair { group: 2 }));
    story.tell(Event::Judged(Subject::Pair { group: 2 }, suspicious("flicker")));
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.retakes(), [(2, "flicker", 1)]);
    assert!(story.machine.findings().is_empty());
}

#[test]
fn a_degraded_pair_is_noted_and_stands() {
    let mut story = Story::begin(Mode::Pse);
    story.until(|action| matches!(action, Action::Judge(_)));
    let suspicion = Suspicion { reason: "nonlinear-response".into(), evidence: "edges".into(), sigma: 2.5 };
    story.tell(Event::Judged(Subject::Pair { group: 2 }, PairVerdict::Degraded(suspicion)));
    assert_eq!(story.outcome(), Outcome::Complete);
    let [finding] = story.machine.findings() else { panic!("{:?}", story.machine.findings()) };
    assert_eq!((finding.reason.as_str(), finding.sigma), ("nonlinear-response", Some(2.5)));
    assert!(story.machine.retaken().is_empty());
}

#[test]
fn references_that_stay_changed_are_reported_and_do_not_fail_the_scan() {
    let mut story = Story::begin(Mode::Pse);
    for _ in 0..3 {
        story.until(|action| *action == Action::Judge(Subject::Drift { group: 6 }));
        story.tell(Event::Judged(Subject::Drift { group: 6 }, suspicious("motion")));
    }
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.retakes().len(), 2);
    assert_eq!(story.machine.findings()[0].reason, "motion");
}

#[test]
fn a_last_reference_that_keeps_showing_another_picture_fails_the_scan() {
    for reason in ["stale-frame", "torn-frame"] {
        let mut story = Story::begin(Mode::Pse);
        for _ in 0..3 {
            story.until(|action| *action == Action::Judge(Subject::Drift { group: 6 }));
            story.tell(Event::Judged(Subject::Drift { group: 6 }, suspicious(reason)));
        }
        let diagnosis = story.failure();
        assert_eq!(diagnosis.reason, reason);
        assert!(matches!(diagnosis.role, Some(Role::ReferenceH | Role::ReferenceV)), "{diagnosis:?}");
        assert_eq!(story.retakes().len(), 2);
        assert!(!story.trace.contains(&Action::Accept { group: 6 }));
        assert!(story.machine.findings().is_empty());
    }
}

#[test]
fn a_frame_of_an_earlier_slide_is_dropped_and_the_right_one_awaited() {
    let mut story = Story::begin(Mode::Pse);
    story.lose_frame(4);
    let deadline = story.until_awaited(4);
    let stale = story.stamp(story.frames - 1, Timestamp(story.triggered.0 - 300_000_000));
    story.tell(Event::FrameArrived(stale));
    assert_eq!(story.actions, [Action::AwaitFrame { deadline }]);
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.machine.discarded()[0].reason, "stale-frame");
}

#[test]
fn an_endless_stream_of_repeated_frames_does_not_hold_the_scan() {
    let mut story = Story::begin(Mode::Pse);
    for _ in 0..3 {
        story.until_awaited(2);
        for _ in 0..MAX_DISCARDED {
            let duplicate = story.stamp(story.frames - 1, Timestamp(0));
            story.tell(Event::FrameArrived(duplicate));
            story.actions.retain(|action| !matches!(action, Action::AwaitFrame { .. }));
        }
    }
    // Each repeat waits for the end of the exposure under way, of 2 ms, though no frame is awaited any more.
    let (mut exposed, mut repeats) = (Timestamp(0), 0);
    for action in &story.trace {
        match action {
            Action::Trigger { at } => exposed = *at + after(2),
            Action::Show { step: 2, not_before } => {
                assert!(*not_before >= exposed);
                repeats += 1;
            }
            _ => {}
        }
    }
    assert_eq!(repeats, 3);
    assert_eq!(story.failure().reason, "duplicate-frame");
}

#[test]
fn a_timeout_after_a_foreign_frame_names_that_frame() {
    let mut story = Story::begin(Mode::Pse);
    let deadline = story.until_awaited(3);
    let stale = story.stamp(story.frames, Timestamp(story.triggered.0 - 100_000_000));
    story.frames += 1;
    story.tell(Event::FrameArrived(stale));
    assert_eq!(story.actions.pop_front(), Some(Action::AwaitFrame { deadline }));
    story.now = deadline;
    story.tell(Event::TimedOut);
    assert_eq!(story.retakes(), [(2, "stale-frame", 1)]);
    assert_eq!(story.outcome(), Outcome::Complete);
}

#[test]
fn a_receipt_for_another_slide_is_no_proof() {
    let mut story = Story::begin(Mode::Pse);
    story.until_shown(3);
    story.now = Timestamp((story.now.0 / 10_000_000 + 3) * 10_000_000);
    story.tell(Event::Presented(story.receipt(2)));
    assert_eq!(story.retakes(), [(2, "wrong-slide", 1)]);
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown()[..6], [0, 1, 2, 3, 2, 3]);
}

#[test]
fn a_guessed_flip_gets_more_time_and_a_finding() {
    let mut story = Story::begin(Mode::Fast);
    story.until_shown(0);
    let guessed = PresentReceipt { method: ReceiptMethod::Guessed, refresh: None, ..story.receipt(0) };
    story.tell(Event::Presented(guessed));
    assert_eq!(story.actions, [Action::Trigger { at: guessed.flipped + after(20 + 31) }]);
    assert_eq!(story.machine.findings()[0].reason, "guessed-flips");
}

#[test]
fn a_device_that_goes_away_ends_the_scan_at_once() {
    let gone = DeviceError::Unavailable { device: "cam".into(), detail: "unplugged".into() };
    let mut story = Story::begin(Mode::Pse);
    story.until_awaited(3);
    story.tell(Event::DeviceFailed(Device::Camera, gone.clone()));
    let diagnosis = story.failure();
    assert_eq!(
        (diagnosis.reason.as_str(), diagnosis.source),
        ("camera-failed", Some((Device::Camera, gone.clone())))
    );
    let mut story = Story::begin(Mode::Pse);
    story.until_shown(3);
    story.tell(Event::DeviceFailed(Device::Projector, gone));
    assert_eq!(story.failure().reason, "projector-failed");
    assert_eq!(story.shown(), [0, 1, 2, 3]);
}

#[test]
fn passing_troubles_of_devices_are_repeated() {
    let timeout = DeviceError::Timeout { device: "d".into(), awaited: "answer", timeout_ms: 5 };
    let bad = DeviceError::BadData { device: "cam".into(), detail: "half a frame".into() };
    let mut story = Story::begin(Mode::Pse);
    story.until_shown(2);
    story.tell(Event::DeviceFailed(Device::Projector, timeout.clone()));
    story.until_awaited(4);
    story.frames += 1;
    story.tell(Event::DeviceFailed(Device::Camera, bad));
    story.until(|action| matches!(action, Action::Trigger { .. }));
    story.tell(Event::DeviceFailed(Device::Camera, timeout));
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.retakes(), [(2, "missed-flip", 1), (3, "damaged-frame", 1), (3, "lost-frame", 2)]);
}

#[test]
fn cancel_ends_in_every_state() {
    for steps in 0..60 {
        let mut story = Story::begin(Mode::Pse);
        for _ in 0..steps {
            let Some(action) = story.actions.pop_front() else { break };
            if let Some(event) = story.answer(&action) {
                story.tell(event);
            }
        }
        if story.machine.ended() {
            continue;
        }
        story.tell(Event::CancelRequested);
        assert_eq!(story.actions, [Action::Black, Action::Finish(Outcome::Cancelled)]);
        assert!(story.machine.handle(story.now, Event::Start).is_empty(), "nothing follows the end");
    }
}

#[test]
fn the_next_slide_is_asked_for_when_the_exposure_is_over_and_exposed_when_the_frame_is_in_hand() {
    let mut story = Story::overlapped(Mode::Pse);
    let Action::Trigger { at } = story.until(|action| matches!(action, Action::Trigger { .. })) else {
        unreachable!("stopped at another action")
    };
    let flip = story.now;
    story.now = at;
    story.tell(Event::Triggered(at));
    // Delay 31 ms, exposure 2, guard 2; a quarter into the refresh before the next flip is earlier.
    assert_eq!(story.actions, [Action::Show { step: 1, not_before: flip + after(35) }]);
    story.actions.clear();
    story.now = flip + after(40);
    story.tell(Event::Presented(story.receipt(1)));
    let deadline = at + after(2 + 5 + 250);
    assert_eq!(story.actions, [Action::AwaitFrame { deadline }]);
    story.actions.clear();
    story.tell(Event::FrameArrived(story.stamp(0, at)));
    assert_eq!(
        story.actions,
        [
            Action::Keep { step: 0 },
            Action::Accept { group: 0 },
            Action::Trigger { at: flip + after(40 + 31) }
        ]
    );
}

#[test]
fn a_frame_lost_behind_the_next_slide_is_taken_again_before_that() {
    let mut story = Story::overlapped(Mode::Pse);
    // The frame of step 3, the last of its pair, is awaited when slide 4 of the next pair is on the glass.
    story.until_shown(4);
    story.now = Timestamp((story.now.0 / 10_000_000 + 2) * 10_000_000);
    story.tell(Event::Presented(story.receipt(4)));
    assert!(matches!(story.actions.pop_front(), Some(Action::AwaitFrame { .. })));
    story.frames += 1;
    story.tell(Event::TimedOut);
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 2, 3, 4, 2, 3, 4, 5, 6, 7, 8, 9]);
    assert_eq!(story.retakes(), [(2, "lost-frame", 1)]);
}

#[test]
fn a_slide_that_fails_over_a_frame_costs_its_own_group_only() {
    let timeout = DeviceError::Timeout { device: "d".into(), awaited: "flip", timeout_ms: 5 };
    let mut story = Story::overlapped(Mode::Pse);
    story.until_shown(4);
    story.tell(Event::DeviceFailed(Device::Projector, timeout));
    assert!(matches!(story.actions.front(), Some(Action::AwaitFrame { .. })));
    assert_eq!(story.outcome(), Outcome::Complete);
    assert_eq!(story.shown(), [0, 1, 2, 3, 4, 4, 5, 6, 7, 8, 9]);
    assert_eq!(story.retakes(), [(3, "missed-flip", 1)]);
    assert!(story.trace.contains(&Action::Judge(Subject::Pair { group: 2 })));
}

#[test]
fn an_impossible_event_ends_the_scan_as_a_defect() {
    let mut story = Story::begin(Mode::Pse);
    story.tell(Event::Triggered(story.now));
    assert_eq!(story.failure().reason, "out-of-order");
}

/// Something that may happen instead of what a healthy rig does.
#[derive(Debug, Clone)]
enum Whim {
    Healthy,
    Timeout,
    Stamp { id_offset: i64, trigger_offset: i64, time_offset_ms: i64 },
    Receipt { slide: Option<u32>, flip_offset_ms: i64, refresh: Option<u64>, guessed: bool },
    Device(Device, DeviceError),
    Verdict(u8, usize),
    Start,
    Cancel,
}

fn whim() -> impl Strategy<Value = Whim> {
    let device = prop_oneof![Just(Device::Projector), Just(Device::Camera)];
    let error = prop_oneof![
        Just(DeviceError::Timeout { device: "d".into(), awaited: "answer", timeout_ms: 1 }),
        Just(DeviceError::BadData { device: "d".into(), detail: "bad".into() }),
        Just(DeviceError::Unavailable { device: "d".into(), detail: "gone".into() }),
    ];
    prop_oneof![
        40 => Just(Whim::Healthy),
        1 => Just(Whim::Timeout),
        2 => (-3i64..4, -3i64..4, -200i64..200).prop_map(|(id_offset, trigger_offset, time_offset_ms)| {
            Whim::Stamp { id_offset, trigger_offset, time_offset_ms }
        }),
        1 => (proptest::option::of(0u32..12), -100i64..200, proptest::option::of(0u64..200), any::<bool>())
            .prop_map(|(slide, flip_offset_ms, refresh, guessed)| {
                Whim::Receipt { slide, flip_offset_ms, refresh, guessed }
            }),
        1 => (device, error).prop_map(|(device, error)| Whim::Device(device, error)),
        2 => (0u8..3, 0usize..7).prop_map(|(kind, group)| Whim::Verdict(kind, group)),
        1 => Just(Whim::Start),
        1 => Just(Whim::Cancel),
    ]
}

/// The event that `whim` makes of `action`: one that the action can have; with `anything`, any but the failure of a
/// device that was not asked to do anything.
fn twisted(story: &mut Story, action: &Action, whim: &Whim, anything: bool) -> Option<Event> {
    let moved = |time: Timestamp, ms: i64| Timestamp(time.0.saturating_add_signed(ms * 1_000_000));
    let verdict = |kind: u8| match kind {
        0 => PairVerdict::Accept,
        1 => PairVerdict::Degraded(Suspicion { reason: "odd".into(), evidence: "x".into(), sigma: 1.0 }),
        _ => suspicious("motion"),
    };
    let healthy = story.answer(action);
    match (whim, action) {
        (Whim::Healthy, _) => healthy,
        (Whim::Timeout, Action::AwaitFrame { .. }) => Some(Event::TimedOut),
        (Whim::Stamp { id_offset, trigger_offset, time_offset_ms }, Action::AwaitFrame { .. }) => {
            let mut stamp = story.stamp(story.frames, moved(story.triggered, *time_offset_ms));
            stamp.frame_id = stamp.frame_id.saturating_add_signed(*id_offset);
            stamp.trigger = stamp.trigger.saturating_add_signed(*trigger_offset);
            Some(Event::FrameArrived(stamp))
        }
        (Whim::Receipt { slide, flip_offset_ms, refresh, guessed }, Action::Show { .. }) => {
            let method = if *guessed { ReceiptMethod::Guessed } else { ReceiptMethod::X11Present };
            let flipped = moved(story.now, *flip_offset_ms);
            Some(Event::Presented(PresentReceipt { slide: *slide, flipped, refresh: *refresh, method }))
        }
        (Whim::Verdict(kind, _), Action::Judge(subject)) => Some(Event::Judged(*subject, verdict(*kind))),
        (
            Whim::Device(device, error),
            Action::Show { .. } | Action::Trigger { .. } | Action::AwaitFrame { .. },
        ) => Some(Event::DeviceFailed(*device, error.clone())),
        (Whim::Cancel, _) => Some(Event::CancelRequested),
        (Whim::Start, _) if anything => Some(Event::Start),
        (Whim::Verdict(kind, group), _) if anything => {
            Some(Event::Judged(Subject::Pair { group: *group }, verdict(*kind)))
        }
        (Whim::Timeout, _) if anything => Some(Event::TimedOut),
        _ => healthy,
    }
}

/// Holds for every trace of actions and events, however mad the events.
fn assert_sane(story: &Story, overlapped: bool, log: &[Result<Action, Event>]) {
    let finishes = story.trace.iter().filter(|action| matches!(action, Action::Finish(_))).count();
    let blacks = story.trace.iter().filter(|action| **action == Action::Black).count();
    assert_eq!((finishes, blacks), (1, 1));
    assert_eq!(story.trace[story.trace.len() - 2], Action::Black);
    assert!(matches!(story.trace.last(), Some(Action::Finish(_))));
    assert!(story.machine.retaken().len() <= 6);
    // Groups and repeats, of two steps with show, trigger, awaits and keep, with notice, judgement and acceptance.
    // Each repeat may have cost a slide that was on the glass too early.
    assert!(story.trace.len() <= (7 + 6) * (2 * (3 + MAX_DISCARDED as usize + 1) + 3) + 2 + 6 * 2);

    // One slide at a time: shown, then exposed to its end, or refused; and one frame at a time.
    let (mut presenting, mut triggering, mut exposing, mut fresh) = (false, false, false, false);
    for entry in log {
        match entry {
            Ok(Action::Show { .. }) => {
                assert!(!presenting && !triggering, "a second slide in flight");
                assert!(overlapped || !exposing, "a slide over a frame that is awaited");
                presenting = true;
            }
            Ok(Action::Trigger { .. }) => {
                assert!(!presenting && !triggering, "an exposure without its slide");
                assert!(!exposing, "a second frame in flight");
                triggering = true;
            }
            Ok(Action::Keep { .. }) => {
                assert!(std::mem::take(&mut fresh), "a frame kept that did not arrive")
            }
            Err(Event::Presented(_)) => presenting = false,
            Err(Event::Triggered(_)) => (triggering, exposing) = (false, true),
            Err(Event::DeviceFailed(..)) => (presenting, triggering, exposing) = (false, false, false),
            Err(Event::FrameArrived(_)) => (exposing, fresh) = (false, true),
            Err(Event::TimedOut) => exposing = false,
            Ok(Action::AwaitFrame { .. }) => exposing = true,
            _ => {}
        }
    }
}

fn run_with(whims: &[Whim], overlapped: bool, anything: bool) -> Story {
    let mut story = if overlapped { Story::overlapped(Mode::Pse) } else { Story::begin(Mode::Pse) };
    let mut log: Vec<Result<Action, Event>> = Vec::new();
    let mut whims = whims.iter();
    let mut bound = 2000;
    while let Some(action) = story.actions.pop_front() {
        bound -= 1;
        assert!(bound > 0, "the story does not end");
        log.push(Ok(action.clone()));
        let whim = whims.next().unwrap_or(&Whim::Healthy);
        if let Some(event) = twisted(&mut story, &action, whim, anything) {
            log.push(Err(event.clone()));
            story.tell(event);
        }
    }
    assert!(story.machine.ended(), "stuck: {:?}", story.trace);
    assert_sane(&story, overlapped, &log);
    story
}

proptest! {
    #[test]
    fn whatever_devices_and_judge_do_the_scan_ends_once_and_black(
        whims in prop::collection::vec(whim(), 0..120),
        overlapped in any::<bool>(),
    ) {
        let story = run_with(&whims, overlapped, false);
        let defect = story.trace.iter().any(|action| {
            matches!(action, Action::Finish(Outcome::Failed(diagnosis)) if diagnosis.reason == "out-of-order")
        });
        prop_assert!(!defect, "{:?}", story.trace);
    }

    #[test]
    fn whatever_events_come_in_whatever_order_the_scan_ends_once_and_black(
        whims in prop::collection::vec(whim(), 0..120),
        overlapped in any::<bool>(),
    ) {
        run_with(&whims, overlapped, true);
    }
}
