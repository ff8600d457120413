//! Frames of a bundle in memory: a mapped `.npy`, or images decoded in parallel.

use std::{
    fs::File,
    io::BufReader,
    path::{Path, PathBuf},
    sync::{Arc, OnceLock},
};

use memmap2::Mmap;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::{
    error::{Fault, Faults, InputError},
    images::{self, Info, Reduction, Samples},
    manifest::{self, FileEntry, FrameFiles, Manifest, SourceFile, full_scale},
    npy::{Dtype, Header},
    source::{Policy, hex, open_regular, read_bounded, resolve},
};
use crate::decode::{Plane, PlaneSource, SharedPlane};

/// Most bytes of an image file per sample, beyond which it cannot be one frame: four channels of 16 bits, stored as
/// text.
const MAX_FILE_BYTES_PER_SAMPLE: u64 = 4 * 6;

/// What a bundle may ask of this machine.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// Longest side of a frame in pixels.
    pub max_side: u32,
    /// Most samples of a frame.
    pub max_frame_samples: u64,
    /// Most bytes of all frames together, once in memory.
    pub max_total_bytes: u64,
}

impl Default for Limits {
    /// Frames of 128 megapixels, 16 GiB in all.
    fn default() -> Self {
        Self { max_side: 32_768, max_frame_samples: 128 << 20, max_total_bytes: 16 << 30 }
    }
}

/// All frames of a bundle, in the order of its sequence.
pub struct FrameSet {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Bits that a sample is stored in: 8 or 16.
    pub sample_bits: u8,
    /// The frames.
    pub planes: Vec<SharedPlane>,
    /// What the report should say about them.
    pub notes: Vec<String>,
    files: Files,
    /// Lengths and hashes, once somebody has asked for them.
    hashes: OnceLock<Vec<SourceFile>>,
}

/// Where the samples came from.
enum Files {
    Npy { name: String, map: Arc<Mmap> },
    Images(Vec<SourceFile>),
}

impl std::fmt::Debug for FrameSet {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FrameSet")
            .field("width", &self.width)
            .field("height", &self.height)
            .field("sample_bits", &self.sample_bits)
            .field("planes", &self.planes.len())
            .field("notes", &self.notes)
            .finish_non_exhaustive()
    }
}

impl FrameSet {
    /// Length and hash of each file the frames came from, of the very bytes that were decoded. The first call
    /// takes as long as reading a mapped file once.
    pub fn hashes(&self) -> &[SourceFile] {
        self.hashes.get_or_init(|| match &self.files {
            Files::Images(files) => files.clone(),
            Files::Npy { name, map } => {
                let entry = FileEntry { bytes: map.len() as u64, sha256: hex(&Sha256::digest(&map[..])) };
                vec![SourceFile { path: name.clone(), entry }]
            }
        })
    }
}

/// Samples in memory of their own.
struct OwnedPlane(Samples);

impl PlaneSource for OwnedPlane {
    fn plane(&self) -> Plane<'_> {
        match &self.0 {
            Samples::U8(samples) => Plane::U8(samples),
            Samples::U16(samples) => Plane::U16(samples),
        }
    }
}

/// Samples in a mapped file.
struct MappedPlane {
    map: Arc<Mmap>,
    start: usize,
    bytes: usize,
    dtype: Dtype,
}

impl PlaneSource for MappedPlane {
    fn plane(&self) -> Plane<'_> {
        let bytes = &self.map[self.start..][..self.bytes];
        match self.dtype {
            Dtype::U8 => Plane::U8(bytes),
            _ => Plane::U16(bytemuck::cast_slice(bytes)),
        }
    }
}

/// Loads the frames of the bundle in `folder`.
pub(super) fn load(
    folder: &Path,
    manifest: &Manifest,
    policy: Policy,
    limits: &Limits,
) -> Result<FrameSet, InputError> {
    let mut set = match &manifest.frames {
        FrameFiles::Npy(name) => load_npy(name, &resolve(folder, name, policy)?, policy, limits)?,
        FrameFiles::Images(names) => load_images(folder, names, policy, limits)?,
    };
    let path = folder.join(manifest::FILE_NAME);
    if set.planes.len() != manifest.sequence.len() {
        let detail = format!(
            "its `sequence` has {} entries, the frames are {}",
            manifest.sequence.len(),
            set.planes.len()
        );
        return Err(InputError::content(&path, detail));
    }
    let camera = manifest.camera.unwrap_or_default();
    for (key, given, found) in [("width", camera.width, set.width), ("height", camera.height, set.height)] {
        if let Some(given) = given.filter(|&given| given as usize != found) {
            let detail = format!("its `camera.{key}` is {given} px, the frames have {found}");
            return Err(InputError::content(&path, detail));
        }
    }
    check_levels(&path, manifest, &mut set)?;
    Ok(set)
}

