//! Where a bundle is written before it has its name, and how it gets it.

use std::{
    ffi::{OsStr, OsString},
    fs::{self, File, TryLockError},
    io,
    os::unix::fs::MetadataExt,
    path::{Path, PathBuf},
};

use super::remove_folder;
use crate::store::{disk::Disk, error::StorageError, manifest};

/// Marks an unfinished folder as ours, and is locked as long as its process lives.
const MARKER: &str = ".polscan-partial";

/// Name of the unfinished folder where it must lie inside the target.
const INNER: &str = ".polscan.partial";

/// Longest number of tries for a name beside the target.
const NAME_TRIES: usize = 16;

/// Free space that is left over, in bytes: manifest, folders and the file system's own needs.
const RESERVE_BYTES: u64 = 4 << 20;

/// The target and the folder that will become it.
#[derive(Debug)]
pub(super) struct Place {
    target: PathBuf,
    partial: PathBuf,
    /// Whether `partial` lies in the target, so that its entries move rather than itself.
    inside: bool,
    /// Parents that were made, outermost first.
    made: Vec<PathBuf>,
    /// Held for its lock.
    _marker: File,
}

impl Place {
    pub(super) fn target(&self) -> &Path {
        &self.target
    }

    pub(super) fn partial(&self) -> &Path {
        &self.partial
    }

    /// Checks `out` and makes the folder to write to.
    pub(super) fn claim(
        disk: &dyn Disk,
        out: &Path,
        source: Option<&Path>,
        expected_bytes: u64,
    ) -> Result<Self, StorageError> {
        let target = Target::find(out)?;
        if let Some(source) = source {
            target.refuse_inside(source)?;
        }
        if target.exists {
            refuse_occupied(&target.path)?;
        }
        let needed = expected_bytes.saturating_add(RESERVE_BYTES);
        let free = disk.free_bytes(&target.ancestor);
        let free =
            free.map_err(|error| StorageError::file("query free space of", &target.ancestor, error))?;
        if let Some(available) = free.filter(|&available| available < needed) {
            return Err(StorageError::Space { path: target.ancestor, needed, available });
        }
        let mut made = Vec::new();
        let claimed = target.make_parents(disk, &mut made).and_then(|()| target.claim_partial(disk));
        match claimed {
            Ok((partial, inside, marker)) => {
                Ok(Self { target: target.path, partial, inside, made, _marker: marker })
            }
            Err(error) => {
                remove_made(&made);
                Err(error)
            }
        }
    }

    /// As [`Place::claim`] for an empty folder that no rename can replace.
    #[cfg(test)]
    pub(super) fn claim_inside(disk: &dyn Disk, out: &Path) -> Result<Self, StorageError> {
        let target = Target::find(out)?;
        let (partial, inside, marker) = target.claim_inner(disk)?;
        Ok(Self { target: target.path, partial, inside, made: Vec::new(), _marker: marker })
    }

    /// Gives the finished folder its name, on the medium.
    pub(super) fn publish(&mut self, disk: &dyn Disk) -> Result<(), StorageError> {
        let sync = |folder: &Path| {
            disk.sync_folder(folder).map_err(|error| StorageError::file("sync folder", folder, error))
        };
        sync(&self.partial)?;
        let parent = self.target.parent().unwrap_or(Path::new("/")).to_owned();
        if self.inside {
            let mut moved = Vec::new();
            let done = self.move_entries(disk, &mut moved).and_then(|()| sync(&self.target));
            return done.inspect_err(|_| take_back(&moved));
        }
        disk.rename(&self.partial, &self.target)
            .map_err(|error| StorageError::file("give the finished bundle its name", &self.target, error))?;
        // Only now: without its marker an unfinished folder is nobody's, and beside a name that is not final somebody
        // else would take it for his own. What a crash here leaves of the marker changes nothing in the bundle.
        let unmarked = unmark(&self.target).and_then(|()| sync(&self.target));
        unmarked.inspect_err(|_| take_back(std::slice::from_ref(&self.target)))?;
        // A name that may not survive a power cut is taken back, as the caller will report a failure.
        sync(&parent).inspect_err(|_| take_back(std::slice::from_ref(&self.target)))?;
        // Parents that were made are entries of folders as well.
        self.made
            .iter()
            .filter_map(|folder| folder.parent())
            .try_for_each(sync)
            .inspect_err(|_| take_back(std::slice::from_ref(&self.target)))
    }

