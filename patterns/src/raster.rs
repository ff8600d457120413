//! The pixels of each pattern.

use serde::{Deserialize, Serialize};

use crate::{Axis, Role, Sequence};

/// Code values of one projector pixel: red, green, blue.
pub type Rgb = [u8; 3];

/// Which colour channels of the projector carry one polarization state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelSet {
    /// Red panel.
    pub red: bool,
    /// Green panel.
    pub green: bool,
    /// Blue panel.
    pub blue: bool,
}

impl ChannelSet {
    /// Full drive of the channels of the set.
    pub fn rgb(self) -> Rgb {
        [self.red, self.green, self.blue].map(|on| if on { 255 } else { 0 })
    }
}

/// Which channels leave the projector horizontally and which vertically polarized.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Polarization {
    /// Channels with horizontal polarization.
    pub horizontal: ChannelSet,
    /// Channels with vertical polarization.
    pub vertical: ChannelSet,
}

/// A picture of a projector's size in its most compact form.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Raster {
    /// One value everywhere.
    Uniform(Rgb),
    /// One value per column, the same in all rows.
    Columns(Vec<Rgb>),
    /// One value per row, the same in all columns.
    Rows(Vec<Rgb>),
    /// Row-major values of all pixels.
    Full(Vec<Rgb>),
}

/// A still picture for set-up, held with `polscan show`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Picture {
    /// All channels full.
    White,
    /// All channels off.
    Black,
    /// Uniform horizontal polarization.
    H,
    /// Uniform vertical polarization.
    V,
    /// Fine detail in the centre and the corners, to focus on.
    Focus,
    /// Centre and border lines, to aim.
    Crosshair,
    /// Checker of single pixels, to prove 1:1 display.
    Checker,
}

impl Sequence {
    /// The picture that frame `role` shows. `polarization` is unused by mode `gray`.
    pub fn raster(&self, role: Role, polarization: Polarization) -> Raster {
        match role {
            Role::ReferenceV => Raster::Uniform(polarization.vertical.rgb()),
            Role::ReferenceH => Raster::Uniform(polarization.horizontal.rgb()),
            Role::White => Raster::Uniform([255; 3]),
            Role::Black => Raster::Uniform([0; 3]),
            Role::Code { axis, bit, inverse } => {
                let (high, low) = match self.mode.is_polarized() {
                    true => (polarization.horizontal.rgb(), polarization.vertical.rgb()),
                    false => ([255; 3], [0; 3]),
                };
                let code = self.code(axis);
                let values = (0..code.size())
                    .map(|index| if code.bit(index, bit) != inverse { high } else { low })
                    .collect();
                match axis {
                    Axis::Column => Raster::Columns(values),
                    Axis::Row => Raster::Rows(values),
                }
            }
        }
    }
}
