//! What a capture does, known before its first flip. Pure: what the devices say of themselves in, a plan out.

mod timing;

use std::time::Duration;

use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, Schedule},
    projector::ProjectorInfo,
};
use polscan_patterns::{Axis, Polarization, PolarizationError, ProjectorSize, Role, Sequence};
use thiserror::Error;

pub use timing::{Order, Timing};

/// Refreshes from flip to first light that are assumed of an unmeasured projector: signal processing of common
/// projectors takes one to three.
pub const ASSUMED_LATENCY_REFRESHES: u32 = 3;

/// Settling that is assumed of an unmeasured projector, besides the refresh that scan-out takes from top to bottom.
pub const ASSUMED_SETTLING: Duration = Duration::from_millis(20);

/// Refreshes by which a flip may follow a receipt that was only [guessed](polscan_drivers::projector::ReceiptMethod::Guessed): a swapchain holds
/// that many pictures back.
pub const GUESSED_FLIP_REFRESHES: u32 = 2;

/// Most refreshes that a slide may be held: two minutes at 60 Hz.
pub const MAX_HOLD_REFRESHES: u32 = 7200;

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
    /// The configured hold is shorter than delay, exposure and what must follow.
    #[error(
        "a hold of {hold} refreshes is too short: delay, exposure and what follows need {needed}; raise it, or leave it out"
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
        camera: &CameraInfo,
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
        let (exposure_us, readout_us) = (applied.settings.exposure_us, applied.readout_us);
        let timing = Timing::new(projector, camera, exposure_us, readout_us, options)?;
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

    /// What is asked of the devices where nothing is repeated.
    pub fn schedule(&self) -> Schedule {
        Schedule {
            slides: self.sequence.roles.len(),
            hold_refreshes: self.timing.hold_refreshes,
            trigger_delay: self.timing.trigger_delay,
        }
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
