//! Planes and spheres among points of which some belong to something else.
//!
//! A surface through few random points at a time, kept where a quantile of the distance of all points is least (least quantile of
//! squares, Rousseeuw 1984), says which points belong to it; least squares over these says where it is and how sure that is.

use nalgebra::{Matrix3, Matrix4, SymmetricEigen, Vector3, Vector4};
use thiserror::Error;

/// A point in mm in the camera's frame with the standard deviation that its scan gives it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Point.
    pub mm: [f64; 3],
    /// Standard deviation of its depth in mm: it is uncertain along its ray.
    pub sigma_z_mm: f64,
}

impl Point {
    /// How far it moves along `normal` while its depth grows by 1 mm; negative where the surface faces the camera.
    fn along(&self, normal: &Vector3<f64>) -> f64 {
        normal.dot(&vector(self)) / self.mm[2].max(f64::MIN_POSITIVE)
    }
}

/// A plane `normal . x = offset`.
#[derive(Debug, Clone, PartialEq)]
pub struct FittedPlane {
    /// Mean of its points.
    pub centroid_mm: Vector3<f64>,
    /// Unit normal, towards the origin.
    pub normal: Vector3<f64>,
    /// Points that lie on it.
    pub inliers: Vec<Point>,
    /// Share of the points that do.
    pub share: f64,
    /// Root mean square distance of these in mm.
    pub rms_mm: f64,
}

/// A sphere.
#[derive(Debug, Clone, PartialEq)]
pub struct FittedSphere {
    /// Centre.
    pub centre_mm: Vector3<f64>,
    /// Radius.
    pub radius_mm: f64,
    /// Covariance of centre and radius in mm^2, of noise alone.
    pub covariance_mm2: Matrix4<f64>,
    /// Points that lie on it.
    pub inliers: Vec<Point>,
    /// Share of the points that do.
    pub share: f64,
    /// Root mean square distance of these in mm.
    pub rms_mm: f64,
}

/// Why nothing was fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum FitError {
    /// Too few points.
    #[error("it has {0} points, at least {LEAST_POINTS} are needed; enlarge its region or light it better")]
    TooFew(usize),
    /// No surface has half of the points.
    #[error("no {0} goes through half of its points; point its region at it")]
    NoSurface(&'static str),
}

/// Fewer points say nothing.
pub const LEAST_POINTS: usize = 100;

/// Random subsets: with 60 % of the points foreign, one in 39 of four points is free of them, so that all of these fail once
/// in 10^11.
const SUBSETS: usize = 1000;

/// Points that judge a subset, evenly spread over all.
const JUDGES: usize = 1500;

/// A point further off than this many standard deviations belongs to something else.
const GATE: f64 = 3.5;

/// Share of the points that a plane's distance is judged by.
const PLANE_QUANTILE: f64 = 0.5;

/// Likewise of a ball, which may fill no more than this of a region with a wall in it.
const BALL_QUANTILE: f64 = 0.25;

/// A ball's radius may be off by this factor. No wall looks like a ball of that size.
const RADIUS_FACTOR: f64 = 1.5;

/// First gate about a ball, as a share of its radius, above noise: what spheres through four noisy points are off by.
const FIRST_GATE: f64 = 0.06;

/// Flanks whose normal moves by less than this for a mm of depth are left out: there one pixel sees much of a slope.
const LEAST_FACING: f64 = 0.35;

/// A median absolute deviation of normal noise is this share of its standard deviation.
const MAD_OF_SIGMA: f64 = 0.6745;

