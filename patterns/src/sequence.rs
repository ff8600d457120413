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

impl Role {
    /// The picture that the role shows as one word, for file names and the command line: `reference-v`, `white`,
    /// `column-0`, `row-9-inverse`.
    pub fn slug(self) -> String {
        match self {
            Self::Code { axis, bit, inverse } => {
                format!("{axis}-{bit}{}", if inverse { "-inverse" } else { "" })
            }
            reference => reference.to_string(),
        }
    }

    /// The other frame of the pair, `None` for a reference.
    pub fn opposite(self) -> Option<Self> {
        match self {
            Self::Code { axis, bit, inverse } => Some(Self::Code { axis, bit, inverse: !inverse }),
            _ => None,
        }
    }
}

impl FromStr for Role {
    type Err = String;

    /// Reads a [slug](Role::slug).
    fn from_str(text: &str) -> Result<Self, Self::Err> {
        for role in [Self::ReferenceV, Self::ReferenceH, Self::White, Self::Black] {
            if text == role.slug() {
                return Ok(role);
            }
        }
        let (pattern, inverse) = match text.strip_suffix("-inverse") {
            Some(pattern) => (pattern, true),
            None => (text, false),
        };
        let code = pattern.split_once('-').and_then(|(axis, bit)| {
            let axis = [Axis::Column, Axis::Row].into_iter().find(|known| known.to_string() == axis)?;
            // Digits only: `parse` alone would let a sign pass.
            let bit = bit.bytes().all(|byte| byte.is_ascii_digit()).then(|| bit.parse().ok())??;
            Some(Self::Code { axis, bit, inverse })
        });
        code.ok_or_else(|| {
            format!(
                "pattern `{text}` is none of reference-v, reference-h, white, black, column-BIT, row-BIT, \
                 column-BIT-inverse, row-BIT-inverse"
            )
        })
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

    /// Whether there is a picture for `role`: every uniform one, and the bits of the two codes (also where the mode
    /// shows none of them).
    pub fn can_show(&self, role: Role) -> bool {
        match role {
            Role::Code { axis, bit, .. } => bit < self.code(axis).bits(),
            _ => true,
        }
    }

    /// Projector that the sequence is for.
    pub fn size(&self) -> ProjectorSize {
        ProjectorSize { width: self.column.size(), height: self.row.size() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn sequence(mode: Mode, width: u32, height: u32) -> Sequence {
        Sequence::new(mode, ProjectorSize { width, height }).unwrap()
    }

    #[test]
    fn frame_counts_of_the_paper_s_projector() {
        let counts = [Mode::Paper, Mode::Pse, Mode::Fast, Mode::Gray]
            .map(|mode| sequence(mode, 1024, 768).roles.len());
        assert_eq!(counts, [41, 44, 24, 44]);
    }

    #[test]
    fn codes_are_centred_except_in_the_paper_s_mode() {
        for mode in Mode::ALL {
            let sequence = sequence(mode, 1024, 768);
            assert_eq!(sequence.column.offset(), 0);
            assert_eq!(sequence.row.offset(), if mode == Mode::Paper { 0 } else { 128 });
            assert_eq!(sequence.size(), ProjectorSize { width: 1024, height: 768 });
        }
    }

    #[test]
    fn a_sequence_in_full() {
        let slugs =
            |mode| sequence(mode, 3, 2).roles.iter().map(|role| role.slug()).collect::<Vec<_>>().join(" ");
        let columns = "column-0 column-0-inverse column-1 column-1-inverse";
        let rows = "row-0 row-0-inverse";
        assert_eq!(slugs(Mode::Paper), format!("reference-v {columns} {rows}"));
        let (first, last) = ("reference-v reference-h", "reference-v reference-h");
        assert_eq!(slugs(Mode::Pse), format!("{first} {columns} {rows} {last}"));
        assert_eq!(slugs(Mode::Fast), format!("{first} {columns} {last}"));
        assert_eq!(slugs(Mode::Gray), format!("black white {columns} {rows} black white"));
    }

    #[test]
    fn a_side_of_one_pixel_has_no_frames() {
        assert_eq!(sequence(Mode::Pse, 1, 1).roles.len(), 4);
        assert_eq!(sequence(Mode::Paper, 1, 8).roles.len(), 1 + 6);
        assert_eq!(sequence(Mode::Fast, 1, 8).roles.len(), 4);
        assert!(!sequence(Mode::Pse, 1, 1).can_show(Role::Code { axis: Axis::Row, bit: 0, inverse: false }));
    }

    #[test]
    fn sides_out_of_range_are_refused() {
        for (width, height) in [(0, 768), (1024, 0), (8193, 768), (1024, u32::MAX)] {
            for mode in Mode::ALL {
                assert!(Sequence::new(mode, ProjectorSize { width, height }).is_err(), "{width}x{height}");
            }
        }
    }

    #[test]
    fn modes_read_back() {
        for mode in Mode::ALL {
            assert_eq!(mode.to_string().parse(), Ok(mode));
        }
        assert_eq!("PSE".parse::<Mode>(), Err("mode `PSE` is none of paper, pse, fast, gray".to_string()));
    }

    #[test]
    fn roles_have_the_public_json_shape() {
        let role = Role::Code { axis: Axis::Column, bit: 3, inverse: true };
        let text = r#"{"role":"code","axis":"column","bit":3,"inverse":true}"#;
        assert_eq!(serde_json::to_string(&role).unwrap(), text);
        assert_eq!(serde_json::from_str::<Role>(text).unwrap(), role);
        let plain = r#"{"role":"code","axis":"row","bit":0}"#;
        let role = Role::Code { axis: Axis::Row, bit: 0, inverse: false };
        assert_eq!(serde_json::to_string(&role).unwrap(), plain);
        assert_eq!(serde_json::from_str::<Role>(plain).unwrap(), role);
        assert_eq!(serde_json::to_string(&Role::ReferenceV).unwrap(), r#"{"role":"reference-v"}"#);
    }

    #[test]
    fn what_is_no_pattern_is_refused() {
        for text in [
            "",
            "column",
            "column-",
            "column--1",
            "column-+1",
            "column-256",
            "depth-1",
            "row-1-inverse-inverse",
        ] {
            assert!(text.parse::<Role>().is_err(), "{text}");
        }
    }

    proptest! {
        #[test]
        fn sequences_show_each_bit_once_with_its_inverse_next(
            width in 1u32..=8192, height in 1u32..=8192, mode in proptest::sample::select(&Mode::ALL[..]),
        ) {
            let sequence = sequence(mode, width, height);
            let codes: Vec<Role> =
                sequence.roles.iter().copied().filter(|role| matches!(role, Role::Code { .. })).collect();
            let bits = |axis| match (mode, axis) {
                (Mode::Fast, Axis::Row) => 0,
                _ => u32::from(sequence.code(axis).bits()),
            };
            prop_assert_eq!(codes.len() as u32, 2 * (bits(Axis::Column) + bits(Axis::Row)));
            for pair in codes.chunks(2) {
                prop_assert_eq!(pair[0].opposite(), Some(pair[1]));
                prop_assert_eq!(codes.iter().filter(|&&role| role == pair[0]).count(), 1);
            }
            for &role in &sequence.roles {
                prop_assert!(sequence.can_show(role));
                prop_assert_eq!(role.slug().parse(), Ok(role));
            }
        }
    }
}
