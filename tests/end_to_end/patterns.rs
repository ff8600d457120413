//! The written patterns are themselves a capture: of a camera that sees the projector's pixels one to one.

use crate::rig::{json, polscan, text};

#[test]
fn written_patterns_decode_to_the_identity() {
    let folder = tempfile::tempdir().expect("a folder");
    for (mode, size) in [("gray", "60x41"), ("pse", "64x48"), ("fast", "33x7"), ("paper", "40x30")] {
        let (out, maps) = (folder.path().join(mode), folder.path().join(format!("{mode}-maps")));
        polscan(&["patterns", "--mode", mode, "--size", size, "--out", text(&out)]).expect(0);
        polscan(&["decode", text(&out), "--out", text(&maps)]).expect(0);
        let report = json(&maps.join("report.json"));
        let (width, height) = size.split_once('x').expect("a size");
        let pixels: u64 = width.parse::<u64>().expect("a side") * height.parse::<u64>().expect("a side");
        assert_eq!(report["pixels"]["valid"], pixels, "{mode}: {}", report["pixels"]);
        let column = floats(&maps.join("maps.npz"), "column.npy");
        let width: usize = width.parse().expect("a side");
        for (index, value) in column.iter().enumerate() {
            let truth = (index % width) as f32;
            // Stripes without blur say no more than which side of a boundary a pixel is on.
            assert!((value - truth).abs() <= 0.51, "{mode}: pixel {index} is column {value}, not {truth}");
        }
    }
}

#[test]
fn a_size_that_no_projector_has_is_wrong_usage() {
    for size in ["0x10", "9000x10", "ten"] {
        polscan(&["patterns", "--mode", "gray", "--size", size, "--out", "/nowhere/out"]).expect(2);
    }
}

/// The float32 array `name` of an archive.
fn floats(path: &std::path::Path, name: &str) -> Vec<f32> {
    use std::io::Read;
    let file = std::fs::File::open(path).expect("maps.npz");
    let mut archive = zip::ZipArchive::new(file).expect("an archive");
    let mut bytes = Vec::new();
    archive.by_name(name).expect("the array").read_to_end(&mut bytes).expect("its bytes");
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    bytes[header..].chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
}
