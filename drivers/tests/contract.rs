//! What every driver owes the scanner, checked on each of them.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod common;

use std::{sync::Arc, time::Duration};

use common::{H, METAL, V, after, clean_rig, region, samples, scene, settings};
use polscan_drivers::{
    camera::{
        AppliedSettings, Camera, CameraDriver, CameraNoise, CameraSettings, PixelFormat, StreamStatistics,
        TriggerSource,
    },
    clock::{Clock, MonotonicClock, Timestamp, VirtualClock},
    error::DeviceError,
    frame::{Frame, PixelStore},
    projector::{Projector, ProjectorDriver, ReceiptMethod, Slide},
    replay::{Recording, ReplayRig},
    sim::{Pacing, Rig, RigDescription},
};

/// Slides that every rig here can show.
const SLIDES: usize = 4;

/// A driver under test, its devices unopened.
struct Subject {
    name: &'static str,
    clock: Arc<dyn Clock>,
    cameras: Box<dyn CameraDriver>,
    projectors: Box<dyn ProjectorDriver>,
    settings: CameraSettings,
    method: ReceiptMethod,
}

fn slides() -> Vec<Slide> {
    (0..SLIDES)
        .map(|number| {
            Slide::Columns((0..128).map(|u| if u >> (number + 2) & 1 == 0 { H } else { V }).collect())
        })
        .collect()
}

fn lagging_rig(pacing: Pacing) -> RigDescription {
    let mut description = clean_rig();
    description.pacing = pacing;
    description.camera.read_noise_e = 2.3;
    description.camera.blur_px = 0.6;
    description.projector.lcd_10_90_ms = 2.0;
    description.projector.latency_refreshes = 1;
    description
}

fn simulated(pacing: Pacing) -> Subject {
    let clock = pacing.clock();
    let rig = Rig::new(&lagging_rig(pacing), &scene(METAL), clock.clone()).unwrap();
    Subject {
        name: match pacing {
            Pacing::Fast => "sim, fast",
            Pacing::RealTime => "sim, real time",
        },
        clock,
        cameras: Box::new(rig.cameras()),
        projectors: Box::new(rig.projectors()),
        settings: settings(PixelFormat::Mono12, 1.0),
        method: ReceiptMethod::Simulated,
    }
}

fn recording() -> Recording {
    let settings = settings(PixelFormat::Mono12, 1.0);
    let frames =
        (0..SLIDES as u16).map(|i| Arc::new(vec![i * 100 + 7; 40 * 30]) as Arc<dyn PixelStore>).collect();
    Recording {
        width: 40,
        height: 30,
        bit_depth: 12,
        frames,
        pictures: slides(),
        applied: AppliedSettings {
            settings,
            width: 40,
            height: 30,
            black_level_dn: Some(41.0),
            saturation_dn: 4095,
            readout_us: 6100.0,
            noise: Some(CameraNoise { gain_dn_per_electron: 0.39, read_noise_dn: 0.9 }),
        },
        projector_size: [128, 96],
        refresh_period: Duration::from_nanos(16_666_667),
    }
}

fn replayed(clock: Arc<dyn Clock>, name: &'static str) -> Subject {
    let recording = recording();
    let settings = recording.applied.settings.clone();
    let rig = ReplayRig::new(recording, clock.clone()).unwrap();
    Subject {
        name,
        clock,
        cameras: Box::new(rig.cameras()),
        projectors: Box::new(rig.projectors()),
        settings,
        method: ReceiptMethod::Recorded,
    }
}

fn subjects() -> Vec<Subject> {
    vec![
        simulated(Pacing::Fast),
        simulated(Pacing::RealTime),
        replayed(Arc::new(VirtualClock::default()), "replay, fast"),
        replayed(Arc::new(MonotonicClock::start()), "replay, real time"),
    ]
}

struct Open {
    name: &'static str,
    clock: Arc<dyn Clock>,
    camera: Box<dyn Camera>,
    projector: Box<dyn Projector>,
    settings: CameraSettings,
    method: ReceiptMethod,
}

impl Subject {
    fn open(&self) -> Open {
        Open {
            name: self.name,
            clock: self.clock.clone(),
            camera: self.cameras.open(None).unwrap(),
            projector: self.projectors.open(None).unwrap(),
            settings: self.settings.clone(),
            method: self.method,
        }
    }
}