    /// Moves what was written up into the target, the manifest last.
    fn move_entries(&self, disk: &dyn Disk, moved: &mut Vec<PathBuf>) -> Result<(), StorageError> {
        let entries =
            list(&self.partial).map_err(|error| StorageError::file("list", &self.partial, error))?;
        let (manifest, others): (Vec<_>, Vec<_>) = entries
            .into_iter()
            .filter(|name| name.as_os_str() != OsStr::new(MARKER))
            .partition(|name| name.as_os_str() == OsStr::new(manifest::FILE_NAME));
        for name in others.iter().chain(&manifest) {
            let to = self.target.join(name);
            let fail = |error| StorageError::file("give the finished file its name", &to, error);
            if fs::symlink_metadata(&to).is_ok() {
                return Err(fail(io::ErrorKind::AlreadyExists.into()));
            }
            disk.rename(&self.partial.join(name), &to).map_err(fail)?;
            moved.push(to);
        }
        unmark(&self.partial)?;
        fs::remove_dir(&self.partial).map_err(|error| StorageError::file("remove", &self.partial, error))
    }

    /// Removes all traces of an unfinished bundle.
    pub(super) fn abandon(&self) {
        remove_folder(&self.partial);
        remove_made(&self.made);
    }
}

/// Removes the marker from `folder`.
fn unmark(folder: &Path) -> Result<(), StorageError> {
    let marker = folder.join(MARKER);
    fs::remove_file(&marker).map_err(|error| StorageError::file("remove", &marker, error))
}

/// Removes what already bears its final name, the last first: the manifest moved last, and without it what is left is
/// no bundle.
fn take_back(paths: &[PathBuf]) {
    for path in paths.iter().rev() {
        let removed = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        if let Err(error) = removed {
            tracing::warn!(path = %path.display(), %error, "unfinished bundle could not be removed");
        }
    }
}

/// Removes parents that were made, unless somebody has put something there meanwhile.
fn remove_made(made: &[PathBuf]) {
    for folder in made.iter().rev() {
        if fs::remove_dir(folder).is_err() {
            return;
        }
    }
}

/// Where the result should go.
struct Target {
    /// Absolute, without links as far as it exists.
    path: PathBuf,
    exists: bool,
    /// The deepest folder of it that exists.
    ancestor: PathBuf,
}

