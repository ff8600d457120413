//! Damaged and lying input: one clear message, the documented exit code, nothing changed, nothing left behind.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::{Value, json};

use crate::rig::{Rig, json as read_json, polscan, run, text};

/// A small foreign capture: the patterns of mode gray as images, their manifest, and a calibration by which what they
/// show is a plane at 1000 mm.
struct Foreign {
    folder: tempfile::TempDir,
}

const CALIBRATION: &str = r#"
schema = "polscan.calibration/1"
[camera]
size = [64, 48]
matrix = [[80.0, 0.0, 31.5], [0.0, 80.0, 23.5], [0.0, 0.0, 1.0]]
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[projector]
size = [64, 48]
matrix = [[80.0, 0.0, 39.5], [0.0, 80.0, 23.5], [0.0, 0.0, 1.0]]
distortion = [0.0, 0.0, 0.0, 0.0, 0.0]
[transform]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
translation_mm = [-100.0, 0.0, 0.0]
"#;

impl Foreign {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let this = Self { folder };
        polscan(&["patterns", "--mode", "gray", "--size", "64x48", "--out", text(&this.bundle())]).expect(0);
        fs::write(this.bundle().join("calibration.toml"), CALIBRATION).expect("the calibration");
        this.manifest(|manifest| {
            manifest.retain(|key, _| !["files", "id", "created", "software"].contains(&key.as_str()));
            manifest.insert("calibration".into(), "calibration.toml".into());
        });
        this
    }

    fn bundle(&self) -> PathBuf {
        self.folder.path().join("bundle")
    }

    /// Path of image `number`.
    fn image(&self, number: usize) -> PathBuf {
        let manifest = read_json(&self.bundle().join("manifest.json"));
        self.bundle().join(manifest["frames"][number].as_str().expect("a path"))
    }

    fn manifest(&self, change: impl FnOnce(&mut serde_json::Map<String, Value>)) {
        let path = self.bundle().join("manifest.json");
        let mut manifest = read_json(&path);
        change(manifest.as_object_mut().expect("an object"));
        fs::write(&path, manifest.to_string()).expect("the manifest");
    }

    fn calibration(&self, from: &str, to: &str) {
        assert!(CALIBRATION.contains(from), "{from}");
        fs::write(self.bundle().join("calibration.toml"), CALIBRATION.replacen(from, to, 1))
            .expect("the calibration");
    }

    /// Decodes, expects `code` with all `words` on stderr, and that nothing was changed or left behind.
    fn refuses(&self, what: &str, code: i32, words: &[&str]) {
        let before = contents(self.folder.path());
        let out = self.folder.path().join("out");
        let run = polscan(&["decode", text(&self.bundle()), "--out", text(&out)]).expect(code);
        for word in words {
            assert!(run.stderr.contains(word), "{what}: no `{word}` in\n{}", run.stderr);
        }
        assert_eq!(run.stderr.trim_end().lines().count(), 1, "{what}: one message\n{}", run.stderr);
        assert!(contents(self.folder.path()) == before, "{what}: something was changed or left behind");
    }
}

/// Every file below a folder with its bytes; folders with `None`.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Option<Vec<u8>>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            found.extend(contents(&path));
            found.insert(path, None);
        } else {
            let bytes = fs::read(&path).expect("a file");
            found.insert(path, Some(bytes));
        }
    }
    found
}

#[test]
fn the_undamaged_capture_decodes() {
    let foreign = Foreign::new();
    let out = foreign.folder.path().join("out");
    polscan(&["decode", text(&foreign.bundle()), "--out", text(&out)]).expect(0);
    assert_eq!(read_json(&out.join("report.json"))["pixels"]["valid"], 64 * 48);
}

