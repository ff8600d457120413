//! Deaths at random moments while clients ask for scans, and what every one of them must leave.

use std::{
    collections::BTreeMap,
    fs,
    net::SocketAddr,
    sync::atomic::{AtomicUsize, Ordering},
    time::{Duration, Instant},
};

use rand::{RngExt, SeedableRng, rngs::StdRng};
use serde_json::{Value, json};

use crate::{
    client::{Answer, try_send},
    daemon::{Daemon, sha256},
    rig::{Rig, json as json_file},
};

/// Clients that ask for scans at the same time.
const CLIENTS: usize = 2;

/// Longest life of a service between two deaths, beyond the opening of its rig.
const LIFE: Duration = Duration::from_millis(1500);

/// What a client knows of one of its requests.
#[derive(Debug, Default, Clone)]
struct Asked {
    /// The scan, where the answer arrived.
    location: Option<String>,
    /// Files and their hashes, where the client saw the scan done.
    done: Option<BTreeMap<String, String>>,
}

fn post(address: SocketAddr, key: &str, mode: &str) -> Option<Answer> {
    let headers = [("Content-Type", "application/json"), ("Idempotency-Key", key)];
    let body = json!({ "mode": mode, "label": key, "queue": true }).to_string();
    try_send(address, "POST", "/v1/scans", &headers, body.as_bytes())
}

/// Files of a scan and their hashes.
fn hashes(scan: &Value) -> BTreeMap<String, String> {
    let text = |value: &Value| value.as_str().expect("text").to_owned();
    let files = scan["artifacts"].as_array().expect("files");
    files.iter().map(|file| (text(&file["name"]), text(&file["sha256"]))).collect()
}

/// Asks for one scan after the other until the service is gone, and says what it knows of each.
fn client(address: SocketAddr, name: &str, seen: &AtomicUsize) -> BTreeMap<String, Asked> {
    let mut all = BTreeMap::new();
    for number in 0.. {
        let key = format!("{name}-{number}");
        let entry: &mut Asked = all.entry(key.clone()).or_default();
        let Some(answer) = post(address, &key, "fast") else { break };
        let answer = answer.expect(202);
        let location = answer.header("location").to_owned();
        entry.location = Some(location.clone());
        let Some(answer) = try_send(address, "GET", &format!("{location}?wait=done"), &[], b"") else {
            break;
        };
        let scan = answer.expect(200).json();
        assert_eq!(scan["state"], "done", "{scan}");
        entry.done = Some(hashes(&scan));
        seen.fetch_add(1, Ordering::Relaxed);
    }
    all
}

/// That disk and index agree, and that nothing unfinished has a name. Answers the scans by their labels.
fn check_store(daemon: &Daemon) -> BTreeMap<String, Value> {
    let mut scans = Vec::new();
    let mut path = "/v1/scans?limit=500".to_owned();
    loop {
        let page = daemon.get(&path).expect(200).json();
        scans.extend(page["scans"].as_array().expect("scans").clone());
        let Some(next) = page["next"].as_str() else { break };
        path = format!("/v1/scans?limit=500&cursor={next}");
    }
    let mut with_bundle = Vec::new();
    let mut by_label = BTreeMap::new();
    for scan in scans {
        let (id, label) = (scan["id"].as_str().expect("an identity"), scan["label"].as_str().unwrap_or(""));
        let state = scan["state"].as_str().expect("a state");
        assert!(["done", "interrupted", "cancelled", "queued"].contains(&state), "{scan}");
        assert!(state != "queued" || scan["held"] == true, "{scan}");
        assert!(state != "done" || !scan["bytes"].is_null(), "{scan}");
        if !scan["bytes"].is_null() {
            with_bundle.push(id.to_owned());
        }
        let twice = by_label.insert(label.to_owned(), scan.clone());
        assert!(twice.is_none(), "two scans of one key: {twice:?} and {scan}");
    }
    with_bundle.sort();
    assert_eq!(daemon.bundles(), with_bundle);
    by_label
}

/// That a bundle is whole: every file has the hash that its manifest says.
fn files_on_disk(daemon: &Daemon, id: &str) -> BTreeMap<String, String> {
    let bundle = daemon.store.join(id);
    let manifest = json_file(&bundle.join("manifest.json"));
    assert_eq!(manifest["id"], id);
    let files = manifest["files"].as_object().expect("files");
    let mut found: BTreeMap<String, String> = BTreeMap::new();
    for (name, entry) in files {
        let hash = sha256(&fs::read(bundle.join(name)).expect("a file of the manifest"));
        assert_eq!(hash, entry["sha256"].as_str().expect("a hash"), "{id}/{name}");
        found.insert(name.clone(), hash);
    }
    found
}

