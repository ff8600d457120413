//! The only place that names concrete drivers: settings in, devices out.

use std::sync::Arc;

use polscan_drivers::{
    camera::{Camera, CameraDriver, Listing},
    clock::Clock,
    error::DeviceError,
    projector::{Projector, ProjectorDriver},
    sim,
};
use thiserror::Error;

use crate::{
    config::{DeviceDriver, Settings},
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
    sim: Option<sim::Rig>,
}

impl Rig {
    /// Opens what the settings ask for.
    pub fn open(settings: &Settings) -> Result<Self, RigError> {
        let some = |serial: &str| (!serial.is_empty()).then(|| serial.to_string());
        let (camera, projector) = (&settings.raw.camera, &settings.raw.projector);
        let simulated = simulated(settings)?;
        match (camera.driver, projector.driver, &simulated) {
            (DeviceDriver::Sim, DeviceDriver::Sim, Some(Simulated { rig, clock })) => Ok(Self {
                clock: clock.clone(),
                camera: rig.cameras().open(some(&camera.serial).as_deref())?,
                projector: rig.projectors().open(some(&projector.serial).as_deref())?,
                sim: Some(rig.clone()),
            }),
            (DeviceDriver::None, ..) => Err(RigError::NotConfigured("camera")),
            _ => Err(RigError::NotConfigured("projector")),
        }
    }

    /// Whether what this rig measures is computed rather than seen.
    pub fn is_simulated(&self) -> bool {
        self.sim.is_some()
    }

    /// What the rig knows of its scene, for a simulated one.
    pub fn truth(&self) -> Option<Truth> {
        self.sim.as_ref().map(|rig| truth_maps(&rig.truth()))
    }
}

/// All cameras and all projectors that the configured drivers find.
pub fn list(settings: &Settings) -> Result<(Vec<Listing>, Vec<Listing>), RigError> {
    let Some(Simulated { rig, .. }) = simulated(settings)? else {
        return Ok((Vec::new(), Vec::new()));
    };
    Ok((rig.cameras().list()?, rig.projectors().list()?))
}

/// A simulated rig and the clock that it runs by.
struct Simulated {
    rig: sim::Rig,
    clock: Arc<dyn Clock>,
}

fn simulated(settings: &Settings) -> Result<Option<Simulated>, RigError> {
    let (Some((description, scene)), DeviceDriver::Sim) = (&settings.sim, settings.raw.camera.driver) else {
        return Ok(None);
    };
    let clock = description.pacing.clock();
    Ok(Some(Simulated { rig: sim::Rig::new(description, scene, clock.clone())?, clock }))
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
