//! Rigs and scenes for the tests, and short cuts to operate them.
#![allow(dead_code, reason = "each test binary uses its own part")]

pub mod blackfly;

use std::{path::PathBuf, sync::Arc, time::Duration};

use polscan_drivers::{
    camera::{Camera, CameraDriver, CameraSettings, PixelFormat, Region, TriggerSource},
    clock::{Clock, Timestamp, VirtualClock},
    frame::Frame,
    projector::{Projector, ProjectorDriver, Rgb, Slide},
    sim::{Rig, RigDescription, Scene, Truth},
};

pub const H: Rgb = [0, 255, 0];
pub const V: Rgb = [255, 0, 255];
pub const BLACK: Rgb = [0; 3];
pub const WHITE: Rgb = [255; 3];

/// A rig of the paper's proportions with few pixels, and nothing that blurs, leaks, lags or makes noise.
pub const CLEAN_RIG: &str = r#"
scene = "none"
[camera]
size = [200, 150]
focal_px = 580.0
full_well_e = 10500.0
read_noise_e = 0.0
bits = 16
[projector]
size = [128, 96]
focal_px = 192.5
principal_point_px = [63.5, 92.6]
blur_px = 0.3
extinction = [1e9, 1e9, 1e9]
refresh_hz = 60.0
[pose]
baseline_mm = 52.4
aim_mm = 1000.0
[analyser]
extinction = 1e9
[ambient]
electrons = 0.0
"#;

/// A metal mirror-like plate that fills the view, facing half way between camera and projector.
pub const METAL: &str = r#"
[materials.aluminium]
index = [0.96, 6.7]
roughness = 0.5
[[objects]]
name = "plate"
material = "aluminium"
level = 0.5
shape = { plane = { point_mm = [0.0, 0.0, 1000.0], normal = [0.0262, 0.0, -1.0] } }
"#;

pub fn rig_description(text: &str) -> RigDescription {
    toml::from_str(text).unwrap()
}

pub fn clean_rig() -> RigDescription {
    rig_description(CLEAN_RIG)
}

pub fn scene(text: &str) -> Scene {
    toml::from_str(text).unwrap()
}

pub fn config_path(name: &str) -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "..", "config", name].iter().collect()
}

pub fn config_text(name: &str) -> String {
    std::fs::read_to_string(config_path(name)).unwrap()
}

#[derive(serde::Deserialize)]
pub struct Config {
    pub sim: RigDescription,
}

pub fn paper_rig() -> RigDescription {
    // Other parts of the file belong to others.
    let table: toml::Table = config_text("sim.toml").parse().unwrap();
    table["sim"].clone().try_into().unwrap()
}

/// A rig with its devices open and settings at hand.
pub struct Bench {
    pub rig: Rig,
    pub clock: Arc<dyn Clock>,
    pub camera: Box<dyn Camera>,
    pub projector: Box<dyn Projector>,
    pub settings: CameraSettings,
}

impl Bench {
    pub fn new(description: &RigDescription, scene: &Scene) -> Self {
        let clock: Arc<dyn Clock> = Arc::new(VirtualClock::default());
        let rig = Rig::new(description, scene, clock.clone()).unwrap();
        let format = match description.camera.bits {
            8 => PixelFormat::Mono8,
            10 => PixelFormat::Mono10,
            12 => PixelFormat::Mono12,
            _ => PixelFormat::Mono16,
        };
        Self {
            camera: rig.cameras().open(None).unwrap(),
            projector: rig.projectors().open(None).unwrap(),
            settings: settings(format, description.camera.gamma),
            rig,
            clock,
        }
    }

    /// One frame of a slide that has been on the glass for long.
    pub fn settled(&mut self, slide: Slide) -> Frame {
        self.settled_frames(slide, 1).remove(0)
    }

    pub fn settled_frames(&mut self, slide: Slide, count: usize) -> Vec<Frame> {
        self.projector.load(&[slide]).unwrap();
        let shown = self.projector.show(0).unwrap();
        self.clock.sleep_until(shown.flipped + Duration::from_secs(1));
        self.camera.apply(&self.settings).unwrap();
        self.camera.arm(count).unwrap();
        let frames = (0..count)
            .map(|_| {
                self.camera.trigger(self.clock.now()).unwrap();
                self.camera.next_frame(Duration::from_secs(60)).unwrap()
            })
            .collect();
        self.camera.disarm().unwrap();
        frames
    }

    /// Electrons (above the black level) of a settled frame.
    pub fn electrons(&mut self, slide: Slide) -> Vec<f64> {
        let applied = self.camera.apply(&self.settings).unwrap();
        let frame = self.settled(slide);
        let black = applied.black_level_dn.unwrap();
        let gain = applied.noise.unwrap().gain_dn_per_electron;
        samples(&frame).into_iter().map(|dn| (f64::from(dn) - black) / gain).collect()
    }

    pub fn truth(&self) -> Truth {
        self.rig.truth()
    }
}

pub fn settings(format: PixelFormat, gamma: f64) -> CameraSettings {
    CameraSettings {
        exposure_us: 2000.0,
        gain_db: 0.0,
        gamma,
        region: None,
        format,
        trigger: TriggerSource::Software,
    }
}

pub fn samples(frame: &Frame) -> Vec<u16> {
    let pixels = frame.pixels();
    (0..pixels.len()).map(|index| pixels.get(index)).collect()
}

pub fn region(x: u32, y: u32, width: u32, height: u32) -> Region {
    Region { x, y, width, height }
}

pub fn mean(values: impl IntoIterator<Item = f64>) -> f64 {
    let (sum, count) = values.into_iter().fold((0.0, 0.0), |(sum, count), value| (sum + value, count + 1.0));
    sum / count
}

pub fn after(start: Timestamp, ms: f64) -> Timestamp {
    start + Duration::from_secs_f64(1e-3 * ms)
}
