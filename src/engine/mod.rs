//! One scan, from settings to a bundle, without a user interface: the command line and the service both come through
//! here. [`Scan::prepare`] needs the rig for a moment, [`Scan::capture`] for as long as frames are taken, and
//! [`Scan::finish`] not at all, so that the next scan may be captured while one is decoded.

mod failure;
mod pictures;
mod recorded;
mod results;
mod salvage;
mod scan;
mod setup;
mod shown;

pub use failure::{Failure, Kind};
pub use recorded::{DecodeRequest, Recorded, decode};
pub use results::{Results, new_id, write, write_unfinished};
pub use salvage::salvage;
pub use scan::{Label, Scan, Taken, rig_failure};
pub use shown::{Shown, hold};
