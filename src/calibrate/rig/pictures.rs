//! Pictures of a calibration: where the corners of all views lie, and how far each is off.

use image::{Rgb, RgbImage};

use crate::{
    calibration::{observation::View, rig::Calibrated},
    report::colormap::Colormap,
};

/// Residuals are drawn this many times as long as they are.
const EXAGGERATION: f64 = 100.0;
/// Longer side of a picture, at most.
const MOST_PX: f64 = 1600.0;
const PAPER: Rgb<u8> = Rgb([24, 24, 28]);
const GRID: Rgb<u8> = Rgb([60, 60, 68]);

/// A picture of the camera's image, smaller where that is large.
struct Canvas {
    picture: RgbImage,
    scale: f64,
}

impl Canvas {
    fn new((width, height): (u32, u32)) -> Self {
        let scale = (MOST_PX / f64::from(width.max(height))).min(1.0);
        let side = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
        let mut canvas = Self { picture: RgbImage::from_pixel(side(width), side(height), PAPER), scale };
        // Thirds of the image, which should all be filled.
        let (right, bottom) = (f64::from(width), f64::from(height));
        for third in [1.0 / 3.0, 2.0 / 3.0] {
            canvas.line([third * right, 0.0], [third * right, bottom], GRID);
            canvas.line([0.0, third * bottom], [right, third * bottom], GRID);
        }
        canvas
    }

    fn dot(&mut self, [x, y]: [f64; 2], colour: Rgb<u8>) {
        for (dx, dy) in [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)] {
            self.put((x * self.scale).round() as i64 + dx, (y * self.scale).round() as i64 + dy, colour);
        }
    }

    fn put(&mut self, x: i64, y: i64, colour: Rgb<u8>) {
        let (width, height) = self.picture.dimensions();
        if (0..i64::from(width)).contains(&x) && (0..i64::from(height)).contains(&y) {
            self.picture.put_pixel(x as u32, y as u32, colour);
        }
    }

    fn line(&mut self, from: [f64; 2], to: [f64; 2], colour: Rgb<u8>) {
        let [dx, dy] = [to[0] - from[0], to[1] - from[1]];
        let steps = (dx.abs().max(dy.abs()) * self.scale).ceil().clamp(1.0, 4.0 * MOST_PX);
        for step in 0..=steps as u32 {
            let share = f64::from(step) / steps;
            let [x, y] =
                [from[0] + share * dx, from[1] + share * dy].map(|value| (value * self.scale).round());
            self.put(x as i64, y as i64, colour);
        }
    }
}

/// A colour for each view.
fn colour(view: usize, views: usize) -> Rgb<u8> {
    Rgb(Colormap::Jet.color(0.15 + 0.7 * view as f32 / views.max(1) as f32))
}

/// Corners of all views, each view in its colour.
pub fn coverage(views: &[View], size: (u32, u32)) -> RgbImage {
    let mut canvas = Canvas::new(size);
    for (number, view) in views.iter().enumerate() {
        for corner in &view.corners {
            canvas.dot(corner.camera_px, colour(number, views.len()));
        }
    }
    canvas.picture
}

/// From each corner a line towards where the calibration has it, a hundred times as long as it is off.
pub fn residuals(views: &[View], calibrated: &Calibrated) -> RgbImage {
    let lens = &calibrated.calibration.camera;
    let mut canvas = Canvas::new(lens.size());
    for (number, (view, pose)) in views.iter().zip(&calibrated.boards).enumerate() {
        for corner in &view.corners {
            let [x, y] = corner.board_mm;
            let Some(expected) = lens.project(&pose.transform(&nalgebra::Vector3::new(x, y, 0.0))) else {
                continue;
            };
            let at = corner.camera_px;
            let end = [0, 1].map(|axis| at[axis] + EXAGGERATION * (expected[axis] - at[axis]));
            canvas.line(at, end, colour(number, views.len()));
            canvas.dot(at, colour(number, views.len()));
        }
    }
    canvas.picture
}
