//! Starting the scanner's threads, and the handle by which everybody else talks to them.

use std::{
    path::{Path, PathBuf},
    sync::{
        Arc,
        mpsc::{Sender, channel},
    },
    thread::{Builder, JoinHandle},
    time::Duration,
};

use tokio::sync::{oneshot, watch};

use super::{
    EventLog, Heartbeat, Metrics, Preview, Record, Snapshot,
    calibration::CalibrationRecord,
    disk, finish,
    owner::{CalibrationAsk, Change, Denied, Message, Outlets, Owner, SessionAsk, Submit},
    rig,
};
use crate::{
    calibrate::rig::Step,
    config::Settings,
    engine::Shown,
    pipeline::background_pool,
    store::{Index, Library},
};

/// Talks to the scanner. Cheap to clone.
#[derive(Debug, Clone)]
pub struct Scanner {
    messages: Sender<Message>,
    snapshot: watch::Receiver<Arc<Snapshot>>,
    folder: PathBuf,
    /// Events.
    pub events: Arc<EventLog>,
    /// The latest frame.
    pub preview: Arc<Preview>,
    /// Metrics.
    pub metrics: Arc<Metrics>,
    /// Signs of life of owner and rig.
    pub heartbeats: [Arc<Heartbeat>; 2],
}

/// The scanner's threads.
#[derive(Debug)]
pub struct Threads(Vec<JoinHandle<()>>);

impl Threads {
    /// Waits until all have ended.
    pub fn join(self) {
        for thread in self.0 {
            let name = thread.thread().name().unwrap_or_default().to_owned();
            if thread.join().is_err() {
                tracing::error!(name, "a thread ended in a defect of this program");
            }
        }
    }
}

/// Starts the scanner on a store that has been recovered. The rig is opened in the background.
pub fn start(settings: Settings, library: Library, index: Index) -> std::io::Result<(Scanner, Threads)> {
    let (messages, inbox) = channel();
    let (rig_sender, rig_commands) = channel();
    let (finish_sender, work) = channel();
    let (step_sender, steps) = channel();
    let (disk_sender, disk_thread) = disk::start()?;
    let (snapshot_sender, snapshot) = watch::channel(Arc::new(Snapshot::default()));
    let next = next_event(&index);
    let scanner = Scanner {
        messages: messages.clone(),
        snapshot,
        folder: library.folder().to_owned(),
        events: Arc::new(EventLog::new(next)),
        preview: Arc::new(Preview::default()),
        metrics: Arc::new(Metrics::default()),
        heartbeats: [Arc::new(Heartbeat::default()), Arc::new(Heartbeat::default())],
    };
    let pool = Arc::new(background_pool(None).map_err(std::io::Error::other)?);
    let shared = rig::Shared {
        settings: settings.clone(),
        news: messages.clone(),
        disk: disk_sender.clone(),
        preview: scanner.preview.clone(),
        metrics: scanner.metrics.clone(),
        heartbeat: scanner.heartbeats[1].clone(),
    };
    let outlets = Outlets {
        rig: rig_sender,
        finish: finish_sender,
        steps: step_sender,
        disk: disk_sender,
        snapshot: snapshot_sender,
        events: scanner.events.clone(),
        metrics: scanner.metrics.clone(),
        heartbeat: scanner.heartbeats[0].clone(),
        rig_heartbeat: scanner.heartbeats[1].clone(),
    };
    let owner = Owner::new(settings, library, index, outlets);
    let (step_pool, step_news) = (pool.clone(), messages.clone());
    let spawn = |name: &str, run: Box<dyn FnOnce() + Send>| Builder::new().name(name.to_owned()).spawn(run);
    let threads = vec![
        spawn("owner", Box::new(move || owner.run(&inbox)))?,
        spawn("rig", Box::new(move || rig::run(&shared, &rig_commands)))?,
        spawn("finish", Box::new(move || finish::run(&pool, &messages, &work)))?,
        spawn("steps", Box::new(move || finish::run_steps(&step_pool, &step_news, &steps)))?,
        disk_thread,
    ];
    Ok((scanner, Threads(threads)))
}

