//! Every fault that the twin can have, many times over: what does a scan call it, and is a wrong cloud ever called `ok`?
//!
//! Each fault is judged twice: by the live scan, which may take frames again, and by `polscan decode` of what a recorder
//! without any checks makes of the same rig: pictures in the order in which they arrived, without receipts or stamps.
//!
//! `POLSCAN_FAULTS_SEEDS` (20), `POLSCAN_FAULTS_SCALE` (2: half of the paper's rig along each side; 1: all of it),
//! `POLSCAN_FAULTS_ONLY` (part of a fault's name), `POLSCAN_FAULTS_OUT` (a file for the table).

mod cases;
mod recorder;
#[path = "../end_to_end/rig.rs"]
#[allow(dead_code, reason = "the other suites need more of it")]
mod rig;

use std::{
    collections::BTreeMap,
    env,
    fmt::Write as _,
    fs,
    sync::atomic::{AtomicU64, Ordering},
    thread,
};

use cases::{Case, Random};
use rig::Rig;
use serde_json::Value;

/// Share of the scans of a fault that must be named right.
const NAMED: f64 = 0.95;
/// Share of wrong points above which a cloud is wrong.
const WRONG: f64 = 1e-3;

/// What one run came to.
struct Found {
    /// What a user reads first: the gravest reason, else why a picture was taken again, else the verdict.
    headline: String,
    verdict: String,
    wrong: Option<f64>,
    all: Vec<String>,
}

/// All runs of one fault in one way.
#[derive(Default)]
struct Tally {
    runs: u32,
    right: u32,
    headlines: BTreeMap<String, u32>,
    wrong_ok: u32,
    worst_ok: f64,
    worst_degraded: f64,
}

#[test]
fn every_fault_is_named_and_none_ends_in_a_wrong_cloud_called_ok() {
    let number = |name: &str, default: f64| {
        env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}: a number")))
    };
    let seeds = number("POLSCAN_FAULTS_SEEDS", 20.0) as u64;
    let scale = number("POLSCAN_FAULTS_SCALE", 2.0);
    let only = env::var("POLSCAN_FAULTS_ONLY").unwrap_or_default();
    let mut rows = Vec::new();
    let cases = cases::all();
    for case in cases.iter().filter(|case| case.name.contains(&only)) {
        let mut tallies = [Tally::default(), Tally::default()];
        for (seed, [live, alone]) in (1..).zip(run_all(case, seeds, scale)) {
            for (way, (tally, found)) in ["live", "alone"].iter().zip(tallies.iter_mut().zip([live, alone])) {
                let Some(found) = found else { continue };
                let expected = if *way == "live" { case.live } else { case.alone };
                println!(
                    "{} seed {seed} {way}: {} ({}), wrong {:?}, all {:?}",
                    case.name, found.headline, found.verdict, found.wrong, found.all
                );
                tally.add(&found, expected);
            }
        }
        rows.push((case, tallies));
    }
    let table = table(&rows, seeds, scale);
    println!("{table}");
    if let Ok(path) = env::var("POLSCAN_FAULTS_OUT") {
        fs::write(&path, &table).unwrap_or_else(|error| panic!("{path}: {error}"));
    }
    let mut failures = Vec::new();
    for (case, tallies) in &rows {
        for (way, tally) in ["live", "alone"].iter().zip(tallies) {
            if f64::from(tally.right) < NAMED * f64::from(tally.runs) {
                failures
                    .push(format!("{} ({way}): {} of {} named right", case.name, tally.right, tally.runs));
            }
            if tally.wrong_ok > 0 {
                failures.push(format!("{} ({way}): {} wrong clouds called ok", case.name, tally.wrong_ok));
            }
        }
    }
    assert!(failures.is_empty(), "{}", failures.join("\n"));
}

