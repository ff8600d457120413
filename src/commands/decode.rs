//! `polscan decode`: recorded frames, ours or foreign, to maps, cloud and report.

use std::path::Path;

use super::print_result;
use crate::engine::{self, DecodeRequest, Failure, Label, new_id};

/// Decodes and writes into the folder `out`; returns the exit code.
pub fn decode(request: &DecodeRequest, out: &Path, json: bool) -> Result<u8, Failure> {
    let report = engine::decode(request, Label { id: new_id(), ..Label::default() }, out)?;
    Ok(print_result(&report, out, json))
}
