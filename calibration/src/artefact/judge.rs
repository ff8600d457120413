//! Measured against known, each with how far the measurement can be trusted.

use nalgebra::Vector3;
use polscan_reconstruction::cloud::fit_plane;
use serde::{Deserialize, Serialize};

use super::{
    Artefact,
    description::Region,
    fit::{FittedPlane, FittedSphere, Point, robust_plane, robust_sphere, scatter},
};

/// Least share of a plane's points that must lie on it: a plate with something on it is not the artefact.
const PLANE_SHARE: f64 = 0.9;

/// A measurement whose noise alone may use up this share of what is tolerated tells nothing.
const NOISE_SHARE: f64 = 1.0 / 3.0;

/// A point and the camera pixel that it is seen at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PixelPoint {
    /// Column of the camera's image.
    pub x: u32,
    /// Row.
    pub y: u32,
    /// Point.
    pub point: Point,
}

/// What is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Kind {
    /// Peak to peak of the quadratic that fits a plane's points best.
    Bow,
    /// Root mean square distance of points from their plane.
    Rms,
    /// Distance of two planes.
    Height,
    /// Diameter of a ball.
    Diameter,
    /// Distance of two balls.
    Distance,
}

/// One quantity of the artefact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Check {
    /// Part of the artefact.
    pub name: String,
    /// Quantity.
    pub kind: Kind,
    /// What it should be, in mm; 0 for errors of form.
    pub nominal_mm: f64,
    /// What it is; `None` where it could not be measured.
    pub measured_mm: Option<f64>,
    /// Standard deviation of the measured value, of noise alone; 0 for errors of form.
    pub sigma_mm: Option<f64>,
    /// Most that measured and nominal may differ.
    pub tolerance_mm: f64,
    /// Whether they do not differ by more.
    pub passed: bool,
    /// Why not, in words.
    pub reason: Option<String>,
}

/// What became of an artefact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Accepted {
    /// Every check passed.
    pub passed: bool,
    /// All checks, in the order of the description.
    pub checks: Vec<Check>,
}

/// Measures the artefact in a cloud. A check that cannot be made fails, with the reason.
pub fn judge(artefact: &Artefact, points: &[PixelPoint]) -> Accepted {
    let planes: Vec<_> = artefact.planes.iter().map(|plane| on_plane(points, plane.region)).collect();
    let balls: Vec<_> = artefact
        .balls
        .iter()
        .map(|ball| robust_sphere(&within(points, ball.region), 0.5 * ball.diameter_mm))
        .collect();
    let plane = |name: &str| find(&artefact.planes, &planes, |plane| plane.name == name);
    let ball = |name: &str| find(&artefact.balls, &balls, |ball| ball.name == name);
    let mut checks = Vec::new();
    for (known, found) in artefact.planes.iter().zip(&planes) {
        let form = |kind, limit: Option<f64>, value: fn(&FittedPlane) -> f64| {
            let tolerance_mm = limit?;
            let found = found.as_ref().map(|found| (value(found), 0.0)).map_err(Clone::clone);
            Some(check(&known.name, kind, 0.0, tolerance_mm, found))
        };
        checks.extend(form(Kind::Bow, known.bow_mm, bow));
        checks.extend(form(Kind::Rms, known.rms_mm, |found| found.rms_mm));
    }
    for step in &artefact.steps {
        let height = plane(&step.upper).and_then(|upper| Ok(height(upper, plane(&step.lower)?)));
        checks.push(check(&step.name, Kind::Height, step.height_mm, step.tolerance_mm, height));
    }
    for (known, found) in artefact.balls.iter().zip(&balls) {
        let diameter = found
            .as_ref()
            .map_err(|error| error.to_string())
            .map(|found| (2.0 * found.radius_mm, 2.0 * found.covariance_mm2[(3, 3)].max(0.0).sqrt()));
        checks.push(check(&known.name, Kind::Diameter, known.diameter_mm, known.tolerance_mm, diameter));
    }
    for known in &artefact.distances {
        let [from, to] = &known.between;
        let apart = ball(from).and_then(|from| Ok(apart(from, ball(to)?)));
        checks.push(check(&known.name, Kind::Distance, known.distance_mm, known.tolerance_mm, apart));
    }
    Accepted { passed: checks.iter().all(|check| check.passed), checks }
}

fn within(points: &[PixelPoint], [x, y, width, height]: Region) -> Vec<Point> {
    let inside = |start: u32, length: u32, at: u32| at >= start && at - start < length;
    let seen = points.iter().filter(|point| inside(x, width, point.x) && inside(y, height, point.y));
    seen.map(|point| point.point).collect()
}