impl Open {
    /// Shows a slide, lets it settle and takes one frame.
    fn take(&mut self, slide: u32) -> Frame {
        let shown = self.projector.show(slide).unwrap();
        assert_eq!((shown.slide, shown.method), (Some(slide), self.method));
        self.camera.trigger(after(shown.flipped, 60.0)).unwrap();
        self.camera.next_frame(Duration::from_secs(20)).unwrap()
    }

    fn armed(mut self) -> Self {
        self.projector.load(&slides()).unwrap();
        self.camera.apply(&self.settings).unwrap();
        self.camera.arm(8).unwrap();
        self
    }
}

fn assert_order(result: Result<impl Sized, DeviceError>, name: &str, expected: &str) {
    match result {
        Err(DeviceError::OutOfOrder { operation, .. }) => assert_eq!(operation, expected, "{name}"),
        Err(other) => panic!("{name}: {expected} out of order gave {other}"),
        Ok(_) => panic!("{name}: {expected} out of order was accepted"),
    }
}

#[test]
fn drivers_list_and_open_each_device_once() {
    for subject in subjects() {
        let name = subject.name;
        let listed = subject.cameras.list().unwrap();
        assert!(listed.len() == 1 && listed[0].unusable.is_none(), "{name}");
        let camera = subject.cameras.open(Some(&listed[0].serial)).unwrap();
        assert_eq!(camera.info().serial, listed[0].serial);
        assert_eq!(camera.info().driver, listed[0].driver);
        let again = subject.cameras.open(None).err().unwrap();
        assert!(matches!(again, DeviceError::Unavailable { .. }), "{name}: {again}");
        drop(camera);
        subject.cameras.open(None).unwrap();
        assert!(matches!(subject.cameras.open(Some("other")).err(), Some(DeviceError::Unavailable { .. })));

        let listed = subject.projectors.list().unwrap();
        let projector = subject.projectors.open(Some(&listed[0].serial)).unwrap();
        assert_eq!((projector.info().width, projector.info().height), (128, 96));
        assert_eq!(projector.info().refresh_period, Duration::from_nanos(16_666_667));
        assert!(subject.projectors.open(None).is_err());
        drop(projector);
        subject.projectors.open(None).unwrap();
        assert!(subject.projectors.open(Some("other")).is_err());
    }
}

#[test]
fn calls_out_of_order_are_refused_and_leave_the_device_usable() {
    for subject in subjects() {
        let Open { name, clock, mut camera, mut projector, settings, .. } = subject.open();
        assert_order(camera.arm(1), name, "arm");
        assert_order(camera.trigger(clock.now()), name, "trigger");
        assert_order(camera.next_frame(Duration::ZERO), name, "next_frame");
        assert_order(camera.disarm(), name, "disarm");
        camera.apply(&settings).unwrap();
        assert_order(camera.trigger(clock.now()), name, "trigger");
        camera.arm(1).unwrap();
        assert_order(camera.apply(&settings), name, "apply");
        assert_order(camera.arm(1), name, "arm");
        camera.disarm().unwrap();
        assert_order(camera.disarm(), name, "disarm");
        assert_order(projector.show(0), name, "show");
        projector.load(&slides()).unwrap();
        projector.show(0).unwrap();
    }
}

#[test]
fn black_works_with_nothing_loaded_and_after_errors() {
    for subject in subjects() {
        let Open { name, clock, mut projector, method, .. } = subject.open();
        let mut latest = clock.now();
        let mut black = |projector: &mut Box<dyn Projector>| {
            let shown = projector.black().unwrap();
            assert_eq!((shown.slide, shown.method), (None, method), "{name}");
            assert!(shown.flipped > latest && clock.now() >= shown.flipped, "{name}");
            latest = shown.flipped;
        };
        black(&mut projector);
        assert!(projector.show(3).is_err());
        black(&mut projector);
        let narrow = Slide::Columns(vec![H; 127].into());
        assert!(matches!(projector.load(&[narrow]), Err(DeviceError::Refused { .. })), "{name}");
        black(&mut projector);
        for wrong in [Slide::Rows(vec![H; 128].into()), Slide::Full(vec![H; 128 * 96 - 1].into())] {
            assert!(matches!(projector.load(&[wrong]), Err(DeviceError::Refused { .. })), "{name}");
        }
        projector.load(&slides()).unwrap();
        assert!(matches!(projector.show(SLIDES as u32), Err(DeviceError::Refused { .. })), "{name}");
        black(&mut projector);
    }
}

