//! The Gray code of one projector axis.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest supported side of a projector, in pixels.
pub const MAX_SIDE: u32 = 8192;

/// Why a code for an axis cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum CodeError {
    /// The side has no pixel or more than the supported number.
    #[error("projector side of {size} px is outside 1..={MAX_SIDE}")]
    Size {
        /// The refused side in pixels.
        size: u32,
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
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct AxisCode {
    size: u32,
    bits: u8,
    offset: u32,
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
        if bits > 16 || u64::from(size) + u64::from(offset) > 1u64 << bits {
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

    /// Value of pattern bit `bit` (0 = most significant) at `index`.
    pub fn bit(self, index: u32, bit: u8) -> bool {
        (self.encode(index) >> (self.bits - 1 - bit)) & 1 == 1
    }

    /// Which bit changes between `index` and `index + 1`: exactly one does.
    pub fn bit_of_boundary(self, index: u32) -> u8 {
        let changed = self.encode(index) ^ self.encode(index + 1);
        self.bits - 1 - changed.trailing_zeros() as u8
    }
}

/// Binary value of a reflected Gray word.
pub fn gray_to_binary(word: u32) -> u32 {
    let mut value = word;
    value ^= value >> 16;
    value ^= value >> 8;
    value ^= value >> 4;
    value ^= value >> 2;
    value ^ (value >> 1)
}
