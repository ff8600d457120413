//! The service itself: health, status, devices, configuration, metrics, set-up.

use std::collections::BTreeMap;

use axum::{
    Json,
    extract::State as Shared,
    http::{StatusCode, header},
    response::{IntoResponse, Response},
};
use polscan_drivers::camera::Listing;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use utoipa::ToSchema;

use super::{
    App,
    extract::Body,
    problem::{Kind, Problem, ProblemBody},
};
use crate::{
    app,
    engine::Shown,
    scanner::{Obstacle, RigState, Snapshot, StorageStatus},
};

/// Whether the service can scan.
#[derive(Debug, Serialize, ToSchema)]
pub struct Readiness {
    /// Whether a scan would be accepted on an idle rig.
    ready: bool,
    /// Why not.
    reasons: Vec<Obstacle>,
}

impl Readiness {
    fn of(snapshot: &Snapshot) -> Self {
        let mut reasons = snapshot.obstacles.clone();
        if snapshot.rig.state == RigState::Connecting {
            reasons.push(Obstacle::new("rig", "the rig is being opened; scans are accepted and wait for it"));
        }
        Self { ready: reasons.is_empty(), reasons }
    }
}

/// Whether the process is alive
#[utoipa::path(get, path = "/livez", tag = "service",
    responses((status = 200, description = "It is", body = String, content_type = "text/plain")))]
pub async fn livez() -> &'static str {
    "alive\n"
}

/// Whether the rig can scan now
#[utoipa::path(get, path = "/readyz", tag = "service",
    responses((status = 200, description = "It can", body = Readiness), (status = 503, description = "It cannot, and why", body = Readiness)))]
pub async fn readyz(Shared(app): Shared<App>) -> Response {
    let readiness = Readiness::of(&app.scanner.snapshot());
    let status = if readiness.ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(readiness)).into_response()
}

/// Metrics for Prometheus
#[utoipa::path(get, path = "/metrics", tag = "service",
    responses((status = 200, description = "OpenMetrics text", body = String,
        content_type = "application/openmetrics-text")))]
pub async fn metrics(Shared(app): Shared<App>) -> Response {
    let kind = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    ([(header::CONTENT_TYPE, kind)], app.scanner.metrics.text()).into_response()
}

/// Everything about the service at one moment.
#[derive(Debug, Serialize, ToSchema)]
pub struct Status {
    /// Number of the latest event; it only grows.
    revision: u64,
    /// Whether a scan would be accepted on an idle rig.
    ready: bool,
    /// Why not.
    reasons: Vec<Obstacle>,
    /// `idle`, `scanning`, `calibrating`, `stopping` or `fault`.
    state: &'static str,
    /// The scan that has the rig.
    capturing: Option<String>,
    /// The calibration that has the rig.
    calibrating: Option<String>,
    /// Scans that are decoded or wait for it.
    finishing: Vec<String>,
    /// Scans that wait for the rig, in order.
    queue: Vec<String>,
    /// How many of them wait to be released.
    held: usize,
    /// Scans that may wait.
    queue_capacity: usize,
    /// State of the rig.
    rig: RigState,
    /// What is wrong with the rig.
    rig_message: Option<String>,
    /// Camera: driver, model, serial number, size.
    #[schema(value_type = Option<Object>)]
    camera: Option<Value>,
    /// Projector: driver, model, serial number, size, timing.
    #[schema(value_type = Option<Object>)]
    projector: Option<Value>,
    /// What the camera's streams counted since the start, by name.
    camera_stream: BTreeMap<String, u64>,
    /// Picture that the projector holds for set-up.
    showing: Option<String>,
    /// Room for scans.
    storage: StorageStatus,
    /// Version of the program.
    version: &'static str,
    /// Versions of the libraries that drive devices, by name.
    libraries: BTreeMap<&'static str, String>,
    /// Seconds since the start.
    uptime_s: f64,
}

