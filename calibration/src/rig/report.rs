//! What a calibration says of itself, and why one is refused.

use nalgebra::{DMatrix, Matrix6};
use polscan_reconstruction::geometry::{Calibration, Pose};
use serde::Serialize;
use thiserror::Error;

use super::{coverage::Coverage, setup::Setup};

/// An accepted calibration.
#[derive(Debug, Clone)]
pub struct Calibrated {
    /// Camera alone, or camera and projector. Its date is for the caller to fill in.
    pub calibration: Calibration,
    /// `camera_from_board` of every view, in the order of the views.
    pub boards: Vec<Pose>,
    /// Covariance of each board's pose in the camera frame: a small turn on top of it in rad, then its shift in mm.
    pub board_covariances: Vec<Matrix6<f64>>,
    /// Covariance of [`Report::parameters`], in their order and units.
    pub covariance: DMatrix<f64>,
    /// How good it is, and by what it was judged.
    pub report: Report,
}

/// How good a calibration is.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// By what it was made and judged.
    pub setup: Setup,
    /// Reprojection rms of the corners, in px: root of the mean squared distance.
    pub camera_rms_px: f64,
    /// The same of the plane points in projector px.
    pub projector_rms_px: Option<f64>,
    /// Noise of corners along each axis in px: as given, or found.
    pub sigma_camera_px: f64,
    /// Noise of projector coordinates along each axis in px: as given, or found.
    pub sigma_projector_px: Option<f64>,
    /// Sum of squared residuals in sigma over the degrees of freedom: 1 when given sigmas are right; 1 by
    /// construction where they were found.
    pub chi_square: f64,
    /// Observations less parameters.
    pub degrees_of_freedom: usize,
    /// Shared parameters with their standard deviations.
    pub parameters: Vec<Parameter>,
    /// Pairs of parameters that the views hardly tell apart: correlated beyond 0.95.
    pub correlations: Vec<Correlation>,
    /// Every view, in order.
    pub views: Vec<ViewReport>,
    /// Which parts of the images the views fill.
    pub coverage: Coverage,
    /// Range of the boards' tilts over all views about the image's x and y axis, in degrees.
    pub tilt_range_deg: [f64; 2],
    /// Every check with its value and limit.
    pub checks: Vec<Check>,
}

/// One parameter.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Parameter {
    /// Such as `camera.fx` or `rig.shift_x`.
    pub name: String,
    /// Its unit: `px`, `1`, `rad` or `mm`.
    pub unit: &'static str,
    /// Value; a turn is given as the rotation vector of `projector_from_camera`.
    pub value: f64,
    /// Standard deviation; of a turn: of a small turn on top of it.
    pub sigma: f64,
}

/// Two parameters that move together.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Correlation {
    /// One.
    pub first: String,
    /// The other.
    pub second: String,
    /// -1 to 1.
    pub coefficient: f64,
}

/// One view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewReport {
    /// As the user calls it.
    pub name: String,
    /// Corners that took part.
    pub corners: usize,
    /// Plane points that took part.
    pub plane_points: usize,
    /// Corners and plane points left out as plainly wrong.
    pub left_out: [usize; 2],
    /// Reprojection rms of its corners in px.
    pub camera_rms_px: f64,
    /// Reprojection rms of its plane points in projector px.
    pub projector_rms_px: Option<f64>,
    /// How well the others' calibration explains it. `None` where too few others are there.
    pub held_out: Option<HeldOut>,
    /// How much neighbouring residuals agree: 0 for noise, towards 1 for what bends or moves the view as a whole.
    pub smoothness: f64,
    /// Tilt of the board about the image's x and y axis in degrees; 0 facing the camera.
    pub tilt_deg: [f64; 2],
    /// Depth of the board's middle in mm.
    pub distance_mm: f64,
    /// How flat its triangulated points are.
    pub flatness: Option<Flatness>,
}

/// A view as the calibration without it sees it: only its pose was adjusted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HeldOut {
    /// Of its corners in px.
    pub camera_rms_px: f64,
    /// Of its plane points in projector px.
    pub projector_rms_px: Option<f64>,
}

/// A board's triangulated points against a plane.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Flatness {
    /// Points.
    pub points: usize,
    /// Rms distance from the plane in mm, noise included.
    pub rms_mm: f64,
    /// What the noise alone makes of it, in mm.
    pub expected_rms_mm: f64,
    /// Bend, peak to peak, free of noise, in mm.
    pub bow_mm: f64,
}

/// One check.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Check {
    /// What was checked.
    pub name: &'static str,
    /// Worst value found; `None` where it could not be computed.
    pub value: Option<f64>,
    /// Limit.
    pub limit: f64,
    /// View that the value is of.
    pub view: Option<String>,
    /// Whether the limit is kept.
    pub passed: bool,
}

/// One reason to refuse.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Refusal {
    /// Stable name.
    #[serde(rename = "type")]
    pub slug: &'static str,
    /// What is wrong, with numbers, and what to do.
    pub message: String,
    /// View to drop or take again, where one is the cause.
    pub view: Option<String>,
    /// The value that failed.
    pub value: Option<f64>,
    /// What it failed against.
    pub limit: Option<f64>,
}

impl Refusal {
    pub(super) fn new(slug: &'static str, message: String) -> Self {
        Self { slug, message, view: None, value: None, limit: None }
    }

    pub(super) fn of(mut self, view: &str) -> Self {
        self.view = Some(view.to_owned());
        self
    }

    pub(super) fn against(mut self, value: f64, limit: f64) -> Self {
        self.value = value.is_finite().then_some(value);
        self.limit = Some(limit);
        self
    }
}

/// A calibration that is not accepted: there is none.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("cannot accept this calibration: {}", messages(refusals))]
pub struct Refused {
    /// Why, the likeliest cause first. Never empty.
    pub refusals: Vec<Refusal>,
    /// What was found, where the adjustment came to rest.
    pub report: Option<Box<Report>>,
}

fn messages(refusals: &[Refusal]) -> String {
    refusals.iter().map(|r| r.message.as_str()).collect::<Vec<_>>().join("; ")
}
