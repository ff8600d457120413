//! Pages for people: operating the scanner, and the documentation of the interface. They need nothing from elsewhere.

use axum::{
    Router,
    http::{HeaderValue, header},
    response::{IntoResponse, Response},
    routing::get,
};

use super::{App, openapi, problem};

// Built by scripts/page from web/; the build script says so where they are missing.
const OPERATE: &str = include_str!("../../web/dist/index.html");
const OPERATE_SCRIPT: &str = include_str!("../../web/dist/assets/page.js");
const OPERATE_STYLE: &str = include_str!("../../web/dist/assets/page.css");
const CLOUD_SCRIPT: &str = include_str!("../../web/dist/assets/cloud.js");
const ICON: &str = include_str!("../../web/dist/assets/icon.svg");
const DOCS: &str = include_str!("../../web/docs/docs.html");
const DOCS_STYLE: &str = include_str!("../../web/docs/docs.css");
const DOCS_SCRIPT: &str = include_str!("../../web/docs/docs.js");

/// Only what this service itself serves is loaded, and nothing inline runs.
const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; \
                      base-uri 'none'; form-action 'none'; frame-ancestors 'none'";

fn file(kind: &'static str, text: impl Into<String>) -> Response {
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static(kind)),
        (header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(POLICY)),
        (header::CACHE_CONTROL, HeaderValue::from_static("no-cache")),
    ];
    (headers, text.into()).into_response()
}

/// All pages.
pub fn routes() -> Router<App> {
    const HTML: &str = "text/html; charset=utf-8";
    const SCRIPT: &str = "text/javascript; charset=utf-8";
    const STYLE: &str = "text/css; charset=utf-8";
    let problems = || serde_json::Value::from(problem::table()).to_string();
    Router::new()
        .route("/", get(|| async { file(HTML, OPERATE) }))
        .route("/docs", get(|| async { file(HTML, DOCS) }))
        .route("/openapi.json", get(|| async { file("application/json", openapi()) }))
        .route("/assets/page.js", get(|| async { file(SCRIPT, OPERATE_SCRIPT) }))
        .route("/assets/page.css", get(|| async { file(STYLE, OPERATE_STYLE) }))
        .route("/assets/cloud.js", get(|| async { file(SCRIPT, CLOUD_SCRIPT) }))
        .route("/assets/icon.svg", get(|| async { file("image/svg+xml", ICON) }))
        .route("/assets/docs.css", get(|| async { file(STYLE, DOCS_STYLE) }))
        .route("/assets/docs.js", get(|| async { file(SCRIPT, DOCS_SCRIPT) }))
        .route("/assets/problems.json", get(move || async move { file("application/json", problems()) }))
}
