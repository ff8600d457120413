//! A closer look at a pair whose sum fails: where, by how much of the light, and whether a change of brightness
//! explains it. Done only for pairs that fail, on a few hundred thousand pixels.

use polscan_patterns::{Axis, Role};

use crate::{
    decode::{Class, DecodeSettings, Decoded, Plane},
    report::statistics,
};

/// No more pixels than this are looked at.
const PIXELS: usize = 300_000;
/// Beyond this many sigma a pixel is an outlier, as in the statistics of the decode.
const OUTLIER_SIGMA: f64 = 5.0;
/// A pixel this near to a stripe edge is not flat.
const NEAR_EDGE: usize = 2;
/// How many sigma apart P and Q must be to tell the bright frame.
const BRIGHT_SIGMA: f64 = 8.0;
/// A larger change of one frame's brightness is another picture.
const LARGEST_CHANGE: f64 = 0.5;
/// Without references, so many pairs are needed to tell a bad one from the others.
const LEAST_PAIRS: usize = 4;
/// Variance of the median of normal samples over that of their mean: pi / 2.
const MEDIAN_VARIANCE: f64 = std::f64::consts::FRAC_PI_2;
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
/// A row of the image counts with this many pixels looked at.
const ROW_PIXELS: u32 = 16;

/// The frames of a scan, for a closer look.
#[derive(Clone, Copy)]
pub struct Frames<'a> {
    /// Roles and planes.
    pub all: &'a [(Role, Plane<'a>)],
    /// How they were decoded.
    pub settings: &'a DecodeSettings,
    /// What came of it.
    pub decoded: &'a Decoded,
}

/// What a closer look at one pair shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Look {
    /// Share of the pixels looked at that are outliers.
    pub outliers: f64,
    /// The same after the brightness of each frame was allowed to differ.
    pub unexplained: f64,
    /// Change of the brightness of P and Q that explains most.
    pub change: [f64; 2],
    /// Median over the unexplained outliers of the residual as a share of the modulation: 1 for another picture.
    pub strength: Option<f64>,
    /// First image row below a tear.
    pub torn_at: Option<usize>,
    /// Whether each pixel looked at is an unexplained outlier; the same pixels for all pairs, `None` where not judged.
    marks: Vec<Option<bool>>,
}

impl Look {
    /// Whether the frames differ in brightness from the others, and by nothing else.
    pub fn is_brightness(&self) -> bool {
        self.unexplained <= 0.1 * self.outliers
            && self.change.iter().all(|change| change.abs() < LARGEST_CHANGE)
    }

    /// Share of this pair's outliers that are outliers of `other` as well, among the pixels judged in both. Where
    /// something moved the same pixels fail in all pairs; where frames show other patterns, other pixels fail in each.
    pub fn overlap(&self, other: &Self) -> Option<f64> {
        let (mut both, mut either) = (0, [0u64; 2]);
        for (one, two) in self.marks.iter().zip(&other.marks) {
            if let (Some(one), Some(two)) = (one, two) {
                both += u64::from(*one && *two);
                either[0] += u64::from(*one);
                either[1] += u64::from(*two);
            }
        }
        statistics::share(both, either[0].min(either[1]))
    }
}

impl<'a> Frames<'a> {
    fn of(&self, wanted: Role) -> Vec<Plane<'a>> {
        self.all.iter().filter(|(role, _)| *role == wanted).map(|(_, plane)| *plane).collect()
    }

    /// Bright and dark references, where there are both.
    fn references(&self) -> Option<[Vec<Plane<'a>>; 2]> {
        let (bright, dark) = match self.settings.mode.is_polarized() {
            true => (Role::ReferenceH, Role::ReferenceV),
            false => (Role::White, Role::Black),
        };
        let found = [self.of(bright), self.of(dark)];
        found.iter().all(|planes| !planes.is_empty()).then_some(found)
    }

    /// Both frames of all pairs.
    fn pairs(&self) -> Vec<[Plane<'a>; 2]> {
        let pair = |(role, plane): &(Role, Plane<'a>)| match *role {
            Role::Code { axis, bit, inverse: false } => {
                Some([*plane, *self.of(Role::Code { axis, bit, inverse: true }).first()?])
            }
            _ => None,
        };
        self.all.iter().filter_map(pair).collect()
    }

    /// Looks at one pair. `flat_only`: away from stripe edges, which a response that is not linear spoils. `None` where
    /// a frame is missing, or there is nothing to compare it with.
    pub fn look(&self, axis: Axis, bit: u8, flat_only: bool) -> Option<Look> {
        let frame = |inverse| self.of(Role::Code { axis, bit, inverse }).first().copied();
        let pair = [frame(false)?, frame(true)?];
        let expected = match self.references() {
            Some(references) => Expected::References(references),
            None => Expected::Pairs(self.pairs()),
        };
        if matches!(&expected, Expected::Pairs(pairs) if pairs.len() < LEAST_PAIRS) {
            return None;
        }
        Some(Sampler { frames: self, pair, expected, flat_only }.look(axis == Axis::Row))
    }

    /// Last less first modulation as a share of the modulation, median over the lit pixels.
    pub fn modulation_drift(&self) -> Option<f64> {
        let [bright, dark] = self.references()?;
        let ([first, .., last], [first_dark, .., last_dark]) = (&bright[..], &dark[..]) else { return None };
        let step = self.decoded.class.len().div_ceil(PIXELS).max(1);
        let mut shares: Vec<f64> = (0..self.decoded.class.len())
            .step_by(step)
            .filter(|&at| usable(self.decoded.class.data()[at]))
            .map(|at| {
                let before = sample(*first, at) - sample(*first_dark, at);
                let after = sample(*last, at) - sample(*last_dark, at);
                (after - before) / (0.5 * (after + before)).abs()
            })
            .filter(|share| share.is_finite())
            .collect();
        statistics::median(&mut shares)
    }
}

