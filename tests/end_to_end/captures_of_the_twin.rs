//! Scans of the simulated rig against its own truth.

use crate::rig::{Rig, json, reasons};

/// Largest rms of the column error in projector px over all pixels off silhouettes. The full-size rig reaches 0.016;
/// a quarter of the size has the same pixels per stripe, so the same bound holds with room for few pixels.
const COLUMN_RMS_PX: f64 = 0.05;

fn check_against_truth(rig: &Rig, out: &str) {
    let report = rig.report(out);
    assert_eq!(report["verdict"], "ok", "{}", report["reasons"]);
    assert!(reasons(&report).is_empty());
    let truth = &report["truth"];
    let number = |key: &str| truth[key].as_f64().unwrap_or_else(|| panic!("truth.{key}: {truth}"));
    assert!(number("coverage") > 0.99, "{truth}");
    assert_eq!(number("wrong_code_rate"), 0.0, "{truth}");
    assert!(number("column_rms_px") < COLUMN_RMS_PX, "{truth}");
    let honesty = number("sigma_z_ratio");
    assert!((0.8..1.25).contains(&honesty), "{truth}");
    let residual = report["capture"]["pair_residual_sigma"]["median"].as_f64().expect("pairs were judged");
    assert!((residual - 1.0).abs() < 0.05, "the pair sum is {residual} times its noise");
}

#[test]
fn every_mode_reads_both_plates_and_decodes_its_own_bundle_to_the_same_bytes() {
    let rig = Rig::small();
    for (mode, frames) in [("pse", 36), ("fast", 20), ("gray", 36), ("paper", 33)] {
        rig.scan(mode, &["--mode", mode]).expect(0);
        assert_eq!(rig.report(mode)["frames"], frames);
        check_against_truth(&rig, mode);
        let again = format!("{mode}-decoded");
        rig.decode(mode, &again, &[]).expect(0);
        for name in ["maps.npz", "cloud.ply", "calibration.toml", "truth.npz"] {
            assert!(rig.bytes(mode, name) == rig.bytes(&again, name), "{mode}: {name} differs");
        }
    }
}

#[test]
fn depth_and_precision_of_samples_do_not_change_the_result() {
    for format in ["mono8", "mono10", "mono16"] {
        let bits: i64 = if format == "mono16" { 16 } else { 12 };
        let rig = Rig::small().set("camera.format", format).set("sim.camera.bits", bits);
        rig.scan("scan", &[]).expect(0);
        let report = rig.report("scan");
        assert_eq!(report["verdict"], "ok", "{format}: {}", report["reasons"]);
        assert_eq!(report["truth"]["wrong_code_rate"], 0.0, "{format}: {}", report["truth"]);
    }
}

#[test]
fn a_scan_repeats_bit_by_bit_and_in_real_time() {
    let rig = Rig::small();
    rig.scan("first", &["--mode", "fast"]).expect(0);
    rig.scan("second", &["--mode", "fast"]).expect(0);
    assert!(rig.bytes("first", "frames.npy") == rig.bytes("second", "frames.npy"));
    // A busy machine may hold up some frames of a scan in real time; those that were on time are the same bit by bit.
    let slow = Rig::small().set("sim.pacing", "real-time");
    let compared = (0..6).map(|attempt| format!("slow-{attempt}")).find_map(|out| {
        slow.scan(&out, &["--mode", "fast"]);
        let on_time = same_exposures(&rig, "first", &slow, &out);
        (on_time > 0).then_some(on_time)
    });
    assert!(compared.is_some(), "no frame of six scans was on time");
}

