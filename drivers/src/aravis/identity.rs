//! Which exposure a buffer is: numbers of frames, and the triggers that they answer.

use std::{collections::VecDeque, time::Duration};

use crate::clock::Timestamp;

/// Numbers of a 16-bit counter: 1 to 65535, 0 is none.
const SHORT_CYCLE: u64 = 65535;

/// Turns the numbers that a camera gives its frames into numbers since arming.
#[derive(Debug, Clone)]
pub struct FrameIds {
    short: bool,
    /// Number of the camera and number since arming of the latest frame.
    latest: Option<(u64, u64)>,
}

impl FrameIds {
    /// For a camera whose counter has 16 bits (`short`, GigE Vision up to 1.2), or 64.
    pub fn new(short: bool) -> Self {
        Self { short, latest: None }
    }

    /// Number since arming of the frame that the camera calls `raw`: the first to come is 0, one that was lost leaves a
    /// gap, one that comes late gets the number that was left for it.
    pub fn enter(&mut self, raw: u64) -> u64 {
        let Some((last_raw, last)) = self.latest else {
            self.latest = Some((raw, 0));
            return 0;
        };
        // A newer camera counts with 64 bits over the same protocol.
        self.short &= raw <= SHORT_CYCLE;
        let number = if self.short {
            let ahead = (raw + SHORT_CYCLE - last_raw) % SHORT_CYCLE;
            if ahead <= SHORT_CYCLE / 2 { last + ahead } else { last.saturating_sub(SHORT_CYCLE - ahead) }
        } else if raw >= last_raw {
            last + (raw - last_raw)
        } else {
            last.saturating_sub(last_raw - raw)
        };
        if number >= last {
            self.latest = Some((raw, number));
        }
        number
    }
}

/// Triggers that have not been answered, and which of them a frame answers.
///
/// The camera's own clock decides where it can: a trigger that the camera missed must not shift all later answers by
/// one.
#[derive(Debug, Clone)]
pub struct Pairing {
    /// A first frame that comes this long after its trigger is believed to answer a later one.
    first_answer: Duration,
    pending: VecDeque<(u64, Timestamp)>,
    sent: u64,
    /// Least difference between the camera's clock at a frame and the rig's clock at its trigger.
    offset_ns: Option<i128>,
    latest: (u64, Timestamp),
}

impl Pairing {
    /// Of a camera whose frames are here `first_answer` after their triggers at the latest.
    pub fn new(first_answer: Duration) -> Self {
        Self { first_answer, pending: VecDeque::new(), sent: 0, offset_ns: None, latest: (0, Timestamp(0)) }
    }

    /// A trigger for `start` was sent.
    pub fn sent(&mut self, start: Timestamp) {
        self.pending.push_back((self.sent, start));
        self.sent += 1;
    }

    /// Triggers sent so far.
    pub fn count(&self) -> u64 {
        self.sent
    }

    /// Number and start of the trigger that a frame answers which the camera stamped with `device_ns` and which was
    /// here at `received`. A frame without a trigger of its own is given the latest answered one, which exposes it.
    pub fn answer(&mut self, device_ns: Option<u64>, received: Timestamp) -> (u64, Timestamp) {
        let possible = self.pending.iter().take_while(|(_, start)| *start <= received).count();
        let device = device_ns.map(i128::from);
        let chosen = match (device, self.offset_ns) {
            _ if possible == 0 => return self.latest,
            (Some(device), Some(offset)) => {
                let expected = device - offset;
                let distance = |index: &usize| (i128::from(self.pending[*index].1.0) - expected).abs();
                (0..possible).min_by_key(distance).unwrap_or(0)
            }
            _ => (0..possible - 1)
                .take_while(|&index| received.since(self.pending[index].1) > self.first_answer)
                .count(),
        };
        self.latest = self.pending.drain(..=chosen).next_back().unwrap_or(self.latest);
        if let Some(device) = device {
            let offset = device - i128::from(self.latest.1.0);
            self.offset_ns = Some(self.offset_ns.map_or(offset, |before| before.min(offset)));
        }
        self.latest
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        /// Against a camera that counts for ever and shows only the short number.
        #[test]
        fn short_numbers_are_unrolled_over_gaps_and_the_wrap(
            first in 0u64..70_000, gaps in prop::collection::vec(1u64..30_000, 1..40),
        ) {
            let short = |count: u64| count % SHORT_CYCLE + 1;
            let mut ids = FrameIds::new(true);
            prop_assert_eq!(ids.enter(short(first)), 0);
            let mut count = first;
            for gap in gaps {
                count += gap;
                prop_assert_eq!(ids.enter(short(count)), count - first);
            }
        }
    }

    #[test]
    fn repeated_and_late_frames_keep_their_numbers() {
        for (short, start) in [(true, 65533), (false, 65533), (false, 1 << 40)] {
            let mut ids = FrameIds::new(short);
            let raw = |ahead: u64| if short { (start - 1 + ahead) % SHORT_CYCLE + 1 } else { start + ahead };
            let found: Vec<u64> = [0, 1, 4, 4, 3, 5].into_iter().map(|ahead| ids.enter(raw(ahead))).collect();
            assert_eq!(found, [0, 1, 4, 4, 3, 5], "{short}");
        }
        let mut wide = FrameIds::new(true);
        assert_eq!(
            [65534, 65535, 65536, 65537].map(|raw| wide.enter(raw)),
            [0, 1, 2, 3],
            "64 bits over GigE"
        );
    }

    fn ms(ms: u64) -> Timestamp {
        Timestamp(ms * 1_000_000)
    }

    const ANSWER: Duration = Duration::from_millis(240);

    const CAMERA_STARTED_NS: u64 = 77_000_000_000;

    fn device(ms: u64) -> Option<u64> {
        Some(CAMERA_STARTED_NS + ms * 1_000_000)
    }

    #[test]
    fn a_missed_trigger_does_not_shift_the_later_answers() {
        let mut pairing = Pairing::new(ANSWER);
        for start in [100, 200, 300] {
            pairing.sent(ms(start));
        }
        assert_eq!(pairing.answer(device(101), ms(120)), (0, ms(100)));
        // The second is missed.
        assert_eq!(pairing.answer(device(302), ms(320)), (2, ms(300)));
        pairing.sent(ms(400));
        assert_eq!(pairing.answer(device(401), ms(420)), (3, ms(400)));
        // Nobody asked for this one.
        assert_eq!(pairing.answer(device(450), ms(470)), (3, ms(400)));
        assert_eq!(pairing.count(), 4);
    }

    #[test]
    fn without_a_device_clock_answers_come_in_order() {
        let mut pairing = Pairing::new(ANSWER);
        for start in [100, 200, 9000] {
            pairing.sent(ms(start));
        }
        // Frames do not answer triggers that are still to come.
        assert_eq!(pairing.answer(None, ms(120)), (0, ms(100)));
        assert_eq!(pairing.answer(None, ms(220)), (1, ms(200)));
        assert_eq!(pairing.answer(None, ms(230)), (1, ms(200)));
        assert_eq!(pairing.answer(None, ms(9010)), (2, ms(9000)));
    }

    #[test]
    fn a_first_trigger_that_nothing_answered_for_long_is_given_up() {
        let mut pairing = Pairing::new(ANSWER);
        pairing.sent(ms(100));
        pairing.sent(ms(450));
        assert_eq!(pairing.answer(device(451), ms(470)), (1, ms(450)));
        pairing.sent(ms(800));
        assert_eq!(pairing.answer(device(801), ms(820)), (2, ms(800)));
    }
}
