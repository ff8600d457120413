//! The thread that owns the rig: opens it, and opens it again after a failure; captures scans; holds pictures; takes
//! single frames for the preview. Nothing else ever touches a device.

pub mod calibrate;
mod picture;

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    path::PathBuf,
    sync::{
        Arc,
        mpsc::{Receiver, RecvTimeoutError, Sender},
    },
    time::{Duration, Instant},
};

use polscan_drivers::{camera::CameraInfo, error::DeviceError, projector::ProjectorInfo};
use polscan_patterns::Mode;

use super::{
    disk,
    heartbeat::Heartbeat,
    metrics::Metrics,
    owner::{Message, Reply},
    prepared::Prepared,
    preview::Preview,
};
use crate::{
    app::Rig,
    config::Settings,
    engine::{Failure, Label, Scan, Shown, Taken, rig_failure},
    report::Diagnosis,
    sequencer::{CancelFlag, Progress},
    store::BundleWriter,
};

/// Pauses before the rig is opened again.
const BACKOFF: [Duration; 5] = [
    Duration::from_millis(500),
    Duration::from_secs(1),
    Duration::from_secs(2),
    Duration::from_secs(5),
    Duration::from_secs(10),
];

/// Longest time between two signs of life of an idle rig.
const TICK: Duration = Duration::from_millis(500);

/// Test-only, and set by no unit: the label of scans in which the rig hangs for ever, as a driver that never returns does.
const STALL_VARIABLE: &str = "POLSCAN_TEST_STALL";

/// A scan to capture.
#[derive(Debug)]
pub struct Job {
    /// How it is called.
    pub label: Label,
    /// Mode.
    pub mode: Mode,
    /// Exposure, where it is not the configured one.
    pub exposure_us: Option<f64>,
    /// When it was accepted, where it is this process that accepted it.
    pub accepted: Option<Instant>,
    /// Asks it to stop.
    pub cancel: CancelFlag,
    /// Where its bundle will be.
    pub bundle: PathBuf,
    /// Where its frames are spooled.
    pub spool: PathBuf,
}

/// What the rig is asked to do.
#[derive(Debug)]
pub enum Command {
    /// Capture a scan.
    Scan(Box<Job>),
    /// Calibrate.
    Calibrate(Box<calibrate::Job>),
    /// Hold a picture, which is called this.
    Show(Shown, String, Reply<()>),
    /// Take a frame for the preview.
    Preview,
}

/// A capture that is to be finished.
#[derive(Debug)]
pub struct Captured {
    /// What was to be captured.
    pub scan: Arc<Scan>,
    /// What was.
    pub taken: Taken,
    /// Where the result goes.
    pub writer: BundleWriter,
    /// How it is called.
    pub label: Label,
    /// Asks to keep the frames alone.
    pub cancel: CancelFlag,
}

/// What the rig tells.
#[derive(Debug)]
pub enum News {
    /// It is open.
    Open {
        /// Camera.
        camera: Box<CameraInfo>,
        /// Projector.
        projector: Box<ProjectorInfo>,
        /// Bytes that a scan may need on the disk, spool and result.
        scan_bytes: u64,
    },
    /// It cannot be opened, or failed; it will be tried again.
    Down {
        /// Why and what to do.
        message: String,
    },
    /// The projector was opened again without any failure.
    Projector(Box<ProjectorInfo>),
    /// The first pattern is due.
    Started {
        /// Scan.
        id: String,
        /// Frames of the sequence.
        frames: usize,
    },
    /// A frame has come.
    Frame {
        /// Scan.
        id: String,
        /// Frames in hand.
        done: usize,
    },
    /// Frames are taken again.
    Retaking {
        /// Scan.
        id: String,
    },
    /// The capture is over and the projector black.
    Taken(Box<Captured>),
    /// The scan could not begin.
    Refused {
        /// Scan.
        id: String,
        /// Why.
        failure: Failure,
    },
    /// The capture ended in a panic, a defect of this program.
    Panicked {
        /// Scan.
        id: String,
        /// What the panic said.
        message: String,
    },
    /// A picture is held, or cannot be.
    Shown {
        /// How it is called.
        name: String,
        /// Why it cannot be.
        held: Result<(), Failure>,
        /// Who asked for it.
        reply: Reply<()>,
    },
    /// A calibration goes on or has come to its end.
    Calibration {
        /// Calibration.
        id: String,
        /// What it tells.
        said: calibrate::Said,
    },
    /// The frame for the preview has been taken, or not.
    Previewed,
}

