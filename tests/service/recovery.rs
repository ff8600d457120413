//! What is left when the process dies in the middle.

use std::{fs, time::Duration};

use serde_json::{Value, json};

use crate::{
    daemon::{Daemon, sha256},
    rig::{json as json_file, polscan, text},
};

/// Deaths in the test below; each takes a second or two.
const DEATHS: u64 = 8;

/// What must hold after every start.
fn check(daemon: &Daemon) -> Vec<Value> {
    let scans =
        daemon.get("/v1/scans?limit=500").expect(200).json()["scans"].as_array().expect("scans").clone();
    let mut with_bundle: Vec<String> = Vec::new();
    for scan in &scans {
        let state = scan["state"].as_str().expect("a state");
        assert!(["done", "interrupted", "queued"].contains(&state), "{scan}");
        assert!(state != "queued" || scan["held"] == true, "{scan}");
        if !scan["bytes"].is_null() {
            with_bundle.push(scan["id"].as_str().expect("an identity").to_owned());
        }
    }
    with_bundle.sort();
    // The index and the disk agree, and nothing unfinished has a name.
    assert_eq!(daemon.bundles(), with_bundle);
    for id in &with_bundle {
        let bundle = daemon.store.join(id);
        let manifest = json_file(&bundle.join("manifest.json"));
        assert_eq!(manifest["id"], id.as_str());
        // Whatever is there is whole.
        for (name, entry) in manifest["files"].as_object().expect("files") {
            let bytes = fs::read(bundle.join(name)).expect("a file of the manifest");
            assert_eq!(sha256(&bytes), entry["sha256"].as_str().expect("a hash"), "{name}");
        }
        assert!(bundle.join("frames.npy").is_file() && bundle.join("report.json").is_file());
    }
    let left = fs::read_dir(daemon.store.join(".spool")).map_or(0, Iterator::count);
    assert_eq!(left, 0, "spools");
    scans
}

#[test]
fn a_death_at_any_moment_leaves_a_store_that_agrees_with_itself() {
    let mut daemon = Daemon::real_time();
    let mut interrupted = 0;
    for death in 0..DEATHS {
        daemon.ready();
        let id = daemon.scan(&json!({ "mode": "fast" }));
        let waiting = daemon.scan(&json!({ "mode": "fast", "queue": true }));
        // From the first frames into the writing of the result.
        std::thread::sleep(Duration::from_millis(60 + 330 * death));
        let before = daemon.state(&id);
        daemon.kill();
        daemon.start();
        let scans = check(&daemon);
        let after = daemon.state(&id);
        assert!(after["revision"].as_u64() >= before["revision"].as_u64());
        if after["state"] == "interrupted" {
            interrupted += 1;
            assert_eq!(after["error"]["type"], "interrupted");
            // The last frame or two may still have been on their way to the disk.
            let (seen, kept) = (before["progress"]["frames"].as_u64().unwrap(), &after["bytes"]);
            assert!(seen < 3 || kept.is_u64(), "{after}");
        }
        assert_eq!(scans.len() as u64, death + 2);
        let cancelled = daemon.post(&format!("/v1/scans/{waiting}/cancel"), &json!({}));
        let answer = String::from_utf8_lossy(&cancelled.body).into_owned();
        assert!([202, 409].contains(&cancelled.status), "{} {answer}", cancelled.status);
        // Terminal states of earlier rounds included.
        let ended = |scan: &Value| {
            !["queued", "projecting", "acquired", "decoding"].contains(&scan["state"].as_str().unwrap_or(""))
        };
        let state = daemon.until(&waiting, ended)["state"].clone();
        assert!(state == "cancelled" || state == "interrupted" || state == "done", "{state} after {answer}");
        daemon.request("DELETE", &format!("/v1/scans/{waiting}"), &json!({})).expect(204);
    }
    daemon.finished_scan();
    assert!(interrupted >= 2, "{interrupted} of {DEATHS} deaths hit a scan");
}

#[test]
fn queued_scans_wait_for_somebody_after_a_restart() {
    let mut daemon = Daemon::real_time();
    let running = daemon.scan(&json!({ "mode": "fast" }));
    let queued = daemon.scan(&json!({ "mode": "fast", "queue": true, "label": "later" }));
    daemon.until(&running, |scan| scan["progress"]["frames"].as_u64() >= Some(4));
    daemon.kill();
    daemon.start();
    daemon.ready();
    let interrupted = daemon.state(&running);
    assert_eq!(interrupted["state"], "interrupted");
    let report = daemon.get(&format!("/v1/scans/{running}/report.json")).expect(200).json();
    assert_eq!(
        (&report["verdict"], &report["reasons"][0]["type"]),
        (&json!("failed"), &json!("interrupted"))
    );
    assert!(report["frames"].as_u64() >= Some(3), "{report}");
    let waiting = daemon.state(&queued);
    assert_eq!(
        (&waiting["state"], &waiting["held"], &waiting["label"]),
        (&json!("queued"), &json!(true), &json!("later"))
    );
    // Somebody else does not have to wait for it.
    daemon.finished_scan();
    assert_eq!(daemon.state(&queued)["state"], "queued");
    assert_eq!(daemon.post("/v1/queue/resume", &json!({})).expect(200).json()["scans"], 1);
    assert_eq!(daemon.done(&queued)["state"], "done");
    assert_eq!(daemon.state(&running)["state"], "interrupted", "a terminal state never changes");
}

#[test]
fn a_lost_index_is_made_again_with_pins_and_tags() {
    let mut daemon = Daemon::fast();
    let id = daemon.finished_scan()["id"].as_str().unwrap().to_owned();
    let other = daemon.finished_scan()["id"].as_str().unwrap().to_owned();
    let patch = json!({ "label": "kept", "tags": ["t"], "pinned": true });
    let patched = daemon.request("PATCH", &format!("/v1/scans/{id}"), &patch).expect(200).json();
    assert_eq!((&patched["label"], &patched["pinned"]), (&json!("kept"), &json!(true)));
    assert!(daemon.stop().success());
    for name in ["index.sqlite", "index.sqlite-wal", "index.sqlite-shm"] {
        let _ = fs::remove_file(daemon.store.join(name));
    }
    daemon.start();
    let found = daemon.state(&id);
    for key in ["label", "tags", "pinned", "state", "verdict", "created", "mode", "points", "bytes"] {
        assert_eq!(found[key], patched[key], "{key}");
    }
    assert_eq!(daemon.state(&other)["state"], "done");
    assert_eq!(daemon.request("DELETE", &format!("/v1/scans/{id}"), &json!({})).expect(409).slug(), "pinned");

    // By hand, while the service does not run; and from bundles alone.
    let running = polscan(&["store", "reindex", "--config", text(&daemon.rig.config())]);
    assert_eq!(running.code, 74, "{}", running.stderr);
    assert!(daemon.stop().success());
    fs::remove_file(daemon.store.join(&other).join("scan.json")).unwrap();
    fs::write(daemon.store.join("index.sqlite"), vec![1; 9999]).unwrap();
    let run = polscan(&["store", "reindex", "--json", "--config", text(&daemon.rig.config())]).expect(0);
    assert_eq!(serde_json::from_str::<Value>(&run.stdout).unwrap()["scans"], 2);
    daemon.start();
    let found = daemon.state(&other);
    assert_eq!(
        (&found["state"], &found["verdict"], &found["mode"]),
        (&json!("done"), &json!("ok"), &json!("fast"))
    );
    daemon.get(&format!("/v1/scans/{other}/cloud.ply")).expect(200);
}
