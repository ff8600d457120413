//! The gates: each check with its value and limit, and what a failure most likely means.

use polscan_reconstruction::geometry::Calibration;

use super::{
    adjust::{Block, Failure, Noise, Problem, State},
    coverage,
    estimate::{Estimate, residuals, rms},
    homography,
    initial::{board_pose, free},
    model::{ASPECT, Optics},
    report::{Check, Refusal, Report, ViewReport},
    setup::Setup,
};

/// What was solved, for checks that try something else.
pub(super) struct Case<'a> {
    pub(super) blocks: &'a [Block],
    pub(super) estimate: &'a Estimate,
    pub(super) calibration: &'a Calibration,
}

/// Neighbouring residuals that agree less than this are noise.
const NOISE_LIKE: f64 = 0.3;
/// A view that is bad in the fit itself is at least so many times worse than the median one.
const BAD_IN_FIT: f64 = 1.5;
/// No view is called an outlier for less, in px.
const LEAST_OUTLIER_PX: f64 = 0.1;

/// By a guessed lens tilts are wrong by so many times the limit for parallel views.
const GUESSED: f64 = 3.0;

/// Why there is no solution.
pub(super) fn unsolved(blocks: &[Block], setup: &Setup, failure: Failure) -> Refusal {
    parallel(blocks, setup, None).unwrap_or_else(|| match failure {
        Failure::Diverged => Refusal::new(
            "diverged",
            "the adjustment did not come to rest; check that all views are of one board and one camera, and tilt it more".into(),
        ),
        Failure::Singular => Refusal::new(
            "poorly-determined",
            "the views do not fix all parameters; add views tilted about both axes, in all parts of the image".into(),
        ),
    })
}

/// Why a solution is none: its numbers cannot be those of a lens.
pub(super) fn implausible(
    blocks: &[Block],
    setup: &Setup,
    estimate: &Estimate,
    faults: &[String],
) -> Refusal {
    parallel(blocks, setup, Some(estimate)).unwrap_or_else(|| {
        Refusal::new("diverged", format!("the solution cannot be a rig's: {}", faults.join("; ")))
    })
}

/// Whether all boards face the same way. Where nothing was solved, by a lens guessed from the image's size: a wrong
/// focal length scales tilts, but makes no tilt of none; distortion makes some, so that the limit is wider then.
fn parallel(blocks: &[Block], setup: &Setup, estimate: Option<&Estimate>) -> Option<Refusal> {
    let boards = if let Some(estimate) = estimate {
        estimate.fit.state.poses.clone()
    } else {
        let optics = guessed(setup);
        let noise = Noise { camera_px: 1.0, projector_px: 1.0, huber: 10.0 };
        blocks.iter().filter_map(|b| Some(board_pose(&optics, b, noise)?.0)).collect()
    };
    let angle = coverage::widest_angle(&boards);
    let limit = setup.gates.parallel_deg * if estimate.is_some() { 1.0 } else { GUESSED };
    (angle < limit).then(|| {
        let message = format!(
            "all views are parallel: the boards' tilts differ by {angle:.1} degrees at most, which does not fix the focal \
             length; tilt the board by 20 to 30 degrees, each time another way"
        );
        Refusal::new("parallel-views", message).against(angle, limit)
    })
}

fn guessed(setup: &Setup) -> Optics {
    let (width, height) = setup.camera.size;
    let focal = 2.0 * f64::from(width);
    let lens = polscan_reconstruction::geometry::Lens {
        width,
        height,
        fx: focal,
        fy: focal,
        cx: 0.5 * (f64::from(width) - 1.0),
        cy: 0.5 * (f64::from(height) - 1.0),
        distortion: [0.0; 5],
    };
    let rig = homography::pose(&nalgebra::Matrix3::identity(), &nalgebra::Matrix3::identity());
    let rig = rig.expect("the identity is a pose");
    Optics { camera: lens, projector: lens, rig, aspect: 1.0 }
}

/// Collects checks and what failed.
#[derive(Default)]
struct Verdict {
    checks: Vec<Check>,
    refusals: Vec<Refusal>,
}

impl Verdict {
    /// Notes `value <= limit`; what `refusal` makes of a failure is added.
    fn at_most(
        &mut self,
        name: &'static str,
        (value, view): (f64, Option<&str>),
        limit: f64,
        refusal: impl FnOnce() -> Refusal,
    ) {
        self.note(name, (value, view), limit, value <= limit, refusal);
    }

    fn at_least(&mut self, name: &'static str, value: f64, limit: f64, refusal: impl FnOnce() -> Refusal) {
        self.note(name, (value, None), limit, value >= limit, refusal);
    }

