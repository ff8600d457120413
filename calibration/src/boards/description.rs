//! What a calibration board looks like: the description that is printed, found again and measured by.

use serde::{Deserialize, Serialize};

use super::dictionary::Dictionary;

/// Name and version of the file format.
pub const SCHEMA: &str = "polscan.board/1";
/// Length of the bar that is printed beside every board, in mm.
pub const BAR_MM: f64 = 100.0;
/// A print whose bar is off by a larger share was not printed at 100 %, or another length was measured.
pub const MAX_PRINT_ERROR: f64 = 0.05;

/// A board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Board {
    /// [`SCHEMA`].
    #[serde(default = "schema")]
    pub schema: String,
    /// Measured length of the printed bar of [`BAR_MM`]: what a printer really made of the sizes below.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub measured_mm: Option<f64>,
    /// What is on it.
    pub pattern: Pattern,
    /// How dark and how light it is printed.
    #[serde(default)]
    pub tones: Tones,
}

fn schema() -> String {
    SCHEMA.into()
}

/// What is on a board.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pattern {
    /// Dark and light squares, the top left one dark. It must be seen whole. Turned by half a turn it looks the same
    /// where columns + rows are even: then the numbers of its corners may start at either end, which costs a
    /// calibration nothing, since each view has a pose of its own.
    Checkerboard(Checkerboard),
    /// A checkerboard with markers in its light squares: parts of it are enough, and its numbers are the same however
    /// it is turned.
    Charuco(Charuco),
    /// Dark discs on a light ground.
    Circles(Circles),
}

/// Squares.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Checkerboard {
    /// Squares in a row.
    pub columns: u32,
    /// Squares in a column.
    pub rows: u32,
    /// Side of a square.
    pub square_mm: f64,
}

/// Squares with markers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Charuco {
    /// Squares in a row.
    pub columns: u32,
    /// Squares in a column.
    pub rows: u32,
    /// Side of a square.
    pub square_mm: f64,
    /// Side of a marker, its dark border included.
    pub marker_mm: f64,
    /// Markers.
    pub dictionary: Dictionary,
    /// Layout of OpenCV before 4.6: with an even number of rows the top left square is light and bears marker 0.
    #[serde(default)]
    pub legacy: bool,
}

/// Discs.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Circles {
    /// Discs in a row.
    pub columns: u32,
    /// Rows.
    pub rows: u32,
    /// Between the centres of neighbours in a row; between rows the same, or half of it where they are staggered.
    pub pitch_mm: f64,
    /// Diameter of a disc.
    pub diameter_mm: f64,
    /// Every second row is shifted by half a pitch. With an odd number of rows the numbers are then the same however
    /// the board is turned.
    #[serde(default)]
    pub asymmetric: bool,
}

/// Tones as shares of the paper's white.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tones {
    /// Dark parts. Grey by default: projected stripes cannot be decoded on black ones.
    pub dark: f64,
    /// Light parts.
    pub light: f64,
}

impl Default for Tones {
    fn default() -> Self {
        Self { dark: 0.4, light: 1.0 }
    }
}

/// A marked point of a board.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Number.
    pub id: u32,
    /// Place on the board from its top left corner, x right, y down, in mm.
    pub board_mm: [f64; 2],
}

impl Board {
    /// A board in the default tones.
    pub fn new(pattern: Pattern) -> Self {
        Self { schema: schema(), measured_mm: None, pattern, tones: Tones::default() }
    }

    /// Every fault, each with its key. Empty where the board can be used.
    pub fn faults(&self) -> Vec<String> {
        let mut faults = Vec::new();
        if self.schema != SCHEMA {
            faults.push(format!("schema is `{}`, expected `{SCHEMA}`", self.schema));
        }
        let Tones { dark, light } = self.tones;
        if !(0.0..=1.0).contains(&dark) || !(0.0..=1.0).contains(&light) {
            faults.push(format!("tones.dark is {dark} and tones.light {light}, expected 0 to 1"));
        } else if light - dark < 0.2 {
            faults.push(format!(
                "tones.light is {light}, only {:.2} above tones.dark; corners need 0.2 of contrast",
                light - dark
            ));
        }
        if let Some(measured) = self.measured_mm {
            let share = measured / BAR_MM - 1.0;
            // NaN is no measurement either.
            if share.is_nan() || share.abs() > MAX_PRINT_ERROR {
                faults.push(format!(
                    "measured_mm is {measured}, more than {:.0} % off the bar's {BAR_MM} mm: print again at 100 % \
                     (\"actual size\"), and measure the bar from end to end",
                    100.0 * MAX_PRINT_ERROR
                ));
            }
        }
        self.pattern.faults(&mut faults);
        faults
    }

    /// Real over intended size.
    pub fn scale(&self) -> f64 {
        self.measured_mm.map_or(1.0, |measured| measured / BAR_MM)
    }

