//! Photon transfer: gain, read noise, black level, linearity, saturation.
//!
//! The camera sees one picture at several exposure times, several frames each. Differences of two frames of one level
//! hold temporal noise alone, whatever the picture and whatever the pixels differ in (EMVA 1288, section 6):
//!
//! ```text
//! variance = read_noise^2 + K (level - black) + 1/12
//! level    = black + rate * exposure
//! ```
//!
//! The 1/12 DN^2 of rounding holds only where noise spreads a level over neighbouring values, so that levels with less
//! noise take no part in the fits.

mod level;
mod pixels;
mod transfer;

pub use level::{Level, Meter};
pub use pixels::{BadPixels, bad_pixels, clip_level_dn, evenly_lit};
pub use transfer::{Linearity, Noise, NoiseError, solve};
