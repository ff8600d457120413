//! When each slide is shown and each exposure starts. Pure: durations in, a timetable out.
//!
//! One slide is in flight at a time. Seen from its flip:
//!
//! ```text
//! flip    latency      settling    margin  exposure   readout   lead   next flip
//! |-----------------|------------|--|===============|----------|------|
//! |    old light    |   mixture  |       stable light               (latency) ... until the next slide's light
//! |------------------------- hold_refreshes x refresh_period -----------------|
//! ```
//!
//! The frame is in hand before the next slide is asked for, so that an exposure cannot reach into the next picture
//! even where the camera is slower than it says: the scan then takes longer, no more. Judging a pair overlaps the
//! latency of the slide after it.

use std::time::Duration;

use polscan_drivers::{
    camera::AppliedSettings,
    clock::Timestamp,
    projector::{PresentReceipt, ProjectorInfo, ReceiptMethod},
};
use polscan_patterns::{Axis, Polarization, PolarizationError, ProjectorSize, Role, Sequence};
use thiserror::Error;

/// Refreshes from flip to first light that are assumed of an unmeasured projector: signal processing of common
/// projectors takes one to three.
pub const ASSUMED_LATENCY_REFRESHES: u32 = 3;

/// Settling that is assumed of an unmeasured projector, besides the refresh that scan-out takes from top to bottom.
pub const ASSUMED_SETTLING: Duration = Duration::from_millis(20);

/// Refreshes by which a flip may follow a receipt that was only [guessed](ReceiptMethod::Guessed): a swapchain holds
/// that many pictures back.
pub const GUESSED_FLIP_REFRESHES: u32 = 2;

/// Most refreshes that a slide may be held: two minutes at 60 Hz.
pub const MAX_HOLD_REFRESHES: u32 = 7200;

/// Longest time that is planned with, so that sums cannot overflow.
const LONGEST: Duration = Duration::from_secs(3600);

/// What the configuration can say about a capture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PlanOptions {
    /// Refreshes to hold each slide; `None` is the least that is safe.
    pub hold_refreshes: Option<u32>,
    /// From flip to trigger; `None` is latency + settling + margin.
    pub trigger_delay: Option<Duration>,
    /// Added to latency and settling; never less than `stamp_tolerance`.
    pub margin: Duration,
    /// How far a frame's stamp may be off.
    pub stamp_tolerance: Duration,
    /// How long before a refresh a slide must be asked for, to be flipped at it.
    pub submit_lead: Duration,
    /// How much later than computed a frame may arrive before it counts as lost.
    pub frame_slack: Duration,
    /// How often one pair or reference may be taken again.
    pub retakes_each: u32,
    /// How many takes of all pairs and references may be repeated in one scan.
    pub retakes_total: u32,
}

impl Default for PlanOptions {
    fn default() -> Self {
        Self {
            hold_refreshes: None,
            trigger_delay: None,
            margin: Duration::from_millis(1),
            stamp_tolerance: Duration::from_millis(1),
            submit_lead: Duration::from_millis(2),
            frame_slack: Duration::from_millis(250),
            retakes_each: 2,
            retakes_total: 6,
        }
    }
}

/// Why a capture cannot be planned.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum PlanError {
    /// The projector is not the one that the patterns are for.
    #[error(
        "the patterns are for a projector of {}x{} px but {model} has {width}x{height}: correct the configured size",
        expected.width, expected.height
    )]
    Size {
        /// Size that the sequence is for.
        expected: ProjectorSize,
        /// Connected projector.
        model: String,
        /// Its columns.
        width: u32,
        /// Its rows.
        height: u32,
    },
    /// A time makes no sense.
    #[error("{what} of {value} cannot be planned with: {expected}")]
    Value {
        /// Which time.
        what: &'static str,
        /// Its value with unit.
        value: String,
        /// What it must be.
        expected: &'static str,
    },
    /// The configured delay starts the exposure on a mixture of two pictures.
    #[error(
        "a trigger delay of {delay:?} starts the exposure before the picture has settled: the projector needs \
         {needed:?} after the flip; raise it, or leave it out"
    )]
    EarlyTrigger {
        /// Configured delay.
        delay: Duration,
        /// Least delay.
        needed: Duration,
    },
    /// The configured hold is shorter than delay, exposure and readout.
    #[error(
        "a hold of {hold} refreshes is too short: delay, exposure and readout need {needed}; raise it, or leave it out"
    )]
    ShortHold {
        /// Configured hold.
        hold: u32,
        /// Least hold.
        needed: u32,
    },
    /// The channels cannot carry the code.
    #[error("the projector's channels cannot carry a polarization code")]
    Polarization(#[source] PolarizationError),
}

