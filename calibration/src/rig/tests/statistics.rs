//! Fifty rigs drawn at random: found parameters against true ones, in units of their own standard deviation.

use nalgebra::{Matrix3, Rotation3, Vector3};
use polscan_reconstruction::geometry::Pose;
use rayon::prelude::*;

use super::truth::{Made, Truth};
use crate::rig::{
    adjust::Block,
    estimate::{Estimate, Task, rms},
    model::{ASPECT, PROJECTOR, RIG, lens_numbers},
    setup::Setup,
};

const NOISE: Made = Made { camera_px: 0.05, projector_px: 0.1, every_px: 40 };

pub(super) fn blocks(views: Vec<crate::observation::View>) -> Vec<Block> {
    views.into_iter().map(|v| Block { corners: v.corners, plane_points: v.plane_points }).collect()
}

/// Rotation vector and shift that take one pose to another.
fn difference(found: &Pose, truth: &Pose) -> [f64; 6] {
    let turn: Matrix3<f64> = found.rotation * truth.rotation.transpose();
    let turn: Vector3<f64> = Rotation3::from_matrix_unchecked(turn).scaled_axis();
    let shift = found.translation_mm - truth.translation_mm;
    [turn.x, turn.y, turn.z, shift.x, shift.y, shift.z]
}

/// Every parameter's error in sigma: shared ones, then those of the boards.
fn errors(found: &Estimate, truth: &Truth) -> (Vec<f64>, Vec<f64>) {
    let (optics, covariance) = (&found.fit.state.optics, &found.fit.covariance);
    let mut shared = Vec::new();
    for (first, lens, true_lens) in
        [(0, &optics.camera, &truth.camera), (PROJECTOR, &optics.projector, &truth.projector)]
    {
        let (numbers, true_numbers) = (lens_numbers(lens), lens_numbers(true_lens));
        for k in 0..8 {
            shared.push((numbers[k] - true_numbers[k]) / covariance.globals[(first + k, first + k)].sqrt());
        }
    }
    for (k, error) in (RIG..ASPECT).zip(difference(&optics.rig, &truth.rig)) {
        shared.push(error / covariance.globals[(k, k)].sqrt());
    }
    let boards =
        found.fit.state.poses.iter().zip(&truth.boards).zip(&covariance.poses).flat_map(|((f, t), c)| {
            let sigma = c.diagonal().map(f64::sqrt);
            difference(f, t).into_iter().zip(sigma.iter().copied().collect::<Vec<_>>()).map(|(e, s)| e / s)
        });
    (shared, boards.collect())
}

/// What came of one rig.
struct Tried {
    shared: Vec<f64>,
    boards: Vec<f64>,
    chi_square: f64,
    camera_rms_px: f64,
    projector_rms_px: f64,
}

fn try_rig(seed: u64) -> Tried {
    let truth = Truth::random(1000 + seed, 10);
    let blocks = blocks(truth.views(NOISE, seed));
    let mut setup = Setup::rig((1600, 1200), (1024, 768));
    (setup.sigma_camera_px, setup.sigma_projector_px) = (Some(NOISE.camera_px), Some(NOISE.projector_px));
    let task = Task::new(&setup);
    let found = task.estimate(&blocks).unwrap_or_else(|e| panic!("rig {seed}: {e:?}"));
    let observations: usize = found.blocks.iter().map(|b| 2 * (b.corners.len() + b.plane_points.len())).sum();
    let (shared, boards) = errors(&found, &truth);
    Tried {
        shared,
        boards,
        chi_square: found.fit.cost / (observations - task.parameters(10)) as f64,
        camera_rms_px: rms(found.residuals.iter().flat_map(|r| &r.camera)),
        projector_rms_px: rms(found.residuals.iter().flat_map(|r| &r.projector)),
    }
}

#[test]
fn errors_are_as_large_as_their_covariance_says() {
    let tried: Vec<Tried> = (0..50u64).into_par_iter().map(try_rig).collect();
    let shared: Vec<f64> = tried.iter().flat_map(|t| t.shared.clone()).collect();
    let boards: Vec<f64> = tried.iter().flat_map(|t| t.boards.clone()).collect();
    let beyond =
        |errors: &[f64]| errors.iter().filter(|e| e.abs() > 3.0).count() as f64 / errors.len() as f64;
    let spread = |errors: &[f64]| (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt();
    let chi = tried.iter().map(|t| t.chi_square).sum::<f64>() / tried.len() as f64;
    let camera = tried.iter().map(|t| t.camera_rms_px).fold(0.0, f64::max);
    let projector = tried.iter().map(|t| t.projector_rms_px).fold(0.0, f64::max);
    println!(
        "50 rigs: {:.2} % of {} shared and {:.2} % of {} board parameters beyond 3 sigma, spread {:.3} and {:.3}; \
         chi-square {chi:.3}; worst rms camera {camera:.3} px, projector {projector:.3} px",
        100.0 * beyond(&shared),
        shared.len(),
        100.0 * beyond(&boards),
        boards.len(),
        spread(&shared),
        spread(&boards)
    );
    assert!(beyond(&shared) <= 0.01 && beyond(&boards) <= 0.01);
    assert!((0.8..1.25).contains(&chi) && camera <= 0.3 && projector <= 0.3);
}
