//! Captures on a small rig that keeps its own account of what was on the glass during each exposure: a frame's pixels
//! say which slide was stable in front of the camera, whatever receipts and stamps claim.

use std::sync::Mutex;

use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraSettings, Overlap, PixelFormat, TriggerSource},
    clock::{MonotonicClock, VirtualClock},
    frame::{FrameStamp, PixelStore, Pixels},
    projector::{ProjectorInfo, ProjectorTiming, ReceiptMethod},
};
use polscan_patterns::{Axis, Mode, Polarization, ProjectorSize, Sequence};
use proptest::prelude::*;

use super::*;
use crate::sequencer::plan::{Order, PlanOptions};

const REFRESH_NS: u64 = 16_666_667;
const LATENCY: Duration = Duration::from_micros(33_334);
const SETTLING: Duration = Duration::from_micros(18_900);
const EXPOSURE: Duration = Duration::from_millis(2);
const READOUT: Duration = Duration::from_micros(6_100);

/// Pixel of a frame that was exposed to a mixture of pictures.
const MIXTURE: u16 = 999;
/// Pixel of a frame exposed to black or to what was there before.
const NO_SLIDE: u16 = 998;

/// What goes wrong. Frames and shows are counted from 0 over the whole capture.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Fault {
    /// The frame of exposure `n` never arrives.
    Drop(u64),
    /// The trigger is not seen: there is no exposure.
    Deaf(u64),
    /// Frame `n` arrives so much later.
    Delay(u64, Duration),
    /// Frame `n` is delivered twice.
    Duplicate(u64),
    /// Frame `n` is delivered after frame `n + 1`.
    Overtake(u64),
    /// Frame `n` is damaged.
    Damage(u64),
    /// Frame `n` has another size.
    Shrink(u64),
    /// Exposure `n` starts so much earlier than asked for, and its stamp admits it.
    Early(u64, Duration),
    /// From trigger `n` on the camera is gone.
    CameraGone(u64),
    /// No frame comes from exposure `n` on.
    Silent(u64),
    /// The camera cannot be armed.
    NoArm,
    /// Show `n` presents slide `m`, as its receipt says.
    WrongSlide(u64, u32),
    /// Show `n` presents slide `m`, and its receipt does not admit it.
    Lie(u64, u32),
    /// Show `n` flips nothing and returns the receipt of the flip before, under the new slide's name.
    FalseReceipt(u64),
    /// Show `n` flips so many refreshes late, honestly.
    LateFlip(u64, u64),
    /// Show `n` times out.
    MissedFlip(u64),
    /// From show `n` on the projector is gone, for black too.
    ProjectorGone(u64),
    /// The projector refuses its pictures.
    NoLoad,
    /// Black fails, so many times.
    NoBlack(u32),
    /// The camera's counters at the end have so many frames more.
    MoreFrames(u64),
    /// The user cancels while show `n` is under way.
    CancelAtShow(u64),
    /// The user cancels while the frame of trigger `n` is awaited.
    CancelAtFrame(u64),
}

#[derive(Debug)]
struct World {
    clock: Arc<dyn Clock>,
    faults: Vec<Fault>,
    cancel: CancelFlag,
    /// Flips so far: when, and which slide (`None` is black).
    flips: Mutex<Vec<(Timestamp, Option<u32>)>>,
}

impl World {
    fn has(&self, fault: Fault) -> bool {
        self.faults.contains(&fault)
    }

    fn find<T>(&self, select: impl Fn(Fault) -> Option<T>) -> Option<T> {
        self.faults.iter().copied().find_map(select)
    }

    /// What a sensor saw from `start` on for one exposure.
    fn seen(&self, start: Timestamp) -> u16 {
        let flips = self.flips.lock().unwrap();
        let end = start + EXPOSURE;
        let mut seen = NO_SLIDE;
        for (index, &(flip, slide)) in flips.iter().enumerate() {
            let stable = flip + LATENCY + SETTLING;
            let over = flips.get(index + 1).map_or(Timestamp(u64::MAX), |next| next.0 + LATENCY);
            if stable <= start && end <= over {
                seen = slide.map_or(NO_SLIDE, |slide| slide as u16);
            } else if start < over && flip + LATENCY < end {
                seen = MIXTURE;
            }
        }
        seen
    }
}

struct Panel {
    world: Arc<World>,
    info: ProjectorInfo,
    slides: usize,
    shows: u64,
    blacks: u32,
    gone: bool,
}

impl Panel {
    fn flip(&self, slide: Option<u32>, late: u64) -> PresentReceipt {
        let refresh = self.world.clock.now().0 / REFRESH_NS + 1 + late;
        let flipped = Timestamp(refresh * REFRESH_NS);
        self.world.clock.sleep_until(flipped);
        self.world.flips.lock().unwrap().push((flipped, slide));
        PresentReceipt { slide, flipped, refresh: Some(refresh), method: ReceiptMethod::Simulated }
    }

    fn unavailable() -> DeviceError {
        DeviceError::Unavailable { device: "panel".into(), detail: "no signal".into() }
    }

    fn timeout() -> DeviceError {
        DeviceError::Timeout { device: "panel".into(), awaited: "flip", timeout_ms: 50 }
    }
}

impl Projector for Panel {
    fn info(&self) -> &ProjectorInfo {
        &self.info
    }

    fn load(&mut self, slides: &[Slide]) -> Result<(), DeviceError> {
        if self.world.has(Fault::NoLoad) {
            return Err(Self::unavailable());
        }
        self.slides = slides.len();
        Ok(())
    }

