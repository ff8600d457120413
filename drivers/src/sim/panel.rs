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
    if total > 1e-9 {
        sum / total
    } else {
        lights[(start + weights.len() as i64 / 2).clamp(0, last) as usize]
    }
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
                light
                    .iter_mut()
                    .zip(values.iter())
                    .for_each(|(sum, rgb)| *sum += levels[usize::from(rgb[channel])]);
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
        for (channel, light) in light.iter_mut().take(3).enumerate() {
            let [dx, dy] = self.panel.shift_px[channel];
            let across = self.neighbours(u - dx, width);
            let down = self.neighbours(v - dy, height);
            let (mut sum, mut total) = (0.0, 0.0);
            for (line, wy) in down.pixels.clone().zip(down.weights()) {
                let values = &self.light[channel][line * width..(line + 1) * width][across.pixels.clone()];
                let (mut partial, mut share) = (0.0, 0.0);
                for (value, wx) in values.iter().zip(across.weights()) {
                    partial += value * wx;
                    share += wx;
                }
                sum += wy * partial;
                total += wy * share;
            }
            *light = if total > 1e-9 { sum / total } else { 0.0 };
        }
        light
    }

    /// Pixels of an axis of `size` pixels that give light at a coordinate.
    fn neighbours(&self, at: f64, size: usize) -> Neighbours<'_> {
        let whole = at.floor();
        let phase = (at - whole) * PER_PIXEL as f64;
        let index = (phase as usize).min(PER_PIXEL - 1);
        let first = whole as i64 - self.panel.reach as i64;
        let end = first + self.phases[index].len() as i64;
        let pixels = first.clamp(0, size as i64) as usize..end.clamp(0, size as i64) as usize;
        let skip = (pixels.start as i64 - first) as usize;
        Neighbours {
            pixels,
            low: &self.phases[index][skip.min(self.phases[index].len())..],
            high: &self.phases[index + 1][skip.min(self.phases[index].len())..],
            share: (phase - index as f64) as f32,
        }
    }
}

/// Pixels that exist, and their weights between two phases.
struct Neighbours<'a> {
    pixels: std::ops::Range<usize>,
    low: &'a [f32],
    high: &'a [f32],
    share: f32,
}

