//! Calibrations on the rig's thread.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    time::{Duration, Instant},
};

use super::{News, Open, Shared, said};
use crate::{
    calibrate::{self, Light, Outcome, Progress, Task},
    scanner::finish::Broken,
    sequencer::CancelFlag,
};

/// Least time between two values of a watch: eyes need no more, and each is stored.
const BETWEEN_VALUES: Duration = Duration::from_millis(100);

/// A calibration to carry out.
#[derive(Debug)]
pub struct Job {
    /// Identity.
    pub id: String,
    /// What to do.
    pub task: Task,
    /// Asks it to stop.
    pub cancel: CancelFlag,
    /// Where its files will be.
    pub folder: PathBuf,
}

/// What a calibration tells.
#[derive(Debug)]
pub enum Said {
    /// What is being done.
    Doing(String),
    /// A value of a watch.
    Watched(Light),
    /// It came to its end; the rig is free.
    Ended(Result<Box<Outcome>, Broken>),
}

impl Open {
    /// Calibrates; says what is broken afterwards, if anything is.
    pub(super) fn calibrate(&mut self, shared: &Shared, job: &Job) -> Option<String> {
        let span = tracing::info_span!("calibration", id = job.id);
        let _inside = span.enter();
        let tell = |said| shared.tell(News::Calibration { id: job.id.clone(), said });
        let mut told: Option<Instant> = None;
        let mut progress = |progress: Progress<'_>| {
            shared.heartbeat.beat();
            match progress {
                Progress::Doing(what) => tell(Said::Doing(what.to_owned())),
                Progress::Watched(light) => {
                    if told.is_none_or(|told| told.elapsed() >= BETWEEN_VALUES) {
                        told = Some(Instant::now());
                        tell(Said::Watched(light));
                    }
                }
            }
        };
        let (rig, settings) = (&mut self.rig, &shared.settings);
        let run = || calibrate::run(&job.task, &job.folder, rig, settings, &job.cancel, &mut progress);
        let (end, mut broken) = match catch_unwind(AssertUnwindSafe(run)) {
            Ok(Ok(outcome)) => (Ok(Box::new(outcome)), None),
            Ok(Err(failure)) => {
                let broken = super::broken_by(&failure);
                (Err(Broken::from(failure)), broken)
            }
            Err(panic) => {
                let message = format!("a defect of this program: {}", said(&*panic));
                (Err(Broken { kind: "internal", message: message.clone() }), Some(message))
            }
        };
        // The camera was set for the measurement: the next scan and the preview want it back as it was.
        if broken.is_none() {
            let restore = || self.prepared.restore(settings, &mut self.rig);
            broken = match catch_unwind(AssertUnwindSafe(restore)) {
                Ok(restored) => restored.err().map(|error| error.chain()),
                Err(panic) => Some(format!("a defect of this program: {}", said(&*panic))),
            };
        }
        self.tell_projector(shared);
        // Before anybody hears of the end, and may ask for more.
        if let Some(message) = &broken {
            shared.down(message);
        }
        tell(Said::Ended(end));
        broken
    }
}
