//! Every derivative against central differences, every prediction against the plain pinhole.

use polscan_reconstruction::geometry::Pose;

use super::truth::{Made, P3, Truth, pixel, place, ray};
use crate::rig::model::{GLOBALS, Optics, Prediction, WIDTH, moved_pose};

const EXACT: Made = Made { camera_px: 0.0, projector_px: 0.0, every_px: 160 };

fn optics(truth: &Truth) -> Optics {
    let mut camera = truth.camera;
    camera.distortion[4] = 0.05;
    Optics { camera, projector: truth.projector, rig: truth.rig, aspect: 1.02 }
}

/// Largest difference of `predict`'s derivatives from central differences, each in px per typical change.
fn check(optics: &Optics, board: &Pose, predict: impl Fn(&Optics, &Pose) -> Option<Prediction>) -> f64 {
    let typical = |k: usize| match k {
        0..=3 | 9..=12 => 1.0,
        4..=8 | 13..=17 => 1e-3,
        21..=23 => 1.0,
        _ if k >= GLOBALS + 3 => 1.0,
        _ => 1e-3,
    };
    let rows = predict(optics, board).expect("seen").rows;
    let mut worst: f64 = 0.0;
    for k in 0..WIDTH {
        let half = 1e-3 * typical(k);
        let at = |change: f64| {
            let mut step = [0.0; WIDTH];
            step[k] = change;
            let moved = (optics.moved(&step[..GLOBALS]), moved_pose(board, &step[GLOBALS..]));
            predict(&moved.0, &moved.1).expect("seen").pixel
        };
        let slope = (at(half) - at(-half)) / (2.0 * half);
        for axis in 0..2 {
            worst = worst.max((slope[axis] - rows[axis][k]).abs() * typical(k));
        }
    }
    worst
}

#[test]
fn derivatives_agree_with_finite_differences() {
    let mut worst: f64 = 0.0;
    let mut tried = 0;
    for seed in 0..8 {
        let truth = Truth::random(seed, 7);
        let optics = optics(&truth);
        for (view, board) in truth.views(EXACT, seed).iter().zip(&truth.boards) {
            for corner in view.corners.iter().step_by(9) {
                worst = worst.max(check(&optics, board, |o, b| o.corner(b, corner)));
                tried += 1;
            }
            for point in view.plane_points.iter().step_by(3) {
                worst = worst.max(check(&optics, board, |o, b| o.plane_point(b, point)));
                tried += 1;
            }
        }
    }
    println!("derivatives: {tried} observations, worst difference {worst:.2e} px per typical change");
    assert!(tried > 500 && worst < 1e-6, "{worst:e} over {tried}");
}

#[test]
fn predictions_are_the_plain_pinhole_s() {
    for seed in 0..8 {
        let truth = Truth::random(seed, 5);
        let optics = Optics { camera: truth.camera, projector: truth.projector, rig: truth.rig, aspect: 1.0 };
        for (view, board) in truth.views(EXACT, seed).iter().zip(&truth.boards) {
            for corner in &view.corners {
                let seen = optics.corner(board, corner).unwrap().pixel;
                assert!((seen - nalgebra::Vector2::from(corner.camera_px)).norm() < 1e-9);
            }
            for point in &view.plane_points {
                let seen = optics.plane_point(board, point).unwrap().pixel;
                assert!((seen - nalgebra::Vector2::from(point.projector_px)).norm() < 1e-7, "{point:?}");
                let on_plane = optics.on_plane(board, point.camera_px).unwrap();
                assert!((board.rotation.column(2).dot(&(on_plane - board.translation_mm))).abs() < 1e-9);
                assert!(on_plane.cross(&ray(&truth.camera, point.camera_px)).norm() < 1e-6);
                let lit = pixel(&truth.projector, place(&truth.rig, on_plane));
                assert!((seen - nalgebra::Vector2::from(lit)).norm() < 1e-7);
            }
        }
    }
}

#[test]
fn what_lies_behind_a_lens_is_not_predicted() {
    let truth = Truth::random(1, 1);
    let optics = optics(&truth);
    let view = &truth.views(EXACT, 1)[0];
    let behind = Pose { translation_mm: P3::new(0.0, 0.0, -900.0), ..truth.boards[0] };
    assert!(optics.corner(&behind, &view.corners[0]).is_none());
    assert!(optics.plane_point(&behind, &view.plane_points[0]).is_none());
}
