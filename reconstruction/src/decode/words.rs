//! From samples to words and classes, one row at a time over all planes, so that each byte is read once.
//!
//! Gates are in units of noise. With references of `n` frames each, `sigma(C)^2 = var(R_H)/n_H + var(R_V)/n_V`. A pair
//! sums to the references' sum, so `sigma(P - Q)` is the same for all pairs of a pixel:
//! `2 read^2 + 1/6 + K * (level of R_H + level of R_V)`. One comparison with an integer per pair is left.
//!
//! Where references are missing the mean pair sum stands in for `R_H + R_V`. Without any, the modulation is the mean
//! of |P - Q| over all pairs: on a lit pixel all but the pairs at an edge differ by |C|. On an unlit one that mean is
//! 0.80 sigma(P - Q) and, with at least eight pairs, hardly ever over 1.5, so that the gate of
//! `lit_sigma * sigma(P - Q) / sqrt(2)` (2.8 sigma; the same gate that references of two frames give) passes none.

use polscan_patterns::Mode;
use rayon::prelude::*;

use super::{
    kernels::{WEAK_BIT_SHIFT, pair_bit, pair_sum, track_weakest},
    limits::Gates,
    plan::{AxisFrames, BitFrames, Frames, Levels, PrefixCode, binary_of_gray},
    sample::Sample,
    types::Class,
};

/// Bits whose boundaries lie at least this far apart (in values) are coarse: the pattern is flat between them.
const COARSE_SPACING: u32 = 16;
/// A coarse bit may be weak this near to its own boundary, in values.
const EDGE_REACH: i32 = 7;
/// Weakness is judged where |C| is at least this many sigma of P - Q.
const WEAK_JUDGED: f32 = 9.0;
/// Scale of the stored weakness; `WEAK_UNKNOWN` where it is not judged.
pub(crate) const WEAK_SCALE: f32 = 128.0;
pub(crate) const WEAK_UNKNOWN: u8 = u8::MAX;

/// One image of every per-pixel result.
pub(crate) struct PixelMaps {
    pub class: Vec<Class>,
    /// Words as read (bits without meaning where the class is unlit), per axis of the plan.
    pub words: [Vec<u16>; 2],
    /// Binary value of the known bits, -1 where there is none.
    pub values: [Vec<i32>; 2],
    pub half_saturated: Vec<bool>,
    pub modulation: Vec<f32>,
    /// Standard deviation of P - Q.
    pub sigma: Vec<f32>,
    pub residual: Vec<f32>,
    pub dolp: Vec<f32>,
    pub intensity: Vec<u8>,
    /// Smallest |P - Q| / |C| of the coarse bits away from their own edges, times `WEAK_SCALE`.
    pub weakest: Vec<u8>,
}

