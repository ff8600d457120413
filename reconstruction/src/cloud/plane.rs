//! How flat a plate is.

use nalgebra::{Matrix3, Matrix6, SymmetricEigen, Vector3, Vector6};
use thiserror::Error;

/// A plane fitted by total least squares, and how the points lie about it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlaneFit {
    /// Number of points.
    pub points: usize,
    /// Their mean in mm; the plane goes through it.
    pub centroid_mm: [f64; 3],
    /// Unit normal, towards the origin of the points' frame (the camera).
    pub normal: [f64; 3],
    /// Root mean square distance of the points from the plane in mm.
    pub rmse_mm: f64,
    /// 95th percentile of the unsigned distance in mm.
    pub p95_mm: f64,
    /// Peak-to-peak height over the points of the quadratic that fits the distances best: the sagitta of a bent
    /// plate, free of noise, in mm. For a sphere's cap of radius R seen on a disc of radius r it is r^2 / (2 R).
    pub bow_mm: f64,
}

/// Why no plane can be fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum PlaneError {
    /// Too few points.
    #[error("cannot fit a plane to {0} points, at least 6 are needed; choose a larger region")]
    TooFew(usize),
    /// Points on a line, at one place, or not finite.
    #[error("cannot fit a plane: the points lie on a line or are not finite; choose another region")]
    Degenerate,
}

/// Fits a plane to points in mm by total least squares, without removing outliers.
///
/// # Errors
/// [`PlaneError`] for fewer than 6 points and for points that do not span a plane.
pub fn fit_plane(points_mm: &[[f64; 3]]) -> Result<PlaneFit, PlaneError> {
    let count = points_mm.len();
    if count < 6 {
        return Err(PlaneError::TooFew(count));
    }
    let vector = |p: &[f64; 3]| Vector3::new(p[0], p[1], p[2]);
    let centroid = points_mm.iter().map(vector).sum::<Vector3<f64>>() / count as f64;
    let mut scatter = Matrix3::zeros();
    for point in points_mm {
        let offset = vector(point) - centroid;
        scatter += offset * offset.transpose();
    }
    if !scatter.iter().all(|v| v.is_finite()) {
        return Err(PlaneError::Degenerate);
    }
    let eigen = SymmetricEigen::new(scatter);
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [least, middle, most] = order.map(|k| eigen.eigenvalues[k]);
    if most.is_nan() || most <= 0.0 || middle <= 1e-10 * most || least.is_nan() {
        return Err(PlaneError::Degenerate);
    }
    let axis = |k: usize| eigen.eigenvectors.column(order[k]).into_owned();
    let mut normal: Vector3<f64> = axis(0);
    if normal.dot(&centroid) > 0.0 {
        normal = -normal;
    }
    let (across, along): (Vector3<f64>, Vector3<f64>) = (axis(1), axis(2));
    // Unit spread along both axes keeps the quadratic's equations well conditioned.
    let (scale_along, scale_across) = ((count as f64 / most).sqrt(), (count as f64 / middle).sqrt());
    let local: Vec<[f64; 3]> = points_mm
        .iter()
        .map(|point| {
            let offset = vector(point) - centroid;
            [offset.dot(&along) * scale_along, offset.dot(&across) * scale_across, offset.dot(&normal)]
        })
        .collect();
    let mut distances: Vec<f64> = local.iter().map(|p| p[2].abs()).collect();
    let rmse_mm = (distances.iter().map(|d| d * d).sum::<f64>() / count as f64).sqrt();
    let rank = ((0.95 * count as f64).ceil() as usize).clamp(1, count) - 1;
    let p95_mm = *distances.select_nth_unstable_by(rank, f64::total_cmp).1;
    Ok(PlaneFit {
        points: count,
        centroid_mm: centroid.into(),
        normal: normal.into(),
        rmse_mm,
        p95_mm,
        bow_mm: bow(&local),
    })
}

fn terms(point: &[f64; 3]) -> Vector6<f64> {
    let [u, v, _] = *point;
    Vector6::new(1.0, u, v, u * u, u * v, v * v)
}

