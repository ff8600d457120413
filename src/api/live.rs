//! What goes on while it goes on: events and the preview.

use std::{collections::VecDeque, sync::Arc, time::Duration};

use axum::{
    body::{Body, Bytes},
    extract::State as Shared,
    http::{HeaderMap, HeaderValue, header},
    response::{IntoResponse, Response},
};
use futures_util::stream::unfold;
use serde::Deserialize;
use tokio::{sync::watch, time::timeout};
use utoipa::IntoParams;

use super::{
    App, Place,
    extract::Params,
    problem::{Kind, Problem, ProblemBody},
};
use crate::{scanner::Picture, store::index::Event};

/// How often a silent stream says that it is there.
const HEARTBEAT: Duration = Duration::from_secs(5);

/// Events that are read from the index at once.
const BATCH: usize = 500;

/// Longest wait for a fresh frame.
const FRESH: Duration = Duration::from_millis(1500);

/// Shortest time between two frames of a stream.
const FRAME_PERIOD: Duration = Duration::from_millis(100);

const BOUNDARY: &str = "polscan-frame";

/// Where a stream of events begins.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields, default)]
pub struct EventParams {
    /// Events after this number; the header `Last-Event-ID` comes before it. Without both: from now on.
    after: Option<u64>,
}

struct Follower {
    app: App,
    cursor: u64,
    latest: watch::Receiver<u64>,
    waiting: VecDeque<Arc<Event>>,
    greeted: bool,
    _place: Place,
}

/// Follow events
///
/// Server-sent events. `scan`: a scan changed, with all that is known of it. `progress`: a frame more. `rig`,
/// `projector`, `deleted`. Numbers grow over restarts; `Last-Event-ID` goes on where a client was. `gap` says that
/// events before it are no longer known.
#[utoipa::path(
    get, path = "/v1/events", tag = "live", params(EventParams,
        ("Last-Event-ID" = Option<u64>, Header, description = "Number of the last event that the client has")),
    responses(
        (status = 200, description = "Events", content_type = "text/event-stream", body = String),
        (status = 503, description = "Too many clients", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_events(
    Shared(app): Shared<App>,
    Params(params): Params<EventParams>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let last = match headers.get("last-event-id") {
        None => None,
        Some(value) => {
            let number = value.to_str().ok().and_then(|text| text.trim().parse::<u64>().ok());
            Some(number.ok_or_else(|| Kind::Invalid.with("Last-Event-ID is the number of an event"))?)
        }
    };
    let latest = app.scanner.events.latest();
    let newest = *latest.borrow();
    let cursor = last.or(params.after).unwrap_or(newest).min(newest);
    let place = app.stream_place()?;
    let stopping = app.stopping.clone();
    let follower = Follower { app, cursor, latest, waiting: VecDeque::new(), greeted: false, _place: place };
    let stream = unfold(follower, move |mut follower| {
        let mut stopping = stopping.clone();
        async move {
            let text = tokio::select! {
                text = follower.next() => text,
                _ = stopping.wait_for(|stopping| *stopping) => return None,
            };
            Some((Ok::<_, std::io::Error>(Bytes::from(text)), follower))
        }
    });
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static("text/event-stream")),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-store")),
        (header::HeaderName::from_static("x-accel-buffering"), HeaderValue::from_static("no")),
    ];
    Ok((headers, Body::from_stream(stream)).into_response())
}

impl Follower {
    /// The text of the next events, or a heartbeat.
    async fn next(&mut self) -> String {
        if !std::mem::replace(&mut self.greeted, true) {
            return format!(": polscan {}\nretry: 2000\n\n", env!("CARGO_PKG_VERSION"));
        }
        loop {
            if !self.waiting.is_empty() {
                let text: String = self.waiting.drain(..).map(|event| written(&event)).collect();
                return text;
            }
            self.latest.borrow_and_update();
            let (events, gap) = self.fetch().await;
            if let Some(last) = events.last() {
                self.cursor = last.id;
                self.waiting.extend(events);
                if gap {
                    return "event: gap\ndata: {}\n\n".to_owned();
                }
                continue;
            }
            if timeout(HEARTBEAT, self.latest.changed()).await.is_err() {
                return ": alive\n\n".to_owned();
            }
        }
    }

