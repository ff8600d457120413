//! The thread that owns a camera, its stream and its buffers: the library is not thread-safe, so nobody else ever
//! touches them.

use std::{
    sync::{
        Arc, OnceLock,
        mpsc::{Receiver, RecvTimeoutError, Sender, TryRecvError, channel},
    },
    time::Duration,
};

use aravis::{GvDevice, GvStreamOption, glib::prelude::*, prelude::*};

use super::{
    checklist::{self, Applied},
    features::{Features, Trouble},
    health::Health,
    library,
    options::{Options, UsbMode},
    recovery::Event,
    stream::{Pool, Running},
};
use crate::{
    camera::{AppliedSettings, CameraInfo, CameraSettings, Overlap, StreamStatistics, TriggerSource},
    clock::{Clock, Timestamp},
    error::DeviceError,
    frame::Frame,
};

/// How long a buffer is waited for between two looks at the commands.
const POLL: Duration = Duration::from_millis(1);

/// How long nothing is done while no stream runs, until the next look at whether the camera is still there.
const IDLE: Duration = Duration::from_millis(200);

/// Least version of the library whose asynchronous USB streams can be trusted.
const ASYNC_FROM: [u32; 3] = [0, 8, 29];

/// What the thread is asked to do. An answer that nobody waits for any more is dropped.
pub enum Command {
    /// Apply settings.
    Apply(CameraSettings, Sender<Result<AppliedSettings, DeviceError>>),
    /// Start a stream for so many frames; the arrivals.
    Arm(usize, Sender<Result<Receiver<Result<Frame, DeviceError>>, DeviceError>>),
    /// Start an exposure.
    Trigger(Timestamp, Sender<Result<Timestamp, DeviceError>>),
    /// Stop the stream.
    Disarm(Sender<Result<StreamStatistics, DeviceError>>),
}

/// An open camera and what was made of it.
pub struct Actor {
    // Fields are dropped in this order: the stream before the camera.
    running: Option<Running>,
    features: Option<Features>,
    pool: Pool,
    device: String,
    options: Options,
    clock: Arc<dyn Clock>,
    health: Health,
    applied: Option<Applied>,
    lost: Receiver<()>,
    /// Why the camera is gone, for everybody who asks.
    gone: Arc<OnceLock<DeviceError>>,
}

impl Actor {
    /// Opens the camera called `id`, and is called `device` in errors.
    pub fn open(
        id: &str,
        device: &str,
        options: Options,
        clock: Arc<dyn Clock>,
        health: Health,
        gone: Arc<OnceLock<DeviceError>>,
    ) -> Result<(Self, CameraInfo), DeviceError> {
        let unavailable = |detail: String| DeviceError::Unavailable { device: device.to_owned(), detail };
        let camera = library::open(id).map_err(|error| {
            unavailable(format!(
                "cannot be opened ({}); {}",
                error.message(),
                super::listing::hint(error.message())
            ))
        })?;
        if camera.is_uv_device() {
            let mode = usb_mode(options.usb_mode, library::version()).map_err(unavailable)?;
            camera.uv_set_usb_mode(mode);
        }
        if camera.is_gv_device() && !options.packet_socket {
            camera.gv_set_stream_options(GvStreamOption::PACKET_SOCKET_DISABLED);
        }
        let features = Features::new(camera)?;
        if features.device().downcast_ref::<GvDevice>().is_some_and(|device| !device.is_controller()) {
            return Err(unavailable("is used by another program; close that first".to_owned()));
        }
        let (sender, lost) = channel();
        // Runs on a thread of the library, where nothing of it may be called.
        features.device().connect_control_lost(move |_| {
            let _ = sender.send(());
        });
        let info = info(&features, device, &options);
        let actor = Self {
            running: None,
            features: Some(features),
            pool: Pool::new(),
            device: device.to_owned(),
            options,
            clock,
            health,
            applied: None,
            lost,
            gone,
        };
        Ok((actor, info))
    }

