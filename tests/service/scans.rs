//! What a bench script does: ask, wait, fetch.

use std::io::Cursor;

use serde_json::{Value, json};

use crate::{
    client::send,
    daemon::{Daemon, sha256},
};

#[test]
fn a_scan_is_asked_for_awaited_and_fetched() {
    let daemon = Daemon::fast();
    let body = json!({ "mode": "fast", "label": "first", "tags": ["a", "b"], "exposure_us": 1500.0 });
    let answer = daemon.post("/v1/scans?wait=acquired", &body).expect(202);
    let scan = answer.json();
    let id = scan["id"].as_str().unwrap();
    assert_eq!(answer.header("location"), format!("/v1/scans/{id}"));
    assert!(["acquired", "decoding", "done"].contains(&scan["state"].as_str().unwrap()), "{scan}");

    let done = daemon.done(id);
    assert_eq!((done["state"].as_str(), done["verdict"].as_str()), (Some("done"), Some("ok")), "{done}");
    assert!(done["revision"].as_u64() > scan["revision"].as_u64());
    assert_eq!(done["progress"]["frames"], done["progress"]["of"]);

    // Every file is what the list says.
    let artifacts = done["artifacts"].as_array().unwrap();
    for artifact in artifacts {
        let file = daemon.get(artifact["href"].as_str().unwrap()).expect(200);
        assert_eq!(file.body.len() as u64, artifact["bytes"].as_u64().unwrap(), "{artifact}");
        assert_eq!(sha256(&file.body), artifact["sha256"].as_str().unwrap(), "{artifact}");
        assert_eq!(file.header("etag"), format!("\"{}\"", artifact["sha256"].as_str().unwrap()));
    }
    for name in ["cloud.ply", "report.json", "frames.npy", "maps.npz", "maps/depth.png", "manifest.json"] {
        assert!(artifacts.iter().any(|artifact| artifact["name"] == name), "{name}");
    }
    let report = daemon.get(&format!("/v1/scans/{id}/report.json")).json();
    assert_eq!(report["verdict"], "ok");
    let manifest = daemon.get(&format!("/v1/scans/{id}/manifest.json")).json();
    assert_eq!(manifest["id"], id);
    assert_eq!(manifest["label"], "first");
    assert_eq!(manifest["settings"]["requested"]["exposure_us"], 1500.0);

    // The archive holds the same.
    let archive = daemon.get(&format!("/v1/scans/{id}/bundle.zip")).expect(200);
    let mut zip = zip::ZipArchive::new(Cursor::new(archive.body)).unwrap();
    assert_eq!(zip.len(), artifacts.len());
    for artifact in artifacts {
        let mut bytes = Vec::new();
        let mut file = zip.by_name(&format!("{id}/{}", artifact["name"].as_str().unwrap())).unwrap();
        std::io::copy(&mut file, &mut bytes).unwrap();
        assert_eq!(sha256(&bytes), artifact["sha256"].as_str().unwrap());
    }
    let metrics = String::from_utf8(daemon.get("/metrics").expect(200).body).unwrap();
    assert!(metrics.contains("polscan_scans_total{result=\"done\"} 1"), "{metrics}");
}

