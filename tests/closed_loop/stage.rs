//! Screen, scene and camera of the loop.

use std::{
    path::{Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use polscan::config::{Layers, Settings};
use polscan_drivers::{
    aravis::fake::{ADDRESS, Exposure, Fake},
    camera::{Camera, CameraDriver, CameraSettings},
    clock::{Clock, VirtualClock},
    frame::Pixels,
    projector::{Projector, ProjectorDriver, Rgb, Slide},
    sim,
};
use x11rb::{connection::Connection as _, protocol::xproto::Window, rust_connection::RustConnection};

use crate::{
    daemon::Daemon,
    rig::Rig,
    xvfb::{Xvfb, grab},
};

/// Registers of the camera in software, as `blackfly.xml` lays them out.
mod register {
    pub const SENSOR_HEIGHT: u32 = 0x118;
    pub const SENSOR_WIDTH: u32 = 0x11c;
    pub const GAMMA: u32 = 0x101c;
    pub const BLACK_LEVEL: u32 = 0x1020;
    pub const RESULTING_FRAME_RATE: u32 = 0x1028;
    pub const TRIGGER_DELAY: u32 = 0x1030;
}

/// Code of the format Mono12p: two samples in three bytes, a stream of bits from the lowest on.
const MONO12P: u32 = 0x010c_0047;

/// Long enough for liquid crystals to have forgotten the picture before.
const SETTLED: Duration = Duration::from_secs(1);

/// The twin's optics: pixels in, frame out.
struct Optics {
    camera: Box<dyn Camera>,
    projector: Box<dyn Projector>,
    clock: Arc<VirtualClock>,
    settings: CameraSettings,
}

impl Optics {
    /// Optics of `rig`, whose clock is `clock`, with the camera set as `settings` say.
    fn new(rig: &sim::Rig, clock: Arc<VirtualClock>, settings: &CameraSettings) -> Self {
        let camera = rig.cameras().open(None).expect("the twin's camera");
        let projector = rig.projectors().open(None).expect("the twin's projector");
        let mut optics = Self { camera, projector, clock, settings: settings.clone() };
        optics.arm(settings.exposure_us);
        optics
    }

    fn arm(&mut self, exposure_us: f64) {
        self.settings.exposure_us = exposure_us;
        self.camera.apply(&self.settings).expect("settings of the twin's camera");
        self.camera.arm(1).expect("the twin's camera");
    }

    /// Samples that an exposure gives while the pixels of `screen` stand on the projector.
    fn expose(&mut self, screen: Vec<Rgb>, exposure: &Exposure) -> Vec<u16> {
        if f64::from(exposure.exposure_us) != self.settings.exposure_us {
            self.camera.disarm().expect("the twin's camera");
            self.arm(f64::from(exposure.exposure_us));
        }
        self.projector.load(&[slide(screen, self.projector.info().width as usize)]).expect("the screen fits");
        let shown = self.projector.show(0).expect("the twin's projector");
        self.clock.sleep_until(shown.flipped + SETTLED);
        self.camera.trigger(self.clock.now()).expect("the twin's camera");
        let frame = self.camera.next_frame(SETTLED).expect("a frame of the twin");
        assert_eq!((frame.width as usize, frame.height as usize), (exposure.width, exposure.height));
        match frame.pixels() {
            Pixels::U16(samples) => samples.to_vec(),
            Pixels::U8(samples) => samples.iter().map(|sample| u16::from(*sample)).collect(),
        }
    }
}

/// The least that says what `pixels` show: the twin draws stripes much faster than pictures without structure.
fn slide(pixels: Vec<Rgb>, width: usize) -> Slide {
    let first = &pixels[..width];
    let alike = |row: &[Rgb]| row.iter().all(|pixel| *pixel == row[0]);
    if alike(&pixels) {
        Slide::Uniform(pixels[0])
    } else if pixels.chunks(width).all(|row| row == first) {
        Slide::Columns(first.into())
    } else if pixels.chunks(width).all(alike) {
        Slide::Rows(pixels.iter().copied().step_by(width).collect())
    } else {
        Slide::Full(pixels.into())
    }
}

/// Samples of 12 bits as they travel.
fn pack(samples: &[u16], bytes: &mut [u8]) {
    for (group, pair) in bytes.chunks_exact_mut(3).zip(samples.chunks_exact(2)) {
        let word = u32::from(pair[0]) | u32::from(pair[1]) << 12;
        group.copy_from_slice(&word.to_le_bytes()[..3]);
    }
}

/// What a display shows that may come and go; black while there is none.
struct Screen {
    display: String,
    connection: Option<(RustConnection, Window)>,
    pixels: usize,
}

impl Screen {
    fn now(&mut self) -> Vec<Rgb> {
        let shown = self.connection.as_ref().and_then(|connection| grab(connection).ok());
        let shown = shown.or_else(|| {
            let (x, screen) = RustConnection::connect(Some(&self.display)).ok()?;
            let root = x.setup().roots[screen].root;
            self.connection = Some((x, root));
            grab(self.connection.as_ref()?).ok()
        });
        shown.unwrap_or_else(|| vec![[0; 3]; self.pixels])
    }
}

/// A screen, the twin's scene before it, and a camera that looks at it.
pub struct Stage {
    pub xvfb: Xvfb,
    camera: Option<Fake>,
    /// The twin as `polscan scan` takes it.
    pub twin: Rig,
    settings: Settings,
    rig: sim::Rig,
    clock: Arc<VirtualClock>,
    running: Arc<Mutex<()>>,
    frames_hz: f32,
}

impl Stage {
    /// The stage of `twin`, whose camera states that it sends `frames_hz` frames a second.
    pub fn new(twin: Rig, frames_hz: f32) -> Self {
        let layers = Layers { file: Some(twin.config()), ..Layers::default() };
        let settings = layers.load().expect("a configuration");
        let (description, scene) = settings.sim.as_ref().expect("a twin");
        let [width, height] = description.projector.size;
        let xvfb = Xvfb::start(width, height);
        let clock = Arc::new(VirtualClock::default());
        let rig = sim::Rig::new(description, scene, clock.clone()).expect("a twin");
        let mut stage =
            Self { xvfb, camera: None, twin, settings, rig, clock, running: Arc::default(), frames_hz };
        stage.plug();
        stage
    }

    /// Stops the camera in the middle of its next exposure until what is returned is dropped: one thread does all that
    /// it does, so that it neither sends nor answers.
    pub fn stop_camera(&self) -> MutexGuard<'_, ()> {
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the camera away with its sockets: whoever writes to it hears that nobody is there.
    pub fn unplug(&mut self) {
        self.camera = None;
    }

    /// Puts the camera where it was.
    pub fn plug(&mut self) {
        let (description, _) = self.settings.sim.as_ref().expect("a twin");
        let [width, height] = description.projector.size;
        let mut optics = Optics::new(&self.rig, self.clock.clone(), &self.settings.camera);
        let pixels = (width * height) as usize;
        let mut screen = Screen { display: self.xvfb.display(), connection: None, pixels };
        let genicam: PathBuf =
            [env!("CARGO_MANIFEST_DIR"), "drivers", "tests", "data", "blackfly.xml"].iter().collect();
        let running = self.running.clone();
        let paint = move |exposure: Exposure, bytes: &mut [u8]| {
            let _stopped_meanwhile = running.lock().unwrap_or_else(PoisonError::into_inner);
            assert_eq!(exposure.format, MONO12P);
            pack(&optics.expose(screen.now(), &exposure), bytes);
        };
        let camera = Fake::new("PS-LOOP", Some(Path::new(&genicam)), paint).expect("a camera in software");
        let [columns, rows] = description.camera.size;
        camera.poke(register::SENSOR_WIDTH, columns);
        camera.poke(register::SENSOR_HEIGHT, rows);
        camera.poke(register::GAMMA, 1f32.to_bits());
        let black_level = 100.0 * description.camera.black_level_share as f32;
        camera.poke(register::BLACK_LEVEL, black_level.to_bits());
        camera.poke(register::RESULTING_FRAME_RATE, self.frames_hz.to_bits());
        camera.poke(register::TRIGGER_DELAY, 9f32.to_bits());
        self.camera = Some(camera);
    }

    /// What the camera truly sees.
    pub fn truth(&self) -> sim::Truth {
        self.rig.truth_of(None)
    }

    /// The service, started, which knows of the twin only what a calibration says.
    pub fn daemon(&self, rig: Rig) -> Daemon {
        let rig = rig
            .without("sim")
            .set("camera.driver", "aravis")
            .set("camera.serial", ADDRESS)
            .set("projector.driver", "window")
            .set("projector.x11_display", self.xvfb.display());
        Daemon::on(rig).started()
    }
}
