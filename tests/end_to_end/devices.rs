//! Which cameras the program finds, on a camera in software that listens on the loopback network.

use std::fs;

use polscan_drivers::aravis::fake::Fake;

use crate::rig::{Rig, polscan, text};

#[test]
fn a_camera_on_the_network_is_listed_with_its_serial() {
    let _camera = Fake::new("PS-42", None, |_, _| {}).expect("a camera in software");
    let folder = tempfile::tempdir().expect("a folder");
    let config = folder.path().join("rig.toml");
    fs::write(&config, "[camera]\ndriver = \"aravis\"\n").expect("a configuration");
    let run = polscan(&["devices", "--json", "--config", text(&config)]).expect(0);
    let listed: serde_json::Value = serde_json::from_str(&run.stdout).expect("one object on stdout");
    let cameras = listed["cameras"].as_array().expect("cameras");
    let mine = cameras.iter().find(|camera| camera["serial"] == "PS-42").expect("the camera");
    assert_eq!(mine["driver"], "aravis");
    assert_eq!(mine["unusable"], serde_json::Value::Null, "{mine}");
}

/// What the doctor says with the given configuration: its findings by check.
fn findings(config: &std::path::Path, code: i32) -> Vec<(String, String, String)> {
    let run = polscan(&["doctor", "--json", "--config", text(config)]).expect(code);
    let said: serde_json::Value = serde_json::from_str(&run.stdout).expect("one object on stdout");
    assert_eq!(said["passed"], code == 0, "{said:#}");
    let word = |finding: &serde_json::Value, key: &str| finding[key].as_str().expect("a text").to_owned();
    let all = said["findings"].as_array().expect("findings");
    all.iter().map(|found| (word(found, "check"), word(found, "level"), word(found, "message"))).collect()
}

#[test]
fn the_simulated_rig_is_well_and_one_without_devices_is_not() {
    let rig = Rig::small();
    let well = findings(&rig.config(), 0);
    let checks: Vec<&str> = well.iter().map(|(check, ..)| check.as_str()).collect();
    assert_eq!(checks, ["camera", "projector", "calibration", "disk", "clock"]);
    let folder = tempfile::tempdir().expect("a folder");
    let config = folder.path().join("rig.toml");
    fs::write(&config, "[store]\nmin_free_gib = 1e6\n").expect("a configuration");
    let bad: Vec<(String, String, String)> =
        findings(&config, 1).into_iter().filter(|(_, level, _)| level == "bad").collect();
    for (check, words) in
        [("camera", "set camera.driver"), ("projector", "set projector.driver"), ("disk", "delete")]
    {
        let found = bad.iter().find(|(found, ..)| found == check).expect("it is found");
        assert!(found.2.contains(words), "{found:?}");
    }
    assert_eq!(bad.len(), 3, "{bad:?}");
}

#[test]
fn a_camera_that_answers_is_no_complaint_of_the_doctor() {
    let _camera = Fake::new("PS-43", None, |_, _| {}).expect("a camera in software");
    let folder = tempfile::tempdir().expect("a folder");
    let config = folder.path().join("rig.toml");
    fs::write(&config, "[camera]\ndriver = \"aravis\"\nserial = \"PS-43\"\n").expect("a configuration");
    let found = findings(&config, 1);
    let camera = found.iter().find(|(check, ..)| check == "camera").expect("the camera");
    assert_eq!((camera.1.as_str(), camera.2.contains("PS-43 is usable")), ("ok", true), "{camera:?}");
    assert!(found.iter().any(|(check, ..)| check == "udev-rule"), "{found:?}");
}