fn on_plane(points: &[PixelPoint], region: Region) -> Result<FittedPlane, String> {
    let found = robust_plane(&within(points, region)).map_err(|error| error.to_string())?;
    if found.share < PLANE_SHARE {
        return Err(format!(
            "only {:.0} % of the points of its region lie on one plane; move the region off borders and dirt",
            100.0 * found.share
        ));
    }
    Ok(found)
}

fn find<'a, K, T, E: ToString>(
    known: &[K],
    found: &'a [Result<T, E>],
    named: impl Fn(&K) -> bool,
) -> Result<&'a T, String> {
    let index = known.iter().position(named).ok_or("the artefact has no part of that name")?;
    found[index].as_ref().map_err(ToString::to_string)
}

fn bow(found: &FittedPlane) -> f64 {
    let points: Vec<[f64; 3]> = found.inliers.iter().map(|point| point.mm).collect();
    // A plane was fitted to these points, so that they span one.
    fit_plane(&points).map_or(f64::INFINITY, |fit| fit.bow_mm)
}

/// Distance of two planes along their common normal, and its standard deviation.
fn height(upper: &FittedPlane, lower: &FittedPlane) -> (f64, f64) {
    let spread = scatter(&upper.inliers, &upper.centroid_mm) + scatter(&lower.inliers, &lower.centroid_mm);
    let eigen = nalgebra::SymmetricEigen::new(spread);
    let normal: Vector3<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    let between = upper.centroid_mm - lower.centroid_mm;
    let height = normal.dot(&between).abs();
    let mean = |plane: &FittedPlane| plane.rms_mm.powi(2) / plane.inliers.len() as f64;
    let noise = upper.rms_mm.max(lower.rms_mm).powi(2);
    // A tilt of the common normal lifts one plane over the other by its lever across.
    let tilt: f64 = (0..3)
        .filter(|&axis| axis != eigen.eigenvalues.imin())
        .map(|axis| {
            let lever: f64 = eigen.eigenvectors.column(axis).dot(&between);
            noise * lever.powi(2) / eigen.eigenvalues[axis].max(f64::MIN_POSITIVE)
        })
        .sum();
    (height, (mean(upper) + mean(lower) + tilt).sqrt())
}

/// Distance of two centres and its standard deviation.
fn apart(from: &FittedSphere, to: &FittedSphere) -> (f64, f64) {
    let between = to.centre_mm - from.centre_mm;
    let direction = between.try_normalize(1e-9).unwrap_or_else(Vector3::x);
    let covariance = (from.covariance_mm2 + to.covariance_mm2).fixed_view::<3, 3>(0, 0).into_owned();
    (between.norm(), direction.dot(&(covariance * direction)).max(0.0).sqrt())
}

