//! Where in the image, and by how much of the light, the pair sums fail.

use crate::{
    decode::{Class, Decoded},
    report::statistics,
};

/// No more pixels than this go into a median: enough for two digits.
const SAMPLES: usize = 1 << 17;
/// A single residual of this many sigma stands out of any number of pixels.
const OUTLIER_SIGMA: f64 = 5.0;
/// A row of the image counts with this many lit pixels.
const ROW_PIXELS: u32 = 16;
/// A torn frame is bad on this share of the pixels of one side of the tear: another pattern differs on half of them...
const TORN_SIDE: f64 = 0.3;
/// ...where a row of the image is bad with this share of its pixels...
const TORN_ROW: f64 = 0.15;
/// ...and this share of the rows is bad: what moves seldom reaches from a side of the image to the tear...
const TORN_ROWS_BAD: f64 = 0.8;
/// ...sound on all but this share of the other side...
const SOUND_SIDE: f64 = 0.02;
/// ...and each side has this share of the rows.
const TORN_ROWS: f64 = 0.05;

/// Signal to noise of a pair sum, and what its residuals look like in the image.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Field {
    /// Share of the lit pixels with a residual that noise does not explain.
    pub affected: f64,
    /// Median over those pixels of the residual per disturbed pair, as a share of the modulation: 1 where one frame of a
    /// pair shows the opposite of what it should.
    pub relative: Option<f64>,
    /// First image row below the tear, where the affected pixels end at one.
    pub torn_at: Option<usize>,
}

/// Standard deviation in DN of the pair sum at pixel `index`, from its modulation and its degree of polarization
/// (contrast, in mode `gray`): `R_H + R_V = C / dolp`. `None` where there is no such number.
fn sum_sigma(decoded: &Decoded, index: usize) -> Option<f64> {
    let modulation = f64::from(decoded.modulation.data()[index]).abs();
    let dolp = f64::from(decoded.dolp.data()[index]);
    // Two frames of a pair against two references, each the mean of two where there are two.
    let frames = if decoded.drift.is_some() { 3.0 } else { 4.0 };
    let level = modulation / dolp / 2.0;
    let sigma = (frames * decoded.noise.variance(level)).sqrt();
    (dolp > 0.0 && sigma.is_finite() && sigma > 0.0 && modulation > 0.0).then_some(sigma)
}

fn usable(class: Class) -> bool {
    class.is_lit() && class != Class::Saturated
}

/// Median over the lit pixels of the modulation in units of the noise of a pair sum.
pub fn modulation_sigma(decoded: &Decoded) -> Option<f64> {
    let step = decoded.class.len().div_ceil(SAMPLES).max(1);
    let mut samples: Vec<f64> = (0..decoded.class.len())
        .step_by(step)
        .filter(|&index| usable(decoded.class.data()[index]))
        .filter_map(|index| {
            Some(f64::from(decoded.modulation.data()[index]).abs() / sum_sigma(decoded, index)?)
        })
        .collect();
    statistics::median(&mut samples)
}

/// Looks at the residuals of a decode of which `disturbed` pairs are bad. `striped`: they code rows, so that another
/// pattern differs on whole bands of rows.
pub fn survey(decoded: &Decoded, disturbed: usize, striped: bool) -> Field {
    let pairs = decoded.pairs.len() as f64;
    // Sum of squares of `pairs` residuals: 4 sigma of its own spread, and one outlier on top.
    let limit = pairs + 4.0 * (2.0 * pairs).sqrt() + OUTLIER_SIGMA * OUTLIER_SIGMA;
    let mut rows = vec![[0u32; 2]; decoded.class.height()];
    let mut relative = Vec::new();
    for (index, &class) in decoded.class.data().iter().enumerate() {
        let residual = f64::from(decoded.residual.data()[index]);
        if !usable(class) || !residual.is_finite() {
            continue;
        }
        let row = &mut rows[index / decoded.class.width()];
        row[0] += 1;
        let sum = residual * residual * pairs;
        if sum <= limit {
            continue;
        }
        row[1] += 1;
        if relative.len() < SAMPLES * 4
            && let Some(sigma) = sum_sigma(decoded, index)
        {
            let per_pair = ((sum - pairs) / disturbed.max(1) as f64).sqrt();
            relative.push(per_pair * sigma / f64::from(decoded.modulation.data()[index]).abs());
        }
    }
    let total: u64 = rows.iter().map(|row| u64::from(row[0])).sum();
    let affected: u64 = rows.iter().map(|row| u64::from(row[1])).sum();
    Field {
        affected: statistics::share(affected, total).unwrap_or(0.0),
        relative: statistics::median(&mut relative),
        torn_at: tear(&rows, striped),
    }
}

