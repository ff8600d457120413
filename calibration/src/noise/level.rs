//! Mean and temporal variance of one exposure time.

/// Pairs of frames in which a pixel differs by more than this many sigma are not noise: a cosmic ray, a fly.
const OUTLIER_SIGMA: f64 = 7.0;

/// What the frames of one exposure time say, over the chosen pixels.
#[derive(Debug, Clone, PartialEq)]
pub struct Level {
    /// Exposure time in microseconds, as the camera reports it.
    pub exposure_us: f64,
    /// Mean over pixels and frames in DN.
    pub mean_dn: f64,
    /// Standard deviation of that mean in DN: noise, and what the lamp did between frames.
    pub mean_sigma_dn: f64,
    /// Temporal variance of a sample in DN^2, with the 1/12 of rounding.
    pub variance_dn2: f64,
    /// Standard deviation of that variance in DN^2.
    pub variance_sigma_dn2: f64,
    /// Share of the samples at or above saturation.
    pub clipped_share: f64,
}

/// Collects the frames of one exposure time; memory for two frames.
#[derive(Debug)]
pub struct Meter<'a> {
    exposure_us: f64,
    /// Pixels that take part.
    pixels: &'a [u32],
    saturation_dn: u16,
    /// Rough black level, by which a brighter lamp is told from noise.
    black_dn: f64,
    before: Option<Vec<u16>>,
    frame_means: Vec<f64>,
    pair_variances: Vec<f64>,
    clipped: u64,
}

impl<'a> Meter<'a> {
    /// Begins an exposure time. `pixels` are indices into the frames; `black_dn` need not be exact.
    pub fn new(exposure_us: f64, pixels: &'a [u32], black_dn: f64, saturation_dn: u16) -> Self {
        Self {
            exposure_us,
            pixels,
            saturation_dn,
            black_dn,
            before: None,
            frame_means: Vec::new(),
            pair_variances: Vec::new(),
            clipped: 0,
        }
    }

    /// Adds a frame.
    ///
    /// # Panics
    /// Where the frame does not hold all pixels.
    pub fn add(&mut self, frame: &[u16]) {
        let values: Vec<u16> = self.pixels.iter().map(|&pixel| frame[pixel as usize]).collect();
        self.clipped += values.iter().filter(|&&value| value >= self.saturation_dn).count() as u64;
        let mean = mean(values.iter().map(|&value| f64::from(value)));
        // Frames are used in pairs of their own: neighbouring pairs that share a frame are not independent.
        match (self.before.take(), self.frame_means.last()) {
            (Some(before), Some(&mean_before)) => {
                self.pair_variances.push(self.pair_variance(&before, mean_before, &values, mean));
            }
            _ => self.before = Some(values),
        }
        self.frame_means.push(mean);
    }

    /// Variance of one sample, from two frames of the same picture under a lamp that may have changed between them.
    fn pair_variance(&self, first: &[u16], first_mean: f64, second: &[u16], second_mean: f64) -> f64 {
        let light = |mean: f64| mean - self.black_dn;
        let lamp = if light(second_mean) > 1.0 && light(first_mean) > 1.0 {
            light(first_mean) / light(second_mean)
        } else {
            1.0
        };
        let difference =
            |(a, b): (&u16, &u16)| (f64::from(*a) - first_mean) - lamp * (f64::from(*b) - second_mean);
        let differences = || first.iter().zip(second).map(difference);
        let all = mean(differences().map(|difference| difference * difference));
        let limit = OUTLIER_SIGMA * OUTLIER_SIGMA * all;
        let kept = mean(differences().map(|value| value * value).filter(|&square| square <= limit));
        kept / (1.0 + lamp * lamp)
    }

    /// What was found; `None` without a pair of frames or pixels.
    pub fn finish(self) -> Option<Level> {
        let (frames, pixels) = (self.frame_means.len() as f64, self.pixels.len() as f64);
        if self.pair_variances.is_empty() || self.pixels.is_empty() {
            return None;
        }
        let mean_dn = mean(self.frame_means.iter().copied());
        let variance_dn2 = mean(self.pair_variances.iter().copied());
        let between =
            self.frame_means.iter().map(|mean| (mean - mean_dn).powi(2)).sum::<f64>() / (frames - 1.0);
        let mean_variance = (between / frames).max(variance_dn2 / (frames * pixels));
        let degrees = pixels * self.pair_variances.len() as f64;
        Some(Level {
            exposure_us: self.exposure_us,
            mean_dn,
            // A level on which all samples are equal is known no better than its rounding lets it be.
            mean_sigma_dn: mean_variance.sqrt().max(1e-6),
            variance_dn2,
            variance_sigma_dn2: (variance_dn2 * (2.0 / degrees).sqrt()).max(1e-9),
            clipped_share: self.clipped as f64 / (frames * pixels),
        })
    }
}