    /// Works until all senders of `commands` are gone, then closes the camera.
    pub fn run(mut self, commands: &Receiver<Command>) {
        loop {
            let command = if self.running.is_some() {
                match commands.try_recv() {
                    Ok(command) => Some(command),
                    Err(TryRecvError::Empty) => None,
                    Err(TryRecvError::Disconnected) => break,
                }
            } else {
                match commands.recv_timeout(IDLE) {
                    Ok(command) => Some(command),
                    Err(RecvTimeoutError::Timeout) => None,
                    Err(RecvTimeoutError::Disconnected) => break,
                }
            };
            if self.lost.try_recv().is_ok() {
                self.lose("the connection to it broke");
            }
            match command {
                Some(command) => self.handle(command),
                None => self.poll(POLL),
            }
            // After the answer: whoever waits for it shall not wait for this.
            if self.gone.get().is_some() {
                self.close();
            }
        }
        self.close();
    }

    fn handle(&mut self, command: Command) {
        match command {
            Command::Apply(settings, reply) => drop(reply.send(self.apply(&settings))),
            Command::Arm(frames, reply) => drop(reply.send(self.arm(frames))),
            Command::Trigger(at, reply) => drop(reply.send(self.trigger(at))),
            Command::Disarm(reply) => drop(reply.send(self.disarm())),
        }
    }

    fn out_of_order(&self, operation: &'static str, state: &'static str) -> DeviceError {
        DeviceError::OutOfOrder { device: self.device.clone(), operation, state }
    }

    /// The features of a camera that is there.
    fn features(&self) -> Result<&Features, DeviceError> {
        self.features.as_ref().ok_or_else(|| match self.gone.get() {
            Some(error) => error.clone(),
            None => DeviceError::Unavailable {
                device: self.device.clone(),
                detail: "was closed; open it again".to_owned(),
            },
        })
    }

    fn poll(&mut self, timeout: Duration) {
        if let Some(running) = &mut self.running
            && running.poll(&mut self.pool, timeout)
        {
            self.health.enter(&self.device, Event::Delivered);
        }
    }

    fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        if self.running.is_some() {
            return Err(self.out_of_order("apply", "armed"));
        }
        let applied = checklist::apply(&self.device, self.features()?, settings, &self.options);
        match applied {
            Ok(applied) => {
                self.applied = Some(applied.clone());
                Ok(applied.settings)
            }
            Err(error) if error.is_refusal() => {
                // The camera may hold half of each; what it had before is put back where there was something.
                if let Some(before) = self.applied.take() {
                    let before = &before.settings.settings;
                    self.applied =
                        checklist::apply(&self.device, self.features()?, before, &self.options).ok();
                }
                Err(error)
            }
            Err(error) => {
                self.lose_with(error.clone());
                Err(error)
            }
        }
    }

    fn arm(&mut self, frames: usize) -> Result<Receiver<Result<Frame, DeviceError>>, DeviceError> {
        if self.running.is_some() {
            return Err(self.out_of_order("arm", "armed"));
        }
        self.features()?;
        let Some(applied) = &self.applied else {
            return Err(self.out_of_order("arm", "no settings are applied"));
        };
        let Some(features) = &self.features else {
            return Err(self.out_of_order("arm", "closed"));
        };
        let (sender, arrivals) = channel();
        let clock = self.clock.clone();
        let started = Running::start(features, &mut self.pool, applied, frames, &self.device, clock, sender);
        match started {
            Ok(running) => {
                self.running = Some(running);
                Ok(arrivals)
            }
            Err(error) => {
                if matches!(error, DeviceError::Unavailable { .. }) {
                    self.lose_with(error.clone());
                }
                Err(error)
            }
        }
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        self.features()?;
        let Some(running) = &self.running else {
            return Err(self.out_of_order("trigger", "not armed"));
        };
        let start = running.earliest(at);
        let source = self.applied.as_ref().map(|applied| applied.settings.settings.trigger);
        if source == Some(TriggerSource::Software) {
            self.wait_until(start);
        }
        let now = self.clock.now().max(start);
        if source == Some(TriggerSource::Software)
            && let Err(trouble) = self.features()?.execute("TriggerSoftware")
        {
            let words = format!("did not take a trigger ({})", trouble.message());
            return Err(match trouble {
                Trouble::Camera(_) => self.lose(&words),
                Trouble::Feature(_) => DeviceError::BadData { device: self.device.clone(), detail: words },
            });
        }
        // The exposure cannot have begun before the camera was told.
        let start = if now.since(start) < POLL { start } else { now };
        if let Some(running) = &mut self.running {
            running.triggered(start);
        }
        Ok(start)
    }

    /// Waits, and takes frames meanwhile.
    fn wait_until(&mut self, start: Timestamp) {
        loop {
            let left = start.since(self.clock.now());
            if left <= 2 * POLL {
                return self.clock.sleep_until(start);
            }
            self.poll(POLL);
        }
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        let Some(running) = self.running.take() else {
            self.features()?;
            return Err(self.out_of_order("disarm", "not armed"));
        };
        let statistics = running.statistics();
        let stopped = self.features()?.camera().stop_acquisition();
        drop(running);
        match stopped {
            Ok(()) => Ok(statistics),
            Err(error) => Err(self.lose(&format!("could not be stopped ({})", error.message()))),
        }
    }

    /// Gives up a camera that does not answer; the error that says so from now on.
    fn lose(&mut self, what: &str) -> DeviceError {
        let detail = format!("{what}; check power and cable, it is opened again by itself");
        let error = DeviceError::Unavailable { device: self.device.clone(), detail };
        self.lose_with(error.clone());
        error
    }

    fn lose_with(&mut self, error: DeviceError) {
        if self.gone.set(error.clone()).is_ok() {
            self.health.enter(&self.device, Event::Lost);
            if let Some(running) = &self.running {
                running.fail(&error);
            }
        }
    }

    /// Stops and closes in the order that leaves a camera usable. Each step blocks for seconds on one that is gone, and
    /// a stream that is kept on a USB camera that is gone keeps a processor busy.
    fn close(&mut self) {
        self.running = None;
        if let Some(features) = self.features.take() {
            // Whether it heard that does not matter any more.
            let _ = features.camera().stop_acquisition();
        }
    }
}

