//! Real captures made by others, decoded by the program and compared with what other software made of them.
//!
//! `POLSCAN_CAPTURES` names the folder of captures (`tests/captures/README.md` says what it must hold). A test
//! here makes a bundle from a committed manifest and a link to the capture, runs `polscan decode` on it and reads
//! only what a user would read: the exit code, `report.json` and `maps.npz`.
//!
//! Codes are judged without a calibration: with one, a gate refuses pixels where row and column contradict it, and
//! towards the corners these calibrations are off by several projector pixels. Depth is judged with it, where it fits.

#[path = "captures/boards.rs"]
mod boards;

use std::{
    env, fs,
    io::Read as _,
    path::{Path, PathBuf},
    process::Command,
};

use image::{ImageBuffer, Luma};
use serde_json::Value;
use tempfile::TempDir;

/// Least share of the pixels with a reference value that must keep a value.
///
/// Not 1: the references were made with a fixed threshold of a few grey levels, and gates in units of noise rightly
/// refuse some pixels in deep shade that such a threshold lets through.
const KEPT: f64 = 0.97;

/// Least share of the pixels valid in both that must lie within one code of each other.
///
/// Not 0: a pixel on a stripe boundary has two right answers, so a difference of one is no error; anything beyond is.
const AGREE: f64 = 0.999;

/// Largest rms of the wall in mm. The reference's own integer codes give 0.76 mm and 0.78 mm on the two regions.
const WALL_RMS_MM: f64 = 1.2;

/// Largest error of the board's median depth, in units of the chessboard rig.
const DEPTH_ERROR: f64 = 2.0;

#[test]
fn procam_chess_0() {
    procam_chess(0, [440, 360, 300, 260], 3646.1);
}

#[test]
fn procam_chess_1() {
    procam_chess(1, [440, 360, 200, 200], 3324.9);
}

#[test]
fn procam_chess_2() {
    procam_chess(2, [440, 360, 300, 260], 3257.2);
}

#[test]
fn procam_chess_3() {
    procam_chess(3, [440, 360, 300, 260], 3535.4);
}

#[test]
fn procam_chess_4() {
    procam_chess(4, [440, 360, 300, 260], 3469.5);
}

/// The projector of this rig has a curved response, which shows as a pair sum that fails at the stripes only; the
/// decode stands, but the verdict must say so.
#[test]
fn steve_cam0() {
    let Some(capture) = Capture::open("steve-cam0", "steve-cam0") else { return };
    let decode = capture.decode("maps", &[]);
    decode.assert_agrees_with("steve-cam0/reference/cam000");
    decode.assert_nonlinear();

    // Two pieces of the wall, left and right of the figure, chosen by hand on the white frame.
    let calibration = capture.bundle().join("calibration.toml");
    let regions = ["--region", "wall-left=48,160,336,448", "--region", "wall-right=800,160,400,400"];
    let decode =
        capture.decode("cloud", &[&["--calibration", &path_text(&calibration)], &regions[..]].concat());
    decode.assert_nonlinear();
    let planes = decode.report["planes"].as_array().expect("report.planes is a list");
    for name in ["wall-left", "wall-right"] {
        let plane = planes.iter().find(|plane| plane["name"] == name);
        let rms_mm = plane.and_then(|plane| plane["rmse_mm"].as_f64());
        println!("captures: steve-cam0: {name}: plane rms {rms_mm:?} mm");
        assert!(rms_mm.is_some_and(|rms_mm| rms_mm < WALL_RMS_MM), "{name}: {plane:?}");
    }
    assert!(decode.out.join("cloud.ply").is_file(), "a calibrated decode writes a cloud");
}

/// Decodes one pose. `depth` is the median z of a window [x, y, width, height] on the board in units of its author,
/// triangulated from the reference's rows by a few lines of numpy with OpenCV's undistortion.
///
/// The baseline of this rig is vertical: depth comes from rows, and columns alone would say next to nothing.
fn procam_chess(number: u32, window: [usize; 4], depth: f64) {
    let Some(capture) = Capture::open(&format!("procam-chess-{number}"), "procam-chess") else { return };
    let prefix = format!("procam-chess/reference/capture_{number}");
    let decode = capture.decode("maps", &[]);
    decode.assert_agrees_with(&prefix);
    assert_eq!(decode.report["verdict"], "ok", "reasons: {}", decode.report["reasons"]);

    // Only the board is judged here: the calibration was made from the board, and its distortion runs away outside.
    let calibration = capture.captures.join("procam-chess/reference/calibration_result_opencv4.11.xml");
    let decode = capture.decode("cloud", &["--calibration", &path_text(&calibration)]);
    let reference = capture.reference(&format!("{prefix}_row_u16.png"));
    let map = Npy::read(&decode.out.join("maps.npz"), "depth");
    let values = map.floats();
    let [left, top, width, height] = window;
    let pixels = (top..top + height).flat_map(|y| (left..left + width).map(move |x| (x, y)));
    let on_board: Vec<f32> = pixels
        .filter(|&(x, y)| reference.get_pixel(x as u32, y as u32).0[0] != u16::MAX)
        .map(|(x, y)| values[y * map.shape[1] + x])
        .collect();
    let mut known: Vec<f32> = on_board.iter().copied().filter(|z| z.is_finite()).collect();
    let share = known.len() as f64 / on_board.len() as f64;
    assert!(share >= KEPT, "{}: {share:.4} of the board has a depth", capture.name);
    known.sort_by(f32::total_cmp);
    let median = f64::from(known[known.len() / 2]);
    println!(
        "captures: {}: board at {median:.1}, reference {depth:.1}, {:.2} % of it with depth",
        capture.name,
        100.0 * share
    );
    // One row is 10 units of depth here, so the bound is a fifth of a row: rows off by half a pixel would fail.
    assert!((median - depth).abs() < DEPTH_ERROR, "{}: {median} is not {depth}", capture.name);
}

