//! Inner loops over one block of one pair. They are functions of slices: that no two of them overlap is then known to
//! the compiler, which vectorises them. Samples are compared as they are, 64 of 8 bits in the widest register.

use std::ops::Range;

use super::BLOCK;
use crate::decode::{plan::BitFrames, sample::Sample};

/// Words of an axis as they grow. A word is longer than a sample of 8 bits: its upper and its lower bits grow apart.
pub(super) struct Bits<T> {
    words: [[T; BLOCK]; 2],
    soft: [[T; BLOCK]; 2],
}

impl<T: Sample> Bits<T> {
    pub fn new() -> Self {
        Self { words: [[T::default(); BLOCK]; 2], soft: [[T::default(); BLOCK]; 2] }
    }

    #[inline(always)]
    pub fn clear(&mut self, len: usize) {
        for half in self.words.iter_mut().chain(&mut self.soft) {
            half[..len].fill(T::default());
        }
    }

    /// Word and soft bits where the bit at `place` (0 = least significant) is put.
    #[inline(always)]
    pub fn place(&mut self, place: u8) -> (&mut [T; BLOCK], &mut [T; BLOCK]) {
        let half = usize::from(place >= T::BITS);
        (&mut self.words[half], &mut self.soft[half])
    }

    /// The words and the soft bits of the first pixels, as many as fit.
    #[inline(always)]
    pub fn join(&self, words: &mut [u16], soft: &mut [u16]) {
        joined(&self.words, words);
        joined(&self.soft, soft);
    }
}

#[inline(always)]
fn joined<T: Sample>([lower, upper]: &[[T; BLOCK]; 2], whole: &mut [u16]) {
    let len = whole.len();
    let (lower, upper) = (&lower[..len], &upper[..len]);
    for x in 0..len {
        whole[x] = match T::BITS {
            8 => (upper[x].bits() << 8) | lower[x].bits(),
            _ => lower[x].bits(),
        };
    }
}

/// Bit of a pair by the sign of its difference.
#[inline(always)]
pub(super) fn pair_bit<T: Sample>(
    p: &[T],
    q: &[T],
    soft_at: &[T; BLOCK],
    (word, soft): (&mut [T; BLOCK], &mut [T; BLOCK]),
    peaks: &mut Peaks<T>,
) {
    let len = p.len();
    let (q, soft_at) = (&q[..len], &soft_at[..len]);
    let (word, soft) = (&mut word[..len], &mut soft[..len]);
    let (one, both) = (&mut peaks.one[..len], &mut peaks.both[..len]);
    for x in 0..len {
        let (high, low) = (p[x].max(q[x]), p[x].min(q[x]));
        word[x] = word[x].shifted_in(p[x] > q[x]);
        soft[x] = soft[x].shifted_in(high.above(low) <= soft_at[x]);
        one[x] = one[x].max(high);
        both[x] = both[x].max(low);
    }
}

/// What tells saturation: the largest sample of any frame of the code, and the largest that both frames of a pair reach.
pub(super) struct Peaks<T> {
    pub one: [T; BLOCK],
    pub both: [T; BLOCK],
}

impl<T: Sample> Peaks<T> {
    pub fn new() -> Self {
        Self { one: [T::default(); BLOCK], both: [T::default(); BLOCK] }
    }

    #[inline(always)]
    pub fn clear(&mut self, len: usize) {
        self.one[..len].fill(T::default());
        self.both[..len].fill(T::default());
    }

    #[inline(always)]
    pub fn add(&mut self, p: &[T], q: &[T]) {
        let len = p.len();
        let (q, one, both) = (&q[..len], &mut self.one[..len], &mut self.both[..len]);
        for x in 0..len {
            one[x] = one[x].max(p[x].max(q[x]));
            both[x] = both[x].max(p[x].min(q[x]));
        }
    }

    #[inline(always)]
    pub fn add_single(&mut self, plane: &[T]) {
        let one = &mut self.one[..plane.len()];
        for (one, &sample) in one.iter_mut().zip(plane) {
            *one = (*one).max(sample);
        }
    }