impl Neighbours<'_> {
    fn weights(&self) -> impl Iterator<Item = f32> {
        self.low.iter().zip(self.high).map(|(low, high)| low + self.share * (high - low))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::description::PanelPolarization;
    use proptest::prelude::*;

    fn description(size: [u32; 2], blur_px: f64, shift: [f64; 2]) -> ProjectorDescription {
        ProjectorDescription {
            size,
            focal_px: 1000.0,
            principal_point_px: None,
            k1: 0.0,
            k2: 0.0,
            p1: 0.0,
            p2: 0.0,
            k3: 0.0,
            blur_px,
            polarization: [PanelPolarization::None; 3],
            extinction: [1.0; 3],
            response: [1.0; 3],
            black_leak: 0.01,
            gamma: 2.2,
            panel_shift_px: [shift, [0.0, 0.0], [-0.3, 0.1]],
            lcd_10_90_ms: 0.0,
            latency_refreshes: 0,
            refresh_hz: 60.0,
            states_timing: true,
        }
    }

    /// Light by brute force: each pixel's box and the normal distribution, integrated by the midpoint rule on a plane
    /// that is infinite and dark outside, over the same of a picture at full drive.
    fn oracle(panel: &Panel, light: impl Fn(usize, usize) -> f64, channel: usize, at: [f64; 2]) -> f64 {
        let fine = 400;
        let weight = |axis: usize, pixel: usize| {
            let x = at[axis] - panel.shift_px[channel][axis] - pixel as f64;
            let density = |d: f64| (-0.5 * (d / panel.blur_px).powi(2)).exp();
            (0..fine).map(|step| density(x - (f64::from(step) + 0.5) / f64::from(fine) + 0.5)).sum::<f64>()
                / f64::from(fine)
                / (panel.blur_px * std::f64::consts::TAU.sqrt())
        };
        let (mut sum, mut total) = (0.0, 0.0);
        let across: Vec<f64> = (0..panel.size[0]).map(|x| weight(0, x)).collect();
        for y in 0..panel.size[1] {
            let down = weight(1, y);
            for (x, across) in across.iter().enumerate() {
                sum += across * down * light(x, y);
                total += across * down;
            }
        }
        sum / total
    }

    fn code(x: usize, y: usize) -> Rgb {
        let word = crate::sim::noise::mix((x * 31 + y) as u64);
        [word as u8, (word >> 8) as u8 & 0x80, if word & 0x10000 == 0 { 0 } else { 255 }]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn tables_and_look_ups_agree_with_brute_force(
            u in -1.0f64..24.0, v in -1.0f64..18.0, blur in 0.4f64..1.5, dx in -1.0f64..1.0,
        ) {
            let panel = Panel::new(&description([24, 18], blur, [dx, 0.4]));
            let columns: Arc<[Rgb]> = (0..24).map(|x| code(x, 0)).collect();
            let rows: Arc<[Rgb]> = (0..18).map(|y| code(3, y)).collect();
            let full: Arc<[Rgb]> = (0..18).flat_map(|y| (0..24).map(move |x| code(x, y))).collect();
            type Pick = fn(usize, usize) -> Rgb;
            let cases: [(Slide, Pick); 4] = [
                (Slide::Columns(columns), |x, _| code(x, 0)),
                (Slide::Rows(rows), |_, y| code(3, y)),
                (Slide::Full(full), code),
                (Slide::Uniform([200, 0, 255]), |_, _| [200, 0, 255]),
            ];
            let position = [panel.position(0, u), panel.position(1, v)];
            for (slide, pick) in cases {
                let ours = panel.illuminate(&vec![(Arc::new(slide), 1.0)]).at(position[0], position[1]);
                for (channel, ours) in ours.into_iter().take(3).enumerate() {
                    let light = |x, y| panel.light(pick(x, y)[channel]);
                    let expected = oracle(&panel, light, channel, [u, v]);
                    prop_assert!((f64::from(ours) - expected).abs() < 1e-4, "{ours} {expected}");
                }
            }
        }
    }

    #[test]
    fn mixtures_are_sums() {
        let panel = Panel::new(&description([24, 18], 0.6, [0.2, 0.0]));
        let columns = Arc::new(Slide::Columns((0..24).map(|x| code(x, 0)).collect()));
        let rows = Arc::new(Slide::Rows((0..18).map(|y| code(3, y)).collect()));
        let uniform = Arc::new(Slide::Uniform([10, 255, 0]));
        let mixture = vec![(columns.clone(), 0.5), (rows.clone(), 0.2), (uniform.clone(), 0.3)];
        let (u, v) = (panel.position(0, 7.31), panel.position(1, 11.8));
        let together = panel.illuminate(&mixture).at(u, v);
        for (channel, together) in together.into_iter().take(3).enumerate() {
            let sum: f32 = mixture
                .iter()
                .map(|(slide, weight)| {
                    *weight as f32 * panel.illuminate(&vec![(slide.clone(), 1.0)]).at(u, v)[channel]
                })
                .sum();
            assert!((together - sum).abs() < 1e-6);
        }
    }

    #[test]
    fn boxes_add_up_and_borders_fall_off() {
        for blur in [0.0, 0.3, 0.6, 2.0] {
            let sum: f64 = (-30..=30).map(|pixel| blurred_box(0.37 - f64::from(pixel), blur)).sum();
            assert!((sum - 1.0).abs() < 1e-12, "{blur}: {sum}");
            let panel = Panel::new(&description([24, 18], blur, [0.0, 0.0]));
            assert!((panel.coverage(1, [12.0, 9.0]) - 1.0).abs() < 1e-4);
            assert!((panel.coverage(1, [-0.5, 9.0]) - 0.5).abs() < 1e-4);
            assert!(panel.coverage(1, [-0.5 - 6.0 * blur - 0.01, 9.0]) < 1e-8);
        }
        // Full contrast without blur.
        let panel = Panel::new(&description([4, 4], 0.0, [0.0, 0.0]));
        let slide = Slide::Columns([[0; 3], [255; 3], [0; 3], [255; 3]].into());
        let light = panel.illuminate(&vec![(Arc::new(slide), 1.0)]);
        let at = |u| light.at(panel.position(0, u), panel.position(1, 1.0))[1];
        assert!((at(0.45) - 0.01).abs() < 1e-6 && (at(0.55) - 1.0).abs() < 1e-6);
    }
}
