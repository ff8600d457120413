//! The cloud seen obliquely: a shaded surface in a box with axes in mm.

mod mesh;
mod raster;

use image::{RgbImage, imageops};

use self::mesh::Mesh;
use super::{
    canvas::{self, FAINT, INK, WHITE, blank, line},
    maps::Range,
    text::{self, Ink},
    ticks,
};
use crate::{cloud::Cloud, report::colormap::Colormap};

/// Samples per pixel along each side, averaged for soft edges.
const OVERSAMPLING: u32 = 2;

/// How a cloud is looked at.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewSettings {
    /// Width of the picture in px.
    pub width: u32,
    /// Height of the picture in px.
    pub height: u32,
    /// How far the eye moves to the right around the scene, in degrees; 0 is the camera's own direction.
    pub azimuth_deg: f32,
    /// How far the eye moves up, in degrees.
    pub elevation_deg: f32,
    /// By how much depth is stretched; `None` chooses, so that relief is seen. The picture says so.
    pub depth_scale: Option<f32>,
}

impl Default for ViewSettings {
    fn default() -> Self {
        Self { width: 1280, height: 860, azimuth_deg: 32.0, elevation_deg: 24.0, depth_scale: None }
    }
}

/// A point of the scene in mm or a direction.
pub(super) type Vector = [f32; 3];

/// From scene to picture: stretch, turn, perspective.
#[derive(Debug, Clone, Copy)]
struct Projection {
    center: Vector,
    depth_scale: f32,
    azimuth: (f32, f32),
    elevation: (f32, f32),
    distance: f32,
    zoom: f32,
    shift: (f32, f32),
}

impl Projection {
    /// Turns a direction or centred point into the eye's frame: x right, y down, z away.
    fn turn(&self, [x, y, z]: Vector) -> Vector {
        let ((sin_a, cos_a), (sin_e, cos_e)) = (self.azimuth, self.elevation);
        let (x, z) = (x * cos_a + z * sin_a, z * cos_a - x * sin_a);
        [x, y * cos_e - z * sin_e, y * sin_e + z * cos_e]
    }

    fn eye(&self, point: Vector) -> Vector {
        let [x, y, z] = std::array::from_fn(|axis| point[axis] - self.center[axis]);
        self.turn([x, y, z * self.depth_scale])
    }

    /// Place in the picture in px, and distance from the eye.
    fn pixel(&self, point: Vector) -> Vector {
        let [x, y, z] = self.eye(point);
        let scale = self.zoom / (z + self.distance);
        [x * scale + self.shift.0, y * scale + self.shift.1, z + self.distance]
    }

