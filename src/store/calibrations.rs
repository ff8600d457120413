//! The calibrations that a service made: `.calibrations/ID.json` is what is known of one, `.calibrations/ID/` its files.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::{bundle, error::StorageError};
use crate::scanner::{CalibrationRecord, CalibrationState, is_id};

/// Folder within a store.
const FOLDER: &str = ".calibrations";

/// Folder within it of what is being deleted.
const TRASH: &str = ".trash";

/// Calibrations of a store.
#[derive(Debug, Clone)]
pub struct Calibrations(PathBuf);

impl Calibrations {
    /// Those of the store in `folder`.
    pub fn of(folder: &Path) -> Self {
        Self(folder.join(FOLDER))
    }

    /// Where the files of a calibration are or will be.
    pub fn files(&self, id: &str) -> PathBuf {
        debug_assert!(is_id(id), "{id}");
        self.0.join(id)
    }

    /// Where the views of a session are; there from now on.
    ///
    /// # Errors
    /// The disk says no.
    pub fn session(&self, id: &str) -> Result<PathBuf, StorageError> {
        debug_assert!(is_id(id), "{id}");
        let folder = self.views(id);
        fs::create_dir_all(&folder).map_err(|error| StorageError::file("create folder", &folder, error))?;
        Ok(folder)
    }

    fn views(&self, id: &str) -> PathBuf {
        self.0.join(format!("{id}.session"))
    }

    /// Takes a calibration away with all its files, at once and as a whole. What is known of it goes first: without it the
    /// rest is nothing. What is returned still takes space, and is to be removed.
    ///
    /// # Errors
    /// The disk says no.
    pub fn discard(&self, id: &str) -> Result<Vec<PathBuf>, StorageError> {
        let record = self.0.join(format!("{id}.json"));
        match fs::remove_file(&record) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(StorageError::file("remove", &record, error));
            }
            _ => {}
        }
        let trash = self.0.join(TRASH);
        fs::create_dir_all(&trash).map_err(|error| StorageError::file("create folder", &trash, error))?;
        let mut left = Vec::new();
        for folder in [self.files(id), self.views(id)] {
            let aside = folder.file_name().map(|name| trash.join(name)).unwrap_or_else(|| trash.join(id));
            match fs::rename(&folder, &aside) {
                Ok(()) => left.push(aside),
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                Err(error) => return Err(StorageError::file("remove", &folder, error)),
            }
        }
        Ok(left)
    }

    /// Writes what is known of a calibration. All or nothing.
    ///
    /// # Errors
    /// The disk says no.
    pub fn write(&self, record: &CalibrationRecord) -> Result<(), StorageError> {
        let (path, fresh) =
            (self.0.join(format!("{}.json", record.id)), self.0.join(format!("{}.new", record.id)));
        let write = || {
            let json = serde_json::to_vec_pretty(record).map_err(io::Error::from)?;
            fs::create_dir_all(&self.0)?;
            let mut file = File::create(&fresh)?;
            file.write_all(&json)?;
            file.sync_all()?;
            fs::rename(&fresh, &path)
        };
        write().map_err(|error| StorageError::file("write", &path, error))
    }

    /// All calibrations after a start: those that had not come to their end are `interrupted`, and keep no files.
    ///
    /// # Errors
    /// The folder cannot be listed. A record that cannot be read is left out and logged.
    pub fn recover(&self, now: &str) -> Result<Vec<CalibrationRecord>, StorageError> {
        let fail = |error| StorageError::file("list", &self.0, error);
        let entries = match fs::read_dir(&self.0) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(fail(error)),
        };
        if let Err(error) = bundle::remove_stale_partials(&self.0) {
            tracing::warn!(%error, "what a calibration left still takes space");
        }
        let trash = self.0.join(TRASH);
        if trash.exists()
            && let Err(error) = fs::remove_dir_all(&trash)
        {
            tracing::warn!(%error, "deleted calibrations still take space");
        }
        let mut records = Vec::new();
        for entry in entries {
            let path = entry.map_err(fail)?.path();
            if path.extension().is_none_or(|extension| extension != "json") {
                continue;
            }
            match read(&path) {
                Ok(record) if is_id(&record.id) => records.push(self.settle(record, now)),
                Ok(_) => tracing::warn!(path = %path.display(), "the identity of a calibration is none"),
                Err(error) => tracing::warn!(path = %path.display(), %error, "a calibration cannot be read"),
            }
        }
        Ok(records)
    }

    fn settle(&self, mut record: CalibrationRecord, now: &str) -> CalibrationRecord {
        if record.session.is_some()
            && let Err(error) = bundle::remove_stale_partials(&self.views(&record.id))
        {
            tracing::warn!(%error, "what a view left still takes space");
        }
        if record.state.is_terminal() || record.state == CalibrationState::Open {
            return record;
        }
        if record.session.is_some() {
            // Its views are on the disk: only the step that was under way is lost.
            record.state = CalibrationState::Open;
            record.doing = None;
            record.blame("interrupted", "the service ended in the middle of a step; ask for it again");
            if let Err(error) = self.write(&record) {
                tracing::warn!(%error, "an interrupted step is not noted as such");
            }
            return record;
        }
        record.end(CalibrationState::Interrupted, now.to_owned());
        record.blame("interrupted", "the service ended before the calibration did; start it again");
        // Files have their final name only once they are complete: the measurement was made, only its end was not noted.
        let files = self.files(&record.id);
        if files.exists() {
            record.blame(
                "interrupted",
                format!("the service ended before it noted the end; all files are in {}", files.display()),
            );
        }
        if let Err(error) = self.write(&record) {
            tracing::warn!(%error, "an interrupted calibration is not noted as such");
        }
        record
    }
}

fn read(path: &Path) -> io::Result<CalibrationRecord> {
    serde_json::from_slice(&fs::read(path)?).map_err(io::Error::from)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scanner::CalibrationKind;

    #[test]
    fn what_was_running_is_interrupted_and_what_had_ended_stays() {
        let folder = tempfile::tempdir().unwrap();
        let store = Calibrations::of(folder.path());
        assert!(store.recover("now").unwrap().is_empty());
        let running = CalibrationRecord::new("a".into(), CalibrationKind::Noise, "t".into());
        let mut ended = CalibrationRecord::new("b".into(), CalibrationKind::Sync, "t".into());
        ended.end(CalibrationState::Done, "then".into());
        for record in [&running, &ended] {
            store.write(record).unwrap();
            fs::create_dir(store.files(&record.id)).unwrap();
        }
        fs::write(folder.path().join(FOLDER).join("c.json"), "{").unwrap();
        let mut found = store.recover("now").unwrap();
        found.sort_by(|a, b| a.id.cmp(&b.id));
        let [first, second] = &found[..] else { panic!("{found:?}") };
        assert_eq!((first.state, first.finished.as_deref()), (CalibrationState::Interrupted, Some("now")));
        assert_eq!(second, &ended);
        assert_eq!((store.files("a").exists(), store.files("b").exists()), (true, true));
        fs::create_dir(store.views("b")).unwrap();
        let left = store.discard("b").unwrap();
        assert_eq!((left.len(), left.iter().all(|left| left.is_dir())), (2, true), "{left:?}");
        assert!(store.discard("b").unwrap().is_empty());
        assert_eq!(store.recover("later").unwrap(), std::slice::from_ref(first));
        assert!(!left.iter().any(|left| left.exists()), "a start removes what a death left");
    }
}