#[test]
fn settings_are_honoured_or_refused_by_name() {
    for subject in subjects() {
        let Open { name, mut camera, settings, .. } = subject.open();
        let applied = camera.apply(&settings).unwrap();
        assert_eq!(applied.settings, settings, "{name}");
        // Five sigma of read noise below full scale at most: a full pixel is read with noise.
        assert!((4090..=4095).contains(&applied.saturation_dn) && applied.readout_us == 6100.0, "{name}");
        let refusals: [(&str, CameraSettings); 9] = [
            ("exposure_us", CameraSettings { exposure_us: 0.0, ..settings.clone() }),
            ("exposure_us", CameraSettings { exposure_us: f64::NAN, ..settings.clone() }),
            ("exposure_us", CameraSettings { exposure_us: 1e12, ..settings.clone() }),
            ("gain_db", CameraSettings { gain_db: -1.0, ..settings.clone() }),
            ("gain_db", CameraSettings { gain_db: f64::INFINITY, ..settings.clone() }),
            ("gamma", CameraSettings { gamma: 2.2, ..settings.clone() }),
            ("region", CameraSettings { region: Some(region(199, 0, 2, 1)), ..settings.clone() }),
            ("region", CameraSettings { region: Some(region(0, 0, 0, 1)), ..settings.clone() }),
            ("trigger", CameraSettings { trigger: TriggerSource::Line0, ..settings.clone() }),
        ];
        for (expected, settings) in refusals {
            match camera.apply(&settings) {
                Err(DeviceError::Refused { setting, .. }) => assert_eq!(setting, expected, "{name}"),
                other => panic!("{name}: {expected}: {other:?}"),
            }
        }
        // What was applied before still holds.
        camera.arm(1).unwrap();
    }
}

#[test]
fn frames_carry_their_identity_and_statistics_add_up() {
    for subject in subjects() {
        let mut open = subject.open().armed();
        let applied = open.settings.clone();
        let size = (open.camera.info().sensor_width, open.camera.info().sensor_height);
        for round in 0..2 {
            for number in 0..3u64 {
                let frame = open.take(number as u32);
                assert_eq!((frame.stamp.frame_id, frame.stamp.trigger), (number, number), "{}", open.name);
                assert_eq!((frame.width, frame.height), size);
                assert_eq!(frame.bit_depth, 12);
                assert_eq!(frame.pixels().len(), (size.0 * size.1) as usize);
                let exposure = Duration::from_secs_f64(1e-6 * applied.exposure_us);
                assert!(frame.stamp.received >= frame.stamp.exposure_start + exposure);
                assert!(open.clock.now() >= frame.stamp.received);
            }
            // One exposure is left under way.
            open.camera.trigger(open.clock.now()).unwrap();
            let statistics = open.camera.disarm().unwrap();
            assert_eq!(
                statistics,
                StreamStatistics { triggers: 4, frames: 3, failed: 0, ..Default::default() },
                "{round}"
            );
            open.camera.arm(4).unwrap();
        }
    }
}

#[test]
fn triggers_start_exactly_when_asked_or_at_once_and_never_overlap() {
    for subject in subjects() {
        let mut open = subject.open().armed();
        let shown = open.projector.show(0).unwrap();
        let at = after(shown.flipped, 500.0);
        assert_eq!(open.camera.trigger(at).unwrap(), at, "{}", open.name);
        let next = open.camera.trigger(at).unwrap();
        assert!(next >= after(at, 2.0), "{}", open.name);
        let frames: Vec<Frame> =
            (0..2).map(|_| open.camera.next_frame(Duration::from_secs(20)).unwrap()).collect();
        assert_eq!(frames[0].stamp.exposure_start, at);
        assert_eq!(frames[1].stamp.exposure_start, next);
        let before = open.clock.now();
        let late = open.camera.trigger(at).unwrap();
        assert!(late >= before && late <= after(open.clock.now(), 10.0), "{}", open.name);
    }
}

