//! Samples of 8 and 16 bits behind one trait, so that every kernel is written once.

use super::types::Plane;

/// A sample of a frame.
pub(crate) trait Sample: Copy + Send + Sync + 'static {
    /// Value in DN.
    fn dn(self) -> i32;
    /// The samples of a plane, or `None` where it holds the other type.
    fn of(plane: Plane<'_>) -> Option<&[Self]>;
}

impl Sample for u8 {
    fn dn(self) -> i32 {
        i32::from(self)
    }

    fn of(plane: Plane<'_>) -> Option<&[Self]> {
        match plane {
            Plane::U8(samples) => Some(samples),
            Plane::U16(_) => None,
        }
    }
}

impl Sample for u16 {
    fn dn(self) -> i32 {
        i32::from(self)
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
