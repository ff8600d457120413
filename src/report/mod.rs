//! What a scan came to: figures, a verdict with its reasons, and words for people.

mod accuracy;
mod build;
mod capture;
pub mod colormap;
mod diagnosis;
pub mod pictures;
mod region;
pub(crate) mod statistics;
mod summary;
#[cfg(test)]
mod testing;
mod types;

pub use accuracy::Accuracy;
pub use build::{ReportInput, build};
pub use capture::CaptureSummary;
pub use diagnosis::{Diagnosis, Reason, Verdict, verdict};
pub use region::{NamedRegion, RegionError, check_regions};
pub use summary::{Outputs, summary};
pub use types::{
    BorderReport, CalibrationReport, CaptureReport, Contrast, NoiseReport, PairName, PairReport,
    PairResidualReport, PixelCounts, PlaneReport, Report, RowCheckReport, SCHEMA, Size, Timings, TruthReport,
};