/// Compares the samples with the bit depth. This reads every sample once, so a mapped file is resident afterwards.
fn check_levels(path: &Path, manifest: &Manifest, set: &mut FrameSet) -> Result<(), InputError> {
    let bit_depth = manifest.bit_depth(set.sample_bits);
    if bit_depth > set.sample_bits {
        let detail = format!(
            "its `camera.bit_depth` is {bit_depth}, the frames have samples of {} bits",
            set.sample_bits
        );
        return Err(InputError::content(path, detail));
    }
    let levels = level_faults(manifest, bit_depth);
    if !levels.is_empty() {
        return Err(InputError::Manifest { path: path.to_owned(), faults: Faults(levels) });
    }
    let brightest: Vec<u16> = set.planes.par_iter().map(|plane| brightest(plane.plane())).collect();
    let top = full_scale(bit_depth);
    if let Some(index) = brightest.iter().position(|&level| level > top) {
        let detail = format!(
            "frame {index} ({}) has a sample of {} DN, more than the {bit_depth} bits of `camera.bit_depth` hold: \
             samples must be right-aligned; shift them or correct the bit depth",
            manifest.sequence[index], brightest[index]
        );
        return Err(InputError::content(path, detail));
    }
    let overall = brightest.into_iter().max().unwrap_or(0);
    let given = manifest.camera.is_some_and(|camera| camera.bit_depth.is_some());
    if !given && set.sample_bits == 16 && overall < 1 << 14 {
        set.notes.push(format!(
            "the frames are taken as 16-bit, but no sample is above {overall}: give `camera.bit_depth` or \
             `camera.saturation`, without which saturation is not seen"
        ));
    }
    Ok(())
}

/// Levels of the manifest that no sample of `bit_depth` reaches. Without its own bit depth a manifest tells them only
/// together with the frames.
fn level_faults(manifest: &Manifest, bit_depth: u8) -> Vec<Fault> {
    let camera = manifest.camera.unwrap_or_default();
    let top = full_scale(bit_depth);
    let given = [("saturation", camera.saturation.map(f64::from)), ("black_level", camera.black_level)];
    let beyond = |(key, level): (&str, Option<f64>)| {
        let level = level.filter(|&level| level > f64::from(top))?;
        let message = format!("is {level} DN, the samples have {bit_depth} bits and end at {top}");
        Some(Fault::new(format!("camera.{key}"), message))
    };
    given.into_iter().filter_map(beyond).collect()
}

fn brightest(plane: Plane<'_>) -> u16 {
    match plane {
        Plane::U8(samples) => u16::from(samples.iter().copied().fold(0, u8::max)),
        Plane::U16(samples) => samples.iter().copied().fold(0, u16::max),
    }
}

fn load_npy(name: &str, path: &Path, policy: Policy, limits: &Limits) -> Result<FrameSet, InputError> {
    let wrong = |detail: String| InputError::content(path, detail);
    let file = open_regular(path, policy, "read frames")?;
    let map = Arc::new(map(&file, path)?);
    let header = Header::parse(&map).map_err(wrong)?;
    if !matches!(header.dtype, Dtype::U8 | Dtype::U16 | Dtype::U16BigEndian) {
        return Err(wrong(format!("has elements of type {:?}, expected uint8 or uint16", header.dtype)));
    }
    let &[frames, height, width] = header.shape.as_slice() else {
        return Err(wrong(format!("has the shape {:?}, expected (frames, height, width)", header.shape)));
    };
    let found = map.len() - header.data_offset;
    if header.data_bytes() != Some(found) {
        return Err(wrong(format!(
            "has {found} bytes of data, its header promises {frames} x {height} x {width} samples of {} bytes: it is \
             cut off or damaged",
            header.dtype.bytes()
        )));
    }
    let side = |side: usize| (1..=limits.max_side as usize).contains(&side);
    let samples = height.saturating_mul(width);
    if !side(height)
        || !side(width)
        || samples as u64 > limits.max_frame_samples
        || frames > manifest::MAX_FRAMES
    {
        return Err(wrong(format!(
            "has {frames} frames of {width} x {height}, which is none or more than is read"
        )));
    }
    if found as u64 > limits.max_total_bytes {
        return Err(wrong(format!("has {found} bytes, at most {} are read", limits.max_total_bytes)));
    }
    let bytes = samples * header.dtype.bytes();
    let start = |index: usize| header.data_offset + index * bytes;
    let usable = match header.dtype {
        Dtype::U8 => true,
        Dtype::U16 => {
            cfg!(target_endian = "little")
                && bytemuck::try_cast_slice::<u8, u16>(&map[header.data_offset..]).is_ok()
        }
        _ => false,
    };
    let planes = (0..frames).into_par_iter().map(|index| -> SharedPlane {
        if usable {
            return Arc::new(MappedPlane {
                map: Arc::clone(&map),
                start: start(index),
                bytes,
                dtype: header.dtype,
            });
        }
        let value = match header.dtype {
            Dtype::U16BigEndian => |pair: &[u8]| u16::from_be_bytes([pair[0], pair[1]]),
            _ => |pair: &[u8]| u16::from_le_bytes([pair[0], pair[1]]),
        };
        Arc::new(OwnedPlane(Samples::U16(map[start(index)..][..bytes].chunks_exact(2).map(value).collect())))
    });
    Ok(FrameSet {
        width,
        height,
        sample_bits: 8 * header.dtype.bytes() as u8,
        planes: planes.collect(),
        notes: Vec::new(),
        files: Files::Npy { name: name.to_owned(), map },
        hashes: OnceLock::new(),
    })
}

