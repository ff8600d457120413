//! What goes wrong with views, and what it is called.

use nalgebra::Rotation3;
use polscan_reconstruction::geometry::Pose;
use rand::{SeedableRng, rngs::StdRng};
use rayon::prelude::*;

use super::truth::{Made, P3, Truth, normal};
use crate::{
    observation::View,
    rig::{Calibrated, Refused, Setup, calibrate, guidance},
};

const NOISE: Made = Made { camera_px: 0.05, projector_px: 0.1, every_px: 36 };

fn setup() -> Setup {
    Setup::rig((1600, 1200), (1024, 768))
}

fn good(seed: u64) -> (Truth, Vec<View>) {
    let truth = Truth::random(seed, 10);
    let views = truth.views(NOISE, seed);
    (truth, views)
}

/// Slugs of the refusal, the first one first.
fn refused(found: Result<Calibrated, Refused>) -> (Vec<&'static str>, Refused) {
    let refused = found.expect_err("a refusal");
    assert!(!refused.refusals.is_empty());
    println!("{refused}");
    (refused.refusals.iter().map(|r| r.slug).collect(), refused)
}

#[test]
fn good_rigs_are_accepted_and_found() {
    let found: Vec<_> = (0..6u64)
        .into_par_iter()
        .map(|seed| {
            let (truth, views) = good(3000 + seed);
            let found = calibrate(&views, &setup()).unwrap_or_else(|e| panic!("rig {seed}: {e}"));
            (truth, found)
        })
        .collect();
    for (truth, found) in found {
        let report = &found.report;
        assert!(report.checks.iter().all(|c| c.passed) && report.checks.len() >= 12, "{:?}", report.checks);
        assert!((report.sigma_camera_px / NOISE.camera_px - 1.0).abs() < 0.06, "{}", report.sigma_camera_px);
        let projector = report.sigma_projector_px.unwrap();
        assert!((projector / NOISE.projector_px - 1.0).abs() < 0.06, "{projector}");
        assert!((report.chi_square - 1.0).abs() < 0.1, "{}", report.chi_square);
        let rig = found.calibration.projector.unwrap().projector_from_camera;
        let turn = Rotation3::from_matrix_unchecked(rig.rotation * truth.rig.rotation.transpose()).angle();
        assert!(turn < 0.02 && (rig.translation_mm - truth.rig.translation_mm).norm() < 20.0);
        for view in &report.views {
            let flatness = view.flatness.unwrap();
            let ratio = flatness.rms_mm / flatness.expected_rms_mm;
            assert!((0.85..1.15).contains(&ratio), "flat to {ratio} of the reported sigma");
            assert!(view.held_out.unwrap().projector_rms_px.unwrap() < 0.3, "{view:?}");
        }
        assert_eq!(found.covariance.nrows(), report.parameters.len());
        assert_eq!(found.boards.len(), 10);
        assert!(serde_json::to_string(report).unwrap().contains("\"camera.fx\""));
    }
}

#[test]
fn a_camera_alone_needs_no_projector() {
    let (truth, mut views) = good(3100);
    views.iter_mut().for_each(|v| v.plane_points.clear());
    let found = calibrate(&views, &Setup::camera((1600, 1200))).unwrap();
    assert!(found.calibration.projector.is_none() && found.report.projector_rms_px.is_none());
    assert!((found.calibration.camera.fx / truth.camera.fx - 1.0).abs() < 0.01);
}

#[test]
fn two_views_are_too_few() {
    let (_, views) = good(3000);
    let (slugs, _) = refused(calibrate(&views[..2], &setup()));
    assert_eq!(slugs, ["too-few-views"]);
    let mut lax = setup();
    lax.gates.min_views = 0;
    assert_eq!(refused(calibrate(&views[..2], &lax)).0, ["too-few-views"], "no gate allows the impossible");
}

