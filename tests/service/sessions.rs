//! Calibration of the rig over REST: views one after the other, guidance, solution, and what a session survives.

use std::{
    fs,
    time::{Duration, Instant},
};

use serde_json::{Value, json};

use crate::{
    client::{Answer, Events},
    daemon::Daemon,
    rig::Rig,
};

/// Nine by six squares of 18 mm.
fn board() -> Value {
    json!({ "pattern": { "checkerboard": { "columns": 9, "rows": 6, "square_mm": 18.0 } } })
}

fn open(daemon: &Daemon) -> String {
    let answer = daemon.post("/v1/calibrations/rig", &json!({ "board": board() })).expect(202);
    let session = answer.json();
    assert_eq!(answer.header("location"), session["href"].as_str().expect("an address"));
    assert_eq!((&session["kind"], &session["state"]), (&json!("rig"), &json!("open")), "{session}");
    assert_eq!((&session["session"]["views"], &session["finished"]), (&json!([]), &Value::Null), "{session}");
    session["id"].as_str().expect("an identity").to_owned()
}

fn begin(daemon: &Daemon, id: &str, step: &str) -> Answer {
    daemon.post(&format!("/v1/calibrations/{id}/{step}"), &json!({}))
}

fn state(daemon: &Daemon, id: &str) -> Value {
    daemon.get(&format!("/v1/calibrations/{id}")).expect(200).json()
}

/// The session after the step that is under way.
#[track_caller]
fn settled(daemon: &Daemon, id: &str) -> Value {
    let start = Instant::now();
    loop {
        let session = state(daemon, id);
        if session["state"] != "running" {
            return session;
        }
        assert!(start.elapsed() < Duration::from_secs(120), "{session}");
        std::thread::sleep(Duration::from_millis(10));
    }
}

#[track_caller]
fn step(daemon: &Daemon, id: &str, step: &str) -> Value {
    let begun = begin(daemon, id, step).expect(202).json();
    assert_eq!(begun["state"], "running", "{begun}");
    settled(daemon, id)
}

/// Takes a view that is of use.
#[track_caller]
fn view(daemon: &Daemon, id: &str) -> Value {
    let before = names(&state(daemon, id)).len();
    let session = step(daemon, id, "views");
    assert_eq!((&session["state"], &session["error"]), (&json!("open"), &Value::Null), "{session}");
    let last = session["session"]["views"].as_array().and_then(|views| views.last()).expect("a view").clone();
    assert_eq!(names(&session).len(), before + 1);
    assert!(last["corners"].as_u64() >= Some(8) && last["unusable"].is_null(), "{last}");
    session
}

fn names(session: &Value) -> Vec<String> {
    let views = session["session"]["views"].as_array().expect("views").iter();
    views.map(|view| view["name"].as_str().expect("a name").to_owned()).collect()
}

fn drop_view(daemon: &Daemon, id: &str, name: &str) -> Answer {
    daemon.request("DELETE", &format!("/v1/calibrations/{id}/views/{name}"), &json!({}))
}

fn delete(daemon: &Daemon, id: &str) -> Answer {
    daemon.request("DELETE", &format!("/v1/calibrations/{id}"), &json!({}))
}

fn missing(session: &Value) -> &Vec<Value> {
    session["session"]["missing"].as_array().expect("a list")
}

