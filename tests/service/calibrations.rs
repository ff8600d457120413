//! Calibrations over REST: what comes of them, who may have the rig, and what a restart leaves.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::{
    client::{Answer, Events},
    daemon::Daemon,
    rig::Rig,
};

fn id(answer: &Answer) -> String {
    let run = answer.json();
    assert_eq!(answer.header("location"), run["href"].as_str().expect("an address"));
    run["id"].as_str().expect("an identity").to_owned()
}

/// Begins a calibration.
#[track_caller]
fn begin(daemon: &Daemon, kind: &str, body: &Value) -> String {
    id(&daemon.post(&format!("/v1/calibrations/{kind}"), body).expect(202))
}

fn run(daemon: &Daemon, id: &str) -> Value {
    daemon.get(&format!("/v1/calibrations/{id}")).expect(200).json()
}

/// A calibration at its end.
#[track_caller]
fn ended(daemon: &Daemon, id: &str) -> Value {
    let start = Instant::now();
    loop {
        let run = run(daemon, id);
        if run["state"] != "running" {
            assert!(run["finished"].is_string(), "{run}");
            return run;
        }
        assert!(start.elapsed() < Duration::from_secs(60), "{run}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

fn cancel(daemon: &Daemon, id: &str) -> Answer {
    daemon.post(&format!("/v1/calibrations/{id}/cancel"), &json!({}))
}

/// Names of the files of a calibration.
fn names(run: &Value) -> Vec<&str> {
    let files = run["artifacts"].as_array().expect("files").iter();
    files.map(|file| file["name"].as_str().expect("a name")).collect()
}

fn text(daemon: &Daemon, id: &str, name: &str) -> String {
    let answer = daemon.get(&format!("/v1/calibrations/{id}/{name}")).expect(200);
    String::from_utf8(answer.body).expect("text")
}

/// A rig of the smallest size on which there is enough to measure.
fn tiny() -> Rig {
    Rig::scaled(8.0)
}

/// A calibration that takes its time.
fn slow() -> Daemon {
    let daemon = Daemon::on(tiny().set("sim.pacing", "real-time")).started();
    daemon.ready();
    daemon
}

#[test]
fn noise_and_timing_are_measured_told_listed_and_kept() {
    let mut daemon = Daemon::on(tiny()).started();
    daemon.ready();
    let mut events = Events::follow(daemon.address(), None);
    let noise = begin(&daemon, "noise", &json!({}));
    let mut steps = Vec::new();
    let last = loop {
        let event = events.next();
        if event.kind == "calibration" {
            assert_eq!((&event.data["id"], event.data["revision"].as_u64()), (&json!(noise), Some(event.id)));
            steps.extend(event.data["doing"].as_str().map(str::to_owned));
            if event.data["state"] != "running" {
                break event.data;
            }
        }
    };
    assert!(steps.len() > 3 && steps.iter().any(|step| step == "saturation"), "{steps:?}");
    let done = ended(&daemon, &noise);
    assert_eq!(
        (&done["state"], &done["accepted"], &last["state"]),
        (&json!("done"), &json!(true), &json!("done"))
    );
    assert!(names(&done).contains(&"noise.toml") && names(&done).contains(&"photon-transfer.svg"), "{done}");
    let file: toml::Table = text(&daemon, &noise, "noise.toml").parse().expect("TOML");
    // The twin's sensor holds 10 500 electrons.
    assert!((file["noise"]["full_well_e"].as_float().unwrap() / 10_500.0 - 1.0).abs() < 0.03, "{file}");
    for name in ["../scan.json", "..%2Findex.sqlite", "secret"] {
        daemon.get(&format!("/v1/calibrations/{noise}/{name}")).expect(404);
    }
    assert_eq!(cancel(&daemon, &noise).expect(409).slug(), "wrong-state");
    let sync = begin(&daemon, "sync", &json!({}));
    let timing = ended(&daemon, &sync);
    assert_eq!((&timing["state"], &timing["accepted"]), (&json!("done"), &json!(true)), "{timing}");
    let file: toml::Table = text(&daemon, &sync, "sync.toml").parse().expect("TOML");
    assert_eq!(file["timing"]["latency_refreshes"].as_integer(), Some(2), "{file}");
    // The camera is set as it was, and a restart forgets nothing.
    daemon.finished_scan();
    daemon.stop();
    daemon.start();
    let runs = daemon.get("/v1/calibrations").expect(200).json()["runs"].clone();
    assert_eq!(runs, json!([timing, done]), "the newest first");
    assert!(text(&daemon, &noise, "report.json").contains("polscan.noise-report/1"));
}

#[test]
fn a_camera_with_a_hidden_gamma_is_refused_with_the_reason() {
    let daemon = Daemon::on(tiny().fault("kind = \"hidden-gamma\", exponent = 0.9")).started();
    daemon.ready();
    let run = ended(&daemon, &begin(&daemon, "noise", &json!({})));
    assert_eq!((&run["state"], &run["accepted"]), (&json!("done"), &json!(false)), "{run}");
    assert!(run["refused"][0].as_str().unwrap().contains("not linear"), "{run}");
    assert!(!names(&run).contains(&"noise.toml") && names(&run).contains(&"linearity.svg"), "{run}");
}

#[test]
fn one_calibration_has_the_rig_until_it_is_cancelled() {
    let daemon = slow();
    let answers: Vec<Answer> = std::thread::scope(|scope| {
        let ask = |kind| daemon.post(&format!("/v1/calibrations/{kind}"), &json!({}));
        let clients = ["noise", "sync"].map(|kind| scope.spawn(move || ask(kind)));
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    let (begun, refused): (Vec<_>, Vec<_>) = answers.into_iter().partition(|answer| answer.status == 202);
    let [begun, refused] = [&begun[..], &refused[..]].map(|one| match one {
        [one] => one.json(),
        _ => panic!("one of two has the rig: {one:?}"),
    });
    let id = begun["id"].as_str().unwrap();
    assert_eq!((&refused["type"], &refused["status"]), (&json!("busy"), &json!(409)));
    assert_eq!((&refused["holder"]["id"], &refused["holder"]["calibration"]), (&begun["id"], &begun["kind"]));
    let status = daemon.get("/v1/status").expect(200).json();
    assert_eq!((&status["state"], &status["calibrating"]), (&json!("calibrating"), &begun["id"]));
    let busy = daemon.post("/v1/scans", &json!({ "mode": "fast" })).expect(409).json();
    assert_eq!(busy["holder"]["id"], begun["id"]);
    daemon.request("PUT", "/v1/projector", &json!({ "show": "h" })).expect(409);
    assert_eq!(daemon.get(&format!("/v1/calibrations/{id}/report.json")).expect(409).slug(), "not-finished");
    // A scan may wait for it.
    let scan = daemon.scan(&json!({ "mode": "fast", "queue": true }));
    assert_eq!(daemon.state(&scan)["state"], "queued");
    cancel(&daemon, id).expect(202);
    let run = ended(&daemon, id);
    assert_eq!((&run["state"], &run["error"]["type"]), (&json!("cancelled"), &json!("cancelled")), "{run}");
    assert_eq!((&run["accepted"], names(&run).len()), (&Value::Null, 0));
    cancel(&daemon, id).expect(202);
    assert_eq!(daemon.done(&scan)["state"], "done");
}

#[test]
fn a_calibration_that_was_cut_short_is_interrupted_and_the_rig_free_again() {
    let mut daemon = slow();
    let killed = begin(&daemon, "noise", &json!({}));
    daemon.kill();
    daemon.start();
    daemon.ready();
    let run_of = |daemon: &Daemon, id: &str| {
        let run = ended(daemon, id);
        assert_eq!(
            (&run["state"], &run["error"]["type"]),
            (&json!("interrupted"), &json!("interrupted")),
            "{run}"
        );
    };
    run_of(&daemon, &killed);
    let stopped = begin(&daemon, "sync", &json!({}));
    assert!(daemon.stop().success());
    daemon.start();
    daemon.ready();
    run_of(&daemon, &stopped);
    run_of(&daemon, &killed);
    daemon.finished_scan();
}

#[test]
fn polarization_is_joined_from_three_angles() {
    let error_deg = 1.7;
    let mut rig = Rig::coupon().set("camera.exposure_us", 1600.0);
    rig.change("sim.analyser.azimuth_error_deg", error_deg + 90.0);
    let mut daemon = Daemon::on(rig).started();
    let mut measured: Vec<String> = Vec::new();
    let mut last = Value::Null;
    for angle in [90.0, 45.0, 0.0] {
        if angle < 90.0 {
            daemon.stop();
            daemon.rig.change("sim.analyser.azimuth_error_deg", error_deg + angle);
            daemon.start();
        }
        daemon.ready();
        let with: &[String] = if angle > 0.0 { &[] } else { &measured };
        let body = json!({ "angle_deg": angle, "with": with, "coupon": "coupon=20,60,180,120" });
        last = ended(&daemon, &begin(&daemon, "polarization", &body));
        assert_eq!(last["state"], "done", "{last}");
        // One angle alone is neither accepted nor refused.
        assert_eq!(last["accepted"], if angle > 0.0 { Value::Null } else { json!(true) }, "{last}");
        measured.push(last["id"].as_str().unwrap().to_owned());
    }
    assert_eq!(last["with"], json!(measured[..2]));
    let file: toml::Table = text(&daemon, &measured[2], "polarization.toml").parse().expect("TOML");
    assert!((file["azimuth_error_deg"].as_float().unwrap() - error_deg).abs() < 0.2, "{file}");
}

#[test]
fn h_and_v_are_told_while_somebody_turns_the_polarizer() {
    let daemon = Daemon::on(Rig::coupon().set("camera.exposure_us", 1600.0)).started();
    daemon.ready();
    let mut events = Events::follow(daemon.address(), None);
    let id = begin(&daemon, "polarization", &json!({ "watch_s": 600, "coupon": "coupon=20,60,180,120" }));
    for value in 1..=3 {
        let live = loop {
            let event = events.next();
            if event.kind == "calibration-value" {
                assert_eq!(event.data["id"], json!(id));
                break event.data["live"].clone();
            }
        };
        assert_eq!(live["values"], json!(value), "{live}");
        assert!(live["h_dn"].as_f64().unwrap() > 10.0 * live["v_dn"].as_f64().unwrap(), "{live}");
        assert!(live["advice"].as_str().unwrap().contains("quarter turn"), "{live}");
    }
    cancel(&daemon, &id).expect(202);
    let run = ended(&daemon, &id);
    assert_eq!(
        (&run["state"], &run["accepted"], &run["error"]),
        (&json!("done"), &Value::Null, &Value::Null)
    );
    // Left alone, it ends by itself.
    let short = begin(&daemon, "polarization", &json!({ "watch_s": 1 }));
    assert_eq!(ended(&daemon, &short)["state"], "done");
    daemon.finished_scan();
}