    fn note(
        &mut self,
        name: &'static str,
        (value, view): (f64, Option<&str>),
        limit: f64,
        passed: bool,
        refusal: impl FnOnce() -> Refusal,
    ) {
        let finite = value.is_finite().then_some(value);
        self.checks.push(Check { name, value: finite, limit, view: view.map(str::to_owned), passed });
        if !passed {
            let refusal = refusal().against(value, limit);
            self.refusals.push(view.map_or_else(|| refusal.clone(), |view| refusal.clone().of(view)));
        }
    }
}

/// All checks, and the reasons to refuse: causes before symptoms.
pub(super) fn judge(report: &Report, case: &Case) -> (Vec<Check>, Vec<Refusal>) {
    let mut verdict = Verdict::default();
    tilts(report, case, &mut verdict);
    fullness(report, &mut verdict);
    let culprit = outlier(report, &mut verdict);
    residual_checks(report, case, culprit, &mut verdict);
    certainty(report, &mut verdict);
    shapes(report, case, &mut verdict);
    sizes(report, case, &mut verdict);
    if let Some(view) = culprit {
        let (name, cause) = (&report.views[view].name, ["bumped-view", "blurred"]);
        verdict.refusals.retain(|r| r.view.as_ref() != Some(name) || cause.contains(&r.slug));
    }
    (verdict.checks, verdict.refusals)
}

fn tilts(report: &Report, case: &Case, verdict: &mut Verdict) {
    let gates = &report.setup.gates;
    let angle = coverage::widest_angle(&case.estimate.fit.state.poses);
    verdict.at_least("widest-angle", angle, gates.parallel_deg, || {
        parallel(case.blocks, &report.setup, Some(case.estimate))
            .unwrap_or_else(|| Refusal::new("parallel-views", "all views are parallel".into()))
    });
    for (axis, name) in ["tilt-range-x", "tilt-range-y"].into_iter().enumerate() {
        let (range, limit) = (report.tilt_range_deg[axis], gates.tilt_range_deg);
        verdict.at_least(name, range, limit, || {
            let message = format!(
                "tilts about the image's {} axis span only {range:.1} degrees, at least {limit:.0} are needed; add a view \
                 tilted that way",
                ["x", "y"][axis]
            );
            Refusal::new("tilt-range", message)
        });
    }
}

fn fullness(report: &Report, verdict: &mut Verdict) {
    let corners = ("quarters-with-corners", "coverage-camera", report.coverage.camera_corners);
    let points = ("quarters-with-plane-points", "coverage-projector", report.coverage.camera_plane_points);
    let wanted = if report.setup.projector.is_some() { 2 } else { 1 };
    for (name, slug, cells) in [corners, points].into_iter().take(wanted) {
        let empty = cells.empty_quarters();
        verdict.at_least(name, (4 - empty.len()) as f64, report.setup.gates.quarters as f64, || {
            let message = format!(
                "no view has the board in the {} of the camera's image{}; add one there",
                empty.join(" nor in the "),
                if slug == "coverage-projector" { " lit by the projector" } else { "" }
            );
            Refusal::new(slug, message)
        });
    }
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.collect();
    if values.is_empty() {
        return f64::NAN;
    }
    let middle = (values.len() - 1) / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}

/// Worst of camera and projector: how many times worse than the median view, and that view's rms.
fn ratio(report: &Report, view: usize, rms: impl Fn(&ViewReport) -> Option<[Option<f64>; 2]>) -> (f64, f64) {
    let side = |k: usize| {
        let own = rms(&report.views[view]).and_then(|r| r[k])?;
        let typical = median(report.views.iter().filter_map(|v| rms(v)?[k]));
        Some((own / typical.max(1e-6), own))
    };
    let sides = [side(0), side(1)].into_iter().flatten();
    sides.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, 0.0))
}

fn in_fit(view: &ViewReport) -> Option<[Option<f64>; 2]> {
    Some([Some(view.camera_rms_px), view.projector_rms_px])
}

fn held_out(view: &ViewReport) -> Option<[Option<f64>; 2]> {
    view.held_out.map(|h| [Some(h.camera_rms_px), h.projector_rms_px])
}

/// One view among others that does not go with them.
fn outlier(report: &Report, verdict: &mut Verdict) -> Option<usize> {
    let gates = &report.setup.gates;
    let views = 0..report.views.len();
    let (view, (worst, rms_px)) =
        views.map(|k| (k, ratio(report, k, held_out))).max_by(|a, b| a.1.0.total_cmp(&b.1.0))?;
    let seen = &report.views[view];
    let (fit_ratio, _) = ratio(report, view, in_fit);
    let is_outlier = worst > gates.outlier_ratio && fit_ratio > BAD_IN_FIT && rms_px > LEAST_OUTLIER_PX;
    let value = (worst, Some(seen.name.as_str()));
    verdict.note("outlier-ratio", value, gates.outlier_ratio, !is_outlier, || {
        let name = &seen.name;
        if seen.smoothness < NOISE_LIKE {
            let message = format!(
                "view {name} is blurred or dark: {rms_px:.2} px without it in the solution, {worst:.1} times the other \
                 views, and without pattern; drop it or take it again in focus"
            );
            return Refusal::new("blurred", message);
        }
        let message = format!(
            "view {name} does not go with the others: {rms_px:.2} px when the calibration is made without it, {worst:.1} \
             times the other views: camera, projector or board was bumped while it was taken; drop it"
        );
        Refusal::new("bumped-view", message)
    });
    is_outlier.then_some(view)
}

