use super::*;
use polscan_drivers::{
    camera::{CameraSettings, Overlap, PixelFormat, TriggerSource},
    clock::Timestamp,
    projector::ProjectorTiming,
};
use polscan_patterns::{ChannelSet, Mode};
use proptest::prelude::*;

fn ms(value: f64) -> Duration {
    Duration::from_secs_f64(value * 1e-3)
}

fn projector(period: Duration, timing: Option<(Duration, Duration)>) -> ProjectorInfo {
    ProjectorInfo {
        driver: "test".into(),
        model: "panel".into(),
        serial: "1".into(),
        width: 1024,
        height: 768,
        refresh_period: period,
        display: None,
        timing: timing.map(|(latency, settling)| ProjectorTiming { latency, settling }),
    }
}

fn hz60(timing: Option<(f64, f64)>) -> ProjectorInfo {
    projector(Duration::from_nanos(16_666_667), timing.map(|(latency, settling)| (ms(latency), ms(settling))))
}

fn camera(overlap: Option<Overlap>) -> CameraInfo {
    CameraInfo {
        driver: "test".into(),
        model: "eye".into(),
        serial: "1".into(),
        sensor_width: 2,
        sensor_height: 1,
        triggered: true,
        overlap,
    }
}

/// A camera that waits for nobody.
fn overlapping() -> CameraInfo {
    camera(Some(Overlap { latency: Duration::ZERO, stamped: true }))
}

fn applied(exposure_us: f64, readout_us: f64) -> AppliedSettings {
    AppliedSettings {
        settings: CameraSettings {
            exposure_us,
            gain_db: 0.0,
            gamma: 1.0,
            region: None,
            format: PixelFormat::Mono12,
            trigger: TriggerSource::Software,
        },
        width: 16,
        height: 12,
        black_level_dn: None,
        saturation_dn: 4095,
        readout_us,
        noise: None,
    }
}

fn sequence(mode: Mode) -> Sequence {
    Sequence::new(mode, ProjectorSize { width: 1024, height: 768 }).unwrap()
}

fn plan(mode: Mode, projector: &ProjectorInfo, options: &PlanOptions) -> Result<Plan, PlanError> {
    let polarization = Polarization::green_horizontal();
    Plan::new(sequence(mode), polarization, projector, &overlapping(), applied(2000.0, 6100.0), options)
}

#[test]
fn the_paper_s_rig_holds_each_slide_for_four_refreshes() {
    // Latency 2 refreshes; a 10-90 % time of 6 ms settles to 0.1 % in 6 ms x ln(1000) / ln(9) = 18.9 ms.
    let plan = plan(Mode::Pse, &hz60(Some((33.3, 18.9))), &PlanOptions::default()).unwrap();
    assert_eq!(plan.timing.trigger_delay, ms(53.2));
    assert_eq!(plan.timing.hold_refreshes, 4);
    assert!((plan.limit().as_secs_f64() - 44.0 * 4.0 / 60.0).abs() < 1e-6);
    // The first flip to the last frame: one hold less, and the last frame's own way.
    let expected = 43.0 * 4.0 / 60.0 + 0.0532 + 0.002 + 0.0061;
    assert!((plan.expected().as_secs_f64() - expected).abs() < 1e-6);
    assert!(plan.timing.measured);
}

#[test]
fn an_unmeasured_projector_gets_conservative_times() {
    let timing = plan(Mode::Fast, &hz60(None), &PlanOptions::default()).unwrap().timing;
    assert!(!timing.measured);
    assert!((timing.latency.as_secs_f64() - 0.050).abs() < 1e-6);
    assert!((timing.settling.as_secs_f64() - 0.036_667).abs() < 1e-6);
    assert_eq!(timing.hold_refreshes, 6);
    // Its latency protects nothing.
    assert_eq!(timing.light_after(Timestamp(7)), Timestamp(7));
}

#[test]
fn overrides_are_honoured_where_they_are_safe() {
    let rig = hz60(Some((33.3, 18.9)));
    let hold = |hold| PlanOptions { hold_refreshes: Some(hold), ..PlanOptions::default() };
    assert_eq!(plan(Mode::Pse, &rig, &hold(9)).unwrap().timing.hold_refreshes, 9);
    assert_eq!(plan(Mode::Pse, &rig, &hold(3)), Err(PlanError::ShortHold { hold: 3, needed: 4 }));
    assert_eq!(plan(Mode::Pse, &rig, &hold(0)), Err(PlanError::ShortHold { hold: 0, needed: 4 }));
    assert!(matches!(plan(Mode::Pse, &rig, &hold(7201)), Err(PlanError::Value { what: "a hold", .. })));
    let delay = |delay| PlanOptions { trigger_delay: Some(ms(delay)), ..PlanOptions::default() };
    let later = plan(Mode::Pse, &rig, &delay(70.0)).unwrap().timing;
    assert_eq!((later.trigger_delay, later.hold_refreshes), (ms(70.0), 5));
    let refusal = plan(Mode::Pse, &rig, &delay(53.0)).unwrap_err();
    assert_eq!(refusal, PlanError::EarlyTrigger { delay: ms(53.0), needed: ms(53.2) });
    // Nothing is known of an unmeasured projector but what the user says.
    assert_eq!(plan(Mode::Pse, &hz60(None), &delay(20.0)).unwrap().timing.trigger_delay, ms(20.0));
}

