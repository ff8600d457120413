//! A session on the disk: a folder with `session.toml` and one bundle per view.

use std::{
    fs::File,
    io::Write as _,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};

use crate::{
    calibration::{boards::Board, rig::Gates},
    engine::Failure,
};

const SCHEMA: &str = "polscan.session/1";

/// What a session is about.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Session {
    /// `polscan.session/1`.
    schema: String,
    /// Name of the rig.
    pub rig: String,
    /// Folders of its views, within its own.
    pub views: Vec<String>,
    /// Board.
    pub board: Board,
    /// When a calibration is accepted.
    pub gates: Gates,
    /// Distance between camera and projector, where it was measured, in mm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baseline_mm: Option<f64>,
}

impl Session {
    /// Name of its file.
    pub const FILE_NAME: &str = "session.toml";

    /// A session without views.
    pub fn new(rig: &str, board: &Board, gates: Gates, baseline_mm: Option<f64>) -> Self {
        Self {
            schema: SCHEMA.into(),
            rig: rig.into(),
            views: Vec::new(),
            board: board.clone(),
            gates,
            baseline_mm,
        }
    }

    /// Reads `session.toml` of a folder.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(Self::FILE_NAME);
        let operation = format!("read the session {}", path.display());
        let text = std::fs::read_to_string(&path).map_err(|error| Failure::data(operation.clone(), error))?;
        let session: Self = toml::from_str(&text).map_err(|error| Failure::data(operation.clone(), error))?;
        let faults = session.board.faults();
        if session.schema != SCHEMA {
            let message = format!("its schema is `{}`, expected `{SCHEMA}`", session.schema);
            return Err(Failure::data(operation, message));
        }
        if faults.is_empty() { Ok(session) } else { Err(Failure::data(operation, faults.join("; "))) }
    }

    /// Writes `session.toml`; it replaces an earlier one at once or not at all.
    pub fn write(&self, folder: &Path) -> Result<(), Failure> {
        let failed = |error: std::io::Error| Failure::storage("write the session", error);
        let text = toml::to_string(self).map_err(|error| Failure::storage("write the session", error))?;
        let partial = folder.join("session.toml.partial");
        let mut file = File::create(&partial).map_err(failed)?;
        file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(failed)?;
        std::fs::rename(&partial, folder.join(Self::FILE_NAME)).map_err(failed)
    }

    /// Folders of the views.
    pub fn paths(&self, folder: &Path) -> Vec<PathBuf> {
        self.views.iter().map(|view| folder.join(view)).collect()
    }
}