    fn show(&mut self, index: u32) -> Result<PresentReceipt, DeviceError> {
        assert!((index as usize) < self.slides, "slide {index} was loaded");
        let show = self.shows;
        self.shows += 1;
        self.gone |= self.world.has(Fault::ProjectorGone(show));
        if self.gone {
            return Err(Self::unavailable());
        }
        if self.world.has(Fault::CancelAtShow(show)) {
            self.world.cancel.cancel();
        }
        if self.world.has(Fault::MissedFlip(show)) {
            self.world.clock.sleep_until(self.world.clock.now() + Duration::from_millis(50));
            return Err(Self::timeout());
        }
        if self.world.has(Fault::FalseReceipt(show)) {
            let flips = self.world.flips.lock().unwrap();
            let flipped = flips.last().map_or(Timestamp(0), |last| last.0);
            let refresh = Some(flipped.0 / REFRESH_NS);
            return Ok(PresentReceipt {
                slide: Some(index),
                flipped,
                refresh,
                method: ReceiptMethod::Simulated,
            });
        }
        let shown = self.world.find(|fault| match fault {
            Fault::WrongSlide(n, slide) if n == show => Some(slide),
            _ => None,
        });
        let late = self.world.find(|fault| match fault {
            Fault::LateFlip(n, refreshes) if n == show => Some(refreshes),
            _ => None,
        });
        let lie = self.world.find(|fault| match fault {
            Fault::Lie(n, slide) if n == show => Some(slide),
            _ => None,
        });
        if let Some(slide) = lie {
            return Ok(PresentReceipt { slide: Some(index), ..self.flip(Some(slide), 0) });
        }
        Ok(self.flip(Some(shown.unwrap_or(index)), late.unwrap_or(0)))
    }

    fn black(&mut self) -> Result<PresentReceipt, DeviceError> {
        let failures = self.world.find(|fault| if let Fault::NoBlack(n) = fault { Some(n) } else { None });
        self.blacks += 1;
        if self.gone {
            return Err(Self::unavailable());
        }
        if failures.is_some_and(|n| self.blacks <= n) {
            return Err(Self::timeout());
        }
        Ok(self.flip(None, 0))
    }
}

struct Eye {
    world: Arc<World>,
    info: CameraInfo,
    armed: bool,
    disarmed: u32,
    triggers: u64,
    exposures: u64,
    delivered: u64,
    /// Frames under way in the order of delivery, with the time of arrival.
    queue: VecDeque<(Timestamp, Frame)>,
    held: Option<(Timestamp, Frame)>,
}

impl Eye {
    fn frame(&self, frame_id: u64, trigger: u64, start: Timestamp, received: Timestamp) -> Frame {
        let stamp = FrameStamp { frame_id, trigger, exposure_start: start, received, device_time_ns: None };
        let width = if self.world.has(Fault::Shrink(frame_id)) { 1 } else { 2 };
        let store: Arc<dyn PixelStore> = Arc::new(vec![NO_SLIDE; width]);
        Frame { width: width as u32, height: 1, bit_depth: 12, stamp, store }
    }

    fn expose(&mut self, trigger: u64, start: Timestamp) {
        let (id, world) = (self.exposures, self.world.clone());
        self.exposures += 1;
        let silent = world.find(|fault| if let Fault::Silent(n) = fault { Some(n) } else { None });
        if world.has(Fault::Drop(id)) || silent.is_some_and(|n| id >= n) {
            return;
        }
        let delay = world.find(|fault| match fault {
            Fault::Delay(n, delay) if n == id => Some(delay),
            _ => None,
        });
        let received = start + EXPOSURE + READOUT + delay.unwrap_or_default();
        let entry = (received, self.frame(id, trigger, start, received));
        if world.has(Fault::Overtake(id)) {
            self.held = Some(entry);
            return;
        }
        self.queue.push_back(entry.clone());
        if world.has(Fault::Duplicate(id)) {
            self.queue.push_back(entry);
        }
        self.queue.extend(self.held.take());
    }
}

impl Camera for Eye {
    fn info(&self) -> &CameraInfo {
        &self.info
    }

    fn apply(&mut self, _: &CameraSettings) -> Result<AppliedSettings, DeviceError> {
        Ok(applied())
    }

    fn arm(&mut self, _: usize) -> Result<(), DeviceError> {
        if self.world.has(Fault::NoArm) {
            return Err(DeviceError::Unavailable { device: "eye".into(), detail: "busy".into() });
        }
        self.armed = true;
        Ok(())
    }

    fn trigger(&mut self, at: Timestamp) -> Result<Timestamp, DeviceError> {
        assert!(self.armed, "triggered while armed");
        let trigger = self.triggers;
        if self.world.find(|fault| if let Fault::CameraGone(n) = fault { Some(n) } else { None })
            == Some(trigger)
        {
            return Err(DeviceError::Unavailable { device: "eye".into(), detail: "unplugged".into() });
        }
        self.triggers += 1;
        let early = self.world.find(|fault| match fault {
            Fault::Early(n, early) if n == trigger => Some(early),
            _ => None,
        });
        let start = self.world.clock.now().max(Timestamp(at.0 - early.unwrap_or_default().as_nanos() as u64));
        self.world.clock.sleep_until(start);
        if !self.world.has(Fault::Deaf(trigger)) {
            self.expose(trigger, start);
        }
        if self.world.has(Fault::CancelAtFrame(trigger)) {
            self.world.cancel.cancel();
        }
        Ok(start)
    }

