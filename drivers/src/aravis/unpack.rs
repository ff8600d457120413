//! From samples as they travel to one native sample a pixel.

use crate::{
    camera::PixelFormat,
    frame::{PixelStore, Pixels},
};

/// Sample format on the wire, of the names that the GenICam pixel format naming convention gives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WireFormat {
    /// One byte a sample.
    Mono8,
    /// Two bytes a sample, little endian, the low 10 bits count.
    Mono10,
    /// Four samples in five bytes, a stream of bits from the lowest on.
    Mono10p,
    /// Two samples in three bytes: high 8 bits, low 2 bits of both, high 8 bits.
    Mono10Packed,
    /// Two bytes a sample, little endian, the low 12 bits count.
    Mono12,
    /// Two samples in three bytes, a stream of bits from the lowest on.
    Mono12p,
    /// Two samples in three bytes: high 8 bits, low 4 bits of both, high 8 bits.
    Mono12Packed,
    /// Two bytes a sample, little endian.
    Mono16,
}

impl WireFormat {
    /// All that carry samples of `format`, the shortest on the wire first.
    pub fn carrying(format: PixelFormat) -> &'static [Self] {
        match format {
            PixelFormat::Mono8 => &[Self::Mono8],
            PixelFormat::Mono10 => &[Self::Mono10p, Self::Mono10Packed, Self::Mono10],
            PixelFormat::Mono12 => &[Self::Mono12p, Self::Mono12Packed, Self::Mono12],
            PixelFormat::Mono16 => &[Self::Mono16],
        }
    }

    /// Name of the entry of the feature `PixelFormat`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Mono8 => "Mono8",
            Self::Mono10 => "Mono10",
            Self::Mono10p => "Mono10p",
            Self::Mono10Packed => "Mono10Packed",
            Self::Mono12 => "Mono12",
            Self::Mono12p => "Mono12p",
            Self::Mono12Packed => "Mono12Packed",
            Self::Mono16 => "Mono16",
        }
    }

    /// Code of the format in frames and in the value of the feature, as the GigE Vision and USB3 Vision standards give it.
    pub fn code(self) -> u32 {
        match self {
            Self::Mono8 => 0x0108_0001,
            Self::Mono10 => 0x0110_0003,
            Self::Mono10p => 0x010a_0046,
            Self::Mono10Packed => 0x010c_0004,
            Self::Mono12 => 0x0110_0005,
            Self::Mono12p => 0x010c_0047,
            Self::Mono12Packed => 0x010c_0006,
            Self::Mono16 => 0x0110_0007,
        }
    }

    /// Bytes of a frame of `samples` samples.
    pub fn bytes(self, samples: usize) -> usize {
        match self {
            Self::Mono8 => samples,
            Self::Mono10 | Self::Mono12 | Self::Mono16 => 2 * samples,
            Self::Mono10p => (10 * samples).div_ceil(8),
            Self::Mono10Packed | Self::Mono12p | Self::Mono12Packed => (12 * samples).div_ceil(8),
        }
    }

    /// Whether a frame can be used where it lies, without a copy.
    pub fn is_native(self) -> bool {
        self == Self::Mono8 || cfg!(target_endian = "little") && self == Self::Mono16
    }

    /// The first `samples` samples of `bytes`, which holds at least [`Self::bytes`] of them.
    pub fn unpack(self, bytes: &[u8], samples: usize) -> Unpacked {
        let bytes = &bytes[..self.bytes(samples)];
        let pairs = |mask: u16| -> Vec<u16> {
            bytes.chunks_exact(2).map(|pair| u16::from_le_bytes([pair[0], pair[1]]) & mask).collect()
        };
        match self {
            Self::Mono8 => Unpacked::U8(bytes.to_vec()),
            Self::Mono10 => Unpacked::U16(pairs(0x03ff)),
            Self::Mono12 => Unpacked::U16(pairs(0x0fff)),
            Self::Mono16 => Unpacked::U16(pairs(0xffff)),
            Self::Mono10p => Unpacked::U16(groups::<5, 4>(bytes, samples, |b| {
                let low = |at: usize| u16::from(b[at]);
                [
                    low(0) | (low(1) & 0x03) << 8,
                    low(1) >> 2 | (low(2) & 0x0f) << 6,
                    low(2) >> 4 | (low(3) & 0x3f) << 4,
                    low(3) >> 6 | low(4) << 2,
                ]
            })),
            Self::Mono12p => Unpacked::U16(groups::<3, 2>(bytes, samples, |b| {
                let [first, middle, last] = b.map(u16::from);
                [first | (middle & 0x0f) << 8, middle >> 4 | last << 4]
            })),
            Self::Mono10Packed => Unpacked::U16(groups::<3, 2>(bytes, samples, |b| {
                let [first, middle, last] = b.map(u16::from);
                [first << 2 | middle & 0x03, last << 2 | middle >> 4 & 0x03]
            })),
            Self::Mono12Packed => Unpacked::U16(groups::<3, 2>(bytes, samples, |b| {
                let [first, middle, last] = b.map(u16::from);
                [first << 4 | middle & 0x0f, last << 4 | middle >> 4]
            })),
        }
    }
}

