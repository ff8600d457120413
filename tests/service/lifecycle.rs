//! Starting, ending, and what service managers and scripts see of it.

use std::{fs, os::unix::net::UnixDatagram, path::Path, process::Command, time::Duration};

use serde_json::json;

use crate::{
    daemon::Daemon,
    rig::{Rig, polscan, run, text},
};

#[test]
fn the_service_manager_is_told_and_the_running_scan_comes_to_its_end() {
    let rig = Rig::small().set("sim.pacing", "real-time");
    let path = rig.path("notify");
    let manager = UnixDatagram::bind(&path).unwrap();
    manager.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
    let mut daemon =
        Daemon::on(rig).with("NOTIFY_SOCKET", text(&path)).with("WATCHDOG_USEC", "2000000").started();
    let mut heard: Vec<String> = Vec::new();
    let hear = |wanted: &str, heard: &mut Vec<String>| {
        while !heard.iter().any(|text| text.starts_with(wanted)) {
            let mut buffer = [0; 1024];
            let length =
                manager.recv(&mut buffer).unwrap_or_else(|error| panic!("{wanted}: {error}, {heard:?}"));
            heard.push(String::from_utf8(buffer[..length].to_vec()).unwrap());
        }
    };
    hear("READY=1", &mut heard);
    hear("WATCHDOG=1", &mut heard);
    hear("STATUS=", &mut heard);
    let id = daemon.scan(&json!({ "mode": "fast" }));
    let queued = daemon.scan(&json!({ "mode": "fast", "queue": true }));
    daemon.until(&id, |scan| scan["state"] == "projecting");
    daemon.terminate();
    hear("STOPPING=1", &mut heard);
    // Whoever waits gets an answer, nobody new gets a scan.
    let refused = daemon.post("/v1/scans", &json!({}));
    assert_eq!(refused.expect(503).json()["reasons"][0]["type"], "stopping");
    assert_eq!(daemon.done(&id)["state"], "done");
    let status = daemon.stop_waiting();
    assert!(status.success(), "{status}");
    daemon.start();
    assert_eq!(daemon.state(&id)["state"], "done");
    assert_eq!(daemon.state(&queued)["state"], "queued");
}

#[test]
fn a_scan_that_takes_longer_than_the_service_may_is_cut_short() {
    // Half a second for each of some forty patterns.
    let rig = Rig::small().set("sim.pacing", "real-time").set("projector.hold_refreshes", 30);
    let mut daemon = Daemon::on(rig.set("api.stop_grace_s", 0.5)).started();
    let id = daemon.scan(&json!({ "mode": "pse" }));
    daemon.until(&id, |scan| scan["progress"]["frames"].as_u64() >= Some(2));
    let asked = std::time::Instant::now();
    let status = daemon.stop();
    assert!(status.success(), "{status}");
    assert!(asked.elapsed() < Duration::from_secs(10), "{:?}", asked.elapsed());
    daemon.start();
    let scan = daemon.state(&id);
    assert_eq!(scan["state"], "interrupted", "{scan}");
    let frames = daemon.get(&format!("/v1/scans/{id}/frames.npy")).expect(200);
    assert!(frames.body.starts_with(b"\x93NUMPY"));
}

#[test]
fn what_keeps_a_service_from_starting_is_said() {
    let daemon = Daemon::fast();
    let config = daemon.rig.config();
    let second = polscan(&["serve", "--config", text(&config)]).expect(74);
    assert!(second.stderr.contains("another process"), "{}", second.stderr);
    let taken = daemon.address().to_string();
    let other = daemon.rig.path("other");
    let taken = polscan(&["serve", "--config", text(&config), "--listen", &taken, "--store", text(&other)])
        .expect(64);
    assert!(taken.stderr.contains("api.listen"), "{}", taken.stderr);
    let open = polscan(&["serve", "--config", text(&config), "--listen", "0.0.0.0:0"]).expect(64);
    assert!(open.stderr.contains("api.tokens"), "{}", open.stderr);
    let nowhere = polscan(&["serve", "--config", text(&config), "--store", "/proc/none"]).expect(74);
    assert!(nowhere.stderr.contains("/proc/none"), "{}", nowhere.stderr);
}

#[test]
fn a_service_without_a_rig_says_so_and_serves_what_it_has() {
    let daemon =
        Daemon::on(Rig::small().set("camera.driver", "none").set("projector.driver", "none")).started();
    daemon.get("/livez").expect(200);
    let start = std::time::Instant::now();
    while daemon.get("/v1/status").json()["rig"] != "fault" {
        assert!(start.elapsed() < Duration::from_secs(20));
    }
    let answer = daemon.post("/v1/scans", &json!({})).expect(503);
    assert_eq!(answer.slug(), "not-ready");
    assert!(
        answer.json()["reasons"][0]["message"].as_str().unwrap().contains("camera"),
        "{:?}",
        answer.json()
    );
    assert_eq!(daemon.get("/readyz").status, 503);
    daemon.request("PUT", "/v1/projector", &json!({ "show": "white" })).expect(503);
    daemon.get("/v1/preview.jpg").expect(503);
    daemon.get("/v1/scans").expect(200);
}

/// The examples as they are printed in the documentation, run against a service.
#[test]
fn the_examples_do_what_they_say() {
    let daemon = Daemon::fast();
    let examples = Path::new(env!("CARGO_MANIFEST_DIR")).join("examples");
    let url = format!("http://{}", daemon.address());
    let python = run(Command::new("python3").arg(examples.join("scan.py")).args([&url, "--mode", "fast"]));
    let python = python.expect(0);
    assert!(python.stdout.contains("points"), "{}", python.stdout);
    for program in ["curl", "jq"] {
        let found = Command::new(program).arg("--version").output();
        assert!(found.is_ok(), "{program} is missing: scripts/install test brings it");
    }
    let out = daemon.rig.path("cloud.ply");
    let shell = run(Command::new("bash").arg(examples.join("scan.sh")).arg(&url).arg(&out)).expect(0);
    assert!(shell.stdout.contains("done"), "{}", shell.stdout);
    assert!(fs::read(&out).unwrap().starts_with(b"ply\n"));
}

#[test]
fn the_sandbox_of_the_unit_is_as_tight_as_it_is_meant_to_be() {
    let unit = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd/polscan.service");
    let mut command = Command::new("systemd-analyze");
    // In tenths: an exposure above 2.5 is an error.
    command.args(["security", "--no-pager", "--offline=true", "--threshold=25"]).arg(&unit);
    let done = command.output().expect("systemd-analyze, which scripts/install test brings");
    assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stdout));
}
