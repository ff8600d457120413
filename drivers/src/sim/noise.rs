//! The randomness of a sensor: one stream per exposure, one draw per pixel, the same whoever computes it.

/// Below this mean the number of electrons is drawn from Poisson's law itself.
const POISSON_BELOW: f32 = 5.0;
/// Pixels that are computed at a time.
const BLOCK: usize = 64;
/// Odd constant whose multiples step through all 64-bit values (2^64 over the golden ratio).
const STEP: u64 = 0x9e37_79b9_7f4a_7c15;

/// A bijection of 64-bit words in which each input bit changes each output bit half of the time (the finalizer of
/// SplitMix64; Steele, Lea, Flood 2014).
pub(crate) fn mix(word: u64) -> u64 {
    let word = word.wrapping_add(STEP);
    let word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    let word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ (word >> 31)
}

/// Random numbers of one exposure, or of the sensor itself.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Stream {
    key: u64,
}

impl Stream {
    /// Stream number `number` of a rig with `seed`.
    pub(crate) fn new(seed: u64, number: u64) -> Self {
        Self { key: mix(mix(seed) ^ number.wrapping_mul(STEP)) }
    }

    /// 64 random bits of a pixel.
    fn word(self, pixel: u64) -> u64 {
        mix(self.key.wrapping_add(pixel.wrapping_mul(STEP)))
    }

    /// Two independent standard normal numbers of a pixel.
    pub(crate) fn normals(self, pixel: u64) -> (f32, f32) {
        let word = self.word(pixel);
        normal_pair((word >> 32) as u32, word as u32)
    }

    /// Turns mean electrons (not negative) into electrons collected plus read noise, from pixel `first` on. Above the
    /// bound the law is a normal one with the skewness of Poisson's: `a z + (z^2 - 1) / 6` has variance `a^2 + 1/18`.
    pub(crate) fn expose(self, first: u64, row: &mut [f32], full_well: f32, read_noise: f32) {
        // Blocks of plain loops, so that the compiler can make vectors of them.
        let (mut high, mut low) = ([0u32; BLOCK], [0u32; BLOCK]);
        for (block, means) in row.chunks_mut(BLOCK).enumerate() {
            let start = first + (block * BLOCK) as u64;
            for (index, (high, low)) in high.iter_mut().zip(&mut low).enumerate() {
                let word = self.word(start + index as u64);
                (*high, *low) = ((word >> 32) as u32, word as u32);
            }
            let few: [bool; BLOCK] =
                std::array::from_fn(|index| means.get(index).is_some_and(|&mean| mean < POISSON_BELOW));
            let any_few = few.contains(&true);
            let before: [f32; BLOCK] = std::array::from_fn(|index| means.get(index).copied().unwrap_or(0.0));
            for (index, mean) in means.iter_mut().enumerate() {
                let (shot, read) = normal_pair(high[index], low[index]);
                let spread = (*mean - 1.0 / 18.0).max(0.0).sqrt();
                let collected = *mean + spread * shot + (shot * shot - 1.0) * (1.0 / 6.0);
                *mean = collected.min(full_well) + read_noise * read;
            }
            if any_few {
                for (index, electrons) in means.iter_mut().enumerate().filter(|(index, _)| few[*index]) {
                    let (_, read) = normal_pair(high[index], low[index]);
                    let collected = self.poisson(start + index as u64, before[index]);
                    *electrons = collected.min(full_well) + read_noise * read;
                }
            }
        }
    }

    /// Poisson's law by inversion.
    fn poisson(self, pixel: u64, mean: f32) -> f32 {
        let mean = f64::from(mean.max(0.0));
        // Another word than that of the read noise: the two must not be related.
        let uniform = (mix(!self.word(pixel)) >> 11) as f64 * (1.0 / (1u64 << 53) as f64);
        let mut probability = libm::exp(-mean);
        let mut cumulative = probability;
        let mut count = 0.0;
        while uniform >= cumulative && count < 60.0 {
            count += 1.0;
            probability *= mean / count;
            cumulative += probability;
        }
        count as f32
    }
}

/// Box and Muller's transform of two 32-bit words. Own logarithm and sine, so that every machine draws the same.
fn normal_pair(first: u32, second: u32) -> (f32, f32) {
    // 31 bits, because vectors convert only signed words. The half keeps the logarithm finite.
    let uniform = ((first >> 1) as i32 as f32 + 0.5) * (1.0 / 2_147_483_648.0);
    let radius = (-2.0 * ln(uniform)).max(0.0).sqrt();
    // The quadrant comes from two bits; within it the angle runs from -pi/4 to pi/4 about its middle.
    let angle =
        ((second & 0x3fff_ffff) as i32 as f32 * (1.0 / 1_073_741_824.0) - 0.5) * std::f32::consts::FRAC_PI_2;
    let square = angle * angle;
    let sin = angle * (1.0 + square * (-1.0 / 6.0 + square * (1.0 / 120.0 + square * (-1.0 / 5040.0))));
    let cos =
        1.0 + square * (-0.5 + square * (1.0 / 24.0 + square * (-1.0 / 720.0 + square * (1.0 / 40320.0))));
    let half = std::f32::consts::FRAC_1_SQRT_2 * radius;
    let across = if second & 0x4000_0000 == 0 { half } else { -half };
    let up = if second & 0x8000_0000 == 0 { half } else { -half };
    (across * cos - up * sin, across * sin + up * cos)
}

