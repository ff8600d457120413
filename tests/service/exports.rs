//! Scans in the formats of other programs, over the interface.

use std::process::Command;

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
