//! The files of a scan: whole, in part, and all of them as one archive. Only names that the scan's manifest lists lead
//! to a file.

use std::{
    io::{self, Write},
    path::{Path, PathBuf},
    sync::Arc,
};

use axum::{
    body::{Body, Bytes},
    extract::{Path as Part, State as Shared},
    http::{HeaderMap, HeaderValue, StatusCode, header},
    response::{IntoResponse, Response},
};
use serde::Serialize;
use sha2::{Digest as _, Sha256};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;
use utoipa::ToSchema;

use super::{
    App,
    extract::Id,
    problem::{Kind, Problem, ProblemBody},
    scans::find,
};
use crate::{
    report::{Report, summary},
    scanner::Record,
    store::{
        Manifest,
        bundle::FRAMES_FILE_NAME,
        manifest::{FILE_NAME, FileEntry},
        source::hex,
    },
};

/// Bytes that are read at once.
pub(super) const CHUNK: usize = 256 << 10;

/// Chunks of an archive that may wait for a slow client.
const CHUNKS: usize = 8;

/// Names that a scan may come to have, for telling "not yet" from "never".
const EXPECTED: [&str; 9] = [
    "manifest.json",
    "report.json",
    "cloud.ply",
    "cloud.png",
    "overview.png",
    "frames.npy",
    "maps.npz",
    "truth.npz",
    "calibration.toml",
];

/// A file of a scan.
#[derive(Debug, Serialize, ToSchema)]
pub struct Artifact {
    /// Name.
    name: String,
    /// Address.
    href: String,
    /// Length in bytes.
    bytes: u64,
    /// SHA-256, also its entity tag.
    sha256: String,
}

/// A file on the disk.
pub(super) struct Found {
    /// Where it is.
    pub path: PathBuf,
    /// What the manifest says of it.
    pub entry: FileEntry,
}

/// Reads the manifest of a bundle; the hash of the file itself comes with it.
pub(super) fn manifest(folder: &Path) -> Option<(Manifest, FileEntry)> {
    let bytes = std::fs::read(folder.join(FILE_NAME)).ok()?;
    let manifest = Manifest::parse(&bytes).ok()?.manifest;
    Some((manifest, FileEntry { bytes: bytes.len() as u64, sha256: hex(&Sha256::digest(&bytes)) }))
}

/// The files of a scan; none before its end.
pub async fn artifacts(app: &App, record: &Record) -> Result<Vec<Artifact>, Problem> {
    if !record.state.is_terminal() || record.bytes.is_none() {
        return Ok(Vec::new());
    }
    let (folder, id) = (app.scanner.folder().join(&record.id), record.id.clone());
    let list = move || {
        let Some((manifest, own)) = manifest(&folder) else { return Vec::new() };
        let entries = manifest.files.into_iter().chain([(FILE_NAME.to_owned(), own)]);
        let artifact = |(name, entry): (String, FileEntry)| {
            let href = format!("/v1/scans/{id}/{name}");
            Artifact { name, href, bytes: entry.bytes, sha256: entry.sha256 }
        };
        entries.map(artifact).collect()
    };
    app.blocking(list).await
}

pub(super) fn no_artifact(name: &str) -> Problem {
    Kind::NoArtifact.with(format!("there is no {name:?}; the scan's `artifacts` lists its files"))
}

pub(super) fn not_finished(record: &Record) -> Problem {
    let state = record.state.name();
    Kind::NotFinished
        .with(format!("the scan is {state}; ask again when it is done, or wait with ?wait=done"))
        .and("state", state)
}

/// Finds a file by a name that the manifest lists.
pub(super) async fn locate(app: &App, id: &str, name: &str) -> Result<Found, Problem> {
    let record = find(app, id).await?;
    let expected = EXPECTED.contains(&name) || (name.starts_with("maps/") && name.ends_with(".png"));
    if !record.state.is_terminal() {
        return Err(if expected { not_finished(&record) } else { no_artifact(name) });
    }
    // A scan that was decoded again has its frames where they were recorded.
    let owner = match &record.source {
        Some(source) if name == FRAMES_FILE_NAME => source.clone(),
        _ => record.id.clone(),
    };
    let folder = app.scanner.folder().join(owner);
    let wanted = name.to_owned();
    let found = app
        .blocking(move || {
            let (manifest, own) = manifest(&folder)?;
            let entry = if wanted == FILE_NAME { own } else { manifest.files.get(&wanted)?.clone() };
            Some(Found { path: folder.join(&wanted), entry })
        })
        .await?;
    found.ok_or_else(|| no_artifact(name))
}

