//! From words to values: what a reflected Gray word stands for, and what soft bits leave of it.
//!
//! The words inside a projector are those of a range of values without a gap, so that two comparisons take the place
//! of a table, and all of it is arithmetic on 16 bits without a branch.

use super::{RowMaps, Scratch, kernels::Weakest};
use crate::decode::{
    plan::{AxisFrames, PrefixCode, binary_of_gray},
    sample::Sample,
};

/// What the words of the axes so far say, the graver the larger.
pub(super) const CLEAR: u16 = 0;
pub(super) const EDGE: u16 = 1;
pub(super) const OUTSIDE: u16 = 2;
pub(super) const AMBIGUOUS: u16 = 3;

/// A coarse bit may be weak this near to its own boundary, in values.
const EDGE_REACH: i32 = 7;

/// First and last value that stands for anything inside the projector.
#[derive(Debug, Clone, Copy)]
pub(super) struct Inside {
    first: u16,
    last: u16,
}

impl Inside {
    /// Values of a code. Its size is at least one pixel, so there is one.
    pub fn of(code: PrefixCode) -> Self {
        let (offset, size) = (code.code.offset(), code.code.size());
        Self { first: (offset >> code.shift) as u16, last: ((offset + size - 1) >> code.shift) as u16 }
    }

    #[inline(always)]
    fn has(self, value: u16) -> bool {
        (self.first <= value) & (value <= self.last)
    }
}

impl<T: Sample> Scratch<T> {
    /// Words of one axis to values.
    #[inline(always)]
    pub(super) fn resolve(&mut self, axis: &AxisFrames<'_, T>, index: usize, row: &mut RowMaps<'_>) {
        let mask = ((1u32 << axis.code.bits) - 1) as u16;
        let (words, values) = (&mut *row.words[index], &mut *row.values[index]);
        let len = words.len();
        let soft = &mut self.soft[..len];
        self.bits.join(words, soft);
        polarity(words, &self.inverted[..len], mask);
        read_words(words, soft, Inside::of(axis.code), values, &mut self.status[..len]);
        let Weakest { least, place, second, pairs } = &self.weakest;
        let weak = &mut self.weak[..len];
        match pairs {
            0 => {}
            1 => weaken(values, &least[..len], &place[..len], |_| i32::MAX, weak),
            _ => weaken(values, &least[..len], &place[..len], |x| second[x].dn(), weak),
        }
    }
}

#[inline(always)]
fn polarity(words: &mut [u16], inverted: &[u16], mask: u16) {
    for (word, inverted) in words.iter_mut().zip(inverted) {
        *word = (*word ^ inverted) & mask;
    }
}

#[inline(always)]
fn read_words(words: &[u16], soft: &[u16], inside: Inside, values: &mut [i32], status: &mut [u16]) {
    let len = words.len();
    let (soft, values, status) = (&soft[..len], &mut values[..len], &mut status[..len]);
    for x in 0..len {
        let (value, found, says) = resolve_word(inside, words[x], soft[x]);
        values[x] = if found { i32::from(value) } else { -1 };
        status[x] = status[x].max(says);
    }
}

/// Takes the smallest difference of a coarse bit that is not near its own edge into account; `second` is what counts
/// where the smallest is.
#[inline(always)]
fn weaken<T: Sample>(
    values: &[i32],
    least: &[T],
    place: &[T],
    second: impl Fn(usize) -> i32,
    weak: &mut [i32],
) {
    let len = values.len();
    let (least, place, weak) = (&least[..len], &place[..len], &mut weak[..len]);
    for x in 0..len {
        let near = boundary_distance(place[x].dn(), values[x]) <= EDGE_REACH;
        let difference = if near { second(x) } else { least[x].dn() };
        weak[x] = if values[x] >= 0 { weak[x].min(difference) } else { weak[x] };
    }
}

/// Value of a word with at most one soft bit, whether there is one, and what the word says. A single soft bit is an
/// edge where both readings are neighbours, of which one may lie just beyond the rim of the projector.
#[inline(always)]
pub(super) fn resolve_word(inside: Inside, word: u16, soft: u16) -> (u16, bool, u16) {
    let value = binary_of_gray(word);
    let other = binary_of_gray(word ^ soft);
    let at_most_one = soft & soft.wrapping_sub(1) == 0;
    // With no soft bit both are the same reading.
    let neighbours = value.abs_diff(other) <= 1;
    let (here, there) = (inside.has(value), inside.has(other));
    let read = if here { value } else { other };
    let inside = here | there;
    let says = match (soft == 0, neighbours) {
        (true, _) => CLEAR,
        (_, true) => EDGE,
        _ => AMBIGUOUS,
    };
    let says = if inside { says } else { OUTSIDE };
    let says = if at_most_one { says } else { AMBIGUOUS };
    (read, says <= EDGE, says)
}

/// Distance in values from the centre of `value` to the next boundary of the bit at `place`, rounded down.
#[inline(always)]
pub(super) fn boundary_distance(place: i32, value: i32) -> i32 {
    let half = 1i32 << (place & 31);
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
                let range = Inside::of(code);
                let list = words(known);
                let inside = |place: usize| code.span(place as i32).is_some();
                for (place, &word) in list.iter().enumerate() {
                    let clear = if inside(place) { (place as u16, true, CLEAR) } else { (0, false, OUTSIDE) };
                    let found = resolve_word(range, word, 0);
                    assert_eq!((found.1, found.2), (clear.1, clear.2), "{size} px, {known} bits: {word:b}");
                    assert!(!found.1 || found.0 == clear.0);
                    for bit in 0..known {
                        let other = list.iter().position(|&found| found == word ^ (1 << bit)).unwrap();
                        let (value, known_value, says) = resolve_word(range, word, 1 << bit);
                        let here = if inside(place) { place } else { other };
                        let expected = match (inside(place), inside(other)) {
                            (false, false) => OUTSIDE,
                            _ if place.abs_diff(other) == 1 => EDGE,
                            _ => AMBIGUOUS,
                        };
                        assert_eq!(says, expected, "{size} px, {known} bits: {word:b} bit {bit}");
                        assert_eq!(known_value, expected == EDGE);
                        assert!(!known_value || usize::from(value) == here);
                        if inside(place) != inside(other) {
                            rims += u32::from(expected == EDGE);
                            strangers += u32::from(expected == AMBIGUOUS);
                        }
                        for second in (0..known).filter(|second| *second != bit) {
                            let two = (1 << bit) | (1 << second);
                            assert_eq!(resolve_word(range, word, two).2, AMBIGUOUS);
                        }
                    }
                }
            }
        }
        assert!(rims > 10 && strangers > 10, "{rims} {strangers}");
    }
}