fn path_text(path: &Path) -> String {
    path.to_str().expect("a path of plain text").to_owned()
}

/// Folder of all captures.
fn captures() -> Option<PathBuf> {
    let captures = env::var_os("POLSCAN_CAPTURES").map(PathBuf::from);
    if captures.is_none() {
        println!("captures: did not run: POLSCAN_CAPTURES is not set");
    }
    captures
}

/// A capture made into a bundle.
struct Capture {
    name: String,
    /// Folder of all captures.
    captures: PathBuf,
    /// Holds the bundle and what is decoded from it.
    folder: TempDir,
}

impl Capture {
    /// Makes `tests/captures/NAME` and `POLSCAN_CAPTURES/DATA` into a bundle. `None` without captures.
    fn open(name: &str, data: &str) -> Option<Self> {
        let captures = captures()?;
        assert!(captures.join(data).is_dir(), "POLSCAN_CAPTURES={} has no {data}", captures.display());
        let folder = tempfile::tempdir().expect("a folder for the bundle");
        let capture = Self { name: name.into(), captures, folder };
        make_bundle(name, &capture.captures.join(data), data, &capture.bundle());
        Some(capture)
    }

    fn bundle(&self) -> PathBuf {
        self.folder.path().join("bundle")
    }

    /// Runs `polscan decode` into a folder of its own.
    fn decode(&self, out: &str, arguments: &[&str]) -> Decode<'_> {
        let manifest = || fs::read(self.bundle().join("manifest.json")).expect("the manifest of the bundle");
        let before = manifest();
        let out = self.folder.path().join(out);
        let run = Command::new(env!("CARGO_BIN_EXE_polscan"))
            .arg("decode")
            .arg(self.bundle())
            .args(arguments)
            .arg("--out")
            .arg(&out)
            .output()
            .expect("polscan starts");
        assert!(
            run.status.success(),
            "{}: polscan decode ended with {}\n{}",
            self.name,
            run.status,
            String::from_utf8_lossy(&run.stderr)
        );
        assert_eq!(before, manifest(), "{}: the bundle that was decoded has changed", self.name);

        let report = fs::read(out.join("report.json")).expect("report.json");
        let report = serde_json::from_slice(&report).expect("report.json is JSON");
        let decode = Decode { capture: self, out, report };
        println!(
            "captures: {}: decode {arguments:?}: verdict {}, reasons {:?}",
            self.name,
            decode.report["verdict"],
            decode.reasons()
        );
        decode
    }

    /// A map of integer codes among the captures, 65535 = none.
    fn reference(&self, path: &str) -> ImageBuffer<Luma<u16>, Vec<u16>> {
        let path = self.captures.join(path);
        image::open(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).into_luma16()
    }
}

/// What one run of `polscan decode` wrote.
struct Decode<'a> {
    capture: &'a Capture,
    out: PathBuf,
    report: Value,
}

impl Decode<'_> {
    fn reasons(&self) -> Vec<&str> {
        let reasons = self.report["reasons"].as_array().expect("report.reasons is a list");
        reasons.iter().map(|reason| reason["type"].as_str().expect("a reason has a type")).collect()
    }

    fn assert_nonlinear(&self) {
        assert_eq!(self.report["verdict"], "degraded", "reasons: {}", self.report["reasons"]);
        assert!(self.reasons().contains(&"nonlinear-response"), "reasons: {}", self.report["reasons"]);
    }

    /// Compares column and row with `PREFIX_col_u16.png` and `PREFIX_row_u16.png` among the captures.
    fn assert_agrees_with(&self, prefix: &str) {
        let name = &self.capture.name;
        let mask = Npy::read(&self.out.join("maps.npz"), "mask");
        for (map, suffix) in [("column", "col"), ("row", "row")] {
            let reference = self.capture.reference(&format!("{prefix}_{suffix}_u16.png"));
            let decoded = Npy::read(&self.out.join("maps.npz"), map);
            let (width, height) = reference.dimensions();
            assert_eq!(decoded.shape, [height as usize, width as usize], "{}: shape of {map}", name);
            assert_eq!(mask.shape, decoded.shape, "{}: shape of mask", name);

            let agreement = Agreement::of(&decoded.floats(), mask.bools(), reference.as_raw());
            println!(
                "captures: {}: {map}: kept {:.2} % of {}, {:.4} % of them within one code, {:.1} % more pixels than the reference",
                name,
                100.0 * agreement.kept(),
                agreement.reference,
                100.0 * agreement.agree(),
                100.0 * agreement.more(),
            );
            assert!(agreement.kept() >= KEPT, "{}: {map}: {agreement:?}", name);
            assert!(agreement.agree() >= AGREE, "{}: {map}: {agreement:?}", name);
        }
    }
}

