use std::time::Duration;

use polscan_drivers::{
    camera::{CameraInfo, Overlap},
    projector::ProjectorInfo,
};

use super::*;
use crate::sequencer::plan::PlanOptions;

const REFRESH: u64 = 10_000_000;

fn timing() -> Timing {
    timing_with(None)
}

fn timing_with(overlap: Option<Overlap>) -> Timing {
    let projector = ProjectorInfo {
        driver: "test".into(),
        model: "panel".into(),
        serial: "1".into(),
        width: 8,
        height: 8,
        refresh_period: Duration::from_nanos(REFRESH),
        display: None,
        timing: None,
    };
    let camera = CameraInfo {
        driver: "test".into(),
        model: "eye".into(),
        serial: "1".into(),
        sensor_width: 2,
        sensor_height: 1,
        triggered: true,
        overlap,
    };
    let readout_us = if overlap.is_some() { 6000.0 } else { 0.0 };
    Timing::new(&projector, &camera, 2000.0, readout_us, &PlanOptions::default()).unwrap()
}

fn receipt(slide: u32, refresh: u64) -> PresentReceipt {
    PresentReceipt {
        slide: Some(slide),
        flipped: Timestamp(refresh * REFRESH),
        refresh: Some(refresh),
        method: ReceiptMethod::Simulated,
    }
}

fn enter(flips: &mut Flips, receipt: PresentReceipt, asked_refresh: u64) -> Option<&'static str> {
    let asked = Timestamp(asked_refresh * REFRESH);
    flips.enter(&timing(), 3, asked, receipt.flipped, receipt).err().map(|refusal| refusal.reason)
}

#[test]
fn receipts_must_answer_the_slide_and_the_time_that_were_asked_for() {
    let check = |receipt: PresentReceipt| {
        let mut flips = Flips::default();
        assert_eq!(enter(&mut flips, super::tests::receipt(3, 10), 9), None);
        enter(&mut flips, receipt, 13)
    };
    assert_eq!(check(receipt(3, 14)), None);
    assert_eq!(check(receipt(2, 14)), Some("wrong-slide"));
    assert_eq!(check(PresentReceipt { slide: None, ..receipt(3, 14) }), Some("wrong-slide"));
    assert_eq!(check(receipt(3, 10)), Some("stale-receipt"), "the flip before, again");
    assert_eq!(check(receipt(3, 12)), Some("stale-receipt"), "flipped before it was asked for");
    let far = PresentReceipt { flipped: Timestamp(40 * REFRESH), ..receipt(3, 40) };
    let mut flips = Flips::default();
    let now = Timestamp(13 * REFRESH);
    assert!(flips.enter(&timing(), 3, now, now, far).is_err(), "announced 27 refreshes ahead");
    let count = |refresh| PresentReceipt { refresh: Some(refresh), ..receipt(3, 14) };
    assert_eq!(check(count(15)), Some("stale-receipt"), "five refreshes counted in the time of four");
    assert_eq!(check(count(13)), Some("stale-receipt"));
    assert_eq!(check(count(9)), Some("stale-receipt"), "counted backwards");
    assert_eq!(check(PresentReceipt { refresh: None, ..receipt(3, 14) }), None);
}

#[test]
fn the_flip_of_a_wrong_slide_cannot_be_claimed_again() {
    let mut flips = Flips::default();
    assert_eq!(enter(&mut flips, receipt(2, 14), 13), Some("wrong-slide"));
    assert_eq!(enter(&mut flips, receipt(3, 14), 14), Some("stale-receipt"));
    assert_eq!(enter(&mut flips, receipt(3, 15), 14), None);
    // Also where refreshes are not counted.
    let uncounted = PresentReceipt { refresh: None, ..receipt(3, 15) };
    assert_eq!(enter(&mut flips, uncounted, 15), Some("stale-receipt"));
}

#[test]
fn a_refresh_rate_a_little_off_its_nominal_value_is_no_lie() {
    let mut flips = Flips::default();
    assert_eq!(enter(&mut flips, receipt(3, 0), 0), None);
    // 600 refreshes at 59.94 Hz instead of 60 Hz.
    let slower = PresentReceipt { flipped: Timestamp(600 * REFRESH * 1001 / 1000), ..receipt(3, 600) };
    assert_eq!(enter(&mut flips, slower, 599), None);
}

/// A camera and the times of its triggers: trigger `n` at `100 n` ms.
struct Camera {
    exposures: Exposures,
    trigger: u64,
}

impl Camera {
    fn new(one_each: bool) -> Self {
        Self { exposures: Exposures::new(one_each), trigger: 0 }
    }

    fn trigger(&mut self) -> &mut Self {
        self.trigger = self.exposures.triggers();
        self.exposures.trigger();
        self
    }

    fn lose(&mut self) -> &mut Self {
        self.trigger();
        self.exposures.unanswered(true);
        self
    }

