//! Calibrations in every format; what is accepted must be usable and survive being written.
#![no_main]

use libfuzzer_sys::fuzz_target;
use polscan::geometry::{Calibration, ReadHints};

const NAMES: [&str; 5] = ["c.toml", "c.yml", "c.xml", "c.mat", "c.m"];

fuzz_target!(|bytes: &[u8]| {
    let Some((kind, bytes)) = bytes.split_first() else { return };
    let name = NAMES[usize::from(*kind) % NAMES.len()];
    let hints = ReadHints {
        camera_size: Some((1600, 1200)),
        projector_size: Some((1024, 768)),
        swap: kind & 0x80 != 0,
        ..ReadHints::default()
    };
    if let Ok(calibration) = Calibration::from_bytes(bytes, name, &hints) {
        assert!(calibration.faults().is_empty());
        let written = calibration.to_toml();
        let read = Calibration::from_bytes(written.as_bytes(), "c.toml", &ReadHints::default());
        assert_eq!(read.as_ref(), Ok(&calibration));
    }
});