#[test]
fn a_rig_is_calibrated_view_by_view_over_refusal_and_restart() {
    let rig = Rig::small();
    let truth: toml::Table =
        fs::read_to_string(rig.path("sim-calibration.toml")).expect("a calibration").parse().expect("TOML");
    let mut daemon = Daemon::on(rig).started();
    daemon.ready();
    let id = open(&daemon);
    let mut events = Events::follow(daemon.address(), None);
    let first = view(&daemon, &id);
    assert!(!missing(&first).is_empty() && first["session"]["views_missing"].as_u64() > Some(0), "{first}");
    let told = std::iter::repeat_with(|| events.next())
        .find(|event| event.kind == "calibration" && event.data["state"] == "open")
        .expect("events go on");
    assert_eq!(told.data["session"], first["session"]);
    drop(events);
    // Between two views the rig is everybody's.
    daemon.finished_scan();

    view(&daemon, &id);
    let refused = step(&daemon, &id, "solve");
    assert_eq!((&refused["state"], &refused["accepted"]), (&json!("open"), &json!(false)), "{refused}");
    assert!(refused["refused"][0].as_str().expect("a reason").contains("view"), "{refused}");
    let report = daemon.get(&format!("/v1/calibrations/{id}/report.json")).expect(200).json();
    assert_eq!(report["refusals"][0]["type"].as_str(), Some("too-few-views"), "{report}");
    daemon.get(&format!("/v1/calibrations/{id}/calibration.toml")).expect(404);

    view(&daemon, &id);
    let dropped = drop_view(&daemon, &id, "view-02").expect(202).json();
    assert_eq!(dropped["id"], json!(id));
    assert_eq!(names(&settled(&daemon, &id)), ["view-01", "view-03"]);
    let before = state(&daemon, &id);
    daemon.stop();
    daemon.start();
    daemon.ready();
    assert_eq!(state(&daemon, &id), before, "the revision as well");
    // The frames are the truth: what was seen in them is found again.
    let folder = daemon.store.join(".calibrations").join(format!("{id}.session"));
    fs::remove_file(folder.join("view-01.json")).expect("what was seen");
    while names(&view(&daemon, &id)).len() < 12 {}
    let done = step(&daemon, &id, "solve");
    assert_eq!((&done["state"], &done["accepted"]), (&json!("done"), &json!(true)), "{done}");
    assert!(done["finished"].is_string() && done["refused"] == json!([]), "{done}");

    let file = daemon.get(&format!("/v1/calibrations/{id}/calibration.toml")).expect(200).body;
    let found: toml::Table = String::from_utf8(file).expect("text").parse().expect("TOML");
    let focal =
        |file: &toml::Table, device: &str| file[device]["matrix"][0][0].as_float().expect("a focal length");
    for device in ["camera", "projector"] {
        let ratio = focal(&found, device) / focal(&truth, device);
        assert!((ratio - 1.0).abs() < 0.02, "{device}: {ratio}");
    }
    daemon.get(&format!("/v1/calibrations/{id}/opencv.yaml")).expect(200);
    assert_eq!(begin(&daemon, &id, "views").expect(409).slug(), "wrong-state");
    delete(&daemon, &id).expect(204);
    daemon.get(&format!("/v1/calibrations/{id}")).expect(404);
    assert!(!folder.exists() && !daemon.store.join(".calibrations").join(&id).exists());
}

#[test]
fn a_session_refuses_what_cannot_be_and_can_be_closed() {
    let daemon = Daemon::real_time();
    daemon.ready();
    let wrong =
        json!({ "board": { "pattern": { "checkerboard": { "columns": 1, "rows": 6, "square_mm": -2.0 } } } });
    assert_eq!(daemon.post("/v1/calibrations/rig", &wrong).expect(422).slug(), "invalid");
    daemon.post("/v1/calibrations/rig", &json!({})).expect(422);
    daemon.post("/v1/calibrations/rig", &json!({ "board": board(), "baseline_mm": -1.0 })).expect(422);
    let id = open(&daemon);
    let second = daemon.post("/v1/calibrations/rig", &json!({ "board": board() })).expect(409);
    assert_eq!(second.json()["session"], json!(id));
    for (address, slug) in [("00000000-0000", "unknown-calibration"), ("..%2F..", "unknown-calibration")] {
        assert_eq!(begin(&daemon, address, "views").expect(404).slug(), slug);
    }
    for name in ["view-01", "..", "..%2Fsession.toml", "session.toml"] {
        drop_view(&daemon, &id, name).expect(404);
    }
    assert_eq!(delete(&daemon, &id).expect(409).slug(), "wrong-state");

    begin(&daemon, &id, "views").expect(202);
    let busy = begin(&daemon, &id, "views").expect(409);
    assert_eq!((busy.slug(), busy.json()["holder"]["id"].clone()), ("busy".into(), json!(id)));
    assert_eq!(daemon.post("/v1/scans", &json!({})).expect(409).json()["holder"]["calibration"], "rig");
    // A step hears of the cancel whatever it is doing.
    while !state(&daemon, &id)["doing"].as_str().is_some_and(|doing| doing.starts_with("looking")) {
        std::thread::sleep(Duration::from_millis(2));
    }
    begin(&daemon, &id, "cancel").expect(202);
    let closed = settled(&daemon, &id);
    assert_eq!(
        (&closed["state"], &closed["error"]["type"]),
        (&json!("cancelled"), &json!("cancelled")),
        "{closed}"
    );
    assert_eq!(begin(&daemon, &id, "solve").expect(409).slug(), "wrong-state");

    // One that waits is closed as well, and another kind takes no views.
    let other = open(&daemon);
    let on_disk = || -> Value {
        let record = daemon.store.join(".calibrations").join(format!("{other}.json"));
        serde_json::from_slice(&fs::read(record).expect("a record")).expect("JSON")
    };
    assert_eq!(on_disk()["revision"], state(&daemon, &other)["revision"]);
    assert_eq!(begin(&daemon, &other, "cancel").expect(202).json()["state"], "cancelled");
    assert_eq!(on_disk()["revision"], state(&daemon, &other)["revision"]);
    let noise = daemon.post("/v1/calibrations/noise", &json!({})).expect(202).json();
    let noise = noise["id"].as_str().expect("an identity");
    assert_eq!(begin(&daemon, noise, "views").expect(409).slug(), "wrong-state");
    begin(&daemon, noise, "cancel").expect(202);
}

