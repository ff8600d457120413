//! What one picture of a calibration board says: the seam between finding boards and solving for optics.

use serde::{Deserialize, Serialize};

/// A marked point of the board, found in the image.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Corner {
    /// Number of the point on the board; the same in every view.
    pub id: u32,
    /// Where it is on the board, in mm; the board is the plane z = 0.
    pub board_mm: [f64; 2],
    /// Where the camera sees it, in px; pixel centres at integers.
    pub camera_px: [f64; 2],
}

/// A camera pixel on the plane of the board, decoded: where on the board it lies is not known.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PlanePoint {
    /// Camera pixel, in px.
    pub camera_px: [f64; 2],
    /// Projector position that lights it, in px.
    pub projector_px: [f64; 2],
}

/// One view of the board.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct View {
    /// What the user calls it; messages name it.
    pub name: String,
    /// Marked points.
    pub corners: Vec<Corner>,
    /// Decoded points of the same plane; empty where only the camera is calibrated.
    pub plane_points: Vec<PlanePoint>,
}
