//! Bundles as input: finding, checking and reading what a manifest names.

use std::{
    fs::{self, File},
    io::{self, Read},
    os::unix::fs::OpenOptionsExt,
    path::{Component, Path, PathBuf},
};

use polscan_patterns::Mode;
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use thiserror::Error;

use super::{
    error::{Fault, Faults, InputError},
    frames::{self, FrameSet, Limits},
    manifest::{self, FileEntry, Manifest, Source, SourceFile, path_fault},
    maps, npz,
};
use crate::{
    geometry::{self, Calibration, CalibrationError, ReadHints},
    truth::Truth,
};

/// Longest manifest that is read, in bytes.
pub(crate) const MAX_MANIFEST_BYTES: u64 = 32 << 20;

/// What the array `object` of the truth holds where there is none.
const NO_OBJECT: u8 = 255;

/// How far a bundle is trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Policy {
    /// Given by a person on this machine: paths may lead anywhere and symbolic links are followed.
    Local,
    /// Came over the network: nothing may lead out of the bundle's folder, and symbolic links are refused.
    Upload,
}

/// A bundle whose manifest has been read and checked.
#[derive(Debug, Clone)]
pub struct Bundle {
    folder: PathBuf,
    manifest: Manifest,
    manifest_sha256: String,
    policy: Policy,
    notes: Vec<String>,
}