impl Target {
    fn find(out: &Path) -> Result<Self, StorageError> {
        let fail = |error| StorageError::file("find", out, error);
        match fs::canonicalize(out) {
            Ok(path) => {
                if !fs::metadata(&path).map_err(fail)?.is_dir() {
                    return Err(StorageError::Occupied { path, found: "it is a file".to_owned() });
                }
                return Ok(Self { ancestor: path.clone(), path, exists: true });
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(fail(error)),
        }
        let full = std::path::absolute(out).map_err(fail)?;
        let mut missing: Vec<OsString> = Vec::new();
        let mut existing: &Path = &full;
        while fs::metadata(existing).is_err() {
            if fs::symlink_metadata(existing).is_ok() {
                let found = "it is a symbolic link that leads nowhere".to_owned();
                return Err(StorageError::Occupied { path: existing.to_owned(), found });
            }
            // `..` after a folder that is missing names nothing.
            let (Some(name), Some(parent)) = (existing.file_name(), existing.parent()) else {
                return Err(fail(io::ErrorKind::InvalidInput.into()));
            };
            missing.push(name.to_owned());
            existing = parent;
        }
        let ancestor = fs::canonicalize(existing).map_err(fail)?;
        if !ancestor.is_dir() {
            return Err(StorageError::file("create", out, io::ErrorKind::NotADirectory.into()));
        }
        let path = missing.iter().rev().fold(ancestor.clone(), |path, name| path.join(name));
        Ok(Self { path, exists: false, ancestor })
    }

    fn refuse_inside(&self, source: &Path) -> Result<(), StorageError> {
        let bundle = fs::canonicalize(source).map_err(|error| StorageError::file("find", source, error))?;
        let bundle = if bundle.is_dir() { bundle } else { bundle.parent().unwrap_or(&bundle).to_owned() };
        if self.path.starts_with(&bundle) {
            return Err(StorageError::InsideSource { path: self.path.clone(), bundle });
        }
        Ok(())
    }

    fn make_parents(&self, disk: &dyn Disk, made: &mut Vec<PathBuf>) -> Result<(), StorageError> {
        let missing: Vec<&Path> = self
            .path
            .ancestors()
            .skip(1)
            .take_while(|folder| *folder != self.ancestor && !self.exists)
            .collect();
        for folder in missing.into_iter().rev() {
            match disk.create_folder(folder) {
                Ok(()) => made.push(folder.to_owned()),
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(StorageError::file("create folder", folder, error)),
            }
        }
        Ok(())
    }

    /// Makes the folder to write to: beside the target, or in it where a rename could not replace the target.
    fn claim_partial(&self, disk: &dyn Disk) -> Result<(PathBuf, bool, File), StorageError> {
        if self.exists && must_stay(&self.path) {
            return self.claim_inner(disk);
        }
        let name = self.path.file_name().unwrap_or_default();
        let parent = self.path.parent().unwrap_or(Path::new("/"));
        for attempt in 0..NAME_TRIES {
            let mut candidate = name.to_owned();
            if attempt > 0 {
                candidate.push(format!(".{attempt}"));
            }
            candidate.push(".partial");
            let partial = parent.join(candidate);
            match self.try_claim(disk, &partial) {
                Ok(Some(marker)) => return Ok((partial, false, marker)),
                Ok(None) => {}
                // A folder that one may write to can lie in one that one may not.
                Err(StorageError::File { source, .. })
                    if self.exists
                        && matches!(
                            source.kind(),
                            io::ErrorKind::PermissionDenied | io::ErrorKind::ReadOnlyFilesystem
                        ) =>
                {
                    return self.claim_inner(disk);
                }
                Err(error) => return Err(error),
            }
        }
        let found = "all names for the unfinished bundle beside it are taken".to_owned();
        Err(StorageError::Occupied { path: self.path.clone(), found })
    }

    fn claim_inner(&self, disk: &dyn Disk) -> Result<(PathBuf, bool, File), StorageError> {
        let partial = self.path.join(INNER);
        match self.try_claim(disk, &partial)? {
            Some(marker) => Ok((partial, true, marker)),
            None => {
                let found = format!("it holds {INNER}, which is not an unfinished bundle");
                Err(StorageError::Occupied { path: self.path.clone(), found })
            }
        }
    }

    /// Makes and marks `partial`, in place of what a dead process left there. `None` if it is somebody else's.
    fn try_claim(&self, disk: &dyn Disk, partial: &Path) -> Result<Option<File>, StorageError> {
        let made = match disk.create_folder(partial) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => match state(partial) {
                State::Live => return Err(StorageError::Busy { path: self.path.clone() }),
                State::Foreign => return Ok(None),
                State::Stale(_lock) => {
                    remove_folder(partial);
                    disk.create_folder(partial)
                }
            },
            other => other,
        };
        made.map_err(|error| StorageError::file("create folder", partial, error))?;
        let marker = partial.join(MARKER);
        let fail = |error| {
            remove_folder(partial);
            StorageError::file("create", &marker, error)
        };
        let file = File::create_new(&marker).map_err(fail)?;
        match file.try_lock() {
            Ok(()) => Ok(Some(file)),
            // Somebody looked at the marker before it was locked and takes the folder for his own.
            Err(TryLockError::WouldBlock) => Err(StorageError::Busy { path: self.path.clone() }),
            // Some network file systems have no locks; there what a dead process left is never taken for stale.
            Err(TryLockError::Error(error)) if error.kind() == io::ErrorKind::Unsupported => Ok(Some(file)),
            Err(TryLockError::Error(error)) => Err(fail(error)),
        }
    }
}