/// On a virtual clock nothing is late, so that the pace is exact: not one refresh is idle.
#[test]
fn a_scan_takes_its_holds_and_the_last_frame_s_own_way_and_no_more() {
    let rig = Rig::small();
    rig.scan("scan", &[]).expect(0);
    let report = rig.report("scan");
    let capture = &report["capture"];
    let number = |key: &str| capture[key].as_f64().unwrap_or_else(|| panic!("{key}: {capture}"));
    let synchrony = &capture["synchrony"];
    assert_eq!(synchrony["order"], "overlapped", "{synchrony}");
    assert_eq!(synchrony["idle_refreshes"], 0, "{synchrony}");
    assert!(synchrony["phase_error_us"]["worst"].as_f64().expect("a phase error") < 0.01, "{synchrony}");
    let frames = report["frames"].as_f64().expect("frames");
    let hold_s = number("hold_frames") * 1e-3 * synchrony["refresh_period_ms"].as_f64().expect("a period");
    // Exposure 2 ms, readout 6.1 ms.
    let own_s = 1e-3 * (synchrony["trigger_delay_ms"].as_f64().expect("a delay") + 2.0 + 6.1);
    let expected_s = (frames - 1.0) * hold_s + own_s;
    assert!((number("seconds") - expected_s).abs() < 1e-6, "{} s, not {expected_s} s", number("seconds"));
    let manifest = json(&rig.path("scan").join("manifest.json"));
    for frame in manifest["capture"]["frames"].as_array().expect("evidence") {
        assert!(frame["phase_error_us"].as_f64().expect("of each frame").abs() < 0.01, "{frame}");
    }
}

/// How near a scan in real time comes to that depends on what else the machine does: printed, and held loosely.
#[test]
fn a_scan_in_real_time_keeps_the_pace_as_far_as_the_machine_does() {
    let rig = Rig::small().set("sim.pacing", "real-time");
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let capture = &rig.report("scan")["capture"];
    let number = |key: &str| capture[key].as_f64().unwrap_or_else(|| panic!("{key}: {capture}"));
    let ratio = number("seconds") / number("limit_seconds");
    let manifest = json(&rig.path("scan").join("manifest.json"));
    let rehearsed = &manifest["capture"]["statistics"]["counters"]["rehearsed_frames"];
    println!(
        "capture.seconds / capture.limit_seconds: {ratio:.3}, {rehearsed} frames rendered in advance, {}",
        capture["synchrony"]
    );
    assert!(rehearsed.as_u64().is_some_and(|frames| frames > 0), "no frame was rendered in advance");
    assert!((0.9..10.0).contains(&ratio), "{ratio} times the display's own pace");
}

/// Compares the frames that both scans exposed as the same exposure at the same time after its flip; returns how many.
fn same_exposures(rig: &Rig, out: &str, other: &Rig, other_out: &str) -> usize {
    let (ours, theirs) = (exposures(rig, out), exposures(other, other_out));
    let on_time = ours.iter().zip(&theirs).filter(|(a, b)| a.0 == b.0);
    on_time.inspect(|(a, b)| assert!(a.1 == b.1, "exposure {:?} differs", a.0)).count()
}

/// Of each frame: number of the exposure, time from its flip to it in ns, and its samples.
fn exposures(rig: &Rig, out: &str) -> Vec<([u64; 2], Vec<u8>)> {
    let manifest = json(&rig.path(out).join("manifest.json"));
    let frames = manifest["capture"]["frames"].as_array().expect("evidence").clone();
    let bytes = rig.bytes(out, "frames.npy");
    let size = 2 * 400 * 300;
    let samples = &bytes[bytes.len() - size * frames.len()..];
    let time = |value: &serde_json::Value| value.as_u64().expect("a time in ns");
    let key = |frame: &serde_json::Value| {
        let delay = time(&frame["stamp"]["exposure_start_ns"]) - time(&frame["receipt"]["flipped_ns"]);
        [time(&frame["stamp"]["frame_id"]), delay]
    };
    frames
        .iter()
        .zip(samples.chunks_exact(size))
        .map(|(frame, samples)| (key(frame), samples.to_vec()))
        .collect()
}

#[test]
fn the_manifest_holds_the_evidence_of_every_frame() {
    let rig = Rig::small();
    let run = rig.scan("scan", &["--mode", "fast", "--json", "--region", "plate=200,20,100,60"]).expect(0);
    let printed: serde_json::Value = serde_json::from_str(&run.stdout).expect("one object on stdout");
    assert_eq!(printed["report"], rig.report("scan"));
    let manifest = json(&rig.path("scan").join("manifest.json"));
    assert_eq!(manifest["schema"], "polscan.bundle/1");
    let frames = manifest["capture"]["frames"].as_array().expect("evidence");
    assert_eq!(frames.len(), 20);
    for (index, frame) in frames.iter().enumerate() {
        assert_eq!(frame["stamp"]["trigger"], index, "{frame}");
        assert_eq!(frame["receipt"]["method"], "simulated");
    }
    let planes = rig.report("scan")["planes"].clone();
    let names: Vec<_> =
        planes.as_array().expect("planes").iter().map(|plane| plane["name"].clone()).collect();
    assert!(names.contains(&"plate".into()), "{names:?}");
    // A later decode measures the same region without being told.
    rig.decode("scan", "again", &[]).expect(0);
    assert_eq!(rig.report("again")["planes"], planes);
}

