//! Calibrations: starting and stopping them, what came of them, and their files.

use std::{collections::BTreeSet, sync::Arc, time::Duration};

use axum::{
    Json,
    extract::{Path as Part, State as Shared, rejection::PathRejection},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use utoipa::ToSchema;

use super::{
    App,
    artifacts::serve_file,
    extract::MaybeBody,
    problem::{Kind, Problem, ProblemBody},
    scans::{Empty, invalid},
};
use crate::{
    calibrate::{Task, polarization},
    geometry::{Calibration, ReadHints},
    report::NamedRegion,
    scanner::{CalibrationAsk, CalibrationRecord, CalibrationState, is_id},
    store::{calibrations::Calibrations as Store, library::chain, source::read_calibration},
};

const WATCH_S: std::ops::RangeInclusive<f64> = 1.0..=3600.0;
const ANGLE_DEG: std::ops::RangeInclusive<f64> = -360.0..=360.0;
const MOST_WITH: usize = 32;

/// A calibration file in use.
#[derive(Debug, Serialize, ToSchema)]
pub struct CalibrationInUse {
    /// SHA-256 of its canonical form; bundles name it.
    id: String,
    /// File.
    file: String,
    /// What is calibrated.
    kind: &'static str,
    /// What it says of its own quality.
    #[schema(value_type = Object)]
    quality: Value,
}

/// A file of a calibration.
#[derive(Debug, Serialize, ToSchema)]
pub struct CalibrationFile {
    /// Name.
    name: String,
    /// Address.
    href: String,
}

/// A calibration that this service made, or is making.
#[derive(Debug, Serialize, ToSchema)]
pub struct CalibrationRun {
    #[serde(flatten)]
    record: CalibrationRecord,
    /// Address.
    href: String,
    /// Its files; empty before its end.
    artifacts: Vec<CalibrationFile>,
}

impl CalibrationRun {
    pub(super) fn new(record: &CalibrationRecord) -> Self {
        let href = format!("/v1/calibrations/{}", record.id);
        let file = |name: &String| CalibrationFile { name: name.clone(), href: format!("{href}/{name}") };
        let artifacts = record.files.iter().map(file).collect();
        Self { record: record.clone(), artifacts, href }
    }

    pub(super) fn accepted(&self) -> Response {
        let mut response = (StatusCode::ACCEPTED, Json(self)).into_response();
        if let Ok(location) = HeaderValue::from_str(&self.href) {
            response.headers_mut().insert(header::LOCATION, location);
        }
        response
    }
}

/// Calibrations.
#[derive(Debug, Serialize, ToSchema)]
pub struct Calibrations {
    /// The file that scans use.
    calibrations: Vec<CalibrationInUse>,
    /// Why the file that scans use cannot be read.
    fault: Option<String>,
    /// What this service calibrated, the newest first.
    runs: Vec<CalibrationRun>,
}

/// Calibrations
///
/// The file that scans use, and all calibrations that this service made, the newest first.
#[utoipa::path(get, path = "/v1/calibrations", tag = "calibrations",
    responses((status = 200, description = "Calibrations", body = Calibrations)))]
pub async fn get_calibrations(Shared(app): Shared<App>) -> Result<Json<Calibrations>, Problem> {
    let snapshot = app.scanner.snapshot();
    // Identities sort by time.
    let runs = snapshot.calibrations.values().rev().map(|record| CalibrationRun::new(record)).collect();
    let Some(rig) = app.settings.calibration.clone() else {
        return Ok(Json(Calibrations { calibrations: Vec::new(), fault: None, runs }));
    };
    let hints = ReadHints {
        camera_size: snapshot.rig.camera.as_ref().map(|camera| (camera.sensor_width, camera.sensor_height)),
        projector_size: snapshot.rig.projector.as_ref().map(|projector| (projector.width, projector.height)),
        swap: rig.projector_left,
        unit_mm: rig.unit_mm,
    };
    let path = rig.path.clone();
    let read = app.blocking(move || read_calibration(&path, &hints)).await?;
    let calibration: Calibration = match read {
        Ok(calibration) => calibration,
        // What was measured is there all the same.
        Err(error) => {
            let fault = Some(chain(&error));
            return Ok(Json(Calibrations { calibrations: Vec::new(), fault, runs }));
        }
    };
    let in_use = CalibrationInUse {
        id: calibration.id(),
        file: rig.path.display().to_string(),
        kind: "rig",
        quality: json!(crate::report::CalibrationReport::new(None, &calibration.quality)),
    };
    Ok(Json(Calibrations { calibrations: vec![in_use], fault: None, runs }))
}

async fn begin(app: &App, task: Task, with: Vec<String>) -> Result<Response, Problem> {
    let record = app.scanner.calibrate(CalibrationAsk { task, with }).await?;
    Ok(CalibrationRun::new(&record).accepted())
}