/// Numbers below it may have been given out before.
fn next_event(index: &Index) -> u64 {
    let reserved = index.number("events").ok().flatten().unwrap_or(0);
    let stored = index.event_range().ok().flatten().map_or(0, |(_, newest)| newest);
    // Reserved numbers that were not used are skipped only where the last of them may have been lost.
    if stored > 0 && index.number("clean").ok().flatten() == Some(stored) {
        stored + 1
    } else {
        reserved.max(stored) + 1
    }
}

impl Scanner {
    async fn ask<T>(
        &self,
        message: impl FnOnce(oneshot::Sender<Result<T, Denied>>) -> Message,
    ) -> Result<T, Denied> {
        let (sender, receiver) = oneshot::channel();
        let gone = || Denied::Rig("the service is ending".to_owned());
        self.messages.send(message(sender)).map_err(|_| gone())?;
        receiver.await.map_err(|_| gone())?
    }

    /// Asks for scans; answers with all of them, and whether the answer is that of an earlier request with the same key.
    pub async fn submit(&self, submit: Submit) -> Result<(Vec<Arc<Record>>, bool), Denied> {
        self.ask(|reply| Message::Submit(Box::new(submit), reply)).await
    }

    /// Stops a scan.
    pub async fn cancel(&self, id: &str) -> Result<Arc<Record>, Denied> {
        self.ask(|reply| Message::Cancel(id.to_owned(), reply)).await
    }

    /// Deletes a scan.
    pub async fn delete(&self, id: &str) -> Result<(), Denied> {
        self.ask(|reply| Message::Delete(id.to_owned(), reply)).await
    }

    /// Changes label, tags or pin of a scan.
    pub async fn change(&self, id: &str, change: Change) -> Result<Arc<Record>, Denied> {
        self.ask(|reply| Message::Change(id.to_owned(), change, reply)).await
    }

    /// Holds all queued scans back, or releases them; answers how many that were.
    pub async fn hold(&self, held: bool) -> Result<usize, Denied> {
        self.ask(|reply| Message::Hold(held, reply)).await
    }

    /// Asks for a calibration, which begins at once or is refused.
    pub async fn calibrate(&self, ask: CalibrationAsk) -> Result<Arc<CalibrationRecord>, Denied> {
        self.ask(|reply| Message::Calibrate(Box::new(ask), reply)).await
    }

    /// Opens a session with a board.
    pub async fn open_session(&self, ask: SessionAsk) -> Result<Arc<CalibrationRecord>, Denied> {
        self.ask(|reply| Message::OpenSession(Box::new(ask), reply)).await
    }

    /// Goes on with a session, at once or not at all.
    pub async fn session_step(&self, id: &str, step: Step) -> Result<Arc<CalibrationRecord>, Denied> {
        self.ask(|reply| Message::SessionStep(id.to_owned(), step, reply)).await
    }

    /// Deletes a calibration and its files.
    pub async fn delete_calibration(&self, id: &str) -> Result<(), Denied> {
        self.ask(|reply| Message::DeleteCalibration(id.to_owned(), reply)).await
    }

    /// Stops a calibration.
    pub async fn cancel_calibration(&self, id: &str) -> Result<Arc<CalibrationRecord>, Denied> {
        self.ask(|reply| Message::CancelCalibration(id.to_owned(), reply)).await
    }

    /// Holds a picture; `name` is what the status calls it.
    pub async fn show(&self, shown: Shown, name: &str) -> Result<(), Denied> {
        self.ask(|reply| Message::Show(shown, name.to_owned(), reply)).await
    }

    /// Asks for a frame for the preview, if that disturbs nobody.
    pub fn want_preview(&self) {
        let _ = self.messages.send(Message::Preview);
    }

    /// Ends the scanner, after the scan that is running or after `grace`.
    pub fn stop(&self, grace: Duration) {
        let _ = self.messages.send(Message::Stop(grace));
    }

    /// Everything at this moment.
    pub fn snapshot(&self) -> Arc<Snapshot> {
        self.snapshot.borrow().clone()
    }

    /// The snapshot, now and whenever there is a new one.
    pub fn watch(&self) -> watch::Receiver<Arc<Snapshot>> {
        self.snapshot.clone()
    }

    /// Folder of the store.
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}
