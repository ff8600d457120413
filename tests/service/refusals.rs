//! What is not to happen: wrong requests, foreign pages, paths that lead elsewhere, tokens that do not reach.

use std::{
    io::{Read, Write},
    net::TcpStream,
    time::Duration,
};

use serde_json::json;

use crate::{
    client::{Answer, send},
    daemon::Daemon,
    rig::{Rig, polscan, text},
};

/// What clients do wrong is no fault of the service.
fn nothing_at_error_level(daemon: &Daemon) {
    let log = daemon.log();
    assert!(log.contains("\"INFO\"") && !log.contains("\"ERROR\""), "{log}");
}

const TYPED: (&str, &str) = ("Content-Type", "application/json");

#[test]
fn wrong_requests_get_problems_that_say_what_is_wrong() {
    let daemon = Daemon::fast();
    let raw = |body: &[u8]| send(daemon.address(), "POST", "/v1/scans", &[TYPED], body);
    assert_eq!(raw(b"{").expect(400).slug(), "malformed");
    assert_eq!(raw(b"{} {}").expect(400).slug(), "malformed");
    assert_eq!(raw(b"\xff\xfe").expect(400).slug(), "malformed");
    let invalid = [
        json!({ "mode": "fringe" }),
        json!({ "mode": 7 }),
        json!({ "exposure_us": -1.0 }),
        json!({ "exposure_us": "long" }),
        json!({ "label": "x".repeat(1000) }),
        json!({ "label": "a\nb" }),
        json!({ "tags": [""] }),
        json!({ "speed": 1 }),
        json!({ "repeat": 100_000 }),
        json!([]),
    ];
    for body in invalid {
        let problem = daemon.post("/v1/scans", &body).expect(422);
        assert_eq!(problem.slug(), "invalid", "{body}");
        assert!(problem.json()["errors"][0]["message"].is_string(), "{body}");
    }
    let long = format!("{{\"label\": \"{}\"}}", "x".repeat(100_000));
    assert_eq!(raw(long.as_bytes()).expect(413).slug(), "too-large");
    for kind in ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""] {
        let answer = send(daemon.address(), "POST", "/v1/scans", &[("Content-Type", kind)], b"{}");
        assert_eq!(answer.expect(415).slug(), "unsupported-media-type");
    }
    send(daemon.address(), "POST", "/v1/scans", &[], b"{}").expect(415);
    daemon.get("/v1/nothing").expect(404);
    daemon.request("PUT", "/v1/scans", &json!({})).expect(405);
    daemon.get("/v1/scans?wait=never").expect(422);
    daemon.request("PUT", "/v1/projector", &json!({ "show": "unicorn" })).expect(422);
    daemon.ready();
    // A pattern, but none of this projector's.
    daemon.request("PUT", "/v1/projector", &json!({ "show": "column-99" })).expect(422);
    assert_eq!(daemon.post("/v1/calibrations/rig", &json!({})).expect(422).slug(), "invalid");
    daemon.post("/v1/calibrations/odd", &json!({})).expect(404);
    daemon.post("/v1/calibrations/odd/cancel", &json!({})).expect(404);
    daemon.get("/v1/calibrations/odd").expect(404);
    daemon.get("/v1/calibrations/odd/report.json").expect(404);
    for body in [
        json!({ "angle_deg": 1000 }),
        json!({ "with": ["nobody"] }),
        json!({ "coupon": "everywhere" }),
        json!({ "card": "card=0,0,1,1" }),
        json!({ "watch_s": 0 }),
        json!({ "speed": 1 }),
    ] {
        assert_eq!(
            daemon.post("/v1/calibrations/polarization", &body).expect(422).slug(),
            "invalid",
            "{body}"
        );
    }
    daemon.post("/v1/calibrations/noise", &json!({ "speed": 1 })).expect(422);
    assert_eq!(daemon.get("/v1/calibrations").json()["runs"], json!([]));
    // Nothing of all this was a scan.
    assert!(daemon.get("/v1/scans").json()["scans"].as_array().unwrap().is_empty());
    nothing_at_error_level(&daemon);
}

#[test]
fn no_path_leads_out_of_a_bundle() {
    let daemon = Daemon::fast();
    let scan = daemon.finished_scan();
    let id = scan["id"].as_str().unwrap();
    std::fs::write(daemon.store.join("secret"), "secret").unwrap();
    std::fs::write(daemon.store.join(id).join("unlisted"), "secret").unwrap();
    let names = [
        "../secret",
        "..%2Fsecret",
        "%2e%2e/secret",
        "%2e%2e%2fsecret",
        "maps/../../secret",
        "maps/..%2f..%2fsecret",
        "unlisted",
        "scan.json",
        "cloud.ply%00",
        "/etc/passwd",
        "%2Fetc%2Fpasswd",
        "%ff",
        "index.sqlite",
    ];
    for name in names {
        let answer = daemon.get(&format!("/v1/scans/{id}/{name}"));
        assert!([400, 404].contains(&answer.status), "{name}: {}", answer.status);
        assert!(
            !answer.body.windows(6).any(|window| window == b"secret" && !name.contains("secret")),
            "{name}"
        );
    }
    for id in ["..", "%2e%2e", ".spool", "..%2f..", "A", "index.sqlite", "%00", "a%2fb"] {
        for path in [format!("/v1/scans/{id}"), format!("/v1/scans/{id}/cloud.ply")] {
            let status = daemon.get(&path).status;
            assert!([400, 404].contains(&status), "{path}: {status}");
        }
        let status = daemon.request("DELETE", &format!("/v1/scans/{id}"), &json!({})).status;
        assert!([400, 404, 405].contains(&status), "{id}: {status}");
    }
    assert!(daemon.store.join("secret").is_file() && daemon.store.join("index.sqlite").is_file());
    nothing_at_error_level(&daemon);
}

