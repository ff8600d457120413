//! Disks end.

use std::{fs, path::Path, process::Command};

use serde_json::json;

use crate::{
    daemon::Daemon,
    rig::{Rig, text},
};

const MIB: f64 = (1u64 << 20) as f64;
const GIB: f64 = (1u64 << 30) as f64;

/// A disk of some size; unmounted when dropped.
struct SmallDisk<'a>(&'a Path);

impl<'a> SmallDisk<'a> {
    fn mount(path: &'a Path, mib: u64) -> Self {
        fs::create_dir_all(path).expect("a folder for the disk");
        let size = format!("size={mib}m");
        let done = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs", text(path)]).output();
        let done = done.expect("mount runs");
        assert!(done.status.success(), "{}", String::from_utf8_lossy(&done.stderr));
        Self(path)
    }
}

impl Drop for SmallDisk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

#[test]
#[ignore = "mounts a disk of its own, which takes root: make systemd runs it"]
fn a_full_disk_fails_the_scan_and_nothing_else() {
    let rig = Rig::small().set("sim.pacing", "real-time");
    let folder = tempfile::tempdir().unwrap();
    let disk = folder.path().join("disk");
    let _mounted = SmallDisk::mount(&disk, 160);
    let daemon = Daemon::in_store(rig, disk.join("store")).started();
    let id = daemon.scan(&json!({}));
    daemon.until(&id, |scan| scan["progress"]["frames"].as_u64() >= Some(2));
    // Somebody else fills it while the scan runs.
    let filler = disk.join("filler");
    let mut bytes = fs::File::create(&filler).unwrap();
    while std::io::Write::write_all(&mut bytes, &[7; 1 << 16]).is_ok() {}
    // A file that is open takes its space even after it was removed.
    drop(bytes);
    let scan = daemon.done(&id);
    assert_eq!((&scan["state"], &scan["error"]["type"]), (&json!("failed"), &json!("storage")), "{scan}");
    assert!(scan["bytes"].is_null() && daemon.bundles().is_empty(), "{:?}", daemon.bundles());
    // Known now, it is refused before the first pattern; the interface is there all the while.
    let refused = daemon.post("/v1/scans", &json!({})).expect(503);
    assert_eq!(refused.json()["reasons"][0]["type"], "storage");
    assert_eq!(daemon.get("/readyz").status, 503);
    daemon.get("/livez").expect(200);
    fs::remove_file(filler).unwrap();
    daemon.finished_scan();
    assert_eq!(daemon.get("/readyz").status, 200);
    assert_eq!(daemon.state(&id)["state"], "failed");
}

#[test]
fn a_quota_refuses_before_it_is_exceeded() {
    let daemon = Daemon::on(Rig::small().set("store.quota_gib", 80.0 * MIB / GIB)).started();
    daemon.ready();
    let mut scans = 0;
    let refused = loop {
        let answer = daemon.post("/v1/scans?wait=done", &json!({ "mode": "fast" }));
        if answer.status != 202 {
            break answer.expect(503);
        }
        scans += 1;
        assert!(scans < 50, "no end");
    };
    assert!(scans >= 1);
    assert_eq!(refused.json()["reasons"][0]["type"], "storage");
    let storage = daemon.get("/v1/status").json()["storage"].clone();
    assert!(storage["used_bytes"].as_u64() <= storage["quota_bytes"].as_u64(), "{storage}");
    // Whoever makes room can go on.
    for scan in daemon.get("/v1/scans").json()["scans"].as_array().unwrap() {
        daemon.request("DELETE", scan["href"].as_str().unwrap(), &json!({})).expect(204);
    }
    daemon.finished_scan();
}

#[test]
fn retention_deletes_the_oldest_that_nobody_holds() {
    let rig = Rig::small().set("store.quota_gib", 90.0 * MIB / GIB).set("store.delete_oldest", true);
    let daemon = Daemon::on(rig).started();
    daemon.ready();
    let pinned = daemon.finished_scan()["id"].as_str().unwrap().to_owned();
    daemon.request("PATCH", &format!("/v1/scans/{pinned}"), &json!({ "pinned": true })).expect(200);
    // A folder that the service did not make is not its to delete.
    let foreign = daemon.store.join("foreign");
    fs::create_dir_all(&foreign).unwrap();
    let ids: Vec<String> =
        (0..8).map(|_| daemon.finished_scan()["id"].as_str().unwrap().to_owned()).collect();
    daemon.get(&format!("/v1/scans/{pinned}")).expect(200);
    assert!(foreign.is_dir());
    let left: Vec<bool> = ids.iter().map(|id| daemon.get(&format!("/v1/scans/{id}")).status == 200).collect();
    assert_eq!(left.last(), Some(&true));
    assert!(!left[0], "the oldest made room: {left:?}");
    assert!(left.is_sorted(), "older ones go first: {left:?}");
    let metrics = String::from_utf8(daemon.get("/metrics").body).unwrap();
    assert!(!metrics.contains("polscan_retention_deleted_scans_total 0"), "{metrics}");
}
