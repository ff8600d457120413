//! The folder of a service's scans: where each bundle lies, what is kept beside it, what a crash left, and how much room
//! there is.
//!
//! ```text
//! DIR/ID/                  a bundle, complete; ID/scan.json is what the service knows of it besides, written anew at
//!                          every change
//! DIR/ID.partial/          a bundle that is being written
//! DIR/.spool/ID/           frames of a scan that is being captured
//! DIR/.calibrations/       calibrations that the service made
//! DIR/.trash/ID/           a bundle that is being deleted
//! DIR/index.sqlite         the index
//! DIR/.lock                held by the one process that writes here
//! ```

use std::{
    collections::BTreeSet,
    fs::{self, File, TryLockError},
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::{bundle, calibrations::Calibrations, error::StorageError, index, manifest, spool::Spooled};
use crate::{
    engine::Failure,
    report::{Diagnosis, Reason, Report},
    scanner::{Record, State, is_id},
    store::{BundleWriter, Index, IndexError},
};

/// What the service knows of a scan, beside its bundle.
const RECORD: &str = "scan.json";
const SPOOL: &str = ".spool";
const TRASH: &str = ".trash";
const LOCK: &str = ".lock";

/// The store of a service, locked as long as it lives.
#[derive(Debug)]
pub struct Library {
    folder: PathBuf,
    _lock: File,
}

/// What a start found and put in order.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Recovery {
    /// Scans that the index did not know.
    pub found: Vec<String>,
    /// Scans of the index whose bundles are gone.
    pub lost: Vec<String>,
    /// Scans that had not come to their end.
    pub interrupted: Vec<String>,
    /// Whether the index was made again.
    pub rebuilt: bool,
}

