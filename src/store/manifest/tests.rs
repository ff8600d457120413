use polscan_drivers::{
    camera::{PixelFormat, TriggerSource},
    projector::ReceiptMethod,
};
use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;
use crate::store::{
    error::Faults,
    source::Policy::{self, Local, Upload},
};

/// The example of the public description, word for word.
const EXAMPLE: &str = r#"{ "schema": "polscan.bundle/1",
  "mode": "gray",
  "projector": {"width": 1024, "height": 768},
  "code_offset": {"column": 0, "row": 0},
  "code_bits": {"column": 10, "row": 10},
  "sequence": [ {"role": "white"}, {"role": "black"},
                {"role": "code", "axis": "column", "bit": 0}, {"role": "code", "axis": "column", "bit": 0, "inverse": true} ],
  "frames": ["img_01.png", "img_02.png", "img_03.png", "img_04.png"],
  "camera": {"width": 1600, "height": 1200, "bit_depth": 12, "black_level": 41.0, "saturation": 4095,
             "gain_dn_per_electron": 0.39, "read_noise_dn": 0.9},
  "calibration": "calibration.toml" }"#;

fn example() -> Value {
    serde_json::from_str(EXAMPLE).unwrap()
}

fn read(value: &Value, policy: Policy) -> Result<Manifest, Faults> {
    let manifest = Manifest::parse(&serde_json::to_vec(value).unwrap())?.manifest;
    manifest.check(policy, None)?;
    Ok(manifest)
}

fn faults(value: &Value, policy: Policy) -> Vec<String> {
    read(value, policy).unwrap_err().0.iter().map(ToString::to_string).collect()
}

/// Sets the value at a JSON pointer and returns the faults.
fn faults_with(pointer: &str, value: Value) -> Vec<String> {
    let mut manifest = example();
    match manifest.pointer_mut(pointer) {
        Some(place) => *place = value,
        None => {
            let (parent, key) = pointer.rsplit_once('/').unwrap();
            manifest.pointer_mut(parent).unwrap()[key] = value;
        }
    }
    faults(&manifest, Local)
}

fn role(text: &str) -> Role {
    serde_json::from_str(text).unwrap()
}

#[test]
fn the_public_example_is_read_and_written_back() {
    let manifest = read(&example(), Upload).unwrap();
    assert_eq!(manifest.mode, Some(Mode::Gray));
    assert_eq!(manifest.sequence[3], Role::Code { axis: Axis::Column, bit: 0, inverse: true });
    assert_eq!(manifest.camera.unwrap().black_level, Some(41.0));
    let written: Value = serde_json::from_slice(&manifest.to_json().unwrap()).unwrap();
    assert_eq!(written, example());
}

