//! What the adjustment predicts for each observation, and how that changes with every parameter.
//!
//! Corners are projected into the camera. A plane point is the other way about: its camera pixel is exact, so its ray
//! is met with the plane of the board, and that point is projected into the projector, whose coordinate was measured.
//! The ray needs the inverse of the camera's distortion; its derivative follows from the implicit function theorem.

use nalgebra::{Matrix2x3, Matrix3, Matrix3x2, Rotation3, Vector2, Vector3};
use polscan_reconstruction::geometry::{Lens, Pose};

use crate::observation::{Corner, PlanePoint};

/// Numbers of one lens: fx, fy, cx, cy, k1, k2, p1, p2, k3.
pub(super) const LENS: usize = 9;
/// First parameter of the projector's lens; the camera's begin at 0.
pub(super) const PROJECTOR: usize = LENS;
/// First parameter of the rig pose: turn, then shift.
pub(super) const RIG: usize = 2 * LENS;
/// Stretch of the board along y against its description; 1 unless it is asked whether the description is wrong.
pub(super) const ASPECT: usize = RIG + 6;
/// Parameters that all views share.
pub(super) const GLOBALS: usize = ASPECT + 1;
/// Shared parameters and those of one board pose.
pub(super) const WIDTH: usize = GLOBALS + 6;

/// Everything that all views share.
#[derive(Debug, Clone, Copy)]
pub(super) struct Optics {
    pub(super) camera: Lens,
    pub(super) projector: Lens,
    /// `projector_from_camera`.
    pub(super) rig: Pose,
    pub(super) aspect: f64,
}

/// Predicted pixel, and its derivative by shared parameters and by those of the view's board pose.
pub(super) struct Prediction {
    pub(super) pixel: Vector2<f64>,
    pub(super) rows: [[f64; WIDTH]; 2],
}

impl Optics {
    /// After a step of all shared parameters. Rotations turn by a rotation vector from the left.
    pub(super) fn moved(&self, step: &[f64]) -> Self {
        Self {
            camera: moved_lens(&self.camera, &step[..LENS]),
            projector: moved_lens(&self.projector, &step[PROJECTOR..RIG]),
            rig: moved_pose(&self.rig, &step[RIG..ASPECT]),
            aspect: self.aspect + step[ASPECT],
        }
    }

    /// All shared parameters but the rig pose's, which has no numbers of its own: those entries are 0.
    pub(super) fn numbers(&self) -> [f64; GLOBALS] {
        let mut all = [0.0; GLOBALS];
        all[..LENS].copy_from_slice(&lens_numbers(&self.camera));
        all[PROJECTOR..RIG].copy_from_slice(&lens_numbers(&self.projector));
        all[ASPECT] = self.aspect;
        all
    }

    /// Where the camera sees a corner. `None` behind the camera.
    pub(super) fn corner(&self, board: &Pose, corner: &Corner) -> Option<Prediction> {
        let [x, y] = corner.board_mm;
        let on_board = Vector3::new(x, y * self.aspect, 0.0);
        let turned = board.rotation * on_board;
        let seen = project(&self.camera, &(turned + board.translation_mm))?;
        let mut rows = [[0.0; WIDTH]; 2];
        let by_turn = -seen.by_point * turned.cross_matrix();
        let by_aspect = seen.by_point * (board.rotation * Vector3::new(0.0, y, 0.0));
        for (axis, row) in rows.iter_mut().enumerate() {
            row[..LENS].copy_from_slice(&seen.by_lens[axis]);
            row[ASPECT] = by_aspect[axis];
            fill(&mut row[GLOBALS..], &by_turn, &seen.by_point, axis);
        }
        Some(Prediction { pixel: seen.pixel, rows })
    }