/// Everything that the thread shares with others.
pub struct Shared {
    /// Settings of the daemon.
    pub settings: Settings,
    /// Where news go.
    pub news: Sender<Message>,
    /// Where frames are spooled.
    pub disk: Sender<disk::Task>,
    /// Where the latest frame goes.
    pub preview: Arc<Preview>,
    /// Metrics.
    pub metrics: Arc<Metrics>,
    /// When the thread last gave a sign of life.
    pub heartbeat: Arc<Heartbeat>,
}

/// An open rig and the scan that its camera is set for.
struct Open {
    rig: Rig,
    prepared: Prepared,
    /// What everybody knows of the projector.
    told: ProjectorInfo,
}

/// Runs until all senders of `commands` are gone.
pub fn run(shared: &Shared, commands: &Receiver<Command>) {
    let mut open: Option<Open> = None;
    let mut failures = 0usize;
    let mut next_try = Instant::now();
    let mut looked = Instant::now();
    loop {
        shared.heartbeat.beat();
        if open.is_none() && Instant::now() >= next_try {
            match guarded(|| Open::new(shared)) {
                Ok(opened) => {
                    shared.tell(opened.news());
                    shared.up(true);
                    open = Some(opened);
                    failures = 0;
                }
                Err(message) => {
                    shared.tell(News::Down { message });
                    next_try = Instant::now() + BACKOFF[failures.min(BACKOFF.len() - 1)];
                    failures += 1;
                }
            }
            shared.heartbeat.beat();
        }
        let wait =
            if open.is_none() { next_try.saturating_duration_since(Instant::now()).min(TICK) } else { TICK };
        // A scan says so itself, before it gives the rig back.
        let down = |message: &String| shared.down(message);
        let broken = match (commands.recv_timeout(wait), &mut open) {
            (Err(RecvTimeoutError::Disconnected), _) => break,
            (Err(RecvTimeoutError::Timeout), _) => None,
            (Ok(Command::Scan(job)), Some(rig)) => rig.scan(shared, *job),
            (Ok(Command::Calibrate(job)), Some(rig)) => rig.calibrate(shared, &job),
            (Ok(Command::Show(shown, name, reply)), Some(rig)) => {
                let held = rig.show(shared, shown);
                let broken = held.as_ref().err().and_then(broken_by);
                shared.tell(News::Shown { name, held, reply });
                broken.inspect(down)
            }
            (Ok(Command::Preview), Some(rig)) => {
                let broken = rig.preview(shared).err().map(|error| error.to_string());
                shared.tell(News::Previewed);
                broken.inspect(down)
            }
            (Ok(command), None) => {
                refuse(shared, command);
                None
            }
        };
        // Whoever watches the preview asks again and again: the projector is looked after all the same.
        let broken = match &mut open {
            Some(rig) if broken.is_none() && looked.elapsed() >= TICK => {
                looked = Instant::now();
                rig.alive().err().map(|error| error.to_string()).inspect(down)
            }
            _ => broken,
        };
        if let Some(message) = broken {
            tracing::warn!(message, "the rig is opened again");
            // Closed first: a device cannot be opened twice.
            open = None;
            shared.metrics.camera_reconnects.inc();
            next_try = Instant::now() + BACKOFF[0];
        }
    }
}

