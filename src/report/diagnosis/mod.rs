//! From what was measured to what it means: reasons in plain words, each with its evidence.
//!
//! Every threshold is in units of noise or a share of something, and says where it comes from. A sound scan has no
//! reason at all; what is merely worth knowing is a note of the report.

mod captured;
mod dark;
mod order;
mod pairs;
mod polarity;
mod references;
mod rules;
mod sensor;

use std::fmt;

use serde::{Deserialize, Serialize};
use serde_json::Value;

pub(super) use rules::{degree_of_polarization, diagnose, notes};

/// What can be wrong with a scan. `docs/diagnoses.md` has a row for each.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Diagnosis {
    /// A frame shows the picture before its own.
    StaleFrame,
    /// A frame that was asked for never came.
    LostFrame,
    /// A frame shows two pictures, one above the other.
    TornFrame,
    /// Frames are in another order than their roles say.
    SwappedFrames,
    /// Something moved during the capture.
    Motion,
    /// The brightness of the light changed to and fro between frames.
    Flicker,
    /// Frames carry a rest of the picture before.
    UnsettledDisplay,
    /// Lamp or exposure changed during the capture.
    ExposureDrift,
    /// Other light in the room changed during the capture.
    AmbientDrift,
    /// Projector or camera is not linear.
    NonlinearResponse,
    /// H and V are exchanged.
    PolarizationInverted,
    /// H and V differ too little.
    PolarizationWeak,
    /// Too much light.
    Saturated,
    /// No projector light was seen.
    NothingLit,
    /// Rows disagree with the calibration.
    RowMismatch,
    /// Pixels or lines of the sensor do not answer to light.
    SensorDefect,
    /// Few of the lit pixels gave a measurement.
    LowCoverage,
    /// A device failed, or did not end as it should.
    DeviceFault,
    /// Part of the proof that frames and pictures belong together is missing.
    CaptureUnproven,
    /// Frames are noisier than the camera's noise model says.
    NoiseModel,
    /// The capture was cancelled.
    Cancelled,
    /// The frames are there and cannot be decoded.
    DecodeFailed,
    /// The program ended before the scan did.
    Interrupted,
}

impl Diagnosis {
    /// All of them, in the order of the documentation.
    pub const ALL: [Self; 23] = [
        Self::StaleFrame,
        Self::LostFrame,
        Self::TornFrame,
        Self::SwappedFrames,
        Self::Motion,
        Self::Flicker,
        Self::UnsettledDisplay,
        Self::ExposureDrift,
        Self::AmbientDrift,
        Self::NonlinearResponse,
        Self::PolarizationInverted,
        Self::PolarizationWeak,
        Self::Saturated,
        Self::NothingLit,
        Self::RowMismatch,
        Self::SensorDefect,
        Self::LowCoverage,
        Self::DeviceFault,
        Self::CaptureUnproven,
        Self::NoiseModel,
        Self::Cancelled,
        Self::DecodeFailed,
        Self::Interrupted,
    ];

    /// Its name in files.
    pub fn slug(self) -> &'static str {
        match self {
            Self::StaleFrame => "stale-frame",
            Self::LostFrame => "lost-frame",
            Self::TornFrame => "torn-frame",
            Self::SwappedFrames => "swapped-frames",
            Self::Motion => "motion",
            Self::Flicker => "flicker",
            Self::UnsettledDisplay => "unsettled-display",
            Self::ExposureDrift => "exposure-drift",
            Self::AmbientDrift => "ambient-drift",
            Self::NonlinearResponse => "nonlinear-response",
            Self::PolarizationInverted => "polarization-inverted",
            Self::PolarizationWeak => "polarization-weak",
            Self::Saturated => "saturated",
            Self::NothingLit => "nothing-lit",
            Self::RowMismatch => "row-mismatch",
            Self::SensorDefect => "sensor-defect",
            Self::LowCoverage => "low-coverage",
            Self::DeviceFault => "device-fault",
            Self::CaptureUnproven => "capture-unproven",
            Self::NoiseModel => "noise-model",
            Self::Cancelled => "cancelled",
            Self::DecodeFailed => "decode-failed",
            Self::Interrupted => "interrupted",
        }
    }

    /// The diagnosis of a name.
    pub fn from_slug(slug: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|diagnosis| diagnosis.slug() == slug)
    }
}

