//! From projector coordinates to points.

mod normals;
mod plane;
mod ply;
mod reconstruct;
mod surface;

pub use plane::{PlaneError, PlaneFit, fit_plane};
pub use ply::{CloudFrame, PlyError, PlyPoint, SampleError, read_ply, sample_ply, write_ply};
pub use reconstruct::{
    DEFAULT_ROW_GATE_PX, ReconstructError, ReconstructSettings, reconstruct, reconstruct_with,
};

use nalgebra::Vector3;

use crate::{decode::Class, geometry::Pose, grid::Grid};

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

impl Cloud {
    /// Number of points.
    pub fn points(&self) -> usize {
        self.point_mm.data().iter().filter(|p| p[2].is_finite()).count()
    }

    /// The same points and normals in another frame, such as the world's by `world_from_camera`. `sigma_z_mm` stays
    /// along the camera's axis: it is what the measurement knows.
    pub fn transformed(&self, pose: &Pose) -> Self {
        let apply = |v: [f32; 3], offset: Vector3<f64>| {
            let v = Vector3::new(f64::from(v[0]), f64::from(v[1]), f64::from(v[2]));
            let out = pose.rotation * v + offset;
            [out.x as f32, out.y as f32, out.z as f32]
        };
        Self {
            point_mm: self.point_mm.map(|&p| apply(p, pose.translation_mm)),
            normal: self.normal.map(|&n| apply(n, Vector3::zeros())),
            sigma_z_mm: self.sigma_z_mm.clone(),
            flags: self.flags.clone(),
        }
    }
}

/// How well rows agree with what columns and calibration predict.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowCheck {
    /// Median of measured minus predicted row, in projector px. Where the baseline is not horizontal this is the
    /// signed distance of the measured projector pixel from the camera pixel's epipolar line.
    pub median_px: f64,
    /// 1.4826 times the median absolute deviation of the same, in projector px.
    pub sigma_px: f64,
    /// Gate that was applied, in projector px; a pixel with larger noise is allowed three sigma of it.
    pub gate_px: f64,
    /// Share of the otherwise valid pixels that the gate rejected.
    pub rejected_share: f64,
    /// How far the predicted row moves per column of error, in px/px (median, unsigned): the power of the gate on
    /// columns. From 0.1 on, rows are weighed into the depth.
    pub rows_per_column: f64,
}

/// What a calibrated reconstruction makes of a decode.
#[derive(Debug, Clone)]
pub struct Reconstruction {
    /// Points.
    pub cloud: Cloud,
    /// Class after the gates of volume and row as well.
    pub class: Grid<Class>,
    /// Projector row that column and calibration predict, in px, where rows were not coded; NaN where there is no point.
    pub predicted_row: Option<Grid<f32>>,
    /// Agreement of rows, where rows were coded.
    pub row_check: Option<RowCheck>,
}
