//! From slides to light: drive of each channel at a projector coordinate, after the box of the pixels and the blur of
//! the lens.

use std::sync::Arc;

use super::description::ProjectorDescription;
use crate::projector::{Rgb, Slide};

/// Entries of a profile table per projector pixel. Linear interpolation of the profile of an edge with blur s (px) is
/// then off by at most 7e-6 / s^2.
const PER_PIXEL: usize = 64;
/// Bits of a position below a whole entry.
const FRACTION_BITS: u32 = 11;
/// Widest blur that descriptions may have, in px.
pub(crate) const WIDEST_BLUR_PX: f64 = 20.0;
/// Neighbours that the widest blur reaches, both ways, and one between.
const MOST_NEIGHBOURS: usize = 2 * 115 + 2;

/// Light per channel: red, green, blue, nothing. The fourth keeps the compiler's vectors whole.
pub(crate) type Channels = [f32; 4];

/// A weighted sum of slides: what was on the glass during an exposure.
pub(crate) type Mixture = Vec<(Arc<Slide>, f64)>;

/// Cumulative normal distribution with standard deviation `sigma`, a step where that is 0.
fn cumulative(x: f64, sigma: f64) -> f64 {
    if sigma > 0.0 {
        0.5 * libm::erfc(-x / (sigma * std::f64::consts::SQRT_2))
    } else if x == 0.0 {
        0.5
    } else {
        f64::from(x > 0.0)
    }
}

/// What a pixel of width 1, blurred by a normal distribution, gives at distance `x` from its centre.
pub(crate) fn blurred_box(x: f64, sigma: f64) -> f64 {
    cumulative(x + 0.5, sigma) - cumulative(x - 0.5, sigma)
}

/// Distance from a pixel's centre beyond which `blurred_box` is below 1e-8.
pub(crate) fn reach_px(sigma: f64) -> usize {
    (5.7 * sigma + 0.5).ceil() as usize
}

/// The optics and electronics of the panels.
#[derive(Debug, Clone)]
pub(crate) struct Panel {
    size: [usize; 2],
    blur_px: f64,
    /// Light of code values, 1 at full drive.
    light: Vec<f64>,
    /// Per channel and axis.
    shift_px: [[f64; 2]; 3],
    reach: usize,
}

impl Panel {
    pub(crate) fn new(description: &ProjectorDescription) -> Self {
        let leak = description.black_leak;
        Self {
            size: description.size.map(|side| side as usize),
            blur_px: description.blur_px,
            light: (0..=255)
                .map(|code| leak + (1.0 - leak) * (f64::from(code) / 255.0).powf(description.gamma))
                .collect(),
            shift_px: description.panel_shift_px,
            reach: reach_px(description.blur_px),
        }
    }

    /// Light of a channel at a code value.
    pub(crate) fn light(&self, code: u8) -> f64 {
        self.light[usize::from(code)]
    }

    /// Light at a nominal projector coordinate with all pixels at full drive: 1 inside, falling to 0 across the border.
    pub(crate) fn coverage(&self, channel: usize, at: [f64; 2]) -> f64 {
        (0..2)
            .map(|axis| {
                let x = at[axis] - self.shift_px[channel][axis];
                cumulative(x + 0.5, self.blur_px) - cumulative(x + 0.5 - self.size[axis] as f64, self.blur_px)
            })
            .product()
    }

    fn lights(&self, rgb: Rgb) -> [f64; 3] {
        rgb.map(|code| self.light(code))
    }

    /// Table of one axis from the light of its pixels.
    fn table(&self, axis: usize, lights: &[[f64; 3]]) -> Table {
        let margin = self.margin();
        let entries = (self.size[axis] + 2 * margin) * PER_PIXEL + 2;
        let mut values = vec![[0.0f32; 4]; entries];
        for channel in 0..3 {
            // Channels of one polarization mostly show the same.
            let twin = (0..channel).find(|&other| {
                self.shift_px[other][axis] == self.shift_px[channel][axis]
                    && lights.iter().all(|light| light[other] == light[channel])
            });
            if let Some(twin) = twin {
                values.iter_mut().for_each(|value| value[channel] = value[twin]);
                continue;
            }
            let column: Vec<f64> = lights.iter().map(|light| light[channel]).collect();
            let start = -(margin as f64) - self.shift_px[channel][axis];
            // The weights of the neighbours repeat from pixel to pixel.
            let phases: Vec<(i64, Vec<f64>)> = (0..PER_PIXEL)
                .map(|phase| self.neighbours(start + phase as f64 / PER_PIXEL as f64))
                .collect();
            for (pixel, entries) in values.chunks_mut(PER_PIXEL).enumerate() {
                for (entry, (first, weights)) in entries.iter_mut().zip(&phases) {
                    entry[channel] = weighted(&column, first + pixel as i64, weights) as f32;
                }
            }
        }
        Table { values }
    }

