//! The rig: what its camera, its projector and the truth have in common.

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicBool, AtomicU64, Ordering},
};

use thiserror::Error;

use super::{
    camera::SimCameras, description::RigDescription, panel::Panel, projector::SimProjectors,
    rehearsal::Rehearsal, render::Renderer, scene::Scene, script::Script, timeline::Timeline, world::World,
};
use crate::{camera::Region, clock::Clock, error::DeviceError, projector::Slide};

/// Why a rig cannot be built.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum RigError {
    /// Faults of the description, each with its key path.
    #[error("the simulated rig cannot be built: {}", .0.join("; "))]
    Description(Vec<String>),
    /// Faults of the scene, each with its key path.
    #[error("the scene cannot be built: {}", .0.join("; "))]
    Scene(Vec<String>),
    /// A distortion that has no inverse within the picture.
    #[error(
        "the distortion of the simulated {which} folds over within its picture; reduce sim.{which}.k1 to k3"
    )]
    Lens {
        /// `camera` or `projector`.
        which: &'static str,
    },
    /// No turn of the projector meets the aim.
    #[error(
        "no pose of the projector aims its picture at the camera's axis; change sim.pose.aim_mm or give sim.pose.rotation"
    )]
    Aim,
    /// An object with a level gets no light.
    #[error(
        "object `{object}` of the scene has a level, but no pixel sees it in the projector's light; move it or drop its level"
    )]
    Dark {
        /// Name in the scene.
        object: String,
    },
}

/// What the scene truly is, per pixel, row-major.
#[derive(Debug, Clone)]
pub struct Truth {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// Projector column, pixel centres at integers; NaN where no light of the picture arrives.
    pub column: Vec<f32>,
    /// Projector row; NaN like `column`.
    pub row: Vec<f32>,
    /// z in the camera's frame in mm, also in shadow; NaN where nothing is seen.
    pub depth_mm: Vec<f32>,
    /// Number in `objects`, 255 where nothing is seen.
    pub object: Vec<u8>,
    /// Faces of the scene's objects.
    pub objects: Vec<TruthObject>,
}

/// A face of a scene's object.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TruthObject {
    /// Name in the scene; faces of a composite object have a suffix.
    pub name: String,
    /// Whether a plane can be fitted to it.
    pub planar: bool,
}

/// Range of automatic exposure, as factors of the exposure time that was applied.
const SHORTEST_AUTOMATIC: f64 = 0.1;
const LONGEST_AUTOMATIC: f64 = 4.0;

/// What camera, projector and rig share.
#[derive(Debug)]
pub(crate) struct Shared {
    pub(crate) description: RigDescription,
    pub(crate) clock: Arc<dyn Clock>,
    pub(crate) renderer: Renderer,
    pub(crate) script: Script,
    /// Factor that automatic exposure, where there is one, puts on the exposure time.
    automatic: Mutex<f64>,
    timeline: Mutex<Timeline>,
    /// Slides of the projector.
    loaded: Mutex<Vec<Arc<Slide>>>,
    /// Frames that were rendered before they were exposed.
    rehearsed: Mutex<Option<Rehearsal>>,
    /// Exposures since the rig was made.
    exposures: AtomicU64,
    /// Region of the latest applied settings.
    region: Mutex<Option<Region>>,
    camera_open: AtomicBool,
    projector_open: AtomicBool,
}

/// Which of the rig's devices.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Device {
    Camera,
    Projector,
}

impl Shared {
    pub(crate) fn timeline(&self) -> MutexGuard<'_, Timeline> {
        self.timeline.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The camera has been armed: the script begins.
    pub(crate) fn arm(&self) {
        self.timeline().arm(self.clock.now());
        *self.automatic.lock().unwrap_or_else(PoisonError::into_inner) = 1.0;
    }

