//! Round numbers along an axis.

/// About `wanted` round numbers from `low` to `high`, and the number of decimals that tells them apart.
pub(super) fn ticks(low: f32, high: f32, wanted: usize) -> (Vec<f32>, usize) {
    let (low, high) = (f64::from(low), f64::from(high));
    if !(low.is_finite() && high.is_finite()) || high <= low || wanted == 0 {
        return (Vec::new(), 0);
    }
    let rough = (high - low) / wanted as f64;
    let power = 10f64.powf(rough.log10().floor());
    let step = power
        * [1.0, 2.0, 2.5, 5.0, 10.0]
            .into_iter()
            .find(|&factor| factor * power >= 0.999 * rough)
            .unwrap_or(10.0);
    let (first, last) = ((low / step - 1e-6).ceil(), (high / step + 1e-6).floor());
    // A range too narrow for its numbers, as of 32-bit floats far from zero, has no ticks of its own.
    if !(0.0..1000.0).contains(&(last - first)) {
        return (Vec::new(), 0);
    }
    let decimals = (0..9).find(|&decimals| is_whole(step * 10f64.powi(decimals))).unwrap_or(9) as usize;
    let values = (0..=(last - first) as usize).map(|index| ((first + index as f64) * step) as f32).collect();
    (values, decimals)
}

/// [`ticks`] with their labels.
pub(crate) fn labelled(low: f64, high: f64, wanted: usize) -> Vec<(f64, String)> {
    let (values, decimals) = ticks(low as f32, high as f32, wanted);
    values.into_iter().map(|value| (f64::from(value), label(value, decimals))).collect()
}

fn is_whole(value: f64) -> bool {
    (value - value.round()).abs() < 1e-6 * value.abs().max(1.0)
}

/// `value` with `decimals`, without a minus in front of zero.
pub(super) fn label(value: f32, decimals: usize) -> String {
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        Some(rest) if rest.chars().all(|digit| matches!(digit, '0' | '.')) => rest.to_owned(),
        _ => text,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn round_numbers() {
        assert_eq!(ticks(0.0, 1023.0, 5), (vec![0.0, 250.0, 500.0, 750.0, 1000.0], 0));
        assert_eq!(ticks(0.0, 1.0, 4), (vec![0.0, 0.25, 0.5, 0.75, 1.0], 2));
        assert_eq!(ticks(-1.0, 1.0, 4), (vec![-1.0, -0.5, 0.0, 0.5, 1.0], 1));
        assert_eq!(label(-0.0001, 2), "0.00");
        assert_eq!(label(-12.5, 1), "-12.5");
        assert!(ticks(1.0, 1.0, 4).0.is_empty());
        assert!(ticks(f32::NAN, 1.0, 4).0.is_empty());
    }

    proptest! {
        #[test]
        fn ticks_lie_in_the_range_and_read_differently(low in -1e4f32..1e4, span in 1e-1f32..1e5, wanted in 1usize..12) {
            let (values, decimals) = ticks(low, low + span, wanted);
            prop_assert!(values.len() <= 2 * wanted + 2);
            let slack = 1e-3 * span;
            prop_assert!(values.iter().all(|&value| value >= low - slack && value <= low + span + slack));
            for pair in values.windows(2) {
                prop_assert!(label(pair[0], decimals) != label(pair[1], decimals));
            }
        }
    }
}
