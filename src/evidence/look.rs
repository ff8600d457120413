//! A closer look at a pair whose sum fails: where, by how much of the light, and whether a change of brightness
//! explains it. Done only for pairs that fail, on a few hundred thousand pixels.
//!
//! The file is long because all looks share one sampling of the frames.

use polscan_patterns::{Axis, Role};

use crate::{
    decode::{Class, DecodeSettings, Decoded, NoiseModel, Plane},
    grid::Grid,
    report::statistics,
};

/// No more pixels than this are looked at.
const PIXELS: usize = 300_000;
/// Beyond this many sigma a pixel is an outlier, as in the statistics of the decode.
const OUTLIER_SIGMA: f64 = 5.0;
/// A pixel this near to a stripe edge is not flat. Three sigma of the blur of a usual chain of projector and camera: a
/// response that is not linear spoils the pair sum as far as that.
const NEAR_EDGE: usize = 6;
/// Steps in which the way to `NEAR_EDGE` is looked at, short of the stripes.
const EDGE_STEP: usize = 2;
/// How many sigma apart P and Q must be to tell the bright frame.
const BRIGHT_SIGMA: f64 = 8.0;
/// A larger change of one frame's brightness is another picture. As a share of the frame, so that half the light is -1 and
/// twice the light 1/2.
const LARGEST_CHANGE: [f64; 2] = [-1.0, 0.5];
/// Spread up to which what a change of brightness leaves is noise: 1 by its definition, more where noise is estimated.
const EXPLAINED_SIGMA: f64 = 1.5;
/// Where the modulation is less than this many sigma, another picture might not show.
const ABLE_SIGMA: f64 = 8.0;
/// Noise from pixel to pixel beyond this, in units of the noise assumed, shows that that is too small; and no more than
/// the second is believed to be noise.
const NOISY: f64 = 1.2;
const NOISIEST: f64 = 6.0;
/// Median difference of two frames of one picture, in sigma, at most: 0.67 by noise alone.
const ALIKE_SIGMA: f64 = 2.0;
/// About so many neighbours measure the noise.
const NOISE_PAIRS: usize = 20_000;
/// Fewer pixels than this show nothing.
const LEAST_PIXELS: usize = 200;
/// Without references, so many pairs are needed to tell a bad one from the others.
const LEAST_PAIRS: usize = 4;
/// Variance of the median of normal samples over that of their mean: pi / 2.
const MEDIAN_VARIANCE: f64 = std::f64::consts::FRAC_PI_2;
/// A torn frame is bad on this share of the pixels of one side of the tear (another pattern differs on half of them, and
/// half-way to its edges not by much)...
const TORN_SIDE: f64 = 0.15;
/// ...where a row of the image is bad with this share of its pixels...
const TORN_ROW: f64 = 0.08;
/// ...and this share of the rows is bad: what moves seldom reaches from a side of the image to the tear...
const TORN_ROWS_BAD: f64 = 0.8;
/// ...sound on all but this share of the other side...
const SOUND_SIDE: f64 = 0.02;
/// ...and each side has this share of the rows: a strip that is free of stripes, or of things, at one end is no tear.
const TORN_ROWS: f64 = 0.15;
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
    /// Whether the last references can be relied on as well as the first.
    pub last_references: bool,
    /// Whether the camera adjusted its exposure to the pictures: then frames may differ by any factor.
    pub adjusts: bool,
    /// Share of the frame before that each frame was found to have.
    pub rest: Option<f64>,
}

/// What a closer look at one pair shows.
#[derive(Debug, Clone, PartialEq)]
pub struct Look {
    /// Share of the pixels looked at that are outliers.
    pub outliers: f64,
    /// The same after the change of brightness that explains most.
    pub unexplained: f64,
    /// Spread of what that change leaves, in units of the noise.
    pub spread: f64,
    /// Noise from one pixel to the next, in units of the noise assumed: 1 where the camera's noise is known. Outliers are
    /// counted in units of the larger of the two.
    pub noise: f64,
    /// Whether light was added, rather than the projector's changed.
    pub is_offset: bool,
    /// Change of the projector's light in P and in Q.
    pub gains: [f64; 2],
    /// The change, as a share of the light of a bright pixel.
    pub change: f64,
    /// Median over the outliers of the residual as a share of the modulation: 1 for another picture.
    pub strength: Option<f64>,
    /// Robust spread of the same, as a share of it.
    pub strength_spread: Option<f64>,
    /// Share of the outliers that have the more common sign.
    pub one_sided: f64,
    /// First image row below a tear.
    pub torn_at: Option<usize>,
    /// Whether a change of any size may be one of brightness.
    any_change: bool,
    /// Whether each pixel looked at is an unexplained outlier; the same pixels for all pairs, `None` where not judged.
    marks: Vec<Option<bool>>,
}

