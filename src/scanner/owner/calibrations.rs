//! Calibrations: one at a time on the rig, started where it is idle, never queued, since somebody stands beside it.

use super::*;
use crate::{
    calibrate::Task,
    scanner::{
        calibration::{CalibrationKind, CalibrationRecord, CalibrationState},
        rig::calibrate::{Job, Said},
    },
};

/// The calibration that has the rig.
#[derive(Debug)]
pub(super) struct Calibrating {
    pub(super) id: String,
    pub(super) cancel: CancelFlag,
    /// How often the flag had been looked at when the owner last did.
    looks: u64,
}

/// A request for a calibration.
#[derive(Debug, Clone)]
pub struct CalibrationAsk {
    /// What to do.
    pub task: Task,
    /// Calibrations at other angles that it is joined with.
    pub with: Vec<String>,
}

impl CalibrationAsk {
    fn record(&self) -> CalibrationRecord {
        let kind = match &self.task {
            Task::Noise => CalibrationKind::Noise,
            Task::Sync => CalibrationKind::Sync,
            Task::Rig(_) => CalibrationKind::Rig,
            Task::Polarization(_) | Task::Watch { .. } => CalibrationKind::Polarization,
        };
        let mut record = CalibrationRecord::new(uuid::Uuid::now_v7().to_string(), kind, now());
        record.with = self.with.clone();
        record.watch = matches!(self.task, Task::Watch { .. });
        if let Task::Polarization(task) = &self.task {
            record.angle_deg = Some(task.angle_deg);
        }
        record
    }
}

impl Owner {
    /// The calibrations of earlier lives.
    pub(super) fn recall_calibrations(&mut self) {
        match self.library.calibrations().recover(&now()) {
            Ok(found) => {
                let found = found.into_iter().map(|record| (record.id.clone(), Arc::new(record)));
                self.calibrations = Arc::new(found.collect());
            }
            Err(error) => tracing::error!(error = chain(&error), "earlier calibrations are not known"),
        }
    }

    /// Whether the rig is there and free for a calibration, and the disk for its files.
    pub(super) fn admit_calibration(&mut self) -> Result<(), Denied> {
        self.look_at_storage();
        let situation = self.situation();
        let mut obstacles = situation.obstacles;
        if obstacles.is_empty() && self.rig.state == RigState::Connecting {
            obstacles.push(Obstacle::new("rig", "the rig is being opened; ask again when it is"));
        }
        if !obstacles.is_empty() {
            return Err(Denied::Refused(Refusal::NotReady(obstacles)));
        }
        situation.holder.map_or(Ok(()), |holder| Err(Denied::Refused(Refusal::Busy(holder))))
    }

    pub(super) fn calibrate(&mut self, ask: CalibrationAsk) -> Result<Arc<CalibrationRecord>, Denied> {
        self.admit_calibration()?;
        let record = ask.record();
        self.start_calibration(record, ask.task)
    }

    /// Gives the rig to a calibration that was admitted, or the computing threads where they are enough.
    pub(super) fn start_calibration(
        &mut self,
        mut record: CalibrationRecord,
        task: Task,
    ) -> Result<Arc<CalibrationRecord>, Denied> {
        record.revision = self.out.events.next();
        let (id, store) = (record.id.clone(), self.library.calibrations());
        // Known on the disk before the rig moves: a crash leaves an interrupted calibration, not none.
        store.write(&record).map_err(|error| Denied::Storage(chain(&error)))?;
        Arc::make_mut(&mut self.calibrations).insert(id.clone(), Arc::new(record));
        let cancel = CancelFlag::default();
        let folder = store.files(&id);
        let one = Calibrating { id: id.clone(), cancel: cancel.clone(), looks: 0 };
        match task {
            Task::Rig(task) if !task.needs_rig() => {
                let step = finish::Step { id: id.clone(), task, cancel, folder };
                let _ = self.out.steps.send(step);
                self.stepping = Some(one);
            }
            task => {
                let job = Job { id: id.clone(), task, cancel, folder };
                let _ = self.out.rig.send(rig::Command::Calibrate(Box::new(job)));
                self.calibrating = Some(one);
                self.rig.state = RigState::Busy;
                self.rig.showing = None;
            }
        }
        self.touch_calibration(&id);
        self.calibration(&id)
    }

    pub(super) fn cancel_calibration(&mut self, id: &str) -> Result<Arc<CalibrationRecord>, Denied> {
        let record = self.calibration(id)?;
        match record.state {
            CalibrationState::Running => {
                let running = self.calibrating.iter().chain(&self.stepping);
                running.filter(|one| one.id == id).for_each(|one| one.cancel.cancel());
                Ok(record)
            }
            CalibrationState::Open => self.close_session(id),
            CalibrationState::Cancelled => Ok(record),
            // A watch has no other end.
            CalibrationState::Done if record.watch => Ok(record),
            state => Err(Denied::CalibrationEnded(state)),
        }
    }

