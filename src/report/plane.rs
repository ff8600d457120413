//! How flat points are: a plane by total least squares, and what bends away from it.

use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector3, Vector6};

use super::statistics;

/// Points nearer to a line than this share of their extent do not fix a plane.
const COLLINEAR: f64 = 1e-6;

/// Points of a region against their best plane. All points count; none is an outlier.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneFit {
    /// Number of points.
    pub points: u64,
    /// Mean of the points in mm.
    pub centroid_mm: Vector3<f64>,
    /// Unit normal of the plane, towards the camera (z <= 0).
    pub normal: Vector3<f64>,
    /// Root mean square distance in mm.
    pub rmse_mm: f64,
    /// 95th percentile of the absolute distance in mm.
    pub p95_mm: f64,
    /// Peak to valley over the points, in mm, of the quadratic surface that fits the distances best: the sagitta of a
    /// region that is bent. `None` for fewer than six points, or where they do not fix a quadratic.
    pub bow_mm: Option<f64>,
}

/// Fits a plane through `points` (mm). `None` for fewer than three points and for points on one line.
pub fn fit_plane(points: &[Vector3<f64>]) -> Option<PlaneFit> {
    if points.len() < 3 {
        return None;
    }
    let count = points.len() as f64;
    let centroid_mm = points.iter().sum::<Vector3<f64>>() / count;
    let mut scatter = Matrix3::zeros();
    for point in points {
        let d = point - centroid_mm;
        scatter += d * d.transpose();
    }
    let eigen = SymmetricEigen::new(scatter / count);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let [largest, middle, _] = order.map(|i| eigen.eigenvalues[i]);
    if !(largest.is_finite() && middle > COLLINEAR * COLLINEAR * largest && largest > 0.0) {
        return None;
    }
    let [along, across, normal] = order.map(|i| eigen.eigenvectors.column(i).into_owned());
    let normal = if normal.z > 0.0 { -normal } else { normal };

    let mut distances: Vec<f64> = points.iter().map(|point| (point - centroid_mm).dot(&normal)).collect();
    let sum_of_squares = distances.iter().map(|h| h * h).sum::<f64>();
    let in_plane = |point: &Vector3<f64>| {
        let d = point - centroid_mm;
        (d.dot(&along) / largest.sqrt(), d.dot(&across) / middle.sqrt())
    };
    let bow_mm = bow(points.iter().map(in_plane), &distances);
    distances.iter_mut().for_each(|h| *h = h.abs());
    Some(PlaneFit {
        points: points.len() as u64,
        centroid_mm,
        normal,
        rmse_mm: statistics::root_mean(sum_of_squares, points.len() as u64)?,
        p95_mm: statistics::quantile(&mut distances, 0.95)?,
        bow_mm,
    })
}