#[test]
fn parts_of_files_and_conditions() {
    let daemon = Daemon::fast();
    let scan = daemon.finished_scan();
    let path = format!("{}/cloud.ply", scan["href"].as_str().unwrap());
    let whole = daemon.get(&path).expect(200);
    let tag = whole.header("etag").to_owned();
    let with = |headers: &[(&str, &str)]| send(daemon.address(), "GET", &path, headers, b"");
    let total = whole.body.len();

    let part = with(&[("Range", "bytes=10-19")]).expect(206);
    assert_eq!(part.body, whole.body[10..20]);
    assert_eq!(part.header("content-range"), format!("bytes 10-19/{total}"));
    assert_eq!(with(&[("Range", "bytes=-7")]).expect(206).body, whole.body[total - 7..]);
    assert_eq!(
        with(&[("Range", &format!("bytes={}-", total - 3))]).expect(206).body,
        whole.body[total - 3..]
    );
    let beyond = with(&[("Range", &format!("bytes={total}-"))]).expect(416);
    assert_eq!(beyond.header("content-range"), format!("bytes */{total}"));
    assert_eq!(with(&[("Range", "bytes=0-4"), ("If-Range", &tag)]).expect(206).body.len(), 5);
    assert_eq!(with(&[("Range", "bytes=0-4"), ("If-Range", "\"other\"")]).expect(200).body.len(), total);
    assert!(with(&[("If-None-Match", &tag)]).expect(304).body.is_empty());
    assert_eq!(with(&[("If-None-Match", "\"other\"")]).expect(200).body.len(), total);
    let head = send(daemon.address(), "HEAD", &path, &[], b"");
    assert_eq!((head.status, head.header("content-length")), (200, total.to_string().as_str()));

    // What is text is compressed on request, files of which parts can be asked for are not.
    let packed = |path: &str| send(daemon.address(), "GET", path, &[("Accept-Encoding", "gzip")], b"");
    assert_eq!(packed("/openapi.json").header("content-encoding"), "gzip");
    assert_eq!(packed(&path).header("content-encoding"), "");
}

#[test]
fn scans_are_listed_filtered_and_paged() {
    let daemon = Daemon::fast();
    let bodies = [
        json!({ "mode": "fast", "label": "one", "tags": ["x"] }),
        json!({ "mode": "fast", "label": "two", "tags": ["x", "y"] }),
        json!({ "mode": "gray", "label": "three" }),
    ];
    let ids: Vec<String> = bodies
        .iter()
        .map(|body| {
            let scan = daemon.post("/v1/scans?wait=done", body).expect(202).json();
            scan["id"].as_str().unwrap().to_owned()
        })
        .collect();
    let list = |query: &str| -> Vec<String> {
        let page = daemon.get(&format!("/v1/scans?{query}")).expect(200).json();
        page["scans"].as_array().unwrap().iter().map(|scan| scan["id"].as_str().unwrap().to_owned()).collect()
    };
    let newest: Vec<String> = ids.iter().rev().cloned().collect();
    assert_eq!(list(""), newest);
    assert_eq!(list("tag=x"), newest[1..]);
    assert_eq!(list("tag=x,y"), ids[1..2]);
    assert_eq!(list("mode=gray"), ids[2..]);
    assert_eq!(list("label=two"), ids[1..2]);
    assert_eq!(list("state=queued,failed"), [""; 0]);
    let first = daemon.get("/v1/scans?limit=2").json();
    let second = daemon.get(&format!("/v1/scans?limit=2&cursor={}", first["next"].as_str().unwrap())).json();
    assert_eq!(second["scans"].as_array().unwrap().len(), 1);
    assert_eq!(second["next"], Value::Null);
    for bad in ["limit=0", "limit=1000", "state=odd", "cursor=x", "color=red", "pinned=maybe"] {
        daemon.get(&format!("/v1/scans?{bad}")).expect(422);
    }
}

#[test]
fn a_busy_rig_names_its_holder_and_a_queue_has_an_end() {
    let daemon =
        Daemon::on(crate::rig::Rig::small().set("sim.pacing", "real-time").set("scan.queue_capacity", 2))
            .started();
    let first = daemon.scan(&json!({ "label": "holder" }));
    let busy = daemon.post("/v1/scans", &json!({})).expect(409);
    assert_eq!(busy.slug(), "busy");
    assert_eq!(busy.json()["holder"]["id"], first.as_str());
    assert_eq!(busy.json()["holder"]["label"], "holder");
    let second = daemon.scan(&json!({ "queue": true, "mode": "fast" }));
    let third = daemon.scan(&json!({ "queue": true, "mode": "fast" }));
    assert_eq!(daemon.post("/v1/scans", &json!({ "queue": true })).expect(429).slug(), "queue-full");
    // The rig may still be opened by now: its holder waits for that and for nobody.
    assert_eq!(daemon.state(&first)["queue_position"], Value::Null);
    assert_eq!(daemon.state(&second)["queue_position"], 0);
    assert_eq!(daemon.state(&third)["queue_position"], 1);
    daemon.until(&first, |scan| scan["state"] == "projecting");
    assert_eq!(daemon.state(&third)["queue_position"], 1);
    // Set-up would disturb the scan.
    assert_eq!(
        daemon.request("PUT", "/v1/projector", &json!({ "show": "white" })).expect(409).slug(),
        "busy"
    );
    // While it runs, its files are not there yet; others never will be.
    assert_eq!(daemon.get(&format!("/v1/scans/{first}/cloud.ply")).expect(409).slug(), "not-finished");
    assert_eq!(daemon.get(&format!("/v1/scans/{first}/odd.txt")).expect(404).slug(), "no-artifact");
    assert_eq!(
        daemon.request("DELETE", &format!("/v1/scans/{first}"), &json!({})).expect(409).slug(),
        "wrong-state"
    );

    daemon.post(&format!("/v1/scans/{second}/cancel"), &json!({})).expect(202);
    assert_eq!(daemon.state(&second)["state"], "cancelled");
    assert_eq!(daemon.done(&first)["state"], "done");
    assert_eq!(daemon.done(&third)["state"], "done");
    assert_eq!(daemon.state(&second)["state"], "cancelled");
}