    /// The calibration that has the rig, as scans are told of it.
    pub(super) fn calibration_holder(&self) -> Option<Holder> {
        self.calibration_as_holder(&self.calibrating.as_ref()?.id)
    }

    pub(super) fn calibration_as_holder(&self, id: &str) -> Option<Holder> {
        let record = self.calibrations.get(id)?;
        Some(Holder {
            id: record.id.clone(),
            state: State::Projecting,
            label: None,
            created: record.created.clone(),
            calibration: Some(record.kind),
        })
    }

    pub(super) fn calibration(&self, id: &str) -> Result<Arc<CalibrationRecord>, Denied> {
        self.calibrations.get(id).cloned().ok_or(Denied::UnknownCalibration)
    }

    pub(super) fn calibration_news(&mut self, id: &str, said: Said) {
        match said {
            Said::Doing(what) => {
                self.edit_calibration(id, |record| {
                    record.doing = Some(what);
                    record.steps += 1;
                });
                self.touch_calibration(id);
            }
            Said::Watched(light) => {
                self.edit_calibration(id, |record| record.seen(light));
                self.calibration_value(id);
            }
            Said::Ended(result) => self.calibration_ended(id, result),
        }
    }

    fn calibration_ended(&mut self, id: &str, result: Result<Box<crate::calibrate::Outcome>, Broken>) {
        let had_rig = self.calibrating.as_ref().is_some_and(|one| one.id == id);
        let one = if had_rig { self.calibrating.take() } else { self.stepping.take() };
        if had_rig {
            self.release();
        }
        let stopped = one.is_some_and(|one| one.cancel.is_cancelled());
        let Some(mut record) = self.calibrations.get(id).map(|record| record.as_ref().clone()) else {
            return;
        };
        if record.session.is_some() {
            let state = self.session_state(&mut record, result, stopped);
            match state.is_terminal() {
                true => record.end(state, now()),
                false => record.state = state,
            }
        } else {
            let (stopping, watches) = (self.stopping, record.watch);
            let state = match result {
                Ok(outcome) => {
                    record.adopt(*outcome);
                    CalibrationState::Done
                }
                Err(_) if stopped && watches && !stopping => CalibrationState::Done,
                Err(_) if stopped && stopping => {
                    record
                        .blame("interrupted", "the service ended before the calibration did; start it again");
                    CalibrationState::Interrupted
                }
                Err(_) if stopped => {
                    record.blame("cancelled", "the calibration was cancelled");
                    CalibrationState::Cancelled
                }
                Err(broken) => {
                    record.blame(broken.kind, broken.message);
                    CalibrationState::Failed
                }
            };
            record.end(state, now());
        }
        self.edit_calibration(id, |known| *known = record);
        if let Some(record) = self.calibrations.get(id) {
            tracing::info!(id, state = record.state.name(), accepted = record.accepted, "calibration");
        }
        // On the disk before it is told: whoever hears of the end fetches the files at once.
        let revised = self.revise_calibration(id);
        let written = revised.map(|record| self.library.calibrations().write(&record));
        if let Some(Err(error)) = written {
            tracing::error!(
                id,
                error = chain(&error),
                "the end of a calibration is not noted: a restart calls it interrupted"
            );
        }
        self.tell_calibration(id);
    }

    /// The rig's thread is alive while whoever measures looks whether to go on.
    pub(super) fn feel_calibration(&mut self) {
        if let Some(one) = &mut self.calibrating {
            let looks = one.cancel.looks();
            if looks != std::mem::replace(&mut one.looks, looks) {
                self.out.rig_heartbeat.beat();
            }
        }
    }

    pub(super) fn edit_calibration(&mut self, id: &str, change: impl FnOnce(&mut CalibrationRecord)) {
        if let Some(record) = Arc::make_mut(&mut self.calibrations).get_mut(id) {
            change(Arc::make_mut(record));
        }
    }

    /// Gives a calibration the number of the event that will tell of it.
    fn revise_calibration(&mut self, id: &str) -> Option<Arc<CalibrationRecord>> {
        let revision = self.out.events.next();
        self.edit_calibration(id, |record| record.revision = revision);
        self.calibrations.get(id).cloned()
    }

    /// Gives a calibration a new revision and tells.
    pub(super) fn touch_calibration(&mut self, id: &str) {
        self.revise_calibration(id);
        self.tell_calibration(id);
    }

    fn tell_calibration(&mut self, id: &str) {
        let Some(record) = self.calibrations.get(id) else { return };
        let data = serde_json::to_string(&**record).unwrap_or_default();
        self.event("calibration", |_| data);
    }

    fn calibration_value(&mut self, id: &str) {
        let Some(record) = self.revise_calibration(id) else { return };
        let data = serde_json::json!({ "id": id, "revision": record.revision, "live": record.live });
        self.event("calibration-value", |_| data.to_string());
    }
}
