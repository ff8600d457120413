//! Wavefront OBJ: vertices with normals, and triangles.

use std::io::{self, BufWriter, Write};

use super::{
    cloud::{Organised, Origin, one_line},
    mesh::Mesh,
};

/// Writes all points as vertices in the order of the cloud, and the triangles over them.
pub fn write(out: &mut dyn Write, cloud: &Organised, mesh: &Mesh, origin: &Origin) -> io::Result<()> {
    let mut out = BufWriter::with_capacity(1 << 20, out);
    writeln!(out, "# polscan, scan {}, lengths in mm", one_line(&origin.id))?;
    for point in &cloud.points {
        let [x, y, z] = point.point_mm;
        writeln!(out, "v {x} {y} {z}")?;
    }
    for [x, y, z] in &mesh.normals {
        writeln!(out, "vn {x} {y} {z}")?;
    }
    // The format counts from 1.
    for [a, b, c] in mesh.triangles.iter().map(|corners| corners.map(|corner| corner + 1)) {
        writeln!(out, "f {a}//{a} {b}//{b} {c}//{c}")?;
    }
    out.flush()
}
