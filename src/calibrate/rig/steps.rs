//! One step of a session that the service keeps: the views are on the disk, so that it goes on after any end of the process.

use std::{
    fs,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{
    session::Session,
    solve::{Subject, setup, solve},
    take::{Shot, alive, take},
    views::{Unusable, Views, number_of},
};
use crate::{
    app::{Rig, holding},
    calibrate::{Outcome, Output},
    calibration::{
        boards::DetectSettings,
        rig::{Guidance, guidance},
    },
    config::Settings,
    engine::{Failure, rig_failure},
    sequencer::{CancelFlag, Progress},
};

/// Most views of a session.
pub const MOST_VIEWS: usize = 100;

/// What is to be done in a session.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Step {
    /// Scan the board as it stands.
    View,
    /// Forget a view.
    Drop(String),
    /// Calibrate from the views.
    Solve,
}

/// A step of the session in `folder`, which has a `session.toml`.
#[derive(Debug, Clone)]
pub struct Task {
    /// Its folder.
    pub folder: PathBuf,
    /// What is to be done.
    pub step: Step,
}

/// How many observations lie in each ninth of an image; rows from the top.
pub type Cells = [[usize; 3]; 3];

/// A session as it stands.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SessionState {
    /// The board, in words.
    pub board: String,
    /// Its views, in the order in which they were taken.
    pub views: Vec<SessionView>,
    /// What the next views should do: parts of the image, tilts. Empty when nothing is missing.
    pub missing: Vec<String>,
    /// Views still missing at least.
    pub views_missing: usize,
    /// Corners of the board in each ninth of the camera's image, rows from the top.
    #[schema(value_type = Vec<Vec<usize>>)]
    pub camera_coverage: Cells,
    /// Decoded points of the board in each ninth of the projector's picture, rows from the top.
    #[schema(value_type = Vec<Vec<usize>>)]
    pub projector_coverage: Cells,
}

/// A view of a session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SessionView {
    /// Its name.
    pub name: String,
    /// Why it is of no use; `null` where it is.
    pub unusable: Option<String>,
    /// Corners of the board that were found.
    pub corners: usize,
    /// Their standard deviation by the picture's noise, rms, in px.
    pub corner_sigma_px: Option<f64>,
    /// Decoded points on the board.
    pub plane_points: usize,
    /// Tilt of the board about the image's x and y axis in degrees, by a lens that is guessed from the views.
    #[schema(value_type = Option<Vec<f64>>)]
    pub tilt_deg: Option<[f64; 2]>,
}

impl Task {
    /// Whether the step moves the rig; the others only compute.
    pub fn needs_rig(&self) -> bool {
        self.step == Step::View
    }
}

/// Carries a step out; a solution goes into the folder `out`, in the place of an earlier one.
///
/// # Errors
/// Devices, a view that cannot be taken or is not there, the disk, or `cancel`. A calibration that is refused is an outcome.
pub fn run(
    task: &Task,
    out: &Path,
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    doing: &mut dyn FnMut(&str),
) -> Result<Outcome, Failure> {
    if !task.needs_rig() {
        return compute(task, out, cancel, doing);
    }
    let folder = &task.folder;
    let mut session = Session::read(folder)?;
    let mut views = alive(cancel, || Views::recall(folder, &session, cancel))?;
    let name = next_name(folder, &session)?;
    doing(&format!("taking {name}"));
    let one = add(&name, &session, folder, rig, settings, cancel, doing)?;
    if let Err(error) = views.join(&one) {
        // Another camera or projector than before: its frames are of no use to this session.
        remove(folder, &name)?;
        return Err(error);
    }
    one.remember(folder, &name)?;
    session.views.push(name);
    session.write(folder)?;
    Ok(Outcome { session: Some(SessionState::of(&session, &views)?), ..Outcome::default() })
}

/// Carries out a step that needs no rig, as [`run`] does, on the threads of whoever calls.
///
/// # Errors
/// A view that is not there or cannot be read, the disk, or `cancel`.
pub fn compute(
    task: &Task,
    out: &Path,
    cancel: &CancelFlag,
    doing: &mut dyn FnMut(&str),
) -> Result<Outcome, Failure> {
    let Task { folder, step } = task;
    let mut session = Session::read(folder)?;
    if let Step::Drop(name) = step {
        // First of all, since it may be the view that cannot be read.
        session.views.retain(|view| view != name);
        session.write(folder)?;
        // The session is without it from here on, whatever becomes of its files.
        if let Err(failure) = remove(folder, name) {
            tracing::warn!(error = failure.chain(), "a dropped view still takes space");
        }
    }
    let views = Views::recall(folder, &session, cancel)?;
    let mut outcome = Outcome::default();
    if *step == Step::Solve {
        doing("solving");
        outcome = solution(&session, &views, out)?;
    }
    outcome.session = Some(SessionState::of(&session, &views)?);
    Ok(outcome)
}

/// The name of the next view: after all that there were, also those that a crash left without a mention.
fn next_name(folder: &Path, session: &Session) -> Result<String, Failure> {
    if session.views.len() >= MOST_VIEWS {
        let message = format!("a session has at most {MOST_VIEWS} views; drop one");
        return Err(Failure::data("take a view", message));
    }
    let failed = |error| Failure::storage("look into the session", error);
    let mut last = session.views.iter().filter_map(|name| number_of(name)).max().unwrap_or(0);
    for entry in fs::read_dir(folder).map_err(failed)? {
        let name = entry.map_err(failed)?.file_name();
        last = last.max(name.to_str().and_then(number_of).unwrap_or(0));
    }
    Ok(format!("view-{:02}", last + 1))
}

