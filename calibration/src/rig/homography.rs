//! Planes seen by a pinhole: homographies, and what they say of the intrinsics and of the board's pose.

use nalgebra::{DMatrix, Matrix3, SymmetricEigen, Vector3};
use polscan_reconstruction::geometry::Pose;

/// `H (x, y, 1)^T`, normalised.
pub(super) fn apply(h: &Matrix3<f64>, [x, y]: [f64; 2]) -> [f64; 2] {
    let image = h * Vector3::new(x, y, 1.0);
    [image.x / image.z, image.y / image.z]
}

/// Moves points to mean 0 and mean distance sqrt 2 (Hartley), without which the equations below lose their digits.
pub(super) fn normalizer(points: impl Iterator<Item = [f64; 2]> + Clone) -> Option<Matrix3<f64>> {
    let count = points.clone().count() as f64;
    let mean = points.clone().fold([0.0; 2], |sum, p| [sum[0] + p[0] / count, sum[1] + p[1] / count]);
    let spread = points.map(|p| (p[0] - mean[0]).hypot(p[1] - mean[1])).sum::<f64>() / count;
    let scale = std::f64::consts::SQRT_2 / spread;
    scale
        .is_finite()
        .then(|| Matrix3::new(scale, 0.0, -scale * mean[0], 0.0, scale, -scale * mean[1], 0.0, 0.0, 1.0))
}

/// The unit vector that `rows` takes nearest to zero, and how far the next one is from being another such: ratio of
/// the two least singular values.
pub(super) fn null_vector(rows: &DMatrix<f64>) -> Option<(Vec<f64>, f64)> {
    if rows.iter().any(|v| !v.is_finite()) {
        return None;
    }
    let eigen = SymmetricEigen::new(rows.transpose() * rows);
    let mut order: Vec<usize> = (0..eigen.eigenvalues.len()).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let (least, next) = (eigen.eigenvalues[order[0]].max(0.0), eigen.eigenvalues[*order.get(1)?].max(0.0));
    let vector = eigen.eigenvectors.column(order[0]).iter().copied().collect();
    Some((vector, (least / next.max(f64::MIN_POSITIVE)).sqrt()))
}

/// Homography from `pairs` of (plane, image) points by the direct linear transform, scaled to unit norm. `None` for
/// fewer than four, and for points on a line.
pub(super) fn homography(pairs: &[([f64; 2], [f64; 2])]) -> Option<Matrix3<f64>> {
    if pairs.len() < 4 {
        return None;
    }
    let from = normalizer(pairs.iter().map(|p| p.0))?;
    let to = normalizer(pairs.iter().map(|p| p.1))?;
    let mut rows = DMatrix::zeros(2 * pairs.len(), 9);
    for (k, (plane, image)) in pairs.iter().enumerate() {
        let [x, y] = apply(&from, *plane);
        let [u, v] = apply(&to, *image);
        let point = [x, y, 1.0];
        for (column, value) in point.into_iter().enumerate() {
            rows[(2 * k, column)] = value;
            rows[(2 * k, 6 + column)] = -u * value;
            rows[(2 * k + 1, 3 + column)] = value;
            rows[(2 * k + 1, 6 + column)] = -v * value;
        }
    }
    let (h, ambiguity) = null_vector(&rows)?;
    if ambiguity > 0.5 {
        return None;
    }
    let h = to.try_inverse()? * Matrix3::from_row_slice(&h) * from;
    let norm = h.norm();
    (norm.is_finite() && h.determinant().abs() > 1e-14 * norm.powi(3)).then(|| h / norm)
}

/// Focal lengths from homographies with the principal point given: the images of the board's two axes are orthogonal
/// directions of equal length (Zhang 2000, equations 3 and 4, linear in 1/fx^2 and 1/fy^2).
pub(super) fn focal_lengths(homographies: &[Matrix3<f64>], principal: [f64; 2]) -> Option<[f64; 2]> {
    let shift = Matrix3::new(1.0, 0.0, -principal[0], 0.0, 1.0, -principal[1], 0.0, 0.0, 1.0);
    let (mut normal, mut right) = ([[0.0; 2]; 2], [0.0; 2]);
    for h in homographies {
        let h = shift * h;
        let scale = 1.0 / h.column(0).norm().max(h.column(1).norm());
        let (a, b): (Vector3<f64>, Vector3<f64>) = (h.column(0) * scale, h.column(1) * scale);
        // Sum and difference of the axes are orthogonal, too: the same as equal length.
        for (p, q) in [(a, b), (a + b, a - b)] {
            let row = [p.x * q.x, p.y * q.y];
            // Both sides in the same unit: px^2 against 1, so that no equation outweighs the others by its size alone.
            let weight = 1.0 / (p.xy().norm() * q.xy().norm()).max(f64::MIN_POSITIVE);
            let row = row.map(|v| v * weight);
            let target = -p.z * q.z * weight;
            for i in 0..2 {
                right[i] += row[i] * target;
                for j in 0..2 {
                    normal[i][j] += row[i] * row[j];
                }
            }
        }
    }
    let determinant = normal[0][0] * normal[1][1] - normal[0][1] * normal[1][0];
    let x = (right[0] * normal[1][1] - right[1] * normal[0][1]) / determinant;
    let y = (right[1] * normal[0][0] - right[0] * normal[1][0]) / determinant;
    let focal = [x.recip().sqrt(), y.recip().sqrt()];
    focal.iter().all(|f| f.is_finite()).then_some(focal)
}

