//! When each slide is shown and each exposure starts. Pure: durations in, a timetable out.
//!
//! One frame is under way at a time. Where the camera promises to take a trigger while it reads out
//! ([`Order::Overlapped`]), readout and transfer overlap the latency of the next slide. Seen from a flip:
//!
//! ```text
//! flip    latency      settling    margin  exposure   guard  lead   next flip
//! |-----------------|------------|--|===============|-------|------|
//! |    old light    |   mixture  |       stable light              (latency) ... until the next slide's light
//! |------------------------- hold_refreshes x refresh_period ------|
//!                                                   |--- readout, transfer ---| kept, judged ... next trigger
//! ```
//!
//! The guard is the camera's own latency and twice the tolerance of stamps: no slide is asked for before the exposure of
//! the one before is over for certain, and no exposure begins before the frame before is in hand.
//!
//! Elsewhere ([`Order::OneByOne`]) the readout takes the place of the guard: the frame is in hand before the next slide is
//! asked for, so that an exposure cannot reach into the next picture even where the camera is slower than it says: the
//! scan then takes longer, no more. It is also the plain version that the other order is held against.
//!
//! Judging a pair overlaps the latency of the slide after it.

use std::time::Duration;

use polscan_drivers::{
    camera::CameraInfo,
    clock::Timestamp,
    projector::{PresentReceipt, ProjectorInfo, ReceiptMethod},
};
use serde::{Deserialize, Serialize};

use super::{
    ASSUMED_LATENCY_REFRESHES, ASSUMED_SETTLING, GUESSED_FLIP_REFRESHES, MAX_HOLD_REFRESHES, PlanError,
    PlanOptions,
};

/// Longest time that is planned with, so that sums cannot overflow.
const LONGEST: Duration = Duration::from_secs(3600);

const OVERLAPS: &str =
    "the camera takes a trigger while it reads out, and readout and transfer fit into the hold";
const NOTHING_GAINED: &str =
    "frames arrive so soon that waiting for them costs no more than the guard after an exposure would";
const NO_PROMISE: &str = "the camera does not promise to take a trigger while it reads out";
const FREE_RUNNING: &str = "the camera exposes when it likes, and only a frame in hand says when that was";

/// What comes first, the next flip or the frame of this one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Order {
    /// The next slide is flipped as soon as the exposure is over.
    Overlapped,
    /// The frame is in hand before the next slide is asked for.
    #[default]
    OneByOne,
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
    /// Whether the next slide is flipped while a frame is read out.
    pub order: Order,
    /// Why it is, or is not, in words.
    pub order_reason: &'static str,
    /// Whether the stamps of frames say when exposures really began.
    pub stamped: bool,
    /// From the end of exposure, as computed, until the next slide may be asked for.
    pub guard: Duration,
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
        camera: &CameraInfo,
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
        let refreshes = |busy: Duration| busy.as_nanos().div_ceil(refresh_period.as_nanos()).max(1);
        let one_by_one = refreshes(trigger_delay + exposure + readout + options.submit_lead);
        let overlapped = camera.overlap.filter(|overlap| camera.triggered && overlap.latency <= LONGEST);
        let overlapped = overlapped.map(|overlap| {
            // Receipt and stamp may each be off by the tolerance.
            let guard = overlap.latency + options.stamp_tolerance * 2;
            let shown = refreshes(trigger_delay + exposure + guard + options.submit_lead);
            // The frame is in hand before the next exposure begins.
            let received = refreshes(exposure + guard + readout + margin);
            (Order::Overlapped, guard, shown.max(received))
        });
        let (order, guard, least_hold) = overlapped.filter(|(_, _, hold)| *hold <= one_by_one).unwrap_or((
            Order::OneByOne,
            Duration::ZERO,
            one_by_one,
        ));
        let order_reason = match (order, camera.overlap) {
            (Order::Overlapped, _) => OVERLAPS,
            (Order::OneByOne, Some(_)) if camera.triggered => NOTHING_GAINED,
            (Order::OneByOne, _) if camera.triggered => NO_PROMISE,
            (Order::OneByOne, _) => FREE_RUNNING,
        };
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
            order,
            order_reason,
            stamped: camera.overlap.is_some_and(|overlap| overlap.stamped),
            guard,
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

    /// From when on the next slide may be asked for, as far as an exposure that began at `started` matters.
    pub fn exposed(&self, started: Timestamp) -> Timestamp {
        started + self.exposure + self.guard
    }

    /// When the frame of an exposure that began at `started` counts as lost.
    pub fn frame_deadline(&self, started: Timestamp) -> Timestamp {
        started + self.exposure + self.readout + self.frame_slack
    }

    /// The first moment at which a slide that is flipped at `flip` can change the light. The latency shields the exposure
    /// before it only where it was measured.
    pub fn light_after(&self, flip: Timestamp) -> Timestamp {
        flip + if self.measured { self.latency } else { Duration::ZERO }
    }
}

fn microseconds(what: &'static str, value_us: f64) -> Result<Duration, PlanError> {
    Duration::try_from_secs_f64(value_us * 1e-6)
        .ok()
        .filter(|time| *time <= LONGEST)
        .ok_or_else(|| PlanError::Value { what, value: format!("{value_us} us"), expected: "0 us to 1 h" })
}