    /// The events after the cursor, and whether some between are lost.
    async fn fetch(&mut self) -> (Vec<Arc<Event>>, bool) {
        if let Some(events) = self.app.scanner.events.after(self.cursor) {
            return (events, false);
        }
        let cursor = self.cursor;
        let stored = self.app.read(move |index| {
            Ok((index.events_after(cursor, BATCH)?, index.event_range()?.map(|(oldest, _)| oldest)))
        });
        let (events, oldest) = stored.await.unwrap_or_default();
        if events.is_empty() {
            // Nothing in the index, nothing in memory that far back: go on with what memory has.
            self.cursor = self.app.scanner.events.oldest().saturating_sub(1).max(self.cursor);
            let events = self.app.scanner.events.after(self.cursor).unwrap_or_default();
            return (events, true);
        }
        let gap = cursor > 0 && oldest.is_some_and(|oldest| oldest > cursor + 1);
        (events.into_iter().map(Arc::new).collect(), gap)
    }
}

fn written(event: &Event) -> String {
    // JSON of ours has no line breaks.
    format!("id: {}\nevent: {}\ndata: {}\n\n", event.id, event.kind, event.data)
}

fn hints(picture: &Picture) -> [(&'static str, String); 3] {
    [
        ("x-polscan-frame", picture.number.to_string()),
        ("x-polscan-exposure", picture.exposure.name().to_owned()),
        ("x-polscan-saturated-share", format!("{:.5}", picture.saturated_share)),
    ]
}

/// A frame that is new since `seen`, or else the latest there is.
async fn picture(app: &App, seen: u64) -> Result<Arc<Picture>, Problem> {
    let mut number = app.scanner.preview.number();
    app.scanner.want_preview();
    let _ = timeout(FRESH, number.wait_for(|number| *number > seen)).await;
    let preview = app.scanner.preview.clone();
    let picture = app.blocking(move || preview.picture()).await?;
    picture.ok_or_else(|| {
        Kind::NoFrame.with("no frame has been taken yet; see /readyz for the state of the rig")
    })
}

/// The latest frame
///
/// While a scan runs, its latest frame; else a frame of its own. Saturated pixels are red; the headers
/// `X-Polscan-Exposure` (`good`, `over`, `under`) and `X-Polscan-Saturated-Share` say whether the light is right.
#[utoipa::path(
    get, path = "/v1/preview.jpg", tag = "live",
    responses(
        (status = 200, description = "The frame", content_type = "image/jpeg", body = [u8]),
        (status = 503, description = "There is none", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_preview(Shared(app): Shared<App>) -> Result<Response, Problem> {
    let seen = *app.scanner.preview.number().borrow();
    let picture = picture(&app, seen).await?;
    let mut response = picture.jpeg.clone().into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("image/jpeg"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    for (name, value) in hints(&picture) {
        if let Ok(value) = HeaderValue::from_str(&value) {
            headers.insert(name, value);
        }
    }
    Ok(response)
}

/// The latest frames, one after the other
///
/// Motion JPEG, at most ten frames a second. A slow client misses frames; a scan is never disturbed.
#[utoipa::path(
    get, path = "/v1/preview.mjpeg", tag = "live",
    responses(
        (status = 200, description = "Frames", content_type = "multipart/x-mixed-replace", body = [u8]),
        (status = 503, description = "Too many clients, or no frame", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_preview_stream(Shared(app): Shared<App>) -> Result<Response, Problem> {
    let place = app.stream_place()?;
    // An error has a status only before the first frame.
    picture(&app, 0).await?;
    let stopping = app.stopping.clone();
    let stream = unfold((app, 0, place), move |(app, seen, place)| {
        let mut stopping = stopping.clone();
        async move {
            let next = async {
                if seen > 0 {
                    tokio::time::sleep(FRAME_PERIOD).await;
                }
                picture(&app, seen).await.ok()
            };
            let picture = tokio::select! {
                picture = next => picture?,
                _ = stopping.wait_for(|stopping| *stopping) => return None,
            };
            let mut part = format!(
                "--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n",
                picture.jpeg.len()
            );
            hints(&picture).iter().for_each(|(name, value)| part.push_str(&format!("{name}: {value}\r\n")));
            let mut bytes = part.into_bytes();
            bytes.extend_from_slice(b"\r\n");
            bytes.extend_from_slice(&picture.jpeg);
            bytes.extend_from_slice(b"\r\n");
            Some((Ok::<_, std::io::Error>(Bytes::from(bytes)), (app, picture.number, place)))
        }
    });
    let kind = HeaderValue::from_static("multipart/x-mixed-replace; boundary=polscan-frame");
    let headers =
        [(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, HeaderValue::from_static("no-store"))];
    Ok((headers, Body::from_stream(stream)).into_response())
}
