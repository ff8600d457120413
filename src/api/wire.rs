//! Scans as clients write and read them.

use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::{artifacts::Artifact, document::Tag};
use crate::scanner::Record;

/// What a scan is asked for with. Everything may be left out.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ScanRequest {
    /// `pse`, `fast`, `paper` or `gray`; the configured mode where it is left out.
    #[schema(pattern = "^(pse|fast|paper|gray)$")]
    pub mode: Option<String>,
    /// Name for a person.
    #[schema(max_length = 200, pattern = r"^[^\x00-\x1f\x7f-\x9f]*$")]
    pub label: Option<String>,
    /// For sorting and searching.
    #[schema(max_items = 32, value_type = Vec<Tag>)]
    pub tags: Vec<String>,
    /// Exposure in microseconds, 1 to 30 000 000; the configured one where it is left out.
    #[schema(minimum = 1.0, maximum = 30e6)]
    pub exposure_us: Option<f64>,
    /// Number of scans, one after the other. Each is a scan of its own; the answer names the first and lists all.
    #[serde(deserialize_with = "whole")]
    #[schema(minimum = 1, maximum = 1000)]
    pub repeat: Option<usize>,
    /// Whether to wait for other scans instead of being refused.
    pub queue: bool,
}

/// A whole number, however it is written: to JSON Schema, and to the JSON of some languages, 3.0 is one.
fn whole<'de, D: serde::Deserializer<'de>>(input: D) -> Result<Option<usize>, D::Error> {
    let number = Option::<serde_json::Number>::deserialize(input)?;
    let count = |number: serde_json::Number| {
        let exact = number.as_u64().or_else(|| {
            // Beyond 2^53 neighbours of a float are not whole numbers any more; nobody counts that far.
            let float =
                number.as_f64().filter(|float| float.fract() == 0.0 && (0.0..=9e15).contains(float))?;
            Some(float as u64)
        });
        let count = exact.and_then(|exact| usize::try_from(exact).ok());
        count.ok_or_else(|| serde::de::Error::custom(format!("{number} is no number of scans")))
    };
    number.map(count).transpose()
}

/// How a scan is decoded again.
#[derive(Debug, Default, Serialize, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ReprocessRequest {
    /// Mode, where it is not that of the recorded frames.
    #[schema(pattern = "^(pse|fast|paper|gray)$")]
    pub mode: Option<String>,
    /// Name of the result; that of the source where it is left out.
    #[schema(max_length = 200, pattern = r"^[^\x00-\x1f\x7f-\x9f]*$")]
    pub label: Option<String>,
    /// Tags of the result.
    #[schema(max_items = 32, value_type = Vec<Tag>)]
    pub tags: Vec<String>,
}

/// What may be changed about a scan. What is left out stays.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ScanPatch {
    /// Name for a person; `null` removes it.
    #[serde(default, deserialize_with = "given")]
    #[schema(value_type = Option<String>, max_length = 200, pattern = r"^[^\x00-\x1f\x7f-\x9f]*$")]
    pub label: Option<Option<String>>,
    /// All tags.
    #[serde(default)]
    #[schema(max_items = 32, value_type = Option<Vec<Tag>>)]
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
    #[param(
        pattern = "^((queued|projecting|acquired|decoding|done|failed|cancelled|interrupted)?,)*(queued|projecting|acquired|decoding|done|failed|cancelled|interrupted)?$"
    )]
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
    #[param(minimum = 1, maximum = 500)]
    pub limit: Option<usize>,
    /// `next` of the page before.
    #[param(pattern = "~")]
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_number_may_be_written_as_a_float() {
        let repeat = |text: &str| {
            let read = serde_json::from_str::<ScanRequest>(&format!(r#"{{"repeat": {text}}}"#));
            read.map(|asked| asked.repeat).map_err(|_| ())
        };
        assert_eq!((repeat("3"), repeat("3.0"), repeat("null")), (Ok(Some(3)), Ok(Some(3)), Ok(None)));
        for wrong in ["3.5", "-1", "-1.0", "1e300", "\"3\"", "true"] {
            assert_eq!(repeat(wrong), Err(()), "{wrong}");
        }
    }
}
