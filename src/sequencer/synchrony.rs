//! How well flips and exposures kept step.

use std::time::Duration;

use polscan_drivers::{clock::Timestamp, projector::PresentReceipt};
use serde::{Deserialize, Serialize};

use super::{
    plan::{Order, Timing},
    record::CapturedFrame,
};

/// The timetable of a capture, and how it was kept.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct Synchrony {
    /// Whether the next slide was flipped while a frame was read out.
    pub order: Order,
    /// Why.
    pub order_reason: String,
    /// Time between refreshes, in ms.
    pub refresh_period_ms: f64,
    /// From flip to first light as planned with, in ms.
    pub projector_latency_ms: f64,
    /// From first light to a settled picture as planned with, in ms.
    pub projector_settling_ms: f64,
    /// From flip to trigger as planned, in ms.
    pub trigger_delay_ms: f64,
    /// How far exposures were off their phase to the flip. `None` without frames.
    pub phase_error_us: Option<PhaseError>,
    /// Refreshes between first and last flip beyond those planned: lost to re-takes, late frames and a late computer.
    /// `None` where refreshes are not counted.
    pub idle_refreshes: Option<u64>,
}

/// Sizes of the phase errors of all frames, in us.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct PhaseError {
    /// Median.
    pub median: f64,
    /// Largest.
    pub worst: f64,
}

impl Synchrony {
    /// Of a capture by `timing` before its first frame.
    pub fn planned(timing: &Timing) -> Self {
        let ms = |time: Duration| 1e3 * time.as_secs_f64();
        Self {
            order: timing.order,
            order_reason: timing.order_reason.to_string(),
            refresh_period_ms: ms(timing.refresh_period),
            projector_latency_ms: ms(timing.latency),
            projector_settling_ms: ms(timing.settling),
            trigger_delay_ms: ms(timing.trigger_delay),
            phase_error_us: None,
            idle_refreshes: None,
        }
    }

    /// With what `frames` say, which were to be held `hold_refreshes` each.
    pub fn measured(self, hold_refreshes: u32, frames: &[CapturedFrame]) -> Self {
        let mut errors: Vec<f64> = frames
            .iter()
            .filter_map(|taken| self.phase_error_us_of(&taken.receipt, taken.frame.stamp.exposure_start))
            .map(f64::abs)
            .collect();
        errors.sort_by(f64::total_cmp);
        let median = errors.get(errors.len() / 2).copied();
        let phase_error_us = median.zip(errors.last()).map(|(median, &worst)| PhaseError { median, worst });
        let refreshes: Option<Vec<u64>> = frames.iter().map(|taken| taken.receipt.refresh).collect();
        let idle_refreshes = refreshes.and_then(|refreshes| {
            let passed = refreshes.iter().max()?.saturating_sub(*refreshes.iter().min()?);
            let planned = u64::from(hold_refreshes) * (refreshes.len() as u64 - 1);
            Some(passed.saturating_sub(planned))
        });
        Self { phase_error_us, idle_refreshes, ..self }
    }

    /// How far an exposure is off the phase to its flip that all should have, in us; early is negative. Whole refreshes
    /// do not count, so that it does not matter at which of them a guessed flip was. `None` where there was no timetable.
    pub fn phase_error_us_of(&self, receipt: &PresentReceipt, exposure_start: Timestamp) -> Option<f64> {
        let period_us = 1e3 * self.refresh_period_ms;
        let after_us = 1e-3 * (i128::from(exposure_start.0) - i128::from(receipt.flipped.0)) as f64;
        let off = after_us - 1e3 * self.trigger_delay_ms;
        (period_us > 0.0).then(|| off - period_us * (off / period_us).round())
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use polscan_drivers::{
        frame::{Frame, FrameStamp},
        projector::ReceiptMethod,
    };
    use polscan_patterns::Role;

    use super::*;

    fn taken(refresh: u64, after_us: i64) -> CapturedFrame {
        let flipped = Timestamp(refresh * 10_000_000);
        let exposure_start = Timestamp(flipped.0.saturating_add_signed(after_us * 1000));
        let stamp = FrameStamp {
            frame_id: 0,
            trigger: 0,
            exposure_start,
            received: exposure_start,
            device_time_ns: None,
        };
        CapturedFrame {
            role: Role::White,
            receipt: PresentReceipt {
                slide: Some(0),
                flipped,
                refresh: Some(refresh),
                method: ReceiptMethod::X11Present,
            },
            triggered: exposure_start,
            frame: Frame { width: 1, height: 1, bit_depth: 8, stamp, store: Arc::new(vec![0u8]) },
        }
    }

    fn planned() -> Synchrony {
        Synchrony { refresh_period_ms: 10.0, trigger_delay_ms: 31.0, ..Synchrony::default() }
    }

    #[test]
    fn phases_count_whole_refreshes_as_none_and_early_as_negative() {
        let error = |after_us| {
            let frame = taken(100, after_us);
            planned().phase_error_us_of(&frame.receipt, frame.frame.stamp.exposure_start).unwrap()
        };
        for (after_us, expected) in [(31_000, 0.0), (31_250, 250.0), (30_900, -100.0), (51_001, 1.0)] {
            assert!((error(after_us) - expected).abs() < 1e-6, "{after_us}: {}", error(after_us));
        }
        let frame = taken(1, 5);
        assert_eq!(Synchrony::default().phase_error_us_of(&frame.receipt, frame.triggered), None);
    }

    #[test]
    fn errors_are_summed_up_by_size_and_refreshes_beyond_the_plan_are_counted() {
        let frames = [taken(100, 31_010), taken(104, 30_970), taken(108, 31_020), taken(114, 41_000)];
        let measured = planned().measured(4, &frames);
        let error = measured.phase_error_us.unwrap();
        assert!((error.median - 20.0).abs() < 1e-6 && (error.worst - 30.0).abs() < 1e-6, "{error:?}");
        assert_eq!(measured.idle_refreshes, Some(2));
        assert_eq!(planned().measured(4, &[]).phase_error_us, None);
        let mut uncounted = taken(100, 31_000);
        uncounted.receipt.refresh = None;
        assert_eq!(planned().measured(4, &[uncounted]).idle_refreshes, None);
    }
}
