//! What measures decoding speed still does so, on a sensor too small for its figures to mean anything.

use std::path::Path;

#[path = "../reconstruction/examples/speed/measure.rs"]
mod measure;

#[test]
fn every_stage_and_every_rival_is_measured() {
    let both = measure::bundles(240, 180).unwrap();
    for bundle in &both {
        let whole = measure::times(bundle, 2, None).unwrap();
        let names: Vec<_> = whole.stages.iter().map(|(name, _)| *name).collect();
        let expected = [
            "noise",
            "words",
            "pair-sums",
            "gates",
            "subpixel-first-axis",
            "subpixel-second-axis",
            "triangulator",
            "cloud",
            "ply",
            "contrast",
        ];
        assert_eq!(names, expected, "{}", whole.name);
        assert_eq!(whole.threads, 2);
        assert_eq!(whole.bytes, 44 * 240 * 180 * if whole.name == "8 bit" { 1 } else { 2 });
        let all = whole.stages.iter().map(|(_, ms)| *ms);
        for ms in all.chain([whole.read_ms, whole.codes_ms, whole.decode_ms]) {
            assert!(ms.is_finite() && ms > 0.0, "{}: {ms} ms", whole.name);
        }
        let one = measure::times(bundle, 1, Some("words")).unwrap();
        assert_eq!(one.stages.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["words"]);
    }
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let others = measure::others(root, &both[0], 2).unwrap();
    assert!(others.opencv_ms > 0.0 && others.numpy_ms > 0.0, "{others:?}");
    assert!(others.versions.contains("OpenCV") && others.versions.contains("numpy"), "{}", others.versions);
}
