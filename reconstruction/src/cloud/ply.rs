//! Point clouds as binary little-endian PLY.

mod sample;

use std::io::{self, BufWriter, Write};

use thiserror::Error;

use super::Cloud;
use crate::grid::Grid;

pub use sample::{SampleError, sample_ply};

/// Properties of a vertex in order, with their PLY types: public, and tested from outside.
const PROPERTIES: [(&str, &str); 9] = [
    ("float", "x"),
    ("float", "y"),
    ("float", "z"),
    ("float", "nx"),
    ("float", "ny"),
    ("float", "nz"),
    ("uchar", "intensity"),
    ("float", "sigma_z"),
    ("uchar", "flags"),
];
/// Bytes of a vertex: seven floats and two bytes.
const VERTEX_BYTES: usize = 30;
/// A longer header is none of ours.
const MAX_HEADER: usize = 1 << 16;

/// Frame that the written points are in.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum CloudFrame {
    /// Camera frame: x right, y down, z forward.
    Camera,
    /// The calibration's world frame.
    World,
}

/// One vertex of a file.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlyPoint {
    /// Point in mm.
    pub point_mm: [f32; 3],
    /// Unit normal, or 0 0 0.
    pub normal: [f32; 3],
    /// Brightness.
    pub intensity: u8,
    /// Standard deviation along the camera's axis in mm.
    pub sigma_z_mm: f32,
    /// Bits of [`flag`](super::flag).
    pub flags: u8,
}

/// Why a file is no cloud of ours.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error("cannot read this PLY: {0}; write it again with this program")]
pub struct PlyError(String);

/// Writes the valid points of `cloud` in row-major order of their pixels; returns how many.
///
/// # Errors
/// Those of `out`. `InvalidInput` when `intensity` has another size than the cloud.
pub fn write_ply(
    out: impl Write,
    cloud: &Cloud,
    intensity: &Grid<u8>,
    frame: CloudFrame,
) -> io::Result<usize> {
    if intensity.len() != cloud.point_mm.len() {
        let message = "cannot write a PLY: the intensity has another size than the cloud";
        return Err(io::Error::new(io::ErrorKind::InvalidInput, message));
    }
    let valid = |i: &usize| cloud.point_mm.data()[*i].iter().all(|v| v.is_finite());
    let count = (0..cloud.point_mm.len()).filter(valid).count();
    let mut out = BufWriter::with_capacity(1 << 20, out);
    out.write_all(header(count, frame).as_bytes())?;
    for i in (0..cloud.point_mm.len()).filter(valid) {
        let sigma = cloud.sigma_z_mm.data()[i];
        let mut bytes = [0; VERTEX_BYTES];
        let floats = cloud.point_mm.data()[i].into_iter().chain(cloud.normal.data()[i]);
        for (place, value) in bytes.chunks_exact_mut(4).zip(floats) {
            place.copy_from_slice(&value.to_le_bytes());
        }
        bytes[24] = intensity.data()[i];
        bytes[25..29].copy_from_slice(&sigma.to_le_bytes());
        bytes[29] = cloud.flags.data()[i];
        out.write_all(&bytes)?;
    }
    out.flush()?;
    Ok(count)
}

fn header(count: usize, frame: CloudFrame) -> String {
    let frame = match frame {
        CloudFrame::Camera => "camera frame, x right, y down, z forward",
        CloudFrame::World => "world frame of the calibration",
    };
    let mut header = format!(
        "ply\nformat binary_little_endian 1.0\ncomment polscan\ncomment units mm\ncomment frame {frame}\n\
         comment sigma_z standard deviation of the depth along the camera axis, mm\n\
         comment flags bits: 0 edge, 1 half saturated, 2 inverted, 3 interpolated, 4 near a silhouette\n\
         element vertex {count}\n"
    );
    for (kind, name) in PROPERTIES {
        header.push_str(&format!("property {kind} {name}\n"));
    }
    header.push_str("end_header\n");
    header
}

/// Reads a file of [`write_ply`].
///
/// # Errors
/// [`PlyError`] for anything else, never a panic.
pub fn read_ply(bytes: &[u8]) -> Result<Vec<PlyPoint>, PlyError> {
    let head = Head::read(&bytes[..bytes.len().min(MAX_HEADER)])?;
    let body = &bytes[head.bytes..];
    if head.vertices.checked_mul(VERTEX_BYTES) != Some(body.len()) {
        return Err(length_differs());
    }
    Ok(body.chunks_exact(VERTEX_BYTES).map(vertex).collect())
}

fn length_differs() -> PlyError {
    PlyError("its length does not match the number of vertices".to_owned())
}

/// What comes before the vertices.
struct Head<'a> {
    text: &'a str,
    /// Its length with the line that ends it.
    bytes: usize,
    vertices: usize,
}

