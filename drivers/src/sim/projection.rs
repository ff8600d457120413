//! Where the rig's camera and projector see a point, for whoever wants to compare with an idea of their own.

use super::{
    description::RigDescription,
    optics::{Pinhole, Placement},
    rig::RigError,
    world::{camera_lens, placement, projector_lens},
};

/// Lenses and pose of a simulated rig: the very ones that its frames are rendered with.
#[derive(Debug, Clone)]
pub struct Projection {
    camera: Pinhole,
    projector: Pinhole,
    placement: Placement,
}

impl Projection {
    /// Of a rig as described, before anything of its faults happens.
    ///
    /// # Errors
    /// If no pose of the projector fits the description.
    pub fn new(description: &RigDescription) -> Result<Self, RigError> {
        let (camera, projector) = (camera_lens(description), projector_lens(description));
        Ok(Self { camera, projector, placement: placement(description)? })
    }

    /// Pixel at which the camera sees a point, in mm in the camera's frame; `None` behind it or where its lens folds
    /// over. Pixel centres at integers, origin the whole sensor's; the pixel may lie outside of it.
    pub fn camera_pixel(&self, point_mm: [f64; 3]) -> Option<[f64; 2]> {
        self.camera.project(point_mm.into())
    }

    /// Pixel of the projector whose light meets a point, in mm in the camera's frame; otherwise like
    /// [`Self::camera_pixel`].
    pub fn projector_pixel(&self, point_mm: [f64; 3]) -> Option<[f64; 2]> {
        self.projector.project(self.placement.transform(point_mm.into()))
    }
}