fn check(
    name: &str,
    kind: Kind,
    nominal_mm: f64,
    tolerance_mm: f64,
    found: Result<(f64, f64), String>,
) -> Check {
    let (measured_mm, sigma_mm, reason) = match found {
        Err(reason) => (None, None, Some(reason)),
        Ok((measured, sigma)) => {
            let off = (measured - nominal_mm).abs();
            let reason = if off > tolerance_mm {
                Some(format!("off by {off:.3} mm, {tolerance_mm:.3} are tolerated; calibrate the rig again"))
            } else if sigma > NOISE_SHARE * tolerance_mm {
                Some(format!(
                    "its noise of {sigma:.3} mm is too much to tell whether it is within {tolerance_mm:.3}; \
                     enlarge its region or light it better"
                ))
            } else {
                None
            };
            (Some(measured), Some(sigma), reason)
        }
    };
    let passed = reason.is_none();
    Check { name: name.to_owned(), kind, nominal_mm, measured_mm, sigma_mm, tolerance_mm, passed, reason }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::artefact::{Ball, Distance, Plane, Step};

    /// Noise of either sign that no two neighbours share.
    fn noise(index: usize) -> f64 {
        0.05 * (((index * 7919) % 1000) as f64 / 500.0 - 1.0)
    }

    /// An image of 200 x 100 pixels, one mm each, of `depth`.
    fn image(depth: impl Fn(f64, f64) -> f64) -> Vec<PixelPoint> {
        let pixels = (0..100u32).flat_map(|y| (0..200u32).map(move |x| (x, y)));
        pixels
            .enumerate()
            .map(|(index, (x, y))| {
                let (mm_x, mm_y) = (f64::from(x), f64::from(y));
                let point = Point { mm: [mm_x, mm_y, depth(mm_x, mm_y) + noise(index)], sigma_z_mm: 0.03 };
                PixelPoint { x, y, point }
            })
            .collect()
    }

    fn steps(height_mm: f64, bend: f64) -> (Artefact, Vec<PixelPoint>) {
        let plane =
            |name: &str, region| Plane { name: name.into(), region, bow_mm: Some(0.1), rms_mm: Some(0.1) };
        let step = Step {
            name: "step".into(),
            upper: "top".into(),
            lower: "bottom".into(),
            height_mm: 10.0,
            tolerance_mm: 0.05,
        };
        let artefact = Artefact {
            name: "steps".into(),
            planes: vec![plane("top", [5, 5, 90, 90]), plane("bottom", [105, 5, 90, 90])],
            steps: vec![step],
            balls: Vec::new(),
            distances: Vec::new(),
        };
        let tilted = move |x: f64, y: f64| {
            // Perpendicular to the tilted planes, so that the height is that of the step.
            let rise = if x < 100.0 { -height_mm * (1.0f64 + 0.01 + 0.0025).sqrt() } else { 0.0 };
            800.0 + 0.1 * x + 0.05 * y + rise + bend * (x - 50.0).powi(2) / 2500.0
        };
        (artefact, image(tilted))
    }

    #[test]
    fn a_right_rig_passes_and_each_check_says_what_it_measured() {
        let (artefact, points) = steps(10.0, 0.0);
        assert_eq!(artefact.check(), Ok(()));
        let accepted = judge(&artefact, &points);
        assert!(accepted.passed, "{accepted:?}");
        let height = accepted.checks.last().unwrap();
        assert!((height.measured_mm.unwrap() - 10.0).abs() < 0.005, "{height:?}");
        assert!((0.0002..0.005).contains(&height.sigma_mm.unwrap()), "{height:?}");
    }

    #[test]
    fn a_wrong_height_and_a_bent_plate_fail_by_name() {
        let failed = |(artefact, points): (Artefact, Vec<PixelPoint>)| -> Vec<(String, Kind)> {
            let checks = judge(&artefact, &points).checks;
            checks.into_iter().filter(|check| !check.passed).map(|check| (check.name, check.kind)).collect()
        };
        assert_eq!(failed(steps(10.08, 0.0)), [("step".to_owned(), Kind::Height)]);
        let bent = failed(steps(10.0, 0.3));
        assert!(bent.contains(&("top".to_owned(), Kind::Bow)), "{bent:?}");
    }

    #[test]
    fn balls_and_their_distance() {
        let centres = [[50.0, 50.0], [150.0, 50.0]];
        let depth = |x: f64, y: f64| {
            let on = centres.iter().find_map(|[cx, cy]| {
                let inside = 400.0 - (x - cx).powi(2) - (y - cy).powi(2);
                (inside > 60.0).then(|| 800.0 - inside.sqrt())
            });
            on.unwrap_or(850.0)
        };
        let ball = |name: &str, x: u32| Ball {
            name: name.into(),
            region: [x, 30, 40, 40],
            diameter_mm: 40.0,
            tolerance_mm: 0.1,
        };
        let distance = |distance_mm| Distance {
            name: "bar".into(),
            between: ["left".into(), "right".into()],
            distance_mm,
            tolerance_mm: 0.05,
        };
        let artefact = |distance_mm| Artefact {
            name: "ball bar".into(),
            planes: Vec::new(),
            steps: Vec::new(),
            balls: vec![ball("left", 30), ball("right", 130)],
            distances: vec![distance(distance_mm)],
        };
        let points = image(depth);
        let right = judge(&artefact(100.0), &points);
        assert!(right.passed, "{right:?}");
        let wrong = judge(&artefact(100.2), &points);
        let failed: Vec<&str> =
            wrong.checks.iter().filter(|check| !check.passed).map(|check| check.name.as_str()).collect();
        assert_eq!(failed, ["bar"], "{wrong:?}");
    }

    #[test]
    fn what_is_not_seen_fails_and_is_not_passed_over() {
        let (artefact, _) = steps(10.0, 0.0);
        let accepted = judge(&artefact, &[]);
        assert!(!accepted.passed);
        assert!(accepted.checks.iter().all(|check| check.measured_mm.is_none() && check.reason.is_some()));
    }

    #[test]
    fn all_faults_of_a_description_are_told_at_once() {
        let (mut artefact, _) = steps(10.0, 0.0);
        artefact.steps[0].lower = "floor".into();
        artefact.steps[0].tolerance_mm = -1.0;
        artefact.planes[0].region[2] = 0;
        artefact.planes[1].name = "top".into();
        assert_eq!(artefact.check().unwrap_err().faults.len(), 4, "{:?}", artefact.check());
    }
}
