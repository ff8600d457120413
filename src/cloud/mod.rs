//! From projector coordinates to points.

use crate::grid::Grid;

/// What limits a point besides noise; bits of the PLY property `flags`.
pub mod flag {
    /// On a stripe edge.
    pub const EDGE: u8 = 1 << 0;
    /// One frame of a pair was saturated.
    pub const HALF_SATURATED: u8 = 1 << 1;
    /// Polarity exchanged.
    pub const INVERTED: u8 = 1 << 2;
    /// Interpolated between edges.
    pub const INTERPOLATED: u8 = 1 << 3;
    /// Near a silhouette.
    pub const SILHOUETTE: u8 = 1 << 4;
}

/// Points in the order of the camera's pixels. NaN where there is none.
#[derive(Debug, Clone)]
pub struct Cloud {
    /// Point in mm, in the camera frame.
    pub point_mm: Grid<[f32; 3]>,
    /// Unit normal towards the camera; 0 0 0 where there is no normal.
    pub normal: Grid<[f32; 3]>,
    /// Standard deviation of z in mm.
    pub sigma_z_mm: Grid<f32>,
    /// Bits of [`flag`].
    pub flags: Grid<u8>,
}
