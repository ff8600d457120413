//! A pinhole with Brown's distortion written a second time, plainly, and views of boards made with it.

use nalgebra::{Matrix3, Rotation3, Vector3};
use polscan_reconstruction::geometry::{Lens, Pose};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use crate::observation::{Corner, PlanePoint, View};

pub(crate) type P3 = Vector3<f64>;

/// What is true of a made-up rig.
#[derive(Debug, Clone)]
pub(crate) struct Truth {
    pub(crate) camera: Lens,
    pub(crate) projector: Lens,
    pub(crate) rig: Pose,
    pub(crate) boards: Vec<Pose>,
    /// Inner corners along x and y, and their spacing in mm.
    pub(crate) grid: (u32, u32, f64),
}

/// Noise of made-up observations, per axis.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Made {
    pub(crate) camera_px: f64,
    pub(crate) projector_px: f64,
    /// Camera pixels between plane points.
    pub(crate) every_px: usize,
}

pub(crate) fn distort(lens: &Lens, x: f64, y: f64) -> (f64, f64) {
    let [k1, k2, p1, p2, k3] = lens.distortion;
    let r = x.hypot(y);
    let radial = 1.0 + k1 * r.powi(2) + k2 * r.powi(4) + k3 * r.powi(6);
    let dx = 2.0 * p1 * x * y + p2 * (r * r + 2.0 * x * x);
    let dy = p1 * (r * r + 2.0 * y * y) + 2.0 * p2 * x * y;
    (x * radial + dx, y * radial + dy)
}

pub(crate) fn pixel(lens: &Lens, point: P3) -> [f64; 2] {
    let (x, y) = distort(lens, point.x / point.z, point.y / point.z);
    [lens.fx * x + lens.cx, lens.fy * y + lens.cy]
}

/// Fixed-point iteration, many times: slow and plain.
pub(crate) fn ray(lens: &Lens, pixel: [f64; 2]) -> P3 {
    let target = ((pixel[0] - lens.cx) / lens.fx, (pixel[1] - lens.cy) / lens.fy);
    let (mut x, mut y) = target;
    for _ in 0..200 {
        let (bx, by) = distort(lens, x, y);
        (x, y) = (x + target.0 - bx, y + target.1 - by);
    }
    P3::new(x, y, 1.0)
}

pub(crate) fn place(pose: &Pose, point: P3) -> P3 {
    pose.rotation * point + pose.translation_mm
}

/// A number drawn from the normal distribution (Box and Muller).
pub(crate) fn normal(random: &mut StdRng) -> f64 {
    let (a, b): (f64, f64) = (random.random_range(f64::MIN_POSITIVE..1.0), random.random_range(0.0..1.0));
    (-2.0 * a.ln()).sqrt() * (std::f64::consts::TAU * b).cos()
}

/// Board whose middle is at camera pixel `at` and `distance_mm` away, tilted and turned in degrees.
fn board(camera: &Lens, grid: (u32, u32, f64), at: [f64; 2], distance_mm: f64, turn: [f64; 3]) -> Pose {
    let [a, b, c] = turn.map(f64::to_radians);
    let rotation = Rotation3::from_euler_angles(a, b, c).into_inner();
    let middle = P3::new(f64::from(grid.0 - 1), f64::from(grid.1 - 1), 0.0) * (0.5 * grid.2);
    Pose { rotation, translation_mm: ray(camera, at) * distance_mm - rotation * middle }
}

