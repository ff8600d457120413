//! Scans in a row, with clients that poll and clients that follow events and break off now and then.

use std::{
    fs,
    sync::{
        RwLock,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use serde_json::json;

use crate::{
    client::{Event, Events, send},
    daemon::Daemon,
    rig::Rig,
};

/// Clients that ask how things are.
const POLLERS: usize = 4;

/// Label by which followers know that nothing comes after.
const THE_END: &str = "the end";

/// What the process held at one moment, with no request under way.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Scans that were done.
    pub scans: usize,
    /// Resident memory in KiB.
    pub memory_kib: u64,
    /// Open descriptors.
    pub descriptors: usize,
}

/// What a soak came to.
#[derive(Debug)]
pub struct Soak {
    /// In order of time.
    pub samples: Vec<Sample>,
    /// Events that each follower got.
    pub events: usize,
    /// Requests of all pollers.
    pub requests: u64,
    /// Connections of all followers.
    pub connections: u64,
    /// From the first scan to the last.
    pub took: Duration,
}

impl Soak {
    /// Slope of a least-squares line through `value` of the samples from the scan `from` on, per scan.
    pub fn slope(&self, from: usize, value: impl Fn(&Sample) -> f64) -> f64 {
        let points: Vec<(f64, f64)> = self
            .samples
            .iter()
            .filter(|sample| sample.scans >= from)
            .map(|one| (one.scans as f64, value(one)))
            .collect();
        let count = points.len() as f64;
        let mean = |pick: fn(&(f64, f64)) -> f64| points.iter().map(pick).sum::<f64>() / count;
        let (x, y) = (mean(|point| point.0), mean(|point| point.1));
        let covariance: f64 = points.iter().map(|point| (point.0 - x) * (point.1 - y)).sum();
        covariance / points.iter().map(|point| (point.0 - x).powi(2)).sum::<f64>()
    }
}

/// A size that the kernel tells of a process, such as `VmRSS`, in KiB.
pub fn status_kib(process: u32, name: &str) -> u64 {
    let status = fs::read_to_string(format!("/proc/{process}/status")).expect("the process lives");
    let of_line =
        |line: &str| line.strip_prefix(name)?.strip_prefix(':')?.trim().strip_suffix(" kB")?.parse().ok();
    status.lines().find_map(of_line).expect("a size")
}

fn sample(process: u32, scans: usize) -> Sample {
    let memory_kib = status_kib(process, "VmRSS");
    let descriptors = fs::read_dir(format!("/proc/{process}/fd")).expect("descriptors").count();
    Sample { scans, memory_kib, descriptors }
}

/// Asks again and again: no scan ever goes back, neither in state nor in revision.
fn poll(daemon: &Daemon, pause: &RwLock<()>, over: &AtomicBool) -> u64 {
    const ORDER: [&str; 5] = ["queued", "projecting", "acquired", "decoding", "done"];
    let rank =
        |state: &str| ORDER.iter().position(|one| *one == state).expect("a state of a scan that does well");
    let mut last: Option<(String, usize, u64)> = None;
    let mut requests = 0;
    while !over.load(Ordering::Relaxed) {
        {
            let _free = pause.read().expect("nobody panicked");
            for path in ["/livez", "/v1/status"] {
                daemon.get(path).expect(200);
            }
            let page = daemon.get("/v1/scans?limit=5").expect(200).json();
            if let Some(scan) = page["scans"].as_array().and_then(|scans| scans.first()) {
                let id = scan["id"].as_str().expect("an identity").to_owned();
                let seen = (
                    rank(scan["state"].as_str().expect("text")),
                    scan["revision"].as_u64().expect("a number"),
                );
                if let Some((before, state, revision)) = &last
                    && *before == id
                {
                    assert!(*state <= seen.0 && *revision <= seen.1, "{last:?} to {scan}");
                }
                last = Some((id, seen.0, seen.1));
            }
            requests += 3;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    requests
}

/// Follows events to the end, breaking off after every `leave` events for as long as `away`.
fn follow(
    mut events: Events,
    daemon: &Daemon,
    pause: &RwLock<()>,
    leave: usize,
    away: Duration,
    connections: &AtomicU64,
) -> Vec<Event> {
    let mut all: Vec<Event> = Vec::new();
    loop {
        connections.fetch_add(1, Ordering::Relaxed);
        for _ in 0..leave {
            let event = events.next();
            let end = event.data["label"] == THE_END;
            all.push(event);
            if end {
                return all;
            }
        }
        drop(events);
        std::thread::sleep(away);
        let _free = pause.read().expect("nobody panicked");
        events = Events::follow(daemon.address(), all.last().map(|event| event.id));
    }
}

/// Runs `scans` scans in a row and checks what every client saw.
pub fn soak(scans: usize, every: usize) -> Soak {
    // The oldest make room, so that a soak of any length fits on any disk.
    let rig = Rig::scaled(8.0).set("store.quota_gib", 0.25).set("store.delete_oldest", true);
    let daemon = Daemon::on(rig).started();
    daemon.ready();
    let (pause, over, connections) = (RwLock::new(()), AtomicBool::new(false), AtomicU64::new(0));
    let streams: Vec<Events> = (0..2).map(|_| Events::follow(daemon.address(), None)).collect();
    let begun = Instant::now();
    let mut samples = Vec::new();
    let (requests, mut told) = std::thread::scope(|scope| {
        let pollers: Vec<_> = (0..POLLERS).map(|_| scope.spawn(|| poll(&daemon, &pause, &over))).collect();
        // One is hasty, the other stays away for longer than a scan takes.
        let manners = [(7, Duration::ZERO), (150, Duration::from_millis(1500))];
        let (daemon, pause, connections) = (&daemon, &pause, &connections);
        let followers: Vec<_> = streams
            .into_iter()
            .zip(manners)
            .map(|(events, (leave, away))| {
                scope.spawn(move || follow(events, daemon, pause, leave, away, connections))
            })
            .collect();
        let mut last = String::new();
        for done in 1..=scans {
            last = daemon.finished_scan()["id"].as_str().expect("an identity").to_owned();
            if done % every == 0 {
                let _quiet = pause.write().expect("nobody panicked");
                // Connections that clients have closed are closed here a moment later.
                std::thread::sleep(Duration::from_millis(50));
                samples.push(sample(daemon.process(), done));
            }
        }
        daemon.request("PATCH", &format!("/v1/scans/{last}"), &json!({ "label": THE_END })).expect(200);
        let told: Vec<Vec<Event>> =
            followers.into_iter().map(|follower| follower.join().expect("a follower")).collect();
        over.store(true, Ordering::Relaxed);
        let requests = pollers.into_iter().map(|poller| poller.join().expect("a poller")).sum();
        (requests, told)
    });
    let took = begun.elapsed();
    let (hasty, lazy) = (told.remove(0), told.remove(0));
    check_events(&hasty, scans);
    assert_eq!(hasty, lazy, "both followers saw the same");
    // Whoever comes afterwards is told the same.
    let mut replay = Events::follow(daemon.address(), Some(hasty[0].id));
    for event in &hasty[1..] {
        assert_eq!(&replay.next(), event);
    }
    assert!(!daemon.log().contains("\"ERROR\""), "{}", daemon.log());
    assert_eq!(send(daemon.address(), "GET", "/readyz", &[], b"").status, 200);
    Soak { samples, events: hasty.len(), requests, connections: connections.into_inner(), took }
}

/// Numbers without a gap, every scan through all its states, every frame once.
fn check_events(events: &[Event], scans: usize) {
    for pair in events.windows(2) {
        assert_eq!(pair[1].id, pair[0].id + 1, "{pair:?}");
    }
    let done = |event: &&Event| {
        event.kind == "scan" && event.data["state"] == "done" && event.data["label"] != THE_END
    };
    let ends: Vec<&str> = events.iter().filter(done).filter_map(|event| event.data["id"].as_str()).collect();
    assert_eq!(ends.len(), scans);
    for id in ends {
        let of_it = |kind: &str| {
            events.iter().filter(|event| event.kind == kind && event.data["id"] == id).collect::<Vec<_>>()
        };
        let mut states: Vec<&str> =
            of_it("scan").iter().filter_map(|event| event.data["state"].as_str()).collect();
        states.dedup();
        assert_eq!(states, ["queued", "projecting", "acquired", "decoding", "done"], "{id}");
        let progress = of_it("progress");
        let frames: Vec<u64> =
            progress.iter().filter_map(|event| event.data["progress"]["frames"].as_u64()).collect();
        let of = progress[0].data["progress"]["of"].as_u64().expect("a number");
        // One event says how many there will be, then there is one for each.
        assert_eq!(frames, (0..=of).collect::<Vec<_>>(), "{id}");
    }
}

#[test]
fn scans_in_a_row_lose_no_event_and_hold_nothing_back() {
    let run = soak(15, 5);
    let descriptors: Vec<usize> = run.samples.iter().map(|sample| sample.descriptors).collect();
    let (least, most) = (descriptors.iter().min().unwrap(), descriptors.iter().max().unwrap());
    // A follower may be between two connections.
    assert!(most - least <= 3, "{:?}", run.samples);
}

/// Bytes of a pixel that a scan may take beside its frames: maps, points, and the files that are made of them.
const MOST_BYTES_PER_PIXEL: u64 = 400;

#[test]
fn a_scan_takes_its_frames_once_and_its_maps() {
    let daemon = Daemon::on(Rig::scaled(2.0)).started();
    daemon.ready();
    let before = status_kib(daemon.process(), "VmRSS");
    let (mut grown, mut frames) = (Vec::new(), 0);
    for _ in 0..3 {
        let scan = daemon.done(&daemon.scan(&json!({ "mode": "pse" })));
        assert_eq!(scan["state"], "done", "{scan}");
        grown.push((status_kib(daemon.process(), "VmHWM") - before) << 10);
        let bundle = daemon.store.join(scan["id"].as_str().expect("an identity"));
        frames = fs::metadata(bundle.join("frames.npy")).expect("frames").len();
    }
    let pixels = 800 * 600;
    println!("{grown:?} bytes beside {before} KiB; frames {frames}");
    let [first, .., last] = grown[..] else { unreachable!("three scans") };
    assert!(first < frames + MOST_BYTES_PER_PIXEL * pixels, "{first} bytes, of frames {frames}");
    // What one scan needed is there for the next.
    assert!(last < first + frames / 2, "{grown:?}");
}
