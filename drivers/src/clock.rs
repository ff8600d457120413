//! Time as devices and the sequencer see it: monotonic, and virtual where nothing real has to be waited for.

use std::{
    fmt,
    ops::{Add, Sub},
    sync::Mutex,
    time::{Duration, Instant},
};

use serde::{Deserialize, Serialize};

/// Monotonic time in nanoseconds since the clock's own start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Default, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Timestamp(pub u64);

impl Timestamp {
    /// Seconds since the clock's start.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Time since `earlier`, zero if it lies in the future.
    pub fn since(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }
}

impl Add<Duration> for Timestamp {
    type Output = Self;

    fn add(self, later: Duration) -> Self {
        Self(self.0 + later.as_nanos() as u64)
    }
}

impl Sub for Timestamp {
    type Output = Duration;

    fn sub(self, earlier: Self) -> Duration {
        self.since(earlier)
    }
}

impl fmt::Display for Timestamp {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.6} s", self.seconds())
    }
}

/// Source of time and the only way to wait. All devices of a rig and its sequencer share one clock.
pub trait Clock: Send + Sync + fmt::Debug {
    /// Current time.
    fn now(&self) -> Timestamp;

    /// Returns at `deadline`, at once if it has passed.
    fn sleep_until(&self, deadline: Timestamp);
}

/// The machine's monotonic clock.
#[derive(Debug)]
pub struct MonotonicClock {
    start: Instant,
}

impl MonotonicClock {
    /// A clock that starts now.
    pub fn start() -> Self {
        Self { start: Instant::now() }
    }
}

impl Clock for MonotonicClock {
    fn now(&self) -> Timestamp {
        Timestamp(self.start.elapsed().as_nanos() as u64)
    }

    fn sleep_until(&self, deadline: Timestamp) {
        std::thread::sleep(deadline.since(self.now()));
    }
}

/// A clock that jumps to each deadline: a simulated rig runs as fast as it can be computed, on the same timeline.
#[derive(Debug, Default)]
pub struct VirtualClock {
    now: Mutex<Timestamp>,
}

impl Clock for VirtualClock {
    fn now(&self) -> Timestamp {
        *self.now.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }

    fn sleep_until(&self, deadline: Timestamp) {
        let mut now = self.now.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        *now = (*now).max(deadline);
    }
}
