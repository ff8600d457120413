//! Why a scan, or a command, ends without a result.

use polscan_drivers::error::DeviceError;
use thiserror::Error;

use crate::config::ConfigError;

/// What a failure is about: the exit code of a command and the status of a request follow from it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Bad configuration.
    Config,
    /// Bad input data.
    Data,
    /// A device is not there or refuses.
    Unavailable,
    /// Storage.
    Storage,
}

impl Kind {
    /// Stable slug for scripts.
    pub fn slug(self) -> &'static str {
        match self {
            Self::Config => "config",
            Self::Data => "data",
            Self::Unavailable => "unavailable",
            Self::Storage => "storage",
        }
    }
}

/// What could not be carried out, and why.
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

    /// What it is about.
    pub fn kind(&self) -> Kind {
        match self {
            Self::Config(_) | Self::Setup { .. } => Kind::Config,
            Self::Device { .. } | Self::NoDevice { .. } => Kind::Unavailable,
            Self::Data { .. } => Kind::Data,
            Self::Storage { .. } => Kind::Storage,
        }
    }

    /// The message with all its causes, outermost first.
    pub fn chain(&self) -> String {
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