    /// The view of the box `low..high` that fills `area` (left, top, right, bottom) in px.
    fn of_box(low: Vector, high: Vector, settings: &ViewSettings, depth_scale: f32, area: [f32; 4]) -> Self {
        let extent: Vector = std::array::from_fn(|axis| high[axis] - low[axis]);
        let radius = 0.5 * (extent[0].powi(2) + extent[1].powi(2) + (extent[2] * depth_scale).powi(2)).sqrt();
        let mut view = Self {
            center: std::array::from_fn(|axis| 0.5 * (low[axis] + high[axis])),
            depth_scale,
            azimuth: settings.azimuth_deg.to_radians().sin_cos(),
            elevation: settings.elevation_deg.to_radians().sin_cos(),
            distance: 4.0 * radius,
            zoom: 1.0,
            shift: (0.0, 0.0),
        };
        let mut bounds = [f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        for corner in corners(low, high) {
            let [x, y, _] = view.pixel(corner);
            bounds = [bounds[0].min(x), bounds[1].min(y), bounds[2].max(x), bounds[3].max(y)];
        }
        let fit = |axis: usize| (area[axis + 2] - area[axis]) / (bounds[axis + 2] - bounds[axis]);
        view.zoom = fit(0).min(fit(1));
        let middle = |of: [f32; 4], axis: usize| 0.5 * (of[axis] + of[axis + 2]);
        view.shift = (
            middle(area, 0) - view.zoom * middle(bounds, 0),
            middle(area, 1) - view.zoom * middle(bounds, 1),
        );
        view
    }
}

fn corners(low: Vector, high: Vector) -> impl Iterator<Item = Vector> {
    (0..8usize).map(move |corner| {
        std::array::from_fn(|axis| if corner >> axis & 1 == 0 { low[axis] } else { high[axis] })
    })
}

/// The cloud as a shaded surface, coloured by depth. Neighbouring pixels are joined but across depth jumps.
pub fn cloud_view(cloud: &Cloud, settings: &ViewSettings) -> RgbImage {
    let (width, height) = (settings.width.clamp(64, 8192), settings.height.clamp(64, 8192));
    let letters = canvas::text_height(height);
    let mesh = Mesh::new(&cloud.point_mm, width as usize);
    let Some((low, high)) = mesh.bounds() else {
        let mut picture = blank(width, height, WHITE);
        let message = "no points";
        let at = (0.5 * (width as f32 - text::width(message, letters)), 0.5 * height as f32);
        text::draw(&mut picture, message, at, Ink { height: letters, color: INK });
        return picture;
    };
    let depth_scale = settings.depth_scale.unwrap_or_else(|| suitable_scale(low, high)).clamp(0.01, 1000.0);
    let bar = canvas::bar_width(letters);
    let factor = OVERSAMPLING as f32;
    // Room for numbers and names around the box, less where the picture itself is small.
    let room = |letters: f32, side: u32| letters.min(0.2 * side as f32);
    let inner = [
        room(12.0 * letters, width),
        room(3.0 * letters, height),
        width as f32 - room((bar as f32) + 10.0 * letters, 2 * width),
        height as f32 - room(5.0 * letters, height),
    ];
    let view = Projection::of_box(low, high, settings, depth_scale, inner);
    let fine = Projection {
        zoom: view.zoom * factor,
        shift: (view.shift.0 * factor, view.shift.1 * factor),
        ..view
    };
    let range = Range { low: low[2], high: high[2] };
    let mut canvas = blank(width * OVERSAMPLING, height * OVERSAMPLING, WHITE);
    let axes = axes(&view, low, high, letters);
    draw_walls(&mut canvas, &fine, &axes, factor);
    raster::surface(&mut canvas, &mesh, &fine, range);
    let mut picture = imageops::thumbnail(&canvas, width, height);
    draw_labels(&mut picture, &view, &axes, letters);
    if depth_scale != 1.0 {
        let note = format!("depth ×{}", ticks::label(depth_scale, usize::from(depth_scale.fract() != 0.0)));
        text::draw(&mut picture, &note, (letters, letters), Ink { height: letters, color: INK });
    }
    let bar_style = canvas::ColorBar { map: Colormap::Parula, range, unit: "z mm", letters };
    canvas::color_bar(&mut picture, (width - bar, height / 8, height * 3 / 4), bar_style);
    picture
}

/// Stretches depth in whole steps until it is about a third of the scene's width.
fn suitable_scale(low: Vector, high: Vector) -> f32 {
    let wide = (high[0] - low[0]).max(high[1] - low[1]);
    (0.33 * wide / (high[2] - low[2]).max(1e-6)).floor().clamp(1.0, 5.0)
}

/// One axis of the box.
struct AxisTicks {
    name: &'static str,
    low: f32,
    high: f32,
    values: Vec<f32>,
    decimals: usize,
    /// The edge that carries its numbers, from `low` to `high`.
    edge: [Vector; 2],
}

/// The axes with as many ticks as their edges have room for.
fn axes(view: &Projection, low: Vector, high: Vector, letters: f32) -> [AxisTicks; 3] {
    let far = far_sides(view);
    let side = |axis: usize, is_far: bool| if far[axis] == is_far { high[axis] } else { low[axis] };
    std::array::from_fn(|axis| {
        // x and z run along the floor's near edges, y along the upright edge where the far side wall comes near.
        let at = match axis {
            0 => [0.0, side(1, true), side(2, false)],
            1 => [side(0, true), 0.0, side(2, false)],
            _ => [side(0, false), side(1, true), 0.0],
        };
        let mut edge = [at; 2];
        (edge[0][axis], edge[1][axis]) = (low[axis], high[axis]);
        let [from, to] = edge.map(|end| view.pixel(end));
        // Numbers beside each other need more room than numbers below each other.
        let count = match axis {
            0 => (to[0] - from[0]).abs() / (6.0 * letters),
            _ => (to[1] - from[1]).abs() / (2.0 * letters),
        };
        let wanted = count.clamp(1.0, 6.0) as usize;
        let (values, decimals) = ticks::ticks(low[axis], high[axis], wanted);
        AxisTicks { name: ["x", "y", "z"][axis], low: low[axis], high: high[axis], values, decimals, edge }
    })
}

/// Sides of the box that the eye sees from inside: for each axis whether it is the upper one.
fn far_sides(view: &Projection) -> [bool; 3] {
    std::array::from_fn(|axis| {
        let mut direction = [0.0; 3];
        direction[axis] = 1.0;
        view.turn(direction)[2] > 0.0
    })
}

/// The three far sides of the box, with a grid.
fn draw_walls(image: &mut RgbImage, view: &Projection, axes: &[AxisTicks; 3], width: f32) {
    let far = far_sides(view);
    for wall in 0..3 {
        let level = if far[wall] { axes[wall].high } else { axes[wall].low };
        for axis in (0..3).filter(|&axis| axis != wall) {
            let other = 3 - wall - axis;
            let edges = [axes[axis].low, axes[axis].high];
            for &value in axes[axis].values.iter().chain(&edges) {
                let mut from = [0.0; 3];
                (from[wall], from[axis], from[other]) = (level, value, axes[other].low);
                let mut to = from;
                to[other] = axes[other].high;
                let [from, to] = [view.pixel(from), view.pixel(to)];
                let thick = if edges.contains(&value) { 1.4 * width } else { width };
                line(image, (from[0], from[1]), (to[0], to[1]), thick, FAINT);
            }
        }
    }
}

/// Numbers along the edges of the axes, and their names.
fn draw_labels(image: &mut RgbImage, view: &Projection, axes: &[AxisTicks; 3], letters: f32) {
    let ink = Ink { height: letters, color: INK };
    let middle = |a: f32, b: f32| 0.5 * (a + b);
    let center = view.pixel(std::array::from_fn(|axis| middle(axes[axis].low, axes[axis].high)));
    for (axis, of) in axes.iter().enumerate() {
        let at = |value: f32| {
            let mut point = of.edge[0];
            point[axis] = value;
            view.pixel(point)
        };
        let [x, y, _] = at(middle(of.low, of.high));
        // Numbers stand below the edge of x and beside the other two.
        let (dx, dy) =
            if axis == 0 { (0.0, (y - center[1]).signum()) } else { ((x - center[0]).signum(), 0.0) };
        for &value in &of.values {
            let [x, y, _] = at(value);
            line(image, (x, y), (x + 0.5 * letters * dx, y + 0.5 * letters * dy), 1.0, INK);
        }
        let mut write = |value: f32, label: &str, away: f32| {
            let [x, y, _] = at(value);
            let (cx, cy) = (x + away * dx, y + away * dy);
            let width = text::width(label, letters);
            let left = cx - 0.5 * (1.0 - dx) * width;
            let top = cy - 0.5 * (1.0 - dy) * letters;
            text::draw(image, label, (left, top), ink);
        };
        let labels: Vec<String> = of.values.iter().map(|&value| ticks::label(value, of.decimals)).collect();
        for (&value, label) in of.values.iter().zip(&labels) {
            write(value, label, 0.9 * letters);
        }
        let widest = labels.iter().map(|label| text::width(label, letters)).fold(0.0, f32::max);
        let beyond = if axis == 0 { 1.5 * letters } else { widest + letters };
        write(middle(of.low, of.high), &format!("{} (mm)", of.name), 0.9 * letters + beyond);
    }
}

#[cfg(test)]
mod tests;
