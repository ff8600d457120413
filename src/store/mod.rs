//! Bundles: one scan in one folder. Reading is strict and reports every fault; writing is all or nothing.

pub mod bundle;
pub mod calibrations;
mod disk;
pub mod error;
pub mod frames;
mod images;
pub mod index;
pub mod library;
pub mod manifest;
pub mod maps;
pub mod measured;
pub mod npy;
pub mod npz;
mod pnm;
pub mod single;
pub mod source;
pub mod spool;
pub mod time;

pub use bundle::BundleWriter;
pub use error::{Fault, Faults, InputError, StorageError};
pub use frames::{FrameSet, Limits};
pub use index::{Index, IndexError};
pub use library::Library;
pub use manifest::Manifest;
pub use source::{Bundle, Policy};