#[test]
fn roles_have_their_public_names() {
    for (text, expected) in [
        (r#"{"role":"reference-v"}"#, Role::ReferenceV),
        (r#"{"role":"reference-h"}"#, Role::ReferenceH),
        (r#"{"role":"white"}"#, Role::White),
        (r#"{"role":"black"}"#, Role::Black),
        (r#"{"role":"code","axis":"row","bit":9}"#, Role::Code { axis: Axis::Row, bit: 9, inverse: false }),
        (
            r#"{"role":"code","axis":"column","bit":0,"inverse":true}"#,
            Role::Code { axis: Axis::Column, bit: 0, inverse: true },
        ),
    ] {
        assert_eq!(role(text), expected);
        assert_eq!(serde_json::to_string(&expected).unwrap(), text);
    }
    let explicit = r#"{"role":"code","axis":"row","bit":9,"inverse":false}"#;
    assert_eq!(role(explicit), Role::Code { axis: Axis::Row, bit: 9, inverse: false });
}

#[test]
fn three_keys_are_enough() {
    let small = json!({"schema": SCHEMA, "sequence": [{"role": "code", "axis": "row", "bit": 0}], "frames": ["a.png"]});
    let manifest = read(&small, Upload).unwrap();
    let size = ProjectorSize { width: 1024, height: 768 };
    let sequence = manifest.resolve_sequence(Some(Mode::Gray), Some(size)).unwrap();
    assert_eq!((sequence.column.bits(), sequence.row.bits()), (10, 10));
    assert_eq!((sequence.column.offset(), sequence.row.offset()), (0, 0));
    let settings = manifest.decode_settings(&sequence, (7, 5), 16);
    assert_eq!((settings.camera.bit_depth, settings.camera.saturation_dn), (16, 65_535));
    assert_eq!(manifest.decode_settings(&sequence, (7, 5), 8).camera.saturation_dn, 255);
    assert_eq!(settings.camera.noise, None);
    // What nothing tells is asked for, all at once.
    let open = manifest.resolve_sequence(None, None).unwrap_err();
    let keys: Vec<&str> = open.0.iter().map(|fault| fault.key.as_str()).collect();
    assert_eq!(keys, ["mode", "projector"]);
}

#[test]
fn the_mode_is_told_by_references_where_only_one_has_them() {
    let mode = |roles: Value| {
        let manifest = json!({"schema": SCHEMA, "projector": {"width": 4, "height": 4},
            "sequence": roles, "frames": "frames.npy"});
        read(&manifest, Local).unwrap().resolve_sequence(None, None).map(|sequence| sequence.mode)
    };
    let code = json!({"role": "code", "axis": "column", "bit": 0});
    assert_eq!(mode(json!([{"role": "black"}, code])), Ok(Mode::Gray));
    assert_eq!(mode(json!([{"role": "reference-v"}, {"role": "reference-h"}, code])), Ok(Mode::Pse));
    assert!(mode(json!([{"role": "reference-v"}, code])).is_err());
    // A mode that is asked for comes before all, and must fit the references.
    let manifest = read(&example(), Local).unwrap();
    let error = manifest.resolve_sequence(Some(Mode::Pse), None).unwrap_err();
    assert_eq!(error.0.len(), 2);
    assert!(manifest.check(Local, Some(Mode::Pse)).is_err());
}

#[test]
fn every_fault_is_found_and_named() {
    let cases: Vec<(&str, Value, &str)> = vec![
        ("/schema", json!("polscan.bundle/2"), "newer than this program"),
        ("/schema", json!("other/1"), "expected \"polscan.bundle/1\""),
        ("/mode", json!("grey"), "`mode`: unknown variant `grey`"),
        ("/projector", json!({"width": 1024}), "`projector.height`: is missing"),
        ("/projector/width", json!(0), "outside 1..=8192"),
        ("/projector/width", json!(9000), "outside 1..=8192"),
        ("/projector/width", json!(-1), "`projector.width`"),
        ("/code_bits/column", json!(9), "`code_bits.column`: 9 code bits and offset 0 cannot number 1024"),
        ("/code_bits/column", json!(17), "17 bits"),
        ("/code_offset/column", json!(1), "10 code bits and offset 1 cannot number 1024"),
        ("/code_offset/row", json!(4_294_967_295u32), "cannot number 768"),
        ("/sequence", json!([]), "no code frames (role \"code\")"),
        ("/sequence", json!("all"), "must be a list"),
        ("/sequence/0", json!({"role": "wite"}), "`sequence[0]`: unknown variant `wite`"),
        ("/sequence/0", json!({"role": "white", "inverse": true}), "unknown key `inverse`"),
        (
            "/sequence/0",
            json!({"role": "reference-h"}),
            "`sequence[0].role`: reference-h does not belong to mode gray",
        ),
        ("/sequence/2", json!({"role": "code", "axis": "column", "bit": 10}), "`sequence[2].bit`"),
        (
            "/sequence/2",
            json!({"role": "code", "axis": "column", "bit": 0, "invers": true}),
            "unknown key `invers`",
        ),
        ("/sequence/2", json!({"role": "code", "axis": "column"}), "missing field `bit`"),
        (
            "/sequence/2",
            json!({"role": "code", "axis": "column", "bit": 0, "inverse": true}),
            "is at 2 already",
        ),
        ("/sequence/2", json!({"role": "code", "axis": "column", "bit": 3}), "column bits 1, 2 are missing"),
        ("/frames", json!(["a.png"]), "1 images for the 4 entries"),
        ("/frames", json!("frames.png"), "not a .npy"),
        ("/frames", json!(7), "`frames`: must be a list of image paths"),
        ("/frames", Value::Null, "`frames`: is missing"),
        ("/frames/1", json!(""), "`frames[1]`: \"\" is an empty path"),
        ("/frames/1", json!("b.npy"), "without a list"),
        ("/camera/bit_depth", json!(17), "expected 1 to 16"),
        ("/camera/bit_depth", json!(0), "expected 1 to 16"),
        ("/camera/saturation", json!(5000), "expected 1 to 4095"),
        ("/camera/saturation", json!(10.5), "whole number"),
        ("/camera/black_level", json!(-1), "`camera.black_level`: is -1 DN"),
        ("/camera/black_level", json!(4095), "less than the saturation 4095"),
        ("/camera/gain_dn_per_electron", json!(0), "expected a positive number"),
        ("/camera/read_noise_dn", json!(-0.5), "not negative"),
        (
            "/camera/read_noise_dn",
            Value::Null,
            "`camera.read_noise_dn`: is missing while gain_dn_per_electron",
        ),
        ("/camera/width", json!(0), "at least 1 px"),
        ("/camera", json!([]), "`camera`: must be an object"),
        ("/calibration", json!(3), "`calibration`"),
        ("/processing", json!({"volume": {"near_mm": 900.0, "far_mm": 800.0}}), "is no range"),
        ("/processing", json!({"thresholds": {"lit_sigma": -4.0}}), "`processing.thresholds.lit_sigma`"),
        ("/files", json!({"a": {"bytes": 1, "sha256": "xyz"}}), "`files.a.sha256`"),
    ];
    for (pointer, value, expected) in cases {
        let found = faults_with(pointer, value.clone());
        assert!(found.iter().any(|fault| fault.contains(expected)), "{pointer} = {value}: {found:?}");
    }
}

#[test]
fn every_gate_has_its_range() {
    let mut manifest = read(&example(), Upload).unwrap();
    let mut found = |thresholds| {
        manifest.processing = Some(Processing { thresholds, ..Processing::default() });
        match manifest.check(Upload, None) {
            Ok(()) => Vec::new(),
            Err(faults) => faults.0.into_iter().map(|fault| fault.key).collect(),
        }
    };
    let gates = |lit_sigma, soft_bit_sigma, snap_px, fit_edges| Thresholds {
        lit_sigma,
        soft_bit_sigma,
        snap_px,
        fit_edges,
    };
    for allowed in [Thresholds::default(), gates(1.0, 0.1, 0.5, 2), gates(100.0, 100.0, 16.0, 64)] {
        assert!(found(allowed).is_empty(), "{allowed:?}");
    }
    let all = ["lit_sigma", "soft_bit_sigma", "snap_px", "fit_edges"]
        .map(|key| format!("processing.thresholds.{key}"));
    for refused in [
        gates(0.99, 0.09, 0.49, 1),
        gates(100.1, 100.1, 16.1, 65),
        gates(f64::NAN, f64::NAN, f64::NAN, 0),
        gates(f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, usize::MAX),
    ] {
        assert_eq!(found(refused), all, "{refused:?}");
    }
}

#[test]
fn all_faults_are_reported_at_once() {
    let mut manifest = example();
    manifest["mode"] = json!(1);
    manifest["camera"]["bit_depth"] = json!("twelve");
    manifest["camera"]["black_level"] = json!([]);
    manifest["sequence"][0] = json!({"role": "x"});
    assert_eq!(faults(&manifest, Local).len(), 4);
    let mut manifest = example();
    manifest["camera"]["bit_depth"] = json!(20);
    manifest["code_bits"]["row"] = json!(3);
    manifest["frames"] = json!(["a.png"]);
    assert_eq!(faults(&manifest, Local).len(), 3);
}

#[test]
fn references_may_occur_again() {
    let mut manifest = example();
    manifest["sequence"][1] = json!({"role": "white"});
    read(&manifest, Local).unwrap();
}

#[test]
fn numbers_that_json_cannot_hold_are_refused_all_the_same() {
    let mut manifest = read(&example(), Local).unwrap();
    let camera = manifest.camera.as_mut().unwrap();
    (camera.black_level, camera.read_noise_dn) = (Some(f64::NAN), Some(f64::INFINITY));
    assert_eq!(manifest.check(Local, None).unwrap_err().0.len(), 2);
}

#[test]
fn uploads_may_not_lead_out_of_their_folder() {
    for path in ["/etc/passwd", "../a.png", "a/../../b.png", "..\\b.png", "C:\\a.png"] {
        let mut manifest = example();
        manifest["frames"][2] = json!(path);
        manifest["calibration"] = json!(path);
        read(&manifest, Local).unwrap();
        let found = faults(&manifest, Upload);
        assert_eq!(found.len(), 2, "{path}: {found:?}");
        assert!(found[0].contains("`frames[2]`") && found[1].contains("`calibration`"), "{found:?}");
    }
    let mut manifest = example();
    manifest["frames"][2] = json!("./sub/a..b.png");
    read(&manifest, Upload).unwrap();
}

#[test]
fn unknown_keys_are_ignored_and_told() {
    let mut manifest = example();
    manifest["lens"] = json!("16 mm");
    manifest["camera"]["iso"] = json!(100);
    let parsed = Manifest::parse(&serde_json::to_vec(&manifest).unwrap()).unwrap();
    assert_eq!(parsed.unknown_keys, ["camera.iso", "lens"]);
}

#[test]
fn a_full_manifest_of_our_own_survives() {
    let sequence = Sequence::new(Mode::Fast, ProjectorSize { width: 12, height: 7 }).unwrap();
    let mut manifest = Manifest::new(&sequence, FrameFiles::Npy("frames.npy".to_owned()));
    manifest.stamp(SystemTime::UNIX_EPOCH);
    manifest.id = Some("s1".to_owned());
    manifest.tags = vec!["plate".to_owned()];
    let wanted = CameraSettings {
        exposure_us: 2000.1,
        gain_db: 0.0,
        gamma: 1.0,
        region: None,
        format: PixelFormat::Mono12,
        trigger: TriggerSource::Software,
    };
    manifest.settings = Some(Settings {
        requested: wanted.clone(),
        applied: AppliedSettings {
            settings: wanted,
            width: 1600,
            height: 1200,
            black_level_dn: Some(40.95),
            saturation_dn: 4095,
            readout_us: 6100.0,
            noise: None,
        },
    });
    let evidence = |index: u64| FrameEvidence {
        receipt: PresentReceipt {
            slide: Some(index as u32),
            flipped: Timestamp(index * 16_666_667),
            refresh: None,
            method: ReceiptMethod::Simulated,
        },
        triggered: Timestamp(index * 16_666_667 + 1),
        phase_error_us: Some(-0.5),
        stamp: FrameStamp {
            frame_id: index,
            trigger: index,
            exposure_start: Timestamp(u64::MAX - index),
            received: Timestamp(3),
            device_time_ns: Some(u64::MAX),
        },
    };
    manifest.capture = Some(Capture {
        seconds: 0.1 + 0.2,
        limit_seconds: 1.0 / 3.0,
        latency_ms: 33.3,
        hold_refreshes: 1,
        timing_measured: true,
        synchrony: Some(crate::sequencer::Synchrony::default()),
        statistics: StreamStatistics::default(),
        frames: (0..sequence.roles.len() as u64).map(evidence).collect(),
        retaken: vec![Retake {
            axis: Axis::Column,
            bit: 3,
            reason: "motion".to_owned(),
            evidence: "residual 9.1 sigma".to_owned(),
            attempt: 1,
        }],
        notes: CaptureNotes::default(),
        failure: None,
    });
    manifest.truth_objects = Some(vec![TruthObject { name: "white".to_owned(), planar: true }]);
    manifest.processing = Some(Processing {
        volume: Some(Volume { near_mm: 800.0, far_mm: 1200.0 }),
        regions: vec![NamedRegion { name: "a".to_owned(), x: 1, y: 2, width: 3, height: 4 }],
        row_gate_px: 2.5,
        ..Processing::default()
    });
    manifest.files.insert("frames.npy".to_owned(), FileEntry { bytes: 1, sha256: "0".repeat(64) });
    manifest.check(Local, None).unwrap();
    let parsed = Manifest::parse(&manifest.to_json().unwrap()).unwrap();
    assert_eq!(parsed.manifest, manifest);
    assert!(parsed.unknown_keys.is_empty());
    // The code is written out, so that it does not depend on this program's choice of offsets.
    assert_eq!(parsed.manifest.resolve_sequence(None, None).unwrap(), sequence);
    // A frame without evidence is a fault.
    manifest.capture.as_mut().unwrap().frames.pop();
    assert!(manifest.check(Local, None).unwrap_err().to_string().contains("capture.frames"));
}

proptest! {
    #[test]
    fn decode_settings_survive_exactly(
        width in 1u32..2000, height in 1u32..2000, black in 0.0f64..200.0, gain in 1e-3f64..10.0,
        read_noise in 0.0f64..20.0, lit in 1.0f64..10.0, soft in 0.1f64..10.0, depth in 9u8..17, noisy: bool,
    ) {
        let sequence = Sequence::new(Mode::Pse, ProjectorSize { width, height }).unwrap();
        let mut manifest = Manifest::new(&sequence, FrameFiles::Npy("frames.npy".to_owned()));
        let noise = noisy.then_some(crate::decode::NoiseModel { gain_dn_per_electron: gain, read_noise_dn: read_noise });
        let settings = DecodeSettings {
            mode: Mode::Pse,
            column: sequence.column,
            row: sequence.row,
            width: 640,
            height: 480,
            camera: crate::decode::CameraResponse {
                bit_depth: depth,
                black_level_dn: Some(black),
                saturation_dn: full_scale(depth) - 3,
                noise,
            },
            thresholds: Thresholds { lit_sigma: lit, soft_bit_sigma: soft, ..Thresholds::default() },
        };
        manifest.record_decode(&settings);
        let read = Manifest::parse(&manifest.to_json().unwrap()).unwrap().manifest;
        read.check(Upload, None).unwrap();
        let again = read.decode_settings(&read.resolve_sequence(None, None).unwrap(), (640, 480), 16);
        prop_assert_eq!(again, settings);
    }

    #[test]
    fn any_text_gives_an_answer(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        prop_assert!(Manifest::parse(&bytes).is_err());
    }

    #[test]
    fn a_damaged_manifest_gives_an_answer(at in 0usize..700, value in any::<u8>(), cut in 0usize..1000) {
        let mut bytes = EXAMPLE.as_bytes().to_vec();
        let at = at % bytes.len();
        bytes[at] = value;
        bytes.truncate(cut);
        if let Ok(parsed) = Manifest::parse(&bytes) {
            let _ = parsed.manifest.check(Upload, None);
            let _ = parsed.manifest.resolve_sequence(None, None);
        }
    }
}