#[test]
fn a_death_in_the_middle_of_a_view_costs_that_view_alone() {
    let mut daemon = Daemon::real_time();
    daemon.ready();
    let id = open(&daemon);
    view(&daemon, &id);
    begin(&daemon, &id, "views").expect(202);
    while state(&daemon, &id)["doing"].is_null() {
        std::thread::sleep(Duration::from_millis(5));
    }
    daemon.kill();
    daemon.start();
    daemon.ready();
    let after = state(&daemon, &id);
    assert_eq!(
        (&after["state"], &after["error"]["type"]),
        (&json!("open"), &json!("interrupted")),
        "{after}"
    );
    assert_eq!(names(&after), ["view-01"]);
    let next = view(&daemon, &id);
    assert_eq!(names(&next).len(), 2);
    let folder = daemon.store.join(".calibrations").join(format!("{id}.session"));
    let left: Vec<_> = fs::read_dir(folder)
        .expect("a folder")
        .map(|entry| entry.expect("an entry").file_name().into_string().expect("text"))
        .filter(|name| name.contains("partial"))
        .collect();
    assert!(left.is_empty(), "{left:?}");
}

#[test]
fn solving_and_dropping_need_no_rig() {
    let daemon = Daemon::real_time();
    daemon.ready();
    let id = open(&daemon);
    view(&daemon, &id);
    view(&daemon, &id);
    let scan = daemon.scan(&json!({}));
    let is_captured = || daemon.get(&format!("/v1/scans/{scan}")).expect(200).json()["state"] == "projecting";
    while !is_captured() {
        std::thread::sleep(Duration::from_millis(5));
    }
    // A view has to wait for its turn; what only computes has not.
    assert_eq!(begin(&daemon, &id, "views").expect(409).json()["holder"]["id"], json!(scan));
    drop_view(&daemon, &id, "view-01").expect(202);
    assert_eq!(names(&settled(&daemon, &id)), ["view-02"]);
    let refused = step(&daemon, &id, "solve");
    assert_eq!((&refused["state"], &refused["accepted"]), (&json!("open"), &json!(false)), "{refused}");
    assert!(is_captured(), "the scan went on meanwhile");
    let done = daemon.get(&format!("/v1/scans/{scan}?wait=done")).expect(200).json();
    assert_eq!((&done["state"], &done["verdict"]), (&json!("done"), &json!("ok")), "{done}");
    assert_eq!(names(&view(&daemon, &id)), ["view-02", "view-03"]);
}