#[test]
fn a_timeout_leaves_the_stream_usable() {
    for subject in subjects() {
        let mut open = subject.open().armed();
        let wait = Duration::from_millis(30);
        let timed_out = |open: &mut Open| {
            let start = open.clock.now();
            let result = open.camera.next_frame(wait);
            assert!(
                matches!(result, Err(DeviceError::Timeout { timeout_ms: 30, .. })),
                "{}: {result:?}",
                open.name
            );
            assert!(open.clock.now().since(start) >= wait, "{}", open.name);
        };
        timed_out(&mut open);
        let shown = open.projector.show(1).unwrap();
        let at = after(shown.flipped, 400.0);
        open.camera.trigger(at).unwrap();
        timed_out(&mut open);
        let frame = open.camera.next_frame(Duration::from_secs(20)).unwrap();
        assert_eq!((frame.stamp.frame_id, frame.stamp.exposure_start), (0, at), "{}", open.name);
        let statistics = open.camera.disarm().unwrap();
        assert_eq!(statistics, StreamStatistics { triggers: 1, frames: 1, failed: 0, ..Default::default() });
    }
}

#[test]
fn exposures_can_be_announced_before_the_next_flip() {
    // A pipelined scan: slide n + 1 is flipped while the exposure of slide n is still to come.
    for subject in subjects() {
        let slow = subject.open().projector.info().timing.unwrap().latency;
        let mut open = subject.open().armed();
        let first = open.projector.show(2).unwrap();
        open.camera.trigger(first.flipped + slow + Duration::from_millis(13)).unwrap();
        let second = open.projector.show(3).unwrap();
        let later = second.refresh.unwrap() - first.refresh.unwrap();
        assert!(later == 1 || later > 1 && open.name.contains("real time"), "{}", open.name);
        let pipelined = open.camera.next_frame(Duration::from_secs(20)).unwrap();
        drop(open);
        let mut open = subject.open().armed();
        let settled = open.take(2);
        // The same slide, but for noise and what is left of the previous one.
        let (a, b) = (samples(&pipelined), samples(&settled));
        let far = a.iter().zip(&b).filter(|(a, b)| a.abs_diff(**b) > 250).count();
        assert!(far * 1000 < a.len(), "{}: {far}", open.name);
    }
}

#[test]
fn a_repeated_scan_gives_the_same_frames_on_a_fresh_rig_and_another_take_on_the_same() {
    let scan = |subject: &Subject| -> Vec<Vec<u16>> {
        let mut open = subject.open().armed();
        (0..SLIDES as u32).map(|slide| samples(&open.take(slide))).collect()
    };
    for fresh in [|| simulated(Pacing::Fast), || simulated(Pacing::RealTime)] {
        let (first, second) = (fresh(), fresh());
        let frames = scan(&first);
        assert_eq!(frames, scan(&second), "{}", first.name);
        assert_ne!(frames, scan(&first), "{}", first.name);
    }
    let replay = replayed(Arc::new(VirtualClock::default()), "replay");
    assert_eq!(scan(&replay), scan(&replay));
}

/// Shows and exposes on a given timeline of refreshes and ms, so that pictures overlap in the liquid crystals. `None`
/// where this machine was too busy to keep it.
fn timed_scan(subject: &Subject) -> Option<Vec<(u64, Vec<u16>)>> {
    let mut open = subject.open().armed();
    let period = open.projector.info().refresh_period;
    // Wherever the clock stands: the time of day must not matter.
    let refresh = open.clock.now().0 / period.as_nanos() as u64 + 6;
    let start = Timestamp(refresh * period.as_nanos() as u64);
    let mut frames = vec![];
    for step in 0..6u32 {
        let before = start + 4 * step * period + period / 4;
        open.clock.sleep_until(before);
        let shown = open.projector.show(step % SLIDES as u32).unwrap();
        // In the middle of the change.
        let at = after(shown.flipped, 16.0 + f64::from(step));
        let started = open.camera.trigger(at).unwrap();
        if shown.flipped.since(before) > period || started != at {
            return None;
        }
        let frame = open.camera.next_frame(Duration::from_secs(20)).unwrap();
        frames.push((frame.stamp.exposure_start.0 - start.0, samples(&frame)));
    }
    Some(frames)
}