#[test]
fn a_calibration_of_the_whole_sensor_serves_a_region_of_it() {
    let region = [("x", 120), ("y", 40), ("width", 200), ("height", 160)];
    let region: toml::Table =
        region.map(|(key, value)| (key.to_string(), toml::Value::from(value))).into_iter().collect();
    let rig = Rig::small().set("camera.region", region);
    rig.scan("scan", &[]).expect(0);
    check_against_truth(&rig, "scan");
    let report = rig.report("scan");
    assert_eq!(report["size"], serde_json::json!({ "width": 200, "height": 160 }));
    let rmse = report["truth"]["depth_rmse_mm"].as_f64().expect("depth is compared with the truth");
    // A crop off by one camera pixel would be off by 16 mm.
    assert!(rmse < 2.0, "{}", report["truth"]);
    let whole = rig.path("sim-calibration.toml");
    rig.decode("scan", "again", &[]).expect(0);
    rig.decode("scan", "whole", &["--calibration", crate::rig::text(&whole)]).expect(0);
    for again in ["again", "whole"] {
        assert!(rig.bytes("scan", "cloud.ply") == rig.bytes(again, "cloud.ply"), "{again}");
    }
}

#[test]
fn rows_that_are_not_coded_are_predicted_by_the_calibration() {
    let rig = Rig::small();
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let (width, map) = rig.map("scan", "maps.npz", "row");
    let (_, truth) = rig.map("scan", "truth.npz", "row");
    let (_, depth) = rig.map("scan", "maps.npz", "depth");
    assert_eq!(width, 400);
    let mut off: Vec<f32> = map.iter().zip(&truth).map(|(row, truth)| (row - truth).abs()).collect();
    assert!(map.iter().zip(&depth).all(|(row, depth)| row.is_nan() == depth.is_nan()));
    off.retain(|error| error.is_finite());
    off.sort_by(f32::total_cmp);
    assert!(off.len() > 100_000 && off[off.len() * 99 / 100] < 0.05, "{:?}", off[off.len() * 99 / 100]);
}

#[test]
fn a_replay_of_a_scan_gives_its_maps_and_of_a_part_of_it_the_maps_of_that_part() {
    let rig = Rig::small();
    rig.scan("scan", &[]).expect(0);
    rig.decode("scan", "columns", &["--mode", "fast"]).expect(0);
    let replay = Rig::small().set("camera.driver", "replay").set("projector.driver", "replay");
    let bundle = rig.path("scan");
    let replay = replay.set("replay.bundle", crate::rig::text(&bundle));
    replay.scan("again", &[]).expect(0);
    replay.scan("part", &["--mode", "fast"]).expect(0);
    for (ours, theirs) in [("scan", "again"), ("columns", "part")] {
        for name in ["maps.npz", "cloud.ply", "truth.npz"] {
            assert!(rig.bytes(ours, name) == replay.bytes(theirs, name), "{theirs}: {name} differs");
        }
    }
    assert_eq!(replay.report("again")["truth"], rig.report("scan")["truth"]);
    assert_eq!(replay.report("again")["simulated"], true);
    // What was not recorded is no replay.
    let run = replay.scan("other", &["--mode", "gray"]).expect(1);
    assert!(run.stdout.contains("was not recorded"), "{}", run.stdout);
    let run = replay.scan("longer", &["--exposure-us", "2500"]).expect(69);
    assert!(run.stderr.contains("exposure_us"), "{}", run.stderr);
}

#[test]
fn without_a_calibration_there_are_columns_but_no_cloud() {
    let rig = Rig::small().set("rig.calibration", "");
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    assert!(!rig.path("scan").join("cloud.ply").exists());
    let report = rig.report("scan");
    assert_eq!(report["verdict"], "ok");
    assert!(report["points"].is_null());
    assert_eq!(report["truth"]["wrong_code_rate"], 0.0);
    // The calibration may come later.
    let calibration = rig.path("sim-calibration.toml");
    rig.decode("scan", "later", &["--calibration", crate::rig::text(&calibration)]).expect(0);
    assert!(rig.report("later")["points"].as_u64().expect("points") > 100_000);
}
