//! What every camera owes the scanner in real time, checked on the simulated one and on the driver of real ones alike.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod common;

use std::{sync::Arc, time::Duration};

use common::{
    after, blackfly,
    blackfly::{blackfly as genicam, register},
    clean_rig, region, samples, scene, settings,
};
use polscan_drivers::{
    aravis::{
        AravisCameras, Options,
        fake::{ADDRESS, Fake},
    },
    camera::{Camera, CameraDriver, CameraSettings, PixelFormat},
    clock::{Clock, MonotonicClock},
    error::DeviceError,
    sim::{Pacing, Rig},
};

const WAIT: Duration = Duration::from_secs(5);

/// A camera under test, unopened.
struct Subject {
    name: &'static str,
    clock: Arc<dyn Clock>,
    cameras: Box<dyn CameraDriver>,
    serial: &'static str,
    settings: CameraSettings,
    /// How far behind `at` an exposure may start, in ms.
    late_ms: f64,
    _fake: Option<Fake>,
}

fn simulated() -> Subject {
    let mut description = clean_rig();
    description.pacing = Pacing::RealTime;
    let clock = Pacing::RealTime.clock();
    let rig = Rig::new(&description, &scene(common::METAL), clock.clone()).unwrap();
    Subject {
        name: "sim",
        clock,
        cameras: Box::new(rig.cameras()),
        serial: "sim-camera-0",
        settings: settings(PixelFormat::Mono16, 1.0),
        late_ms: 0.0,
        _fake: None,
    }
}

fn real() -> Subject {
    let fake = blackfly::camera(Some(genicam()));
    fake.poke(register::SENSOR_WIDTH, 200);
    fake.poke(register::SENSOR_HEIGHT, 150);
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
    Subject {
        name: "aravis",
        cameras: Box::new(AravisCameras::new(
            Options { packet_socket: true, ..Options::default() },
            clock.clone(),
        )),
        clock,
        serial: ADDRESS,
        settings: settings(PixelFormat::Mono16, 1.0),
        // This machine may be busy with other tests.
        late_ms: 200.0,
        _fake: Some(fake),
    }
}

/// One after the other: there is one fake at a time.
fn on_each(check: impl Fn(&Subject)) {
    check(&simulated());
    check(&real());
}

impl Subject {
    fn open(&self) -> Box<dyn Camera> {
        self.cameras.open(Some(self.serial)).unwrap()
    }

    fn armed(&self) -> Box<dyn Camera> {
        let mut camera = self.open();
        camera.apply(&self.settings).unwrap();
        camera.arm(8).unwrap();
        camera
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
fn a_camera_is_open_once_and_free_again_when_dropped() {
    on_each(|subject| {
        let camera = subject.open();
        assert_eq!(camera.info().driver, subject.name);
        assert!(camera.info().triggered);
        let again = subject.cameras.open(Some(subject.serial)).err().unwrap();
        assert!(matches!(again, DeviceError::Unavailable { .. }), "{}: {again}", subject.name);
        drop(camera);
        subject.open();
    });
}

#[test]
fn calls_out_of_order_are_refused_and_harm_nothing() {
    on_each(|subject| {
        let (name, mut camera) = (subject.name, subject.open());
        assert_order(camera.arm(1), name, "arm");
        assert_order(camera.trigger(subject.clock.now()), name, "trigger");
        assert_order(camera.next_frame(Duration::ZERO), name, "next_frame");
        assert_order(camera.disarm(), name, "disarm");
        camera.apply(&subject.settings).unwrap();
        camera.arm(1).unwrap();
        assert_order(camera.apply(&subject.settings), name, "apply");
        assert_order(camera.arm(1), name, "arm");
        camera.trigger(subject.clock.now()).unwrap();
        camera.next_frame(WAIT).unwrap();
        camera.disarm().unwrap();
        assert_order(camera.disarm(), name, "disarm");
    });
}

#[test]
fn settings_are_read_back_or_refused_by_name() {
    on_each(|subject| {
        let mut camera = subject.open();
        let asked = CameraSettings { region: Some(region(40, 20, 64, 48)), ..subject.settings.clone() };
        let applied = camera.apply(&asked).unwrap();
        assert_eq!(applied.settings, asked, "{}", subject.name);
        assert_eq!((applied.width, applied.height), (64, 48));
        assert!(applied.readout_us > 0.0 && applied.saturation_dn > 65_000);
        for (expected, settings) in [
            ("exposure_us", CameraSettings { exposure_us: 0.0, ..asked.clone() }),
            ("exposure_us", CameraSettings { exposure_us: f64::NAN, ..asked.clone() }),
            ("gain_db", CameraSettings { gain_db: -1.0, ..asked.clone() }),
            ("gain_db", CameraSettings { gain_db: f64::INFINITY, ..asked.clone() }),
            ("gamma", CameraSettings { gamma: 7.0, ..asked.clone() }),
            ("region", CameraSettings { region: Some(region(200, 0, 4, 4)), ..asked.clone() }),
            ("region", CameraSettings { region: Some(region(0, 0, 0, 2)), ..asked.clone() }),
        ] {
            match camera.apply(&settings) {
                Err(DeviceError::Refused { setting, .. }) => {
                    assert_eq!(setting, expected, "{}", subject.name)
                }
                other => panic!("{}: {expected}: {other:?}", subject.name),
            }
        }
        // What was applied before still holds.
        camera.arm(1).unwrap();
        camera.trigger(subject.clock.now()).unwrap();
        let frame = camera.next_frame(WAIT).unwrap();
        assert_eq!((frame.width, frame.height, samples(&frame).len()), (64, 48, 64 * 48));
    });
}

#[test]
fn frames_are_numbered_from_arming_on_and_disarming_discards_the_rest() {
    on_each(|subject| {
        let mut camera = subject.armed();
        for _ in 0..2 {
            for number in 0..3 {
                let at = after(subject.clock.now(), 5.0);
                let start = camera.trigger(at).unwrap();
                assert!(start >= at && start <= after(at, subject.late_ms), "{}", subject.name);
                let frame = camera.next_frame(WAIT).unwrap();
                let stamp = frame.stamp;
                assert_eq!((stamp.frame_id, stamp.trigger), (number, number), "{}", subject.name);
                assert_eq!(stamp.exposure_start, start, "{}", subject.name);
                assert!(stamp.received > start && subject.clock.now() >= stamp.received);
            }
            // One exposure is left under way.
            camera.trigger(subject.clock.now()).unwrap();
            let statistics = camera.disarm().unwrap();
            assert_eq!((statistics.triggers, statistics.failed), (4, 0), "{}", subject.name);
            camera.arm(4).unwrap();
        }
    });
}

#[test]
fn a_timeout_leaves_the_stream_usable() {
    on_each(|subject| {
        let mut camera = subject.armed();
        let wait = Duration::from_millis(30);
        let start = subject.clock.now();
        let result = camera.next_frame(wait);
        assert!(matches!(result, Err(DeviceError::Timeout { timeout_ms: 30, .. })), "{result:?}");
        assert!(subject.clock.now().since(start) >= wait, "{}", subject.name);
        camera.trigger(subject.clock.now()).unwrap();
        let frame = camera.next_frame(WAIT).unwrap();
        assert_eq!((frame.stamp.frame_id, frame.stamp.trigger), (0, 0), "{}", subject.name);
        let statistics = camera.disarm().unwrap();
        assert_eq!((statistics.triggers, statistics.frames, statistics.failed), (1, 1, 0));
    });
}
