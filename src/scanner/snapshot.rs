//! What the owner publishes: everybody reads it, nobody waits for it.

use std::{collections::BTreeMap, sync::Arc};

use polscan_drivers::{camera::CameraInfo, projector::ProjectorInfo};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::{admission::Obstacle, calibration::CalibrationRecord, record::Record};

/// State of the rig's devices.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum RigState {
    /// Being opened for the first time.
    #[default]
    Connecting,
    /// Open and idle.
    Ready,
    /// Capturing or calibrating.
    Busy,
    /// Not there, or failed; it is tried again.
    Fault,
}

/// The rig.
#[derive(Debug, Clone, Default)]
pub struct RigStatus {
    /// State.
    pub state: RigState,
    /// Camera, once it was open.
    pub camera: Option<CameraInfo>,
    /// Projector, once it was open.
    pub projector: Option<ProjectorInfo>,
    /// What is wrong.
    pub message: Option<String>,
    /// Picture that is held for set-up.
    pub showing: Option<String>,
}

/// The store.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct StorageStatus {
    /// Free bytes of the disk; `null` where it does not tell.
    pub free_bytes: Option<u64>,
    /// Bytes of all bundles.
    pub used_bytes: u64,
    /// Most that bundles may take; `null` for no limit.
    pub quota_bytes: Option<u64>,
    /// Bytes to leave free.
    pub min_free_bytes: u64,
    /// Bytes that a scan may need; 0 until the rig has been open.
    pub scan_bytes: u64,
}

/// Everything at one moment.
#[derive(Debug, Clone, Default)]
pub struct Snapshot {
    /// Number of the latest event: it only grows, over restarts as well.
    pub revision: u64,
    /// Scans that have not come to their end, and the latest that have.
    pub scans: BTreeMap<String, Arc<Record>>,
    /// The scan that has the rig.
    pub capturing: Option<String>,
    /// The calibration that has the rig.
    pub calibrating: Option<String>,
    /// All calibrations.
    pub calibrations: Arc<BTreeMap<String, Arc<CalibrationRecord>>>,
    /// Scans that are being decoded or wait for it, the oldest first.
    pub finishing: Vec<String>,
    /// Scans that wait for the rig, in order.
    pub queue: Vec<String>,
    /// The rig.
    pub rig: RigStatus,
    /// The store.
    pub storage: StorageStatus,
    /// What keeps the rig from scanning.
    pub obstacles: Vec<Obstacle>,
    /// Whether the daemon is ending.
    pub stopping: bool,
}
