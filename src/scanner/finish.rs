//! The threads that compute: one finishes captures, decodes and writes them, one after the other; one solves calibrations.
//! They share a pool that stands back behind all others, so that the interface answers while all cores compute.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    sync::mpsc::{Receiver, Sender},
};

use polscan_patterns::Mode;

use super::{
    owner::Message,
    rig::{Captured, calibrate::Said, said},
};
use crate::{
    calibrate,
    engine::{self, DecodeRequest, Failure, Label},
    report::Report,
    sequencer::CancelFlag,
};

/// What is to be finished.
#[derive(Debug)]
pub enum Work {
    /// A capture.
    Capture(Box<Captured>),
    /// Frames that were recorded before.
    Recorded {
        /// How the result is called.
        label: Label,
        /// Bundle with the frames.
        source: PathBuf,
        /// Mode, where it is not that of the bundle.
        mode: Option<Mode>,
        /// Where the result goes.
        bundle: PathBuf,
        /// Asks not to begin.
        cancel: CancelFlag,
    },
}

/// A step of a session with a board, which needs no rig.
#[derive(Debug)]
pub struct Step {
    /// Identity of the calibration.
    pub id: String,
    /// What to do.
    pub task: calibrate::rig::Task,
    /// Asks it to stop.
    pub cancel: CancelFlag,
    /// Where its files will be.
    pub folder: PathBuf,
}

/// What the thread tells.
#[derive(Debug)]
pub enum News {
    /// It has begun with a scan.
    Begun {
        /// Scan.
        id: String,
    },
    /// A scan is finished.
    Finished {
        /// Scan.
        id: String,
        /// What came of it.
        result: Result<Box<Report>, Broken>,
    },
    /// What a step of a calibration tells.
    Calibration {
        /// Calibration.
        id: String,
        /// What it says.
        said: Said,
    },
}

/// Why there is no result.
#[derive(Debug)]
pub struct Broken {
    /// Stable slug.
    pub kind: &'static str,
    /// What went wrong.
    pub message: String,
}

impl From<Failure> for Broken {
    fn from(failure: Failure) -> Self {
        Self { kind: failure.kind().slug(), message: failure.chain() }
    }
}

/// Finishes captures until all senders of `work` are gone.
pub fn run(pool: &rayon::ThreadPool, news: &Sender<Message>, work: &Receiver<Work>) {
    let tell = |said| drop(news.send(Message::Finish(said)));
    for work in work {
        match work {
            Work::Capture(captured) => {
                let Captured { scan, taken, writer, label, cancel } = *captured;
                let id = label.id.clone();
                finish(pool, &tell, id, || scan.finish(&taken, label, writer, &cancel));
            }
            // Its frames are another's: nothing is lost, and whoever cancelled it has had the answer.
            Work::Recorded { cancel, .. } if cancel.is_cancelled() => {}
            Work::Recorded { label, source, mode, bundle, cancel: _ } => {
                let recorded = DecodeRequest {
                    bundle: &source,
                    calibration: None,
                    projector_left: false,
                    calibration_unit_mm: 1.0,
                    mode,
                    regions: &[],
                };
                let id = label.id.clone();
                finish(pool, &tell, id, || engine::decode(&recorded, label, &bundle));
            }
        }
    }
}

/// Carries out steps of calibrations until all senders are gone; on a thread of its own, so that they hold up no result.
pub fn run_steps(pool: &rayon::ThreadPool, news: &Sender<Message>, steps: &Receiver<Step>) {
    let tell = |said| drop(news.send(Message::Finish(said)));
    for step in steps {
        take_step(pool, &tell, &step);
    }
}

fn finish(
    pool: &rayon::ThreadPool,
    tell: &(dyn Fn(News) + Sync),
    id: String,
    work: impl FnOnce() -> Result<Report, Failure> + Send,
) {
    tell(News::Begun { id: id.clone() });
    let span = tracing::info_span!("scan", id);
    let result = outcome(catch_unwind(AssertUnwindSafe(|| pool.install(|| span.in_scope(work)))));
    tell(News::Finished { id, result });
}

/// What came of work that may have been broken off by a defect.
fn outcome<T>(done: std::thread::Result<Result<T, Failure>>) -> Result<Box<T>, Broken> {
    match done {
        Ok(result) => result.map(Box::new).map_err(Broken::from),
        Err(panic) => {
            let message = format!("a defect of this program: {}", said(&*panic));
            Err(Broken { kind: "internal", message })
        }
    }
}

fn take_step(pool: &rayon::ThreadPool, tell: &(dyn Fn(News) + Sync), step: &Step) {
    let tell = |said| tell(News::Calibration { id: step.id.clone(), said });
    let span = tracing::info_span!("calibration", id = step.id);
    let work = || {
        let mut doing = |what: &str| tell(Said::Doing(what.to_owned()));
        calibrate::rig::compute(&step.task, &step.folder, &step.cancel, &mut doing)
    };
    let end = outcome(catch_unwind(AssertUnwindSafe(|| pool.install(|| span.in_scope(work)))));
    tell(Said::Ended(end));
}
