//! What can go wrong with a device, split by what the caller can do about it.

use thiserror::Error;

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