#[test]
fn pages_of_others_cannot_use_this_machine() {
    let daemon = Daemon::fast();
    let post = |headers: &[(&str, &str)]| -> Answer {
        let all: Vec<(&str, &str)> = headers.iter().copied().chain([TYPED]).collect();
        send(daemon.address(), "POST", "/v1/scans", &all, b"{\"mode\":\"fast\",\"queue\":true}")
    };
    assert_eq!(post(&[("Host", "evil.example")]).expect(403).slug(), "foreign-origin");
    assert_eq!(post(&[("Origin", "http://evil.example")]).expect(403).slug(), "foreign-origin");
    post(&[("Origin", "null")]).expect(403);
    let read = send(daemon.address(), "GET", "/v1/scans", &[("Host", "evil.example:80")], b"");
    assert_eq!(read.expect(403).slug(), "foreign-origin");
    post(&[("Host", "localhost:8631"), ("Origin", "http://127.0.0.1:8631")]).expect(202);
    // No page of another origin may read an answer.
    let answer = post(&[("Origin", "http://localhost:1")]).expect(202);
    assert_eq!(answer.header("access-control-allow-origin"), "");
    nothing_at_error_level(&daemon);
}

#[test]
fn an_answer_reaches_a_client_that_is_still_sending() {
    let daemon = Daemon::fast();
    let slowly = |headers: &str, length: usize| {
        let mut stream = TcpStream::connect(daemon.address()).unwrap();
        let head = format!(
            "POST /v1/scans HTTP/1.1\r\nConnection: close\r\nContent-Length: {length}\r\n{headers}\r\n"
        );
        stream.write_all(head.as_bytes()).unwrap();
        for part in vec![b'x'; length].chunks(length.div_ceil(4)) {
            std::thread::sleep(Duration::from_millis(20));
            let _ = stream.write_all(part);
        }
        let mut answer = String::new();
        stream.read_to_string(&mut answer).unwrap();
        answer.split(' ').nth(1).map(str::to_owned)
    };
    let typed = "Content-Type: application/json\r\n";
    assert_eq!(slowly("Host: evil.example\r\n", 40).as_deref(), Some("403"));
    assert_eq!(slowly("Host: localhost\r\n", 40).as_deref(), Some("415"));
    assert_eq!(slowly(&format!("Host: localhost\r\n{typed}"), 200_000).as_deref(), Some("413"));
}

#[test]
fn another_address_needs_tokens_and_tokens_have_scopes() {
    let rig = Rig::small();
    let config = Rig::small().set("api.listen", "0.0.0.0:0").config();
    let refused = polscan(&["check-config", text(&config)]);
    assert_eq!(refused.code, 64, "{}", refused.stderr);

    let file = rig.path("tokens");
    let token = |name: &str, scope: &str| {
        let run = polscan(&["token", "add", name, "--scope", scope, "--file", text(&file)]).expect(0);
        format!("Bearer {}", run.stdout.trim())
    };
    let (read, scan, admin) = (token("r", "read"), token("s", "scan"), token("a", "admin"));
    let daemon = Daemon::on(rig.set("api.tokens", "tokens")).started();
    let ask = |method: &str, path: &str, token: &str| {
        send(daemon.address(), method, path, &[TYPED, ("Authorization", token)], b"{\"mode\":\"fast\"}")
    };
    for wrong in ["", "Bearer", "Bearer x", "Basic x", &format!("{read}0"), &read[..read.len() - 1]] {
        let answer = ask("GET", "/v1/status", wrong).expect(401);
        assert_eq!((answer.slug().as_str(), answer.header("www-authenticate")), ("unauthorized", "Bearer"));
    }
    send(daemon.address(), "GET", "/v1/status", &[], b"").expect(401);
    ask("GET", "/v1/status", &read).expect(200);
    assert_eq!(ask("POST", "/v1/scans", &read).expect(403).slug(), "insufficient-scope");
    let id = ask("POST", "/v1/scans?wait=done", &scan).expect(202).json()["id"].as_str().unwrap().to_owned();
    ask("DELETE", &format!("/v1/scans/{id}"), &scan).expect(403);
    ask("DELETE", &format!("/v1/scans/{id}"), &admin).expect(204);
    daemon.get("/livez").expect(200);
    // Neither the log nor the configuration gives a token away.
    let config = String::from_utf8(ask("GET", "/v1/config", &read).body).unwrap();
    for token in [&read, &scan, &admin] {
        let secret = token.trim_start_matches("Bearer polscan_");
        assert!(!daemon.log().contains(secret) && !config.contains(secret));
    }
    nothing_at_error_level(&daemon);
}

#[test]
fn too_many_at_once_are_refused_and_probes_are_not() {
    let daemon = Daemon::on(Rig::small().set("api.streams", 1)).started();
    let mut follower = crate::client::Events::follow(daemon.address(), None);
    assert_eq!(daemon.get("/v1/events").expect(503).slug(), "overloaded");
    daemon.get("/livez").expect(200);
    let id = daemon.scan(&json!({ "mode": "fast" }));
    while follower.next().data["id"] != id.as_str() {}
}
