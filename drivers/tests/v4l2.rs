//! The driver on a real kernel with its virtual camera `vivid`, whose HDMI input shows what its output is given.
//!
//! Runs in the virtual machine that `make v4l2` starts, one test after the other; what the driver did is looked at with
//! `v4l2-ctl`, which knows nothing of it.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

use std::{
    fs,
    io::Read,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::{Arc, Mutex},
    time::{Duration, Instant},
};

use polscan_drivers::{
    camera::{Camera, CameraDriver, CameraSettings, PixelFormat, Region, StreamStatistics, TriggerSource},
    clock::{Clock, MonotonicClock},
    error::DeviceError,
    frame::Frame,
    v4l2::{Options, V4l2Cameras},
};

const CAMERA: &str = "/dev/video0";
const OUTPUT: &str = "/dev/video1";
const SERIAL: &str = "platform:vivid-000";
const WAIT: Duration = Duration::from_secs(30);

/// Runs `v4l2-ctl` on a node; what it says.
fn ctl(node: &str, arguments: &[&str]) -> String {
    let output = Command::new("v4l2-ctl").arg("-d").arg(node).args(arguments).output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "v4l2-ctl -d {node} {arguments:?}: {said}");
    said.into_owned()
}

fn control(name: &str) -> String {
    let said = ctl(CAMERA, &["--get-ctrl", name]);
    said.rsplit(':').next().unwrap().trim().to_owned()
}

fn set_control(name: &str, value: u32) {
    ctl(CAMERA, &["--set-ctrl", &format!("{name}={value}")]);
}

/// Number of the timings of this size at 60 Hz in the list of the node.
fn timings(width: u32, height: u32) -> String {
    let list = ctl(CAMERA, &["--list-dv-timings"]);
    let (mut index, mut found) = (String::new(), [0, 0]);
    for line in list.lines().map(str::trim) {
        if let Some(number) = line.strip_prefix("Index:") {
            index = number.trim().to_owned();
        } else if let Some(columns) = line.strip_prefix("Active width:") {
            found[0] = columns.trim().parse().unwrap();
        } else if let Some(rows) = line.strip_prefix("Active height:") {
            found[1] = rows.trim().parse().unwrap();
        } else if line.starts_with("Frame format:")
            && line.ends_with("progressive")
            && found == [width, height]
        {
            return format!("index={index}");
        }
    }
    panic!("no timings of {width} x {height}: {list}");
}

/// What feeds the output while the camera runs: another program, and the file of what it shows.
struct Screen {
    shows: Mutex<Option<Child>>,
    file: PathBuf,
}

impl Screen {
    fn new(width: u32, height: u32, fourcc: &str) -> Self {
        let timings = timings(width, height);
        ctl(CAMERA, &["--set-dv-bt-timings", &timings]);
        ctl(OUTPUT, &["--set-dv-bt-timings", &timings]);
        ctl(OUTPUT, &["--set-fmt-video-out", &format!("width={width},height={height},pixelformat={fourcc}")]);
        ctl(CAMERA, &["--set-ctrl", "loop_video=1,osd_text_mode=2"]);
        Self { shows: Mutex::new(None), file: PathBuf::from("/tmp/picture") }
    }

    /// Shows a picture, and returns when it is on.
    fn show(&self, picture: Vec<u8>) {
        self.stop();
        fs::write(&self.file, picture).unwrap();
        let mut child = Command::new("v4l2-ctl")
            .args(["-d", OUTPUT, "--stream-out-mmap", "--stream-loop", "--stream-count=1000000"])
            .arg(format!("--stream-from={}", self.file.display()))
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        // A sign for each frame that it has given, and more of them than there are buffers.
        let mut signs = [0; 12];
        child.stderr.as_mut().unwrap().read_exact(&mut signs).unwrap();
        assert_eq!(signs, [b'>'; 12], "{}", String::from_utf8_lossy(&signs));
        *self.shows.lock().unwrap() = Some(child);
    }

    fn stop(&self) {
        if let Some(mut child) = self.shows.lock().unwrap().take() {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.stop();
    }
}

/// A picture in which no two near places are alike, different for each seed, of `mask` bits.
fn samples(width: u32, height: u32, seed: u32, mask: u16) -> Vec<u16> {
    let one = |n: u32| {
        (n.wrapping_mul(0x9e37_79b9).wrapping_add(seed.wrapping_mul(0x85eb_ca6b)) >> 13) as u16 & mask
    };
    (0..width * height).map(one).collect()
}

fn bytes(samples: &[u16], format: PixelFormat) -> Vec<u8> {
    match format {
        PixelFormat::Mono8 => samples.iter().map(|&sample| sample as u8).collect(),
        _ => samples.iter().flat_map(|sample| sample.to_le_bytes()).collect(),
    }
}

fn settings(format: PixelFormat) -> CameraSettings {
    CameraSettings {
        exposure_us: 2000.0,
        gain_db: 0.0,
        gamma: 1.0,
        region: None,
        format,
        trigger: TriggerSource::Software,
    }
}

fn options() -> Options {
    Options {
        allow: vec!["gamma".into()],
        gain_raw: Some(50.0),
        fixed_exposure_us: Some(2000.0),
        skip_frames: 0,
        ..Options::default()
    }
}

struct Rig {
    clock: Arc<dyn Clock>,
    camera: Box<dyn Camera>,
}

impl Rig {
    fn open() -> Self {
        let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
        let camera = V4l2Cameras::new(options(), clock.clone()).open(Some(SERIAL)).unwrap();
        Self { clock, camera }
    }

