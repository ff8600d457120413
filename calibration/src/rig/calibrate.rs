//! From views to an accepted calibration, or to the reasons against one.

use nalgebra::{DMatrix, Rotation3, UnitQuaternion, Vector2, Vector3};
use polscan_reconstruction::{
    cloud::fit_plane,
    geometry::{Calibration, Lens, Measurement, Pose, Projector, Quality, Triangulator},
};
use rayon::prelude::*;

use super::{
    adjust::{Block, Covariance},
    coverage::{self, Coverage},
    estimate::{Estimate, Residuals, Task, rms},
    judge::{self, Case},
    model::{ASPECT, GLOBALS, PROJECTOR, RIG, lens_numbers},
    precheck,
    report::{Calibrated, Correlation, Flatness, HeldOut, Parameter, Refused, Report, ViewReport},
    sample::thinned,
    setup::Setup,
};
use crate::observation::View;

/// Correlations from here on are listed.
const CORRELATED: f64 = 0.95;
/// Residuals of one view whose neighbours are looked for.
const NEIGHBOURS: usize = 300;
/// How the file says that it was made.
const METHOD: &str = "joint bundle adjustment of board views";

/// Calibrates a camera, or camera and projector, from views of a board.
///
/// # Errors
/// [`Refused`] with every reason: what is wrong with the views, with the solution, or that there is none.
pub fn calibrate(views: &[View], setup: &Setup) -> Result<Calibrated, Refused> {
    let refusals = precheck::refusals(views, setup);
    if !refusals.is_empty() {
        return Err(Refused { refusals, report: None });
    }
    let limit = if setup.projector.is_some() { setup.plane_points_per_view } else { 0 };
    let blocks: Vec<Block> = views
        .par_iter()
        .map(|v| Block { corners: v.corners.clone(), plane_points: thinned(&v.plane_points, limit) })
        .collect();
    let task = Task::new(setup);
    let estimate = task.estimate(&blocks).map_err(|failure| Refused {
        refusals: vec![judge::unsolved(&blocks, setup, failure)],
        report: None,
    })?;
    let calibration = calibration_of(&estimate, setup);
    let faults = calibration.faults();
    if !faults.is_empty() {
        let refusals = vec![judge::implausible(&blocks, setup, &estimate, &faults)];
        return Err(Refused { refusals, report: None });
    }
    let held_out = held_out(&task, &estimate);
    let mut report = report(views, &task, &estimate, &calibration, &held_out);
    let case = Case { blocks: &blocks, estimate: &estimate, calibration: &calibration };
    let (checks, refusals) = judge::judge(&report, &case);
    report.checks = checks;
    if !refusals.is_empty() {
        return Err(Refused { refusals, report: Some(Box::new(report)) });
    }
    let (_, covariance) = parameters(&task, &estimate);
    let board_covariances = estimate.fit.covariance.poses;
    Ok(Calibrated { calibration, boards: estimate.fit.state.poses, board_covariances, covariance, report })
}

fn calibration_of(estimate: &Estimate, setup: &Setup) -> Calibration {
    let optics = &estimate.fit.state.optics;
    let projector = setup
        .projector
        .is_some()
        .then_some(Projector { lens: optics.projector, projector_from_camera: optics.rig });
    let all =
        |pick: fn(&Residuals) -> &Vec<Option<Vector2<f64>>>| rms(estimate.residuals.iter().flat_map(pick));
    let quality = Quality {
        camera_rms_px: Some(all(|r| &r.camera)),
        projector_rms_px: projector.map(|_| all(|r| &r.projector)),
        views: u32::try_from(estimate.blocks.len()).ok(),
        date: None,
        method: Some(METHOD.to_owned()),
    };
    Calibration { camera: optics.camera, projector, world_from_camera: None, quality }
}

/// Every view against the calibration from all others. Empty where too few would be left.
fn held_out(task: &Task, estimate: &Estimate) -> Vec<Option<Residuals>> {
    let views = estimate.blocks.len();
    if views < 4 {
        return vec![None; views];
    }
    (0..views).into_par_iter().map(|view| task.without(estimate, view).ok().map(|(seen, _)| seen)).collect()
}

