//! What a simulated rig knows of its own scene, pixel by pixel. Absent for every other rig.

use serde::{Deserialize, Serialize};

use crate::grid::Grid;

/// Truth of one camera view. NaN where the pixel sees nothing or no projector light reaches it.
#[derive(Debug, Clone)]
pub struct Truth {
    /// Projector column, pixel centres at integers.
    pub column: Grid<f32>,
    /// Projector row.
    pub row: Grid<f32>,
    /// z in the camera frame in mm; present also in shadow.
    pub depth_mm: Grid<f32>,
    /// Index into `objects`, 255 where there is none.
    pub object: Grid<u8>,
    /// Objects of the scene.
    pub objects: Vec<TruthObject>,
}

/// One object of a simulated scene.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct TruthObject {
    /// Name in the scene file.
    pub name: String,
    /// Whether a plane can be fitted to it.
    pub planar: bool,
}
