//! Writing one file: everything or nothing, and never over another.

use std::{
    fs::{self, File},
    io::{self, BufWriter, Write},
    path::{Path, PathBuf},
};

use rustix::fs::{CWD, RenameFlags, renameat_with};

use super::error::StorageError;

/// Small writes are gathered up to this many bytes.
const BUFFER_BYTES: usize = 1 << 18;

/// An unfinished file; dropping it removes it.
struct Partial(PathBuf);

impl Drop for Partial {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_file(&self.0)
            && error.kind() != io::ErrorKind::NotFound
        {
            tracing::warn!(path = %self.0.display(), %error, "unfinished file could not be removed");
        }
    }
}

/// Writes the file `path`, which must not exist nor lie in the folder `source`, with `write`. Missing folders are made. Until all
/// of it is on the medium it lies beside its place, as `.NAME.PROCESS.partial`.
pub fn write_new<T>(
    path: &Path,
    source: &Path,
    write: impl FnOnce(&mut dyn Write) -> io::Result<T>,
) -> Result<T, StorageError> {
    let full = std::path::absolute(path).map_err(|error| StorageError::file("find", path, error))?;
    let (Some(folder), Some(name)) = (full.parent(), full.file_name()) else {
        return Err(StorageError::file("create", path, io::ErrorKind::InvalidInput.into()));
    };
    refuse_inside(&full, folder, source)?;
    let taken = || StorageError::Exists { path: full.clone() };
    if fs::symlink_metadata(&full).is_ok() {
        return Err(taken());
    }
    fs::create_dir_all(folder).map_err(|error| StorageError::file("create folder", folder, error))?;
    let mut hidden = std::ffi::OsString::from(".");
    hidden.push(name);
    hidden.push(format!(".{}.partial", std::process::id()));
    let partial = folder.join(hidden);
    let fail = |error| StorageError::file("write", &full, error);
    let file = File::create_new(&partial).map_err(fail)?;
    let partial = Partial(partial);
    let mut out = BufWriter::with_capacity(BUFFER_BYTES, file);
    let written = write(&mut out).map_err(fail)?;
    let file = out.into_inner().map_err(|error| fail(error.into_error()))?;
    file.sync_all().map_err(fail)?;
    match renameat_with(CWD, &partial.0, CWD, &full, RenameFlags::NOREPLACE) {
        Ok(()) => {}
        Err(rustix::io::Errno::EXIST) => return Err(taken()),
        // Some file systems cannot refuse to replace; that nothing was there has been seen above.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {
            fs::rename(&partial.0, &full).map_err(fail)?;
        }
        Err(error) => return Err(fail(error.into())),
    }
    let synced = File::open(folder).and_then(|folder| folder.sync_all());
    synced.map_err(|error| StorageError::file("sync folder", folder, error))?;
    Ok(written)
}

/// Refuses a place inside `source`, through whichever links it is named.
fn refuse_inside(path: &Path, folder: &Path, source: &Path) -> Result<(), StorageError> {
    let bundle = fs::canonicalize(source).map_err(|error| StorageError::file("find", source, error))?;
    let existing = folder.ancestors().find_map(|folder| fs::canonicalize(folder).ok());
    match existing.is_some_and(|existing| existing.starts_with(&bundle)) {
        true => Err(StorageError::InsideSource { path: path.to_owned(), bundle }),
        false => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
    }

    #[test]
    fn a_file_appears_whole_and_is_never_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let (source, path) = (folder.path().join("source"), folder.path().join("a/b/file"));
        fs::create_dir(&source).unwrap();
        let length = write_new(&path, &source, |out| {
            assert!(!path.exists(), "before it is whole");
            out.write_all(b"text").map(|()| 4)
        });
        assert_eq!(length.unwrap(), 4);
        assert_eq!(fs::read(&path).unwrap(), b"text");
        let again = write_new(&path, &source, |out| out.write_all(b"other"));
        assert!(matches!(again, Err(StorageError::Exists { .. })), "{again:?}");
        assert_eq!(
            (fs::read(&path).unwrap(), names(path.parent().unwrap())),
            (b"text".into(), vec!["file".into()])
        );
    }

    #[test]
    fn somebody_elses_file_that_appears_meanwhile_stays() {
        let folder = tempfile::tempdir().unwrap();
        let (source, path) = (folder.path().join("source"), folder.path().join("file"));
        fs::create_dir(&source).unwrap();
        let result = write_new(&path, &source, |_| fs::write(&path, "theirs"));
        assert!(matches!(result, Err(StorageError::Exists { .. })), "{result:?}");
        assert_eq!(fs::read(&path).unwrap(), b"theirs");
        assert_eq!(names(folder.path()).len(), 2, "{:?}", names(folder.path()));
    }

    #[test]
    fn what_fails_leaves_nothing() {
        let folder = tempfile::tempdir().unwrap();
        let source = tempfile::tempdir().unwrap();
        let failed = write_new(&folder.path().join("file"), source.path(), |out| {
            out.write_all(&[0; 1 << 19])?;
            Err::<(), _>(io::ErrorKind::StorageFull.into())
        });
        assert!(matches!(failed, Err(StorageError::File { .. })), "{failed:?}");
        assert_eq!(names(folder.path()), Vec::<String>::new());
    }

    #[test]
    fn nothing_is_written_into_the_source() {
        let source = tempfile::tempdir().unwrap();
        let link = tempfile::tempdir().unwrap();
        let through = link.path().join("link");
        std::os::unix::fs::symlink(source.path(), &through).unwrap();
        for path in [source.path().join("file"), source.path().join("a/b"), through.join("file")] {
            let result = write_new(&path, source.path(), |_| Ok(()));
            assert!(matches!(result, Err(StorageError::InsideSource { .. })), "{path:?}: {result:?}");
        }
        assert_eq!(names(source.path()), Vec::<String>::new());
    }
}
