//! The thread's side: the open node, what was set on it, and the stream.

use std::{
    collections::BTreeMap,
    io,
    sync::{Arc, OnceLock, mpsc},
    time::Duration,
};

use rustix::time::{ClockId, clock_gettime};

use super::{
    Options,
    choice::{Choice, Pace, Seen, Verdict},
    controls::Plan,
    format::{Wire, code_name},
    kernel::{Arrival, BUFFER_ERROR, CLOCK_MASK, CLOCK_MONOTONIC, Node, Picture, Stream, Waited},
};
use crate::{
    camera::{AppliedSettings, CameraSettings, Region, StreamStatistics, TriggerSource},
    clock::{Clock, Timestamp},
    error::{DeviceError, Difference},
    frame::{Frame, FrameStamp},
};

/// Buffers of a stream: each frame is taken as it comes.
const BUFFERS: u32 = 6;

/// Time between frames of a camera that does not say.
const SLOWEST_PERIOD_S: f64 = 0.2;

/// A stamp so far in the future was made by another clock.
const ANOTHER_CLOCK_NS: i128 = 1_000_000_000;

/// Where frames go, or why none will come.
pub type Arrivals = mpsc::Receiver<Result<Frame, DeviceError>>;

#[derive(Debug, Clone)]
struct Applied {
    settings: AppliedSettings,
    wire: Wire,
    picture: Picture,
    region: Region,
    pace: Pace,
}

/// An open camera.
pub struct Device {
    // Dropped in this order: the stream before the node.
    running: Option<Running>,
    node: Option<Arc<Node>>,
    name: String,
    options: Options,
    clock: Arc<dyn Clock>,
    applied: Option<Applied>,
    /// Why it is gone, for everybody who asks.
    gone: Arc<OnceLock<DeviceError>>,
}

struct Running {
    stream: Stream,
    choice: Choice,
    arrivals: mpsc::Sender<Result<Frame, DeviceError>>,
    /// What to add to the machine's monotonic time for the rig's.
    offset_ns: i128,
    refused: u64,
}

fn difference(setting: &'static str, requested: impl ToString, offered: impl ToString) -> Difference {
    Difference { setting, requested: requested.to_string(), offered: offered.to_string() }
}

impl Device {
    /// A device called `name` that was just opened.
    pub fn new(
        node: Node,
        name: &str,
        options: Options,
        clock: Arc<dyn Clock>,
        gone: Arc<OnceLock<DeviceError>>,
    ) -> Self {
        let node = Some(Arc::new(node));
        Self { running: None, node, name: name.to_owned(), options, clock, applied: None, gone }
    }

    fn node(&self) -> Result<&Arc<Node>, DeviceError> {
        let ended = || self.out_of_order("a call", "closed");
        self.node.as_ref().ok_or_else(|| self.gone.get().cloned().unwrap_or_else(ended))
    }

    fn out_of_order(&self, operation: &'static str, state: &'static str) -> DeviceError {
        DeviceError::OutOfOrder { device: self.name.clone(), operation, state }
    }

    /// Whether a stream runs.
    pub fn is_running(&self) -> bool {
        self.running.is_some()
    }

    /// Gives up a camera that does not answer, and closes it: as long as it is open it cannot come back.
    fn lose(&mut self, what: &str, error: &io::Error) -> DeviceError {
        let detail = format!("{what} ({error}); check its cable, it is opened again by itself");
        let error = DeviceError::Unavailable { device: self.name.clone(), detail };
        if self.gone.set(error.clone()).is_ok()
            && let Some(running) = &self.running
        {
            let _ = running.arrivals.send(Err(error.clone()));
        }
        self.running = None;
        self.node = None;
        error
    }

    /// Sets everything and reads it back.
    pub fn apply(&mut self, settings: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        if self.running.is_some() {
            return Err(self.out_of_order("apply", "armed"));
        }
        let mut differences = Vec::new();
        if settings.trigger != TriggerSource::Software {
            differences.push(difference("trigger", "line0", "none: it runs by itself"));
        }
        let node = self.node()?.clone();
        let format = match self.set_format(&node, settings, &mut differences) {
            Ok(format) => format,
            Err(error) => return Err(self.lose("setting its format failed", &error)),
        };
        let plan = Plan::new(&node.controls(), settings, &self.options);
        let carried_out = plan.carry_out(|id, value| node.set_control(id, value), |id| node.control(id));
        match carried_out {
            Ok(found) => differences.extend(found),
            Err(error) => return Err(self.lose("setting its controls failed", &error)),
        }
        differences.retain(|found| !self.options.allow.iter().any(|name| name == found.setting));
        if let Some(refusal) = DeviceError::refused(&self.name, differences) {
            return Err(refusal);
        }
        let Some((wire, picture, region)) = format else {
            return Err(self.out_of_order("apply", "without a format"));
        };
        let applied =
            self.applied(&node, settings, plan.exposure_us(settings.exposure_us), wire, picture, region);
        let settings = applied.settings.clone();
        self.applied = Some(applied);
        Ok(settings)
    }

