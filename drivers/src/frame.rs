//! A frame: pixels plus the identity that proves which exposure it is.

use std::{fmt, sync::Arc};

use serde::{Deserialize, Serialize};

use crate::clock::Timestamp;

/// Pixels of one frame, row-major, one sample a pixel, significant bits right-aligned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pixels<'a> {
    /// Samples of up to 8 bits.
    U8(&'a [u8]),
    /// Samples of 9 to 16 bits in native byte order.
    U16(&'a [u16]),
}

impl Pixels<'_> {
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

    /// Sample `index` in DN.
    pub fn get(self, index: usize) -> u16 {
        match self {
            Self::U8(samples) => u16::from(samples[index]),
            Self::U16(samples) => samples[index],
        }
    }
}

/// Owner of a frame's memory. A driver hands out its own buffer without copying; dropping the last handle gives
/// the buffer back to it.
pub trait PixelStore: Send + Sync {
    /// The samples.
    fn pixels(&self) -> Pixels<'_>;
}

impl PixelStore for Vec<u8> {
    fn pixels(&self) -> Pixels<'_> {
        Pixels::U8(self)
    }
}

impl PixelStore for Vec<u16> {
    fn pixels(&self) -> Pixels<'_> {
        Pixels::U16(self)
    }
}

/// What identifies an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrameStamp {
    /// Number that the camera gave the frame since it was armed, counting every exposure from 0; a gap is a lost frame.
    pub frame_id: u64,
    /// Number of the trigger that the driver believes this frame answers, from 0 since arming.
    pub trigger: u64,
    /// Start of exposure on the rig's clock as well as it is known.
    #[serde(rename = "exposure_start_ns")]
    pub exposure_start: Timestamp,
    /// When the whole frame had arrived, on the rig's clock.
    #[serde(rename = "received_ns")]
    pub received: Timestamp,
    /// The camera's own clock in nanoseconds, where it has one.
    pub device_time_ns: Option<u64>,
}

/// One frame. Cloning shares the pixels.
#[derive(Clone)]
pub struct Frame {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Significant bits of a sample.
    pub bit_depth: u8,
    /// Identity.
    pub stamp: FrameStamp,
    /// Memory of the pixels.
    pub store: Arc<dyn PixelStore>,
}

impl Frame {
    /// The samples, `width * height` of them.
    pub fn pixels(&self) -> Pixels<'_> {
        self.store.pixels()
    }
}

impl fmt::Debug for Frame {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Frame")
            .field("width", &self.width)
            .field("height", &self.height)
            .field("bit_depth", &self.bit_depth)
            .field("stamp", &self.stamp)
            .finish_non_exhaustive()
    }
}
