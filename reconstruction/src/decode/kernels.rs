//! Inner loops of the decode over one row of one pair. They are functions of slices: that no two of them overlap is
//! then known to the compiler, which vectorises them.

use super::sample::Sample;

/// Bit of a pair by the sign of its difference.
pub(super) fn pair_bit<T: Sample>(
    p: &[T],
    q: &[T],
    full: i32,
    soft_at: &[i32],
    word: &mut [u16],
    soft: &mut [u16],
    saturated: &mut [u8],
) {
    let width = p.len();
    let (q, soft_at) = (&q[..width], &soft_at[..width]);
    let (word, soft, saturated) = (&mut word[..width], &mut soft[..width], &mut saturated[..width]);
    for x in 0..width {
        let (p, q) = (p[x].dn(), q[x].dn());
        word[x] = (word[x] << 1) | u16::from(p > q);
        soft[x] = (soft[x] << 1) | u16::from((p - q).abs() <= soft_at[x]);
        saturated[x] |= u8::from(p.max(q) >= full) | (u8::from(p.min(q) >= full) << 1);
    }
}

/// Collects the residual of the pair sum where no frame of the pair is saturated.
pub(super) fn pair_sum<T: Sample>(
    p: &[T],
    q: &[T],
    full: i32,
    sums: &[f32],
    squares: &mut [f32],
    pairs: &mut [u32],
) {
    let width = p.len();
    let (q, sums) = (&q[..width], &sums[..width]);
    let (squares, pairs) = (&mut squares[..width], &mut pairs[..width]);
    for x in 0..width {
        let (p, q) = (p[x].dn(), q[x].dn());
        let free = i32::from(p.max(q) < full);
        let residual = ((p + q) as f32 - sums[x]) * free as f32;
        squares[x] += residual * residual;
        pairs[x] += free as u32;
    }
}

/// Keeps the two smallest |P - Q| of the coarse bits (at most one of them is near its own edge), each with its bit.
pub(super) fn track_weakest<T: Sample>(p: &[T], q: &[T], bit: u8, weakest: &mut [i32], second: &mut [i32]) {
    let width = p.len();
    let (q, weakest, second) = (&q[..width], &mut weakest[..width], &mut second[..width]);
    for x in 0..width {
        let key = ((p[x].dn() - q[x].dn()).abs() << WEAK_BIT_SHIFT) | i32::from(bit);
        second[x] = second[x].min(weakest[x].max(key));
        weakest[x] = weakest[x].min(key);
    }
}

/// Bits of a key of [`track_weakest`] that hold the bit's number.
pub(super) const WEAK_BIT_SHIFT: u32 = 5;
