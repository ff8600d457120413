//! What the sequencer found, as reasons of the report.

use serde_json::json;

use super::{Diagnosis, Reason};
use crate::sequencer::{CaptureError, Finding};

/// The diagnosis behind a finding of the sequencer, whose names are finer: they tell how a fault was noticed.
pub(super) fn diagnosis(reason: &str) -> Diagnosis {
    match reason {
        "damaged-frame" | "late-frame" => Diagnosis::LostFrame,
        "duplicate-frame" | "stale-receipt" | "wrong-slide" => Diagnosis::StaleFrame,
        "camera-failed"
        | "camera-not-stopped"
        | "projector-failed"
        | "projector-not-black"
        | "out-of-order"
        | "missed-flip" => Diagnosis::DeviceFault,
        other => Diagnosis::from_slug(other).unwrap_or(Diagnosis::CaptureUnproven),
    }
}

/// What to do about it.
fn advice(diagnosis: Diagnosis) -> &'static str {
    match diagnosis {
        Diagnosis::LostFrame => "check cable, power and load of the camera, then scan again",
        Diagnosis::StaleFrame | Diagnosis::SwappedFrames | Diagnosis::TornFrame => {
            "let the display hold each pattern longer (projector.hold_refreshes), then scan again"
        }
        Diagnosis::Motion => "fix the object and the rig, then scan again",
        Diagnosis::Flicker | Diagnosis::ExposureDrift | Diagnosis::UnsettledDisplay => {
            "let the lamp warm up and switch off every automatic of lamp and camera"
        }
        Diagnosis::AmbientDrift => "keep other light in the room constant",
        Diagnosis::DeviceFault => "check the device and scan again",
        Diagnosis::NonlinearResponse => "switch off sharpening and picture modes of the projector",
        Diagnosis::NoiseModel => {
            "measure it with `polscan calibrate noise`, and check the camera's gamma and gain"
        }
        Diagnosis::Cancelled => "scan again when ready",
        _ => "read the evidence before trusting the result",
    }
}

impl From<&Finding> for Reason {
    fn from(finding: &Finding) -> Self {
        let diagnosis = diagnosis(&finding.reason);
        let message = format!("during capture: {}; {}", finding.evidence, advice(diagnosis));
        let evidence = json!({
            "noticed_as": finding.reason,
            "role": finding.role,
            "sigma": finding.sigma.filter(|sigma| sigma.is_finite()),
        });
        Self::degraded(diagnosis, message, evidence)
    }
}

impl From<&CaptureError> for Reason {
    fn from(error: &CaptureError) -> Self {
        let diagnosis = diagnosis(error.reason());
        let mut chain = error.to_string();
        let mut source = std::error::Error::source(error);
        while let Some(cause) = source {
            chain.push_str(&format!(": {cause}"));
            source = cause.source();
        }
        let message = format!("the capture did not end: {chain}; {}", advice(diagnosis));
        Self::failed(diagnosis, message, json!({ "noticed_as": error.reason() }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::Verdict;

    #[test]
    fn a_finding_keeps_its_name_and_evidence() {
        let finding = Finding {
            reason: "duplicate-frame".into(),
            role: None,
            evidence: "frame 7 came twice".into(),
            sigma: Some(f64::NAN),
        };
        let reason = Reason::from(&finding);
        assert_eq!(reason.diagnosis, Diagnosis::StaleFrame);
        assert_eq!(reason.severity, Verdict::Degraded);
        assert!(reason.message.contains("frame 7 came twice"));
        assert_eq!(reason.evidence["noticed_as"], "duplicate-frame");
    }

    #[test]
    fn an_unknown_finding_is_a_missing_proof_and_a_cancelled_capture_is_failed() {
        assert_eq!(diagnosis("guessed-flips"), Diagnosis::CaptureUnproven);
        let reason = Reason::from(&CaptureError::Cancelled);
        assert_eq!((reason.diagnosis, reason.severity), (Diagnosis::Cancelled, Verdict::Failed));
    }
}
