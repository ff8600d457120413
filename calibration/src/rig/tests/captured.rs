//! Corner lists of others, with what other software made of them.

use std::{collections::BTreeMap, fs, io::Read, path::PathBuf};

use flate2::read::ZlibDecoder;
use serde_json::Value;

use crate::{
    observation::{Corner, View},
    rig::{Setup, calibrate},
};

/// Arrays of a compressed MAT-file of level 5, by name, column by column: as far as the toolbox writes corner lists.
fn arrays(bytes: &[u8]) -> BTreeMap<String, Vec<f64>> {
    let word = |b: &[u8], at: usize| u32::from_le_bytes(b[at..at + 4].try_into().unwrap()) as usize;
    // A data element: its type, where its content begins, how long that is, and where the next one begins.
    let element = |b: &[u8], at: usize| {
        let tag = word(b, at);
        if tag >> 16 != 0 {
            (tag & 0xffff, at + 4, tag >> 16, at + 8)
        } else {
            let length = word(b, at + 4);
            (tag, at + 8, length, at + 8 + length.next_multiple_of(8))
        }
    };
    let mut found = BTreeMap::new();
    let mut at = 128;
    while at < bytes.len() {
        let length = word(bytes, at + 4);
        let mut body = Vec::new();
        ZlibDecoder::new(&bytes[at + 8..at + 8 + length]).read_to_end(&mut body).expect("a zlib stream");
        at += 8 + length;
        let (_, _, _, dimensions) = element(&body, 8);
        let (_, _, _, name) = element(&body, dimensions);
        let (_, start, length, data) = element(&body, name);
        let name = String::from_utf8_lossy(&body[start..start + length]).into_owned();
        if data >= body.len() {
            continue;
        }
        let (kind, start, length, _) = element(&body, data);
        let Some(data) = body.get(start..start + length) else { continue };
        let values: Vec<f64> = match kind {
            2 => data.iter().map(|v| f64::from(*v)).collect(),
            4 => data.chunks_exact(2).map(|v| f64::from(u16::from_le_bytes([v[0], v[1]]))).collect(),
            9 => data.chunks_exact(8).map(|v| f64::from_le_bytes(v.try_into().unwrap())).collect(),
            _ => continue,
        };
        found.insert(name, values);
    }
    found
}

fn folder() -> PathBuf {
    std::env::var_os("POLSCAN_CAPTURES")
        .map(PathBuf::from)
        .expect("POLSCAN_CAPTURES names the folder of captures")
}

#[test]
#[ignore = "needs the captures of `make captures`"]
fn captured_corners_of_the_toolbox_give_its_calibration() {
    let folder = folder().join("bouguet-example");
    let arrays = arrays(&fs::read(folder.join("Calib_Results_old0.mat")).expect("the toolbox's result"));
    let views: Vec<View> = (1..=20)
        .map(|k| {
            let (image, board) = (&arrays[&format!("x_{k}")], &arrays[&format!("X_{k}")]);
            let corners =
                image.chunks_exact(2).zip(board.chunks_exact(3)).zip(0..).map(|((image, board), id)| {
                    Corner { id, board_mm: [board[0], board[1]], camera_px: [image[0], image[1]] }
                });
            View { name: format!("Image{k}"), corners: corners.collect(), plane_points: Vec::new() }
        })
        .collect();
    let reference: Value =
        serde_json::from_slice(&fs::read(folder.join("reference/reference.json")).expect("the reference"))
            .unwrap();
    let number =
        |path: &str| reference.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("no {path}"));
    // Plain least squares, as theirs is.
    let mut setup = Setup::camera((640, 480));
    setup.huber_sigmas = f64::INFINITY;
    let found = calibrate(&views, &setup).unwrap_or_else(|e| panic!("{e}"));
    let (lens, report) = (found.calibration.camera, &found.report);
    let worst = report.views.iter().map(|v| v.held_out.unwrap().camera_rms_px).fold(0.0, f64::max);
    println!(
        "captures: bouguet-example: fx {:.4}, fy {:.4}, rms {:.5} px (theirs {:.5}), worst held out {worst:.3} px, left out {:?}",
        lens.fx,
        lens.fy,
        report.camera_rms_px,
        number("/opencv_on_bouguet_corners/rms"),
        report.views.iter().map(|v| v.left_out[0]).sum::<usize>()
    );
    assert!((report.camera_rms_px / number("/opencv_on_bouguet_corners/rms") - 1.0).abs() < 1e-3);
    for (ours, theirs) in [(lens.fx, "/bouguet/fc/0"), (lens.fy, "/bouguet/fc/1")] {
        assert!((ours / number(theirs) - 1.0).abs() < 1e-4, "{ours} against {theirs}");
    }
    // The toolbox reports three standard deviations.
    let errors = [
        "fc_error/0",
        "fc_error/1",
        "cc_error/0",
        "cc_error/1",
        "kc_error/0",
        "kc_error/1",
        "kc_error/2",
        "kc_error/3",
    ];
    for (parameter, name) in report.parameters.iter().zip(errors) {
        let theirs = number(&format!("/bouguet/{name}")) / 3.0;
        println!(
            "captures: bouguet-example: {} sigma {:.3e}, theirs {theirs:.3e}",
            parameter.name, parameter.sigma
        );
        assert!(
            (parameter.sigma / theirs - 1.0).abs() < 0.05,
            "{}: {} against {theirs}",
            parameter.name,
            parameter.sigma
        );
    }
    // Robustly nearly the same.
    let robust = calibrate(&views, &Setup::camera((640, 480))).unwrap_or_else(|e| panic!("{e}"));
    assert!((robust.calibration.camera.fx / lens.fx - 1.0).abs() < 0.005);
}
