//! From samples as they lie in a buffer to one native sample a pixel.

use std::sync::Arc;

use crate::{
    camera::{PixelFormat, Region},
    frame::PixelStore,
};

/// Sample format of a buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Wire {
    /// One byte a sample.
    Grey,
    /// Two pixels in four bytes, brightness in the first and third.
    Yuyv,
    /// Two pixels in four bytes, brightness in the second and fourth.
    Uyvy,
    /// Two bytes a sample, little endian, the low 10 bits count.
    Y10,
    /// Four samples in five bytes: high 8 bits of each, then all low bits, those of the first lowest.
    Y10p,
    /// Two bytes a sample, little endian, the low 12 bits count.
    Y12,
    /// Two samples in three bytes: high 8 bits of each, then all low bits, those of the first lowest.
    Y12p,
    /// Two bytes a sample, little endian.
    Y16,
    /// Two bytes a sample, big endian.
    Y16Be,
}

impl Wire {
    /// All, those that need the least work first.
    pub const ALL: [Self; 9] = [
        Self::Grey,
        Self::Yuyv,
        Self::Uyvy,
        Self::Y10,
        Self::Y10p,
        Self::Y12,
        Self::Y12p,
        Self::Y16,
        Self::Y16Be,
    ];

    /// Code of the format, four characters.
    pub const fn fourcc(self) -> u32 {
        match self {
            Self::Grey => u32::from_le_bytes(*b"GREY"),
            Self::Yuyv => u32::from_le_bytes(*b"YUYV"),
            Self::Uyvy => u32::from_le_bytes(*b"UYVY"),
            Self::Y10 => u32::from_le_bytes(*b"Y10 "),
            Self::Y10p => u32::from_le_bytes(*b"Y10P"),
            Self::Y12 => u32::from_le_bytes(*b"Y12 "),
            Self::Y12p => u32::from_le_bytes(*b"Y12P"),
            Self::Y16 => u32::from_le_bytes(*b"Y16 "),
            // The highest bit of a code says big endian.
            Self::Y16Be => u32::from_le_bytes(*b"Y16 ") | 1 << 31,
        }
    }

    /// Samples that it carries.
    pub fn carries(self) -> PixelFormat {
        match self {
            Self::Grey | Self::Yuyv | Self::Uyvy => PixelFormat::Mono8,
            Self::Y10 | Self::Y10p => PixelFormat::Mono10,
            Self::Y12 | Self::Y12p => PixelFormat::Mono12,
            Self::Y16 | Self::Y16Be => PixelFormat::Mono16,
        }
    }

    /// Whether colour travels with the brightness.
    pub fn has_colour(self) -> bool {
        matches!(self, Self::Yuyv | Self::Uyvy)
    }

    /// Bytes of a row of so many columns.
    pub fn row_bytes(self, columns: usize) -> usize {
        match self {
            Self::Grey => columns,
            Self::Yuyv | Self::Uyvy => 4 * columns.div_ceil(2),
            Self::Y10 | Self::Y12 | Self::Y16 | Self::Y16Be => 2 * columns,
            Self::Y10p => 5 * columns.div_ceil(4),
            Self::Y12p => 3 * columns.div_ceil(2),
        }
    }

    /// The samples of `region` of a picture whose rows lie `stride` bytes apart; `None` where `bytes` ends before.
    pub fn cut(self, bytes: &[u8], stride: usize, region: Region) -> Option<Arc<dyn PixelStore>> {
        let [left, top, width, height] =
            [region.x, region.y, region.width, region.height].map(|side| side as usize);
        let needed = self.row_bytes(left + width);
        let rows: Vec<&[u8]> =
            (top..top + height).map(|y| bytes.get(y * stride..)?.get(..needed)).collect::<Option<_>>()?;
        let narrow = |sample: fn(&[u8], usize) -> u8| -> Arc<dyn PixelStore> {
            let row = |row: &&[u8]| (left..left + width).map(|x| sample(row, x)).collect::<Vec<u8>>();
            Arc::new(rows.iter().flat_map(row).collect::<Vec<u8>>())
        };
        let wide = |sample: fn(&[u8], usize) -> u16| -> Arc<dyn PixelStore> {
            let row = |row: &&[u8]| (left..left + width).map(|x| sample(row, x)).collect::<Vec<u16>>();
            Arc::new(rows.iter().flat_map(row).collect::<Vec<u16>>())
        };
        Some(match self {
            Self::Grey => {
                Arc::new(rows.iter().flat_map(|row| &row[left..needed]).copied().collect::<Vec<u8>>())
            }
            Self::Yuyv => narrow(|row, x| row[2 * x]),
            Self::Uyvy => narrow(|row, x| row[2 * x + 1]),
            Self::Y10 => wide(|row, x| two(row, x) & 0x03ff),
            Self::Y12 => wide(|row, x| two(row, x) & 0x0fff),
            Self::Y16 => wide(two),
            Self::Y16Be => wide(|row, x| two(row, x).swap_bytes()),
            Self::Y10p => wide(|row, x| {
                let (group, of) = (5 * (x / 4), x % 4);
                u16::from(row[group + of]) << 2 | u16::from(row[group + 4] >> (2 * of)) & 0x03
            }),
            Self::Y12p => wide(|row, x| {
                let (group, of) = (3 * (x / 2), x % 2);
                u16::from(row[group + of]) << 4 | u16::from(row[group + 2] >> (4 * of)) & 0x0f
            }),
        })
    }
}

