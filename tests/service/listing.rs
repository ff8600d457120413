//! Lists of many scans.

use std::{
    collections::BTreeSet,
    time::{Duration, Instant},
};

use polscan::{
    scanner::{Record, State},
    store::Index,
};

use crate::{daemon::Daemon, rig::Rig};

/// What paging took.
#[derive(Debug)]
pub struct Paging {
    /// From the start of the process until it listens.
    pub start: Duration,
    /// Each page, with the filter that it was asked for with.
    pub pages: Vec<(String, Duration)>,
}

/// A scan of a store that has seen many: states, tags and labels as a lab has them.
fn record(number: usize) -> Record {
    const ENDS: [State; 4] = [State::Failed, State::Cancelled, State::Interrupted, State::Failed];
    // Ten of a burst have the same time: order must not hang on it.
    let (minute, burst) = (number / 10, number % 10);
    let created =
        format!("2026-01-{:02}T{:02}:{:02}:00.000Z", 1 + minute / 1440, minute / 60 % 24, minute % 60);
    let id = format!("0{:07x}-0000-7000-8000-{:012x}", minute, burst * 7919);
    let mut record = Record::new(id, ["pse", "fast"][number % 2].to_owned(), created);
    record.state = ENDS[number % ENDS.len()];
    record.label = Some(format!("part {}", number % 50));
    record.tags = vec![format!("batch-{}", number / 100), "bench".to_owned()];
    record.progress.of = 44;
    record
}

/// Pages through `count` scans that the index has, all of them and by filters, and checks every page against the list
/// that the index was filled with.
pub fn page_through(count: usize) -> Paging {
    let mut daemon = Daemon::on(Rig::scaled(8.0));
    std::fs::create_dir_all(&daemon.store).expect("a store");
    let (index, _) = Index::open(&daemon.store).expect("an index");
    let mut records: Vec<Record> = (0..count).map(record).collect();
    index.accept(&records, None).expect("the index takes scans");
    drop(index);
    records.sort_by(|a, b| (&b.created, &b.id).cmp(&(&a.created, &a.id)));
    let begun = Instant::now();
    daemon.start();
    let start = begun.elapsed();
    let mut pages = Vec::new();
    type Belongs = fn(&Record) -> bool;
    let filters: [(&str, Belongs); 6] = [
        ("", |_| true),
        ("&limit=500", |_| true),
        ("&limit=100&state=cancelled,interrupted", |one| one.state != State::Failed),
        ("&limit=100&label=part%207", |one| one.label.as_deref() == Some("part 7")),
        ("&limit=100&tag=bench,batch-3", |one| one.tags.iter().any(|tag| tag == "batch-3")),
        ("&limit=100&mode=fast&verdict=ok", |_| false),
    ];
    for (filter, belongs) in filters {
        let wanted: Vec<&str> =
            records.iter().filter(|one| belongs(one)).map(|one| one.id.as_str()).collect();
        let mut found: Vec<String> = Vec::new();
        let mut cursor = String::new();
        loop {
            let path = format!("/v1/scans?{}{cursor}", filter.trim_start_matches('&'));
            let asked = Instant::now();
            let answer = daemon.get(&path);
            pages.push((filter.to_owned(), asked.elapsed()));
            let page = answer.expect(200).json();
            let scans = page["scans"].as_array().expect("scans");
            found.extend(scans.iter().map(|scan| scan["id"].as_str().expect("an identity").to_owned()));
            let Some(next) = page["next"].as_str() else { break };
            cursor = format!("&cursor={next}");
        }
        assert_eq!(found.iter().collect::<BTreeSet<_>>().len(), found.len(), "none twice with `{filter}`");
        assert_eq!(found, wanted, "with `{filter}`");
    }
    Paging { start, pages }
}

#[test]
fn pages_of_many_scans_are_complete_and_in_order() {
    page_through(2000);
}