/// Measure the noise of the camera
///
/// By photon transfer, of a plate or card before the rig. It has the rig until its end: `GET` its address, or follow
/// the events `calibration`.
#[utoipa::path(post, path = "/v1/calibrations/noise", tag = "calibrations",
    responses((status = 202, description = "Begun", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 409, description = "Something else has the rig", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The rig cannot measure", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_noise(
    Shared(app): Shared<App>,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Response, Problem> {
    begin(&app, Task::Noise, Vec::new()).await
}

/// Measure the timing of the projector
///
/// Latency, rise and fall and the ripple of the lamp, by flashes on a plate or card before the rig. It has the rig until
/// its end.
#[utoipa::path(post, path = "/v1/calibrations/sync", tag = "calibrations",
    responses((status = 202, description = "Begun", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 409, description = "Something else has the rig", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The rig cannot measure", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_sync(
    Shared(app): Shared<App>,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Response, Problem> {
    begin(&app, Task::Sync, Vec::new()).await
}

/// Identity of a calibration.
#[derive(ToSchema)]
#[schema(pattern = "^[a-z0-9][a-z0-9-]{0,63}$")]
#[expect(dead_code, reason = "only its schema is used")]
pub struct CalibrationId(String);

/// What a polarization is measured with. Everything may be left out.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PolarizationRequest {
    /// What the polarizer's mount reads now, in degrees counter-clockwise as the camera sees it; 0 is where H should pass.
    #[schema(minimum = -360.0, maximum = 360.0)]
    pub angle_deg: Option<f64>,
    /// Calibrations of polarization at other angles. Three angles in all make a calibration.
    #[schema(max_items = 32, value_type = Vec<CalibrationId>)]
    pub with: Vec<String>,
    #[schema(pattern = "^[^=]*[^= ]=[0-9]{1,4},[0-9]{1,4},[1-9][0-9]{1,3},[1-9][0-9]{1,3}$")]
    /// Bare metal in the camera's image, `NAME=X,Y,W,H` in pixels; what is evenly lit where it is left out.
    pub coupon: Option<String>,
    #[schema(pattern = "^[^=]*[^= ]=[0-9]{1,4},[0-9]{1,4},[1-9][0-9]{1,3},[1-9][0-9]{1,3}$")]
    /// A white card in the camera's image, `NAME=X,Y,W,H`, to find the drive levels at which it returns H and V alike.
    pub card: Option<String>,
    /// Only watch H and V for so many seconds while somebody turns the polarizer; values come as events
    /// `calibration-value`. `POST .../cancel` ends it sooner.
    #[schema(minimum = 1.0, maximum = 3600.0)]
    pub watch_s: Option<f64>,
}

fn region(key: &str, text: Option<&str>) -> Result<Option<NamedRegion>, Problem> {
    text.map(|text| text.parse().map_err(|error| invalid(key, format!("{error}")))).transpose()
}

/// What earlier calibrations measured at their angles.
async fn earlier(app: &App, with: &[String]) -> Result<Vec<crate::measure::polarization::Set>, Problem> {
    let distinct: BTreeSet<&String> = with.iter().collect();
    if with.len() > MOST_WITH || distinct.len() != with.len() {
        return Err(invalid("with", format!("at most {MOST_WITH} calibrations, each once")));
    }
    let snapshot = app.scanner.snapshot();
    let store = Store::of(app.scanner.folder());
    let mut folders = Vec::new();
    for id in with {
        let found = snapshot.calibrations.get(id).filter(|one| !one.files.is_empty());
        if found.is_none() {
            return Err(invalid("with", format!("`{id}` is no calibration with a result")));
        }
        folders.push(store.files(id));
    }
    let read = move || folders.iter().map(|folder| polarization::read_set(folder)).collect::<Result<_, _>>();
    app.blocking(read).await?.map_err(|error: crate::engine::Failure| invalid("with", error.chain()))
}

/// Measure polarization, or watch it
///
/// At the angle at which the polarizer stands, on bare metal; with the results of two other angles or more it makes a
/// calibration. With `watch_s` it only tells H and V while somebody turns the polarizer.
#[utoipa::path(post, path = "/v1/calibrations/polarization", tag = "calibrations", request_body = PolarizationRequest,
    responses((status = 202, description = "Begun", body = CalibrationRun,
            headers(("Location" = String, description = "Address of the calibration"))),
        (status = 409, description = "Something else has the rig", body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "Asks for something that cannot be", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The rig cannot measure", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_polarization(
    Shared(app): Shared<App>,
    MaybeBody(asked): MaybeBody<PolarizationRequest>,
) -> Result<Response, Problem> {
    let angle_deg = asked.angle_deg.unwrap_or(0.0);
    if !ANGLE_DEG.contains(&angle_deg) {
        return Err(invalid("angle_deg", "-360 to 360"));
    }
    let coupon = region("coupon", asked.coupon.as_deref())?;
    let card = region("card", asked.card.as_deref())?;
    if let Some(seconds) = asked.watch_s {
        if !WATCH_S.contains(&seconds) {
            return Err(invalid("watch_s", "1 to 3600"));
        }
        return begin(&app, Task::Watch { coupon, limit: Duration::from_secs_f64(seconds) }, Vec::new())
            .await;
    }
    let earlier = earlier(&app, &asked.with).await?;
    let task = polarization::Task { angle_deg, earlier, coupon, card };
    begin(&app, Task::Polarization(task), asked.with).await
}

pub(super) fn unknown() -> Problem {
    Kind::UnknownCalibration.with("no calibration has this identity; GET /v1/calibrations lists them")
}

fn find(app: &App, id: &str) -> Result<Arc<CalibrationRecord>, Problem> {
    app.scanner.snapshot().calibrations.get(id).cloned().ok_or_else(unknown)
}

pub(super) type OnePart = Result<Part<String>, PathRejection>;

/// One calibration
#[utoipa::path(get, path = "/v1/calibrations/{id}", tag = "calibrations", params(("id" = String, Path)),
    responses((status = 200, description = "The calibration", body = CalibrationRun),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_calibration(Shared(app): Shared<App>, id: OnePart) -> Result<Json<CalibrationRun>, Problem> {
    let Part(id) = id.map_err(|_| unknown())?;
    find(&app, &id).map(|record| Json(CalibrationRun::new(&record)))
}

/// Something else that cannot be calibrated
///
/// Calibrations are started at the addresses of their kinds.
#[utoipa::path(post, path = "/v1/calibrations/{id}", tag = "calibrations", params(("id" = String, Path)),
    responses((status = 404, description = "Unknown kind", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_unknown(MaybeBody(Empty {}): MaybeBody<Empty>) -> Problem {
    Kind::NotFound.with("calibrations are rig, sync, noise and polarization")
}

/// Stop a calibration
///
/// It ends as `cancelled` and leaves the rig to others; a watch ends as `done`; a session with a board is closed.
#[utoipa::path(post, path = "/v1/calibrations/{id}/cancel", tag = "calibrations", params(("id" = String, Path)),
    responses((status = 202, description = "It will stop", body = CalibrationRun),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "It has come to its end", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn cancel_calibration(
    Shared(app): Shared<App>,
    id: OnePart,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Response, Problem> {
    let Part(id) = id.map_err(|_| unknown())?;
    let record = app.scanner.cancel_calibration(&id).await?;
    Ok((StatusCode::ACCEPTED, Json(CalibrationRun::new(&record))).into_response())
}

/// Delete a calibration
///
/// With its files and, of a rig, with all its views. One that is not at its end has to be cancelled first.
#[utoipa::path(delete, path = "/v1/calibrations/{id}", tag = "calibrations", params(("id" = String, Path)),
    responses((status = 204, description = "Gone"),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "It is not at its end", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The disk says no", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn delete_calibration(Shared(app): Shared<App>, id: OnePart) -> Result<StatusCode, Problem> {
    let Part(id) = id.map_err(|_| unknown())?;
    app.scanner.delete_calibration(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// A file of a calibration
///
/// `calibration.toml`, `opencv.yaml`, `report.json`, `noise.toml`, `sync.toml`, `polarization.toml`, plots, and whatever else its `artifacts` list.
#[utoipa::path(get, path = "/v1/calibrations/{id}/{name}", tag = "calibrations",
    params(("id" = String, Path), ("name" = String, Path, description = "Name of the file")),
    responses(
        (status = 200, description = "The file", content(
            ([u8] = "application/octet-stream"), (Object = "application/json"), (String = "application/toml"),
            (String = "image/svg+xml"))),
        (status = 304, description = "The client has it"),
        (status = 404, description = "Unknown calibration, or it has no such file", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_calibration_file(
    Shared(app): Shared<App>,
    parts: Result<Part<(String, String)>, PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Part((id, name)) = parts.map_err(|_| unknown())?;
    if !is_id(&id) {
        return Err(unknown());
    }
    let record = find(&app, &id)?;
    if record.state == CalibrationState::Running {
        return Err(Kind::NotFinished.with("the calibration is running; ask again when it has ended"));
    }
    // Only names that the record lists lead to a file.
    if !record.files.contains(&name) {
        return Err(Kind::NoArtifact.with("the calibration's `artifacts` list its files"));
    }
    let path = Store::of(app.scanner.folder()).files(&id).join(&name);
    Ok(serve_file(&path, &name, &headers).await)
}
