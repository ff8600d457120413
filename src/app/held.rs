//! The simulated rig holds the board by itself: a printed plane before camera and projector, at scripted poses.

use nalgebra::{Rotation3, Vector3};
use polscan_drivers::sim::{Material, Object, Plane, Print, RigDescription, Scene, Shape};

use super::without_analyser;
use crate::{
    calibration::boards::{
        Board,
        print::{Shape as Ink, dark_shapes},
    },
    config::Settings,
};

/// A square is divided into at most as many cells along a side.
const MOST_CELLS: u32 = 64;
/// Share of the image's shorter side that the board's longer side fills.
const FILLS: f64 = 0.62;
/// Distance of the board where the rig is not aimed at any.
const DISTANCE_MM: f64 = 1000.0;
/// Steepest tilt in degrees.
const TILT_DEG: f64 = 28.0;

/// Settings for ordinary Gray code under which the simulated rig sees the board in pose `number`; `None` where the rig
/// is a real one.
///
/// # Errors
/// Why the rig cannot draw the board.
pub fn holding(settings: &Settings, board: &Board, number: u32) -> Result<Option<Settings>, String> {
    let Some((mut settings, _)) = without_analyser(settings) else { return Ok(None) };
    let print = Cells::of(board)?;
    if let Some((description, scene)) = &mut settings.sim {
        *scene = held(&print, board, description, number);
    }
    Ok(Some(settings))
}

/// A board as cells.
struct Cells {
    cell_mm: f64,
    cells: Vec<String>,
}

impl Cells {
    fn of(board: &Board) -> Result<Self, String> {
        let rectangles: Option<Vec<[f64; 4]>> = dark_shapes(board)
            .into_iter()
            .map(|shape| match shape {
                Ink::Rectangle(rectangle) => Some(rectangle),
                Ink::Disc(_) => None,
            })
            .collect();
        let refused = |message: &str| message.to_owned();
        let Some(rectangles) = rectangles else {
            return Err(refused("it draws squares only: give a checkerboard or a ChArUco board"));
        };
        let size = board.size_mm();
        let square = rectangles.iter().map(|[_, _, width, _]| *width).fold(0.0, f64::max);
        let whole = |value: f64, cell: f64| ((value / cell) - (value / cell).round()).abs() < 1e-6;
        let fits = |cell: f64| rectangles.iter().flatten().chain(&size).all(|&value| whole(value, cell));
        let Some(cell) = (1..=MOST_CELLS).map(|parts| square / f64::from(parts)).find(|&cell| fits(cell))
        else {
            return Err(refused(
                "its squares and markers fit no common grid: make marker_mm three quarters of square_mm with 4x4 markers",
            ));
        };
        let count = size.map(|side| (side / cell).round() as usize);
        let mut cells = vec![vec![b'.'; count[0]]; count[1]];
        for [left, top, width, height] in rectangles {
            let [left, top, width, height] =
                [left, top, width, height].map(|value| (value / cell).round() as usize);
            cells[top..top + height].iter_mut().for_each(|row| row[left..left + width].fill(b'#'));
        }
        let text = |row: Vec<u8>| String::from_utf8(row).expect("cells are ASCII");
        Ok(Self { cell_mm: cell * board.scale(), cells: cells.into_iter().map(text).collect() })
    }
}

/// The board held so that its middle is seen in another part of the image each time, tilted another way.
fn held(print: &Cells, board: &Board, description: &RigDescription, number: u32) -> Scene {
    let camera = &description.camera;
    let [width, height] = camera.size.map(f64::from);
    let size = board.size_mm().map(|side| side * board.scale());
    // As near as makes it fill its share of the image.
    let fitting = size[0].max(size[1]) * camera.focal_px / (FILLS * width.min(height));
    let aimed = description.pose.aim_mm.unwrap_or(DISTANCE_MM);
    let distance = fitting.clamp(0.75 * aimed, 1.25 * aimed) * [1.0, 1.06, 0.95][number as usize % 3];
    let roll = (f64::from(number * 37 % 60) - 30.0).to_radians() * 0.5;
    // Around the image by quarters, as far out as the whole board is still seen; every fifth in the middle.
    let [across, down] =
        [[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [0.0, 0.0]][number as usize % 5];
    let (sin, cos) = (roll.sin().abs(), roll.cos());
    let scale = camera.focal_px / distance;
    let room = |side: f64, board_mm: f64| 0.45 * (side - scale * board_mm).max(0.0);
    let centre = camera.principal_point_px.unwrap_or([0.5 * (width - 1.0), 0.5 * (height - 1.0)]);
    let at = [
        centre[0] + across * room(width, size[0] * cos + size[1] * sin),
        centre[1] + down * room(height, size[0] * sin + size[1] * cos),
    ];
    let middle = Vector3::new((at[0] - centre[0]) / scale, (at[1] - centre[1]) / scale, distance);
    // Seven directions of tilt against five places: no two views of a session are alike before the 35th.
    let direction = std::f64::consts::TAU * f64::from(number % 7) / 7.0;
    let tilt = TILT_DEG.to_radians() * if number % 5 == 4 { 0.6 } else { 1.0 };
    let axis = nalgebra::Unit::new_normalize(Vector3::new(direction.cos(), direction.sin(), 0.0));
    let turned =
        Rotation3::from_axis_angle(&axis, tilt) * Rotation3::from_axis_angle(&Vector3::z_axis(), roll);
    let [right, down, normal] = [Vector3::x(), Vector3::y(), -Vector3::z()].map(|axis| turned * axis);
    let origin = middle - right * (0.5 * size[0]) - down * (0.5 * size[1]);
    let array = |vector: Vector3<f64>| [vector.x, vector.y, vector.z];
    let object = Object {
        name: "board".into(),
        material: "paper".into(),
        level: Some(0.8),
        level_of: None,
        print: Some(Print {
            origin_mm: array(origin),
            right: array(right),
            down: array(down),
            cell_mm: print.cell_mm,
            cells: print.cells.clone(),
            dark: board.tones.dark / board.tones.light,
        }),
        shape: Shape::Plane(Plane { point_mm: array(middle), normal: array(normal), x_mm: None, y_mm: None }),
    };
    let paper =
        Material { index: None, roughness: 0.3, diffuse: 0.8, tint: [1.0; 3], texture: 0.0, texture_mm: 6.0 };
    Scene { materials: [("paper".to_owned(), paper)].into(), objects: vec![object] }
}