fn report(
    views: &[View],
    task: &Task,
    estimate: &Estimate,
    calibration: &Calibration,
    held_out: &[Option<Residuals>],
) -> Report {
    let setup = task.setup;
    let boards = &estimate.fit.state.poses;
    let triangulator = Triangulator::new(calibration).ok();
    let rig = setup.projector.is_some();
    let views_reported = (0..views.len()).into_par_iter().map(|k| {
        let (block, residuals) = (&estimate.blocks[k], &estimate.residuals[k]);
        let held_out = held_out[k].as_ref().map(|seen| HeldOut {
            camera_rms_px: rms(seen.camera.iter()),
            projector_rms_px: rig.then(|| rms(seen.projector.iter())),
        });
        ViewReport {
            name: views[k].name.clone(),
            corners: block.corners.len(),
            plane_points: block.plane_points.len(),
            left_out: estimate.dropped[k],
            camera_rms_px: rms(residuals.camera.iter()),
            projector_rms_px: rig.then(|| rms(residuals.projector.iter())),
            held_out,
            smoothness: smoothness(block, residuals),
            tilt_deg: coverage::tilt(&boards[k]),
            distance_mm: middle(block, &boards[k]).z,
            flatness: triangulator
                .as_ref()
                .and_then(|t| flatness(t, &calibration.camera, block, estimate.noise.projector_px)),
        }
    });
    let observations: usize =
        estimate.blocks.iter().map(|b| 2 * (b.corners.len() + b.plane_points.len())).sum();
    let degrees_of_freedom = observations.saturating_sub(task.parameters(views.len())).max(1);
    let (parameters, covariance) = parameters(task, estimate);
    Report {
        setup: setup.clone(),
        camera_rms_px: calibration.quality.camera_rms_px.unwrap_or_default(),
        projector_rms_px: calibration.quality.projector_rms_px,
        sigma_camera_px: estimate.noise.camera_px,
        sigma_projector_px: rig.then_some(estimate.noise.projector_px),
        chi_square: estimate.fit.cost / degrees_of_freedom as f64,
        degrees_of_freedom,
        correlations: correlations(&parameters, &covariance),
        parameters,
        views: views_reported.collect(),
        coverage: Coverage::of(views, setup),
        tilt_range_deg: coverage::tilt_range(boards),
        checks: Vec::new(),
    }
}

fn middle(block: &Block, board: &Pose) -> Vector3<f64> {
    let on_board = block.corners.iter().map(|c| Vector3::new(c.board_mm[0], c.board_mm[1], 0.0));
    board.transform(&(on_board.sum::<Vector3<f64>>() / block.corners.len().max(1) as f64))
}

/// Names and units of all shared parameters.
fn name(k: usize) -> (String, &'static str) {
    const NUMBERS: [&str; 9] = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3"];
    const POSE: [&str; 6] = ["turn_x", "turn_y", "turn_z", "shift_x", "shift_y", "shift_z"];
    let unit = |k: usize| if k < 4 { "px" } else { "1" };
    match k {
        0..PROJECTOR => (format!("camera.{}", NUMBERS[k]), unit(k)),
        PROJECTOR..RIG => (format!("projector.{}", NUMBERS[k - PROJECTOR]), unit(k - PROJECTOR)),
        RIG..ASPECT => (format!("rig.{}", POSE[k - RIG]), if k < RIG + 3 { "rad" } else { "mm" }),
        _ => ("board.aspect".to_owned(), "1"),
    }
}

