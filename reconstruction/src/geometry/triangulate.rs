//! From a camera pixel and its projector coordinate to a depth.
//!
//! A point on the camera ray `d = (X, Y, 1)` with inverse depth `w = 1 / z` lies in the projector's frame along
//! `q + w t`, where `q = R d`. Its projector pixel is therefore a nearly linear function of `w`, and Newton's method
//! on `w`, with the lens distortion inside, reaches the last bit in two or three steps. Columns and rows are two
//! measurements of the same `w`; they are weighed by their information where the rows carry any.

mod lanes;

use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

pub(crate) use lanes::{LANES, Lane, Measurements, Solutions};

use super::{Calibration, Lens, RayTable};

/// Standard deviation of an integer code without sub-pixel: `1 / sqrt(12)`.
const INTEGER_SIGMA: f64 = 0.288_675_134_594_812_9;
/// Rows are weighed in when one column of error moves the predicted row by at least this much. Below it they add
/// under 1 % of information and only bring the systematic error of the row calibration.
const MIN_ROWS_PER_COLUMN: f64 = 0.1;
/// No camera measures a projector coordinate better than this, in px.
const MIN_SIGMA: f64 = 1e-6;
/// Beyond a thousand kilometres a point is at infinity.
const MIN_INVERSE_DEPTH: f64 = 1e-9;
/// Newton steps; each roughly squares the error.
const MAX_STEPS: usize = 12;
/// A relative step below this leaves an error of about its square times the curvature, under 1e-10.
const STEP_TOLERANCE: f64 = 1e-5;

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
    /// Where the projector's lens has the point: column and row in projector px.
    pub projector_px: [f64; 2],
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
        let sigma = |s: f64| if s.is_finite() && s > 0.0 { s.max(MIN_SIGMA) } else { INTEGER_SIGMA };
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
        if !(w > MIN_INVERSE_DEPTH && information > 0.0) || q.z + w * self.translation_mm.z <= 0.0 {
            return None;
        }
        let z = 1.0 / w;
        let [du, dv] = seen.slope;
        let norm = (du * du + dv * dv).sqrt();
        let (mut row_error_px, mut row_error_sigma_px) = (f64::NAN, f64::NAN);
        if both {
            let missed = [pixel[0] - seen.pixel[0], pixel[1] - seen.pixel[1]];
            let (along, across) = (du * sigmas[1], dv * sigmas[0]);
            row_error_px = du.signum() * (du * missed[1] - dv * missed[0]) / norm;
            row_error_sigma_px = (along * along + across * across).sqrt() / norm;
        }
        Some(Solution {
            point_mm: [dx * z, dy * z, z],
            sigma_z_mm: z * z / information.sqrt(),
            projector_px: seen.pixel,
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
            if step.abs() <= STEP_TOLERANCE * w.abs() {
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
            if step.abs() <= STEP_TOLERANCE * w.abs() {
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::geometry::{
        Projector,
        fixtures::{looking_at, rig, two_axis_rig},
    };

    /// Projector pixel of a camera-frame point, by the slow way round.
    fn truth(calibration: &Calibration, point: &Vector3<f64>) -> [f64; 2] {
        let projector = calibration.projector.unwrap();
        projector.lens.project(&projector.projector_from_camera.transform(point)).unwrap()
    }

    /// Depth at which the ray's projection crosses `column`, by bisection on [`Lens::project`] alone.
    fn bisect(calibration: &Calibration, ray: Vector3<f64>, column: f64) -> f64 {
        let miss = |z: f64| truth(calibration, &(ray * z))[0] - column;
        let (mut near, mut far) = (300.0, 3000.0);
        assert!(miss(near) * miss(far) < 0.0, "the column is crossed between the ends");
        for _ in 0..200 {
            let middle = 0.5 * (near + far);
            if miss(near) * miss(middle) <= 0.0 { far = middle } else { near = middle }
        }
        0.5 * (near + far)
    }

    fn exact(pixel: [f64; 2]) -> Measurement {
        Measurement { column: pixel[0], sigma_column: 0.05, row: f64::NAN, sigma_row: f64::NAN }
    }

    #[test]
    fn agrees_with_bisection_on_the_full_model() {
        for calibration in [rig(8.0), two_axis_rig(8.0)] {
            let triangulator = Triangulator::new(&calibration).unwrap();
            for (x, y) in [(0, 0), (199, 149), (100, 75), (30, 120), (170, 5)] {
                let ray = calibration.camera.ray([x as f64, y as f64]).unwrap();
                for column in
                    [truth(&calibration, &(ray * 800.0))[0], truth(&calibration, &(ray * 1234.5))[0]]
                {
                    let solved = triangulator.solve(x, y, &exact([column, f64::NAN])).unwrap();
                    let z = bisect(&calibration, ray, column);
                    assert!((solved.point_mm[2] - z).abs() < 1e-8 * z, "{} against {z}", solved.point_mm[2]);
                }
            }
        }
    }

    pub(super) fn any_rig() -> impl Strategy<Value = Calibration> {
        let baseline = (20.0..250.0f64, -3.1..3.1f64, -40.0..40.0f64);
        (baseline, -0.1..0.1f64, prop::array::uniform5(-1.0..1.0f64), 300.0..760.0f64).prop_map(
            |((length, angle, forward), roll, d, cy)| {
                let mut calibration = rig(16.0);
                let centre = Vector3::new(length * angle.cos(), length * angle.sin(), forward);
                let pose = looking_at(centre, Vector3::new(5.0, -8.0, 1000.0), roll);
                let scale = [0.1, 0.1, 2e-3, 2e-3, 0.02];
                let mut lens = calibration.projector.unwrap().lens;
                lens.cy = cy;
                lens.distortion = std::array::from_fn(|k| d[k] * scale[k]);
                calibration.projector = Some(Projector { lens, projector_from_camera: pose });
                calibration
            },
        )
    }

    proptest! {
        #[test]
        fn recovers_points_of_random_rigs(
            calibration in any_rig(), x in 0usize..100, y in 0usize..75, z in 500.0..2000.0f64,
            sigma_column in 0.01..1.0f64, sigma_row in 0.01..1.0f64,
        ) {
            let triangulator = Triangulator::new(&calibration).unwrap();
            let point = calibration.camera.ray([x as f64, y as f64]).unwrap() * z;
            let [column, row] = truth(&calibration, &point);
            let both = Measurement { column, sigma_column, row, sigma_row };
            let solved = triangulator.solve(x, y, &both).unwrap();
            // Where the rows are left out the column alone must carry the depth.
            prop_assume!(solved.rows_per_column.abs() < 1e3 || triangulator.rows_carry_depth());
            for k in 0..3 {
                prop_assert!((solved.point_mm[k] - point[k]).abs() < 1e-6, "{:?} {point:?}", solved.point_mm);
            }
            prop_assert!(solved.row_error_px.abs() < 1e-6, "{}", solved.row_error_px);
            // One axis alone knows less, and never knows it better.
            let column_only = Measurement { row: f64::NAN, ..both };
            if let Some(alone) = triangulator.solve(x, y, &column_only) {
                prop_assert!(alone.sigma_z_mm >= solved.sigma_z_mm * (1.0 - 1e-9));
                prop_assert!(alone.row_error_px.is_nan());
            }
        }

        #[test]
        fn sigma_z_is_the_derivative(calibration in any_rig(), x in 0usize..100, y in 0usize..75, z in 600.0..1500.0f64) {
            let triangulator = Triangulator::new(&calibration).unwrap();
            let ray = calibration.camera.ray([x as f64, y as f64]).unwrap();
            let (sigma, h) = (0.07, 0.05);
            let (a, b) = (truth(&calibration, &(ray * (z - h))), truth(&calibration, &(ray * (z + h))));
            let slope = [(b[0] - a[0]) / (2.0 * h), (b[1] - a[1]) / (2.0 * h)];
            prop_assume!(slope[0].abs() > 1e-3);
            let column = truth(&calibration, &(ray * z))[0];
            let one = Measurement { column, sigma_column: sigma, row: f64::NAN, sigma_row: f64::NAN };
            let solved = triangulator.solve(x, y, &one).unwrap();
            let expected = sigma / slope[0].abs();
            prop_assert!((solved.sigma_z_mm / expected - 1.0).abs() < 1e-4, "{} {expected}", solved.sigma_z_mm);
            prop_assert!((solved.rows_per_column - slope[1] / slope[0]).abs() < 1e-4 * (1.0 + (slope[1] / slope[0]).abs()));
        }

        #[test]
        fn no_measurement_panics(
            column in any::<f64>(), row in any::<f64>(), sigma_column in any::<f64>(), sigma_row in any::<f64>(),
        ) {
            let triangulator = Triangulator::new(&two_axis_rig(100.0)).unwrap();
            let solved = triangulator.solve(3, 4, &Measurement { column, sigma_column, row, sigma_row });
            if let Some(solved) = solved {
                prop_assert!(solved.point_mm.iter().all(|v| v.is_finite()) && solved.sigma_z_mm > 0.0);
            }
        }
    }

    /// The weighed depth is the least-squares one: a brute-force scan of the cost finds no better.
    #[test]
    fn weighs_rows_by_information() {
        let calibration = two_axis_rig(8.0);
        let triangulator = Triangulator::new(&calibration).unwrap();
        assert!(triangulator.rows_carry_depth() && triangulator.rows_per_column() > 0.5);
        let ray = calibration.camera.ray([60.0, 40.0]).unwrap();
        let [u, v] = truth(&calibration, &(ray * 1000.0));
        let (sigma_column, sigma_row) = (0.3, 0.1);
        let measured = Measurement { column: u + 0.4, sigma_column, row: v - 0.1, sigma_row };
        let solved = triangulator.solve(60, 40, &measured).unwrap();
        let cost = |z: f64| {
            let at = truth(&calibration, &(ray * z));
            ((at[0] - measured.column) / sigma_column).powi(2) + ((at[1] - measured.row) / sigma_row).powi(2)
        };
        let best =
            (0..400_000).map(|i| 980.0 + f64::from(i) * 1e-4).min_by(|a, b| cost(*a).total_cmp(&cost(*b)));
        assert!((solved.point_mm[2] - best.unwrap()).abs() < 1e-3, "{} {best:?}", solved.point_mm[2]);
    }

    #[test]
    fn rows_are_fixed_by_the_pixel_on_a_horizontal_baseline() {
        let triangulator = Triangulator::new(&rig(8.0)).unwrap();
        assert!(!triangulator.rows_carry_depth());
        // 64 columns of error move the predicted row by under 0.6 px.
        assert!(triangulator.rows_per_column() * 64.0 < 0.6, "{}", triangulator.rows_per_column());
        let [u, v] = truth(&rig(8.0), &(rig(8.0).camera.ray([90.0, 70.0]).unwrap() * 990.0));
        let measured = Measurement { column: u, sigma_column: 0.05, row: v + 3.0, sigma_row: 0.05 };
        let solved = triangulator.solve(90, 70, &measured).unwrap();
        assert!((solved.point_mm[2] - 990.0).abs() < 1e-6, "a wrong row does not touch the depth");
        assert!(
            (solved.row_error_px - 3.0).abs() < 0.01,
            "measured minus predicted row: {}",
            solved.row_error_px
        );
    }

    #[test]
    fn refuses_what_cannot_triangulate() {
        let alone = Calibration { projector: None, ..rig(8.0) };
        assert_eq!(Triangulator::new(&alone).unwrap_err(), TriangulateError::NoProjector);
        let mut bad = rig(8.0);
        bad.camera.fx = f64::NAN;
        assert!(Triangulator::new(&bad).unwrap_err().to_string().contains("fx is NaN"));
    }
}
