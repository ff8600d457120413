//! The one task that owns the scanner's state. Requests and news come in through one channel; what follows is decided
//! here, one message at a time, written to the index, published and told to rig and finisher.
//!
//! The file is long because it is the whole of the state machine's shell; what it decides by is in `admission`,
//! `state` and `record`.

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
use tokio::sync::{oneshot, watch};

use super::{
    admission::{self, Ask, Decision, Holder, Obstacle, Refusal, Situation},
    disk,
    events::{BLOCK, EventLog, IN_INDEX},
    finish::{self, Broken, Work},
    metrics::Metrics,
    record::{Record, Series},
    rig::{self, Captured, Heartbeat, Shown},
    snapshot::{RigState, RigStatus, Snapshot, StorageStatus},
    state::State,
};
use crate::{
    config::Settings,
    engine::{Failure, Label},
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

/// A request for scans.
#[derive(Debug, Clone)]
pub struct Submit {
    /// Mode; the configured one where there is none.
    pub mode: Option<Mode>,
    /// Exposure in microseconds; the configured one where there is none.
    pub exposure_us: Option<f64>,
    /// Name for a person.
    pub label: Option<String>,
    /// Tags.
    pub tags: Vec<String>,
    /// Number of scans.
    pub repeat: usize,
    /// Whether they may wait.
    pub queue: bool,
    /// Frames of this scan are decoded again, without the rig.
    pub source: Option<String>,
    /// Key of the client and digest of its request.
    pub key: Option<(String, String)>,
}

/// Why a request was not carried out.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Denied {
    /// By the rules of admission.
    Refused(Refusal),
    /// The key was used for another request.
    KeyReused,
    /// There is no such scan.
    Unknown,
    /// The scan is in a state that does not allow it.
    State(State),
    /// It is pinned.
    Pinned,
    /// Another scan was decoded from its frames.
    InUse,
    /// It has no bundle.
    NoBundle,
    /// The disk says no.
    Storage(String),
    /// The rig says no.
    Rig(String),
}

/// A change of what a person may change.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Change {
    /// New name; `Some(None)` removes it.
    pub label: Option<Option<String>>,
    /// New tags.
    pub tags: Option<Vec<String>>,
    /// Whether retention leaves it alone.
    pub pinned: Option<bool>,
}

/// An answer to whoever asked.
pub type Reply<T> = oneshot::Sender<Result<T, Denied>>;

