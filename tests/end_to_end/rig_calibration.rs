//! `polscan calibrate board` and `rig` on the twin: what is found is as good as what the rig was described with.

use crate::rig::{Rig, json, polscan, text};

/// Makes a board of 9 x 6 squares of 18 mm, and returns the path of its file.
fn board(rig: &Rig) -> std::path::PathBuf {
    let page = rig.path("board.pdf");
    let arguments = ["--kind", "checkerboard", "--columns", "9", "--rows", "6", "--square-mm", "18"];
    let all = [&["calibrate", "board", "--out", text(&page)], &arguments[..]].concat();
    polscan(&all).expect(0);
    assert!(std::fs::read(&page).expect("a page").starts_with(b"%PDF-"));
    // Neither file is overwritten.
    polscan(&all).expect(74);
    rig.path("board.toml")
}

#[test]
fn a_calibration_found_with_a_board_scans_as_well_as_the_true_one() {
    let rig = Rig::small();
    let (board, config) = (board(&rig), rig.config());
    let (session, out) = (rig.path("session"), rig.path("found"));
    let arguments = ["calibrate", "rig", "--config", text(&config), "--board", text(&board), "--poses", "12"];
    let places = ["--session", text(&session), "--out", text(&out)];
    let run = polscan(&[&arguments[..], &places].concat()).expect(0);
    println!("{}", run.stdout);
    let report = json(&out.join("report.json"));
    assert_eq!(report["accepted"], true, "{report}");
    for name in ["calibration.toml", "opencv.yaml", "coverage.png", "residuals.png"] {
        assert!(out.join(name).is_file(), "{name}");
    }
    // An occupied folder is refused, and a session is not added to.
    polscan(&[&arguments[..], &places].concat()).expect(74);

    rig.scan("true-scan", &["--mode", "gray"]).expect(0);
    let rig = rig.set("rig.calibration", "found/calibration.toml");
    rig.scan("found-scan", &["--mode", "gray"]).expect(0);
    let planes = |out: &str| {
        let report = rig.report(out);
        let planes = report["planes"].as_array().expect("planes").clone();
        planes.into_iter().map(|plane| plane["rmse_mm"].as_f64().expect("a number")).collect::<Vec<_>>()
    };
    let (with_true, with_found) = (planes("true-scan"), planes("found-scan"));
    assert_eq!(with_true.len(), 2);
    for (with_true, with_found) in with_true.iter().zip(&with_found) {
        println!("{with_found} mm with the found calibration, {with_true} mm with the true one");
        assert!(
            *with_found < 1.1 * with_true,
            "{with_found} mm with the found, {with_true} mm with the true one"
        );
    }

    // Solved again from what is on the disk, without a view, and with too few.
    let again = rig.path("again");
    let solve = ["calibrate", "rig", "--session", text(&session)];
    polscan(&[&solve[..], &["--drop", "view-03", "--out", text(&again)]].concat()).expect(0);
    assert_eq!(json(&again.join("report.json"))["views"].as_array().map(Vec::len), Some(11));
    let other = rig.path("other");
    let unknown = polscan(&[&solve[..], &["--drop", "view-99", "--out", text(&other)]].concat()).expect(65);
    assert!(unknown.stderr.contains("view-99"), "{}", unknown.stderr);
    let (one, two) = (session.join("view-01"), session.join("view-02"));
    let few = ["calibrate", "rig", "--board", text(&board), "--views", text(&one), text(&two)];
    let refused = polscan(&[&few[..], &["--out", text(&other), "--json"]].concat()).expect(1);
    assert!(refused.stdout.contains("too-few-views"), "{}", refused.stdout);
    assert!(other.join("report.json").is_file() && !other.join("calibration.toml").exists());
}

#[test]
fn a_board_that_is_not_usable_is_refused_before_anything_is_scanned() {
    let rig = Rig::small();
    let (board, config, out) = (board(&rig), rig.config(), rig.path("found"));
    let arguments = ["calibrate", "rig", "--config", text(&config), "--board", text(&board), "--poses", "5"];
    let misprinted = [&arguments[..], &["--measured-mm", "93", "--out", text(&out)]].concat();
    let refused = polscan(&misprinted).expect(65);
    assert!(refused.stderr.contains("measured_mm is 93"), "{}", refused.stderr);
    assert!(!out.exists());
}