/// Samples that were copied out of a buffer.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Unpacked {
    /// Of 8 bits.
    U8(Vec<u8>),
    /// Of more.
    U16(Vec<u16>),
}

impl PixelStore for Unpacked {
    fn pixels(&self) -> Pixels<'_> {
        match self {
            Self::U8(samples) => Pixels::U8(samples),
            Self::U16(samples) => Pixels::U16(samples),
        }
    }
}

/// Groups of `BYTES` bytes with `SAMPLES` samples each, the last one perhaps cut short.
fn groups<const BYTES: usize, const SAMPLES: usize>(
    bytes: &[u8],
    samples: usize,
    unpack: impl Fn([u8; BYTES]) -> [u16; SAMPLES],
) -> Vec<u16> {
    let mut unpacked = Vec::with_capacity(samples + SAMPLES);
    for chunk in bytes.chunks(BYTES) {
        let mut group = [0; BYTES];
        group[..chunk.len()].copy_from_slice(chunk);
        unpacked.extend_from_slice(&unpack(group));
    }
    unpacked.truncate(samples);
    unpacked
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const ALL: [WireFormat; 8] = [
        WireFormat::Mono8,
        WireFormat::Mono10,
        WireFormat::Mono10p,
        WireFormat::Mono10Packed,
        WireFormat::Mono12,
        WireFormat::Mono12p,
        WireFormat::Mono12Packed,
        WireFormat::Mono16,
    ];

    /// Where bit `bit` of sample `sample` travels, as a number of bits from the start, the lowest bit of a byte first.
    fn place(format: WireFormat, sample: usize, bit: usize) -> usize {
        let (pair, second) = (24 * (sample / 2), sample % 2 == 1);
        match format {
            WireFormat::Mono8 => 8 * sample + bit,
            WireFormat::Mono10 | WireFormat::Mono12 | WireFormat::Mono16 => 16 * sample + bit,
            WireFormat::Mono10p => 10 * sample + bit,
            WireFormat::Mono12p => 12 * sample + bit,
            // The low bits of the first sample in the low half of the middle byte, of the second in the high half.
            WireFormat::Mono10Packed | WireFormat::Mono12Packed => {
                let low = if format == WireFormat::Mono10Packed { 2 } else { 4 };
                match (bit < low, second) {
                    (true, false) => pair + 8 + bit,
                    (true, true) => pair + 12 + bit,
                    (false, false) => pair + bit - low,
                    (false, true) => pair + 16 + bit - low,
                }
            }
        }
    }

    fn depth(format: WireFormat) -> usize {
        match format {
            WireFormat::Mono8 => 8,
            WireFormat::Mono10 | WireFormat::Mono10p | WireFormat::Mono10Packed => 10,
            WireFormat::Mono12 | WireFormat::Mono12p | WireFormat::Mono12Packed => 12,
            WireFormat::Mono16 => 16,
        }
    }

    fn oracle(format: WireFormat, bytes: &[u8], samples: usize) -> Vec<u16> {
        let bit_at = |at: usize| u16::from(bytes[at / 8] >> (at % 8) & 1);
        (0..samples)
            .map(|sample| {
                (0..depth(format)).map(|bit| bit_at(place(format, sample, bit)) << bit).sum::<u16>()
            })
            .collect()
    }

    proptest! {
        #[test]
        fn samples_are_where_the_standard_puts_their_bits(
            bytes in prop::collection::vec(any::<u8>(), 200), samples in 0usize..=98,
        ) {
            for format in ALL {
                // A last sample of a pair may have its high bits in a byte that a cut-off pair does not have.
                let samples = if matches!(format, WireFormat::Mono10Packed | WireFormat::Mono12Packed) {
                    samples & !1
                } else {
                    samples
                };
                let unpacked = format.unpack(&bytes, samples);
                let pixels = unpacked.pixels();
                let found: Vec<u16> = (0..pixels.len()).map(|index| pixels.get(index)).collect();
                prop_assert_eq!(found, oracle(format, &bytes, samples), "{:?}", format);
            }
        }
    }

    #[test]
    fn an_odd_number_of_packed_samples_ends_with_a_whole_sample() {
        // The first byte has the high bits, the second the low ones: 3 samples need 5 bytes.
        let unpacked = WireFormat::Mono12Packed.unpack(&[0xab, 0x3c, 0x12, 0xde, 0x0f], 3);
        assert_eq!(unpacked, Unpacked::U16(vec![0xabc, 0x123, 0xdef]));
    }

    #[test]
    fn formats_of_one_depth_are_found_by_it() {
        for format in [PixelFormat::Mono8, PixelFormat::Mono10, PixelFormat::Mono12, PixelFormat::Mono16] {
            for wire in WireFormat::carrying(format) {
                assert_eq!(depth(*wire), usize::from(format.bit_depth()), "{wire:?}");
                // The code's third byte is the number of bits that a sample takes.
                assert_eq!(wire.bytes(8), (wire.code() >> 16 & 0xff) as usize, "{wire:?}");
            }
        }
    }
}
