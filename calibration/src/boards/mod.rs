//! Calibration boards: what they are, how they are printed, and where they are in an image.

mod crossings;
mod description;
mod detect;
mod dictionary;
mod discs;
mod identify;
mod lattice;
pub mod pdf;
mod picture;
mod plane;
pub mod print;
mod refine;
#[cfg(test)]
mod tests;

pub use description::{
    BAR_MM, Board, Charuco, Checkerboard, Circles, MAX_PRINT_ERROR, Pattern, Point, SCHEMA, Tones,
};
pub use detect::{DetectError, DetectSettings, Found, FoundCorner, detect};
pub use dictionary::Dictionary;
pub use picture::Picture;
pub use plane::{PlaneInput, plane_points};
