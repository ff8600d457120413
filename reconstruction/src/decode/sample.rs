//! Samples of 8 and 16 bits behind one trait, so that every kernel is written once.

use super::types::Plane;

/// A sample of a frame. Kernels compare and subtract samples as they are: the narrower a sample, the more of them a
/// vector register holds.
pub(crate) trait Sample: Copy + Ord + Default + Send + Sync + 'static {
    /// Bits of the type.
    const BITS: u8;
    /// Value in DN.
    fn dn(self) -> i32;
    /// The nearest value that the type has.
    fn nearest(dn: i32) -> Self;
    /// Difference to a sample that is not larger.
    fn above(self, lower: Self) -> Self;
    /// One place to the left, with a new last bit.
    fn shifted_in(self, bit: bool) -> Self;
    /// Bits in the places of a word.
    fn bits(self) -> u16;
    /// The samples of a plane, or `None` where it holds the other type.
    fn of(plane: Plane<'_>) -> Option<&[Self]>;
}

impl Sample for u8 {
    const BITS: u8 = 8;

    #[inline(always)]
    fn dn(self) -> i32 {
        i32::from(self)
    }

    #[inline(always)]
    fn nearest(dn: i32) -> Self {
        dn.clamp(0, i32::from(Self::MAX)) as Self
    }

    #[inline(always)]
    fn above(self, lower: Self) -> Self {
        self.wrapping_sub(lower)
    }

    #[inline(always)]
    fn shifted_in(self, bit: bool) -> Self {
        (self << 1) | Self::from(bit)
    }

    #[inline(always)]
    fn bits(self) -> u16 {
        u16::from(self)
    }

    fn of(plane: Plane<'_>) -> Option<&[Self]> {
        match plane {
            Plane::U8(samples) => Some(samples),
            Plane::U16(_) => None,
        }
    }
}

impl Sample for u16 {
    const BITS: u8 = 16;

    #[inline(always)]
    fn dn(self) -> i32 {
        i32::from(self)
    }

    #[inline(always)]
    fn nearest(dn: i32) -> Self {
        dn.clamp(0, i32::from(Self::MAX)) as Self
    }

    #[inline(always)]
    fn above(self, lower: Self) -> Self {
        self.wrapping_sub(lower)
    }

    #[inline(always)]
    fn shifted_in(self, bit: bool) -> Self {
        (self << 1) | Self::from(bit)
    }

    #[inline(always)]
    fn bits(self) -> u16 {
        self
    }

    fn of(plane: Plane<'_>) -> Option<&[Self]> {
        match plane {
            Plane::U8(_) => None,
            Plane::U16(samples) => Some(samples),
        }
    }
}

impl Plane<'_> {
    /// Number of samples.
    pub fn len(self) -> usize {
        match self {
            Self::U8(samples) => samples.len(),
            Self::U16(samples) => samples.len(),
        }
    }

    /// Whether there is no sample.
    pub fn is_empty(self) -> bool {
        self.len() == 0
    }

    /// Whether both hold the same type of sample.
    pub fn same_type(self, other: Plane<'_>) -> bool {
        matches!((self, other), (Self::U8(_), Plane::U8(_)) | (Self::U16(_), Plane::U16(_)))
    }
}