impl Bundle {
    /// Opens the bundle in the folder `path`, or that of the manifest `path`. `mode` comes before the manifest's own.
    pub fn open(path: &Path, policy: Policy, mode: Option<Mode>) -> Result<Self, InputError> {
        let is_folder =
            fs::metadata(path).map_err(|error| InputError::file("open bundle", path, error))?.is_dir();
        let file = if is_folder { path.join(manifest::FILE_NAME) } else { path.to_owned() };
        let folder = match file.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent.to_owned(),
            _ => PathBuf::from("."),
        };
        let bytes = read_bounded(&file, policy, "read manifest", MAX_MANIFEST_BYTES)?;
        let wrong = |faults| InputError::Manifest { path: file.clone(), faults };
        let parsed = Manifest::parse(&bytes).map_err(wrong)?;
        parsed.manifest.check(policy, mode).map_err(wrong)?;
        let notes = parsed
            .unknown_keys
            .iter()
            .map(|key| format!("the manifest's key `{key}` is unknown and was ignored"))
            .collect();
        Ok(Self {
            folder,
            manifest: parsed.manifest,
            manifest_sha256: hex(&Sha256::digest(&bytes)),
            policy,
            notes,
        })
    }

    /// Folder that the manifest's paths are relative to.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The manifest.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// What the report should say about the manifest itself.
    pub fn notes(&self) -> &[String] {
        &self.notes
    }

    /// Where a path of the manifest leads, if the policy lets it.
    pub fn resolve(&self, path: &str) -> Result<PathBuf, InputError> {
        resolve(&self.folder, path, self.policy)
    }

    /// Loads all frames.
    pub fn frames(&self, limits: &Limits) -> Result<FrameSet, InputError> {
        frames::load(&self.folder, &self.manifest, self.policy, limits)
    }

    /// Path and bytes of the calibration that the manifest names.
    pub fn calibration(&self) -> Result<Option<(PathBuf, Vec<u8>)>, InputError> {
        let Some(name) = &self.manifest.calibration else { return Ok(None) };
        let path = self.resolve(name)?;
        let bytes = read_bounded(&path, self.policy, "read calibration", geometry::MAX_BYTES)?;
        Ok(Some((path, bytes)))
    }

    /// What a simulated rig knew of its scene, if the bundle has it. Its arrays must have the `size` of the frames,
    /// (width, height), and name only objects that the manifest lists.
    pub fn truth(&self, size: (usize, usize)) -> Result<Option<Truth>, InputError> {
        let Some(objects) = &self.manifest.truth_objects else { return Ok(None) };
        let path = self.resolve(maps::TRUTH_FILE_NAME)?;
        let mut arrays = npz::read(&open_regular(&path, self.policy, "read truth")?)
            .map_err(|detail| InputError::content(&path, detail))?;
        let mut floats = |name| arrays.take_f32(name).map_err(|detail| InputError::content(&path, detail));
        let (column, row, depth_mm) = (floats("column")?, floats("row")?, floats("depth")?);
        let object = arrays.take_u8("object").map_err(|detail| InputError::content(&path, detail))?;
        let sizes = [
            ("column", column.width(), column.height()),
            ("row", row.width(), row.height()),
            ("depth", depth_mm.width(), depth_mm.height()),
            ("object", object.width(), object.height()),
        ];
        if let Some((name, width, height)) = sizes.into_iter().find(|&(_, w, h)| (w, h) != size) {
            let detail =
                format!("its `{name}` is {width} x {height}, the frames are {} x {}", size.0, size.1);
            return Err(InputError::content(&path, detail));
        }
        let unknown = |&index: &u8| index != NO_OBJECT && usize::from(index) >= objects.len();
        if let Some(index) = object.data().iter().copied().find(unknown) {
            let detail = format!(
                "its `object` holds {index}, the manifest's `truth_objects` lists {} (and {NO_OBJECT} means none)",
                objects.len()
            );
            return Err(InputError::content(&path, detail));
        }
        Ok(Some(Truth { column, row, depth_mm, object, objects: objects.clone() }))
    }

    /// Compares the files that a decode reads - `frames`, calibration and truth - with the sizes and hashes that the
    /// manifest gives, and reports every difference; frames that lie elsewhere are compared with `source.frames`. What
    /// is wrong with any other file changes no result and is returned as notes.
    pub fn verify(&self, frames: &FrameSet) -> Result<Vec<String>, InputError> {
        let hashes = frames.hashes();
        let of_frame = |name: &str| hashes.iter().find(|file| same_file(&file.path, name));
        let differences: Vec<(&String, String)> = self
            .manifest
            .files
            .par_iter()
            .filter_map(|(name, entry)| {
                let found = match of_frame(name) {
                    Some(file) => Ok(file.entry.clone()),
                    None => self.resolve(name).and_then(|path| hash_file(&path, self.policy)),
                };
                let message = match found {
                    Ok(found) => difference(&found, entry, "the manifest")?,
                    Err(error) => error.to_string(),
                };
                Some((name, message))
            })
            .collect();
        let is_read = |name: &str| {
            of_frame(name).is_some()
                || self.manifest.calibration.as_deref().is_some_and(|path| same_file(path, name))
                || (self.manifest.truth_objects.is_some() && name == maps::TRUTH_FILE_NAME)
        };
        let (read, others): (Vec<_>, Vec<_>) = differences.into_iter().partition(|(name, _)| is_read(name));
        let mut faults: Vec<Fault> =
            read.into_iter().map(|(name, message)| Fault::new(format!("files.{name}"), message)).collect();
        faults.extend(self.source_faults(hashes));
        if !faults.is_empty() {
            let path = self.folder.join(manifest::FILE_NAME);
            return Err(InputError::Manifest { path, faults: Faults(faults) });
        }
        let note = |(name, message)| format!("the bundle's file `{name}`, which is not decoded: {message}");
        Ok(others.into_iter().map(note).collect())
    }

    /// How frames that are no part of this bundle differ from those that it was made from.
    fn source_faults(&self, hashes: &[SourceFile]) -> Vec<Fault> {
        let Some(source) = &self.manifest.source else { return Vec::new() };
        let own = |file: &SourceFile| self.manifest.files.keys().any(|name| same_file(name, &file.path));
        if hashes.iter().all(own) {
            return Vec::new();
        }
        if hashes.len() != source.frames.len() {
            let message = format!("has {} entries for {} files of frames", source.frames.len(), hashes.len());
            return vec![Fault::new("source.frames", message)];
        }
        let compare = |(index, (found, expected)): (usize, (&SourceFile, &SourceFile))| {
            let message = difference(&found.entry, &expected.entry, "`source`")?;
            Some(Fault::new(format!("source.frames[{index}]"), format!("{} {message}", found.path)))
        };
        hashes.iter().zip(&source.frames).enumerate().filter_map(compare).collect()
    }

    /// What the manifest of a decode of `frames` says about their origin.
    pub fn origin(&self, frames: &FrameSet) -> Source {
        Source {
            bundle: absolute(&self.folder).to_string_lossy().into_owned(),
            id: self.manifest.id.clone(),
            manifest_sha256: self.manifest_sha256.clone(),
            frames: frames.hashes().to_vec(),
        }
    }

    /// The frames as a decode's own manifest names them: by paths that hold from any folder.
    pub fn absolute_frames(&self) -> manifest::FrameFiles {
        let folder = absolute(&self.folder);
        let full = |path: &String| folder.join(path).to_string_lossy().into_owned();
        match &self.manifest.frames {
            manifest::FrameFiles::Npy(path) => manifest::FrameFiles::Npy(full(path)),
            manifest::FrameFiles::Images(paths) => {
                manifest::FrameFiles::Images(paths.iter().map(full).collect())
            }
        }
    }
}

/// Whether two paths of a manifest name the same file by their words.
fn same_file(one: &str, other: &str) -> bool {
    let words = |path| Path::new(path).components().filter(|part| *part != Component::CurDir);
    words(one).eq(words(other))
}

/// How `found` differs from what `teller` says.
fn difference(found: &FileEntry, expected: &FileEntry, teller: &str) -> Option<String> {
    if found.bytes != expected.bytes {
        return Some(format!("has {} bytes, {teller} says {}", found.bytes, expected.bytes));
    }
    let other = !found.sha256.eq_ignore_ascii_case(&expected.sha256);
    other.then(|| format!("has another content than {teller} says"))
}

