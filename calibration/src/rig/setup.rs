//! What is to be calibrated, what is known beforehand, and when the result is good enough.

use serde::{Deserialize, Serialize};

/// What is known of one lens beforehand.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LensSetup {
    /// (width, height) in px.
    pub size: (u32, u32),
    /// Also finds k3. Only for wide lenses seen to their corners: on a narrow field it runs away.
    #[serde(default)]
    pub k3: bool,
    /// Where the principal point is expected, such as the data sheet's lens shift says.
    #[serde(default)]
    pub principal: Option<PrincipalPrior>,
}

/// An expected principal point.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PrincipalPrior {
    /// Column and row in px.
    pub at_px: [f64; 2],
    /// Standard deviation of the expectation along each axis, in px. Weak: a tenth of the image, say.
    pub sigma_px: f64,
}

/// What is calibrated from which knowledge.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setup {
    /// Camera.
    pub camera: LensSetup,
    /// Projector. Without it the camera is calibrated alone, from corners.
    pub projector: Option<LensSetup>,
    /// Standard deviation of a corner along each axis, in px. Found from the residuals where it is not given.
    #[serde(default)]
    pub sigma_camera_px: Option<f64>,
    /// Standard deviation of a decoded projector coordinate, in px. Found from the residuals where it is not given.
    #[serde(default)]
    pub sigma_projector_px: Option<f64>,
    /// At most this many plane points of a view take part, spread evenly.
    pub plane_points_per_view: usize,
    /// Residuals longer than this many sigma count with their length instead of its square (Huber).
    pub huber_sigmas: f64,
    /// Distance between camera and projector in mm, as measured with a ruler: shows a board of another size.
    #[serde(default)]
    pub baseline_mm: Option<f64>,
    /// Nearest and farthest place of a board from the camera in mm: shows a board of another size.
    #[serde(default)]
    pub distance_mm: Option<[f64; 2]>,
    /// When the result is accepted.
    pub gates: Gates,
}

impl Setup {
    /// A camera alone.
    pub fn camera(size: (u32, u32)) -> Self {
        Self {
            camera: LensSetup { size, k3: false, principal: None },
            projector: None,
            sigma_camera_px: None,
            sigma_projector_px: None,
            plane_points_per_view: 2000,
            huber_sigmas: 3.0,
            baseline_mm: None,
            distance_mm: None,
            gates: Gates::default(),
        }
    }

    /// Camera and projector, by (width, height) in px.
    pub fn rig(camera: (u32, u32), projector: (u32, u32)) -> Self {
        let projector = Some(LensSetup { size: projector, k3: false, principal: None });
        Self { projector, ..Self::camera(camera) }
    }
}

/// Limits that nothing can reach are written so.
const MOST_OF_A_LIMIT: f64 = 1e6;

/// Limits that a calibration must keep to be accepted.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Gates {
    /// Fewest views; never below 3.
    pub min_views: usize,
    /// Fewest corners of a view.
    pub min_corners: usize,
    /// Largest reprojection rms of the camera in px.
    pub camera_rms_px: f64,
    /// Largest reprojection rms of the projector in px.
    pub projector_rms_px: f64,
    /// Largest rms, in camera or projector px, of a view that the calibration was made without.
    pub held_out_px: f64,
    /// A view is an outlier when it is this many times worse than the median view, held out and in the fit.
    pub outlier_ratio: f64,
    /// Largest share of grossly wrong corners or plane points of a view that are left out.
    pub outlier_share: f64,
    /// Largest bend of a board, peak to peak, as a share of its distance.
    pub bow_share: f64,
    /// Least range of tilts about each image axis, in degrees.
    pub tilt_range_deg: f64,
    /// Views whose normals all lie within this many degrees are parallel.
    pub parallel_deg: f64,
    /// Of the four quarters of the camera's image, so many must hold corners, and plane points where there are any.
    pub quarters: usize,
    /// Least share of a board's corners that have plane points about them.
    pub lit_share: f64,
    /// Largest standard deviation of a focal length, as a share of it.
    pub focal_sigma_share: f64,
    /// Largest |fx / fy - 1| of camera and projector.
    pub aspect_share: f64,
    /// Largest distance of the camera's principal point from the middle of the image, as a share of its larger side.
    pub principal_share: f64,
    /// Largest deviation of the baseline from the one that is known, as a share of it.
    pub baseline_share: f64,
}

impl Gates {
    /// What makes them no limits: values that no calibration could keep, or that would bar nothing. `most_views`: views
    /// that can be taken.
    pub fn faults(&self, most_views: usize) -> Vec<String> {
        let counts = [
            ("min_views", self.min_views, 1..=most_views),
            ("min_corners", self.min_corners, 4..=10_000),
            ("quarters", self.quarters, 0..=4),
        ];
        let counts = counts.into_iter().filter(|(_, value, range)| !range.contains(value)).map(
            |(name, value, range)| {
                format!("{name} is {value}, expected {} to {}", range.start(), range.end())
            },
        );
        let limits = [
            ("camera_rms_px", self.camera_rms_px),
            ("projector_rms_px", self.projector_rms_px),
            ("held_out_px", self.held_out_px),
            ("outlier_ratio", self.outlier_ratio),
            ("outlier_share", self.outlier_share),
            ("bow_share", self.bow_share),
            ("tilt_range_deg", self.tilt_range_deg),
            ("parallel_deg", self.parallel_deg),
            ("lit_share", self.lit_share),
            ("focal_sigma_share", self.focal_sigma_share),
            ("aspect_share", self.aspect_share),
            ("principal_share", self.principal_share),
            ("baseline_share", self.baseline_share),
        ];
        let limits = limits
            .into_iter()
            .filter(|(_, value)| !(0.0..=MOST_OF_A_LIMIT).contains(value))
            .map(|(name, value)| format!("{name} is {value}, expected 0 to {MOST_OF_A_LIMIT}"));
        counts.chain(limits).collect()
    }
}

impl Default for Gates {
    fn default() -> Self {
        Self {
            min_views: 5,
            min_corners: 8,
            camera_rms_px: 0.3,
            projector_rms_px: 0.5,
            held_out_px: 0.5,
            outlier_ratio: 2.5,
            outlier_share: 0.05,
            bow_share: 1e-3,
            tilt_range_deg: 10.0,
            parallel_deg: 4.0,
            quarters: 4,
            lit_share: 0.7,
            focal_sigma_share: 0.01,
            aspect_share: 0.02,
            principal_share: 0.15,
            baseline_share: 0.1,
        }
    }
}