/// The row that parts a bad side from a sound one. `rows`: lit and affected pixels of each.
fn tear(rows: &[[u32; 2]], striped: bool) -> Option<usize> {
    let usable: Vec<(usize, f64)> = rows
        .iter()
        .enumerate()
        .filter(|(_, [lit, _])| *lit >= ROW_PIXELS)
        .map(|(y, [lit, bad])| (y, f64::from(*bad) / f64::from(*lit)))
        .collect();
    let total: f64 = usable.iter().map(|(_, share)| share).sum();
    let least = ((usable.len() as f64 * TORN_ROWS).ceil() as usize).max(2);
    let is_whole = |side: &[(usize, f64)]| {
        let bad = side.iter().filter(|(_, share)| *share >= TORN_ROW).count();
        striped || bad as f64 >= TORN_ROWS_BAD * side.len() as f64
    };
    let mut above = 0.0;
    let mut best: Option<(f64, usize)> = None;
    for (count, &(y, share)) in usable.iter().enumerate() {
        if count >= least && usable.len() - count >= least {
            let means = [above / count as f64, (total - above) / (usable.len() - count) as f64];
            let (low, high) = (means[0].min(means[1]), means[0].max(means[1]));
            let side = if means[0] > means[1] { &usable[..count] } else { &usable[count..] };
            let torn = low <= SOUND_SIDE && high >= TORN_SIDE && is_whole(side);
            if torn && best.is_none_or(|(gap, _)| high - low > gap) {
                best = Some((high - low, y));
            }
        }
        above += share;
    }
    best.map(|(_, y)| y)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::testing;

    #[test]
    fn noise_affects_nothing() {
        let decoded = testing::decoded(64, 48);
        let field = survey(&decoded, 1, false);
        assert_eq!((field.affected, field.relative, field.torn_at), (0.0, None, None));
    }

    #[test]
    fn modulation_is_told_in_sigma() {
        let decoded = testing::decoded(64, 48);
        // Level of the fixture: H 2000, V 40, C 1960, two references each: 3 variances at the mean level of 1020.
        let expected = 1960.0 / (3.0 * decoded.noise.variance(1020.0)).sqrt();
        let found = modulation_sigma(&decoded).unwrap();
        assert!((found / expected - 1.0).abs() < 1e-4, "{found} {expected}");
    }

    #[test]
    fn a_stale_frame_has_residuals_as_large_as_the_modulation() {
        let mut decoded = testing::decoded(64, 48);
        let sigma = modulation_sigma(&decoded).unwrap();
        let pairs = decoded.pairs.len() as f64;
        // One of all pairs is off by the whole modulation, the others are noise.
        let residual = ((sigma * sigma + pairs) / pairs).sqrt() as f32;
        for (index, value) in decoded.residual.data_mut().iter_mut().enumerate() {
            if index % 2 == 0 {
                *value = residual;
            }
        }
        let field = survey(&decoded, 1, false);
        assert_eq!(field.affected, 0.5);
        assert!((field.relative.unwrap() - 1.0).abs() < 1e-3, "{field:?}");
        assert_eq!(field.torn_at, None);
    }

    #[test]
    fn a_tear_is_found_where_it_is() {
        let mut decoded = testing::decoded(64, 48);
        for value in &mut decoded.residual.data_mut()[..30 * 64] {
            *value = 40.0;
        }
        assert_eq!(survey(&decoded, 1, false).torn_at, Some(30));
    }

    #[test]
    fn a_tear_of_rows_is_found_in_bands() {
        let mut decoded = testing::decoded(64, 48);
        for y in (0..48).filter(|y| *y >= 24 && y / 4 % 2 == 0) {
            decoded.residual.data_mut()[y * 64..][..64].fill(40.0);
        }
        assert_eq!(survey(&decoded, 1, true).torn_at, Some(24));
        assert_eq!(survey(&decoded, 1, false).torn_at, None);
    }

    #[test]
    fn a_blob_is_no_tear() {
        let mut decoded = testing::decoded(64, 48);
        for y in 20..30 {
            decoded.residual.data_mut()[y * 64 + 10..][..30].fill(40.0);
        }
        let field = survey(&decoded, 1, false);
        assert_eq!(field.torn_at, None);
        assert!((field.affected - 300.0 / (64.0 * 48.0)).abs() < 1e-9);
    }
}