/// What comes in.
#[derive(Debug)]
pub enum Message {
    /// A request for scans; answered with all of them, and whether the answer is an earlier one's.
    Submit(Box<Submit>, Reply<(Vec<Arc<Record>>, bool)>),
    /// Stop a scan.
    Cancel(String, Reply<Arc<Record>>),
    /// Delete a scan.
    Delete(String, Reply<()>),
    /// Change label, tags or pin.
    Change(String, Change, Reply<Arc<Record>>),
    /// Hold all queued scans back, or release them.
    Hold(bool, Reply<usize>),
    /// Hold a picture.
    Show(Shown, String, Reply<()>),
    /// Take a frame for the preview, if that disturbs nobody.
    Preview,
    /// End, after the scan that is running or this time.
    Stop(Duration),
    /// From the rig.
    Rig(rig::News),
    /// From the finisher.
    Finish(finish::News),
}

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
        owner.number_queue();
        owner.housekeep();
        owner.publish();
        owner
    }

    /// Runs until it has stopped.
    pub fn run(mut self, messages: &Receiver<Message>) {
        loop {
            self.out.heartbeat.beat();
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
                    self.cancel.values().for_each(CancelFlag::cancel);
                }
                if self.active.is_none() && self.finishing.is_empty() {
                    break;
                }
            }
        }
        // With nothing left open, the next start goes on with the next number.
        if let Err(error) = self.index.set_number("clean", self.out.events.next() - 1) {
            tracing::warn!(error = chain(&error), "event numbers will have a gap");
        }
    }

    fn handle(&mut self, message: Message) {
        match message {
            Message::Submit(submit, reply) => {
                let answer = self.submit(&submit);
                // The rig starts before anybody is told: an answer never waits, a pattern might.
                self.dispatch();
                self.publish();
                let _ = reply.send(answer);
                return;
            }
            Message::Cancel(id, reply) => drop(reply.send(self.cancel(&id))),
            Message::Delete(id, reply) => drop(reply.send(self.delete(&id))),
            Message::Change(id, change, reply) => drop(reply.send(self.change(&id, change))),
            Message::Hold(held, reply) => drop(reply.send(Ok(self.hold(held)))),
            Message::Show(shown, name, reply) => self.show(shown, name, reply),
            Message::Preview => self.preview(),
            Message::Stop(grace) => self.stop(grace),
            Message::Rig(news) => self.rig_news(news),
            Message::Finish(news) => self.finish_news(news),
        }
        self.dispatch();
        self.publish();
    }

    // ------------------------------------------------------------------------------------------ requests

    fn submit(&mut self, submit: &Submit) -> Result<(Vec<Arc<Record>>, bool), Denied> {
        if let Some((key, body)) = &submit.key {
            let used = self.index.key(key).map_err(|error| Denied::Storage(chain(&error)))?;
            if let Some(used) = used {
                return self.replay(&used, body);
            }
        }
        let source = submit.source.as_deref().map(|id| self.source(id)).transpose()?;
        let decision = match &source {
            Some(_) => self.admit_decode(),
            None => self.admit(submit),
        };
        let urgent = match decision {
            Decision::Start => !submit.queue,
            Decision::Queue(_) => false,
            Decision::Refuse(refusal) => return Err(Denied::Refused(refusal)),
        };
        let records = self.records(submit, source.as_deref());
        let first = records[0].id.clone();
        let stored = records.iter().try_for_each(|record| self.index.put(record)).and_then(|()| {
            let Some((key, body)) = &submit.key else { return Ok(()) };
            let used = Key { body: body.clone(), scan: first.clone() };
            self.index.set_key(key, &used, seconds_since_1970())
        });
        if let Err(error) = stored {
            records.iter().for_each(|record| drop(self.index.remove(&record.id)));
            return Err(Denied::Storage(chain(&error)));
        }
        for record in records.iter().cloned() {
            let id = record.id.clone();
            self.accepted.insert(id.clone(), Instant::now());
            self.scans.insert(id.clone(), Arc::new(record));
            match &source {
                Some(source) => self.decode_again(&id, source, submit.mode),
                None => self.queue.push_back(Waiting { id, held: false, urgent }),
            }
        }
        if source.is_none() && decision == Decision::Start {
            // Those that are held back stay behind whoever starts now.
            let count = records.len();
            self.queue.rotate_right(count);
        }
        self.number_queue();
        for record in &records {
            self.touch(&record.id);
        }
        let ids = records.iter().map(|record| &record.id);
        Ok((ids.filter_map(|id| self.scans.get(id).cloned()).collect(), false))
    }

    /// The answer that the same request got before.
    fn replay(&self, used: &Key, body: &str) -> Result<(Vec<Arc<Record>>, bool), Denied> {
        if used.body != body {
            return Err(Denied::KeyReused);
        }
        let record = match self.scans.get(&used.scan) {
            Some(record) => Some(record.clone()),
            None => self.index.get(&used.scan).map_err(|error| Denied::Storage(chain(&error)))?.map(Arc::new),
        };
        // A scan that was deleted since is still the answer: the request must not run twice.
        let record = record.unwrap_or_else(|| Arc::new(Record::new(used.scan.clone(), String::new(), now())));
        Ok((vec![record], true))
    }

    fn records(&self, submit: &Submit, source: Option<&str>) -> Vec<Record> {
        let mode = submit.mode.unwrap_or(self.settings.mode).to_string();
        let origin = source.and_then(|id| self.find(id).ok());
        let mut records: Vec<Record> = (0..submit.repeat)
            .map(|_| {
                let mut record = Record::new(uuid::Uuid::now_v7().to_string(), mode.clone(), now());
                record.label = submit.label.clone();
                record.tags = submit.tags.clone();
                record.exposure_us = submit.exposure_us;
                record.source = source.map(str::to_owned);
                if let Some(origin) = &origin {
                    record.mode = submit.mode.map_or(origin.mode.clone(), |mode| mode.to_string());
                    record.label = record.label.or_else(|| origin.label.clone());
                    record.exposure_us = origin.exposure_us;
                }
                record
            })
            .collect();
        if records.len() > 1 {
            let (first, of) = (records[0].id.clone(), records.len());
            for (index, record) in records.iter_mut().enumerate() {
                record.series = Some(Series { index, of, first: first.clone() });
            }
        }
        records
    }

    fn admit(&mut self, submit: &Submit) -> Decision {
        self.look_at_storage();
        self.make_room(submit.repeat as u64);
        admission::admit(&self.situation(), Ask { scans: submit.repeat, queue: submit.queue })
    }

    /// A decode needs no rig, but memory and disk.
    fn admit_decode(&mut self) -> Decision {
        self.look_at_storage();
        self.make_room(1);
        let obstacles: Vec<Obstacle> =
            self.obstacles().into_iter().filter(|one| one.kind == "storage" || one.kind == "stopping").collect();
        let capacity = self.settings.raw.scan.queue_capacity;
        match (obstacles.is_empty(), self.finishing.len() <= capacity) {
            (false, _) => Decision::Refuse(Refusal::NotReady(obstacles)),
            (true, false) => Decision::Refuse(Refusal::QueueFull { capacity }),
            (true, true) => Decision::Start,
        }
    }

    fn situation(&self) -> Situation {
        let next = self.queue.iter().find(|waiting| !waiting.held).map(|waiting| waiting.id.as_str());
        let holder = self.active.as_deref().or(next).and_then(|id| self.holder(id));
        Situation {
            obstacles: self.obstacles(),
            holder,
            finishing: self.finishing.len(),
            oldest_finishing: self.finishing.front().and_then(|id| self.holder(id)),
            runnable: self.queue.iter().filter(|waiting| !waiting.held).count(),
            held: self.queue.iter().filter(|waiting| waiting.held).count(),
            capacity: self.settings.raw.scan.queue_capacity,
        }
    }

    fn holder(&self, id: &str) -> Option<Holder> {
        let record = self.scans.get(id)?;
        let Record { id, state, label, created, .. } = record.as_ref().clone();
        Some(Holder { id, state, label, created })
    }

    fn obstacles(&self) -> Vec<Obstacle> {
        let mut found = Vec::new();
        if self.stopping {
            found.push(Obstacle::new("stopping", "the service is ending; ask again when it is back"));
        }
        if self.rig.state == RigState::Fault {
            let message = self.rig.message.clone().unwrap_or_default();
            found.push(Obstacle::new("rig", message));
        }
        if let Some(message) = &self.storage_fault {
            found.push(Obstacle::new("storage", message.clone()));
        }
        found
    }

    fn find(&self, id: &str) -> Result<Arc<Record>, Denied> {
        if let Some(record) = self.scans.get(id) {
            return Ok(record.clone());
        }
        let found = self.index.get(id).map_err(|error| Denied::Storage(chain(&error)))?;
        found.map(Arc::new).ok_or(Denied::Unknown)
    }

    /// The scan that holds the frames of `id`, which may itself have been decoded from another's.
    fn source(&self, id: &str) -> Result<String, Denied> {
        let record = self.find(id)?;
        if !record.state.is_terminal() {
            return Err(Denied::State(record.state));
        }
        if record.bytes.is_none() {
            return Err(Denied::NoBundle);
        }
        match &record.source {
            Some(source) => self.source(source),
            None => Ok(record.id.clone()),
        }
    }

    fn decode_again(&mut self, id: &str, source: &str, mode: Option<Mode>) {
        let Some(record) = self.scans.get(id) else { return };
        let label = Label { id: id.to_owned(), label: record.label.clone(), tags: record.tags.clone() };
        let (source, bundle) = (self.library.bundle(source), self.library.bundle(id));
        self.cancel.insert(id.to_owned(), CancelFlag::default());
        self.finishing.push_back(id.to_owned());
        let _ = self.out.finish.send(Work::Recorded { label, source, mode, bundle });
    }

    fn cancel(&mut self, id: &str) -> Result<Arc<Record>, Denied> {
        let record = self.find(id)?;
        match record.state {
            State::Cancelled => return Ok(record),
            state if state.is_terminal() => return Err(Denied::State(state)),
            _ => {}
        }
        let series = record.series.as_ref().map(|series| series.first.clone());
        // Who stops one of a series does not want the next to begin.
        let later: Vec<String> = self
            .queue
            .iter()
            .map(|waiting| waiting.id.clone())
            .filter(|other| {
                let other = self.scans.get(other);
                let theirs = other.and_then(|record| record.series.as_ref()).map(|series| &series.first);
                other.is_some_and(|other| other.id == id) || (series.is_some() && theirs == series.as_ref())
            })
            .collect();
        for id in &later {
            self.queue.retain(|waiting| waiting.id != *id);
            self.end(id, State::Cancelled, |record| record.blame("cancelled", "the scan was cancelled"));
        }
        if let Some(flag) = self.cancel.get(id) {
            flag.cancel();
        }
        self.number_queue();
        self.find(id)
    }

    fn delete(&mut self, id: &str) -> Result<(), Denied> {
        let record = self.find(id)?;
        if !record.state.is_terminal() {
            return Err(Denied::State(record.state));
        }
        if record.pinned {
            return Err(Denied::Pinned);
        }
        if self.index.is_source(id).map_err(|error| Denied::Storage(chain(&error)))? {
            return Err(Denied::InUse);
        }
        let left = self.discard(&record).map_err(Denied::Storage)?;
        left.into_iter().for_each(|left| drop(self.out.disk.send(disk::Task::Remove(left))));
        self.look_at_storage();
        Ok(())
    }

    /// Removes a scan from disk and index. The folder's name goes first: without it the index forgets the scan at the
    /// next start in any case.
    fn discard(&mut self, record: &Record) -> Result<Option<PathBuf>, String> {
        let left = self.library.discard(&record.id).map_err(|error| chain(&error))?;
        self.index.remove(&record.id).map_err(|error| chain(&error))?;
        self.scans.remove(&record.id);
        self.recent.retain(|id| *id != record.id);
        self.event("deleted", |_| serde_json::json!({ "id": record.id }).to_string());
        Ok(left)
    }

    fn change(&mut self, id: &str, change: Change) -> Result<Arc<Record>, Denied> {
        let mut record = self.find(id)?.as_ref().clone();
        if let Some(label) = change.label {
            record.label = label;
        }
        if let Some(tags) = change.tags {
            record.tags = tags;
        }
        if let Some(pinned) = change.pinned {
            record.pinned = pinned;
        }
        let was_known = self.scans.contains_key(id);
        self.scans.insert(id.to_owned(), Arc::new(record));
        self.touch(id);
        let record = self.find(id)?;
        if !was_known {
            self.scans.remove(id);
        }
        self.library.write_record(&record).map_err(|error| Denied::Storage(chain(&error)))?;
        Ok(record)
    }

    fn hold(&mut self, held: bool) -> usize {
        let ids: Vec<String> =
            self.queue.iter().filter(|one| one.held != held).map(|one| one.id.clone()).collect();
        self.queue.iter_mut().for_each(|waiting| waiting.held = held);
        for id in &ids {
            self.edit(id, |record| record.held = held);
            self.accepted.insert(id.clone(), Instant::now());
        }
        self.number_queue();
        ids.iter().for_each(|id| self.touch(id));
        ids.len()
    }

    fn show(&mut self, shown: Shown, name: String, reply: Reply<()>) {
        let situation = self.situation();
        if let Some(obstacle) = situation.obstacles.iter().find(|one| one.kind != "storage") {
            let _ = reply.send(Err(Denied::Refused(Refusal::NotReady(vec![obstacle.clone()]))));
        } else if let Some(holder) = situation.holder {
            let _ = reply.send(Err(Denied::Refused(Refusal::Busy(holder))));
        } else {
            self.rig.showing = (name != "black").then_some(name);
            let (sender, receiver) = oneshot::channel::<Result<(), Failure>>();
            let _ = self.out.rig.send(rig::Command::Show(shown, sender));
            // The owner must not wait for a device; a thread of a moment may.
            let answer = move || {
                let answer = match receiver.blocking_recv() {
                    Ok(Ok(())) => Ok(()),
                    Ok(Err(failure)) => Err(Denied::Rig(failure.chain())),
                    Err(_) => Err(Denied::Rig("the rig went away".to_owned())),
                };
                let _ = reply.send(answer);
            };
            if let Err(error) = std::thread::Builder::new().name("show".to_owned()).spawn(answer) {
                tracing::warn!(%error, "no thread for an answer");
            }
            self.event("projector", {
                let showing = self.rig.showing.clone();
                move |_| serde_json::json!({ "show": showing }).to_string()
            });
        }
    }

    fn preview(&mut self) {
        let idle = self.rig.state == RigState::Ready && self.active.is_none() && !self.stopping;
        if idle && !self.previewing && self.queue.iter().all(|waiting| waiting.held) {
            self.previewing = self.out.rig.send(rig::Command::Preview).is_ok();
        }
    }

    fn stop(&mut self, grace: Duration) {
        self.stopping = true;
        self.stop_by = Some(Instant::now() + grace);
        // Decodes that have not begun can be asked for again; queued scans stay queued.
        tracing::info!(grace_s = grace.as_secs_f64(), "stopping");
    }

    // ------------------------------------------------------------------------------------------ dispatch

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
        self.number_queue();
    }

    // ---------------------------------------------------------------------------------------------- news

    fn rig_news(&mut self, news: rig::News) {
        match news {
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
            rig::News::Previewed => self.previewing = false,
        }
    }

    fn rig_down(&mut self, message: String) {
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

    fn taken(&mut self, captured: Box<Captured>) {
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
    fn end_of(&self, diagnosis: Diagnosis) -> (State, &'static str) {
        match diagnosis {
            Diagnosis::Cancelled if self.stop_by.is_some_and(|limit| Instant::now() >= limit) => {
                (State::Interrupted, Diagnosis::Interrupted.slug())
            }
            Diagnosis::Cancelled => (State::Cancelled, Diagnosis::Cancelled.slug()),
            other => (State::Failed, other.slug()),
        }
    }

    fn finish_news(&mut self, news: finish::News) {
        match news {
            finish::News::Begun { id } => {
                // What was cut short is only written down.
                let state = self.scans.get(&id).map(|record| record.state);
                if matches!(state, Some(State::Acquired | State::Queued)) {
                    self.advance(&id, State::Decoding);
                }
            }
            finish::News::Finished { id, result } => self.finished(&id, result),
        }
    }

    fn finished(&mut self, id: &str, result: Result<Box<Report>, Broken>) {
        self.finishing.retain(|other| other != id);
        let cancelled = self.cancel.get(id).is_some_and(CancelFlag::is_cancelled);
        let cut_short = self.cut_short.remove(id);
        match result {
            // The frames were complete and somebody asked to stop all the same: nobody wants the result.
            Ok(_) if cancelled && cut_short.is_none() => {
                match self.library.discard(id) {
                    Ok(left) => left.into_iter().for_each(|left| drop(self.out.disk.send(disk::Task::Remove(left)))),
                    Err(error) => tracing::warn!(id, error = chain(&error), "a cancelled scan still takes space"),
                }
                self.end(id, State::Cancelled, |record| record.blame("cancelled", "the scan was cancelled"));
            }
            Ok(report) => {
                let state = match cut_short {
                    Some(diagnosis) => self.end_of(diagnosis).0,
                    None if report.verdict == Verdict::Failed => State::Failed,
                    None => State::Done,
                };
                let bytes = self.library.bundle_bytes(id);
                self.end(id, state, |record| {
                    record.adopt(&report);
                    record.bytes = bytes;
                });
            }
            Err(broken) => self.end(id, State::Failed, |record| record.blame(broken.kind, broken.message)),
        }
        self.look_at_storage();
    }

    /// The rig is free again.
    fn release(&mut self) {
        self.active = None;
        if self.rig.state == RigState::Busy {
            self.rig.state = RigState::Ready;
        }
    }

    // ------------------------------------------------------------------------------------------- records

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

    fn number_queue(&mut self) {
        let order: Vec<String> = self.queue.iter().map(|waiting| waiting.id.clone()).collect();
        for (position, id) in order.iter().enumerate() {
            if self.scans.get(id).is_some_and(|record| record.queue_position != Some(position)) {
                self.edit(id, |record| record.queue_position = Some(position));
            }
        }
        self.out.metrics.queue_depth.set(order.len() as i64);
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
        let event = self.out.events.add(|id| Event { id, kind: kind.to_owned(), data: data(id) });
        if let Err(error) = self.index.add_event(&event) {
            tracing::warn!(error = chain(&error), "an event will not outlive this process");
        }
    }

    fn publish(&mut self) {
        let finishing = self.finishing.iter().cloned().collect();
        let queue = self.queue.iter().map(|waiting| waiting.id.clone()).collect();
        let snapshot = Snapshot {
            revision: self.out.events.next() - 1,
            scans: self.scans.clone(),
            capturing: self.active.clone(),
            finishing,
            queue,
            rig: self.rig.clone(),
            storage: self.storage,
            obstacles: self.obstacles(),
            stopping: self.stopping,
        };
        self.out.snapshot.send_replace(Arc::new(snapshot));
    }

    // ------------------------------------------------------------------------------------------- storage

    fn housekeep(&mut self) {
        self.housekept = Some(Instant::now());
        self.delete_expired();
        self.look_at_storage();
        let hours = self.settings.raw.api.idempotency_hours;
        let before = seconds_since_1970().saturating_sub((hours * 3600.0) as u64);
        let pruned = self.index.prune_keys(before).and_then(|()| self.index.prune_events(IN_INDEX));
        if let Err(error) = pruned {
            tracing::warn!(error = chain(&error), "the index cannot be pruned");
        }
    }

    fn delete_expired(&mut self) {
        let days = self.settings.raw.store.keep_days;
        if days <= 0.0 {
            return;
        }
        let age = Duration::from_secs_f64(days * 86_400.0);
        let Some(limit) = SystemTime::now().checked_sub(age) else { return };
        for record in self.index.deletable(Some(&rfc3339_utc(limit))).unwrap_or_default() {
            self.retire(&record);
        }
    }

    /// Deletes a scan here and now: its space is wanted.
    fn retire(&mut self, record: &Record) {
        let removed = self.discard(record).and_then(|left| match left {
            Some(left) => std::fs::remove_dir_all(left).map_err(|error| error.to_string()),
            None => Ok(()),
        });
        match removed {
            Ok(()) => {
                tracing::info!(id = record.id, created = record.created, "deleted by retention");
                self.out.metrics.retention_deleted.inc();
            }
            Err(error) => tracing::warn!(id = record.id, error, "retention cannot delete a scan"),
        }
    }

    /// Deletes the oldest scans until `scans` more have room, where the configuration wants that.
    fn make_room(&mut self, scans: u64) {
        if !self.settings.raw.store.delete_oldest || self.shortage(scans).is_none() {
            return;
        }
        for record in self.index.deletable(None).unwrap_or_default() {
            if self.shortage(scans).is_none() {
                break;
            }
            self.retire(&record);
            self.measure_storage();
        }
        self.storage_fault = self.shortage(1);
    }

    /// What is short for `scans` more, besides those under way.
    fn shortage(&self, scans: u64) -> Option<String> {
        let StorageStatus { free_bytes, used_bytes, quota_bytes, min_free_bytes, scan_bytes } = self.storage;
        let under_way = (self.finishing.len() + usize::from(self.active.is_some())) as u64;
        let needed = scan_bytes.saturating_mul(scans + under_way);
        let advice = "delete scans that are no longer needed, or set store.delete_oldest";
        if let Some(free) = free_bytes.filter(|&free| free < needed.saturating_add(min_free_bytes)) {
            return Some(format!(
                "{free} bytes are free on the disk of the scans, {needed} are needed and {min_free_bytes} must stay \
                 free: {advice}"
            ));
        }
        let quota = quota_bytes.filter(|&quota| used_bytes.saturating_add(needed) > quota)?;
        Some(format!("scans take {used_bytes} of the {quota} bytes of their quota, {needed} more are needed: {advice}"))
    }

    fn look_at_storage(&mut self) {
        self.measure_storage();
        self.storage_fault = match self.settings.raw.store.delete_oldest {
            // What retention can delete is as good as free.
            true => self.index.deletable(None).is_ok_and(|found| found.is_empty()).then(|| self.shortage(1)).flatten(),
            false => self.shortage(1),
        };
    }

    fn measure_storage(&mut self) {
        match self.library.free_bytes() {
            Ok(free) => self.storage.free_bytes = free,
            Err(error) => tracing::warn!(%error, "free space is not known"),
        }
        match self.index.bytes() {
            Ok(used) => self.storage.used_bytes = used,
            Err(error) => tracing::warn!(error = chain(&error), "used space is not known"),
        }
        self.out.metrics.storage_free.set(self.storage.free_bytes.unwrap_or(0) as i64);
        self.out.metrics.storage_used.set(self.storage.used_bytes as i64);
    }
}