#[test]
fn limits_that_bar_everything_or_nothing_are_refused() {
    let daemon = Daemon::on(Rig::small()).started();
    let wrong = [
        json!({ "min_views": 10_000_000_000_000_000_000_u64 }),
        json!({ "min_views": 101 }),
        json!({ "min_corners": 0 }),
        json!({ "camera_rms_px": -1.0 }),
        json!({ "quarters": 5 }),
    ];
    for gates in wrong {
        let answer = daemon.post("/v1/calibrations/rig", &json!({ "board": board(), "gates": gates }));
        let name = gates.as_object().and_then(|gates| gates.keys().next()).expect("a limit");
        assert!(
            answer.expect(422).json()["detail"].as_str().is_some_and(|why| why.contains(name)),
            "{gates}"
        );
    }
    let huge = json!({ "pattern": { "charuco": { "columns": 4_000_000_000_u32, "rows": 7, "square_mm": 12.0,
        "marker_mm": 9.0, "dictionary": "4x4" } } });
    daemon.post("/v1/calibrations/rig", &json!({ "board": huge })).expect(422);
    assert_eq!(daemon.get("/v1/calibrations").json()["runs"], json!([]));
    let folder = daemon.rig.path("store/.calibrations");
    assert!(!folder.exists() || std::fs::read_dir(folder).expect("a folder").next().is_none());
}

#[test]
fn a_view_that_cannot_be_read_is_named_and_can_be_dropped() {
    let daemon = Daemon::on(Rig::small()).started();
    daemon.ready();
    let id = open(&daemon);
    view(&daemon, &id);
    view(&daemon, &id);
    let folder = daemon.rig.path(&format!("store/.calibrations/{id}.session"));
    std::fs::remove_file(folder.join("view-01.json")).expect("what was seen in it");
    std::fs::write(folder.join("view-01/frames.npy"), "no frames").expect("a spoilt file");
    let session = step(&daemon, &id, "solve");
    let views = session["session"]["views"].as_array().expect("views").clone();
    assert_eq!((&session["state"], names(&session).len()), (&json!("open"), 2), "{session}");
    assert!(views[0]["unusable"].as_str().is_some_and(|why| why.contains("view-01")), "{session}");
    assert_eq!(views[1]["unusable"], Value::Null);
    drop_view(&daemon, &id, "view-01").expect(202);
    let session = settled(&daemon, &id);
    assert_eq!((&session["error"], names(&session)), (&Value::Null, vec!["view-02".to_owned()]));
}

#[test]
fn a_solve_that_is_cut_short_leaves_all_or_nothing() {
    let mut daemon = Daemon::on(Rig::small()).started();
    daemon.ready();
    let id = open(&daemon);
    while names(&view(&daemon, &id)).len() < 6 {}
    let all = names(&state(&daemon, &id));
    let consistent = |daemon: &Daemon, session: &Value, closed: &str| {
        let file = daemon.get(&format!("/v1/calibrations/{id}/calibration.toml"));
        assert_eq!(names(session), all, "{session}");
        if session["state"] == "done" {
            let file: toml::Table =
                String::from_utf8(file.expect(200).body).expect("text").parse().expect("TOML");
            assert!(file.contains_key("projector"));
        } else {
            assert_eq!(session["state"], closed, "{session}");
            file.expect(404);
        }
    };
    for pause_ms in [0, 20, 60, 150] {
        begin(&daemon, &id, "solve").expect(202);
        std::thread::sleep(Duration::from_millis(pause_ms));
        daemon.kill();
        daemon.start();
        daemon.ready();
        let after = state(&daemon, &id);
        consistent(&daemon, &after, "open");
        if after["state"] == "done" {
            return;
        }
    }
    begin(&daemon, &id, "solve").expect(202);
    begin(&daemon, &id, "cancel").expect(202);
    let after = settled(&daemon, &id);
    consistent(&daemon, &after, "cancelled");
}

#[test]
fn a_view_without_a_board_is_refused_by_name_and_the_session_goes_on() {
    let daemon = Daemon::fast();
    daemon.ready();
    // Squares of a fifth of a camera pixel: nothing of it is seen.
    let tiny = json!({ "pattern": { "checkerboard": { "columns": 9, "rows": 6, "square_mm": 0.2 } } });
    let session = daemon.post("/v1/calibrations/rig", &json!({ "board": tiny })).expect(202).json();
    let id = session["id"].as_str().expect("an identity").to_owned();
    let session = step(&daemon, &id, "views");
    assert_eq!(session["state"], "open", "{session}");
    let told = [&session["error"]["message"], &session["session"]["views"][0]["unusable"]];
    let told = told.into_iter().find_map(Value::as_str).unwrap_or_else(|| panic!("{session}"));
    assert!(told.contains("board"), "{told}");
    let again = step(&daemon, &id, "views");
    assert_eq!(again["state"], "open", "{again}");
    begin(&daemon, &id, "cancel").expect(202);
}
