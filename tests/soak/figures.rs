//! What the service costs: the time to the first pattern, the overhead over `polscan scan`, and how soon it answers
//! while it decodes. And how near a capture comes to the pace of its display.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::{Duration, Instant},
};

use serde_json::{Value, json};

use crate::{
    client::{Events, send},
    daemon::Daemon,
    rig::Rig,
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
    let log = daemon.log();
    let shown = log.lines().filter_map(|line| {
        let fields = &serde_json::from_str::<Value>(line).ok()?["fields"];
        (fields["message"] == "first pattern shown")
            .then(|| Some((fields["after_accepted_ms"].as_f64()?, fields["rehearsed_ms"].as_f64()?)))?
    });
    let shown: Vec<(f64, f64)> = shown.skip(1).collect();
    assert_eq!(shown.len(), SCANS);
    let all = asked.iter().zip(&shown).map(|(asked, (shown, _))| ms(*asked) + shown).collect();
    let own = asked.iter().zip(&shown).map(|(asked, (shown, rehearsed))| ms(*asked) + shown - rehearsed);
    say("request until its answer", asked.iter().map(|asked| ms(*asked)).collect());
    say("rendering of the simulated rig in advance", shown.iter().map(|(_, rehearsed)| *rehearsed).collect());
    say("request until the first pattern is shown, at most", all);
    say("the same without what the simulated rig renders in advance", own.collect());
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
