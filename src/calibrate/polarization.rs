//! Extinction, channels, azimuth, misregistration and drive levels: measured, joined with other angles, and written.

use std::{path::Path, time::SystemTime};

use polscan_calibration::polarization::{CHANNEL_NAMES, Found, PolarizationError, State, Turn, solve};
use serde_json::{Value, json};

use super::output::{Outcome, Output, Summary, series};
use crate::{
    app::Rig,
    compare::plot::Plot,
    config::Settings,
    engine::Failure,
    measure::{
        files::{DeviceKey, Document, PolarizationFile},
        polarization::{self as measure, Conditions, Measured, Set},
    },
    report::NamedRegion,
    sequencer::CancelFlag,
    store::{Policy, source::read_bounded, time::rfc3339_utc},
};

/// Edges are looked at where the polarizer lets H pass.
const EDGES_WITHIN_DEG: f64 = 20.0;
/// A polarizer farther off is to be turned, and measured again.
const MOST_ERROR_DEG: f64 = 5.0;
/// No report of a measurement is longer.
const MAX_REPORT_BYTES: u64 = 4 << 20;
const CLASSES: [&str; 3] = ["raw", "pse", "paper"];

/// What is measured.
#[derive(Debug, Clone, Default)]
pub struct Task {
    /// What the polarizer's mount reads now, in degrees counter-clockwise as the camera sees it; 0 is where H should pass.
    pub angle_deg: f64,
    /// Runs at other angles. Three angles make a calibration.
    pub earlier: Vec<Set>,
    /// Bare metal in the camera's image; what is evenly lit where there is none.
    pub coupon: Option<NamedRegion>,
    /// A white card in the camera's image.
    pub card: Option<NamedRegion>,
}

/// Measures one angle, joins it with those of earlier runs, and writes; `progress` hears what is being done.
///
/// # Errors
/// Devices, regions, a picture without light, the disk, or `cancel`.
pub fn run(
    mut output: Output,
    rig: &mut Rig,
    settings: &Settings,
    task: &Task,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(&str),
) -> Result<Outcome, Failure> {
    let what = measure::Task {
        angle_deg: task.angle_deg,
        coupon: task.coupon.as_ref(),
        card: task.card.as_ref(),
        edges: task.angle_deg.abs() <= EDGES_WITHIN_DEG,
    };
    let measured = measure::measure(rig, settings, &what, cancel, progress)?;
    check_alike(&task.earlier, &measured.set)?;
    let sets: Vec<&Set> = task.earlier.iter().chain([&measured.set]).collect();
    let turns: Vec<Turn> = sets.iter().map(|set| set.turn).collect();
    let found = solve(&turns);
    // A first angle is no failure: the others follow.
    let unfinished = matches!(found, Err(PolarizationError::Turns(_)));
    let refused = match &found {
        Ok(found) => refusal(found),
        Err(_) if unfinished => None,
        Err(error) => Some(error.to_string()),
    };
    if let (Ok(found), None) = (&found, &refused) {
        output.document(&file(found, &measured, &sets))?;
    }
    output.plot("turns.svg", &plot(&turns, found.as_ref().ok()))?;
    let report = json!({
        "schema": "polscan.polarization-report/1",
        "set": measured.set,
        "turns": turns,
        "found": found.as_ref().ok(),
        "message": found.as_ref().err().map(ToString::to_string),
        "misregistration": measured.field,
        "drive": measured.drive,
    });
    let lines = lines(&measured, found.as_ref());
    output.finish(report, Summary { lines, refused: refused.into_iter().collect(), unfinished })
}

/// Brightness is compared from angle to angle, so that nothing else may have changed it.
fn check_alike(earlier: &[Set], this: &Set) -> Result<(), Failure> {
    let Some(here) = &this.taken else { return Ok(()) };
    let other = earlier.iter().find(|set| set.taken.as_ref().is_some_and(|taken| taken != here));
    let Some((set, taken)) = other.and_then(|set| Some((set, set.taken.as_ref()?))) else { return Ok(()) };
    let words = |with: &Conditions| {
        format!("{} and {} at {} us and {} dB", with.camera, with.projector, with.exposure_us, with.gain_db)
    };
    let message = format!(
        "the run at {} degrees was taken with {}, this one with {}; measure all angles alike",
        set.turn.angle_deg,
        words(taken),
        words(here)
    );
    Err(Failure::data("join the angles", message))
}

