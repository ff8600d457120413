//! Long runs of the service: what takes minutes, and what is measured. Each prints what it found; the suite `service`
//! has short forms of the runs. The machine should have nothing else to do.

#[path = "../service/client.rs"]
#[allow(dead_code, reason = "the other suite needs more of it")]
mod client;
#[path = "../service/daemon.rs"]
#[allow(dead_code, reason = "the other suite needs more of it")]
mod daemon;
mod figures;
#[path = "../service/kills.rs"]
mod kills;
#[path = "../service/listing.rs"]
mod listing;
#[path = "../end_to_end/rig.rs"]
#[allow(dead_code, reason = "the other suites need more of it")]
mod rig;
#[path = "../service/soak.rs"]
mod soak;

use std::time::Duration;

/// Most that resident memory may grow by, in KiB a scan, once everything that is bounded is full: less than one
/// of its events takes for each of them.
const MOST_GROWTH_KIB: f64 = 2.0;

/// Scans until everything that is bounded is full: the 4096 latest events after some 166, the 2 MiB of the index that SQLite
/// keeps in memory after some 300.
const FULL: usize = 350;

/// Longest time for a page.
const PAGE: Duration = Duration::from_millis(50);

#[test]
fn five_hundred_scans_in_a_row() {
    let run = soak::soak(500, 10);
    println!("scans  resident KiB  descriptors");
    for one in &run.samples {
        println!("{:5}  {:12}  {:11}", one.scans, one.memory_kib, one.descriptors);
    }
    let memory = run.slope(FULL, |one| one.memory_kib as f64);
    let descriptors = run.slope(10, |one| one.descriptors as f64);
    println!(
        "{} events to each of 2 followers over {} connections, {} requests, {:.1} s; from scan {FULL} on {memory:+.2} \
         KiB a scan, descriptors {descriptors:+.4} a scan",
        run.events,
        run.connections,
        run.requests,
        run.took.as_secs_f64()
    );
    assert!(memory < MOST_GROWTH_KIB, "memory grows by {memory} KiB a scan");
    assert!(descriptors.abs() < 0.02, "descriptors grow by {descriptors} a scan");
}

#[test]
fn ten_thousand_scans_are_listed() {
    let paging = listing::page_through(10_000);
    println!("start with 10 000 scans: {:.0} ms", 1e3 * paging.start.as_secs_f64());
    let filters: std::collections::BTreeSet<&String> =
        paging.pages.iter().map(|(filter, _)| filter).collect();
    for filter in filters {
        let mut times: Vec<f64> = paging
            .pages
            .iter()
            .filter(|(other, _)| other == filter)
            .map(|(_, time)| 1e3 * time.as_secs_f64())
            .collect();
        times.sort_by(f64::total_cmp);
        let (count, most) = (times.len(), times[times.len() - 1]);
        println!("{count:4} pages, median {:6.2} ms, longest {most:6.2} ms  `{filter}`", times[count / 2]);
    }
    let slow: Vec<_> = paging.pages.iter().filter(|(_, time)| *time >= PAGE).collect();
    assert!(slow.is_empty(), "{slow:?}");
}

#[test]
fn fifty_deaths() {
    let seed = std::env::var("POLSCAN_KILLS_SEED").ok().and_then(|seed| seed.parse().ok()).unwrap_or(1);
    let (done, met) = kills::die(50, seed);
    println!("50 deaths (seed {seed}): {done} scans were acknowledged as done; states met: {met:?}");
    assert!(done >= 20, "{done}");
}