    fn next_frame(&mut self, timeout: Duration) -> Result<Frame, DeviceError> {
        let until = self.world.clock.now() + timeout;
        match self.queue.pop_front_if(|(arrival, _)| *arrival <= until) {
            Some((arrival, frame)) => {
                self.world.clock.sleep_until(arrival);
                if self.world.has(Fault::Damage(frame.stamp.frame_id)) {
                    return Err(DeviceError::BadData { device: "eye".into(), detail: "half a frame".into() });
                }
                self.delivered += 1;
                // Looked up only now: what was flipped after the trigger counts too.
                let seen = vec![self.world.seen(frame.stamp.exposure_start); frame.width as usize];
                Ok(Frame { store: Arc::new(seen), ..frame })
            }
            None => {
                self.world.clock.sleep_until(until);
                let timeout_ms = timeout.as_millis() as u64;
                Err(DeviceError::Timeout { device: "eye".into(), awaited: "frame", timeout_ms })
            }
        }
    }

    fn disarm(&mut self) -> Result<StreamStatistics, DeviceError> {
        self.disarmed += 1;
        if !std::mem::take(&mut self.armed) {
            let (operation, state) = ("disarm", "idle");
            return Err(DeviceError::OutOfOrder { device: "eye".into(), operation, state });
        }
        let more = self.world.find(|fault| if let Fault::MoreFrames(n) = fault { Some(n) } else { None });
        Ok(StreamStatistics {
            triggers: self.triggers,
            frames: self.delivered + more.unwrap_or(0),
            ..StreamStatistics::default()
        })
    }
}

fn applied() -> AppliedSettings {
    let settings = CameraSettings {
        exposure_us: EXPOSURE.as_secs_f64() * 1e6,
        gain_db: 0.0,
        gamma: 1.0,
        region: None,
        format: PixelFormat::Mono12,
        trigger: TriggerSource::Software,
    };
    AppliedSettings {
        settings,
        width: 2,
        height: 1,
        black_level_dn: None,
        saturation_dn: 4095,
        readout_us: READOUT.as_secs_f64() * 1e6,
        noise: None,
    }
}

/// Answers the judgements in turn; after that, judges by the slides that the frames show, as the pair sum would.
#[derive(Default)]
struct Script {
    pairs: VecDeque<PairVerdict>,
    drifts: VecDeque<PairVerdict>,
    references: Vec<(Role, u16)>,
    judged: Vec<(Axis, u8, [u16; 2])>,
    panics: bool,
}

impl Script {
    fn reference_of(&self, role: Role) -> Option<u16> {
        self.references.iter().rev().find(|reference| reference.0 == role).map(|reference| reference.1)
    }
}

impl Judge for Script {
    fn reference(&mut self, role: Role, frame: &Frame) {
        self.references.push((role, value(frame)));
    }

    fn pair(&mut self, axis: Axis, bit: u8, frame: &Frame, inverse: &Frame) -> PairVerdict {
        assert!(!self.panics, "the judge panics");
        self.judged.push((axis, bit, [frame, inverse].map(value)));
        let references = [Role::ReferenceV, Role::ReferenceH].map(|role| self.reference_of(role));
        let step = sequence().roles.iter().position(|&role| role == Role::Code { axis, bit, inverse: false });
        let step = step.expect("a bit of the sequence") as u16;
        let agree = references == [Some(0), Some(1)] && [frame, inverse].map(value) == [step, step + 1];
        let own = if agree { PairVerdict::Accept } else { suspicious("stale-frame") };
        self.pairs.pop_front().unwrap_or(own)
    }

    fn drift(&mut self, role: Role, first: &Frame, last: &Frame) -> PairVerdict {
        let expected = if role == Role::ReferenceV { [0, 12] } else { [1, 13] };
        let agree = [first, last].map(value) == expected;
        let own = if agree { PairVerdict::Accept } else { suspicious("stale-frame") };
        self.drifts.pop_front().unwrap_or(own)
    }
}

fn value(frame: &Frame) -> u16 {
    match frame.pixels() {
        Pixels::U8(samples) => samples[0].into(),
        Pixels::U16(samples) => samples[0],
    }
}

struct Run {
    result: Result<CaptureRecord, CaptureFailure>,
    world: Arc<World>,
    judge: Script,
    blacks: u32,
    disarmed: u32,
    progress: Vec<String>,
    began: Timestamp,
}

impl Run {
    fn record(&self) -> &CaptureRecord {
        self.result.as_ref().unwrap_or_else(|failure| panic!("{:?}", failure.error))
    }

    fn failure(&self) -> &CaptureFailure {
        self.result.as_ref().expect_err("the capture fails")
    }

    fn retakes(&self) -> Vec<(String, &str, u32)> {
        let retaken = match &self.result {
            Ok(record) => &record.retaken,
            Err(failure) => &failure.partial.retaken,
        };
        retaken.iter().map(|r| (format!("{} {}", r.axis, r.bit), r.reason.as_str(), r.attempt)).collect()
    }

    fn findings(&self) -> Vec<&str> {
        let notes = match &self.result {
            Ok(record) => &record.notes,
            Err(failure) => &failure.partial.notes,
        };
        notes.findings.iter().map(|finding| finding.reason.as_str()).collect()
    }

