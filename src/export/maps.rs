//! Which maps there are, and how their values become whole numbers.

use serde::Serialize;

use crate::{grid::Grid, store::maps::Maps};

/// Largest sample; 0 stands for "no value".
const MOST: f64 = 65_535.0;

/// One of the arrays of `maps.npz`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum MapName {
    /// z in the camera frame.
    Depth,
    /// Projector column.
    Column,
    /// Projector row.
    Row,
    /// Pair-sum residual.
    Residual,
    /// Modulation.
    Modulation,
    /// Why a pixel has a value, or has none.
    Class,
    /// Where there is a measurement.
    Mask,
}

impl MapName {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::Depth, Self::Column, Self::Row, Self::Residual, Self::Modulation, Self::Class, Self::Mask];

    /// As in `maps.npz`.
    pub fn name(self) -> &'static str {
        match self {
            Self::Depth => "depth",
            Self::Column => "column",
            Self::Row => "row",
            Self::Residual => "residual",
            Self::Modulation => "modulation",
            Self::Class => "class",
            Self::Mask => "mask",
        }
    }

    /// Unit of its values.
    pub fn unit(self) -> &'static str {
        match self {
            Self::Depth => "mm",
            Self::Column | Self::Row => "px",
            Self::Residual => "sigma",
            Self::Modulation => "DN",
            Self::Class | Self::Mask => "1",
        }
    }

    /// Its values; `None` for class and mask.
    pub(super) fn values(self, maps: &Maps) -> Option<&Grid<f32>> {
        match self {
            Self::Depth => Some(&maps.depth_mm),
            Self::Column => Some(&maps.column),
            Self::Row => Some(&maps.row),
            Self::Residual => Some(&maps.residual),
            Self::Modulation => Some(&maps.modulation),
            Self::Class | Self::Mask => None,
        }
    }

    /// Whether any pixel has a value.
    pub(super) fn has_values(self, maps: &Maps) -> bool {
        self.values(maps).is_none_or(|values| values.data().iter().any(|value| value.is_finite()))
    }
}

/// How a sample is read as a value: `offset + scale * sample`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scale {
    /// Value of one step.
    pub scale: f64,
    /// Value of the sample 0, which itself stands for "no value".
    pub offset: f64,
}

impl Scale {
    /// The finest step of 1, 2 or 5 times a power of ten by which the samples 1 to 65535 hold all values, so that scans of one
    /// rig mostly have the same; the offset is a multiple of the step. Values that are not finite do not count.
    pub fn of(values: &[f32]) -> Self {
        let finite = || values.iter().filter(|value| value.is_finite()).map(|value| f64::from(*value));
        let (low, high) = finite()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        if low > high {
            return Self { scale: 1.0, offset: 0.0 };
        }
        // A step far below the resolution of a float would only count its rounding.
        let span = (high - low).max(1e-6 * low.abs().max(high.abs())).max(1e-30);
        let mut power = (span / MOST).log10().floor() as i32;
        loop {
            for digit in [1, 2, 5] {
                let scale = decimal(f64::from(digit), power);
                let first = (low / scale).floor() - 1.0;
                if (high / scale).round() - first <= MOST {
                    return Self { scale, offset: decimal(first * f64::from(digit), power) };
                }
            }
            power += 1;
        }
    }

    /// Sample of a value: 0 for one that is not finite.
    pub fn sample(&self, value: f32) -> u16 {
        match value.is_finite() {
            true => ((f64::from(value) - self.offset) / self.scale).round().clamp(1.0, MOST) as u16,
            false => 0,
        }
    }
}

/// The double that is written as `mantissa` times ten to the `power`: neither 0.020000000000000004 nor its like.
fn decimal(mantissa: f64, power: i32) -> f64 {
    format!("{mantissa}e{power}").parse().unwrap_or(mantissa * 10_f64.powi(power))
}

/// What a picture says of its samples: in the file itself, and beside it.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Key {
    /// Name of the map.
    pub map: &'static str,
    /// Unit of its values.
    pub unit: &'static str,
    /// `offset + scale * sample` is the value.
    #[serde(flatten)]
    pub scale: Scale,
    /// Sample that stands for "no value"; absent where each sample is one, and for floats, where it is NaN.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub no_value: Option<u16>,
    /// Bits of a sample.
    pub bits: u8,
    /// Pixels with a value.
    pub values: usize,
}
