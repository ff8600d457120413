//! Steps of the values between neighbouring pixels, counted a block at a time: nearly all are small, and those are
//! counted in vector registers; what is rare is looked at one by one.

use super::{AxisShape, gray};
use crate::{
    decode::{types::Class, words::BLOCK},
    simd::Work,
};

/// Steps from here on are counted together.
const CAP: usize = 64;
/// Steps below this are counted in vector registers.
const SMALL: usize = 4;

/// How often each step occurs.
#[derive(Debug, Clone)]
pub(super) struct StepCounts([u64; CAP + 1]);

impl StepCounts {
    pub fn new() -> Self {
        Self([0; CAP + 1])
    }

    /// Mean of the smaller 95 %.
    pub fn variation(&self) -> f64 {
        let total: u64 = self.0.iter().sum();
        let mut left = total - total / 20;
        let mut sum = 0;
        for (size, &count) in self.0.iter().enumerate() {
            let taken = count.min(left);
            sum += taken * size as u64;
            left -= taken;
        }
        sum as f64 / total.max(1) as f64
    }

    /// The least step that nine of ten do not exceed.
    pub fn typical(&self) -> i32 {
        let total: u64 = self.0.iter().sum();
        let mut below = 0;
        let found = self.0.iter().position(|&count| {
            below += count;
            below * 10 >= total * 9
        });
        found.unwrap_or(0) as i32
    }

    #[inline(always)]
    fn add(&mut self, here: &[i32], there: &[i32]) {
        for (here, there) in here.chunks(BLOCK).zip(there.chunks(BLOCK)) {
            let (small, known) = small_steps(here, there);
            for (sum, count) in self.0.iter_mut().zip(small) {
                *sum += u64::from(count);
            }
            if small.iter().sum::<u32>() == known {
                continue;
            }
            for (&here, &there) in here.iter().zip(there) {
                let step = here.abs_diff(there) as usize;
                if here >= 0 && there >= 0 && step >= SMALL {
                    self.0[step.min(CAP)] += 1;
                }
            }
        }
    }
}

impl std::ops::Add for StepCounts {
    type Output = Self;

    fn add(mut self, other: Self) -> Self {
        self.0.iter_mut().zip(other.0).for_each(|(sum, more)| *sum += more);
        self
    }
}

/// Numbers of steps of 0, 1, ..., and of all steps between values.
#[inline(always)]
fn small_steps(here: &[i32], there: &[i32]) -> ([u32; SMALL], u32) {
    let (mut counts, mut known) = ([0u32; SMALL], 0u32);
    for (&here, &there) in here.iter().zip(there) {
        let both = (here | there) >= 0;
        let step = here.abs_diff(there);
        known += u32::from(both);
        for (size, count) in counts.iter_mut().enumerate() {
            *count += u32::from(both & (step == size as u32));
        }
    }
    (counts, known)
}

/// Steps of one row along it and to the next one, which is empty below the last.
pub(super) struct RowSteps<'a> {
    pub row: &'a [i32],
    pub next: &'a [i32],
    pub counts: &'a mut [StepCounts; 2],
}

impl Work for RowSteps<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        self.counts[0].add(self.row, self.row.get(1..).unwrap_or_default());
        self.counts[1].add(self.row, self.next);
    }
}

/// Crossings of one bit.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Crossings {
    pub legal: u64,
    pub illegal: u64,
    pub rising: u64,
    pub falling: u64,
    /// Sum of the steps of legal crossings along the axis' direction.
    pub travel: i64,
}

impl Crossings {
    pub fn add(&mut self, other: Self) {
        self.legal += other.legal;
        self.illegal += other.illegal;
        self.rising += other.rising;
        self.falling += other.falling;
        self.travel += other.travel;
    }
}

/// Crossings of one row along it and to the next one, which is empty below the last.
pub(super) struct RowCrossings<'a> {
    pub row: &'a [i32],
    pub next: &'a [i32],
    pub shape: AxisShape,
    /// By bit, the most significant first.
    pub counts: &'a mut [Crossings],
    /// Blocks with more than a step between a pixel and the next one of its row, and of the next row.
    pub across: &'a mut [bool],
    pub down: &'a mut [bool],
}

impl Work for RowCrossings<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { row, next, shape, counts, across, down } = self;
        let beside = row.get(1..).unwrap_or_default();
        for ((here, there), jump) in row.chunks(BLOCK).zip(beside.chunks(BLOCK)).zip(across) {
            *jump = count_block(here, there, shape.step, !shape.along_y, counts);
        }
        for ((here, there), jump) in row.chunks(BLOCK).zip(next.chunks(BLOCK)).zip(down) {
            *jump = count_block(here, there, shape.step, shape.along_y, counts);
        }
    }
}

