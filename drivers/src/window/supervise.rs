//! When the process with the window may be started again. Takes the time, gives an answer, does nothing.

use std::time::Duration;

use crate::clock::Timestamp;

/// Pauses before the next start after so many failures in a row. The first is none: what ran well for long and ended
/// once is started again where it is needed.
const PAUSES: [Duration; 6] = [
    Duration::ZERO,
    Duration::from_millis(500),
    Duration::from_secs(1),
    Duration::from_secs(2),
    Duration::from_secs(5),
    Duration::from_secs(10),
];

/// A process that ran for so long had started well.
const HEALTHY: Duration = Duration::from_secs(10);

/// What is known of the process with the window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Supervisor {
    /// When it said hello, while it runs.
    ready: Option<Timestamp>,
    /// Ends since it last ran well.
    failures: usize,
    /// When it may be started.
    not_before: Timestamp,
    /// How often it ended.
    ended: u32,
}

impl Supervisor {
    /// How long to wait before it may be started; zero means now.
    pub fn wait(&self, now: Timestamp) -> Duration {
        self.not_before.since(now)
    }

    /// It said hello.
    pub fn ready(&mut self, now: Timestamp) {
        self.ready = Some(now);
    }

    /// It ended, was ended because it did not answer, or could not be started.
    pub fn ended(&mut self, now: Timestamp) {
        if self.ready.take().is_some_and(|ready| now.since(ready) >= HEALTHY) {
            self.failures = 0;
        }
        self.not_before = now + PAUSES[self.failures.min(PAUSES.len() - 1)];
        self.failures += 1;
        self.ended += 1;
    }

    /// How often it ended.
    pub fn ends(&self) -> u32 {
        self.ended
    }
}

#[cfg(test)]
mod tests {
    use proptest::{collection::vec, prelude::*};

    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn a_process_that_never_starts_is_tried_ever_more_rarely() {
        let mut supervisor = Supervisor::default();
        let mut now = Timestamp(5);
        let mut waited = Vec::new();
        for _ in 0..8 {
            let wait = supervisor.wait(now);
            waited.push(wait.as_millis());
            now = now + wait;
            // As long as the wait for a hello that does not come.
            now = now + SECOND;
            supervisor.ended(now);
        }
        assert_eq!(waited, [0, 0, 500, 1000, 2000, 5000, 10_000, 10_000]);
        assert_eq!(supervisor.ends(), 8);
    }

    #[test]
    fn one_that_ran_well_is_started_at_once() {
        let mut supervisor = Supervisor::default();
        let mut now = Timestamp(0);
        for _ in 0..5 {
            supervisor.ended(now);
        }
        assert_eq!(supervisor.wait(now), 5 * SECOND);
        supervisor.ready(now);
        now = now + HEALTHY;
        supervisor.ended(now);
        assert_eq!(supervisor.wait(now), Duration::ZERO);
    }

    #[test]
    fn one_that_says_hello_and_ends_is_not_started_at_once_for_ever() {
        let mut supervisor = Supervisor::default();
        let mut now = Timestamp(0);
        for _ in 0..4 {
            now = now + supervisor.wait(now);
            supervisor.ready(now);
            now = now + HEALTHY / 2;
            supervisor.ended(now);
        }
        assert_eq!(supervisor.wait(now), 2 * SECOND);
    }

    proptest! {
        /// Whatever happens: no start is put off for more than the longest pause, and in any minute there are only so
        /// many starts of processes that never got well.
        #[test]
        fn starts_are_bounded(lives in vec((0u64..20_000, any::<bool>()), 1..60)) {
            let mut supervisor = Supervisor::default();
            let mut now = Timestamp(0);
            let mut starts: Vec<Timestamp> = Vec::new();
            for (ms, hello) in lives {
                let wait = supervisor.wait(now);
                prop_assert!(wait <= *PAUSES.last().expect("pauses"));
                now = now + wait;
                starts.push(now);
                let well = hello && ms >= 10_000;
                if hello {
                    supervisor.ready(now);
                }
                now = now + Duration::from_millis(ms);
                supervisor.ended(now);
                if well {
                    starts.clear();
                }
                let recent = starts.iter().filter(|&&start| now.since(start) <= 60 * SECOND).count();
                prop_assert!(recent <= 12, "{recent} starts within a minute");
            }
        }
    }
}
