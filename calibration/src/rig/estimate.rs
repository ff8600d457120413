//! The adjustment with what it does not know: how noisy the observations are, and which of them are plainly wrong.

use nalgebra::Vector2;
use polscan_reconstruction::geometry::Pose;
use rayon::prelude::*;

use super::{
    adjust::{Block, Failure, Fit, Noise, Prior, Problem, State},
    initial::{self, board_pose},
    model::{GLOBALS, PROJECTOR},
    setup::Setup,
};

/// Residuals beyond this many sigma are wrong, not noisy: a code off by columns, another corner.
const GROSS_SIGMAS: f64 = 10.0;
/// Residuals beyond this many sigma of the median's estimate take no part in the estimate of sigma.
const TRIM_SIGMAS: f64 = 4.0;
/// Nothing is measured better than this, in px.
const LEAST_SIGMA_PX: f64 = 1e-4;
/// Plane points per view for fits that only judge.
const JUDGING: usize = 400;

/// Residuals of one view in px, observed less predicted; `None` for what cannot be predicted.
#[derive(Debug, Clone, Default)]
pub(super) struct Residuals {
    pub(super) camera: Vec<Option<Vector2<f64>>>,
    pub(super) projector: Vec<Option<Vector2<f64>>>,
}

/// Root mean square length; 0 of nothing, infinite where one is missing.
pub(super) fn rms<'a>(residuals: impl Iterator<Item = &'a Option<Vector2<f64>>>) -> f64 {
    let (sum, count) = residuals.fold((0.0, 0.0), |(sum, count), r| {
        (sum + r.map_or(f64::INFINITY, |r| r.norm_squared()), count + 1.0)
    });
    if count == 0.0 { 0.0 } else { (sum / count).sqrt() }
}

pub(super) fn residuals(state: &State, blocks: &[Block]) -> Vec<Residuals> {
    let of = |(block, pose): (&Block, &Pose)| {
        let corners = block
            .corners
            .iter()
            .map(|c| state.optics.corner(pose, c).map(|seen| Vector2::from(c.camera_px) - seen.pixel));
        let points = block.plane_points.iter().map(|p| {
            state.optics.plane_point(pose, p).map(|seen| Vector2::from(p.projector_px) - seen.pixel)
        });
        Residuals { camera: corners.collect(), projector: points.collect() }
    };
    blocks.par_iter().zip(&state.poses).map(of).collect()
}

/// What came out of the views.
#[derive(Debug, Clone)]
pub(super) struct Estimate {
    pub(super) fit: Fit,
    pub(super) noise: Noise,
    /// What took part.
    pub(super) blocks: Vec<Block>,
    /// Corners and plane points left out of each view as plainly wrong.
    pub(super) dropped: Vec<[usize; 2]>,
    pub(super) residuals: Vec<Residuals>,
}

/// A setup as the adjustment wants it.
pub(super) struct Task<'a> {
    pub(super) setup: &'a Setup,
    camera: Vec<usize>,
    projector: Vec<usize>,
    pub(super) free: [bool; GLOBALS],
    priors: Vec<Prior>,
}

impl<'a> Task<'a> {
    pub(super) fn new(setup: &'a Setup) -> Self {
        let numbers = |k3: bool| (0..if k3 { 9 } else { 8 }).collect::<Vec<usize>>();
        let camera = numbers(setup.camera.k3);
        let projector = setup.projector.map_or(Vec::new(), |lens| numbers(lens.k3));
        let free = initial::free(&camera, &projector, setup.projector.is_some());
        let lenses = [(0, Some(setup.camera)), (PROJECTOR, setup.projector)];
        let priors = lenses
            .into_iter()
            .filter_map(|(first, lens)| Some((first, lens?.principal?)))
            .flat_map(|(first, prior)| {
                [0, 1].map(|axis| Prior {
                    parameter: first + 2 + axis,
                    value: prior.at_px[axis],
                    sigma: prior.sigma_px,
                })
            })
            .collect();
        Self { setup, camera, projector, free, priors }
    }

    /// Parameters of the answer for so many views.
    pub(super) fn parameters(&self, views: usize) -> usize {
        self.free.iter().filter(|free| **free).count() + 6 * views
    }

    /// All from nothing.
    pub(super) fn estimate(&self, blocks: &[Block]) -> Result<Estimate, Failure> {
        let camera =
            initial::camera(blocks, self.setup.camera.size, &self.camera).ok_or(Failure::Diverged)?;
        let mut state = camera.state;
        if let Some(lens) = self.setup.projector {
            let alone = Setup { projector: None, ..self.setup.clone() };
            let corners: Vec<Block> =
                blocks.iter().map(|b| Block { plane_points: Vec::new(), ..b.clone() }).collect();
            state = Task::new(&alone).refine(&corners, state)?.fit.state;
            state = initial::projector(blocks, &state, lens.size, &self.projector, &self.priors)
                .ok_or(Failure::Diverged)?;
        }
        self.refine(blocks, state)
    }

    /// Solves, measures the noise, leaves out what is plainly wrong, and solves again until nothing changes.
    fn refine(&self, blocks: &[Block], mut state: State) -> Result<Estimate, Failure> {
        let mut kept = blocks.to_vec();
        let mut noise = self.noise(&residuals(&state, &kept));
        for _ in 0..4 {
            let fit = self.problem(&kept, noise).solve(state)?;
            state = fit.state.clone();
            let mut found = residuals(&state, &kept);
            let gross = self.drop_gross(&mut kept, &mut found, noise);
            let next = self.noise(&found);
            let steady = |a: f64, b: f64| (a / b - 1.0).abs() < 0.01;
            if !gross
                && steady(next.camera_px, noise.camera_px)
                && steady(next.projector_px, noise.projector_px)
            {
                return Ok(self.finished(blocks, kept, fit, noise, found));
            }
            noise = next;
        }
        let fit = self.problem(&kept, noise).solve(state)?;
        let found = residuals(&fit.state, &kept);
        Ok(self.finished(blocks, kept, fit, noise, found))
    }

