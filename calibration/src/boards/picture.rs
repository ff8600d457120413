//! A picture as numbers, and what little image processing finding a board takes.

use rayon::prelude::*;

/// Grey values, row-major; pixel centres at integers.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    width: usize,
    height: usize,
    data: Vec<f32>,
}

impl Picture {
    /// Takes row-major `data`. Panics if it does not hold `width * height` values: an invariant of the caller.
    pub fn new(width: usize, height: usize, data: Vec<f32>) -> Self {
        assert_eq!(data.len(), width * height, "a picture of {width}x{height} values");
        Self { width, height, data }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    pub(super) fn data(&self) -> &[f32] {
        &self.data
    }

    pub(super) fn at(&self, x: usize, y: usize) -> f32 {
        self.data[y * self.width + x]
    }

    /// Whether a point lies at least `margin` inside the outermost pixel centres.
    pub(super) fn holds(&self, [x, y]: [f64; 2], margin: f64) -> bool {
        x >= margin
            && y >= margin
            && x <= self.width as f64 - 1.0 - margin
            && y <= self.height as f64 - 1.0 - margin
    }

    /// Value between pixels, bilinear; beyond the border as at it.
    pub(super) fn sample(&self, [x, y]: [f64; 2]) -> f64 {
        let x = x.clamp(0.0, (self.width - 1) as f64);
        let y = y.clamp(0.0, (self.height - 1) as f64);
        let (left, top) = (x.floor() as usize, y.floor() as usize);
        let (right, bottom) = ((left + 1).min(self.width - 1), (top + 1).min(self.height - 1));
        let (u, v) = (x - left as f64, y - top as f64);
        let at = |x, y| f64::from(self.at(x, y));
        (1.0 - v) * ((1.0 - u) * at(left, top) + u * at(right, top))
            + v * ((1.0 - u) * at(left, bottom) + u * at(right, bottom))
    }

    /// Blurred by a Gaussian.
    pub(super) fn blurred(&self, sigma_px: f64) -> Self {
        let reach = (3.0 * sigma_px).ceil() as i64;
        let weights: Vec<f64> =
            (-reach..=reach).map(|at| (-0.5 * (at as f64 / sigma_px).powi(2)).exp()).collect();
        let sum: f64 = weights.iter().sum();
        let weights: Vec<f32> = weights.into_iter().map(|weight| (weight / sum) as f32).collect();
        let (width, height) = (self.width, self.height);
        let clamped = |at: i64, length: usize| at.clamp(0, length as i64 - 1) as usize;
        let mut across = vec![0.0f32; width * height];
        across.par_chunks_mut(width).zip(self.data.par_chunks(width)).for_each(|(out, row)| {
            for (x, out) in out.iter_mut().enumerate() {
                let taps = weights.iter().zip(x as i64 - reach..);
                *out = taps.map(|(weight, at)| weight * row[clamped(at, width)]).sum();
            }
        });
        let mut both = vec![0.0f32; width * height];
        both.par_chunks_mut(width).enumerate().for_each(|(y, out)| {
            for (weight, at) in weights.iter().zip(y as i64 - reach..) {
                let row = &across[clamped(at, height) * width..][..width];
                out.iter_mut().zip(row).for_each(|(out, value)| *out += weight * value);
            }
        });
        Self { width, height, data: both }
    }

    /// Means of 2x2 pixels. Pixel (x, y) of it is centred at (2 x + 0.5, 2 y + 0.5) of this one.
    pub(super) fn halved(&self) -> Self {
        let (width, height) = (self.width / 2, self.height / 2);
        let mean = |at: usize| {
            let (x, y) = (2 * (at % width), 2 * (at / width));
            0.25 * (self.at(x, y) + self.at(x + 1, y) + self.at(x, y + 1) + self.at(x + 1, y + 1))
        };
        Self { width, height, data: (0..width * height).map(mean).collect() }
    }
}
