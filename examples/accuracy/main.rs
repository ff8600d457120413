//! Measures the scanner on its simulated rig and writes `docs/accuracy.md` with its plots: error, coverage, wrong words and
//! honesty of the stated uncertainty against what varies in a laboratory. Run by `make accuracy`.

mod page;
mod sweeps;

use std::{error::Error, path::Path};

use polscan::{
    app::Rig,
    config::{Layers, Settings},
    engine::{Results, Scan},
    pipeline,
    report::{Accuracy, Report},
    sequencer::CancelFlag,
};
use polscan_drivers::camera::Region;

/// The middle of the sensor, where both plates of the paper's scene are seen: enough pixels for every figure, in a fifth
/// of the time.
const MIDDLE: Region = Region { x: 480, y: 360, width: 640, height: 480 };

fn main() -> Result<(), Box<dyn Error>> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let base = Layers { file: Some(root.join("config/sim.toml")), overrides: Vec::new() }.load()?;
    let start = std::time::Instant::now();
    let measured = sweeps::all(&base)?;
    let seconds = start.elapsed().as_secs_f64();
    page::write(&root.join("docs"), &measured)?;
    eprintln!("{} scans in {seconds:.0} s", measured.scans());
    Ok(())
}

/// Settings of the rig, seen through the middle of its sensor.
fn middle(base: &Settings) -> Settings {
    let mut settings = base.clone();
    settings.camera.region = Some(MIDDLE);
    settings
}

/// Scans with `settings` and looks at what came of it.
fn scan<R>(settings: &Settings, look: impl FnOnce(&Results) -> R) -> Result<R, Box<dyn Error>> {
    let mut rig = Rig::open(settings)?;
    let scan = Scan::prepare(settings, &[], &mut rig)?;
    let taken = scan.capture(&mut rig, &mut |_| {}, &CancelFlag::default());
    if let Some(reason) = taken.failure() {
        return Err(format!("the scan failed: {}", reason.message).into());
    }
    Ok(scan.examine(&taken, look)?)
}

/// Scans and reports.
fn report(settings: &Settings) -> Result<Report, Box<dyn Error>> {
    scan(settings, |results| pipeline::report(results.job, results.outcome, results.context, results.timings))
}

/// Figures of one object of a report, with the root mean square distance from its own plane.
#[derive(Debug, Clone, Copy, Default)]
struct Figures {
    accuracy: Accuracy,
    plane_rmse_mm: Option<f64>,
}

/// Figures of a planar object.
fn of_plane(report: &Report, name: &str) -> Option<Figures> {
    let plane = report.planes.iter().find(|plane| plane.name == name)?;
    Some(Figures { accuracy: plane.truth?, plane_rmse_mm: plane.rmse_off_shadow_mm })
}

/// Figures of the whole scene.
fn of_scene(report: &Report) -> Option<Figures> {
    Some(Figures { accuracy: report.truth.as_ref()?.interior, plane_rmse_mm: None })
}