#[test]
fn impossible_plans_are_refused_by_name() {
    let options = PlanOptions::default();
    let new = |projector: &ProjectorInfo, exposure, readout, options: &PlanOptions| {
        let polarization = Polarization::green_horizontal();
        Plan::new(
            sequence(Mode::Pse),
            polarization,
            projector,
            &camera(None),
            applied(exposure, readout),
            options,
        )
        .unwrap_err()
        .to_string()
    };
    let rig = hz60(None);
    assert!(new(&rig, 0.0, 0.0, &options).starts_with("an exposure of 0 us"));
    for bad in [-1.0, f64::NAN, f64::INFINITY, 1e300] {
        assert!(new(&rig, bad, 0.0, &options).starts_with("an exposure of"), "{bad}");
        assert!(new(&rig, 2000.0, bad, &options).starts_with("a readout of"), "{bad}");
    }
    assert!(new(&projector(Duration::ZERO, None), 2e3, 0.0, &options).starts_with("a refresh period of 0ns"));
    assert!(new(&projector(Duration::MAX, None), 2e3, 0.0, &options).starts_with("a refresh period"));
    let endless = Some((Duration::MAX, Duration::ZERO));
    assert!(new(&projector(ms(16.0), endless), 2e3, 0.0, &options).starts_with("a latency"));
    let slack = PlanOptions { frame_slack: Duration::MAX, ..options };
    assert!(new(&rig, 2e3, 0.0, &slack).starts_with("a frame slack"));
    let small = ProjectorInfo { width: 800, height: 600, ..hz60(None) };
    assert!(new(&small, 2e3, 0.0, &options).contains("1024x768 px but panel has 800x600"));
    let none = ChannelSet { red: false, green: false, blue: false };
    let dark = Polarization { vertical: none, ..Polarization::green_horizontal() };
    let refused = |mode| Plan::new(sequence(mode), dark, &rig, &camera(None), applied(2e3, 0.0), &options);
    assert!(matches!(refused(Mode::Pse), Err(PlanError::Polarization(_))));
    assert!(refused(Mode::Gray).is_ok());
}

#[test]
fn steps_are_grouped_with_references_first() {
    let grouped = |mode| plan(mode, &hz60(None), &PlanOptions::default()).unwrap().groups;
    let pse = grouped(Mode::Pse);
    assert_eq!(pse.len(), 2 + 20 + 2);
    assert_eq!(pse[..2], [Group::Single { step: 0 }, Group::Single { step: 1 }]);
    assert_eq!(pse[2], Group::Pair { step: 2, axis: Axis::Column, bit: 0 });
    assert_eq!(pse[21], Group::Pair { step: 40, axis: Axis::Row, bit: 9 });
    assert_eq!(pse[22..], [Group::Again { step: 42, first: 0 }, Group::Again { step: 43, first: 1 }]);
    assert_eq!(grouped(Mode::Paper).len(), 1 + 20);
    for mode in Mode::ALL {
        let steps: Vec<usize> = grouped(mode).into_iter().flat_map(Group::steps).collect();
        assert_eq!(steps, (0..sequence(mode).roles.len()).collect::<Vec<_>>());
    }
}

#[test]
fn the_order_and_why_are_told() {
    let timing = |camera: &CameraInfo, readout_us: f64| {
        Timing::new(&hz60(Some((33.3, 18.9))), camera, 2000.0, readout_us, &PlanOptions::default()).unwrap()
    };
    let told = |timing: &Timing| (timing.order, timing.hold_refreshes);
    // A readout of 20 ms costs a refresh where it is waited for, and nothing where it is not.
    let quick = timing(&overlapping(), 20_000.0);
    assert_eq!(told(&quick), (Order::Overlapped, 4));
    assert!(quick.order_reason.contains("fit into the hold"));
    let plain = timing(&camera(None), 20_000.0);
    assert_eq!(told(&plain), (Order::OneByOne, 5));
    assert!(plain.order_reason.contains("does not promise"));
    // 150 ms do not fit into four refreshes.
    assert_eq!(told(&timing(&overlapping(), 150_000.0)), (Order::Overlapped, 10));
    assert_eq!(told(&timing(&camera(None), 150_000.0)), (Order::OneByOne, 13));
    // The slower its answer to a trigger, the longer the guard, until there is nothing to be gained.
    let slow = |ms| camera(Some(Overlap { latency: Duration::from_millis(ms), stamped: false }));
    assert_eq!(told(&timing(&slow(9), 20_000.0)), (Order::Overlapped, 5));
    let slower = timing(&slow(40), 20_000.0);
    assert_eq!((told(&slower), slower.guard), ((Order::OneByOne, 5), Duration::ZERO));
    assert!(slower.order_reason.contains("costs no more"));
    let free = timing(&CameraInfo { triggered: false, ..overlapping() }, 20_000.0);
    assert_eq!(told(&free), (Order::OneByOne, 5));
    assert!(free.order_reason.contains("when it likes"));
}

