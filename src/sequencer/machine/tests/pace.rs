//! The machine on a rig of which every time is known: what it decides, checked against the rig's own account.

use super::*;

/// A rig that behaves, somewhere within its bounds.
#[derive(Debug, Clone)]
struct Rig {
    period: Duration,
    latency: Duration,
    settling: Duration,
    exposure: Duration,
    /// As stated; frames take a part of it.
    readout: Duration,
    overlap: Option<Overlap>,
    measured: bool,
    /// Of each step, as shares: of the camera's latency, of its readout, of the lead, of the time that judging may take.
    whims: Vec<[f64; 4]>,
}

fn any_rig() -> impl Strategy<Value = Rig> {
    let us = Duration::from_micros;
    let overlap = prop::option::of((0u64..1000, any::<bool>()));
    let shares = [0.0..1.0f64, 0.0..1.0, 0.0..1.0, 0.0..1.0];
    (
        (4_000u64..50_000, 0u64..60_000, 0u64..40_000),
        (100u64..30_000, 0u64..120_000, overlap, any::<bool>()),
        prop::collection::vec(shares, 10),
    )
        .prop_map(move |((period, latency, settling), (exposure, readout, overlap, measured), whims)| {
            Rig {
                period: us(period),
                latency: us(latency),
                settling: us(settling),
                exposure: us(exposure),
                readout: us(readout),
                overlap: overlap.map(|(latency, stamped)| Overlap { latency: us(latency), stamped }),
                measured,
                whims,
            }
        })
}

/// What happened on the rig.
#[derive(Debug, Default)]
struct Account {
    /// When each slide was asked for and flipped.
    flips: Vec<(Timestamp, Timestamp, usize)>,
    /// Exposures with the slide that was asked for last before them.
    exposures: Vec<([Timestamp; 2], usize)>,
    kept: Vec<usize>,
    last_arrival: Timestamp,
}

impl Rig {
    fn plan(&self) -> Plan {
        let timing = ProjectorTiming { latency: self.latency, settling: self.settling };
        let usual = plan_for(Mode::Pse, self.overlap);
        let projector = ProjectorInfo {
            refresh_period: self.period,
            timing: self.measured.then_some(timing),
            ..projector()
        };
        let mut applied = usual.applied;
        applied.settings.exposure_us = 1e6 * self.exposure.as_secs_f64();
        applied.readout_us = 1e6 * self.readout.as_secs_f64();
        let polarization = Polarization::green_horizontal();
        let (camera, options) = (camera(self.overlap), PlanOptions::default());
        Plan::new(usual.sequence, polarization, &projector, &camera, applied, &options).unwrap()
    }

    /// Time of an unmeasured projector as it is assumed, which this one keeps.
    fn stable_after(&self, plan: &Plan) -> Duration {
        if self.measured { self.latency + self.settling } else { plan.timing.latency + plan.timing.settling }
    }

    /// How late an exposure may start, where that is planned for.
    fn late(&self, plan: &Plan) -> Duration {
        let promise = self.overlap.filter(|_| plan.timing.order == Order::Overlapped);
        promise.map_or(Duration::ZERO, |overlap| overlap.latency)
    }

