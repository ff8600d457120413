//! `polscan calibrate board`, and reading what it writes.

use std::{
    fs,
    io::Write as _,
    path::{Path, PathBuf},
};

use crate::{
    calibration::boards::{Board, Charuco, Checkerboard, Circles, Dictionary, Pattern, Tones, pdf},
    commands::say,
    engine::Failure,
};

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Description of a board to print again, instead of the options below.
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// What is on it.
    #[arg(long, default_value = "charuco", conflicts_with = "board")]
    kind: Kind,
    /// Squares or circles in a row.
    #[arg(long, default_value_t = 11, conflicts_with = "board")]
    columns: u32,
    /// Squares or circles in a column.
    #[arg(long, default_value_t = 8, conflicts_with = "board")]
    rows: u32,
    /// Side of a square, or distance of circles in a row.
    #[arg(long, value_name = "MM", default_value_t = 15.0, conflicts_with = "board")]
    square_mm: f64,
    /// Side of a marker; three quarters of a square by default.
    #[arg(long, value_name = "MM", conflicts_with = "board")]
    marker_mm: Option<f64>,
    /// Bits along a marker's side: 4, 5, 6 or 7.
    #[arg(long, value_name = "BITS", default_value_t = 4, conflicts_with = "board")]
    marker_bits: u8,
    /// Diameter of a circle; half the distance, or 0.45 of it where they are staggered, by default.
    #[arg(long, value_name = "MM", conflicts_with = "board")]
    diameter_mm: Option<f64>,
    /// Layout of ChArUco boards made before OpenCV 4.6.
    #[arg(long, conflicts_with = "board")]
    legacy: bool,
    /// Tone of dark parts, 0 black to 1 white. Stripes cannot be decoded on black ones.
    #[arg(long, default_value_t = Tones::default().dark, conflicts_with = "board")]
    dark: f64,
    /// Page to write, such as board.pdf; the description goes beside it, as board.toml.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

/// Kinds of boards.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Kind {
    Charuco,
    Checkerboard,
    Circles,
    AsymmetricCircles,
}

impl Args {
    fn board(&self) -> Result<Board, Failure> {
        if let Some(file) = &self.board {
            return read(file, None);
        }
        let (columns, rows, square_mm) = (self.columns, self.rows, self.square_mm);
        let circles = |asymmetric, share: f64| {
            let diameter_mm = self.diameter_mm.unwrap_or(share * square_mm);
            Pattern::Circles(Circles { columns, rows, pitch_mm: square_mm, diameter_mm, asymmetric })
        };
        let pattern = match self.kind {
            Kind::Checkerboard => Pattern::Checkerboard(Checkerboard { columns, rows, square_mm }),
            Kind::Circles => circles(false, 0.5),
            Kind::AsymmetricCircles => circles(true, 0.45),
            Kind::Charuco => {
                let dictionary = match self.marker_bits {
                    4 => Dictionary::Bits4,
                    5 => Dictionary::Bits5,
                    6 => Dictionary::Bits6,
                    7 => Dictionary::Bits7,
                    bits => {
                        let message = format!("--marker-bits is {bits}, expected 4, 5, 6 or 7");
                        return Err(Failure::data("make a board", message));
                    }
                };
                let marker_mm = self.marker_mm.unwrap_or(0.75 * square_mm);
                let legacy = self.legacy;
                Pattern::Charuco(Charuco { columns, rows, square_mm, marker_mm, dictionary, legacy })
            }
        };
        let mut board = Board::new(pattern);
        board.tones.dark = self.dark;
        checked(board, "make a board")
    }
}

/// Writes page and description; returns the exit code.
pub fn run(args: &Args, json: bool) -> Result<u8, Failure> {
    let board = args.board()?;
    let description = args.out.with_extension("toml");
    if description == args.out {
        return Err(Failure::data(
            "make a board",
            "--out names the page: give it another ending than .toml, such as .pdf",
        ));
    }
    let text = toml::to_string(&board).map_err(|error| Failure::storage("write the board", error))?;
    write_new(&args.out, &pdf::pdf(&board))?;
    if args.board.as_ref().is_none_or(|given| *given != description) {
        write_new(&description, text.as_bytes())?;
    }
    let page_mm = pdf::page_mm(&board);
    if json {
        say(
            serde_json::json!({ "out": args.out, "description": description, "page_mm": page_mm, "board": board }),
        );
    } else {
        say(format_args!("{}: {}, {} x {} mm", args.out.display(), board.summary(), page_mm[0], page_mm[1]));
        say(format_args!("{}: its description, for --board", description.display()));
        say("print at 100 %, measure the bar, and give its length as --measured-mm");
    }
    Ok(0)
}

/// Files that are there are never overwritten.
fn write_new(path: &Path, bytes: &[u8]) -> Result<(), Failure> {
    let operation = || format!("write {}", path.display());
    let file = fs::OpenOptions::new().write(true).create_new(true).open(path);
    let mut file = file.map_err(|error| Failure::storage(operation(), error))?;
    file.write_all(bytes).map_err(|error| Failure::storage(operation(), error))
}

/// Reads the description of a board; `measured_mm` comes before what it says of its bar.
pub fn read(path: &Path, measured_mm: Option<f64>) -> Result<Board, Failure> {
    let operation = format!("read the board {}", path.display());
    let text = fs::read_to_string(path).map_err(|error| Failure::data(operation.clone(), error))?;
    let mut board: Board = toml::from_str(&text).map_err(|error| Failure::data(operation.clone(), error))?;
    board.measured_mm = measured_mm.or(board.measured_mm);
    checked(board, &operation)
}

fn checked(board: Board, operation: &str) -> Result<Board, Failure> {
    let faults = board.faults();
    if faults.is_empty() { Ok(board) } else { Err(Failure::data(operation, faults.join("; "))) }
}