    /// Pixels that give light at a coordinate: the first of them, and the weights from there on.
    fn neighbours(&self, at: f64) -> (i64, Vec<f64>) {
        let first = at.floor() as i64 - self.reach as i64;
        let count = 2 * self.reach as i64 + 2;
        (first, (first..first + count).map(|pixel| blurred_box(at - pixel as f64, self.blur_px)).collect())
    }

    /// Position of a nominal coordinate in the tables of an axis: whole entries, and a fraction in the low bits.
    pub(crate) fn position(&self, axis: usize, at: f64) -> u32 {
        let margin = self.margin() as f64;
        let within = at.clamp(-margin, self.size[axis] as f64 + margin) + margin;
        (within * (PER_PIXEL << FRACTION_BITS) as f64).round() as u32
    }

    /// The coordinate of a position.
    fn coordinate(&self, position: u32) -> f64 {
        f64::from(position) / (PER_PIXEL << FRACTION_BITS) as f64 - self.margin() as f64
    }

    /// Pixels around the panel that tables cover.
    fn margin(&self) -> usize {
        let shift = self.shift_px.iter().flatten().fold(0.0f64, |most, shift| most.max(shift.abs()));
        self.reach + 2 + shift.ceil() as usize
    }

    /// Sums up slides for rendering. Weights are relative to the reference exposure.
    pub(crate) fn illuminate(&self, mixture: &Mixture) -> Illumination {
        let mut constant = [0.0f64; 3];
        let mut columns: Option<Vec<[f64; 3]>> = None;
        let mut rows: Option<Vec<[f64; 3]>> = None;
        let mut full = Vec::new();
        for (slide, weight) in mixture {
            let add = |sum: &mut [f64; 3], rgb: Rgb| {
                for (sum, light) in sum.iter_mut().zip(self.lights(rgb)) {
                    *sum += weight * light;
                }
            };
            match &**slide {
                Slide::Uniform(rgb) => add(&mut constant, *rgb),
                Slide::Columns(values) => {
                    let sums = columns.get_or_insert_with(|| vec![[0.0; 3]; self.size[0]]);
                    sums.iter_mut().zip(values.iter()).for_each(|(sum, rgb)| add(sum, *rgb));
                }
                Slide::Rows(values) => {
                    let sums = rows.get_or_insert_with(|| vec![[0.0; 3]; self.size[1]]);
                    sums.iter_mut().zip(values.iter()).for_each(|(sum, rgb)| add(sum, *rgb));
                }
                Slide::Full(values) => full.push((values.clone(), *weight)),
            }
        }
        Illumination {
            constant: [constant[0] as f32, constant[1] as f32, constant[2] as f32, 0.0],
            columns: columns.map(|lights| self.table(0, &lights)),
            rows: rows.map(|lights| self.table(1, &lights)),
            full: (!full.is_empty()).then(|| Full::new(self, &full)),
        }
    }
}

/// Weighted mean of the pixels from `start` on, over those that exist. Weights of missing pixels are left out of the
/// mean because the fall-off at the border is part of [`Panel::coverage`].
fn weighted(lights: &[f64], start: i64, weights: &[f64]) -> f64 {
    let last = lights.len() as i64 - 1;
    if start >= 0 && start + weights.len() as i64 - 1 <= last {
        let seen = &lights[start as usize..start as usize + weights.len()];
        return seen.iter().zip(weights).map(|(light, weight)| light * weight).sum();
    }
    let (mut sum, mut total) = (0.0, 0.0);
    for (index, weight) in (start..).zip(weights) {
        if (0..=last).contains(&index) {
            sum += weight * lights[index as usize];
            total += weight;
        }
    }
    // Beyond the reach of the last pixel it does not matter which value is taken: nothing is lit there.
    if total > 1e-9 { sum / total } else { lights[(start + weights.len() as i64 / 2).clamp(0, last) as usize] }
}

/// Finely sampled profile along one axis.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    values: Vec<Channels>,
}

impl Table {
    /// Light at a [`Panel::position`].
    #[inline]
    pub(crate) fn at(&self, position: u32) -> Channels {
        let index = (position >> FRACTION_BITS) as usize;
        let share = (position & ((1 << FRACTION_BITS) - 1)) as f32 * (1.0 / (1 << FRACTION_BITS) as f32);
        let (low, high) = (self.values[index], self.values[index + 1]);
        std::array::from_fn(|channel| low[channel] + share * (high[channel] - low[channel]))
    }
}

