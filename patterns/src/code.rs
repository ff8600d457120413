//! The Gray code of one projector axis.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest supported side of a projector, in pixels.
pub const MAX_SIDE: u32 = 8192;

/// Longest supported word. Eight times the shortest word's range of the longest side: no known capture needs more.
pub const MAX_BITS: u8 = 16;

/// Why a code for an axis cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum CodeError {
    /// The side has no pixel or more than the supported number.
    #[error("projector side of {size} px is outside 1..={MAX_SIDE}")]
    Size {
        /// The refused side in pixels.
        size: u32,
    },
    /// The word is longer than supported.
    #[error("a code of {bits} bits is longer than the supported {MAX_BITS}")]
    TooLong {
        /// Length of the word.
        bits: u8,
    },
    /// The word is too short to give each index its own word.
    #[error("{bits} code bits and offset {offset} cannot number {size} projector pixels")]
    TooShort {
        /// Length of the word.
        bits: u8,
        /// What is added to the index before coding.
        offset: u32,
        /// Number of indices.
        size: u32,
    },
}

/// Gray code of one axis: index `i` in `0..size` is sent as the word `gray(i + offset)` of `bits` bits.
///
/// Serialized as its three numbers; reading them back checks them as [`AxisCode::new`] does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "UncheckedCode")]
pub struct AxisCode {
    size: u32,
    bits: u8,
    offset: u32,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct UncheckedCode {
    size: u32,
    bits: u8,
    offset: u32,
}

impl TryFrom<UncheckedCode> for AxisCode {
    type Error = CodeError;

    fn try_from(code: UncheckedCode) -> Result<Self, CodeError> {
        Self::new(code.size, code.bits, code.offset)
    }
}

impl AxisCode {
    /// Shortest code for `size` pixels, centred so that the most significant edge lies mid-image:
    /// `offset = floor((2^n - size) / 2)`.
    pub fn centred(size: u32) -> Result<Self, CodeError> {
        let bits = Self::shortest(size)?;
        Self::new(size, bits, ((1u32 << bits) - size) / 2)
    }

    /// Shortest code without an offset, as in the paper.
    pub fn plain(size: u32) -> Result<Self, CodeError> {
        Self::new(size, Self::shortest(size)?, 0)
    }

    /// A code with a given word length and offset, as recorded with a capture.
    pub fn new(size: u32, bits: u8, offset: u32) -> Result<Self, CodeError> {
        if size == 0 || size > MAX_SIDE {
            return Err(CodeError::Size { size });
        }
        if bits > MAX_BITS {
            return Err(CodeError::TooLong { bits });
        }
        if u64::from(size) + u64::from(offset) > 1u64 << bits {
            return Err(CodeError::TooShort { bits, offset, size });
        }
        Ok(Self { size, bits, offset })
    }

    /// `ceil(log2 size)`: 0 for a side of one pixel.
    pub fn shortest(size: u32) -> Result<u8, CodeError> {
        if size == 0 || size > MAX_SIDE {
            return Err(CodeError::Size { size });
        }
        Ok((u32::BITS - (size - 1).leading_zeros()) as u8)
    }

    /// Number of indices, in projector pixels.
    pub fn size(self) -> u32 {
        self.size
    }

    /// Length of the word.
    pub fn bits(self) -> u8 {
        self.bits
    }

    /// What is added to the index before Gray coding.
    pub fn offset(self) -> u32 {
        self.offset
    }

    /// Word of `index`; the most significant of its `bits` bits is bit 0 of the patterns.
    pub fn encode(self, index: u32) -> u32 {
        debug_assert!(index < self.size, "index within the projector");
        let value = index + self.offset;
        value ^ (value >> 1)
    }

    /// Index of a word, or `None` where the word lies outside the projector. Never clamps.
    pub fn decode(self, word: u32) -> Option<u32> {
        let index = gray_to_binary(word).checked_sub(self.offset)?;
        (index < self.size).then_some(index)
    }

    /// Value of pattern bit `bit` (0 = most significant, below [`bits`](Self::bits)) at `index`.
    pub fn bit(self, index: u32, bit: u8) -> bool {
        (self.encode(index) >> (self.bits - 1 - bit)) & 1 == 1
    }

    /// Which bit changes between `index` and `index + 1`, both within the projector: exactly one does.
    pub fn bit_of_boundary(self, index: u32) -> u8 {
        debug_assert!(index + 1 < self.size, "both sides of the boundary within the projector");
        let changed = self.encode(index) ^ self.encode(index + 1);
        self.bits - 1 - changed.trailing_zeros() as u8
    }

