//! Where the adjustment starts: closed forms for camera, boards and projector, the best of several judged by what it
//! leaves unexplained.

use nalgebra::{DMatrix, Matrix3, Matrix4, Vector3, Vector4};
use polscan_reconstruction::geometry::{Lens, Pose};

use super::{
    adjust::{Block, Fit, Noise, Prior, Problem, State},
    estimate::residuals,
    homography,
    model::{ASPECT, GLOBALS, Optics, PROJECTOR, RIG},
};

/// Focal lengths tried where the views say nothing of it, in image widths: 90 to 8 degrees.
const FOCAL_GUESSES: [f64; 5] = [0.5, 1.0, 2.0, 4.0, 7.0];
/// Plane points per view that judge a start.
const JUDGES: usize = 100;
/// Corners per view that judge a start of the camera.
const JUDGE_CORNERS: usize = 30;
/// So many of the most promising starts are followed to their end.
const TRIED: usize = 3;
/// Noise at the start, in px: far off is not yet an outlier.
const ROUGH: Noise = Noise { camera_px: 1.0, projector_px: 1.0, huber: 10.0 };

/// Shared parameters that move: `camera` and `projector` numbers from the first on, rig pose or not.
pub(super) fn free(camera: &[usize], projector: &[usize], rig: bool) -> [bool; GLOBALS] {
    let mut free = [false; GLOBALS];
    camera.iter().for_each(|k| free[*k] = true);
    projector.iter().for_each(|k| free[PROJECTOR + k] = true);
    free[RIG..ASPECT].fill(rig);
    free
}

/// A lens without distortion.
fn pinhole((width, height): (u32, u32), [fx, fy, cx, cy]: [f64; 4]) -> Lens {
    Lens { width, height, fx, fy, cx, cy, distortion: [0.0; 5] }
}

fn plausible(lens: &Lens) -> bool {
    lens.faults("lens").is_empty()
}

/// Poses that are all zero apart from being poses.
fn nowhere() -> Pose {
    Pose { rotation: Matrix3::identity(), translation_mm: Vector3::zeros() }
}

/// Middle of a board's corners, in mm.
fn middle(block: &Block) -> [f64; 2] {
    let count = block.corners.len().max(1) as f64;
    let sum = |axis: usize| block.corners.iter().map(|c| c.board_mm[axis]).sum::<f64>() / count;
    [sum(0), sum(1)]
}