    fn armed(settings: &CameraSettings) -> Self {
        let mut rig = Self::open();
        rig.camera.apply(settings).unwrap();
        rig.camera.arm(10).unwrap();
        rig
    }

    /// A frame of now.
    fn frame(&mut self) -> Result<Frame, DeviceError> {
        let now = self.clock.now();
        self.camera.trigger(now)?;
        let frame = self.camera.next_frame(WAIT)?;
        assert!(frame.stamp.exposure_start >= now, "{:?}", frame.stamp);
        assert!(frame.stamp.received >= frame.stamp.exposure_start, "{:?}", frame.stamp);
        Ok(frame)
    }

    fn counted(mut self) -> StreamStatistics {
        self.camera.disarm().unwrap()
    }
}

fn found(frame: &Frame) -> Vec<u16> {
    let pixels = frame.pixels();
    (0..pixels.len()).map(|at| pixels.get(at)).collect()
}

#[test]
fn the_camera_is_listed_and_the_output_is_not() {
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
    let cameras = V4l2Cameras::new(options(), clock);
    let listed = cameras.list().unwrap();
    let serials: Vec<_> = listed.iter().map(|camera| camera.serial.as_str()).collect();
    assert_eq!(serials, [SERIAL]);
    assert_eq!(listed[0].unusable, None);

    let opened = cameras.open(None).unwrap();
    assert!(!opened.info().triggered);
    let twice = cameras.open(None).err().unwrap().to_string();
    assert!(twice.contains("open already"), "{twice}");
    drop(opened);

    // Another program that streams: its first sign is a frame.
    let mut other = Command::new("v4l2-ctl")
        .args(["-d", CAMERA, "--stream-mmap", "--stream-count=1000000"])
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    other.stderr.as_mut().unwrap().read_exact(&mut [0]).unwrap();
    let why = cameras.list().unwrap()[0].unusable.clone().expect("it is used");
    other.kill().unwrap();
    other.wait().unwrap();
    assert!(why.contains("used by another program"), "{why}");
}

#[test]
fn what_the_camera_cannot_do_is_refused_with_the_difference() {
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
    let mut camera = V4l2Cameras::new(Options::default(), clock.clone()).open(Some(SERIAL)).unwrap();
    let line = CameraSettings { trigger: TriggerSource::Line0, ..settings(PixelFormat::Mono8) };
    let DeviceError::RefusedAll { differences, .. } = camera.apply(&line).unwrap_err() else {
        panic!("all of it is refused at once");
    };
    let names: Vec<_> = differences.iter().map(|difference| difference.setting).collect();
    assert_eq!(names, ["trigger", "exposure_us", "gain_db", "gamma"]);
    drop(camera);
    let small = Options { frame_size: Some((3, 3)), ..options() };
    let mut camera = V4l2Cameras::new(small, clock).open(Some(SERIAL)).unwrap();
    let refusal = camera.apply(&settings(PixelFormat::Mono8)).unwrap_err();
    assert!(refusal.to_string().contains("frame_size: asked 3 x 3"), "{refusal}");
}

#[test]
fn controls_are_set_and_read_back() {
    set_control("gain_automatic", 1);
    set_control("horizontal_flip", 1);
    let mut rig = Rig::open();
    rig.camera.apply(&settings(PixelFormat::Mono8)).unwrap();
    let names = ["gain_automatic", "gain", "horizontal_flip", "vertical_flip"];
    assert_eq!(names.map(control), ["0", "50", "0", "0"]);
}

#[test]
fn every_format_arrives_as_it_was_sent() {
    for (fourcc, format, mask) in [
        ("GREY", PixelFormat::Mono8, 0xff),
        ("Y12 ", PixelFormat::Mono12, 0x0fff),
        ("Y16 ", PixelFormat::Mono16, 0xffff),
    ] {
        let screen = Screen::new(640, 480, fourcc);
        let mut rig = Rig::armed(&settings(format));
        for seed in 0..3 {
            let sent = samples(640, 480, seed, mask);
            screen.show(bytes(&sent, format));
            assert!(found(&rig.frame().unwrap()) == sent, "{fourcc}, picture {seed}");
        }
        assert_eq!(rig.counted().frames, 3);
    }
}

#[test]
fn a_region_is_cut_out() {
    let screen = Screen::new(640, 480, "GREY");
    let region = Region { x: 17, y: 33, width: 301, height: 211 };
    let mut rig = Rig::armed(&CameraSettings { region: Some(region), ..settings(PixelFormat::Mono8) });
    let sent = samples(640, 480, 5, 0xff);
    screen.show(bytes(&sent, PixelFormat::Mono8));
    let frame = rig.frame().unwrap();
    assert_eq!((frame.width, frame.height), (301, 211));
    let row = |y: usize| sent[(33 + y) * 640 + 17..][..301].to_vec();
    assert!(found(&frame) == (0..211).flat_map(row).collect::<Vec<_>>());
}

#[test]
fn full_size_frames_show_what_was_on_when_they_were_asked_for() {
    let (width, height) = (1600, 1200);
    let screen = Screen::new(width, height, "GREY");
    let mut rig = Rig::armed(&settings(PixelFormat::Mono8));
    let start = Instant::now();
    for seed in 0..6 {
        let sent = samples(width, height, seed, 0xff);
        screen.show(bytes(&sent, PixelFormat::Mono8));
        assert!(found(&rig.frame().unwrap()) == sent, "picture {seed}");
    }
    println!("6 pictures of {width} x {height} in {:.1} s", start.elapsed().as_secs_f64());
    let counted = rig.counted();
    assert_eq!((counted.triggers, counted.frames), (6, 6));
}

#[test]
fn frames_that_are_dropped_are_counted_and_the_next_is_taken() {
    let screen = Screen::new(640, 480, "GREY");
    let mut rig = Rig::armed(&settings(PixelFormat::Mono8));
    set_control("percentage_of_dropped_buffers", 60);
    for seed in 0..5 {
        let sent = samples(640, 480, seed, 0xff);
        screen.show(bytes(&sent, PixelFormat::Mono8));
        let frame = rig.frame();
        assert!(found(&frame.unwrap()) == sent, "picture {seed}");
    }
    set_control("percentage_of_dropped_buffers", 0);
    let counted = rig.counted();
    assert_eq!(counted.frames, 5);
    assert!(counted.counters["missing_numbers"] > 0, "{counted:?}");
}

#[test]
fn frames_that_are_flagged_are_not_taken() {
    // Without a picture on the output, which would take its share of the flags.
    let mut rig = Rig::armed(&settings(PixelFormat::Mono8));
    for _ in 0..5 {
        set_control("inject_v4l2_buf_flag_error", 1);
        rig.frame().unwrap();
    }
    let counted = rig.counted();
    assert_eq!((counted.frames, counted.counters["damaged"]), (5, 5), "{counted:?}");
}

/// Waits for the error that says that the camera is gone.
fn awaited_loss(rig: &mut Rig) -> DeviceError {
    let start = Instant::now();
    loop {
        match rig.frame() {
            Ok(_) => assert!(start.elapsed() < WAIT, "frames still come"),
            Err(error) => return error,
        }
    }
}

#[test]
fn a_camera_that_goes_away_says_so_and_is_opened_again() {
    for (name, words) in [("inject_fatal_streaming_error", "stream broke"), ("disconnect", "No such device")]
    {
        let mut rig = Rig::armed(&settings(PixelFormat::Mono8));
        rig.frame().unwrap();
        set_control(name, 1);
        let lost = awaited_loss(&mut rig);
        assert!(matches!(lost, DeviceError::Unavailable { .. }), "{name}: {lost}");
        assert!(lost.to_string().contains(words), "{name}: {lost}");
        assert_eq!(rig.camera.trigger(rig.clock.now()).unwrap_err(), lost, "{name}: said again");
        drop(rig);
        let mut again = Rig::armed(&settings(PixelFormat::Mono8));
        again.frame().unwrap();
    }
}

#[test]
fn a_camera_that_goes_away_while_nobody_uses_it_is_known_to_be_gone() {
    let rig = Rig::open();
    assert_eq!(rig.camera.alive(), Ok(()));
    set_control("disconnect", 1);
    let start = Instant::now();
    while rig.camera.alive().is_ok() {
        assert!(start.elapsed() < WAIT, "it is not noticed");
        std::thread::sleep(Duration::from_millis(50));
    }
    drop(rig);
    let mut again = Rig::armed(&settings(PixelFormat::Mono8));
    again.frame().unwrap();
}

#[test]
fn the_kernel_takes_a_camera_away_and_gives_it_back() {
    let driver = Path::new("/sys/bus/platform/drivers/vivid");
    let mut rig = Rig::armed(&settings(PixelFormat::Mono8));
    rig.frame().unwrap();
    fs::write(driver.join("unbind"), "vivid.0").unwrap();
    let lost = awaited_loss(&mut rig);
    assert!(lost.to_string().contains("it is opened again by itself"), "{lost}");
    drop(rig);
    let cameras = V4l2Cameras::new(options(), Arc::new(MonotonicClock::start()));
    let absent = cameras.open(Some(SERIAL)).err().unwrap().to_string();
    assert!(absent.contains("no camera is connected"), "{absent}");
    fs::write(driver.join("bind"), "vivid.0").unwrap();
    let mut again = Rig::armed(&settings(PixelFormat::Mono8));
    again.frame().unwrap();
}
