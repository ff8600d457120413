//! How far the picture of one state lies off that of the other, over the projector's picture.

use serde::{Deserialize, Serialize};

use super::EdgeShift;
use crate::fit::linear;

/// Edges that a field needs along each axis.
const FEWEST_EDGES: usize = 60;
/// Camera pixels per projector pixel beyond which a picture is seen too obliquely or from too far.
const LEAST_SCALE: f64 = 0.01;

/// Terms of a polynomial of second degree.
fn terms(x: f64, y: f64) -> [f64; 6] {
    [1.0, x, y, x * x, x * y, y * y]
}

/// Misregistration of V against H in projector px: polynomials of second degree in the picture's coordinates, each from
/// -1 to 1. Lenses with lateral colour and panels that are shifted, turned or of another size do nothing else.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Field {
    /// Width and height of the picture in px.
    pub size: [u32; 2],
    /// Coefficients of 1, x, y, x^2, x y, y^2 for the shift along columns.
    pub x: [f64; 6],
    /// The same for the shift along rows.
    pub y: [f64; 6],
    /// Sigma of the shift in the middle of the picture along both axes.
    pub sigma_px: [f64; 2],
    /// Scatter of single edges about the field.
    pub scatter_px: [f64; 2],
}

impl Field {
    /// How far V lies off H at a projector coordinate, in px.
    pub fn at(&self, column: f64, row: f64) -> [f64; 2] {
        let terms = terms(normal(column, self.size[0]), normal(row, self.size[1]));
        [self.x, self.y].map(|of| of.iter().zip(terms).map(|(factor, term)| factor * term).sum())
    }

    /// The largest shift at corners, edges' middles and centre, in px.
    pub fn largest_px(&self) -> f64 {
        let [width, height] = self.size.map(|side| f64::from(side) - 1.0);
        let places = (0..9).map(|n| self.at(0.5 * width * f64::from(n % 3), 0.5 * height * f64::from(n / 3)));
        places.map(|[x, y]| x.hypot(y)).fold(0.0, f64::max)
    }
}

/// Coordinate of a picture from -1 to 1.
fn normal(at: f64, side: u32) -> f64 {
    (2.0 * at + 1.0) / f64::from(side) - 1.0
}

/// A smooth map from camera pixels to one projector coordinate, for telling where edges lie and how long a pixel is.
struct Map {
    factors: Vec<f64>,
    scale: f64,
}

impl Map {
    fn new(edges: &[EdgeShift]) -> Option<Self> {
        let scale = edges.iter().flat_map(|edge| edge.camera_px).fold(1.0, f64::max);
        let rows: Vec<[f64; 6]> =
            edges.iter().map(|edge| terms(edge.camera_px[0] / scale, edge.camera_px[1] / scale)).collect();
        let values: Vec<f64> = edges.iter().map(|edge| edge.projector_px).collect();
        Some(Self { factors: linear(&rows, &values, &vec![1.0; edges.len()])?.parameters, scale })
    }

    fn at(&self, [x, y]: [f64; 2]) -> f64 {
        self.factors
            .iter()
            .zip(terms(x / self.scale, y / self.scale))
            .map(|(factor, term)| factor * term)
            .sum()
    }

    /// Projector px per camera px along x or y.
    fn slope(&self, [x, y]: [f64; 2], axis: usize) -> f64 {
        let step = |sign: f64| if axis == 0 { self.at([x + sign, y]) } else { self.at([x, y + sign]) };
        0.5 * (step(1.0) - step(-1.0))
    }
}