    fn ends_black(&self) -> bool {
        self.world.flips.lock().unwrap().last().is_some_and(|flip| flip.1.is_none())
    }
}

fn sequence() -> Sequence {
    Sequence::new(Mode::Pse, ProjectorSize { width: 8, height: 4 }).unwrap()
}

fn rig(faults: &[Fault]) -> (Arc<World>, Panel, Eye) {
    rig_on(Arc::new(VirtualClock::default()), faults)
}

fn rig_on(clock: Arc<dyn Clock>, faults: &[Fault]) -> (Arc<World>, Panel, Eye) {
    let (cancel, flips) = (CancelFlag::default(), Mutex::default());
    let world = Arc::new(World { clock, faults: faults.to_vec(), cancel, flips });
    let panel = Panel {
        world: world.clone(),
        info: ProjectorInfo {
            driver: "test".into(),
            model: "panel".into(),
            serial: "1".into(),
            width: 8,
            height: 4,
            refresh_period: Duration::from_nanos(REFRESH_NS),
            display: None,
            timing: Some(ProjectorTiming { latency: LATENCY, settling: SETTLING }),
        },
        slides: 0,
        shows: 0,
        blacks: 0,
        gone: false,
    };
    let eye = Eye {
        world: world.clone(),
        info: CameraInfo {
            driver: "test".into(),
            model: "eye".into(),
            serial: "1".into(),
            sensor_width: 2,
            sensor_height: 1,
            triggered: true,
            overlap: Some(OVERLAP),
        },
        armed: false,
        disarmed: 0,
        triggers: 0,
        exposures: 0,
        delivered: 0,
        queue: VecDeque::new(),
        held: None,
    };
    (world, panel, eye)
}

/// What a camera promises that takes triggers while it reads out.
const OVERLAP: Overlap = Overlap { latency: Duration::ZERO, stamped: true };

fn run_judged(faults: &[Fault], judge: Script) -> Run {
    run_with(Some(OVERLAP), faults, judge)
}

fn run_with(overlap: Option<Overlap>, faults: &[Fault], mut judge: Script) -> Run {
    let (world, mut panel, mut eye) = rig(faults);
    eye.info.overlap = overlap;
    let polarization = Polarization::green_horizontal();
    let plan =
        Plan::new(sequence(), polarization, &panel.info, &eye.info, applied(), &PlanOptions::default())
            .unwrap();
    world.clock.sleep_until(Timestamp(5_000_000_000));
    let began = world.clock.now();
    let mut progress = Vec::new();
    let result = capture(
        &mut panel,
        &mut eye,
        &*world.clock,
        &plan,
        &mut judge,
        &mut |step| {
            progress.push(match step {
                Progress::Started { frames, .. } => format!("started {frames}"),
                Progress::Captured { done, frames, frame } => {
                    format!("{} {done}/{frames}", frame.role.slug())
                }
                Progress::Accepted(frame) => format!("accepted {}", frame.role.slug()),
                Progress::Retaking { roles, retake } => {
                    format!("retaking {} {}", roles[0].slug(), retake.reason)
                }
            });
        },
        &world.cancel,
    );
    Run { result, world, judge, blacks: panel.blacks, disarmed: eye.disarmed, progress, began }
}

/// With the next flip over the readout; and, as an oracle, with each frame in hand before the next slide is asked for.
fn run(faults: &[Fault]) -> Run {
    let (run, plain) = in_both_orders(faults);
    // A cancelled capture has what it had by then.
    if !matches!(&run.result, Err(failure) if *failure.error == CaptureError::Cancelled) {
        assert_eq!(account(&run), account(&plain), "{faults:?}");
    }
    run
}

fn in_both_orders(faults: &[Fault]) -> (Run, Run) {
    let [run, plain] = [Some(OVERLAP), None].map(|overlap| {
        let run = run_with(overlap, faults, Script::default());
        assert_eq!(run.disarmed, 1, "disarmed once");
        if let Ok(record) = &run.result {
            assert_proven(record);
            let order = if overlap.is_some() { Order::Overlapped } else { Order::OneByOne };
            assert_eq!(record.synchrony.order, order);
        }
        run
    });
    (run, plain)
}

/// All of a run that does not depend on its order: pictures, slides, what was repeated and why, how it ended.
#[derive(Debug, PartialEq)]
struct Account<'a> {
    frames: Vec<(Role, u16, Option<u32>)>,
    retakes: Vec<(String, &'a str, u32)>,
    references: usize,
    findings: Vec<&'a str>,
    discarded: Vec<&'a str>,
    end: &'a str,
}

fn account(run: &Run) -> Account<'_> {
    let (frames, notes, end) = match &run.result {
        Ok(record) => (&record.frames, &record.notes, "complete"),
        Err(failure) => (&failure.partial.frames, &failure.partial.notes, failure.error.reason()),
    };
    Account {
        frames: frames.iter().map(|f| (f.role, value(&f.frame), f.receipt.slide)).collect(),
        retakes: run.retakes(),
        references: notes.references_retaken.len(),
        findings: run.findings(),
        discarded: notes.discarded.iter().map(|finding| finding.reason.as_str()).collect(),
        end,
    }
}

