//! A recorder that believes every frame: it shows each picture, triggers, and keeps what arrives in the order of arrival.

use std::{fs, time::Duration};

use polscan::{
    app,
    config::{Layers, Override, Settings},
    sequencer::{Plan, PlanOptions, slide},
    store::maps,
};
use polscan_drivers::{clock::Timestamp, error::DeviceError, frame::Pixels};
use polscan_patterns::{ProjectorSize, Sequence};
use serde_json::json;

use crate::rig::{Rig, json};

/// How long it waits for a frame.
const PATIENCE: Duration = Duration::from_millis(300);

/// Records a bundle of the rig into `out`, to be processed as the live scan in `scan` was.
pub fn record(rig: &Rig, mode: Option<&str>, out: &str) {
    let settings = settings(rig, mode);
    let mut devices = app::Rig::open(&settings).expect("the twin opens");
    let applied = devices.camera.apply(&settings.camera).expect("the settings are applied");
    let info = devices.projector.info().clone();
    let size = ProjectorSize { width: info.width, height: info.height };
    let sequence = Sequence::new(settings.mode, size).expect("a sequence");
    let options = PlanOptions {
        trigger_delay: (settings.raw.projector.trigger_delay_ms > 0.0)
            .then(|| Duration::from_secs_f64(1e-3 * settings.raw.projector.trigger_delay_ms)),
        hold_refreshes: (settings.raw.projector.hold_refreshes > 0)
            .then_some(settings.raw.projector.hold_refreshes),
        ..PlanOptions::default()
    };
    let camera = devices.camera.info().clone();
    let plan = Plan::new(sequence.clone(), settings.polarization, &info, &camera, applied.clone(), &options)
        .expect("a timetable");
    let slides: Vec<_> =
        sequence.roles.iter().map(|&role| slide(sequence.raster(role, settings.polarization))).collect();
    devices.projector.load(&slides).expect("the slides are loaded");
    devices.camera.arm(slides.len()).expect("the camera is armed");

    let mut samples: Vec<Vec<u8>> = Vec::new();
    let wide = applied.settings.format.bit_depth() > 8;
    let mut due = Timestamp(0);
    for attempt in 0..2 * slides.len() {
        if samples.len() == slides.len() {
            break;
        }
        devices.clock.sleep_until(due);
        // Frames that are missing at the end are triggered on the last picture.
        let index = attempt.min(slides.len() - 1);
        let receipt = devices.projector.show(index as u32).expect("a flip");
        due = plan.timing.next_show(receipt.flipped);
        devices.camera.trigger(receipt.flipped + plan.timing.trigger_delay).expect("a trigger");
        match devices.camera.next_frame(PATIENCE) {
            Ok(frame) => samples.push(match frame.pixels() {
                Pixels::U8(values) => values.to_vec(),
                Pixels::U16(values) => values.iter().flat_map(|value| value.to_le_bytes()).collect(),
            }),
            Err(DeviceError::Timeout { .. }) => {}
            Err(error) => panic!("{error}"),
        }
    }
    assert_eq!(samples.len(), slides.len(), "too many frames were lost");

    let folder = rig.path(out);
    fs::create_dir(&folder).expect("a folder for the recording");
    let (height, width) = (applied.height, applied.width);
    let mut npy = header(if wide { "<u2" } else { "|u1" }, [samples.len() as u32, height, width]);
    samples.iter().for_each(|frame| npy.extend_from_slice(frame));
    fs::write(folder.join("frames.npy"), npy).expect("the frames are written");
    let live = json(&rig.path("scan").join("manifest.json"));
    let mut manifest = json!({
        "schema": "polscan.bundle/1",
        "mode": settings.mode,
        "projector": { "width": size.width, "height": size.height },
        "sequence": sequence.roles,
        "code_offset": { "column": sequence.column.offset(), "row": sequence.row.offset() },
        "frames": "frames.npy",
        "camera": {
            "width": width, "height": height, "bit_depth": applied.settings.format.bit_depth(),
            "black_level": applied.black_level_dn, "saturation": applied.saturation_dn,
        },
        "processing": live["processing"],
    });
    if let Some(noise) = applied.noise {
        manifest["camera"]["gain_dn_per_electron"] = json!(noise.gain_dn_per_electron);
        manifest["camera"]["read_noise_dn"] = json!(noise.read_noise_dn);
    }
    if !settings.raw.rig.calibration.is_empty() {
        manifest["calibration"] = json!("calibration.toml");
        let calibration = &settings.calibration.as_ref().expect("a calibration is configured").path;
        fs::copy(calibration, folder.join("calibration.toml")).expect("the calibration");
    }
    if let Some(truth) = devices.truth() {
        let file = fs::File::create(folder.join("truth.npz")).expect("a file for the truth");
        maps::write_truth(file, &truth).expect("the truth is written");
        manifest["truth_objects"] = json!(truth.objects);
    }
    let text = serde_json::to_string(&manifest).expect("a manifest is JSON");
    fs::write(folder.join("manifest.json"), text).expect("the manifest is written");
}

fn settings(rig: &Rig, mode: Option<&str>) -> Settings {
    let overrides = mode.map(|mode| Override::flag("--mode", "scan.mode", mode)).into_iter().collect();
    Layers { file: Some(rig.config()), overrides }.load().expect("a sound configuration")
}

/// Header of numpy's format 1.0.
fn header(descr: &str, shape: [u32; 3]) -> Vec<u8> {
    let [frames, height, width] = shape;
    let mut text =
        format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({frames}, {height}, {width}), }}");
    let length = (10 + text.len() + 1).next_multiple_of(64) - 10;
    text.push_str(&" ".repeat(length - text.len() - 1));
    text.push('\n');
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((length as u16).to_le_bytes());
    bytes.extend(text.into_bytes());
    bytes
}
