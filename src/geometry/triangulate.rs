//! From a camera pixel and its projector coordinate to a depth.
//!
//! A point on the camera ray `d = (X, Y, 1)` with inverse depth `w = 1 / z` lies in the projector's frame along
//! `q + w t`, where `q = R d`. Its projector pixel is therefore a nearly linear function of `w`, and Newton's method
//! on `w`, with the lens distortion inside, reaches the last bit in two or three steps. Columns and rows are two
//! measurements of the same `w`; they are weighed by their information where the rows carry any.

use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

use super::{Calibration, Lens, RayTable};

/// Standard deviation of an integer code without sub-pixel: `1 / sqrt(12)`.
const INTEGER_SIGMA: f64 = 0.288_675_134_594_812_9;
/// Rows are weighed in when one column of error moves the predicted row by at least this much. Below it they add
/// under 1 % of information and only bring the systematic error of the row calibration.
const MIN_ROWS_PER_COLUMN: f64 = 0.1;
/// Newton steps; each roughly squares the error.
const MAX_STEPS: usize = 12;

/// What the decoder measured at one pixel. NaN for an axis that was not measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// Projector column in px.
    pub column: f64,
    /// Its standard deviation in px; taken as 1/sqrt(12) unless positive and finite.
    pub sigma_column: f64,
    /// Projector row in px.
    pub row: f64,
    /// Its standard deviation in px; taken as 1/sqrt(12) unless positive and finite.
    pub sigma_row: f64,
}

/// Depth of one pixel, with what is needed to judge it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Solution {
    /// Point in the camera frame in mm.
    pub point_mm: [f64; 3],
    /// Standard deviation of z in mm.
    pub sigma_z_mm: f64,
    /// Signed distance of the measured projector pixel from the camera pixel's epipolar line, in projector px. With
    /// a horizontal baseline this is measured minus predicted row. NaN where one of the axes was not measured.
    pub row_error_px: f64,
    /// Standard deviation of `row_error_px`.
    pub row_error_sigma_px: f64,
    /// How far the predicted row moves per column: slope of the epipolar line.
    pub rows_per_column: f64,
}

/// A calibration prepared for triangulation; make it once and use it for all scans.
#[derive(Debug, Clone)]
pub struct Triangulator {
    rays: RayTable,
    projector: Lens,
    rotation: Matrix3<f64>,
    translation_mm: Vector3<f64>,
    rows_per_column: f64,
}

/// Why a calibration cannot triangulate.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum TriangulateError {
    /// The file held a camera alone.
    #[error(
        "cannot triangulate: the calibration has no projector; calibrate the rig, or give the stereo result"
    )]
    NoProjector,
    /// Numbers that cannot be used.
    #[error("cannot triangulate: {}", .0.join("; "))]
    Faults(Vec<String>),
}

/// Projector pixel at an inverse depth, and its derivative by it.
struct Seen {
    pixel: [f64; 2],
    slope: [f64; 2],
}

impl Triangulator {
    /// Undistorts all camera pixels and measures how much depth the rows of this rig carry.
    ///
    /// # Errors
    /// [`TriangulateError`] for a calibration without a projector or with [faults](Calibration::faults).
    pub fn new(calibration: &Calibration) -> Result<Self, TriangulateError> {
        let faults = calibration.faults();
        if !faults.is_empty() {
            return Err(TriangulateError::Faults(faults));
        }
        let projector = calibration.projector.ok_or(TriangulateError::NoProjector)?;
        let pose = projector.projector_from_camera;
        let mut this = Self {
            rays: RayTable::new(&calibration.camera),
            projector: projector.lens,
            rotation: pose.rotation,
            translation_mm: pose.translation_mm,
            rows_per_column: 0.0,
        };
        this.rows_per_column = this.median_slope();
        Ok(this)
    }

    /// Rays of the camera's pixels.
    pub fn rays(&self) -> &RayTable {
        &self.rays
    }

    /// (width, height) of the projector.
    pub fn projector_size(&self) -> (u32, u32) {
        self.projector.size()
    }

    /// Median over the camera's image of |rows per column|: the gate's power on columns, and how much depth rows carry.
    pub fn rows_per_column(&self) -> f64 {
        self.rows_per_column
    }

    /// Whether rows carry enough depth in this rig to be weighed in.
    pub fn rows_carry_depth(&self) -> bool {
        self.rows_per_column >= MIN_ROWS_PER_COLUMN
    }

