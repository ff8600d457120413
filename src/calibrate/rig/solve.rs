//! From views to files: what a calibration came to, or why there is none.

use std::time::SystemTime;

use serde_json::{Value, json};

use super::{pictures, views::Views};
use crate::{
    calibrate::{Outcome, Output, Summary},
    calibration::{
        boards::Board,
        rig::{Calibrated, Gates, Refused, Setup, calibrate, guidance},
    },
    engine::Failure,
    geometry::Calibration,
    store::time::rfc3339_utc,
};

/// Schema of the report.
const SCHEMA: &str = "polscan.calibration-report/1";

/// What is calibrated, from what.
pub struct Subject<'a> {
    /// Board.
    pub board: &'a Board,
    /// What was seen of it.
    pub views: &'a Views,
    /// When it is accepted.
    pub gates: Gates,
    /// Distance between camera and projector, where it is known.
    pub baseline_mm: Option<f64>,
}

/// Sizes and limits as the solver takes them.
///
/// # Errors
/// Where no picture was seen at all.
pub fn setup(views: &Views, gates: Gates, baseline_mm: Option<f64>) -> Result<Setup, Failure> {
    let Some(camera) = views.camera else {
        return Err(Failure::data("calibrate", "there is no view; give scans or pictures of the board"));
    };
    let setup = match views.projector {
        Some(projector) => Setup::rig(camera, projector),
        None => Setup::camera(camera),
    };
    Ok(Setup { gates, baseline_mm, ..setup })
}

/// Solves and writes everything.
///
/// # Errors
/// No view, or the disk; a calibration that is refused is an outcome.
pub fn solve(subject: &Subject<'_>, mut output: Output) -> Result<Outcome, Failure> {
    let Subject { board, views, .. } = *subject;
    let setup = setup(views, subject.gates, subject.baseline_mm)?;
    let result = calibrate(&views.views, &setup);
    if let Ok(calibrated) = &result {
        let calibration = dated(calibrated);
        output.add("calibration.toml", calibration.to_toml().as_bytes())?;
        output.add("opencv.yaml", calibration.to_opencv_yaml().as_bytes())?;
        output.png("residuals.png", &pictures::residuals(&views.views, calibrated))?;
    }
    output.png("coverage.png", &pictures::coverage(&views.views, setup.camera.size))?;
    let missing = guidance(&views.views, &setup, None);
    let report = report(subject, &result, &missing.missing, missing.views_missing);
    let mut lines = vec![format!("board: {}", board.summary())];
    lines.extend(self::lines(views, &result));
    let refused: Vec<String> = match &result {
        Ok(_) => Vec::new(),
        Err(refused) => refused.refusals.iter().map(|refusal| refusal.message.clone()).collect(),
    };
    match refused.is_empty() {
        true => lines.push("accepted".into()),
        false => lines.extend(missing.missing.iter().map(|missing| format!("missing: {missing}"))),
    }
    output.finish(report, Summary { lines, refused, ..Summary::default() })
}

fn dated(calibrated: &Calibrated) -> Calibration {
    let mut calibration = calibrated.calibration.clone();
    calibration.quality.date = Some(rfc3339_utc(SystemTime::now()));
    calibration
}

fn report(
    subject: &Subject<'_>,
    result: &Result<Calibrated, Refused>,
    missing: &[String],
    views_missing: usize,
) -> Value {
    let views = subject.views;
    let (solution, refusals) = match result {
        Ok(calibrated) => (Some(&calibrated.report), json!([])),
        Err(refused) => (refused.report.as_deref(), json!(refused.refusals)),
    };
    json!({
        "schema": SCHEMA,
        "kind": if views.projector.is_some() { "rig" } else { "camera" },
        "accepted": result.is_ok(),
        "refusals": refusals,
        "board": subject.board,
        "gates": subject.gates,
        "views": views.seen,
        "unusable": views.unusable,
        "missing": missing,
        "views_missing": views_missing,
        "solution": solution,
    })
}

/// What a person reads.
fn lines(views: &Views, result: &Result<Calibrated, Refused>) -> Vec<String> {
    let mut lines: Vec<String> = views
        .unusable
        .iter()
        .map(|unusable| format!("view {} cannot be used: {}", unusable.name, unusable.reason))
        .collect();
    let report = match result {
        Ok(calibrated) => Some(&calibrated.report),
        Err(refused) => refused.report.as_deref(),
    };
    if let Some(report) = report {
        for view in &report.views {
            let projector = view.projector_rms_px.map(|rms| format!(", projector {rms:.3} px"));
            lines.push(format!(
                "view {}: {} corners, camera {:.3} px{}",
                view.name,
                view.corners,
                view.camera_rms_px,
                projector.unwrap_or_default()
            ));
        }
        let projector = report.projector_rms_px.map(|rms| format!(", projector {rms:.3} px"));
        lines.push(format!(
            "reprojection: camera {:.3} px{}",
            report.camera_rms_px,
            projector.unwrap_or_default()
        ));
    }
    lines
}
