use std::os::unix::fs::symlink;

use tempfile::TempDir;

use super::*;

/// A bundle of one white pixel, coded in one column bit.
fn capture(folder: &Path) {
    let manifest = r#"{"schema": "polscan.bundle/1", "mode": "gray", "projector": {"width": 2, "height": 1},
        "sequence": [{"role": "white"}, {"role": "code", "axis": "column", "bit": 0}],
        "frames": ["a.pgm", "sub/b.pgm"], "calibration": "calibration.toml", "note": "x"}"#;
    fs::create_dir(folder.join("sub")).unwrap();
    fs::write(folder.join("manifest.json"), manifest).unwrap();
    fs::write(folder.join("a.pgm"), b"P5 1 1 255\n\xff").unwrap();
    fs::write(folder.join("sub/b.pgm"), b"P5 1 1 255\n\x10").unwrap();
    fs::write(folder.join("calibration.toml"), b"text").unwrap();
}

#[test]
fn a_bundle_opens_by_its_folder_and_by_its_manifest() {
    let folder = TempDir::new().unwrap();
    capture(folder.path());
    for path in [folder.path().to_owned(), folder.path().join("manifest.json")] {
        let bundle = Bundle::open(&path, Policy::Upload, None).unwrap();
        let frames = bundle.frames(&Limits::default()).unwrap();
        assert_eq!((frames.width, frames.height, frames.planes.len()), (1, 1, 2));
        assert_eq!(bundle.calibration().unwrap().unwrap().1, b"text");
        assert_eq!(bundle.notes(), ["the manifest's key `note` is unknown and was ignored"]);
        assert!(bundle.truth((1, 1)).unwrap().is_none());
        let origin = bundle.origin(&frames);
        assert_eq!(origin.frames[1].path, "sub/b.pgm");
        assert_eq!(origin.frames[1].entry.bytes, 12);
        let manifest = fs::read(folder.path().join("manifest.json")).unwrap();
        assert_eq!(origin.manifest_sha256, hex(&Sha256::digest(manifest)));
    }
}

#[test]
fn absolute_frames_lead_to_the_same_files_from_elsewhere() {
    let (folder, elsewhere) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    capture(folder.path());
    let bundle = Bundle::open(folder.path(), Policy::Local, None).unwrap();
    let mut manifest = bundle.manifest().clone();
    manifest.frames = bundle.absolute_frames();
    manifest.calibration = None;
    fs::write(elsewhere.path().join("manifest.json"), manifest.to_json().unwrap()).unwrap();
    let again = Bundle::open(elsewhere.path(), Policy::Local, None).unwrap();
    assert_eq!(again.frames(&Limits::default()).unwrap().planes.len(), 2);
    assert!(Bundle::open(elsewhere.path(), Policy::Upload, None).is_err());
}

#[test]
fn frames_elsewhere_are_compared_with_those_of_the_source() {
    let (folder, elsewhere) = (TempDir::new().unwrap(), TempDir::new().unwrap());
    capture(folder.path());
    let bundle = Bundle::open(folder.path(), Policy::Local, None).unwrap();
    let frames = bundle.frames(&Limits::default()).unwrap();
    assert!(bundle.verify(&frames).unwrap().is_empty());
    let source = bundle.origin(&frames);
    let check = |source: Source| {
        let manifest = Manifest {
            frames: bundle.absolute_frames(),
            calibration: None,
            source: Some(source),
            ..bundle.manifest().clone()
        };
        fs::write(elsewhere.path().join("manifest.json"), manifest.to_json().unwrap()).unwrap();
        let again = Bundle::open(elsewhere.path(), Policy::Local, None).unwrap();
        again.verify(&again.frames(&Limits::default()).unwrap()).map_err(|error| error.to_string())
    };
    assert!(check(source.clone()).unwrap().is_empty());
    let mut fewer = source.clone();
    fewer.frames.pop();
    let error = check(fewer).unwrap_err();
    assert!(error.contains("`source.frames`: has 1 entries for 2 files"), "{error}");
    fs::write(folder.path().join("sub/b.pgm"), b"P5 1 1 255\n\x11").unwrap();
    let error = check(source).unwrap_err();
    assert!(error.contains("`source.frames[1]`") && error.contains("another content"), "{error}");
    assert!(!error.contains("frames[0]"), "{error}");
}

#[test]
fn links_are_followed_here_and_refused_in_uploads() {
    for (link, target) in [("a.pgm", "real.pgm"), ("sub", "real")] {
        let folder = TempDir::new().unwrap();
        capture(folder.path());
        fs::rename(folder.path().join(link), folder.path().join(target)).unwrap();
        symlink(target, folder.path().join(link)).unwrap();
        let load = |policy| Bundle::open(folder.path(), policy, None).unwrap().frames(&Limits::default());
        assert_eq!(load(Policy::Local).unwrap().planes.len(), 2);
        let error = load(Policy::Upload).unwrap_err().to_string();
        assert!(error.contains("symbolic link"), "{error}");
    }
}

#[test]
fn what_is_no_regular_file_is_refused_rather_than_waited_for() {
    let folder = TempDir::new().unwrap();
    capture(folder.path());
    fs::remove_file(folder.path().join("a.pgm")).unwrap();
    rustix::fs::mkfifoat(rustix::fs::CWD, folder.path().join("a.pgm"), rustix::fs::Mode::RUSR).unwrap();
    let bundle = Bundle::open(folder.path(), Policy::Local, None).unwrap();
    let error = bundle.frames(&Limits::default()).unwrap_err().to_string();
    assert!(error.contains("not a regular file"), "{error}");
}

#[test]
fn what_is_missing_is_named() {
    let folder = TempDir::new().unwrap();
    let error = Bundle::open(&folder.path().join("none"), Policy::Local, None).unwrap_err().to_string();
    assert!(error.contains("none") && error.contains("check the path"), "{error}");
    let error = Bundle::open(folder.path(), Policy::Local, None).unwrap_err().to_string();
    assert!(error.contains("manifest.json"), "{error}");
    capture(folder.path());
    fs::remove_file(folder.path().join("sub/b.pgm")).unwrap();
    fs::remove_file(folder.path().join("calibration.toml")).unwrap();
    let bundle = Bundle::open(folder.path(), Policy::Local, None).unwrap();
    let error = bundle.frames(&Limits::default()).unwrap_err().to_string();
    assert!(error.contains("b.pgm"), "{error}");
    assert!(bundle.calibration().is_err());
}

#[test]
fn long_files_are_not_swallowed() {
    let folder = TempDir::new().unwrap();
    let path = folder.path().join("long");
    fs::write(&path, [0; 11]).unwrap();
    assert_eq!(read_bounded(&path, Policy::Local, "read", 11).unwrap().len(), 11);
    assert!(read_bounded(&path, Policy::Local, "read", 10).is_err());
    // An endless device is no file.
    assert!(read_bounded(Path::new("/dev/zero"), Policy::Local, "read", 10).is_err());
}