#[test]
fn a_cancelled_scan_stops_soon_keeps_its_frames_and_stays_cancelled() {
    let daemon = Daemon::real_time();
    let id = daemon.scan(&json!({}));
    daemon.until(&id, |scan| scan["progress"]["frames"].as_u64() >= Some(3));
    daemon.post(&format!("/v1/scans/{id}/cancel"), &json!({})).expect(202);
    let scan = daemon.done(&id);
    assert_eq!(scan["state"], "cancelled", "{scan}");
    assert!(scan["progress"]["frames"].as_u64() < scan["progress"]["of"].as_u64());
    let report = daemon.get(&format!("/v1/scans/{id}/report.json")).expect(200).json();
    assert_eq!(report["reasons"][0]["type"], "cancelled");
    daemon.get(&format!("/v1/scans/{id}/frames.npy")).expect(200);
    assert_eq!(daemon.get(&format!("/v1/scans/{id}/cloud.ply")).expect(404).slug(), "no-artifact");
    // Again, it is as it was; and the rig is free.
    daemon.post(&format!("/v1/scans/{id}/cancel"), &json!({})).expect(202);
    assert_eq!(daemon.state(&id), scan);
    daemon.finished_scan();
}

#[test]
fn a_series_is_as_many_scans_and_stops_as_one() {
    let daemon = Daemon::fast();
    let body = json!({ "mode": "fast", "repeat": 3, "label": "series" });
    let answer = daemon.post("/v1/scans?wait=done", &body).expect(202).json();
    let ids = answer["scans"].as_array().unwrap().clone();
    assert_eq!(ids.len(), 3);
    assert_eq!(ids[0], answer["id"]);
    for (index, id) in ids.iter().enumerate() {
        let scan = daemon.state(id.as_str().unwrap());
        assert_eq!(scan["state"], "done");
        assert_eq!(scan["series"], json!({ "index": index, "of": 3, "first": ids[0] }));
    }
    daemon.post("/v1/scans", &json!({ "repeat": 0 })).expect(422);
    assert_eq!(daemon.post("/v1/scans", &json!({ "repeat": 100 })).expect(429).slug(), "queue-full");

    let series = daemon.post("/v1/scans", &json!({ "repeat": 3 })).expect(202).json();
    let first = series["id"].as_str().unwrap();
    daemon.post(&format!("/v1/scans/{first}/cancel"), &json!({})).expect(202);
    for id in series["scans"].as_array().unwrap() {
        assert_eq!(daemon.done(id.as_str().unwrap())["state"], "cancelled");
    }
}

