//! Boards in real captures: found, solved, and compared with what OpenCV makes of them.

use std::{
    collections::HashMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use nalgebra::{Matrix3, Vector3};
use polscan::{
    calibration::boards::{Board, DetectSettings, Picture, detect},
    geometry::{Calibration, ReadHints},
};
use serde_json::Value;

use super::{Capture, Npy, path_text};

/// Largest distance of a focal length from the reference's, as a share of it.
const FOCAL: f64 = 0.005;
/// Largest rms over the reference's.
const RMS: f64 = 1.1;
/// Side of a square of the chessboard rig, in its author's unit.
const SQUARE: f64 = 75.0;

#[test]
fn opencv_stereo_left_is_calibrated() {
    // The reference beside the capture has 0.408 px and fx 536.07: its corners were refined in windows of 11 px half-width,
    // which reach into the next squares of this small board. The figures here are OpenCV 5.0's on windows of 5 px.
    camera("opencv-stereo", &stereo_board(), "left", [533.09, 533.22], 0.1957);
}

#[test]
fn opencv_stereo_right_is_calibrated() {
    // As on the left; the reference has 0.458 px and fx 542.34.
    camera("opencv-stereo", &stereo_board(), "right", [537.20, 536.74], 0.2077);
}

#[test]
fn charuco_left_is_calibrated() {
    let board = [
        &["--kind", "charuco", "--columns", "25", "--rows", "18", "--square-mm", "7.5"][..],
        &["--marker-mm", "5.6", "--marker-bits", "5", "--legacy"],
    ];
    camera("charuco-left", &board.concat(), "data/left/", [3744.70, 3744.70], 0.1984);
}

fn stereo_board() -> Vec<&'static str> {
    vec!["--kind", "checkerboard", "--columns", "10", "--rows", "7", "--square-mm", "25"]
}

/// Calibrates a camera from all pictures of a capture whose path begins so.
fn camera(data: &str, board: &[&str], begins: &str, focal: [f64; 2], rms: f64) {
    let Some(captures) = super::captures() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let board = make_board(folder.path(), board);
    let (within, begins) = begins.rsplit_once('/').unwrap_or(("", begins));
    let within = captures.join(data).join(within);
    let entries = fs::read_dir(&within).unwrap_or_else(|e| panic!("{}: {e}", within.display()));
    let mut pictures: Vec<PathBuf> = entries.map(|entry| entry.expect("an entry").path()).collect();
    pictures.retain(|path| {
        let name = path.file_name().and_then(|name| name.to_str()).expect("a name of plain text");
        name.starts_with(begins) && (name.ends_with(".jpg") || name.ends_with(".png"))
    });
    pictures.sort();
    assert!(pictures.len() >= 13, "{data}: {} pictures", pictures.len());
    let out = folder.path().join("out");
    let pictures: Vec<String> = pictures.iter().map(|path| path_text(path)).collect();
    let pictures: Vec<&str> = pictures.iter().map(String::as_str).collect();
    let (board, place) = (path_text(&board), path_text(&out));
    let run = polscan(
        &[&["calibrate", "camera", "--board", &board, "--out", &place, "--images"], &pictures[..]].concat(),
    );
    assert!(run.status.success(), "{data}: {}", text(&run));
    let lens = calibration(&out).camera;
    let report = report(&out);
    let found = report["solution"]["camera_rms_px"].as_f64().expect("an rms");
    println!(
        "captures: {data} {begins}: {} views, rms {found:.4} px (OpenCV {rms}), fx {:.2}, fy {:.2} (OpenCV {focal:?})",
        pictures.len(),
        lens.fx,
        lens.fy
    );
    assert_eq!(report["unusable"], serde_json::json!([]), "{data}: a view is not used");
    assert!(found <= RMS * rms, "{data}: rms {found} px");
    for (ours, theirs) in [lens.fx, lens.fy].into_iter().zip(focal) {
        assert!((ours / theirs - 1.0).abs() <= FOCAL, "{data}: focal length {ours}, OpenCV {theirs}");
    }
}

