//! Frames on the disk while a scan is still being captured, so that a crash does not take them along.
//!
//! A spool is a folder with the manifest that the scan will have, its calibration, the samples of all frames one after
//! another, and a journal with one line of JSON per frame. Nothing is synchronised: a spool outlives its process; after
//! a power cut the checksums tell which frames are whole.

use std::{
    fs::{self, File},
    io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write},
    path::{Path, PathBuf},
    sync::Arc,
};

use polscan_drivers::{
    clock::Timestamp,
    frame::{Frame, FrameStamp, PixelStore, Pixels},
    projector::PresentReceipt,
};
use polscan_patterns::Role;
use serde::{Deserialize, Serialize};

use super::error::InputError;
use crate::sequencer::CapturedFrame;

const MANIFEST: &str = "manifest.json";
const CALIBRATION: &str = "calibration.toml";
const SAMPLES: &str = "frames.raw";
const JOURNAL: &str = "journal.jsonl";

/// One line of the journal.
#[derive(Debug, Serialize, Deserialize)]
struct Entry {
    role: Role,
    receipt: PresentReceipt,
    triggered: Timestamp,
    stamp: FrameStamp,
    width: u32,
    height: u32,
    bit_depth: u8,
    /// First byte of the samples.
    offset: u64,
    bytes: u64,
    crc32: u32,
}

/// A spool that is being written.
#[derive(Debug)]
pub struct SpoolWriter {
    folder: PathBuf,
    samples: File,
    journal: File,
    offset: u64,
}

impl SpoolWriter {
    /// Begins a spool in `folder`, which is replaced.
    pub fn create(folder: &Path, manifest: &[u8], calibration: Option<&str>) -> io::Result<Self> {
        match fs::remove_dir_all(folder) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
            _ => {}
        }
        fs::create_dir_all(folder)?;
        fs::write(folder.join(MANIFEST), manifest)?;
        if let Some(calibration) = calibration {
            fs::write(folder.join(CALIBRATION), calibration)?;
        }
        Ok(Self {
            folder: folder.to_owned(),
            samples: File::create_new(folder.join(SAMPLES))?,
            journal: File::create_new(folder.join(JOURNAL))?,
            offset: 0,
        })
    }

    /// Appends a frame. A frame that is taken again is appended again; the last one counts.
    pub fn push(&mut self, captured: &CapturedFrame) -> io::Result<()> {
        let frame = &captured.frame;
        let bytes: &[u8] = match frame.pixels() {
            Pixels::U8(samples) => samples,
            Pixels::U16(samples) => bytemuck::cast_slice(samples),
        };
        self.samples.write_all(bytes)?;
        let entry = Entry {
            role: captured.role,
            receipt: captured.receipt,
            triggered: captured.triggered,
            stamp: frame.stamp,
            width: frame.width,
            height: frame.height,
            bit_depth: frame.bit_depth,
            offset: self.offset,
            bytes: bytes.len() as u64,
            crc32: crc32fast::hash(bytes),
        };
        self.offset += bytes.len() as u64;
        let mut line = serde_json::to_vec(&entry)?;
        line.push(b'\n');
        self.journal.write_all(&line)
    }

    /// Removes the spool: its frames are somewhere else now.
    pub fn remove(self) -> io::Result<()> {
        fs::remove_dir_all(&self.folder)
    }
}

/// What a spool holds.
#[derive(Debug)]
pub struct Spooled {
    /// Manifest that the scan would have had, with its whole sequence.
    pub manifest: Vec<u8>,
    /// Calibration of the rig.
    pub calibration: Option<Vec<u8>>,
    /// Whole frames, the last take of each, in the order of the sequence.
    pub frames: Vec<CapturedFrame>,
}

/// Samples that were read back.
struct Samples {
    bytes: Vec<u8>,
    wide: Vec<u16>,
}

impl PixelStore for Samples {
    fn pixels(&self) -> Pixels<'_> {
        if self.wide.is_empty() { Pixels::U8(&self.bytes) } else { Pixels::U16(&self.wide) }
    }
}

