//! Which frames a scan consists of and in which order.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use crate::{AxisCode, CodeError};

/// How a scan codes and decodes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// The paper's sequence: one uniform V reference, polarization-coded pairs, decoded by degree of linear polarization.
    Paper,
    /// Polarization-coded pairs of both axes between two sets of V and H references.
    Pse,
    /// As [`Mode::Pse`], columns only.
    Fast,
    /// Ordinary intensity Gray code between black and white references.
    Gray,
}

impl Mode {
    /// All modes, in the order of the documentation.
    pub const ALL: [Self; 4] = [Self::Paper, Self::Pse, Self::Fast, Self::Gray];

    /// Name used on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Paper => "paper",
            Self::Pse => "pse",
            Self::Fast => "fast",
            Self::Gray => "gray",
        }
    }

    /// Whether the patterns differ by polarization (rather than by intensity).
    pub fn is_polarized(self) -> bool {
        self != Self::Gray
    }
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for Mode {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Self::ALL
            .into_iter()
            .find(|mode| mode.name() == text)
            .ok_or_else(|| format!("mode `{text}` is none of paper, pse, fast, gray"))
    }
}

/// A projector axis: columns vary along x, rows along y.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Axis {
    /// Index along x.
    Column,
    /// Index along y.
    Row,
}

impl fmt::Display for Axis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Column => "column",
            Self::Row => "row",
        })
    }
}

/// What one frame of a scan shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(tag = "role", rename_all = "kebab-case", deny_unknown_fields)]
pub enum Role {
    /// Uniform vertical polarization: what the analyser blocks.
    ReferenceV,
    /// Uniform horizontal polarization: what the analyser passes.
    ReferenceH,
    /// Uniform full intensity.
    White,
    /// Projector black.
    Black,
    /// One bit of the code of one axis.
    Code {
        /// Coded axis.
        axis: Axis,
        /// Bit, 0 = most significant.
        bit: u8,
        /// Whether light and dark (H and V) are exchanged.
        #[serde(default, skip_serializing_if = "std::ops::Not::not")]
        inverse: bool,
    },
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::ReferenceV => f.write_str("reference-v"),
            Self::ReferenceH => f.write_str("reference-h"),
            Self::White => f.write_str("white"),
            Self::Black => f.write_str("black"),
            Self::Code { axis, bit, inverse } => {
                write!(f, "{axis} bit {bit}{}", if *inverse { " inverse" } else { "" })
            }
        }
    }
}

/// Width and height of a projector in pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProjectorSize {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// The frames of one scan in the order in which they are shown, and the codes they carry.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Sequence {
    /// Mode that the sequence belongs to.
    pub mode: Mode,
    /// Code of the columns.
    pub column: AxisCode,
    /// Code of the rows. Present in mode `fast` too, where no frame carries it.
    pub row: AxisCode,
    /// What each frame shows.
    pub roles: Vec<Role>,
}

impl Sequence {
    /// The sequence of `mode` for a projector of `size`.
    pub fn new(mode: Mode, size: ProjectorSize) -> Result<Self, CodeError> {
        let code = |side| if mode == Mode::Paper { AxisCode::plain(side) } else { AxisCode::centred(side) };
        let (column, row) = (code(size.width)?, code(size.height)?);
        let references: &[Role] = match mode {
            Mode::Paper => &[Role::ReferenceV],
            Mode::Pse | Mode::Fast => &[Role::ReferenceV, Role::ReferenceH],
            Mode::Gray => &[Role::Black, Role::White],
        };
        let axes: &[(Axis, AxisCode)] = match mode {
            Mode::Fast => &[(Axis::Column, column)],
            _ => &[(Axis::Column, column), (Axis::Row, row)],
        };
        let mut roles = references.to_vec();
        for &(axis, code) in axes {
            for bit in 0..code.bits() {
                roles.extend([false, true].map(|inverse| Role::Code { axis, bit, inverse }));
            }
        }
        if mode != Mode::Paper {
            roles.extend_from_slice(references);
        }
        Ok(Self { mode, column, row, roles })
    }

    /// Code of `axis`.
    pub fn code(&self, axis: Axis) -> AxisCode {
        match axis {
            Axis::Column => self.column,
            Axis::Row => self.row,
        }
    }

    /// Projector that the sequence is for.
    pub fn size(&self) -> ProjectorSize {
        ProjectorSize { width: self.column.size(), height: self.row.size() }
    }
}
