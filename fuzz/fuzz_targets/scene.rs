//! Scenes of the simulated rig: reading and validation.
#![no_main]

use libfuzzer_sys::fuzz_target;
use polscan_drivers::sim::Scene;

fuzz_target!(|text: &str| {
    if let Ok(scene) = toml::from_str::<Scene>(text) {
        let _ = scene.validate();
    }
});