/// The plane that most points lie on.
///
/// # Errors
/// [`FitError`].
pub fn robust_plane(points: &[Point]) -> Result<FittedPlane, FitError> {
    let through = |corners: &[Vector3<f64>]| {
        let normal = (corners[1] - corners[0]).cross(&(corners[2] - corners[0])).try_normalize(1e-9)?;
        Some((corners[0], normal))
    };
    let none = FitError::NoSurface("plane");
    let distance =
        |(corner, normal): &(Vector3<f64>, Vector3<f64>), point: &Vector3<f64>| normal.dot(&(point - corner));
    let (first, median) = consensus(points, (3, PLANE_QUANTILE), through, distance)?.ok_or(none)?;
    // Few judges stretch the median of the best subset beyond that of the fit, never below.
    let mut inliers = close(points, |point| distance(&first, &vector(point)), median / MAD_OF_SIGMA);
    let mut fit = plane(&inliers).ok_or(none)?;
    for _ in 0..5 {
        let distance = |point: &Point| fit.1.dot(&(vector(point) - fit.0));
        inliers = close(points, distance, scale(&inliers, distance));
        if inliers.len() < LEAST_POINTS {
            return Err(FitError::TooFew(inliers.len()));
        }
        fit = plane(&inliers).ok_or(none)?;
    }
    let (centroid_mm, normal) = fit;
    let rms_mm = rms(&inliers, |point| normal.dot(&(vector(point) - centroid_mm)));
    let share = inliers.len() as f64 / points.len() as f64;
    Ok(FittedPlane { centroid_mm, normal, inliers, share, rms_mm })
}

/// The sphere of about `nominal_mm` radius that most points lie on, weighted by their standard deviations across its surface.
///
/// # Errors
/// [`FitError`].
pub fn robust_sphere(points: &[Point], nominal_mm: f64) -> Result<FittedSphere, FitError> {
    let through = |corners: &[Vector3<f64>]| {
        let (centre, radius) = algebraic(corners)?;
        let likely = radius * RADIUS_FACTOR > nominal_mm && radius < nominal_mm * RADIUS_FACTOR;
        likely.then_some((centre, radius))
    };
    let none = FitError::NoSurface("sphere");
    let distance = |&(centre, radius): &Sphere, point: &Vector3<f64>| (point - centre).norm() - radius;
    let mut sphere =
        consensus(points, (4, BALL_QUANTILE), through, distance)?.map(|(sphere, _)| sphere).ok_or(none)?;
    let in_sigma =
        |sphere: &Sphere, point: &Point| off_sphere(point, sphere).map_or(0.0, |(off, sigma)| off / sigma);
    let mut inliers = on_sphere(points, &sphere, |sigma_mm| GATE * sigma_mm + FIRST_GATE * nominal_mm)?;
    for _ in 0..12 {
        (sphere, _) = gauss_newton(&inliers, &sphere).ok_or(none)?;
        let excess = scale(&inliers, |point| in_sigma(&sphere, point)).max(1.0);
        inliers = on_sphere(points, &sphere, |sigma_mm| GATE * excess * sigma_mm)?;
    }
    let (centre_mm, radius_mm) = sphere;
    let (_, normal_matrix) = gauss_newton(&inliers, &sphere).ok_or(none)?;
    let inverse = normal_matrix.try_inverse().ok_or(none)?;
    let excess = rms(&inliers, |point| in_sigma(&sphere, point)).max(1.0);
    let rms_mm = rms(&inliers, |point| distance(&sphere, &vector(point)));
    let share = inliers.len() as f64 / points.len() as f64;
    Ok(FittedSphere {
        centre_mm,
        radius_mm,
        covariance_mm2: inverse * excess.powi(2),
        inliers,
        share,
        rms_mm,
    })
}

/// Distance of a point from a sphere and the standard deviation of that; `None` on a flank.
fn off_sphere(point: &Point, (centre, radius): &Sphere) -> Option<(f64, f64)> {
    let out = vector(point) - centre;
    let facing = -point.along(&out.try_normalize(f64::MIN_POSITIVE)?);
    (facing > LEAST_FACING).then(|| (out.norm() - radius, (facing * point.sigma_z_mm).max(f64::MIN_POSITIVE)))
}

/// The points that are no further from a sphere than `gate` makes of the standard deviation of their distance.
fn on_sphere(points: &[Point], sphere: &Sphere, gate: impl Fn(f64) -> f64) -> Result<Vec<Point>, FitError> {
    let near =
        |point: &&Point| off_sphere(point, sphere).is_some_and(|(off, sigma)| off.abs() <= gate(sigma));
    let found: Vec<Point> = points.iter().filter(near).copied().collect();
    if found.len() < LEAST_POINTS { Err(FitError::TooFew(found.len())) } else { Ok(found) }
}

/// Centre and radius in mm.
type Sphere = (Vector3<f64>, f64);

fn vector(point: &Point) -> Vector3<f64> {
    Vector3::from(point.mm)
}

