//! Why a command ends without a result, and with which exit code.

use polscan_drivers::error::DeviceError;
use thiserror::Error;

use super::say;
use crate::config::ConfigError;

/// Exit code: done, but the result is a failure that the report names.
pub const FAILED: u8 = 1;
/// Exit code: wrong usage of the command line.
pub const USAGE: u8 = 2;
/// Exit code: bad configuration.
pub const CONFIG: u8 = 64;
/// Exit code: bad input data.
pub const DATA: u8 = 65;
/// Exit code: a device is not there.
pub const UNAVAILABLE: u8 = 69;
/// Exit code: storage.
pub const STORAGE: u8 = 74;

/// A command that could not be carried out.
#[derive(Debug, Error)]
pub enum Failure {
    /// The configuration has faults.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Settings that are sound one by one do not go together.
    #[error("cannot {operation}")]
    Setup {
        /// What was attempted.
        operation: &'static str,
        /// What does not go together and what to change.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// A device is missing or refuses.
    #[error("cannot {operation}")]
    Device {
        /// What was attempted.
        operation: &'static str,
        /// What the device said.
        #[source]
        source: DeviceError,
    },
    /// No device is configured where one is needed.
    #[error("cannot {operation}: {message}")]
    NoDevice {
        /// What was attempted.
        operation: &'static str,
        /// What is missing and what to do.
        message: String,
    },
    /// Input data cannot be used.
    #[error("cannot {operation}")]
    Data {
        /// What was attempted.
        operation: String,
        /// What is wrong with the data.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
    /// The result cannot be written.
    #[error("cannot {operation}")]
    Storage {
        /// What was attempted.
        operation: String,
        /// What the file system said.
        #[source]
        source: Box<dyn std::error::Error + Send + Sync>,
    },
}

impl Failure {
    /// Bad input data while doing `operation`.
    pub fn data(
        operation: impl Into<String>,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        Self::Data { operation: operation.into(), source: source.into() }
    }

    /// A storage error while doing `operation`.
    pub fn storage(
        operation: impl Into<String>,
        source: impl Into<Box<dyn std::error::Error + Send + Sync>>,
    ) -> Self {
        Self::Storage { operation: operation.into(), source: source.into() }
    }

    /// Documented exit code.
    pub fn code(&self) -> u8 {
        match self {
            Self::Config(_) | Self::Setup { .. } => CONFIG,
            Self::Device { .. } | Self::NoDevice { .. } => UNAVAILABLE,
            Self::Data { .. } => DATA,
            Self::Storage { .. } => STORAGE,
        }
    }

    /// Stable slug for scripts.
    fn slug(&self) -> &'static str {
        match self {
            Self::Config(_) | Self::Setup { .. } => "config",
            Self::Device { .. } | Self::NoDevice { .. } => "unavailable",
            Self::Data { .. } => "data",
            Self::Storage { .. } => "storage",
        }
    }

    /// The message with all its causes, outermost first.
    fn chain(&self) -> String {
        let mut text = self.to_string();
        let mut source = std::error::Error::source(self);
        while let Some(error) = source {
            text.push_str(": ");
            text.push_str(&error.to_string());
            source = error.source();
        }
        text
    }
}

/// Says on stderr what went wrong, and on stdout as JSON where that was asked for.
pub fn print_failure(failure: &Failure, json: bool) {
    eprintln!("polscan: {}", failure.chain());
    if json {
        let mut error = serde_json::json!({ "type": failure.slug(), "message": failure.chain() });
        if let Failure::Config(config) = failure {
            error["faults"] = config
                .faults
                .iter()
                .map(|fault| serde_json::json!({ "key": fault.key, "message": fault.message, "origin": fault.origin }))
                .collect();
        }
        say(serde_json::json!({ "error": error, "exit_code": failure.code() }));
    }
}
