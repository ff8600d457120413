//! One file of a bundle while it is written.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

use super::BundleWriter;
use crate::store::{
    disk::DiskFile,
    error::StorageError,
    manifest::FileEntry,
    source::{Policy, hash_file},
};

/// Small writes are gathered up to this many bytes.
const BUFFER_BYTES: usize = 1 << 18;

/// A file of a bundle that is being written. Belongs to the bundle once [`BundleFile::commit`] has returned; dropping it
/// before removes it.
pub struct BundleFile<'a> {
    writer: &'a BundleWriter,
    name: String,
    path: PathBuf,
    out: Option<Box<dyn DiskFile>>,
    buffer: Vec<u8>,
    bytes: u64,
    failed: bool,
}

/// A file that is complete but not yet known to be on the medium.
pub(super) struct Written {
    pub(super) name: String,
    path: PathBuf,
    bytes: u64,
    out: Box<dyn DiskFile>,
}

impl Written {
    /// Brings the file to the medium and hashes what is there.
    pub(super) fn seal(mut self) -> Result<(String, FileEntry), StorageError> {
        self.out.sync().map_err(|error| StorageError::file("sync", &self.path, error))?;
        let entry = hash_file(&self.path, Policy::Local)
            .map_err(|error| StorageError::file("hash", &self.path, io::Error::other(error)))?;
        if entry.bytes != self.bytes {
            let detail = format!("{} bytes were written, {} are there", self.bytes, entry.bytes);
            return Err(StorageError::refused(&self.name, detail));
        }
        Ok((self.name, entry))
    }
}

impl std::fmt::Debug for BundleFile<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BundleFile")
            .field("name", &self.name)
            .field("bytes", &self.bytes)
            .finish_non_exhaustive()
    }
}

impl<'a> BundleFile<'a> {
    pub(super) fn new(writer: &'a BundleWriter, name: &str, path: PathBuf, out: Box<dyn DiskFile>) -> Self {
        Self {
            writer,
            name: name.to_owned(),
            path,
            out: Some(out),
            buffer: Vec::new(),
            bytes: 0,
            failed: false,
        }
    }

    /// Where the file is while it is written.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Makes the file part of the bundle.
    pub fn commit(mut self) -> Result<(), StorageError> {
        let fail = |path: &Path, error| StorageError::file("write", path, error);
        self.flush().map_err(|error| fail(&self.path, error))?;
        if self.failed {
            return Err(StorageError::refused(&self.name, "an earlier write to it failed"));
        }
        let Some(out) = self.out.take() else {
            return Err(StorageError::refused(&self.name, "was committed already"));
        };
        let written = Written { name: self.name.clone(), path: self.path.clone(), bytes: self.bytes, out };
        self.writer.progress().written.push(written);
        Ok(())
    }

    fn send(&mut self, data: &[u8]) -> io::Result<()> {
        let Some(out) = &mut self.out else { return Ok(()) };
        if let Err(error) = out.write_all(data) {
            self.failed = true;
            return Err(error);
        }
        self.bytes += data.len() as u64;
        Ok(())
    }
}

impl Write for BundleFile<'_> {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        if self.buffer.len() + data.len() > BUFFER_BYTES {
            self.flush()?;
        }
        if data.len() >= BUFFER_BYTES {
            self.send(data)?;
        } else {
            self.buffer.extend_from_slice(data);
        }
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        let mut buffer = std::mem::take(&mut self.buffer);
        let sent = self.send(&buffer);
        buffer.clear();
        self.buffer = buffer;
        sent
    }
}

impl Drop for BundleFile<'_> {
    fn drop(&mut self) {
        // Still here: never committed.
        if self.out.take().is_some()
            && let Err(error) = fs::remove_file(&self.path)
        {
            tracing::warn!(path = %self.path.display(), %error, "unfinished file could not be removed");
        }
    }
}