/// Peak-to-peak of the best quadratic over the points; 0 where the points do not fix one (all on a conic).
fn bow(local: &[[f64; 3]]) -> f64 {
    let (mut normal_matrix, mut right) = (Matrix6::zeros(), Vector6::zeros());
    for point in local {
        let row = terms(point);
        normal_matrix += row * row.transpose();
        right += row * point[2];
    }
    let Some(solution) = normal_matrix.cholesky().map(|c| c.solve(&right)) else {
        return 0.0;
    };
    let heights = local.iter().map(|point| terms(point).dot(&solution));
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if (high - low).is_finite() { high - low } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A grid of points on z = f(x, y) over [-r, r]^2 that `keep` keeps.
    fn points(r: f64, f: impl Fn(f64, f64) -> f64, keep: impl Fn(f64, f64) -> bool) -> Vec<[f64; 3]> {
        let at = |k: i32| r * f64::from(k) / 50.0;
        let grid = (-50..=50).flat_map(|i| (-50..=50).map(move |j| (at(i), at(j))));
        grid.filter(|&(x, y)| keep(x, y)).map(|(x, y)| [x, y, f(x, y)]).collect()
    }

    #[test]
    fn an_exact_plane_is_flat() {
        let fit = fit_plane(&points(80.0, |x, y| 1000.0 + 0.2 * x - 0.1 * y, |_, _| true)).unwrap();
        assert_eq!(fit.points, 101 * 101);
        assert!(fit.rmse_mm < 1e-9 && fit.p95_mm < 1e-9 && fit.bow_mm < 1e-9, "{fit:?}");
        let norm = (1.0_f64 + 0.04 + 0.01).sqrt();
        let expected = [0.2 / norm, -0.1 / norm, -1.0 / norm];
        assert!(
            (Vector3::from(fit.normal) - Vector3::from(expected)).abs().max() < 1e-12,
            "{:?}",
            fit.normal
        );
        assert!((fit.centroid_mm[2] - 1000.0).abs() < 1e-9);
    }

    /// Distances +1 and -1 in equal shares, uncorrelated with the position: rms 1, every quantile 1, no bow.
    #[test]
    fn rmse_is_the_distance_along_the_normal() {
        let mut signs = [1.0, -1.0].into_iter().cycle();
        let mut flat = points(50.0, |_, _| 0.0, |_, _| true);
        flat.pop();
        for point in &mut flat {
            point[2] += signs.next().unwrap();
        }
        let fit = fit_plane(&flat).unwrap();
        assert!((fit.rmse_mm - 1.0).abs() < 1e-3 && (fit.p95_mm - 1.0).abs() < 0.05, "{fit:?}");
        assert!(fit.bow_mm < 0.01, "{fit:?}");
        // Tilting the whole by 60 degrees changes no distance.
        let turn = nalgebra::Rotation3::from_euler_angles(1.05, 0.3, -0.4);
        let turned: Vec<[f64; 3]> = flat
            .iter()
            .map(|p| (turn * Vector3::from(*p) + Vector3::new(10.0, 20.0, 900.0)).into())
            .collect();
        let tilted = fit_plane(&turned).unwrap();
        assert!((tilted.rmse_mm - fit.rmse_mm).abs() < 1e-9 && (tilted.bow_mm - fit.bow_mm).abs() < 1e-9);
        let normal = turn * Vector3::z();
        assert!(Vector3::from(tilted.normal).cross(&normal).norm() < 1e-3);
        assert!(
            Vector3::from(tilted.normal).dot(&Vector3::from(tilted.centroid_mm)) < 0.0,
            "towards the camera"
        );
    }

    #[test]
    fn bow_of_a_sphere_cap_is_its_sagitta() {
        let (big, r) = (20_000.0_f64, 60.0);
        let cap = |x: f64, y: f64| 1000.0 + big - (big * big - x * x - y * y).sqrt();
        let fit = fit_plane(&points(r, cap, |x, y| x.hypot(y) <= r)).unwrap();
        let sagitta = r * r / (2.0 * big);
        assert!((fit.bow_mm - sagitta).abs() < 1e-3 * sagitta, "{} against {sagitta}", fit.bow_mm);
        // The mean square of a paraboloid about its mean over a disc is sagitta^2 / 12.
        assert!((fit.rmse_mm - sagitta / 12.0_f64.sqrt()).abs() < 0.01 * sagitta, "{}", fit.rmse_mm);
    }

    #[test]
    fn bow_sees_a_cylinder_on_a_long_strip() {
        let fit = fit_plane(&points(100.0, |x, _| 900.0 + 1e-4 * x * x, |_, y| y.abs() < 5.0)).unwrap();
        assert!((fit.bow_mm - 1.0).abs() < 1e-6, "{}", fit.bow_mm);
    }

    #[test]
    fn refuses_what_is_no_plane() {
        assert_eq!(fit_plane(&[[0.0; 3]; 5]), Err(PlaneError::TooFew(5)));
        assert_eq!(fit_plane(&[[1.0, 2.0, 3.0]; 50]), Err(PlaneError::Degenerate));
        let line: Vec<[f64; 3]> = (0..50).map(|i| [f64::from(i), 2.0 * f64::from(i), 5.0]).collect();
        assert_eq!(fit_plane(&line), Err(PlaneError::Degenerate));
        let mut holes = points(10.0, |x, _| x, |_, _| true);
        holes[7][1] = f64::NAN;
        assert_eq!(fit_plane(&holes), Err(PlaneError::Degenerate));
    }
}
