//! What can go wrong with stored data, split by what the caller can do about it.

use std::{
    fmt, io,
    path::{Path, PathBuf},
};

use thiserror::Error;

/// One thing that is wrong in a manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Where, as a key path: `sequence[3].bit`.
    pub key: String,
    /// What is wrong and what would be right.
    pub message: String,
}

impl Fault {
    /// A fault of `key`.
    pub fn new(key: impl Into<String>, message: impl Into<String>) -> Self {
        Self { key: key.into(), message: message.into() }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}`: {}", self.key, self.message)
    }
}

/// All faults of a manifest, never empty.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Faults(pub Vec<Fault>);

impl fmt::Display for Faults {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, fault) in self.0.iter().enumerate() {
            write!(f, "{}{fault}", if index == 0 { "" } else { "; " })?;
        }
        Ok(())
    }
}

impl std::error::Error for Faults {}

/// Recorded data cannot be used: wrong, damaged or absent input.
#[derive(Debug, Error)]
pub enum InputError {
    /// The manifest contradicts itself or its schema.
    #[error("manifest {} cannot be used: {faults}", path.display())]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// Everything that is wrong with it.
        faults: Faults,
    },
    /// A file cannot be read.
    #[error("cannot {operation} {}: {next_step}", path.display())]
    File {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// What to do.
        next_step: &'static str,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A file holds something else than it should.
    #[error("{}: {detail}", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it, and what would be right.
        detail: String,
    },
    /// A path that leads where this kind of input must not lead.
    #[error("path {path:?} is refused: {reason}")]
    Path {
        /// As written in the manifest.
        path: String,
        /// Why.
        reason: &'static str,
    },
}

impl InputError {
    /// A failed read with the advice that fits its cause.
    pub fn file(operation: &'static str, path: &Path, source: io::Error) -> Self {
        let next_step = match source.kind() {
            io::ErrorKind::NotFound => "check the path, or restore the file that is missing",
            io::ErrorKind::PermissionDenied => "give this user the right to read it",
            io::ErrorKind::IsADirectory => "name a file rather than a folder",
            _ => "check the medium, then try again",
        };
        Self::File { operation, path: path.to_owned(), next_step, source }
    }

    /// A file whose content is wrong.
    pub fn content(path: &Path, detail: impl Into<String>) -> Self {
        Self::Content { path: path.to_owned(), detail: detail.into() }
    }
}

/// A result cannot be written.
#[derive(Debug, Error)]
pub enum StorageError {
    /// The target holds something already, which is never overwritten.
    #[error("cannot write the result to {}: {found}; name a folder that is absent or empty", path.display())]
    Occupied {
        /// The target.
        path: PathBuf,
        /// What is there.
        found: String,
    },
    /// A single file is there already, which is never overwritten.
    #[error("cannot write the result to {}: it exists already; name a file that does not", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The target is the input itself or lies in it.
    #[error("cannot write the result to {}: it would change the bundle {}; name a folder outside it",
        path.display(), bundle.display())]
    InsideSource {
        /// The target.
        path: PathBuf,
        /// The input.
        bundle: PathBuf,
    },
    /// Another process is writing to the same target.
    #[error("cannot write the result to {}: another process is writing it; wait for it or name another folder",
        path.display())]
    Busy {
        /// The target.
        path: PathBuf,
    },
    /// The disk is too small for what is to come.
    #[error("cannot write {needed} bytes to {}: only {available} are free; free some space or name a folder \
        on another disk", path.display())]
    Space {
        /// Where.
        path: PathBuf,
        /// Bytes that are needed.
        needed: u64,
        /// Bytes that are free.
        available: u64,
    },
    /// An operation on a file failed.
    #[error("cannot {operation} {}: {next_step}", path.display())]
    File {
        /// What was tried.
        operation: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What to do.
        next_step: &'static str,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The caller broke the rules of a bundle: a defect, reported rather than written.
    #[error("refused to write {name} into the bundle: {detail}")]
    Refused {
        /// Entry of the bundle.
        name: String,
        /// Which rule was broken.
        detail: String,
    },
}

impl StorageError {
    /// A failed operation with the advice that fits its cause.
    pub fn file(operation: &'static str, path: &Path, source: io::Error) -> Self {
        let next_step = match source.kind() {
            io::ErrorKind::StorageFull => {
                "the disk is full: free some space or name a folder on another disk"
            }
            io::ErrorKind::QuotaExceeded => {
                "the quota is used up: free some space or name a folder on another disk"
            }
            io::ErrorKind::ReadOnlyFilesystem => {
                "the file system is read-only: name a folder on another disk"
            }
            io::ErrorKind::PermissionDenied => {
                "give this user the right to write there or name another folder"
            }
            io::ErrorKind::NotADirectory => "a part of the path is a file: name another folder",
            io::ErrorKind::DirectoryNotEmpty | io::ErrorKind::AlreadyExists => {
                "something appeared there meanwhile: name a folder that is absent or empty"
            }
            _ => "check the disk, then try again",
        };
        Self::File { operation, path: path.to_owned(), next_step, source }
    }

    /// A broken rule.
    pub fn refused(name: impl Into<String>, detail: impl Into<String>) -> Self {
        Self::Refused { name: name.into(), detail: detail.into() }
    }
}