/// Five poses do not make a calibration that can be trusted, and the program says which one is missing. Solved all the
/// same, it is no worse than the reference.
#[test]
fn procam_chess_is_refused_with_the_reason_and_solved_on_demand() {
    let Some(captures) = super::captures() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let checkerboard = ["--kind", "checkerboard", "--columns", "10", "--rows", "8", "--square-mm", "75"];
    let board = make_board(folder.path(), &checkerboard);
    let poses: Vec<Capture> = (0..5)
        .map(|pose| Capture::open(&format!("procam-chess-{pose}"), "procam-chess").expect("captures"))
        .collect();
    // Named as the poses are: a view is called as its folder.
    let views: Vec<PathBuf> = poses
        .iter()
        .map(|pose| {
            let view = folder.path().join(&pose.name);
            std::os::unix::fs::symlink(pose.bundle(), &view).expect("a link");
            view
        })
        .collect();
    let views: Vec<String> = views.iter().map(|view| path_text(view)).collect();
    let solve = |out: &Path, more: &[&str]| {
        let (board, out) = (path_text(&board), path_text(out));
        let mut arguments = vec!["calibrate", "rig", "--board", &board, "--out", &out];
        arguments.extend(more);
        arguments.push("--views");
        arguments.extend(views.iter().map(String::as_str));
        polscan(&arguments)
    };

    let refused = folder.path().join("refused");
    let run = solve(&refused, &[]);
    assert_eq!(run.status.code(), Some(1), "{}", text(&run));
    let reasons = report(&refused)["refusals"].clone();
    println!("captures: procam-chess: refused: {reasons}");
    assert_eq!(reasons[0]["type"], "held-out", "{reasons}");
    assert_eq!(reasons[0]["view"], "procam-chess-2", "{reasons}");
    assert!(!refused.join("calibration.toml").exists());

    let gates = folder.path().join("gates.toml");
    fs::write(&gates, "held_out_px = 1.0\noutlier_share = 0.1\n").expect("a file of limits");
    let out = folder.path().join("out");
    let run = solve(&out, &["--gates", &path_text(&gates)]);
    assert!(run.status.success(), "{}", text(&run));
    let (solution, found) = (report(&out)["solution"].clone(), calibration(&out));
    let number = |name: &str| solution[name].as_f64().expect("an rms");
    let (camera, projector) = (number("camera_rms_px"), number("projector_rms_px"));
    println!(
        "captures: procam-chess: camera {camera:.4} px (0.3163), projector {projector:.4} px (0.2339), fx {:.1} (3452.39), fy {:.1} (3449.92)",
        found.camera.fx, found.camera.fy
    );
    assert!(camera <= RMS * 0.3163 && projector <= RMS * 0.2339, "{camera} {projector}");
    for (ours, theirs) in [(found.camera.fx, 3452.39), (found.camera.fy, 3449.92)] {
        assert!((ours / theirs - 1.0f64).abs() <= FOCAL, "focal length {ours}, reference {theirs}");
    }
    for view in solution["views"].as_array().expect("views") {
        let flatness = |name: &str| view["flatness"][name].as_f64().expect("a number");
        let (rms, expected) = (flatness("rms_mm"), flatness("expected_rms_mm"));
        println!("captures: {}: board flat to {rms:.3}, expected {expected:.3}", view["name"]);
        // The steeply tilted board is twice as rough as its sigma says; the others are within a quarter.
        let most = if view["name"] == "procam-chess-1" { 2.5 } else { 1.25 };
        assert!(rms < most * expected, "{}: {rms} {expected}", view["name"]);
    }
    let board: Board = toml::from_str(&fs::read_to_string(&board).expect("the board")).expect("a board");
    let file = path_text(&out.join("calibration.toml"));
    for (number, pose) in poses.iter().enumerate() {
        let decode = pose.decode("cloud", &["--calibration", &file]);
        let frame = format!("procam-chess/sample_data/capture_{number}/graycode_40.png");
        let spacing = spacing(&board, &captures.join(frame), &decode.out, &found);
        println!("captures: {}: corners {spacing:.3} apart, {SQUARE} in truth", pose.name);
        assert!((spacing / SQUARE - 1.0).abs() < 0.01, "{}: corners are {spacing} apart", pose.name);
    }
}

