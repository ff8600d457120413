//! From slides to light: drive of each channel at a projector coordinate, after the box of the pixels and the blur of
//! the lens.

use std::sync::Arc;

use super::description::ProjectorDescription;
use crate::projector::{Rgb, Slide};

/// Entries of a profile table per projector pixel. Linear interpolation of the profile of an edge with blur s (px) is
/// then off by at most 7e-6 / s^2.
const PER_PIXEL: usize = 64;

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
        let entries = (self.size[axis] + 2 * margin) * PER_PIXEL + 1;
        let mut values = vec![[0.0f32; 4]; entries];
        for channel in 0..3 {
            let shift = self.shift_px[channel][axis];
            // The weights of the neighbours repeat from pixel to pixel.
            for phase in 0..PER_PIXEL {
                let base = phase as f64 / PER_PIXEL as f64 - margin as f64 - shift;
                let first = base.floor() as i64 - self.reach as i64;
                let weights: Vec<f64> = (0..2 * self.reach as i64 + 2)
                    .map(|neighbour| blurred_box(base - (first + neighbour) as f64, self.blur_px))
                    .collect();
                for (pixel, entry) in (phase..entries).step_by(PER_PIXEL).enumerate() {
                    let start = first + pixel as i64;
                    values[entry][channel] = weighted(lights, channel, start, &weights) as f32;
                }
            }
        }
        Table { values, offset: (margin * PER_PIXEL) as f32 }
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
            full: (!full.is_empty()).then(|| Full { panel: self.clone(), slides: full }),
        }
    }
}

/// Weighted mean of the pixels from `start` on, over those that exist. Weights of missing pixels are left out of the
/// mean because the fall-off at the border is part of [`Panel::coverage`].
fn weighted(lights: &[[f64; 3]], channel: usize, start: i64, weights: &[f64]) -> f64 {
    let (mut sum, mut total) = (0.0, 0.0);
    for (neighbour, weight) in weights.iter().enumerate() {
        let index = start + neighbour as i64;
        if let Some(light) = usize::try_from(index).ok().and_then(|index| lights.get(index)) {
            sum += weight * light[channel];
            total += weight;
        }
    }
    if total > 1e-9 {
        sum / total
    } else {
        let middle = start + weights.len() as i64 / 2;
        lights[middle.clamp(0, lights.len() as i64 - 1) as usize][channel]
    }
}

/// Finely sampled profile along one axis.
#[derive(Debug, Clone)]
pub(crate) struct Table {
    values: Vec<Channels>,
    offset: f32,
}

impl Table {
    /// Light at coordinate `at`; the border's value outside, anything for NaN.
    #[inline]
    pub(crate) fn at(&self, at: f32) -> Channels {
        let position = (at * PER_PIXEL as f32 + self.offset).clamp(0.0, (self.values.len() - 2) as f32);
        let index = (position as usize).min(self.values.len() - 2);
        let share = position - index as f32;
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

/// Slides without structure, convolved at each look-up.
#[derive(Debug, Clone)]
pub(crate) struct Full {
    panel: Panel,
    slides: Vec<(Arc<[Rgb]>, f64)>,
}

impl Full {
    /// Light at a nominal projector coordinate; nothing for NaN.
    pub(crate) fn at(&self, u: f32, v: f32) -> Channels {
        let mut light = [0.0f32; 4];
        if !(u.is_finite() && v.is_finite()) {
            return light;
        }
        for (channel, light) in light.iter_mut().take(3).enumerate() {
            let across = self.weights(channel, 0, f64::from(u));
            let down = self.weights(channel, 1, f64::from(v));
            let total = across.1.iter().sum::<f64>() * down.1.iter().sum::<f64>();
            if total < 1e-12 {
                continue;
            }
            let width = self.panel.size[0];
            for (values, weight) in &self.slides {
                let mut sum = 0.0;
                for (y, wy) in down.1.iter().enumerate() {
                    let row = &values[(down.0 + y) * width + across.0..];
                    sum += wy
                        * across
                            .1
                            .iter()
                            .zip(row)
                            .map(|(wx, rgb)| wx * self.panel.light(rgb[channel]))
                            .sum::<f64>();
                }
                *light += (weight * sum / total) as f32;
            }
        }
        light
    }

    /// First pixel that matters along an axis, and the weights from there.
    fn weights(&self, channel: usize, axis: usize, at: f64) -> (usize, Vec<f64>) {
        let at = at - self.panel.shift_px[channel][axis];
        let last = self.panel.size[axis] as f64 - 1.0;
        let first = (at.round() - self.panel.reach as f64).clamp(0.0, last) as usize;
        let end = (at.round() + self.panel.reach as f64).clamp(0.0, last) as usize;
        (first, (first..=end).map(|pixel| blurred_box(at - pixel as f64, self.panel.blur_px)).collect())
    }
}

impl Illumination {
    /// Light at a nominal projector coordinate.
    pub(crate) fn at(&self, u: f32, v: f32) -> Channels {
        let mut light = self.constant;
        let parts = [
            self.columns.as_ref().map(|table| table.at(u)),
            self.rows.as_ref().map(|table| table.at(v)),
            self.full.as_ref().map(|full| full.at(u, v)),
        ];
        for part in parts.into_iter().flatten() {
            light.iter_mut().zip(part).for_each(|(light, part)| *light += part);
        }
        light
    }
}
