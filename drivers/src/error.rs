//! What can go wrong with a device, split by what the caller can do about it.

use thiserror::Error;

/// A setting that a device does not have as asked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Difference {
    /// Name of the setting with its unit.
    pub setting: &'static str,
    /// Requested value.
    pub requested: String,
    /// What the device offers or has read back.
    pub offered: String,
}

/// `gamma: asked 1, has 0.8; ...`
fn listed(differences: &[Difference]) -> String {
    let one = |d: &Difference| format!("{}: asked {}, has {}", d.setting, d.requested, d.offered);
    differences.iter().map(one).collect::<Vec<_>>().join("; ")
}

/// Failure of an operation on a camera or projector.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum DeviceError {
    /// No device answers to the selector, or it went away: check power and cable, then scan again.
    #[error("{device}: {detail}")]
    Unavailable {
        /// Device or selector that was asked for.
        device: String,
        /// What was found instead and what to do.
        detail: String,
    },
    /// The device refuses a setting or cannot honour it: change the configuration.
    #[error("{device} cannot honour {setting}: asked {requested}, has {offered}")]
    Refused {
        /// Device.
        device: String,
        /// Name of the setting with its unit.
        setting: &'static str,
        /// Requested value.
        requested: String,
        /// What the device offers or has read back.
        offered: String,
    },
    /// The device refuses several settings: change the configuration, or allow them by name.
    #[error("{device} cannot honour {} settings: {}", differences.len(), listed(differences))]
    RefusedAll {
        /// Device.
        device: String,
        /// All that differ.
        differences: Vec<Difference>,
    },
    /// Nothing arrived in time: the caller may try again.
    #[error("{device}: no {awaited} within {timeout_ms} ms")]
    Timeout {
        /// Device.
        device: String,
        /// What was awaited.
        awaited: &'static str,
        /// How long it was awaited.
        timeout_ms: u64,
    },
    /// The device delivered something that is not what was configured.
    #[error("{device}: {detail}")]
    BadData {
        /// Device.
        device: String,
        /// What is wrong with it.
        detail: String,
    },
    /// The call came out of order: a defect of the caller, reported rather than panicked on.
    #[error("{device}: {operation} called while {state}")]
    OutOfOrder {
        /// Device.
        device: String,
        /// Called operation.
        operation: &'static str,
        /// State that forbids it.
        state: &'static str,
    },
}

impl DeviceError {
    /// The refusal of all `differences`, if there are any.
    pub fn refused(device: &str, mut differences: Vec<Difference>) -> Option<Self> {
        let device = device.to_owned();
        if differences.len() > 1 {
            return Some(Self::RefusedAll { device, differences });
        }
        let Difference { setting, requested, offered } = differences.pop()?;
        Some(Self::Refused { device, setting, requested, offered })
    }

    /// Whether the device is well and only refuses what it was asked for.
    pub fn is_refusal(&self) -> bool {
        matches!(self, Self::Refused { .. } | Self::RefusedAll { .. })
    }
}