    /// Legal boundaries of `bit` (below [`bits`](Self::bits)), ascending: each item `i` says that the bit changes between `i` and `i + 1`, that is
    /// at the coordinate `i + 0.5`.
    ///
    /// In values (index + offset) the bit changes in front of the odd multiples of `2^(bits - 1 - bit)`.
    pub fn boundaries(self, bit: u8) -> impl Iterator<Item = u32> {
        let half_period = 1u32 << (self.bits - 1 - bit);
        let (first, end) = (self.offset + 1, self.offset + self.size);
        // Rounds `first` up to an odd multiple of the half period.
        let multiple = first.div_ceil(half_period) | 1;
        let offset = self.offset;
        (multiple * half_period..end).step_by(2 * half_period as usize).map(move |value| value - offset - 1)
    }
}

/// Binary value of a reflected Gray word: each bit is the parity of itself and all higher bits.
fn gray_to_binary(word: u32) -> u32 {
    let mut value = word;
    value ^= value >> 16;
    value ^= value >> 8;
    value ^= value >> 4;
    value ^= value >> 2;
    value ^ (value >> 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Reflected Gray words of `bits` bits by the definition: the list, then the list backwards with a leading one.
    fn reflected(bits: u8) -> Vec<u32> {
        let mut words = vec![0];
        for bit in 0..bits {
            let mirrored: Vec<u32> = words.iter().rev().map(|word| word | 1 << bit).collect();
            words.extend(mirrored);
        }
        words
    }

    #[test]
    fn words_are_the_reflected_code_of_the_definition() {
        for bits in 0..=MAX_BITS {
            let size = MAX_SIDE.min(1 << bits);
            let code = AxisCode::new(size, bits, (1 << bits) - size).unwrap();
            let words = reflected(bits);
            for index in 0..size {
                assert_eq!(code.encode(index), words[(index + code.offset()) as usize]);
            }
        }
    }

    #[test]
    fn every_size_numbers_each_pixel_with_a_word_of_its_own() {
        let mut seen_at = vec![0u32; MAX_SIDE as usize];
        let mut pass = 0;
        for size in 1..=MAX_SIDE {
            for code in [AxisCode::plain(size).unwrap(), AxisCode::centred(size).unwrap()] {
                pass += 1;
                for index in 0..size {
                    let word = code.encode(index);
                    assert!(word < 1 << code.bits(), "{code:?} {index}");
                    assert_ne!(
                        std::mem::replace(&mut seen_at[word as usize], pass),
                        pass,
                        "{code:?} {index}"
                    );
                    assert_eq!(code.decode(word), Some(index), "{code:?}");
                }
            }
        }
    }

    #[test]
    fn every_boundary_is_an_edge_of_exactly_one_bit() {
        for size in (1..=300).chain([767, 768, 1023, 1024, 1025, 1080, 1920, 4095, 4096, 4097, 8191, 8192]) {
            for code in [AxisCode::plain(size).unwrap(), AxisCode::centred(size).unwrap()] {
                let mut edges = vec![0u32; size as usize - 1];
                for bit in 0..code.bits() {
                    let slow: Vec<u32> = (1..size)
                        .filter(|&i| code.bit(i - 1, bit) != code.bit(i, bit))
                        .map(|i| i - 1)
                        .collect();
                    let listed: Vec<u32> = code.boundaries(bit).collect();
                    assert_eq!(listed, slow, "{code:?} bit {bit}");
                    for index in listed {
                        edges[index as usize] += 1;
                        assert_eq!(code.bit_of_boundary(index), bit);
                    }
                }
                assert!(edges.iter().all(|&count| count == 1), "{code:?}");
            }
        }
    }

    #[test]
    fn the_most_significant_edge_of_a_centred_code_is_mid_image() {
        for size in 2..=MAX_SIDE {
            let edges: Vec<u32> = AxisCode::centred(size).unwrap().boundaries(0).collect();
            let [edge] = edges[..] else { panic!("size {size} has edges {edges:?}") };
            let from_centre = f64::from(edge) + 0.5 - f64::from(size - 1) / 2.0;
            let allowed = if size % 2 == 0 { 0.0 } else { 0.5 };
            assert_eq!(from_centre.abs(), allowed, "size {size}");
        }
    }

    #[test]
    fn words_are_as_short_as_can_be() {
        for size in 1..=MAX_SIDE {
            let bits = AxisCode::shortest(size).unwrap();
            assert!(size <= 1 << bits && (bits == 0 || size > 1 << (bits - 1)), "size {size}");
        }
        assert_eq!(AxisCode::shortest(1024), Ok(10));
        assert_eq!(AxisCode::shortest(768), Ok(10));
    }

    #[test]
    fn a_side_of_one_pixel_has_no_bits() {
        let code = AxisCode::centred(1).unwrap();
        assert_eq!((code.bits(), code.offset(), code.encode(0)), (0, 0, 0));
        assert_eq!((code.decode(0), code.decode(1)), (Some(0), None));
    }

    #[test]
    fn impossible_codes_are_refused() {
        for size in [0, MAX_SIDE + 1, u32::MAX] {
            assert_eq!(AxisCode::centred(size), Err(CodeError::Size { size }));
            assert_eq!(AxisCode::plain(size), Err(CodeError::Size { size }));
            assert_eq!(AxisCode::new(size, 13, 0), Err(CodeError::Size { size }));
        }
        assert_eq!(AxisCode::new(8, 17, 0), Err(CodeError::TooLong { bits: 17 }));
        assert_eq!(AxisCode::new(8, 3, 1), Err(CodeError::TooShort { bits: 3, offset: 1, size: 8 }));
        assert_eq!(
            AxisCode::new(2, 3, u32::MAX),
            Err(CodeError::TooShort { bits: 3, offset: u32::MAX, size: 2 })
        );
        assert!(serde_json::from_str::<AxisCode>(r#"{"size":9,"bits":3,"offset":0}"#).is_err());
    }

    proptest! {
        #[test]
        fn any_legal_code_survives_writing_and_words_outside_are_never_clamped(
            size in 1..=MAX_SIDE, spare_bits in 0u8..=3, share in 0.0..=1.0f64, word in any::<u32>(),
        ) {
            let bits = AxisCode::shortest(size).unwrap() + spare_bits;
            let offset = (share * f64::from((1u32 << bits) - size)) as u32;
            let code = AxisCode::new(size, bits, offset).unwrap();
            let text = serde_json::to_string(&code).unwrap();
            prop_assert_eq!(serde_json::from_str::<AxisCode>(&text).unwrap(), code);
            for word in [word, word % (1 << bits)] {
                let owner = (0..size).find(|&index| code.encode(index) == word);
                prop_assert_eq!(code.decode(word), owner);
            }
        }
    }
}