/// Each frame shows its own slide and nothing else, as the rig itself knows; but for references that are reported.
fn assert_proven(record: &CaptureRecord) {
    let roles = sequence().roles;
    assert_eq!(record.frames.iter().map(|captured| captured.role).collect::<Vec<_>>(), roles);
    for (step, captured) in record.frames.iter().enumerate() {
        let reported = record.notes.findings.iter().any(|f| f.role == Some(captured.role) && step >= 12);
        assert!(
            value(&captured.frame) == step as u16 || reported,
            "{} shows {:?}",
            captured.role,
            captured.frame
        );
        assert_eq!(captured.receipt.slide, Some(step as u32));
        assert_eq!(captured.frame.stamp.exposure_start, captured.triggered);
    }
}

// Mode `pse` on 8x4 pixels: 0-1 references, 2-7 column pairs, 8-11 row pairs, 12-13 references.

#[test]
fn a_healthy_rig_is_captured_at_the_display_s_own_pace() {
    let run = run(&[]);
    let record = run.record();
    assert!(record.retaken.is_empty() && record.notes == CaptureNotes::default(), "{:?}", record.notes);
    assert_eq!(record.hold_refreshes, 4);
    assert!((record.limit_seconds - 14.0 * 4.0 / 60.0).abs() < 1e-6);
    assert!(record.seconds <= record.limit_seconds, "{} of {}", record.seconds, record.limit_seconds);
    // Within the last hold, which ends with its frame.
    assert!(record.seconds > record.limit_seconds * 13.0 / 14.0);
    assert!((record.latency_ms - 53.234).abs() < 1e-3, "{}", record.latency_ms);
    assert!(record.timing_measured);
    assert_eq!(
        record.statistics,
        StreamStatistics { triggers: 14, frames: 14, ..StreamStatistics::default() }
    );
    assert!(run.ends_black());
    // Both references before the first pair, and both again at the end.
    assert_eq!(run.judge.references.len(), 4);
    let bits: Vec<(Axis, u8)> = run.judge.judged.iter().map(|judged| (judged.0, judged.1)).collect();
    assert_eq!(
        bits,
        [(Axis::Column, 0), (Axis::Column, 1), (Axis::Column, 2), (Axis::Row, 0), (Axis::Row, 1)]
    );
    assert_eq!(run.judge.judged[1].2, [4, 5]);
    assert_eq!(run.progress[0], "started 14");
    assert_eq!(run.progress.iter().filter(|line| line.starts_with("accepted")).count(), 14);
    assert!(run.progress.contains(&"row-1-inverse 12/14".to_string()));
}

#[test]
fn both_orders_show_and_expose_at_the_same_times_where_nothing_goes_wrong() {
    let (run, plain) = in_both_orders(&[]);
    let times = |run: &Run| -> Vec<(PresentReceipt, Timestamp, FrameStamp)> {
        run.record().frames.iter().map(|f| (f.receipt, f.triggered, f.frame.stamp)).collect()
    };
    assert_eq!(times(&run), times(&plain));
    assert_eq!(run.record().seconds, plain.record().seconds);
    let synchrony = &run.record().synchrony;
    assert_eq!(synchrony.idle_refreshes, Some(0));
    // The trigger delay is written in ms, to the nearest double.
    assert!(synchrony.phase_error_us.is_some_and(|error| error.worst < 1e-6), "{synchrony:?}");
    // Without a millisecond that nobody needs: 13 holds, and the last frame's own way.
    let expected = Duration::from_nanos(REFRESH_NS) * 13 * 4 + Duration::from_micros(53_234 + 2_000 + 6_100);
    assert!((run.record().seconds - expected.as_secs_f64()).abs() < 1e-9, "{}", run.record().seconds);
}

#[test]
fn a_frame_that_is_late_within_the_hold_costs_nothing_where_the_flip_does_not_wait_for_it() {
    // 20 ms later than computed: the next flip is long done, the next trigger still far.
    let late = [3, 6, 9].map(|frame| Fault::Delay(frame, Duration::from_millis(20)));
    let (run, plain) = in_both_orders(&late);
    let idle = |run: &Run| run.record().synchrony.idle_refreshes;
    assert_eq!((idle(&run), idle(&plain)), (Some(0), Some(3)));
}

#[test]
fn a_capture_in_real_time_is_proven_like_one_in_virtual_time() {
    let (world, mut panel, mut eye) = rig_on(Arc::new(MonotonicClock::start()), &[Fault::Drop(4)]);
    let polarization = Polarization::green_horizontal();
    let plan =
        Plan::new(sequence(), polarization, &panel.info, &eye.info, applied(), &PlanOptions::default())
            .unwrap();
    let mut judge = Script::default();
    let record =
        capture(&mut panel, &mut eye, &*world.clock, &plan, &mut judge, &mut |_| {}, &world.cancel).unwrap();
    assert_proven(&record);
    assert_eq!(record.retaken.len(), 1);
    // Two frames more than planned and one wait for a lost frame; a busy machine may take longer.
    assert!(record.seconds > plan.expected().as_secs_f64() + 0.25);
}

#[test]
fn a_dropped_frame_is_taken_again_with_its_pair() {
    let run = run(&[Fault::Drop(5)]);
    assert_eq!(run.retakes(), [("column 1".into(), "lost-frame", 1)]);
    assert!(run.record().retaken[0].evidence.starts_with("column bit 1 inverse: no frame"));
    assert!(run.progress.contains(&"retaking column-1 lost-frame".to_string()));
    assert!(run.findings().is_empty());
}

#[test]
fn a_trigger_that_the_camera_missed_is_taken_again() {
    assert_eq!(run(&[Fault::Deaf(9)]).retakes(), [("row 0".into(), "lost-frame", 1)]);
}

