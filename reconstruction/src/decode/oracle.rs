//! The decoder once more, slow and obvious: one pixel at a time, in double precision, words found by looking through
//! all indices. Shares nothing with the fast path but the public types. For tests.

use polscan_patterns::{Axis, AxisCode, Mode, Role};

use super::types::{Class, DecodeSettings, NoiseModel};

/// What became of one pixel before any gate over its neighbourhood.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OraclePixel {
    /// Class.
    pub class: Class,
    /// Column and row index, -1 where there is none (or the axis is not decoded).
    pub codes: [i32; 2],
    /// Smallest relative distance of any compared quantity from its threshold: rounding may decide where it is tiny.
    pub margin: f64,
}

/// Samples of one pixel by role.
pub type PixelSamples = [(Role, u16)];

struct Levels {
    high: f64,
    low: f64,
    modulation: f64,
    modulation_variance: f64,
}

/// Decodes one pixel.
pub fn decode_pixel(settings: &DecodeSettings, noise: NoiseModel, samples: &PixelSamples) -> OraclePixel {
    let camera = settings.camera;
    let black = camera.black_level_dn.unwrap_or(0.0);
    let variance = |dn: f64| noise.variance(dn - black);
    let full = f64::from(camera.saturation_dn);
    let all = |role: Role| -> Vec<f64> {
        samples.iter().filter(|(r, _)| *r == role).map(|(_, dn)| f64::from(*dn)).collect()
    };
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (low_role, high_role) = match settings.mode {
        Mode::Gray => (Role::Black, Role::White),
        _ => (Role::ReferenceV, Role::ReferenceH),
    };
    let dark = all(low_role);
    let bright = if settings.mode == Mode::Paper { Vec::new() } else { all(high_role) };
    let both = !dark.is_empty() && !bright.is_empty();
    let axes = [(Axis::Column, settings.column), (Axis::Row, settings.row)];
    let decoded_axes = if settings.mode == Mode::Fast { &axes[..1] } else { &axes[..] };
    // Frames of each axis down to the first bit that cannot be decided.
    let bits_of = |axis: Axis, code: AxisCode| -> Vec<(Option<f64>, Option<f64>)> {
        let frame = |bit, inverse| all(Role::Code { axis, bit, inverse }).first().copied();
        (0..code.bits())
            .map(|bit| (frame(bit, false), frame(bit, true)))
            .take_while(|found| matches!(found, (Some(_), Some(_))) || (both && *found != (None, None)))
            .collect()
    };
    let pairs: Vec<(f64, f64)> = decoded_axes
        .iter()
        .flat_map(|&(axis, code)| bits_of(axis, code))
        .filter_map(|(p, q)| Some((p?, q?)))
        .collect();
    let count = pairs.len() as f64;
    let mean_sum = pairs.iter().map(|(p, q)| p + q).sum::<f64>() / count;
    let levels = if both {
        let (high, low) = (mean(&bright), mean(&dark));
        let modulation_variance = variance(high) / bright.len() as f64 + variance(low) / dark.len() as f64;
        Levels { high, low, modulation: high - low, modulation_variance }
    } else if (dark.is_empty() && bright.is_empty()) || settings.mode == Mode::Paper {
        let modulation = pairs.iter().map(|(p, q)| (p - q).abs()).sum::<f64>() / count;
        let (high, low) = ((mean_sum + modulation) / 2.0, (mean_sum - modulation) / 2.0);
        Levels { high, low, modulation, modulation_variance: (variance(high) + variance(low)) / 2.0 }
    } else {
        let known = if dark.is_empty() { &bright } else { &dark };
        let other = mean_sum - mean(known);
        let (high, low) = if dark.is_empty() { (mean(known), other) } else { (other, mean(known)) };
        let modulation_variance =
            4.0 * variance(mean(known)) / known.len() as f64 + (variance(high) + variance(low)) / count;
        Levels { high, low, modulation: high - low, modulation_variance }
    };
    let pair_sigma = (variance(levels.high) + variance(levels.low)).sqrt();
    let inverted = levels.modulation < 0.0;
    let mut margin = f64::INFINITY;
    let mut compare = |value: f64, threshold: f64| {
        margin = margin.min((value - threshold).abs() / threshold.abs().max(1e-9));
        value < threshold
    };
    let mut both_saturated = bright.iter().any(|&dn| dn >= full) && dark.iter().any(|&dn| dn >= full);
    let (mut ambiguous, mut outside, mut edge) = (false, false, false);
    let mut codes = [-1; 2];
    for (slot, &(axis, code)) in decoded_axes.iter().enumerate() {
        let bits = bits_of(axis, code);
        if bits.is_empty() && code.bits() > 0 {
            continue;
        }
        let mut word = Vec::new();
        let mut soft = Vec::new();
        for &(p, q) in &bits {
            let z = settings.thresholds.soft_bit_sigma;
            match (p, q) {
                (Some(p), Some(q)) => {
                    both_saturated |= p >= full && q >= full;
                    let weak = compare((p - q).abs(), z * pair_sigma);
                    if settings.mode == Mode::Paper {
                        let degree = |i: f64| {
                            let (i, r) = (i - black, mean(&dark) - black);
                            if i + r > 0.0 { (i - r) / (i + r) } else { 0.0 }
                        };
                        word.push(degree(p) > degree(q));
                        soft.push(weak || degree(p) == degree(q));
                    } else {
                        word.push((p > q) != inverted);
                        soft.push(weak);
                    }
                }
                (Some(sample), None) | (None, Some(sample)) => {
                    let above = 2.0 * sample - levels.high - levels.low;
                    let sigma = (4.0 * variance(sample) + levels.modulation_variance).sqrt();
                    soft.push(compare(above.abs(), z * sigma));
                    word.push(((above > 0.0) != p.is_none()) != inverted);
                }
                (None, None) => unreachable!("bits end before the first without a frame"),
            }
        }
        let spans: Vec<(u32, u32)> =
            readings(&word, &soft).iter().filter_map(|word| indices(code, word)).collect();
        match soft.iter().filter(|soft| **soft).count() {
            0 => outside |= spans.is_empty(),
            1 => match spans[..] {
                [(a, b), (c, d)] if b + 1 == c || d + 1 == a => edge = true,
                [_, _] => ambiguous = true,
                [_] => match readings(&word, &soft).iter().map(|word| place(word)).collect::<Vec<_>>()[..] {
                    [one, other] if one + 1 == other || other + 1 == one => edge = true,
                    _ => ambiguous = true,
                },
                _ => outside = true,
            },
            _ => ambiguous = true,
        }
        if let Some(&(first, last)) = spans.first() {
            codes[slot] = ((first + last) / 2) as i32;
        }
    }
    let gate = settings.thresholds.lit_sigma * if inverted { 2.0 } else { 1.0 };
    let unlit = compare(levels.modulation.abs(), gate * levels.modulation_variance.sqrt());
    let class = if both_saturated {
        Class::Saturated
    } else if unlit {
        Class::Unlit
    } else if ambiguous {
        Class::Ambiguous
    } else if outside {
        Class::OutOfProjector
    } else if inverted {
        Class::Inverted
    } else if edge {
        Class::Edge
    } else {
        Class::Valid
    };
    OraclePixel { class, codes: if class.is_valid() { codes } else { [-1; 2] }, margin }
}

/// The word as read, and where one bit is soft also the word with that bit the other way.
fn readings(word: &[bool], soft: &[bool]) -> Vec<Vec<bool>> {
    let mut readings = vec![word.to_vec()];
    if soft.iter().filter(|soft| **soft).count() == 1 {
        readings.push(word.iter().zip(soft).map(|(bit, soft)| bit ^ soft).collect());
    }
    readings
}

/// Place of a word in the list of all words as it is written down by reflection: first the shorter list behind a 0,
/// then the same list backwards behind a 1.
fn place(word: &[bool]) -> u32 {
    match word {
        [] => 0,
        [false, rest @ ..] => place(rest),
        [true, rest @ ..] => (1 << word.len()) - 1 - place(rest),
    }
}

/// First and last index whose word begins with these bits.
fn indices(code: AxisCode, word: &[bool]) -> Option<(u32, u32)> {
    let matching =
        |index: &u32| word.iter().enumerate().all(|(bit, value)| code.bit(*index, bit as u8) == *value);
    let mut found = (0..code.size()).filter(matching);
    let first = found.next()?;
    Some((first, found.next_back().unwrap_or(first)))
}