/// Counts the crossings of one block and tells whether one of them is longer than a step.
#[inline(always)]
fn count_block(here: &[i32], there: &[i32], step: i32, along: bool, counts: &mut [Crossings]) -> bool {
    let len = here.len().min(there.len());
    let (here, there) = (&here[..len], &there[..len]);
    let (mut legal, mut rising) = ([0u16; BLOCK], [0u16; BLOCK]);
    let (seen, travel, jump) = legal_bits(here, there, step, &mut legal[..len], &mut rising[..len]);
    let last = counts.len().saturating_sub(1);
    for (bit, count) in counts.iter_mut().enumerate() {
        let place = (last - bit) as u32;
        if (seen >> place) & 1 == 0 {
            continue;
        }
        let crossings = u64::from(count_place(&legal[..len], place));
        count.legal += crossings;
        if along {
            let up = u64::from(count_place(&rising[..len], place));
            count.rising += up;
            count.falling += crossings - up;
        }
    }
    // Which bit the travel belongs to does not matter: only its sum over all bits is looked at.
    if let (true, Some(first)) = (along, counts.first_mut()) {
        first.travel += travel;
    }
    if jump {
        count_illegal(here, there, step, counts);
    }
    jump
}

/// Bits that change at crossings of at most a step, and those of them where the value rises. Returns the bits that
/// occur, the sum of the steps, each as often as it changes bits, and whether there are longer steps.
#[inline(always)]
fn legal_bits(
    here: &[i32],
    there: &[i32],
    step: i32,
    legal: &mut [u16],
    rising: &mut [u16],
) -> (u16, i64, bool) {
    let len = here.len();
    let (there, legal, rising) = (&there[..len], &mut legal[..len], &mut rising[..len]);
    let (mut seen, mut travel, mut jump) = (0u16, 0i32, false);
    for x in 0..len {
        let (from, to) = (here[x], there[x]);
        let both = (from | to) >= 0;
        let within = (to - from).abs() <= step;
        let changed = if both & within { (gray(from) ^ gray(to)) as u16 } else { 0 };
        legal[x] = changed;
        rising[x] = if to > from { changed } else { 0 };
        seen |= changed;
        jump |= both & !within;
    }
    for x in 0..len {
        travel += (there[x] - here[x]) * legal[x].count_ones() as i32;
    }
    (seen, i64::from(travel), jump)
}

#[inline(always)]
fn count_place(bits: &[u16], place: u32) -> u16 {
    // At most as many as a block has pixels.
    bits.iter().fold(0, |sum, &bits| sum + ((bits >> place) & 1))
}

/// Crossings of a single bit that are longer than a step.
fn count_illegal(here: &[i32], there: &[i32], step: i32, counts: &mut [Crossings]) {
    for (&from, &to) in here.iter().zip(there) {
        let changed = gray(from) ^ gray(to);
        if (from | to) >= 0 && (to - from).abs() > step && changed.count_ones() == 1 {
            counts[counts.len() - 1 - changed.trailing_zeros() as usize].illegal += 1;
        }
    }
}

/// 1 where a pixel and the next one carry a measurement.
#[inline(always)]
pub(super) fn both_valid(class: &[Class], agrees: &mut [u8]) {
    for (agrees, (here, there)) in agrees.iter_mut().zip(class.iter().zip(class.get(1..).unwrap_or_default()))
    {
        *agrees = u8::from(here.is_valid() & there.is_valid());
    }
}

/// Leaves the 1 where a value and the next one differ by at most `step`.
#[inline(always)]
pub(super) fn within(values: &[i32], step: i32, agrees: &mut [u8]) {
    let next = values.get(1..).unwrap_or_default();
    for (agrees, (here, there)) in agrees.iter_mut().zip(values.iter().zip(next)) {
        *agrees &= u8::from(here.abs_diff(*there) as i32 <= step);
    }
}

/// Whether a valid pixel lacks one of its neighbours along the row.
#[inline(always)]
pub(super) fn any_alone(class: &[Class], agrees: &[u8]) -> bool {
    let mut alone = false;
    for (class, (before, after)) in class.iter().zip(agrees.iter().zip(agrees.get(1..).unwrap_or_default())) {
        alone |= class.is_valid() & (before & after == 0);
    }
    alone
}