fn mean(values: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = values.fold((0.0, 0u64), |(sum, count), value| (sum + value, count + 1));
    sum / count.max(1) as f64
}

#[cfg(test)]
pub(super) mod testing {
    use rand::{RngExt, SeedableRng, rngs::StdRng};

    /// A camera written out: Poisson and normal noise, power law, rounding, clipping.
    pub struct Camera {
        pub gain: f64,
        pub read_e: f64,
        pub black_dn: f64,
        pub full_dn: f64,
        pub gamma: f64,
        random: StdRng,
    }

    impl Camera {
        pub fn new(bits: u8, full_well_e: f64, read_e: f64, seed: u64) -> Self {
            let full_dn = f64::from((1u32 << bits) - 1);
            let black_dn = 0.01 * full_dn;
            let gain = (full_dn - black_dn) / full_well_e;
            Self { gain, read_e, black_dn, full_dn, gamma: 1.0, random: StdRng::seed_from_u64(seed) }
        }

        fn normal(&mut self) -> f64 {
            let (a, b): (f64, f64) = (self.random.random(), self.random.random());
            (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
        }

        /// Shot noise as a normal deviate: levels of the tests are far from single electrons.
        pub fn sample(&mut self, electrons: f64) -> u16 {
            let noisy = electrons + electrons.max(0.0).sqrt() * self.normal() + self.read_e * self.normal();
            let white = (self.full_dn - self.black_dn) / self.gain;
            let bent = if self.gamma == 1.0 {
                noisy
            } else {
                white * (noisy / white).abs().powf(self.gamma).copysign(noisy)
            };
            (bent * self.gain + self.black_dn).round().clamp(0.0, self.full_dn) as u16
        }

        /// A frame of a picture whose pixels get these rates in electrons per microsecond.
        pub fn frame(&mut self, rates: &[f64], exposure_us: f64) -> Vec<u16> {
            rates.iter().map(|rate| self.sample(rate * exposure_us)).collect()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{testing::Camera, *};

    #[test]
    fn fixed_pattern_and_lamp_do_not_pass_for_noise() {
        let mut camera = Camera::new(12, 10_500.0, 2.3, 7);
        let rates: Vec<f64> = (0..20_000).map(|pixel| 1.0 + f64::from(pixel % 100) / 50.0).collect();
        let pixels: Vec<u32> = (0..20_000).collect();
        let mut meter = Meter::new(2000.0, &pixels, 41.0, 4095);
        for lamp in [1.0, 1.02, 0.99, 1.0] {
            meter.add(&camera.frame(&rates, 2000.0 * lamp));
        }
        let level = meter.finish().unwrap();
        let electrons = 2000.0 * rates.iter().sum::<f64>() / 20_000.0;
        let expected = camera.gain * camera.gain * (electrons + 2.3 * 2.3) + 1.0 / 12.0;
        assert!((level.variance_dn2 / expected - 1.0).abs() < 0.03, "{level:?} {expected}");
        assert!(level.mean_sigma_dn > 5.0, "what the lamp does belongs to the mean's sigma: {level:?}");
    }

    #[test]
    fn a_fly_is_no_noise() {
        let mut camera = Camera::new(12, 10_500.0, 2.3, 8);
        let rates = vec![1.0; 10_000];
        let pixels: Vec<u32> = (0..10_000).collect();
        let mut meter = Meter::new(1000.0, &pixels, 41.0, 4095);
        meter.add(&camera.frame(&rates, 1000.0));
        let mut disturbed = camera.frame(&rates, 1000.0);
        disturbed[..4].fill(4000);
        meter.add(&disturbed);
        let level = meter.finish().unwrap();
        let expected = camera.gain * camera.gain * 1005.3 + 1.0 / 12.0;
        assert!((level.variance_dn2 / expected - 1.0).abs() < 0.06, "{level:?} {expected}");
    }

    #[test]
    fn one_frame_says_nothing() {
        let mut meter = Meter::new(1.0, &[0], 0.0, 255);
        meter.add(&[3]);
        assert_eq!(meter.finish(), None);
    }
}
