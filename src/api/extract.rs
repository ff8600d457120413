//! Bodies and queries, with everything that can be wrong with them as a problem of ours.

use std::time::Duration;

use axum::{
    body::Bytes,
    extract::{FromRequest, FromRequestParts, Path, Query, Request, rejection::BytesRejection},
    http::{HeaderMap, header, request::Parts},
};
use serde::de::DeserializeOwned;
use serde_json::json;

use super::problem::{Kind, Problem};
use crate::scanner::is_id;

/// Longest body that is read.
pub const MOST_BYTES: usize = 64 << 10;

/// How long a body may take to arrive.
const PATIENCE: Duration = Duration::from_secs(10);

/// A body of JSON. The media type is asked for, since only so a browser asks before it sends one from a page of somebody
/// else's.
pub struct Body<T>(pub T);

/// A body of JSON, or none at all. Without a body no media type is needed.
pub struct MaybeBody<T>(pub T);

async fn bytes<S: Send + Sync>(request: Request, state: &S) -> Result<Bytes, Problem> {
    let read = tokio::time::timeout(PATIENCE, Bytes::from_request(request, state)).await;
    match read {
        Err(_) => Err(Kind::Timeout.with("send the whole body within ten seconds")),
        Ok(Ok(bytes)) => Ok(bytes),
        Ok(Err(BytesRejection::FailedToBufferBody(error))) => {
            let too_large = axum::response::IntoResponse::into_response(error).status() == 413;
            Err(match too_large {
                true => Kind::TooLarge.with(format!("a body has at most {MOST_BYTES} bytes")),
                false => Kind::Malformed.with("the body broke off"),
            })
        }
        Ok(Err(_)) => Err(Kind::Malformed.with("the body cannot be read")),
    }
}

fn is_json(headers: &HeaderMap) -> bool {
    let kind = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or_default();
    kind.split(';').next().is_some_and(|kind| kind.trim().eq_ignore_ascii_case("application/json"))
}

fn parse<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, Problem> {
    let bytes = if bytes.trim_ascii().is_empty() { b"{}" } else { bytes };
    // Serde would take a list for an object with the same members in order.
    if bytes.trim_ascii_start().first() == Some(&b'[') {
        let errors = json!([{ "key": "", "message": "is a list" }]);
        return Err(Kind::Invalid.with("the body is a list, expected an object").and("errors", errors));
    }
    let mut reader = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize::<_, T>(&mut reader).map_err(|error| {
        let (path, inner) = (error.path().to_string(), error.inner());
        let message = inner.to_string();
        match inner.classify() {
            serde_json::error::Category::Data => {
                let errors = json!([{ "key": path, "message": message }]);
                Kind::Invalid.with(format!("{path}: {message}")).and("errors", errors)
            }
            _ => Kind::Malformed.with(format!("the body is not JSON: {message}")),
        }
    })?;
    reader.end().map_err(|error| Kind::Malformed.with(format!("the body is not JSON: {error}")))?;
    Ok(value)
}

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Body<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &S) -> Result<Self, Problem> {
        if !is_json(request.headers()) {
            return Err(Kind::MediaType.with("send the header Content-Type: application/json"));
        }
        parse(&bytes(request, state).await?).map(Self)
    }
}

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for MaybeBody<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, state: &S) -> Result<Self, Problem> {
        let headers = request.headers();
        let (typed, json) = (headers.contains_key(header::CONTENT_TYPE), is_json(headers));
        let wrong = || Kind::MediaType.with("send the header Content-Type: application/json");
        if typed && !json {
            return Err(wrong());
        }
        let bytes = bytes(request, state).await?;
        if !typed && !bytes.is_empty() {
            return Err(wrong());
        }
        // Where nothing need be said, null says nothing.
        let said = if bytes.trim_ascii() == b"null" { b"" } else { &bytes[..] };
        parse(said).map(Self)
    }
}

/// Parameters of a query.
pub struct Params<T>(pub T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Params<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let query = Query::<T>::from_request_parts(parts, state).await;
        query.map(|Query(value)| Self(value)).map_err(|error| Kind::Invalid.with(error.body_text()))
    }
}

/// Identity of a scan in the address.
pub struct Id(pub String);

impl<S: Send + Sync> FromRequestParts<S> for Id {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let unknown = || Kind::UnknownScan.with("no scan has this identity; GET /v1/scans lists them");
        let Path(pairs) =
            Path::<Vec<(String, String)>>::from_request_parts(parts, state).await.map_err(|_| unknown())?;
        let id = pairs.into_iter().find(|(name, _)| name == "id").map(|(_, id)| id);
        id.filter(|id| is_id(id)).map(Self).ok_or_else(unknown)
    }
}