/// The same for one row.
struct RowMaps<'a> {
    class: &'a mut [Class],
    words: [&'a mut [u16]; 2],
    values: [&'a mut [i32]; 2],
    half_saturated: &'a mut [bool],
    modulation: &'a mut [f32],
    sigma: &'a mut [f32],
    residual: &'a mut [f32],
    dolp: &'a mut [f32],
    intensity: &'a mut [u8],
    weakest: &'a mut [u8],
}

/// Decodes all pixels, each on its own.
pub(crate) fn decode_pixels<T: Sample>(frames: &Frames<'_, T>, gates: &Gates) -> PixelMaps {
    let (width, len) = (frames.width, frames.width * frames.height);
    let axis_len = |index: usize| if frames.axes.len() > index { len } else { 0 };
    let mut maps = PixelMaps {
        class: vec![Class::Unlit; len],
        words: [0, 1].map(|axis| vec![0; axis_len(axis)]),
        values: [0, 1].map(|axis| vec![-1; axis_len(axis)]),
        half_saturated: vec![false; len],
        modulation: vec![0.0; len],
        sigma: vec![0.0; len],
        residual: vec![f32::NAN; len],
        dolp: vec![0.0; len],
        intensity: vec![0; len],
        weakest: vec![WEAK_UNKNOWN; len],
    };
    split_rows(&mut maps, width)
        .into_par_iter()
        .enumerate()
        .for_each_init(|| Scratch::new(width), |scratch, (y, row)| scratch.decode_row(frames, gates, y, row));
    maps
}

fn split_rows(maps: &mut PixelMaps, width: usize) -> Vec<RowMaps<'_>> {
    let [words_0, words_1] = &mut maps.words;
    let [values_0, values_1] = &mut maps.values;
    let (mut words_0, mut words_1) = (words_0.chunks_mut(width), words_1.chunks_mut(width));
    let (mut values_0, mut values_1) = (values_0.chunks_mut(width), values_1.chunks_mut(width));
    let mut half_saturated = maps.half_saturated.chunks_mut(width);
    let mut modulation = maps.modulation.chunks_mut(width);
    let mut sigma = maps.sigma.chunks_mut(width);
    let mut residual = maps.residual.chunks_mut(width);
    let mut dolp = maps.dolp.chunks_mut(width);
    let mut intensity = maps.intensity.chunks_mut(width);
    let mut weakest = maps.weakest.chunks_mut(width);
    maps.class
        .chunks_mut(width)
        .map(|class| RowMaps {
            class,
            words: [words_0.next().unwrap_or_default(), words_1.next().unwrap_or_default()],
            values: [values_0.next().unwrap_or_default(), values_1.next().unwrap_or_default()],
            half_saturated: half_saturated.next().unwrap_or_default(),
            modulation: modulation.next().unwrap_or_default(),
            sigma: sigma.next().unwrap_or_default(),
            residual: residual.next().unwrap_or_default(),
            dolp: dolp.next().unwrap_or_default(),
            intensity: intensity.next().unwrap_or_default(),
            weakest: weakest.next().unwrap_or_default(),
        })
        .collect()
}

/// Working memory of one thread: one row of everything that lives only within a row.
struct Scratch {
    /// R_H + R_V or what stands in for it, in DN.
    level_sum: Vec<f32>,
    /// Variance of `level_sum` and of C from the references' own noise.
    level_variance: Vec<f32>,
    /// A bit is soft where |P - Q| is at most this.
    soft_at: Vec<i32>,
    inverted: Vec<u16>,
    word: Vec<u16>,
    soft: Vec<u16>,
    /// Bit 0: one frame of a pair saturated; bit 1: both; bit 2: a reference.
    saturated: Vec<u8>,
    squares: Vec<f32>,
    pairs: Vec<u32>,
    weakest: Vec<i32>,
    second: Vec<i32>,
    status: Vec<Status>,
}

/// What the words of the axes so far say.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Status {
    Clear,
    Edge,
    Outside,
    Ambiguous,
}

impl Scratch {
    fn new(width: usize) -> Self {
        Self {
            level_sum: vec![0.0; width],
            level_variance: vec![0.0; width],
            soft_at: vec![0; width],
            inverted: vec![0; width],
            word: vec![0; width],
            soft: vec![0; width],
            saturated: vec![0; width],
            squares: vec![0.0; width],
            pairs: vec![0; width],
            weakest: vec![0; width],
            second: vec![0; width],
            status: vec![Status::Clear; width],
        }
    }

    fn decode_row<T: Sample>(
        &mut self,
        frames: &Frames<'_, T>,
        gates: &Gates,
        y: usize,
        mut row: RowMaps<'_>,
    ) {
        let width = frames.width;
        let at = y * width..(y + 1) * width;
        let full = gates.saturation_dn;
        self.saturated.fill(0);
        self.squares.fill(0.0);
        self.pairs.fill(0);
        self.status.fill(Status::Clear);
        self.levels(frames, gates, y, &mut row);
        let mut weak = vec![f32::INFINITY; width];
        for (index, axis) in frames.axes.iter().enumerate() {
            self.word.fill(0);
            self.soft.fill(0);
            self.weakest.fill(i32::MAX);
            self.second.fill(i32::MAX);
            for (bit, bit_frames) in axis.bits.iter().enumerate() {
                match *bit_frames {
                    BitFrames::Pair(p, q) => {
                        let (p, q) = (&p[at.clone()], &q[at.clone()]);
                        if gates.mode == Mode::Paper {
                            self.paper_bit(p, q, &frames.low, y, gates);
                        } else {
                            let (soft_at, saturated) = (&self.soft_at, &mut self.saturated);
                            pair_bit(p, q, full, soft_at, &mut self.word, &mut self.soft, saturated);
                        }
                        pair_sum(p, q, full, &self.level_sum, &mut self.squares, &mut self.pairs);
                        if is_coarse(axis.code, bit as u8) {
                            track_weakest(p, q, bit as u8, &mut self.weakest, &mut self.second);
                        }
                    }
                    BitFrames::Single(plane, inverse) => self.single_bit(&plane[at.clone()], inverse, gates),
                }
            }
            self.resolve(axis, index, &mut row, &mut weak);
        }
        self.classify(frames, gates, &mut row, &weak);
    }

