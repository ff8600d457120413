//! Bundle adjustment: Levenberg-Marquardt on a robust sum of squares, board poses eliminated by Schur's complement.

use nalgebra::{Cholesky, DMatrix, DVector, Dyn, Matrix6, Matrix6xX, SMatrix, SVector, Vector2};
use polscan_reconstruction::geometry::Pose;
use rayon::prelude::*;

use super::model::{GLOBALS, Optics, Prediction, WIDTH, moved_pose};
use crate::observation::{Corner, PlanePoint};

/// More steps than any problem with an answer needs.
const MAX_STEPS: usize = 100;
/// A step is the last one when the sum of squares, in units of the noise, can fall by no more than this: parameters are
/// then within a hundred-thousandth of their own standard deviation.
const LAST_GAIN: f64 = 1e-10;
/// Damping beyond which no downhill step exists.
const MAX_DAMPING: f64 = 1e12;
/// An observation that cannot be predicted (a point behind a lens) counts like one this many sigma away.
const UNSEEN_SIGMAS: f64 = 1e4;
/// Correlated beyond this, parameters cannot be told apart in double precision.
const SINGULAR: f64 = 1e-13;

/// The observations of one view that take part.
#[derive(Debug, Clone, Default)]
pub(super) struct Block {
    pub(super) corners: Vec<Corner>,
    pub(super) plane_points: Vec<PlanePoint>,
}

/// Noise of the observations, per axis, and where the loss turns from square to linear.
#[derive(Debug, Clone, Copy)]
pub(super) struct Noise {
    pub(super) camera_px: f64,
    pub(super) projector_px: f64,
    /// Huber's threshold on the length of a residual in sigma.
    pub(super) huber: f64,
}

/// What is known of a shared parameter beforehand.
#[derive(Debug, Clone, Copy)]
pub(super) struct Prior {
    pub(super) parameter: usize,
    pub(super) value: f64,
    pub(super) sigma: f64,
}

/// What is adjusted to what.
pub(super) struct Problem<'a> {
    pub(super) blocks: &'a [Block],
    pub(super) noise: Noise,
    /// Shared parameters that may move.
    pub(super) free: [bool; GLOBALS],
    pub(super) poses_free: bool,
    pub(super) priors: &'a [Prior],
}

/// A set of values.
#[derive(Debug, Clone)]
pub(super) struct State {
    pub(super) optics: Optics,
    pub(super) poses: Vec<Pose>,
}

/// Why an adjustment has no answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Failure {
    /// Steps never came to rest.
    Diverged,
    /// The observations do not fix all parameters.
    Singular,
}

/// The answer.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    pub(super) state: State,
    /// Twice the robust loss, in units of the noise.
    pub(super) cost: f64,
    pub(super) covariance: Covariance,
}

/// Covariance of all parameters; zero where one was held.
#[derive(Debug, Clone)]
pub(super) struct Covariance {
    pub(super) globals: DMatrix<f64>,
    /// Of the board poses: turn, then shift in mm.
    pub(super) poses: Vec<Matrix6<f64>>,
}

type Normal = SMatrix<f64, WIDTH, WIDTH>;

/// One view's share of the normal equations, at one set of values.
#[derive(Clone)]
struct Share {
    matrix: Normal,
    gradient: SVector<f64, WIDTH>,
    cost: f64,
}

impl Share {
    fn empty() -> Self {
        Self { matrix: Normal::zeros(), gradient: SVector::zeros(), cost: 0.0 }
    }

    fn add(&mut self, prediction: Option<Prediction>, observed: [f64; 2], sigma: f64, huber: f64) {
        let Some(Prediction { pixel, rows }) = prediction else {
            self.cost += UNSEEN_SIGMAS * UNSEEN_SIGMAS;
            return;
        };
        let residual = (Vector2::from(observed) - pixel) / sigma;
        let length = residual.norm();
        let weight = if length <= huber { 1.0 } else { huber / length };
        self.cost += if length <= huber { length * length } else { huber * (2.0 * length - huber) };
        let scale = weight / (sigma * sigma);
        let pull = residual * (weight / sigma);
        for (axis, row) in rows.iter().enumerate() {
            for (j, &right) in row.iter().enumerate() {
                self.gradient[j] += pull[axis] * right;
                if right != 0.0 {
                    let scaled = scale * right;
                    let column = &mut self.matrix.as_mut_slice()[j * WIDTH..=j * WIDTH + j];
                    for (entry, &left) in column.iter_mut().zip(row) {
                        *entry += scaled * left;
                    }
                }
            }
        }
    }

    /// The part that all views share; only the upper triangle is kept up to here.
    fn shared(&self) -> (DMatrix<f64>, DVector<f64>) {
        let upper = |i: usize, j: usize| self.matrix[(i.min(j), i.max(j))];
        (
            DMatrix::from_fn(GLOBALS, GLOBALS, upper),
            DVector::from_iterator(GLOBALS, self.gradient.iter().take(GLOBALS).copied()),
        )
    }

