//! One pinhole with Brown-Conrady distortion: a camera, or a projector taken as its inverse.

/// Intrinsics of a camera or projector. Pixel centres lie at integers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lens {
    /// Size in pixels.
    pub width: u32,
    /// Size in pixels.
    pub height: u32,
    /// Focal length along x in pixels.
    pub fx: f64,
    /// Focal length along y in pixels.
    pub fy: f64,
    /// Principal point in pixels.
    pub cx: f64,
    /// Principal point in pixels.
    pub cy: f64,
    /// k1, k2, p1, p2, k3 in OpenCV's order and meaning.
    pub distortion: [f64; 5],
}