fn media_type(name: &str) -> &'static str {
    match name.rsplit('.').next() {
        Some("json") => "application/json",
        Some("png") => "image/png",
        Some("svg") => "image/svg+xml",
        Some("toml") => "application/toml",
        Some("npz" | "zip") => "application/zip",
        _ => "application/octet-stream",
    }
}

/// What part of a file is asked for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Span {
    Whole,
    Part { first: u64, last: u64 },
    Nothing,
}

/// Reads the header `Range`; what is not understood, or is about several parts, is about the whole file.
fn span(range: Option<&str>, bytes: u64) -> Span {
    let Some(text) = range.and_then(|range| range.trim().strip_prefix("bytes=")) else { return Span::Whole };
    let Some((from, to)) = text.split_once('-') else { return Span::Whole };
    let (from, to) = (from.trim(), to.trim());
    let digits = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    // Numbers beyond all files are as good as the largest.
    let number = |text: &str| text.parse::<u64>().unwrap_or(u64::MAX);
    match (digits(from), digits(to)) {
        (true, true) if number(to) < number(from) => Span::Whole,
        (true, _) if to.is_empty() || digits(to) => {
            let last = if to.is_empty() { u64::MAX } else { number(to) };
            match number(from) < bytes {
                true => Span::Part { first: number(from), last: last.min(bytes - 1) },
                false => Span::Nothing,
            }
        }
        (false, true) if from.is_empty() => match number(to).min(bytes) {
            0 => Span::Nothing,
            length => Span::Part { first: bytes - length, last: bytes - 1 },
        },
        _ => Span::Whole,
    }
}

pub(super) fn header_text(headers: &HeaderMap, name: header::HeaderName) -> Option<&str> {
    headers.get(name).and_then(|value| value.to_str().ok())
}

/// Whether one of the tags of a header is this one.
pub(super) fn has_tag(header: Option<&str>, tag: &str) -> bool {
    header.is_some_and(|list| {
        list.split(',')
            .map(|item| item.trim().trim_start_matches("W/"))
            .any(|item| item == "*" || item == tag)
    })
}

pub(super) fn value(text: &str) -> HeaderValue {
    HeaderValue::from_str(text).unwrap_or(HeaderValue::from_static(""))
}

/// The tag of a file with this hash, and the headers that say what it is.
pub(super) fn described(name: &str, sha256: &str) -> (String, HeaderMap) {
    let tag = format!("\"{sha256}\"");
    let mut headers = HeaderMap::new();
    headers.insert(header::ETAG, value(&tag));
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type(name)));
    // Results never change; whoever has a file has it for ever, but must ask whether it is still there.
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("private, no-cache"));
    (tag, headers)
}

async fn serve(app: &App, id: &str, name: &str, headers: &HeaderMap) -> Result<Response, Problem> {
    let Found { path, entry } = locate(app, id, name).await?;
    let (tag, mut answer) = described(name, &entry.sha256);
    answer.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    if has_tag(header_text(headers, header::IF_NONE_MATCH), &tag) {
        return Ok((StatusCode::NOT_MODIFIED, answer).into_response());
    }
    let same = header_text(headers, header::IF_RANGE).is_none_or(|condition| condition.trim() == tag);
    let asked = header_text(headers, header::RANGE).filter(|_| same);
    let (status, first, length) = match span(asked, entry.bytes) {
        Span::Whole => (StatusCode::OK, 0, entry.bytes),
        Span::Part { first, last } => {
            answer.insert(header::CONTENT_RANGE, value(&format!("bytes {first}-{last}/{}", entry.bytes)));
            (StatusCode::PARTIAL_CONTENT, first, last - first + 1)
        }
        Span::Nothing => {
            let mut response =
                Kind::Range.with(format!("the file has {} bytes", entry.bytes)).into_response();
            response.headers_mut().insert(header::CONTENT_RANGE, value(&format!("bytes */{}", entry.bytes)));
            return Ok(response);
        }
    };
    let gone = |error: io::Error| {
        tracing::warn!(path = %path.display(), %error, "a file of a bundle cannot be read");
        no_artifact(name)
    };
    let mut file = tokio::fs::File::open(&path).await.map_err(gone)?;
    file.seek(io::SeekFrom::Start(first)).await.map_err(gone)?;
    answer.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    let body = Body::from_stream(ReaderStream::with_capacity(file.take(length), CHUNK));
    Ok((status, answer, body).into_response())
}

