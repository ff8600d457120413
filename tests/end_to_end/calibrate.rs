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
    let content = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    content.parse().unwrap()
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
    assert!(refused.stderr.contains("a gain in dB of 0") && refused.stderr.contains("rig.noise"), "{}", refused.stderr);
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