#[test]
fn fast_and_real_time_frames_are_the_same_bit_by_bit() {
    let in_time = |subject: &dyn Fn() -> Subject| {
        (0..20)
            .find_map(|_| timed_scan(&subject()))
            .expect("this machine keeps a timeline in one of 20 tries")
    };
    assert_eq!(in_time(&|| simulated(Pacing::Fast)), in_time(&|| simulated(Pacing::RealTime)));
    let fast = in_time(&|| replayed(Arc::new(VirtualClock::default()), "fast"));
    assert_eq!(fast, in_time(&|| replayed(Arc::new(MonotonicClock::start()), "real")));
}

#[test]
fn a_recording_answers_with_the_frame_of_the_slide() {
    let subject = replayed(Arc::new(VirtualClock::default()), "replay");
    let mut open = subject.open().armed();
    for slide in [0, 2, 2, 1, 3, 0] {
        assert!(samples(&open.take(slide)).iter().all(|&dn| dn == slide as u16 * 100 + 7));
    }
    // No frame was recorded of black.
    open.projector.black().unwrap();
    open.camera.trigger(open.clock.now()).unwrap();
    let error = open.camera.next_frame(Duration::from_secs(1)).unwrap_err();
    assert!(matches!(&error, DeviceError::BadData { detail, .. } if detail.contains("black")), "{error}");
    let statistics = open.camera.disarm().unwrap();
    assert_eq!(statistics, StreamStatistics { triggers: 7, frames: 6, failed: 1, ..Default::default() });
    let other = [slides(), vec![Slide::Uniform(H)]].concat();
    let error = open.projector.load(&other).unwrap_err();
    assert!(
        matches!(&error, DeviceError::Refused { requested, .. } if requested.contains("number 4")),
        "{error}"
    );
    // Only what was recorded can be applied.
    let other = CameraSettings { exposure_us: 1999.0, ..open.settings.clone() };
    let error = open.camera.apply(&other).unwrap_err();
    assert!(matches!(error, DeviceError::Refused { setting: "exposure_us", .. }), "{error}");
}

#[test]
fn a_part_of_a_recording_is_found_by_its_pictures() {
    let mut recording = recording();
    // A reference that was shown at the beginning and again at the end.
    recording.pictures[3] = recording.pictures[0].clone();
    let pictures = recording.pictures.clone();
    let clock: Arc<dyn Clock> = Arc::new(VirtualClock::default());
    let settings = recording.applied.settings.clone();
    let rig = ReplayRig::new(recording, clock.clone()).unwrap();
    let (mut camera, mut projector) =
        (rig.cameras().open(None).unwrap(), rig.projectors().open(None).unwrap());
    camera.apply(&settings).unwrap();
    let slides: Vec<Slide> = [2, 0, 1, 0, 0].map(|picture: usize| pictures[picture].clone()).into();
    projector.load(&slides).unwrap();
    camera.arm(slides.len()).unwrap();
    let shown: Vec<u16> = (0..slides.len() as u32)
        .map(|slide| {
            assert_eq!(projector.show(slide).unwrap().slide, Some(slide));
            camera.trigger(clock.now()).unwrap();
            samples(&camera.next_frame(Duration::from_secs(1)).unwrap())[0] / 100
        })
        .collect();
    assert_eq!(shown, [2, 0, 1, 3, 3]);
}

#[test]
fn recordings_that_contradict_themselves_are_refused() {
    let clock: Arc<dyn Clock> = Arc::new(VirtualClock::default());
    let refuse = |change: fn(&mut Recording)| {
        let mut recording = recording();
        change(&mut recording);
        let error = ReplayRig::new(recording, clock.clone()).unwrap_err();
        assert!(matches!(error, DeviceError::BadData { .. }), "{error}");
    };
    refuse(|recording| recording.frames[2] = Arc::new(vec![0u16; 40 * 30 - 1]));
    refuse(|recording| recording.frames[1] = Arc::new(vec![0u8; 40 * 30]));
    refuse(|recording| recording.bit_depth = 8);
    refuse(|recording| recording.bit_depth = 17);
    refuse(|recording| recording.width = 41);
    refuse(|recording| recording.refresh_period = Duration::ZERO);
    refuse(|recording| recording.pictures.truncate(3));
    refuse(|recording| recording.applied.settings.exposure_us = -1.0);
    refuse(|recording| recording.applied.readout_us = f64::INFINITY);
}
