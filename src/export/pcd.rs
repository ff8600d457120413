//! PCD 0.7, binary and organised: one place per camera pixel, NaN where there is no point.

use std::io::{self, BufWriter, Write};

use super::cloud::{Organised, Origin};
use crate::cloud::PlyPoint;

/// Bytes of a place: eight floats and the flags.
const PLACE_BYTES: usize = 33;

/// Writes the whole grid, in mm like the cloud itself.
pub fn write(out: &mut dyn Write, cloud: &Organised, origin: &Origin) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, out);
    out.write_all(header(cloud, origin).as_bytes())?;
    let nowhere = place([f32::NAN; 8], 0);
    let mut measured = cloud.pixels.iter().zip(&cloud.points).peekable();
    for pixel in 0..cloud.width * cloud.height {
        match measured.next_if(|(at, _)| **at == pixel) {
            Some((_, point)) => out.write_all(&of(point))?,
            None => out.write_all(&nowhere)?,
        }
    }
    out.flush()
}

fn header(cloud: &Organised, origin: &Origin) -> String {
    let ([x, y, z], [qw, qx, qy, qz]) = cloud.viewpoint();
    let (width, height) = (cloud.width, cloud.height);
    format!(
        "# .PCD v0.7 - Point Cloud Data file format\n# polscan, scan {}, lengths in mm\nVERSION 0.7\n\
         FIELDS x y z normal_x normal_y normal_z intensity sigma_z flags\nSIZE 4 4 4 4 4 4 4 4 1\n\
         TYPE F F F F F F F F U\nCOUNT 1 1 1 1 1 1 1 1 1\nWIDTH {width}\nHEIGHT {height}\n\
         VIEWPOINT {x} {y} {z} {qw} {qx} {qy} {qz}\nPOINTS {}\nDATA binary\n",
        super::cloud::one_line(&origin.id),
        width * height
    )
}

fn of(point: &PlyPoint) -> [u8; PLACE_BYTES] {
    let ([x, y, z], [nx, ny, nz]) = (point.point_mm, point.normal);
    place([x, y, z, nx, ny, nz, f32::from(point.intensity), point.sigma_z_mm], point.flags)
}

fn place(floats: [f32; 8], flags: u8) -> [u8; PLACE_BYTES] {
    let mut bytes = [0; PLACE_BYTES];
    for (to, value) in bytes.chunks_exact_mut(4).zip(floats) {
        to.copy_from_slice(&value.to_le_bytes());
    }
    bytes[PLACE_BYTES - 1] = flags;
    bytes
}