/// Sample `x` of two bytes, little endian.
fn two(row: &[u8], x: usize) -> u16 {
    u16::from_le_bytes([row[2 * x], row[2 * x + 1]])
}

/// Code of a format for people.
pub fn code_name(fourcc: u32) -> String {
    let characters = (fourcc & !(1 << 31)).to_le_bytes().map(|byte| match byte {
        b' '..=b'~' => char::from(byte),
        _ => '?',
    });
    let name: String = characters.iter().collect();
    name.trim().to_owned() + if fourcc >> 31 == 1 { "-BE" } else { "" }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Where bit `bit` of the sample in column `x` lies in its row, as a number of bits, the lowest bit of a byte first.
    fn place(wire: Wire, x: usize, bit: usize) -> usize {
        match wire {
            Wire::Grey => 8 * x + bit,
            Wire::Yuyv => 16 * x + bit,
            Wire::Uyvy => 16 * x + 8 + bit,
            Wire::Y10 | Wire::Y12 | Wire::Y16 => 16 * x + bit,
            Wire::Y16Be => 16 * x + if bit < 8 { 8 + bit } else { bit - 8 },
            Wire::Y10p if bit < 2 => 40 * (x / 4) + 32 + 2 * (x % 4) + bit,
            Wire::Y10p => 40 * (x / 4) + 8 * (x % 4) + bit - 2,
            Wire::Y12p if bit < 4 => 24 * (x / 2) + 16 + 4 * (x % 2) + bit,
            Wire::Y12p => 24 * (x / 2) + 8 * (x % 2) + bit - 4,
        }
    }

    proptest! {
        #[test]
        fn every_bit_is_read_from_where_the_kernel_puts_it(
            x in 0u32..7, y in 0u32..3, width in 1u32..9, height in 1u32..4, padding in 0usize..5, seed: u64,
        ) {
            for wire in Wire::ALL {
                let stride = wire.row_bytes((x + width) as usize) + padding;
                let bytes: Vec<u8> = (0..stride * (y + height) as usize)
                    .map(|at| (seed.wrapping_mul(at as u64 + 1).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as u8)
                    .collect();
                let bit = |row: usize, at: usize| u16::from(bytes[row * stride + at / 8] >> (at % 8) & 1);
                let depth = usize::from(wire.carries().bit_depth());
                let mut expected = Vec::new();
                for row in y..y + height {
                    for column in x..x + width {
                        let bits = (0..depth)
                            .map(|n| bit(row as usize, place(wire, column as usize, n)) << n);
                        expected.push(bits.sum::<u16>());
                    }
                }
                let store = wire.cut(&bytes, stride, Region { x, y, width, height }).unwrap();
                let pixels = store.pixels();
                let found: Vec<u16> = (0..pixels.len()).map(|at| pixels.get(at)).collect();
                prop_assert_eq!(found, expected, "{:?}", wire);
                let missing = &bytes[..bytes.len() - padding - 1];
                let short = wire.cut(missing, stride, Region { x, y, width, height });
                prop_assert!(short.is_none(), "{:?}", wire);
            }
        }
    }

    #[test]
    fn codes_have_names() {
        assert_eq!(code_name(Wire::Grey.fourcc()), "GREY");
        assert_eq!(code_name(Wire::Y16Be.fourcc()), "Y16-BE");
        assert_eq!(code_name(u32::from_le_bytes([b'M', 1, b'P', b'G'])), "M?PG");
    }
}
