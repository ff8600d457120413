//! Which frame of a camera that runs by itself shows what was asked for.
//!
//! There is no trigger: a frame answers the request for an exposure from `at` on when even the earliest moment at which
//! its exposure can have begun is not before `at`. The stamp of a frame is at least the start of its exposure and at
//! most the end of its read-out, which takes no longer than the time between frames. A kernel driver may call its
//! stamp the start of exposure, as that of USB cameras always does, and take it of the first packet that arrives, so
//! that this word is not relied on. Cameras that hold back frames in a memory of their own are allowed for by skipping
//! whole frames on top.

use std::{collections::VecDeque, time::Duration};

use crate::clock::Timestamp;

/// Times of a camera that runs by itself.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pace {
    /// How long the sensor is exposed.
    pub exposure: Duration,
    /// Time between two frames.
    pub period: Duration,
    /// Frames to skip beyond those that can have begun too early.
    pub skip: u32,
}

impl Pace {
    /// Least time from the start of exposure that a stamp allows for to the stamp.
    fn before_stamp(&self) -> Duration {
        self.exposure + self.period
    }

    /// Longest time from the end of exposure that was asked for until its frame has arrived.
    pub fn longest_wait(&self) -> Duration {
        // The one under way, the one that its stamp cannot prove, those skipped, and the one that is taken.
        self.period * (self.skip + 4)
    }
}

/// What is known of a frame when it arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// The driver's number, which wraps.
    pub sequence: u32,
    /// Its stamp, on the rig's clock.
    pub stamp: Timestamp,
    /// Whether it is whole.
    pub whole: bool,
}

/// What becomes of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nobody asked for it.
    Unwanted,
    /// It would have been taken if it were whole.
    Damaged,
    /// Its stamp lies before that of the frame before it.
    ClockWentBack,
    /// It is what was asked for.
    Answer {
        /// Request that it answers, from 0.
        trigger: u64,
        /// Number of the frame since the start, those that were lost counted.
        frame: u64,
        /// Earliest moment at which its exposure can have begun.
        earliest_start: Timestamp,
    },
}

#[derive(Debug, Clone, Copy)]
struct Wanted {
    trigger: u64,
    at: Timestamp,
    skip: u32,
}

/// Requests and frames so far.
#[derive(Debug, Clone)]
pub struct Choice {
    pace: Pace,
    wanted: VecDeque<Wanted>,
    last: Option<Seen>,
    next_frame: u64,
    /// Requests made.
    pub triggers: u64,
    /// Frames that were given out.
    pub answered: u64,
    /// Numbers that the driver left out.
    pub lost: u64,
    /// Frames that were not whole, asked for or not.
    pub damaged: u64,
    /// Frames that nobody asked for.
    pub unwanted: u64,
}

impl Choice {
    /// Nothing asked for, nothing seen.
    pub fn new(pace: Pace) -> Self {
        Self {
            pace,
            wanted: VecDeque::new(),
            last: None,
            next_frame: 0,
            triggers: 0,
            answered: 0,
            lost: 0,
            damaged: 0,
            unwanted: 0,
        }
    }

    /// Asks for a frame that was exposed wholly after `at`.
    pub fn want(&mut self, at: Timestamp) {
        self.wanted.push_back(Wanted { trigger: self.triggers, at, skip: self.pace.skip });
        self.triggers += 1;
    }

