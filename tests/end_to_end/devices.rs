//! Which cameras the program finds, on a camera in software that listens on the loopback network.

use std::fs;

use polscan_drivers::aravis::fake::Fake;

use crate::rig::{polscan, text};

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
