//! The camera that is handed out: commands to the thread that owns the real one.

use std::{
    sync::{
        Arc, OnceLock,
        mpsc::{Receiver, RecvTimeoutError, Sender, channel},
    },
    thread,
    time::{Duration, Instant},
};

use super::{
    actor::{Actor, Command},
    health::{Health, Taken},
    options::Options,
};
use crate::{
    camera::{AppliedSettings, Camera, CameraInfo, CameraSettings, StreamStatistics},
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::Frame,
};

/// Longest that the camera's thread may take for a command: a camera that is gone blocks each access for seconds.
const ANSWER: Duration = Duration::from_secs(30);

/// How long an answer is waited for between two looks at whether the camera is gone.
const LOOK: Duration = Duration::from_millis(50);

/// Longest that closing is waited for; the thread then ends by itself.
const CLOSING: Duration = Duration::from_secs(15);

/// Opens a camera on a thread of its own.
pub fn open(
    id: &str,
    name: &str,
    options: Options,
    clock: Arc<dyn Clock>,
    health: Health,
    taken: Taken,
) -> Result<Box<dyn Camera>, DeviceError> {
    let (sender, commands) = channel();
    let (opened, opening) = channel();
    let (alive, closed) = channel::<()>();
    let (id, device) = (id.to_owned(), name.to_owned());
    let thread_clock = clock.clone();
    let gone = Arc::new(OnceLock::new());
    let gone_there = gone.clone();
    let work = move || {
        match Actor::open(&id, &device, options, thread_clock, health, gone_there) {
            Ok((actor, info)) => {
                // Whoever does not wait any more has dropped the commands too.
                let _ = opened.send(Ok(info));
                actor.run(&commands);
            }
            Err(error) => drop(opened.send(Err(error))),
        }
        // In this order: the camera is free before its closing is over.
        drop(taken);
        drop(alive);
    };
    let unavailable = |detail: String| DeviceError::Unavailable { device: name.to_owned(), detail };
    thread::Builder::new()
        .name("aravis".to_owned())
        .spawn(work)
        .map_err(|error| unavailable(format!("its thread does not start: {error}")))?;
    let info = opening
        .recv_timeout(ANSWER)
        .map_err(|_| unavailable("does not answer; check power and cable".to_owned()))??;
    Ok(Box::new(AravisCamera { commands: Some(sender), closed, info, clock, arrivals: None, gone }))
}

struct AravisCamera {
    /// Gone only while this is dropped.
    commands: Option<Sender<Command>>,
    /// Ends when the camera is closed.
    closed: Receiver<()>,
    info: CameraInfo,
    clock: Arc<dyn Clock>,
    arrivals: Option<Receiver<Result<Frame, DeviceError>>>,
    /// Why the camera is gone: its thread may be busy for seconds with letting go of it.
    gone: Arc<OnceLock<DeviceError>>,
}

impl AravisCamera {
    fn ask<T>(
        &self,
        command: impl FnOnce(Sender<Result<T, DeviceError>>) -> Command,
        extra: Duration,
    ) -> Result<T, DeviceError> {
        let (reply, answer) = channel();
        let silent = |detail: &str| DeviceError::Unavailable {
            device: self.info.serial.clone(),
            detail: detail.to_owned(),
        };
        let sent = self.commands.as_ref().is_some_and(|commands| commands.send(command(reply)).is_ok());
        if !sent {
            return Err(silent("its thread has ended; open it again"));
        }
        let deadline = Instant::now() + ANSWER + extra;
        loop {
            match answer.recv_timeout(LOOK) {
                Ok(answer) => return answer,
                Err(RecvTimeoutError::Disconnected) => {
                    return Err(silent("its thread has ended; open it again"));
                }
                Err(RecvTimeoutError::Timeout) => {}
            }
            if let Some(gone) = self.gone.get() {
                return Err(gone.clone());
            }
            if Instant::now() > deadline {
                return Err(silent("does not answer; check power and cable"));
            }
        }
    }
}

impl Camera for AravisCamera {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn alive(&self) -> Result<(), DeviceError> {
        self.gone.get().map_or(Ok(()), |gone| Err(gone.clone()))
    }

    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        let settings = settings.clone();
        self.ask(|reply| Command::Apply(settings, reply), Duration::ZERO)
    }

    fn arm(&mut self, frames: usize) -> Result<(), DeviceError> {
        self.arrivals = Some(self.ask(|reply| Command::Arm(frames, reply), Duration::ZERO)?);
        Ok(())
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        let ahead = at.since(self.clock.now());
        self.ask(|reply| Command::Trigger(at, reply), ahead)
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let Some(arrivals) = &self.arrivals else {
            let device = self.info.serial.clone();
            return Err(DeviceError::OutOfOrder { device, operation: "next_frame", state: "not armed" });
        };
        match arrivals.recv_timeout(timeout) {
            Ok(arrival) => arrival,
            Err(RecvTimeoutError::Timeout) => Err(DeviceError::Timeout {
                device: self.info.serial.clone(),
                awaited: "frame",
                timeout_ms: timeout.as_millis() as u64,
            }),
            Err(RecvTimeoutError::Disconnected) => Err(DeviceError::Unavailable {
                device: self.info.serial.clone(),
                detail: "its stream has ended; open it again".to_owned(),
            }),
        }
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        let statistics = self.ask(Command::Disarm, Duration::ZERO);
        self.arrivals = None;
        statistics
    }
}

impl Drop for AravisCamera {
    fn drop(&mut self) {
        self.arrivals = None;
        self.commands = None;
        // One that is gone is let go of in its own time, and cannot be opened before.
        if self.gone.get().is_none() {
            // Ends with the sender on the other side; nothing is ever sent.
            let _ = self.closed.recv_timeout(CLOSING);
        }
    }
}
