//! Noise of the camera, by photon transfer: measured and written.

use std::time::SystemTime;

use serde_json::{Value, json};

use super::output::{Outcome, Output, Summary, series};
use crate::{
    app::Rig,
    compare::plot::Plot,
    config::Settings,
    engine::Failure,
    measure::{
        files::{DeviceKey, Document, NoiseFigures, NoiseFile, NoiseSettings},
        noise::{Measured, measure},
    },
    sequencer::CancelFlag,
    store::time::rfc3339_utc,
};

/// Ill pixels that a report lists of each kind.
const MOST_LISTED: usize = 200;

/// Measures and writes; `progress` hears what is being done.
///
/// # Errors
/// Devices, a picture without light, the disk, or `cancel`.
pub fn run(
    mut output: Output,
    rig: &mut Rig,
    settings: &Settings,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(&str),
) -> Result<Outcome, Failure> {
    let measured = measure(rig, settings, cancel, progress)?;
    let linearity = &measured.noise.linearity;
    let refused = (!linearity.linear).then(|| {
        format!(
            "the response is not linear: its exponent is {:.3} +- {:.3}; switch gamma and look-up tables of the camera off",
            linearity.exponent, linearity.exponent_sigma
        )
    });
    let file = file(&measured);
    if refused.is_none() {
        output.document(&file)?;
    }
    for (name, plot) in plots(&measured) {
        output.plot(name, &plot)?;
    }
    let refused = refused.into_iter().collect();
    let summary = Summary { lines: lines(&measured), refused, ..Summary::default() };
    output.finish(report(&measured, &file), summary)
}

fn file(measured: &Measured) -> NoiseFile {
    let (noise, settings) = (&measured.noise, &measured.applied.settings);
    NoiseFile {
        schema: NoiseFile::SCHEMA.into(),
        created: rfc3339_utc(SystemTime::now()),
        camera: DeviceKey::from(&measured.camera),
        settings: NoiseSettings { format: settings.format, gain_db: settings.gain_db, gamma: settings.gamma },
        noise: NoiseFigures {
            gain_dn_per_electron: noise.gain_dn_per_electron,
            gain_sigma: noise.gain_sigma,
            read_noise_dn: noise.read_noise_dn,
            read_noise_sigma_dn: noise.read_noise_sigma_dn,
            black_level_dn: noise.black_level_dn,
            black_level_sigma_dn: noise.black_level_sigma_dn,
            exponent: noise.linearity.exponent,
            exponent_sigma: noise.linearity.exponent_sigma,
            saturation_dn: measured.clip_dn.map(|(_, low)| low),
            full_well_e: measured.full_well_e(),
        },
    }
}

fn report(measured: &Measured, file: &NoiseFile) -> Value {
    let levels: Vec<Value> = measured
        .levels
        .iter()
        .enumerate()
        .map(|(index, level)| {
            json!({
                "exposure_us": level.exposure_us,
                "mean_dn": level.mean_dn,
                "mean_sigma_dn": level.mean_sigma_dn,
                "variance_dn2": level.variance_dn2,
                "variance_sigma_dn2": level.variance_sigma_dn2,
                "clipped_share": level.clipped_share,
                "used": measured.noise.used.contains(&index),
            })
        })
        .collect();
    let listed = |pixels: &[[u32; 2]]| json!({ "count": pixels.len(), "pixels": &pixels[..pixels.len().min(MOST_LISTED)] });
    json!({
        "schema": "polscan.noise-report/1",
        "noise": file,
        "linearity": measured.noise.linearity,
        "variance_reduced_chi2": measured.noise.variance_reduced_chi2,
        "camera_says": { "noise": measured.applied.noise, "black_level_dn": measured.applied.black_level_dn,
                         "saturation_dn": measured.applied.saturation_dn },
        "clip_dn": measured.clip_dn.map(|(mean, _)| mean),
        "pixels": measured.pixels,
        "hot": listed(&measured.bad.hot),
        "dead": listed(&measured.bad.dead),
        "levels": levels,
    })
}

fn lines(measured: &Measured) -> Vec<String> {
    let noise = &measured.noise;
    let gain = noise.gain_dn_per_electron;
    let mut lines = vec![
        format!("gain K      {gain:.4} +- {:.4} DN per electron", noise.gain_sigma),
        format!(
            "read noise  {:.3} +- {:.3} DN, that is {:.2} electrons",
            noise.read_noise_dn,
            noise.read_noise_sigma_dn,
            noise.read_noise_dn / gain
        ),
        format!("black level {:.2} +- {:.2} DN", noise.black_level_dn, noise.black_level_sigma_dn),
        format!(
            "linearity   exponent {:.4} +- {:.4}, at most {:.2} % of the range off a straight line",
            noise.linearity.exponent,
            noise.linearity.exponent_sigma,
            100.0 * noise.linearity.largest_residual_share
        ),
    ];
    lines.push(match (measured.clip_dn, measured.full_well_e()) {
        (Some((level, low)), Some(full)) => {
            format!("saturation  at {level:.1} DN, that is {full:.0} electrons; samples from {low} DN on may be clipped")
        }
        _ => "saturation  not reached: the picture is too dark for the longest exposure".into(),
    });
    lines.push(format!("pixels      {} hot, {} dead", measured.bad.hot.len(), measured.bad.dead.len()));
    lines
}

fn plots(measured: &Measured) -> [(&'static str, Plot); 3] {
    let noise = &measured.noise;
    let black = noise.black_level_dn;
    let light = |dn: f64| (dn - black).max(0.0);
    let top = measured.levels.iter().map(|level| light(level.mean_dn)).fold(1.0, f64::max);
    let at_black = noise.read_noise_dn.powi(2) + 1.0 / 12.0;
    let transfer = Plot {
        label: "temporal variance over level".into(),
        x_name: "level above black in DN".into(),
        y_name: "variance in DN²".into(),
        series: vec![
            series(
                "fit",
                "truth",
                true,
                vec![(0.0, at_black), (top, at_black + noise.gain_dn_per_electron * top)],
            ),
            series(
                "measured",
                "pse",
                false,
                measured.levels.iter().map(|level| (light(level.mean_dn), level.variance_dn2)).collect(),
            ),
        ],
        ..Plot::default()
    };
    let linearity = Plot {
        label: "level over exposure time".into(),
        x_name: "exposure in us".into(),
        y_name: "level in DN".into(),
        series: vec![series(
            "",
            "pse",
            false,
            measured.levels.iter().map(|level| (level.exposure_us, level.mean_dn)).collect(),
        )],
        ..Plot::default()
    };
    let used = noise.used.iter().map(|&index| measured.levels[index].exposure_us);
    let residual = Plot {
        label: "distance of the levels from a straight line".into(),
        x_name: "exposure in us".into(),
        y_name: "residual in DN".into(),
        series: vec![series(
            "",
            "pse",
            false,
            used.zip(noise.linearity.residuals_dn.iter().copied()).collect(),
        )],
        marks: vec![(0.0, String::new())],
        ..Plot::default()
    };
    [("photon-transfer.svg", transfer), ("linearity.svg", linearity), ("linearity-residual.svg", residual)]
}
