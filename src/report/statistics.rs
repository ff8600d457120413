//! Order statistics of samples that are finite. Each returns `None` for no sample rather than a number that means nothing.

/// Makes the median absolute deviation of a normal distribution its standard deviation: `1 / quantile(0.75)`.
pub const MAD_TO_SIGMA: f64 = 1.4826;

/// Quantile `q` in 0..=1 with linear interpolation between the two samples beside it. Reorders `samples`.
pub fn quantile(samples: &mut [f64], q: f64) -> Option<f64> {
    if samples.is_empty() {
        return None;
    }
    let position = q.clamp(0.0, 1.0) * (samples.len() - 1) as f64;
    let (below, share) = (position.floor() as usize, position.fract());
    let (_, &mut low, above) = samples.select_nth_unstable_by(below, f64::total_cmp);
    if share == 0.0 {
        return Some(low);
    }
    let high = above.iter().copied().fold(f64::INFINITY, f64::min);
    Some(low + share * (high - low))
}

/// Median. Reorders `samples`.
pub fn median(samples: &mut [f64]) -> Option<f64> {
    quantile(samples, 0.5)
}

/// `1.4826 * median(|x - median(x)|)`. Overwrites `samples`.
pub fn robust_sigma(samples: &mut [f64]) -> Option<f64> {
    let centre = median(samples)?;
    for sample in samples.iter_mut() {
        *sample = (*sample - centre).abs();
    }
    Some(MAD_TO_SIGMA * median(samples)?)
}

/// Root mean square from a sum of squares, `None` for no sample or one that is not finite.
pub fn root_mean(sum_of_squares: f64, count: u64) -> Option<f64> {
    (count > 0).then(|| (sum_of_squares / count as f64).sqrt()).filter(|value| value.is_finite())
}

/// `part / whole`, `None` where `whole` is 0.
pub fn share(part: u64, whole: u64) -> Option<f64> {
    (whole > 0).then(|| part as f64 / whole as f64)
}

/// The number, unless JSON has no word for it.
pub fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Sorts and looks up.
    fn sorted_quantile(samples: &[f64], q: f64) -> f64 {
        let mut sorted = samples.to_vec();
        sorted.sort_by(f64::total_cmp);
        let position = q * (sorted.len() - 1) as f64;
        let (low, high) = (sorted[position.floor() as usize], sorted[position.ceil() as usize]);
        low + position.fract() * (high - low)
    }

    proptest! {
        #[test]
        fn quantile_is_that_of_the_sorted_samples(
            mut samples in prop::collection::vec(-1e3..1e3, 1..60), q in 0.0..=1.0,
        ) {
            let expected = sorted_quantile(&samples, q);
            prop_assert!((quantile(&mut samples, q).unwrap() - expected).abs() < 1e-9);
        }

        #[test]
        fn robust_sigma_moves_and_scales(samples in prop::collection::vec(-1e3..1e3, 1..60), by in -5.0..5.0, to in -9.0..9.0) {
            let plain = robust_sigma(&mut samples.clone()).unwrap();
            let mut other: Vec<f64> = samples.iter().map(|x| by * x + to).collect();
            prop_assert!((robust_sigma(&mut other).unwrap() - f64::abs(by) * plain).abs() < 1e-6);
        }
    }

    #[test]
    fn known_values() {
        assert_eq!(median(&mut [3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(&mut [4.0, 1.0, 2.0, 3.0]), Some(2.5));
        assert_eq!(quantile(&mut [0.0, 10.0, 20.0], 0.95), Some(19.0));
        assert_eq!(robust_sigma(&mut [0.0, 1.0, 2.0, 3.0, 100.0]), Some(MAD_TO_SIGMA));
        assert_eq!(median(&mut []), None);
        assert_eq!(robust_sigma(&mut []), None);
        assert_eq!(root_mean(1.0, 0), None);
        assert_eq!(root_mean(50.0, 2), Some(5.0));
        assert_eq!(share(1, 0), None);
        assert_eq!(finite(f64::NAN), None);
    }
}
