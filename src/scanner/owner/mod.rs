//! The one task that owns the scanner's state. Requests and news come in through one channel; what follows is decided
//! here, one message at a time, written to the index, published and told to rig and finisher.
//!
//! What it decides by is in `admission`, `state` and `record`; here is the loop, what goes to the rig, and how a record
//! changes. `requests`, `news` and `room` have the rest.

mod calibrations;
mod message;
mod news;
mod requests;
mod room;
mod sessions;

use std::{
    collections::{BTreeMap, VecDeque},
    path::PathBuf,
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, Sender},
    },
    time::{Duration, Instant, SystemTime, UNIX_EPOCH},
};

use polscan_patterns::Mode;
use tokio::sync::watch;

use super::{
    admission::{self, Ask, Decision, Holder, Obstacle, Refusal, Situation},
    calibration::CalibrationRecord,
    disk,
    events::{BLOCK, EventLog, IN_INDEX},
    finish::{self, Broken, Work},
    heartbeat::Heartbeat,
    metrics::Metrics,
    record::{Record, Series},
    rig::{self, Captured},
    snapshot::{RigState, RigStatus, Snapshot, StorageStatus},
    state::State,
};
use crate::{
    config::Settings,
    engine::{Failure, Label, Shown},
    report::{Diagnosis, Report, Verdict},
    sequencer::CancelFlag,
    store::{
        Index, Library,
        index::{Event, Key},
        library::chain,
        time::rfc3339_utc,
    },
};

/// Longest time between two looks at the clock.
const TICK: Duration = Duration::from_millis(500);

/// How often free space and retention are looked at without a scan.
const HOUSEKEEPING: Duration = Duration::from_secs(10);

/// Finished scans that stay in the snapshot.
const RECENT: usize = 64;

const GIB: f64 = (1u64 << 30) as f64;

pub use calibrations::CalibrationAsk;
pub use message::{Change, Denied, Message, Reply, Submit};
pub use sessions::SessionAsk;
use {
    calibrations::Calibrating,
    message::{Answer, answer},
};

/// A scan that waits.
#[derive(Debug)]
struct Waiting {
    id: String,
    held: bool,
    /// Whether its client did not want to wait: it does so only because the rig is being opened.
    urgent: bool,
}

/// Where everything goes.
pub struct Outlets {
    /// To the rig.
    pub rig: Sender<rig::Command>,
    /// To the finisher.
    pub finish: Sender<Work>,
    /// To whoever carries out steps of calibrations.
    pub steps: Sender<finish::Step>,
    /// To the disk.
    pub disk: Sender<disk::Task>,
    /// The snapshot.
    pub snapshot: watch::Sender<Arc<Snapshot>>,
    /// Events.
    pub events: Arc<EventLog>,
    /// Metrics.
    pub metrics: Arc<Metrics>,
    /// Signs of life.
    pub heartbeat: Arc<Heartbeat>,
    /// Signs of life of the rig, while it measures.
    pub rig_heartbeat: Arc<Heartbeat>,
}

/// The state.
pub struct Owner {
    settings: Settings,
    library: Library,
    index: Index,
    out: Outlets,
    scans: BTreeMap<String, Arc<Record>>,
    recent: VecDeque<String>,
    queue: VecDeque<Waiting>,
    active: Option<String>,
    cancel: BTreeMap<String, CancelFlag>,
    finishing: VecDeque<String>,
    accepted: BTreeMap<String, Instant>,
    /// Why captures that did not come to their end did not.
    cut_short: BTreeMap<String, Diagnosis>,
    calibrating: Option<Calibrating>,
    stepping: Option<Calibrating>,
    calibrations: Arc<BTreeMap<String, Arc<CalibrationRecord>>>,
    rig: RigStatus,
    storage: StorageStatus,
    storage_fault: Option<String>,
    previewing: bool,
    stop_by: Option<Instant>,
    stopping: bool,
    reserved: u64,
    housekept: Option<Instant>,
}

fn now() -> String {
    rfc3339_utc(SystemTime::now())
}

fn seconds_since_1970() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