#[test]
fn parallel_views_are_named() {
    for seed in [3000, 3003] {
        let (mut truth, _) = good(seed);
        let lean = Rotation3::from_euler_angles(0.1, 0.05, 0.0).into_inner();
        for board in &mut truth.boards {
            let middle = P3::new(5.0 * truth.grid.2, 3.5 * truth.grid.2, 0.0);
            let at = board.transform(&middle);
            *board = Pose { rotation: lean, translation_mm: at - lean * middle };
        }
        let views = truth.views(NOISE, seed);
        assert_eq!(refused(calibrate(&views, &setup())).0[0], "parallel-views");
        let mut alone = Setup::camera((1600, 1200));
        alone.gates.focal_sigma_share = f64::INFINITY;
        assert_eq!(refused(calibrate(&views, &alone)).0[0], "parallel-views");
    }
}

#[test]
fn one_way_of_tilting_is_not_enough() {
    let (mut truth, _) = good(3005);
    for (k, board) in truth.boards.iter_mut().enumerate() {
        let middle = P3::new(5.0 * truth.grid.2, 3.5 * truth.grid.2, 0.0);
        let at = board.transform(&middle);
        let rotation = Rotation3::from_euler_angles(0.5 * (k as f64 / 4.5 - 1.0), 0.02, 0.0).into_inner();
        *board = Pose { rotation, translation_mm: at - rotation * middle };
    }
    let views = truth.views(NOISE, 1);
    let (slugs, refused) = refused(calibrate(&views, &setup()));
    assert_eq!(slugs[0], "tilt-range");
    assert!(refused.to_string().contains("image's y axis"), "{refused}");
    let missing = guidance(&views, &setup(), Some(&truth.camera)).missing;
    assert_eq!(missing.len(), 2, "{missing:?}");
    assert!(missing[0].contains("right nearer") && missing[1].contains("left nearer"), "{missing:?}");
}

#[test]
fn blurred_pictures_are_named() {
    let truth = Truth::random(3006, 10);
    let views = truth.views(Made { camera_px: 0.6, ..NOISE }, 6);
    assert_eq!(refused(calibrate(&views, &setup())).0[0], "blurred");
    // One of ten.
    let mut views = truth.views(NOISE, 6);
    let mut random = StdRng::seed_from_u64(5);
    for corner in &mut views[4].corners {
        corner.camera_px = corner.camera_px.map(|v| v + 0.6 * normal(&mut random));
    }
    let (slugs, refused) = refused(calibrate(&views, &setup()));
    assert_eq!((slugs, refused.refusals[0].view.as_deref()), (vec!["blurred"], Some("view-04")));
}

#[test]
fn one_bumped_view_among_ten_is_named() {
    for (seed, bumped, bump_deg) in [(3007, 0, 0.1), (3008, 3, 0.1), (3009, 9, 0.5), (3010, 6, 0.05)] {
        let (truth, mut views) = good(seed);
        let turn =
            Rotation3::from_euler_angles(f64::to_radians(bump_deg), f64::to_radians(0.5 * bump_deg), 0.0);
        let rig = Pose {
            rotation: turn.into_inner() * truth.rig.rotation,
            translation_mm: turn * truth.rig.translation_mm,
        };
        let mut random = StdRng::seed_from_u64(seed);
        views[bumped] = truth.view(&truth.boards[bumped], &rig, bumped, NOISE, &mut random);
        let (slugs, refused) = refused(calibrate(&views, &setup()));
        assert_eq!(slugs, ["bumped-view"], "rig {seed}, {bump_deg} degrees");
        assert_eq!(refused.refusals[0].view, Some(format!("view-{bumped:02}")));
        views.remove(bumped);
        calibrate(&views, &setup()).unwrap_or_else(|e| panic!("without the bumped view of rig {seed}: {e}"));
    }
}