    fn finished(
        &self,
        all: &[Block],
        blocks: Vec<Block>,
        fit: Fit,
        noise: Noise,
        residuals: Vec<Residuals>,
    ) -> Estimate {
        let left_out = |(all, kept): (&Block, &Block)| {
            [all.corners.len() - kept.corners.len(), all.plane_points.len() - kept.plane_points.len()]
        };
        let dropped = all.iter().zip(&blocks).map(left_out).collect();
        Estimate { fit, noise, blocks, dropped, residuals }
    }

    fn problem<'b>(&'b self, blocks: &'b [Block], noise: Noise) -> Problem<'b> {
        Problem { blocks, noise, free: self.free, poses_free: true, priors: &self.priors }
    }

    /// The given sigmas, or those of the residuals.
    fn noise(&self, found: &[Residuals]) -> Noise {
        let corners_fix = self.camera.len() + 6 * found.len();
        let camera_px = || sigma(found.iter().flat_map(|r| &r.camera), corners_fix);
        let projector_px = || sigma(found.iter().flat_map(|r| &r.projector), self.projector.len() + 6);
        Noise {
            camera_px: self.setup.sigma_camera_px.unwrap_or_else(camera_px),
            projector_px: self.setup.sigma_projector_px.unwrap_or_else(projector_px),
            huber: self.setup.huber_sigmas,
        }
    }

    /// Leaves out single gross errors. A view that is full of them is not cleaned: its residuals shall show.
    fn drop_gross(&self, blocks: &mut [Block], found: &mut [Residuals], noise: Noise) -> bool {
        let share = self.setup.gates.outlier_share;
        let mut any = false;
        for (block, residuals) in blocks.iter_mut().zip(found) {
            any |=
                keep_good(&mut block.corners, &mut residuals.camera, GROSS_SIGMAS * noise.camera_px, share);
            let limit = GROSS_SIGMAS * noise.projector_px;
            any |= keep_good(&mut block.plane_points, &mut residuals.projector, limit, share);
        }
        any
    }

    /// The same without one view, from where the whole came to rest, and that view's pose found with what the others
    /// say: residuals of the view, and the fit without it.
    pub(super) fn without(&self, whole: &Estimate, view: usize) -> Result<(Residuals, Estimate), Failure> {
        let fewer: Vec<Block> = whole.blocks.iter().map(judging).collect();
        let mut others = fewer.clone();
        let held = [others.remove(view)];
        let mut state = whole.fit.state.clone();
        state.poses.remove(view);
        let fit = self.problem(&others, whole.noise).solve(state)?;
        let (start, _) = board_pose(&fit.state.optics, &held[0], whole.noise).ok_or(Failure::Diverged)?;
        let resection = Problem {
            blocks: &held,
            noise: whole.noise,
            free: [false; GLOBALS],
            poses_free: true,
            priors: &[],
        };
        let seen = resection.solve(State { optics: fit.state.optics, poses: vec![start] })?;
        let residuals_of_view = residuals(&seen.state, &held).swap_remove(0);
        let found = residuals(&fit.state, &others);
        let dropped = vec![[0; 2]; others.len()];
        Ok((
            residuals_of_view,
            Estimate { fit, noise: whole.noise, blocks: others, dropped, residuals: found },
        ))
    }
}

fn judging(block: &Block) -> Block {
    let every = block.plane_points.len().div_ceil(JUDGING).max(1);
    let plane_points = block.plane_points.iter().step_by(every).copied().collect();
    Block { corners: block.corners.clone(), plane_points }
}

/// Standard deviation per axis: of what lies within four sigma by the median, with `parameters` taken off.
fn sigma<'a>(residuals: impl Iterator<Item = &'a Option<Vector2<f64>>>, parameters: usize) -> f64 {
    let mut squares: Vec<f64> = residuals.flatten().map(|r| r.norm_squared()).collect();
    if squares.is_empty() {
        return 1.0;
    }
    let middle = squares.len() / 2;
    // The median of a squared length is 2 ln 2 sigma^2.
    let rough = *squares.select_nth_unstable_by(middle, f64::total_cmp).1 / (2.0 * std::f64::consts::LN_2);
    let limit = (TRIM_SIGMAS * TRIM_SIGMAS * rough).max(LEAST_SIGMA_PX * LEAST_SIGMA_PX);
    let (sum, count) =
        squares.iter().filter(|&&s| s <= limit).fold((0.0, 0.0), |(sum, count), s| (sum + s, count + 1.0));
    let freedom = (2.0 * count - parameters as f64).max(0.1 * count).max(1.0);
    (sum / freedom).sqrt().max(LEAST_SIGMA_PX)
}

fn keep_good<T>(items: &mut Vec<T>, found: &mut Vec<Option<Vector2<f64>>>, limit: f64, share: f64) -> bool {
    let good: Vec<bool> = found.iter().map(|r| r.is_some_and(|r| r.norm() <= limit)).collect();
    let bad = good.iter().filter(|good| !**good).count();
    if bad == 0 || bad as f64 > share * items.len() as f64 {
        return false;
    }
    let mut keep = good.iter();
    items.retain(|_| *keep.next().expect("one verdict per item"));
    let mut keep = good.iter();
    found.retain(|_| *keep.next().expect("one verdict per item"));
    true
}
