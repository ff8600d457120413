//! From projector coordinates to points.

use crate::{decode::Class, grid::Grid};

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

/// How well rows agree with what columns and calibration predict.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowCheck {
    /// Median of measured minus predicted row, in projector px.
    pub median_px: f64,
    /// 1.4826 times the median absolute deviation of the same, in projector px.
    pub sigma_px: f64,
    /// Gate that was applied, in projector px.
    pub gate_px: f64,
    /// Share of the otherwise valid pixels that the gate rejected.
    pub rejected_share: f64,
    /// How far the predicted row moves per column of error, in px/px (median): the power of the gate on columns.
    pub rows_per_column: f64,
}

/// What a calibrated reconstruction makes of a decode.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// Points.
    pub cloud: Cloud,
    /// Class after the gates of volume and row as well.
    pub class: Grid<Class>,
    /// Agreement of rows, where rows were coded.
    pub row_check: Option<RowCheck>,
}