impl Spooled {
    /// Reads the spool in `folder`. Frames that are not whole are left out, as is what follows a torn line.
    pub fn read(folder: &Path) -> Result<Self, InputError> {
        let read = |name: &str| {
            let path = folder.join(name);
            fs::read(&path).map_err(|error| InputError::file("read", &path, error))
        };
        let manifest = read(MANIFEST)?;
        let calibration = folder.join(CALIBRATION).is_file().then(|| read(CALIBRATION)).transpose()?;
        let open = |name: &str| {
            let path = folder.join(name);
            File::open(&path).map_err(|error| InputError::file("open", &path, error))
        };
        let (mut samples, journal) = (open(SAMPLES)?, BufReader::new(open(JOURNAL)?));
        let mut frames: Vec<(u32, CapturedFrame)> = Vec::new();
        for line in journal.lines() {
            let Some(entry) = line.ok().and_then(|line| serde_json::from_str::<Entry>(&line).ok()) else {
                break;
            };
            // Slides are loaded in the order of the sequence, so that the receipt's number is the frame's place in it.
            let Some(step) = entry.receipt.slide else { continue };
            if let Some(captured) = entry.frame(&mut samples) {
                frames.retain(|(taken, _)| *taken != step);
                frames.push((step, captured));
            }
        }
        frames.sort_by_key(|(step, _)| *step);
        Ok(Self { manifest, calibration, frames: frames.into_iter().map(|(_, frame)| frame).collect() })
    }
}

impl Entry {
    /// The frame, if all its samples are there.
    fn frame(self, samples: &mut File) -> Option<CapturedFrame> {
        let sample_bytes = if self.bit_depth > 8 { 2 } else { 1 };
        if self.bytes != u64::from(self.width) * u64::from(self.height) * sample_bytes
            || samples.metadata().ok()?.len() < self.offset.checked_add(self.bytes)?
        {
            return None;
        }
        samples.seek(SeekFrom::Start(self.offset)).ok()?;
        let mut bytes = vec![0; usize::try_from(self.bytes).ok()?];
        samples.read_exact(&mut bytes).ok()?;
        if crc32fast::hash(&bytes) != self.crc32 {
            return None;
        }
        let store = match sample_bytes {
            2 => Samples { wide: bytemuck::pod_collect_to_vec(&bytes), bytes: Vec::new() },
            _ => Samples { wide: Vec::new(), bytes },
        };
        let frame = Frame {
            width: self.width,
            height: self.height,
            bit_depth: self.bit_depth,
            stamp: self.stamp,
            store: Arc::new(store),
        };
        Some(CapturedFrame { role: self.role, receipt: self.receipt, triggered: self.triggered, frame })
    }
}

#[cfg(test)]
mod tests {
    use polscan_drivers::projector::ReceiptMethod;
    use polscan_patterns::Axis;
    use proptest::prelude::*;

    use super::*;

    fn captured(step: u32, value: u16, wide: bool) -> CapturedFrame {
        let store: Arc<dyn PixelStore> =
            if wide { Arc::new(vec![value; 12]) } else { Arc::new(vec![value as u8; 12]) };
        let stamp = FrameStamp {
            frame_id: u64::from(step),
            trigger: u64::from(step),
            exposure_start: Timestamp(5),
            received: Timestamp(9),
            device_time_ns: None,
        };
        CapturedFrame {
            role: Role::Code { axis: Axis::Column, bit: step as u8, inverse: false },
            receipt: PresentReceipt {
                slide: Some(step),
                flipped: Timestamp(1),
                refresh: Some(7),
                method: ReceiptMethod::Simulated,
            },
            triggered: Timestamp(3),
            frame: Frame { width: 4, height: 3, bit_depth: if wide { 12 } else { 8 }, stamp, store },
        }
    }

    proptest! {
        #[test]
        fn what_was_written_comes_back_in_order_with_the_last_take(
            takes in prop::collection::vec((0u32..6, 0u16..256), 0..12),
            wide: bool,
            torn in 0u64..40,
        ) {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("spool");
            let mut writer = SpoolWriter::create(&path, b"{}", Some("c")).unwrap();
            for &(step, value) in &takes {
                writer.push(&captured(step, value, wide)).unwrap();
            }
            let whole = |takes: &[(u32, u16)]| {
                let mut last = std::collections::BTreeMap::new();
                last.extend(takes.iter().copied());
                last.into_iter().collect::<Vec<_>>()
            };
            let found = |spooled: &Spooled| spooled
                .frames
                .iter()
                .map(|frame| (frame.receipt.slide.unwrap(), frame.frame.pixels().get(11)))
                .collect::<Vec<_>>();
            let spooled = Spooled::read(&path).unwrap();
            prop_assert_eq!(found(&spooled), whole(&takes));
            prop_assert_eq!(spooled.calibration.as_deref(), Some(&b"c"[..]));

            // A crash cuts both files anywhere; what is left are whole frames of the beginning.
            let samples = File::options().write(true).open(path.join(SAMPLES)).unwrap();
            let bytes = samples.metadata().unwrap().len().saturating_sub(torn);
            samples.set_len(bytes).unwrap();
            let left = (bytes / if wide { 24 } else { 12 }) as usize;
            let spooled = Spooled::read(&path).unwrap();
            prop_assert_eq!(found(&spooled), whole(&takes[..left]));
        }
    }
}