fn worst(report: &Report, of: impl Fn(&ViewReport) -> Option<f64>) -> (f64, Option<&str>) {
    let values = report.views.iter().filter_map(|v| Some((of(v)?, Some(v.name.as_str()))));
    values.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((0.0, None))
}

fn residual_checks(report: &Report, case: &Case, culprit: Option<usize>, verdict: &mut Verdict) {
    let gates = &report.setup.gates;
    // Where one view is the cause, it says so already; the sums that it spoils are no further reasons. A bad fit in turn
    // explains a view held out.
    let keep = verdict.refusals.len();
    let camera = report.camera_rms_px;
    verdict.at_most("camera-rms", (camera, None), gates.camera_rms_px, || camera_rms(report, case));
    if let Some(projector) = report.projector_rms_px {
        verdict.at_most("projector-rms", (projector, None), gates.projector_rms_px, || {
            let message = format!(
                "projector reprojection is {projector:.3} px, at most {:.2} is allowed; check focus and exposure of the \
                 scans, that the board is flat, and that camera and projector are fixed to each other",
                gates.projector_rms_px
            );
            Refusal::new("projector-rms", message)
        });
    }
    let explained = if culprit.is_some() { keep } else { verdict.refusals.len().max(keep + 1) };
    let held = worst(report, |v| v.held_out.map(|h| h.camera_rms_px.max(h.projector_rms_px.unwrap_or(0.0))));
    verdict.at_most("held-out", held, gates.held_out_px, || {
        let message = format!(
            "view {} is {:.2} px off when the calibration is made without it, at most {:.2} is allowed: it alone covers \
             its part of the volume; add views like it",
            held.1.unwrap_or_default(),
            held.0,
            gates.held_out_px
        );
        Refusal::new("held-out", message)
    });
    verdict.refusals.truncate(explained);
    let unstable = report.views.len() >= 4 && report.views.iter().any(|v| v.held_out.is_none());
    verdict.note("held-out-solved", (f64::from(u8::from(unstable)), None), 0.0, !unstable, || {
        let view = report.views.iter().find(|v| v.held_out.is_none()).map_or("", |v| &v.name);
        let message = format!("without view {view} the others give no solution; add views");
        Refusal::new("poorly-determined", message)
    });
    let left_out = worst(report, |v| {
        let share = |left: usize, used: usize| left as f64 / ((left + used) as f64).max(1.0);
        Some(share(v.left_out[0], v.corners).max(share(v.left_out[1], v.plane_points)))
    });
    verdict.at_most("left-out-share", left_out, gates.outlier_share, || {
        Refusal::new(
            "outliers",
            format!("view {} has too many wrong points; drop it", left_out.1.unwrap_or("")),
        )
    });
}

/// What a bad fit of the corners means: a board of another shape, noise, or something bent.
fn camera_rms(report: &Report, case: &Case) -> Refusal {
    let (rms_px, limit) = (report.camera_rms_px, report.setup.gates.camera_rms_px);
    let intro = format!("camera reprojection is {rms_px:.3} px, at most {limit:.2} is allowed");
    if let Some((aspect, better)) = other_aspect(case)
        && better < 0.6 * rms_px
        && (aspect - 1.0).abs() > 1e-3
    {
        let message = format!(
            "{intro}; with squares {aspect:.4} times as high as they are wide it would be {better:.3} px: measure the \
             board along both sides and correct its description"
        );
        return Refusal::new("board-shape", message);
    }
    let smoothness = median(report.views.iter().map(|v| v.smoothness));
    if smoothness < NOISE_LIKE {
        let message = format!(
            "{intro}, in all views and without pattern: the pictures are blurred, dark or moving; focus, light the board, \
             and hold it still"
        );
        Refusal::new("blurred", message)
    } else {
        let message = format!(
            "{intro}, and neighbouring corners are off the same way: the board is bent, its description is wrong, or the \
             lens needs k3"
        );
        Refusal::new("camera-rms", message)
    }
}

