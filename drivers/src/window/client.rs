//! The projector as the scanner knows it: asks the process with the window, and starts it again where it has ended.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use rustix::time::{ClockId, clock_gettime};

use super::{
    DRIVER, WindowOptions,
    process::{Process, Silence},
    protocol::{DisplayLine, Fault, Hello, Reply, Request, Shown, VERSION, Want, encode_slide},
    supervise::Supervisor,
};
use crate::{
    clock::{Clock, Timestamp},
    error::DeviceError,
    projector::{
        DisplayState, PresentReceipt, Projector, ProjectorInfo, Slide, WindowProcess, check_slide,
        no_such_slide,
    },
};

/// Longest pause that a call sits out before it starts the process again; for longer ones it says when to come back.
const SIT_OUT: Duration = Duration::from_secs(1);

/// A window on a display.
pub(super) struct WindowProjector {
    options: WindowOptions,
    want: Want,
    clock: Arc<dyn Clock>,
    process: Option<Process>,
    supervisor: Supervisor,
    info: ProjectorInfo,
    slides: Option<Vec<Slide>>,
    /// Whether the process that runs has the slides.
    loaded: bool,
    /// Whether one of them was shown: then the end of the process took it off the display, which must not go unsaid.
    held: bool,
}

impl WindowProjector {
    /// Opens a window on the display that `serial` names, or on the only one.
    pub(super) fn open(
        options: WindowOptions,
        clock: Arc<dyn Clock>,
        serial: Option<&str>,
    ) -> Result<Self, DeviceError> {
        let want = Want {
            display: serial.unwrap_or_default().to_owned(),
            size: options.size.map(|[width, height]| (width, height)),
            refresh_hz: options.refresh_hz,
        };
        let (process, hello) = start(&options, &want)?;
        let mut supervisor = Supervisor::default();
        supervisor.ready(clock.now());
        let info = info(&hello, process.id(), 0);
        Ok(Self {
            options,
            want,
            clock,
            process: Some(process),
            supervisor,
            info,
            slides: None,
            loaded: false,
            held: false,
        })
    }

    /// Makes sure that a window is open and has the slides.
    fn ready(&mut self) -> Result<(), DeviceError> {
        if self.process.as_mut().is_some_and(|process| !process.is_there()) {
            self.end();
        }
        if self.process.is_none() {
            let now = self.clock.now();
            let wait = self.supervisor.wait(now);
            if wait > SIT_OUT {
                return Err(self.unavailable(format!(
                    "its window ended {} times; it is opened again in {:.1} s",
                    self.supervisor.ends(),
                    wait.as_secs_f64()
                )));
            }
            self.clock.sleep_until(now + wait);
            let started = start(&self.options, &self.want).and_then(|(process, hello)| {
                let has = info(&hello, process.id(), self.supervisor.ends());
                let same = |info: &ProjectorInfo| {
                    (info.serial.clone(), info.width, info.height, info.refresh_period)
                };
                let named = |info: &ProjectorInfo| {
                    let hz = info.refresh_period.as_secs_f64().recip();
                    format!("{} with {} x {} at {hz:.2} Hz", info.serial, info.width, info.height)
                };
                if same(&has) == same(&self.info) {
                    return Ok((process, has));
                }
                Err(DeviceError::Refused {
                    device: self.info.serial.clone(),
                    setting: "display as before",
                    requested: named(&self.info),
                    offered: named(&has),
                })
            });
            match started {
                Ok((process, info)) => {
                    self.supervisor.ready(self.clock.now());
                    self.process = Some(process);
                    self.info = info;
                }
                Err(error) => {
                    self.supervisor.ended(self.clock.now());
                    return Err(error);
                }
            }
        }
        if !self.loaded
            && let Some(slides) = &self.slides
        {
            let count = slides.len() as u32;
            let mut messages = vec![Request::Load { count }.encode()];
            messages.extend(slides.iter().map(encode_slide));
            match self.ask(&messages, "set of slides", self.options.patience.load)? {
                Reply::Loaded { count: has } if has == count => self.loaded = true,
                other => return Err(self.nonsense(&other)),
            }
        }
        Ok(())
    }