/// Timetable of one slide, the same for all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timing {
    /// Time between refreshes.
    pub refresh_period: Duration,
    /// From flip to first light.
    pub latency: Duration,
    /// From first light to a settled picture.
    pub settling: Duration,
    /// Whether latency and settling were measured (rather than assumed).
    pub measured: bool,
    /// From flip to the start of exposure.
    pub trigger_delay: Duration,
    /// Exposure time.
    pub exposure: Duration,
    /// From the end of exposure until the frame has arrived.
    pub readout: Duration,
    /// Refreshes that each slide is held.
    pub hold_refreshes: u32,
    /// How far a frame's stamp may be off.
    pub stamp_tolerance: Duration,
    /// How much later than computed a frame may arrive.
    pub frame_slack: Duration,
}

impl Timing {
    /// The timetable with the least safe hold, or the configured one where it is safe.
    pub fn new(
        projector: &ProjectorInfo,
        exposure_us: f64,
        readout_us: f64,
        options: &PlanOptions,
    ) -> Result<Self, PlanError> {
        let refresh_period = projector.refresh_period;
        if refresh_period.is_zero() || refresh_period > Duration::from_secs(1) {
            return Err(PlanError::Value {
                what: "a refresh period",
                value: format!("{refresh_period:?}"),
                expected: "more than 0 and at most 1 s",
            });
        }
        let exposure = microseconds("an exposure", exposure_us)?;
        if exposure.is_zero() {
            let value = format!("{exposure_us} us");
            return Err(PlanError::Value { what: "an exposure", value, expected: "more than 0" });
        }
        let readout = microseconds("a readout", readout_us)?;
        let (latency, settling) = match projector.timing {
            Some(timing) => (timing.latency, timing.settling),
            None => (refresh_period * ASSUMED_LATENCY_REFRESHES, refresh_period + ASSUMED_SETTLING),
        };
        for (what, time) in [
            ("a latency", latency),
            ("a settling", settling),
            ("a trigger delay", options.trigger_delay.unwrap_or_default()),
            ("a margin", options.margin),
            ("a stamp tolerance", options.stamp_tolerance),
            ("a submit lead", options.submit_lead),
            ("a frame slack", options.frame_slack),
        ] {
            if time > LONGEST {
                return Err(PlanError::Value { what, value: format!("{time:?}"), expected: "at most 1 h" });
            }
        }
        let margin = options.margin.max(options.stamp_tolerance);
        let needed = latency + settling + margin;
        let trigger_delay = match options.trigger_delay {
            // Against a measured projector the delay is checked; otherwise it is all that is known of it.
            Some(delay) if projector.timing.is_some() && delay < needed => {
                return Err(PlanError::EarlyTrigger { delay, needed });
            }
            Some(delay) => delay,
            None => needed,
        };
        let busy = trigger_delay + exposure + readout + options.submit_lead;
        let least_hold = busy.as_nanos().div_ceil(refresh_period.as_nanos()).max(1);
        let too_long = || PlanError::Value {
            what: "a hold",
            value: format!("{} refreshes", u128::from(options.hold_refreshes.unwrap_or(0)).max(least_hold)),
            expected: "at most 7200",
        };
        let least_hold = u32::try_from(least_hold).map_err(|_| too_long())?;
        let hold_refreshes = options.hold_refreshes.unwrap_or(least_hold);
        if least_hold.max(hold_refreshes) > MAX_HOLD_REFRESHES {
            return Err(too_long());
        }
        if hold_refreshes < least_hold {
            return Err(PlanError::ShortHold { hold: hold_refreshes, needed: least_hold });
        }
        Ok(Self {
            refresh_period,
            latency,
            settling,
            measured: projector.timing.is_some(),
            trigger_delay,
            exposure,
            readout,
            hold_refreshes,
            stamp_tolerance: options.stamp_tolerance,
            frame_slack: options.frame_slack,
        })
    }

    /// How long each slide is held.
    pub fn hold(&self) -> Duration {
        self.refresh_period * self.hold_refreshes
    }

    /// The latest moment at which the slide of `receipt` may have been flipped.
    pub fn latest_flip(&self, receipt: &PresentReceipt) -> Timestamp {
        match receipt.method {
            ReceiptMethod::Guessed => receipt.flipped + self.refresh_period * GUESSED_FLIP_REFRESHES,
            _ => receipt.flipped,
        }
    }

    /// When to start the exposure of a slide flipped at `flip`. Where that has passed, whole refreshes later: a
    /// constant phase to the refresh keeps a pulsed lamp and the panel's frame inversion out of the comparison of
    /// frames.
    pub fn trigger_at(&self, flip: Timestamp, now: Timestamp) -> Timestamp {
        let at = flip + self.trigger_delay;
        let late = now.since(at).as_nanos().div_ceil(self.refresh_period.as_nanos()) as u64;
        Timestamp(at.0 + late * self.refresh_period.as_nanos() as u64)
    }

