//! What to do about a camera that went away: try again, ever more slowly, then more roughly, then ask for a hand.

use std::time::Duration;

use crate::clock::Timestamp;

/// Pauses before the camera is opened again, one for each failure in a row.
const BACKOFF: [Duration; 5] = [
    Duration::from_millis(500),
    Duration::from_secs(1),
    Duration::from_secs(2),
    Duration::from_secs(5),
    Duration::from_secs(10),
];

/// How long a camera takes to come back after a reset.
const RESET_PAUSE: Duration = Duration::from_secs(10);

/// Tries after a reset until a person is asked for help.
const TRIES_AFTER_RESET: u32 = 2;

/// What was seen of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Event {
    /// It stopped answering while it was open.
    Lost,
    /// It is there and could not be opened or reset.
    OpenFailed,
    /// It was told to reset itself.
    Reset,
    /// It delivered a whole frame: all is well.
    Delivered,
}

/// What is to be done when the camera is wanted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// Open it.
    Open,
    /// Nothing before this time.
    Wait(Timestamp),
    /// Open it, tell it to reset itself and close it.
    Reset,
    /// Open it, and if that fails tell a person to unplug it: all else was tried.
    LastResort,
}

/// Where one camera stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Ladder {
    failures: u32,
    /// Failures before the reset, where there was one.
    reset_after: Option<u32>,
    not_before: Timestamp,
}

impl Ladder {
    /// What to do at `now`.
    pub fn next(&self, now: Timestamp) -> Action {
        if now < self.not_before {
            return Action::Wait(self.not_before);
        }
        match self.reset_after {
            None if self.failures as usize > BACKOFF.len() => Action::Reset,
            Some(before) if self.failures >= before + TRIES_AFTER_RESET => Action::LastResort,
            _ => Action::Open,
        }
    }

    /// Enters what was seen at `now`.
    pub fn enter(&mut self, now: Timestamp, event: Event) {
        match event {
            Event::Delivered => *self = Self::default(),
            Event::Reset => {
                self.reset_after.get_or_insert(self.failures);
                self.not_before = now + RESET_PAUSE;
            }
            Event::Lost | Event::OpenFailed => {
                // A camera that cannot be opened cannot be told to reset itself either.
                if self.next(now) == Action::Reset {
                    self.reset_after = Some(self.failures);
                }
                let pause = BACKOFF[(self.failures as usize).min(BACKOFF.len() - 1)];
                self.failures = self.failures.saturating_add(1);
                self.not_before = now + pause;
            }
        }
    }

    /// Failures in a row.
    pub fn failures(&self) -> u32 {
        self.failures
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn s(seconds: f64) -> Timestamp {
        Timestamp((seconds * 1e9) as u64)
    }

    /// Does what the ladder says on a camera that never opens, until it gives up; what was done after how many ms.
    fn climb(resets: bool) -> Vec<(u128, Action)> {
        let mut ladder = Ladder::default();
        let mut now = s(100.0);
        ladder.enter(now, Event::Lost);
        let mut done = vec![];
        while done.len() < 12 {
            let action = ladder.next(now);
            if let Action::Wait(until) = action {
                assert!(until > now);
                now = until;
                continue;
            }
            done.push((now.since(s(100.0)).as_millis(), action));
            match action {
                Action::Reset if resets => ladder.enter(now, Event::Reset),
                _ => ladder.enter(now, Event::OpenFailed),
            }
        }
        done
    }

    #[test]
    fn a_camera_is_tried_ever_more_slowly_then_reset_then_given_to_a_person() {
        let opens = [500, 1500, 3500, 8500, 18_500].map(|at| (at, Action::Open));
        let done = climb(true);
        assert_eq!(done[..5], opens);
        assert_eq!(done[5], (28_500, Action::Reset));
        assert_eq!(done[6..8], [(38_500, Action::Open), (48_500, Action::Open)]);
        assert!(done[8..].iter().all(|(_, action)| *action == Action::LastResort), "{done:?}");
        // It is tried for ever: whoever comes with a hand need not restart anything.
        assert_eq!(done[11].0 - done[10].0, 10_000);
    }

    #[test]
    fn a_reset_that_fails_is_not_tried_again() {
        let done = climb(false);
        assert_eq!(done.iter().filter(|(_, action)| *action == Action::Reset).count(), 1);
        assert_eq!(done.last().map(|(_, action)| *action), Some(Action::LastResort));
    }

    #[test]
    fn a_whole_frame_ends_all_trouble_and_a_second_loss_does_not() {
        let mut ladder = Ladder::default();
        assert_eq!(ladder.next(s(0.0)), Action::Open);
        ladder.enter(s(1.0), Event::Lost);
        assert_eq!(ladder.next(s(1.2)), Action::Wait(s(1.5)));
        assert_eq!(ladder.next(s(1.5)), Action::Open);
        // Opened, and lost again before anything came.
        ladder.enter(s(2.0), Event::Lost);
        assert_eq!(ladder.next(s(2.9)), Action::Wait(s(3.0)));
        assert_eq!(ladder.failures(), 2);
        ladder.enter(s(4.0), Event::Delivered);
        assert_eq!(ladder, Ladder::default());
    }
}
