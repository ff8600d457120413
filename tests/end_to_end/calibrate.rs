//! `polscan calibrate` on the twin: what is measured is what the rig was described with.

use toml::Table;

use crate::rig::{Rig, json, polscan, text};

/// A number of a file that a calibration wrote.
fn number(file: &Table, path: &str) -> f64 {
    let (tables, name) = path.rsplit_once('.').unwrap_or(("", path));
    let table = tables.split('.').filter(|part| !part.is_empty()).fold(file, |table, part| {
        table[part].as_table().unwrap_or_else(|| panic!("{path}: no table {part}"))
    });
    let value = table.get(name).unwrap_or_else(|| panic!("{path} is missing"));
    value.as_float().or(value.as_integer().map(|value| value as f64)).unwrap_or_else(|| panic!("{path}"))
}

/// A TOML file in the rig's folder.
fn table(rig: &Rig, name: &str) -> Table {
    let path = rig.path(name);
    let content =
        std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    content.parse().expect("a calibration is TOML")
}

/// Runs `polscan calibrate WHAT` into the folder `out`.
fn calibrate(rig: &Rig, what: &str, out: &str, arguments: &[&str]) -> crate::rig::Run {
    let (config, out) = (rig.config(), rig.path(out));
    polscan(&[&["calibrate", what, "--config", text(&config), "--out", text(&out)], arguments].concat())
}

#[test]
fn noise_of_the_camera_is_found_at_every_bit_depth_and_used_by_scans() {
    let mut rig = Rig::scaled(8.0).set("sim.camera.prnu_share", 0.01);
    for (seed, bits) in [(1, 12), (2, 10), (3, 8), (4, 8), (5, 12)] {
        rig = rig.set("sim.seed", seed).set("camera.format", format!("mono{bits}"));
        let out = format!("noise-{seed}");
        calibrate(&rig, "noise", &out, &[]).expect(0);
        let file = table(&rig, &format!("{out}/noise.toml"));
        let full_dn = f64::from((1 << bits) - 1);
        let (black, gain) = (0.01 * full_dn, 0.99 * full_dn / 10_500.0);
        let context = format!("seed {seed}, {bits} bits: {file}");
        assert!((number(&file, "noise.gain_dn_per_electron") / gain - 1.0).abs() < 0.02, "{context}");
        assert!((number(&file, "noise.black_level_dn") - black).abs() < 0.2, "{context}");
        assert!((number(&file, "noise.exponent") - 1.0).abs() < 0.01, "{context}");
        assert!((number(&file, "noise.full_well_e") / 10_500.0 - 1.0).abs() < 0.03, "{context}");
        let read_error = (number(&file, "noise.read_noise_dn") - 2.3 * gain).abs();
        assert!(read_error < 4.0 * number(&file, "noise.read_noise_sigma_dn").max(0.002), "{context}");
    }
    // A scan takes it, and refuses it with another gain.
    rig = rig.set("rig.noise", "noise-5/noise.toml");
    rig.scan("scan", &[]).expect(0);
    let manifest = json(&rig.path("scan/manifest.json"));
    let measured = number(&table(&rig, "noise-5/noise.toml"), "noise.gain_dn_per_electron");
    assert_eq!(manifest["camera"]["gain_dn_per_electron"].as_f64(), Some(measured), "{manifest}");
    let refused = rig.set("camera.gain_db", 6.0).scan("other", &[]).expect(64);
    assert!(
        refused.stderr.contains("a gain in dB of 0") && refused.stderr.contains("rig.noise"),
        "{}",
        refused.stderr
    );
}

#[test]
fn a_camera_with_a_hidden_gamma_gets_no_noise_file() {
    let rig = Rig::scaled(8.0).fault("kind = \"hidden-gamma\", exponent = 0.9");
    let run = calibrate(&rig, "noise", "noise", &["--json"]).expect(1);
    let answer: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    let exponent = answer["report"]["linearity"]["exponent"].as_f64().unwrap();
    assert!((exponent - 0.9).abs() < 0.01, "{exponent}");
    assert!(answer["refused"].as_str().unwrap().contains("not linear"));
    assert!(!rig.path("noise/noise.toml").exists() && rig.path("noise/linearity.svg").exists());
}

#[test]
fn a_file_that_is_none_is_refused_with_its_key() {
    let rig = Rig::scaled(8.0).set("rig.noise", "sim-calibration.toml");
    let refused = rig.scan("scan", &[]).expect(64);
    assert!(refused.stderr.contains("rig.noise") && refused.stderr.contains("polscan calibrate noise"));
}