#[test]
fn damaged_images_are_named() {
    let foreign = Foreign::new();
    let path = foreign.image(3);
    let name = path.file_name().expect("a name").to_str().expect("text").to_owned();
    let whole = fs::read(&path).expect("an image");
    fs::write(&path, &whole[..whole.len() / 2]).expect("the image");
    foreign.refuses("truncated", 65, &[&name]);
    fs::write(&path, b"").expect("the image");
    foreign.refuses("empty", 65, &[&name]);
    fs::write(&path, b"P5 not really an image").expect("the image");
    foreign.refuses("no image", 65, &[&name]);
    image::GrayImage::new(63, 48).save(&path).expect("the image");
    foreign.refuses("of another size", 65, &[&name, "63 x 48", "64 x 48"]);
    fs::remove_file(&path).expect("the image");
    foreign.refuses("missing", 65, &[&name]);
    fs::create_dir(&path).expect("a folder");
    foreign.refuses("a folder", 65, &[&name]);
}

#[test]
fn coloured_images_are_read_by_their_green_channel_and_the_report_says_so() {
    let foreign = Foreign::new();
    let path = foreign.image(0);
    let mut picture = image::open(&path).expect("an image").into_rgb8();
    for pixel in picture.pixels_mut() {
        pixel.0 = [7, pixel.0[1], 99];
    }
    picture.save(&path).expect("the image");
    let out = foreign.folder.path().join("out");
    polscan(&["decode", text(&foreign.bundle()), "--out", text(&out)]).expect(0);
    let report = read_json(&out.join("report.json"));
    assert_eq!(report["pixels"]["valid"], 64 * 48);
    assert!(report["notes"].to_string().contains("green"), "{}", report["notes"]);
}

#[test]
fn manifests_that_lie_are_refused() {
    type Change = fn(&mut serde_json::Map<String, Value>);
    let cases: [(&str, Change, &[&str]); 14] = [
        ("a frame too few", |m| drop(m["frames"].as_array_mut().map(Vec::pop)), &["frames", "sequence"]),
        ("an entry too few", |m| drop(m["sequence"].as_array_mut().map(Vec::pop)), &["frames", "sequence"]),
        ("no frames", |m| drop(m.insert("frames".into(), json!([]))), &["frames"]),
        (
            "a size that is not",
            |m| drop(m.insert("camera".into(), json!({"width": 65, "height": 48}))),
            &["65"],
        ),
        ("17 bits", |m| drop(m.insert("camera".into(), json!({"bit_depth": 17}))), &["bit_depth"]),
        (
            "too few code bits",
            |m| drop(m.insert("code_bits".into(), json!({"column": 5, "row": 6}))),
            &["code_bits"],
        ),
        ("a bit beyond the code", |m| m["sequence"][4]["bit"] = json!(40), &["40"]),
        (
            "a negative size",
            |m| drop(m.insert("projector".into(), json!({"width": -64, "height": 48}))),
            &["projector"],
        ),
        ("a role twice", |m| m["sequence"][4] = m["sequence"][3].clone(), &["sequence"]),
        ("an unknown role", |m| m["sequence"][4] = json!({"role": "fringe"}), &["fringe"]),
        (
            "a newer schema",
            |m| drop(m.insert("schema".into(), json!("polscan.bundle/2"))),
            &["polscan.bundle/2", "polscan.bundle/1"],
        ),
        ("an unknown mode", |m| drop(m.insert("mode".into(), json!("fringe"))), &["fringe"]),
        ("frames that are none", |m| drop(m.insert("frames".into(), json!(7))), &["frames"]),
        (
            "a black level above white",
            |m| drop(m.insert("camera".into(), json!({"black_level": 300.0}))),
            &["black_level"],
        ),
    ];
    for (what, change, words) in cases {
        let foreign = Foreign::new();
        foreign.manifest(change);
        foreign.refuses(what, 65, words);
    }
    let foreign = Foreign::new();
    for text in ["", "{", "[]", "null", "{\"schema\": 1}"] {
        fs::write(foreign.bundle().join("manifest.json"), text).expect("the manifest");
        foreign.refuses(text, 65, &["manifest.json"]);
    }
}

#[test]
fn frames_that_cannot_be_decoded_without_an_axis_say_which() {
    let foreign = Foreign::new();
    foreign.manifest(|manifest| {
        let sequence = manifest["sequence"].as_array().expect("a list").clone();
        let frames = manifest["frames"].as_array().expect("a list").clone();
        let kept = sequence.into_iter().zip(frames).filter(|(role, _)| role["axis"] != "column");
        let (sequence, frames): (Vec<_>, Vec<_>) = kept.unzip();
        manifest.insert("sequence".into(), sequence.into());
        manifest.insert("frames".into(), frames.into());
    });
    foreign.refuses("no columns", 65, &["column"]);
}