/// A bundle as a user would make it: a manifest, a calibration where it is ours, and a link to the pictures.
fn make_bundle(name: &str, capture: &Path, link: &str, bundle: &Path) {
    let template = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/captures").join(name);
    fs::create_dir(bundle).expect("a fresh bundle folder");
    for entry in fs::read_dir(&template).unwrap_or_else(|e| panic!("{}: {e}", template.display())) {
        let path = entry.expect("an entry of the template").path();
        let file = path.file_name().expect("an entry has a name");
        fs::copy(&path, bundle.join(file)).expect("a copy of the template");
    }
    std::os::unix::fs::symlink(capture, bundle.join(link)).expect("a link to the capture");
}

/// Counts of pixels.
#[derive(Debug, Default)]
struct Agreement {
    /// With a value in the reference.
    reference: u64,
    /// With a value in ours.
    ours: u64,
    /// With a value in both.
    both: u64,
    /// With a value in both, within one code.
    within_one: u64,
}

impl Agreement {
    fn of(values: &[f32], mask: &[u8], reference: &[u16]) -> Self {
        let mut counts = Self::default();
        for ((&value, &valid), &expected) in values.iter().zip(mask).zip(reference) {
            let (ours, theirs) = (valid != 0, expected != u16::MAX);
            counts.ours += u64::from(ours);
            counts.reference += u64::from(theirs);
            counts.both += u64::from(ours && theirs);
            // The reference is an integer and ours is not: within one code after rounding is under 1.5. NaN is not.
            counts.within_one += u64::from(ours && theirs && (value - f32::from(expected)).abs() < 1.5);
        }
        counts
    }

    fn kept(&self) -> f64 {
        self.both as f64 / self.reference as f64
    }

    fn agree(&self) -> f64 {
        self.within_one as f64 / self.both as f64
    }

    fn more(&self) -> f64 {
        self.ours as f64 / self.reference as f64 - 1.0
    }
}

/// One array of an `.npz`: a zip of `.npy` files (numpy's format 1.0, C order).
struct Npy {
    descr: String,
    shape: Vec<usize>,
    data: Vec<u8>,
}

impl Npy {
    fn read(npz: &Path, name: &str) -> Self {
        let file = fs::File::open(npz).unwrap_or_else(|e| panic!("{}: {e}", npz.display()));
        let mut archive = zip::ZipArchive::new(file).expect("maps.npz is a zip");
        let mut bytes = Vec::new();
        let mut entry = archive.by_name(&format!("{name}.npy")).unwrap_or_else(|e| panic!("{name}: {e}"));
        entry.read_to_end(&mut bytes).expect("an entry that is stored, not compressed");
        Self::parse(&bytes).unwrap_or_else(|| panic!("{name}.npy has no header of numpy's format 1.0"))
    }

    /// Magic, version 1.0, length of the header as two bytes, a Python dictionary, data.
    fn parse(bytes: &[u8]) -> Option<Self> {
        let rest = bytes.strip_prefix(b"\x93NUMPY\x01\x00")?;
        let (length, rest) = rest.split_first_chunk::<2>()?;
        let (header, data) = rest.split_at_checked(usize::from(u16::from_le_bytes(*length)))?;
        let header = std::str::from_utf8(header).ok()?;
        header.contains("'fortran_order': False").then_some(())?;
        let value = |key: &str, open: char, close: char| {
            let (_, rest) = header.split_once(&format!("'{key}': {open}"))?;
            rest.split_once(close).map(|(value, _)| value)
        };
        let shape = value("shape", '(', ')')?.split(',').map(str::trim).filter(|side| !side.is_empty());
        Some(Self {
            descr: value("descr", '\'', '\'')?.to_owned(),
            shape: shape.map(|side| side.parse().ok()).collect::<Option<_>>()?,
            data: data.to_vec(),
        })
    }

    fn floats(&self) -> Vec<f32> {
        assert_eq!(self.descr, "<f4", "an array of float32");
        let (values, []) = self.data.as_chunks::<4>() else { panic!("float32 data in whole values") };
        values.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect()
    }

    fn bools(&self) -> &[u8] {
        assert_eq!(self.descr, "|b1", "an array of bool");
        &self.data
    }
}
