//! Configurations: every fault is reported, none ends the program.
#![no_main]

use std::path::Path;

use libfuzzer_sys::fuzz_target;
use polscan::config::Layers;

fuzz_target!(|text: &str| {
    if let Err(error) = Layers::parse(text, Path::new("/nonexistent")) {
        assert!(!error.faults.is_empty());
        let _ = error.to_string();
    }
});
