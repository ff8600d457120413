//! The twin's own pinhole with Brown-Conrady distortion.
//!
//! It shares no code with the scanner's geometry, so that an error there cannot hide behind the same error here.

use nalgebra::{Matrix3, Vector3};

/// A pinhole with distortion: `x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)`, and likewise y;
/// pixel = focal * x_d + centre, pixel centres at integers.
#[derive(Debug, Clone)]
pub(crate) struct Pinhole {
    focal_px: f64,
    centre_px: [f64; 2],
    radial: [f64; 3],
    tangential: [f64; 2],
    /// Square of the largest undistorted radius up to which the radial part is monotone.
    valid_radius_sq: f64,
}

/// Largest undistorted radius that is looked at: a field of 2 x 84 degrees.
const WIDEST_RADIUS: f64 = 10.0;
/// Residual of the undistortion, in units of the focal length.
const UNDISTORTION_TOLERANCE: f64 = 1e-13;

impl Pinhole {
    /// `distortion` is k1, k2, p1, p2, k3.
    pub(crate) fn new(focal_px: f64, centre_px: [f64; 2], distortion: [f64; 5]) -> Self {
        let [k1, k2, p1, p2, k3] = distortion;
        let steps = 4000;
        let monotone = |radius: f64| {
            let s = radius * radius;
            1.0 + s * (3.0 * k1 + s * (5.0 * k2 + s * 7.0 * k3)) > 0.0
        };
        let valid_radius = (1..=steps)
            .map(|step| WIDEST_RADIUS * f64::from(step) / f64::from(steps))
            .take_while(|&radius| monotone(radius))
            .last()
            .unwrap_or(0.0);
        Self {
            focal_px,
            centre_px,
            radial: [k1, k2, k3],
            tangential: [p1, p2],
            valid_radius_sq: valid_radius * valid_radius,
        }
    }

    /// Distorted coordinates and their Jacobian [[dxx, dxy], [dyx, dyy]].
    fn distort(&self, x: f64, y: f64) -> ([f64; 2], [[f64; 2]; 2]) {
        let [k1, k2, k3] = self.radial;
        let [p1, p2] = self.tangential;
        let s = x * x + y * y;
        let radial = 1.0 + s * (k1 + s * (k2 + s * k3));
        let slope = k1 + s * (2.0 * k2 + s * 3.0 * k3);
        let distorted = [
            x * radial + 2.0 * p1 * x * y + p2 * (s + 2.0 * x * x),
            y * radial + p1 * (s + 2.0 * y * y) + 2.0 * p2 * x * y,
        ];
        let cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = [
            [radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x, cross],
            [cross, radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x],
        ];
        (distorted, jacobian)
    }

    /// Pixel of a point in the frame of this pinhole; `None` behind it or where the distortion folds over.
    pub(crate) fn project(&self, point: Vector3<f64>) -> Option<[f64; 2]> {
        if point.z <= 0.0 {
            return None;
        }
        let (x, y) = (point.x / point.z, point.y / point.z);
        if x * x + y * y > self.valid_radius_sq {
            return None;
        }
        let ([xd, yd], _) = self.distort(x, y);
        Some([self.focal_px * xd + self.centre_px[0], self.focal_px * yd + self.centre_px[1]])
    }

    /// Unit direction of the ray through a pixel; `None` where the distortion has no inverse.
    pub(crate) fn ray(&self, pixel: [f64; 2]) -> Option<Vector3<f64>> {
        let target =
            [(pixel[0] - self.centre_px[0]) / self.focal_px, (pixel[1] - self.centre_px[1]) / self.focal_px];
        let [mut x, mut y] = target;
        for _ in 0..50 {
            let ([xd, yd], [[a, b], [c, d]]) = self.distort(x, y);
            let (ex, ey) = (xd - target[0], yd - target[1]);
            if ex.abs().max(ey.abs()) < UNDISTORTION_TOLERANCE {
                return (x * x + y * y <= self.valid_radius_sq).then(|| Vector3::new(x, y, 1.0).normalize());
            }
            let determinant = a * d - b * c;
            x -= (d * ex - b * ey) / determinant;
            y -= (a * ey - c * ex) / determinant;
        }
        None
    }
}