/// Pose of one board before known optics: from its homography and from that pose's mirror image, the better one after
/// adjustment of the pose alone.
pub(super) fn board_pose(optics: &Optics, block: &Block, noise: Noise) -> Option<(Pose, f64)> {
    let pairs: Vec<_> = block
        .corners
        .iter()
        .map(|c| {
            let ray = optics.camera.ray(c.camera_px);
            ([c.board_mm[0], c.board_mm[1] * optics.aspect], ray.map_or([f64::NAN; 2], |r| [r.x, r.y]))
        })
        .collect();
    let start = homography::pose(&homography::homography(&pairs)?, &Matrix3::identity())?;
    let blocks = [block.clone()];
    let refined = [start, homography::mirrored(&start, middle(block))].into_iter().filter_map(|pose| {
        let problem =
            Problem { blocks: &blocks, noise, free: [false; GLOBALS], poses_free: true, priors: &[] };
        let fit = problem.solve(State { optics: *optics, poses: vec![pose] }).ok()?;
        Some((fit.state.poses[0], fit.cost))
    });
    refined.min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Camera and board poses from corners, adjusted. `numbers` are the lens numbers that may move.
pub(super) fn camera(blocks: &[Block], size: (u32, u32), numbers: &[usize]) -> Option<Fit> {
    let corners: Vec<Block> =
        blocks.iter().map(|b| Block { corners: b.corners.clone(), plane_points: Vec::new() }).collect();
    let homographies: Vec<Matrix3<f64>> = corners
        .iter()
        .map(|b| b.corners.iter().map(|c| (c.board_mm, c.camera_px)).collect::<Vec<_>>())
        .filter_map(|pairs| homography::homography(&pairs))
        .collect();
    let (width, height) = (f64::from(size.0), f64::from(size.1));
    let centre = [0.5 * (width - 1.0), 0.5 * (height - 1.0)];
    let guess = FOCAL_GUESSES.map(|f| [f * width, f * width, centre[0], centre[1]]);
    let fixed =
        homography::focal_lengths(&homographies, centre).map(|[fx, fy]| [fx, fy, centre[0], centre[1]]);
    let closed = [fixed, homography::zhang(&homographies, [width, height])];
    let few: Vec<Block> = corners.iter().map(fewer_corners).collect();
    let lenses = closed.into_iter().flatten().chain(guess).map(|k| pinhole(size, k)).filter(plausible);
    let mut starts: Vec<(f64, State)> = lenses
        .filter_map(|lens| {
            let optics = Optics { camera: lens, projector: lens, rig: nowhere(), aspect: 1.0 };
            let found: Option<Vec<_>> = few.iter().map(|b| board_pose(&optics, b, ROUGH)).collect();
            let (poses, costs): (Vec<_>, Vec<f64>) = found?.into_iter().unzip();
            Some((costs.iter().sum(), State { optics, poses }))
        })
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    starts.into_iter().take(TRIED).find_map(|(_, start)| {
        let solve = |numbers: &[usize], start: State| {
            let free = free(numbers, &[], false);
            Problem { blocks: &corners, noise: ROUGH, free, poses_free: true, priors: &[] }.solve(start).ok()
        };
        let fit = solve(numbers, solve(&numbers[..4], start)?.state)?;
        plausible(&fit.state.optics.camera).then_some(fit)
    })
}

/// Every so many corners, all over the board: enough to judge a start by.
fn fewer_corners(block: &Block) -> Block {
    let every = block.corners.len().div_ceil(JUDGE_CORNERS).max(1);
    Block { corners: block.corners.iter().step_by(every).copied().collect(), plane_points: Vec::new() }
}

/// A plane point's place: on the board, in the camera frame, and its projector pixel.
struct Placed {
    board_mm: [f64; 2],
    point_mm: Vector3<f64>,
    projector_px: [f64; 2],
}

/// Projector and rig pose from plane points, with camera and boards as they are. `numbers` are the lens numbers that may
/// move.
pub(super) fn projector(
    blocks: &[Block],
    start: &State,
    size: (u32, u32),
    numbers: &[usize],
    priors: &[Prior],
) -> Option<State> {
    let placed: Vec<Vec<Placed>> = blocks.iter().zip(&start.poses).map(|(b, p)| place(b, start, p)).collect();
    let fewer: Vec<Block> = blocks
        .iter()
        .map(|b| {
            let every = (b.plane_points.len() / JUDGES).max(1);
            Block {
                corners: Vec::new(),
                plane_points: b.plane_points.iter().step_by(every).copied().collect(),
            }
        })
        .collect();
    let solve = |numbers: &[usize], blocks: &[Block], state: State| {
        let free = free(&[], numbers, true);
        Problem { blocks, noise: ROUGH, free, poses_free: false, priors }.solve(state).ok()
    };
    let with = |(lens, rig): (Lens, Pose)| State {
        optics: Optics { projector: lens, rig, ..start.optics },
        poses: start.poses.clone(),
    };
    let mut starts: Vec<(f64, State)> = projector_starts(&placed, &start.poses, size, priors)
        .into_iter()
        .filter(|(lens, _)| plausible(lens))
        .map(|candidate| (unexplained(&fewer, &with(candidate)), with(candidate)))
        .collect();
    starts.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut found: Vec<Fit> = starts
        .into_iter()
        .take(TRIED)
        .filter_map(|(_, start)| solve(&numbers[..4], &fewer, start))
        .filter(|fit| plausible(&fit.state.optics.projector))
        .collect();
    found.sort_by(|a, b| a.cost.total_cmp(&b.cost));
    found.into_iter().find_map(|fit| {
        let state = solve(numbers, &fewer, fit.state)?.state;
        plausible(&state.optics.projector).then_some(state)
    })
}

/// Median over all plane points of how far the projector's prediction is off, in px.
fn unexplained(blocks: &[Block], state: &State) -> f64 {
    let off = residuals(state, blocks).into_iter().flat_map(|r| r.projector);
    let mut off: Vec<f64> = off.map(|r| r.map_or(f64::INFINITY, |r| r.norm())).collect();
    if off.is_empty() {
        return f64::INFINITY;
    }
    let middle = off.len() / 2;
    *off.select_nth_unstable_by(middle, f64::total_cmp).1
}

fn place(block: &Block, state: &State, pose: &Pose) -> Vec<Placed> {
    let every = (block.plane_points.len() / JUDGES).max(1);
    let points = block.plane_points.iter().step_by(every);
    points
        .filter_map(|point| {
            let point_mm = state.optics.on_plane(pose, point.camera_px)?;
            let local = pose.inverse().transform(&point_mm);
            Some(Placed { board_mm: [local.x, local.y], point_mm, projector_px: point.projector_px })
        })
        .collect()
}

/// Lenses and rig poses to try: direct linear transform over all views, and closed forms from the homographies of the
/// single views with the principal point found, given, or at the edges that lens shift puts it at.
fn projector_starts(
    placed: &[Vec<Placed>],
    poses: &[Pose],
    size: (u32, u32),
    priors: &[Prior],
) -> Vec<(Lens, Pose)> {
    let mut starts = Vec::new();
    let all: Vec<(Vector3<f64>, [f64; 2])> =
        placed.iter().flatten().map(|p| (p.point_mm, p.projector_px)).collect();
    if let Some((numbers, rig)) = resection(&all) {
        starts.push((pinhole(size, numbers), rig));
    }
    let planes: Vec<(Matrix3<f64>, &Pose)> = placed
        .iter()
        .zip(poses)
        .filter_map(|(points, pose)| {
            let pairs: Vec<_> = points.iter().map(|p| (p.board_mm, p.projector_px)).collect();
            Some((trimmed(&pairs)?, pose))
        })
        .collect();
    let homographies: Vec<Matrix3<f64>> = planes.iter().map(|(h, _)| *h).collect();
    let (width, height) = (f64::from(size.0), f64::from(size.1));
    let told = |k: usize| priors.iter().find(|p| p.parameter == PROJECTOR + k).map(|p| p.value);
    let middle = [0.5 * (width - 1.0), 0.5 * (height - 1.0)];
    let mut principals = vec![middle, [middle[0], height], [middle[0], 0.0]];
    principals.insert(0, [told(2).unwrap_or(middle[0]), told(3).unwrap_or(height)]);
    let mut lenses: Vec<[f64; 4]> = homography::zhang(&homographies, [width, height]).into_iter().collect();
    for [cx, cy] in principals {
        lenses.extend(homography::focal_lengths(&homographies, [cx, cy]).map(|[fx, fy]| [fx, fy, cx, cy]));
        lenses.push([1.6 * width, 1.6 * width, cx, cy]);
    }
    for numbers in lenses {
        let lens = pinhole(size, numbers);
        for (h, board) in planes.iter().take(3) {
            let Some(seen) = homography::pose(h, &lens.matrix()) else { continue };
            starts.push((lens, after(&seen, &board.inverse())));
        }
    }
    starts
}

/// `first` applied after `second`.
fn after(first: &Pose, second: &Pose) -> Pose {
    Pose {
        rotation: first.rotation * second.rotation,
        translation_mm: first.transform(&second.translation_mm),
    }
}

/// Homography with wrong codes left out: thrice fitted to what lies within three median errors.
fn trimmed(pairs: &[([f64; 2], [f64; 2])]) -> Option<Matrix3<f64>> {
    let mut h = homography::homography(pairs)?;
    for _ in 0..3 {
        let error = |(from, to): &([f64; 2], [f64; 2])| {
            let image = homography::apply(&h, *from);
            (image[0] - to[0]).hypot(image[1] - to[1])
        };
        let limit = three_medians(pairs.iter().map(error).collect());
        let kept: Vec<_> = pairs.iter().filter(|&pair| error(pair) <= limit).copied().collect();
        h = homography::homography(&kept)?;
    }
    Some(h)
}

fn three_medians(mut errors: Vec<f64>) -> f64 {
    let middle = errors.len() / 2;
    3.0 * errors.select_nth_unstable_by(middle, f64::total_cmp).1.max(0.3)
}

/// Lens numbers and pose from points in space and their pixels: direct linear transform of the whole projection, wrong
/// codes left out, skew dropped. `None` where the points do not fix it (one plane, too few).
pub(super) fn resection(points: &[(Vector3<f64>, [f64; 2])]) -> Option<([f64; 4], Pose)> {
    let mut kept = points.to_vec();
    let mut projection = direct(&kept)?;
    for _ in 0..3 {
        let error = |(point, pixel): &(Vector3<f64>, [f64; 2])| {
            let image = projection * point.push(1.0);
            (image.x / image.z - pixel[0]).hypot(image.y / image.z - pixel[1])
        };
        let limit = three_medians(points.iter().map(error).collect());
        kept = points.iter().filter(|&p| error(p) <= limit).copied().collect();
        projection = direct(&kept)?;
    }
    let m = projection.fixed_columns::<3>(0).into_owned();
    let scale = m.determinant().signum() / m.row(2).norm();
    let (m, t) = (m * scale, projection.column(3) * scale);
    let rows: [Vector3<f64>; 3] = [0, 1, 2].map(|k| m.row(k).transpose());
    let (cx, cy) = (rows[0].dot(&rows[2]), rows[1].dot(&rows[2]));
    let (fx, fy) = ((rows[0] - rows[2] * cx).norm(), (rows[1] - rows[2] * cy).norm());
    let third = rows[2];
    let second = (rows[1] - third * cy) / fy;
    let turn = Matrix3::from_rows(&[second.cross(&third).transpose(), second.transpose(), third.transpose()]);
    let shift = Vector3::new((t.x - cx * t.z) / fx, (t.y - cy * t.z) / fy, t.z);
    let ahead = points.iter().filter(|(p, _)| (third.dot(p) + t.z) > 0.0).count();
    let usable = [fx, fy, cx, cy].iter().all(|v| v.is_finite()) && 2 * ahead > points.len();
    usable.then_some(([fx, fy, cx, cy], Pose { rotation: turn, translation_mm: shift }))
}

/// Rows p1, p2, p3 of the projection, up to a factor.
fn direct(points: &[(Vector3<f64>, [f64; 2])]) -> Option<nalgebra::Matrix3x4<f64>> {
    if points.len() < 12 {
        return None;
    }
    let count = points.len() as f64;
    let mean = points.iter().map(|p| p.0).sum::<Vector3<f64>>() / count;
    let spread = points.iter().map(|p| (p.0 - mean).norm()).sum::<f64>() / count;
    let scale = 3.0_f64.sqrt() / spread;
    let space = Matrix4::new_translation(&(-mean * scale)) * Matrix4::new_scaling(scale);
    let image = homography::normalizer(points.iter().map(|p| p.1))?;
    let mut rows = DMatrix::zeros(2 * points.len(), 12);
    for (k, (point, pixel)) in points.iter().enumerate() {
        let x: Vector4<f64> = space * point.push(1.0);
        let [u, v] = homography::apply(&image, *pixel);
        for j in 0..4 {
            rows[(2 * k, j)] = x[j];
            rows[(2 * k, 8 + j)] = -u * x[j];
            rows[(2 * k + 1, 4 + j)] = x[j];
            rows[(2 * k + 1, 8 + j)] = -v * x[j];
        }
    }
    let (p, ambiguity) = homography::null_vector(&rows)?;
    let p = image.try_inverse()? * nalgebra::Matrix3x4::from_row_slice(&p) * space;
    (ambiguity < 0.5 && p.iter().all(|v| v.is_finite())).then_some(p)
}