#[test]
fn timing_of_the_projector_is_found_and_used_where_the_driver_states_none() {
    let cases = [(0, 6.0), (2, 6.0), (3, 12.0)];
    let mut rig = Rig::scaled(8.0).set("sim.projector.states_timing", false);
    for (latency_refreshes, lcd_ms) in cases {
        rig = rig
            .set("sim.seed", 7 + latency_refreshes)
            .set("sim.projector.latency_refreshes", latency_refreshes)
            .set("sim.projector.lcd_10_90_ms", lcd_ms);
        let out = format!("sync-{latency_refreshes}");
        calibrate(&rig, "sync", &out, &[]).expect(0);
        let file = table(&rig, &format!("{out}/sync.toml"));
        let latency_ms = latency_refreshes as f64 * 1000.0 / 60.0;
        let settling_ms = lcd_ms / 9f64.ln() * 1000f64.ln();
        let context = format!("{latency_refreshes} refreshes, {lcd_ms} ms: {file}");
        assert_eq!(file["timing"]["latency_refreshes"].as_integer(), Some(latency_refreshes), "{context}");
        assert!((number(&file, "timing.latency_ms") - latency_ms).abs() <= 1.0, "{context}");
        assert!((number(&file, "timing.settling_ms") - settling_ms).abs() <= 1.0, "{context}");
        // The twin's panel switches as a whole.
        assert!(number(&file, "timing.scan_out_ms") <= 1.0, "{context}");
        for band in
            file["bands"].as_array().unwrap().iter().filter(|band| band["channel"].as_str() == Some("white"))
        {
            for change in ["rise", "fall"] {
                let t10_90 = band[change]["t10_90_ms"].as_float().unwrap();
                assert!((t10_90 - lcd_ms).abs() < 0.5, "{context}");
            }
        }
        assert!(file["ripple"].get("hz").is_none(), "{context}");
    }
    // A scan holds no longer than with the timing that the driver would state, and refuses another projector's.
    rig = rig.set("sim.projector.latency_refreshes", 2).set("sim.projector.lcd_10_90_ms", 6.0);
    rig.scan("unknown", &[]).expect(0);
    rig = rig.set("rig.sync", "sync-2/sync.toml");
    rig.scan("measured", &[]).expect(0);
    let hold = |out: &str| rig.report(out)["capture"]["hold_frames"].as_u64().unwrap();
    assert_eq!((hold("measured"), hold("unknown")), (4, 6));
    // The scan waits for what was measured, and is as much shorter.
    let capture = |out: &str| rig.report(out)["capture"].clone();
    let (measured, unknown) = (capture("measured"), capture("unknown"));
    assert_eq!((&measured["timing_measured"], &unknown["timing_measured"]), (&true.into(), &false.into()));
    let file = table(&rig, "sync-2/sync.toml");
    for (ours, theirs) in
        [("projector_latency_ms", "timing.latency_ms"), ("projector_settling_ms", "timing.settling_ms")]
    {
        let planned = measured["synchrony"][ours].as_f64().expect("a time");
        assert!((planned - number(&file, theirs)).abs() < 1e-3, "{ours}: {measured}");
    }
    let [short_s, long_s] = [&measured, &unknown].map(|capture| capture["seconds"].as_f64().expect("a time"));
    assert!(short_s < 0.7 * long_s, "{short_s} s of {long_s} s");
    assert_eq!(measured["synchrony"]["idle_refreshes"], 0);
    let refused = rig.set("sim.projector.refresh_hz", 50.0).scan("other", &[]).expect(64);
    assert!(refused.stderr.contains("60.00 Hz") && refused.stderr.contains("rig.sync"), "{}", refused.stderr);
}

#[test]
fn ripple_of_the_lamp_is_found() {
    let flicker: Table = toml::from_str("share = 0.02\nhz = 100.0").unwrap();
    let rig = Rig::scaled(8.0).set("sim.flicker", flicker);
    calibrate(&rig, "sync", "sync", &[]).expect(0);
    let file = table(&rig, "sync/sync.toml");
    assert!((number(&file, "ripple.hz") - 100.0).abs() < 0.2, "{file}");
    assert!((number(&file, "ripple.share") / 0.02 - 1.0).abs() < 0.1, "{file}");
    assert_eq!(file["timing"]["latency_refreshes"].as_integer(), Some(2), "{file}");
    assert!((number(&file, "timing.settling_ms") - 6.0 / 9f64.ln() * 1000f64.ln()).abs() < 4.0, "{file}");
}

