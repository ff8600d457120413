//! Edges of any image to a fraction of a pixel, found and measured by the partial-area method: what the paper does with
//! raw frames and with images of the degree of linear polarization. The decoder itself does not come through here: it
//! knows from the code where edges are.

use std::ops::Range;

use super::subpixel::area::{self, Form, Order};
use crate::grid::Grid;

/// A place on an edge.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ImageEdge {
    /// Place in px, pixel centres at integers.
    pub x: f64,
    /// Place in px.
    pub y: f64,
    /// Whether the edge was crossed along x; then `x` is the measured coordinate and `y` a whole number, else the
    /// other way round.
    pub along_x: bool,
    /// Change of the measured coordinate per px across.
    pub slope: f64,
    /// Level behind the edge less that before it, along the crossing.
    pub step: f64,
}

/// Edges in the part `columns` x `rows` of an image: pixels where the 3x3 mean of the image changes by at least
/// `threshold` over two pixels along one of its axes, more than at both neighbours along that axis, each measured by the
/// method's form for noisy images of second order. A window reaches from its pixel as far as the change falls, up to
/// four pixels.
pub fn edges_of_image(
    image: &Grid<f32>,
    columns: Range<usize>,
    rows: Range<usize>,
    threshold: f32,
) -> Vec<ImageEdge> {
    let smooth = smoothed(image);
    let mut edges = Vec::new();
    for y in rows.start..rows.end.min(image.height()) {
        for x in columns.start..columns.end.min(image.width()) {
            edges.extend(Pixel { image, smooth: &smooth, x, y }.edge(threshold));
        }
    }
    edges
}

/// Means over 3x3 pixels; NaN at the rim.
fn smoothed(image: &Grid<f32>) -> Grid<f32> {
    let (width, height) = (image.width(), image.height());
    let mut out = Grid::filled(width, height, f32::NAN);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let near = (y - 1..=y + 1).flat_map(|y| (x - 1..=x + 1).map(move |x| (x, y)));
            out.data_mut()[y * width + x] = near.map(|(x, y)| image.at(x, y)).sum::<f32>() / 9.0;
        }
    }
    out
}

/// A pixel that may lie on an edge.
#[derive(Clone, Copy)]
struct Pixel<'a> {
    image: &'a Grid<f32>,
    smooth: &'a Grid<f32>,
    x: usize,
    y: usize,
}

impl Pixel<'_> {
    /// Value `t` pixels along and `line` pixels across.
    fn value(self, of: &Grid<f32>, along_x: bool, line: i32, t: i32) -> Option<f32> {
        let (dx, dy) = if along_x { (t, line) } else { (line, t) };
        let x = self.x.checked_add_signed(dx as isize).filter(|&x| x < of.width())?;
        let y = self.y.checked_add_signed(dy as isize).filter(|&y| y < of.height())?;
        Some(of.at(x, y)).filter(|value| value.is_finite())
    }

    /// Change over the two pixels around pixel `t` along the crossing.
    fn change(self, along_x: bool, t: i32) -> Option<f32> {
        let value = |t| self.value(self.smooth, along_x, 0, t);
        Some(value(t + 1)? - value(t - 1)?)
    }

    fn edge(self, threshold: f32) -> Option<ImageEdge> {
        let (by_x, by_y) = (self.change(true, 0)?, self.change(false, 0)?);
        let along_x = by_x.abs() >= by_y.abs();
        let here = if along_x { by_x } else { by_y }.abs();
        let at = |t| self.change(along_x, t).map(f32::abs);
        if here < threshold || at(-1)? > here || at(1)? >= here {
            return None;
        }
        let reach = area::reach(|line, t| self.value(self.smooth, along_x, line, t).map(f64::from))?;
        let form = Form { order: Order::Second, smoothed: true, reach };
        let sample = |line, t| Some((f64::from(self.value(self.image, along_x, line, t)?), 1.0));
        let found = area::locate(form, sample)?;
        // An edge that is not in its own pixel, or leans more than its crossing allows, is none.
        if found.position.abs() > 1.0 || found.slope.abs() > 1.5 {
            return None;
        }
        let (x, y) = (self.x as f64, self.y as f64);
        let (x, y) = if along_x { (x + found.position, y) } else { (x, y + found.position) };
        Some(ImageEdge { x, y, along_x, slope: found.slope, step: found.after - found.before })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A disc with soft pixels: share of each pixel inside, from 32 x 32 points.
    fn disc(cx: f64, cy: f64, radius: f64) -> Grid<f32> {
        let side = 40;
        let share = |x: usize, y: usize| {
            let place = |at: usize, k: usize| at as f64 - 0.5 + (k as f64 + 0.5) / 32.0;
            let inside = (0..1024).filter(|k| (place(x, k % 32) - cx).hypot(place(y, k / 32) - cy) < radius);
            inside.count() as f32 / 1024.0
        };
        Grid::from_vec(
            side,
            side,
            (0..side * side).map(|i| 20.0 + 200.0 * share(i % side, i / side)).collect(),
        )
    }

    #[test]
    fn a_disc_has_a_closed_rim_of_the_right_radius() {
        let (cx, cy, radius) = (19.3, 20.1, 11.7);
        let edges = edges_of_image(&disc(cx, cy, radius), 0..40, 0..40, 30.0);
        // One edge per pixel that a rim of this radius runs through, by the longer of its two directions.
        let expected = 8.0 * radius * std::f64::consts::FRAC_1_SQRT_2;
        assert!((edges.len() as f64 - expected).abs() < 6.0, "{} of {expected}", edges.len());
        for edge in &edges {
            let off = (edge.x - cx).hypot(edge.y - cy) - radius;
            assert!(off.abs() < 0.02, "{edge:?} is {off} px off");
            let inwards = if edge.along_x {
                (edge.x < cx) == (edge.step > 0.0)
            } else {
                (edge.y < cy) == (edge.step > 0.0)
            };
            assert!(inwards && (edge.step.abs() - 200.0).abs() < 2.0, "{edge:?}");
        }
        let part = edges_of_image(&disc(cx, cy, radius), 0..19, 5..30, 30.0);
        let inside = |edge: &&ImageEdge| edge.x.round() < 19.0 && (5.0..29.5).contains(&edge.y);
        assert!(!part.is_empty() && part.len().abs_diff(edges.iter().filter(inside).count()) <= 2);
    }

    #[test]
    fn flat_and_tiny_images_have_no_edges() {
        assert!(edges_of_image(&Grid::filled(30, 30, 7.0), 0..30, 0..30, 1.0).is_empty());
        assert!(edges_of_image(&Grid::filled(2, 1, 7.0), 0..9, 0..9, 0.0).is_empty());
        assert!(edges_of_image(&Grid::filled(30, 30, f32::NAN), 0..30, 0..30, 1.0).is_empty());
    }
}