/// Takes a view; the simulated rig moves its board by itself.
fn add(
    name: &str,
    session: &Session,
    folder: &Path,
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    doing: &mut dyn FnMut(&str),
) -> Result<Views, Failure> {
    let pose = number_of(name).unwrap_or(1) - 1;
    let held = holding(settings, &session.board, pose)
        .map_err(|message| Failure::data("draw the board on the simulated rig", message))?;
    let mut simulated = match &held {
        Some(held) => Some(Rig::open(held).map_err(rig_failure)?),
        None => None,
    };
    let mut views = Views::default();
    let shot =
        Shot { name, board: &session.board, settings: held.as_ref().unwrap_or(settings), keep: Some(folder) };
    let mut progress = |progress: Progress<'_>| {
        if let Progress::Captured { done, frames, .. } = progress
            && done == frames
        {
            doing(&format!("looking for the board in {name}"));
        }
    };
    take(&shot, simulated.as_mut().unwrap_or(rig), &mut views, &mut progress, cancel)?;
    Ok(views)
}

fn solution(session: &Session, views: &Views, out: &Path) -> Result<Outcome, Failure> {
    let failed = |error| Failure::storage("replace the earlier calibration", error);
    if out.exists() {
        fs::remove_dir_all(out).map_err(failed)?;
    }
    let Session { board, gates, baseline_mm, .. } = session;
    solve(&Subject { board, views, gates: *gates, baseline_mm: *baseline_mm }, Output::create(out)?)
}

/// Removes the frames of a view and what was seen in them.
fn remove(folder: &Path, name: &str) -> Result<(), Failure> {
    let failed = |error| Failure::storage(format!("remove the view {name}"), error);
    let (frames, seen) = (folder.join(name), Views::file(folder, name));
    if seen.exists() {
        fs::remove_file(seen).map_err(failed)?;
    }
    if frames.exists() { fs::remove_dir_all(frames).map_err(failed) } else { Ok(()) }
}

impl SessionState {
    /// A session as it stands with these views.
    ///
    /// # Errors
    /// None: where no view can be read, there are no sizes to judge by, and all is missing.
    fn of(session: &Session, views: &Views) -> Result<Self, Failure> {
        let empty = Self::empty(session);
        let setup = views.camera.map(|_| setup(views, session.gates, session.baseline_mm)).transpose()?;
        let found = match setup {
            Some(setup) => guidance(&views.views, &setup, None),
            None => Guidance {
                views_missing: empty.views_missing,
                missing: empty.missing.clone(),
                ..Guidance::default()
            },
        };
        let Guidance { coverage, tilts_deg, views_missing, missing } = found;
        let view = |name: &String| {
            let usable = views.views.iter().position(|view| view.name == *name);
            let seen = views.seen.iter().find(|seen| seen.name == *name);
            let unusable = views.unusable.iter().find(|view| view.name == *name);
            SessionView {
                name: name.clone(),
                unusable: unusable.map(|view| view.reason.clone()),
                corners: seen.map_or(0, |seen| seen.corners),
                corner_sigma_px: seen.and_then(|seen| seen.corner_sigma_px),
                plane_points: seen.map_or(0, |seen| seen.plane_points),
                tilt_deg: usable.and_then(|at| tilts_deg.get(at).copied().flatten()),
            }
        };
        Ok(Self {
            views: session.views.iter().map(view).collect(),
            missing,
            views_missing,
            camera_coverage: coverage.camera_corners.ninths,
            projector_coverage: coverage.projector_plane_points.ninths,
            ..empty
        })
    }

    /// A session without views.
    pub fn empty(session: &Session) -> Self {
        let views_missing = session.gates.min_views;
        let missing = vec![format!(
            "at least {views_missing} views of the board, in all parts of the image and tilted every way"
        )];
        Self { board: session.board.summary(), views_missing, missing, ..Self::default() }
    }
}

impl Views {
    /// Everything that was seen in the views of a session. A view whose frames are not there, or cannot be decoded, is
    /// of no use, with the reason.
    ///
    /// # Errors
    /// `cancel`.
    fn recall(folder: &Path, session: &Session, cancel: &CancelFlag) -> Result<Self, Failure> {
        let mut all = Self::default();
        for name in &session.views {
            if cancel.is_cancelled() {
                return Err(Failure::data("look into the views", "it was cancelled"));
            }
            let written = fs::read(Self::file(folder, name)).ok();
            let added = match written.and_then(|json| serde_json::from_slice::<Self>(&json).ok()) {
                Some(one) => all.join(&one),
                // The frames are the truth.
                None => all.add_bundle(name, &folder.join(name), &session.board, DetectSettings::default()),
            };
            if let Err(failure) = added {
                all.unusable.push(Unusable { name: name.clone(), reason: failure.chain() });
            }
        }
        Ok(all)
    }

    /// Writes what was seen in a view, so that it need not be looked for again.
    fn remember(&self, folder: &Path, name: &str) -> Result<(), Failure> {
        let failed = |error| Failure::storage(format!("note what was seen in the view {name}"), error);
        let json = serde_json::to_vec(self).expect("numbers and text are JSON");
        fs::write(Self::file(folder, name), json).map_err(failed)
    }

    fn file(folder: &Path, name: &str) -> PathBuf {
        folder.join(format!("{name}.json"))
    }
}