/// Height over width of the squares that fits the corners best, and the camera's rms with it.
fn other_aspect(case: &Case) -> Option<(f64, f64)> {
    let blocks: Vec<Block> =
        case.blocks.iter().map(|b| Block { plane_points: Vec::new(), ..b.clone() }).collect();
    let mut free = free(&[0, 1, 2, 3, 4, 5, 6, 7], &[], false);
    free[ASPECT] = true;
    let State { optics, poses } = case.estimate.fit.state.clone();
    let problem =
        Problem { blocks: &blocks, noise: case.estimate.noise, free, poses_free: true, priors: &[] };
    let state = problem.solve(State { optics, poses }).ok()?.state;
    let found = residuals(&state, &blocks);
    Some((state.optics.aspect, rms(found.iter().flat_map(|r| &r.camera))))
}

fn certainty(report: &Report, verdict: &mut Verdict) {
    let limit = report.setup.gates.focal_sigma_share;
    for (check, who) in [("camera-focal-sigma", "camera"), ("projector-focal-sigma", "projector")] {
        let focal = report.parameters.iter().filter(|p| p.name.starts_with(&format!("{who}.f")));
        let Some(share) = focal.map(|p| p.sigma / p.value).reduce(f64::max) else { continue };
        verdict.at_most(check, (share, None), limit, || {
            let message = format!(
                "the {who}'s focal length is known to {:.2} % only, {:.2} % is allowed; add views tilted by 20 to 30 degrees, \
                 near and far",
                100.0 * share,
                100.0 * limit
            );
            Refusal::new("poorly-determined", message)
        });
    }
}

fn shapes(report: &Report, case: &Case, verdict: &mut Verdict) {
    let gates = &report.setup.gates;
    let lenses = [
        ("camera-aspect", "camera", Some(case.calibration.camera)),
        ("projector-aspect", "projector", case.calibration.projector.map(|p| p.lens)),
    ];
    for (check, who, lens) in lenses {
        let Some(lens) = lens else { continue };
        let aspect = lens.fx / lens.fy;
        verdict.at_most(check, ((aspect - 1.0).abs(), None), gates.aspect_share, || {
            let message = format!(
                "the {who}'s fx/fy is {aspect:.4}: unless its pixels are not square, the board's squares are not; measure the \
                 board along both sides"
            );
            Refusal::new("board-shape", message)
        });
    }
    let bow = worst(report, |v| Some(v.flatness?.bow_mm / v.distance_mm));
    if report.setup.projector.is_some() {
        verdict.at_most("bow", bow, gates.bow_share, || {
            let name = bow.1.unwrap_or_default();
            let message = format!(
                "the board of view {name} comes out bent by {:.2} ‰ of its distance, {:.2} are allowed: the board is not \
                 flat, or the projector's lens is not well known there; check it with a straight edge",
                1e3 * bow.0,
                1e3 * gates.bow_share
            );
            Refusal::new("not-flat", message)
        });
    }
}

fn sizes(report: &Report, case: &Case, verdict: &mut Verdict) {
    let (setup, gates) = (&report.setup, &report.setup.gates);
    let (width, height) = (f64::from(setup.camera.size.0), f64::from(setup.camera.size.1));
    let lens = &case.calibration.camera;
    let off =
        |width: f64, height: f64| (lens.cx - 0.5 * width).hypot(lens.cy - 0.5 * height) / width.max(height);
    verdict.at_most("camera-principal-point", (off(width, height), None), gates.principal_share, || {
        let place = format!("the camera's principal point comes out at ({:.0}, {:.0})", lens.cx, lens.cy);
        if width != height && off(height, width) < gates.principal_share {
            let message = format!("{place}, the middle of a {height}x{width} image: width and height are exchanged");
            return Refusal::new("swapped-size", message);
        }
        let message = format!(
            "{place}, far from the middle of {width}x{height} px; give the size of the whole image, not of a region, or add \
             tilted views"
        );
        Refusal::new("principal-point", message)
    });
    let advice = |scale: f64| {
        format!("measure a square of the board: one of {scale:.3} times the given size would agree")
    };
    if let (Some(expected), Some(projector)) = (setup.baseline_mm, case.calibration.projector) {
        let found = projector.projector_from_camera.translation_mm.norm();
        verdict.at_most("baseline", ((found / expected - 1.0).abs(), None), gates.baseline_share, || {
            let message = format!(
                "the baseline comes out as {found:.1} mm, {expected:.1} mm is known; {}",
                advice(expected / found)
            );
            Refusal::new("board-size", message)
        });
    }
    if let Some([near, far]) = setup.distance_mm {
        let found = median(report.views.iter().map(|v| v.distance_mm));
        let beyond = (near / found).max(found / far);
        verdict.at_most("distance", (beyond, None), 1.0, || {
            let scale = if found < near { near / found } else { far / found };
            let message = format!(
                "the boards come out {found:.0} mm away, {near:.0} to {far:.0} mm is known; {}",
                advice(scale)
            );
            Refusal::new("board-size", message)
        });
    }
}
