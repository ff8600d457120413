//! `manifest.json`, schema `polscan.bundle/1`: what a bundle's frames show and how they came about. One type serves
//! our own bundles and captures made by others, who give only what they know.

mod check;
mod parse;
mod resolve;

use std::{collections::BTreeMap, time::SystemTime};

use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraSettings, StreamStatistics},
    clock::Timestamp,
    frame::FrameStamp,
    projector::{PresentReceipt, ProjectorInfo},
};
use polscan_patterns::{Axis, Mode, Polarization, ProjectorSize, Role, Sequence};
use serde::{Deserialize, Serialize};

use crate::{
    cloud::DEFAULT_ROW_GATE_PX,
    decode::{DecodeSettings, Thresholds},
    report::{NamedRegion, Reason},
    sequencer::{CaptureNotes, CaptureRecord, Retake, Synchrony},
    truth::TruthObject,
};

pub(crate) use check::{full_scale, path_fault};
pub use parse::{MAX_FRAMES, Parsed};

/// Schema of the manifests that this program writes, and the newest that it reads.
pub const SCHEMA: &str = "polscan.bundle/1";

/// Name of the manifest in its bundle.
pub const FILE_NAME: &str = "manifest.json";

/// A bundle's manifest. Everything but `schema`, `sequence` and `frames` may be absent.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Manifest {
    /// `polscan.bundle/1`.
    pub schema: String,
    /// Identity of the scan.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// Name given by a person.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub label: Option<String>,
    /// Tags given by a person.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<String>,
    /// How the frames were coded.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mode: Option<Mode>,
    /// When, RFC 3339, UTC.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub created: Option<String>,
    /// Program and version that wrote it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub software: Option<String>,
    /// Devices and calibration.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rig: Option<Rig>,
    /// Camera settings requested and applied.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub settings: Option<Settings>,
    /// Size of the projector.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub projector: Option<ProjectorSize>,
    /// What was added to the index before Gray coding; absent means 0.
    #[serde(skip_serializing_if = "PerAxis::is_empty")]
    pub code_offset: PerAxis<u32>,
    /// Length of the word; absent means `ceil(log2 size)`.
    #[serde(skip_serializing_if = "PerAxis::is_empty")]
    pub code_bits: PerAxis<u8>,
    /// What each frame shows.
    pub sequence: Vec<Role>,
    /// Where the frames are, in the order of `sequence`.
    pub frames: FrameFiles,
    /// What is known of the camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera: Option<Camera>,
    /// Calibration file, relative to the manifest.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub calibration: Option<String>,
    /// Settings of the processing, by which a later decode gives the same maps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub processing: Option<Processing>,
    /// How the capture went, with the evidence of each frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub capture: Option<Capture>,
    /// Where the frames came from, if they were not captured for this bundle.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<Source>,
    /// Objects of `truth.npz`; the array `object` holds their indices.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub truth_objects: Option<Vec<TruthObject>>,
    /// Size and hash of every other file of the bundle.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub files: BTreeMap<String, FileEntry>,
}

/// One value for each axis, either of which may be absent.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize)]
pub struct PerAxis<T> {
    /// Of the columns.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub column: Option<T>,
    /// Of the rows.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub row: Option<T>,
}

impl<T: Copy> PerAxis<T> {
    fn is_empty(&self) -> bool {
        self.column.is_none() && self.row.is_none()
    }

    /// Value of `axis`.
    pub fn of(&self, axis: Axis) -> Option<T> {
        match axis {
            Axis::Column => self.column,
            Axis::Row => self.row,
        }
    }
}

/// Where frames are.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum FrameFiles {
    /// One `.npy` of shape (frames, height, width).
    Npy(String),
    /// One image per frame.
    Images(Vec<String>),
}

impl FrameFiles {
    /// All paths as written.
    pub fn paths(&self) -> &[String] {
        match self {
            Self::Npy(path) => std::slice::from_ref(path),
            Self::Images(paths) => paths,
        }
    }
}

