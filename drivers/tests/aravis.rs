//! The driver of real cameras, on a camera in software behind the real library and the real protocol over loopback.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod common;

use std::{
    net::UdpSocket,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use common::{
    blackfly::{blackfly, camera, dn, register, variant},
    region, samples, settings,
};
use polscan_drivers::{
    aravis::{
        AravisCameras, Options,
        fake::{ADDRESS, Exposure},
    },
    camera::{Camera, CameraDriver, CameraSettings, PixelFormat, TriggerSource},
    clock::{Clock, MonotonicClock, Timestamp},
    error::{DeviceError, Difference},
    frame::Frame,
};

const SECOND: Duration = Duration::from_secs(1);

struct Bench {
    clock: Arc<dyn Clock>,
    camera: Box<dyn Camera>,
}

fn driver(options: Options) -> (AravisCameras, Arc<dyn Clock>) {
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
    // The camera in software sends a frame faster than an ordinary socket is sure to take it.
    let options = Options { packet_socket: true, ..options };
    (AravisCameras::new(options, clock.clone()), clock)
}

impl Bench {
    fn open(options: Options) -> Self {
        let (cameras, clock) = driver(options);
        Self { camera: cameras.open(Some(ADDRESS)).unwrap(), clock }
    }

    fn now(&self) -> Timestamp {
        self.clock.now()
    }

    fn take(&mut self) -> Frame {
        self.camera.trigger(self.clock.now()).unwrap();
        self.camera.next_frame(5 * SECOND).unwrap()
    }
}

fn small(format: PixelFormat) -> CameraSettings {
    CameraSettings { region: Some(region(160, 40, 128, 96)), ..settings(format, 1.0) }
}

fn assert_pixels(frame: &Frame, number: u64, settings: &CameraSettings) {
    let (width, height) = (frame.width as usize, frame.height as usize);
    let exposure = Exposure { number, exposure_us: settings.exposure_us as u32, format: 0, width, height };
    let depth = u32::from(settings.format.bit_depth());
    let painted: Vec<u16> =
        (0..height).flat_map(|y| (0..width).map(move |x| dn(&exposure, x, y, depth))).collect();
    assert!(samples(frame) == painted, "frame {number}");
}

#[test]
fn the_frames_of_a_scan_arrive_exactly_and_without_a_copy() {
    let fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    let info = bench.camera.info().clone();
    assert_eq!((info.driver.as_str(), info.serial.as_str()), ("aravis", "PS-17"));
    assert_eq!((info.sensor_width, info.sensor_height), (1920, 1200));
    // The region of the method, in the middle of the sensor.
    let asked =
        CameraSettings { region: Some(region(160, 0, 1600, 1200)), ..settings(PixelFormat::Mono8, 1.0) };
    let applied = bench.camera.apply(&asked).unwrap();
    assert_eq!(applied.settings, asked);
    assert_eq!((applied.width, applied.height, applied.saturation_dn), (1600, 1200, 255));
    bench.camera.arm(41).unwrap();
    let started = Instant::now();
    let frames: Vec<Frame> = (0..41).map(|_| bench.take()).collect();
    let seconds = started.elapsed().as_secs_f64();
    println!("41 frames of 1600 x 1200 in {seconds:.2} s");
    let statistics = bench.camera.disarm().unwrap();
    assert_eq!((statistics.triggers, statistics.frames, statistics.failed), (41, 41, 0));
    assert_eq!(statistics.counters["copied_frames"], 0);
    assert_eq!(statistics.counters["n_completed_buffers"], 41, "{:?}", statistics.counters);
    for name in ["n_failures", "n_underruns", "n_missing_packets", "n_resent_packets"] {
        assert!(statistics.counters.contains_key(name), "{:?}", statistics.counters);
    }
    assert_eq!(fake.exposures(), 41);
    // They outlive the stream and the camera.
    drop(bench);
    drop(fake);
    for (number, frame) in (0..).zip(&frames) {
        let stamp = frame.stamp;
        assert_eq!((stamp.frame_id, stamp.trigger), (number, number));
        assert!(stamp.device_time_ns.is_some() && stamp.received > stamp.exposure_start);
        assert_pixels(frame, number, &asked);
    }
    assert!(frames.windows(2).all(|pair| pair[0].stamp.received < pair[1].stamp.exposure_start));
}

#[test]
fn samples_of_every_format_arrive_as_they_were_painted() {
    let fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    let mut number = 0;
    for (format, saturation) in
        [(PixelFormat::Mono8, 255), (PixelFormat::Mono12, 4095), (PixelFormat::Mono16, 65520)]
    {
        let asked = CameraSettings { exposure_us: 1500.0 + f64::from(saturation), ..small(format) };
        let applied = bench.camera.apply(&asked).unwrap();
        assert_eq!(applied.settings, asked);
        assert_eq!(applied.saturation_dn, saturation, "12 bits of the converter, the rest empty");
        bench.camera.arm(3).unwrap();
        for _ in 0..3 {
            let frame = bench.take();
            assert_eq!(frame.bit_depth, format.bit_depth());
            assert_pixels(&frame, number, &asked);
            number += 1;
        }
        let statistics = bench.camera.disarm().unwrap();
        let copied = if format == PixelFormat::Mono12 { 3 } else { 0 };
        assert_eq!(statistics.counters["copied_frames"], copied, "{format:?}");
    }
    assert_eq!(fake.peek(register::EXPOSURE_US), Some(1500 + 65520));
    drop((bench, fake));
    // A camera that packs the other way.
    let other =
        variant("packed.xml", &[("<EnumEntry Name=\"Mono12p\"><Value>17563719</Value></EnumEntry>", "")]);
    let _fake = camera(Some(other));
    let mut bench = Bench::open(Options::default());
    let asked = small(PixelFormat::Mono12);
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(1).unwrap();
    assert_pixels(&bench.take(), 0, &asked);
}

#[test]
fn every_setting_that_bends_the_response_is_switched_off_and_read_back() {
    let fake = camera(Some(blackfly()));
    // What another program left.
    fake.poke(register::TRIGGER_MODE, 1);
    fake.poke(register::TRIGGER_MODE + 0x20, 1);
    fake.poke(register::OFFSET_X, 1000);
    fake.poke(register::WIDTH, 64);
    let mut bench = Bench::open(Options::default());
    let asked = small(PixelFormat::Mono12);
    let applied = bench.camera.apply(&asked).unwrap();
    assert_eq!(applied.settings, asked);
    assert!((applied.black_level_dn.unwrap() - 40.95).abs() < 1e-3);
    assert!((applied.readout_us - 1e6 / 163.0).abs() < 1.0);
    let float = |address: u32| f32::from_bits(fake.peek(address).unwrap());
    for (name, address, expected) in [
        ("width", register::WIDTH, 128),
        ("height", register::HEIGHT, 96),
        ("offset x", register::OFFSET_X, 160),
        ("offset y", register::OFFSET_Y, 40),
        ("exposure", register::EXPOSURE_US, 2000),
        ("automatic exposure", register::EXPOSURE_AUTO, 1),
        ("automatic gain", register::GAIN_AUTO, 1),
        ("exposure mode", register::EXPOSURE_MODE, 1),
        ("processing", register::ISP_ENABLE, 1),
        ("frame rate", register::FRAME_RATE_ENABLE, 1),
        ("overlap", register::TRIGGER_OVERLAP, 1),
        ("user set", register::USER_SET_LOAD, 1),
        ("trigger mode", register::TRIGGER_MODE, 1),
        ("trigger mode of the acquisition", register::TRIGGER_MODE + 0x20, 0),
        ("trigger source", register::TRIGGER_SOURCE, 1),
        ("strobe", register::LINE_SOURCE, 1),
        ("gamma", register::GAMMA_ENABLE, 1),
    ] {
        assert_eq!(fake.peek(address), Some(expected), "{name}");
    }
    assert_eq!((float(register::GAIN), float(register::GAMMA)), (0.0, 1.0));
    assert_eq!(float(register::TRIGGER_DELAY), 9.0, "the least there is");
    bench.camera.apply(&CameraSettings { trigger: TriggerSource::Line0, ..asked }).unwrap();
    assert_eq!(fake.peek(register::TRIGGER_SOURCE), Some(0));
}

fn refused(result: Result<impl std::fmt::Debug, DeviceError>) -> Vec<Difference> {
    match result.unwrap_err() {
        DeviceError::RefusedAll { differences, .. } => differences,
        DeviceError::Refused { setting, requested, offered, .. } => {
            vec![Difference { setting, requested, offered }]
        }
        other => panic!("{other}"),
    }
}

#[test]
fn a_camera_that_cannot_is_refused_with_all_that_differs_unless_it_is_allowed() {
    let crooked = variant(
        "crooked.xml",
        &[
            // No gamma of 1, and no way around it.
            ("<Min>0.25</Min><Max>4</Max>", "<Min>0.25</Min><Max>0.9</Max>"),
            ("Name=\"GammaEnable\"", "Name=\"GammaSwitch\""),
            ("<pFeature>GammaEnable</pFeature>", ""),
            // Automatic exposure for ever.
            (
                "<EnumEntry Name=\"Off\"><Value>1</Value></EnumEntry><EnumEntry Name=\"Once\"><Value>2</Value></EnumEntry><pValue>ExposureAutoRegister",
                "<pValue>ExposureAutoRegister",
            ),
            // A black level that is amplified from 2 dB on.
            ("<Min>0</Min><Max>47.99</Max>", "<Min>2</Min><Max>47.99</Max>"),
        ],
    );
    let _fake = camera(Some(crooked));
    let mut bench = Bench::open(Options::default());
    let asked = small(PixelFormat::Mono8);
    let differences = refused(bench.camera.apply(&asked));
    let named: Vec<&str> = differences.iter().map(|difference| difference.setting).collect();
    assert_eq!(named, ["gain_db", "exposure_auto", "gamma"], "{differences:?}");
    assert_eq!(differences[1].offered.split(' ').next(), Some("Continuous"), "{differences:?}");
    assert!(differences[2].offered.starts_with("0.8"), "{differences:?}");
    let error = bench.camera.apply(&asked).unwrap_err();
    assert!(error.is_refusal() && error.to_string().contains("3 settings"), "{error}");
    // Nothing is applied, nothing can be armed.
    assert!(matches!(bench.camera.arm(1), Err(DeviceError::OutOfOrder { .. })));
    drop(bench);
    let allow = |names: &[&str]| Options {
        allow: names.iter().map(|&name| name.to_owned()).collect(),
        ..Options::default()
    };
    let mut bench = Bench::open(allow(&["gamma", "exposure_auto"]));
    assert_eq!(refused(bench.camera.apply(&asked)).len(), 1);
    drop(bench);
    let mut bench = Bench::open(allow(&["gamma", "exposure_auto", "gain_db"]));
    let applied = bench.camera.apply(&asked).unwrap();
    assert!((applied.settings.gamma - 0.8).abs() < 1e-6, "what the camera has, not what was asked for");
    assert!((applied.settings.gain_db - 5.0).abs() < 1e-6);
}

#[test]
fn settings_out_of_range_are_refused_by_name_and_the_ones_before_hold() {
    let fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    let asked = small(PixelFormat::Mono8);
    bench.camera.apply(&asked).unwrap();
    for (expected, settings) in [
        ("exposure_us", CameraSettings { exposure_us: 1e12, ..asked.clone() }),
        ("exposure_us", CameraSettings { exposure_us: f64::NAN, ..asked.clone() }),
        ("gain_db", CameraSettings { gain_db: -1.0, ..asked.clone() }),
        ("gamma", CameraSettings { gamma: 5.0, ..asked.clone() }),
        ("region", CameraSettings { region: Some(region(161, 40, 128, 96)), ..asked.clone() }),
        ("region", CameraSettings { region: Some(region(1900, 0, 128, 96)), ..asked.clone() }),
        ("format", CameraSettings { format: PixelFormat::Mono10, ..asked.clone() }),
    ] {
        let differences = refused(bench.camera.apply(&settings));
        let named: Vec<&str> = differences.iter().map(|difference| difference.setting).collect();
        assert_eq!(named, [expected], "{differences:?}");
    }
    assert_eq!(fake.peek(register::EXPOSURE_US), Some(2000));
    bench.camera.arm(1).unwrap();
    assert_pixels(&bench.take(), 0, &asked);
}

#[test]
fn a_gain_in_a_unit_of_its_own_must_be_named_in_it() {
    // The library's own camera knows only a raw gain, and neither gamma nor black level.
    let _fake = camera(None);
    let asked = CameraSettings { region: None, ..small(PixelFormat::Mono8) };
    let mut bench = Bench::open(Options::default());
    let differences = refused(bench.camera.apply(&asked));
    assert!(differences[0].offered.contains("camera.gain_raw"), "{differences:?}");
    assert_eq!(differences.len(), 1, "{differences:?}");
    drop(bench);
    let mut bench = Bench::open(Options { gain_raw: Some(0.0), ..Options::default() });
    let applied = bench.camera.apply(&asked).unwrap();
    assert_eq!(applied.settings, asked);
    assert_eq!((applied.width, applied.height), (1920, 1200), "the whole sensor");
    assert_eq!(applied.black_level_dn, None);
}

#[test]
fn a_frame_that_is_not_as_configured_fails_and_the_stream_goes_on() {
    let fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    bench.camera.apply(&small(PixelFormat::Mono8)).unwrap();
    let mut fails_after = |address: u32, value: u32, words: &str| {
        let before = fake.peek(address).unwrap();
        fake.poke(address, value);
        bench.camera.arm(2).unwrap();
        bench.camera.trigger(bench.clock.now()).unwrap();
        let error = bench.camera.next_frame(5 * SECOND).unwrap_err();
        assert!(
            matches!(&error, DeviceError::BadData { detail, .. } if detail.contains(words)),
            "{words}: {error}"
        );
        let statistics = bench.camera.disarm().unwrap();
        assert_eq!((statistics.triggers, statistics.frames, statistics.failed), (1, 0, 1), "{words}");
        fake.poke(address, before);
    };
    // Somebody turns it behind our back.
    fails_after(register::PIXEL_FORMAT, 0x0110_0007, "format 0x1100007");
    fails_after(register::OFFSET_X, 164, "region");
    fails_after(register::WIDTH, 132, "region");
    bench.camera.arm(1).unwrap();
    bench.take();
}

#[test]
fn lost_packets_fail_their_frame_by_name_and_no_other() {
    let fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    let asked = CameraSettings { region: Some(region(0, 0, 1600, 1200)), ..small(PixelFormat::Mono8) };
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(20).unwrap();
    fake.lose_packets(0.01);
    for _ in 0..3 {
        bench.camera.trigger(bench.now()).unwrap();
        let error = bench.camera.next_frame(5 * SECOND).unwrap_err();
        assert!(
            matches!(&error, DeviceError::BadData { detail, .. } if detail.contains("packets were lost")),
            "{error}"
        );
    }
    fake.lose_packets(0.0);
    let frame = bench.take();
    assert_eq!((frame.stamp.frame_id, frame.stamp.trigger), (3, 3));
    assert_pixels(&frame, 3, &asked);
    let statistics = bench.camera.disarm().unwrap();
    assert_eq!((statistics.triggers, statistics.frames, statistics.failed), (4, 1, 3));
    assert!(statistics.counters["n_missing_packets"] >= 3, "{:?}", statistics.counters);
}

#[test]
fn a_trigger_that_the_camera_missed_is_a_missing_frame() {
    let fake = camera(Some(blackfly()));
    // Three triggers between two looks are one exposure; a second is time enough for them on a busy machine.
    fake.look_for_triggers(1.0);
    let mut bench = Bench::open(Options::default());
    let asked = small(PixelFormat::Mono8);
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(4).unwrap();
    // The first look of all comes soon after the start of the stream; from the frame on they are regular.
    bench.take();
    for _ in 0..3 {
        bench.camera.trigger(bench.now()).unwrap();
    }
    bench.camera.next_frame(3 * SECOND).unwrap();
    let missing = bench.camera.next_frame(2 * SECOND);
    assert!(matches!(missing, Err(DeviceError::Timeout { timeout_ms: 2000, .. })), "{missing:?}");
    // The next frame is known to answer the next trigger, not the missed one.
    let frame = bench.take();
    assert_eq!((frame.stamp.frame_id, frame.stamp.trigger), (2, 4));
    let statistics = bench.camera.disarm().unwrap();
    assert_eq!((statistics.triggers, statistics.frames, statistics.failed), (5, 3, 0));
}

#[test]
fn other_traffic_while_a_stream_starts_is_not_taken_for_frames() {
    let _camera = camera(Some(blackfly()));
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
    let cameras = AravisCameras::new(Options::default(), clock.clone());
    let mut bench = Bench { camera: cameras.open(Some(ADDRESS)).unwrap(), clock };
    bench.camera.apply(&small(PixelFormat::Mono8)).unwrap();
    let talking = AtomicBool::new(true);
    thread::scope(|scope| {
        // Somebody else's packets on the same network, which as frames would have very high numbers.
        scope.spawn(|| {
            let socket = UdpSocket::bind((ADDRESS, 0)).unwrap();
            let to = socket.local_addr().unwrap();
            while talking.load(Ordering::Relaxed) {
                socket.send_to(&[0xfe; 64], to).unwrap();
                thread::sleep(Duration::from_millis(1));
            }
        });
        bench.camera.arm(3).unwrap();
        talking.store(false, Ordering::Relaxed);
    });
    for number in 0..3 {
        assert_eq!(bench.take().stamp.frame_id, number);
    }
    let statistics = bench.camera.disarm().unwrap();
    assert_eq!(statistics.counters["n_ignored_packets"], 0, "{:?}", statistics.counters);
}

#[test]
fn frame_numbers_run_on_over_the_end_of_the_counter() {
    // The camera begins at 65400 of 65535.
    let _fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    let asked =
        CameraSettings { region: Some(region(0, 0, 64, 48)), exposure_us: 50.0, ..small(PixelFormat::Mono8) };
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(10).unwrap();
    for number in 0..150 {
        let frame = bench.take();
        assert_eq!((frame.stamp.frame_id, frame.stamp.trigger), (number, number));
        assert_pixels(&frame, number, &asked);
    }
    let statistics = bench.camera.disarm().unwrap();
    assert_eq!((statistics.triggers, statistics.frames, statistics.failed), (150, 150, 0));
}

#[test]
fn frames_are_copied_where_somebody_keeps_all_buffers() {
    let _fake = camera(Some(blackfly()));
    let mut bench = Bench::open(Options::default());
    let asked = small(PixelFormat::Mono8);
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(2).unwrap();
    let kept: Vec<Frame> = (0..30).map(|_| bench.take()).collect();
    for (number, frame) in (0..).zip(&kept) {
        assert_pixels(frame, number, &asked);
    }
    let statistics = bench.camera.disarm().unwrap();
    assert_eq!((statistics.frames, statistics.failed), (30, 0));
    let copied = statistics.counters["copied_frames"];
    assert!((20..30).contains(&copied), "{copied}");
    drop(kept);
    // What came back is used again.
    bench.camera.arm(2).unwrap();
    for number in 30..36 {
        assert_pixels(&bench.take(), number, &asked);
    }
    assert_eq!(bench.camera.disarm().unwrap().counters["copied_frames"], 0);
}

#[test]
fn a_camera_is_listed_with_what_keeps_it_from_being_used() {
    let _fake = camera(Some(blackfly()));
    let (cameras, _) = driver(Options::default());
    let unusable = || {
        let listed = cameras.list().unwrap();
        let mine: Vec<_> = listed.iter().filter(|listing| listing.serial == "PS-17").collect();
        assert_eq!(mine.len(), 1, "{listed:?}");
        assert_eq!(mine[0].driver, "aravis");
        mine[0].unusable.clone()
    };
    assert_eq!(unusable(), None);
    let camera = cameras.open(Some(ADDRESS)).unwrap();
    assert_eq!(unusable(), None, "it is this process that uses it");
    let again = cameras.open(Some(ADDRESS)).err().unwrap();
    assert!(again.to_string().contains("is open already"), "{again}");
    drop(camera);
    // Another program, as far as the camera can tell.
    let other = aravis::Camera::new(Some(ADDRESS)).unwrap();
    assert!(unusable().is_some_and(|why| why.contains("another program")));
    let busy = cameras.open(Some(ADDRESS)).err().unwrap();
    assert!(busy.to_string().contains("another program"), "{busy}");
    drop(other);
    let missing = cameras.open(Some("PS-18")).err().unwrap();
    assert!(missing.to_string().contains("there is PS-17"), "{missing}");
}

#[test]
fn a_camera_that_vanishes_in_a_scan_is_named_and_works_again_when_it_is_back() {
    let fake = camera(Some(blackfly()));
    let (cameras, clock) = driver(Options::default());
    let mut bench = Bench { camera: cameras.open(Some(ADDRESS)).unwrap(), clock };
    let asked = small(PixelFormat::Mono8);
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(10).unwrap();
    let kept = bench.take();
    drop(fake);
    let error = loop {
        let triggered = bench.camera.trigger(bench.now()).map(|_| ());
        match triggered.and_then(|()| bench.camera.next_frame(SECOND / 10).map(|_| ())) {
            Err(DeviceError::Timeout { .. }) => {}
            Err(error) => break error,
            Ok(()) => panic!("a frame of a camera that is gone"),
        }
    };
    assert!(matches!(&error, DeviceError::Unavailable { .. }), "{error}");
    assert!(error.to_string().contains("check power and cable"), "{error}");
    // Whatever is asked of it now fails at once, and nothing hangs.
    let disarmed = bench.camera.disarm();
    assert!(matches!(disarmed, Err(DeviceError::Unavailable { .. })), "{disarmed:?}");
    let asked_again = Instant::now();
    assert!(matches!(bench.camera.apply(&asked), Err(DeviceError::Unavailable { .. })));
    assert!(asked_again.elapsed() < SECOND, "{:?}", asked_again.elapsed());
    drop(bench.camera);
    // It comes back, and is opened within the pauses of the ladder.
    let _fake = camera(Some(blackfly()));
    let deadline = Instant::now() + 10 * SECOND;
    bench.camera = loop {
        match cameras.open(Some(ADDRESS)) {
            Ok(camera) => break camera,
            Err(error) => assert!(Instant::now() < deadline, "{error}"),
        }
        thread::sleep(SECOND / 10);
    };
    bench.camera.apply(&asked).unwrap();
    bench.camera.arm(1).unwrap();
    assert_pixels(&bench.take(), 0, &asked);
    assert_pixels(&kept, 0, &asked);
}