    /// Format, size and region, as far as the camera has them; the error is that it is gone.
    fn set_format(
        &self,
        node: &Node,
        settings: &CameraSettings,
        differences: &mut Vec<Difference>,
    ) -> io::Result<Option<(Wire, Picture, Region)>> {
        let offered = node.formats();
        let fits = |wire: &Wire| wire.carries() == settings.format && offered.contains(&wire.fourcc());
        let Some(wire) = Wire::ALL.into_iter().find(fits) else {
            let names = offered.iter().map(|&code| code_name(code)).collect::<Vec<_>>().join(", ");
            let asked = format!("{:?}", settings.format).to_lowercase();
            differences.push(difference(
                "format",
                asked,
                if names.is_empty() { "none".into() } else { names },
            ));
            return Ok(None);
        };
        let (width, height) = match self.options.frame_size {
            Some(size) => size,
            None => node.natural_size(wire.fourcc())?,
        };
        let picture = node.set_picture(Picture::wish(wire.fourcc(), width, height))?;
        if picture.fourcc != wire.fourcc() {
            differences.push(difference("format", code_name(wire.fourcc()), code_name(picture.fourcc)));
        }
        if (width, height) != (picture.width, picture.height) {
            let has = format!("{} x {}", picture.width, picture.height);
            differences.push(difference("frame_size", format!("{width} x {height}"), has));
        }
        if picture.field > 1 {
            differences.push(difference("interlacing", "none", format!("field order {}", picture.field)));
        }
        if (picture.stride as usize) < wire.row_bytes(picture.width as usize) {
            let needed = wire.row_bytes(picture.width as usize);
            differences.push(difference("format", format!("rows of {needed} bytes"), picture.stride));
        }
        let whole = Region { x: 0, y: 0, width: picture.width, height: picture.height };
        let region = settings.region.unwrap_or(whole);
        let inside = |start: u32, length: u32, all: u32| {
            length > 0 && start.checked_add(length).is_some_and(|end| end <= all)
        };
        if !inside(region.x, region.width, whole.width) || !inside(region.y, region.height, whole.height) {
            let asked = format!("{} x {} at ({}, {})", region.width, region.height, region.x, region.y);
            differences.push(difference("region", asked, format!("{} x {}", whole.width, whole.height)));
        }
        Ok(Some((wire, picture, region)))
    }

    fn applied(
        &self,
        node: &Node,
        asked: &CameraSettings,
        exposure_us: f64,
        wire: Wire,
        picture: Picture,
        region: Region,
    ) -> Applied {
        // A camera that is exposed for longer than its frames are apart is slowed down by it.
        let period_s = node.period_s().unwrap_or(SLOWEST_PERIOD_S).max(1e-6 * exposure_us);
        let exposure = Duration::from_secs_f64(1e-6 * exposure_us);
        let skip = self.options.skip_frames;
        let pace = Pace { exposure, period: Duration::from_secs_f64(period_s), skip };
        // Brightness that travels with colour has room below black and above white, unless it says otherwise.
        let narrowed = wire.has_colour() && !picture.is_full_range();
        let depth = asked.format.bit_depth();
        let settings = AppliedSettings {
            settings: CameraSettings { exposure_us, region: Some(region), ..asked.clone() },
            width: region.width,
            height: region.height,
            black_level_dn: narrowed.then_some(16.0),
            saturation_dn: if narrowed { 235 } else { ((1u32 << depth) - 1) as u16 },
            readout_us: 1e6 * pace.longest_wait().as_secs_f64(),
            noise: None,
        };
        Applied { settings, wire, picture, region, pace }
    }

    /// Starts the stream; where its frames will come out.
    pub fn arm(&mut self) -> Result<Arrivals, DeviceError> {
        if self.running.is_some() {
            return Err(self.out_of_order("arm", "armed"));
        }
        let node = self.node()?.clone();
        let Some(applied) = &self.applied else {
            return Err(self.out_of_order("arm", "no settings are applied"));
        };
        let pace = applied.pace;
        // Somebody else may have set another one meanwhile, which nothing keeps them from.
        match node.set_picture(applied.picture) {
            Ok(picture) if picture == applied.picture => {}
            Ok(_) => {
                let detail = "has another format than it was given; another program changed it".to_owned();
                return Err(DeviceError::BadData { device: self.name.clone(), detail });
            }
            Err(error) if error.kind() == io::ErrorKind::ResourceBusy => return Err(self.busy()),
            Err(error) => return Err(self.lose("setting its format failed", &error)),
        }
        match Stream::start(&node, BUFFERS) {
            Ok(stream) => {
                let (sender, arrivals) = mpsc::channel();
                let offset_ns = self.offset_ns();
                let choice = Choice::new(pace);
                self.running = Some(Running { stream, choice, arrivals: sender, offset_ns, refused: 0 });
                Ok(arrivals)
            }
            Err(error) if error.kind() == io::ErrorKind::ResourceBusy => Err(self.busy()),
            Err(error) => Err(self.lose("starting its stream failed", &error)),
        }
    }

