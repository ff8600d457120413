//! Optics of camera and projector and the pose between them, from views of a board: a session of scans on the disk, what
//! was seen in them, what is still missing, and the solution. Command line and service share it.

mod pictures;
mod session;
mod solve;
mod steps;
mod take;
mod views;

pub use session::Session;
pub use solve::{Subject, setup, solve};
pub use steps::{Cells, MOST_VIEWS, SessionState, SessionView, Step, Task, compute, run};
pub use take::{Shot, take};
pub use views::{Views, name_of, number_of, read_picture};
