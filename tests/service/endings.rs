//! Scans whose frames have come when somebody asks to stop: no end may cost what was captured.

use serde_json::{Value, json};

use crate::{client::send, daemon::Daemon, rig::Rig};

/// A service in which a captured scan waits behind decodes of recorded frames: its identity, and theirs.
fn captured_behind_decodes(daemon: &Daemon) -> (String, Vec<String>) {
    let source = daemon.finished_scan()["id"].as_str().expect("an identity").to_owned();
    let id = daemon.scan(&json!({ "mode": "pse" }));
    daemon.until(&id, |scan| scan["progress"]["frames"].as_u64() >= Some(2));
    // The last frames are some tenths of a second away.
    let again = || {
        let answer = daemon.post(&format!("/v1/scans/{source}/reprocess"), &json!({})).expect(202);
        answer.json()["id"].as_str().expect("an identity").to_owned()
    };
    let decodes = (0..8).map(|_| again()).collect();
    daemon.until(&id, |scan| scan["state"] != "projecting");
    assert_eq!(daemon.state(&id)["state"], "acquired", "the decodes before it have ended too soon");
    (id, decodes)
}

fn kept(daemon: &Daemon, id: &str) -> Value {
    let frames = daemon.get(&format!("/v1/scans/{id}/frames.npy")).expect(200);
    assert!(frames.body.starts_with(b"\x93NUMPY"));
    daemon.get(&format!("/v1/scans/{id}/report.json")).expect(200).json()
}

#[test]
fn a_scan_that_is_cancelled_after_its_capture_keeps_all_frames() {
    let daemon = Daemon::real_time();
    let (id, decodes) = captured_behind_decodes(&daemon);
    daemon.post(&format!("/v1/scans/{id}/cancel"), &json!({})).expect(202);
    // What has not begun ends at once, and leaves nothing behind.
    let last = decodes.last().expect("decodes");
    daemon.post(&format!("/v1/scans/{last}/cancel"), &json!({})).expect(202);
    assert_eq!(daemon.state(last)["state"], "cancelled");
    let scan = daemon.done(&id);
    assert_eq!(
        (&scan["state"], &scan["error"]["type"]),
        (&json!("cancelled"), &json!("cancelled")),
        "{scan}"
    );
    assert_eq!(scan["progress"]["frames"], scan["progress"]["of"]);
    let report = kept(&daemon, &id);
    assert_eq!(report["reasons"][0]["type"], "cancelled", "{report}");
    daemon.get(&format!("/v1/scans/{id}/cloud.ply")).expect(404);
    for decode in &decodes[..decodes.len() - 1] {
        assert_eq!(daemon.done(decode)["state"], "done");
    }
    assert!(!daemon.bundles().contains(last), "nothing was decoded");
    // They are as good as any others.
    let again = daemon.post(&format!("/v1/scans/{id}/reprocess?wait=done"), &json!({})).expect(202).json();
    assert_eq!((&again["state"], &again["verdict"]), (&json!("done"), &json!("ok")), "{again}");
}

#[test]
fn a_stop_that_outlasts_its_grace_keeps_what_was_captured() {
    let rig = Rig::small().set("sim.pacing", "real-time").set("api.stop_grace_s", 0.05);
    let mut daemon = Daemon::on(rig).started();
    let (id, decodes) = captured_behind_decodes(&daemon);
    let status = daemon.stop();
    assert!(status.success(), "{status}");
    daemon.start();
    let scan = daemon.state(&id);
    assert_eq!((&scan["state"], &scan["verdict"]), (&json!("done"), &json!("ok")), "{scan}");
    assert_eq!(kept(&daemon, &id)["verdict"], "ok");
    // Decodes of recorded frames can be asked for again: the stop has not waited for them.
    let states: Vec<Value> = decodes.iter().map(|decode| daemon.state(decode)["state"].clone()).collect();
    assert_eq!(states.last(), Some(&json!("interrupted")), "{states:?}");
    assert!(states.iter().all(|state| state == "done" || state == "interrupted"), "{states:?}");
}

#[test]
fn a_repeated_request_for_a_series_is_answered_with_all_of_it() {
    let mut daemon = Daemon::fast();
    let body = json!({ "mode": "fast", "repeat": 3 });
    let post = |daemon: &Daemon, query: &str| {
        let headers = [("Content-Type", "application/json"), ("Idempotency-Key", "series")];
        let path = format!("/v1/scans{query}");
        send(daemon.address(), "POST", &path, &headers, body.to_string().as_bytes()).expect(202).json()
    };
    let first = post(&daemon, "");
    assert_eq!(first["scans"].as_array().map(Vec::len), Some(3), "{first}");
    let other = daemon.post("/v1/scans", &json!({ "mode": "fast", "queue": true })).expect(202).json();
    assert_eq!(post(&daemon, "?wait=done")["scans"], first["scans"]);
    daemon.done(other["id"].as_str().expect("an identity"));
    daemon.kill();
    daemon.start();
    assert_eq!(post(&daemon, "")["scans"], first["scans"]);
    // Without those that were deleted; the first of them names the request all the same.
    for (at, left) in [(1, 2), (0, 2)] {
        let id = first["scans"][at].as_str().expect("an identity");
        daemon.request("DELETE", &format!("/v1/scans/{id}"), &json!({})).expect(204);
        let again = post(&daemon, "?wait=done");
        assert_eq!(again["scans"].as_array().map(Vec::len), Some(left), "{again}");
        assert_eq!(again["id"], first["id"]);
    }
    assert_eq!(post(&daemon, "")["error"]["type"], "deleted");
    assert_eq!(daemon.get("/v1/scans").json()["scans"].as_array().map(Vec::len), Some(2));
}