impl fmt::Display for Diagnosis {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.slug())
    }
}

/// Whether a result can be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Verdict {
    /// Nothing speaks against it.
    Ok,
    /// It can be used, knowing the reasons.
    Degraded,
    /// It cannot be used.
    Failed,
}

impl fmt::Display for Verdict {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Ok => "ok",
            Self::Degraded => "degraded",
            Self::Failed => "failed",
        })
    }
}

/// Why a verdict is not `ok`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Reason {
    /// What is wrong.
    #[serde(rename = "type")]
    pub diagnosis: Diagnosis,
    /// What was seen, the likely cause and what to do next, in plain words with numbers.
    pub message: String,
    /// The numbers behind it, by name.
    pub evidence: Value,
    /// What it makes of the verdict at least: `degraded` or `failed`.
    pub severity: Verdict,
}

impl Reason {
    /// A reason that lets the result be used with care.
    pub fn degraded(diagnosis: Diagnosis, message: impl Into<String>, evidence: Value) -> Self {
        Self { diagnosis, message: message.into(), evidence, severity: Verdict::Degraded }
    }

    /// A reason that forbids to use the result.
    pub fn failed(diagnosis: Diagnosis, message: impl Into<String>, evidence: Value) -> Self {
        Self { severity: Verdict::Failed, ..Self::degraded(diagnosis, message, evidence) }
    }
}

/// The verdict of some reasons: the gravest, `ok` for none.
pub fn verdict(reasons: &[Reason]) -> Verdict {
    // A reason is never harmless, whatever it says of itself, or `ok` could come with reasons.
    reasons.iter().map(|reason| reason.severity.max(Verdict::Degraded)).max().unwrap_or(Verdict::Ok)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn slugs_are_the_names_in_json() {
        for diagnosis in Diagnosis::ALL {
            assert_eq!(serde_json::to_value(diagnosis).unwrap(), diagnosis.slug());
            assert_eq!(Diagnosis::from_slug(diagnosis.slug()), Some(diagnosis));
        }
        assert_eq!(Diagnosis::from_slug("no-such-thing"), None);
    }

    #[test]
    fn the_verdict_is_ok_if_and_only_if_there_is_no_reason() {
        let minor = Reason::degraded(Diagnosis::Flicker, "", Value::Null);
        let grave = Reason::failed(Diagnosis::NothingLit, "", Value::Null);
        let denied = Reason { severity: Verdict::Ok, ..minor.clone() };
        assert_eq!(verdict(&[]), Verdict::Ok);
        assert_eq!(verdict(&[denied]), Verdict::Degraded);
        assert_eq!(verdict(std::slice::from_ref(&minor)), Verdict::Degraded);
        assert_eq!(verdict(&[minor, grave]), Verdict::Failed);
    }

    /// The first cell of each row of the table in the documentation.
    fn documented() -> Vec<&'static str> {
        let table = include_str!("../../../docs/diagnoses.md");
        table
            .lines()
            .filter_map(|line| line.strip_prefix("| `"))
            .filter_map(|line| line.split_once('`'))
            .map(|(slug, _)| slug)
            .collect()
    }

    #[test]
    fn each_diagnosis_has_one_row_in_the_documentation() {
        let expected: Vec<_> = Diagnosis::ALL.iter().map(|diagnosis| diagnosis.slug()).collect();
        assert_eq!(documented(), expected);
    }

    #[test]
    fn each_row_of_the_documentation_says_what_is_seen_why_and_what_to_do() {
        for line in include_str!("../../../docs/diagnoses.md").lines().filter(|line| line.starts_with("| `"))
        {
            let cells: Vec<_> = line.trim_matches('|').split('|').map(str::trim).collect();
            assert_eq!(cells.len(), 4, "{line}");
            assert!(cells.iter().all(|cell| cell.len() >= 8), "{line}");
        }
    }
}