    /// Whether any frame of the code is above `dn` at one of the first `len` pixels.
    #[inline(always)]
    pub fn any_above(&self, dn: i32, len: usize) -> bool {
        self.one[..len].iter().fold(T::default(), |peak, &one| peak.max(one)).dn() > dn
    }
}

/// The two smallest |P - Q| of the coarse bits (at most one of them is near its own edge), the smallest with the place
/// of its bit; of two equal ones the more significant bit comes first.
pub(super) struct Weakest<T> {
    pub least: [T; BLOCK],
    pub place: [T; BLOCK],
    pub second: [T; BLOCK],
    /// Coarse pairs so far, the same for all pixels.
    pub pairs: usize,
}

impl<T: Sample> Weakest<T> {
    pub fn new() -> Self {
        let zeros = [T::default(); BLOCK];
        Self { least: zeros, place: zeros, second: zeros, pairs: 0 }
    }

    #[inline(always)]
    pub fn clear(&mut self, len: usize) {
        self.pairs = 0;
        let most = T::nearest(i32::MAX);
        self.least[..len].fill(most);
        self.second[..len].fill(most);
        self.place[..len].fill(T::default());
    }

    #[inline(always)]
    pub fn track(&mut self, p: &[T], q: &[T], place: u8) {
        let len = p.len();
        let here = T::nearest(i32::from(place));
        let (least, second) = (&mut self.least[..len], &mut self.second[..len]);
        let (q, place) = (&q[..len], &mut self.place[..len]);
        // The first pair takes the place even where its difference is as large as can be.
        let first = self.pairs == 0;
        for x in 0..len {
            let difference = p[x].max(q[x]).above(p[x].min(q[x]));
            second[x] = second[x].min(least[x].max(difference));
            place[x] = if first || difference < least[x] { here } else { place[x] };
            least[x] = least[x].min(difference);
        }
        self.pairs += 1;
    }
}

/// Adds the squared residuals of the sums of up to two pairs, and returns how many pairs they are.
#[inline(always)]
pub(super) fn pair_sums<T: Sample>(
    bits: &[BitFrames<'_, T>],
    at: &Range<usize>,
    sums: &[f32],
    squares: &mut [f32],
) -> u16 {
    match *bits {
        [BitFrames::Pair(p, q), BitFrames::Pair(r, s)] => {
            let (p, q, r, s) = (&p[at.clone()], &q[at.clone()], &r[at.clone()], &s[at.clone()]);
            let len = p.len();
            let (q, r, s) = (&q[..len], &r[..len], &s[..len]);
            let (sums, squares) = (&sums[..len], &mut squares[..len]);
            for x in 0..len {
                let first = (p[x].dn() + q[x].dn()) as f32 - sums[x];
                let second = (r[x].dn() + s[x].dn()) as f32 - sums[x];
                squares[x] = (squares[x] + first * first) + second * second;
            }
            2
        }
        _ => {
            let mut pairs = 0;
            for frames in bits {
                if let BitFrames::Pair(p, q) = *frames {
                    let (p, q) = (&p[at.clone()], &q[at.clone()]);
                    let len = p.len();
                    let (q, sums, squares) = (&q[..len], &sums[..len], &mut squares[..len]);
                    for x in 0..len {
                        let residual = (p[x].dn() + q[x].dn()) as f32 - sums[x];
                        squares[x] += residual * residual;
                    }
                    pairs += 1;
                }
            }
            pairs
        }
    }
}

/// Adds the squared residual of a pair's sum where no frame of the pair is saturated, and counts the pair there.
#[inline(always)]
pub(super) fn pair_sum_unsaturated<T: Sample>(
    p: &[T],
    q: &[T],
    full: i32,
    sums: &[f32],
    squares: &mut [f32],
    pairs: &mut [u16; BLOCK],
) {
    let len = p.len();
    let (q, sums) = (&q[..len], &sums[..len]);
    let (squares, pairs) = (&mut squares[..len], &mut pairs[..len]);
    for x in 0..len {
        let (p, q) = (p[x].dn(), q[x].dn());
        let free = p.max(q) < full;
        let residual = if free { (p + q) as f32 - sums[x] } else { 0.0 };
        squares[x] += residual * residual;
        pairs[x] += u16::from(free);
    }
}