/// fx, fy, cx, cy from at least three homographies of planes that are not parallel: Zhang's closed form without skew.
/// `size` only scales the equations.
pub(super) fn zhang(homographies: &[Matrix3<f64>], size: [f64; 2]) -> Option<[f64; 4]> {
    let side = size[0].max(size[1]);
    let shift =
        Matrix3::new(2.0 / side, 0.0, -size[0] / side, 0.0, 2.0 / side, -size[1] / side, 0.0, 0.0, 1.0);
    let mut rows = DMatrix::zeros(2 * homographies.len(), 5);
    for (k, h) in homographies.iter().enumerate() {
        let h = shift * h;
        let scale = 1.0 / h.column(0).norm().max(h.column(1).norm());
        let (a, b): (Vector3<f64>, Vector3<f64>) = (h.column(0) * scale, h.column(1) * scale);
        for (offset, (p, q)) in [(a, b), (a + b, a - b)].into_iter().enumerate() {
            let row = [p.x * q.x, p.y * q.y, p.x * q.z + p.z * q.x, p.y * q.z + p.z * q.y, p.z * q.z];
            for (column, value) in row.into_iter().enumerate() {
                rows[(2 * k + offset, column)] = value;
            }
        }
    }
    // B = K^-T K^-1 up to a factor, as B11, B22, B13, B23, B33.
    let (b, _) = null_vector(&rows)?;
    let (cx, cy) = (-b[2] / b[0], -b[3] / b[1]);
    let factor = b[4] + cx * b[2] + cy * b[3];
    let (fx, fy) = ((factor / b[0]).sqrt(), (factor / b[1]).sqrt());
    let back = [0.5 * side * fx, 0.5 * side * fy, 0.5 * (side * cx + size[0]), 0.5 * (side * cy + size[1])];
    back.iter().all(|v| v.is_finite()).then_some(back)
}

/// Pose of a plane from its homography and the camera matrix: the nearest rotation to what the homography says.
pub(super) fn pose(h: &Matrix3<f64>, camera: &Matrix3<f64>) -> Option<Pose> {
    let m = camera.try_inverse()? * h;
    let scale = 2.0 / (m.column(0).norm() + m.column(1).norm());
    let scale = if m[(2, 2)] < 0.0 { -scale } else { scale };
    let m = m * scale;
    let (a, b): (Vector3<f64>, Vector3<f64>) = (m.column(0).into_owned(), m.column(1).into_owned());
    let svd = Matrix3::from_columns(&[a, b, a.cross(&b)]).svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let mirror = (u * v).determinant().signum();
    let rotation = u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, mirror)) * v;
    let pose = Pose { rotation, translation_mm: m.column(2).into_owned() };
    (pose.rotation.iter().chain(pose.translation_mm.iter()).all(|v| v.is_finite())).then_some(pose)
}

/// The other pose under which a far plane looks nearly the same: tilted the opposite way against the line of sight.
pub(super) fn mirrored(pose: &Pose, centre_mm: [f64; 2]) -> Pose {
    let centre = pose.rotation * Vector3::new(centre_mm[0], centre_mm[1], 0.0);
    let place = centre + pose.translation_mm;
    let sight = place.normalize();
    let mirror = |axis: Vector3<f64>| axis - 2.0 * axis.dot(&sight) * sight;
    let (a, b) = (mirror(pose.rotation.column(0).into_owned()), mirror(pose.rotation.column(1).into_owned()));
    let rotation = Matrix3::from_columns(&[a, b, a.cross(&b)]);
    let moved = rotation * Vector3::new(centre_mm[0], centre_mm[1], 0.0);
    Pose { rotation, translation_mm: place - moved }
}
