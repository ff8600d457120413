//! What goes into the decoder and what comes out.

use std::sync::Arc;

use polscan_patterns::{Axis, AxisCode, Mode, Role};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::gates::BoundaryCheck;
use crate::grid::Grid;

/// Samples of one frame, row-major, in DN, significant bits right-aligned.
#[derive(Debug, Clone, Copy)]
pub enum Plane<'a> {
    /// Up to 8 bits.
    U8(&'a [u8]),
    /// 9 to 16 bits.
    U16(&'a [u16]),
}

/// Shared owner of a plane's memory: a camera's buffer, a decoded image, a mapped file.
pub trait PlaneSource: Send + Sync {
    /// The samples; the same at every call.
    fn plane(&self) -> Plane<'_>;
}

impl PlaneSource for Vec<u8> {
    fn plane(&self) -> Plane<'_> {
        Plane::U8(self)
    }
}

impl PlaneSource for Vec<u16> {
    fn plane(&self) -> Plane<'_> {
        Plane::U16(self)
    }
}

/// Noise of a linear camera: `var(I) = read_noise_dn^2 + gain_dn_per_electron * I + 1/12`, I in DN above black.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct NoiseModel {
    /// System gain K in DN per electron.
    pub gain_dn_per_electron: f64,
    /// Temporal dark noise in DN.
    pub read_noise_dn: f64,
}

impl NoiseModel {
    /// Variance of a sample in DN^2, `level_dn` above black (negative levels count as dark).
    pub fn variance(self, level_dn: f64) -> f64 {
        self.read_noise_dn * self.read_noise_dn + self.gain_dn_per_electron * level_dn.max(0.0) + 1.0 / 12.0
    }
}

/// What the decoder knows of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraResponse {
    /// Significant bits of a sample.
    pub bit_depth: u8,
    /// Level of a dark pixel in DN. `None`: 0 is assumed.
    pub black_level_dn: Option<f64>,
    /// A sample at or above this is saturated.
    pub saturation_dn: u16,
    /// Noise; `None` is estimated from the pair sums, and the result says so.
    pub noise: Option<NoiseModel>,
}

/// Gates in units of noise. The defaults are those of the method.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Thresholds {
    /// Lit where |C| >= this many sigma of C; twice that for inverted pixels.
    pub lit_sigma: f64,
    /// A bit is soft where |P - Q| is below this many sigma of P - Q.
    pub soft_bit_sigma: f64,
    /// How far a zero crossing may lie from a legal boundary of its bit, in projector px.
    pub snap_px: f64,
    /// Number of edges in a local fit.
    pub fit_edges: usize,
}

impl Default for Thresholds {
    fn default() -> Self {
        Self { lit_sigma: 4.0, soft_bit_sigma: 2.0, snap_px: 1.5, fit_edges: 8 }
    }
}

impl Thresholds {
    /// Each gate that lies outside its range: its name, and what is wrong with it.
    pub fn faults(&self) -> Vec<(&'static str, String)> {
        let within = |key, value: f64, range: std::ops::RangeInclusive<f64>, unit: &str| {
            // NaN lies in no range.
            let (least, most) = (*range.start(), *range.end());
            (!range.contains(&value)).then(|| (key, format!("is {value}, expected {least} to {most}{unit}")))
        };
        [
            within("lit_sigma", self.lit_sigma, 1.0..=100.0, " sigma"),
            within("soft_bit_sigma", self.soft_bit_sigma, 0.1..=100.0, " sigma"),
            within("snap_px", self.snap_px, 0.5..=16.0, " px"),
            within("fit_edges", self.fit_edges as f64, 2.0..=64.0, " edges"),
        ]
        .into_iter()
        .flatten()
        .collect()
    }
}

/// Everything that fixes a decode besides the frames themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct DecodeSettings {
    /// Mode that the frames were made in.
    pub mode: Mode,
    /// Code of the columns.
    pub column: AxisCode,
    /// Code of the rows.
    pub row: AxisCode,
    /// Frame width in pixels.
    pub width: usize,
    /// Frame height in pixels.
    pub height: usize,
    /// Camera.
    pub camera: CameraResponse,
    /// Gates.
    pub thresholds: Thresholds,
}

/// What became of a pixel. The numbers are public (maps.npz, `class`).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u8)]
pub enum Class {
    /// No projector light.
    Unlit = 0,
    /// Decoded.
    Valid = 1,
    /// Decoded, on a stripe boundary.
    Edge = 2,
    /// Decoded with the polarity exchanged: a depolarising surface.
    Inverted = 3,
    /// Both frames of a pair saturated.
    Saturated = 4,
    /// Two or more soft bits, or two words that are not neighbours.
    Ambiguous = 5,
    /// A zero crossing where its bit has no boundary.
    OffBoundary = 6,
    /// A word outside the projector.
    OutOfProjector = 7,
    /// A depth outside the working volume.
    OutOfVolume = 8,
    /// The measured row disagrees with the row that column and calibration predict.
    RowGate = 9,
    /// Disagrees with its neighbourhood.
    Vote = 10,
    /// A coarse bit weak far from its own edges.
    Interreflection = 11,
}

