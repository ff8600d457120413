//! Whole parts of numbers, in a form that every vector unit has: the conversion of the language saturates and knows NaN,
//! for which compilers leave vector registers.

/// From here on neighbouring `f32` are 1 apart, so that adding it rounds.
const UNIT_SPACING: f32 = 8_388_608.0;

/// Largest argument of [`whole_part`].
pub(crate) const LARGEST: f32 = 4_194_304.0;

/// Whole part of a number in 0..=[`LARGEST`]; anything for other numbers and for NaN.
#[inline(always)]
pub(crate) fn whole_part(value: f32) -> i32 {
    let nearest = (value + UNIT_SPACING) - UNIT_SPACING;
    let whole = if nearest > value { nearest - 1.0 } else { nearest };
    ((whole + UNIT_SPACING).to_bits() & 0x007F_FFFF) as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_what_the_language_converts_to() {
        let near_whole = (0..5000).flat_map(|n| {
            let n = n as f32;
            [n, n.next_down().max(0.0), n.next_up(), n + 0.5, (n + 0.5).next_down(), (n + 0.5).next_up()]
        });
        let ranges = (0..1_000_000).map(|n| LARGEST * (n as f32 / 1e6)).chain([LARGEST, LARGEST - 0.5]);
        for value in near_whole.chain(ranges) {
            assert_eq!(whole_part(value), value as i32, "{value}");
        }
    }
}
