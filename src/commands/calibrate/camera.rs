//! `polscan calibrate camera`.

use std::path::PathBuf;

use super::{board, limits::Limits, output::print};
use crate::{
    calibrate::{
        Output,
        rig::{Subject, Views, name_of, read_picture, solve},
    },
    calibration::boards::DetectSettings,
    engine::Failure,
};

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Description of the board, as `polscan calibrate board` writes it.
    #[arg(long, value_name = "FILE")]
    board: PathBuf,
    /// Measured length of the board's printed bar.
    #[arg(long, value_name = "MM")]
    measured_mm: Option<f64>,
    /// Pictures of the board.
    #[arg(long, value_name = "FILE", num_args = 1.., required = true)]
    images: Vec<PathBuf>,
    #[command(flatten)]
    limits: Limits,
    /// Folder for the result; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Calibrates and writes; returns the exit code.
pub fn run(args: &Args, json: bool) -> Result<u8, Failure> {
    let output = Output::create(&args.out)?;
    let board = board::read(&args.board, args.measured_mm)?;
    let gates = args.limits.given()?.unwrap_or_default();
    let mut views = Views::default();
    for path in &args.images {
        let picture = read_picture(path)?;
        views.add(&name_of(path, &args.images), &board, &picture, None, DetectSettings::default())?;
    }
    let outcome = solve(&Subject { board: &board, views: &views, gates, baseline_mm: None }, output)?;
    Ok(print(&args.out, &outcome, json))
}