/// Lets the service die `deaths` times and checks what is left after each. Answers how many scans were seen done, and
/// how many were interrupted in each state.
pub fn die(deaths: usize, seed: u64) -> (usize, BTreeMap<String, usize>) {
    let mut random = StdRng::seed_from_u64(seed);
    let mut daemon =
        Daemon::on(Rig::scaled(8.0).set("sim.pacing", "real-time").set("scan.queue_capacity", 64)).started();
    let mut all: BTreeMap<String, Asked> = BTreeMap::new();
    let mut met: BTreeMap<String, usize> = BTreeMap::new();
    for death in 0..deaths {
        daemon.ready();
        let address = daemon.address();
        let life = LIFE.mul_f64(random.random::<f64>());
        let seen = AtomicUsize::new(0);
        let asked = std::thread::scope(|scope| {
            let names = (0..CLIENTS).map(|client| format!("d{death}-c{client}"));
            let seen = &seen;
            let clients: Vec<_> =
                names.map(|name| scope.spawn(move || client(address, &name, seen))).collect();
            // Every other life sees a scan done, however slow the machine is.
            let start = Instant::now();
            while death % 2 == 1 && seen.load(Ordering::Relaxed) == 0 {
                assert!(start.elapsed() < Duration::from_secs(60), "no scan is done");
                std::thread::sleep(Duration::from_millis(5));
            }
            std::thread::sleep(life);
            let status = try_send(address, "GET", "/v1/scans?limit=2", &[], b"").map(|answer| answer.json());
            daemon.kill();
            for scan in status.iter().flat_map(|page| page["scans"].as_array().into_iter().flatten()) {
                *met.entry(scan["state"].as_str().unwrap_or("").to_owned()).or_default() += 1;
            }
            clients.into_iter().flat_map(|client| client.join().expect("a client")).collect::<Vec<_>>()
        });
        let fresh: Vec<String> = asked.iter().map(|(key, _)| key.clone()).collect();
        all.extend(asked);
        // Before anything is put in order: what has its final name is whole.
        for id in daemon.bundles().iter().filter(|name| !name.ends_with(".partial")) {
            files_on_disk(&daemon, id);
        }
        daemon.start();
        let scans = check_store(&daemon);
        assert!(daemon.bundles().iter().all(|name| !name.ends_with(".partial")));
        for (key, asked) in &all {
            let found = scans.get(key);
            let Some(location) = &asked.location else { continue };
            let scan = found.unwrap_or_else(|| panic!("{key} was accepted and is gone: {asked:?}"));
            assert_eq!(scan["href"], location.as_str());
            if let Some(done) = &asked.done {
                assert_eq!(scan["state"], "done", "{scan}");
                let id = scan["id"].as_str().expect("an identity");
                let mut on_disk = files_on_disk(&daemon, id);
                let listed = hashes(&daemon.state(id));
                assert_eq!(&listed, done, "{id}");
                on_disk.retain(|name, _| done.contains_key(name));
                let mut named = done.clone();
                named.retain(|name, _| on_disk.contains_key(name));
                assert!(!on_disk.is_empty() && on_disk == named, "{id}");
            }
        }
        again(&daemon, &fresh, &scans, &mut all);
        release(&daemon);
    }
    (all.values().filter(|asked| asked.done.is_some()).count(), met)
}

/// Asks again with the same keys: what was begun is the answer, and another request is refused.
fn again(
    daemon: &Daemon,
    keys: &[String],
    before: &BTreeMap<String, Value>,
    all: &mut BTreeMap<String, Asked>,
) {
    for key in keys {
        let location =
            post(daemon.address(), key, "fast").expect("an answer").expect(202).header("location").to_owned();
        if let Some(scan) = before.get(key) {
            assert_eq!(scan["href"], location.as_str(), "{key}");
        }
        let other = post(daemon.address(), key, "gray").expect("an answer").expect(422);
        assert_eq!(other.slug(), "idempotency-key-reused");
        all.entry(key.clone()).or_default().location = Some(location);
    }
}

/// Cancels whatever waits and lets the rest end, so that the next life begins with an idle rig.
fn release(daemon: &Daemon) {
    let start = Instant::now();
    loop {
        let open = "/v1/scans?limit=500&state=queued,projecting,acquired,decoding";
        let page = daemon.get(open).expect(200).json();
        let scans = page["scans"].as_array().expect("scans");
        if scans.is_empty() {
            return;
        }
        for scan in scans.iter().filter(|scan| scan["held"] == true) {
            let path = format!("{}/cancel", scan["href"].as_str().expect("an address"));
            daemon.post(&path, &json!({})).expect(202);
        }
        assert!(start.elapsed() < Duration::from_secs(60), "{page}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[test]
fn deaths_under_load_lose_nothing_that_was_acknowledged() {
    let (done, met) = die(6, 20_211_130);
    assert!(done >= 3, "{done} scans were seen done, states met: {met:?}");
}