/// The mode of a USB stream that the library of this version can be trusted with.
fn usb_mode(asked: UsbMode, version: [u32; 3]) -> Result<aravis::UvUsbMode, String> {
    match asked {
        UsbMode::Sync => Ok(aravis::UvUsbMode::Sync),
        UsbMode::Async if version >= ASYNC_FROM => Ok(aravis::UvUsbMode::Async),
        UsbMode::Async => {
            let [major, minor, micro] = version;
            Err(format!(
                "asynchronous USB hangs on unplugging with libaravis {major}.{minor}.{micro}; set camera.usb_mode = \"sync\", or install 0.8.29 or later"
            ))
        }
    }
}

/// Only where the camera takes triggers while it reads out, and must, and somebody has measured how late it exposes.
fn overlap(features: &Features, options: &Options) -> Option<Overlap> {
    let must = !options.allow.iter().any(|setting| setting == "trigger_overlap");
    let can = features.has("TriggerOverlap")
        && features.entries("TriggerOverlap").iter().any(|entry| entry == "ReadOut");
    // Stamps are the times of trigger commands.
    options.trigger_latency.filter(|_| must && can).map(|latency| Overlap { latency, stamped: false })
}

fn info(features: &Features, device: &str, options: &Options) -> CameraInfo {
    let camera = features.camera();
    let text = |text: Result<aravis::glib::GString, aravis::glib::Error>| {
        text.map(|text| text.trim().to_owned()).unwrap_or_default()
    };
    let model = format!("{} {}", text(camera.vendor_name()), text(camera.model_name())).trim().to_owned();
    let serial = ["DeviceSerialNumber", "DeviceID"]
        .into_iter()
        .filter(|name| features.has(name))
        .find_map(|name| features.text(name).ok().filter(|serial| !serial.is_empty()));
    let (width, height) = camera.sensor_size().unwrap_or_default();
    CameraInfo {
        driver: super::NAME.to_owned(),
        model,
        serial: serial.unwrap_or_else(|| device.to_owned()),
        sensor_width: width.max(0) as u32,
        sensor_height: height.max(0) as u32,
        triggered: true,
        overlap: overlap(features, options),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn asynchronous_usb_is_refused_where_the_library_would_hang() {
        assert_eq!(usb_mode(UsbMode::Sync, [0, 8, 26]), Ok(aravis::UvUsbMode::Sync));
        assert_eq!(usb_mode(UsbMode::Async, [0, 8, 29]), Ok(aravis::UvUsbMode::Async));
        assert_eq!(usb_mode(UsbMode::Async, [0, 10, 0]), Ok(aravis::UvUsbMode::Async));
        assert!(usb_mode(UsbMode::Async, [0, 8, 26]).is_err_and(|why| why.contains("0.8.26")));
    }
}
