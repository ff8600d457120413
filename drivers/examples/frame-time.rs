//! Measures the simulated rig: set-up and rendering of frames at full size.
//!
//! `cargo run --release -p polscan-drivers --example frame-time [CONFIG]`, by default config/sim.toml.

use std::{path::Path, time::Instant};

use polscan_drivers::{
    camera::{CameraDriver, CameraSettings, PixelFormat, TriggerSource},
    projector::{ProjectorDriver, Slide},
    sim::{Pacing, Rig, RigDescription, Scene},
};

#[derive(serde::Deserialize)]
struct Config {
    sim: RigDescription,
}

/// Processor time of this process so far in ms, in steps of 10; on Linux only.
fn processor_ms() -> Option<f64> {
    let text = std::fs::read_to_string("/proc/self/stat").ok()?;
    // After the name in parentheses, user and system ticks are fields 12 and 13.
    let fields: Vec<&str> = text.rsplit(')').next()?.split_whitespace().collect();
    let ticks = |field: usize| fields.get(field)?.parse::<f64>().ok();
    Some(10.0 * (ticks(11)? + ticks(12)?))
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let default = concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml");
    let path = std::env::args().nth(1).unwrap_or_else(|| default.to_owned());
    let mut description = toml::from_str::<Config>(&std::fs::read_to_string(&path)?)?.sim;
    description.pacing = Pacing::Fast;
    let scene = Path::new(&path).parent().unwrap_or(Path::new(".")).join(&description.scene);
    let scene: Scene = toml::from_str(&std::fs::read_to_string(scene)?)?;

    let clock = description.pacing.clock();
    let start = Instant::now();
    let rig = Rig::new(&description, &scene, clock.clone())?;
    println!(
        "set-up {:.0} ms, {} threads",
        1e3 * start.elapsed().as_secs_f64(),
        rayon::current_num_threads()
    );

    let mut camera = rig.cameras().open(None)?;
    let mut projector = rig.projectors().open(None)?;
    let (width, height) = (projector.info().width as usize, projector.info().height as usize);
    let stripes = |size: usize| (0..size).map(|i| if i / 8 % 2 == 0 { [0, 255, 0] } else { [255, 0, 255] });
    projector.load(&[
        Slide::Uniform([0, 255, 0]),
        Slide::Columns(stripes(width).collect()),
        Slide::Rows(stripes(height).collect()),
        Slide::Full(stripes(width * height).collect()),
    ])?;
    camera.apply(&CameraSettings {
        exposure_us: 2000.0,
        gain_db: 0.0,
        gamma: description.camera.gamma,
        region: None,
        format: PixelFormat::Mono12,
        trigger: TriggerSource::Software,
    })?;
    camera.arm(44)?;
    for (slide, name, count) in [(0, "uniform", 20), (1, "columns", 40), (2, "rows", 40), (3, "full", 2)] {
        let shown = projector.show(slide)?;
        let settled = shown.flipped + std::time::Duration::from_millis(300);
        clock.sleep_until(settled);
        let mut times = Vec::new();
        let processor = processor_ms();
        for _ in 0..count {
            camera.trigger(clock.now())?;
            let start = Instant::now();
            camera.next_frame(std::time::Duration::from_secs(5))?;
            times.push(1e3 * start.elapsed().as_secs_f64());
        }
        times.sort_by(f64::total_cmp);
        let processor = processor_ms()
            .zip(processor)
            .map_or(f64::NAN, |(after, before)| (after - before) / f64::from(count));
        println!(
            "{name}: best {:.1} ms, median {:.1} ms, worst {:.1} ms, processor {processor:.0} ms a frame",
            times[0],
            times[times.len() / 2],
            times[times.len() - 1]
        );
    }
    Ok(())
}
