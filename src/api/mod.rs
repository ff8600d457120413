//! The service's interface: REST and events over HTTP. Handlers are thin: they check what a client sent, ask the
//! scanner, and put its answer into words.

mod artifacts;
mod auth;
mod calibrations;
mod document;
mod exports;
mod extract;
mod linger;
mod live;
mod pages;
mod problem;
mod samples;
mod scans;
mod server;
mod sessions;
mod system;
mod tls;
mod wire;

use std::{
    net::IpAddr,
    sync::{Arc, Mutex, PoisonError},
    time::{Duration, Instant},
};

use axum::{
    Router,
    extract::{DefaultBodyLimit, MatchedPath, Request, State},
    http::{Method, StatusCode, header},
    middleware::{Next, from_fn_with_state},
    response::{IntoResponse, Response},
};
use polscan_drivers::camera::Listing;
use tokio::sync::{OnceCell, OwnedSemaphorePermit, Semaphore, watch};
use tower_http::{
    catch_panic::CatchPanicLayer,
    compression::{CompressionLayer, predicate::Predicate},
};
use utoipa::OpenApi;
use utoipa_axum::{router::OpenApiRouter, routes};

use crate::{
    config::Settings,
    scanner::Scanner,
    store::{Index, IndexError, library::chain},
};

pub use auth::{Gate, Scope, TokenError, TokenFile, Tokens, add_token, revoke_token};
use problem::{Kind, Problem};
pub use server::{Listening, serve};
pub use tls::{Tls, TlsError};

/// A place among the streams; dropping it gives it back.
pub type Place = OwnedSemaphorePermit;

/// Everything that handlers share. Cheap to clone.
#[derive(Debug, Clone)]
pub struct App {
    scanner: Scanner,
    settings: Arc<Settings>,
    gate: Arc<Gate>,
    /// Opened by the first who reads: a connection is for one thread at a time.
    index: Arc<Mutex<Option<Index>>>,
    requests: Arc<Semaphore>,
    streams: Arc<Semaphore>,
    /// Exports are made one at a time, so that a decode keeps its processors.
    exports: Arc<Semaphore>,
    wait_limit: Duration,
    stopping: watch::Receiver<bool>,
    started: Instant,
    devices: Arc<OnceCell<(Vec<Listing>, Vec<Listing>)>>,
}

impl App {
    /// The interface of `scanner` on `address`; `stopping` ends what would go on for ever.
    pub fn new(
        scanner: Scanner,
        settings: Settings,
        tokens: Option<Arc<TokenFile>>,
        address: IpAddr,
        stopping: watch::Receiver<bool>,
    ) -> Self {
        let api = &settings.raw.api;
        Self {
            scanner,
            gate: Arc::new(Gate { tokens, address }),
            index: Arc::default(),
            requests: Arc::new(Semaphore::new(api.concurrency)),
            streams: Arc::new(Semaphore::new(api.streams)),
            exports: Arc::new(Semaphore::new(1)),
            wait_limit: scans::wait_limit(api.wait_limit_s),
            stopping,
            started: Instant::now(),
            devices: Arc::default(),
            settings: Arc::new(settings),
        }
    }

    /// A place for a client that stays.
    fn stream_place(&self) -> Result<Place, Problem> {
        let full = || Kind::Overloaded.with("too many clients wait, follow or watch; see api.streams");
        self.streams.clone().try_acquire_owned().map_err(|_| full())
    }

    /// Runs what may block where that hurts nobody.
    async fn blocking<T: Send + 'static>(
        &self,
        run: impl FnOnce() -> T + Send + 'static,
    ) -> Result<T, Problem> {
        tokio::task::spawn_blocking(run).await.map_err(|error| {
            tracing::error!(%error, "a request ended in a defect");
            Kind::Internal.with("the request ended in a defect of the service; its log says more")
        })
    }

    /// Reads from the index.
    async fn read<T: Send + 'static>(
        &self,
        read: impl FnOnce(&Index) -> Result<T, IndexError> + Send + 'static,
    ) -> Result<T, Problem> {
        let (index, folder) = (self.index.clone(), self.scanner.folder().to_owned());
        let run = move || {
            let mut index = index.lock().unwrap_or_else(PoisonError::into_inner);
            let opened = match index.take() {
                Some(index) => index,
                None => Index::open_read_only(&folder)?,
            };
            let result = read(&opened)?;
            // After an error the next reader opens it anew.
            *index = Some(opened);
            Ok(result)
        };
        self.blocking(run).await?.map_err(|error: IndexError| {
            tracing::error!(error = chain(&error), "the index cannot be read");
            Kind::Internal.with(chain(&error))
        })
    }
}

