//! Entry point of the `polscan` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    ExitCode::from(polscan::cli::run())
}