#[test]
fn a_dropped_reference_is_taken_again() {
    let run = run(&[Fault::Drop(0)]);
    let [retake] = &run.record().notes.references_retaken[..] else { panic!("{:?}", run.record().notes) };
    assert_eq!((retake.role, retake.reason.as_str(), retake.attempt), (Role::ReferenceV, "lost-frame", 1));
}

#[test]
fn a_camera_that_dies_leaves_what_was_captured() {
    let run = run(&[Fault::CameraGone(7)]);
    let failure = run.failure();
    assert_eq!(failure.error.reason(), "camera-failed");
    assert!(matches!(&*failure.error, CaptureError::Device { device: Device::Camera, .. }));
    assert_eq!(
        failure.error.to_string(),
        "capture failed (camera-failed) at column bit 2 inverse: the camera gave up"
    );
    assert_eq!(failure.partial.frames.len(), 7);
    assert_eq!(failure.partial.statistics.as_ref().unwrap().frames, 7);
    assert!(run.ends_black());
}

#[test]
fn a_camera_that_falls_silent_fails_after_three_tries_with_what_was_captured() {
    let run = run(&[Fault::Silent(7)]);
    assert_eq!(run.failure().error.reason(), "lost-frame");
    assert_eq!(run.retakes(), [("column 2".into(), "lost-frame", 1), ("column 2".into(), "lost-frame", 2)]);
    assert_eq!(run.failure().partial.frames.len(), 7);
    assert_eq!(
        *run.failure().partial.statistics.as_ref().unwrap(),
        StreamStatistics { triggers: 10, frames: 7, ..StreamStatistics::default() }
    );
    assert!(run.ends_black());
}

#[test]
fn a_late_frame_is_told_from_the_one_awaited() {
    let run = run(&[Fault::Delay(4, Duration::from_millis(280))]);
    assert_eq!(run.retakes(), [("column 1".into(), "lost-frame", 1)]);
    let [discarded] = &run.record().notes.discarded[..] else { panic!("{:?}", run.record().notes) };
    assert_eq!(discarded.reason, "stale-frame");
    assert!(run.findings().is_empty(), "{:?}", run.record().notes);
}

#[test]
fn a_frame_a_little_late_costs_time_only() {
    let run = run(&[Fault::Delay(4, Duration::from_millis(100))]);
    assert!(run.record().retaken.is_empty());
    assert!(run.record().seconds > run.record().limit_seconds);
}

#[test]
fn a_duplicate_is_dropped() {
    let run = run(&[Fault::Duplicate(6)]);
    assert!(run.record().retaken.is_empty());
    assert_eq!(run.record().notes.discarded[0].reason, "duplicate-frame");
    assert_eq!(run.record().statistics.frames, 15);
}

#[test]
fn swapped_frames_are_detected_by_their_stamps() {
    let run = run(&[Fault::Overtake(4)]);
    assert_eq!(run.retakes(), [("column 1".into(), "lost-frame", 1)]);
    assert_eq!(run.record().notes.discarded[0].reason, "swapped-frames");
}

#[test]
fn damaged_and_misshapen_frames_are_taken_again() {
    assert_eq!(run(&[Fault::Damage(3)]).retakes(), [("column 0".into(), "damaged-frame", 1)]);
    let run = run(&[Fault::Shrink(3)]);
    assert_eq!(run.retakes(), [("column 0".into(), "damaged-frame", 1)]);
    assert!(run.record().retaken[0].evidence.contains("1 samples as 1x1 px of 12 bits, 2x1 px of 12 bits"));
}

#[test]
fn an_exposure_on_an_unsettled_picture_is_not_kept() {
    let run = run(&[Fault::Early(6, Duration::from_millis(9))]);
    assert_eq!(run.retakes(), [("column 2".into(), "stale-frame", 1)]);
    assert!(
        run.record().retaken[0].evidence.contains("exposed 9.0ms before"),
        "{}",
        run.record().retaken[0].evidence
    );
}

#[test]
fn receipts_that_do_not_hold_are_not_believed() {
    assert_eq!(run(&[Fault::WrongSlide(8, 7)]).retakes(), [("row 0".into(), "wrong-slide", 1)]);
    assert_eq!(run(&[Fault::FalseReceipt(8)]).retakes(), [("row 0".into(), "stale-receipt", 1)]);
    assert_eq!(run(&[Fault::MissedFlip(8)]).retakes(), [("row 0".into(), "missed-flip", 1)]);
}

#[test]
fn a_projector_that_lies_about_a_pair_is_caught_by_the_judge() {
    let run = run(&[Fault::Lie(4, 2)]);
    assert_eq!(run.retakes(), [("column 1".into(), "stale-frame", 1)]);
}

#[test]
fn a_projector_that_lies_about_a_reference_is_caught_by_the_pairs() {
    for (show, slide) in [(0, 1), (1, 0)] {
        let run = run(&[Fault::Lie(show, slide)]);
        let again: Vec<Role> =
            run.record().notes.references_retaken.iter().map(|retake| retake.role).collect();
        assert_eq!(again, [Role::ReferenceH, Role::ReferenceV]);
        let pairs: Vec<String> = run.retakes().into_iter().map(|retake| retake.0).collect();
        assert_eq!(pairs, ["column 0", "column 1", "column 0"]);
    }
    let last = run(&[Fault::Lie(13, 12)]);
    assert_eq!(last.record().notes.references_retaken[0].role, Role::ReferenceH);
}