/// A small file as a whole; one that went away meanwhile is none.
pub async fn serve_file(path: &Path, name: &str, headers: &HeaderMap) -> Response {
    let Ok(bytes) = tokio::fs::read(path).await else { return no_artifact(name).into_response() };
    let (tag, answer) = described(name, &hex(&Sha256::digest(&bytes)));
    if has_tag(header_text(headers, header::IF_NONE_MATCH), &tag) {
        return (StatusCode::NOT_MODIFIED, answer).into_response();
    }
    (answer, bytes).into_response()
}

/// A file of a scan
///
/// `cloud.ply`, `report.json`, `frames.npy`, `maps.npz`, `manifest.json` and whatever else its `artifacts` list.
#[utoipa::path(
    get, path = "/v1/scans/{id}/{name}", tag = "artifacts",
    params(("id" = String, Path), ("name" = String, Path, description = "Name of the file")),
    responses(
        (status = 200, description = "The file", content(
            ([u8] = "application/octet-stream"), (Object = "application/json"), (String = "application/toml"),
            ([u8] = "application/zip"), ([u8] = "image/png"))),
        (status = 206, description = "A part of it", content(
            ([u8] = "application/octet-stream"), (Object = "application/json"), (String = "application/toml"),
            ([u8] = "application/zip"), ([u8] = "image/png"))),
        (status = 304, description = "The client has it"),
        (status = 404, description = "Unknown scan, or it has no such file", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json"),
        (status = 416, description = "No such bytes", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_artifact(
    Shared(app): Shared<App>,
    Id(id): Id,
    part: Result<Part<(String, String)>, axum::extract::rejection::PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Part((_, name)) = part.map_err(|_| no_artifact("that"))?;
    serve(&app, &id, &name, &headers).await
}

/// The result in words
///
/// What a person wants to know of a scan, as text of fixed width.
#[utoipa::path(
    get, path = "/v1/scans/{id}/summary.txt", tag = "artifacts", params(("id" = String, Path)),
    responses(
        (status = 200, description = "The summary", content_type = "text/plain", body = String),
        (status = 404, description = "Unknown scan, or it has no report", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_summary(Shared(app): Shared<App>, Id(id): Id) -> Result<Response, Problem> {
    let found = locate(&app, &id, "report.json").await?;
    let read = move || {
        let report: Report = serde_json::from_slice(&std::fs::read(found.path).ok()?).ok()?;
        Some(summary(&report, None))
    };
    let text = app.blocking(read).await?.ok_or_else(|| no_artifact("summary.txt"))?;
    Ok(([(header::CONTENT_TYPE, "text/plain; charset=utf-8")], text).into_response())
}

/// A picture of a map
#[utoipa::path(
    get, path = "/v1/scans/{id}/maps/{name}", tag = "artifacts",
    params(("id" = String, Path), ("name" = String, Path, description = "`depth.png`, `column.png`, `dolp.png` and others")),
    responses(
        (status = 200, description = "The picture", content_type = "image/png", body = [u8]),
        (status = 404, description = "Unknown scan, or it has no such map", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_map(
    Shared(app): Shared<App>,
    Id(id): Id,
    part: Result<Part<(String, String)>, axum::extract::rejection::PathRejection>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let Part((_, name)) = part.map_err(|_| no_artifact("that"))?;
    serve(&app, &id, &format!("maps/{name}"), &headers).await
}

/// All files of a scan as one archive
#[utoipa::path(
    get, path = "/v1/scans/{id}/bundle.zip", tag = "artifacts", params(("id" = String, Path)),
    responses(
        (status = 200, description = "The archive, stored without compression", content_type = "application/zip", body = [u8]),
        (status = 404, description = "Unknown scan, or it has no files", body = ProblemBody, content_type = "application/problem+json"),
        (status = 409, description = "Not yet", body = ProblemBody, content_type = "application/problem+json")))]
pub async fn get_bundle(Shared(app): Shared<App>, Id(id): Id) -> Result<Response, Problem> {
    let record = find(&app, &id).await?;
    if !record.state.is_terminal() {
        return Err(not_finished(&record));
    }
    let folder = app.scanner.folder().join(&record.id);
    let listed = folder.clone();
    let found = app.blocking(move || manifest(&listed)).await?;
    let Some((manifest, own)) = found else { return Err(no_artifact("bundle.zip")) };
    let mut files: Vec<(String, u64)> =
        manifest.files.into_iter().map(|(name, entry)| (name, entry.bytes)).collect();
    files.push((FILE_NAME.to_owned(), own.bytes));
    let (sender, receiver) = tokio::sync::mpsc::channel(CHUNKS);
    let place = Arc::new(app.stream_place()?);
    tokio::task::spawn_blocking(move || {
        let _place = place;
        let mut out = Channel(sender.clone());
        if let Err(error) = archive(&folder, &id, &files, &mut out) {
            // The client sees a body that breaks off; where it went away itself, nobody is left to tell.
            let _ = sender.blocking_send(Err(error));
        }
    });
    let stream = futures_util::stream::unfold(receiver, |mut receiver| async move {
        receiver.recv().await.map(|chunk| (chunk, receiver))
    });
    let name = format!("attachment; filename=\"{}.zip\"", record.id);
    let headers = [
        (header::CONTENT_TYPE, HeaderValue::from_static("application/zip")),
        (
            header::CONTENT_DISPOSITION,
            HeaderValue::from_str(&name).unwrap_or(HeaderValue::from_static("attachment")),
        ),
    ];
    Ok((headers, Body::from_stream(stream)).into_response())
}

/// Writes into a channel, and waits for the client where it is full.
struct Channel(tokio::sync::mpsc::Sender<io::Result<Bytes>>);

impl Write for Channel {
    fn write(&mut self, data: &[u8]) -> io::Result<usize> {
        let chunk = Bytes::copy_from_slice(data);
        self.0.blocking_send(Ok(chunk)).map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe))?;
        Ok(data.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

fn archive(folder: &Path, id: &str, files: &[(String, u64)], out: &mut Channel) -> io::Result<()> {
    let mut zip = zip::ZipWriter::new_stream(io::BufWriter::with_capacity(CHUNK, out));
    for (name, bytes) in files {
        let options = zip::write::SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored)
            .large_file(*bytes >= u64::from(u32::MAX));
        zip.start_file(format!("{id}/{name}"), options).map_err(io::Error::other)?;
        let mut file = std::fs::File::open(folder.join(name))?;
        io::copy(&mut file, &mut zip)?;
    }
    let out = zip.finish().map_err(io::Error::other)?;
    out.into_inner().flush()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn ranges_as_in_the_standard() {
        let cases = [
            (None, Span::Whole),
            (Some("bytes=0-0"), Span::Part { first: 0, last: 0 }),
            (Some("bytes=2-"), Span::Part { first: 2, last: 9 }),
            (Some("bytes=2-100"), Span::Part { first: 2, last: 9 }),
            (Some("bytes=-3"), Span::Part { first: 7, last: 9 }),
            (Some("bytes=-100"), Span::Part { first: 0, last: 9 }),
            (Some("bytes=10-"), Span::Nothing),
            (Some("bytes=-0"), Span::Nothing),
            (Some("bytes=5-3"), Span::Whole),
            (Some("bytes=0-1,3-4"), Span::Whole),
            (Some("rows=0-1"), Span::Whole),
            (Some("bytes=a-b"), Span::Whole),
            (Some("bytes="), Span::Whole),
            (Some("bytes=99999999999999999999-"), Span::Nothing),
        ];
        for (range, expected) in cases {
            assert_eq!(span(range, 10), expected, "{range:?}");
        }
        assert_eq!(span(Some("bytes=0-"), 0), Span::Nothing);
        assert_eq!(span(Some("bytes=-1"), 0), Span::Nothing);
    }

    proptest! {
        #[test]
        fn a_part_lies_within_the_file(range in "bytes=[0-9]{0,21}-[0-9]{0,21}", bytes in 0u64..1000) {
            if let Span::Part { first, last } = span(Some(&range), bytes) {
                prop_assert!(first <= last && last < bytes);
            }
        }
    }
}
