//! The few operations by which bundles reach the disk, so that tests can make each of them fail.

use std::{
    fs::{self, File},
    io::{self, Write},
    path::Path,
};

/// A file that is being written.
pub(super) trait DiskFile: Write + Send {
    /// Returns once all that was written is on the medium.
    fn sync(&mut self) -> io::Result<()>;
}

/// A file system.
pub(super) trait Disk: Send + Sync {
    /// Creates a file that must not exist.
    fn create(&self, path: &Path) -> io::Result<Box<dyn DiskFile>>;
    /// Creates a folder that must not exist.
    fn create_folder(&self, path: &Path) -> io::Result<()>;
    /// Gives `from` the name `to`, which may be an empty folder.
    fn rename(&self, from: &Path, to: &Path) -> io::Result<()>;
    /// Returns once the entries of a folder are on the medium.
    fn sync_folder(&self, path: &Path) -> io::Result<()>;
    /// Bytes that this user may still write where `path` is; `None` where the file system does not tell.
    fn free_bytes(&self, path: &Path) -> io::Result<Option<u64>>;
}

impl DiskFile for File {
    fn sync(&mut self) -> io::Result<()> {
        self.sync_all()
    }
}

/// The machine's own.
#[derive(Debug)]
pub(super) struct RealDisk;

impl Disk for RealDisk {
    fn create(&self, path: &Path) -> io::Result<Box<dyn DiskFile>> {
        Ok(Box::new(File::create_new(path)?))
    }

    fn create_folder(&self, path: &Path) -> io::Result<()> {
        fs::create_dir(path)
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        fs::rename(from, to)
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        File::open(path)?.sync_all()
    }

    fn free_bytes(&self, path: &Path) -> io::Result<Option<u64>> {
        let found = rustix::fs::statvfs(path)?;
        Ok((found.f_blocks > 0).then(|| found.f_bavail.saturating_mul(found.f_frsize)))
    }
}
