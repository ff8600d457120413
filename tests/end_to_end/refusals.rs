//! What the program refuses, with which exit code, and that nothing is left behind.

use std::{fs, process::Command};

use crate::rig::{Rig, polscan, run, text};

#[test]
fn all_faults_of_a_configuration_come_at_once() {
    let rig = Rig::small()
        .set("camera.exposure_us", -1.0)
        .set("camera.driver", "kodak")
        .set("volume.near_mm", 5000.0)
        .set("sim.camera.bits", 11)
        .set("projector.horizontal", "x");
    let run = rig.scan("scan", &[]).expect(64);
    for key in
        ["camera.exposure_us", "camera.driver", "volume.far_mm", "sim.camera.bits", "projector.horizontal"]
    {
        assert!(run.stderr.contains(key), "{key} is not named:\n{}", run.stderr);
    }
    assert!(!rig.path("scan").exists());
    let config = rig.path("rig.toml");
    polscan(&["check-config", text(&config)]).expect(64);
}

#[test]
fn check_config_looks_into_the_calibration() {
    let rig = Rig::small();
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let config = rig.path("rig.toml");
    polscan(&["check-config", text(&config)]).expect(0);
    let path = rig.path("sim-calibration.toml");
    let calibration = fs::read_to_string(&path).expect("the calibration");
    for (wrong, word) in [
        (calibration.replace("size = [400, 300]", "size = [300, 400]"), "exchanged"),
        (calibration.replace("translation_mm = [", "translation_mm = [nan, "), "translation_mm"),
        (String::new(), "calibration"),
    ] {
        assert_ne!(wrong, calibration);
        fs::write(&path, wrong).expect("the calibration is written");
        let run = polscan(&["check-config", "--json", text(&config)]).expect(64);
        assert!(run.stderr.contains("rig.calibration") && run.stderr.contains(word), "{}", run.stderr);
        let printed: serde_json::Value = serde_json::from_str(&run.stdout).expect("one object on stdout");
        assert_eq!(printed["error"]["faults"][0]["key"], "rig.calibration");
    }
}

#[test]
fn an_occupied_folder_is_refused_and_left_alone() {
    let rig = Rig::small();
    fs::create_dir(rig.path("scan")).expect("a folder");
    fs::write(rig.path("scan").join("notes.txt"), "mine").expect("a file in it");
    rig.scan("scan", &[]).expect(74);
    assert_eq!(fs::read_dir(rig.path("scan")).expect("the folder").count(), 1);
}

#[test]
fn no_device_is_69_and_says_what_to_set() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("scan");
    let run = polscan(&["scan", "--out", text(&out)]).expect(69);
    assert!(run.stderr.contains("camera.driver"), "{}", run.stderr);
    assert!(!out.exists());
}

#[test]
fn an_unknown_variable_of_our_form_is_a_bad_configuration() {
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("scan");
    let mut command = Command::new(env!("CARGO_BIN_EXE_polscan"));
    command.args(["scan", "--out", text(&out)]).env("POLSCAN_SCAN__MOOD", "gray");
    let run = run(&mut command).expect(64);
    assert!(run.stderr.contains("POLSCAN_SCAN__MOOD"), "{}", run.stderr);
}

#[test]
fn a_damaged_bundle_is_bad_data_and_leaves_nothing() {
    let rig = Rig::small();
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    // The bundle itself is never a place for results.
    rig.decode("scan", "scan", &[]).expect(74);
    rig.decode("scan", "scan/inside", &[]).expect(74);
    let frames = rig.path("scan").join("frames.npy");
    let whole = fs::read(&frames).expect("frames");
    let mut flipped = whole.clone();
    let middle = flipped.len() / 2;
    flipped[middle] ^= 1;
    for (what, bytes) in [("cut", &whole[..whole.len() - 7]), ("changed", &flipped[..])] {
        fs::write(&frames, bytes).expect("frames are written");
        let run = rig.decode("scan", "out", &[]).expect(65);
        assert!(run.stderr.contains("frames.npy"), "{what}: {}", run.stderr);
        assert!(!rig.path("out").exists(), "{what}");
    }
    polscan(&["decode", "/nowhere", "--out", text(&rig.path("out"))]).expect(65);
}

#[test]
fn a_calibration_of_another_size_is_bad_data() {
    let rig = Rig::small();
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let full = concat!(env!("CARGO_MANIFEST_DIR"), "/config/sim-calibration.toml");
    let run = rig.decode("scan", "out", &["--calibration", full]).expect(65);
    assert!(run.stderr.contains("1600"), "{}", run.stderr);
    assert!(!rig.path("out").exists());
}

#[test]
fn wrong_usage_is_2() {
    polscan(&["scan"]).expect(2);
    polscan(&["scan", "--mode", "fringe", "--out", "x"]).expect(2);
    polscan(&["scan", "--region", "a=1,2,3", "--out", "x"]).expect(2);
    let run = polscan(&["frobnicate", "--json"]).expect(2);
    let printed: serde_json::Value = serde_json::from_str(&run.stdout).expect("one object on stdout");
    assert_eq!((&printed["error"]["type"], &printed["exit_code"]), (&"usage".into(), &2.into()));
    assert!(run.stderr.contains("frobnicate"), "{}", run.stderr);
}