/// The surface through a subset of `few` points of which the given quantile of all distances is least, and that quantile; `None`
/// where no subset makes a surface.
fn consensus<S>(
    points: &[Point],
    (few, quantile): (usize, f64),
    through: impl Fn(&[Vector3<f64>]) -> Option<S>,
    distance: impl Fn(&S, &Vector3<f64>) -> f64,
) -> Result<Option<(S, f64)>, FitError> {
    if points.len() < LEAST_POINTS {
        return Err(FitError::TooFew(points.len()));
    }
    let stride = points.len().div_ceil(JUDGES);
    let judges: Vec<Vector3<f64>> = points.iter().step_by(stride).map(vector).collect();
    let mut draw = Draw(0x9E37_79B9_7F4A_7C15);
    let mut best: Option<(S, f64)> = None;
    for _ in 0..SUBSETS {
        let subset: Vec<_> = (0..few).map(|_| judges[draw.below(judges.len())]).collect();
        let Some(surface) = through(&subset) else { continue };
        let mut distances: Vec<f64> = judges.iter().map(|point| distance(&surface, point).abs()).collect();
        let rank = (distances.len() as f64 * quantile) as usize;
        let reached = *distances.select_nth_unstable_by(rank, f64::total_cmp).1;
        if best.as_ref().is_none_or(|(_, least)| reached < *least) {
            best = Some((surface, reached));
        }
    }
    Ok(best)
}

/// Points within the gate, each at least as far as its own noise allows.
fn close(points: &[Point], distance: impl Fn(&Point) -> f64, sigma_mm: f64) -> Vec<Point> {
    let near = |point: &&Point| distance(point).abs() <= GATE * sigma_mm.max(point.sigma_z_mm);
    points.iter().filter(near).copied().collect()
}

fn scale(points: &[Point], distance: impl Fn(&Point) -> f64) -> f64 {
    let mut distances: Vec<f64> = points.iter().map(|point| distance(point).abs()).collect();
    if distances.is_empty() {
        return 0.0;
    }
    let middle = distances.len() / 2;
    *distances.select_nth_unstable_by(middle, f64::total_cmp).1 / MAD_OF_SIGMA
}

fn rms(points: &[Point], distance: impl Fn(&Point) -> f64) -> f64 {
    (points.iter().map(|point| distance(point).powi(2)).sum::<f64>() / points.len().max(1) as f64).sqrt()
}

/// Centroid and normal by total least squares.
fn plane(points: &[Point]) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let centroid = points.iter().map(vector).sum::<Vector3<f64>>() / points.len() as f64;
    let eigen = SymmetricEigen::new(scatter(points, &centroid));
    let least = eigen.eigenvalues.imin();
    let normal: Vector3<f64> = eigen.eigenvectors.column(least).into_owned();
    let towards = if normal.dot(&centroid) > 0.0 { -normal } else { normal };
    towards.iter().all(|value| value.is_finite()).then_some((centroid, towards))
}

/// Sum of the outer products of all points about `centroid`.
pub(super) fn scatter(points: &[Point], centroid: &Vector3<f64>) -> Matrix3<f64> {
    points.iter().fold(Matrix3::zeros(), |sum, point| {
        let offset = vector(point) - centroid;
        sum + offset * offset.transpose()
    })
}

/// Sphere by linear least squares: `|x|^2 = 2 c.x + (r^2 - |c|^2)`, about the points' mean so that digits are kept.
fn algebraic(points: &[Vector3<f64>]) -> Option<Sphere> {
    let mean = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let (mut matrix, mut right) = (Matrix4::zeros(), Vector4::zeros());
    for point in points {
        let point = point - mean;
        let row = Vector4::new(2.0 * point.x, 2.0 * point.y, 2.0 * point.z, 1.0);
        matrix += row * row.transpose();
        right += row * point.norm_squared();
    }
    let solved = matrix.lu().solve(&right)?;
    let centre = solved.xyz();
    let radius = (solved.w + centre.norm_squared()).sqrt();
    (radius.is_finite() && radius < 1e6).then_some((centre + mean, radius))
}