#[test]
fn a_board_of_another_size_shows_against_a_ruler() {
    let (truth, mut views) = good(3011);
    for corner in views.iter_mut().flat_map(|v| &mut v.corners) {
        corner.board_mm = corner.board_mm.map(|v| 1.25 * v);
    }
    let baseline = truth.rig.translation_mm.norm();
    let mut known = setup();
    calibrate(&views, &known).expect("size alone cannot be seen");
    known.baseline_mm = Some(baseline);
    let (slugs, found) = refused(calibrate(&views, &known));
    assert_eq!(slugs, ["board-size"]);
    assert!(found.to_string().contains("0.8"), "says by how much: {found}");
    known.baseline_mm = None;
    known.distance_mm = Some([300.0, 0.9 * truth.boards[0].translation_mm.z]);
    assert_eq!(refused(calibrate(&views, &known)).0, ["board-size"]);
}

#[test]
fn squares_that_are_none_show_by_themselves() {
    let (_, mut views) = good(3012);
    for corner in views.iter_mut().flat_map(|v| &mut v.corners) {
        corner.board_mm[1] *= 1.03;
    }
    let (slugs, found) = refused(calibrate(&views, &setup()));
    assert_eq!(slugs[0], "board-shape");
    assert!(found.to_string().contains("0.97"), "{found}");
}

#[test]
fn a_board_half_outside_the_projector_is_named() {
    let (_, mut views) = good(3013);
    let middle = views[2].corners.iter().map(|c| c.camera_px[0]).sum::<f64>() / views[2].corners.len() as f64;
    views[2].plane_points.retain(|p| p.camera_px[0] < middle);
    views[5].plane_points.clear();
    let (slugs, found) = refused(calibrate(&views, &setup()));
    assert_eq!(slugs, ["board-outside-projector"; 2]);
    assert_eq!(found.refusals[0].view.as_deref(), Some("view-02"));
    assert_eq!(found.refusals[1].view.as_deref(), Some("view-05"));
}

#[test]
fn exchanged_width_and_height_are_named() {
    let (_, views) = good(3014);
    for swapped in [Setup::rig((1200, 1600), (1024, 768)), Setup::rig((1600, 1200), (768, 1024))] {
        let (slugs, _) = refused(calibrate(&views, &swapped));
        assert_eq!(slugs, ["swapped-size"]);
    }
    // Boards that keep to the part that both sizes share: seen by the principal point, or by the empty parts.
    let (mut truth, _) = good(3015);
    truth.boards.retain(|b| b.transform(&P3::new(5.0 * truth.grid.2, 3.5 * truth.grid.2, 0.0)).x < 0.0);
    let views: Vec<View> = truth.views(NOISE, 3).into_iter().collect();
    let mut swapped = Setup::camera((1200, 1600));
    (swapped.gates.min_views, swapped.gates.quarters) = (3, 0);
    assert!(refused(calibrate(&views, &swapped)).0.contains(&"swapped-size"));
}

#[test]
fn single_wrong_codes_do_no_harm_and_are_counted() {
    let (_, mut views) = good(3016);
    for view in &mut views {
        for point in view.plane_points.iter_mut().step_by(97) {
            point.projector_px[0] += 64.0;
        }
        view.corners[3].camera_px[0] += 4.0;
    }
    let found = calibrate(&views, &setup()).unwrap();
    for (view, report) in views.iter().zip(&found.report.views) {
        assert_eq!(report.left_out, [1, view.plane_points.len().div_ceil(97)], "{report:?}");
    }
    assert!(found.report.projector_rms_px.unwrap() < 0.2 && found.report.camera_rms_px < 0.1);
}

#[test]
fn nonsense_is_refused_not_solved() {
    let (_, mut views) = good(3017);
    let mut random = StdRng::seed_from_u64(1);
    for corner in views.iter_mut().flat_map(|v| &mut v.corners) {
        corner.camera_px = [800.0 + 200.0 * normal(&mut random), 600.0 + 150.0 * normal(&mut random)]
            .map(|v: f64| v.clamp(0.0, 1199.0));
    }
    let refused = calibrate(&views, &setup()).expect_err("nonsense");
    println!("{refused}");
    let mut views = good(3017).1;
    views[1].corners[0].camera_px[0] = f64::NAN;
    assert!(calibrate(&views, &setup()).is_err());
    assert!(calibrate(&[], &setup()).is_err());
}