fn router() -> OpenApiRouter<App> {
    OpenApiRouter::with_openapi(document::Document::openapi())
        .routes(routes!(scans::list_scans, scans::post_scan))
        .routes(routes!(scans::get_scan, scans::patch_scan, scans::delete_scan))
        .routes(routes!(scans::cancel_scan))
        .routes(routes!(scans::reprocess_scan))
        .routes(routes!(artifacts::get_bundle))
        .routes(routes!(artifacts::get_summary))
        .routes(routes!(artifacts::get_artifact))
        .routes(routes!(samples::get_sample))
        .routes(routes!(artifacts::get_map))
        .routes(routes!(exports::get_export))
        .routes(routes!(scans::resume_queue))
        .routes(routes!(scans::pause_queue))
        .routes(routes!(live::get_events))
        .routes(routes!(live::get_preview))
        .routes(routes!(live::get_preview_stream))
        .routes(routes!(system::get_status))
        .routes(routes!(system::get_devices))
        .routes(routes!(system::get_config))
        .routes(routes!(system::put_projector))
        .routes(routes!(calibrations::get_calibrations))
        .routes(routes!(calibrations::post_noise))
        .routes(routes!(calibrations::post_sync))
        .routes(routes!(calibrations::post_polarization))
        .routes(routes!(sessions::post_rig))
        .routes(routes!(sessions::post_view))
        .routes(routes!(sessions::delete_view))
        .routes(routes!(sessions::post_solve))
        .routes(routes!(
            calibrations::get_calibration,
            calibrations::post_unknown,
            calibrations::delete_calibration
        ))
        .routes(routes!(calibrations::cancel_calibration))
        .routes(routes!(calibrations::get_calibration_file))
        .routes(routes!(system::livez))
        .routes(routes!(system::readyz))
        .routes(routes!(system::metrics))
}

/// The API document, made from the handlers.
pub fn openapi() -> String {
    let (_, document) = router().split_for_parts();
    let mut text = document::complete(document).to_pretty_json().unwrap_or_default();
    text.push('\n');
    text
}

/// Everything that is served.
pub fn service(app: App) -> Router {
    let (routes, _) = router().split_for_parts();
    routes
        .merge(pages::routes())
        .fallback(|| async { Kind::NotFound.with("see /docs for all addresses") })
        .method_not_allowed_fallback(|| async { Kind::Method.with("see /docs for what this address takes") })
        .layer(from_fn_with_state(app.clone(), guard))
        .layer(DefaultBodyLimit::max(extract::MOST_BYTES))
        .layer(CompressionLayer::new().gzip(true).compress_when(Compressible))
        .layer(CatchPanicLayer::custom(panicked))
        .with_state(app)
}

fn panicked(panic: Box<dyn std::any::Any + Send>) -> Response {
    let said = panic.downcast_ref::<&str>().map(|text| (*text).to_owned());
    let said = said.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
    tracing::error!(said, "a request ended in a defect");
    Kind::Internal.with("the request ended in a defect of the service; its log says more").into_response()
}

/// What goes before every handler: who may ask, and how many at once; and after it: counting.
async fn guard(State(app): State<App>, request: Request, next: Next) -> Response {
    let path = request.extensions().get::<MatchedPath>().map_or("none", MatchedPath::as_str).to_owned();
    let is_probe = matches!(path.as_str(), "/livez" | "/readyz");
    let checked = app.gate.check(request.method(), request.uri(), request.headers());
    let waits = request.method() == Method::GET && (path == "/v1/events" || path == "/v1/preview.mjpeg")
        || matches!(path.as_str(), "/v1/scans" | "/v1/scans/{id}" | "/v1/scans/{id}/reprocess")
            && request
                .uri()
                .query()
                .is_some_and(|query| query.split('&').any(|pair| pair.starts_with("wait=")));
    let (request, rest) = linger::Rest::of(request);
    // Those that stay have places of their own; probes are always answered.
    let place = (!waits && !is_probe).then(|| app.requests.clone().try_acquire_owned());
    let response = match (checked, place) {
        (Err(problem), _) => problem.into_response(),
        (Ok(()), Some(Err(_))) => {
            Kind::Overloaded.with("too many requests at once; see api.concurrency").into_response()
        }
        (Ok(()), _) => next.run(request).await,
    };
    if let Some(rest) = rest {
        rest.take_in().await;
    }
    app.scanner.metrics.request(&path, response.status().as_u16());
    hardened(response)
}

/// Headers that no page of ours can do without, and no other answer is hurt by.
fn hardened(mut response: Response) -> Response {
    let headers = response.headers_mut();
    let fixed = [
        ("x-content-type-options", "nosniff"),
        ("x-frame-options", "DENY"),
        ("referrer-policy", "no-referrer"),
        ("cross-origin-resource-policy", "same-origin"),
    ];
    for (name, value) in fixed {
        headers.insert(name, header::HeaderValue::from_static(value));
    }
    response
}

/// Text of some length; never files, of which parts may be asked for, and never streams.
#[derive(Debug, Clone, Copy)]
struct Compressible;

impl Predicate for Compressible {
    fn should_compress<B>(&self, response: &axum::http::Response<B>) -> bool
    where
        B: axum::body::HttpBody,
    {
        let headers = response.headers();
        let kind =
            headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or_default();
        let text =
            ["application/json", "text/html", "text/css", "application/openmetrics-text", "text/javascript"];
        let long = response.body().size_hint().exact().is_none_or(|bytes| bytes > 1024);
        long && response.status() != StatusCode::PARTIAL_CONTENT
            && !headers.contains_key(header::ACCEPT_RANGES)
            && text.iter().any(|one| kind.starts_with(one))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_committed_document_is_that_of_the_handlers() {
        let committed = include_str!("../../docs/openapi.json");
        assert!(
            committed == openapi(),
            "docs/openapi.json is not up to date: polscan openapi > docs/openapi.json"
        );
    }
}