#[test]
fn recorded_frames_are_decoded_again() {
    let daemon = Daemon::fast();
    let source = daemon.post("/v1/scans?wait=done", &json!({ "label": "source" })).expect(202).json();
    let id = source["id"].as_str().unwrap();
    let again = daemon.post(&format!("/v1/scans/{id}/reprocess?wait=done"), &json!({})).expect(202).json();
    assert_eq!(again["state"], "done", "{again}");
    assert_eq!((again["source"].as_str(), again["label"].as_str()), (Some(id), Some("source")));
    let other = again["id"].as_str().unwrap();
    // The same frames give the same maps, to the last bit.
    let file = |id: &str, name: &str| daemon.get(&format!("/v1/scans/{id}/{name}")).expect(200).body;
    assert_eq!(file(id, "maps.npz"), file(other, "maps.npz"));
    assert_eq!(file(id, "frames.npy").len(), file(other, "frames.npy").len());
    // Frames that another scan needs stay.
    let delete = |id: &str| daemon.request("DELETE", &format!("/v1/scans/{id}"), &json!({}));
    assert_eq!(delete(id).expect(409).slug(), "in-use");
    delete(other).expect(204);
    delete(id).expect(204);
    daemon.get(&format!("/v1/scans/{id}")).expect(404);
    daemon.get(&format!("/v1/scans/{id}/cloud.ply")).expect(404);
    assert!(daemon.bundles().is_empty());
    daemon.post(&format!("/v1/scans/{id}/reprocess"), &json!({})).expect(404);
}

#[test]
fn a_key_makes_a_request_happen_once_over_restarts_as_well() {
    let mut daemon = Daemon::fast();
    let post = |daemon: &Daemon, key: &str, body: &Value| {
        let headers = [("Content-Type", "application/json"), ("Idempotency-Key", key)];
        send(daemon.address(), "POST", "/v1/scans", &headers, body.to_string().as_bytes())
    };
    let body = json!({ "mode": "fast", "label": "once" });
    let first = post(&daemon, "\"k-1\"", &body).expect(202);
    let again = post(&daemon, "k-1", &body).expect(202);
    assert_eq!(first.header("location"), again.header("location"));
    assert_eq!(post(&daemon, "k-1", &json!({ "mode": "gray" })).expect(422).slug(), "idempotency-key-reused");
    daemon.done(first.json()["id"].as_str().unwrap());
    daemon.kill();
    daemon.start();
    let later = post(&daemon, "k-1", &body).expect(202);
    assert_eq!(later.header("location"), first.header("location"));
    assert_eq!(later.json()["state"], "done");
    assert_eq!(post(&daemon, "k-1", &json!({})).expect(422).slug(), "idempotency-key-reused");
    assert_eq!(daemon.get("/v1/scans").json()["scans"].as_array().unwrap().len(), 1);
    post(&daemon, "", &body).expect(422);
}

#[test]
fn one_key_of_many_clients_at_once_is_one_scan() {
    let daemon = Daemon::real_time();
    daemon.ready();
    let post = || {
        let headers = [("Content-Type", "application/json"), ("Idempotency-Key", "k")];
        let answer = send(daemon.address(), "POST", "/v1/scans", &headers, b"{\"mode\":\"fast\"}");
        answer.expect(202).header("location").to_owned()
    };
    let locations: Vec<String> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..8).map(|_| scope.spawn(post)).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    assert!(locations.iter().all(|location| *location == locations[0]), "{locations:?}");
    assert_eq!(daemon.get("/v1/scans").json()["scans"].as_array().unwrap().len(), 1);
}

#[test]
fn of_two_clients_at_once_one_gets_the_rig() {
    let daemon = Daemon::real_time();
    daemon.ready();
    let answers: Vec<u16> = std::thread::scope(|scope| {
        let clients: Vec<_> = (0..2)
            .map(|_| scope.spawn(|| daemon.post("/v1/scans", &json!({ "mode": "fast" })).status))
            .collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    let mut sorted = answers.clone();
    sorted.sort_unstable();
    assert_eq!(sorted, [202, 409], "{answers:?}");
    let ids: Vec<String> = std::thread::scope(|scope| {
        let clients: Vec<_> =
            (0..2).map(|_| scope.spawn(|| daemon.scan(&json!({ "mode": "fast", "queue": true })))).collect();
        clients.into_iter().map(|client| client.join().unwrap()).collect()
    });
    for id in ids {
        assert_eq!(daemon.done(&id)["state"], "done");
    }
}