/// Where the projector stands: `x_p = rotation * x_c + translation_mm`.
#[derive(Debug, Clone)]
pub(crate) struct Placement {
    /// Rotation from the camera's frame into the projector's.
    pub(crate) rotation: Matrix3<f64>,
    /// Camera centre in the projector's frame.
    pub(crate) translation_mm: Vector3<f64>,
    /// Projector centre in the camera's frame.
    pub(crate) centre_mm: Vector3<f64>,
}

impl Placement {
    /// From the transform itself.
    pub(crate) fn new(rotation: Matrix3<f64>, translation_mm: Vector3<f64>) -> Self {
        Self { rotation, translation_mm, centre_mm: -(rotation.transpose() * translation_mm) }
    }

    /// A projector at `centre_mm` turned about its vertical and then about its own horizontal axis (no roll) so that
    /// its ray `aimed` meets the point `target_mm`. `None` where no such turn exists.
    pub(crate) fn aimed(
        centre_mm: Vector3<f64>,
        aimed: Vector3<f64>,
        target_mm: Vector3<f64>,
    ) -> Option<Self> {
        let to = (target_mm - centre_mm).normalize();
        let ray = aimed.normalize();
        // Yaw: the x component of the turned direction must become that of the ray.
        let across = to.x.hypot(to.z);
        if across < ray.x.abs() || !across.is_normal() {
            return None;
        }
        let yaw = to.x.atan2(to.z) - (ray.x / across).asin();
        let (sin, cos) = yaw.sin_cos();
        let turn = Matrix3::new(cos, 0.0, -sin, 0.0, 1.0, 0.0, sin, 0.0, cos);
        let turned = turn * to;
        let tilt = ray.y.atan2(ray.z) - turned.y.atan2(turned.z);
        let (sin, cos) = tilt.sin_cos();
        let nod = Matrix3::new(1.0, 0.0, 0.0, 0.0, cos, sin, 0.0, -sin, cos);
        let rotation = nod * turn;
        Some(Self { rotation, translation_mm: -(rotation * centre_mm), centre_mm })
    }

    /// A point of the camera's frame in the projector's.
    pub(crate) fn transform(&self, point_mm: Vector3<f64>) -> Vector3<f64> {
        self.rotation * point_mm + self.translation_mm
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn camera() -> Pinhole {
        Pinhole::new(4638.0, [799.5, 599.5], [-0.11, 0.15, 4e-4, -3e-4, 0.02])
    }

    proptest! {
        #[test]
        fn a_ray_projects_back_to_its_pixel(x in -20.0f64..1620.0, y in -20.0f64..1220.0, z in 10.0f64..5000.0) {
            let pixel = camera().project(camera().ray([x, y]).unwrap() * z).unwrap();
            // 1e-9 of the focal length is 5e-6 px; the solution is much better than that.
            prop_assert!((pixel[0] - x).abs() < 1e-9 && (pixel[1] - y).abs() < 1e-9, "{pixel:?}");
        }

        #[test]
        fn the_aim_meets_the_target(
            cx in -300.0f64..300.0, cy in -300.0f64..300.0,
            rx in -0.3f64..0.3, ry in -0.5f64..0.5, z in 300.0f64..3000.0,
        ) {
            let ray = Vector3::new(rx, ry, 1.0);
            let placement =
                Placement::aimed(Vector3::new(cx, cy, 0.0), ray, Vector3::new(0.0, 0.0, z)).unwrap();
            let seen = placement.transform(Vector3::new(0.0, 0.0, z)).normalize();
            prop_assert!((seen - ray.normalize()).norm() < 1e-12);
            let unit = placement.rotation * placement.rotation.transpose() - Matrix3::identity();
            prop_assert!(unit.norm() < 1e-12 && (placement.rotation.determinant() - 1.0).abs() < 1e-12);
            prop_assert!(placement.transform(placement.centre_mm).norm() < 1e-9);
            // No roll: the projector's horizontal stays level in the camera's frame.
            prop_assert!(placement.rotation[(0, 1)].abs() < 1e-12);
        }
    }

    #[test]
    fn points_beyond_the_fold_or_behind_are_not_seen() {
        let folding = Pinhole::new(1000.0, [0.0, 0.0], [-0.5, 0.0, 0.0, 0.0, 0.0]);
        assert!(folding.project(Vector3::new(1.2, 0.0, 1.0)).is_none());
        assert!(folding.project(Vector3::new(0.3, 0.0, 1.0)).is_some());
        assert!(folding.project(Vector3::new(0.3, 0.0, -1.0)).is_none());
        assert!(folding.ray([900.0, 0.0]).is_none());
    }
}