/// Fits the field from edges between columns, found along camera rows, and between rows, found along camera columns.
/// `None` where there are too few, or where the camera sees the picture turned on its side.
pub fn misregistration(size: [u32; 2], columns: &[EdgeShift], rows: &[EdgeShift]) -> Option<Field> {
    if columns.len() < FEWEST_EDGES || rows.len() < FEWEST_EDGES {
        return None;
    }
    let maps = [Map::new(columns)?, Map::new(rows)?];
    let mut field = Field { size, x: [0.0; 6], y: [0.0; 6], sigma_px: [0.0; 2], scatter_px: [0.0; 2] };
    for (axis, edges) in [columns, rows].into_iter().enumerate() {
        let slopes: Vec<f64> = edges.iter().map(|edge| maps[axis].slope(edge.camera_px, axis)).collect();
        if slopes.iter().any(|slope| slope.abs() < LEAST_SCALE) {
            return None;
        }
        let places: Vec<[f64; 6]> = edges
            .iter()
            .map(|edge| {
                let at = [0, 1].map(|other| match other == axis {
                    true => edge.projector_px,
                    false => maps[other].at(edge.camera_px),
                });
                terms(normal(at[0], size[0]), normal(at[1], size[1]))
            })
            .collect();
        let shifts: Vec<f64> = edges.iter().zip(&slopes).map(|(edge, slope)| edge.shift_px * slope).collect();
        let scatter = scatter(&shifts);
        let fit = linear(&places, &shifts, &vec![scatter.max(1e-6); shifts.len()])?;
        let factors: [f64; 6] = fit.parameters.clone().try_into().ok()?;
        let target = if axis == 0 { &mut field.x } else { &mut field.y };
        *target = factors;
        field.sigma_px[axis] = fit.sigma(0);
        field.scatter_px[axis] = scatter * fit.reduced_chi2.sqrt();
    }
    Some(field)
}

/// Robust spread.
fn scatter(values: &[f64]) -> f64 {
    let median = |mut values: Vec<f64>| {
        let middle = values.len() / 2;
        *values.select_nth_unstable_by(middle, f64::total_cmp).1
    };
    let centre = median(values.to_vec());
    1.4826 * median(values.iter().map(|value| (value - centre).abs()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    #[test]
    fn a_field_is_found_through_a_perspective_view() {
        let mut random = StdRng::seed_from_u64(5);
        let size = [1024, 768];
        let truth = |u: f64, v: f64| {
            let (x, y) = (u / 512.0 - 1.0, v / 384.0 - 1.0);
            [0.4 + 0.1 * x - 0.05 * x * y, -0.25 + 0.08 * y * y]
        };
        // Camera px of a projector coordinate, with some perspective.
        let seen = |u: f64, v: f64| {
            let depth = 1.0 + 5e-5 * u + 3e-5 * v;
            [40.0 + 1.5 * u / depth, 20.0 + 1.4 * v / depth]
        };
        let mut noise = || 0.1 * ((0..12).map(|_| random.random::<f64>()).sum::<f64>() - 6.0);
        let (mut columns, mut rows) = (Vec::new(), Vec::new());
        for line in 0..200 {
            for edge in 1..8 {
                let (u, v) = (f64::from(edge * 128) - 0.5, f64::from(line) * 3.8);
                let (here, there) = (seen(u, v), seen(u + truth(u, v)[0], v));
                columns.push(EdgeShift {
                    camera_px: here,
                    projector_px: u,
                    shift_px: there[0] - here[0] + noise(),
                });
                let (u, v) = (f64::from(line) * 5.1, f64::from(edge * 96) - 0.5);
                let (here, there) = (seen(u, v), seen(u, v + truth(u, v)[1]));
                rows.push(EdgeShift {
                    camera_px: here,
                    projector_px: v,
                    shift_px: there[1] - here[1] + noise(),
                });
            }
        }
        let field = misregistration(size, &columns, &rows).unwrap();
        for (u, v) in [(10.0, 10.0), (512.0, 384.0), (1000.0, 700.0), (20.0, 750.0)] {
            let (found, expected) = (field.at(u, v), truth(u, v));
            assert!(
                (0..2).all(|axis| (found[axis] - expected[axis]).abs() < 0.05),
                "{u} {v}: {found:?} {expected:?}"
            );
        }
        assert!(field.sigma_px.iter().all(|sigma| (5e-4..0.01).contains(sigma)), "{field:?}");
        assert!(misregistration(size, &columns[..20], &rows).is_none());
        // Seen on its side: what are columns runs along camera rows.
        assert!(misregistration(size, &rows, &columns).is_none());
    }
}