/// Mean distance of neighbouring corners of the board, by the depth of what was scanned.
fn spacing(board: &Board, white: &Path, decoded: &Path, calibration: &Calibration) -> f64 {
    let white = image::open(white).unwrap_or_else(|e| panic!("{}: {e}", white.display())).into_luma8();
    let size = (white.width() as usize, white.height() as usize);
    let picture = Picture::new(size.0, size.1, white.into_raw().into_iter().map(f32::from).collect());
    let found = detect(board, &picture, DetectSettings::default()).expect("the board");
    let depth = Npy::read(&decoded.join("maps.npz"), "depth").floats();
    let points: HashMap<[i64; 2], Vector3<f64>> = found
        .corners
        .iter()
        .filter_map(|found| {
            let z = depth_at(&depth, size.0, found.corner.camera_px)?;
            let ray = calibration.camera.ray(found.corner.camera_px)?;
            let cell = found.corner.board_mm.map(|mm| (mm / SQUARE).round() as i64);
            Some((cell, ray * (z / ray.z)))
        })
        .collect();
    let away = |from: &Vector3<f64>, cell: [i64; 2]| Some((points.get(&cell)? - from).norm());
    let pairs = points.iter().flat_map(|(&[x, y], point)| [away(point, [x + 1, y]), away(point, [x, y + 1])]);
    let distances: Vec<f64> = pairs.flatten().collect();
    // 110 pairs where every corner is seen.
    assert!(distances.len() >= 90, "{} pairs of corners", distances.len());
    distances.iter().sum::<f64>() / distances.len() as f64
}

/// Depth at a place between pixels: on a plane the inverse of depth is linear in them.
fn depth_at(depth: &[f32], width: usize, [x, y]: [f64; 2]) -> Option<f64> {
    let (left, top) = ((x.round() as usize).checked_sub(6)?, (y.round() as usize).checked_sub(6)?);
    let (mut normal, mut right, mut count) = (Matrix3::zeros(), Vector3::zeros(), 0);
    for (v, u) in (top..top + 13).flat_map(|v| (left..left + 13).map(move |u| (v, u))) {
        let z = f64::from(*depth.get(v * width + u)?);
        if z.is_finite() {
            let row = Vector3::new(u as f64 - x, v as f64 - y, 1.0);
            normal += row * row.transpose();
            right += row / z;
            count += 1;
        }
    }
    (count >= 80).then(|| Some(1.0 / (normal.try_inverse()? * right).z))?
}

fn make_board(folder: &Path, arguments: &[&str]) -> PathBuf {
    let page = path_text(&folder.join("board.pdf"));
    let run = polscan(&[&["calibrate", "board", "--out", &page], arguments].concat());
    assert!(run.status.success(), "{}", text(&run));
    folder.join("board.toml")
}

fn polscan(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_polscan")).args(arguments).output().expect("polscan starts")
}

fn text(run: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&run.stdout), String::from_utf8_lossy(&run.stderr))
}

fn report(out: &Path) -> Value {
    let bytes = fs::read(out.join("report.json")).expect("report.json");
    serde_json::from_slice(&bytes).expect("report.json is JSON")
}

fn calibration(out: &Path) -> Calibration {
    let bytes = fs::read(out.join("calibration.toml")).expect("calibration.toml");
    Calibration::from_bytes(&bytes, "calibration.toml", &ReadHints::default()).expect("a calibration")
}
