//! Scans: asking for them, looking at them, stopping, changing and deleting them.

use std::{sync::Arc, time::Duration};

use axum::{
    Json,
    extract::State as Shared,
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use polscan_patterns::Mode;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use utoipa::ToSchema;

use super::{
    App,
    artifacts::artifacts,
    extract::{Body, Id, MaybeBody, Params},
    problem::{Kind, Problem, ProblemBody},
    wire::{ListParams, Page, ReprocessRequest, Scan, ScanPatch, ScanRequest, Wait, WaitParams},
};
use crate::{
    scanner::{Change, MOST_REPEATS, Record, State, Submit},
    store::{index::Filter, source::hex},
};

const LONGEST_LABEL: usize = 200;
const MOST_TAGS: usize = 32;
const LONGEST_TAG: usize = 64;
const LONGEST_KEY: usize = 255;
const PAGE_SCANS: usize = 50;
const LARGEST_PAGE: usize = 500;
const EXPOSURE_US: std::ops::RangeInclusive<f64> = 1.0..=30e6;

fn accepted(scan: &Scan) -> Response {
    let location = HeaderValue::from_str(&scan.href);
    let mut response = (StatusCode::ACCEPTED, Json(scan)).into_response();
    if let Ok(location) = location {
        response.headers_mut().insert(header::LOCATION, location);
    }
    response
}

/// A problem with the value of a key.
pub(super) fn invalid(key: &str, message: impl Into<String>) -> Problem {
    let message = message.into();
    let errors = serde_json::json!([{ "key": key, "message": message }]);
    Kind::Invalid.with(format!("{key}: {message}")).and("errors", errors)
}

fn mode(text: Option<&str>) -> Result<Option<Mode>, Problem> {
    let modes = [Mode::Pse, Mode::Fast, Mode::Paper, Mode::Gray].map(Mode::name).join(", ");
    let parse =
        |text: &str| text.parse().map_err(|_| invalid("mode", format!("`{text}` is none of {modes}")));
    text.map(parse).transpose()
}

fn check_names(label: Option<&str>, tags: &[String]) -> Result<(), Problem> {
    let odd = |text: &str| text.chars().any(char::is_control);
    if label.is_some_and(|label| label.chars().count() > LONGEST_LABEL || odd(label)) {
        return Err(invalid(
            "label",
            format!("at most {LONGEST_LABEL} characters, none of them a control character"),
        ));
    }
    let wrong = |tag: &String| tag.is_empty() || tag.chars().count() > LONGEST_TAG || odd(tag);
    if tags.len() > MOST_TAGS || tags.iter().any(wrong) {
        return Err(invalid(
            "tags",
            format!("at most {MOST_TAGS} tags of 1 to {LONGEST_TAG} characters each"),
        ));
    }
    Ok(())
}

/// The key of a request and the digest of what it asks for. A key may be quoted or not.
fn key(
    headers: &HeaderMap,
    asked: &impl Serialize,
    about: &str,
) -> Result<Option<(String, String)>, Problem> {
    let Some(value) = headers.get("idempotency-key") else { return Ok(None) };
    let text = value.to_str().unwrap_or_default().trim();
    let key = text.strip_prefix('"').and_then(|text| text.strip_suffix('"')).unwrap_or(text);
    if key.is_empty() || key.len() > LONGEST_KEY {
        return Err(invalid("Idempotency-Key", format!("1 to {LONGEST_KEY} printable ASCII characters")));
    }
    let body = serde_json::to_vec(asked).map_err(|error| Kind::Internal.with(error.to_string()))?;
    let mut digest = Sha256::new();
    digest.update(about.as_bytes());
    digest.update([0]);
    digest.update(&body);
    Ok(Some((key.to_owned(), hex(&digest.finalize()))))
}

/// Ask for a scan
///
/// Answers at once, or with `wait` when the frames are taken or the scan is done. The same `Idempotency-Key` with the
/// same body gets the same answer and starts nothing, over restarts as well.
#[utoipa::path(
    post, path = "/v1/scans", tag = "scans", params(WaitParams,
        ("Idempotency-Key" = Option<String>, Header, description = "Key of the request, such as a UUID; may be quoted",
            pattern = r#"^"?[!#-~]([ -~]{0,252}[!#-~])?"?$"#)),
    request_body = ScanRequest,
    responses(
        (status = 202, description = "Accepted", body = Scan,
            headers(("Location" = String, description = "Address of the (first) scan"))),
        (status = 400, description = "No JSON", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Another scan has the rig", body = ProblemBody, content_type = "application/problem+json"),
        (status = 413, description = "Too long", body = ProblemBody, content_type = "application/problem+json"),
        (status = 415, description = "Not application/json", body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "Asks for something that cannot be, or a key that was used", body = ProblemBody, content_type = "application/problem+json"),
        (status = 429, description = "Queue full", body = ProblemBody, content_type = "application/problem+json"),
        (status = 503, description = "The rig cannot scan", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn post_scan(
    Shared(app): Shared<App>,
    Params(params): Params<WaitParams>,
    headers: HeaderMap,
    Body(asked): Body<ScanRequest>,
) -> Result<Response, Problem> {
    check_names(asked.label.as_deref(), &asked.tags)?;
    let repeat = asked.repeat.unwrap_or(1);
    if !(1..=MOST_REPEATS).contains(&repeat) {
        return Err(invalid("repeat", format!("1 to {MOST_REPEATS}")));
    }
    if let Some(exposure) = asked.exposure_us.filter(|exposure| !EXPOSURE_US.contains(exposure)) {
        return Err(invalid("exposure_us", format!("{exposure} is outside 1 to 30 000 000")));
    }
    let submit = Submit {
        mode: mode(asked.mode.as_deref())?,
        exposure_us: asked.exposure_us,
        label: asked.label.clone(),
        tags: asked.tags.clone(),
        repeat,
        queue: asked.queue,
        source: None,
        key: key(&headers, &asked, "scan")?,
    };
    submit_and_wait(&app, submit, &params).await
}

async fn submit_and_wait(app: &App, submit: Submit, params: &WaitParams) -> Result<Response, Problem> {
    let _place = params.wait.map(|_| app.stream_place()).transpose()?;
    let (records, _) = app.scanner.submit(submit).await?;
    let mut latest = Vec::new();
    for record in &records {
        latest.push(await_state(app, record, params.wait).await?);
    }
    let Some(first) = latest.first() else { return Err(Kind::Internal.with("a request without a scan")) };
    let mut scan = with_artifacts(app, first).await?;
    if records.len() > 1 {
        scan.scans = records.iter().map(|record| record.id.clone()).collect();
    }
    Ok(accepted(&scan))
}

/// The scan once it has got as far as `wait`, or the time is up.
async fn await_state(app: &App, record: &Arc<Record>, wait: Option<Wait>) -> Result<Arc<Record>, Problem> {
    let reached = |record: &Record| match wait {
        None => true,
        Some(Wait::Acquired) => record.state.is_acquired(),
        Some(Wait::Done) => record.state.is_terminal(),
    };
    if reached(record) {
        return Ok(record.clone());
    }
    let mut snapshots = app.scanner.watch();
    let mut stopping = app.stopping.clone();
    let id = record.id.clone();
    let wanted = snapshots.wait_for(|snapshot| snapshot.scans.get(&id).is_none_or(|record| reached(record)));
    let found = tokio::select! {
        found = wanted => found.ok().and_then(|snapshot| snapshot.scans.get(&id).cloned()),
        () = tokio::time::sleep(app.wait_limit) => app.scanner.snapshot().scans.get(&id).cloned(),
        _ = stopping.wait_for(|stopping| *stopping) => app.scanner.snapshot().scans.get(&id).cloned(),
    };
    match found {
        Some(record) => Ok(record),
        None => find(app, &id).await,
    }
}

/// A scan, running or not.
pub async fn find(app: &App, id: &str) -> Result<Arc<Record>, Problem> {
    if let Some(record) = app.scanner.snapshot().scans.get(id) {
        return Ok(record.clone());
    }
    let wanted = id.to_owned();
    let found = app.read(move |index| index.get(&wanted)).await?;
    found
        .map(Arc::new)
        .ok_or_else(|| Kind::UnknownScan.with("no scan has this identity; GET /v1/scans lists them"))
}

async fn with_artifacts(app: &App, record: &Record) -> Result<Scan, Problem> {
    Ok(Scan { artifacts: artifacts(app, record).await?, ..Scan::new(record) })
}

/// One scan
#[utoipa::path(
    get, path = "/v1/scans/{id}", tag = "scans", params(("id" = String, Path), WaitParams),
    responses(
        (status = 200, description = "The scan", body = Scan),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_scan(
    Shared(app): Shared<App>,
    Id(id): Id,
    Params(params): Params<WaitParams>,
) -> Result<Json<Scan>, Problem> {
    let _place = params.wait.map(|_| app.stream_place()).transpose()?;
    let record = find(&app, &id).await?;
    let record = await_state(&app, &record, params.wait).await?;
    with_artifacts(&app, &record).await.map(Json)
}

fn filter(params: ListParams) -> Result<Filter, Problem> {
    let words = |text: Option<String>| -> Vec<String> {
        text.iter()
            .flat_map(|text| text.split(','))
            .filter(|word| !word.is_empty())
            .map(str::to_owned)
            .collect()
    };
    let state = |name: String| {
        State::from_name(&name).ok_or_else(|| invalid("state", format!("`{name}` is no state")))
    };
    let before = |cursor: String| {
        let (created, id) = cursor.split_once('~')?;
        Some((created.to_owned(), id.to_owned()))
    };
    let cursor =
        params.cursor.map(|cursor| before(cursor).ok_or_else(|| invalid("cursor", "use `next` of a page")));
    Ok(Filter {
        states: words(params.state).into_iter().map(state).collect::<Result<_, _>>()?,
        verdict: params.verdict,
        mode: params.mode,
        label: params.label,
        tags: words(params.tag),
        pinned: params.pinned,
        since: params.since,
        until: params.until,
        before: cursor.transpose()?,
    })
}

/// List scans
#[utoipa::path(
    get, path = "/v1/scans", tag = "scans", params(ListParams),
    responses(
        (status = 200, description = "A page", body = Page),
        (status = 422, description = "Unknown filter", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn list_scans(
    Shared(app): Shared<App>,
    Params(params): Params<ListParams>,
) -> Result<Json<Page>, Problem> {
    let limit = params.limit.unwrap_or(PAGE_SCANS);
    if !(1..=LARGEST_PAGE).contains(&limit) {
        return Err(invalid("limit", format!("1 to {LARGEST_PAGE}")));
    }
    let filter = filter(params)?;
    let mut records = app.read(move |index| index.list(&filter, limit + 1)).await?;
    let more = records.len() > limit;
    records.truncate(limit);
    let last = records.last().filter(|_| more);
    let next = last.map(|record| format!("{}~{}", record.created, record.id));
    // What runs is further than the index knows.
    let snapshot = app.scanner.snapshot();
    let scans = records
        .iter()
        .map(|record| Scan::new(snapshot.scans.get(&record.id).map_or(record, |live| live.as_ref())))
        .collect();
    Ok(Json(Page { scans, next }))
}

/// Stop a scan
///
/// The projector goes black within a frame; frames that were taken are kept. Later scans of the same request do not
/// begin. A scan that is cancelled already is answered as it is.
#[utoipa::path(
    post, path = "/v1/scans/{id}/cancel", tag = "scans", params(("id" = String, Path)),
    responses(
        (status = 202, description = "It will be, or is, cancelled", body = Scan),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "It is at its end", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn cancel_scan(
    Shared(app): Shared<App>,
    Id(id): Id,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Response, Problem> {
    let record = app.scanner.cancel(&id).await?;
    Ok(accepted(&Scan::new(&record)))
}

/// An object without members.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Empty {}

/// Decode a scan again
///
/// Makes a scan of its own from the recorded frames, without the rig. The source cannot be deleted before it.
#[utoipa::path(
    post, path = "/v1/scans/{id}/reprocess", tag = "scans", params(("id" = String, Path), WaitParams,
        ("Idempotency-Key" = Option<String>, Header, description = "Key of the request, such as a UUID; may be quoted",
            pattern = r#"^"?[!#-~]([ -~]{0,252}[!#-~])?"?$"#)),
    request_body = Option<ReprocessRequest>,
    responses(
        (status = 202, description = "Accepted", body = Scan, headers(("Location" = String, description = "Address of the new scan"))),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "It has no frames yet, or none at all", body = ProblemBody, content_type = "application/problem+json"),
        (status = 429, description = "Queue full", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn reprocess_scan(
    Shared(app): Shared<App>,
    Id(id): Id,
    Params(params): Params<WaitParams>,
    headers: HeaderMap,
    MaybeBody(asked): MaybeBody<ReprocessRequest>,
) -> Result<Response, Problem> {
    check_names(asked.label.as_deref(), &asked.tags)?;
    let submit = Submit {
        mode: mode(asked.mode.as_deref())?,
        exposure_us: None,
        label: asked.label.clone(),
        tags: asked.tags.clone(),
        repeat: 1,
        queue: true,
        key: key(&headers, &asked, &id)?,
        source: Some(id),
    };
    submit_and_wait(&app, submit, &params).await
}

/// Change label, tags or pin
#[utoipa::path(
    patch, path = "/v1/scans/{id}", tag = "scans", params(("id" = String, Path)), request_body = ScanPatch,
    responses(
        (status = 200, description = "As it is now", body = Scan),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 422, description = "Too long", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn patch_scan(
    Shared(app): Shared<App>,
    Id(id): Id,
    Body(patch): Body<ScanPatch>,
) -> Result<Json<Scan>, Problem> {
    check_names(patch.label.as_ref().and_then(Option::as_deref), patch.tags.as_deref().unwrap_or_default())?;
    let change = Change { label: patch.label, tags: patch.tags, pinned: patch.pinned };
    let record = app.scanner.change(&id, change).await?;
    with_artifacts(&app, &record).await.map(Json)
}

/// Delete a scan and its files
#[utoipa::path(
    delete, path = "/v1/scans/{id}", tag = "scans", params(("id" = String, Path)),
    responses(
        (status = 204, description = "It is gone"),
        (status = 404, description = "Unknown", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "It runs, is pinned, or another scan was decoded from it", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn delete_scan(Shared(app): Shared<App>, Id(id): Id) -> Result<StatusCode, Problem> {
    app.scanner.delete(&id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// How many queued scans were concerned.
#[derive(Debug, Serialize, ToSchema)]
pub struct Held {
    /// Number of scans.
    scans: usize,
}

/// Release queued scans
///
/// Scans that were queued when the service ended, or when the rig failed, wait for this.
#[utoipa::path(
    post, path = "/v1/queue/resume", tag = "scans",
    responses((status = 200, description = "They will run", body = Held)))]
pub async fn resume_queue(
    Shared(app): Shared<App>,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Json<Held>, Problem> {
    Ok(Json(Held { scans: app.scanner.hold(false).await? }))
}

/// Hold queued scans back
#[utoipa::path(
    post, path = "/v1/queue/pause", tag = "scans",
    responses((status = 200, description = "They wait", body = Held)))]
pub async fn pause_queue(
    Shared(app): Shared<App>,
    MaybeBody(Empty {}): MaybeBody<Empty>,
) -> Result<Json<Held>, Problem> {
    Ok(Json(Held { scans: app.scanner.hold(true).await? }))
}

/// Longest wait that a configuration can ask for.
pub fn wait_limit(seconds: f64) -> Duration {
    Duration::from_secs_f64(seconds.clamp(1.0, 86_400.0))
}
