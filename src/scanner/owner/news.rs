//! What rig and finisher tell.

use super::*;

/// Slug and message of a scan that somebody asked to stop.
pub(super) const CANCELLED: (&str, &str) = ("cancelled", "the scan was cancelled");

impl Owner {
    /// The answer is for whoever asked the rig through the owner.
    pub(super) fn rig_news(&mut self, news: rig::News) -> Option<Answer> {
        match news {
            rig::News::Shown { name, held, reply } => return Some(self.shown(name, held, reply)),
            rig::News::Open { camera, projector, scan_bytes } => {
                self.rig = RigStatus {
                    state: RigState::Ready,
                    camera: Some(*camera),
                    projector: Some(*projector),
                    ..RigStatus::default()
                };
                self.storage.scan_bytes = scan_bytes;
                self.look_at_storage();
                self.rig_event();
            }
            rig::News::Down { message } => self.rig_down(message),
            rig::News::Projector(projector) => self.rig.projector = Some(*projector),
            rig::News::Started { id, frames } => {
                self.edit(&id, |record| record.progress.of = frames);
                self.progress(&id);
            }
            rig::News::Frame { id, done } => {
                self.edit(&id, |record| record.progress.frames = done);
                self.progress(&id);
            }
            rig::News::Retaking { id } => {
                self.edit(&id, |record| record.progress.retaken += 1);
                self.progress(&id);
            }
            rig::News::Taken(captured) => self.taken(captured),
            rig::News::Refused { id, failure } => {
                self.release();
                let kind = failure.kind().slug();
                self.end(&id, State::Failed, |record| record.blame(kind, failure.chain()));
            }
            rig::News::Panicked { id, message } => {
                self.release();
                let message = format!("a defect of this program: {message}");
                self.end(&id, State::Failed, |record| record.blame("internal", message));
            }
            rig::News::Calibration { id, said } => self.calibration_news(&id, said),
            rig::News::Previewed => self.previewing = false,
        }
        None
    }

    fn shown(&mut self, name: String, held: Result<(), Failure>, reply: Reply<()>) -> Answer {
        let held = held.map_err(|failure| match failure {
            // No fault of the rig: this projector has no such picture.
            Failure::Setup { .. } | Failure::Data { .. } => Denied::NoSuchPicture(failure.chain()),
            failure => Denied::Rig(failure.chain()),
        });
        // A scan or a calibration that has begun meanwhile has taken the picture away.
        if held.is_ok() && self.active.is_none() && self.calibrating.is_none() {
            self.rig.showing = (name != "black").then_some(name);
            let showing = self.rig.showing.clone();
            self.event("projector", |_| serde_json::json!({ "show": showing }).to_string());
        }
        answer(held, reply)
    }

    pub(super) fn rig_down(&mut self, message: String) {
        tracing::warn!(message, "the rig cannot scan");
        self.rig.state = RigState::Fault;
        self.rig.message = Some(message.clone());
        self.rig.showing = None;
        self.rig_event();
        // Whoever did not want to wait learns it now; the others wait for somebody to release them.
        let urgent: Vec<String> =
            self.queue.iter().filter(|one| one.urgent && !one.held).map(|one| one.id.clone()).collect();
        self.queue.retain(|waiting| !urgent.contains(&waiting.id));
        for id in &urgent {
            self.end(id, State::Failed, |record| record.blame("unavailable", message.clone()));
        }
        self.hold(true);
    }

    pub(super) fn taken(&mut self, captured: Box<Captured>) {
        self.release();
        let id = captured.label.id.clone();
        let failure = captured.taken.failure().cloned();
        if let Some(reason) = &failure
            && captured.taken.record().frames.is_empty()
        {
            let (state, kind) = self.end_of(reason.diagnosis);
            let message = reason.message.clone();
            self.end(&id, state, |record| record.blame(kind, message));
            return;
        }
        match failure {
            None => self.advance(&id, State::Acquired),
            Some(reason) => drop(self.cut_short.insert(id.clone(), reason.diagnosis)),
        }
        self.finishing.push_back(id);
        let _ = self.out.finish.send(Work::Capture(captured));
    }

    /// State and slug of a capture that did not come to its end.
    pub(super) fn end_of(&self, diagnosis: Diagnosis) -> (State, &'static str) {
        match diagnosis {
            Diagnosis::Cancelled if self.stop_by.is_some_and(|limit| Instant::now() >= limit) => {
                (State::Interrupted, Diagnosis::Interrupted.slug())
            }
            Diagnosis::Cancelled => (State::Cancelled, Diagnosis::Cancelled.slug()),
            other => (State::Failed, other.slug()),
        }
    }

    pub(super) fn finish_news(&mut self, news: finish::News) {
        match news {
            finish::News::Begun { id } => {
                // What was cut short is only written down.
                let state = self.scans.get(&id).map(|record| record.state);
                if matches!(state, Some(State::Acquired | State::Queued)) {
                    self.advance(&id, State::Decoding);
                }
            }
            finish::News::Finished { id, result } => self.finished(&id, result),
            finish::News::Calibration { id, said } => self.calibration_news(&id, said),
        }
    }

    pub(super) fn finished(&mut self, id: &str, result: Result<Box<Report>, Broken>) {
        self.finishing.retain(|other| other != id);
        let cut_short = self.cut_short.remove(id);
        let Some(record) = self.scans.get(id) else { return };
        let (ended, decoded_again) = (record.state.is_terminal(), record.source.is_some());
        let cancelled = cut_short.is_none() && self.cancel.get(id).is_some_and(CancelFlag::is_cancelled);
        // A result that nobody wants any more; the frames are another's.
        if ended || cancelled && decoded_again {
            self.forget_bundle(id);
            if !ended {
                self.end(id, State::Cancelled, |record| record.blame(CANCELLED.0, CANCELLED.1));
            }
            return self.look_at_storage();
        }
        match result {
            Ok(report) => {
                let state = match cut_short {
                    Some(diagnosis) => self.end_of(diagnosis).0,
                    // Frames are kept in any case, and so is a result that was already being written.
                    None if cancelled => State::Cancelled,
                    None if report.verdict == Verdict::Failed => State::Failed,
                    None => State::Done,
                };
                let bytes = self.library.bundle_bytes(id);
                self.end(id, state, |record| {
                    record.adopt(&report);
                    record.bytes = bytes;
                    if cancelled && record.error.is_none() {
                        record.blame(CANCELLED.0, CANCELLED.1);
                    }
                });
            }
            Err(broken) => self.end(id, State::Failed, |record| record.blame(broken.kind, broken.message)),
        }
        self.look_at_storage();
    }

    /// Takes away what was written of a scan that was given up.
    fn forget_bundle(&mut self, id: &str) {
        match self.library.discard(id) {
            Ok(left) => left.into_iter().for_each(|left| drop(self.out.disk.send(disk::Task::Remove(left)))),
            Err(error) => tracing::warn!(id, error = chain(&error), "a cancelled scan still takes space"),
        }
    }

    /// The rig is free again.
    pub(super) fn release(&mut self) {
        self.active = None;
        if self.rig.state == RigState::Busy {
            self.rig.state = RigState::Ready;
        }
    }
}