/// Never returns from a scan that a test named to see what becomes of a rig that hangs.
fn stall_if_asked(label: Option<&str>) {
    let asked = std::env::var(STALL_VARIABLE).is_ok_and(|stalled| label == Some(stalled.as_str()));
    if asked {
        tracing::warn!("the rig hangs, as {STALL_VARIABLE} asks for");
        loop {
            std::thread::park();
        }
    }
}

/// Runs `open`, with a panic of a driver as an error like any other.
fn guarded(open: impl FnOnce() -> Result<Open, Failure>) -> Result<Open, String> {
    match catch_unwind(AssertUnwindSafe(open)) {
        Ok(Ok(opened)) => Ok(opened),
        Ok(Err(failure)) => Err(failure.chain()),
        Err(panic) => Err(format!("opening the rig ended in a defect of this program: {}", said(&*panic))),
    }
}

/// What a failure says of a device that is broken. One that refuses a setting is well.
fn broken_by(failure: &Failure) -> Option<String> {
    match failure {
        Failure::Device { source, .. } if !source.is_refusal() => Some(failure.chain()),
        _ => None,
    }
}

/// What a panic said.
pub fn said(panic: &(dyn std::any::Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    text.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "no message".to_owned())
}

fn refuse(shared: &Shared, command: Command) {
    let message = "the rig is not open; see /readyz for the reason".to_owned();
    let failure = Failure::NoDevice { operation: "use the rig", message };
    match command {
        Command::Scan(job) => shared.tell(News::Refused { id: job.label.id, failure }),
        Command::Show(_, name, reply) => shared.tell(News::Shown { name, held: Err(failure), reply }),
        Command::Calibrate(job) => {
            let said = calibrate::Said::Ended(Err(failure.into()));
            shared.tell(News::Calibration { id: job.id, said });
        }
        Command::Preview => shared.tell(News::Previewed),
    }
}

impl Shared {
    fn tell(&self, news: News) {
        // Whoever does not listen any more is ending the process.
        let _ = self.news.send(Message::Rig(news));
    }

    fn down(&self, message: &str) {
        self.up(false);
        self.tell(News::Down { message: message.to_owned() });
    }

    fn up(&self, up: bool) {
        self.metrics.camera_up.set(i64::from(up));
        self.metrics.projector_up.set(i64::from(up));
    }
}

impl Open {
    fn new(shared: &Shared) -> Result<Self, Failure> {
        let mut rig = Rig::open(&shared.settings).map_err(rig_failure)?;
        let prepared = Prepared::new(&shared.settings, shared.settings.mode, None, &mut rig)?;
        let told = rig.projector.info().clone();
        Ok(Self { rig, prepared, told })
    }

    /// Whether camera and projector are still there.
    fn alive(&mut self) -> Result<(), DeviceError> {
        self.rig.camera.alive()?;
        self.rig.projector.alive()
    }

    /// Tells what the projector is now where it was opened again meanwhile.
    fn tell_projector(&mut self, shared: &Shared) {
        let projector = self.rig.projector.info();
        if *projector != self.told {
            self.told = projector.clone();
            shared.tell(News::Projector(Box::new(projector.clone())));
        }
    }

    fn news(&self) -> News {
        News::Open {
            camera: Box::new(self.rig.camera.info().clone()),
            projector: Box::new(self.rig.projector.info().clone()),
            scan_bytes: self.prepared.scan.bytes() + self.prepared.scan.frame_bytes(),
        }
    }

