//! Accuracy on simulated scenes with known coordinates.

use polscan_patterns::{Axis, Mode};

use super::synth::{Rig, Spot, accuracy, sequence, uniform};

/// 15 % texture on patches of 5 px.
fn texture(x: f64, y: f64) -> f64 {
    let cell = ((x / 5.0).floor() as i64 as u64).wrapping_mul(7919) ^ ((y / 5.0).floor() as i64 as u64);
    1.0 + 0.15 * (2.0 * uniform(cell) - 1.0)
}

fn slanted(reflectance: f64, slope: f64) -> impl Fn(f64, f64) -> Spot + Sync {
    move |x, y| Spot {
        u: 300.2 + slope * x + 0.011 * y,
        v: 200.4 + 0.333 * y - 0.008 * x,
        reflectance: reflectance * texture(x, y) / 1.15,
        ..Spot::default()
    }
}

fn report(name: &str, a: super::synth::Accuracy) {
    println!(
        "  {name:<28} cover {:.4} wrong {:.1e} rms {:.4} bias {:+.4} norm {:.2} rms {:.2} sigma {:.4} fallback {:.4}",
        a.coverage, a.wrong, a.rms, a.bias, a.normalised, a.normalised_rms, a.median_sigma, a.fallback
    );
}

#[test]
fn probe() {
    for slope in [0.331, 0.25, 0.21, 0.47, 0.7, 1.0] {
        for blur_px in [1.9, 1.2, 0.8, 0.6, 0.5, 0.4, 0.3, 0.05] {
            for reflectance in [1.0, 0.1, 0.03] {
                let rig = Rig { blur_px, ..Rig::default() };
                let scene = slanted(reflectance, slope);
                let decoded = rig.decode(&scene, &sequence(Mode::Fast));
                let name = format!("{slope} blur {blur_px} at {reflectance}");
                report(&name, accuracy(&rig, &scene, &decoded, Axis::Column, |_, _| true));
            }
        }
    }
}