impl<'a> Head<'a> {
    /// Reads it from the beginning of a file, of which `bytes` are the first.
    fn read(bytes: &'a [u8]) -> Result<Self, PlyError> {
        let bad = |what: &str| PlyError(what.to_owned());
        let marker = b"end_header\n";
        let end = bytes.windows(marker.len()).position(|w| w == marker);
        let end = end.ok_or_else(|| bad("the header has no end"))?;
        let text = std::str::from_utf8(&bytes[..end]).map_err(|_| bad("the header is no text"))?;
        let mut lines = text.lines().filter(|line| !line.starts_with("comment"));
        if lines.next() != Some("ply") || lines.next() != Some("format binary_little_endian 1.0") {
            return Err(bad("it is not binary little endian PLY 1.0"));
        }
        let vertices: usize = lines
            .next()
            .and_then(|line| line.strip_prefix("element vertex "))
            .and_then(|count| count.parse().ok())
            .ok_or_else(|| bad("its first element is not the vertices"))?;
        if !lines.eq(PROPERTIES.iter().map(|(kind, name)| format!("property {kind} {name}"))) {
            return Err(bad("its properties are not those of a scan"));
        }
        Ok(Self { text, bytes: end + marker.len(), vertices })
    }
}

fn vertex(bytes: &[u8]) -> PlyPoint {
    let float = |at: usize| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    PlyPoint {
        point_mm: [float(0), float(4), float(8)],
        normal: [float(12), float(16), float(20)],
        intensity: bytes[24],
        sigma_z_mm: float(25),
        flags: bytes[29],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud() -> (Cloud, Grid<u8>) {
        let nan = f32::NAN;
        let points =
            vec![[nan; 3], [1.0, 2.0, 3.0], [4.5, -5.25, 1000.125], [nan; 3], [7.0, 8.0, 9.0], [nan; 3]];
        let normals = vec![[0.0; 3], [0.0, 0.0, -1.0], [0.0; 3], [0.0; 3], [0.6, 0.0, -0.8], [0.0; 3]];
        let cloud = Cloud {
            point_mm: Grid::from_vec(3, 2, points),
            normal: Grid::from_vec(3, 2, normals),
            sigma_z_mm: Grid::from_vec(3, 2, vec![nan, 0.5, 0.25, nan, 0.125, nan]),
            flags: Grid::from_vec(3, 2, vec![0, 1, 16, 0, 31, 0]),
        };
        (cloud, Grid::from_vec(3, 2, vec![0, 10, 200, 0, 255, 0]))
    }

    #[test]
    fn writes_valid_points_in_row_major_order() {
        let (cloud, intensity) = cloud();
        let mut bytes = Vec::new();
        assert_eq!(write_ply(&mut bytes, &cloud, &intensity, CloudFrame::Camera).unwrap(), 3);
        let read = read_ply(&bytes).unwrap();
        let expected = [(1, 0.5, 10, 1), (2, 0.25, 200, 16), (4, 0.125, 255, 31)];
        assert_eq!(read.len(), expected.len());
        for (point, (at, sigma_z_mm, intensity, flags)) in read.into_iter().zip(expected) {
            let (point_mm, normal) = (cloud.point_mm.data()[at], cloud.normal.data()[at]);
            assert_eq!(point, PlyPoint { point_mm, normal, intensity, sigma_z_mm, flags });
        }
    }

    #[test]
    fn the_header_is_the_public_one() {
        let text = header(7, CloudFrame::World);
        let properties: Vec<&str> = text.lines().filter_map(|l| l.strip_prefix("property ")).collect();
        assert_eq!(
            properties,
            [
                "float x",
                "float y",
                "float z",
                "float nx",
                "float ny",
                "float nz",
                "uchar intensity",
                "float sigma_z",
                "uchar flags"
            ]
        );
        assert!(text.starts_with("ply\nformat binary_little_endian 1.0\ncomment "));
        assert!(text.contains("comment units mm\n") && text.contains("comment frame world"));
        assert!(text.contains("element vertex 7\n") && text.ends_with("end_header\n"));
    }

    #[test]
    fn an_empty_cloud_is_a_file() {
        let (mut cloud, intensity) = cloud();
        cloud.point_mm = Grid::filled(3, 2, [f32::NAN; 3]);
        let mut bytes = Vec::new();
        assert_eq!(write_ply(&mut bytes, &cloud, &intensity, CloudFrame::Camera).unwrap(), 0);
        assert_eq!(read_ply(&bytes).unwrap(), []);
    }

    #[test]
    fn the_reader_refuses_other_files() {
        let (cloud, intensity) = cloud();
        let mut bytes = Vec::new();
        write_ply(&mut bytes, &cloud, &intensity, CloudFrame::Camera).unwrap();
        for cut in 0..bytes.len() {
            assert!(read_ply(&bytes[..cut]).is_err(), "{cut}");
        }
        assert!(
            read_ply(b"ply\nformat ascii 1.0\nelement vertex 99999999999999999999\nend_header\n").is_err()
        );
    }

    #[test]
    fn errors_of_the_target_are_passed_on() {
        struct Full;
        impl Write for Full {
            fn write(&mut self, _: &[u8]) -> io::Result<usize> {
                Err(io::Error::from(io::ErrorKind::StorageFull))
            }
            fn flush(&mut self) -> io::Result<()> {
                Ok(())
            }
        }
        let (cloud, intensity) = cloud();
        let error = write_ply(Full, &cloud, &intensity, CloudFrame::Camera).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull);
    }
}