/// Light on the glass during an exposure, ready to be looked up.
#[derive(Debug, Clone)]
pub(crate) struct Illumination {
    pub(crate) constant: Channels,
    pub(crate) columns: Option<Table>,
    pub(crate) rows: Option<Table>,
    pub(crate) full: Option<Full>,
}

/// Slides without structure, summed up and convolved at each look-up.
#[derive(Debug, Clone)]
pub(crate) struct Full {
    panel: Panel,
    /// Row-major, per channel.
    light: [Vec<f32>; 3],
    /// Weights of the neighbours at each phase and, for interpolation, the next.
    phases: Vec<Vec<f32>>,
}

impl Full {
    fn new(panel: &Panel, slides: &[(Arc<[Rgb]>, f64)]) -> Self {
        let pixels = panel.size[0] * panel.size[1];
        let light = std::array::from_fn(|channel| {
            let mut light = vec![0.0f32; pixels];
            for (values, weight) in slides {
                let levels: Vec<f32> = (0..=255).map(|code| (weight * panel.light(code)) as f32).collect();
                light.iter_mut().zip(values.iter()).for_each(|(sum, rgb)| *sum += levels[usize::from(rgb[channel])]);
            }
            light
        });
        let weights = |phase: usize| {
            let (_, weights) = panel.neighbours(phase as f64 / PER_PIXEL as f64);
            weights.into_iter().map(|weight| weight as f32).collect()
        };
        let mut phases: Vec<Vec<f32>> = (0..PER_PIXEL).map(weights).collect();
        // One pixel on the same neighbours, counted from the first phase's first, end with that pixel's weights.
        let mut wrapped = phases[0].clone();
        wrapped.rotate_right(1);
        phases.push(wrapped);
        Self { panel: panel.clone(), light, phases }
    }

    /// Light at the positions of both axes.
    pub(crate) fn at(&self, column: u32, row: u32) -> Channels {
        let mut light = [0.0f32; 4];
        let (u, v) = (self.panel.coordinate(column), self.panel.coordinate(row));
        let [width, height] = self.panel.size;
        for channel in 0..3 {
            let [dx, dy] = self.panel.shift_px[channel];
            let (x, across) = self.weights(u - dx);
            let (y, down) = self.weights(v - dy);
            let (mut sum, mut total) = (0.0, 0.0);
            for (line, wy) in (y..).zip(&down.0[..down.1]) {
                if !(0..height as i64).contains(&line) {
                    continue;
                }
                let from = x.clamp(0, width as i64);
                let until = (x + across.1 as i64).clamp(0, width as i64);
                let values = &self.light[channel][line as usize * width..(line as usize + 1) * width];
                let values = &values[from as usize..until as usize];
                let weights = &across.0[(from - x) as usize..(until - x) as usize];
                let (mut partial, mut share) = (0.0, 0.0);
                for (value, weight) in values.iter().zip(weights) {
                    partial += value * weight;
                    share += weight;
                }
                sum += wy * partial;
                total += wy * share;
            }
            light[channel] = if total > 1e-9 { sum / total } else { 0.0 };
        }
        light
    }

    /// First neighbour, the weights and how many of them there are.
    fn weights(&self, at: f64) -> (i64, ([f32; MOST_NEIGHBOURS], usize)) {
        let whole = at.floor();
        let phase = (at - whole) * PER_PIXEL as f64;
        let index = (phase as usize).min(PER_PIXEL - 1);
        let share = (phase - index as f64) as f32;
        let (low, high) = (&self.phases[index], &self.phases[index + 1]);
        let mut weights = [0.0; MOST_NEIGHBOURS];
        for (weight, (low, high)) in weights.iter_mut().zip(low.iter().zip(high)) {
            *weight = low + share * (high - low);
        }
        (whole as i64 - self.panel.reach as i64, (weights, low.len()))
    }
}

impl Illumination {
    /// Light at the positions of both axes.
    pub(crate) fn at(&self, column: u32, row: u32) -> Channels {
        let mut light = self.constant;
        let parts = [
            self.columns.as_ref().map(|table| table.at(column)),
            self.rows.as_ref().map(|table| table.at(row)),
            self.full.as_ref().map(|full| full.at(column, row)),
        ];
        for part in parts.into_iter().flatten() {
            light.iter_mut().zip(part).for_each(|(light, part)| *light += part);
        }
        light
    }
}