impl Library {
    /// Opens the store in `folder`, which is made where it is missing.
    pub fn open(folder: &Path) -> Result<Self, StorageError> {
        let file = |operation, path: &Path, error| StorageError::file(operation, path, error);
        fs::create_dir_all(folder).map_err(|error| file("create folder", folder, error))?;
        let folder = folder.canonicalize().map_err(|error| file("find", folder, error))?;
        let path = folder.join(LOCK);
        let lock = File::options()
            .create(true)
            .truncate(false)
            .write(true)
            .open(&path)
            .map_err(|error| file("create", &path, error))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => return Err(StorageError::Busy { path: folder }),
            // Some network file systems have no locks.
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => {}
            Err(TryLockError::Error(error)) => return Err(file("lock", &path, error)),
        }
        Ok(Self { folder, _lock: lock })
    }

    /// Whether a service has the store in `folder`.
    ///
    /// # Errors
    /// A store that this user may not look into.
    pub fn is_in_use(folder: &Path) -> Result<bool, StorageError> {
        let path = folder.join(LOCK);
        match File::open(&path) {
            Ok(lock) => Ok(matches!(lock.try_lock_shared(), Err(TryLockError::WouldBlock))),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(StorageError::file("open", &path, error)),
        }
    }

    /// Where the store is.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Where the bundle of a scan is or will be.
    pub fn bundle(&self, id: &str) -> PathBuf {
        debug_assert!(is_id(id), "{id}");
        self.folder.join(id)
    }

    /// Where the frames of a scan are spooled.
    pub fn spool(&self, id: &str) -> PathBuf {
        self.folder.join(SPOOL).join(id)
    }

    /// Writes what is known of a scan beside its bundle, if it has one. All or nothing.
    pub fn write_record(&self, record: &Record) -> Result<(), StorageError> {
        let folder = self.bundle(&record.id);
        let (path, fresh) = (folder.join(RECORD), folder.join(format!("{RECORD}.new")));
        let fail = |error| StorageError::file("write", &path, error);
        if record.bytes.is_none() || !folder.is_dir() {
            return Ok(());
        }
        let json = serde_json::to_vec_pretty(record).map_err(|error| fail(error.into()))?;
        let write = || {
            let mut file = File::create(&fresh)?;
            file.write_all(&json)?;
            file.sync_all()?;
            fs::rename(&fresh, &path)
        };
        write().map_err(fail)
    }

    /// Takes the bundle of a scan away, at once and as a whole. What is returned still takes space, and is to be removed.
    pub fn discard(&self, id: &str) -> Result<Option<PathBuf>, StorageError> {
        let (bundle, trash) = (self.bundle(id), self.folder.join(TRASH));
        let fail = |error| StorageError::file("delete", &bundle, error);
        fs::create_dir_all(&trash).map_err(fail)?;
        let left = trash.join(id);
        match fs::rename(&bundle, &left) {
            Ok(()) => Ok(Some(left)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(fail(error)),
        }
    }

    /// The calibrations of the service.
    pub fn calibrations(&self) -> Calibrations {
        Calibrations::of(&self.folder)
    }

    /// Free bytes on the disk of the store; `None` where it does not tell.
    pub fn free_bytes(&self) -> io::Result<Option<u64>> {
        super::disk::Disk::free_bytes(&super::disk::RealDisk, &self.folder)
    }

    /// Bytes of the bundle of a scan; `None` where there is none.
    pub fn bundle_bytes(&self, id: &str) -> Option<u64> {
        let bytes = fs::read(self.folder.join(id).join(manifest::FILE_NAME)).ok()?;
        let parsed = manifest::Manifest::parse(&bytes);
        let files = parsed.map_or(0, |parsed| parsed.manifest.files.values().map(|file| file.bytes).sum());
        Some(bytes.len() as u64 + files)
    }

    /// Opens the index, makes it again where it is missing or damaged, and brings index and disk to agree: bundles that
    /// the index does not know are added, scans whose bundle is gone are forgotten, and scans that had not come to
    /// their end are `interrupted`, with the frames that were spooled.
    pub fn recover(&self, now: &str) -> Result<(Index, Recovery), StorageError> {
        let fail = |error: IndexError| StorageError::refused(index::FILE_NAME, chain(&error));
        let (index, new) = match Index::open(&self.folder) {
            Ok(opened) => opened,
            Err(error) => {
                tracing::warn!(error = chain(&error), "the index is made again from the bundles");
                self.set_index_aside()?;
                Index::open(&self.folder).map_err(fail)?
            }
        };
        let mut recovery = Recovery { rebuilt: new, ..Recovery::default() };
        let stale = bundle::remove_stale_partials(&self.folder);
        stale.map_err(|error| StorageError::file("list", &self.folder, error))?;
        let trash = self.folder.join(TRASH);
        if trash.exists()
            && let Err(error) = fs::remove_dir_all(&trash)
        {
            tracing::warn!(%error, "deleted scans still take space");
        }
        let known = index.ids().map_err(fail)?;
        let on_disk = self.ids_on_disk()?;
        for (id, has_bundle) in &known {
            if *has_bundle && !on_disk.contains(id) {
                index.remove(id).map_err(fail)?;
                recovery.lost.push(id.clone());
            }
        }
        for record in index.unfinished().map_err(fail)? {
            // Scans that waited for the rig go on waiting.
            if record.state == State::Queued && record.source.is_none() {
                continue;
            }
            let record = self.settle(record, now);
            let record = announce(&index, record).map_err(fail)?;
            self.write_record(&record)?;
            if record.state == State::Interrupted {
                recovery.interrupted.push(record.id);
            }
        }
        let known: BTreeSet<String> = index.ids().map_err(fail)?.into_iter().map(|(id, _)| id).collect();
        let mut newest = 0;
        for id in on_disk.difference(&known) {
            let Some(record) = self.read_record(id) else { continue };
            index.put(&record).map_err(fail)?;
            newest = newest.max(record.revision);
            recovery.found.push(id.clone());
        }
        if new {
            // Revisions are numbers of events, and go on growing where the index that counted them is lost.
            index.set_number("events", newest).map_err(fail)?;
        }
        self.salvage_unknown(&index, now, &mut recovery).map_err(fail)?;
        Ok((index, recovery))
    }

    /// Makes the index again from the bundles, whatever it held. Scans that had not come to their end are settled first,
    /// so that what was queued is all that is lost.
    pub fn reindex(&self, now: &str) -> Result<(Index, Recovery), StorageError> {
        if let Ok((index, settled)) = self.recover(now) {
            drop(index);
            tracing::info!(
                interrupted = settled.interrupted.len(),
                "what had not come to its end was settled"
            );
        }
        self.set_index_aside()?;
        self.recover(now)
    }

    /// Moves a damaged index out of the way, for somebody to look at.
    fn set_index_aside(&self) -> Result<(), StorageError> {
        let path = self.folder.join(index::FILE_NAME);
        for suffix in ["-wal", "-shm"] {
            let _ = fs::remove_file(self.folder.join(format!("{}{suffix}", index::FILE_NAME)));
        }
        match fs::rename(&path, path.with_extension("sqlite.damaged")) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                Err(StorageError::file("set aside", &path, error))
            }
            _ => Ok(()),
        }
    }

    /// Identities of all bundles.
    fn ids_on_disk(&self) -> Result<BTreeSet<String>, StorageError> {
        let fail = |error| StorageError::file("list", &self.folder, error);
        let entries = fs::read_dir(&self.folder).map_err(fail)?;
        let mut ids = BTreeSet::new();
        for entry in entries {
            let name = entry.map_err(fail)?.file_name();
            if let Some(id) = name.to_str().filter(|name| is_id(name))
                && self.folder.join(id).join(manifest::FILE_NAME).is_file()
            {
                ids.insert(id.to_owned());
            }
        }
        Ok(ids)
    }

    /// What became of a scan that the index believes to be running, now that nothing runs.
    fn settle(&self, mut record: Record, now: &str) -> Record {
        let id = record.id.clone();
        if let Some(found) = self.bundle(&id).is_dir().then(|| self.read_record(&id)).flatten() {
            // The bundle was complete before the crash, the index only had not heard of it.
            let Record { state, verdict, reasons, error, points, bytes, finished, .. } = found;
            record.progress.frames = record.progress.of.max(found.progress.frames);
            record = Record { state, verdict, reasons, error, points, bytes, finished, ..record };
            let _ = fs::remove_dir_all(self.spool(&id));
            return record;
        }
        let message = "the service ended before the scan did";
        match self.salvage(&id) {
            Ok(Some((report, frames))) => {
                record.adopt(&report);
                record.progress.frames = report.frames;
                record.progress.of = frames;
            }
            Ok(None) => record.blame(Diagnosis::Interrupted.slug(), message),
            Err(error) => {
                tracing::warn!(id, error = error.chain(), "what was captured could not be kept");
                record.blame(Diagnosis::Interrupted.slug(), format!("{message}, but: {}", error.chain()));
            }
        }
        record.advance(State::Interrupted, now.to_owned());
        record.bytes = self.bundle_bytes(&id);
        record
    }

    /// Makes a bundle of what was spooled, if anything was. Answers its report and how many frames there should have been.
    fn salvage(&self, id: &str) -> Result<Option<(Report, usize)>, Failure> {
        let folder = self.spool(id);
        if !folder.is_dir() {
            return Ok(None);
        }
        let spooled = Spooled::read(&folder).map_err(|error| Failure::data("read the spool", error))?;
        let mut report = None;
        if !spooled.frames.is_empty() {
            let message = format!(
                "the program or the machine stopped before the scan was done; {} frames are kept",
                spooled.frames.len()
            );
            let reason = Reason::failed(Diagnosis::Interrupted, message, serde_json::Value::Null);
            let writer = BundleWriter::create(&self.bundle(id), None, 0)
                .map_err(|error| Failure::storage("keep what was captured", error))?;
            let parsed = manifest::Manifest::parse(&spooled.manifest);
            let frames = parsed.map_or(0, |parsed| parsed.manifest.sequence.len());
            report = Some((crate::engine::salvage(spooled, reason, writer)?, frames));
        }
        if let Err(error) = fs::remove_dir_all(&folder) {
            tracing::warn!(%error, "a spool that is done with still takes space");
        }
        Ok(report)
    }

    /// Spools of scans that the index has forgotten, because it was made again.
    fn salvage_unknown(&self, index: &Index, now: &str, recovery: &mut Recovery) -> Result<(), IndexError> {
        let Ok(entries) = fs::read_dir(self.folder.join(SPOOL)) else { return Ok(()) };
        for entry in entries.flatten() {
            let name = entry.file_name();
            let Some(id) = name.to_str().filter(|name| is_id(name)) else { continue };
            match index.get(id)? {
                // Its frames could not be kept so far, for want of space perhaps.
                Some(mut known) if known.state == State::Interrupted && known.bytes.is_none() => {
                    if let Ok(Some((report, _))) = self.salvage(id) {
                        known.adopt(&report);
                        known.bytes = self.bundle_bytes(id);
                        announce(index, known)?;
                    }
                    continue;
                }
                // A spool that its scan has outlived: the result was written.
                Some(_) => {
                    let _ = fs::remove_dir_all(entry.path());
                    continue;
                }
                None => {}
            }
            let mut record = Record::new(id.to_owned(), String::new(), now.to_owned());
            record.state = State::Projecting;
            let record = self.settle(record, now);
            if let Some(record) = record.bytes.and_then(|_| self.read_record(id)) {
                announce(index, record)?;
                recovery.interrupted.push(id.to_owned());
            }
        }
        Ok(())
    }

    /// What is known of the scan in a bundle: from beside it, or else from the bundle itself.
    fn read_record(&self, id: &str) -> Option<Record> {
        let folder = self.bundle(id);
        let beside = fs::read(folder.join(RECORD)).ok();
        let beside = beside.and_then(|bytes| serde_json::from_slice::<Record>(&bytes).ok());
        if let Some(record) = beside.filter(|record| record.id == id && record.state.is_terminal()) {
            return Some(record);
        }
        let bytes = fs::read(folder.join(manifest::FILE_NAME)).ok()?;
        let manifest = manifest::Manifest::parse(&bytes).ok()?.manifest;
        let created = manifest.created.clone().unwrap_or_default();
        let mode = manifest.mode.map_or_else(String::new, |mode| mode.to_string());
        let mut record = Record::new(id.to_owned(), mode, created.clone());
        record.label = manifest.label.clone();
        record.tags = manifest.tags.clone();
        record.progress.frames = manifest.sequence.len();
        record.progress.of = manifest.sequence.len();
        record.bytes = self.bundle_bytes(id);
        record.finished = Some(created);
        record.source = manifest.source.as_ref().and_then(|source| self.own_source(source));
        record.state = State::Done;
        let report = fs::read(folder.join("report.json")).ok();
        if let Some(report) = report.and_then(|bytes| serde_json::from_slice::<Report>(&bytes).ok()) {
            record.adopt(&report);
            let is = |kind: Diagnosis| report.reasons.iter().any(|reason| reason.diagnosis == kind);
            record.state = match report.verdict {
                crate::report::Verdict::Failed if is(Diagnosis::Interrupted) => State::Interrupted,
                crate::report::Verdict::Failed if is(Diagnosis::Cancelled) => State::Cancelled,
                crate::report::Verdict::Failed => State::Failed,
                _ => State::Done,
            };
        }
        Some(record)
    }

    /// The scan of this store that a bundle was decoded from.
    fn own_source(&self, source: &manifest::Source) -> Option<String> {
        let path = Path::new(&source.bundle);
        let id = path.file_name()?.to_str().filter(|id| is_id(id))?;
        (path.parent()? == self.folder).then(|| id.to_owned())
    }
}

/// Gives a scan that was settled the number of an event that tells of it, beyond all that were given out before.
fn announce(index: &Index, mut record: Record) -> Result<Record, IndexError> {
    let given =
        index.number("events")?.unwrap_or(0).max(index.event_range()?.map_or(0, |(_, newest)| newest));
    record.revision = given + 1;
    index.set_number("events", record.revision)?;
    index.put(&record)?;
    let data = serde_json::to_string(&record).unwrap_or_default();
    index.add_event(&index::Event { id: record.revision, kind: "scan".to_owned(), data })?;
    Ok(record)
}

/// A message with all its causes.
pub fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        text.push_str(": ");
        text.push_str(&error.to_string());
        source = error.source();
    }
    text
}