#[test]
fn polarization_is_found_from_three_angles_and_guards_scans() {
    let (error_deg, shift) = (1.7, [[0.31, -0.22], [0.0, 0.0], [0.31, -0.22]]);
    let extinction = [30.0, 50.0, 70.0];
    let shifts: Vec<Vec<f64>> = shift.iter().map(|shift| shift.to_vec()).collect();
    let mut rig = Rig::coupon()
        .set("sim.projector.extinction", extinction.to_vec())
        .set("sim.projector.panel_shift_px", shifts)
        .set("rig.extinction_ratio", 0.0)
        .set("camera.exposure_us", 1600.0);
    let coupon = ["--coupon", "coupon=20,60,180,120"];
    for (out, angle) in [("a", 90.0), ("b", 45.0)] {
        rig = rig.set("sim.analyser.azimuth_error_deg", error_deg + angle);
        let angle = angle.to_string();
        calibrate(&rig, "polarization", out, &[&["--angle", angle.as_str()], &coupon[..]].concat()).expect(0);
        assert!(!rig.path(out).join("polarization.toml").exists());
    }
    rig = rig.set("sim.analyser.azimuth_error_deg", error_deg);
    let (a, b) = (rig.path("a"), rig.path("b"));
    let rest =
        ["--with", text(&a), "--with", text(&b), "--card", "card=240,90,40,60", "--watch", "--values", "3"];
    let run = calibrate(&rig, "polarization", "c", &[&coupon[..], &rest[..]].concat()).expect(0);
    assert_eq!(run.stderr.matches("H/V").count(), 3, "{}", run.stderr);
    let file = table(&rig, "c/polarization.toml");
    assert!((number(&file, "azimuth_error_deg") - error_deg).abs() < 0.2, "{file}");
    assert_eq!((file["horizontal"].as_str(), file["vertical"].as_str()), (Some("g"), Some("rb")));
    for (channel, of_panel) in file["channels"].as_array().unwrap().iter().zip(extinction) {
        // Light along and across the panel's state, each through the polarizer (500:1) along and across its axis.
        let expected = (of_panel * 500.0 + 1.0) / (of_panel + 500.0);
        let found = channel["extinction"].as_float().unwrap();
        assert!((found / expected - 1.0).abs() < 0.05, "{found} {expected}\n{file}");
    }
    // The field is flat: its constant is the shift.
    for (axis, expected) in [("x", 0.31), ("y", -0.22)] {
        let field = file["misregistration"][axis].as_array().unwrap();
        let at = |terms: &[f64]| -> f64 {
            field.iter().zip(terms).map(|(factor, term)| factor.as_float().unwrap() * term).sum()
        };
        for terms in [[1.0, 0.0, 0.0, 0.0, 0.0, 0.0], [1.0, 0.3, 0.3, 0.09, 0.09, 0.09]] {
            assert!((at(&terms) - expected).abs() < 0.05, "{axis}: {file}");
        }
    }
    // Paper returns both states as the sensor likes their colours: 0.8 of green for magenta.
    assert!((number(&file, "drive.ratio_at_full") / 1.25 - 1.0).abs() < 0.05, "{file}");
    let green = 255.0 * 0.8f64.powf(1.0 / 2.2);
    assert!((number(&file, "drive.horizontal") - green).abs() <= 3.0, "{file}");
    // Scans know the extinction from it, and refuse other channels.
    rig = rig.set("rig.polarization", "c/polarization.toml").set("camera.exposure_us", 1500.0);
    rig.scan("scan", &[]).expect(0);
    let manifest = json(&rig.path("scan/manifest.json"));
    let known = manifest["processing"]["extinction_ratio"].as_f64();
    assert_eq!(known, Some(number(&file, "extinction_ratio")), "{manifest}");
    let swapped = rig.set("projector.horizontal", "rb").set("projector.vertical", "g");
    let refused = swapped.scan("other", &[]).expect(64);
    assert!(refused.stderr.contains("rig.polarization"), "{}", refused.stderr);
}