#[test]
fn a_late_flip_is_followed() {
    let run = run(&[Fault::LateFlip(5, 3)]);
    assert!(run.record().retaken.is_empty());
}

#[test]
fn a_projector_that_dies_is_reported_and_so_is_that_it_is_not_black() {
    let run = run(&[Fault::ProjectorGone(6)]);
    assert_eq!(run.failure().error.reason(), "projector-failed");
    assert_eq!(run.failure().partial.frames.len(), 6);
    assert_eq!(run.findings(), ["projector-not-black"]);
}

#[test]
fn black_does_not_wait_for_what_was_still_to_be_judged() {
    // The first pair is complete when the slide after it fails.
    let run = run(&[Fault::ProjectorGone(4)]);
    assert_eq!(run.failure().partial.frames.len(), 4);
    assert!(run.judge.judged.is_empty());
}

#[test]
fn black_is_tried_twice_and_its_failure_does_not_cost_the_frames() {
    let once = run(&[Fault::NoBlack(1)]);
    assert!(once.ends_black() && once.findings().is_empty());
    let never = run(&[Fault::NoBlack(9)]);
    assert_eq!(never.record().frames.len(), 14);
    assert_eq!((never.findings(), never.blacks), (vec!["projector-not-black"], 2));
}

#[test]
fn devices_that_cannot_begin_leave_nothing_on() {
    let unarmed = run(&[Fault::NoArm]);
    assert!(matches!(&*unarmed.failure().error, CaptureError::Arm { frames: 14, .. }));
    assert!(unarmed.ends_black() && unarmed.findings().is_empty());
    let unloaded = run(&[Fault::NoLoad]);
    assert!(matches!(&*unloaded.failure().error, CaptureError::Load { slides: 14, .. }));
    assert!(unloaded.ends_black() && unloaded.failure().partial.frames.is_empty());
}

#[test]
fn counters_that_do_not_agree_are_reported() {
    let run = run(&[Fault::MoreFrames(1)]);
    assert_eq!(run.findings(), ["lost-frame"]);
    assert!(
        run.record().notes.findings[0]
            .evidence
            .ends_with("14 triggers and 15 frames, 14 were sent and 14 received")
    );
}

#[test]
fn cancel_leaves_black_within_one_frame_time() {
    for fault in (0..14).flat_map(|n| [Fault::CancelAtShow(n), Fault::CancelAtFrame(n)]) {
        let run = run(&[fault]);
        assert_eq!(*run.failure().error, CaptureError::Cancelled);
        assert!(run.ends_black(), "{fault:?}");
        let flips = run.world.flips.lock().unwrap();
        let [.., last, black] = flips[..] else { panic!("{flips:?}") };
        assert!(black.0.since(last.0) <= Duration::from_nanos(REFRESH_NS) * 5, "{fault:?}");
    }
    // While nothing comes from the camera, too: far before the frame counts as lost.
    let run = run(&[Fault::Silent(3), Fault::CancelAtFrame(3)]);
    let flips = run.world.flips.lock().unwrap();
    let (last, black) = (flips[flips.len() - 2], flips[flips.len() - 1]);
    assert!(black.0.since(last.0) < Duration::from_millis(100), "{flips:?}");
}

#[test]
fn cancelled_before_it_begins_it_shows_nothing() {
    let (world, mut panel, mut eye) = rig(&[]);
    world.cancel.cancel();
    let polarization = Polarization::green_horizontal();
    let plan =
        Plan::new(sequence(), polarization, &panel.info, &eye.info, applied(), &PlanOptions::default())
            .unwrap();
    let mut judge = Script::default();
    let result = capture(&mut panel, &mut eye, &*world.clock, &plan, &mut judge, &mut |_| {}, &world.cancel);
    assert_eq!(result.unwrap_err().error.reason(), "cancelled");
    assert_eq!((panel.shows, panel.blacks, eye.disarmed), (0, 1, 1));
}

fn suspicious(reason: &str) -> PairVerdict {
    PairVerdict::Retake(Suspicion {
        reason: reason.into(),
        evidence: "column bit 0: seen".into(),
        sigma: 9.0,
    })
}

#[test]
fn a_pair_that_the_judge_refuses_is_taken_again_and_then_fails_the_scan() {
    let pairs = VecDeque::from([suspicious("torn-frame")]);
    let once = run_judged(&[], Script { pairs, ..Script::default() });
    assert_proven(once.record());
    assert_eq!(once.retakes(), [("column 0".into(), "torn-frame", 1)]);
    // Judgements alternate between the refused pair and the one under way meanwhile.
    let refused = || suspicious("stale-frame");
    let pairs = VecDeque::from([refused(), PairVerdict::Accept, refused(), PairVerdict::Accept, refused()]);
    let never = run_judged(&[], Script { pairs, ..Script::default() });
    let CaptureError::Diagnosed { reason, role, evidence } = &*never.failure().error else {
        panic!("{:?}", never.failure().error)
    };
    assert_eq!((reason.as_str(), role.unwrap().slug()), ("stale-frame", "column-0".into()));
    assert!(evidence.contains("column bit 0: seen (try 3"), "{evidence}");
    assert_eq!(never.failure().partial.frames.len(), 8, "what was captured is kept");
}