/// Whether renaming another folder to `path` would fail or pull it away from under somebody.
pub(super) fn must_stay(path: &Path) -> bool {
    let is_mount = rustix::fs::statx(
        rustix::fs::CWD,
        path,
        rustix::fs::AtFlags::empty(),
        rustix::fs::StatxFlags::BASIC_STATS,
    )
    .is_ok_and(|found| found.stx_attributes.contains(rustix::fs::StatxAttributes::MOUNT_ROOT));
    let is_here = std::env::current_dir().and_then(fs::canonicalize).is_ok_and(|here| here.starts_with(path));
    is_mount || is_here || path.parent().is_none()
}

fn list(folder: &Path) -> io::Result<Vec<OsString>> {
    fs::read_dir(folder)?.map(|entry| entry.map(|entry| entry.file_name())).collect()
}

/// What an existing folder must not hold to become a bundle: anything.
fn refuse_occupied(path: &Path) -> Result<(), StorageError> {
    let names = list(path).map_err(|error| StorageError::file("list", path, error))?;
    // What a dead process left inside is removed when the place is claimed.
    let Some(name) = names.iter().find(|name| name.as_os_str() != OsStr::new(INNER)) else { return Ok(()) };
    let others = match names.len() - 1 {
        0 => String::new(),
        count => format!(" and {count} more"),
    };
    Err(StorageError::Occupied {
        path: path.to_owned(),
        found: format!("it holds {}{others}", name.to_string_lossy()),
    })
}

/// Whose an unfinished folder is.
#[derive(Debug)]
enum State {
    /// A living process writes it, or nothing tells that none does.
    Live,
    /// A process died over it. Nobody else finds it stale as long as its marker is held, which is locked.
    Stale(File),
    /// Nothing says that it is ours.
    Foreign,
}

fn state(partial: &Path) -> State {
    let path = partial.join(MARKER);
    let marker = match File::open(&path) {
        Ok(marker) => marker,
        Err(error) if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) => {
            return State::Foreign;
        }
        Err(_) => return State::Live,
    };
    // Between opening and locking, the folder may have got its name or another owner.
    match marker.try_lock() {
        Ok(()) if is_same(&marker, &path) => State::Stale(marker),
        _ => State::Live,
    }
}

/// Whether `path` still names the opened `file`.
fn is_same(file: &File, path: &Path) -> bool {
    let identity = |found: fs::Metadata| (found.dev(), found.ino());
    match (file.metadata(), fs::symlink_metadata(path)) {
        (Ok(opened), Ok(named)) => identity(opened) == identity(named),
        _ => false,
    }
}

/// Stale folders in `folder` in order of their names, with their locks.
fn find_stale(folder: &Path) -> io::Result<Vec<(PathBuf, File)>> {
    let mut found: Vec<(PathBuf, File)> = list(folder)?
        .into_iter()
        .filter(|name| Path::new(name).extension().is_some_and(|extension| extension == "partial"))
        .map(|name| folder.join(name))
        .filter(|path| path.is_dir())
        .filter_map(|path| match state(&path) {
            State::Stale(lock) => Some((path, lock)),
            State::Live | State::Foreign => None,
        })
        .collect();
    found.sort_by(|(one, _), (other, _)| one.cmp(other));
    Ok(found)
}

/// Folders in `folder` that unfinished bundles of dead processes left behind.
pub fn stale_partials(folder: &Path) -> io::Result<Vec<PathBuf>> {
    Ok(find_stale(folder)?.into_iter().map(|(path, _)| path).collect())
}

/// Removes what [`stale_partials`] finds, and returns it.
pub fn remove_stale_partials(folder: &Path) -> io::Result<Vec<PathBuf>> {
    let remove = |(path, _lock): (PathBuf, File)| fs::remove_dir_all(&path).map(|()| path);
    find_stale(folder)?.into_iter().map(remove).collect()
}
