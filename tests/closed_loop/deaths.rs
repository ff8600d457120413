//! A device dies in the middle of a scan: what the service says of it and when, and that the next scan works.

use std::time::{Duration, Instant};

use rustix::process::{Signal, kill_process};
use serde_json::{Value, json};

use crate::{
    client::Events,
    daemon::Daemon,
    rig::Rig,
    stage::Stage,
    xvfb::{Xvfb, eventually, window_process},
};

/// From the death until the scan has failed: patience with a picture of 1 s or with a lost frame, tries included, the
/// frames so far written, and all of it on a busy machine.
const DEADLINE: Duration = Duration::from_secs(15);

/// Frames that a scan has when its device dies.
const IN_THE_MIDDLE: u64 = 6;

/// The stage of a small twin, and the service on it.
pub fn set_up() -> (Stage, Daemon) {
    let stage = Stage::new(Rig::small(), 20.0);
    let daemon = stage.daemon(Rig::small());
    daemon.ready();
    (stage, daemon)
}

/// Begins a scan and waits until it is in the middle.
pub fn in_the_middle(daemon: &Daemon) -> String {
    let id = daemon.scan(&json!({ "mode": "fast" }));
    daemon.until(&id, |scan| {
        let stream = || daemon.get("/v1/status").json()["camera_stream"].clone();
        assert!(scan["state"] != "failed", "{scan} {}", stream());
        scan["progress"]["frames"].as_u64() >= Some(IN_THE_MIDDLE)
    });
    id
}

/// The scan that failed since `since`, whose error says all of `says`, as does the status.
#[track_caller]
pub fn failed(daemon: &Daemon, id: &str, since: Instant, kind: &str, says: &[&str]) {
    let scan = daemon.until(id, |scan| scan["state"] == "failed");
    let after = since.elapsed();
    assert!(after < DEADLINE, "{after:?}");
    let error = &scan["error"];
    assert_eq!(error["type"], kind, "{scan}");
    let said = |message: &Value| {
        let message = message.as_str().unwrap_or_default().to_owned();
        says.iter().all(|word| message.contains(word))
    };
    assert!(said(&error["message"]), "{scan}");
    let frames = scan["progress"]["frames"].as_u64();
    assert!(frames >= Some(IN_THE_MIDDLE) && frames < scan["progress"]["of"].as_u64(), "{scan}");
    println!("failed {after:.1?} after the death: {}", error["message"]);
}

/// Waits until the status says that the rig is out of order, in words that hold all of `says`.
#[track_caller]
fn out_of_order(daemon: &Daemon, says: &[&str]) {
    eventually("the status says so", || {
        let status = daemon.get("/v1/status").json();
        let message = status["rig_message"].as_str().unwrap_or_default();
        let said = status["state"] == "fault" && status["rig"] == "fault" && status["ready"] == false;
        said && says.iter().all(|word| message.contains(word))
    });
    let refused = daemon.post("/v1/scans", &json!({ "mode": "fast" })).expect(503);
    assert_eq!(refused.slug(), "not-ready");
}

/// Number of the window's process, as the status has it.
fn process(status: &Value) -> Option<i64> {
    status["projector"]["display"]["process"]["pid"].as_i64()
}

/// Waits for the event that says that the rig is out of order, in words that hold `says`.
fn tells_fault(events: &mut Events, says: &str) {
    let fault = std::iter::repeat_with(|| events.next())
        .find(|event| event.kind == "rig" && event.data["state"] == "fault")
        .expect("events go on");
    let message = fault.data["message"].as_str().expect("a message");
    assert!(message.contains(says), "{message}");
}

/// The next scan, once the rig is open again.
#[track_caller]
pub fn works_again(daemon: &Daemon) {
    daemon.ready();
    let scan = daemon.post("/v1/scans?wait=done", &json!({ "mode": "fast" })).expect(202).json();
    assert_eq!(scan["state"], "done", "{scan}");
    let status = daemon.get("/v1/status").json();
    assert_eq!((&status["rig"], &status["rig_message"]), (&"ready".into(), &Value::Null), "{status}");
}

#[test]
fn a_display_server_that_dies_fails_the_scan_and_its_successor_serves_the_next() {
    let (mut stage, daemon) = set_up();
    let id = in_the_middle(&daemon);
    stage.xvfb.kill();
    failed(&daemon, &id, Instant::now(), "device-fault", &["screen"]);
    out_of_order(&daemon, &["X server", &stage.xvfb.display()]);
    stage.xvfb = Xvfb::start_at(stage.xvfb.number, 256, 192);
    works_again(&daemon);
}

#[test]
fn a_window_that_is_killed_fails_the_scan_and_is_opened_again_for_the_next() {
    let (stage, daemon) = set_up();
    let first = window_process(&stage.xvfb);
    let number = i64::from(first.as_raw_nonzero().get());
    assert_eq!(process(&daemon.get("/v1/status").json()), Some(number));
    let id = in_the_middle(&daemon);
    let mut events = Events::follow(daemon.address(), None);
    kill_process(first, Signal::KILL).expect("it runs");
    failed(&daemon, &id, Instant::now(), "device-fault", &["screen", "window is gone", "signal: 9"]);
    // It is opened again within the second, so that only the events say for certain what the status said meanwhile.
    tells_fault(&mut events, "window is gone");
    works_again(&daemon);
    let second = window_process(&stage.xvfb);
    assert_ne!(second, first);
    assert_eq!(process(&daemon.get("/v1/status").json()), Some(i64::from(second.as_raw_nonzero().get())));
}

#[test]
fn a_camera_that_falls_silent_fails_the_scan_and_serves_the_next_when_it_is_back() {
    let (stage, daemon) = set_up();
    let id = in_the_middle(&daemon);
    let stopped = stage.stop_camera();
    failed(&daemon, &id, Instant::now(), "device-fault", &["127.0.0.1"]);
    out_of_order(&daemon, &["127.0.0.1"]);
    drop(stopped);
    works_again(&daemon);
}

#[test]
fn a_window_that_is_killed_while_nothing_is_asked_of_it_is_opened_again_and_said() {
    let (stage, daemon) = set_up();
    daemon.request("PUT", "/v1/projector", &json!({ "show": "white" })).expect(200);
    assert!(stage.xvfb.screen().iter().all(|byte| *byte == 255));
    let mut events = Events::follow(daemon.address(), None);
    let first = window_process(&stage.xvfb);
    kill_process(first, Signal::KILL).expect("it runs");
    tells_fault(&mut events, "window is gone");
    daemon.ready();
    let status = daemon.get("/v1/status").json();
    assert_eq!(status["showing"], Value::Null, "{status}");
    assert_eq!(process(&status), Some(i64::from(window_process(&stage.xvfb).as_raw_nonzero().get())));
    daemon.request("PUT", "/v1/projector", &json!({ "show": "white" })).expect(200);
    assert!(stage.xvfb.screen().iter().all(|byte| *byte == 255));
}
