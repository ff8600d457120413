//! Scans as clients write and read them.

use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::artifacts::Artifact;
use crate::scanner::Record;

/// What a scan is asked for with. Everything may be left out.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ScanRequest {
    /// `pse`, `fast`, `paper` or `gray`; the configured mode where it is left out.
    pub mode: Option<String>,
    /// Name for a person.
    pub label: Option<String>,
    /// For sorting and searching.
    pub tags: Vec<String>,
    /// Exposure in microseconds, 1 to 30 000 000; the configured one where it is left out.
    pub exposure_us: Option<f64>,
    /// Number of scans, one after the other. Each is a scan of its own; the answer names the first and lists all.
    pub repeat: Option<usize>,
    /// Whether to wait for other scans instead of being refused.
    pub queue: bool,
}

/// How a scan is decoded again.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReprocessRequest {
    /// Mode, where it is not that of the recorded frames.
    pub mode: Option<String>,
    /// Name of the result; that of the source where it is left out.
    pub label: Option<String>,
    /// Tags of the result.
    pub tags: Vec<String>,
}

/// What may be changed about a scan. What is left out stays.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ScanPatch {
    /// Name for a person; `null` removes it.
    #[serde(default, deserialize_with = "given")]
    #[schema(value_type = Option<String>)]
    pub label: Option<Option<String>>,
    /// All tags.
    #[serde(default)]
    pub tags: Option<Vec<String>>,
    /// Whether retention leaves it alone.
    #[serde(default)]
    pub pinned: Option<bool>,
}

/// Tells `null` from what was left out.
fn given<'de, D: serde::Deserializer<'de>>(input: D) -> Result<Option<Option<String>>, D::Error> {
    Option::<String>::deserialize(input).map(Some)
}

/// What an answer waits for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize, ToSchema)]
#[serde(rename_all = "lowercase")]
pub enum Wait {
    /// All frames are taken: the object may move.
    Acquired,
    /// There is a result, or there will be none.
    Done,
}

/// What an answer waits for.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
pub struct WaitParams {
    /// `acquired`: until the object may move; `done`: until the scan is at its end. After `api.wait_limit_s` the answer
    /// comes in any case, and `state` says how far it is.
    #[param(inline)]
    pub wait: Option<Wait>,
}

/// A scan as it is answered.
#[derive(Debug, Serialize, ToSchema)]
pub struct Scan {
    #[serde(flatten)]
    pub record: Record,
    /// Address of the scan.
    pub href: String,
    /// Its files; empty before there are any.
    pub artifacts: Vec<Artifact>,
    /// All scans of the request, where it asked for several.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub scans: Vec<String>,
}

impl Scan {
    /// A scan whose files are not listed.
    pub fn new(record: &Record) -> Self {
        let href = format!("/v1/scans/{}", record.id);
        Self { record: record.clone(), href, artifacts: Vec::new(), scans: Vec::new() }
    }
}

/// Which scans are listed.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[into_params(parameter_in = Query)]
#[serde(deny_unknown_fields, default)]
pub struct ListParams {
    /// States, separated by commas.
    pub state: Option<String>,
    /// `ok`, `degraded` or `failed`.
    pub verdict: Option<String>,
    /// Mode.
    pub mode: Option<String>,
    /// Label, in full.
    pub label: Option<String>,
    /// Tags, separated by commas; a scan must have all of them.
    pub tag: Option<String>,
    /// Pinned or not.
    pub pinned: Option<bool>,
    /// Accepted at or after this time, RFC 3339, UTC.
    pub since: Option<String>,
    /// Accepted before this time, RFC 3339, UTC.
    pub until: Option<String>,
    /// Number of scans of a page, 1 to 500; 50 where it is left out.
    pub limit: Option<usize>,
    /// `next` of the page before.
    pub cursor: Option<String>,
}

/// A page of scans, the newest first.
#[derive(Debug, Serialize, ToSchema)]
pub struct Page {
    /// The scans; their files are listed by each scan itself.
    pub scans: Vec<Scan>,
    /// `cursor` of the next page; `null` on the last.
    pub next: Option<String>,
}
