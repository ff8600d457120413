//! Latency, rise and fall of the projector and ripple of its lamp: measured and written.

use std::time::SystemTime;

use polscan_calibration::synchrony::Sample;
use serde_json::{Value, json};

use super::output::{Outcome, Output, Summary, series};
use crate::{
    app::Rig,
    compare::plot::Plot,
    config::Settings,
    engine::Failure,
    measure::{
        files::{Chosen, DeviceKey, DisplayMode, Document, SyncFile},
        sync::{Curve, Synchrony, measure},
    },
    sequencer::CancelFlag,
    store::time::rfc3339_utc,
};

/// Colours of the bands' curves, from the top of the picture down.
const CLASSES: [&str; 4] = ["raw", "paper", "pse", "truth"];

/// Measures and writes; `progress` hears what is being done.
///
/// # Errors
/// Devices, a picture that the camera does not see, the disk, or `cancel`.
pub fn run(
    mut output: Output,
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(&str),
) -> Result<Outcome, Failure> {
    let found = measure(rig, settings, cancel, progress)?;
    let file = file(&found);
    output.document(&file)?;
    for (name, plot) in plots(&found) {
        output.plot(&name, &plot)?;
    }
    let summary = Summary { lines: lines(&found, &file), ..Summary::default() };
    output.finish(report(&found, &file), summary)
}

fn file(found: &Synchrony) -> SyncFile {
    let (timing, chosen) = (found.timing, found.chosen);
    let ms = |duration: std::time::Duration| 1e3 * duration.as_secs_f64();
    SyncFile {
        schema: SyncFile::SCHEMA.into(),
        created: rfc3339_utc(SystemTime::now()),
        projector: DeviceKey::from(&found.projector),
        mode: DisplayMode::from(&found.projector),
        timing,
        chosen: Chosen {
            exposure_us: 1e3 * ms(chosen.exposure),
            trigger_delay_ms: ms(chosen.trigger_delay),
            hold_refreshes: chosen.hold_refreshes,
            safe_from_ms: timing.latency_ms + timing.settling_ms,
            safe_until_ms: ms(chosen.hold()) + timing.latency_ms,
        },
        ripple: found.ripple,
        bands: found.bands.clone(),
    }
}

fn report(found: &Synchrony, file: &SyncFile) -> Value {
    let samples = |samples: &[Sample]| -> Vec<[f64; 3]> {
        samples.iter().map(|sample| [sample.start_ms, sample.light, sample.sigma]).collect()
    };
    let curve = |curve: &Curve| json!({ "channel": curve.channel, "rows": curve.rows, "rise": samples(&curve.rise), "fall": samples(&curve.fall) });
    let unseen = found
        .unseen
        .iter()
        .map(|(channel, error)| json!({ "channel": channel, "message": error.to_string() }));
    json!({
        "schema": "polscan.sync-report/1",
        "sync": file,
        "projector_says": found.projector.timing,
        "exposure_ms": found.exposure_ms,
        "unseen": unseen.collect::<Vec<_>>(),
        "samples": "start of the exposure after the flip in ms, level in DN, its sigma",
        "curves": found.curves.iter().map(curve).collect::<Vec<_>>(),
    })
}

fn lines(found: &Synchrony, file: &SyncFile) -> Vec<String> {
    let (timing, chosen) = (found.timing, file.chosen);
    let mut lines = vec![
        format!("latency  {:.1} ms, {} refreshes", timing.latency_ms, timing.latency_refreshes),
        format!(
            "settling {:.1} ms from there to a thousandth; scan-out {:.1} ms from top to bottom",
            timing.settling_ms, timing.scan_out_ms
        ),
    ];
    for band in &found.bands {
        lines.push(format!(
            "{:8} rows {:4} to {:4}: first light {:5.1} ms, rise {:4.1} ms, fall {:4.1} ms (10-90 %), settled {:5.1} and {:5.1} ms",
            band.channel,
            band.first_row,
            band.end_row,
            band.rise.first_light_ms,
            band.rise.t10_90_ms,
            band.fall.t10_90_ms,
            band.rise.settled_ms,
            band.fall.settled_ms
        ));
    }
    for (channel, error) in &found.unseen {
        lines.push(format!("{channel}: {error}"));
    }
    lines.push(match found.ripple {
        Some(ripple) => match ripple.hz {
            Some(hz) => format!("lamp     ripple of {:.2} % at {hz:.1} Hz", 100.0 * ripple.share),
            None => format!("lamp     no ripple above {:.3} %", 100.0 * ripple.share),
        },
        None => "lamp     too dark to tell".into(),
    });
    lines.push(format!(
        "scan     trigger after {:.1} ms, hold {} refreshes; the light is steady from {:.1} to {:.1} ms",
        chosen.trigger_delay_ms, chosen.hold_refreshes, chosen.safe_from_ms, chosen.safe_until_ms
    ));
    lines
}

/// One plot for each channel: rise and, after it, fall.
fn plots(found: &Synchrony) -> Vec<(String, Plot)> {
    let middle = 0.5 * found.exposure_ms;
    let mut channels: Vec<&str> = found.curves.iter().map(|curve| curve.channel).collect();
    channels.dedup();
    let mut plots = Vec::new();
    for channel in channels {
        for (name, pick) in [("rise", 0), ("fall", 1)] {
            let bands = found.curves.iter().filter(|curve| curve.channel == channel);
            let series = bands.zip(CLASSES.iter().cycle()).map(|(curve, class)| {
                let mut samples = if pick == 0 { curve.rise.clone() } else { curve.fall.clone() };
                samples.sort_by(|a, b| a.start_ms.total_cmp(&b.start_ms));
                let points = samples.iter().map(|sample| (sample.start_ms + middle, sample.light)).collect();
                series(&format!("rows {} to {}", curve.rows[0], curve.rows[1]), class, true, points)
            });
            let plot = Plot {
                label: format!("{name} of {channel} after the flip"),
                x_name: "time after the flip in ms".into(),
                y_name: "level in DN".into(),
                series: series.collect(),
                ..Plot::default()
            };
            plots.push((format!("{channel}-{name}.svg"), plot));
        }
    }
    plots
}