prop_compose! {
    fn any_rig()(
        period_us in 2_000u64..100_000,
        latency_us in 0u64..200_000,
        settling_us in 0u64..150_000,
        measured in any::<bool>(),
        exposure_us in 1.0..400_000.0f64,
        readout_us in 0.0..200_000.0f64,
        margin_us in 0u64..5_000,
        tolerance_us in 0u64..5_000,
        lead_us in 0u64..5_000,
        overlap in prop::option::of((0u64..10_000, any::<bool>())),
    ) -> (ProjectorInfo, CameraInfo, f64, f64, PlanOptions) {
        let us = Duration::from_micros;
        let projector = projector(us(period_us), measured.then(|| (us(latency_us), us(settling_us))));
        let options = PlanOptions {
            margin: us(margin_us),
            stamp_tolerance: us(tolerance_us),
            submit_lead: us(lead_us),
            ..PlanOptions::default()
        };
        let camera = camera(overlap.map(|(latency, stamped)| Overlap { latency: us(latency), stamped }));
        (projector, camera, exposure_us, readout_us, options)
    }
}

proptest! {
    #[test]
    fn the_exposure_lies_wholly_in_the_stable_window(
        (projector, camera, exposure_us, readout_us, options) in any_rig(),
        flip in 0u64..1_000_000_000_000,
        late_us in 0u64..1_000_000,
        spare in 0u32..5,
    ) {
        let least = Timing::new(&projector, &camera, exposure_us, readout_us, &options).unwrap();
        let hold = Some(least.hold_refreshes + spare);
        let timing = Timing::new(&projector, &camera, exposure_us, readout_us, &PlanOptions { hold_refreshes: hold, ..options }).unwrap();
        let flip = Timestamp(flip);
        let at = timing.trigger_at(flip, flip);
        prop_assert!(at >= flip + timing.latency + timing.settling + options.stamp_tolerance);
        // The next slide can be asked for in time when the exposure is over for certain, or its frame in hand.
        let next = flip + timing.hold();
        let over = match timing.order {
            Order::Overlapped => timing.exposed(at),
            Order::OneByOne => at + timing.exposure + timing.readout,
        };
        prop_assert!(over + options.submit_lead <= next);
        prop_assert!(timing.light_after(next) >= next);
        // And the frame is in hand before the next exposure.
        prop_assert!(at + timing.exposure + timing.readout <= timing.trigger_at(next, next));

        // A late trigger comes a whole number of refreshes later, and no more than it must.
        let now = flip + Duration::from_micros(late_us);
        let late = timing.trigger_at(flip, now);
        let shift = late.since(at).as_nanos();
        prop_assert!(late >= now && late >= at);
        prop_assert_eq!(shift % timing.refresh_period.as_nanos(), 0);
        prop_assert!(shift == 0 || late < now + timing.refresh_period);

        // The next slide is asked for in the refresh before the one it is due at.
        let show = timing.next_show(flip);
        prop_assert!(show < flip + timing.hold());
        prop_assert!(show + timing.refresh_period > flip + timing.hold());
    }

    #[test]
    fn the_hold_is_the_smallest_that_is_safe(
        (projector, camera, exposure_us, readout_us, options) in any_rig(),
    ) {
        let timing = Timing::new(&projector, &camera, exposure_us, readout_us, &options).unwrap();
        let delay = timing.trigger_delay + timing.exposure;
        let least = |fits: &dyn Fn(Duration) -> bool| {
            (1..).find(|&hold| fits(timing.refresh_period * hold)).unwrap_or(u32::MAX)
        };
        let one_by_one = least(&|hold| delay + timing.readout + options.submit_lead <= hold);
        let overlapped = camera.overlap.map(|overlap| {
            let guard = overlap.latency + options.stamp_tolerance * 2;
            let margin = options.margin.max(options.stamp_tolerance);
            least(&|hold| {
                delay + guard + options.submit_lead <= hold
                    && timing.exposure + guard + timing.readout + margin <= hold
            })
        });
        let slow = overlapped.map_or(one_by_one, |overlapped| overlapped.min(one_by_one));
        prop_assert_eq!(timing.hold_refreshes, slow);
        prop_assert_eq!(timing.order == Order::Overlapped, overlapped.is_some_and(|hold| hold <= one_by_one));
        if slow > 1 {
            let shorter = PlanOptions { hold_refreshes: Some(slow - 1), ..options };
            let refused = Timing::new(&projector, &camera, exposure_us, readout_us, &shorter);
            prop_assert_eq!(refused, Err(PlanError::ShortHold { hold: slow - 1, needed: slow }));
        }
    }
}
