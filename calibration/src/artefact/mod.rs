//! Acceptance: does the rig still measure a known artefact as it should?
//!
//! Plates, steps and balls that somebody else has measured, each seen in a rectangle of the camera's image, are fitted in a cloud
//! and compared with what they are. The quantities are those of VDI/VDE 2634 part 2: form of a plane, distance of two balls,
//! diameter of a ball; a step is the distance of two planes.

mod description;
mod fit;
mod judge;

pub use description::{Artefact, ArtefactError, Ball, Distance, Plane, Region, Step};
pub use fit::{FitError, FittedPlane, FittedSphere, Point, robust_plane, robust_sphere};
pub use judge::{Accepted, Check, Kind, PixelPoint, judge};
