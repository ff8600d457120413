//! `polscan calibrate rig`.

use std::{
    io::{BufRead as _, Write as _},
    path::{Path, PathBuf},
};

use super::{board, limits::Limits, output::print};
use crate::{
    app::{Rig, holding},
    calibrate::{
        Output,
        rig::{Session, Shot, Subject, Views, name_of, setup, solve, take},
    },
    calibration::{
        boards::{Board, DetectSettings},
        rig::{Gates, guidance},
    },
    commands::{progress::Bar, scan::cancel_on_interrupt},
    config::{ConfigError, Settings},
    engine::{Failure, rig_failure},
    sequencer::{CancelFlag, Progress},
};

/// Arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Configuration file of the rig, to take views with it.
    #[arg(long, value_name = "FILE", conflicts_with = "views", requires = "poses")]
    config: Option<PathBuf>,
    /// Number of views to take; the simulated rig moves its board by itself.
    #[arg(long, value_name = "N", requires = "config", value_parser = clap::value_parser!(u32).range(1..=100))]
    poses: Option<u32>,
    /// Description of the board, as `polscan calibrate board` writes it; a session has its own.
    #[arg(long, value_name = "FILE")]
    board: Option<PathBuf>,
    /// Measured length of the board's printed bar.
    #[arg(long, value_name = "MM")]
    measured_mm: Option<f64>,
    /// Recorded scans of the board in mode gray, one per view.
    #[arg(long, value_name = "BUNDLE", num_args = 1..)]
    views: Vec<PathBuf>,
    /// Folder of a session: with --poses its views are kept there, without they are read from it.
    #[arg(long, value_name = "DIR", conflicts_with = "views")]
    session: Option<PathBuf>,
    /// View of the session or among the bundles to leave out. May be repeated.
    #[arg(long, value_name = "NAME")]
    drop: Vec<String>,
    #[command(flatten)]
    limits: Limits,
    /// Folder for the result; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

const OPERATION: &str = "calibrate the rig";

/// Calibrates and writes; returns the exit code.
pub fn run(
    args: &Args,
    load: impl Fn(Option<&Path>) -> Result<Settings, ConfigError>,
    json: bool,
) -> Result<u8, Failure> {
    let output = Output::create(&args.out)?;
    let recorded = args.poses.is_none().then_some(args.session.as_deref()).flatten();
    let session = recorded.map(Session::read).transpose()?;
    let mut board = match (&args.board, &session) {
        (Some(path), _) => board::read(path, args.measured_mm)?,
        (None, Some(session)) => session.board.clone(),
        (None, None) => {
            return Err(Failure::data(OPERATION, "no board is given: give its file with --board"));
        }
    };
    board.measured_mm = args.measured_mm.or(board.measured_mm);
    let gates = args.limits.given()?.or(session.as_ref().map(|session| session.gates)).unwrap_or_default();
    let known_mm = session.as_ref().and_then(|session| session.baseline_mm);
    let baseline_mm = args.limits.baseline_mm.or(known_mm);
    let views = match args.poses {
        Some(poses) => {
            let settings = load(args.config.as_deref())?;
            let keep = args.session.as_deref();
            Taking { board: &board, gates, baseline_mm, keep }.all(&settings, poses)?
        }
        None => {
            let paths = match (&session, &args.session) {
                (Some(session), Some(folder)) => session.paths(folder),
                _ => args.views.clone(),
            };
            read(&paths, &args.drop, &board)?
        }
    };
    let subject = Subject { board: &board, views: &views, gates, baseline_mm };
    Ok(print(&args.out, &solve(&subject, output)?, json))
}

/// Reads recorded views, but those to drop.
fn read(paths: &[PathBuf], dropped: &[String], board: &Board) -> Result<Views, Failure> {
    let names: Vec<String> = paths.iter().map(|path| name_of(path, paths)).collect();
    if let Some(unknown) = dropped.iter().find(|name| !names.contains(name)) {
        let message = format!("--drop names {unknown}, which is none of the views {}", names.join(", "));
        return Err(Failure::data(OPERATION, message));
    }
    let mut views = Views::default();
    for (path, name) in paths.iter().zip(&names).filter(|(_, name)| !dropped.contains(name)) {
        views.add_bundle(name, path, board, DetectSettings::default())?;
    }
    Ok(views)
}

/// Taking views with the rig.
struct Taking<'a> {
    board: &'a Board,
    gates: Gates,
    baseline_mm: Option<f64>,
    keep: Option<&'a Path>,
}

impl Taking<'_> {
    /// Takes all views; what is still missing is said before each.
    fn all(&self, settings: &Settings, poses: u32) -> Result<Views, Failure> {
        let session_file = self.keep.map(|folder| folder.join(Session::FILE_NAME));
        if let Some(taken) = session_file.filter(|file| file.exists()) {
            let message = format!("{} holds a session already; give another folder", taken.display());
            return Err(Failure::storage("keep the session", message));
        }
        let mut session = Session::new(&settings.raw.rig.name, self.board, self.gates, self.baseline_mm);
        let mut views = Views::default();
        let cancel = CancelFlag::default();
        cancel_on_interrupt(&cancel);
        let mut rig = None;
        for number in 0..poses {
            let name = format!("view-{:02}", number + 1);
            let held = holding(settings, self.board, number)
                .map_err(|message| Failure::data("draw the board on the simulated rig", message))?;
            let settings = match held {
                Some(posed) => {
                    rig = None;
                    posed
                }
                None => {
                    self.ask(&views, number + 1, poses)?;
                    settings.clone()
                }
            };
            let rig = match &mut rig {
                Some(rig) => rig,
                none => none.insert(Rig::open(&settings).map_err(rig_failure)?),
            };
            self.view(&name, &settings, rig, &mut views, &cancel)?;
            if let Some(folder) = self.keep {
                session.views.push(name);
                session.write(folder)?;
            }
        }
        Ok(views)
    }

    /// Waits for the user to place the board.
    fn ask(&self, views: &Views, number: u32, of: u32) -> Result<(), Failure> {
        let mut stderr = std::io::stderr().lock();
        let failed = |error| Failure::storage("ask for the next view", error);
        if views.camera.is_some() {
            let setup = setup(views, self.gates, self.baseline_mm)?;
            for missing in guidance(&views.views, &setup, None).missing {
                writeln!(stderr, "missing: {missing}").map_err(failed)?;
            }
        }
        if let (Some(last), true) = (views.unusable.last(), views.views.len() + 1 < number as usize) {
            writeln!(stderr, "view {} cannot be used: {}", last.name, last.reason).map_err(failed)?;
        }
        writeln!(stderr, "view {number} of {of}: place the board, keep it still and press Enter")
            .map_err(failed)?;
        let read = std::io::stdin().lock().read_line(&mut String::new()).map_err(failed)?;
        if read == 0 {
            return Err(Failure::data(OPERATION, "the input ended before all views were taken"));
        }
        Ok(())
    }

    /// Scans the board once.
    fn view(
        &self,
        name: &str,
        settings: &Settings,
        rig: &mut Rig,
        views: &mut Views,
        cancel: &CancelFlag,
    ) -> Result<(), Failure> {
        let bar = Bar::new(1);
        bar.say(name.to_owned());
        let mut progress = |progress: Progress<'_>| match progress {
            Progress::Started { frames, .. } => bar.length(frames as u64),
            Progress::Captured { done, .. } => bar.frames(done as u64),
            _ => {}
        };
        let shot = Shot { name, board: self.board, settings, keep: self.keep };
        take(&shot, rig, views, &mut progress, cancel)
    }
}