/// Status of the service
#[utoipa::path(get, path = "/v1/status", tag = "service", responses((status = 200, description = "Status", body = Status)))]
pub async fn get_status(Shared(app): Shared<App>) -> Json<Status> {
    let snapshot = app.scanner.snapshot();
    let readiness = Readiness::of(&snapshot);
    let state = match snapshot.rig.state {
        _ if snapshot.stopping => "stopping",
        RigState::Fault => "fault",
        _ if snapshot.calibrating.is_some() => "calibrating",
        _ if snapshot.capturing.is_some() || !snapshot.finishing.is_empty() => "scanning",
        _ => "idle",
    };
    let held =
        snapshot.queue.iter().filter(|id| snapshot.scans.get(*id).is_some_and(|scan| scan.held)).count();
    Json(Status {
        revision: snapshot.revision,
        ready: readiness.ready,
        reasons: readiness.reasons,
        state,
        capturing: snapshot.capturing.clone(),
        calibrating: snapshot.calibrating.clone(),
        finishing: snapshot.finishing.clone(),
        queue: snapshot.queue.clone(),
        held,
        queue_capacity: app.settings.raw.scan.queue_capacity,
        rig: snapshot.rig.state,
        rig_message: snapshot.rig.message.clone(),
        camera: snapshot.rig.camera.as_ref().map(|camera| json!(camera)),
        projector: snapshot.rig.projector.as_ref().map(|projector| json!(projector)),
        camera_stream: app.scanner.metrics.stream_totals(),
        showing: snapshot.rig.showing.clone(),
        storage: snapshot.storage,
        version: env!("CARGO_PKG_VERSION"),
        libraries: app::libraries().into_iter().collect(),
        uptime_s: app.started.elapsed().as_secs_f64(),
    })
}

/// A camera or projector.
#[derive(Debug, Serialize, ToSchema)]
pub struct Device {
    /// Driver that found it.
    driver: String,
    /// Maker and model.
    model: String,
    /// Serial number.
    serial: String,
    /// Why it cannot be used; `null` where it can.
    unusable: Option<String>,
    /// Whether it is part of the rig that is open.
    in_use: bool,
}

/// Cameras and projectors.
#[derive(Debug, Serialize, ToSchema)]
pub struct Devices {
    cameras: Vec<Device>,
    projectors: Vec<Device>,
}

/// Cameras and projectors that are found
#[utoipa::path(get, path = "/v1/devices", tag = "service",
    responses((status = 200, description = "Devices", body = Devices),
        (status = 503, description = "They cannot be listed", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_devices(Shared(app): Shared<App>) -> Result<Json<Devices>, Problem> {
    let snapshot = app.scanner.snapshot();
    let used: Vec<String> = [
        snapshot.rig.camera.as_ref().map(|camera| camera.serial.clone()),
        snapshot.rig.projector.as_ref().map(|projector| projector.serial.clone()),
    ]
    .into_iter()
    .flatten()
    .collect();
    let settings = app.settings.clone();
    let computed = !app::is_real(&settings);
    let look = async || {
        app.blocking(move || app::list(&settings))
            .await?
            .map_err(|error| Kind::NotReady.with(error.to_string()))
    };
    // What a simulated rig consists of does not change, and finding out takes as long as building one.
    let (cameras, projectors) = match computed {
        true => app.devices.get_or_try_init(look).await?.clone(),
        false => look().await?,
    };
    let device = |listing: &Listing| Device {
        driver: listing.driver.clone(),
        model: listing.model.clone(),
        serial: listing.serial.clone(),
        unusable: listing.unusable.clone(),
        in_use: used.contains(&listing.serial),
    };
    Ok(Json(Devices {
        cameras: cameras.iter().map(device).collect(),
        projectors: projectors.iter().map(device).collect(),
    }))
}

/// The configuration in force
///
/// Every key with its value, as `config/default.toml` documents them.
#[utoipa::path(get, path = "/v1/config", tag = "service", responses((status = 200, description = "Configuration", body = Object)))]
pub async fn get_config(Shared(app): Shared<App>) -> Json<Value> {
    Json(json!(app.settings.raw))
}

/// A picture to hold.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Projection {
    /// `white`, `h`, `v`, `black`, `focus`, `crosshair`, `checker`, or a pattern such as `column-0` or `column-0-inverse`.
    #[schema(pattern = "^(white|h|v|black|focus|crosshair|checker|(column|row)-[0-9]+(-inverse)?)$")]
    show: String,
}

/// Hold one picture for set-up
#[utoipa::path(put, path = "/v1/projector", tag = "service", request_body = Projection,
    responses((status = 200, description = "It is shown", body = Projection),
        (status = 409, description = "A scan has the rig", body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "No such picture", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "There is no projector", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn put_projector(
    Shared(app): Shared<App>,
    Body(asked): Body<Projection>,
) -> Result<Json<Projection>, Problem> {
    let shown: Shown = asked.show.parse().map_err(|error: String| {
        Kind::Invalid
            .with(format!("show: {error}"))
            .and("errors", json!([{ "key": "show", "message": error }]))
    })?;
    app.scanner.show(shown, &asked.show).await?;
    Ok(Json(asked))
}
