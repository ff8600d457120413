//! Writing a bundle: everything or nothing. Files are written in a folder `NAME.partial` beside the target,
//! brought to the medium and hashed, followed by the manifest, and only then the folder gets its name.

mod file;
mod place;

use std::{
    collections::BTreeSet,
    fs, io,
    path::{Component, Path, PathBuf},
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use rayon::prelude::*;

use super::{
    disk::{Disk, RealDisk},
    error::StorageError,
    manifest::{self, FrameFiles, Manifest},
    maps::{self, Maps},
    npy::FrameStream,
    npz::{self, Array},
    source::Policy,
};
use crate::{decode::Plane, truth::Truth};

pub use file::BundleFile;
pub use place::{remove_stale_partials, stale_partials};

use file::Written;
use place::Place;

/// Name of the frames in our own bundles.
pub const FRAMES_FILE_NAME: &str = "frames.npy";

/// Name of the calibration in our own bundles.
pub const CALIBRATION_FILE_NAME: &str = "calibration.toml";

/// A bundle that is being written. Dropping it unfinished leaves nothing behind.
pub struct BundleWriter {
    disk: Arc<dyn Disk>,
    place: Place,
    progress: Mutex<Progress>,
    finished: bool,
}

impl std::fmt::Debug for BundleWriter {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("BundleWriter").field("place", &self.place).finish_non_exhaustive()
    }
}

/// What has been written so far.
#[derive(Default)]
struct Progress {
    /// Names given out, so that no file is written twice.
    names: BTreeSet<String>,
    written: Vec<Written>,
    folders: BTreeSet<PathBuf>,
    /// Number of frames in `frames.npy`, once it is committed.
    frames: Option<usize>,
}

impl BundleWriter {
    /// Begins a bundle that will become the folder `out`, which must be absent or empty and must not be, or lie in,
    /// `source`, the bundle that is read meanwhile. `expected_bytes` must be free on its disk. Missing parents are made.
    pub fn create(out: &Path, source: Option<&Path>, expected_bytes: u64) -> Result<Self, StorageError> {
        Self::create_on(Arc::new(RealDisk), out, source, expected_bytes)
    }

    fn create_on(
        disk: Arc<dyn Disk>,
        out: &Path,
        source: Option<&Path>,
        expected_bytes: u64,
    ) -> Result<Self, StorageError> {
        let place = Place::claim(&*disk, out, source, expected_bytes)?;
        Ok(Self { disk, place, progress: Mutex::default(), finished: false })
    }

    /// The folder that the bundle will become, as an absolute path.
    pub fn target(&self) -> &Path {
        self.place.target()
    }

