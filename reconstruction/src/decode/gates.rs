//! Gates that look at a pixel's neighbourhood.
//!
//! **Legal boundaries.** Between neighbouring pixels of one surface the value changes by little, and each bit that
//! changes does so at a legal boundary. A wrong bit breaks this: where the wrong region begins exactly one bit changes
//! although its boundary is far away. At a depth discontinuity several bits change at once as a rule, but by chance it
//! may be one. What tells the two apart: a wrong bit mirrors the code, so the value runs the other way on one side,
//! whereas two surfaces that camera and projector both see always run the same way. (On one surface the order along
//! an epipolar line is the same in both views.) So a crossing is rejected where exactly one bit changes, further than
//! `snap_px` from its boundary, and the two sides run in opposite directions. A pair whose frames are exchanged or
//! belong to another pair mirrors every block alike; there no slope differs, but most crossings of a bit are illegal,
//! and then all illegal crossings of that bit are rejected.
//!
//! **Vote.** A pixel needs supporters among its eight neighbours: one is enough where hardly anybody dissents, none is
//! never enough. A line one pixel wide has two, so thin structures stay.
//!
//! **Interreflection.** The smallest |P - Q| / |C| of the coarse bits away from their own edges is 1 in theory. Below
//! a third of its median over the image, and significantly so, the light of the pattern comes from elsewhere too.

use polscan_patterns::Axis;
use rayon::prelude::*;

use super::{
    plan::Frames,
    types::{Class, Thresholds},
    words::{PixelMaps, WEAK_SCALE, WEAK_UNKNOWN},
};

/// Dissenting neighbours that outvote a single supporter: more than the four that the end of a line one pixel wide has
/// where it meets the rim of the image.
const DISSENTERS: usize = 5;
/// How far a side's direction is followed, in px.
const SLOPE_REACH: usize = 16;
/// Illegal crossings that make a bit suspect, at least.
const SUSPECT_CROSSINGS: u64 = 64;
/// Share of the median below which a coarse bit is weak.
const WEAK_SHARE: f32 = 1.0 / 3.0;

/// Zero crossings of one bit between neighbouring pixels, over the whole image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BoundaryCheck {
    /// Axis.
    pub axis: Axis,
    /// Bit.
    pub bit: u8,
    /// Crossings at a legal boundary of the bit.
    pub legal: u64,
    /// Crossings of this bit alone where it has no boundary.
    pub illegal: u64,
    /// Legal crossings along the axis' direction that run against the way in which its values run as a whole.
    pub against: u64,
}

impl BoundaryCheck {
    /// Whether the frames of this bit or of the next finer one cannot be what was projected: exchanged, or another
    /// pair's. Of the finest bit an exchange moves codes by one only, which no boundary shows; but its crossings then
    /// run against all others.
    pub fn is_suspect(&self) -> bool {
        let misplaced = self.illegal >= SUSPECT_CROSSINGS && self.illegal > self.legal;
        misplaced || (self.against >= SUSPECT_CROSSINGS && 2 * self.against > self.legal)
    }
}

/// Crossings of one bit.
#[derive(Debug, Clone, Copy, Default)]
struct Crossings {
    legal: u64,
    illegal: u64,
    rising: u64,
    falling: u64,
    /// Sum of the steps of legal crossings along the axis' direction.
    travel: i64,
}

impl Crossings {
    fn add(&mut self, other: Self) {
        self.legal += other.legal;
        self.illegal += other.illegal;
        self.rising += other.rising;
        self.falling += other.falling;
        self.travel += other.travel;
    }
}

/// How the values of one axis vary over the image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct AxisShape {
    /// Whether the value varies along y rather than along x.
    pub along_y: bool,
    /// Largest difference between neighbours of one surface.
    pub step: i32,
}

/// Neighbourhood of one axis.
struct AxisView<'a> {
    values: &'a [i32],
    width: usize,
    height: usize,
    shape: AxisShape,
    suspect: u32,
}