impl Look {
    /// Share of the pixels that a change of brightness, if it is no absurd one, does not explain.
    pub fn disturbed(&self) -> f64 {
        if self.is_sensible() { self.unexplained } else { self.outliers }
    }

    /// Whether the frames differ in brightness from the others, and by nothing else.
    pub fn is_brightness(&self) -> bool {
        self.unexplained <= 0.1 * self.outliers
            && self.spread <= EXPLAINED_SIGMA * self.noise.max(1.0)
            && self.is_sensible()
    }

    fn is_sensible(&self) -> bool {
        self.any_change || (LARGEST_CHANGE[0]..LARGEST_CHANGE[1]).contains(&self.change)
    }

    /// How far the outliers of this pair and of `other` are the same pixels: 1 where all are, 0 where as many are as
    /// chance makes. Where something moved the same pixels fail in all pairs; where frames show other patterns, other
    /// pixels fail in each.
    pub fn same_pixels(&self, other: &Self) -> Option<f64> {
        let (mut both, mut either, mut all) = (0u64, [0u64; 2], 0u64);
        for (one, two) in self.marks.iter().zip(&other.marks) {
            if let (Some(one), Some(two)) = (one, two) {
                both += u64::from(*one && *two);
                either[0] += u64::from(*one);
                either[1] += u64::from(*two);
                all += 1;
            }
        }
        let found = statistics::share(both, either[0].min(either[1]))?;
        let chance = statistics::share(either[0].max(either[1]), all)?;
        statistics::finite((found - chance) / (1.0 - chance))
    }
}

