//! A scan in the formats of other programs, made when somebody asks for it.

use std::{
    fs::File,
    io::{self, BufWriter, Seek, Write},
    path::Path,
};

use axum::{
    body::Body,
    extract::{Path as Part, State as Shared},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use futures_util::StreamExt;
use sha2::{Digest as _, Sha256};
use tokio_util::io::ReaderStream;

use super::{
    App,
    artifacts::{CHUNK, described, has_tag, header_text, manifest, no_artifact, not_finished, value},
    extract::Id,
    problem::{Kind, Problem, ProblemBody},
    scans::find,
};
use crate::{
    engine::Failure,
    export::{Item, Scan},
    scanner::Denied,
    store::source::hex,
};

/// Why there is no file.
enum Missing {
    /// The scan does not have what it would be made of.
    Lacks(String),
    /// The bundle cannot be read.
    Broken(Failure),
    /// It cannot be written.
    Storage(io::Error),
}

impl From<Missing> for Problem {
    fn from(missing: Missing) -> Self {
        match missing {
            Missing::Lacks(reason) => Kind::NoArtifact.with(reason),
            Missing::Broken(failure) => {
                let message = failure.chain();
                tracing::warn!(message, "a scan cannot be exported");
                Kind::Internal.with(message)
            }
            Missing::Storage(error) => Denied::Storage(format!(
                "cannot write the export into the store: {error}; free some space on its disk"
            ))
            .into(),
        }
    }
}

/// A scan for other programs
///
/// `cloud.e57`, `cloud.pcd`, `cloud.xyz`, `mesh.obj`; `depth.tiff`, `depth.f32.tiff`, `depth.png` and the same for `column`, `row`,
/// `residual` and `modulation`; `class` and `mask` as `.tiff` and `.png`. Made on demand, one after the other, and not kept.
#[utoipa::path(
    get, path = "/v1/scans/{id}/export/{name}", tag = "artifacts",
    params(("id" = String, Path), ("name" = String, Path, description = "Name of the file, such as `cloud.e57`")),
    responses(
        (status = 200, description = "The file", content(
            ([u8] = "application/octet-stream"), ([u8] = "model/e57"), (String = "model/obj"), (String = "text/plain"),
            ([u8] = "image/tiff"), ([u8] = "image/png"))),
        (status = 304, description = "The client has it"),
        (status = 404, description = "Unknown scan, no such format, or the scan has nothing to make it of", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_export(
    Shared(app): Shared<App>,
    Id(id): Id,
    part: Result<Part<(String, String)>, axum::extract::rejection::PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Part((_, name)) = part.map_err(|_| no_artifact("that"))?;
    let record = find(&app, &id).await?;
    let unknown =
        || Kind::NoArtifact.with(format!("nothing is exported as {name:?}; see /docs for all names"));
    let item = Item::from_file_name(&name).ok_or_else(unknown)?;
    if !record.state.is_terminal() {
        return Err(not_finished(&record));
    }
    let folder = app.scanner.folder().join(&record.id);
    let listed = folder.clone();
    let own = app.blocking(move || manifest(&listed)).await?.map(|(_, own)| own);
    let own = own.ok_or_else(|| no_artifact(&name))?;
    // What a file holds follows from the bundle, of which the manifest has all hashes, and from this program.
    let identity = format!("{} {} {name}", own.sha256, env!("CARGO_PKG_VERSION"));
    let (tag, mut answer) = described(&name, &hex(&Sha256::digest(identity)));
    if has_tag(header_text(&headers, header::IF_NONE_MATCH), &tag) {
        return Ok((StatusCode::NOT_MODIFIED, answer).into_response());
    }
    // Whoever reads slowly keeps a file on the disk, so that there are only as many as there are places.
    let place = app.stream_place()?;
    let turn = app.exports.clone().acquire_owned().await;
    let store = app.scanner.folder().to_owned();
    let made = app
        .blocking(move || {
            // Kept to the end even if the client goes away meanwhile: only so many are made at once.
            let _turn = turn;
            make(&folder, item, &store)
        })
        .await?;
    let (file, bytes) = made.map_err(Problem::from)?;
    answer.insert(header::CONTENT_TYPE, HeaderValue::from_static(item.media_type()));
    answer.insert(header::CONTENT_LENGTH, HeaderValue::from(bytes));
    let attached = format!("attachment; filename=\"{}-{name}\"", record.id);
    answer.insert(header::CONTENT_DISPOSITION, value(&attached));
    let chunks = ReaderStream::with_capacity(tokio::fs::File::from_std(file), CHUNK);
    let body = Body::from_stream(chunks.map(move |chunk| {
        let _place = &place;
        chunk
    }));
    Ok((answer, body).into_response())
}

/// Makes the file, without a name: it is gone when nobody reads it any more.
fn make(bundle: &Path, item: Item, store: &Path) -> Result<(File, u64), Missing> {
    let scan = Scan::read(bundle).map_err(Missing::Broken)?;
    if let Some(reason) = scan.lacks(item) {
        return Err(Missing::Lacks(reason));
    }
    let write = || {
        let mut out = BufWriter::with_capacity(CHUNK, nameless(store)?);
        scan.write(item, &mut out)?;
        out.flush()?;
        let mut file = out.into_inner().map_err(io::IntoInnerError::into_error)?;
        let bytes = file.stream_position()?;
        file.rewind()?;
        Ok((file, bytes))
    };
    write().map_err(Missing::Storage)
}

/// A file in `folder` that has no name any more.
fn nameless(folder: &Path) -> io::Result<File> {
    let path = folder.join(format!(".export-{}", uuid::Uuid::now_v7().simple()));
    let file = File::options().read(true).write(true).create_new(true).open(&path)?;
    std::fs::remove_file(&path)?;
    Ok(file)
}