/// Parameters that were free, and their covariance.
fn parameters(task: &Task, estimate: &Estimate) -> (Vec<Parameter>, DMatrix<f64>) {
    let optics = &estimate.fit.state.optics;
    let Covariance { globals, .. } = &estimate.fit.covariance;
    let turn = Rotation3::from_matrix_unchecked(optics.rig.rotation);
    let turn = UnitQuaternion::from_rotation_matrix(&turn).scaled_axis();
    let (camera, projector) = (lens_numbers(&optics.camera), lens_numbers(&optics.projector));
    let pose = turn.iter().chain(optics.rig.translation_mm.iter());
    let values: Vec<f64> = camera.iter().chain(&projector).chain(pose).copied().collect();
    let free: Vec<usize> = (0..GLOBALS).filter(|&k| task.free[k]).collect();
    let parameters = free.iter().map(|&k| {
        let (name, unit) = name(k);
        Parameter { name, unit, value: values[k], sigma: globals[(k, k)].sqrt() }
    });
    let covariance = DMatrix::from_fn(free.len(), free.len(), |i, j| globals[(free[i], free[j])]);
    (parameters.collect(), covariance)
}

fn correlations(parameters: &[Parameter], covariance: &DMatrix<f64>) -> Vec<Correlation> {
    let mut found = Vec::new();
    for (i, first) in parameters.iter().enumerate() {
        for (j, second) in parameters.iter().enumerate().skip(i + 1) {
            let coefficient = covariance[(i, j)] / (first.sigma * second.sigma);
            if coefficient.abs() > CORRELATED {
                found.push(Correlation {
                    first: first.name.clone(),
                    second: second.name.clone(),
                    coefficient,
                });
            }
        }
    }
    found
}

/// How much residuals agree with that of the nearest neighbour, as a share of their square; the worse of camera and
/// projector.
fn smoothness(block: &Block, residuals: &Residuals) -> f64 {
    let corners = block.corners.iter().map(|c| c.camera_px).zip(&residuals.camera);
    let every = block.plane_points.len().div_ceil(NEIGHBOURS).max(1);
    let points = block.plane_points.iter().map(|p| p.camera_px).zip(&residuals.projector).step_by(every);
    agreement(corners.collect()).max(agreement(points.collect()))
}

fn agreement(residuals: Vec<([f64; 2], &Option<Vector2<f64>>)>) -> f64 {
    let known: Vec<([f64; 2], Vector2<f64>)> =
        residuals.into_iter().filter_map(|(at, residual)| Some((at, (*residual)?))).collect();
    let away = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let (mut product, mut square) = (0.0, 0.0);
    for (k, (at, residual)) in known.iter().enumerate() {
        let others = known.iter().enumerate().filter(|(other, _)| *other != k).map(|(_, other)| other);
        if let Some(nearest) = others.min_by(|a, b| away(a.0, *at).total_cmp(&away(b.0, *at))) {
            product += residual.dot(&nearest.1);
            square += residual.norm_squared();
        }
    }
    if square > 0.0 { product / square } else { 0.0 }
}

/// Triangulates the plane points, without what is known of the board, and fits a plane.
fn flatness(triangulator: &Triangulator, camera: &Lens, block: &Block, sigma_px: f64) -> Option<Flatness> {
    let mut variance = 0.0;
    let mut points = Vec::with_capacity(block.plane_points.len());
    for point in &block.plane_points {
        let [x, y] = point.camera_px.map(f64::round);
        let inside =
            (0.0..f64::from(camera.width)).contains(&x) && (0.0..f64::from(camera.height)).contains(&y);
        // Rays are those of whole pixels.
        if !inside || (point.camera_px[0] - x).hypot(point.camera_px[1] - y) > 1e-3 {
            continue;
        }
        let [column, row] = point.projector_px;
        let measured = Measurement { column, sigma_column: sigma_px, row, sigma_row: sigma_px };
        if let Some(solution) = triangulator.solve(x as usize, y as usize, &measured) {
            points.push(solution.point_mm);
            variance += solution.sigma_z_mm * solution.sigma_z_mm;
        }
    }
    let plane = fit_plane(&points).ok()?;
    Some(Flatness {
        points: plane.points,
        rms_mm: plane.rmse_mm,
        // The error lies along the ray, nearly z; the distance is taken along the normal.
        expected_rms_mm: (variance / points.len() as f64).sqrt() * plane.normal[2].abs(),
        bow_mm: plane.bow_mm,
    })
}