#[test]
fn a_polarizer_that_is_far_off_and_surfaces_that_scatter_are_refused() {
    let mut rig = Rig::coupon().set("camera.exposure_us", 1000.0);
    for (out, angle) in [("a", 90.0), ("b", 45.0)] {
        rig = rig.set("sim.analyser.azimuth_error_deg", 8.0 + angle);
        calibrate(&rig, "polarization", out, &["--angle", &angle.to_string()]).expect(0);
    }
    rig = rig.set("sim.analyser.azimuth_error_deg", 8.0);
    let (a, b) = (rig.path("a"), rig.path("b"));
    let with = ["--with", text(&a), "--with", text(&b)];
    let run = calibrate(&rig, "polarization", "c", &with).expect(1);
    assert!(run.stdout.contains("clockwise") && !rig.path("c/polarization.toml").exists(), "{}", run.stdout);
    let card = ["--coupon", "card=240,90,40,60"];
    for (out, angle) in [("d", 90.0), ("e", 45.0)] {
        rig = rig.set("sim.analyser.azimuth_error_deg", angle);
        calibrate(&rig, "polarization", out, &[&["--angle", &angle.to_string()], &card[..]].concat())
            .expect(0);
    }
    rig = rig.set("sim.analyser.azimuth_error_deg", 0.0);
    let (d, e) = (rig.path("d"), rig.path("e"));
    let with = ["--with", text(&d), "--with", text(&e)];
    let run = calibrate(&rig, "polarization", "f", &[&with[..], &card[..]].concat()).expect(1);
    assert!(run.stdout.contains("scatters"), "{}", run.stdout);
}

#[test]
fn the_planner_forecasts_what_scans_of_the_twin_reach() {
    let rig = Rig::small();
    rig.scan("scan", &[]).expect(0);
    let (_, modulation) = rig.map("scan", "maps.npz", "modulation");
    let (_, depth_mm) = rig.map("scan", "truth.npz", "depth");
    let report = rig.report("scan");
    let gain = json(&rig.path("scan/manifest.json"))["camera"]["gain_dn_per_electron"].as_f64().unwrap();
    for plane in report["planes"].as_array().unwrap() {
        let black = plane["name"] == "black";
        // What the planner cannot know is how bright the surfaces are: that is taken from the scan. Noise is largest where
        // they are darkest, hence the quadratic mean of 1 / modulation.
        let squares: Vec<f64> = modulation
            .iter()
            .zip(&depth_mm)
            .filter(|(modulation, depth_mm)| (**depth_mm < 985.0) == black && **modulation > 0.0)
            .map(|(modulation, _)| (f64::from(*modulation) / gain).powi(-2))
            .collect();
        let modulation_e = (squares.iter().sum::<f64>() / squares.len() as f64).powf(-0.5);
        let share = modulation_e / (1.0 - 1.0 / 16.2) / 10_500.0;
        // The small rig has lenses of a quarter of the focal length on a quarter of the pixels.
        let run = polscan(&[
            "plan",
            "--json",
            "--focal-mm",
            "4.0003",
            "--sensor",
            "400x300",
            "--projector",
            "256x192",
            "--bright",
            &share.to_string(),
            "--extinction-ratio",
            "16.2",
        ])
        .expect(0);
        let forecast: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
        let expected = forecast["forecast"]["bright"]["column_rms_px"].as_f64().unwrap();
        let found = plane["truth"]["column_rms_px"].as_f64().unwrap();
        let depth = forecast["forecast"]["bright"]["sigma_z_mm"].as_f64().unwrap();
        let found_depth = plane["truth"]["depth_rmse_mm"].as_f64().unwrap();
        // Where noise reaches the height of the fringe, crossings are no longer linear in it, and the forecast is kind.
        let most = if black { 1.8 } else { 1.3 };
        let context = format!("{}: {found} {expected} px, {found_depth} {depth} mm", plane["name"]);
        assert!((0.7..most).contains(&(found / expected)), "{context}");
        assert!((0.7..most).contains(&(found_depth / depth)), "{context}");
    }
}

#[test]
fn the_planner_reads_its_own_designs_and_names_what_is_wrong() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("design.toml");
    std::fs::write(&path, "baseline_mm = 104.8\nmode = \"fast\"").unwrap();
    let run = polscan(&["plan", "--from", text(&path), "--json", "--distance-mm", "900"]).expect(0);
    let answer: serde_json::Value = serde_json::from_str(&run.stdout).unwrap();
    assert_eq!(answer["design"]["baseline_mm"].as_f64(), Some(104.8));
    assert_eq!(
        (answer["design"]["distance_mm"].as_f64(), answer["forecast"]["frames"].as_u64()),
        (Some(900.0), Some(24))
    );
    let plain = polscan(&["plan", "--focal-mm", "6"]).expect(0);
    assert!(plain.stdout.contains("sigma_z") && plain.stdout.contains("finest stripes"), "{}", plain.stdout);
    let refused = polscan(&["plan", "--baseline-mm", "0"]).expect(65);
    assert!(refused.stderr.contains("baseline_mm"), "{}", refused.stderr);
    std::fs::write(&path, "baseline = 1").unwrap();
    polscan(&["plan", "--from", text(&path)]).expect(65);
}
