//! The board as a decoded plane: camera pixels on it, each with the projector position that lights it.

use polscan_reconstruction::{decode::Decoded, grid::Grid};

use crate::observation::{Corner, PlanePoint};

/// What is known of a view.
#[derive(Debug, Clone, Copy)]
pub struct PlaneInput<'a> {
    /// Its decoded maps; rows must have been coded.
    pub decoded: &'a Decoded,
    /// Corners of the board, which bound it.
    pub corners: &'a [Corner],
    /// Points wanted, at most.
    pub most: usize,
}

/// Printed edges are kept this far away, in px: there the pixel sees two tones, and a stripe's edge seems shifted.
const CLEARANCE: usize = 2;
/// Light varies by at most this share within the clearance of a pixel that is used.
const MOST_VARIATION: f32 = 0.15;

/// Valid pixels inside the convex hull of the corners, on an even grid. Empty where rows were not coded.
pub fn plane_points(input: &PlaneInput<'_>) -> Vec<PlanePoint> {
    let Some(rows) = &input.decoded.row else { return Vec::new() };
    let hull = hull(input.corners.iter().map(|corner| corner.camera_px).collect());
    if hull.len() < 3 {
        return Vec::new();
    }
    let class = &input.decoded.class;
    let least = [0, 1].map(|axis| hull.iter().map(|at| at[axis]).fold(f64::MAX, f64::min));
    let most = [0, 1].map(|axis| hull.iter().map(|at| at[axis]).fold(f64::MIN, f64::max));
    let range = |axis: usize, length: usize| {
        least[axis].ceil().max(0.0) as usize..(most[axis].floor() as usize + 1).min(length)
    };
    let mut points = Vec::new();
    for y in range(1, class.height()) {
        for x in range(0, class.width()) {
            let at = y * class.width() + x;
            if !class.data()[at].is_valid() || !inside(&hull, [x as f64, y as f64]) {
                continue;
            }
            if !is_even(&input.decoded.modulation, x, y) {
                continue;
            }
            let projector =
                [input.decoded.column.coordinate.data()[at], rows.coordinate.data()[at]].map(f64::from);
            if projector.iter().all(|value| value.is_finite()) {
                points.push(PlanePoint { camera_px: [x as f64, y as f64], projector_px: projector });
            }
        }
    }
    thinned(points, input.most)
}

/// About `most` of the points, evenly: those nearest to the nodes of a square grid.
fn thinned(points: Vec<PlanePoint>, most: usize) -> Vec<PlanePoint> {
    if points.len() <= most {
        return points;
    }
    let step = (points.len() as f64 / most as f64).sqrt().ceil() as u64;
    let on_grid =
        |point: &PlanePoint| point.camera_px.iter().all(|&value| (value as u64).is_multiple_of(step));
    points.into_iter().filter(on_grid).collect()
}

/// Whether the light hardly changes around a pixel.
fn is_even(modulation: &Grid<f32>, x: usize, y: usize) -> bool {
    let (width, height) = (modulation.width(), modulation.height());
    if x < CLEARANCE || y < CLEARANCE || x + CLEARANCE >= width || y + CLEARANCE >= height {
        return false;
    }
    let (mut low, mut high) = (f32::MAX, f32::MIN);
    for v in y - CLEARANCE..=y + CLEARANCE {
        for &value in &modulation.data()[v * width + x - CLEARANCE..=v * width + x + CLEARANCE] {
            low = low.min(value);
            high = high.max(value);
        }
    }
    high - low <= MOST_VARIATION * high
}

/// Corners of the convex hull, in turn (Andrew's monotone chain).
fn hull(mut points: Vec<[f64; 2]>) -> Vec<[f64; 2]> {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let chain = |points: &mut dyn Iterator<Item = [f64; 2]>| {
        let mut chain: Vec<[f64; 2]> = Vec::new();
        for point in points {
            while chain.len() >= 2 && side(chain[chain.len() - 2], chain[chain.len() - 1], point) <= 0.0 {
                chain.pop();
            }
            chain.push(point);
        }
        chain.pop();
        chain
    };
    let mut around = chain(&mut points.iter().copied());
    around.extend(chain(&mut points.iter().rev().copied()));
    around
}

/// Twice the area of a triangle, positive where it turns as the axes do.
fn side([ax, ay]: [f64; 2], [bx, by]: [f64; 2], [cx, cy]: [f64; 2]) -> f64 {
    (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
}

fn inside(hull: &[[f64; 2]], at: [f64; 2]) -> bool {
    let next = hull.iter().cycle().skip(1);
    hull.iter().zip(next).all(|(&from, &to)| side(from, to, at) >= 0.0)
}
