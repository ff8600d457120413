//! Configuration: a raw mirror of the file, then validated settings. All faults are reported at once, each with
//! its key path.

mod layers;
mod raw;
mod settings;

pub use layers::{ConfigError, Fault, Layers, Override};
pub use raw::{DeviceDriver, Raw, UsbMode};
pub use settings::{RigCalibration, Settings};