    /// Reference levels, modulation, thresholds and pictures of the row.
    fn levels<T: Sample>(&mut self, frames: &Frames<'_, T>, gates: &Gates, y: usize, row: &mut RowMaps<'_>) {
        let width = frames.width;
        let pair_count = frames.pair_count() as f32;
        let mut pair_sums = vec![0i32; width];
        let mut pair_differences = vec![0i32; width];
        if frames.levels != Levels::References {
            for (_, _, p, q) in frames.pairs() {
                for x in 0..width {
                    let (p, q) = (p[y * width + x].dn(), q[y * width + x].dn());
                    pair_sums[x] += p + q;
                    pair_differences[x] += (p - q).abs();
                }
            }
        }
        let mean = |planes: &[&[T]], x: usize, saturated: &mut u8| {
            let mut sum = 0i64;
            for plane in planes {
                let dn = plane[y * width + x].dn();
                *saturated |= u8::from(dn >= gates.saturation_dn) << 2;
                sum += i64::from(dn);
            }
            sum as f32 / planes.len().max(1) as f32
        };
        let (high_count, low_count) = (frames.high.len().max(1) as f32, frames.low.len().max(1) as f32);
        for x in 0..width {
            let saturated = &mut self.saturated[x];
            let mut low_saturated = 0;
            let high = mean(&frames.high, x, saturated);
            let low = mean(&frames.low, x, &mut low_saturated);
            // With both references saturated no modulation is left, as when both frames of a pair are.
            *saturated |= low_saturated | ((*saturated & low_saturated) >> 1);
            let mean_sum = pair_sums[x] as f32 / pair_count;
            let (high, low, modulation, variance) = match frames.levels {
                Levels::References => {
                    let variance = gates.variance(high) / high_count + gates.variance(low) / low_count;
                    (high, low, high - low, variance)
                }
                Levels::HighOnly | Levels::LowOnly => {
                    let (high, low) = if frames.levels == Levels::HighOnly {
                        (high, mean_sum - high)
                    } else {
                        (mean_sum - low, low)
                    };
                    let (known, count) =
                        if frames.levels == Levels::HighOnly { (high, high_count) } else { (low, low_count) };
                    // C = +-(2 R - mean sum): the known reference counts twice.
                    let variance = 4.0 * gates.variance(known) / count
                        + (gates.variance(high) + gates.variance(low)) / pair_count;
                    (high, low, high - low, variance)
                }
                Levels::Pairs => {
                    let modulation = pair_differences[x] as f32 / pair_count;
                    let (high, low) = ((mean_sum + modulation) / 2.0, (mean_sum - modulation) / 2.0);
                    (high, low, modulation, (gates.variance(high) + gates.variance(low)) / 2.0)
                }
            };
            let pair_variance = gates.variance(high) + gates.variance(low);
            let sigma = pair_variance.sqrt();
            self.level_sum[x] = high + low;
            self.level_variance[x] = variance;
            self.soft_at[x] = (gates.soft_sigma * sigma).ceil() as i32 - 1;
            self.inverted[x] = if modulation < 0.0 { u16::MAX } else { 0 };
            row.modulation[x] = modulation;
            row.sigma[x] = sigma;
            // Mode paper knows R_V; its R_H is the mean pair sum less R_V.
            let dark = if gates.mode == Mode::Paper { mean(&frames.low, x, &mut 0) } else { low };
            row.dolp[x] = gates.dolp(high + low - dark, dark).clamp(0.0, 1.0);
            row.intensity[x] = (high.max(low) * (255.0 / gates.full_scale_dn) + 0.5).clamp(0.0, 255.0) as u8;
        }
    }