/// What is known of the camera that made the frames.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Camera {
    /// Width of the frames in pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub width: Option<u32>,
    /// Height of the frames in pixels.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub height: Option<u32>,
    /// Significant bits of a sample, right-aligned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bit_depth: Option<u8>,
    /// Level of a dark pixel in DN.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub black_level: Option<f64>,
    /// A sample at or above this is saturated, in DN.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saturation: Option<u16>,
    /// System gain in DN per electron.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub gain_dn_per_electron: Option<f64>,
    /// Temporal dark noise in DN.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub read_noise_dn: Option<f64>,
}

/// Devices of the rig and the calibration in force.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Name in the configuration.
    pub name: String,
    /// Camera.
    pub camera: CameraInfo,
    /// Projector.
    pub projector: ProjectorInfo,
    /// Which channels carry which polarization.
    pub polarization: Polarization,
    /// SHA-256 of the calibration's canonical file, if the rig is calibrated.
    pub calibration_id: Option<String>,
}

/// Camera settings.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// As asked for.
    pub requested: CameraSettings,
    /// As read back.
    pub applied: AppliedSettings,
}

/// Everything outside frames, code, camera and calibration that fixes the maps.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Processing {
    /// Gates of the decoder.
    pub thresholds: Thresholds,
    /// Working volume.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub volume: Option<Volume>,
    /// Named regions that planes are fitted to.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub regions: Vec<NamedRegion>,
    /// Largest distance of a measured row from the predicted one, in projector px.
    pub row_gate_px: f64,
    /// H over V that the rig shows on metal, where it is known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub extinction_ratio: Option<f64>,
}

impl Default for Processing {
    fn default() -> Self {
        Self {
            thresholds: Thresholds::default(),
            volume: None,
            row_gate_px: DEFAULT_ROW_GATE_PX,
            regions: Vec::new(),
            extinction_ratio: None,
        }
    }
}

/// Depths that a point can have, z in the camera frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Volume {
    /// Least depth in mm.
    pub near_mm: f64,
    /// Greatest depth in mm.
    pub far_mm: f64,
}

/// How the capture went.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Capture {
    /// From the first flip to the last frame, in seconds.
    pub seconds: f64,
    /// The least that the display allows, in seconds.
    pub limit_seconds: f64,
    /// From flip to trigger, in ms.
    pub latency_ms: f64,
    /// Refreshes that each slide was held.
    pub hold_refreshes: u32,
    /// Whether latency and settling were measured.
    pub timing_measured: bool,
    /// How flips and exposures kept step.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub synchrony: Option<Synchrony>,
    /// Counters of the camera's stream.
    pub statistics: StreamStatistics,
    /// Evidence of each frame, in the order of the sequence.
    pub frames: Vec<FrameEvidence>,
    /// Pairs that were captured again.
    pub retaken: Vec<Retake>,
    /// What was noticed.
    #[serde(default)]
    pub notes: CaptureNotes,
    /// Why the capture ended before its end; absent for a complete one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub failure: Option<Reason>,
}

/// What proves that a frame shows its role.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FrameEvidence {
    /// Receipt of the slide.
    pub receipt: PresentReceipt,
    /// When its exposure was asked for, on the rig's clock.
    #[serde(rename = "triggered_ns")]
    pub triggered: Timestamp,
    /// How far the exposure is off the phase to the flip that all should have, in us; early is negative, whole refreshes do
    /// not count.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub phase_error_us: Option<f64>,
    /// Identity of the exposure.
    pub stamp: FrameStamp,
}

/// Where decoded frames came from.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Source {
    /// Folder of the bundle that was decoded.
    pub bundle: String,
    /// Identity of the scan in it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub id: Option<String>,
    /// SHA-256 of its manifest.
    pub manifest_sha256: String,
    /// Its files of frames.
    pub frames: Vec<SourceFile>,
}

/// A file outside the bundle.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct SourceFile {
    /// Path as the source's manifest gives it.
    pub path: String,
    /// Length and hash.
    #[serde(flatten)]
    pub entry: FileEntry,
}

/// Length and hash of a file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileEntry {
    /// Length in bytes.
    pub bytes: u64,
    /// SHA-256 in lower-case hexadecimal digits.
    pub sha256: String,
}