    /// Where the projector lights what this camera pixel sees of the plane. `None` where the ray meets the plane nowhere
    /// before camera and projector.
    pub(super) fn plane_point(&self, board: &Pose, point: &PlanePoint) -> Option<Prediction> {
        let met = meet(&self.camera, board, point.camera_px)?;
        let turned = self.rig.rotation * met.point;
        let seen = project(&self.projector, &(turned + self.rig.translation_mm))?;
        let by_point: Matrix2x3<f64> = seen.by_point * self.rig.rotation;
        let by_rig_turn = -seen.by_point * turned.cross_matrix();
        let mut rows = [[0.0; WIDTH]; 2];
        for (axis, row) in rows.iter_mut().enumerate() {
            let along = by_point.row(axis);
            for (entry, by_lens) in row[..LENS].iter_mut().zip(&met.by_lens) {
                *entry = (along * by_lens).x;
            }
            row[PROJECTOR..RIG].copy_from_slice(&seen.by_lens[axis]);
            fill(&mut row[RIG..ASPECT], &by_rig_turn, &seen.by_point, axis);
            let reach = (along * met.ray).x;
            for k in 0..3 {
                row[GLOBALS + k] = reach * met.by_turn[k];
                row[GLOBALS + 3 + k] = reach * met.by_shift[k];
            }
        }
        Some(Prediction { pixel: seen.pixel, rows })
    }

    /// The point of the board's plane that a camera pixel sees, in the camera frame.
    pub(super) fn on_plane(&self, board: &Pose, camera_px: [f64; 2]) -> Option<Vector3<f64>> {
        Some(meet(&self.camera, board, camera_px)?.point)
    }
}

/// A pose after a step: turn (rotation vector, applied from the left), then shift.
pub(super) fn moved_pose(pose: &Pose, step: &[f64]) -> Pose {
    let turn = Rotation3::new(Vector3::new(step[0], step[1], step[2]));
    Pose {
        rotation: turn.into_inner() * pose.rotation,
        translation_mm: pose.translation_mm + Vector3::new(step[3], step[4], step[5]),
    }
}

pub(super) fn lens_numbers(lens: &Lens) -> [f64; LENS] {
    let [k1, k2, p1, p2, k3] = lens.distortion;
    [lens.fx, lens.fy, lens.cx, lens.cy, k1, k2, p1, p2, k3]
}

fn moved_lens(lens: &Lens, step: &[f64]) -> Lens {
    let mut distortion = lens.distortion;
    for (coefficient, change) in distortion.iter_mut().zip(&step[4..]) {
        *coefficient += change;
    }
    Lens {
        fx: lens.fx + step[0],
        fy: lens.fy + step[1],
        cx: lens.cx + step[2],
        cy: lens.cy + step[3],
        distortion,
        ..*lens
    }
}

fn fill(row: &mut [f64], by_turn: &Matrix2x3<f64>, by_shift: &Matrix2x3<f64>, axis: usize) {
    for k in 0..3 {
        row[k] = by_turn[(axis, k)];
        row[3 + k] = by_shift[(axis, k)];
    }
}

/// Brown's distortion with its derivatives by position (symmetric: xx, xy, yy) and by coefficient (k1, k2, p1, p2, k3).
struct Bent {
    at: [f64; 2],
    by_position: [f64; 3],
    by_coefficient: [[f64; 2]; 5],
}

fn bend(lens: &Lens, x: f64, y: f64) -> Bent {
    let [k1, k2, p1, p2, k3] = lens.distortion;
    let (xx, xy, yy) = (x * x, x * y, y * y);
    let r2 = xx + yy;
    let (r4, r6) = (r2 * r2, r2 * r2 * r2);
    let gain = 1.0 + k1 * r2 + k2 * r4 + k3 * r6;
    let gain_by_r2 = k1 + 2.0 * k2 * r2 + 3.0 * k3 * r4;
    let tangential = [r2 + 2.0 * xx, r2 + 2.0 * yy];
    Bent {
        at: [x * gain + 2.0 * p1 * xy + p2 * tangential[0], y * gain + p1 * tangential[1] + 2.0 * p2 * xy],
        by_position: [
            gain + 2.0 * (gain_by_r2 * xx + p1 * y + 3.0 * p2 * x),
            2.0 * (gain_by_r2 * xy + p1 * x + p2 * y),
            gain + 2.0 * (gain_by_r2 * yy + 3.0 * p1 * y + p2 * x),
        ],
        by_coefficient: [
            [x * r2, y * r2],
            [x * r4, y * r4],
            [2.0 * xy, tangential[1]],
            [tangential[0], 2.0 * xy],
            [x * r6, y * r6],
        ],
    }
}