impl Owner {
    /// The state after a start: scans that were queued still are, held back unless the configuration says otherwise.
    pub fn new(settings: Settings, library: Library, index: Index, out: Outlets) -> Self {
        let queued = index.unfinished().unwrap_or_else(|error| {
            tracing::error!(error = chain(&error), "scans that were queued are not known");
            Vec::new()
        });
        let held = !settings.raw.scan.resume_queue;
        let quota = settings.raw.store.quota_gib;
        let storage = StorageStatus {
            quota_bytes: (quota > 0.0).then_some((quota * GIB) as u64),
            min_free_bytes: (settings.raw.store.min_free_gib * GIB) as u64,
            ..StorageStatus::default()
        };
        let mut owner = Self {
            settings,
            library,
            index,
            out,
            scans: BTreeMap::new(),
            recent: VecDeque::new(),
            queue: VecDeque::new(),
            active: None,
            cancel: BTreeMap::new(),
            finishing: VecDeque::new(),
            accepted: BTreeMap::new(),
            cut_short: BTreeMap::new(),
            calibrating: None,
            stepping: None,
            calibrations: Arc::default(),
            rig: RigStatus::default(),
            storage,
            storage_fault: None,
            previewing: false,
            stop_by: None,
            stopping: false,
            reserved: 0,
            housekept: None,
        };
        for mut record in queued {
            record.held = held;
            owner.queue.push_back(Waiting { id: record.id.clone(), held, urgent: false });
            owner.scans.insert(record.id.clone(), Arc::new(record));
        }
        owner.recall_calibrations();
        owner.number_queue();
        owner.housekeep();
        owner.publish();
        owner
    }

    /// Runs until it has stopped.
    pub fn run(mut self, messages: &Receiver<Message>) {
        loop {
            self.out.heartbeat.beat();
            self.feel_calibration();
            match messages.recv_timeout(TICK) {
                Ok(message) => self.handle(message),
                Err(RecvTimeoutError::Timeout) => {}
                Err(RecvTimeoutError::Disconnected) => break,
            }
            if self.housekept.is_none_or(|last| last.elapsed() >= HOUSEKEEPING) {
                self.housekeep();
                self.publish();
            }
            if self.stopping {
                if self.stop_by.is_some_and(|limit| Instant::now() >= limit) {
                    // Whoever has all frames is left to end: a stop must not cost what was captured.
                    let capturing = self.active.as_ref().and_then(|id| self.cancel.get(id));
                    capturing.into_iter().for_each(CancelFlag::cancel);
                }
                let calibrates = self.calibrating.is_some() || self.stepping.is_some();
                if self.active.is_none() && self.finishing.is_empty() && !calibrates {
                    break;
                }
            }
        }
        // With nothing left open, the next start goes on with the next number.
        if let Err(error) = self.index.set_number("clean", self.out.events.next() - 1) {
            tracing::warn!(error = chain(&error), "event numbers will have a gap");
        }
    }

    /// Nobody is answered before everybody can see what the answer says: who asks again at once must not be told what
    /// was. The rig starts before both: an answer never waits, a pattern might.
    fn handle(&mut self, message: Message) {
        let answer: Option<Answer> = match message {
            Message::Submit(submit, reply) => Some(answer(self.submit(&submit), reply)),
            Message::Cancel(id, reply) => Some(answer(self.cancel(&id), reply)),
            Message::Delete(id, reply) => Some(answer(self.delete(&id), reply)),
            Message::Change(id, change, reply) => Some(answer(self.change(&id, change), reply)),
            Message::Hold(held, reply) => Some(answer(Ok(self.hold(held)), reply)),
            Message::Calibrate(ask, reply) => Some(answer(self.calibrate(*ask), reply)),
            Message::OpenSession(ask, reply) => Some(answer(self.open_session(&ask), reply)),
            Message::SessionStep(id, step, reply) => Some(answer(self.session_step(&id, step), reply)),
            Message::DeleteCalibration(id, reply) => Some(answer(self.delete_calibration(&id), reply)),
            Message::CancelCalibration(id, reply) => Some(answer(self.cancel_calibration(&id), reply)),
            Message::Show(shown, name, reply) => self.show(shown, name, reply),
            Message::Preview => {
                self.preview();
                None
            }
            Message::Stop(grace) => {
                self.stop(grace);
                None
            }
            Message::Rig(news) => self.rig_news(news),
            Message::Finish(news) => {
                self.finish_news(news);
                None
            }
        };
        self.dispatch();
        self.number_queue();
        self.publish();
        if let Some(answer) = answer {
            answer();
        }
    }

    /// Gives the rig its next scan, if it can take one.
    fn dispatch(&mut self) {
        let free = self.active.is_none() && self.rig.state == RigState::Ready && !self.stopping;
        if !free || self.finishing.len() >= admission::MOST_FINISHING {
            return;
        }
        let Some(at) = self.queue.iter().position(|waiting| !waiting.held) else { return };
        let Some(Waiting { id, .. }) = self.queue.remove(at) else { return };
        let Some(record) = self.scans.get(&id).cloned() else { return };
        let cancel = CancelFlag::default();
        let job = rig::Job {
            label: Label { id: id.clone(), label: record.label.clone(), tags: record.tags.clone() },
            mode: record.mode.parse().unwrap_or(self.settings.mode),
            exposure_us: record.exposure_us,
            accepted: self.accepted.get(&id).copied(),
            cancel: cancel.clone(),
            bundle: self.library.bundle(&id),
            spool: self.library.spool(&id),
        };
        let _ = self.out.rig.send(rig::Command::Scan(Box::new(job)));
        self.cancel.insert(id.clone(), cancel);
        self.active = Some(id.clone());
        self.rig.state = RigState::Busy;
        self.rig.showing = None;
        self.advance(&id, State::Projecting);
    }

