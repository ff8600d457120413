//! The points of a scan with the camera pixels they belong to.

use nalgebra::{Matrix3, Quaternion, Rotation3, UnitQuaternion, Vector3};

use crate::{cloud::PlyPoint, geometry::Pose, grid::Grid};

/// What files say of where they come from.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Origin {
    /// Identity of the scan; that of its manifest for a foreign one.
    pub id: String,
    /// Name given by a person.
    pub label: Option<String>,
    /// When, RFC 3339, UTC.
    pub created: Option<String>,
    /// Program and version that decoded it.
    pub software: Option<String>,
    /// Maker and model of the camera.
    pub camera_model: Option<String>,
    /// Serial number of the camera.
    pub camera_serial: Option<String>,
}

/// The measured points in row-major order of their camera pixels.
#[derive(Debug, Clone)]
pub struct Organised {
    /// Columns of the camera.
    pub width: usize,
    /// Rows of the camera.
    pub height: usize,
    /// Row-major index of the camera pixel of each point, ascending.
    pub pixels: Vec<usize>,
    /// The points in mm, in the world frame where there is one, else in the camera frame.
    pub points: Vec<PlyPoint>,
    /// Where the camera is; `None` where the points are in its own frame.
    pub world_from_camera: Option<Pose>,
}

impl Organised {
    /// Gives each point the next pixel of `mask`. The error is a sentence that follows the cloud's name.
    pub fn new(
        mask: &Grid<bool>,
        points: Vec<PlyPoint>,
        world_from_camera: Option<Pose>,
    ) -> Result<Self, String> {
        let pixels: Vec<usize> =
            mask.data().iter().enumerate().filter(|(_, set)| **set).map(|(index, _)| index).collect();
        if pixels.len() != points.len() {
            return Err(format!("has {} points, the maps beside it {}", points.len(), pixels.len()));
        }
        Ok(Self { width: mask.width(), height: mask.height(), pixels, points, world_from_camera })
    }

    /// Points (mm) and normals in the camera frame.
    pub fn in_camera(&self) -> impl Iterator<Item = ([f64; 3], [f64; 3])> {
        let camera_from_cloud = self.world_from_camera.as_ref().map(Pose::inverse);
        let turned = move |point: &PlyPoint| {
            let (at, normal) = (point.point_mm.map(f64::from), point.normal.map(f64::from));
            match &camera_from_cloud {
                None => (at, normal),
                Some(pose) => {
                    (pose.transform(&at.into()).into(), (pose.rotation * Vector3::from(normal)).into())
                }
            }
        };
        self.points.iter().map(turned)
    }

    /// Position (mm) and orientation of the camera in the frame of the points, the quaternion's scalar first and not
    /// negative.
    pub fn viewpoint(&self) -> ([f64; 3], [f64; 4]) {
        let camera = Pose { rotation: Matrix3::identity(), translation_mm: Vector3::zeros() };
        let pose = self.world_from_camera.unwrap_or(camera);
        let turn = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(pose.rotation));
        let Quaternion { coords } = turn.into_inner();
        let sign = if coords.w < 0.0 { -1.0 } else { 1.0 };
        let scalar_first = [coords.w, coords.x, coords.y, coords.z].map(|value| sign * value + 0.0);
        (pose.translation_mm.into(), scalar_first)
    }
}

/// Text of somebody else's for a place where a line break or a control character would end it.
pub(super) fn one_line(text: &str) -> String {
    text.chars().map(|letter| if letter.is_control() { ' ' } else { letter }).collect()
}
