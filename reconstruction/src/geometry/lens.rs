//! One pinhole with Brown-Conrady distortion: a camera, or a projector taken as its inverse.

use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Intrinsics of a camera or projector. Pixel centres lie at integers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Size in pixels.
    pub width: u32,
    /// Size in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point in pixels.
    pub cx: f64,
    /// Principal point in pixels.
    pub cy: f64,
    /// k1, k2, p1, p2, k3 in OpenCV's order and meaning.
    pub distortion: [f64; 5],
}

/// Largest size of an image side that is taken for real; bounds the ray table.
const MAX_SIDE: u32 = 32_768;
/// A longer lens sees less than 0.6 degrees, which no structured-light rig does: the sign of a diverged fit.
const MAX_FOCAL_SIDES: f64 = 100.0;
/// A shorter lens would see more than 157 degrees, where the pinhole model has no meaning.
const MIN_FOCAL_SIDES: f64 = 0.1;
/// Lens shift puts the principal point outside the image, but not by more than this many sides.
const PRINCIPAL_MARGIN: f64 = 0.5;
/// A small region in a corner of a sensor has it farther out, within the field of the lens: this many focal lengths.
const PRINCIPAL_FIELD: f64 = 0.7;
/// Pixels of diamond micro-mirrors have 1:2; anything far beyond is a swapped or diverged number.
const MAX_ASPECT: f64 = 2.5;
/// Newton steps of the inverse; a monotone lens needs fewer than ten.
const MAX_STEPS: usize = 50;
/// The inverse has converged when a step (normalised units) is below this; the result is then good to its square.
const STEP_TOLERANCE: f64 = 1e-12;

impl Lens {
    /// The same lens before a part of its image: the region of `size` (width, height) that begins at pixel `origin`.
    /// Brown's distortion is a matter of angles, so that it stays as it is.
    pub fn cropped(&self, origin: (u32, u32), size: (u32, u32)) -> Self {
        Self {
            width: size.0,
            height: size.1,
            cx: self.cx - f64::from(origin.0),
            cy: self.cy - f64::from(origin.1),
            ..*self
        }
    }

    /// (width, height) in pixels.
    pub fn size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// The camera matrix `[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`.
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, 0.0, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// Applies the distortion to normalised coordinates (`x/z`, `y/z`).
    ///
    /// Brown's model in OpenCV's form: with `r2 = x^2 + y^2`,
    /// `x' = x (1 + k1 r2 + k2 r2^2 + k3 r2^3) + 2 p1 x y + p2 (r2 + 2 x^2)`, and for y with p1 and p2 exchanged.
    pub fn distort(&self, normalized: [f64; 2]) -> [f64; 2] {
        let [x, y] = normalized;
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    }