/// Runs all gates and returns the crossings of each bit and the shape of each axis.
pub(crate) fn apply<T: Sync>(
    frames: &Frames<'_, T>,
    maps: &mut PixelMaps,
    thresholds: &Thresholds,
) -> (Vec<BoundaryCheck>, Vec<AxisShape>) {
    let (width, height) = (frames.width, frames.height);
    let mut checks = Vec::new();
    let mut views = Vec::new();
    for (index, axis) in frames.axes.iter().enumerate() {
        let values = &maps.values[index][..];
        let snap = (2.0 * thresholds.snap_px / f64::from(1u32 << axis.code.shift)).floor() as i32;
        let shape = axis_shape(values, width, height, snap);
        let mut view = AxisView { values, width, height, shape, suspect: 0 };
        let crossings = view.count_crossings(axis.code.bits);
        let rises = crossings.iter().map(|crossing| crossing.travel).sum::<i64>() >= 0;
        for (bit, crossing) in crossings.into_iter().enumerate() {
            let Crossings { legal, illegal, rising, falling, .. } = crossing;
            let against = if rises { falling } else { rising };
            let check = BoundaryCheck { axis: axis.axis, bit: bit as u8, legal, illegal, against };
            if check.is_suspect() {
                view.suspect |= 1 << (usize::from(axis.code.bits) - 1 - bit);
            }
            checks.push(check);
        }
        views.push(view);
    }
    let weak_below = weak_threshold(&maps.weakest);
    let before = &maps.class[..];
    let mut gated = before.to_vec();
    gated.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, class) in row.iter_mut().enumerate() {
            if !class.is_valid() {
                continue;
            }
            let weakest = maps.weakest[y * width + x];
            if views.iter().any(|view| view.is_off_boundary(x, y)) {
                *class = Class::OffBoundary;
            } else if weakest != WEAK_UNKNOWN && f32::from(weakest) < weak_below {
                *class = Class::Interreflection;
            }
        }
    });
    let before = gated.clone();
    gated.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, class) in row.iter_mut().enumerate() {
            if class.is_valid() && is_outvoted(&before, &views, x, y) {
                *class = Class::Vote;
            }
        }
    });
    let shapes = views.iter().map(|view| view.shape).collect();
    maps.class = gated;
    (checks, shapes)
}

/// Direction and step of the values. Large differences (depth jumps, wrong words) are kept out by their rarity.
fn axis_shape(values: &[i32], width: usize, height: usize, snap: i32) -> AxisShape {
    const CAP: usize = 64;
    let count = |offset: usize, columns: usize, rows: usize| -> Vec<u64> {
        (0..rows)
            .into_par_iter()
            .map(|y| {
                let mut counts = vec![0u64; CAP + 1];
                for at in y * width..y * width + columns {
                    let (here, there) = (values[at], values[at + offset]);
                    if here >= 0 && there >= 0 {
                        counts[(here.abs_diff(there) as usize).min(CAP)] += 1;
                    }
                }
                counts
            })
            .reduce(|| vec![0; CAP + 1], |a, b| a.iter().zip(&b).map(|(a, b)| a + b).collect())
    };
    let along_x = count(1, width.saturating_sub(1), height);
    let along_y = count(width, width, height.saturating_sub(1));
    // Mean of the smaller 95 %.
    let variation = |counts: &[u64]| {
        let total: u64 = counts.iter().sum();
        let mut left = total - total / 20;
        let mut sum = 0;
        for (size, &count) in counts.iter().enumerate() {
            let taken = count.min(left);
            sum += taken * size as u64;
            left -= taken;
        }
        sum as f64 / total.max(1) as f64
    };
    let vertical = variation(&along_y) > variation(&along_x);
    let counts = if vertical { &along_y } else { &along_x };
    let total: u64 = counts.iter().sum();
    let mut below = 0;
    let mut typical = 0;
    for (size, &count) in counts.iter().enumerate() {
        below += count;
        if below * 10 >= total * 9 {
            typical = size as i32;
            break;
        }
    }
    AxisShape { along_y: vertical, step: snap.max(2 * typical).max(2) }
}

/// Level below which the stored weakness is suspicious: a share of the median.
fn weak_threshold(weakest: &[u8]) -> f32 {
    let mut counts = [0u64; 256];
    for &value in weakest {
        counts[usize::from(value)] += 1;
    }
    let total: u64 = counts[..usize::from(WEAK_UNKNOWN)].iter().sum();
    let mut below = 0;
    let median = counts.iter().position(|&count| {
        below += count;
        2 * below >= total
    });
    let median = if total == 0 { WEAK_SCALE } else { median.unwrap_or(0) as f32 };
    WEAK_SHARE * median
}

fn gray(value: i32) -> u32 {
    (value ^ (value >> 1)) as u32
}

