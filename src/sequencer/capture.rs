//! The thin shell around the [`Machine`]: it does what the machine says and tells it what came of it.
//!
//! The file is long because shell, guard and errors share the rig's private state.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::Duration,
};

use polscan_drivers::{
    camera::{Camera, StreamStatistics},
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::Frame,
    projector::{PresentReceipt, Projector, Slide},
};
use polscan_patterns::{Raster, Role};

use super::{
    failure::{CaptureError, CaptureFailure, PartialCapture},
    judge::{Judge, PairVerdict, Suspicion},
    machine::{Action, Device, Event, GroupRetake, Machine, Outcome, Subject},
    plan::{Group, Plan},
    record::{CaptureNotes, CaptureRecord, CapturedFrame, Finding, ReferenceRetake, Retake},
    synchrony::Synchrony,
};

/// Longest wait between two looks at the cancel flag.
const POLL: Duration = Duration::from_millis(20);

/// How long before an exposure the camera is told of it.
const TRIGGER_LEAD: Duration = Duration::from_millis(10);

/// Asks a capture to stop. Clones share one flag.
#[derive(Debug, Clone, Default)]
pub struct CancelFlag(Arc<Asked>);

#[derive(Debug, Default)]
struct Asked {
    asked: AtomicBool,
    looks: AtomicU64,
}

impl CancelFlag {
    /// Asks to stop; it cannot be taken back.
    pub fn cancel(&self) {
        self.0.asked.store(true, Ordering::Relaxed);
    }

    /// Whether it was asked.
    pub fn is_cancelled(&self) -> bool {
        self.0.looks.fetch_add(1, Ordering::Relaxed);
        self.0.asked.load(Ordering::Relaxed)
    }

    /// How often somebody looked whether it was asked: who looks is alive.
    pub fn looks(&self) -> u64 {
        self.0.looks.load(Ordering::Relaxed)
    }
}

/// What a capture tells while it runs. Called from its thread: what takes long here delays the next exposure.
#[derive(Debug)]
pub enum Progress<'a> {
    /// The camera is armed.
    Started {
        /// Frames of the sequence.
        frames: usize,
        /// Time that it will take where nothing is repeated.
        expected: Duration,
        /// Time that the camera took to get ready for the timetable: what a simulated one renders in advance.
        rehearsed: Duration,
    },
    /// A frame has arrived and its identity holds. It may still be taken again.
    Captured {
        /// Frames in hand.
        done: usize,
        /// Frames of the sequence.
        frames: usize,
        /// The frame.
        frame: &'a CapturedFrame,
    },
    /// A frame is final: decoding may begin with it.
    Accepted(&'a CapturedFrame),
    /// Frames are taken again.
    Retaking {
        /// What they show.
        roles: &'a [Role],
        /// Why, and for which time.
        retake: &'a GroupRetake,
    },
}

/// The picture as a projector takes it.
pub fn slide(raster: Raster) -> Slide {
    match raster {
        Raster::Uniform(value) => Slide::Uniform(value),
        Raster::Columns(values) => Slide::Columns(values.into()),
        Raster::Rows(values) => Slide::Rows(values.into()),
        Raster::Full(values) => Slide::Full(values.into()),
    }
}

/// Captures the frames of `plan`. The settings that the plan was made of have been applied to the camera.
///
/// Blocks for [`Plan::expected`] and more; returns within one frame time after `cancel`. Whatever comes, the camera
/// is disarmed and the projector asked for black; where it refuses, the finding `projector-not-black` says so.
pub fn capture(
    projector: &mut dyn Projector,
    camera: &mut dyn Camera,
    clock: &dyn Clock,
    plan: &Plan,
    judge: &mut dyn Judge,
    progress: &mut dyn FnMut(Progress<'_>),
    cancel: &CancelFlag,
) -> Result<CaptureRecord, CaptureFailure> {
    let roles = &plan.sequence.roles;
    let mut machine = Machine::new(plan, camera.info().triggered);
    let mut rig = Rig { projector, camera, dark: None, armed: true };
    let prepared = rig.prepare(plan, clock, cancel);
    let mut shell = Shell {
        rig,
        clock,
        plan,
        judge,
        progress,
        cancel,
        slots: vec![None; roles.len()],
        shown: None,
        exposed: None,
        arrived: None,
        received: 0,
        first_flip: None,
        last_frame: None,
        outcome: None,
    };
    if let Ok(rehearsed) = prepared {
        let (frames, expected) = (roles.len(), plan.expected());
        (shell.progress)(Progress::Started { frames, expected, rehearsed });
        shell.run(&mut machine);
    }
    shell.conclude(&machine, prepared.map(drop))
}

/// The devices, left black and disarmed when dropped, also by a panic of the judge.
struct Rig<'a> {
    projector: &'a mut dyn Projector,
    camera: &'a mut dyn Camera,
    dark: Option<Result<PresentReceipt, DeviceError>>,
    armed: bool,
}

