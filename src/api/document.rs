//! The API document: what the handlers say of themselves, and what holds for all of them alike.

use utoipa::{
    OpenApi, ToSchema,
    openapi::{
        Content, HttpMethod, OpenApi as Whole, Ref, RefOr, Response,
        path::{Operation, ParameterIn},
        security::{HttpAuthScheme, HttpBuilder, SecurityRequirement, SecurityScheme},
    },
};

/// Operations that are answered whoever asks.
const PROBES: [&str; 2] = ["/livez", "/readyz"];

/// Name of the way in which a client says who it is.
const BEARER: &str = "token";

#[derive(OpenApi)]
#[openapi(
    info(
        title = "polscan",
        description = "A structured-light scanner for objects too shiny and too black for others: ask for a scan, get its cloud.",
        license(name = "MIT OR Apache-2.0", identifier = "MIT OR Apache-2.0")
    ),
    tags(
        (name = "scans", description = "Ask for scans, look at them, stop, change and delete them"),
        (name = "artifacts", description = "Files of a scan"),
        (name = "calibrations", description = "Measure what the rig is like"),
        (name = "live", description = "What goes on while it goes on"),
        (name = "service", description = "The service itself")
    )
)]
pub struct Document;

/// A name for sorting and searching, as the document describes it.
#[derive(ToSchema)]
#[schema(pattern = r"^[^\x00-\x1f\x7f-\x9f]{1,64}$")]
#[expect(dead_code, reason = "only its schema is used")]
pub struct Tag(String);

/// Adds what no handler says because it holds for all: answers of what goes before handlers, and of their inputs.
pub fn complete(mut document: Whole) -> Whole {
    for (path, item) in &mut document.paths.paths {
        for (method, operation) in [
            (HttpMethod::Get, &mut item.get),
            (HttpMethod::Put, &mut item.put),
            (HttpMethod::Post, &mut item.post),
            (HttpMethod::Delete, &mut item.delete),
            (HttpMethod::Patch, &mut item.patch),
        ] {
            if let Some(operation) = operation {
                complete_operation(path, &method, operation);
            }
        }
    }
    let bearer = HttpBuilder::new()
        .scheme(HttpAuthScheme::Bearer)
        .description(Some(
            "Needed where the service has tokens; without them only its own machine is served.",
        ))
        .build();
    let components = document.components.get_or_insert_default();
    components.security_schemes.insert(BEARER.to_owned(), SecurityScheme::Http(bearer));
    document
}

fn complete_operation(path: &str, method: &HttpMethod, operation: &mut Operation) {
    let is_probe = PROBES.contains(&path);
    // Whether anything is needed is for the service's configuration: none, or a token.
    if !is_probe {
        let token = SecurityRequirement::new::<_, [&str; 0], &str>(BEARER, []);
        operation.security = Some(vec![SecurityRequirement::default(), token]);
        add(operation, "401", "There are tokens, and none of them came along");
        add(operation, "503", "Too many requests at once");
    }
    add(
        operation,
        "403",
        "The token does not reach so far, or the request comes from a page of somebody else's",
    );
    let takes_query = operation
        .parameters
        .iter()
        .flatten()
        .any(|parameter| !matches!(parameter.parameter_in, ParameterIn::Path));
    let takes_body = matches!(method, HttpMethod::Post | HttpMethod::Put | HttpMethod::Patch);
    if takes_query || takes_body {
        add(operation, "422", "Asks for something that cannot be");
    }
    if takes_body {
        add(operation, "400", "No JSON");
        add(operation, "408", "The body did not come in time");
        add(operation, "413", "Too long");
        add(operation, "415", "Not application/json");
    }
}

/// Adds a problem, unless the handler has said it in its own words.
fn add(operation: &mut Operation, status: &str, description: &str) {
    let problem = || {
        let body = Content::new(Some(RefOr::Ref(Ref::from_schema_name("ProblemBody"))));
        let mut response = Response::new(description);
        response.content.insert("application/problem+json".to_owned(), body);
        RefOr::T(response)
    };
    operation.responses.responses.entry(status.to_owned()).or_insert_with(problem);
}
