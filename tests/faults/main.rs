//! Every fault that the twin can have, many times over: what does a scan call it, and is a wrong cloud ever called `ok`?
//!
//! Each fault is judged twice: by the live scan, which may take frames again, and by `polscan decode` of what a recorder
//! without any checks makes of the same rig: pictures in the order in which they arrived, without receipts or stamps.
//!
//! `POLSCAN_FAULTS_SEEDS` (20), `POLSCAN_FAULTS_FIRST` (the first of them, 1), `POLSCAN_FAULTS_SCALE` (3: a third of the paper's rig along each side; 1: all of it),
//! `POLSCAN_FAULTS_ONLY` (part of a fault's name), `POLSCAN_FAULTS_OUT` (a file for the table, written after each seed),
//! `POLSCAN_FAULTS_REPORTS` (a folder for the reports of scans whose fault was named wrong).

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
    ops::Range,
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
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
    report: Value,
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
    let first = number("POLSCAN_FAULTS_FIRST", 1.0) as u64;
    let seeds = first..first + number("POLSCAN_FAULTS_SEEDS", 20.0) as u64;
    let scale = number("POLSCAN_FAULTS_SCALE", 3.0);
    let only = env::var("POLSCAN_FAULTS_ONLY").unwrap_or_default();
    let cases: Vec<Case> = cases::all().into_iter().filter(|case| case.name.contains(&only)).collect();
    let out = env::var("POLSCAN_FAULTS_OUT").ok();
    let rows = run_all(&cases, &seeds, scale, |rows, done| {
        if let Some(path) = &out {
            fs::write(path, table(rows, &(first..done), scale))
                .unwrap_or_else(|error| panic!("{path}: {error}"));
        }
    });
    println!("{}", table(&rows, &seeds, scale));
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

/// A fault with its tallies of the live scan and of the frames alone.
type Row<'a> = (&'a Case, [Tally; 2]);

/// All faults with one seed after the other, as many at once as the machine has processors; `report` sees the rows each time
/// that as many scans as there are faults have ended, and the seed that is next then.
fn run_all<'a>(
    cases: &'a [Case],
    seeds: &Range<u64>,
    scale: f64,
    report: impl Fn(&[Row<'a>], u64) + Sync,
) -> Vec<Row<'a>> {
    let rows: Vec<Row> = cases.iter().map(|case| (case, Default::default())).collect();
    let (next, done) = (AtomicUsize::new(0), Mutex::new((rows, 0)));
    let work = || {
        loop {
            let job = next.fetch_add(1, Ordering::Relaxed);
            let (seed, index) = (seeds.start + (job / cases.len()) as u64, job % cases.len());
            if seed >= seeds.end {
                return;
            }
            let case = &cases[index];
            let found = run(case, seed, scale);
            let mut done = done.lock().unwrap_or_else(PoisonError::into_inner);
            let (rows, ended) = &mut *done;
            let ways = [("live", case.live), ("alone", case.alone)].into_iter().zip(found);
            for (tally, ((way, expected), found)) in rows[index].1.iter_mut().zip(ways) {
                let Some(found) = found else { continue };
                println!(
                    "{} seed {seed} {way}: {} ({}), wrong {:?}, all {:?}",
                    case.name, found.headline, found.verdict, found.wrong, found.all
                );
                if !expected.contains(&found.headline.as_str()) {
                    keep(&format!("{} seed {seed} {way}", case.name), &found.report);
                }
                tally.add(&found, expected);
            }
            *ended += 1;
            if *ended % cases.len() == 0 {
                report(rows, seeds.start + (*ended / cases.len()) as u64);
            }
        }
    };
    let workers = thread::available_parallelism().map_or(1, usize::from);
    thread::scope(|scope| {
        let running: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        running.into_iter().for_each(|worker| worker.join().expect("no scan panics"));
    });
    done.into_inner().unwrap_or_else(PoisonError::into_inner).0
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
    let wrong = report["truth"]["wrong_code_rate"].as_f64();
    Found { headline, verdict, wrong, all, report: report.clone() }
}

/// Keeps a report for somebody who wants to know why its fault was named wrong.
fn keep(name: &str, report: &Value) {
    if let Ok(folder) = env::var("POLSCAN_FAULTS_REPORTS") {
        fs::create_dir_all(&folder).unwrap_or_else(|error| panic!("{folder}: {error}"));
        let path = format!("{folder}/{name}.json");
        fs::write(&path, format!("{report:#}")).unwrap_or_else(|error| panic!("{path}: {error}"));
    }
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

fn table(rows: &[Row], seeds: &Range<u64>, scale: f64) -> String {
    let mut text =
        format!("Seeds {} to {}, the paper's rig divided by {scale}.\n\n", seeds.start, seeds.end - 1);
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
