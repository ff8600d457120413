//! A manifest: whatever is understood must survive its own checks, and what passes them must resolve or say why not.
#![no_main]

use libfuzzer_sys::fuzz_target;
use polscan::store::{Manifest, Policy};

fuzz_target!(|bytes: &[u8]| {
    let Ok(parsed) = Manifest::parse(bytes) else { return };
    let manifest = parsed.manifest;
    let sound = manifest.check(Policy::Upload, None).is_ok();
    if let (true, Ok(sequence)) = (sound, manifest.resolve_sequence(None, None)) {
        let settings = manifest.decode_settings(&sequence, (4, 3), 16);
        assert_eq!((settings.width, settings.height), (4, 3));
        let written = manifest.to_json().expect("a sound manifest can be written");
        let read = Manifest::parse(&written).expect("a written manifest can be read");
        assert_eq!(read.manifest, manifest);
    }
});
