//! Triangles with a depth buffer and soft light.

use image::{Rgb as Pixel, RgbImage};

use super::{
    Projection, Vector,
    mesh::{Mesh, is_there},
};
use crate::report::{
    colormap::{Colormap, Rgb},
    pictures::maps::Range,
};

/// Towards the lamp, in the eye's frame: from the upper left, behind the eye.
const LAMP: Vector = [-0.45, -0.58, -0.68];

/// Share of the light that comes from everywhere.
const AMBIENT: f32 = 0.5;

/// Brightness of the lamp: surfaces at a slant to it have the colours of the bar.
const BRIGHTNESS: f32 = 1.35;

/// Strength and sharpness of the lamp's reflection.
const GLOSS: (f32, i32) = (0.1, 18);

/// A corner of a triangle in the picture.
#[derive(Debug, Clone, Copy)]
struct Corner {
    x: f32,
    y: f32,
    distance: f32,
    color: [f32; 3],
}

/// Draws the mesh over `image`.
pub(super) fn surface(image: &mut RgbImage, mesh: &Mesh, view: &Projection, range: Range) {
    let corners: Vec<Option<Corner>> = mesh
        .points
        .data()
        .iter()
        .zip(mesh.normals.data())
        .map(|(&point, &normal)| is_there(point).then(|| corner(point, normal, view, range)))
        .collect();
    let mut distances = vec![f32::INFINITY; image.width() as usize * image.height() as usize];
    let (width, height) = (mesh.points.width(), mesh.points.height());
    let depth = |index: usize| mesh.points.data()[index][2];
    for y in 1..height {
        for x in 1..width {
            let at = y * width + x;
            let (a, b, c, d) = (at - width - 1, at - width, at - 1, at);
            for triangle in [[a, b, c], [b, d, c]] {
                let [Some(p), Some(q), Some(r)] = triangle.map(|index| corners[index]) else { continue };
                let [near, mid, far] = triangle.map(depth);
                let span = near.max(mid).max(far) - near.min(mid).min(far);
                if span <= mesh.jump_mm {
                    fill(image, &mut distances, [p, q, r]);
                }
            }
        }
    }
}

fn corner(point: Vector, normal: Vector, view: &Projection, range: Range) -> Corner {
    let [x, y, distance] = view.pixel(point);
    let color = Colormap::Parula.color(range.share(point[2]));
    Corner { x, y, distance, color: shade(color, normal, view) }
}

fn shade(color: Rgb, [nx, ny, nz]: Vector, view: &Projection) -> [f32; 3] {
    // Stretching depth turns normals the other way.
    let turned = view.turn([nx, ny, nz / view.depth_scale]);
    let length = turned.iter().map(|value| value * value).sum::<f32>().sqrt().max(1e-12);
    let lamp = LAMP.iter().map(|value| value * value).sum::<f32>().sqrt();
    let cosine: f32 = turned.iter().zip(LAMP).map(|(n, l)| n * l).sum::<f32>() / (length * lamp);
    // Halfway between lamp and eye.
    let half = [LAMP[0] / lamp, LAMP[1] / lamp, LAMP[2] / lamp - 1.0];
    let half_length = half.iter().map(|value| value * value).sum::<f32>().sqrt();
    let gloss = turned.iter().zip(half).map(|(n, h)| n * h).sum::<f32>() / (length * half_length);
    // Surfaces are seen from both sides.
    let light = (AMBIENT + (1.0 - AMBIENT) * BRIGHTNESS * cosine.abs()).min(1.1);
    let shine = 255.0 * GLOSS.0 * gloss.abs().powi(GLOSS.1);
    color.map(|channel| (f32::from(channel) * light + shine).min(255.0))
}

fn fill(image: &mut RgbImage, distances: &mut [f32], [a, b, c]: [Corner; 3]) {
    let area = (b.x - a.x) * (c.y - a.y) - (b.y - a.y) * (c.x - a.x);
    if !area.is_normal() {
        return;
    }
    let span = |p: f32, q: f32, r: f32, side: u32| {
        let (low, high) = (p.min(q).min(r), p.max(q).max(r));
        ((low - 0.5).ceil().max(0.0) as u32)..((high + 0.5).floor().clamp(0.0, side as f32) as u32)
    };
    let width = image.width() as usize;
    for row in span(a.y, b.y, c.y, image.height()) {
        for column in span(a.x, b.x, c.x, image.width()) {
            let (x, y) = (column as f32 + 0.5, row as f32 + 0.5);
            let v = ((x - a.x) * (c.y - a.y) - (y - a.y) * (c.x - a.x)) / area;
            let w = ((b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x)) / area;
            let u = 1.0 - v - w;
            // A hair more than the triangle, so that no seam shows between neighbours.
            if u.min(v).min(w) < -1e-3 {
                continue;
            }
            let distance = u * a.distance + v * b.distance + w * c.distance;
            let place = &mut distances[row as usize * width + column as usize];
            if distance < *place {
                *place = distance;
                let mixed =
                    |channel: usize| u * a.color[channel] + v * b.color[channel] + w * c.color[channel];
                let color = std::array::from_fn(|channel| mixed(channel).round().clamp(0.0, 255.0) as u8);
                image.put_pixel(column, row, Pixel(color));
            }
        }
    }
}