    /// Bit of a pair by its degrees of linear polarization (method, section 3). Where these are equal the bit is lost.
    fn paper_bit<T: Sample>(&mut self, p: &[T], q: &[T], dark: &[&[T]], y: usize, gates: &Gates) {
        let width = p.len();
        for x in 0..width {
            let dark_sum: i64 = dark.iter().map(|plane| i64::from(plane[y * width + x].dn())).sum();
            let dark_dn = dark_sum as f32 / dark.len() as f32;
            let (p, q) = (p[x].dn(), q[x].dn());
            let difference = gates.dolp(p as f32, dark_dn) - gates.dolp(q as f32, dark_dn);
            let soft = (p - q).abs() <= self.soft_at[x] || difference == 0.0;
            self.word[x] = (self.word[x] << 1) | u16::from(difference > 0.0);
            self.soft[x] = (self.soft[x] << 1) | u16::from(soft);
            let (p_full, q_full) = (p >= gates.saturation_dn, q >= gates.saturation_dn);
            self.saturated[x] |= u8::from(p_full | q_full) | (u8::from(p_full & q_full) << 1);
        }
    }

    /// Bit of a frame without its partner, against the middle of the references.
    fn single_bit<T: Sample>(&mut self, plane: &[T], inverse: bool, gates: &Gates) {
        for (x, sample) in plane.iter().enumerate() {
            let dn = sample.dn();
            let above = 2.0 * dn as f32 - self.level_sum[x];
            let variance = 4.0 * gates.variance(dn as f32) + self.level_variance[x];
            let soft = above * above < gates.soft_sigma * gates.soft_sigma * variance;
            self.word[x] = (self.word[x] << 1) | u16::from((above > 0.0) != inverse);
            self.soft[x] = (self.soft[x] << 1) | u16::from(soft);
            self.saturated[x] |= u8::from(dn >= gates.saturation_dn);
        }
    }

    /// Words of one axis to values.
    fn resolve<T>(
        &mut self,
        axis: &AxisFrames<'_, T>,
        index: usize,
        row: &mut RowMaps<'_>,
        weak: &mut [f32],
    ) {
        let mask = ((1u32 << axis.code.bits) - 1) as u16;
        for (x, weak) in weak.iter_mut().enumerate() {
            let word = (self.word[x] ^ self.inverted[x]) & mask;
            let (value, status) = resolve_word(&axis.values, word, self.soft[x]);
            row.words[index][x] = word;
            row.values[index][x] = value;
            self.status[x] = self.status[x].max(status);
            if value >= 0 && self.weakest[x] != i32::MAX {
                let bit = (self.weakest[x] & ((1 << WEAK_BIT_SHIFT) - 1)) as u8;
                let near = boundary_distance(axis.code, bit, value) <= EDGE_REACH;
                let key = if near { self.second[x] } else { self.weakest[x] };
                if key != i32::MAX {
                    *weak = weak.min((key >> WEAK_BIT_SHIFT) as f32);
                }
            }
        }
    }

    fn classify<T>(&self, frames: &Frames<'_, T>, gates: &Gates, row: &mut RowMaps<'_>, weak: &[f32]) {
        let pair_count = frames.pair_count() as f32;
        for (x, &weak) in weak.iter().enumerate() {
            let modulation = row.modulation[x].abs();
            let inverted = self.inverted[x] != 0;
            let gate = if inverted { 2.0 * gates.lit_sigma } else { gates.lit_sigma };
            let lit = modulation >= gate * self.level_variance[x].sqrt();
            let class = if self.saturated[x] & 2 != 0 {
                Class::Saturated
            } else if !lit {
                Class::Unlit
            } else {
                match self.status[x] {
                    Status::Ambiguous => Class::Ambiguous,
                    Status::Outside => Class::OutOfProjector,
                    _ if inverted => Class::Inverted,
                    Status::Edge => Class::Edge,
                    Status::Clear => Class::Valid,
                }
            };
            row.class[x] = class;
            row.half_saturated[x] = self.saturated[x] != 0;
            if !class.is_valid() {
                for values in &mut row.values {
                    if let Some(value) = values.get_mut(x) {
                        *value = -1;
                    }
                }
            }
            let sigma = row.sigma[x];
            if class.is_valid()
                && weak.is_finite()
                && self.saturated[x] == 0
                && modulation >= WEAK_JUDGED * sigma
            {
                row.weakest[x] = (weak / modulation * WEAK_SCALE).min(254.0) as u8;
            }
            if self.pairs[x] > 0 && self.saturated[x] & 4 == 0 {
                let variance = match frames.levels {
                    Levels::References => sigma * sigma + self.level_variance[x],
                    _ => sigma * sigma * (1.0 - 1.0 / pair_count),
                };
                row.residual[x] = (self.squares[x] / (self.pairs[x] as f32 * variance)).sqrt();
            }
        }
    }
}

