//! What each command of the program does: reads, calls the pure parts, writes, prints.

mod decode;
mod devices;
mod failure;
mod patterns;
mod pictures;
mod progress;
mod results;
mod scan;

pub use decode::{DecodeArgs, decode};
pub use devices::{config_is_good, devices};
pub use failure::{Failure, USAGE, print_failure};
pub use patterns::{Size, patterns};
pub use scan::scan;
