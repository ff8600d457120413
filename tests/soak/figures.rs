//! What the service costs: the time to the first pattern, the overhead over `polscan scan`, and how soon it answers
//! while it decodes. And how near a capture comes to the pace of its display.

use std::{
    collections::HashMap,
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use serde_json::{Value, json};

use crate::{
    client::{Events, send},
    daemon::Daemon,
    rig::Rig,
    soak::status_kib,
};

/// Scans of each figure.
const SCANS: usize = 50;

/// Scans of each way in the comparison; a scan of the whole rig takes seconds.
const PAIRS: usize = 10;

fn ms(time: Duration) -> f64 {
    1e3 * time.as_secs_f64()
}

/// Sorted; the value below which `part` of all are, by nearest rank.
fn quantile(sorted: &[f64], part: f64) -> f64 {
    let rank = (part * sorted.len() as f64).ceil() as usize;
    sorted[rank.clamp(1, sorted.len()) - 1]
}

fn say(name: &str, mut values: Vec<f64>) -> Vec<f64> {
    values.sort_by(f64::total_cmp);
    let [half, most] = [0.5, 0.99].map(|part| quantile(&values, part));
    let last = values[values.len() - 1];
    println!("{name}: p50 {half:.2} ms, p99 {most:.2} ms, longest {last:.2} ms of {}", values.len());
    values
}

/// On what a figure was measured.
fn describe(when: &str) {
    let cores = std::thread::available_parallelism().map_or(0, usize::from);
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let build = if cfg!(debug_assertions) { "development build" } else { "release build" };
    println!("{cores} cores, {build}, load {when} {}", load.trim());
}

/// What the service logs when light is on the object.
struct FirstPattern {
    scan: String,
    after_accepted_ms: f64,
    rehearsed_ms: f64,
}

/// Of all scans, in order.
fn first_patterns(daemon: &Daemon) -> impl Iterator<Item = FirstPattern> {
    let read = |line: &str| {
        let said: Value = serde_json::from_str(line).ok()?;
        let fields = &said["fields"];
        (fields["message"] == "first pattern shown").then_some(())?;
        Some(FirstPattern {
            scan: said["span"]["id"].as_str()?.to_owned(),
            after_accepted_ms: fields["after_accepted_ms"].as_f64()?,
            rehearsed_ms: fields["rehearsed_ms"].as_f64()?,
        })
    };
    daemon.log().lines().filter_map(read).collect::<Vec<_>>().into_iter()
}

/// From before the request is sent until light is on the object: an upper bound, as the answer's way back is counted in.
#[test]
fn figures_of_the_first_pattern() {
    describe("before");
    let daemon = Daemon::real_time();
    daemon.ready();
    // The first scan sets the mode; the prepared one after it is what a bench sees.
    daemon.finished_scan();
    let mut asked = Vec::new();
    for _ in 0..SCANS {
        let begun = Instant::now();
        let id = daemon.scan(&json!({ "mode": "fast" }));
        asked.push(begun.elapsed());
        assert_eq!(daemon.done(&id)["state"], "done");
    }
    let shown: Vec<FirstPattern> = first_patterns(&daemon).skip(1).collect();
    assert_eq!(shown.len(), SCANS);
    let all = asked.iter().zip(&shown).map(|(asked, shown)| ms(*asked) + shown.after_accepted_ms).collect();
    let own = asked
        .iter()
        .zip(&shown)
        .map(|(asked, shown)| ms(*asked) + shown.after_accepted_ms - shown.rehearsed_ms);
    say("request until its answer", asked.iter().map(|asked| ms(*asked)).collect());
    say("rendering of the simulated rig in advance", shown.iter().map(|shown| shown.rehearsed_ms).collect());
    say("request until the first pattern is shown, at most", all);
    say("the same without what the simulated rig renders in advance", own.collect());
    describe("after");
}

/// From before the process is started until `/readyz` says that a scan would be accepted.
#[test]
fn figures_of_the_start() {
    describe("before");
    let mut daemon = Daemon::on(Rig::scaled(1.0));
    let (mut first, mut later) = (Vec::new(), Vec::new());
    for number in 0..2 * PAIRS {
        let begun = Instant::now();
        daemon.start();
        while send(daemon.address(), "GET", "/readyz", &[], b"").status != 200 {
            std::thread::sleep(Duration::from_millis(1));
        }
        if number == 0 { &mut first } else { &mut later }.push(ms(begun.elapsed()));
        daemon.stop();
    }
    say("start until ready, a store that is to be made", first);
    say("start until ready", later);
    describe("after");
}

/// A series of scans of the whole rig in real time: how long from one capture to the next, while the one before is computed.
#[test]
fn figures_of_a_series() {
    describe("before");
    let daemon = Daemon::on(Rig::scaled(1.0).set("sim.pacing", "real-time")).started();
    daemon.ready();
    daemon.finished_scan();
    let mut events = Events::follow(daemon.address(), None);
    let memory = |key: &str| status_kib(daemon.process(), key);
    let idle_kib = memory("VmRSS");
    let asked = daemon.post("/v1/scans", &json!({ "mode": "pse", "repeat": PAIRS })).expect(202).json();
    let ids: Vec<&str> = asked["scans"].as_array().expect("scans").iter().filter_map(Value::as_str).collect();
    let (mut acquired, mut after) = (Vec::new(), Vec::new());
    while after.len() < ids.len() {
        let event = events.next();
        let Some(place) = ids.iter().position(|id| event.data["id"] == *id) else { continue };
        match event.data["state"].as_str() {
            Some("acquired") => acquired.push(Instant::now()),
            Some("done") => after.push(ms(acquired[place].elapsed())),
            Some("failed") => panic!("{}", event.data),
            _ => {}
        }
    }
    let rehearsed_ms: HashMap<String, f64> =
        first_patterns(&daemon).map(|one| (one.scan, one.rehearsed_ms)).collect();
    let between = acquired.windows(2).map(|two| ms(two[1] - two[0]));
    let own = between.zip(&ids[1..]).map(|(between, id)| {
        let report = daemon.get(&format!("/v1/scans/{id}/report.json")).expect(200).json();
        between - rehearsed_ms[*id] - 1e3 * report["capture"]["seconds"].as_f64().expect("a time")
    });
    say(
        "from the last frame of a scan to the first pattern of the next, without what the simulated rig renders in advance",
        own.collect(),
    );
    say("from the last frame until the result is on the disk, with that", after);
    println!("resident memory: {idle_kib} KiB before, {} KiB at most", memory("VmHWM"));
    describe("after");
}

/// How near scans of the whole rig come to the pace of their display, in real time.
#[test]
fn figures_of_the_pace() {
    describe("before");
    let rig = Rig::scaled(1.0).set("sim.pacing", "real-time");
    let mut ratios = Vec::new();
    for number in 0..PAIRS {
        let out = format!("out-{number}");
        rig.scan(&out, &[]).expect(0);
        let report = rig.report(&out);
        let capture = &report["capture"];
        let seconds = |key: &str| capture[key].as_f64().expect("a time");
        ratios.push(seconds("seconds") / seconds("limit_seconds"));
        println!(
            "{:.3} s of {:.3} s, idle refreshes {}, phase error {} us",
            seconds("seconds"),
            seconds("limit_seconds"),
            capture["synchrony"]["idle_refreshes"],
            capture["synchrony"]["phase_error_us"]
        );
        std::fs::remove_dir_all(rig.path(&out)).expect("the bundle is removed");
    }
    ratios.sort_by(f64::total_cmp);
    let [half, last] = [quantile(&ratios, 0.5), ratios[ratios.len() - 1]];
    println!("capture.seconds / capture.limit_seconds: median {half:.3}, largest {last:.3} of {PAIRS}");
    describe("after");
}

/// The same scan by the service and by `polscan scan`, in turn. The rig is open in a service, so that the program's
/// own start is measured apart, by a command that only opens the rig.
#[test]
fn figures_of_the_overhead() {
    describe("before");
    let rig = || Rig::scaled(2.0).set("sim.pacing", "real-time");
    let command = rig();
    let daemon = Daemon::on(rig()).started();
    daemon.ready();
    daemon.finished_scan();
    let (mut served, mut run, mut opened) = (Vec::new(), Vec::new(), Vec::new());
    for number in 0..PAIRS {
        let begun = Instant::now();
        daemon.finished_scan();
        served.push(ms(begun.elapsed()));
        let begun = Instant::now();
        command.scan(&format!("out-{number}"), &["--mode", "fast"]).expect(0);
        run.push(ms(begun.elapsed()));
        let begun = Instant::now();
        let config = command.config();
        crate::rig::polscan(&["devices", "--config", crate::rig::text(&config)]).expect(0);
        opened.push(ms(begun.elapsed()));
    }
    let served = say("scan by the service, request until done", served);
    let run = say("the same by `polscan scan`, start until end", run);
    let opened = say("`polscan devices`, start until end", opened);
    let [served, run, opened] = [served, run, opened].map(|values| quantile(&values, 0.5));
    println!("service over `polscan scan`, medians: {:+.1} %", 100.0 * (served / run - 1.0));
    println!("without the start of the program: {:+.1} %", 100.0 * (served / (run - opened) - 1.0));
    describe("after");
}

/// `/livez` as often as one client can ask, with scans of the whole rig decoded one after the other.
#[test]
fn figures_of_answers_while_it_decodes() {
    describe("before");
    let daemon = Daemon::on(Rig::scaled(1.0)).started();
    daemon.ready();
    let source = daemon.finished_scan();
    let path = format!("{}/reprocess?wait=done", source["href"].as_str().expect("an address"));
    let over = AtomicBool::new(false);
    let times = std::thread::scope(|scope| {
        let prober = scope.spawn(|| {
            let mut times = Vec::new();
            while !over.load(Ordering::Relaxed) {
                let begun = Instant::now();
                assert_eq!(send(daemon.address(), "GET", "/livez", &[], b"").status, 200);
                times.push(ms(begun.elapsed()));
                std::thread::sleep(Duration::from_millis(2));
            }
            times
        });
        let mut events = Events::follow(daemon.address(), None);
        for _ in 0..5 {
            let scan = daemon.post(&path, &json!({})).expect(202).json();
            assert_eq!(scan["state"], "done", "{scan}");
        }
        while events.next().data["state"] != "done" {}
        over.store(true, Ordering::Relaxed);
        prober.join().expect("a prober")
    });
    describe("after");
    let times = say("/livez while scans of the whole rig are decoded on all cores", times);
    assert!(quantile(&times, 0.99) < 50.0, "the service does not answer while it decodes");
}
