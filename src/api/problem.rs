//! Everything that a request can come to instead of an answer, in one table. RFC 9457: `application/problem+json`.

use axum::{
    http::{HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use utoipa::ToSchema;

use crate::scanner::{Denied, Refusal};

/// What went wrong.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// The request is no request.
    Malformed,
    /// There is no token, or not one of ours.
    Unauthorized,
    /// The token does not reach that far.
    Scope,
    /// The request comes from a page of somebody else's.
    Foreign,
    /// There is nothing at this address.
    NotFound,
    /// There is no scan of this identity.
    UnknownScan,
    /// There is no calibration of this identity.
    UnknownCalibration,
    /// The session has no such view.
    UnknownView,
    /// The scan has no such file.
    NoArtifact,
    /// The address takes other methods.
    Method,
    /// The body did not come in time.
    Timeout,
    /// Another scan has the rig.
    Busy,
    /// The scan has no result yet.
    NotFinished,
    /// The scan is in a state that does not allow it.
    State,
    /// The scan is pinned.
    Pinned,
    /// Another scan was decoded from its frames.
    InUse,
    /// The body is too long.
    TooLarge,
    /// The body is not JSON.
    MediaType,
    /// There are no such bytes.
    Range,
    /// The request contradicts itself or the rules.
    Invalid,
    /// The key was used for another request.
    KeyReused,
    /// Too many scans wait.
    QueueFull,
    /// A defect.
    Internal,
    /// The rig cannot scan.
    NotReady,
    /// Too many requests at once.
    Overloaded,
    /// There is no frame to look at.
    NoFrame,
}

/// One row of the table: slug, status, title.
const TABLE: [(Kind, &str, u16, &str); 26] = [
    (Kind::Malformed, "malformed", 400, "the request cannot be read"),
    (Kind::Unauthorized, "unauthorized", 401, "a token is needed"),
    (Kind::Scope, "insufficient-scope", 403, "the token does not allow this"),
    (Kind::Foreign, "foreign-origin", 403, "the request does not come from this machine"),
    (Kind::NotFound, "not-found", 404, "there is nothing here"),
    (Kind::UnknownScan, "unknown-scan", 404, "there is no such scan"),
    (Kind::UnknownCalibration, "unknown-calibration", 404, "there is no such calibration"),
    (Kind::UnknownView, "unknown-view", 404, "there is no such view"),
    (Kind::NoArtifact, "no-artifact", 404, "there is no such file"),
    (Kind::Method, "method-not-allowed", 405, "this address takes other methods"),
    (Kind::Timeout, "request-timeout", 408, "the request took too long to arrive"),
    (Kind::Busy, "busy", 409, "another scan or a calibration has the rig"),
    (Kind::NotFinished, "not-finished", 409, "there is no result yet"),
    (Kind::State, "wrong-state", 409, "the state does not allow this"),
    (Kind::Pinned, "pinned", 409, "the scan is pinned"),
    (Kind::InUse, "in-use", 409, "another scan was decoded from its frames"),
    (Kind::TooLarge, "too-large", 413, "the request is too large"),
    (Kind::MediaType, "unsupported-media-type", 415, "the body must be application/json"),
    (Kind::Range, "range-not-satisfiable", 416, "there are no such bytes"),
    (Kind::Invalid, "invalid", 422, "the request asks for something that cannot be"),
    (Kind::KeyReused, "idempotency-key-reused", 422, "the Idempotency-Key was used for another request"),
    (Kind::QueueFull, "queue-full", 429, "too many scans wait"),
    (Kind::Internal, "internal", 500, "a defect of this service"),
    (Kind::NotReady, "not-ready", 503, "the rig cannot scan now"),
    (Kind::Overloaded, "overloaded", 503, "too many requests at once"),
    (Kind::NoFrame, "no-frame", 503, "there is no frame to look at"),
];

impl Kind {
    fn row(self) -> (&'static str, StatusCode, &'static str) {
        let found = TABLE.iter().find(|row| row.0 == self);
        let (_, slug, status, title) = found.expect("the table has a row for each kind, which a test holds");
        (slug, StatusCode::from_u16(*status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR), title)
    }

    /// A problem of this kind.
    pub fn with(self, detail: impl Into<String>) -> Problem {
        Problem { kind: self, detail: detail.into(), more: Map::new() }
    }
}

/// What the body of an error looks like, for the API document.
#[derive(Debug, Serialize, Deserialize, ToSchema)]
pub struct ProblemBody {
    /// Stable slug, such as `busy`.
    #[serde(rename = "type")]
    pub kind: String,
    /// The same for all problems of the type.
    pub title: String,
    /// HTTP status.
    pub status: u16,
    /// What is wrong here and what to do.
    pub detail: String,
    /// Who has the rig, with `busy`.
    pub holder: Option<crate::scanner::Holder>,
    /// Why the rig cannot scan, with `not-ready`.
    pub reasons: Option<Vec<crate::scanner::Obstacle>>,
    /// What is wrong with which key, with `invalid`.
    pub errors: Option<Vec<Value>>,
}

/// An error as it is answered.
#[derive(Debug, Clone)]
pub struct Problem {
    kind: Kind,
    detail: String,
    more: Map<String, Value>,
}

impl Problem {
    /// Adds a member.
    pub fn and(mut self, key: &str, value: impl Into<Value>) -> Self {
        self.more.insert(key.to_owned(), value.into());
        self
    }

    /// HTTP status.
    pub fn status(&self) -> StatusCode {
        self.kind.row().1
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let (slug, status, title) = self.kind.row();
        let mut body = Map::new();
        body.insert("type".to_owned(), slug.into());
        body.insert("title".to_owned(), title.into());
        body.insert("status".to_owned(), status.as_u16().into());
        body.insert("detail".to_owned(), self.detail.into());
        body.extend(self.more);
        let mut response = (status, Value::Object(body).to_string()).into_response();
        let headers = response.headers_mut();
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
        match self.kind {
            Kind::Unauthorized => {
                headers.insert(header::WWW_AUTHENTICATE, HeaderValue::from_static("Bearer"));
            }
            Kind::QueueFull | Kind::NotReady | Kind::Overloaded => {
                headers.insert(header::RETRY_AFTER, HeaderValue::from_static("2"));
            }
            _ => {}
        }
        response
    }
}

impl From<Denied> for Problem {
    fn from(denied: Denied) -> Self {
        match denied {
            Denied::Refused(Refusal::Busy(holder)) if let Some(kind) = holder.calibration => {
                let kind = kind.name();
                Kind::Busy
                    .with(format!(
                        "calibration {} ({kind}) is under way; wait for it, or cancel it",
                        holder.id
                    ))
                    .and("holder", json!(holder))
            }
            Denied::Refused(Refusal::Busy(holder)) => Kind::Busy
                .with(format!("scan {} has the rig; wait for it, or post with \"queue\": true", holder.id))
                .and("holder", json!(holder)),
            Denied::Refused(Refusal::QueueFull { capacity }) => Kind::QueueFull
                .with(format!("at most {capacity} scans may wait; try again when some are done"))
                .and("capacity", capacity),
            Denied::Refused(Refusal::NotReady(reasons)) => {
                let messages: Vec<_> = reasons.iter().map(|one| one.message.as_str()).collect();
                Kind::NotReady.with(messages.join("; ")).and("reasons", json!(reasons))
            }
            Denied::KeyReused => {
                Kind::KeyReused.with("give each request a key of its own, and repeat only with the same body")
            }
            Denied::Unknown => Kind::UnknownScan.with("no scan has this identity; GET /v1/scans lists them"),
            Denied::State(state) => {
                let state = state.name();
                Kind::State
                    .with(format!("the scan is {state}, which does not allow this"))
                    .and("state", state)
            }
            Denied::Pinned => Kind::Pinned.with("PATCH it with \"pinned\": false first"),
            Denied::InUse => Kind::InUse.with("delete the scans that were decoded from it first"),
            Denied::UnknownCalibration => Kind::UnknownCalibration
                .with("no calibration has this identity; GET /v1/calibrations lists them"),
            Denied::CalibrationEnded(state) => {
                let state = state.name();
                Kind::State
                    .with(format!("the calibration is {state}, which does not allow this"))
                    .and("state", state)
            }
            Denied::UnknownView => {
                Kind::UnknownView.with("GET the calibration: its `session` lists its views")
            }
            Denied::NoSession => Kind::State.with("only the calibration of a rig has views and is solved"),
            Denied::SessionOpen(id) => Kind::State
                .with(format!("session {id} is open; go on with it, or cancel it first"))
                .and("session", id),
            Denied::NoBundle => Kind::State.with("the scan left no frames"),
            Denied::Storage(message) => {
                let reasons = json!([{ "type": "storage", "message": message }]);
                Kind::NotReady.with(message).and("reasons", reasons)
            }
            Denied::NoSuchPicture(message) => Kind::Invalid
                .with(format!("show: {message}"))
                .and("errors", json!([{ "key": "show", "message": message }])),
            Denied::Rig(message) => {
                let reasons = json!([{ "type": "rig", "message": message }]);
                Kind::NotReady.with(message).and("reasons", reasons)
            }
        }
    }
}

/// The table in words, for the documentation.
pub fn table() -> Vec<Value> {
    TABLE
        .iter()
        .map(|(_, slug, status, title)| json!({ "type": slug, "status": status, "title": title }))
        .collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn each_kind_has_one_row_and_each_slug_one_kind() {
        let slugs: BTreeSet<_> = TABLE.iter().map(|row| row.1).collect();
        assert_eq!(slugs.len(), TABLE.len());
        for (kind, slug, status, _) in TABLE {
            let problem = kind.with("detail");
            assert_eq!(kind.row().0, slug);
            assert_eq!(problem.status().as_u16(), status);
            assert!(slug.bytes().all(|byte| byte.is_ascii_lowercase() || byte == b'-'));
        }
    }
}