    /// Ends the process.
    fn end(&mut self) {
        self.process = None;
        self.loaded = false;
        self.supervisor.ended(self.clock.now());
    }

    /// Asks and waits for the answer. A process that does not answer is ended, one that is gone is named.
    fn ask(
        &mut self,
        messages: &[Vec<u8>],
        what: &'static str,
        patience: Duration,
    ) -> Result<Reply, DeviceError> {
        let device = self.info.serial.clone();
        let Some(process) = &mut self.process else {
            return Err(DeviceError::OutOfOrder { device, operation: what, state: "no window is open" });
        };
        let asked = ask(process, &device, messages, what, patience);
        match asked {
            Ok(Reply::Failed(fault)) => Err(error(&device, fault)),
            Ok(reply) => Ok(reply),
            Err(error) => {
                self.end();
                Err(error)
            }
        }
    }

    /// Shows a slide or black. The picture before the failure of a process may stay on the display until then.
    fn present(&mut self, slide: Option<u32>) -> Result<PresentReceipt, DeviceError> {
        self.ready()?;
        let messages = [Request::Show(slide).encode()];
        match self.ask(&messages, "picture on the display", self.options.patience.show)? {
            Reply::Shown(shown) if shown.slide == slide => Ok(self.receipt(&shown)),
            other => Err(self.nonsense(&other)),
        }
    }

    /// The receipt on the rig's clock. Both clocks run at the same rate and are read at the same moment.
    fn receipt(&self, shown: &Shown) -> PresentReceipt {
        let (ours, machine) = (self.clock.now(), clock_gettime(ClockId::Monotonic));
        let machine_ns = machine.tv_sec as u64 * 1_000_000_000 + machine.tv_nsec as u64;
        let flipped = i128::from(ours.0) + i128::from(shown.flipped_ns) - i128::from(machine_ns);
        PresentReceipt {
            slide: shown.slide,
            flipped: Timestamp(flipped.clamp(0, i128::from(u64::MAX)) as u64),
            refresh: shown.refresh,
            method: shown.method,
        }
    }

    fn unavailable(&self, detail: String) -> DeviceError {
        DeviceError::Unavailable { device: self.info.serial.clone(), detail }
    }

    fn nonsense(&mut self, reply: &Reply) -> DeviceError {
        self.end();
        let device = self.info.serial.clone();
        DeviceError::BadData {
            device,
            detail: format!("the projector process answers out of turn: {reply:?}"),
        }
    }
}

impl Projector for WindowProjector {
    fn info(&self) -> &ProjectorInfo {
        &self.info
    }

    fn alive(&mut self) -> Result<(), DeviceError> {
        let Some(process) = &mut self.process else { return Ok(()) };
        if process.is_there() {
            return Ok(());
        }
        Err(gone(process, &self.info.serial, "ended while nothing was asked of it"))
    }

    fn load(&mut self, slides: &[Slide]) -> Result<(), DeviceError> {
        for (number, slide) in slides.iter().enumerate() {
            check_slide(&self.info, number, slide)?;
        }
        self.slides = Some(slides.to_vec());
        self.loaded = false;
        self.held = false;
        self.ready()
    }

    fn show(&mut self, index: u32) -> Result<PresentReceipt, DeviceError> {
        let Some(slides) = &self.slides else {
            let device = self.info.serial.clone();
            return Err(DeviceError::OutOfOrder { device, operation: "show", state: "no slides are loaded" });
        };
        if index as usize >= slides.len() {
            return Err(no_such_slide(&self.info, index, slides.len()));
        }
        let held = std::mem::replace(&mut self.held, true);
        if held && let Err(gone) = self.alive() {
            self.end();
            return Err(gone);
        }
        self.present(Some(index))
    }

    fn black(&mut self) -> Result<PresentReceipt, DeviceError> {
        self.present(None)
    }
}