impl Manifest {
    /// A manifest of frames that show `sequence`, with the code written out.
    pub fn new(sequence: &Sequence, frames: FrameFiles) -> Self {
        Self {
            mode: Some(sequence.mode),
            projector: Some(sequence.size()),
            code_offset: PerAxis { column: Some(sequence.column.offset()), row: Some(sequence.row.offset()) },
            code_bits: PerAxis { column: Some(sequence.column.bits()), row: Some(sequence.row.bits()) },
            sequence: sequence.roles.clone(),
            ..Self::empty(frames)
        }
    }

    fn empty(frames: FrameFiles) -> Self {
        Self {
            schema: SCHEMA.to_owned(),
            id: None,
            label: None,
            tags: Vec::new(),
            mode: None,
            created: None,
            software: None,
            rig: None,
            settings: None,
            projector: None,
            code_offset: PerAxis::default(),
            code_bits: PerAxis::default(),
            sequence: Vec::new(),
            frames,
            camera: None,
            calibration: None,
            processing: None,
            capture: None,
            source: None,
            truth_objects: None,
            files: BTreeMap::new(),
        }
    }

    /// Sets `created` and `software`.
    pub fn stamp(&mut self, now: SystemTime) {
        self.created = Some(super::time::rfc3339_utc(now));
        self.software = Some(concat!("polscan ", env!("CARGO_PKG_VERSION")).to_owned());
    }

    /// Records how the frames were captured, and the camera's response as applied.
    pub fn record_capture(&mut self, record: &CaptureRecord, requested: CameraSettings) {
        let applied = &record.applied;
        self.camera = Some(Camera {
            width: Some(applied.width),
            height: Some(applied.height),
            bit_depth: Some(applied.settings.format.bit_depth()),
            black_level: applied.black_level_dn,
            saturation: Some(applied.saturation_dn),
            gain_dn_per_electron: applied.noise.map(|noise| noise.gain_dn_per_electron),
            read_noise_dn: applied.noise.map(|noise| noise.read_noise_dn),
        });
        self.settings = Some(Settings { requested, applied: applied.clone() });
        self.capture = Some(Capture {
            seconds: record.seconds,
            limit_seconds: record.limit_seconds,
            latency_ms: record.latency_ms,
            hold_refreshes: record.hold_refreshes,
            timing_measured: record.timing_measured,
            synchrony: Some(record.synchrony.clone()),
            statistics: record.statistics.clone(),
            frames: record
                .frames
                .iter()
                .map(|frame| FrameEvidence {
                    receipt: frame.receipt,
                    triggered: frame.triggered,
                    phase_error_us: record
                        .synchrony
                        .phase_error_us_of(&frame.receipt, frame.frame.stamp.exposure_start),
                    stamp: frame.frame.stamp,
                })
                .collect(),
            retaken: record.retaken.clone(),
            notes: record.notes.clone(),
            failure: None,
        });
    }

    /// Records what the decoder was told, so that decoding the written bundle gives the same maps.
    pub fn record_decode(&mut self, settings: &DecodeSettings) {
        self.mode = Some(settings.mode);
        self.projector = Some(ProjectorSize { width: settings.column.size(), height: settings.row.size() });
        self.code_offset =
            PerAxis { column: Some(settings.column.offset()), row: Some(settings.row.offset()) };
        self.code_bits = PerAxis { column: Some(settings.column.bits()), row: Some(settings.row.bits()) };
        let response = settings.camera;
        self.camera = Some(Camera {
            width: u32::try_from(settings.width).ok(),
            height: u32::try_from(settings.height).ok(),
            bit_depth: Some(response.bit_depth),
            black_level: response.black_level_dn,
            saturation: Some(response.saturation_dn),
            gain_dn_per_electron: response.noise.map(|noise| noise.gain_dn_per_electron),
            read_noise_dn: response.noise.map(|noise| noise.read_noise_dn),
        });
        self.processing.get_or_insert_default().thresholds = settings.thresholds;
    }

    /// The file's bytes: JSON with two spaces of indentation and a final newline.
    pub fn to_json(&self) -> Result<Vec<u8>, serde_json::Error> {
        let mut bytes = serde_json::to_vec_pretty(self)?;
        bytes.push(b'\n');
        Ok(bytes)
    }
}

#[cfg(test)]
mod tests;