    /// What automatic exposure makes of the exposure time now.
    pub(crate) fn automatic_factor(&self) -> f64 {
        *self.automatic.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets automatic exposure answer to a picture whose mean is `mean_share` of full scale.
    pub(crate) fn meter(&self, mean_share: f64) {
        let Some(automatic) = self.script.auto_exposure() else { return };
        let mut factor = self.automatic.lock().unwrap_or_else(PoisonError::into_inner);
        let error = (automatic.target / mean_share.max(1e-3)).clamp(0.1, 10.0);
        *factor = (*factor * error.powf(automatic.speed)).clamp(SHORTEST_AUTOMATIC, LONGEST_AUTOMATIC);
    }

    pub(crate) fn set_loaded(&self, slides: Vec<Arc<Slide>>) {
        *self.loaded.lock().unwrap_or_else(PoisonError::into_inner) = slides;
    }

    pub(crate) fn loaded(&self) -> Vec<Arc<Slide>> {
        self.loaded.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Frames that were rendered in advance.
    pub(crate) fn rehearsed(&self) -> MutexGuard<'_, Option<Rehearsal>> {
        self.rehearsed.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Number that the next exposure will have.
    pub(crate) fn coming_exposure(&self) -> u64 {
        self.exposures.load(Ordering::Relaxed)
    }

    /// Number of a new exposure.
    pub(crate) fn next_exposure(&self) -> u64 {
        self.exposures.fetch_add(1, Ordering::Relaxed)
    }

    pub(crate) fn set_region(&self, region: Region) {
        *self.region.lock().unwrap_or_else(PoisonError::into_inner) = Some(region);
    }

    fn flag(&self, device: Device) -> &AtomicBool {
        match device {
            Device::Camera => &self.camera_open,
            Device::Projector => &self.projector_open,
        }
    }

    /// Takes a device, which only one may have.
    pub(crate) fn take(
        self: &Arc<Self>,
        device: Device,
        serial: &str,
        asked: Option<&str>,
    ) -> Result<Taken, DeviceError> {
        if let Some(asked) = asked.filter(|asked| *asked != serial) {
            return Err(DeviceError::Unavailable {
                device: asked.to_owned(),
                detail: format!("the simulated rig has only {serial}; select that or nothing"),
            });
        }
        if self.flag(device).swap(true, Ordering::AcqRel) {
            return Err(DeviceError::Unavailable {
                device: serial.to_owned(),
                detail: "is open already; close it first".to_owned(),
            });
        }
        Ok(Taken { shared: self.clone(), device })
    }
}

/// A taken device; dropping gives it back.
#[derive(Debug)]
pub(crate) struct Taken {
    pub(crate) shared: Arc<Shared>,
    device: Device,
}

impl Drop for Taken {
    fn drop(&mut self) {
        self.shared.flag(self.device).store(false, Ordering::Release);
    }
}

/// A simulated rig. Its drivers and devices share its clock and its state.
#[derive(Debug, Clone)]
pub struct Rig {
    shared: Arc<Shared>,
}

impl Rig {
    /// Builds a rig around a scene. `clock` is the one that everything on the rig runs by, see
    /// [`super::Pacing::clock`].
    pub fn new(description: &RigDescription, scene: &Scene, clock: Arc<dyn Clock>) -> Result<Self, RigError> {
        let faults = description.validate();
        if !faults.is_empty() {
            return Err(RigError::Description(faults));
        }
        let script = Script::new(&description.faults);
        let faults = [scene.validate(), script.check_scene(scene)].concat();
        if !faults.is_empty() {
            return Err(RigError::Scene(faults));
        }
        let panel = Panel::new(&description.projector);
        let world = World::new(description, scene, &panel)?;
        let bumped =
            script.bump().map(|(_, bump)| world.bumped(description, scene, &panel, &bump)).transpose()?;
        let shared = Shared {
            description: description.clone(),
            clock,
            renderer: Renderer::new(description, world, bumped, panel, &script),
            script,
            automatic: Mutex::new(1.0),
            timeline: Mutex::new(Timeline::new(description)),
            loaded: Mutex::default(),
            rehearsed: Mutex::default(),
            exposures: AtomicU64::new(0),
            region: Mutex::default(),
            camera_open: AtomicBool::new(false),
            projector_open: AtomicBool::new(false),
        };
        Ok(Self { shared: Arc::new(shared) })
    }

    /// Driver of the rig's one camera.
    pub fn cameras(&self) -> SimCameras {
        SimCameras::new(self.shared.clone())
    }

    /// Driver of the rig's one projector.
    pub fn projectors(&self) -> SimProjectors {
        SimProjectors::new(self.shared.clone())
    }

    /// What the camera truly sees, cropped to the region that was applied last.
    pub fn truth(&self) -> Truth {
        self.truth_of(*self.shared.region.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// What the camera truly sees in a region (clipped to the sensor), `None` for the whole sensor.
    pub fn truth_of(&self, region: Option<Region>) -> Truth {
        let world = self.shared.renderer.world();
        let [sensor_width, sensor_height] = self.shared.description.camera.size;
        let whole = Region { x: 0, y: 0, width: sensor_width, height: sensor_height };
        let region = region.unwrap_or(whole);
        let end = |start: u32, size: u32, sensor: u32| start.saturating_add(size).min(sensor) as usize;
        let columns = region.x as usize..end(region.x, region.width, sensor_width);
        let rows = region.y as usize..end(region.y, region.height, sensor_height);
        let mut truth = Truth {
            width: columns.len(),
            height: rows.len(),
            column: Vec::new(),
            row: Vec::new(),
            depth_mm: Vec::new(),
            object: Vec::new(),
            objects: world
                .faces
                .iter()
                .map(|(name, planar)| TruthObject { name: name.clone(), planar: *planar })
                .collect(),
        };
        for y in rows {
            let start = (y + world.border) * world.width + world.border;
            for sight in &world.sights[start + columns.start..start + columns.end.max(columns.start)] {
                truth.column.push(sight.at[0]);
                truth.row.push(sight.at[1]);
                truth.depth_mm.push(sight.depth_mm);
                truth.object.push(sight.face);
            }
        }
        truth
    }
}
