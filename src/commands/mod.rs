//! What each command of the program does: reads, calls the pure parts, writes, prints.

mod decode;
mod devices;
mod failure;
mod patterns;
mod pictures;
mod progress;
mod results;
mod scan;

use std::io::Write;

pub use decode::{DecodeArgs, decode};
pub use devices::{config_is_good, devices};
pub use failure::{Failure, USAGE, print_failure};
pub use patterns::{Size, patterns};
pub use scan::scan;

/// Prints a line to stdout. A reader that has gone away is no error of ours.
fn say(text: impl std::fmt::Display) {
    let _ = writeln!(std::io::stdout().lock(), "{text}");
}