fn usable(class: Class) -> bool {
    class.is_lit() && class != Class::Saturated
}

fn sample(plane: Plane<'_>, at: usize) -> f64 {
    match plane {
        Plane::U8(samples) => f64::from(samples[at]),
        Plane::U16(samples) => f64::from(samples[at]),
    }
}

/// One pixel of a pair.
#[derive(Clone, Copy)]
struct Pixel {
    /// Above black, in DN.
    p: f64,
    q: f64,
    /// P + Q less the references, in DN.
    residual: f64,
    /// Its standard deviation.
    sigma: f64,
    modulation: f64,
}

impl Pixel {
    /// Which frame is the bright one, where one is.
    fn bright(&self) -> Option<usize> {
        let apart = (self.p - self.q) / self.sigma;
        (apart.abs() > BRIGHT_SIGMA).then_some(usize::from(apart < 0.0))
    }

    fn left(&self, change: [f64; 2]) -> f64 {
        self.residual - change[0] * self.p - change[1] * self.q
    }

    fn is_outlier(&self, change: [f64; 2]) -> bool {
        self.left(change).abs() > OUTLIER_SIGMA * self.sigma
    }
}

/// What a pair sum is compared with.
enum Expected<'a> {
    /// The sum of the means of both references.
    References([Vec<Plane<'a>>; 2]),
    /// The median of all pair sums, which a few bad pairs do not move.
    Pairs(Vec<[Plane<'a>; 2]>),
}

struct Sampler<'a, 'b> {
    frames: &'b Frames<'a>,
    pair: [Plane<'a>; 2],
    expected: Expected<'a>,
    flat_only: bool,
}

impl Sampler<'_, '_> {
    fn look(&self, striped: bool) -> Look {
        let class = &self.frames.decoded.class;
        let stride = (class.len() as f64 / PIXELS as f64).sqrt().ceil().max(1.0) as usize;
        let rows: Vec<usize> = (0..class.height()).step_by(stride).collect();
        let columns: Vec<usize> = (0..class.width()).step_by(stride).collect();
        let pixels: Vec<Option<Pixel>> = rows
            .iter()
            .flat_map(|&y| columns.iter().map(move |&x| (x, y)))
            .map(|(x, y)| self.pixel(x, y))
            .collect();
        let change = [0, 1].map(|which| change(&pixels, which));
        let marks: Vec<Option<bool>> =
            pixels.iter().map(|pixel| pixel.map(|pixel| pixel.is_outlier(change))).collect();
        let count =
            |of: &dyn Fn(&Pixel) -> bool| pixels.iter().flatten().filter(|pixel| of(pixel)).count() as u64;
        let total = count(&|_| true);
        let share = |of: &dyn Fn(&Pixel) -> bool| statistics::share(count(of), total).unwrap_or(0.0);
        let mut strengths: Vec<f64> = pixels
            .iter()
            .flatten()
            .filter(|pixel| pixel.is_outlier(change))
            .filter_map(|pixel| statistics::finite((pixel.left(change) / pixel.modulation).abs()))
            .collect();
        let by_row: Vec<[u32; 2]> = marks
            .chunks(columns.len().max(1))
            .map(|row| {
                [row.iter().flatten().count() as u32, row.iter().flatten().filter(|bad| **bad).count() as u32]
            })
            .collect();
        Look {
            outliers: share(&|pixel| pixel.is_outlier([0.0; 2])),
            unexplained: share(&|pixel| pixel.is_outlier(change)),
            change,
            strength: statistics::median(&mut strengths),
            torn_at: tear(&by_row, striped).map(|row| rows[row]),
            marks,
        }
    }

    fn pixel(&self, x: usize, y: usize) -> Option<Pixel> {
        let (decoded, settings) = (self.frames.decoded, self.frames.settings);
        let (width, height) = (decoded.class.width(), decoded.class.height());
        let at = y * width + x;
        if !usable(decoded.class.data()[at]) || (self.flat_only && !self.is_flat(x, y, width, height)) {
            return None;
        }
        let saturation = f64::from(settings.camera.saturation_dn);
        let level = |plane: Plane<'_>| {
            Some(sample(plane, at)).filter(|&dn| dn < saturation).map(|dn| dn - decoded.black_level_dn)
        };
        let (p, q) = (level(self.pair[0])?, level(self.pair[1])?);
        let mut variance = decoded.noise.variance(p) + decoded.noise.variance(q);
        let expected = match &self.expected {
            Expected::References(references) => {
                let mut sum = 0.0;
                for planes in references {
                    let count = planes.len() as f64;
                    let mean = planes.iter().map(|plane| level(*plane)).sum::<Option<f64>>()? / count;
                    variance += decoded.noise.variance(mean) / count;
                    sum += mean;
                }
                sum
            }
            Expected::Pairs(pairs) => {
                let sums = pairs.iter().map(|[p, q]| Some(level(*p)? + level(*q)?));
                let mut sums: Vec<f64> = sums.collect::<Option<_>>()?;
                variance *= 1.0 + MEDIAN_VARIANCE / sums.len() as f64;
                statistics::median(&mut sums)?
            }
        };
        let modulation = f64::from(decoded.modulation.data()[at]);
        Some(Pixel { p, q, residual: p + q - expected, sigma: variance.sqrt(), modulation })
    }

    /// Whether P and Q are in the same order all around.
    fn is_flat(&self, x: usize, y: usize, width: usize, height: usize) -> bool {
        let order =
            |x: usize, y: usize| sample(self.pair[0], y * width + x) > sample(self.pair[1], y * width + x);
        let here = order(x, y);
        order(x.saturating_sub(NEAR_EDGE), y) == here
            && order((x + NEAR_EDGE).min(width - 1), y) == here
            && order(x, y.saturating_sub(NEAR_EDGE)) == here
            && order(x, (y + NEAR_EDGE).min(height - 1)) == here
    }
}

/// Change of brightness of frame `which` where it is the bright one.
fn change(pixels: &[Option<Pixel>], which: usize) -> f64 {
    let mut changes: Vec<f64> = pixels
        .iter()
        .flatten()
        .filter(|pixel| pixel.bright() == Some(which))
        .map(|pixel| pixel.residual / if which == 0 { pixel.p } else { pixel.q })
        .collect();
    statistics::median(&mut changes).and_then(statistics::finite).unwrap_or(0.0)
}

/// The row that parts a bad side from a sound one. `rows`: pixels looked at and outliers of each. `striped`: the pair
/// codes rows, so that another pattern differs on whole bands of rows.
fn tear(rows: &[[u32; 2]], striped: bool) -> Option<usize> {
    let usable: Vec<(usize, f64)> = rows
        .iter()
        .enumerate()
        .filter(|(_, [seen, _])| *seen >= ROW_PIXELS)
        .map(|(y, [seen, bad])| (y, f64::from(*bad) / f64::from(*seen)))
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

    #[test]
    fn a_tear_is_found_where_it_is() {
        let torn: Vec<[u32; 2]> = (0..48).map(|y| [60, if y < 30 { 33 } else { 0 }]).collect();
        assert_eq!(tear(&torn, false), Some(30));
        let below: Vec<[u32; 2]> = (0..48).map(|y| [60, if y < 20 { 1 } else { 30 }]).collect();
        assert_eq!(tear(&below, false), Some(20));
    }

    #[test]
    fn a_tear_of_rows_is_found_in_bands() {
        let bands: Vec<[u32; 2]> =
            (0..48).map(|y| [60, if y >= 24 && y / 4 % 2 == 0 { 60 } else { 0 }]).collect();
        assert_eq!(tear(&bands, true), Some(24));
        assert_eq!(tear(&bands, false), None);
    }

    #[test]
    fn a_blob_a_whole_frame_and_a_sound_one_are_no_tear() {
        let blob: Vec<[u32; 2]> = (0..48).map(|y| [60, if (10..30).contains(&y) { 30 } else { 0 }]).collect();
        assert_eq!(tear(&blob, false), None);
        assert_eq!(tear(&[[60, 30]; 48], false), None);
        assert_eq!(tear(&[[60, 0]; 48], false), None);
        // Rows with hardly a pixel say nothing.
        assert_eq!(tear(&(0..48).map(|y| [5, if y < 24 { 5 } else { 0 }]).collect::<Vec<_>>(), false), None);
        assert_eq!(tear(&[], false), None);
    }
}
