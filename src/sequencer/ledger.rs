//! Accounts of flips and exposures: whether a receipt answers the slide that was asked for, and whether a frame is the
//! exposure that was asked for.

use polscan_drivers::{
    clock::Timestamp,
    frame::FrameStamp,
    projector::{PresentReceipt, ReceiptMethod},
};

use super::plan::Timing;

/// Flips that a receipt may announce ahead of its return.
const FLIPS_AHEAD: u32 = 10;

/// Why a receipt or a frame is not the one asked for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Refusal {
    /// Slug.
    pub reason: &'static str,
    /// Evidence in words.
    pub evidence: String,
    /// Whether the frame asked for may still come.
    pub may_come: bool,
}

impl Refusal {
    fn new(reason: &'static str, evidence: String) -> Self {
        Self { reason, evidence, may_come: false }
    }

    fn passing(reason: &'static str, evidence: String) -> Self {
        Self { reason, evidence, may_come: true }
    }
}

/// The flips so far.
#[derive(Debug, Clone, Default)]
pub(super) struct Flips {
    last: Option<PresentReceipt>,
}

impl Flips {
    /// The flip before.
    pub fn last(&self) -> Option<&PresentReceipt> {
        self.last.as_ref()
    }

    /// Enters the receipt for `slide`, asked for at `asked` or later and received at `now`.
    pub fn enter(
        &mut self,
        timing: &Timing,
        slide: u32,
        asked: Timestamp,
        now: Timestamp,
        receipt: PresentReceipt,
    ) -> Result<(), Refusal> {
        let flipped = receipt.flipped;
        // A recording's times are its own.
        if receipt.method != ReceiptMethod::Recorded {
            let latest = now + timing.refresh_period * FLIPS_AHEAD;
            if flipped + timing.stamp_tolerance < asked || flipped > latest {
                let evidence =
                    format!("slide {slide} asked for at {asked}, the receipt of {now} says {flipped}");
                return Err(Refusal::new("stale-receipt", evidence));
            }
        }
        if let Some(before) = self.last {
            if flipped <= before.flipped {
                let evidence =
                    format!("slide {slide} flipped at {flipped}, the one before at {}", before.flipped);
                return Err(Refusal::new("stale-receipt", evidence));
            }
            if let (Some(from), Some(to)) = (before.refresh, receipt.refresh) {
                let elapsed = flipped.since(before.flipped).as_secs_f64();
                let period = timing.refresh_period.as_secs_f64();
                let counted = (to as f64 - from as f64) * period;
                // Half a refresh, and half a percent between the nominal rate and the real one.
                if to <= from || (counted - elapsed).abs() > 0.5 * period + 0.005 * elapsed {
                    let evidence = format!(
                        "slide {slide}: refresh {from} to {to} in {:.1} ms at {:.3} ms a refresh",
                        elapsed * 1e3,
                        period * 1e3
                    );
                    return Err(Refusal::new("stale-receipt", evidence));
                }
            }
        }
        // A flip to another slide is a flip all the same: no later receipt may claim it.
        self.last = Some(receipt);
        if receipt.slide != Some(slide) {
            let shown = receipt.slide.map_or("black".to_string(), |shown| format!("slide {shown}"));
            return Err(Refusal::new(
                "wrong-slide",
                format!("asked for slide {slide}, the receipt names {shown}"),
            ));
        }
        Ok(())
    }
}

/// When the exposure that is awaited can have begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Window {
    /// Asked-for start: the picture is stable from here on.
    pub at: Timestamp,
    /// Start that the camera announced.
    pub started: Timestamp,
    /// When the light of the next picture can come, where that is asked for before the frame is in hand.
    pub next_light: Option<Timestamp>,
}

/// The exposures so far.
#[derive(Debug, Clone)]
pub(super) struct Exposures {
    /// Whether each trigger starts exactly one exposure and each exposure is counted.
    one_each: bool,
    triggers: u64,
    failed_triggers: u64,
    lost: u64,
    unanswered: u64,
    next_id: u64,
}

impl Exposures {
    pub fn new(one_each: bool) -> Self {
        Self { one_each, triggers: 0, failed_triggers: 0, lost: 0, unanswered: 0, next_id: 0 }
    }

    /// Triggers that the camera has taken.
    pub fn triggers(&self) -> u64 {
        self.triggers
    }

    /// A trigger was taken.
    pub fn trigger(&mut self) {
        self.triggers += 1;
    }

    /// A trigger was refused; whether the camera counted it cannot be known.
    pub fn trigger_failed(&mut self) {
        self.failed_triggers += 1;
    }

    /// The last trigger brought no frame that could be kept; `outstanding` where its own frame has not been seen.
    pub fn unanswered(&mut self, outstanding: bool) {
        if outstanding {
            self.unanswered += 1;
            self.lost += 1;
        }
    }

    /// Enters a frame and says whether it is the exposure of the last trigger.
    ///
    /// Order of the checks: the camera's own count (repeated, out of order), the time of the exposure, the driver's
    /// belief, then whether frames are missing in front of it.
    pub fn enter(&mut self, timing: &Timing, window: Window, stamp: &FrameStamp) -> Result<(), Refusal> {
        let FrameStamp { frame_id, trigger, exposure_start, received, .. } = *stamp;
        if frame_id + 1 == self.next_id {
            return Err(Refusal::passing("duplicate-frame", format!("frame {frame_id} came again")));
        }
        if frame_id < self.next_id {
            let evidence = format!("frame {frame_id} came after frame {}", self.next_id - 1);
            return Err(Refusal::passing("swapped-frames", evidence));
        }
        let gap = frame_id - self.next_id;
        let unanswered = std::mem::take(&mut self.unanswered);
        self.next_id = frame_id + 1;

        let tolerance = timing.stamp_tolerance;
        if exposure_start + tolerance < window.at {
            let early = window.at.since(exposure_start);
            // The trigger that it answers was counted as unanswered, and others may still be.
            self.unanswered = unanswered.saturating_sub(gap + 1);
            let evidence = format!("frame {frame_id} was exposed {early:.1?} before the picture was stable");
            return Err(Refusal::passing("stale-frame", evidence));
        }
        let latest = window.at.max(window.started) + tolerance;
        if self.one_each && exposure_start > latest {
            let late = exposure_start.since(latest);
            let evidence = format!("frame {frame_id} was exposed {late:.1?} after its trigger");
            return Err(Refusal::new("late-frame", evidence));
        }
        // Where a stamp only repeats when the exposure was asked for, the arrival has to prove when it was over.
        if let Some(light) = window.next_light
            && !timing.stamped
            && received > light + timing.readout
        {
            let late = received.since(light + timing.readout);
            let evidence = format!(
                "frame {frame_id} arrived {late:.1?} too late to be certain that the next picture is not in it"
            );
            return Err(Refusal::new("late-frame", evidence));
        }
        // A driver that numbers frames by counting them falls behind by one with each lost frame.
        let believed =
            (self.triggers - 1).saturating_sub(self.lost)..=self.triggers - 1 + self.failed_triggers;
        if self.one_each && !believed.contains(&trigger) {
            let evidence = format!("frame {frame_id} answers trigger {trigger}, not {}", self.triggers - 1);
            return Err(Refusal::new("swapped-frames", evidence));
        }
        if self.one_each && gap > unanswered + self.failed_triggers {
            let evidence =
                format!("{gap} exposures are missing before frame {frame_id}, {unanswered} were known to be");
            return Err(Refusal::new("lost-frame", evidence));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