    /// Depth of camera pixel (x, y). `None` where the measurement meets the camera ray nowhere in front of camera and
    /// projector, or where nothing was measured.
    pub fn solve(&self, x: usize, y: usize, measured: &Measurement) -> Option<Solution> {
        let [dx, dy] = self.rays.directions().at(x, y);
        let q = self.rotation * Vector3::new(dx, dy, 1.0);
        let sigma = |s: f64| if s.is_finite() && s > 0.0 { s } else { INTEGER_SIGMA };
        let sigmas = [sigma(measured.sigma_column), sigma(measured.sigma_row)];
        let pixel = [measured.column, measured.row];
        let gain = self.pinhole_gain(&q);
        let column_first = match (pixel[0].is_finite(), pixel[1].is_finite()) {
            (true, false) => true,
            (false, true) => false,
            // Without information in the rows the depth is the column plane's, whatever the sigmas say.
            (true, true) => {
                !self.rows_carry_depth() || (gain[0] / sigmas[0]).abs() >= (gain[1] / sigmas[1]).abs()
            }
            (false, false) => return None,
        };
        let both = pixel[0].is_finite() && pixel[1].is_finite();
        let axis = usize::from(!column_first);
        let (mut w, mut seen) = self.meet_plane(&q, axis, pixel[axis])?;
        let mut information = (seen.slope[axis] / sigmas[axis]).powi(2);
        if both && self.rows_carry_depth() {
            (w, seen, information) = self.weigh(&q, pixel, sigmas, w, seen)?;
        }
        if !(w > 0.0 && information > 0.0) || q.z + w * self.translation_mm.z <= 0.0 {
            return None;
        }
        let z = 1.0 / w;
        let [du, dv] = seen.slope;
        let norm = du.hypot(dv);
        let (mut row_error_px, mut row_error_sigma_px) = (f64::NAN, f64::NAN);
        if both {
            let missed = [pixel[0] - seen.pixel[0], pixel[1] - seen.pixel[1]];
            row_error_px = du.signum() * (du * missed[1] - dv * missed[0]) / norm;
            row_error_sigma_px = (du * sigmas[1]).hypot(dv * sigmas[0]) / norm;
        }
        Some(Solution {
            point_mm: [dx * z, dy * z, z],
            sigma_z_mm: z * z / information.sqrt(),
            row_error_px,
            row_error_sigma_px,
            rows_per_column: dv / du,
        })
    }

    /// Numerators of du/dw and dv/dw of the pinhole: `f (t x q)`; their ratio is the slope of the epipolar line.
    fn pinhole_gain(&self, q: &Vector3<f64>) -> [f64; 2] {
        let t = &self.translation_mm;
        [self.projector.fx * (t.x * q.z - q.x * t.z), self.projector.fy * (t.y * q.z - q.y * t.z)]
    }

    /// Projector pixel of the point at inverse depth `w`. `None` behind the projector.
    #[inline]
    fn see(&self, q: &Vector3<f64>, w: f64) -> Option<Seen> {
        let t = &self.translation_mm;
        let depth = q.z + w * t.z;
        if depth <= 0.0 || !depth.is_finite() {
            return None;
        }
        let inverse = 1.0 / depth;
        let (x, y) = ((q.x + w * t.x) * inverse, (q.y + w * t.y) * inverse);
        let (slope_x, slope_y) = ((t.x - x * t.z) * inverse, (t.y - y * t.z) * inverse);
        let (distorted_x, distorted_y, [xx, xy, yy]) = self.projector.distort_with_jacobian(x, y);
        Some(Seen {
            pixel: [
                self.projector.fx * distorted_x + self.projector.cx,
                self.projector.fy * distorted_y + self.projector.cy,
            ],
            slope: [
                self.projector.fx * (xx * slope_x + xy * slope_y),
                self.projector.fy * (xy * slope_x + yy * slope_y),
            ],
        })
    }

    /// Inverse depth at which the camera ray meets the surface of projector column (axis 0) or row (axis 1) `value`.
    fn meet_plane(&self, q: &Vector3<f64>, axis: usize, value: f64) -> Option<(f64, Seen)> {
        let t = &self.translation_mm;
        let (focal, centre) =
            [(self.projector.fx, self.projector.cx), (self.projector.fy, self.projector.cy)][axis];
        let plane = (value - centre) / focal;
        let mut w = (q[axis] - plane * q.z) / (plane * t.z - t[axis]);
        // The pinhole start may lie just behind the projector where the distorted answer does not.
        let mut seen = self.see(q, w).or_else(|| {
            w = 0.0;
            self.see(q, w)
        })?;
        for _ in 0..MAX_STEPS {
            let step = (value - seen.pixel[axis]) / seen.slope[axis];
            w += step;
            seen = self.see(q, w)?;
            if step.abs() <= 1e-7 * w.abs() {
                return Some((w, seen));
            }
        }
        None
    }

    /// Inverse depth that fits column and row best, each weighed by its sigma (Gauss-Newton), and its information.
    fn weigh(
        &self,
        q: &Vector3<f64>,
        pixel: [f64; 2],
        sigmas: [f64; 2],
        mut w: f64,
        mut seen: Seen,
    ) -> Option<(f64, Seen, f64)> {
        for _ in 0..MAX_STEPS {
            let (mut pull, mut information) = (0.0, 0.0);
            for axis in 0..2 {
                let weight = seen.slope[axis] / (sigmas[axis] * sigmas[axis]);
                pull += weight * (pixel[axis] - seen.pixel[axis]);
                information += weight * seen.slope[axis];
            }
            let step = pull / information;
            w += step;
            seen = self.see(q, w)?;
            if step.abs() <= 1e-7 * w.abs() {
                return Some((w, seen, information));
            }
        }
        None
    }

    fn median_slope(&self) -> f64 {
        let directions = self.rays.directions();
        let step = (directions.width().min(directions.height()) / 32).max(1);
        let mut slopes = Vec::new();
        for y in (0..directions.height()).step_by(step) {
            for x in (0..directions.width()).step_by(step) {
                let [dx, dy] = directions.at(x, y);
                let [du, dv] = self.pinhole_gain(&(self.rotation * Vector3::new(dx, dy, 1.0)));
                slopes.push((dv / du).abs());
            }
        }
        slopes.sort_by(f64::total_cmp);
        slopes[slopes.len() / 2]
    }
}
