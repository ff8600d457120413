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

/// A sphere of 40 mm on the paper's rig (`bump` 1), or one whose depth counts `bump` times.
fn sphere(reflectance: f64, bump: f64) -> impl Fn(f64, f64) -> Spot + Sync {
    move |x, y| {
        let r2 = (x - 200.0).powi(2) + (y - 48.0).powi(2);
        let depth = (40.0f64.powi(2) - r2 * 0.2156 * 0.2156).max(0.0).sqrt();
        let inside = depth > 10.0;
        Spot {
            u: 300.0 + 0.331 * x - bump * depth / 12.0,
            v: 200.0 + 0.331 * y,
            reflectance: if inside { reflectance } else { 0.0 },
            surface: u32::from(inside),
            ..Spot::default()
        }
    }
}

/// Two slanted planes side by side, the right one `jump` columns further, along a border that leans by `lean`.
fn step(reflectance: f64, jump: f64, lean: f64) -> impl Fn(f64, f64) -> Spot + Sync {
    move |x, y| {
        let right = x > 160.3 + lean * (y - 48.0);
        Spot {
            u: 300.2 + 0.331 * x + 0.011 * y + if right { jump } else { 0.0 },
            v: 200.4 + 0.333 * y - 0.008 * x,
            reflectance,
            surface: u32::from(right),
            ..Spot::default()
        }
    }
}

/// Classes of the pixels of an image.
fn classes(decoded: &crate::decode::Decoded) -> String {
    use crate::decode::Class;
    Class::ALL
        .iter()
        .map(|class| (class, decoded.class.data().iter().filter(|c| *c == class).count()))
        .filter(|(_, count)| *count > 0)
        .map(|(class, count)| format!("{class:?} {count} "))
        .collect()
}

#[test]
fn probe() {
    for reflectance in [1.0, 0.1, 0.03] {
        for bump in [1.0, 3.0, 10.0] {
            let rig = Rig { width: 400, ..Rig::default() };
            let scene = sphere(reflectance, bump);
            let decoded = rig.decode(&scene, &sequence(Mode::Pse));
            report(
                &format!("sphere {bump} at {reflectance}"),
                accuracy(&rig, &scene, &decoded, Axis::Column, |_, _| true),
            );
            println!("      {}", classes(&decoded));
        }
        for jump in [0.0, 0.3, 1.0, 2.0, 3.0, 20.0] {
            for lean in [0.0, 0.5] {
                let rig = Rig::default();
                let scene = step(reflectance, jump, lean);
                let decoded = rig.decode(&scene, &sequence(Mode::Pse));
                report(
                    &format!("jump {jump} lean {lean} at {reflectance}"),
                    accuracy(&rig, &scene, &decoded, Axis::Column, |x, y| {
                        let border = 160.3 + lean * (y as f64 - 48.0);
                        (x as f64 - border).abs() < 12.0
                    }),
                );
                println!("      {}", classes(&decoded));
            }
        }
    }
}

/// Time of a decode of the size of the paper's rig. Run with `--release -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement, not a check"]
fn timing_at_full_size() {
    let rig = Rig { width: 1600, height: 1200, ..Rig::default() };
    let scene = slanted(0.3, 0.331);
    let sequence = sequence(Mode::Pse);
    let frames: Vec<(polscan_patterns::Role, crate::decode::SharedPlane)> = rig
        .cached_scan(&scene, &sequence)
        .into_iter()
        .map(|(role, frame)| (role, std::sync::Arc::new(frame) as crate::decode::SharedPlane))
        .collect();
    for round in 0..6 {
        let mut accumulator = crate::decode::Accumulator::new(rig.settings(&sequence)).unwrap();
        for (role, plane) in &frames {
            accumulator.push(*role, plane.clone()).unwrap();
        }
        let start = std::time::Instant::now();
        let decoded = accumulator.finish().unwrap();
        println!("round {round}: {:.0} ms, {}", start.elapsed().as_secs_f64() * 1e3, classes(&decoded));
    }
}