    fn busy(&self) -> DeviceError {
        let detail = "is used by another program; close that first".to_owned();
        DeviceError::Unavailable { device: self.name.clone(), detail }
    }

    /// What lies between the machine's monotonic clock and the rig's, from the closest of some pairs of looks.
    fn offset_ns(&self) -> i128 {
        let looks = (0..5).map(|_| {
            let before = self.clock.now();
            let machine = clock_gettime(ClockId::Monotonic);
            let after = self.clock.now();
            let machine = i128::from(machine.tv_sec) * 1_000_000_000 + i128::from(machine.tv_nsec);
            let between = (i128::from(before.0) + i128::from(after.0)) / 2;
            (after.since(before), between - machine)
        });
        looks.min().map_or(0, |(_, offset)| offset)
    }

    /// Asks for an exposure; when it can begin.
    pub fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        self.node()?;
        match &mut self.running {
            Some(running) => {
                running.choice.want(at);
                Ok(at.max(self.clock.now()))
            }
            None => Err(self.out_of_order("trigger", "not armed")),
        }
    }

    /// Stops the stream and counts.
    pub fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        self.node()?;
        match self.running.take() {
            Some(running) => Ok(running.statistics()),
            None => Err(self.out_of_order("disarm", "not armed")),
        }
    }

    /// Looks whether the camera is still there while no stream runs.
    pub fn look(&mut self) {
        if let Some(Err(error)) = self.node.as_ref().map(|node| node.capability()) {
            self.lose("it went away", &error);
        }
    }

    /// Waits for a frame and passes it on if it is one that was asked for.
    pub fn poll(&mut self, milliseconds: u32) {
        let (Some(running), Some(applied)) = (&mut self.running, &self.applied) else { return };
        let ended = match running.stream.wait(milliseconds) {
            Ok(Waited::Nothing) => return,
            Ok(Waited::Frame(arrival)) => {
                if let Some(arrived) = running.judge(&arrival, applied, self.clock.now(), &self.name) {
                    let _ = running.arrivals.send(arrived);
                }
                running.stream.give_back(arrival.index)
            }
            Err(error) => Err(error),
        };
        if let Err(error) = ended {
            self.lose("its stream broke", &error);
        }
    }
}

impl Running {
    /// What to tell of a frame.
    fn judge(
        &mut self,
        arrival: &Arrival,
        applied: &Applied,
        received: Timestamp,
        device: &str,
    ) -> Option<Result<Frame, DeviceError>> {
        let bad = |detail: String| Some(Err(DeviceError::BadData { device: device.to_owned(), detail }));
        if arrival.flags & CLOCK_MASK != CLOCK_MONOTONIC {
            self.refused += 1;
            return bad(format!(
                "frame {} is not stamped by the monotonic clock (flags {:#x}): what it shows cannot be known",
                arrival.sequence, arrival.flags
            ));
        }
        let stamp = i128::from(arrival.stamp_ns) + self.offset_ns;
        let future = stamp - i128::from(received.0);
        if future > ANOTHER_CLOCK_NS {
            self.refused += 1;
            return bad(format!("frame {} is stamped {future} ns in the future", arrival.sequence));
        }
        // A driver that reckons its stamps may be ahead; nothing is read out after it has arrived.
        let stamp = stamp.min(i128::from(received.0));
        let bytes = self.stream.bytes(arrival);
        let samples = match arrival.flags & BUFFER_ERROR {
            0 => applied.wire.cut(bytes, applied.picture.stride as usize, applied.region),
            _ => None,
        };
        let stamp = Timestamp(stamp.max(0) as u64);
        let seen = Seen { sequence: arrival.sequence, stamp, whole: samples.is_some() };
        match (self.choice.enter(seen), samples) {
            (Verdict::Answer { trigger, frame, earliest_start }, Some(store)) => Some(Ok(Frame {
                width: applied.region.width,
                height: applied.region.height,
                bit_depth: applied.settings.settings.format.bit_depth(),
                stamp: FrameStamp {
                    frame_id: frame,
                    trigger,
                    exposure_start: earliest_start,
                    received,
                    device_time_ns: Some(arrival.stamp_ns),
                },
                store,
            })),
            (Verdict::ClockWentBack, _) => {
                self.refused += 1;
                bad(format!("frame {} is stamped before the one before it", arrival.sequence))
            }
            // The next frame shows the same picture.
            _ => None,
        }
    }

    fn statistics(&self) -> StreamStatistics {
        let Choice { triggers, answered, lost, damaged, unwanted, .. } = self.choice;
        let counters = [
            ("buffers", self.stream.buffers() as u64),
            ("damaged", damaged),
            ("missing_numbers", lost),
            ("unprovable", self.refused),
            ("unwanted", unwanted),
        ];
        StreamStatistics {
            triggers,
            frames: answered,
            failed: damaged + lost + self.refused,
            counters: BTreeMap::from(counters.map(|(name, count)| (name.to_owned(), count))),
        }
    }
}