    fn progress(&self) -> MutexGuard<'_, Progress> {
        self.progress.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Begins the file `name`, which may lie in a sub-folder: `maps/column.png`. Files may be written in parallel. What is
    /// not committed is removed again.
    pub fn file(&self, name: &str) -> Result<BundleFile<'_>, StorageError> {
        let plain = |part| matches!(part, Component::Normal(_));
        if name.is_empty() || name == manifest::FILE_NAME || !Path::new(name).components().all(plain) {
            return Err(StorageError::refused(name, "is no name of a file in a bundle"));
        }
        if !self.progress().names.insert(name.to_owned()) {
            return Err(StorageError::refused(name, "was written already"));
        }
        self.open(name)
    }

    fn open(&self, name: &str) -> Result<BundleFile<'_>, StorageError> {
        let path = self.place.partial().join(name);
        let folder = Path::new(name).parent().unwrap_or(Path::new(""));
        let mut so_far = self.place.partial().to_owned();
        for part in folder.components() {
            so_far.push(part);
            let mut progress = self.progress();
            if !progress.folders.contains(&so_far) {
                self.disk
                    .create_folder(&so_far)
                    .map_err(|error| StorageError::file("create folder", &so_far, error))?;
                progress.folders.insert(so_far.clone());
            }
        }
        let out = self.disk.create(&path).map_err(|error| StorageError::file("create", &path, error))?;
        Ok(BundleFile::new(self, name, path, out))
    }

    /// Writes the file `name` with `write`, to which it is a stream.
    pub fn write_with(
        &self,
        name: &str,
        write: impl FnOnce(&mut BundleFile<'_>) -> io::Result<()>,
    ) -> Result<(), StorageError> {
        let mut file = self.file(name)?;
        write(&mut file).map_err(|error| StorageError::file("write", file.path(), error))?;
        file.commit()
    }

    /// Writes `bytes` as the file `name`.
    pub fn bytes(&self, name: &str, bytes: &[u8]) -> Result<(), StorageError> {
        self.write_with(name, |out| io::Write::write_all(out, bytes))
    }

    /// Begins `frames.npy`, to which frames are then added one by one; there may be none.
    pub fn frames(
        &self,
        frames: usize,
        (width, height): (usize, usize),
        bit_depth: u8,
    ) -> Result<FramesWriter<'_>, StorageError> {
        let file = self.file(FRAMES_FILE_NAME)?;
        let path = file.path().to_owned();
        let stream = FrameStream::new(file, frames, height, width, bit_depth)
            .map_err(|error| StorageError::file("write", &path, error))?;
        Ok(FramesWriter { stream, path, writer: self, frames })
    }

    /// Writes `arrays` as the archive `name`.
    pub fn npz(&self, name: &str, arrays: &[(&str, Array<'_>)]) -> Result<(), StorageError> {
        self.write_with(name, |out| npz::write(out, arrays))
    }

    /// Writes `maps.npz`.
    pub fn maps(&self, maps: &Maps) -> Result<(), StorageError> {
        self.write_with(maps::FILE_NAME, |out| maps.write(out))
    }

    /// Writes `truth.npz`. The names of its objects belong into the manifest.
    pub fn truth(&self, truth: &Truth) -> Result<(), StorageError> {
        self.write_with(maps::TRUTH_FILE_NAME, |out| maps::write_truth(out, truth))
    }

    /// Writes a picture as PNG.
    pub fn png(&self, name: &str, picture: &image::RgbImage) -> Result<(), StorageError> {
        self.write_with(name, |out| {
            let encoder = image::codecs::png::PngEncoder::new_with_quality(
                out,
                image::codecs::png::CompressionType::Fast,
                image::codecs::png::FilterType::Adaptive,
            );
            picture.write_with_encoder(encoder).map_err(|error| match error {
                image::ImageError::IoError(error) => error,
                other => io::Error::other(other),
            })
        })
    }

    /// Brings everything to the medium, writes the manifest with the hashes of all files, and gives the folder its name.
    /// Returns the manifest as written.
    pub fn finish(mut self, mut manifest: Manifest) -> Result<Manifest, StorageError> {
        let progress = self.progress.get_mut().unwrap_or_else(PoisonError::into_inner);
        let Progress { written, folders, frames, .. } = std::mem::take(progress);
        let names: BTreeSet<&str> = written.iter().map(|file| file.name.as_str()).collect();
        check(&manifest, &names, frames)?;
        manifest.files = written.into_par_iter().map(Written::seal).collect::<Result<_, _>>()?;
        self.sync(&folders)?;
        let json = manifest.to_json().map_err(|error| {
            StorageError::refused(manifest::FILE_NAME, format!("cannot be written: {error}"))
        })?;
        let path = self.place.partial().join(manifest::FILE_NAME);
        let fail = |error| StorageError::file("write", &path, error);
        let mut file = self.disk.create(&path).map_err(fail)?;
        file.write_all(&json).and_then(|()| file.sync()).map_err(fail)?;
        drop(file);
        self.place.publish(&*self.disk)?;
        self.finished = true;
        Ok(manifest)
    }

    /// As [`BundleWriter::finish`] for a result that is no bundle and has no manifest.
    pub fn finish_plain(mut self) -> Result<(), StorageError> {
        let progress = self.progress.get_mut().unwrap_or_else(PoisonError::into_inner);
        let Progress { written, folders, .. } = std::mem::take(progress);
        written.into_par_iter().try_for_each(|file| file.seal().map(drop))?;
        self.sync(&folders)?;
        self.place.publish(&*self.disk)?;
        self.finished = true;
        Ok(())
    }

    /// Brings folders to the medium.
    fn sync(&self, folders: &BTreeSet<PathBuf>) -> Result<(), StorageError> {
        let sync = |folder: &PathBuf| {
            self.disk.sync_folder(folder).map_err(|error| StorageError::file("sync folder", folder, error))
        };
        folders.iter().try_for_each(sync)
    }
}

impl Drop for BundleWriter {
    fn drop(&mut self) {
        if !self.finished {
            self.place.abandon();
        }
    }
}

/// Whether a bundle of `files` with `manifest`, in whose own `frames.npy` are `frames`, is what its manifest says. It need not be
/// decodable: a capture that was cut short, even before its first frame, is kept as well.
fn check(manifest: &Manifest, files: &BTreeSet<&str>, frames: Option<usize>) -> Result<(), StorageError> {
    let refused = |detail: String| Err(StorageError::refused(manifest::FILE_NAME, detail));
    if let Err(faults) = manifest.check_form(Policy::Local) {
        return refused(faults.to_string());
    }
    let mut named: Vec<&String> = manifest.calibration.iter().collect();
    match &manifest.frames {
        FrameFiles::Images(paths) if manifest.source.is_none() => named.extend(paths),
        FrameFiles::Npy(path) if manifest.source.is_none() => named.push(path),
        _ => {}
    }
    let own = matches!(&manifest.frames, FrameFiles::Npy(path) if path == FRAMES_FILE_NAME);
    if let Some(frames) = frames.filter(|&frames| own && frames != manifest.sequence.len()) {
        let entries = manifest.sequence.len();
        return refused(format!(
            "has {entries} entries in `sequence` for {frames} frames in {FRAMES_FILE_NAME}"
        ));
    }
    if manifest.truth_objects.is_some() != files.contains(maps::TRUTH_FILE_NAME) {
        return refused(format!("{} and the names of its objects belong together", maps::TRUTH_FILE_NAME));
    }
    match named.into_iter().find(|name| !files.contains(name.as_str())) {
        Some(name) => refused(format!("names {name}, which is not in the bundle")),
        None => Ok(()),
    }
}

/// `frames.npy` while it grows.
#[derive(Debug)]
pub struct FramesWriter<'a> {
    stream: FrameStream<BundleFile<'a>>,
    path: PathBuf,
    writer: &'a BundleWriter,
    frames: usize,
}

impl FramesWriter<'_> {
    /// Appends a frame.
    pub fn push(&mut self, plane: Plane<'_>) -> Result<(), StorageError> {
        self.stream.push(plane).map_err(|error| StorageError::file("write frame to", &self.path, error))
    }

    /// Ends the file; all frames must have been added.
    pub fn finish(self) -> Result<(), StorageError> {
        let file = self.stream.finish().map_err(|error| StorageError::file("write", &self.path, error))?;
        file.commit()?;
        self.writer.progress().frames = Some(self.frames);
        Ok(())
    }
}

/// Removes a folder and what is in it, as far as that goes.
fn remove_folder(path: &Path) {
    if let Err(error) = fs::remove_dir_all(path)
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!(path = %path.display(), %error, "unfinished bundle could not be removed");
    }
}

#[cfg(test)]
mod tests;
