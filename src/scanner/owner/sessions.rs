//! Sessions with a board: open for as long as somebody takes views; between its steps the rig is everybody's.

use super::*;
use crate::{
    calibrate::{
        self, Task,
        rig::{Session, SessionState, Step, number_of},
    },
    calibration::{boards::Board, rig::Gates},
    scanner::calibration::{CalibrationKind, CalibrationRecord, CalibrationState},
};

/// A request for a session.
#[derive(Debug, Clone)]
pub struct SessionAsk {
    /// Board that will be shown.
    pub board: Board,
    /// When a calibration is accepted.
    pub gates: Gates,
    /// Distance between camera and projector, where it was measured, in mm.
    pub baseline_mm: Option<f64>,
}

impl Owner {
    pub(super) fn open_session(&mut self, ask: &SessionAsk) -> Result<Arc<CalibrationRecord>, Denied> {
        let unfinished =
            |one: &&Arc<CalibrationRecord>| one.kind == CalibrationKind::Rig && !one.state.is_terminal();
        if let Some(other) = self.calibrations.values().find(unfinished) {
            return Err(Denied::SessionOpen(other.id.clone()));
        }
        let id = uuid::Uuid::now_v7().to_string();
        let mut record = CalibrationRecord::new(id.clone(), CalibrationKind::Rig, now());
        let SessionAsk { board, gates, baseline_mm } = ask;
        let session = Session::new(&self.settings.raw.rig.name, board, *gates, *baseline_mm);
        record.state = CalibrationState::Open;
        record.session = Some(SessionState::empty(&session));
        // As the event will say that tells of it.
        record.revision = self.out.events.next();
        let store = self.library.calibrations();
        let folder = store.session(&id).map_err(|error| Denied::Storage(chain(&error)))?;
        session.write(&folder).map_err(|failure| Denied::Storage(failure.chain()))?;
        store.write(&record).map_err(|error| Denied::Storage(chain(&error)))?;
        Arc::make_mut(&mut self.calibrations).insert(id.clone(), Arc::new(record));
        self.touch_calibration(&id);
        self.calibration(&id)
    }

    pub(super) fn session_step(&mut self, id: &str, step: Step) -> Result<Arc<CalibrationRecord>, Denied> {
        let record = self.calibration(id)?;
        let Some(session) = &record.session else { return Err(Denied::NoSession) };
        let store = self.library.calibrations();
        let folder = store.session(id).map_err(|error| Denied::Storage(chain(&error)))?;
        // A view that a crash kept unmentioned lies in the folder all the same.
        let known = |name: &String| {
            session.views.iter().any(|view| view.name == *name)
                || (number_of(name).is_some() && folder.join(name).is_dir())
        };
        match (&record.state, &step) {
            (CalibrationState::Open, Step::Drop(name)) if !known(name) => return Err(Denied::UnknownView),
            (CalibrationState::Open, _) => {}
            (CalibrationState::Running, _) => {
                let holder = self.calibration_as_holder(id).ok_or(Denied::UnknownCalibration)?;
                return Err(Denied::Refused(Refusal::Busy(holder)));
            }
            (state, _) => return Err(Denied::CalibrationEnded(*state)),
        }
        self.admit_step(&step)?;
        let mut running = record.as_ref().clone();
        running.state = CalibrationState::Running;
        // Whatever the step brings, an earlier solution is one of other views.
        (running.files, running.summary, running.refused) = Default::default();
        running.accepted = None;
        self.start_calibration(running, Task::Rig(calibrate::rig::Task { folder, step }))
    }

    /// A view needs the rig; a solution only space for its files; dropping a view makes some.
    fn admit_step(&mut self, step: &Step) -> Result<(), Denied> {
        let minds: &[&str] = match step {
            Step::View => return self.admit_calibration(),
            Step::Solve => &["stopping", "storage"],
            Step::Drop(_) => &["stopping"],
        };
        self.look_at_storage();
        let mut obstacles = self.obstacles();
        obstacles.retain(|obstacle| minds.contains(&obstacle.kind.as_str()));
        if obstacles.is_empty() { Ok(()) } else { Err(Denied::Refused(Refusal::NotReady(obstacles))) }
    }

    /// A step came to its end: the session stays open, unless its calibration was accepted or somebody closed it.
    pub(super) fn session_state(
        &self,
        record: &mut CalibrationRecord,
        result: Result<Box<calibrate::Outcome>, Broken>,
        stopped: bool,
    ) -> CalibrationState {
        record.doing = None;
        match result {
            Ok(outcome) => {
                record.adopt(*outcome);
                match record.accepted {
                    Some(true) => CalibrationState::Done,
                    // Somebody closed it while what was taken was looked at.
                    _ if stopped && !self.stopping => {
                        record.blame("cancelled", "the session was closed");
                        CalibrationState::Cancelled
                    }
                    _ => CalibrationState::Open,
                }
            }
            Err(_) if stopped && self.stopping => {
                record.blame("interrupted", "the service ended in the middle of a step; ask for it again");
                CalibrationState::Open
            }
            Err(_) if stopped => {
                record.blame("cancelled", "the session was closed");
                CalibrationState::Cancelled
            }
            Err(broken) => {
                record.blame(broken.kind, broken.message);
                CalibrationState::Open
            }
        }
    }

    /// Closes a session that waits. What was taken stays until it is deleted.
    pub(super) fn close_session(&mut self, id: &str) -> Result<Arc<CalibrationRecord>, Denied> {
        let mut closed = self.calibration(id)?.as_ref().clone();
        closed.blame("cancelled", "the session was closed");
        closed.end(CalibrationState::Cancelled, now());
        closed.revision = self.out.events.next();
        self.library.calibrations().write(&closed).map_err(|error| Denied::Storage(chain(&error)))?;
        self.edit_calibration(id, |record| *record = closed);
        self.touch_calibration(id);
        self.calibration(id)
    }

    pub(super) fn delete_calibration(&mut self, id: &str) -> Result<(), Denied> {
        let record = self.calibration(id)?;
        if !record.state.is_terminal() {
            return Err(Denied::CalibrationEnded(record.state));
        }
        let left = self.library.calibrations().discard(id).map_err(|error| Denied::Storage(chain(&error)))?;
        left.into_iter().for_each(|left| drop(self.out.disk.send(disk::Task::Remove(left))));
        Arc::make_mut(&mut self.calibrations).remove(id);
        self.event("calibration-deleted", |_| serde_json::json!({ "id": id }).to_string());
        self.look_at_storage();
        Ok(())
    }
}
