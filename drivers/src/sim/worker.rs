//! The thread that renders frames while a rig runs in real time.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread::JoinHandle,
    time::Duration,
};

use super::{camera::expose, render::Response, rig::Shared};
use crate::{clock::Timestamp, error::DeviceError, frame::PixelStore};

/// One triggered exposure.
#[derive(Debug, Clone)]
pub(crate) struct Job {
    /// Number since the rig was made.
    pub(crate) number: u64,
    /// Number since the camera was armed.
    pub(crate) trigger: u64,
    /// Start of exposure.
    pub(crate) start: Timestamp,
    /// End of exposure.
    pub(crate) end: Timestamp,
    /// End of readout.
    pub(crate) arrives: Timestamp,
}

/// A rendered exposure.
pub(crate) struct Delivery {
    pub(crate) job: Job,
    pub(crate) received: Timestamp,
    pub(crate) store: Arc<dyn PixelStore>,
}

/// Renders in order of exposure, each frame as soon as its exposure is over.
pub(crate) struct Worker {
    jobs: Option<Sender<Job>>,
    frames: Receiver<Delivery>,
    /// The frame that has been rendered but had not arrived when it was asked for.
    early: Option<Delivery>,
    cancelled: Arc<AtomicBool>,
    thread: Option<JoinHandle<Vec<Job>>>,
}

impl Worker {
    pub(crate) fn start(shared: Arc<Shared>, response: Response) -> Result<Self, DeviceError> {
        let (jobs, incoming) = channel::<Job>();
        let (outgoing, frames) = channel();
        let cancelled = Arc::new(AtomicBool::new(false));
        let stop = cancelled.clone();
        let thread = std::thread::Builder::new()
            .name("sim-camera".to_owned())
            .spawn(move || run(&shared, &response, &incoming, &outgoing, &stop))
            .map_err(|error| DeviceError::Unavailable {
                device: "sim-camera-0".to_owned(),
                detail: format!(
                    "cannot start its thread: {error}; free memory or raise the limit of threads"
                ),
            })?;
        Ok(Self { jobs: Some(jobs), frames, early: None, cancelled, thread: Some(thread) })
    }

    pub(crate) fn send(&self, job: Job) -> Result<(), DeviceError> {
        self.jobs.as_ref().and_then(|jobs| jobs.send(job).ok()).ok_or_else(died)
    }

    /// The next frame, once it has arrived; `None` after `timeout`.
    pub(crate) fn next(
        &mut self,
        shared: &Shared,
        timeout: Duration,
    ) -> Result<Option<Delivery>, DeviceError> {
        let deadline = shared.clock.now() + timeout;
        let delivery = match self.early.take() {
            Some(delivery) => delivery,
            None => match self.frames.recv_timeout(timeout) {
                Ok(delivery) => delivery,
                Err(RecvTimeoutError::Timeout) => return Ok(None),
                Err(RecvTimeoutError::Disconnected) => return Err(died()),
            },
        };
        if delivery.received > deadline {
            self.early = Some(delivery);
            shared.clock.sleep_until(deadline);
            return Ok(None);
        }
        shared.clock.sleep_until(delivery.received);
        Ok(Some(delivery))
    }

    /// Stops the thread; the exposures that it has not rendered.
    pub(crate) fn stop(mut self) -> Vec<Job> {
        self.halt()
    }

    fn halt(&mut self) -> Vec<Job> {
        self.cancelled.store(true, Ordering::Release);
        self.jobs = None;
        self.thread.take().and_then(|thread| thread.join().ok()).unwrap_or_default()
    }
}

impl Drop for Worker {
    fn drop(&mut self) {
        self.halt();
    }
}

fn died() -> DeviceError {
    DeviceError::Unavailable {
        device: "sim-camera-0".to_owned(),
        detail: "its rendering thread has ended; disarm and arm again".to_owned(),
    }
}

fn run(
    shared: &Shared,
    response: &Response,
    jobs: &Receiver<Job>,
    frames: &Sender<Delivery>,
    cancelled: &AtomicBool,
) -> Vec<Job> {
    /// Longest wait before a stop is noticed.
    const NAP: Duration = Duration::from_millis(20);
    let mut left = Vec::new();
    for job in jobs {
        while !cancelled.load(Ordering::Acquire) && shared.clock.now() < job.end {
            shared.clock.sleep_until(job.end.min(shared.clock.now() + NAP));
        }
        if cancelled.load(Ordering::Acquire) {
            left.push(job);
            continue;
        }
        let store = expose(shared, response, &job);
        let received = job.arrives.max(shared.clock.now());
        if frames.send(Delivery { job, received, store }).is_err() {
            break;
        }
    }
    left
}
