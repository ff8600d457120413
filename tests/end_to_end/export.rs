//! Scans in the formats of other programs: what is written, what is refused, and that nothing is ever half there. What the files
//! hold is compared by tests/python/exports.py, with readers of others.

use std::fs;

use serde_json::Value;

use crate::rig::{Rig, Run, polscan, text};

fn export(rig: &Rig, bundle: &str, out: &str, arguments: &[&str]) -> Run {
    let (bundle, out) = (rig.path(bundle), rig.path(out));
    polscan(&[&["export", "--json", text(&bundle), "--out", text(&out)], arguments].concat())
}

fn answer(run: &Run) -> Value {
    serde_json::from_str(&run.stdout).expect("one object on stdout")
}

fn names(list: &Value) -> Vec<&str> {
    let list = list.as_array().expect("a list");
    list.iter().map(|file| file["name"].as_str().expect("a name")).collect()
}

/// Files of the folder `name` of the rig, without those that end in `but`.
fn listing(rig: &Rig, name: &str) -> Vec<String> {
    let entries = fs::read_dir(rig.path(name)).expect("a folder");
    let mut names: Vec<String> =
        entries.map(|entry| entry.expect("an entry").file_name().into_string().expect("text")).collect();
    names.sort();
    names
}

#[test]
fn files_and_folders_appear_whole_or_not_at_all() {
    let rig = Rig::scaled(8.0);
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let before = listing(&rig, "scan");

    let run = export(&rig, "scan", "all", &[]).expect(0);
    let written = answer(&run);
    let expected =
        ["cloud.e57", "cloud.pcd", "cloud.xyz", "mesh.obj", "depth.tiff", "depth.f32.tiff", "mask.png"];
    for name in expected {
        assert!(names(&written["files"]).contains(&name), "{name} in {written:#}");
        let bytes = fs::metadata(rig.path("all").join(name)).expect("a file").len();
        let file = written["files"].as_array().expect("a list").iter().find(|file| file["name"] == name);
        assert_eq!(file.expect("it is listed")["bytes"], bytes, "{name}");
    }
    let key: Value = serde_json::from_slice(&rig.bytes("all", "export.json")).expect("JSON");
    assert_eq!(key["files"], written["files"]);
    assert_eq!(listing(&rig, "all").len(), names(&written["files"]).len() + 1);

    // The same again, as single files: equal bytes.
    for (name, arguments) in
        [("cloud.e57", &[][..]), ("cloud.pcd", &[]), ("mesh.obj", &["--format", "obj"]), ("depth.tiff", &[])]
    {
        export(&rig, "scan", &format!("deep/er/{name}"), arguments).expect(0);
        assert!(rig.bytes("deep/er", name) == rig.bytes("all", name), "{name} differs");
    }
    // A bundle may be named by its manifest.
    export(&rig, "scan/manifest.json", "by-manifest.xyz", &[]).expect(0);
    assert!(rig.bytes("", "by-manifest.xyz") == rig.bytes("all", "cloud.xyz"));

    // What is there stays.
    fs::write(rig.path("mine.xyz"), "mine").expect("a file");
    let run = export(&rig, "scan", "mine.xyz", &[]).expect(74);
    assert!(run.stderr.contains("mine.xyz") && run.stderr.contains("exists"), "{}", run.stderr);
    assert_eq!(rig.bytes("", "mine.xyz"), b"mine");
    export(&rig, "scan", "all", &["--format", "xyz"]).expect(74);
    export(&rig, "scan", "mine.xyz", &["--format", "xyz,pcd"]).expect(2);

    // Nor is anything ever written into the bundle.
    for out in ["scan/cloud.e57", "scan/maps/cloud.e57", "scan", "scan/exports"] {
        let run = export(&rig, "scan", out, &["--format", "e57"]).expect(74);
        assert!(run.stderr.contains("bundle"), "{out}: {}", run.stderr);
    }
    assert_eq!(listing(&rig, "scan"), before);
}

#[test]
fn a_scan_without_a_calibration_gives_its_maps() {
    let rig = Rig::scaled(8.0);
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    fs::remove_file(rig.path("scan/calibration.toml")).expect("the calibration is removed");
    let manifest = rig.path("scan/manifest.json");
    let mut object: Value =
        serde_json::from_slice(&fs::read(&manifest).expect("the manifest")).expect("JSON");
    object.as_object_mut().expect("an object").remove("calibration");
    fs::write(&manifest, object.to_string()).expect("the manifest is written");
    rig.decode("scan", "bare", &[]).expect(0);
    assert!(!rig.path("bare/cloud.ply").exists(), "this test needs a scan without a cloud");

    for out in ["cloud.e57", "mesh.obj"] {
        let run = export(&rig, "bare", out, &[]).expect(65);
        assert!(run.stderr.contains(out) && run.stderr.contains("calibration"), "{}", run.stderr);
        assert!(!rig.path(out).exists());
    }
    let run = export(&rig, "bare", "points", &["--format", "pcd,png"]).expect(65);
    assert!(run.stderr.contains("cloud.pcd") && !rig.path("points").exists(), "{}", run.stderr);
    export(&rig, "bare", "depth.png", &[]).expect(65);

    let run = export(&rig, "bare", "maps", &[]).expect(0);
    let written = answer(&run);
    assert!(names(&written["files"]).contains(&"column.tiff"), "{written:#}");
    for name in ["cloud.e57", "cloud.pcd", "cloud.xyz", "mesh.obj", "depth.tiff"] {
        assert!(names(&written["skipped"]).contains(&name), "{name} in {written:#}");
        assert!(!rig.path("maps").join(name).exists());
    }
}

#[test]
fn damaged_bundles_are_bad_data_and_wrong_words_wrong_usage() {
    let rig = Rig::scaled(8.0);
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    for name in ["cloud.ply", "maps.npz", "manifest.json"] {
        let path = rig.path("scan").join(name);
        let whole = fs::read(&path).expect("a file of the bundle");
        for bytes in [&whole[..whole.len() / 2], b""] {
            fs::write(&path, bytes).expect("it is damaged");
            let run = export(&rig, "scan", "out", &[]).expect(65);
            assert!(run.stderr.contains(name), "{name}: {}", run.stderr);
            assert!(!rig.path("out").exists(), "{name}");
        }
        fs::write(&path, whole).expect("it is mended");
    }
    export(&rig, "nowhere", "out", &[]).expect(65);
    for (out, arguments) in [("a.las", &[][..]), ("a.tiff", &[]), ("a.e57", &["--format", "png"])] {
        let run = export(&rig, "scan", out, arguments).expect(2);
        assert_eq!(answer(&run)["error"]["type"], "usage", "{out}");
        assert!(!rig.path(out).exists(), "{out}");
    }
}