    /// Judges the next frame.
    pub fn enter(&mut self, seen: Seen) -> Verdict {
        let before = self.last.replace(seen);
        let gap = before.map_or(0, |last| seen.sequence.wrapping_sub(last.sequence).wrapping_sub(1));
        // A number that came again or went back is no gap of billions.
        let gap = if gap < u32::MAX / 2 { u64::from(gap) } else { 0 };
        self.lost += gap;
        let frame = self.next_frame + gap;
        self.next_frame = frame + 1;
        if !seen.whole {
            self.damaged += 1;
        }
        if before.is_some_and(|last| seen.stamp < last.stamp) {
            return Verdict::ClockWentBack;
        }
        let earliest_start =
            Timestamp(seen.stamp.0.saturating_sub(self.pace.before_stamp().as_nanos() as u64));
        let Some(first) = self.wanted.front_mut().filter(|wanted| earliest_start >= wanted.at) else {
            self.unwanted += 1;
            return Verdict::Unwanted;
        };
        if first.skip > 0 {
            first.skip -= 1;
            self.unwanted += 1;
            return Verdict::Unwanted;
        }
        if !seen.whole {
            return Verdict::Damaged;
        }
        let trigger = first.trigger;
        self.wanted.pop_front();
        self.answered += 1;
        Verdict::Answer { trigger, frame, earliest_start }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A frame as the sensor knows it, in microseconds.
    #[derive(Debug, Clone, Copy)]
    struct Shot {
        start: u64,
        stamp: u64,
        whole: bool,
        lost: bool,
    }

    /// A camera that stamps somewhere between start of exposure and end of read-out.
    fn shots() -> impl Strategy<Value = (u64, u64, Vec<Shot>)> {
        let one = (0.0..=1.0f64, prop::bool::weighted(0.1), prop::bool::weighted(0.1));
        (1_000..30_000u64, 0.05..1.0f64, 0..50_000u64, prop::collection::vec(one, 1..60)).prop_map(
            |(period, share, first, shots)| {
                let exposure = (period as f64 * share) as u64;
                let shots = shots.iter().enumerate().map(|(n, &(within, damaged, lost))| {
                    let start = first + n as u64 * period;
                    let stamp = start + (within * (exposure + period) as f64) as u64;
                    Shot { start, stamp, whole: !damaged, lost }
                });
                (period, exposure, shots.collect())
            },
        )
    }

    fn us(us: u64) -> Timestamp {
        Timestamp(1000 * us)
    }

    proptest! {
        /// Against the sensor's own knowledge: no answer was exposed before it was asked for, each whole frame that
        /// can be proven to be late enough is taken, and each request has one answer.
        #[test]
        fn an_answer_was_exposed_wholly_after_the_picture_was_stable(
            (period, exposure, shots) in shots(), asked in prop::collection::vec(0..1_500_000u64, 1..5), skip in 0..3u32,
            first_sequence: u32,
        ) {
            let mut asked = asked;
            asked.sort_unstable();
            let micros = Duration::from_micros;
            let mut choice = Choice::new(Pace { exposure: micros(exposure), period: micros(period), skip });
            asked.iter().for_each(|&at| choice.want(us(at)));

            // The oracle goes over the list for each request anew.
            let mut expected = Vec::new();
            let mut from = 0;
            let ordered = |n: usize| shots[..n].iter().rfind(|shot| !shot.lost).is_none_or(|before| shots[n].stamp >= before.stamp);
            for (trigger, &at) in asked.iter().enumerate() {
                let late = |&n: &usize| {
                    !shots[n].lost && ordered(n) && shots[n].stamp.saturating_sub(exposure + period) >= at
                };
                let candidates: Vec<usize> = (from..shots.len()).filter(late).collect();
                match candidates.iter().skip(skip as usize).find(|&&n| shots[n].whole) {
                    Some(&n) => {
                        expected.push((trigger as u64, n));
                        from = n + 1;
                    }
                    None => break,
                }
            }

            let mut answers = Vec::new();
            let mut first_seen = None;
            for (n, shot) in shots.iter().enumerate().filter(|(_, shot)| !shot.lost) {
                let sequence = first_sequence.wrapping_add(n as u32);
                let first = *first_seen.get_or_insert(n);
                let seen = Seen { sequence, stamp: us(shot.stamp), whole: shot.whole };
                if let Verdict::Answer { trigger, frame, earliest_start } = choice.enter(seen) {
                    prop_assert!(us(shot.start) >= us(asked[trigger as usize]), "{shot:?}");
                    prop_assert!(earliest_start <= us(shot.start) && earliest_start >= us(asked[trigger as usize]));
                    prop_assert_eq!(frame, (n - first) as u64, "numbers count what was lost");
                    answers.push((trigger, n));
                }
            }
            prop_assert_eq!(answers, expected);
        }
    }

    const MS: Duration = Duration::from_millis(1);

    fn seen(sequence: u32, ms: u64) -> Seen {
        Seen { sequence, stamp: us(1000 * ms), whole: true }
    }

    #[test]
    fn a_damaged_frame_is_followed_by_the_next_whole_one() {
        let mut choice = Choice::new(Pace { exposure: 2 * MS, period: 10 * MS, skip: 0 });
        choice.want(us(0));
        assert_eq!(choice.enter(Seen { whole: false, ..seen(0, 20) }), Verdict::Damaged);
        assert!(matches!(choice.enter(seen(1, 30)), Verdict::Answer { trigger: 0, frame: 1, .. }));
        assert_eq!((choice.damaged, choice.answered, choice.lost), (1, 1, 0));
    }

    #[test]
    fn a_clock_that_goes_back_proves_nothing() {
        let mut choice = Choice::new(Pace { exposure: 2 * MS, period: 10 * MS, skip: 0 });
        assert_eq!(choice.enter(seen(0, 100)), Verdict::Unwanted);
        choice.want(us(0));
        assert_eq!(choice.enter(seen(1, 90)), Verdict::ClockWentBack);
        assert!(matches!(choice.enter(seen(2, 110)), Verdict::Answer { .. }));
    }

    #[test]
    fn a_number_that_repeats_or_starts_over_is_no_gap() {
        let mut choice = Choice::new(Pace { exposure: 2 * MS, period: 10 * MS, skip: 0 });
        for (n, sequence) in [7, 7, 3, u32::MAX, 0, 2].into_iter().enumerate() {
            choice.enter(seen(sequence, 10 * n as u64));
        }
        assert_eq!(choice.lost, 1, "only 1 is missing, before 2");
    }
}
