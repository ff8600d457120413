//! `polscan token`, `polscan store` and `polscan openapi`: what an operator does beside the service.

use std::{path::Path, time::SystemTime};

use super::say;
use crate::{
    api::{self, Scope, Tokens},
    config::Settings,
    engine::Failure,
    store::{Library, time::rfc3339_utc},
};

/// Adds a token to a file and prints it: it cannot be shown again.
pub fn add_token(file: &Path, name: &str, scope: Scope, json: bool) -> Result<u8, Failure> {
    let token = api::add_token(file, name, scope)
        .map_err(|error| Failure::storage(format!("add the token {name}"), error))?;
    match json {
        true => say(serde_json::json!({ "name": name, "scope": scope.to_string(), "token": token })),
        false => say(token),
    }
    Ok(0)
}

/// Prints what a file of tokens allows whom.
pub fn list_tokens(file: &Path, json: bool) -> Result<u8, Failure> {
    let tokens = Tokens::read(file).map_err(|error| Failure::storage("list the tokens of a file", error))?;
    if json {
        let all: Vec<_> = tokens
            .names()
            .map(|(name, scope)| serde_json::json!({ "name": name, "scope": scope.to_string() }))
            .collect();
        say(serde_json::json!({ "tokens": all }));
    } else {
        tokens.names().for_each(|(name, scope)| say(format_args!("{name} {scope}")));
    }
    Ok(0)
}

/// Takes a token out of a file.
pub fn revoke_token(file: &Path, name: &str, json: bool) -> Result<u8, Failure> {
    api::revoke_token(file, name)
        .map_err(|error| Failure::storage(format!("revoke the token {name}"), error))?;
    match json {
        true => say(serde_json::json!({ "revoked": name })),
        false => say(format_args!("{name} is revoked")),
    }
    Ok(0)
}

/// Makes the index of the store again from its bundles. The service must not run.
pub fn reindex(settings: &Settings, json: bool) -> Result<u8, Failure> {
    let fail = |error| Failure::storage("make the index again", error);
    let library = Library::open(Path::new(&settings.raw.store.dir)).map_err(fail)?;
    let (_, recovery) = library.reindex(&rfc3339_utc(SystemTime::now())).map_err(fail)?;
    let scans = recovery.found.len() + recovery.interrupted.len();
    match json {
        true => say(
            serde_json::json!({ "store": library.folder(), "scans": scans, "interrupted": recovery.interrupted }),
        ),
        false => say(format_args!("{}: {scans} scans in the index", library.folder().display())),
    }
    Ok(0)
}

/// Prints the API document.
pub fn openapi() -> u8 {
    say(api::openapi().trim_end());
    0
}
