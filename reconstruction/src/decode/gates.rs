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

#[cfg(test)]
pub(crate) mod plain;
mod steps;

use polscan_patterns::Axis;
use rayon::prelude::*;

use self::steps::{Crossings, RowSteps, StepCounts};
use super::{
    plan::Frames,
    types::{Class, Thresholds},
    words::{BLOCK, PixelMaps, WEAK_SCALE, WEAK_UNKNOWN},
};
use crate::simd::{InstructionSet, Work};

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
    /// Per block of each row: whether a pixel of it may lie beside a crossing that is longer than a step.
    jumps: Vec<bool>,
}

/// Runs all gates and returns the crossings of each bit and the shape of each axis.
pub(crate) fn apply<T: Sync>(
    frames: &Frames<'_, T>,
    maps: &mut PixelMaps,
    thresholds: &Thresholds,
    set: InstructionSet,
) -> (Vec<BoundaryCheck>, Vec<AxisShape>) {
    let size = [frames.width, frames.height];
    let mut checks = Vec::new();
    let mut views = Vec::new();
    for (index, axis) in frames.axes.iter().enumerate() {
        let values = &maps.values[index][..];
        let snap = (2.0 * thresholds.snap_px / f64::from(1u32 << axis.code.shift)).floor() as i32;
        let shape = axis_shape(values, size, snap, set);
        let (crossings, jumps) = count_crossings(values, size, shape, axis.code.bits, set);
        let rises = crossings.iter().map(|crossing| crossing.travel).sum::<i64>() >= 0;
        let [width, height] = size;
        let mut view = AxisView { values, width, height, shape, suspect: 0, jumps };
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
    let mut gated = maps.class.clone();
    gated.par_chunks_mut(frames.width).enumerate().for_each(|(y, class)| {
        let weakest = &maps.weakest[y * frames.width..][..frames.width];
        set.run(GateRow { class, weakest, weak_below, views: &views, y });
    });
    let before = gated.clone();
    gated.par_chunks_mut(frames.width).enumerate().for_each(|(y, class)| {
        set.run(VoteRow { class, before: &before, views: &views, y });
    });
    let shapes = views.iter().map(|view| view.shape).collect();
    maps.class = gated;
    (checks, shapes)
}

/// Direction and step of the values. Large differences (depth jumps, wrong words) are kept out by their rarity.
fn axis_shape(values: &[i32], [width, height]: [usize; 2], snap: i32, set: InstructionSet) -> AxisShape {
    let [along_x, along_y] = (0..height)
        .into_par_iter()
        .fold(
            || [StepCounts::new(), StepCounts::new()],
            |mut counts, y| {
                let row = &values[y * width..][..width];
                let next = values.get((y + 1) * width..(y + 2) * width).unwrap_or_default();
                set.run(RowSteps { row, next, counts: &mut counts });
                counts
            },
        )
        .reduce(
            || [StepCounts::new(), StepCounts::new()],
            |[x, y], [more_x, more_y]| [x + more_x, y + more_y],
        );
    let vertical = along_y.variation() > along_x.variation();
    let typical = if vertical { &along_y } else { &along_x }.typical();
    AxisShape { along_y: vertical, step: snap.max(2 * typical).max(2) }
}

/// Crossings of each bit, and the blocks that hold more than one step between neighbours.
fn count_crossings(
    values: &[i32],
    [width, height]: [usize; 2],
    shape: AxisShape,
    bits: u8,
    set: InstructionSet,
) -> (Vec<Crossings>, Vec<bool>) {
    let blocks = width.div_ceil(BLOCK);
    let zero = || vec![Crossings::default(); usize::from(bits)];
    let mut across = vec![false; blocks * height];
    let mut down = vec![false; blocks * height];
    let crossings = across
        .par_chunks_mut(blocks)
        .zip(down.par_chunks_mut(blocks))
        .enumerate()
        .fold(zero, |mut counts, (y, (across, down))| {
            let row = &values[y * width..][..width];
            let next = values.get((y + 1) * width..(y + 2) * width).unwrap_or_default();
            set.run(steps::RowCrossings { row, next, shape, counts: &mut counts, across, down });
            counts
        })
        .reduce(zero, |mut sum, more| {
            sum.iter_mut().zip(more).for_each(|(sum, more)| sum.add(more));
            sum
        });
    // A crossing lies between a pixel and the next one, of the same block, the next block or the row below.
    let jumps = (0..blocks * height)
        .map(|at| {
            let before = at % blocks > 0 && across[at - 1];
            across[at] || before || down[at] || (at >= blocks && down[at - blocks])
        })
        .collect();
    (crossings, jumps)
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

pub(crate) fn gray(value: i32) -> u32 {
    (value ^ (value >> 1)) as u32
}

/// Legal boundaries and interreflection of one row.
struct GateRow<'a> {
    class: &'a mut [Class],
    weakest: &'a [u8],
    weak_below: f32,
    views: &'a [AxisView<'a>],
    y: usize,
}

impl Work for GateRow<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { class, weakest, weak_below, views, y } = self;
        // Boundaries go first, and a pixel that they reject is not looked at again.
        let blocks = class.len().div_ceil(BLOCK);
        for (block, class) in class.chunks_mut(BLOCK).enumerate() {
            if views.iter().any(|view| view.jumps[y * blocks + block]) {
                for (x, class) in class.iter_mut().enumerate().filter(|(_, class)| class.is_valid()) {
                    if views.iter().any(|view| view.is_off_boundary(block * BLOCK + x, y)) {
                        *class = Class::OffBoundary;
                    }
                }
            }
        }
        for (class, &weakest) in class.iter_mut().zip(weakest) {
            let weak = (weakest != WEAK_UNKNOWN) & (f32::from(weakest) < weak_below);
            *class = if weak & class.is_valid() { Class::Interreflection } else { *class };
        }
    }
}

/// The vote of one row.
struct VoteRow<'a> {
    class: &'a mut [Class],
    before: &'a [Class],
    views: &'a [AxisView<'a>],
    y: usize,
}

impl Work for VoteRow<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { class, before, views, y } = self;
        let width = class.len();
        let at = y * width;
        // Whether a pixel and the next one are valid and agree: both neighbours along the row are support enough.
        let mut agrees = [0u8; BLOCK + 1];
        for start in (0..width).step_by(BLOCK) {
            let end = (start + BLOCK).min(width);
            // From the pixel before the block to the last of it; those at the rim of the image lack a neighbour.
            let first = start.max(1) - 1;
            let pairs = end.min(width - 1) - first;
            let offset = first + 1 - start;
            agrees.fill(0);
            steps::both_valid(&before[at + first..][..pairs + 1], &mut agrees[offset..offset + pairs]);
            for view in views {
                let values = &view.values[at + first..][..pairs + 1];
                steps::within(values, view.shape.step.max(2), &mut agrees[offset..offset + pairs]);
            }
            let class = &mut class[start..end];
            if !steps::any_alone(class, &agrees[..class.len() + 1]) {
                continue;
            }
            for (x, class) in class.iter_mut().enumerate().filter(|(_, class)| class.is_valid()) {
                if agrees[x] & agrees[x + 1] == 0 && is_outvoted(before, views, start + x, y) {
                    *class = Class::Vote;
                }
            }
        }
    }
}

impl AxisView<'_> {
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