/// Natural logarithm of a positive normal number, relative error below 1e-6.
fn ln(value: f32) -> f32 {
    let bits = value.to_bits();
    // Mantissa within sqrt(1/2) and sqrt(2).
    let shifted = bits.wrapping_sub(0x3f35_04f3);
    let exponent = (shifted as i32) >> 23;
    let mantissa = f32::from_bits((shifted & 0x007f_ffff).wrapping_add(0x3f35_04f3));
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let square = s * s;
    let series =
        2.0 * s * (1.0 + square * (1.0 / 3.0 + square * (1.0 / 5.0 + square * (1.0 / 7.0 + square / 9.0))));
    exponent as f32 * std::f32::consts::LN_2 + series
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_functions_agree_with_the_library() {
        for step in 1..100_000u32 {
            let value = step as f32 * 1e-5;
            assert!((ln(value) - value.ln()).abs() < 1e-6 * (1.0 + value.ln().abs()), "{value}");
        }
        for step in 0..10_000u32 {
            let second = step.wrapping_mul(429_497);
            let (x, y) = normal_pair(0x2000_0000, second);
            let radius = x.hypot(y);
            assert!((radius - (2.0 * 8f32.ln()).sqrt()).abs() < 1e-5);
            // The angle is uniform: within its quadrant it follows the low 30 bits.
            let within =
                (f64::from(second & 0x3fff_ffff) / f64::from(1u32 << 30) - 0.5) * std::f64::consts::FRAC_PI_2;
            let base = f64::from(y).atan2(f64::from(x)) - within;
            let quarter = (base / std::f64::consts::FRAC_PI_2 - 0.5).rem_euclid(1.0);
            assert!(quarter.min(1.0 - quarter) < 1e-5, "{second} {quarter}");
        }
    }

    fn electrons(stream: Stream, pixel: u64, mean: f32, full_well: f32, read_noise: f32) -> f32 {
        let mut row = [mean];
        stream.expose(pixel, &mut row, full_well, read_noise);
        row[0]
    }

    #[test]
    fn rows_are_pixels_side_by_side() {
        let stream = Stream::new(9, 4);
        let means: Vec<f32> = (0..300).map(|pixel| 0.1 * pixel as f32).collect();
        let mut row = means.clone();
        stream.expose(1000, &mut row, 25.0, 2.0);
        for (pixel, mean) in means.into_iter().enumerate() {
            assert_eq!(row[pixel], electrons(stream, 1000 + pixel as u64, mean, 25.0, 2.0));
        }
    }

    /// Mean, variance and skewness of `count` draws.
    fn moments(count: u64, draw: impl Fn(u64) -> f32) -> [f64; 3] {
        let values: Vec<f64> = (0..count).map(|pixel| f64::from(draw(pixel))).collect();
        let mean = values.iter().sum::<f64>() / count as f64;
        let central = |power| values.iter().map(|v| (v - mean).powi(power)).sum::<f64>() / count as f64;
        let variance = central(2);
        [mean, variance, central(3) / variance.powf(1.5)]
    }

    #[test]
    fn normals_are_normal_and_independent() {
        let stream = Stream::new(1, 2);
        let count = 1_000_000;
        for [mean, variance, skewness] in
            [moments(count, |p| stream.normals(p).0), moments(count, |p| stream.normals(p).1)]
        {
            assert!(mean.abs() < 5e-3 && (variance - 1.0).abs() < 8e-3 && skewness.abs() < 0.012);
        }
        let mixed = moments(count, |p| stream.normals(p).0 * stream.normals(p).1);
        assert!(mixed[0].abs() < 5e-3);
        let next = Stream::new(1, 3);
        let across = moments(count, |p| stream.normals(p).0 * next.normals(p).0);
        let along = moments(count, |p| stream.normals(p).0 * stream.normals(p + 1).0);
        assert!(across[0].abs() < 5e-3 && along[0].abs() < 5e-3);
    }

    #[test]
    fn shot_noise_has_mean_variance_and_skewness_of_poisson() {
        let count = 1_000_000;
        for mean in [0.05f32, 0.7, 3.0, 4.9, 5.1, 20.0, 400.0, 9000.0] {
            let stream = Stream::new(3, mean.to_bits().into());
            let [m, variance, skewness] = moments(count, |p| electrons(stream, p, mean, 1e9, 0.0));
            let expected = f64::from(mean);
            let error = (expected / count as f64).sqrt();
            assert!((m - expected).abs() < 5.0 * error, "{mean}: mean {m}");
            let tolerance = 5.0 * ((2.0 + 1.0 / expected) / count as f64).sqrt();
            assert!((variance / expected - 1.0).abs() < tolerance, "{mean}: variance {variance}");
            let skew = expected.powf(-0.5);
            assert!((skewness - skew).abs() < 0.015 + 0.01 * skew, "{mean}: skewness {skewness} for {skew}");
        }
    }

    #[test]
    fn no_light_gives_no_electrons_and_the_full_well_holds() {
        let stream = Stream::new(1, 0);
        for pixel in 0..10_000 {
            assert_eq!(electrons(stream, pixel, 0.0, 1e9, 0.0), 0.0);
            assert!(electrons(stream, pixel, 12_000.0, 10_500.0, 0.0) <= 10_500.0);
        }
        let [mean, variance, _] = moments(1_000_000, |p| electrons(stream, p, 0.0, 1e9, 2.3));
        assert!(mean.abs() < 0.012 && (variance.sqrt() - 2.3).abs() < 0.01);
    }
}
