//! A cloud that is small enough to be looked at as soon as it is there.

use std::{fs::File, io};

use axum::{
    extract::State as Shared,
    http::{HeaderMap, StatusCode},
    response::{IntoResponse, Response},
};
use serde::Deserialize;
use sha2::{Digest as _, Sha256};
use utoipa::IntoParams;

use super::{
    App,
    artifacts::{described, has_tag, header_text, locate, no_artifact},
    extract::{Id, Params},
    problem::{Kind, Problem, ProblemBody},
    scans::invalid,
};
use crate::{
    cloud::{SampleError, sample_ply},
    store::{measured::CLOUD_FILE_NAME, source::hex},
};

/// Points where the client does not say how many.
const POINTS: usize = 50_000;
/// Most points of an answer: it is made in memory, of 30 bytes each.
const MOST_POINTS: usize = 200_000;

/// How much of a cloud is asked for.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields, default)]
pub struct SampleParams {
    /// Most points of the answer, 1 to 200 000; 50 000 where it is left out.
    #[param(minimum = 1, maximum = 200_000)]
    points: Option<usize>,
}

/// A part of the cloud
///
/// A PLY like `cloud.ply` with at most `points` of its points, spread evenly over the image: what a view that follows the
/// scans needs.
#[utoipa::path(
    get, path = "/v1/scans/{id}/sample.ply", tag = "artifacts",
    params(("id" = String, Path), SampleParams),
    responses(
        (status = 200, description = "The points", content_type = "application/octet-stream", body = [u8]),
        (status = 304, description = "The client has it"),
        (status = 404, description = "Unknown scan, or it has no cloud", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_sample(
    Shared(app): Shared<App>,
    Id(id): Id,
    Params(params): Params<SampleParams>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let most = params.points.unwrap_or(POINTS);
    if !(1..=MOST_POINTS).contains(&most) {
        return Err(invalid("points", format!("{most} is outside 1 to {MOST_POINTS}")));
    }
    let found = locate(&app, &id, CLOUD_FILE_NAME).await?;
    let identity = format!("{} {} sample {most}", found.entry.sha256, env!("CARGO_PKG_VERSION"));
    let (tag, answer) = described("sample.ply", &hex(&Sha256::digest(identity)));
    if has_tag(header_text(&headers, axum::http::header::IF_NONE_MATCH), &tag) {
        return Ok((StatusCode::NOT_MODIFIED, answer).into_response());
    }
    let path = found.path.clone();
    let sampled = app
        .blocking(move || {
            let mut bytes = Vec::new();
            sample_ply(File::open(&path)?, most, &mut bytes)?;
            Ok::<_, SampleError>(bytes)
        })
        .await?;
    match sampled {
        Ok(bytes) => Ok((answer, bytes).into_response()),
        // Retention may have taken the scan meanwhile.
        Err(SampleError::Io(error)) if error.kind() == io::ErrorKind::NotFound => {
            Err(no_artifact(CLOUD_FILE_NAME))
        }
        Err(error) => {
            let message = format!("cannot read {}: {error}", found.path.display());
            tracing::warn!(message, "a cloud cannot be sampled");
            Err(Kind::Internal.with(message))
        }
    }
}
