//! Events, preview, set-up.

use std::io::Read;

use serde_json::json;

use crate::{
    client::{Events, open, read_head},
    daemon::Daemon,
};

#[test]
fn events_tell_a_scan_from_its_beginning_to_its_end() {
    let daemon = Daemon::fast();
    let mut events = Events::follow(daemon.address(), None);
    let id = daemon.scan(&json!({ "mode": "fast" }));
    let (mut states, mut frames, mut last) = (Vec::new(), 0, 0);
    while states.last().map(String::as_str) != Some("done") {
        let event = events.next();
        assert!(event.id > last, "numbers grow");
        last = event.id;
        match event.kind.as_str() {
            "scan" if event.data["id"] == id.as_str() => {
                assert_eq!(event.data["revision"], event.id);
                assert!(
                    daemon.state(&id)["revision"].as_u64() >= Some(event.id),
                    "whoever asks at once sees it"
                );
                states.push(event.data["state"].as_str().unwrap().to_owned());
            }
            "progress" => {
                let done = event.data["progress"]["frames"].as_u64().unwrap();
                assert!(done >= frames);
                frames = done;
            }
            _ => {}
        }
    }
    states.dedup();
    assert_eq!(states, ["queued", "projecting", "acquired", "decoding", "done"]);
    assert_eq!(daemon.state(&id)["progress"]["of"], frames);
}

#[test]
fn events_are_told_again_after_a_restart_and_their_numbers_go_on() {
    let mut daemon = Daemon::fast();
    let mut live = Events::follow(daemon.address(), None);
    let id = daemon.scan(&json!({ "mode": "fast" }));
    let mut told = Vec::new();
    while told.last().is_none_or(|event: &crate::client::Event| event.data["state"] != "done") {
        told.push(live.next());
    }
    for violent in [true, false] {
        if violent {
            daemon.kill()
        } else {
            daemon.stop();
        }
        daemon.start();
        let mut replay = Events::follow(daemon.address(), Some(told[0].id));
        for event in &told[1..] {
            assert_eq!(&replay.next(), event);
        }
    }
    let newest = told.last().unwrap().id;
    let mut later = Events::follow(daemon.address(), Some(newest));
    let second = daemon.scan(&json!({ "mode": "fast" }));
    loop {
        let event = later.next();
        assert!(event.id > newest);
        if event.data["id"] == second.as_str() {
            break;
        }
        assert_ne!(event.data["id"], id.as_str(), "what was seen is not told again");
    }
    assert!(
        daemon.done(&second)["revision"].as_u64().unwrap() > daemon.state(&id)["revision"].as_u64().unwrap()
    );
}

#[test]
fn the_preview_shows_what_the_projector_holds() {
    let daemon = Daemon::fast();
    daemon.ready();
    let mean = |picture: &str| {
        daemon.request("PUT", "/v1/projector", &json!({ "show": picture })).expect(200);
        // The first frame may still show the picture before.
        daemon.get("/v1/preview.jpg").expect(200);
        let answer = daemon.get("/v1/preview.jpg").expect(200);
        assert_eq!(answer.header("content-type"), "image/jpeg");
        let picture = image::load_from_memory(&answer.body).unwrap().to_luma8();
        let sum: u64 = picture.pixels().map(|pixel| u64::from(pixel.0[0])).sum();
        (
            sum as f64 / f64::from(picture.width() * picture.height()),
            answer.header("x-polscan-exposure").to_owned(),
        )
    };
    let (dark, hint) = mean("black");
    assert_eq!(hint, "under");
    let (bright, _) = mean("white");
    assert!(bright > dark + 20.0, "{dark} to {bright}");
    assert_eq!(daemon.get("/v1/status").json()["showing"], "white");
    mean("column-3");
    // A scan takes the projector, and leaves it black.
    daemon.finished_scan();
    assert_eq!(daemon.get("/v1/status").json()["showing"], serde_json::Value::Null);

    let mut stream = open(daemon.address(), "GET", "/v1/preview.mjpeg", &[], b"");
    let (status, headers) = read_head(&mut stream);
    assert_eq!(status, 200);
    assert!(headers["content-type"].starts_with("multipart/x-mixed-replace"));
    let mut text: Vec<u8> = Vec::new();
    let mut buffer = [0; 4096];
    while text.windows(13).filter(|window| window == b"polscan-frame").count() < 3 {
        let length = stream.read(&mut buffer).unwrap();
        assert!(length > 0);
        text.extend(&buffer[..length]);
    }
}

#[test]
fn pages_and_documents_are_served_whole() {
    let daemon = Daemon::fast();
    for (path, kind) in [("/", "text/html"), ("/docs", "text/html"), ("/openapi.json", "application/json")] {
        let answer = daemon.get(path).expect(200);
        assert!(answer.header("content-type").starts_with(kind), "{path}");
        let text = String::from_utf8(answer.body).unwrap();
        assert!(
            !text.contains("://cdn") && !text.contains("src=\"http"),
            "{path} needs nothing from elsewhere"
        );
        // What a page loads is there.
        for part in text.split(['"', '\'']).filter(|part| part.starts_with("/assets/")) {
            daemon.get(part).expect(200);
        }
    }
    let status = daemon.get("/v1/status").expect(200).json();
    assert_eq!(status["rig"].as_str().map(|rig| rig == "ready" || rig == "connecting"), Some(true));
    daemon.ready();
    let devices = daemon.get("/v1/devices").expect(200).json();
    assert_eq!(devices["cameras"][0]["in_use"], true, "{devices}");
    assert_eq!(daemon.get("/v1/config").expect(200).json()["scan"]["mode"], "pse");
    assert_eq!(daemon.get("/v1/calibrations").expect(200).json()["calibrations"][0]["kind"], "rig");
}
