//! Places where two dark and two light sectors meet: corners of a checkerboard, and some that only look like one.
//!
//! Candidates are maxima of the ChESS response (Bennett and Lasenby 2014); the four edges that leave each are then read
//! off a circle around it.

use std::f64::consts::{PI, TAU};

use rayon::prelude::*;

use super::picture::Picture;

/// Circle of the ChESS response, in order of the angle.
const RING: [(i64, i64); 16] = [
    (5, 0),
    (5, 2),
    (3, 3),
    (2, 5),
    (0, 5),
    (-2, 5),
    (-3, 3),
    (-5, 2),
    (-5, 0),
    (-5, -2),
    (-3, -3),
    (-2, -5),
    (0, -5),
    (2, -5),
    (3, -3),
    (5, -2),
];
/// Radius of the circle on which edges are read, in px.
const EDGE_RADIUS: f64 = 4.5;
/// Samples on it.
const EDGE_SAMPLES: usize = 64;
/// Weakest response that is looked at, as a share of the strongest.
const LEAST_RESPONSE: f32 = 0.05;
/// Maxima are this far apart, in px.
const APART: i64 = 3;
/// Opposite edges may be bent by this much against each other.
const MOST_BEND: f64 = 0.5;

/// Where two edges cross.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Crossing {
    /// Place in px.
    pub(super) at: [f64; 2],
    /// Angles of the four edges that leave it, rising; y points down, so they turn clockwise to the eye.
    pub(super) edges: [f64; 4],
    /// Whether the sector between the first and the second edge is the light one.
    pub(super) first_is_light: bool,
    /// Light minus dark.
    pub(super) contrast: f64,
}

impl Crossing {
    /// Whether the sector that follows edge `edge` is light.
    pub(super) fn light_after(&self, edge: usize) -> bool {
        self.first_is_light == edge.is_multiple_of(2)
    }
}

/// All crossings of a picture that is a little blurred.
pub(super) fn crossings(picture: &Picture) -> Vec<Crossing> {
    let (width, height) = (picture.width(), picture.height());
    if width < 16 || height < 16 {
        return Vec::new();
    }
    let mut response = vec![0.0f32; width * height];
    response.par_chunks_mut(width).enumerate().skip(5).take(height - 10).for_each(|(y, out)| {
        for (x, out) in out.iter_mut().enumerate().skip(5).take(width - 10) {
            *out = chess(picture, x, y);
        }
    });
    let strongest = response.iter().copied().fold(0.0, f32::max);
    let is_maximum = |x: usize, y: usize| {
        let own = response[y * width + x];
        let around = (-APART..=APART).flat_map(|dy| (-APART..=APART).map(move |dx| (dx, dy)));
        own > LEAST_RESPONSE * strongest
            && around.filter(|&offset| offset != (0, 0)).all(|(dx, dy)| {
                let (x, y) = ((x as i64 + dx) as usize, (y as i64 + dy) as usize);
                let other = response[y * width + x];
                // Of two equal ones the first.
                own > other || (own == other && (dy, dx) > (0, 0))
            })
    };
    (6..height - 6)
        .into_par_iter()
        .flat_map_iter(|y| (6..width - 6).map(move |x| (x, y)))
        .filter(|&(x, y)| is_maximum(x, y))
        .filter_map(|(x, y)| crossing(picture, centre(&response, width, x, y)))
        .collect()
}

/// Response at a pixel: what of the circle repeats after half a turn, less what does not.
fn chess(picture: &Picture, x: usize, y: usize) -> f32 {
    let ring = RING.map(|(dx, dy)| picture.at((x as i64 + dx) as usize, (y as i64 + dy) as usize));
    let crossed: f32 = (0..4).map(|n| (ring[n] + ring[n + 8] - ring[n + 4] - ring[n + 12]).abs()).sum();
    let edged: f32 = (0..8).map(|n| (ring[n] - ring[n + 8]).abs()).sum();
    let middle = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)]
        .map(|(dx, dy): (i64, i64)| picture.at((x as i64 + dx) as usize, (y as i64 + dy) as usize));
    let mean = ring.iter().sum::<f32>() / 16.0 - middle.iter().sum::<f32>() / 5.0;
    crossed - edged - 16.0 * mean.abs()
}

/// Maximum to a part of a pixel, by the centre of gravity of the response around it.
fn centre(response: &[f32], width: usize, x: usize, y: usize) -> [f64; 2] {
    let (mut sum, mut at) = (0.0, [0.0; 2]);
    for (v, u) in (y - 2..=y + 2).flat_map(|v| (x - 2..=x + 2).map(move |u| (v, u))) {
        let weight = f64::from(response[v * width + u].max(0.0));
        sum += weight;
        at[0] += weight * u as f64;
        at[1] += weight * v as f64;
    }
    at.map(|value| value / sum)
}

/// Reads the edges around a place; `None` where there are not four that cross.
fn crossing(picture: &Picture, at: [f64; 2]) -> Option<Crossing> {
    let angle = |sample: usize| sample as f64 / EDGE_SAMPLES as f64 * TAU;
    let value = |sample| {
        let (sin, cos) = angle(sample).sin_cos();
        picture.sample([at[0] + EDGE_RADIUS * cos, at[1] + EDGE_RADIUS * sin])
    };
    let ring: Vec<f64> = (0..EDGE_SAMPLES).map(value).collect();
    let (low, high) = ring.iter().fold((f64::MAX, f64::MIN), |(low, high), &v| (low.min(v), high.max(v)));
    let middle = 0.5 * (low + high);
    let mut edges = Vec::new();
    for sample in 0..EDGE_SAMPLES {
        let (here, next) = (ring[sample] - middle, ring[(sample + 1) % EDGE_SAMPLES] - middle);
        if (here > 0.0) != (next > 0.0) {
            let part = here / (here - next);
            edges.push((angle(sample) + part / EDGE_SAMPLES as f64 * TAU, next > 0.0));
        }
    }
    let &[(a, first_is_light), (b, _), (c, _), (d, _)] = edges.as_slice() else { return None };
    let straight = |one: f64, other: f64| (other - one - PI).abs() < MOST_BEND;
    (straight(a, c) && straight(b, d)).then_some(Crossing {
        at,
        edges: [a, b, c, d],
        first_is_light,
        contrast: high - low,
    })
}