/// What to do with the polarizer that stands `off` degrees from the darkest V that was seen, if that is known yet.
pub fn turning_advice(off: Option<f64>) -> String {
    match off {
        Some(angle) if angle < 0.5 => "V is as dark as it was seen: stop here".to_owned(),
        Some(angle) => format!("{angle:4.1} degrees off the darkest V that was seen"),
        None => "turn the polarizer through a quarter turn".to_owned(),
    }
}

/// What an earlier run measured, from its folder.
///
/// # Errors
/// It has no report of a polarization.
pub fn read_set(folder: &Path) -> Result<Set, Failure> {
    let path = folder.join("report.json");
    let operation = || format!("use the earlier run {}", folder.display());
    let bytes = read_bounded(&path, Policy::Local, "read", MAX_REPORT_BYTES)
        .map_err(|error| Failure::data(operation(), error))?;
    let report: Value = serde_json::from_slice(&bytes).map_err(|error| Failure::data(operation(), error))?;
    serde_json::from_value(report["set"].clone()).map_err(|error| Failure::data(operation(), error))
}

/// Why a rig is not to be used as it stands.
fn refusal(found: &Found) -> Option<String> {
    let none: Vec<&str> = (0..3)
        .filter(|&index| found.channels[index].state == State::None)
        .map(|index| CHANNEL_NAMES[index])
        .collect();
    if !none.is_empty() {
        return Some(format!(
            "{} is not polarized: it cannot carry a code; leave it out of projector.horizontal and projector.vertical, or \
             measure on bare metal",
            none.join(" and ")
        ));
    }
    if letters(found, State::Horizontal).is_empty() || letters(found, State::Vertical).is_empty() {
        return Some(
            "all channels carry the same state: this projector cannot show a polarization code".into(),
        );
    }
    (found.azimuth_error_deg.abs() > MOST_ERROR_DEG).then(|| {
        format!(
            "the polarizer's axis is {:.1} degrees off H where its mount reads 0: {}, call that 0, and measure again",
            found.azimuth_error_deg,
            turn_advice(found)
        )
    })
}

/// What to do with the mount.
fn turn_advice(found: &Found) -> String {
    let error = found.azimuth_error_deg;
    let way = if error > 0.0 { "clockwise" } else { "counter-clockwise" };
    format!("turn it to {:.1} degrees, {:.1} degrees {way} as the camera sees it", -error, error.abs())
}

fn letters(found: &Found, state: State) -> String {
    (0..3).filter(|&index| found.channels[index].state == state).map(|index| ["r", "g", "b"][index]).collect()
}

fn file(found: &Found, measured: &Measured, sets: &[&Set]) -> PolarizationFile {
    let best = sets.iter().map(|set| set.h_over_v()).fold(0.0, f64::max);
    let brightest = sets.iter().map(|set| set.white).fold(1e-9, f64::max);
    let black = sets.iter().map(|set| set.black).fold(0.0, f64::max);
    PolarizationFile {
        schema: PolarizationFile::SCHEMA.into(),
        created: rfc3339_utc(SystemTime::now()),
        horizontal: letters(found, State::Horizontal),
        vertical: letters(found, State::Vertical),
        extinction_ratio: best,
        azimuth_error_deg: found.azimuth_error_deg,
        azimuth_sigma_deg: found.azimuth_sigma_deg,
        black_share: black / brightest,
        camera: DeviceKey::from(&measured.camera),
        projector: DeviceKey::from(&measured.projector),
        drive: measured.drive,
        misregistration: measured.field,
        channels: found.channels,
    }
}