/// Value of a word (`values` by word, negative outside the projector) with at most one soft bit. A single soft bit is
/// an edge where both readings are neighbours, of which one may lie just beyond the rim of the projector.
fn resolve_word(values: &[i32], word: u16, soft: u16) -> (i32, Status) {
    let read = values[usize::from(word)];
    if soft == 0 {
        return (read, if read < 0 { Status::Outside } else { Status::Clear });
    }
    let inside = |value: i32| (value >= 0).then_some(value);
    match soft.count_ones() {
        1 => {
            let other = word ^ soft;
            let neighbours = binary_of_gray(word).abs_diff(binary_of_gray(other)) == 1;
            match inside(read).or(inside(values[usize::from(other)])) {
                None => (-1, Status::Outside),
                Some(value) if neighbours => (value, Status::Edge),
                Some(_) => (-1, Status::Ambiguous),
            }
        }
        _ => (-1, Status::Ambiguous),
    }
}

/// Whether the known boundaries down to this bit lie far apart.
fn is_coarse(code: PrefixCode, bit: u8) -> bool {
    u32::from(bit) < u32::from(code.bits) && (1u32 << (code.bits - 1 - bit)) >= COARSE_SPACING
}

/// Distance in values from the centre of `value` to the next boundary of `bit`, rounded down.
fn boundary_distance(code: PrefixCode, bit: u8, value: i32) -> i32 {
    let half = 1i32 << (code.bits - 1 - bit);
    let within = value & (2 * half - 1);
    if within < half { half - 1 - within } else { within - half }
}

#[cfg(test)]
mod tests {
    use polscan_patterns::AxisCode;

    use super::*;

    /// All words in order, by reflection.
    fn words(bits: u8) -> Vec<u16> {
        (0..bits).fold(vec![0], |list: Vec<u16>, bit| {
            let again = list.iter().rev().map(|word| word | 1 << bit);
            list.iter().copied().chain(again).collect()
        })
    }

    #[test]
    fn a_soft_bit_is_an_edge_only_between_neighbours() {
        let (mut rims, mut strangers) = (0, 0);
        for size in [1, 2, 3, 5, 12, 17, 100, 768, 1024] {
            let whole = AxisCode::centred(size).unwrap();
            for known in 1..=whole.bits() {
                let code = PrefixCode::new(whole, known);
                let list = words(known);
                let inside = |place: usize| code.span(place as i32).is_some();
                let mut values = vec![-1; list.len()];
                for place in (0..list.len()).filter(|&place| inside(place)) {
                    values[usize::from(list[place])] = place as i32;
                }
                for (place, &word) in list.iter().enumerate() {
                    for bit in 0..known {
                        let other = list.iter().position(|&found| found == word ^ (1 << bit)).unwrap();
                        let found = resolve_word(&values, word, 1 << bit);
                        let here = if inside(place) { place } else { other };
                        let expected = match (inside(place), inside(other)) {
                            (false, false) => (-1, Status::Outside),
                            _ if place.abs_diff(other) == 1 => (here as i32, Status::Edge),
                            _ => (-1, Status::Ambiguous),
                        };
                        assert_eq!(found, expected, "{size} px, {known} bits: {word:b} bit {bit}");
                        if inside(place) != inside(other) {
                            rims += u32::from(expected.1 == Status::Edge);
                            strangers += u32::from(expected.1 == Status::Ambiguous);
                        }
                    }
                }
            }
        }
        assert!(rims > 10 && strangers > 10, "{rims} {strangers}");
    }
}