/// Starts a process, or connects to one, and opens its window.
fn start(options: &WindowOptions, want: &Want) -> Result<(Process, Hello), DeviceError> {
    let device = if want.display.is_empty() { "display" } else { &want.display };
    let mut process = Process::start(options).map_err(|cause| unstarted(options, device, &cause))?;
    let open = Request::Open { version: VERSION, want: want.clone() };
    match ask(&mut process, device, &[open.encode()], "open window", options.patience.open)? {
        Reply::Hello(hello) if hello.version == VERSION => Ok((process, hello)),
        Reply::Failed(fault) => Err(error(device, fault)),
        other => Err(DeviceError::BadData {
            device: device.to_owned(),
            detail: format!("the projector process answers out of turn: {other:?}"),
        }),
    }
}

/// Displays that a process which runs already can see.
pub(super) fn list(options: &WindowOptions) -> Result<Vec<DisplayLine>, DeviceError> {
    let device = "projector process";
    let mut process = Process::start(options).map_err(|cause| unstarted(options, device, &cause))?;
    let messages = [Request::List { version: VERSION }.encode()];
    match ask(&mut process, device, &messages, "list of displays", options.patience.show)? {
        Reply::Displays(lines) => Ok(lines),
        Reply::Failed(fault) => Err(error(device, fault)),
        other => Err(DeviceError::BadData {
            device: device.to_owned(),
            detail: format!("the projector process answers out of turn: {other:?}"),
        }),
    }
}

fn unstarted(options: &WindowOptions, device: &str, cause: &std::io::Error) -> DeviceError {
    let detail = match &options.socket {
        Some(path) => format!(
            "nothing serves a projector at {} ({cause}); start `polscan projector --listen` in the seat's session",
            path.display()
        ),
        None => format!("cannot start {} projector: {cause}", options.program.display()),
    };
    DeviceError::Unavailable { device: device.to_owned(), detail }
}

/// Asks and waits for the answer, with the end of the process in words.
fn ask(
    process: &mut Process,
    device: &str,
    messages: &[Vec<u8>],
    awaited: &'static str,
    patience: Duration,
) -> Result<Reply, DeviceError> {
    process.ask(messages, Instant::now() + patience).map_err(|silence| match silence {
        Silence::Late => DeviceError::Timeout {
            device: device.to_owned(),
            awaited,
            timeout_ms: patience.as_millis() as u64,
        },
        Silence::Gone(cause) => gone(process, device, &cause.to_string()),
    })
}

fn gone(process: &mut Process, device: &str, cause: &str) -> DeviceError {
    let detail = format!(
        "the process with its window is gone ({cause}; {}); it is started again with the next picture",
        process.last_words()
    );
    DeviceError::Unavailable { device: device.to_owned(), detail }
}

/// A fault of the window as what can go wrong with a device.
pub(super) fn error(device: &str, fault: Fault) -> DeviceError {
    let device = device.to_owned();
    match fault {
        Fault::Unavailable(detail) => DeviceError::Unavailable { device, detail },
        Fault::Refused { what, requested, offered } => {
            DeviceError::Refused { device, setting: what.name(), requested, offered }
        }
        Fault::Timeout(timeout_ms) => {
            DeviceError::Timeout { device, awaited: "picture on the display", timeout_ms }
        }
        Fault::Broken(detail) => DeviceError::BadData { device, detail },
    }
}

fn info(hello: &Hello, pid: Option<u32>, restarts: u32) -> ProjectorInfo {
    ProjectorInfo {
        driver: DRIVER.to_owned(),
        model: hello.model.clone(),
        serial: hello.connector.clone(),
        width: hello.width,
        height: hello.height,
        refresh_period: Duration::from_nanos(hello.period_ns),
        timing: None,
        display: Some(DisplayState {
            adapter: hello.adapter.clone(),
            format: hello.format.clone(),
            receipts: hello.method,
            findings: hello.findings.clone(),
            process: Some(WindowProcess { pid, restarts }),
        }),
    }
}
