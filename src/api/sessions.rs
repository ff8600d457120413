//! Calibration of the rig as a session: views of a board, one after the other, then the solution.

use axum::{
    extract::{Path as Part, State as Shared, rejection::PathRejection},
    response::Response,
};
use serde::Deserialize;
use utoipa::ToSchema;

use super::{
    App,
    calibrations::{CalibrationRun, OnePart, unknown},
    extract::{Body, MaybeBody},
    problem::{Problem, ProblemBody},
    scans::{Empty, invalid},
};
use crate::{
    calibrate::rig::{MOST_VIEWS, Step},
    calibration::{boards::Board, rig::Gates},
    scanner::{SessionAsk, is_id},
};

const BASELINE_MM: std::ops::RangeInclusive<f64> = 0.1..=100_000.0;

/// A session to open.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct RigRequest {
    /// The board, as the file that `polscan calibrate board` writes beside its page describes it, such as
    /// `{"pattern": {"charuco": {"columns": 10, "rows": 7, "square_mm": 12.0, "marker_mm": 9.0, "dictionary": "4x4"}}}`.
    #[schema(value_type = Object)]
    pub board: Board,
    /// Measured length of the board's printed bar in mm; before what the board says of it.
    #[serde(default)]
    pub measured_mm: Option<f64>,
    /// Limits that a calibration must keep, where they are not the usual ones, such as `{"min_views": 8}`.
    #[serde(default)]
    #[schema(value_type = Option<Object>)]
    pub gates: Option<Gates>,
    /// Distance between camera and projector as measured with a ruler, in mm: shows a board of another size.
    #[serde(default)]
    #[schema(minimum = 0.1, maximum = 100_000.0)]
    pub baseline_mm: Option<f64>,
}

/// Calibrate the rig
///
/// Opens a session. Put the board before the rig and `POST .../views`, again and again: `session.missing` says which part of
/// the image and which tilt is still missing, in every answer and event. Then `POST .../solve`. Between the steps the
/// rig is free; the session survives restarts. One is open at a time.
#[utoipa::path(post, path = "/v1/calibrations/rig", tag = "calibrations", request_body = RigRequest,
    responses((status = 202, description = "The session is open", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 400, description = "No JSON", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Another session is open", body = ProblemBody, content_type = "application/problem+json"),
        (status = 413, description = "Too long", body = ProblemBody, content_type = "application/problem+json"),
        (status = 415, description = "Not application/json", body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "No such board can be", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The disk says no", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_rig(Shared(app): Shared<App>, Body(asked): Body<RigRequest>) -> Result<Response, Problem> {
    let RigRequest { mut board, measured_mm, gates, baseline_mm } = asked;
    board.measured_mm = measured_mm.or(board.measured_mm);
    let faults = board.faults();
    if !faults.is_empty() {
        return Err(invalid("board", faults.join("; ")));
    }
    if baseline_mm.is_some_and(|baseline| !BASELINE_MM.contains(&baseline)) {
        return Err(invalid("baseline_mm", "0.1 to 100 000"));
    }
    let gates = gates.unwrap_or_default();
    let faults = gates.faults(MOST_VIEWS);
    if !faults.is_empty() {
        return Err(invalid("gates", faults.join("; ")));
    }
    let ask = SessionAsk { board, gates, baseline_mm };
    let record = app.scanner.open_session(ask).await?;
    Ok(CalibrationRun::new(&record).accepted())
}

async fn go_on(app: &App, id: OnePart, step: Step) -> Result<Response, Problem> {
    let Part(id) = id.map_err(|_| unknown())?;
    let record = app.scanner.session_step(&id, step).await?;
    Ok(CalibrationRun::new(&record).accepted())
}

/// Take a view of the board
///
/// One scan of the board as it stands; the simulated rig moves its board from view to view. The calibration is `running`
/// until the view is looked at, then `open` again, with the view in `session.views` and what is still missing in
/// `session.missing`; `error` says why there is none.
#[utoipa::path(post, path = "/v1/calibrations/{id}/views", tag = "calibrations", params(("id" = String, Path)),
    responses((status = 202, description = "Begun", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Something else has the rig, or it is no open session", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The rig cannot scan", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_view(
    Shared(app): Shared<App>,
    id: OnePart,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Response, Problem> {
    go_on(&app, id, Step::View).await
}

/// Calibrate from the views
///
/// The calibration is `running` until it is solved: then `done` and `accepted`, with `calibration.toml` among its
/// `artifacts`, or `open` again, with the failing checks and the view to drop in `refused`. More views can be taken
/// and it be solved again. It needs no rig: scans go on meanwhile.
#[utoipa::path(post, path = "/v1/calibrations/{id}/solve", tag = "calibrations", params(("id" = String, Path)),
    responses((status = 202, description = "Begun", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "A step is under way, or it is no open session", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The service is ending, or the disk says no", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_solve(
    Shared(app): Shared<App>,
    id: OnePart,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Response, Problem> {
    go_on(&app, id, Step::Solve).await
}

/// Drop a view
///
/// With its frames. It needs no rig.
#[utoipa::path(delete, path = "/v1/calibrations/{id}/views/{name}", tag = "calibrations",
    params(("id" = String, Path), ("name" = String, Path, description = "Name of the view, as `session.views` has it")),
    responses((status = 202, description = "Begun", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 404, description = "Unknown calibration or view", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "A step is under way, or it is no open session", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The service is ending, or the disk says no", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn delete_view(
    Shared(app): Shared<App>,
    parts: Result<Part<(String, String)>, PathRejection>,
) -> Result<Response, Problem> {
    let Part((id, name)) = parts.map_err(|_| unknown())?;
    if !is_id(&id) {
        return Err(unknown());
    }
    go_on(&app, Ok(Part(id)), Step::Drop(name)).await
}