    /// Shared against pose parameters, the pose's own matrix and gradient.
    fn own(&self) -> (DMatrix<f64>, Matrix6<f64>, SVector<f64, 6>) {
        let upper = |i: usize, j: usize| self.matrix[(GLOBALS + i.min(j), GLOBALS + i.max(j))];
        (
            DMatrix::from_fn(GLOBALS, 6, |i, j| self.matrix[(i, GLOBALS + j)]),
            Matrix6::from_fn(upper),
            SVector::from_fn(|i, _| self.gradient[GLOBALS + i]),
        )
    }
}

/// All views' shares.
struct Equations {
    shared: DMatrix<f64>,
    gradient: DVector<f64>,
    own: Vec<(DMatrix<f64>, Matrix6<f64>, SVector<f64, 6>)>,
    cost: f64,
}

struct Step {
    globals: DVector<f64>,
    poses: Vec<SVector<f64, 6>>,
    /// By how much the linear model says the cost falls.
    gain: f64,
}

impl Problem<'_> {
    /// Adjusts from `start` until nothing is left to gain.
    pub(super) fn solve(&self, start: State) -> Result<Fit, Failure> {
        let mut state = start;
        let mut equations = self.equations(&state);
        let mut damping = 1e-4;
        for _ in 0..MAX_STEPS {
            let step = self.step(&equations, damping).ok_or(Failure::Singular)?;
            if !step.gain.is_finite() {
                return Err(Failure::Diverged);
            }
            let next = State {
                optics: state.optics.moved(step.globals.as_slice()),
                poses: state
                    .poses
                    .iter()
                    .zip(&step.poses)
                    .map(|(p, s)| moved_pose(p, s.as_slice()))
                    .collect(),
            };
            let found = self.equations(&next);
            let gained = equations.cost - found.cost;
            let last = step.gain <= LAST_GAIN.max(1e-14 * equations.cost);
            if gained >= 0.0 || last {
                if gained >= 0.0 {
                    (state, equations) = (next, found);
                }
                // A heavily damped step is small for that reason alone.
                if last && damping <= 1e-3 {
                    return self.finish(state, &equations);
                }
                damping = (damping * if gained > 0.75 * step.gain { 0.1 } else { 0.5 }).max(1e-12);
            } else {
                damping *= 10.0;
                if damping > MAX_DAMPING {
                    return Err(Failure::Diverged);
                }
            }
        }
        Err(Failure::Diverged)
    }

    fn finish(&self, mut state: State, equations: &Equations) -> Result<Fit, Failure> {
        let covariance = self.covariance(equations).ok_or(Failure::Singular)?;
        for pose in state.poses.iter_mut().chain([&mut state.optics.rig]) {
            *pose = orthonormal(pose);
        }
        let cost = equations.cost;
        Ok(Fit { state, cost, covariance })
    }

    fn equations(&self, state: &State) -> Equations {
        let Noise { camera_px, projector_px, huber } = self.noise;
        let shares: Vec<Share> = self
            .blocks
            .par_iter()
            .zip(&state.poses)
            .map(|(block, pose)| {
                let mut share = Share::empty();
                for corner in &block.corners {
                    share.add(state.optics.corner(pose, corner), corner.camera_px, camera_px, huber);
                }
                for point in &block.plane_points {
                    share.add(state.optics.plane_point(pose, point), point.projector_px, projector_px, huber);
                }
                share
            })
            .collect();
        // Added up in the order of the views: the same sum on any number of threads.
        let mut total = Share::empty();
        for share in &shares {
            total.matrix += share.matrix;
            total.gradient += share.gradient;
            total.cost += share.cost;
        }
        let (mut shared, mut gradient) = total.shared();
        let numbers = state.optics.numbers();
        for prior in self.priors {
            let (k, residual) = (prior.parameter, (prior.value - numbers[prior.parameter]) / prior.sigma);
            shared[(k, k)] += 1.0 / (prior.sigma * prior.sigma);
            gradient[k] += residual / prior.sigma;
            total.cost += residual * residual;
        }
        Equations { shared, gradient, own: shares.iter().map(Share::own).collect(), cost: total.cost }
    }

    fn free_globals(&self) -> Vec<usize> {
        (0..GLOBALS).filter(|&k| self.free[k]).collect()
    }

    /// Solves `(H + damping diag H) step = gradient` over what is free.
    fn step(&self, equations: &Equations, damping: f64) -> Option<Step> {
        let grow = 1.0 + damping;
        let reduced = self.reduced(equations, grow)?;
        let free = self.free_globals();
        let mut right = DVector::from_iterator(free.len(), free.iter().map(|&k| equations.gradient[k]));
        for (cross, own) in reduced.crosses.iter().zip(&equations.own) {
            right -= cross.transpose() * own.2;
        }
        let moved = if free.is_empty() { DVector::zeros(0) } else { reduced.solve(&right) };
        let mut globals = DVector::zeros(GLOBALS);
        for (k, value) in free.iter().zip(moved.iter()) {
            globals[*k] = *value;
        }
        let mut gain = equations.gradient.dot(&globals);
        let poses: Vec<SVector<f64, 6>> = equations
            .own
            .iter()
            .zip(&reduced.inverses)
            .map(|((cross, _, own), inverse)| {
                let coupled = cross.transpose() * &globals;
                let pose = inverse * (own - SVector::<f64, 6>::from_fn(|i, _| coupled[i]));
                gain += own.dot(&pose);
                pose
            })
            .collect();
        Some(Step { globals, poses, gain })
    }

    /// Eliminates the board poses. Diagonals are multiplied by `grow`.
    fn reduced(&self, equations: &Equations, grow: f64) -> Option<Reduced> {
        let free = self.free_globals();
        let mut matrix = DMatrix::from_fn(free.len(), free.len(), |i, j| {
            equations.shared[(free[i], free[j])] * if i == j { grow } else { 1.0 }
        });
        let (mut inverses, mut crosses) = (Vec::new(), Vec::new());
        for (cross, own, _) in &equations.own {
            let inverse = if self.poses_free {
                let mut grown = *own;
                (0..6).for_each(|k| grown[(k, k)] *= grow);
                let unit = SVector::<f64, 6>::from_fn(|k, _| grown[(k, k)].sqrt().recip());
                let scaled = Matrix6::from_fn(|i, j| grown[(i, j)] * unit[i] * unit[j]);
                let inverse = scaled.cholesky()?.inverse();
                Matrix6::from_fn(|i, j| inverse[(i, j)] * unit[i] * unit[j])
            } else {
                Matrix6::zeros()
            };
            let picked = DMatrix::from_fn(free.len(), 6, |i, j| cross[(free[i], j)]);
            let reduced = inverse * picked.transpose();
            matrix -= &picked * &reduced;
            inverses.push(inverse);
            crosses.push(reduced);
        }
        let unit = DVector::from_fn(free.len(), |k, _| matrix[(k, k)].sqrt().recip());
        let scaled = DMatrix::from_fn(free.len(), free.len(), |i, j| matrix[(i, j)] * unit[i] * unit[j]);
        let factor = Cholesky::new(scaled)?;
        let weakest = factor.l_dirty().diagonal().iter().fold(1.0, |least: f64, v| least.min(v * v));
        (weakest > SINGULAR).then_some(Reduced { factor, unit, inverses, crosses })
    }

    /// Inverse of the whole normal matrix, block by block.
    fn covariance(&self, equations: &Equations) -> Option<Covariance> {
        let reduced = self.reduced(equations, 1.0)?;
        let free = self.free_globals();
        let inverse = if free.is_empty() { DMatrix::zeros(0, 0) } else { reduced.inverse() };
        let mut globals = DMatrix::zeros(GLOBALS, GLOBALS);
        for (i, &k) in free.iter().enumerate() {
            for (j, &l) in free.iter().enumerate() {
                globals[(k, l)] = inverse[(i, j)];
            }
        }
        let poses = reduced.inverses.iter().zip(&reduced.crosses).map(|(own, cross)| {
            let coupled = cross * &inverse * cross.transpose();
            own + Matrix6::from_fn(|i, j| coupled[(i, j)])
        });
        Some(Covariance { poses: poses.collect(), globals })
    }
}

/// The normal equations without the board poses, scaled to unit diagonal and factored.
struct Reduced {
    factor: Cholesky<f64, Dyn>,
    unit: DVector<f64>,
    inverses: Vec<Matrix6<f64>>,
    /// Inverse of the pose's matrix times what couples it to the free shared parameters, 6 x free.
    crosses: Vec<Matrix6xX<f64>>,
}

impl Reduced {
    fn solve(&self, right: &DVector<f64>) -> DVector<f64> {
        self.factor.solve(&right.component_mul(&self.unit)).component_mul(&self.unit)
    }

    fn inverse(&self) -> DMatrix<f64> {
        let inverse = self.factor.inverse();
        DMatrix::from_fn(self.unit.len(), self.unit.len(), |i, j| {
            inverse[(i, j)] * self.unit[i] * self.unit[j]
        })
    }
}

/// Takes out what rounding has left after many turns.
fn orthonormal(pose: &Pose) -> Pose {
    let svd = pose.rotation.svd(true, true);
    let rotation = svd.u.zip(svd.v_t).map_or(pose.rotation, |(u, v)| u * v);
    Pose { rotation, ..*pose }
}