#[test]
fn references_that_drifted_are_reported() {
    let drift = Suspicion { reason: "exposure-drift".into(), evidence: "7 %".into(), sigma: 1.0 };
    let drifts = VecDeque::from([PairVerdict::Degraded(drift)]);
    let run = run_judged(&[], Script { drifts, ..Script::default() });
    assert_eq!(run.findings(), ["exposure-drift"]);
    assert_eq!(run.record().notes.findings[0].role, Some(Role::ReferenceV));
}

#[test]
fn a_judge_that_panics_leaves_the_projector_black_and_the_camera_idle() {
    let (world, mut panel, mut eye) = rig(&[]);
    let polarization = Polarization::green_horizontal();
    let plan =
        Plan::new(sequence(), polarization, &panel.info, &eye.info, applied(), &PlanOptions::default())
            .unwrap();
    let mut judge = Script { panics: true, ..Script::default() };
    let result = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
        capture(&mut panel, &mut eye, &*world.clock, &plan, &mut judge, &mut |_| {}, &world.cancel)
    }));
    assert!(result.is_err());
    assert_eq!((panel.blacks, eye.disarmed, eye.armed), (1, 1, false));
    assert_eq!(world.flips.lock().unwrap().last().unwrap().1, None);
}

#[test]
fn pictures_become_slides_of_the_same_pixels() {
    let values = vec![[1, 2, 3], [4, 5, 6]];
    assert_eq!(slide(Raster::Uniform([7; 3])), Slide::Uniform([7; 3]));
    assert_eq!(slide(Raster::Columns(values.clone())), Slide::Columns(values.clone().into()));
    assert_eq!(slide(Raster::Rows(values.clone())), Slide::Rows(values.clone().into()));
    assert_eq!(slide(Raster::Full(values.clone())), Slide::Full(values.into()));
}

fn any_fault() -> impl Strategy<Value = Fault> {
    let ms = |range: std::ops::Range<u64>| range.prop_map(Duration::from_millis);
    prop_oneof![
        (0u64..20).prop_map(Fault::Drop),
        (0u64..20).prop_map(Fault::Deaf),
        (0u64..20, ms(0..900)).prop_map(|(n, delay)| Fault::Delay(n, delay)),
        (0u64..20).prop_map(Fault::Duplicate),
        (0u64..20).prop_map(Fault::Overtake),
        (0u64..20).prop_map(Fault::Damage),
        (0u64..20).prop_map(Fault::Shrink),
        (0u64..20, ms(0..60)).prop_map(|(n, early)| Fault::Early(n, early)),
        (0u64..20, 0u32..14).prop_map(|(n, slide)| Fault::WrongSlide(n, slide)),
        (0u64..20).prop_map(Fault::FalseReceipt),
        (0u64..20, 0u32..14).prop_map(|(n, slide)| Fault::Lie(n, slide)),
        (0u64..20, 0u64..6).prop_map(|(n, late)| Fault::LateFlip(n, late)),
        (0u64..20).prop_map(Fault::MissedFlip),
        (0u64..60).prop_map(Fault::CameraGone),
        (0u64..60).prop_map(Fault::Silent),
        (0u64..60).prop_map(Fault::ProjectorGone),
        (0u64..60).prop_map(Fault::CancelAtShow),
    ]
}

/// What a camera can do wrong, and no clock decides what comes of it. How early an exposure can be depends on when its
/// trigger is heard, so that `Early` stands alone, in its own test.
fn camera_fault() -> impl Strategy<Value = Fault> {
    let ms = |range: std::ops::Range<u64>| range.prop_map(Duration::from_millis);
    prop_oneof![
        (0u64..20).prop_map(Fault::Drop),
        (0u64..20).prop_map(Fault::Deaf),
        (0u64..20, ms(0..200)).prop_map(|(n, delay)| Fault::Delay(n, delay)),
        (0u64..20).prop_map(Fault::Duplicate),
        (0u64..20).prop_map(Fault::Damage),
        (0u64..20).prop_map(Fault::Shrink),
        (0u64..60).prop_map(Fault::CameraGone),
        (0u64..60).prop_map(Fault::Silent),
    ]
}

proptest! {
    /// The order decides when things are done, never what comes of them.
    #[test]
    fn both_orders_come_to_the_same_frames_and_the_same_end(
        faults in prop::collection::vec(camera_fault(), 0..5),
    ) {
        let (run, plain) = in_both_orders(&faults);
        prop_assert_eq!(account(&run), account(&plain));
    }

    /// Whatever goes wrong: a record is right in each frame, or the failure has a name; and the rig is left safe.
    #[test]
    fn no_fault_makes_a_wrong_record(faults in prop::collection::vec(any_fault(), 0..6)) {
        let (run, plain) = in_both_orders(&faults);
        for run in [&run, &plain] {
        match &run.result {
            Ok(record) => prop_assert!(record.retaken.len() + record.notes.references_retaken.len() <= 6),
            Err(failure) => {
                let named = [
                    "lost-frame", "stale-frame", "late-frame", "duplicate-frame", "swapped-frames", "damaged-frame",
                    "wrong-slide", "stale-receipt", "missed-flip", "camera-failed", "projector-failed", "cancelled",
                ];
                prop_assert!(named.contains(&failure.error.reason()), "{:?}", failure.error);
            }
        }
        prop_assert!(run.ends_black() || run.findings().contains(&"projector-not-black"));
        // Bounded: 20 takes of a fifth of a second and 6 waits for lost frames, at the most.
        prop_assert!(run.world.clock.now().since(run.began) < Duration::from_secs(20));
        }
    }
}