fn lines(measured: &Measured, found: Result<&Found, &PolarizationError>) -> Vec<String> {
    let set = &measured.set;
    let [red, green, blue] = set.turn.light;
    let mut lines = vec![format!(
        "at {:.1} degrees: red {red:.1}, green {green:.1}, blue {blue:.1} DN; H over V {:.2}; panels {:.2} % off adding up",
        set.turn.angle_deg,
        set.h_over_v(),
        100.0 * set.crosstalk
    )];
    match found {
        Ok(found) => {
            for (name, channel) in CHANNEL_NAMES.iter().zip(&found.channels) {
                let state = match channel.state {
                    State::Horizontal => "H",
                    State::Vertical => "V",
                    State::None => "neither",
                };
                lines.push(format!(
                    "{name:6} carries {state}: extinction {:.1} +- {:.1}, that is a leakage of {:.2} %; axis {:.2} +- {:.2} degrees",
                    channel.extinction,
                    channel.extinction_sigma,
                    100.0 / channel.extinction,
                    channel.axis_deg,
                    channel.axis_sigma_deg
                ));
            }
            lines.push(format!(
                "polarizer {:.2} +- {:.2} degrees off; {}",
                found.azimuth_error_deg,
                found.azimuth_sigma_deg,
                turn_advice(found)
            ));
        }
        Err(error) => lines.push(error.to_string()),
    }
    if let Some(field) = &measured.field {
        let [x, y] = field.at(0.5 * f64::from(field.size[0]) - 0.5, 0.5 * f64::from(field.size[1]) - 0.5);
        lines.push(format!(
            "V lies {x:+.3}, {y:+.3} px off H in the middle of the picture (sigma {:.3}, {:.3}), {:.3} px at most",
            field.sigma_px[0],
            field.sigma_px[1],
            field.largest_px()
        ));
    }
    if let Some(drive) = &measured.drive {
        lines.push(format!(
            "the card returns H {:.2} times as bright as V; alike at codes H {} and V {}",
            drive.ratio_at_full, drive.horizontal, drive.vertical
        ));
    }
    lines
}

/// Light of each channel over the angle, with what Malus' law makes of it.
fn plot(turns: &[Turn], found: Option<&Found>) -> Plot {
    let mut all = Vec::new();
    for (index, class) in CLASSES.into_iter().enumerate() {
        let most = turns.iter().map(|turn| turn.light[index]).fold(1e-9, f64::max);
        let points = turns.iter().map(|turn| (turn.angle_deg, turn.light[index] / most)).collect();
        all.push(series(CHANNEL_NAMES[index], class, false, points));
        if let Some(channel) = found.map(|found| found.channels[index]) {
            let malus = |angle: f64| {
                let cos = (2.0 * (angle - channel.axis_deg).to_radians()).cos();
                0.5 * (channel.extinction * (1.0 + cos) + 1.0 - cos) / channel.extinction
            };
            let sum: f64 = turns.iter().map(|turn| turn.light[index] / malus(turn.angle_deg)).sum();
            let top = sum / turns.len() as f64 / most;
            let curve = (-90..=180).step_by(3).map(|angle| (f64::from(angle), top * malus(f64::from(angle))));
            all.push(series("", class, true, curve.collect()));
        }
    }
    Plot {
        label: "light of each channel over the angle of the polarizer".into(),
        x_name: "reading of the mount in degrees".into(),
        y_name: "light, brightest = 1".into(),
        series: all,
        ..Plot::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angles_that_were_taken_otherwise_are_not_joined() {
        let key =
            |serial: &str| DeviceKey { driver: "sim".into(), model: "twin".into(), serial: serial.into() };
        let set = |exposure_us: Option<f64>| Set {
            turn: Turn { angle_deg: 30.0, light: [1.0; 3], sigma: [0.1; 3] },
            black: 0.0,
            white: 3.0,
            h: 1.0,
            v: 2.0,
            crosstalk: 0.0,
            taken: exposure_us.map(|exposure_us| Conditions {
                camera: key("camera"),
                projector: key("projector"),
                exposure_us,
                gain_db: 0.0,
            }),
        };
        let this = set(Some(2000.0));
        assert!(check_alike(&[set(Some(2000.0)), set(None)], &this).is_ok());
        let refused = check_alike(&[set(Some(2000.0)), set(Some(4000.0))], &this).unwrap_err().chain();
        assert!(refused.contains("30 degrees") && refused.contains("4000 us"), "{refused}");
    }
}