impl Rig<'_> {
    /// Loads the slides, lets the camera get ready for them, and arms it. Returns what getting ready took.
    fn prepare(
        &mut self,
        plan: &Plan,
        clock: &dyn Clock,
        cancel: &CancelFlag,
    ) -> Result<Duration, Box<CaptureError>> {
        let slides: Vec<Slide> = plan
            .sequence
            .roles
            .iter()
            .map(|&role| slide(plan.sequence.raster(role, plan.polarization)))
            .collect();
        let load = |source| Box::new(CaptureError::Load { slides: slides.len(), source });
        self.projector.load(&slides).map_err(load)?;
        let arm = |source| Box::new(CaptureError::Arm { frames: slides.len(), source });
        let schedule = plan.schedule();
        let begun = clock.now();
        // One call a frame at the most; more would be a device that never gets ready.
        for _ in 0..slides.len() {
            if cancel.is_cancelled() || self.camera.rehearse(&schedule).map_err(arm)? == 0 {
                break;
            }
        }
        let rehearsed = clock.now().since(begun);
        self.camera.arm(slides.len()).map_err(arm)?;
        Ok(rehearsed)
    }

    fn black(&mut self) -> Result<PresentReceipt, DeviceError> {
        let projector = &mut self.projector;
        let twice = || match projector.black() {
            Err(DeviceError::Timeout { .. }) => projector.black(),
            result => result,
        };
        self.dark.get_or_insert_with(twice).clone()
    }

    fn disarm(&mut self) -> Option<Result<StreamStatistics, DeviceError>> {
        std::mem::take(&mut self.armed).then(|| self.camera.disarm())
    }
}

impl Drop for Rig<'_> {
    fn drop(&mut self) {
        // Reported by `conclude`; here only a panic is under way.
        let _ = self.black();
        let _ = self.disarm();
    }
}

struct Shell<'a> {
    rig: Rig<'a>,
    clock: &'a dyn Clock,
    plan: &'a Plan,
    judge: &'a mut dyn Judge,
    progress: &'a mut dyn FnMut(Progress<'_>),
    cancel: &'a CancelFlag,
    slots: Vec<Option<CapturedFrame>>,
    /// Receipt of the slide that was shown last.
    shown: Option<PresentReceipt>,
    /// Receipt and start of the exposure whose frame is awaited.
    exposed: Option<(PresentReceipt, Timestamp)>,
    arrived: Option<Frame>,
    received: u64,
    first_flip: Option<Timestamp>,
    last_frame: Option<Timestamp>,
    outcome: Option<Outcome>,
}

