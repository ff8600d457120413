//! The only place that names concrete drivers: settings in, devices out.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
    time::Duration,
};

use polscan_drivers::{
    aravis::{self, AravisCameras},
    camera::{Camera, CameraDriver, Listing},
    clock::{Clock, MonotonicClock, VirtualClock},
    error::DeviceError,
    projector::{Projector, ProjectorDriver},
    sim,
    v4l2::{self, V4l2Cameras},
};
use thiserror::Error;

mod held;
mod replay;
mod twin;
mod window;

pub use held::holding;
pub use twin::without_analyser;
pub use window::{WindowError, serve_projector};

use crate::{
    config::{DeviceDriver, Settings, UsbMode},
    grid::Grid,
    truth::{Truth, TruthObject},
};

/// Why the devices of a rig cannot be had.
#[derive(Debug, Error)]
pub enum RigError {
    /// The configuration names no device.
    #[error("no {0} is configured: set {0}.driver in the file given with --config, as config/sim.toml does")]
    NotConfigured(&'static str),
    /// The simulated rig cannot be set up.
    #[error(transparent)]
    Sim(#[from] sim::RigError),
    /// The bundle cannot be replayed.
    #[error("cannot replay {}", bundle.display())]
    Replay {
        /// Bundle.
        bundle: PathBuf,
        /// Why not.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A driver says no.
    #[error(transparent)]
    Device(#[from] DeviceError),
}

/// The devices of a scan, on one clock.
pub struct Rig {
    /// Clock that both devices and the sequencer share.
    pub clock: Arc<dyn Clock>,
    /// Camera.
    pub camera: Box<dyn Camera>,
    /// Projector.
    pub projector: Box<dyn Projector>,
    knows: Knowledge,
}

/// What a rig knows of its scene.
enum Knowledge {
    Nothing,
    Sim(sim::Rig),
    Recorded(Box<replay::Recorded>),
}

impl Rig {
    /// Opens what the settings ask for.
    pub fn open(settings: &Settings) -> Result<Self, RigError> {
        let Families { cameras, projectors, clock, knows } = families(settings)?;
        let cameras = cameras.ok_or(RigError::NotConfigured("camera"))?;
        let projectors = projectors.ok_or(RigError::NotConfigured("projector"))?;
        Ok(Self {
            clock,
            camera: cameras.open(named(&settings.raw.camera.serial))?,
            projector: projectors.open(named(&settings.raw.projector.serial))?,
            knows,
        })
    }

    /// Whether what this rig measures is computed rather than seen.
    pub fn is_simulated(&self) -> bool {
        match &self.knows {
            Knowledge::Nothing => false,
            Knowledge::Sim(_) => true,
            Knowledge::Recorded(recorded) => recorded.simulated,
        }
    }

    /// What the rig knows of its scene, for a simulated one or a recording of one.
    pub fn truth(&self) -> Option<Truth> {
        match &self.knows {
            Knowledge::Nothing => None,
            Knowledge::Sim(rig) => Some(truth_maps(&rig.truth())),
            Knowledge::Recorded(recorded) => recorded.truth.clone(),
        }
    }
}

/// A projector without a camera, for pictures that no camera needs to see.
pub struct Beam {
    /// Projector.
    pub projector: Box<dyn Projector>,
    /// Clock of its receipts.
    pub clock: Arc<dyn Clock>,
}

impl Beam {
    /// Opens the projector that the settings ask for.
    pub fn open(settings: &Settings) -> Result<Self, RigError> {
        let Families { projectors, clock, .. } = families(settings)?;
        let projectors = projectors.ok_or(RigError::NotConfigured("projector"))?;
        Ok(Self { projector: projectors.open(named(&settings.raw.projector.serial))?, clock })
    }

    /// What a person should know of the way to its display.
    pub fn findings(&self) -> Vec<String> {
        self.projector.info().display.as_ref().map(|display| display.findings.clone()).unwrap_or_default()
    }
}

/// A serial number of the configuration, where an empty one stands for the only device there is.
fn named(serial: &str) -> Option<&str> {
    (!serial.is_empty()).then_some(serial)
}

/// All cameras and all projectors that the configured drivers find. Where a driver cannot look, that is what is listed.
pub fn list(settings: &Settings) -> Result<(Vec<Listing>, Vec<Listing>), RigError> {
    let Families { cameras, projectors, .. } = families(settings)?;
    let blind = |driver: DeviceDriver, model: &str, error: DeviceError| Listing {
        driver: driver.name().to_owned(),
        model: model.to_owned(),
        serial: String::new(),
        unusable: Some(error.to_string()),
    };
    let cameras = cameras.map_or(Ok(Vec::new()), |driver| driver.list());
    let projectors = projectors.map_or(Ok(Vec::new()), |driver| driver.list());
    Ok((
        cameras.unwrap_or_else(|error| vec![blind(settings.raw.camera.driver, "any camera", error)]),
        projectors.unwrap_or_else(|error| vec![blind(settings.raw.projector.driver, "any projector", error)]),
    ))
}

/// The configured drivers; `None` for a device that is not configured.
struct Families {
    cameras: Option<Box<dyn CameraDriver>>,
    projectors: Option<Box<dyn ProjectorDriver>>,
    clock: Arc<dyn Clock>,
    knows: Knowledge,
}

fn families(settings: &Settings) -> Result<Families, RigError> {
    if let (Some((description, scene)), DeviceDriver::Sim) = (&settings.sim, settings.raw.camera.driver) {
        let clock = description.pacing.clock();
        let rig = sim::Rig::new(description, scene, clock.clone())?;
        return Ok(Families {
            cameras: Some(Box::new(rig.cameras())),
            projectors: Some(Box::new(rig.projectors())),
            clock,
            knows: Knowledge::Sim(rig),
        });
    }
    if let Some(bundle) = &settings.replay {
        let clock: Arc<dyn Clock> = Arc::new(VirtualClock::default());
        let (rig, recorded) = replay::open(bundle, settings, clock.clone())
            .map_err(|source| RigError::Replay { bundle: bundle.clone(), source })?;
        return Ok(Families {
            cameras: Some(Box::new(rig.cameras())),
            projectors: Some(Box::new(rig.projectors())),
            clock,
            knows: Knowledge::Recorded(Box::new(recorded)),
        });
    }
    let clock: Arc<dyn Clock> = Arc::new(MonotonicClock::start());
    let cameras: Option<Box<dyn CameraDriver>> = match settings.raw.camera.driver {
        DeviceDriver::Aravis => Some(Box::new(AravisCameras::new(aravis_options(settings), clock.clone()))),
        DeviceDriver::V4l2 => Some(Box::new(V4l2Cameras::new(v4l2_options(settings), clock.clone()))),
        DeviceDriver::None | DeviceDriver::Sim | DeviceDriver::Replay | DeviceDriver::Window => None,
    };
    let projectors = window::projectors(settings, &clock);
    Ok(Families { cameras, projectors, clock, knows: Knowledge::Nothing })
}

fn aravis_options(settings: &Settings) -> aravis::Options {
    let camera = &settings.raw.camera;
    aravis::Options {
        allow: camera.allow.clone(),
        gain_raw: camera.gain_raw,
        black_level: camera.black_level,
        usb_mode: match camera.usb_mode {
            UsbMode::Sync => aravis::UsbMode::Sync,
            UsbMode::Async => aravis::UsbMode::Async,
        },
        trigger_latency: camera.trigger_latency_ms.map(|ms| Duration::from_secs_f64(1e-3 * ms)),
        packet_socket: false,
    }
}

fn v4l2_options(settings: &Settings) -> v4l2::Options {
    let camera = &settings.raw.camera;
    v4l2::Options {
        allow: camera.allow.clone(),
        gain_raw: camera.gain_raw,
        black_level: camera.black_level,
        fixed_exposure_us: camera.fixed_exposure_us,
        frame_size: camera.frame_size.first().copied().zip(camera.frame_size.get(1).copied()),
        skip_frames: camera.skip_frames,
    }
}

/// Whether devices that the settings name come and go with plugs.
pub fn is_real(settings: &Settings) -> bool {
    let drivers = [settings.raw.camera.driver, settings.raw.projector.driver];
    drivers
        .iter()
        .any(|driver| matches!(driver, DeviceDriver::Aravis | DeviceDriver::V4l2 | DeviceDriver::Window))
}

/// Number of USB3 Vision cameras that the kernel lists in its folder `devices`, whether or not they may be opened.
pub fn usb_cameras(devices: &Path) -> usize {
    aravis::usb_cameras(devices).len()
}

/// What the drivers stand on, with its version: `(name, version)`.
pub fn libraries() -> Vec<(&'static str, String)> {
    let [major, minor, micro] = aravis::version();
    vec![("aravis", format!("{major}.{minor}.{micro}"))]
}

fn truth_maps(truth: &sim::Truth) -> Truth {
    let (width, height) = (truth.width, truth.height);
    let grid = |values: &[f32]| Grid::from_vec(width, height, values.to_vec());
    Truth {
        column: grid(&truth.column),
        row: grid(&truth.row),
        depth_mm: grid(&truth.depth_mm),
        object: Grid::from_vec(width, height, truth.object.clone()),
        objects: truth
            .objects
            .iter()
            .map(|object| TruthObject { name: object.name.clone(), planar: object.planar })
            .collect(),
    }
}