    /// Marked points in order of their numbers, at their measured places.
    pub fn points(&self) -> Vec<Point> {
        let scale = self.scale();
        let places: Vec<[f64; 2]> = match &self.pattern {
            Pattern::Checkerboard(Checkerboard { columns, rows, square_mm })
            | Pattern::Charuco(Charuco { columns, rows, square_mm, .. }) => {
                let inner = |row| (1..*columns).map(move |column| (column, row));
                let at = |(column, row)| [f64::from(column) * square_mm, f64::from(row) * square_mm];
                (1..*rows).flat_map(inner).map(at).collect()
            }
            Pattern::Circles(circles) => {
                let row = |row| (0..circles.columns).map(move |column| circles.centre(column, row));
                (0..circles.rows).flat_map(row).collect()
            }
        };
        let numbered = places.into_iter().zip(0..);
        numbered.map(|(at, id)| Point { id, board_mm: at.map(|value| value * scale) }).collect()
    }

    /// Width and height of the printed pattern in mm as intended, without margins.
    pub fn size_mm(&self) -> [f64; 2] {
        match &self.pattern {
            Pattern::Checkerboard(Checkerboard { columns, rows, square_mm })
            | Pattern::Charuco(Charuco { columns, rows, square_mm, .. }) => {
                [f64::from(*columns) * square_mm, f64::from(*rows) * square_mm]
            }
            Pattern::Circles(circles) => {
                let last = |row| circles.centre(circles.columns - 1, row);
                let half = 0.5 * circles.pitch_mm;
                [last(0)[0].max(last(1)[0]) + half, last(circles.rows - 1)[1] + half]
            }
        }
    }

    /// What a person calls it.
    pub fn summary(&self) -> String {
        match &self.pattern {
            Pattern::Checkerboard(board) => {
                format!("checkerboard, {} x {} squares of {} mm", board.columns, board.rows, board.square_mm)
            }
            Pattern::Charuco(board) => {
                let side = board.dictionary.side();
                let legacy = if board.legacy { ", layout before OpenCV 4.6" } else { "" };
                format!(
                    "ChArUco, {} x {} squares of {} mm, {side}x{side} markers of {} mm{legacy}",
                    board.columns, board.rows, board.square_mm, board.marker_mm
                )
            }
            Pattern::Circles(board) => {
                let kind = if board.asymmetric { "staggered circles" } else { "circles" };
                format!(
                    "{kind}, {} x {} of {} mm, {} mm apart",
                    board.columns, board.rows, board.diameter_mm, board.pitch_mm
                )
            }
        }
    }
}

impl Pattern {
    fn faults(&self, faults: &mut Vec<String>) {
        let mut count = |key: &str, value: u32, least: u32| {
            if !(least..=100).contains(&value) {
                faults.push(format!("{key} is {value}, expected {least} to 100"));
            }
        };
        match self {
            Self::Checkerboard(Checkerboard { columns, rows, .. })
            | Self::Charuco(Charuco { columns, rows, .. }) => {
                count("pattern.columns", *columns, 3);
                count("pattern.rows", *rows, 3);
            }
            Self::Circles(Circles { columns, rows, .. }) => {
                count("pattern.columns", *columns, 2);
                count("pattern.rows", *rows, 3);
            }
        }
        let mut length = |key: &str, value: f64, most: f64| {
            if !(value > 0.1 && value < most) {
                faults.push(format!("{key} is {value}, expected more than 0.1 and less than {most} mm"));
            }
        };
        match self {
            Self::Checkerboard(board) => length("pattern.square_mm", board.square_mm, 1000.0),
            Self::Charuco(board) => {
                length("pattern.square_mm", board.square_mm, 1000.0);
                length("pattern.marker_mm", board.marker_mm, board.square_mm);
            }
            Self::Circles(board) => {
                length("pattern.pitch_mm", board.pitch_mm, 1000.0);
                // Staggered neighbours are 0.707 of a pitch apart.
                let apart = if board.asymmetric { 0.7 * board.pitch_mm } else { board.pitch_mm };
                length("pattern.diameter_mm", board.diameter_mm, 0.9 * apart);
            }
        }
        if let Self::Charuco(board) = self {
            let light = board.columns.saturating_mul(board.rows) / 2;
            if light > 1000 {
                faults.push(format!("pattern has {light} light squares, a dictionary only 1000 markers"));
            }
        }
    }
}

impl Circles {
    /// Centre of a disc, in mm as intended.
    pub(super) fn centre(&self, column: u32, row: u32) -> [f64; 2] {
        let (column, row) = (f64::from(column), f64::from(row));
        let half = 0.5 * self.pitch_mm;
        match self.asymmetric {
            true => [half + self.pitch_mm * column + half * (row % 2.0), half + half * row],
            false => [half + self.pitch_mm * column, half + self.pitch_mm * row],
        }
    }
}

impl Charuco {
    /// Squares that bear a marker, in order of the markers' numbers.
    pub(super) fn marked_squares(&self) -> Vec<[u32; 2]> {
        let shifted = u32::from(self.legacy && self.rows.is_multiple_of(2));
        let row = |row| (0..self.columns).map(move |column| [column, row]);
        (0..self.rows).flat_map(row).filter(|[column, row]| (column + row + shifted) % 2 == 1).collect()
    }
}