    /// Enters a frame with its number, the trigger it answers and the exposure's start after that of the last trigger.
    fn frame(&mut self, frame_id: u64, trigger: u64, offset_ms: i64) -> Option<&'static str> {
        let at = Timestamp(1_000_000_000 + self.trigger * 100_000_000);
        let exposure_start = Timestamp(at.0.saturating_add_signed(offset_ms * 1_000_000));
        let received = exposure_start + Duration::from_millis(8);
        let stamp = FrameStamp { frame_id, trigger, exposure_start, received, device_time_ns: None };
        let window = Window { at, started: at, next_light: None };
        self.exposures.enter(&timing(), window, &stamp).err().map(|refusal| refusal.reason)
    }
}

#[test]
fn frames_are_accepted_in_their_order_and_time() {
    let mut camera = Camera::new(true);
    for number in 0..5 {
        assert_eq!(camera.trigger().frame(number, number, 0), None);
    }
}

#[test]
fn a_lost_frame_explains_a_gap_of_one() {
    let mut camera = Camera::new(true);
    assert_eq!(camera.trigger().frame(0, 0, 0), None);
    assert_eq!(camera.lose().trigger().frame(2, 2, 0), None);
    assert_eq!(
        camera.trigger().frame(4, 3, 0),
        Some("lost-frame"),
        "exposure 3 is missing and nobody noticed"
    );
    assert_eq!(camera.trigger().frame(5, 4, 0), None, "the gap counts once");
}

#[test]
fn a_trigger_that_was_missed_leaves_no_gap() {
    let mut camera = Camera::new(true);
    assert_eq!(camera.lose().lose().trigger().frame(0, 0, 0), None, "a driver that numbers what it sees");
    assert_eq!(camera.trigger().frame(1, 3, 0), None, "one that numbers what it sent");
    assert_eq!(camera.trigger().frame(2, 1, 0), Some("swapped-frames"), "more behind than frames were lost");
    assert_eq!(camera.trigger().frame(3, 9, 0), Some("swapped-frames"), "a trigger that was never sent");
}

#[test]
fn a_late_frame_of_a_lost_trigger_is_told_from_the_awaited_one() {
    let mut camera = Camera::new(true);
    assert_eq!(camera.lose().trigger().frame(0, 0, -100), Some("stale-frame"));
    assert_eq!(camera.frame(1, 1, 0), None);
    assert_eq!(camera.trigger().frame(3, 2, 0), Some("lost-frame"), "the late frame settled the account");
}

#[test]
fn of_two_lost_frames_one_may_come_late_and_the_other_never() {
    let mut camera = Camera::new(true);
    assert_eq!(camera.lose().lose().trigger().frame(0, 0, -200), Some("stale-frame"));
    assert_eq!(camera.frame(2, 2, 0), None);
}

#[test]
fn repeated_and_overtaken_frames_are_told_apart() {
    let mut camera = Camera::new(true);
    assert_eq!(camera.trigger().frame(0, 0, 0), None);
    assert_eq!(camera.trigger().frame(0, 0, -100), Some("duplicate-frame"));
    assert_eq!(camera.frame(1, 1, 0), None);
    assert_eq!(camera.lose().trigger().frame(3, 3, 0), None);
    assert_eq!(camera.trigger().frame(2, 2, -200), Some("swapped-frames"));
    assert_eq!(camera.frame(4, 4, 0), None);
}

#[test]
fn exposures_out_of_their_window_are_refused() {
    let mut camera = Camera::new(true);
    assert_eq!(camera.trigger().frame(0, 0, -2), Some("stale-frame"));
    assert_eq!(camera.trigger().frame(1, 1, -1), None, "within the tolerance");
    assert_eq!(camera.trigger().frame(2, 2, 1), None);
    assert_eq!(camera.trigger().frame(3, 3, 2), Some("late-frame"));
}

#[test]
fn a_free_running_camera_counts_frames_that_nobody_asked_for() {
    let mut camera = Camera::new(false);
    assert_eq!(camera.trigger().frame(17, 0, 5), None);
    assert_eq!(camera.trigger().frame(23, 0, 12), None);
    assert_eq!(camera.trigger().frame(24, 0, -30), Some("stale-frame"));
    assert_eq!(camera.frame(24, 0, 0), Some("duplicate-frame"));
}

#[test]
fn a_stamp_that_was_not_measured_needs_an_arrival_that_excludes_the_next_picture() {
    let overlap = |stamped| Some(Overlap { latency: Duration::from_millis(1), stamped });
    let (at, light) = (Timestamp(500_000_000), Timestamp(510_000_000));
    let window = Window { at, started: at, next_light: Some(light) };
    let arrive = |stamped, after_light_us: u64| {
        let received = light + Duration::from_micros(after_light_us);
        let stamp =
            FrameStamp { frame_id: 0, trigger: 0, exposure_start: at, received, device_time_ns: None };
        let mut exposures = Exposures::new(true);
        exposures.trigger();
        exposures.enter(&timing_with(overlap(stamped)), window, &stamp).err()
    };
    // With a readout of 6 ms an arrival 6 ms after the next light is of an exposure that ended before that.
    assert_eq!(arrive(false, 6000), None);
    let refusal = arrive(false, 6001).unwrap();
    assert_eq!((refusal.reason, refusal.may_come), ("late-frame", false));
    assert_eq!(arrive(true, 60_000), None, "its stamp says when it was exposed");
}
