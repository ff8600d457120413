//! Rigs on which something is wrong: the verdict must say what, and never be `ok` over a wrong cloud.

use crate::rig::{Rig, reasons};

#[test]
fn an_empty_scene_is_a_failure_that_keeps_its_report() {
    let rig = Rig::small().set("sim.scene", "scenes/empty.toml");
    rig.scan("scan", &[]).expect(1);
    let report = rig.report("scan");
    assert_eq!(report["verdict"], "failed");
    assert!(reasons(&report).contains(&"nothing-lit"), "{}", report["reasons"]);
    assert!(rig.path("scan").join("frames.npy").exists());
}

#[test]
fn a_camera_that_is_not_linear_is_seen_by_the_decode_of_its_frames() {
    // The settings ask for the gamma that this camera has, so that it does not refuse.
    let rig = Rig::small().set("sim.camera.gamma", 0.45).set("camera.gamma", 0.45);
    rig.scan("scan", &[]);
    let report = rig.report("scan");
    assert_ne!(report["verdict"], "ok");
}

#[test]
fn a_gamma_that_the_camera_does_not_have_is_refused_before_anything_is_shown() {
    let rig = Rig::small().set("camera.gamma", 2.2);
    let run = rig.scan("scan", &[]).expect(69);
    assert!(run.stderr.contains("gamma"), "{}", run.stderr);
    assert!(!rig.path("scan").exists());
}

#[test]
fn channels_in_the_wrong_order_are_named() {
    let rig = Rig::small().set("projector.horizontal", "rb").set("projector.vertical", "g");
    rig.scan("scan", &[]);
    let report = rig.report("scan");
    assert_ne!(report["verdict"], "ok");
    assert!(reasons(&report).contains(&"polarization-inverted"), "{}", report["reasons"]);
}

#[test]
fn the_calibration_of_another_pose_is_a_row_mismatch() {
    let rig = Rig::small();
    let path = rig.path("sim-calibration.toml");
    let text = std::fs::read_to_string(&path).expect("the calibration");
    // Two millimetres up: a bumped projector.
    std::fs::write(&path, text.replace("-0.625", "-2.625")).expect("the calibration is written");
    rig.scan("scan", &[]);
    let report = rig.report("scan");
    assert_ne!(report["verdict"], "ok");
    assert!(reasons(&report).contains(&"row-mismatch"), "{}", report["reasons"]);
}
