//! The marker dictionaries of ArUco, as OpenCV numbers them.

use serde::{Deserialize, Serialize};

/// Codes of one size, a thousand of them; OpenCV's smaller dictionaries are their first 50, 100 and 250.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Dictionary {
    /// Markers of 4x4 bits.
    #[serde(rename = "4x4")]
    Bits4,
    /// Markers of 5x5 bits.
    #[serde(rename = "5x5")]
    Bits5,
    /// Markers of 6x6 bits.
    #[serde(rename = "6x6")]
    Bits6,
    /// Markers of 7x7 bits.
    #[serde(rename = "7x7")]
    Bits7,
}

impl Dictionary {
    /// Bits along a side, without the border.
    pub fn side(self) -> usize {
        match self {
            Self::Bits4 => 4,
            Self::Bits5 => 5,
            Self::Bits6 => 6,
            Self::Bits7 => 7,
        }
    }

    /// Codes in order of their numbers: bits row by row from the top left, the first in the most significant place; 1 is light.
    pub fn codes(self) -> Vec<u64> {
        let text = match self {
            Self::Bits4 => include_str!("dictionaries/4x4.txt"),
            Self::Bits5 => include_str!("dictionaries/5x5.txt"),
            Self::Bits6 => include_str!("dictionaries/6x6.txt"),
            Self::Bits7 => include_str!("dictionaries/7x7.txt"),
        };
        let code = |word| u64::from_str_radix(word, 16).expect("the tables hold hexadecimal numbers");
        text.split_whitespace().map(code).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The same marker a quarter turn on.
    fn turned(code: u64, side: usize) -> u64 {
        let bit = |x: usize, y: usize| code >> (side * side - 1 - (y * side + x)) & 1;
        (0..side * side).fold(0, |sum, at| sum << 1 | bit(at / side, side - 1 - at % side))
    }

    #[test]
    fn no_marker_is_another_one_turned() {
        for dictionary in [Dictionary::Bits4, Dictionary::Bits5, Dictionary::Bits6, Dictionary::Bits7] {
            let side = dictionary.side();
            let codes = dictionary.codes();
            assert_eq!(codes.len(), 1000);
            let mut seen = std::collections::HashSet::new();
            for code in codes {
                assert!(code < 1 << (side * side));
                let mut turn = code;
                for _ in 0..4 {
                    assert!(seen.insert(turn), "{side}: {code:x}");
                    turn = turned(turn, side);
                }
                assert_eq!(turn, code);
            }
        }
    }

    #[test]
    fn the_first_marker_of_4x4_is_the_known_one() {
        // Published picture of marker 0 of DICT_4X4_50: rows 1011, 0101, 0011, 0010.
        assert_eq!(Dictionary::Bits4.codes()[0], 0b1011_0101_0011_0010);
    }
}