    /// When to ask for the slide after the one flipped at `flip`: a quarter into the refresh before its own, safe from
    /// jitter to both sides.
    pub fn next_show(&self, flip: Timestamp) -> Timestamp {
        flip + self.refresh_period * (self.hold_refreshes - 1) + self.refresh_period / 4
    }

    /// When the frame of an exposure that began at `started` counts as lost.
    pub fn frame_deadline(&self, started: Timestamp) -> Timestamp {
        started + self.exposure + self.readout + self.frame_slack
    }

    /// When the light can change that the slide after the one flipped at `flip` brings, where that is flipped in time.
    /// The latency shields the exposure only where it was measured.
    pub fn next_light(&self, flip: Timestamp) -> Timestamp {
        flip + self.hold() + if self.measured { self.latency } else { Duration::ZERO }
    }
}

fn microseconds(what: &'static str, value_us: f64) -> Result<Duration, PlanError> {
    Duration::try_from_secs_f64(value_us * 1e-6)
        .ok()
        .filter(|time| *time <= LONGEST)
        .ok_or_else(|| PlanError::Value { what, value: format!("{value_us} us"), expected: "0 us to 1 h" })
}

/// Steps that are taken, judged and if need be repeated together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Group {
    /// A frame that nothing is compared with: a first reference, or a bit without an inverse.
    Single {
        /// Its step.
        step: usize,
    },
    /// A reference that was shown before.
    Again {
        /// Its step.
        step: usize,
        /// Step that showed the same before.
        first: usize,
    },
    /// A bit and its inverse, in this order or the other.
    Pair {
        /// Step shown first; the second is the next one.
        step: usize,
        /// Axis of the pair.
        axis: Axis,
        /// Bit of the pair.
        bit: u8,
    },
}

impl Group {
    /// Steps of the group.
    pub fn steps(self) -> std::ops::Range<usize> {
        match self {
            Self::Single { step } | Self::Again { step, .. } => step..step + 1,
            Self::Pair { step, .. } => step..step + 2,
        }
    }
}

/// Everything that a capture does, known before its first flip. Step `i` shows role `i` of the sequence as slide `i`.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// What is shown.
    pub sequence: Sequence,
    /// What polarized pictures are made of.
    pub polarization: Polarization,
    /// The steps in groups, in order.
    pub groups: Vec<Group>,
    /// Timetable.
    pub timing: Timing,
    /// Settings in effect while capturing.
    pub applied: AppliedSettings,
    /// How often one group may be taken again.
    pub retakes_each: u32,
    /// How often groups may be taken again in all.
    pub retakes_total: u32,
}

impl Plan {
    /// Plans the capture of `sequence`. `applied` is what the camera read back.
    pub fn new(
        sequence: Sequence,
        polarization: Polarization,
        projector: &ProjectorInfo,
        applied: AppliedSettings,
        options: &PlanOptions,
    ) -> Result<Self, PlanError> {
        let expected = sequence.size();
        if (expected.width, expected.height) != (projector.width, projector.height) {
            return Err(PlanError::Size {
                expected,
                model: projector.model.clone(),
                width: projector.width,
                height: projector.height,
            });
        }
        if sequence.mode.is_polarized() {
            polarization.validate().map_err(PlanError::Polarization)?;
        }
        let timing = Timing::new(projector, applied.settings.exposure_us, applied.readout_us, options)?;
        Ok(Self {
            groups: groups(&sequence.roles),
            sequence,
            polarization,
            timing,
            applied,
            retakes_each: options.retakes_each,
            retakes_total: options.retakes_total,
        })
    }

    /// What the display allows at least: frames x hold.
    pub fn limit(&self) -> Duration {
        self.timing.hold() * self.sequence.roles.len() as u32
    }

    /// What the capture takes from the first flip to the last frame where nothing is repeated or late.
    pub fn expected(&self) -> Duration {
        let Timing { trigger_delay, exposure, readout, .. } = self.timing;
        self.timing.hold() * (self.sequence.roles.len() as u32).saturating_sub(1)
            + trigger_delay
            + exposure
            + readout
    }
}

fn groups(roles: &[Role]) -> Vec<Group> {
    let mut groups = Vec::new();
    let mut step = 0;
    while step < roles.len() {
        let group = match roles[step] {
            Role::Code { axis, bit, .. } if roles.get(step + 1).copied() == roles[step].opposite() => {
                Group::Pair { step, axis, bit }
            }
            role => match roles[..step].iter().position(|&shown| shown == role) {
                Some(first) => Group::Again { step, first },
                None => Group::Single { step },
            },
        };
        step = group.steps().end;
        groups.push(group);
    }
    groups
}

#[cfg(test)]
mod tests;