    fn run(&self, plan: &Plan) -> Account {
        let options = PlanOptions::default();
        let mut machine = Machine::new(plan, true);
        let mut now = Timestamp(1_000_000_007);
        let mut actions = VecDeque::from(machine.handle(now, Event::Start));
        let mut account = Account::default();
        while let Some(action) = actions.pop_front() {
            let step = account.exposures.len();
            let share = |time: Duration, kind: usize| {
                let whims = self.whims[step.saturating_sub(1).min(self.whims.len() - 1)];
                time.mul_f64(whims[kind])
            };
            let event = match action {
                Action::Show { step, not_before } => {
                    // A quarter of a refresh is all that is certain for a show that is asked for early.
                    let asked = now.max(not_before);
                    let heard = asked + share(options.submit_lead.min(self.period / 4), 2);
                    let period = self.period.as_nanos() as u64;
                    let refresh = heard.0 / period + 1;
                    now = Timestamp(refresh * period);
                    account.flips.push((asked, now, step));
                    Event::Presented(PresentReceipt {
                        slide: Some(step as u32),
                        flipped: now,
                        refresh: Some(refresh),
                        method: ReceiptMethod::X11Present,
                    })
                }
                Action::Trigger { at } => {
                    let started = now.max(at);
                    let late = share(self.late(plan), 0);
                    let slide = account.flips.last().unwrap().2;
                    account.exposures.push(([started + late, started + late + self.exposure], slide));
                    now = started;
                    Event::Triggered(started)
                }
                Action::AwaitFrame { .. } => {
                    let [start, end] = account.exposures.last().unwrap().0;
                    let arrival = end + share(self.readout, 1);
                    now = now.max(arrival);
                    account.last_arrival = arrival;
                    let number = account.exposures.len() as u64 - 1;
                    Event::FrameArrived(FrameStamp {
                        frame_id: number,
                        trigger: number,
                        exposure_start: start,
                        received: arrival,
                        device_time_ns: None,
                    })
                }
                Action::Judge(subject) => {
                    let due = account.flips.last().unwrap().1 + plan.timing.trigger_delay;
                    now = now + share(due.since(now), 3);
                    Event::Judged(subject, PairVerdict::Accept)
                }
                Action::Keep { step } => {
                    account.kept.push(step);
                    continue;
                }
                Action::Finish(outcome) => {
                    assert_eq!(outcome, Outcome::Complete, "{:?}", machine.retaken());
                    continue;
                }
                Action::Accept { .. } | Action::Black => continue,
                Action::Retake(retake) => panic!("{retake:?}"),
            };
            actions.extend(machine.handle(now, event));
        }
        account
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]
    /// However late camera, display and judge are within their bounds, in either order: exposures see their own slide
    /// and nothing else, and not one refresh is idle.
    #[test]
    fn every_exposure_sees_its_own_slide_at_the_pace_of_the_display(rig in any_rig()) {
        let plan = rig.plan();
        let timing = plan.timing;
        let account = rig.run(&plan);
        let steps: Vec<usize> = (0..plan.sequence.roles.len()).collect();
        prop_assert_eq!(&account.kept, &steps);
        prop_assert_eq!(account.flips.iter().map(|flip| flip.2).collect::<Vec<_>>(), steps.clone());
        prop_assert_eq!(account.exposures.iter().map(|exposure| exposure.1).collect::<Vec<_>>(), steps);
        for (index, ([start, end], _)) in account.exposures.iter().enumerate() {
            let (_, flip, _) = account.flips[index];
            prop_assert!(*start >= flip + rig.stable_after(&plan), "exposed before the light is stable");
            if let Some((asked, next, _)) = account.flips.get(index + 1) {
                prop_assert!(end <= asked, "slide {} is asked for in the exposure before", index + 1);
                prop_assert_eq!(next.since(flip), timing.hold(), "slide {} was held too long", index);
            }
            let (_, first, _) = account.flips[0];
            let phase = (start.since(first) - timing.trigger_delay).as_nanos() % rig.period.as_nanos();
            prop_assert!(phase <= rig.late(&plan).as_nanos(), "exposed {phase} ns off its phase");
        }
        let holds = timing.hold() * (account.flips.len() as u32 - 1);
        let (first, last) = (account.flips[0].1, account.exposures.last().unwrap().0);
        let own = last[0].since(account.flips.last().unwrap().1) + account.last_arrival.since(last[0]);
        prop_assert_eq!(account.last_arrival.since(first), holds + own);
        prop_assert!(own <= timing.trigger_delay + rig.exposure + rig.readout + Duration::from_millis(1));
    }
}

/// What the other order saves: a readout that does not fit beside delay and exposure costs refreshes where it is waited for.
#[test]
fn a_long_readout_is_free_where_it_overlaps() {
    let rig = |overlap| Rig {
        period: Duration::from_millis(10),
        latency: Duration::from_millis(20),
        settling: Duration::from_millis(10),
        exposure: Duration::from_millis(2),
        readout: Duration::from_millis(30),
        overlap,
        measured: true,
        whims: vec![[0.0, 1.0, 0.0, 0.0]; 10],
    };
    let seconds = |overlap| {
        let rig = rig(overlap);
        let account = rig.run(&rig.plan());
        account.last_arrival.since(account.flips[0].1)
    };
    let overlap = Some(Overlap { latency: Duration::ZERO, stamped: true });
    assert_eq!(seconds(overlap), after(9 * 40 + 31 + 2 + 30));
    assert_eq!(seconds(None), after(9 * 70 + 31 + 2 + 30));
}
