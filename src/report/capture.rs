//! What the report needs to know of a capture, whether it has just ended or is read from a recording.

use polscan_drivers::{camera::StreamStatistics, frame::FrameStamp, projector::PresentReceipt};
use polscan_patterns::Role;
use serde::{Deserialize, Serialize};

use crate::sequencer::{CaptureRecord, Finding, ReferenceRetake, Retake, Synchrony};

/// A capture without its pixels.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CaptureSummary {
    /// From the first flip to the last frame, in seconds of the rig's clock.
    pub seconds: f64,
    /// The least that the display allows, in seconds.
    pub limit_seconds: f64,
    /// From flip to trigger, in ms.
    pub latency_ms: f64,
    /// Refreshes that each slide was held.
    pub hold_frames: u32,
    /// Whether latency and settling were measured (rather than conservative defaults).
    pub timing_measured: bool,
    /// How flips and exposures kept step, where it was noted.
    #[serde(default)]
    pub synchrony: Option<Synchrony>,
    /// Pairs that were captured again.
    pub retaken: Vec<Retake>,
    /// References that were captured again.
    #[serde(default)]
    pub references_retaken: Vec<ReferenceRetake>,
    /// Frames that arrived and were not the ones awaited.
    #[serde(default)]
    pub discarded: Vec<Finding>,
    /// Counters of the camera's stream.
    pub statistics: StreamStatistics,
    /// Frames whose exposure began before their own picture was flipped: they show the picture before.
    pub early: Vec<Role>,
    /// Frames of different roles that the same slide was on the glass for.
    pub shared_slide: Vec<[Role; 2]>,
}

impl From<&CaptureRecord> for CaptureSummary {
    fn from(record: &CaptureRecord) -> Self {
        let frames: Vec<_> =
            record.frames.iter().map(|taken| (taken.role, taken.receipt, taken.frame.stamp)).collect();
        Self {
            seconds: record.seconds,
            limit_seconds: record.limit_seconds,
            latency_ms: record.latency_ms,
            hold_frames: record.hold_refreshes,
            timing_measured: record.timing_measured,
            synchrony: Some(record.synchrony.clone()),
            retaken: record.retaken.clone(),
            references_retaken: record.notes.references_retaken.clone(),
            discarded: record.notes.discarded.clone(),
            statistics: record.statistics.clone(),
            early: Vec::new(),
            shared_slide: Vec::new(),
        }
        .with_evidence(&frames)
    }
}

impl CaptureSummary {
    /// Looks through receipts and stamps for frames that cannot show what their role says.
    pub fn with_evidence(mut self, frames: &[(Role, PresentReceipt, FrameStamp)]) -> Self {
        let exposed_early = |(role, receipt, stamp): &(Role, PresentReceipt, FrameStamp)| {
            (stamp.exposure_start < receipt.flipped).then_some(*role)
        };
        self.early = frames.iter().filter_map(exposed_early).collect();
        for (index, (role, receipt, _)) in frames.iter().enumerate() {
            for (earlier_role, earlier, _) in &frames[..index] {
                if receipt.slide.is_some() && receipt.slide == earlier.slide && role != earlier_role {
                    self.shared_slide.push([*earlier_role, *role]);
                }
            }
        }
        self
    }

    /// Exposures that were asked for and gave no whole frame.
    pub fn lost_frames(&self) -> u64 {
        let StreamStatistics { triggers, frames, failed, .. } = self.statistics;
        failed.max(triggers.saturating_sub(frames))
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use polscan_drivers::{
        camera::{AppliedSettings, CameraSettings, PixelFormat, TriggerSource},
        clock::Timestamp,
        frame::{Frame, FrameStamp},
        projector::{PresentReceipt, ReceiptMethod},
    };
    use polscan_patterns::Axis;

    use super::*;
    use crate::sequencer::CapturedFrame;

    fn frame(role: Role, slide: u32, flipped: u64, exposed: u64) -> CapturedFrame {
        let stamp = FrameStamp {
            frame_id: 0,
            trigger: 0,
            exposure_start: Timestamp(exposed),
            received: Timestamp(exposed + 10),
            device_time_ns: None,
        };
        CapturedFrame {
            role,
            receipt: PresentReceipt {
                slide: Some(slide),
                flipped: Timestamp(flipped),
                refresh: None,
                method: ReceiptMethod::Simulated,
            },
            triggered: Timestamp(exposed),
            frame: Frame { width: 1, height: 1, bit_depth: 8, stamp, store: Arc::new(vec![0u8]) },
        }
    }

    fn record(frames: Vec<CapturedFrame>) -> CaptureRecord {
        CaptureRecord {
            frames,
            retaken: vec![],
            seconds: 1.5,
            limit_seconds: 1.4,
            latency_ms: 33.0,
            hold_refreshes: 2,
            timing_measured: true,
            synchrony: Synchrony::default(),
            applied: AppliedSettings {
                settings: CameraSettings {
                    exposure_us: 2000.0,
                    gain_db: 0.0,
                    gamma: 1.0,
                    region: None,
                    format: PixelFormat::Mono8,
                    trigger: TriggerSource::Software,
                },
                width: 1,
                height: 1,
                black_level_dn: None,
                saturation_dn: 255,
                readout_us: 0.0,
                noise: None,
            },
            statistics: StreamStatistics { triggers: 7, frames: 5, failed: 1, ..StreamStatistics::default() },
            notes: Default::default(),
        }
    }

    #[test]
    fn receipts_that_belie_their_frames_are_listed() {
        let code = |bit, inverse| Role::Code { axis: Axis::Column, bit, inverse };
        let summary = CaptureSummary::from(&record(vec![
            frame(Role::ReferenceV, 0, 100, 200),
            frame(code(0, false), 1, 300, 299),
            frame(code(0, true), 1, 500, 600),
            frame(Role::ReferenceV, 0, 700, 800),
        ]));
        assert_eq!(summary.early, [code(0, false)]);
        assert_eq!(summary.shared_slide, [[code(0, false), code(0, true)]]);
        assert_eq!(summary.lost_frames(), 2);
        assert_eq!((summary.seconds, summary.limit_seconds, summary.hold_frames), (1.5, 1.4, 2));
    }

    #[test]
    fn a_sound_capture_has_nothing_to_list() {
        let mut record = record(vec![frame(Role::White, 0, 1, 2), frame(Role::Black, 1, 3, 4)]);
        record.statistics = StreamStatistics { triggers: 2, frames: 2, ..StreamStatistics::default() };
        let summary = CaptureSummary::from(&record);
        assert!(summary.early.is_empty() && summary.shared_slide.is_empty());
        assert_eq!(summary.lost_frames(), 0);
        let json = serde_json::to_string(&summary).unwrap();
        assert_eq!(serde_json::from_str::<CaptureSummary>(&json).unwrap(), summary);
    }
}