impl Class {
    /// All classes in order of their numbers.
    pub const ALL: [Self; 12] = [
        Self::Unlit,
        Self::Valid,
        Self::Edge,
        Self::Inverted,
        Self::Saturated,
        Self::Ambiguous,
        Self::OffBoundary,
        Self::OutOfProjector,
        Self::OutOfVolume,
        Self::RowGate,
        Self::Vote,
        Self::Interreflection,
    ];

    /// Whether the pixel carries a measurement.
    #[inline(always)]
    pub fn is_valid(self) -> bool {
        matches!(self, Self::Valid | Self::Edge | Self::Inverted)
    }

    /// Whether the pixel saw projector light (everything but `Unlit`).
    #[inline(always)]
    pub fn is_lit(self) -> bool {
        self != Self::Unlit
    }
}

/// Result of one axis. Coordinates and sigmas are NaN wherever the class is not a valid one.
#[derive(Debug, Clone, PartialEq)]
pub struct AxisMap {
    /// Integer index decoded from the word, -1 where there is none. Pixels that only a gate over their neighbourhood
    /// rejected (`OffBoundary`, `Vote`, `Interreflection`) keep theirs, so that a gate's effect can be measured: the
    /// class alone says whether a pixel is valid.
    pub code: Grid<i32>,
    /// Sub-pixel projector coordinate, pixel centres at integers.
    pub coordinate: Grid<f32>,
    /// Standard deviation of `coordinate` in projector px, from the noise model through the fit.
    pub sigma: Grid<f32>,
}

/// Statistics of the pair sum `P + Q - (R_H + R_V)` of one pair over unsaturated lit pixels, in units of its sigma.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PairResidual {
    /// Axis of the pair.
    pub axis: Axis,
    /// Bit of the pair.
    pub bit: u8,
    /// 1.4826 times the median absolute deviation; 1.00 when all is well.
    pub sigma: f64,
    /// Median, signed: a common brightness change.
    pub median: f64,
    /// Share of flat pixels (those whose bit is not within 2 px of a stripe edge) beyond 5 sigma.
    pub flat_outliers: f64,
    /// Share of the pixels near a stripe edge beyond 5 sigma.
    pub edge_outliers: f64,
    /// Number of pixels looked at.
    pub pixels: u64,
}

/// Result of a decode, before anything that needs a calibration.
#[derive(Debug, Clone)]
pub struct Decoded {
    /// Columns.
    pub column: AxisMap,
    /// Rows, where they were coded.
    pub row: Option<AxisMap>,
    /// Class per pixel after all gates that need no calibration.
    pub class: Grid<Class>,
    /// Whether one frame of some pair was saturated there.
    pub half_saturated: Grid<bool>,
    /// Whether the column was interpolated between edges (rather than measured at one).
    pub interpolated: Grid<bool>,
    /// Modulation C = R_H - R_V (white - black) in DN.
    pub modulation: Grid<f32>,
    /// Root mean square over the pairs of the pair-sum residual, in sigma; NaN where it is not defined.
    pub residual: Grid<f32>,
    /// Degree of linear polarization (R_H - R_V) / (R_H + R_V) clipped to [0, 1], 0/0 = 0.
    pub dolp: Grid<f32>,
    /// Brightest reference scaled to 0..=255 of full scale, for pictures and the cloud's intensity.
    pub intensity: Grid<u8>,
    /// Noise that was used.
    pub noise: NoiseModel,
    /// Whether `noise` was estimated from the frames.
    pub noise_estimated: bool,
    /// Black level that was subtracted, in DN.
    pub black_level_dn: f64,
    /// Residual of each pair in order of axis and bit.
    pub pairs: Vec<PairResidual>,
    /// Crossings of each bit at legal and illegal places, in order of axis and bit.
    pub boundaries: Vec<BoundaryCheck>,
    /// Last minus first reference, median over lit pixels as a share of the modulation, where there are two.
    pub drift: Option<f64>,
    /// What was lost by missing frames, in words.
    pub losses: Vec<String>,
}

/// Why frames cannot be decoded.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DecodeError {
    /// Settings that no frames can be decoded with.
    #[error("decode settings cannot be used: {reason}")]
    Settings {
        /// What is wrong and what would be right.
        reason: String,
    },
    /// A plane has the wrong number of samples.
    #[error("frame {role} has {found} samples, expected {expected}")]
    Size {
        /// What the frame shows.
        role: Role,
        /// Samples of the plane.
        found: usize,
        /// Samples of a frame.
        expected: usize,
    },
    /// Planes of 8 and 16 bits are mixed.
    #[error("frame {role} has another sample type than the frames before it")]
    Mixed {
        /// What the frame shows.
        role: Role,
    },
    /// A role that the code does not have.
    #[error("frame {role} is not part of a code of {bits} bits")]
    UnknownBit {
        /// What the frame shows.
        role: Role,
        /// Bits of the axis.
        bits: u8,
    },
    /// A role twice, where only references may repeat.
    #[error("frame {role} occurs twice")]
    Repeated {
        /// What the frame shows.
        role: Role,
    },
    /// The mode cannot do without a frame.
    #[error("mode {mode} cannot decode without {missing}")]
    Missing {
        /// Mode.
        mode: Mode,
        /// What is missing, in words.
        missing: String,
    },
}

/// Handle to a plane that outlives the call.
pub type SharedPlane = Arc<dyn PlaneSource>;
