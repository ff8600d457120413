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
