//! Rigs on which something is wrong: the verdict must say what, and never be `ok` over a wrong cloud.

use crate::{
    cases::{self, Random},
    rig::{Rig, reasons},
};

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
    rig.scan("scan", &[]).expect(0);
    let report = rig.report("scan");
    assert_eq!(report["verdict"], "degraded", "{}", report["reasons"]);
    assert!(reasons(&report).contains(&"nonlinear-response"), "{}", report["reasons"]);
    assert!(rig.path("scan").join("maps/worst-pair.png").exists());
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
    rig.scan("scan", &[]).expect(0);
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

/// Faults of the suite: one for each way in which frames, display, light, optics and scene go wrong.
const FEW: [&str; 11] = [
    "dropped frame",
    "stale frame",
    "torn frame",
    "dead sensor row",
    "P and Q exchanged",
    "sequence late by a pair",
    "lamp flickers by 10 %",
    "automatic exposure",
    "room light switched on",
    "object bumped",
    "polarizer turned by 15 to 35 degrees",
];

/// One scan of some faults at a quarter of the size; `make faults` makes many of all.
#[test]
fn faults_are_named_and_their_own_bundles_say_the_same() {
    let cases: Vec<_> = cases::all().into_iter().filter(|case| FEW.contains(&case.name)).collect();
    assert_eq!(cases.len(), FEW.len(), "a fault has another name");
    for case in cases {
        let rig = (case.build)(Rig::small(), &mut Random::new(1, 4.0));
        let mode: Vec<&str> = case.mode.map(|mode| vec!["--mode", mode]).unwrap_or_default();
        let run = rig.scan("scan", &mode);
        let report = rig.report("scan");
        let code = i32::from(report["verdict"] == "failed");
        run.expect(code);
        let found = reasons(&report);
        let again = ["retaken", "references_retaken", "discarded"].map(|key| report["capture"][key].clone());
        let again = again.iter().flat_map(|list| list.as_array().expect("a list").clone());
        let again: Vec<String> =
            again.map(|entry| entry["reason"].as_str().expect("a reason").to_owned()).collect();
        let said = |name: &&str| match *name {
            "ok" => found.is_empty(),
            name => found.contains(&name) || again.iter().any(|reason| reason == name),
        };
        let named = case.live.iter().any(said);
        assert!(named, "{}: {found:?}, taken again for {again:?}", case.name);
        let wrong = report["truth"]["wrong_code_rate"].as_f64().unwrap_or(0.0);
        assert!(report["verdict"] != "ok" || wrong < 1e-3, "{}: {wrong} wrong and called ok", case.name);
        if report["pixels"].is_object() {
            rig.decode("scan", "again", &[]).expect(code);
            assert_eq!(reasons(&rig.report("again")), found, "{}", case.name);
        }
    }
}

#[test]
fn surfaces_that_scatter_are_read_with_the_right_polarity_each() {
    let rig = Rig::small().set("sim.scene", "scenes/mixed.toml");
    rig.scan("mixed", &[]).expect(0);
    let report = rig.report("mixed");
    assert_eq!(report["truth"]["wrong_code_rate"], 0.0, "{}", report["truth"]);
    let plane = |report: &serde_json::Value, name: &str, key: &str| {
        let planes = report["planes"].as_array().expect("planes");
        let plane = planes.iter().find(|plane| plane["name"] == name).expect("a plane of that name");
        plane[key].as_f64().expect("a number")
    };
    for name in ["steel", "paint"] {
        assert!(plane(&report, name, "coverage") > 0.98, "{name}: {}", report["planes"]);
    }
    // The paint is inverted, and nothing else is.
    let (inverted, paint) = (report["pixels"]["inverted"].as_f64(), plane(&report, "paint", "points"));
    let inverted = inverted.expect("a count");
    assert!((0.95..1.1).contains(&(inverted / paint)), "{inverted} inverted, {paint} points of paint");

    let rig = Rig::small().set("sim.scene", "scenes/painted.toml");
    rig.scan("painted", &[]).expect(0);
    let report = rig.report("painted");
    assert_eq!(report["truth"]["wrong_code_rate"], 0.0, "{}", report["truth"]);
    assert!(plane(&report, "board", "coverage") > 0.98, "{}", report["planes"]);
    assert!(reasons(&report).contains(&"polarization-inverted"), "{}", report["reasons"]);
    assert_eq!(report["verdict"], "degraded");
}

#[test]
fn faults_of_the_description_are_named_all_at_once() {
    let rig = Rig::small()
        .fault("kind = \"late-frame\", frame = 3, by_ms = -1.0")
        .fault("kind = \"bumped-object\", at_ms = 1.0, object = \"\", by_mm = [1.0, 0.0, 0.0]");
    let run = rig.scan("scan", &[]).expect(64);
    for key in ["sim.faults[0].by_ms", "sim.faults[1].object"] {
        assert!(run.stderr.contains(key), "{}", run.stderr);
    }
}