impl AxisView<'_> {
    /// Crossings of each bit.
    fn count_crossings(&self, bits: u8) -> Vec<Crossings> {
        let bits = usize::from(bits);
        let zero = || vec![Crossings::default(); bits];
        (0..self.height)
            .into_par_iter()
            .map(|y| {
                let mut counts = zero();
                let row = &self.values[y * self.width..][..self.width];
                row.windows(2).for_each(|two| self.count(two[0], two[1], !self.shape.along_y, &mut counts));
                if y + 1 < self.height {
                    let next = &self.values[(y + 1) * self.width..][..self.width];
                    let down = row.iter().zip(next);
                    down.for_each(|(&here, &there)| self.count(here, there, self.shape.along_y, &mut counts));
                }
                counts
            })
            .reduce(zero, |mut sum, more| {
                sum.iter_mut().zip(more).for_each(|(sum, more)| sum.add(more));
                sum
            })
    }

    fn count(&self, here: i32, there: i32, along: bool, counts: &mut [Crossings]) {
        if here < 0 || there < 0 || here == there {
            return;
        }
        let mut changed = gray(here) ^ gray(there);
        let legal = here.abs_diff(there) as i32 <= self.shape.step;
        if !legal && changed.count_ones() > 1 {
            return;
        }
        while changed != 0 {
            let entry = &mut counts[counts.len() - 1 - changed.trailing_zeros() as usize];
            entry.add(Crossings {
                legal: u64::from(legal),
                illegal: u64::from(!legal),
                rising: u64::from(legal && along && there > here),
                falling: u64::from(legal && along && there < here),
                travel: if legal && along { i64::from(there - here) } else { 0 },
            });
            changed &= changed - 1;
        }
    }

    /// Whether a crossing between this valid pixel and one of its four neighbours is where no boundary can be.
    fn is_off_boundary(&self, x: usize, y: usize) -> bool {
        let at = y * self.width + x;
        let here = self.values[at];
        let illegal = |exists: bool, step: isize| {
            exists && {
                let other = at.wrapping_add_signed(step);
                let there = self.values[other];
                there >= 0 && here.abs_diff(there) as i32 > self.shape.step && self.is_illegal(at, other)
            }
        };
        illegal(x > 0, -1)
            || illegal(x + 1 < self.width, 1)
            || illegal(y > 0, -(self.width as isize))
            || illegal(y + 1 < self.height, self.width as isize)
    }

    fn is_illegal(&self, one: usize, other: usize) -> bool {
        let changed = gray(self.values[one]) ^ gray(self.values[other]);
        if changed.count_ones() != 1 {
            return false;
        }
        changed & self.suspect != 0
            || match (self.direction(one), self.direction(other)) {
                (Some(one), Some(other)) => one != other,
                _ => false,
            }
    }

    /// Whether the value rises along its direction around a pixel, on its surface; `None` where that is not seen.
    fn direction(&self, at: usize) -> Option<bool> {
        let (position, len, stride) = if self.shape.along_y {
            (at / self.width, self.height, self.width)
        } else {
            (at % self.width, self.width, 1)
        };
        let (mut first, mut last) = (self.values[at], self.values[at]);
        for step in 1..=SLOPE_REACH.min(position) {
            let value = self.values[at - step * stride];
            if value < 0 || value.abs_diff(first) as i32 > self.shape.step {
                break;
            }
            first = value;
        }
        for step in 1..=SLOPE_REACH.min(len - 1 - position) {
            let value = self.values[at + step * stride];
            if value < 0 || value.abs_diff(last) as i32 > self.shape.step {
                break;
            }
            last = value;
        }
        (first.abs_diff(last) >= 2).then_some(last > first)
    }
}

/// Whether too few of the eight neighbours support a pixel: none, or one against many that dissent.
fn is_outvoted(class: &[Class], views: &[AxisView<'_>], x: usize, y: usize) -> bool {
    let Some(view) = views.first() else { return false };
    let (width, height) = (view.width, view.height);
    let at = y * width + x;
    let (mut supporters, mut dissenters) = (0, 0);
    for other_y in y.saturating_sub(1)..(y + 2).min(height) {
        for other_x in x.saturating_sub(1)..(x + 2).min(width) {
            let other = other_y * width + other_x;
            if other == at || !class[other].is_valid() {
                continue;
            }
            let agrees = views
                .iter()
                .all(|view| view.values[at].abs_diff(view.values[other]) as i32 <= view.shape.step.max(2));
            if agrees {
                supporters += 1;
                if supporters == 2 {
                    return false;
                }
            } else {
                dissenters += 1;
            }
        }
    }
    supporters == 0 || (supporters == 1 && dissenters >= DISSENTERS)
}