impl Truth {
    /// A rig drawn at random: lens, lens shift, baseline, distance, and `views` boards that go into all quarters of the
    /// image and tilt every way.
    pub(crate) fn random(seed: u64, views: usize) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let mut within = |low: f64, high: f64| random.random_range(low..high);
        let focal = within(1800.0, 4800.0);
        let camera = Lens {
            width: 1600,
            height: 1200,
            fx: focal,
            fy: focal * within(0.998, 1.002),
            cx: 799.5 + within(-25.0, 25.0),
            cy: 599.5 + within(-25.0, 25.0),
            distortion: [
                within(-0.2, 0.1),
                within(-0.15, 0.2),
                within(-1e-3, 1e-3),
                within(-1e-3, 1e-3),
                0.0,
            ],
        };
        let distance = within(600.0, 1200.0);
        // The projector's field is somewhat wider than the camera's, so that boards in the corners are lit.
        let throw = (focal / 1600.0 * within(0.7, 0.85)).min(1.9) * 1024.0;
        let projector = Lens {
            width: 1024,
            height: 768,
            fx: throw,
            fy: throw * within(0.998, 1.002),
            cx: 511.5 + within(-15.0, 15.0),
            cy: 768.0 * within(0.5, 1.02),
            distortion: [
                within(-0.04, 0.04),
                within(-0.04, 0.04),
                within(-1e-3, 1e-3),
                within(-1e-3, 1e-3),
                0.0,
            ],
        };
        let centre = P3::new(within(40.0, 180.0), within(-40.0, 40.0), within(-40.0, 40.0));
        // Turned so that the middle of the camera's image is lit by the middle of the projector's.
        let aim = P3::new(0.0, 0.0, distance) - centre;
        let out = ray(&projector, [511.5, 383.5]);
        let turn = Rotation3::rotation_between(&aim, &out).expect("not opposite").into_inner();
        let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), within(-0.03, 0.03)).into_inner();
        let rotation: Matrix3<f64> = roll * turn;
        let rig = Pose { rotation, translation_mm: -(rotation * centre) };
        let field = 1200.0 / focal * distance;
        let grid = (11, 8, 0.6 * field / 10.0);
        let boards = (0..views).map(|k| {
            let quarter = [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0], [0.0, 0.0]][k % 5];
            let at = [799.5 + 330.0 * quarter[0], 599.5 + 260.0 * quarter[1]];
            let tilt =
                [[1.0, 0.3], [-0.3, 1.0], [-1.0, -0.3], [0.3, -1.0], [0.7, 0.7], [-0.7, 0.7], [0.1, 0.1]]
                    [k % 7];
            let lean = within(18.0, 32.0);
            let turn = [lean * tilt[0], lean * tilt[1], within(-25.0, 25.0)];
            board(&camera, grid, at, distance * within(0.9, 1.1), turn)
        });
        let boards = boards.collect();
        Self { camera, projector, rig, boards, grid }
    }

    /// What is seen of each board, with noise.
    pub(crate) fn views(&self, made: Made, seed: u64) -> Vec<View> {
        let mut random = StdRng::seed_from_u64(seed);
        self.boards
            .iter()
            .enumerate()
            .map(|(k, pose)| self.view(pose, &self.rig, k, made, &mut random))
            .collect()
    }

    /// One view, with a rig pose of its own.
    pub(crate) fn view(&self, pose: &Pose, rig: &Pose, k: usize, made: Made, random: &mut StdRng) -> View {
        let (columns, rows, spacing) = self.grid;
        let mut corners = Vec::new();
        for id in 0..columns * rows {
            let board_mm = [f64::from(id % columns) * spacing, f64::from(id / columns) * spacing];
            let [u, v] = pixel(&self.camera, place(pose, P3::new(board_mm[0], board_mm[1], 0.0)));
            let camera_px = [u + made.camera_px * normal(random), v + made.camera_px * normal(random)];
            if inside(&self.camera, camera_px) {
                corners.push(Corner { id, board_mm, camera_px });
            }
        }
        let mut plane_points = Vec::new();
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        for y in (0..height).step_by(made.every_px) {
            for x in (0..width).step_by(made.every_px) {
                let camera_px = [x as f64, y as f64];
                let d = ray(&self.camera, camera_px);
                let n = pose.rotation * P3::z();
                let point = d * (n.dot(&pose.translation_mm) / n.dot(&d));
                let local = pose.rotation.transpose() * (point - pose.translation_mm);
                let margin = 0.8 * spacing;
                let on = |v: f64, count: u32| (-margin..f64::from(count - 1) * spacing + margin).contains(&v);
                if !on(local.x, columns) || !on(local.y, rows) {
                    continue;
                }
                let [u, v] = pixel(&self.projector, place(rig, point));
                let noisy = [u + made.projector_px * normal(random), v + made.projector_px * normal(random)];
                if inside(&self.projector, noisy) {
                    plane_points.push(PlanePoint { camera_px, projector_px: noisy });
                }
            }
        }
        View { name: format!("view-{k:02}"), corners, plane_points }
    }
}

fn inside(lens: &Lens, [u, v]: [f64; 2]) -> bool {
    (-0.5..f64::from(lens.width) - 0.5).contains(&u) && (-0.5..f64::from(lens.height) - 0.5).contains(&v)
}