    /// [`distort`](Self::distort) and its Jacobian as `(x', y', [dx'/dx, dx'/dy, dy'/dy])`; `dy'/dx = dx'/dy`.
    #[inline(always)]
    pub(crate) fn distort_with_jacobian(&self, x: f64, y: f64) -> (f64, f64, [f64; 3]) {
        let [k1, k2, p1, p2, k3] = self.distortion;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        // d(radial)/d(r2), twice: the chain rule brings d(r2)/dx = 2 x.
        let slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2));
        (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            [
                radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
                slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
                radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
            ],
        )
    }

    /// Inverse of [`distort`](Self::distort) by damped Newton steps, good to 1e-10 and better. `None` where it does
    /// not converge: beyond the radius at which the distortion folds back, or for numbers that are not finite.
    pub fn undistort(&self, distorted: [f64; 2]) -> Option<[f64; 2]> {
        if self.distortion == [0.0; 5] {
            return distorted.iter().all(|v| v.is_finite()).then_some(distorted);
        }
        let target = Vector2::from(distorted);
        let mut at = target;
        let residual = |at: Vector2<f64>| target - Vector2::from(self.distort([at.x, at.y]));
        let mut error = residual(at);
        for _ in 0..MAX_STEPS {
            let (_, _, [xx, xy, yy]) = self.distort_with_jacobian(at.x, at.y);
            let step = Matrix2::new(xx, xy, xy, yy).try_inverse()? * error;
            if !(step.x.is_finite() && step.y.is_finite()) {
                return None;
            }
            let (mut scale, mut next, mut next_error);
            scale = 1.0;
            loop {
                next = at + step * scale;
                next_error = residual(next);
                // Halving keeps the iteration on the branch that holds the image's centre.
                if next_error.norm_squared() <= error.norm_squared() || scale < 1e-6 {
                    break;
                }
                scale *= 0.5;
            }
            (at, error) = (next, next_error);
            if step.norm() <= STEP_TOLERANCE * (1.0 + at.norm()) {
                let (_, _, [xx, xy, yy]) = self.distort_with_jacobian(at.x, at.y);
                let on_branch = xx * yy - xy * xy > 0.0 && xx + yy > 0.0;
                return (error.norm() <= 1e-11 * (1.0 + target.norm()) && on_branch).then_some([at.x, at.y]);
            }
        }
        None
    }

    /// Pixel of a point in the lens's frame. `None` at or behind the lens.
    pub fn project(&self, point: &Vector3<f64>) -> Option<[f64; 2]> {
        if point.z <= 0.0 {
            return None;
        }
        let [x, y] = self.distort([point.x / point.z, point.y / point.z]);
        Some([self.fx * x + self.cx, self.fy * y + self.cy])
    }

    /// Direction `(x, y, 1)` that a pixel looks along. `None` where the distortion has no inverse.
    pub fn ray(&self, pixel: [f64; 2]) -> Option<Vector3<f64>> {
        let [x, y] = self.undistort([(pixel[0] - self.cx) / self.fx, (pixel[1] - self.cy) / self.fy])?;
        Some(Vector3::new(x, y, 1.0))
    }

    /// Everything that makes these numbers unusable, each naming the number and how it can be put right; `who` is
    /// "camera" or "projector". Empty for a usable lens.
    pub fn faults(&self, who: &str) -> Vec<String> {
        let mut faults = Vec::new();
        for (name, side) in [("width", self.width), ("height", self.height)] {
            if side == 0 || side > MAX_SIDE {
                faults.push(format!("{who} {name} is {side} px, expected 1 to {MAX_SIDE}"));
            }
        }
        let [k1, k2, p1, p2, k3] = self.distortion;
        let numbers = [
            ("fx", self.fx),
            ("fy", self.fy),
            ("cx", self.cx),
            ("cy", self.cy),
            ("k1", k1),
            ("k2", k2),
            ("p1", p1),
            ("p2", p2),
            ("k3", k3),
        ];
        for (name, value) in numbers.into_iter().filter(|(_, v)| !v.is_finite()) {
            faults.push(format!("{who} {name} is {value}, not a finite number"));
        }
        if !faults.is_empty() {
            return faults;
        }
        self.focal_faults(who, &mut faults);
        let axes = [("cx", self.cx, self.width, self.fx), ("cy", self.cy, self.height, self.fy)];
        for (name, value, side, focal) in axes {
            let middle = 0.5 * f64::from(side);
            let reach = ((0.5 + PRINCIPAL_MARGIN) * f64::from(side)).max(PRINCIPAL_FIELD * focal);
            let (low, high) = (middle - reach, middle + reach);
            if !(low..=high).contains(&value) {
                faults.push(format!(
                    "{who} {name} is {value:.1} px, implausible for {side} px (expected {low:.0} to {high:.0}): \
                     the size is of another image, or the calibration diverged"
                ));
            }
        }
        if faults.is_empty() {
            faults.extend(self.distortion_fault(who));
        }
        faults
    }

    fn focal_faults(&self, who: &str, faults: &mut Vec<String>) {
        let side = f64::from(self.width.max(self.height));
        for (name, value) in [("fx", self.fx), ("fy", self.fy)] {
            if value <= 0.0 {
                faults.push(format!("{who} {name} is {value} px, expected a positive focal length"));
            } else if value > MAX_FOCAL_SIDES * side || value < MIN_FOCAL_SIDES * side {
                let degrees = 2.0 * (0.5 * side / value).atan().to_degrees();
                faults.push(format!(
                    "{who} {name} is {value:.1} px, a field of view of {degrees:.2} degrees over {side:.0} px: \
                     the calibration diverged, repeat it with more tilted views"
                ));
            }
        }
        let aspect = self.fx / self.fy;
        if self.fx > 0.0 && self.fy > 0.0 && !(1.0 / MAX_ASPECT..=MAX_ASPECT).contains(&aspect) {
            faults.push(format!("{who} fx/fy is {aspect:.3}, expected {} to {MAX_ASPECT}", 1.0 / MAX_ASPECT));
        }
    }

    /// Whether the distortion has one inverse all over the image: the radial part must grow up to the farthest
    /// corner, and the whole model must invert along the border.
    fn distortion_fault(&self, who: &str) -> Option<String> {
        let [k1, k2, _, _, k3] = self.distortion;
        let (right, bottom) = (f64::from(self.width) - 0.5, f64::from(self.height) - 0.5);
        let normal = |u: f64, v: f64| [(u - self.cx) / self.fx, (v - self.cy) / self.fy];
        let corners = [normal(-0.5, -0.5), normal(right, -0.5), normal(-0.5, bottom), normal(right, bottom)];
        let farthest = corners.iter().map(|[x, y]| x.hypot(*y)).fold(0.0, f64::max);
        if !self.radially_monotone(farthest) {
            return Some(format!(
                "{who} distortion (k1 {k1:.4}, k2 {k2:.4}, k3 {k3:.4}) folds the image back before its corner \
                 at {farthest:.3} normalised: the calibration diverged, repeat it with fewer free coefficients"
            ));
        }
        let samples = 32;
        for i in 0..=samples {
            let t = f64::from(i) / f64::from(samples);
            let (u, v) = (-0.5 + t * (right + 0.5), -0.5 + t * (bottom + 0.5));
            for pixel in [[u, -0.5], [u, bottom], [-0.5, v], [right, v]] {
                if self.ray(pixel).is_none() {
                    let [_, _, p1, p2, _] = self.distortion;
                    return Some(format!(
                        "{who} distortion (k1 {k1:.4}, k2 {k2:.4}, p1 {p1:.4}, p2 {p2:.4}, k3 {k3:.4}) cannot be \
                         inverted at pixel ({:.1}, {:.1})",
                        pixel[0], pixel[1]
                    ));
                }
            }
        }
        None
    }

    /// Whether `r (1 + k1 r^2 + ...)` grows until it reaches `farthest`, within ten times that radius.
    fn radially_monotone(&self, farthest: f64) -> bool {
        let [k1, k2, _, _, k3] = self.distortion;
        let steps = 2000;
        for i in 0..=10 * steps {
            let r = farthest * f64::from(i) / f64::from(steps);
            let r2 = r * r;
            if 1.0 + r2 * (3.0 * k1 + r2 * (5.0 * k2 + r2 * 7.0 * k3)) <= 0.0 {
                return false;
            }
            if r * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))) >= farthest {
                return true;
            }
        }
        false
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn narrow() -> Lens {
        Lens {
            width: 1600,
            height: 1200,
            fx: 4638.0,
            fy: 4641.0,
            cx: 812.5,
            cy: 587.25,
            distortion: [-0.11, 0.15, 4e-4, -3e-4, 0.02],
        }
    }

    /// The published result of the toolbox's own example (20 views, 640x480).
    fn wide() -> Lens {
        Lens {
            width: 640,
            height: 480,
            fx: 657.3955332440277,
            fy: 657.7633541058974,
            cx: 302.98216518636815,
            cy: 242.61782605413717,
            distortion: [
                -0.25583927889009855,
                0.1275762918499085,
                -0.00020819047988286177,
                3.3307713495661755e-05,
                0.0,
            ],
        }
    }

    fn close(a: [f64; 2], b: [f64; 2], tolerance: f64) {
        assert!((a[0] - b[0]).abs() <= tolerance && (a[1] - b[1]).abs() <= tolerance, "{a:?} against {b:?}");
    }

    /// Constants of opencv-python-headless 5.0.0:
    /// `cv2.projectPoints(P, 0, 0, K, d)`.
    #[test]
    fn projects_like_opencv() {
        let cases = [
            ([10.0, 20.0, 1000.0], [858.877218939366, 680.066754780982]),
            ([-150.0, -110.0, 965.0], [94.3106527203854, 60.344055919847165]),
            ([160.0, 120.0, 1010.0], [1544.1793307793148, 1136.478191330827]),
            ([-3.25, 55.5, 870.0], [795.1752722638104, 883.2048998281971]),
        ];
        for (point, pixel) in cases {
            close(narrow().project(&Vector3::from(point)).unwrap(), pixel, 1e-9);
        }
        let cases = [
            ([-0.4, -0.3, 1.0], [54.72564337259348, 56.28291488940121]),
            ([0.5, 0.35, 1.0], [606.1448042429613, 454.89368680234463]),
        ];
        for (point, pixel) in cases {
            close(wide().project(&Vector3::from(point)).unwrap(), pixel, 1e-9);
        }
    }

    /// `cv2.undistortPoints(px, K, d, criteria=(COUNT | EPS, 200, 1e-15))` of the same version.
    #[test]
    fn undistorts_like_opencv() {
        let cases = [
            (narrow(), [0.0, 0.0], [-0.17602241792046205, -0.12717057116684805]),
            (narrow(), [1599.0, 1199.0], [0.17040802443204375, 0.13243027990593376]),
            (narrow(), [300.5, 1000.25], [-0.1106099318725802, 0.08916159116068907]),
            (wide(), [0.0, 0.0], [-0.5032282542552865, -0.40263624855984376]),
            (wide(), [639.0, 479.0], [0.5633957779516999, 0.39623773039815174]),
        ];
        for (lens, pixel, expected) in cases {
            let ray = lens.ray(pixel).unwrap();
            close([ray.x, ray.y], expected, 1e-10);
        }
    }

    #[test]
    fn the_jacobian_is_the_derivative() {
        for lens in [narrow(), wide()] {
            for (x, y) in [(0.1, -0.2), (-0.3, 0.25), (0.0, 0.0)] {
                let (_, _, [xx, xy, yy]) = lens.distort_with_jacobian(x, y);
                let h = 1e-6;
                let by = |dx: f64, dy: f64| {
                    let (a, b) = (lens.distort([x + dx, y + dy]), lens.distort([x - dx, y - dy]));
                    [(a[0] - b[0]) / (2.0 * h), (a[1] - b[1]) / (2.0 * h)]
                };
                close(by(h, 0.0), [xx, xy], 1e-8);
                close(by(0.0, h), [xy, yy], 1e-8);
            }
        }
    }

    proptest! {
        #[test]
        fn undistort_undoes_distort(
            k1 in -0.3..0.3f64, k2 in -0.2..0.2f64, p1 in -2e-3..2e-3f64, p2 in -2e-3..2e-3f64, k3 in -0.1..0.1f64,
            u in -0.5..1599.5f64, v in -0.5..1199.5f64, focal in 1200.0..6000.0f64,
        ) {
            let lens = Lens { fx: focal, fy: focal * 1.01, distortion: [k1, k2, p1, p2, k3], ..narrow() };
            prop_assume!(lens.faults("camera").is_empty());
            let ray = lens.ray([u, v]).expect("a lens without faults inverts all over its image");
            let back = lens.project(&(ray * 870.0)).unwrap();
            prop_assert!((back[0] - u).abs() < 1e-7 && (back[1] - v).abs() < 1e-7, "{back:?} {u} {v}");
            let [x, y] = lens.distort([ray.x, ray.y]);
            let again = lens.undistort([x, y]).unwrap();
            prop_assert!((again[0] - ray.x).abs() < 1e-10 && (again[1] - ray.y).abs() < 1e-10);
        }

        #[test]
        fn no_numbers_panic(values in prop::array::uniform9(any::<f64>()), w in any::<u32>(), h in any::<u32>()) {
            let [fx, fy, cx, cy, k1, k2, p1, p2, k3] = values;
            let lens = Lens { width: w, height: h, fx, fy, cx, cy, distortion: [k1, k2, p1, p2, k3] };
            let _ = lens.faults("camera");
            let _ = lens.undistort([k1, p2]);
        }
    }

    #[test]
    fn usable_lenses_have_no_faults() {
        assert_eq!(narrow().faults("camera"), Vec::<String>::new());
        assert_eq!(wide().faults("camera"), Vec::<String>::new());
        // A projector with its principal point below the image, and one with strong high-order distortion.
        let projector = Lens {
            width: 1024,
            height: 768,
            fx: 1942.5397,
            fy: 1930.5588,
            cx: 453.3146,
            cy: 730.5029,
            distortion: [-0.0969, 1.07258, -0.0018, -0.00867, -6.8213],
        };
        assert_eq!(projector.faults("projector"), Vec::<String>::new());
    }

    #[test]
    fn every_fault_is_named() {
        let named = |lens: Lens, words: &[&str]| {
            let faults = lens.faults("camera").join("; ");
            for word in words {
                assert!(faults.contains(word), "{word:?} not in {faults:?}");
            }
        };
        named(Lens { fx: f64::NAN, cy: f64::INFINITY, ..narrow() }, &["fx is NaN", "cy is inf"]);
        named(Lens { fx: -4638.0, width: 0, ..narrow() }, &["width is 0"]);
        named(Lens { fx: -4638.0, ..narrow() }, &["fx is -4638 px, expected a positive"]);
        named(Lens { cx: 4500.0, cy: -2700.0, ..narrow() }, &["cx is 4500.0 px", "cy is -2700.0 px"]);
        assert_eq!(narrow().cropped((0, 900), (160, 120)).faults("camera"), Vec::<String>::new());
        // A diverged fit of a telecentric view: everything is finite and smooth over the image, but absurd.
        let diverged = Lens {
            width: 512,
            height: 150,
            fx: 217_143.875712604,
            fy: 168_591.855939185,
            cx: 255.5,
            cy: 74.5,
            distortion: [418.88, -618_437.68, -1.8467, -1.485, 0.0],
        };
        named(diverged, &["fx is 217143.9 px", "fy is 168591.9 px", "diverged"]);
        named(
            Lens { distortion: [-2.5, 0.0, 0.0, 0.0, 0.0], fx: 1500.0, fy: 1500.0, ..narrow() },
            &["k1 -2.5", "folds"],
        );
        named(
            Lens { distortion: [0.0, 0.0, 0.9, 0.0, 0.0], fx: 900.0, fy: 900.0, ..narrow() },
            &["p1 0.9", "inverted"],
        );
    }

    #[test]
    fn points_behind_are_not_projected() {
        assert_eq!(narrow().project(&Vector3::new(1.0, 2.0, 0.0)), None);
        assert_eq!(narrow().project(&Vector3::new(1.0, 2.0, -5.0)), None);
    }
}