fn map(file: &File, path: &Path) -> Result<Mmap, InputError> {
    let fail = |error| InputError::file("map frames", path, error);
    if file.metadata().map_err(fail)?.len() == 0 {
        return Err(InputError::content(path, "is empty"));
    }
    // SAFETY: the mapping is read-only and private to this process. Another process that shortens the file while it is
    // mapped would end this one with SIGBUS, and one that writes to it would change samples under the decoder; bundles
    // are never changed once they have their name, and the same holds for what a person hands over for a decode.
    unsafe { Mmap::map(file) }.map_err(fail)
}

fn load_images(
    folder: &Path,
    names: &[String],
    policy: Policy,
    limits: &Limits,
) -> Result<FrameSet, InputError> {
    let paths: Vec<PathBuf> =
        names.iter().map(|name| resolve(folder, name, policy)).collect::<Result<_, _>>()?;
    let probe = |path: &PathBuf| {
        let file = open_regular(path, policy, "read image")?;
        images::probe(BufReader::new(file), limits).map_err(|detail| InputError::content(path, detail))
    };
    let infos: Vec<Info> = paths.par_iter().map(probe).collect::<Result<_, _>>()?;
    let Some(&first) = infos.first() else {
        return Err(InputError::content(&folder.join(manifest::FILE_NAME), "its `frames` name no image"));
    };
    if let Some(index) = infos.iter().position(|info| *info != first) {
        let other = infos[index];
        let detail = format!(
            "is {} x {} of {} bits, the frames before it are {} x {} of {} bits: all must be alike",
            other.width, other.height, other.sample_bits, first.width, first.height, first.sample_bits
        );
        return Err(InputError::content(&paths[index], detail));
    }
    let samples = u64::from(first.width) * u64::from(first.height);
    let total = samples * u64::from(first.sample_bits / 8) * paths.len() as u64;
    if total > limits.max_total_bytes {
        let detail = format!("its frames take {total} bytes, at most {} are read", limits.max_total_bytes);
        return Err(InputError::content(&folder.join(manifest::FILE_NAME), detail));
    }
    let load = |(path, name): (&PathBuf, &String)| {
        let limit = samples * MAX_FILE_BYTES_PER_SAMPLE + (64 << 20);
        let bytes = read_bounded(path, policy, "read image", limit)?;
        let wrong = |detail: String| InputError::content(path, detail);
        let (plane, reduction) = images::decode(&bytes, limits).map_err(wrong)?;
        let (length, bits) = match &plane {
            Samples::U8(samples) => (samples.len(), 8),
            Samples::U16(samples) => (samples.len(), 16),
        };
        if length as u64 != samples || bits != first.sample_bits {
            return Err(wrong("changed while it was read".to_owned()));
        }
        let entry = FileEntry { bytes: bytes.len() as u64, sha256: hex(&Sha256::digest(&bytes)) };
        Ok((plane, reduction, SourceFile { path: name.clone(), entry }))
    };
    let loaded: Vec<_> = paths.par_iter().zip(names).map(load).collect::<Result<_, InputError>>()?;
    let notes = reduction_note(names, loaded.iter().map(|(_, reduction, _)| *reduction));
    let (mut planes, mut files) = (Vec::<SharedPlane>::new(), Vec::new());
    for (plane, _, file) in loaded {
        planes.push(Arc::new(OwnedPlane(plane)));
        files.push(file);
    }
    Ok(FrameSet {
        width: first.width as usize,
        height: first.height as usize,
        sample_bits: first.sample_bits,
        planes,
        notes: notes.into_iter().collect(),
        files: Files::Images(files),
        hashes: OnceLock::new(),
    })
}

/// Which images lost their colour.
fn reduction_note(names: &[String], reductions: impl Iterator<Item = Reduction>) -> Option<String> {
    let green: Vec<&str> = names
        .iter()
        .zip(reductions)
        .filter_map(|(name, reduction)| (reduction == Reduction::Green).then_some(name.as_str()))
        .collect();
    match green.len() {
        0 => None,
        all if all == names.len() => {
            Some(format!("all {all} frames are in colour and were reduced to green"))
        }
        some => Some(format!(
            "{some} of {} frames are in colour and were reduced to green: {}",
            names.len(),
            green.join(", ")
        )),
    }
}

#[cfg(test)]
mod tests;