fn absolute(path: &Path) -> PathBuf {
    path.canonicalize().unwrap_or_else(|_| path.to_owned())
}

/// Where `path` of a manifest in `folder` leads, if `policy` lets it.
pub(crate) fn resolve(folder: &Path, path: &str, policy: Policy) -> Result<PathBuf, InputError> {
    if let Some(reason) = path_fault(path, policy) {
        return Err(InputError::Path { path: path.to_owned(), reason });
    }
    if policy == Policy::Upload {
        let mut so_far = folder.to_owned();
        for part in Path::new(path).components() {
            so_far.push(part);
            let is_link = fs::symlink_metadata(&so_far).is_ok_and(|found| found.file_type().is_symlink());
            if is_link {
                let reason = "is or passes a symbolic link: upload the file itself";
                return Err(InputError::Path { path: path.to_owned(), reason });
            }
        }
    }
    Ok(folder.join(path))
}

/// Opens a regular file: a pipe or device would block or never end.
pub(crate) fn open_regular(path: &Path, policy: Policy, operation: &'static str) -> Result<File, InputError> {
    let fail = |error| InputError::file(operation, path, error);
    let odd = || InputError::content(path, "is not a regular file: give a file");
    if !fs::metadata(path).map_err(fail)?.is_file() {
        return Err(odd());
    }
    let mut options = File::options();
    options.read(true);
    if policy == Policy::Upload {
        // The link check looked at names; this holds even if the last one was exchanged since.
        options.custom_flags(rustix::fs::OFlags::NOFOLLOW.bits() as i32);
    }
    let file = options.open(path).map_err(fail)?;
    if !file.metadata().map_err(fail)?.is_file() {
        return Err(odd());
    }
    Ok(file)
}

/// Reads a whole file of at most `limit` bytes.
pub(crate) fn read_bounded(
    path: &Path,
    policy: Policy,
    operation: &'static str,
    limit: u64,
) -> Result<Vec<u8>, InputError> {
    let file = open_regular(path, policy, operation)?;
    let mut bytes = Vec::new();
    file.take(limit + 1).read_to_end(&mut bytes).map_err(|error| InputError::file(operation, path, error))?;
    if bytes.len() as u64 > limit {
        return Err(InputError::content(
            path,
            format!("is longer than {limit} bytes, the most that is read"),
        ));
    }
    Ok(bytes)
}

/// The part of a sensor that frames show.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SensorPart {
    /// (width, height) of the whole sensor.
    pub sensor: (u32, u32),
    /// (column, row) of the sensor where the frames begin.
    pub origin: (u32, u32),
}

/// A calibration file given by a person, for frames of the size in `hints` that show `part` of the sensor: one of the
/// whole sensor is cut to it.
pub fn read_calibration_for(
    path: &Path,
    hints: &ReadHints,
    part: Option<SensorPart>,
) -> Result<Calibration, CalibrationFileError> {
    let read = read_calibration(path, hints);
    let (Some(part), Some(frame)) = (part, hints.camera_size) else { return read };
    if part.sensor == frame {
        return read;
    }
    // Files of other tools are read with the size that is expected of them.
    let whole = ReadHints { camera_size: Some(part.sensor), ..*hints };
    let calibration = read.or_else(|fault| read_calibration(path, &whole).map_err(|_| fault))?;
    Ok(match calibration.camera.size() == part.sensor {
        true => calibration.cropped(part.origin, frame),
        false => calibration,
    })
}

/// A calibration file given by a person, in any format that is known.
pub fn read_calibration(path: &Path, hints: &ReadHints) -> Result<Calibration, CalibrationFileError> {
    let bytes = read_bounded(path, Policy::Local, "read calibration", geometry::MAX_BYTES)?;
    Ok(Calibration::from_bytes(&bytes, &path.display().to_string(), hints)?)
}

/// Why a calibration cannot be had from a file.
#[derive(Debug, Error)]
pub enum CalibrationFileError {
    /// It cannot be read.
    #[error(transparent)]
    Input(#[from] InputError),
    /// Its content cannot be used.
    #[error(transparent)]
    Content(#[from] CalibrationError),
}

/// Length and hash of a file.
pub(crate) fn hash_file(path: &Path, policy: Policy) -> Result<FileEntry, InputError> {
    let mut file = open_regular(path, policy, "hash")?;
    let mut digest = Sha256::new();
    let mut buffer = vec![0; 1 << 20];
    let mut bytes = 0;
    loop {
        match file.read(&mut buffer) {
            Ok(0) => return Ok(FileEntry { bytes, sha256: hex(&digest.finalize()) }),
            Ok(length) => {
                digest.update(&buffer[..length]);
                bytes += length as u64;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(InputError::file("hash", path, error)),
        }
    }
}

/// Lower-case hexadecimal digits of `bytes`.
pub(crate) fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests;