/// A projected point.
struct Seen {
    pixel: Vector2<f64>,
    by_point: Matrix2x3<f64>,
    by_lens: [[f64; LENS]; 2],
}

fn project(lens: &Lens, point: &Vector3<f64>) -> Option<Seen> {
    if point.z.is_nan() || point.z <= 0.0 {
        return None;
    }
    let inverse = 1.0 / point.z;
    let (x, y) = (point.x * inverse, point.y * inverse);
    let Bent { at, by_position: [xx, xy, yy], by_coefficient } = bend(lens, x, y);
    let focal = [lens.fx, lens.fy];
    let by_normal = [[xx, xy], [xy, yy]];
    let mut by_lens = [[0.0; LENS]; 2];
    let mut by_point = Matrix2x3::zeros();
    for axis in 0..2 {
        let [by_x, by_y] = by_normal[axis];
        let scale = focal[axis] * inverse;
        by_point[(axis, 0)] = scale * by_x;
        by_point[(axis, 1)] = scale * by_y;
        by_point[(axis, 2)] = -scale * (by_x * x + by_y * y);
        by_lens[axis][axis] = at[axis];
        by_lens[axis][2 + axis] = 1.0;
        for (entry, by) in by_lens[axis][4..].iter_mut().zip(&by_coefficient) {
            *entry = focal[axis] * by[axis];
        }
    }
    let pixel = Vector2::new(lens.fx * at[0] + lens.cx, lens.fy * at[1] + lens.cy);
    (pixel.x.is_finite() && pixel.y.is_finite()).then_some(Seen { pixel, by_point, by_lens })
}

/// A camera ray met with the plane of a board.
struct Met {
    point: Vector3<f64>,
    /// Direction (x, y, 1) along which the point moves when the plane does.
    ray: Vector3<f64>,
    /// Change of the point by each number of the camera's lens.
    by_lens: [Vector3<f64>; LENS],
    /// Change of the distance along the ray by turn and shift of the board.
    by_turn: Vector3<f64>,
    by_shift: Vector3<f64>,
}

/// With plane normal n and ray d, the point is `s d`, `s = n.t / n.d`, so that
/// `ds = (n.dt + (t - s d).dn - s n.dd) / n.d`; a turn w of the board makes `dn = w x n`.
fn meet(lens: &Lens, board: &Pose, camera_px: [f64; 2]) -> Option<Met> {
    let bent = [(camera_px[0] - lens.cx) / lens.fx, (camera_px[1] - lens.cy) / lens.fy];
    let [x, y] = lens.undistort(bent)?;
    let ray = Vector3::new(x, y, 1.0);
    let normal: Vector3<f64> = board.rotation.column(2).into_owned();
    let slant = normal.dot(&ray);
    let distance = normal.dot(&board.translation_mm) / slant;
    if !(distance.is_finite() && distance > 0.0) {
        return None;
    }
    let point = ray * distance;
    let by_ray: Matrix3<f64> =
        Matrix3::from_diagonal_element(distance) - ray * normal.transpose() * (distance / slant);
    let by_normal: Matrix3x2<f64> = by_ray.fixed_columns::<2>(0).into_owned();
    // distort(x, y; k) = (pixel - c) / f: by both sides' differentials, d(x, y) = D^-1 (d(bent) - D_k dk).
    let Bent { by_position: [xx, xy, yy], by_coefficient, .. } = bend(lens, x, y);
    let determinant = xx * yy - xy * xy;
    let unbend = |by: [f64; 2]| {
        by_normal * Vector2::new(yy * by[0] - xy * by[1], xx * by[1] - xy * by[0]) / determinant
    };
    let mut by_lens = [Vector3::zeros(); LENS];
    by_lens[0] = unbend([-bent[0] / lens.fx, 0.0]);
    by_lens[1] = unbend([0.0, -bent[1] / lens.fy]);
    by_lens[2] = unbend([-1.0 / lens.fx, 0.0]);
    by_lens[3] = unbend([0.0, -1.0 / lens.fy]);
    for (entry, by) in by_lens[4..].iter_mut().zip(&by_coefficient) {
        *entry = -unbend(*by);
    }
    Some(Met {
        point,
        ray,
        by_lens,
        by_turn: normal.cross(&(board.translation_mm - point)) / slant,
        by_shift: normal / slant,
    })
}