impl<'a> Frames<'a> {
    /// Frames of which nothing is held against them yet.
    pub fn new(all: &'a [(Role, Plane<'a>)], settings: &'a DecodeSettings, decoded: &'a Decoded) -> Self {
        Self { all, settings, decoded, last_references: true, adjusts: false, rest: None }
    }

    /// Frames of a role in the order of the sequence.
    pub fn of(&self, wanted: Role) -> Vec<Plane<'a>> {
        self.all.iter().filter(|(role, _)| *role == wanted).map(|(_, plane)| *plane).collect()
    }

    /// Whether two frames show the same picture, noise apart, on the lit pixels.
    pub fn are_alike(&self, one: Plane<'a>, other: Plane<'a>) -> bool {
        let class = self.decoded.class.data();
        let black = self.decoded.black_level_dn;
        let mut apart: Vec<f64> = (0..class.len())
            .step_by((class.len() / NOISE_PAIRS).max(1))
            .filter(|&at| usable(class[at]))
            .map(|at| {
                let levels = [sample(one, at), sample(other, at)].map(|dn| dn - black);
                (levels[0] - levels[1]).abs()
                    / (2.0 * self.decoded.noise.variance(levels[0].max(levels[1]))).sqrt()
            })
            .collect();
        apart.len() >= LEAST_PIXELS && statistics::median(&mut apart).is_some_and(|apart| apart < ALIKE_SIGMA)
    }

    /// Bright and dark references that can be relied on, where there are both.
    pub fn references(&self) -> Option<[Vec<Plane<'a>>; 2]> {
        let mut found = self.all_references()?;
        if !self.last_references {
            found.iter_mut().for_each(|planes| planes.truncate(1));
        }
        Some(found)
    }

    /// Bright and dark references, where there are both.
    pub fn all_references(&self) -> Option<[Vec<Plane<'a>>; 2]> {
        let (bright, dark) = match self.settings.mode.is_polarized() {
            true => (Role::ReferenceH, Role::ReferenceV),
            false => (Role::White, Role::Black),
        };
        let found = [self.of(bright), self.of(dark)];
        found.iter().all(|planes| !planes.is_empty()).then_some(found)
    }

    /// Whether there is something to compare pair sums with besides each other.
    pub fn has_references(&self) -> bool {
        self.references().is_some()
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
        let look = self.sampler(pair, expected, flat_only).look()?;
        Some(Look { any_change: self.adjusts, ..look })
    }

    /// Residual of a pair in units of its noise, positive, at every pixel; NaN where it says nothing.
    pub fn residual_map(&self, axis: Axis, bit: u8) -> Option<Grid<f32>> {
        let frame = |inverse| self.of(Role::Code { axis, bit, inverse }).first().copied();
        let pair = [frame(false)?, frame(true)?];
        Some(self.sampler(pair, Expected::References(self.references()?), false).residual_map())
    }

    /// Looks at two frames as if they were the pair, by the first references alone. `None` without them.
    pub fn look_at(&self, pair: [Plane<'a>; 2], flat_only: bool) -> Option<Look> {
        let [bright, dark] = self.references()?;
        let first = [vec![*bright.first()?], vec![*dark.first()?]];
        self.sampler(pair, Expected::References(first), flat_only).look()
    }

    fn sampler(&self, pair: [Plane<'a>; 2], expected: Expected<'a>, flat_only: bool) -> Sampler<'a> {
        let decoded = self.decoded;
        Sampler {
            pair,
            expected,
            flat_only,
            width: decoded.class.width(),
            height: decoded.class.height(),
            saturation_dn: self.settings.camera.saturation_dn,
            black_dn: decoded.black_level_dn,
            noise: decoded.noise,
            class: Some(&decoded.class),
            modulation: Some(&decoded.modulation),
        }
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

/// Sample `at` of a plane in DN.
pub fn sample(plane: Plane<'_>, at: usize) -> f64 {
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

    /// Residual less what a change of brightness makes of it.
    fn left(&self, change: Change) -> f64 {
        match change {
            Change::Gain([p, q]) => self.residual - p * self.p - q * self.q,
            Change::Offset(offset) => self.residual - offset,
        }
    }

    /// `unit`: the noise in units of that assumed.
    fn is_outlier(&self, change: Change, unit: f64) -> bool {
        self.left(change).abs() > OUTLIER_SIGMA * unit * self.sigma
    }
}

/// A change of the light.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Change {
    /// Of the lamp or the exposure, in proportion, of P and Q.
    Gain([f64; 2]),
    /// Of other light, in DN.
    Offset(f64),
}

impl Change {
    const NONE: Self = Self::Offset(0.0);
}

/// What a pair sum is compared with.
enum Expected<'a> {
    /// The sum of the means of both references.
    References([Vec<Plane<'a>>; 2]),
    /// The median of all pair sums, which a few bad pairs do not move.
    Pairs(Vec<[Plane<'a>; 2]>),
}

/// One pair during a capture, with the references before it.
#[derive(Clone, Copy)]
pub struct Pair<'a> {
    /// The frame and its inverse.
    pub frames: [Plane<'a>; 2],
    /// Bright and dark reference.
    pub references: [Plane<'a>; 2],
    /// Frame width in pixels.
    pub width: usize,
    /// Least value of a saturated sample.
    pub saturation_dn: u16,
    /// Dark level in DN.
    pub black_dn: f64,
    /// Noise of the camera.
    pub noise: NoiseModel,
}

impl Pair<'_> {
    /// Looks at it. `None` where too little light is seen, or frames differ in size.
    pub fn look(&self, flat_only: bool) -> Option<Look> {
        self.sampler(flat_only)?.look()
    }

    /// Residual in units of its noise, positive, at every pixel; NaN where it says nothing. `None` where frames differ in size.
    pub fn residual_map(&self) -> Option<Grid<f32>> {
        Some(self.sampler(false)?.residual_map())
    }

    fn sampler(&self, flat_only: bool) -> Option<Sampler<'_>> {
        let len = self.frames[0].len();
        let same = self.frames.iter().chain(&self.references).all(|plane| plane.len() == len);
        if !same || self.width == 0 || !len.is_multiple_of(self.width) {
            return None;
        }
        Some(Sampler {
            pair: self.frames,
            expected: Expected::References(self.references.map(|plane| vec![plane])),
            flat_only,
            width: self.width,
            height: len / self.width,
            saturation_dn: self.saturation_dn,
            black_dn: self.black_dn,
            noise: self.noise,
            class: None,
            modulation: None,
        })
    }
}

struct Sampler<'a> {
    pair: [Plane<'a>; 2],
    expected: Expected<'a>,
    flat_only: bool,
    width: usize,
    height: usize,
    saturation_dn: u16,
    black_dn: f64,
    noise: NoiseModel,
    /// Classes of a decode; without one the references tell what is lit.
    class: Option<&'a Grid<Class>>,
    /// Its modulation.
    modulation: Option<&'a Grid<f32>>,
}

impl Sampler<'_> {
    fn residual_map(&self) -> Grid<f32> {
        let residuals = (0..self.width * self.height).map(|at| {
            let pixel = self.pixel(at % self.width, at / self.width);
            pixel.map_or(f32::NAN, |pixel| (pixel.residual / pixel.sigma).abs() as f32)
        });
        Grid::from_vec(self.width, self.height, residuals.collect())
    }

    fn look(&self) -> Option<Look> {
        let stride = ((self.width * self.height) as f64 / PIXELS as f64).sqrt().ceil().max(1.0) as usize;
        let rows: Vec<usize> = (0..self.height).step_by(stride).collect();
        let columns: Vec<usize> = (0..self.width).step_by(stride).collect();
        let pixels: Vec<Option<Pixel>> = rows
            .iter()
            .flat_map(|&y| columns.iter().map(move |&x| (x, y)))
            .map(|(x, y)| self.pixel(x, y))
            .collect();
        let seen: Vec<Pixel> = pixels.iter().flatten().copied().collect();
        if seen.len() < LEAST_PIXELS {
            return None;
        }
        let (change, spread) = explain(&seen)?;
        let noise = self.pixel_noise(&rows, &columns).unwrap_or(1.0);
        let unit = if noise > NOISY { noise.min(NOISIEST) } else { 1.0 };
        let marks: Vec<Option<bool>> =
            pixels.iter().map(|pixel| pixel.map(|pixel| pixel.is_outlier(change, unit))).collect();
        let share = |change: Change| {
            seen.iter().filter(|pixel| pixel.is_outlier(change, unit)).count() as f64 / seen.len() as f64
        };
        let outliers = seen.iter().filter(|pixel| pixel.is_outlier(Change::NONE, unit));
        let strengths =
            outliers.filter_map(|pixel| statistics::finite((pixel.residual / pixel.modulation).abs()));
        let mut strengths: Vec<f64> = strengths.collect();
        let brighter =
            seen.iter().filter(|pixel| pixel.is_outlier(Change::NONE, unit) && pixel.residual > 0.0).count()
                as f64;
        let count = strengths.len().max(1) as f64;
        let one_sided = brighter.max(count - brighter) / count;
        let strength = statistics::median(&mut strengths);
        let strength_spread = statistics::robust_sigma(&mut strengths)
            .zip(strength)
            .and_then(|(spread, strength)| statistics::finite(spread / strength));
        let by_row: Vec<[u32; 2]> = marks
            .chunks(columns.len().max(1))
            .map(|row| {
                let judged = row.iter().flatten();
                [judged.clone().count() as u32, judged.filter(|bad| **bad).count() as u32]
            })
            .collect();
        Some(Look {
            outliers: share(Change::NONE),
            unexplained: share(change),
            spread,
            change: match change {
                Change::Gain([p, q]) => {
                    if p.abs() > q.abs() {
                        p
                    } else {
                        q
                    }
                }
                Change::Offset(offset) => {
                    let mut bright: Vec<f64> = seen.iter().map(|pixel| pixel.p.max(pixel.q)).collect();
                    offset / statistics::median(&mut bright)?
                }
            },
            noise,
            is_offset: matches!(change, Change::Offset(_)),
            gains: match change {
                Change::Gain(gains) => gains,
                Change::Offset(_) => [0.0; 2],
            },
            strength,
            strength_spread,
            one_sided,
            torn_at: tear(&by_row).map(|row| rows[row]),
            any_change: false,
            marks,
        })
    }

    /// Noise from one pixel to the next, which no picture, motion or lamp makes, in units of the noise assumed.
    fn pixel_noise(&self, rows: &[usize], columns: &[usize]) -> Option<f64> {
        let step = (rows.len() * columns.len() / NOISE_PAIRS).max(1);
        let places = rows.iter().flat_map(|&y| columns.iter().map(move |&x| (x, y))).step_by(step);
        let mut differences: Vec<f64> = places
            .filter(|&(x, _)| x + 1 < self.width)
            .filter_map(|(x, y)| {
                let (one, next) = (self.pixel(x, y)?, self.pixel(x + 1, y)?);
                Some((one.residual - next.residual) / one.sigma.hypot(next.sigma))
            })
            .collect();
        if differences.len() < LEAST_PIXELS {
            return None;
        }
        statistics::robust_sigma(&mut differences).and_then(statistics::finite)
    }

    fn pixel(&self, x: usize, y: usize) -> Option<Pixel> {
        let (width, height) = (self.width, self.height);
        let at = y * width + x;
        if self.class.is_some_and(|class| !usable(class.data()[at])) {
            return None;
        }
        let saturation = f64::from(self.saturation_dn);
        let level = |plane: Plane<'_>| {
            Some(sample(plane, at)).filter(|&dn| dn < saturation).map(|dn| dn - self.black_dn)
        };
        let (p, q) = (level(self.pair[0])?, level(self.pair[1])?);
        let mut variance = self.noise.variance(p) + self.noise.variance(q);
        let mut modulation = self.modulation.map(|modulation| f64::from(modulation.data()[at]));
        let expected = match &self.expected {
            Expected::References(references) => {
                let mut sum = 0.0;
                if modulation.is_none() {
                    let [bright, dark] = references;
                    modulation = Some(level(*bright.first()?)? - level(*dark.first()?)?);
                }
                for planes in references {
                    let count = planes.len() as f64;
                    let mean = planes.iter().map(|plane| level(*plane)).sum::<Option<f64>>()? / count;
                    variance += self.noise.variance(mean) / count;
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
        let modulation = modulation?;
        if modulation.abs() < ABLE_SIGMA * variance.sqrt() {
            return None;
        }
        if self.flat_only
            && !self.is_flat([x, y], [width, height], (2.0 * self.noise.variance(p.max(q))).sqrt())
        {
            return None;
        }
        Some(Pixel { p, q, residual: p + q - expected, sigma: variance.sqrt(), modulation })
    }

    /// Whether P and Q are in the same order all around, or equal all around. `sigma`: noise of their difference.
    fn is_flat(&self, [x, y]: [usize; 2], [width, height]: [usize; 2], sigma: f64) -> bool {
        let order = |x: usize, y: usize| {
            let at = y * width + x;
            let apart = (sample(self.pair[0], at) - sample(self.pair[1], at)) / sigma;
            if apart.abs() > BRIGHT_SIGMA { apart.signum() } else { 0.0 }
        };
        let here = order(x, y);
        (1..=NEAR_EDGE / EDGE_STEP).map(|step| step * EDGE_STEP).all(|off| {
            order(x.saturating_sub(off), y) == here
                && order((x + off).min(width - 1), y) == here
                && order(x, y.saturating_sub(off)) == here
                && order(x, (y + off).min(height - 1)) == here
        })
    }
}

/// The change of light that leaves the least spread, and that spread in units of the noise.
fn explain(pixels: &[Pixel]) -> Option<(Change, f64)> {
    let median = |values: &mut dyn Iterator<Item = f64>| {
        statistics::median(&mut values.collect::<Vec<_>>()).and_then(statistics::finite).unwrap_or(0.0)
    };
    let gain = [0, 1].map(|which| {
        let bright = pixels.iter().filter(|pixel| pixel.bright() == Some(which));
        median(&mut bright.map(|pixel| pixel.residual / if which == 0 { pixel.p } else { pixel.q }))
    });
    let offset = median(&mut pixels.iter().map(|pixel| pixel.residual));
    let spread = |change: Change| {
        let mut left: Vec<f64> = pixels.iter().map(|pixel| pixel.left(change) / pixel.sigma).collect();
        Some((change, statistics::robust_sigma(&mut left).and_then(statistics::finite)?))
    };
    let (by_gain, by_offset) = (spread(Change::Gain(gain))?, spread(Change::Offset(offset))?);
    Some(if by_gain.1 <= by_offset.1 { by_gain } else { by_offset })
}

/// The row that parts a bad side from a sound one. `rows`: pixels looked at and outliers of each. A pair of rows that shows
/// another pattern differs on bands; a tear in such a one counts as stale.
fn tear(rows: &[[u32; 2]]) -> Option<usize> {
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
        bad as f64 >= TORN_ROWS_BAD * side.len() as f64
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
        assert_eq!(tear(&torn), Some(30));
        let below: Vec<[u32; 2]> = (0..48).map(|y| [60, if y < 20 { 1 } else { 30 }]).collect();
        assert_eq!(tear(&below), Some(20));
    }

    #[test]
    fn a_blob_bands_a_whole_frame_and_a_sound_one_are_no_tear() {
        let blob: Vec<[u32; 2]> = (0..48).map(|y| [60, if (10..30).contains(&y) { 30 } else { 0 }]).collect();
        assert_eq!(tear(&blob), None);
        let bands: Vec<[u32; 2]> =
            (0..48).map(|y| [60, if y >= 24 && y / 4 % 2 == 0 { 60 } else { 0 }]).collect();
        assert_eq!(tear(&bands), None);
        assert_eq!(tear(&[[60, 30]; 48]), None);
        assert_eq!(tear(&[[60, 0]; 48]), None);
        // Rows with hardly a pixel say nothing.
        assert_eq!(tear(&(0..48).map(|y| [5, if y < 24 { 5 } else { 0 }]).collect::<Vec<_>>()), None);
        assert_eq!(tear(&[]), None);
    }
}
