//! The camera that is handed out: work for the thread that owns the real one.

use std::{
    sync::{
        Arc, OnceLock,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use super::{
    Options, Taken,
    device::{Arrivals, Device},
    kernel::Node,
    listing::Place,
};
use crate::{
    camera::{AppliedSettings, Camera, CameraInfo, CameraSettings, StreamStatistics},
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::Frame,
};

/// How long a frame is waited for between two looks at what there is to do.
const POLL_MS: u32 = 2;

/// How long nothing is done while no stream runs, until the next look at whether the camera is still there.
const IDLE: Duration = Duration::from_millis(200);

/// Longest that a piece of work may take.
const ANSWER: Duration = Duration::from_secs(20);

type Work = Box<dyn FnOnce(&mut Device) + Send>;

/// Opens a camera on a thread of its own.
pub fn open(
    place: &Place,
    options: Options,
    clock: Arc<dyn Clock>,
    taken: Taken,
) -> Result<Box<dyn Camera>, DeviceError> {
    let unavailable = |what: &str, error: std::io::Error| DeviceError::Unavailable {
        device: place.serial.clone(),
        detail: format!("{what} ({error}); see `polscan devices`"),
    };
    let node = Node::open(&place.node).map_err(|error| unavailable("cannot be opened", error))?;
    let (sensor_width, sensor_height) = largest(&node);
    let gone = Arc::new(OnceLock::new());
    let mut device = Device::new(node, &place.serial, options, clock, gone.clone());
    let (sender, work) = channel::<Work>();
    let body = move || {
        run(&mut device, &work);
        // In this order: the node is closed before the camera is free.
        drop(device);
        drop(taken);
    };
    let thread = thread::Builder::new()
        .name("v4l2".to_owned())
        .spawn(body)
        .map_err(|error| unavailable("its thread does not start", error))?;
    let info = CameraInfo {
        driver: super::NAME.to_owned(),
        model: place.model.clone(),
        serial: place.serial.clone(),
        sensor_width,
        sensor_height,
        triggered: false,
        overlap: None,
    };
    Ok(Box::new(V4l2Camera { work: Some(sender), thread: Some(thread), info, arrivals: None, gone }))
}

/// Columns and rows of the largest frames in a format that can be read.
fn largest(node: &Node) -> (u32, u32) {
    let offered = node.formats();
    let known = super::format::Wire::ALL.into_iter().find(|wire| offered.contains(&wire.fourcc()));
    known.and_then(|wire| node.natural_size(wire.fourcc()).ok()).unwrap_or_default()
}

/// Works until nobody can ask any more.
fn run(device: &mut Device, work: &Receiver<Work>) {
    loop {
        let wait = if device.is_running() { Duration::ZERO } else { IDLE };
        match work.recv_timeout(wait) {
            Ok(work) => work(device),
            Err(RecvTimeoutError::Disconnected) => return,
            Err(RecvTimeoutError::Timeout) if device.is_running() => device.poll(POLL_MS),
            Err(RecvTimeoutError::Timeout) => device.look(),
        }
    }
}

struct V4l2Camera {
    /// Gone only while this is dropped.
    work: Option<Sender<Work>>,
    thread: Option<JoinHandle<()>>,
    info: CameraInfo,
    arrivals: Option<Arrivals>,
    gone: Arc<OnceLock<DeviceError>>,
}

impl V4l2Camera {
    fn silent(&self, detail: &str) -> DeviceError {
        let gone = self.gone.get().cloned();
        let device = self.info.serial.clone();
        gone.unwrap_or_else(|| DeviceError::Unavailable { device, detail: detail.to_owned() })
    }

    /// Lets the thread do something and waits for what came of it.
    fn ask<T: Send + 'static>(
        &self,
        work: impl FnOnce(&mut Device) -> Result<T, DeviceError> + Send + 'static,
    ) -> Result<T, DeviceError> {
        let (reply, answer) = channel();
        // An answer that nobody waits for any more is dropped.
        let work: Work = Box::new(move |device| drop(reply.send(work(device))));
        let sent = self.work.as_ref().is_some_and(|queue| queue.send(work).is_ok());
        if !sent {
            return Err(self.silent("its thread has ended; open it again"));
        }
        answer.recv_timeout(ANSWER).unwrap_or_else(|_| Err(self.silent("does not answer; plug it in again")))
    }
}

impl Camera for V4l2Camera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn alive(&self) -> Result<(), DeviceError> {
        self.gone.get().map_or(Ok(()), |gone| Err(gone.clone()))
    }

    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        let settings = settings.clone();
        self.ask(move |device| device.apply(&settings))
    }

    fn arm(&mut self, _frames: usize) -> Result<(), DeviceError> {
        self.arrivals = Some(self.ask(Device::arm)?);
        Ok(())
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        self.ask(move |device| device.trigger(at))
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let device = || self.info.serial.clone();
        let Some(arrivals) = &self.arrivals else {
            return Err(DeviceError::OutOfOrder {
                device: device(),
                operation: "next_frame",
                state: "not armed",
            });
        };
        let silent = |error| match error {
            RecvTimeoutError::Timeout => DeviceError::Timeout {
                device: device(),
                awaited: "frame",
                timeout_ms: timeout.as_millis() as u64,
            },
            RecvTimeoutError::Disconnected => self.silent("its stream has ended; open it again"),
        };
        arrivals.recv_timeout(timeout).unwrap_or_else(|error| Err(silent(error)))
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        let statistics = self.ask(Device::disarm);
        self.arrivals = None;
        statistics
    }
}

impl Drop for V4l2Camera {
    fn drop(&mut self) {
        self.work = None;
        // Nothing that the thread does takes long, and a panic there was already told.
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