/// Peak to valley of the best quadratic `h(u, v)`; `u`, `v` have unit variance, which keeps the equations well scaled.
fn bow(in_plane: impl Iterator<Item = (f64, f64)> + Clone, distances: &[f64]) -> Option<f64> {
    if distances.len() < 6 {
        return None;
    }
    let terms = |(u, v): (f64, f64)| Vector6::new(1.0, u, v, u * u, u * v, v * v);
    let (mut left, mut right) = (Matrix6::zeros(), Vector6::zeros());
    for (uv, &h) in in_plane.clone().zip(distances) {
        let t = terms(uv);
        left.ger(1.0, &t, &t, 1.0);
        right.axpy(h, &t, 1.0);
    }
    let eigen = SymmetricEigen::new(left);
    // Points on a conic (two lines, say) leave a quadratic free; then there is no bow to speak of.
    if eigen.eigenvalues.min() <= 1e-10 * eigen.eigenvalues.max() {
        return None;
    }
    let coefficients = left.cholesky()?.solve(&right);
    let (low, high) = in_plane
        .map(|uv| terms(uv).dot(&coefficients))
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), h| (low.min(h), high.max(h)));
    statistics::finite(high - low)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Rotation3, Unit};
    use proptest::prelude::*;

    use super::*;

    /// A square grid of `2 n + 1` by `2 n + 1` points, spacing 1 mm, height `h(x, y)`, turned and moved.
    fn sheet(n: i32, pose: (Rotation3<f64>, Vector3<f64>), h: impl Fn(f64, f64) -> f64) -> Vec<Vector3<f64>> {
        let mut points = Vec::new();
        for y in -n..=n {
            for x in -n..=n {
                let (x, y) = (f64::from(x), f64::from(y));
                points.push(pose.0 * Vector3::new(x, y, h(x, y)) + pose.1);
            }
        }
        points
    }

    fn upright() -> (Rotation3<f64>, Vector3<f64>) {
        (Rotation3::identity(), Vector3::new(10.0, -20.0, 1000.0))
    }

    #[test]
    fn a_plane_is_flat() {
        let fit = fit_plane(&sheet(10, upright(), |x, y| 0.1 * x - 0.2 * y)).unwrap();
        assert!(fit.rmse_mm < 1e-9 && fit.p95_mm < 1e-9 && fit.bow_mm.unwrap() < 1e-9);
        let expected = Vector3::new(0.1, -0.2, -1.0).normalize();
        assert!((fit.normal - expected).norm() < 1e-9, "{}", fit.normal);
        assert!((fit.centroid_mm - Vector3::new(10.0, -20.0, 1000.0)).norm() < 1e-9);
        assert_eq!(fit.points, 441);
    }

    #[test]
    fn alternate_steps_have_their_own_height_as_rmse() {
        // A checkerboard of +-0.25 mm, as many of each but one: rms 0.25 and no bow.
        let fit =
            fit_plane(&sheet(20, upright(), |x, y| if (x + y) % 2.0 == 0.0 { 0.25 } else { -0.25 })).unwrap();
        assert!((fit.rmse_mm - 0.25).abs() < 1e-3, "{}", fit.rmse_mm);
        assert!((fit.p95_mm - 0.25).abs() < 1e-3);
        assert!(fit.bow_mm.unwrap() < 0.01);
    }

    #[test]
    fn distance_is_taken_across_the_plane_not_along_z() {
        let tilt = Rotation3::from_axis_angle(&Unit::new_normalize(Vector3::y()), 1.0);
        let steps = |x: f64, y: f64| if (x + y) % 2.0 == 0.0 { 0.25 } else { -0.25 };
        let fit = fit_plane(&sheet(20, (tilt, Vector3::new(0.0, 0.0, 1000.0)), steps)).unwrap();
        assert!((fit.rmse_mm - 0.25).abs() < 1e-3);
    }

    #[test]
    fn bow_of_a_cylinder_is_its_sagitta() {
        // h = 0.002 x^2 over x in -20..=20: 0.8 mm from the middle to the sides.
        let fit = fit_plane(&sheet(20, upright(), |x, _| 0.002 * x * x)).unwrap();
        assert!((fit.bow_mm.unwrap() - 0.8).abs() < 1e-6, "{:?}", fit.bow_mm);
    }

    #[test]
    fn bow_of_a_dome_is_from_corner_to_crown() {
        let fit = fit_plane(&sheet(20, upright(), |x, y| -0.001 * (x * x + y * y))).unwrap();
        assert!((fit.bow_mm.unwrap() - 0.8).abs() < 1e-6, "{:?}", fit.bow_mm);
    }

    #[test]
    fn p95_is_that_of_the_distances() {
        // 10 of 441 points off by 3 mm: 2.3 %, beyond the 95th percentile, yet in the rmse.
        let points =
            sheet(10, upright(), |x, y| if y == 0.0 && x.abs() <= 5.0 && x != 0.0 { 3.0 } else { 0.0 });
        let fit = fit_plane(&points).unwrap();
        assert!(fit.p95_mm < 0.2, "{}", fit.p95_mm);
        assert!((fit.rmse_mm - (10.0f64 * 9.0 / 441.0).sqrt()).abs() < 0.02, "{}", fit.rmse_mm);
    }

    #[test]
    fn too_few_or_collinear_points_give_no_plane() {
        assert_eq!(fit_plane(&[]), None);
        assert_eq!(fit_plane(&[Vector3::zeros(), Vector3::x()]), None);
        let line: Vec<_> = (0..100).map(|i| Vector3::new(1.0, 2.0, 3.0) * f64::from(i)).collect();
        assert_eq!(fit_plane(&line), None);
        assert_eq!(fit_plane(&[Vector3::x(); 50]), None);
        let triangle = fit_plane(&[Vector3::x(), Vector3::y(), Vector3::zeros()]).unwrap();
        assert!(triangle.rmse_mm < 1e-12);
        assert_eq!(triangle.bow_mm, None);
    }

    proptest! {
        #[test]
        fn the_fit_moves_with_its_points(
            heights in prop::collection::vec(-0.5..0.5, 25), axis in prop::array::uniform3(-1.0..1.0), angle in 0.1..1.4,
        ) {
            prop_assume!(Vector3::from(axis).norm() > 0.1);
            let h = |x: f64, y: f64| heights[((y + 2.0) * 5.0 + x + 2.0) as usize];
            let plain = fit_plane(&sheet(2, upright(), h)).unwrap();
            let turn = Rotation3::from_axis_angle(&Unit::new_normalize(Vector3::from(axis)), angle);
            let moved = fit_plane(&sheet(2, (turn, Vector3::new(-50.0, 7.0, 900.0)), h)).unwrap();
            prop_assert!((plain.rmse_mm - moved.rmse_mm).abs() < 1e-9);
            prop_assert!((plain.p95_mm - moved.p95_mm).abs() < 1e-9);
            prop_assert!((plain.bow_mm.unwrap() - moved.bow_mm.unwrap()).abs() < 1e-6);
        }

        #[test]
        fn no_other_plane_is_nearer(heights in prop::collection::vec(-0.5..0.5, 25), tilt in prop::array::uniform2(-0.3..0.3), lift in -0.3..0.3) {
            let points = sheet(2, upright(), |x, y| heights[((y + 2.0) * 5.0 + x + 2.0) as usize]);
            let fit = fit_plane(&points).unwrap();
            let normal = (fit.normal + Vector3::new(tilt[0], tilt[1], 0.0)).normalize();
            let apart = |p: &Vector3<f64>| -> f64 { (p - fit.centroid_mm).dot(&normal) + lift };
            let sum: f64 = points.iter().map(|p| apart(p).powi(2)).sum();
            prop_assert!((sum / 25.0).sqrt() >= fit.rmse_mm - 1e-12);
        }
    }
}
