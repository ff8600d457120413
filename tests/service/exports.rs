//! Scans in the formats of other programs, over the interface.

use std::process::Command;

use polscan::cloud::read_ply;
use serde_json::json;

use crate::{
    client::send,
    daemon::Daemon,
    rig::{polscan, text},
};

#[test]
fn exports_are_those_of_the_command_line() {
    let daemon = Daemon::fast();
    let scan = daemon.finished_scan();
    let id = scan["id"].as_str().expect("an identity");
    let folder = tempfile::tempdir().expect("a folder");
    let bundle = daemon.store.join(id);
    let kinds = [
        ("cloud.e57", "model/e57"),
        ("cloud.pcd", "application/octet-stream"),
        ("cloud.xyz", "text/plain; charset=utf-8"),
        ("mesh.obj", "model/obj"),
        ("depth.tiff", "image/tiff"),
        ("mask.png", "image/png"),
    ];
    for (name, kind) in kinds {
        let out = folder.path().join(name);
        polscan(&["export", text(&bundle), "--out", text(&out)]).expect(0);
        let path = format!("/v1/scans/{id}/export/{name}");
        let answer = daemon.get(&path).expect(200);
        assert!(answer.body == std::fs::read(&out).expect("the export"), "{name} differs");
        assert_eq!(answer.header("content-type"), kind, "{name}");
        assert_eq!(answer.header("content-length"), answer.body.len().to_string(), "{name}");
        let tag = answer.header("etag").to_owned();
        let again = send(daemon.address(), "GET", &path, &[("If-None-Match", &tag)], b"").expect(304);
        assert!(again.body.is_empty(), "{name}");
    }
    // Nothing of it stays in the store.
    let left = std::fs::read_dir(&daemon.store).expect("the store").filter(|entry| {
        entry.as_ref().expect("an entry").file_name().to_string_lossy().starts_with(".export")
    });
    assert_eq!(left.count(), 0);
    for name in ["cloud.las", "cloud.ply", "mask.f32.tiff", "..%2Fcloud.e57"] {
        assert_eq!(
            daemon.get(&format!("/v1/scans/{id}/export/{name}")).expect(404).slug(),
            "no-artifact",
            "{name}"
        );
    }
    assert_eq!(daemon.get("/v1/scans/000000000000-0/export/cloud.e57").expect(404).slug(), "unknown-scan");
}

#[test]
fn what_is_not_there_yet_is_409_and_what_never_will_be_404() {
    let daemon = Daemon::real_time();
    let id = daemon.scan(&json!({}));
    assert_eq!(daemon.get(&format!("/v1/scans/{id}/export/cloud.e57")).expect(409).slug(), "not-finished");
    assert_eq!(daemon.get(&format!("/v1/scans/{id}/export/cloud.las")).expect(404).slug(), "no-artifact");
    assert_eq!(daemon.done(&id)["state"], "done");
    daemon.get(&format!("/v1/scans/{id}/export/cloud.e57")).expect(200);
    // A store that was damaged from outside says so rather than serving what is left.
    let cloud = daemon.store.join(&id).join("cloud.ply");
    Command::new("truncate").args(["-s", "-7", text(&cloud)]).status().expect("truncate");
    let broken = daemon.get(&format!("/v1/scans/{id}/export/cloud.xyz")).expect(500);
    assert!(broken.json()["detail"].as_str().is_some_and(|detail| detail.contains("cloud.ply")));
}

#[test]
fn a_sample_has_as_many_points_as_were_asked_for() {
    let daemon = Daemon::fast();
    let scan = daemon.finished_scan();
    let id = scan["id"].as_str().expect("an identity");
    let whole = read_ply(&std::fs::read(daemon.store.join(id).join("cloud.ply")).expect("the cloud"))
        .expect("points of ours");
    let path = |query: &str| format!("/v1/scans/{id}/sample.ply{query}");
    let points = |query: &str| read_ply(&daemon.get(&path(query)).expect(200).body).expect("points of ours");
    let few = points("?points=100");
    assert_eq!(few.len(), 100);
    let mut rest = whole.iter();
    assert!(
        few.iter().all(|point| rest.any(|other| other == point)),
        "they are points of the cloud, in order"
    );
    assert_eq!(points("?points=200000"), whole);
    assert_eq!(points("").len(), whole.len().min(50_000));

    let answer = daemon.get(&path("?points=100")).expect(200);
    let condition = [("If-None-Match", answer.header("etag"))];
    send(daemon.address(), "GET", &path("?points=100"), &condition, b"").expect(304);
    send(daemon.address(), "GET", &path("?points=101"), &condition, b"").expect(200);
    for wrong in ["?points=0", "?points=200001", "?points=-1", "?points=many", "?point=5"] {
        daemon.get(&path(wrong)).expect(422);
    }
    // In the dark no pixel is measured, and the cloud has no point.
    let dark = daemon.done(&daemon.scan(&json!({ "exposure_us": 1 })));
    let none = format!("/v1/scans/{}/sample.ply", dark["id"].as_str().expect("an identity"));
    assert_eq!(read_ply(&daemon.get(&none).expect(200).body).expect("a cloud"), []);
    let unknown = daemon.get("/v1/scans/000000000000-0/sample.ply").expect(404);
    assert_eq!(unknown.slug(), "unknown-scan");

    // A store that was damaged from outside says so.
    let cloud = daemon.store.join(id).join("cloud.ply");
    Command::new("truncate").args(["-s", "-7", text(&cloud)]).status().expect("truncate");
    let broken = daemon.get(&path("?points=7")).expect(500);
    assert!(broken.json()["detail"].as_str().is_some_and(|detail| detail.contains("cloud.ply")));
    std::fs::remove_file(&cloud).expect("it was there");
    assert_eq!(daemon.get(&path("?points=7")).expect(404).slug(), "no-artifact");
}