/// One step on the geometric distances, each weighted by its standard deviation, and the normal matrix before it.
fn gauss_newton(points: &[Point], sphere: &Sphere) -> Option<(Sphere, Matrix4<f64>)> {
    let (centre, radius) = sphere;
    let (mut matrix, mut right) = (Matrix4::zeros(), Vector4::zeros());
    for point in points {
        let Some((off, sigma)) = off_sphere(point, sphere) else { continue };
        let direction = (vector(point) - centre).normalize();
        let row = Vector4::new(direction.x, direction.y, direction.z, 1.0) / sigma;
        matrix += row * row.transpose();
        right += row * (off / sigma);
    }
    let step = matrix.cholesky()?.solve(&right);
    let fit = (centre + step.xyz(), radius + step.w);
    fit.1.is_finite().then_some((fit, matrix))
}

/// Numbers that are spread well enough to choose subsets by, the same in each run (SplitMix64, Steele 2014).
struct Draw(u64);

impl Draw {
    fn below(&mut self, count: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((mixed ^ (mixed >> 31)) % count as u64) as usize
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    use super::*;

    fn noisy(random: &mut StdRng, sigma: f64) -> f64 {
        // Irwin-Hall: twelve uniform numbers have the variance 1.
        sigma * ((0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0)
    }

    fn point(mm: [f64; 3]) -> Point {
        Point { mm, sigma_z_mm: 0.05 }
    }

    /// The front of a ball before a wall that has more than half of the points, with noise along the rays.
    fn ball(centre: [f64; 3], radius: f64, noise: f64, seed: u64) -> Vec<Point> {
        let mut random = StdRng::seed_from_u64(seed);
        let mut points = Vec::new();
        for i in -40..=40 {
            for j in -40..=40 {
                let (x, y) = (f64::from(i) / 40.0 * radius * 1.2, f64::from(j) / 40.0 * radius * 1.2);
                let inside = radius * radius - x * x - y * y;
                let z = if inside > 0.15 * radius * radius {
                    centre[2] - inside.sqrt()
                } else {
                    centre[2] + 80.0
                };
                let stretch = 1.0 + noisy(&mut random, noise) / z;
                points.push(point([centre[0] + x, centre[1] + y, z].map(|value| stretch * value)));
            }
        }
        points
    }

    #[test]
    fn a_ball_before_a_wall_is_found_within_its_covariance() {
        let (centre, radius) = ([12.0, -7.0, 900.0], 25.0);
        let mut beyond = 0;
        for seed in 0..40 {
            let fit = robust_sphere(&ball(centre, radius, 0.05, seed), 24.5).unwrap();
            let off = fit.centre_mm - Vector3::from(centre);
            for (axis, error) in [off.x, off.y, off.z, fit.radius_mm - radius].into_iter().enumerate() {
                let sigma = fit.covariance_mm2[(axis, axis)].sqrt();
                assert!(sigma < 0.05, "{sigma}");
                beyond += usize::from(error.abs() > 3.0 * sigma);
            }
        }
        assert!(beyond <= 4, "{beyond} of 160 beyond three standard deviations");
    }

    #[test]
    fn a_plane_with_a_third_of_its_points_elsewhere_is_found() {
        let mut random = StdRng::seed_from_u64(3);
        let points: Vec<Point> = (0..3000)
            .map(|index| {
                let (x, y) = (random.random::<f64>() * 100.0, random.random::<f64>() * 80.0);
                let foreign = if index % 3 == 0 { 5.0 + 30.0 * random.random::<f64>() } else { 0.0 };
                point([x, y, 800.0 + 0.2 * x - 0.1 * y + foreign + noisy(&mut random, 0.05)])
            })
            .collect();
        let fit = robust_plane(&points).unwrap();
        let truth = Vector3::new(0.2, -0.1, -1.0).normalize();
        assert!((fit.normal - truth).norm() < 1e-3, "{:?}", fit.normal);
        assert!((fit.share - 2.0 / 3.0).abs() < 0.01, "{}", fit.share);
    }

    #[test]
    fn few_points_and_no_surface_are_refused() {
        let few = vec![point([1.0, 2.0, 3.0]); 99];
        assert_eq!(robust_plane(&few), Err(FitError::TooFew(99)));
        let same = vec![point([1.0, 2.0, 3.0]); 200];
        assert_eq!(robust_plane(&same), Err(FitError::NoSurface("plane")));
        assert_eq!(robust_sphere(&same, 5.0), Err(FitError::NoSurface("sphere")));
    }
}
