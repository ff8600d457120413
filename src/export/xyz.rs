//! Points as text: `x y z nx ny nz intensity sigma_z`, one a line, no heading, so that programs that know only the first three
//! or six columns read the file as well.

use std::io::{self, BufWriter, Write};

use super::cloud::Organised;

/// Writes all points, each number with as many digits as tell it from its neighbours.
pub fn write(out: &mut dyn Write, cloud: &Organised) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, out);
    for point in &cloud.points {
        let ([x, y, z], [nx, ny, nz]) = (point.point_mm, point.normal);
        writeln!(out, "{x} {y} {z} {nx} {ny} {nz} {} {}", point.intensity, point.sigma_z_mm)?;
    }
    out.flush()
}