impl Shell<'_> {
    fn run(&mut self, machine: &mut Machine) {
        let mut actions = VecDeque::from(machine.handle(self.clock.now(), Event::Start));
        while let Some(action) = actions.pop_front() {
            let event = match self.cancel.is_cancelled() && !machine.ended() {
                true => Some(Event::CancelRequested),
                false => self.perform(action),
            };
            let Some(event) = event else { continue };
            let next = machine.handle(self.clock.now(), event);
            if machine.ended() {
                // Nothing that was still to be done matters now; black must not wait for it.
                actions.clear();
            }
            actions.extend(next);
        }
    }

    fn perform(&mut self, action: Action) -> Option<Event> {
        match action {
            Action::Show { step, not_before } => Some(self.show(step, not_before)),
            Action::Trigger { at } => Some(self.trigger(at)),
            Action::AwaitFrame { deadline } => Some(self.await_frame(deadline)),
            Action::Judge(subject) => Some(Event::Judged(subject, self.judge(subject))),
            Action::Keep { step } => {
                self.keep(step);
                None
            }
            Action::Accept { group } => {
                self.accept(group);
                None
            }
            Action::Retake(retake) => {
                let roles = &self.plan.sequence.roles[self.plan.groups[retake.group].steps()];
                (self.progress)(Progress::Retaking { roles, retake: &retake });
                None
            }
            Action::Black => {
                // Its failure is kept, and reported at the end.
                let _ = self.rig.black();
                None
            }
            Action::Finish(outcome) => {
                self.outcome = Some(outcome);
                None
            }
        }
    }

    /// Waits, unless cancelled.
    fn wait_until(&self, deadline: Timestamp) -> Result<(), Event> {
        loop {
            let now = self.clock.now();
            if self.cancel.is_cancelled() {
                return Err(Event::CancelRequested);
            }
            if now >= deadline {
                return Ok(());
            }
            self.clock.sleep_until(deadline.min(now + POLL));
        }
    }

    fn show(&mut self, step: usize, not_before: Timestamp) -> Event {
        if let Err(event) = self.wait_until(not_before) {
            return event;
        }
        match self.rig.projector.show(step as u32) {
            Ok(receipt) => {
                self.first_flip.get_or_insert(receipt.flipped);
                self.shown = Some(receipt);
                Event::Presented(receipt)
            }
            Err(error) => Event::DeviceFailed(Device::Projector, error),
        }
    }

    fn trigger(&mut self, at: Timestamp) -> Event {
        if let Err(event) = self.wait_until(Timestamp(at.0.saturating_sub(TRIGGER_LEAD.as_nanos() as u64))) {
            return event;
        }
        match self.rig.camera.trigger(at) {
            Ok(started) => {
                self.exposed = self.shown.map(|receipt| (receipt, started));
                Event::Triggered(started)
            }
            Err(error) => Event::DeviceFailed(Device::Camera, error),
        }
    }

    fn await_frame(&mut self, deadline: Timestamp) -> Event {
        // Counted, so that a device whose time stands still cannot hold the capture.
        let polls = deadline.since(self.clock.now()).as_nanos() / POLL.as_nanos() + 2;
        for _ in 0..polls {
            if self.cancel.is_cancelled() {
                return Event::CancelRequested;
            }
            let left = deadline.since(self.clock.now());
            match self.rig.camera.next_frame(left.min(POLL)) {
                Ok(frame) => return self.arrive(frame),
                Err(DeviceError::Timeout { .. }) if left > POLL => {}
                Err(DeviceError::Timeout { .. }) => return Event::TimedOut,
                Err(error) => return Event::DeviceFailed(Device::Camera, error),
            }
        }
        Event::TimedOut
    }

    fn arrive(&mut self, frame: Frame) -> Event {
        self.received += 1;
        let applied = &self.plan.applied;
        let expected = (applied.width, applied.height, applied.settings.format.bit_depth());
        let samples = frame.pixels().len();
        if (frame.width, frame.height, frame.bit_depth) != expected
            || samples != frame.width as usize * frame.height as usize
        {
            let detail = format!(
                "frame {} has {samples} samples as {}x{} px of {} bits, {}x{} px of {} bits were configured",
                frame.stamp.frame_id,
                frame.width,
                frame.height,
                frame.bit_depth,
                expected.0,
                expected.1,
                expected.2
            );
            let device = self.rig.camera.info().model.clone();
            return Event::DeviceFailed(Device::Camera, DeviceError::BadData { device, detail });
        }
        let stamp = frame.stamp;
        self.arrived = Some(frame);
        Event::FrameArrived(stamp)
    }

    fn keep(&mut self, step: usize) {
        let (Some(frame), Some((receipt, triggered))) = (self.arrived.take(), self.exposed) else {
            return;
        };
        self.last_frame = self.last_frame.max(Some(frame.stamp.received));
        let role = self.plan.sequence.roles[step];
        self.slots[step] = Some(CapturedFrame { role, receipt, triggered, frame });
        let done = self.slots.iter().flatten().count();
        if let Some(frame) = &self.slots[step] {
            (self.progress)(Progress::Captured { done, frames: self.slots.len(), frame });
        }
    }

    fn judge(&mut self, subject: Subject) -> PairVerdict {
        let group = self.plan.groups[subject.group()];
        let frame = |step: usize| self.slots[step].as_ref().map(|captured| &captured.frame);
        let verdict = match group {
            Group::Pair { step, axis, bit } => {
                // The judge is given the frame first, whichever was shown first.
                let inverse_first =
                    matches!(self.plan.sequence.roles[step], Role::Code { inverse: true, .. });
                let (direct, inverse) = if inverse_first { (step + 1, step) } else { (step, step + 1) };
                frame(direct)
                    .zip(frame(inverse))
                    .map(|(direct, inverse)| self.judge.pair(axis, bit, direct, inverse))
            }
            Group::Again { step, first } => {
                let role = self.plan.sequence.roles[step];
                frame(first).zip(frame(step)).map(|(first, last)| self.judge.drift(role, first, last))
            }
            Group::Single { .. } => Some(PairVerdict::Accept),
        };
        verdict.unwrap_or_else(|| {
            PairVerdict::Retake(Suspicion {
                reason: "lost-frame".to_string(),
                evidence: "a frame to be judged is not there".to_string(),
                sigma: f64::NAN,
            })
        })
    }

    fn accept(&mut self, group: usize) {
        for step in self.plan.groups[group].steps() {
            let Some(captured) = &self.slots[step] else { continue };
            if !matches!(captured.role, Role::Code { .. }) {
                self.judge.reference(captured.role, &captured.frame);
            }
            (self.progress)(Progress::Accepted(captured));
        }
    }

    /// Stops the devices and sums up.
    fn conclude(
        mut self,
        machine: &Machine,
        prepared: Result<(), Box<CaptureError>>,
    ) -> Result<CaptureRecord, CaptureFailure> {
        let mut notes = CaptureNotes {
            findings: machine.findings().to_vec(),
            discarded: machine.discarded().to_vec(),
            references_retaken: Vec::new(),
        };
        let mut note = |reason: &str, evidence: String| {
            notes.findings.push(Finding { reason: reason.to_string(), role: None, evidence, sigma: None });
        };
        if let Err(error) = self.rig.black() {
            note("projector-not-black", format!("the projector may still be lit: {error}"));
        }
        let statistics = match self.rig.disarm() {
            Some(Ok(statistics)) => Some(statistics),
            Some(Err(error)) if prepared.is_ok() => {
                note("camera-not-stopped", format!("the camera's counters are not known: {error}"));
                None
            }
            // A camera that was not armed may refuse to be disarmed.
            _ => None,
        };
        if let Some(statistics) =
            statistics.as_ref().filter(|_| prepared.is_ok() && self.rig.camera.info().triggered)
        {
            let (triggers, frames) = (machine.triggers(), self.received);
            if statistics.triggers < triggers || statistics.frames != frames {
                note(
                    "lost-frame",
                    format!(
                        "the camera counts {} triggers and {} frames, {triggers} were sent and {frames} received",
                        statistics.triggers, statistics.frames
                    ),
                );
            }
        }
        let retaken = self.sort_retakes(machine.retaken(), &mut notes);
        let seconds = match (self.first_flip, self.last_frame) {
            (Some(first), Some(last)) => last.since(first).as_secs_f64(),
            _ => 0.0,
        };
        let error = match (prepared, self.outcome.take()) {
            (Err(error), _) => *error,
            (Ok(()), Some(Outcome::Complete)) if self.slots.iter().all(Option::is_some) => {
                let frames: Vec<CapturedFrame> =
                    std::mem::take(&mut self.slots).into_iter().flatten().collect();
                let statistics = statistics.unwrap_or(StreamStatistics {
                    triggers: machine.triggers(),
                    frames: self.received,
                    ..StreamStatistics::default()
                });
                return Ok(self.record(frames, retaken, seconds, statistics, notes));
            }
            (Ok(()), Some(Outcome::Cancelled)) => CaptureError::Cancelled,
            (Ok(()), Some(Outcome::Failed(diagnosis))) => diagnosis.into(),
            (Ok(()), Some(Outcome::Complete) | None) => CaptureError::Diagnosed {
                reason: "out-of-order".to_string(),
                role: None,
                evidence: "the capture ended without all its frames: a defect of the capture itself"
                    .to_string(),
            },
        };
        let frames = std::mem::take(&mut self.slots).into_iter().flatten().collect();
        let partial = PartialCapture { frames, retaken, seconds, statistics, notes };
        Err(CaptureFailure { error: Box::new(error), partial: Box::new(partial) })
    }

    fn record(
        &self,
        frames: Vec<CapturedFrame>,
        retaken: Vec<Retake>,
        seconds: f64,
        statistics: StreamStatistics,
        notes: CaptureNotes,
    ) -> CaptureRecord {
        let delays =
            frames.iter().map(|captured| captured.triggered.since(captured.receipt.flipped).as_secs_f64());
        let latency_ms = delays.sum::<f64>() * 1e3 / frames.len().max(1) as f64;
        CaptureRecord {
            retaken,
            seconds,
            limit_seconds: self.plan.limit().as_secs_f64(),
            synchrony: Synchrony::planned(&self.plan.timing)
                .measured(self.plan.timing.hold_refreshes, &frames),
            frames,
            latency_ms,
            hold_refreshes: self.plan.timing.hold_refreshes,
            timing_measured: self.plan.timing.measured,
            applied: self.plan.applied.clone(),
            statistics,
            notes,
        }
    }

    fn sort_retakes(&self, retakes: &[GroupRetake], notes: &mut CaptureNotes) -> Vec<Retake> {
        let mut pairs = Vec::new();
        for GroupRetake { group, reason, evidence, attempt } in retakes.iter().cloned() {
            match self.plan.sequence.roles[self.plan.groups[group].steps().start] {
                Role::Code { axis, bit, .. } => pairs.push(Retake { axis, bit, reason, evidence, attempt }),
                role => notes.references_retaken.push(ReferenceRetake { role, reason, evidence, attempt }),
            }
        }
        pairs
    }
}

#[cfg(test)]
mod tests;