#[test]
fn calibrations_that_cannot_be_right_are_refused() {
    let cases = [
        ("NaN", "80.0", "nan", "fx"),
        (
            "singular",
            "[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]\ntranslation",
            "[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]\ntranslation",
            "rotation",
        ),
        ("no focal length", "[[80.0,", "[[0.0,", "fx"),
        ("swapped sizes", "size = [64, 48]", "size = [48, 64]", "exchanged"),
        ("the wrong camera", "size = [64, 48]", "size = [640, 480]", "640"),
        ("metres", "-100.0", "-0.1", "metres"),
        ("a word for a number", "-100.0", "\"-100\"", "translation_mm"),
        ("an unknown key", "[transform]", "[transform]\nscale = 2", "scale"),
        ("a newer schema", "calibration/1", "calibration/2", "calibration/2"),
    ];
    for (what, from, to, word) in cases {
        let foreign = Foreign::new();
        foreign.calibration(from, to);
        foreign.refuses(what, 65, &["calibration", word]);
    }
    let foreign = Foreign::new();
    fs::remove_file(foreign.bundle().join("calibration.toml")).expect("the calibration");
    foreign.refuses("no calibration", 65, &["calibration.toml"]);
}

#[test]
fn an_array_that_is_not_what_it_says_is_refused() {
    let rig = Rig::small();
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let bundle = rig.path("scan");
    let path = bundle.join("frames.npy");
    let whole = fs::read(&path).expect("frames");
    // Without the hashes of its own files, as one that others made.
    let mut manifest = read_json(&bundle.join("manifest.json"));
    manifest.as_object_mut().expect("an object").remove("files");
    fs::write(bundle.join("manifest.json"), manifest.to_string()).expect("the manifest");
    let header = |from: &str, to: &str| {
        let mut bytes = whole.clone();
        let at = bytes.windows(from.len()).position(|part| part == from.as_bytes()).expect("in the header");
        bytes[at..at + from.len()].copy_from_slice(to.as_bytes());
        bytes
    };
    let cases = [
        ("cut", whole[..whole.len() - 1].to_vec()),
        ("longer", [&whole[..], b"x"].concat()),
        ("no array", b"frames".to_vec()),
        ("empty", Vec::new()),
        ("floating point", header("'<u2'", "'<f2'")),
        ("signed", header("'<u2'", "'<i2'")),
        ("fortran order", header("False, 'shape'", "True,  'shape'")),
        ("another shape", header("(20, 300, 400)", "(20, 400, 300)")),
    ];
    for (what, bytes) in cases {
        fs::write(&path, bytes).expect("frames");
        let run = rig.decode("scan", "out", &[]).expect(65);
        assert!(run.stderr.contains("frames.npy") || what == "another shape", "{what}: {}", run.stderr);
        assert!(!rig.path("out").exists(), "{what}");
    }
}

#[test]
fn a_full_disk_is_a_storage_failure_that_leaves_nothing() {
    let rig = Rig::small();
    rig.scan("scan", &["--mode", "fast"]).expect(0);
    let (bundle, small) = (rig.path("scan"), rig.path("small"));
    fs::create_dir(&small).expect("a folder");
    // A mount of its own that ends with the command; /proc/mounts of the test stays as it is.
    let script = r#"mount -t tmpfs -o size=2m tmpfs "$1" && shift && "$@"; code=$?; ls -A "$0"; exit $code"#;
    let program = env!("CARGO_BIN_EXE_polscan");
    let out = small.join("out");
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--mount", "sh", "-c", script, text(&small), text(&small)]);
    command.args([program, "decode", text(&bundle), "--out", text(&out)]);
    let run = run(&mut command).expect(74);
    assert!(run.stderr.contains("space"), "{}", run.stderr);
    assert_eq!(run.stdout.trim(), "", "something is left on the full disk");
    polscan(&["decode", text(&bundle), "--out", "/proc/out"]).expect(74);
}