    /// Changes a record without telling anybody yet.
    fn edit(&mut self, id: &str, change: impl FnOnce(&mut Record)) {
        if let Some(record) = self.scans.get_mut(id) {
            change(Arc::make_mut(record));
        }
    }

    /// Goes to `state`, stores and tells.
    fn advance(&mut self, id: &str, state: State) {
        let mut moved = false;
        self.edit(id, |record| moved = record.advance(state, now()));
        if moved {
            tracing::info!(id, state = state.name(), "scan");
            self.touch(id);
        } else {
            tracing::error!(id, state = state.name(), "a scan cannot become this: a defect");
        }
    }

    /// Brings a scan to its end.
    fn end(&mut self, id: &str, state: State, change: impl FnOnce(&mut Record)) {
        self.edit(id, change);
        self.advance(id, state);
        let Some(record) = self.scans.get(id).cloned() else { return };
        if let Err(error) = self.library.write_record(&record) {
            tracing::warn!(id, error = chain(&error), "what is known of a scan is in the index only");
        }
        // The result, or what is left of it, is written: the spool has done its work.
        let _ = self.out.disk.send(disk::Task::End { id: id.to_owned() });
        self.out.metrics.scan(state.name());
        if let Some(accepted) = self.accepted.remove(id) {
            self.out.metrics.scan_duration.observe(accepted.elapsed().as_secs_f64());
        }
        self.cancel.remove(id);
        self.recent.push_back(id.to_owned());
        while self.recent.len() > RECENT {
            if let Some(old) = self.recent.pop_front() {
                self.scans.remove(&old);
            }
        }
    }

    /// Gives a scan a new revision, stores it and tells.
    fn touch(&mut self, id: &str) {
        let revision = self.out.events.next();
        self.edit(id, |record| record.revision = revision);
        let Some(record) = self.scans.get(id).cloned() else { return };
        if let Err(error) = self.index.put(&record) {
            tracing::error!(id, error = chain(&error), "the index does not take a scan");
            self.storage_fault = Some(chain(&error));
        }
        let data = serde_json::to_string(&*record).unwrap_or_default();
        self.event("scan", |_| data);
    }

    /// Tells how far a capture is; that need not outlive a crash, so that the index is not asked.
    fn progress(&mut self, id: &str) {
        let revision = self.out.events.next();
        self.edit(id, |record| record.revision = revision);
        let Some(record) = self.scans.get(id).cloned() else { return };
        let data = serde_json::json!({ "id": id, "revision": revision, "progress": record.progress });
        self.event("progress", |_| data.to_string());
    }

    fn rig_event(&mut self) {
        let data = serde_json::json!({ "state": self.rig.state, "message": self.rig.message });
        self.event("rig", |_| data.to_string());
    }

    fn event(&mut self, kind: &str, data: impl FnOnce(u64) -> String) {
        let next = self.out.events.next();
        if next >= self.reserved {
            match self.index.set_number("events", next + BLOCK) {
                Ok(()) => self.reserved = next + BLOCK,
                Err(error) => tracing::error!(error = chain(&error), "event numbers are not reserved"),
            }
        }
        let event = Event { id: next, kind: kind.to_owned(), data: data(next) };
        // Stored before anybody hears of it: what one reader has seen, another may ask for after a crash.
        if let Err(error) = self.index.add_event(&event) {
            tracing::warn!(error = chain(&error), "an event will not outlive this process");
        }
        self.out.events.add(event);
    }

    fn publish(&mut self) {
        let finishing = self.finishing.iter().cloned().collect();
        let queue = self.queue.iter().map(|waiting| waiting.id.clone()).collect();
        let snapshot = Snapshot {
            revision: self.out.events.next() - 1,
            scans: self.scans.clone(),
            capturing: self.active.clone(),
            calibrating: self.calibrating.as_ref().map(|one| one.id.clone()),
            calibrations: self.calibrations.clone(),
            finishing,
            queue,
            rig: self.rig.clone(),
            storage: self.storage,
            obstacles: self.obstacles(),
            stopping: self.stopping,
        };
        self.out.snapshot.send_replace(Arc::new(snapshot));
        // Whoever hears of a change and asks at once sees it.
        self.out.events.tell();
    }
}