/// All seeds of a fault, as many at once as the machine has processors.
fn run_all(case: &Case, seeds: u64, scale: f64) -> Vec<[Option<Found>; 2]> {
    let next = AtomicU64::new(1);
    let work = || {
        let mut done = Vec::new();
        loop {
            let seed = next.fetch_add(1, Ordering::Relaxed);
            if seed > seeds {
                return done;
            }
            done.push((seed, run(case, seed, scale)));
        }
    };
    let workers = thread::available_parallelism().map_or(1, usize::from);
    let mut done: Vec<_> = thread::scope(|scope| {
        let running: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        running.into_iter().flat_map(|worker| worker.join().expect("no scan panics")).collect()
    });
    done.sort_by_key(|(seed, _)| *seed);
    done.into_iter().map(|(_, found)| found).collect()
}

fn run(case: &Case, seed: u64, scale: f64) -> [Option<Found>; 2] {
    let mut random = Random::new(seed, scale);
    let rig = (case.build)(Rig::scaled(scale).set("sim.seed", seed as i64), &mut random);
    let mut arguments = vec![];
    if let Some(mode) = case.mode {
        arguments.extend(["--mode", mode]);
    }
    let scan = rig.scan("scan", &arguments);
    assert!([0, 1].contains(&scan.code), "{}: exit {}\n{}", case.name, scan.code, scan.stderr);
    let report = rig.report("scan");
    assert_eq!(scan.code == 1, report["verdict"] == "failed", "{}: exit code and verdict", case.name);
    let live = found(&report);
    let alone = (!case.alone.is_empty()).then(|| {
        recorder::record(&rig, case.mode, "bare");
        let decode = rig.decode("bare", "decoded", &[]);
        assert!([0, 1].contains(&decode.code), "{}: exit {}\n{}", case.name, decode.code, decode.stderr);
        found(&rig.report("decoded"))
    });
    [Some(live), alone]
}

fn found(report: &Value) -> Found {
    let list = |value: &Value, key: &str| -> Vec<String> {
        let entries = value.as_array().map(Vec::as_slice).unwrap_or_default();
        entries.iter().filter_map(|entry| entry[key].as_str()).map(str::to_owned).collect()
    };
    let reasons = list(&report["reasons"], "type");
    let capture = &report["capture"];
    let mut again = list(&capture["retaken"], "reason");
    again.extend(list(&capture["references_retaken"], "reason"));
    again.extend(list(&capture["discarded"], "reason"));
    let verdict = report["verdict"].as_str().expect("a verdict").to_owned();
    let headline = reasons.first().or(again.first()).cloned().unwrap_or_else(|| verdict.clone());
    let all = reasons.iter().cloned().chain(again.iter().map(|slug| format!("again: {slug}"))).collect();
    Found { headline, verdict, wrong: report["truth"]["wrong_code_rate"].as_f64(), all }
}

impl Tally {
    fn add(&mut self, found: &Found, expected: &[&str]) {
        self.runs += 1;
        self.right += u32::from(expected.contains(&found.headline.as_str()));
        *self.headlines.entry(found.headline.clone()).or_default() += 1;
        let wrong = found.wrong.unwrap_or(0.0);
        match found.verdict.as_str() {
            "ok" => {
                self.worst_ok = self.worst_ok.max(wrong);
                self.wrong_ok += u32::from(wrong > WRONG);
            }
            "degraded" => self.worst_degraded = self.worst_degraded.max(wrong),
            _ => {}
        }
    }
}

fn table(rows: &[(&Case, [Tally; 2])], seeds: u64, scale: f64) -> String {
    let mut text = format!("Seeds 1 to {seeds}, the paper's rig divided by {scale}.\n\n");
    text.push_str("| fault | judged by | named right | called | most wrong in `ok` | in `degraded` |\n");
    text.push_str("|---|---|---|---|---|---|\n");
    for (case, tallies) in rows {
        for (way, tally) in ["live scan", "frames alone"].iter().zip(tallies) {
            if tally.runs == 0 {
                continue;
            }
            let called: Vec<String> =
                tally.headlines.iter().map(|(name, count)| format!("{name} {count}")).collect();
            let _ = writeln!(
                text,
                "| {} | {way} | {}/{} | {} | {:.5} | {:.5} |",
                case.name,
                tally.right,
                tally.runs,
                called.join(", "),
                tally.worst_ok,
                tally.worst_degraded
            );
        }
    }
    text
}