    /// Captures a scan; says what is broken afterwards, if anything is.
    fn scan(&mut self, shared: &Shared, job: Job) -> Option<String> {
        let id = job.label.id.clone();
        let span = tracing::info_span!("scan", id);
        let _inside = span.enter();
        stall_if_asked(job.label.label.as_deref());
        let outcome = catch_unwind(AssertUnwindSafe(|| self.capture(shared, job)));
        let (news, broken) = match outcome {
            Ok(Ok(captured)) => {
                let failure = captured.taken.failure();
                // A camera that stopped sending may be helped by being opened again; one that is well loses a moment.
                let broken = failure.filter(|reason| {
                    matches!(reason.diagnosis, Diagnosis::DeviceFault | Diagnosis::LostFrame)
                });
                let broken = broken.map(|reason| reason.message.clone());
                (News::Taken(Box::new(captured)), broken)
            }
            Ok(Err(failure)) => {
                let broken = broken_by(&failure);
                (News::Refused { id, failure }, broken)
            }
            Err(panic) => {
                let message = said(&*panic);
                (News::Panicked { id, message: message.clone() }, Some(message))
            }
        };
        // Before the rig is free again: whoever asks for the next scan must not be told that it can have it.
        if let Some(message) = &broken {
            shared.down(message);
        }
        shared.tell(news);
        broken
    }

    fn capture(&mut self, shared: &Shared, job: Job) -> Result<Captured, Failure> {
        self.prepared.renew(&shared.settings, job.mode, job.exposure_us, &mut self.rig)?;
        let scan = self.prepared.scan.clone();
        let needed = scan.bytes() + scan.frame_bytes();
        let writer = BundleWriter::create(&job.bundle, None, needed)
            .map_err(|error| Failure::storage("write the result", error))?;
        let (manifest, calibration) = scan.preface(job.label.clone())?;
        let id = job.label.id.clone();
        let spool = |task| drop(shared.disk.send(task));
        spool(disk::Task::Begin { id: id.clone(), folder: job.spool, manifest, calibration });
        let camera = self.rig.camera.info().serial.clone();
        let period = self.rig.projector.info().refresh_period.as_secs_f64();
        let clock = self.rig.clock.clone();
        let (mut first_flip, mut rehearsed_ms) = (None, 0.0);
        let mut progress = |progress: Progress<'_>| {
            shared.heartbeat.beat();
            match progress {
                Progress::Started { frames, rehearsed, .. } => {
                    rehearsed_ms = 1e3 * rehearsed.as_secs_f64();
                    shared.tell(News::Started { id: id.clone(), frames });
                }
                Progress::Captured { done, frame, .. } => {
                    spool(disk::Task::Frame { id: id.clone(), frame: Box::new(frame.clone()) });
                    shared.preview.offer(&frame.frame, &self.prepared.applied);
                    let latency = frame.frame.stamp.received.since(frame.triggered);
                    shared.metrics.trigger_to_frame.observe(latency.as_secs_f64());
                    let first = *first_flip.get_or_insert_with(|| {
                        let ago = clock.now().since(frame.receipt.flipped);
                        let waited = job.accepted.map(|accepted| accepted.elapsed().saturating_sub(ago));
                        let after_accepted_ms = waited.map(|waited| 1e3 * waited.as_secs_f64());
                        tracing::info!(after_accepted_ms, rehearsed_ms, "first pattern shown");
                        frame.receipt.flipped
                    });
                    let refreshes = frame.receipt.flipped.since(first).as_secs_f64() / period;
                    shared.metrics.present_phase_error.set((refreshes - refreshes.round()) * period);
                    shared.metrics.frames(&camera, "ok", 1);
                    shared.tell(News::Frame { id: id.clone(), done });
                }
                Progress::Accepted(_) => {}
                Progress::Retaking { roles, .. } => {
                    shared.metrics.frames(&camera, "retaken", roles.len() as u64);
                    shared.tell(News::Retaking { id: id.clone() });
                }
            }
        };
        let taken = scan.capture(&mut self.rig, &mut progress, &job.cancel);
        self.tell_projector(shared);
        shared.metrics.stream(&self.rig.camera.info().serial, taken.statistics());
        Ok(Captured { scan, taken, writer, label: job.label, cancel: job.cancel })
    }
}
