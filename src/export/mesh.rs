//! A surface through the points of neighbouring camera pixels.

use super::cloud::Organised;

/// Two neighbours whose depths differ by up to this many sigma of each may be one surface: with equal sigmas that is 5 of the
/// difference, which noise alone exceeds once in a million edges.
const JUMP_SIGMAS: f64 = 3.5;

/// Tangent of 75 degrees: a surface seen more obliquely than that is not told from a step. Beyond it a pixel sees four times
/// its own width of depth, and normals are as good as lost.
const STEEPEST: f64 = 3.732;

/// No point at this pixel.
const NONE: u32 = u32::MAX;

/// Triangles over the points of an [`Organised`] cloud.
#[derive(Debug, Clone, PartialEq)]
pub struct Mesh {
    /// Indices of points, counter-clockwise as seen from the camera.
    pub triangles: Vec<[u32; 3]>,
    /// Unit normal of each point in the frame of the points: its own where it has one, else that of the triangles around it;
    /// 0 0 0 for a point that has neither.
    pub normals: Vec<[f32; 3]>,
}

/// What decides whether two pixels are neighbours on a surface: camera frame.
#[derive(Debug, Clone, Copy)]
struct Sample {
    /// x/z and y/z.
    ray: [f64; 2],
    depth_mm: f64,
    sigma_mm: f64,
}

/// Whether two neighbouring pixels see one surface.
///
/// Seen at an angle `a` to its normal, a surface rises by `footprint * tan a` from one pixel to the next, where the footprint is
/// what the angle between their rays spans at their distance. On top of that comes the noise of both depths. What is more is a
/// jump from one object to another, which no triangle may bridge.
fn connected(a: &Sample, b: &Sample) -> bool {
    let apart = (a.ray[0] - b.ray[0]).hypot(a.ray[1] - b.ray[1]);
    let footprint_mm = 0.5 * (a.depth_mm + b.depth_mm) * apart;
    // False for NaN: what is not known is not connected.
    (a.depth_mm - b.depth_mm).abs() <= STEEPEST * footprint_mm + JUMP_SIGMAS * (a.sigma_mm + b.sigma_mm)
}

/// Joins the points of neighbouring pixels. Each square of four pixels gives up to two triangles, cut along the diagonal that
/// gives more of them, or else the one that differs less in depth.
pub fn mesh(cloud: &Organised) -> Mesh {
    let sample = |((point, _), measured): (([f64; 3], [f64; 3]), &crate::cloud::PlyPoint)| Sample {
        ray: [point[0] / point[2], point[1] / point[2]],
        depth_mm: point[2],
        sigma_mm: f64::from(measured.sigma_z_mm),
    };
    let samples: Vec<Sample> = cloud.in_camera().zip(&cloud.points).map(sample).collect();
    let mut at = vec![NONE; cloud.width * cloud.height];
    for (number, pixel) in (0_u32..).zip(&cloud.pixels) {
        at[*pixel] = number;
    }
    let joined =
        |a: u32, b: u32| a != NONE && b != NONE && connected(&samples[a as usize], &samples[b as usize]);
    let step = |a: u32, b: u32| match a != NONE && b != NONE {
        true => (samples[a as usize].depth_mm - samples[b as usize].depth_mm).abs(),
        false => f64::INFINITY,
    };
    let mut triangles = Vec::with_capacity(2 * cloud.points.len());
    for y in 1..cloud.height {
        let (upper, lower) = (&at[(y - 1) * cloud.width..], &at[y * cloud.width..]);
        for x in 1..cloud.width {
            let [a, b, c, d] = [upper[x - 1], upper[x], lower[x - 1], lower[x]];
            let [top, left, right, bottom] = [joined(a, b), joined(a, c), joined(b, d), joined(c, d)];
            let (rising, falling) = (joined(b, c), joined(a, d));
            // Whether the first and the second triangle of each cut is there.
            let along_rising = [rising && top && left, rising && right && bottom];
            let along_falling = [falling && left && bottom, falling && top && right];
            let count = |there: [bool; 2]| there.into_iter().filter(|there| *there).count();
            let choose_rising = match count(along_rising).cmp(&count(along_falling)) {
                std::cmp::Ordering::Greater => true,
                std::cmp::Ordering::Less => false,
                std::cmp::Ordering::Equal => step(b, c) <= step(a, d),
            };
            let (there, cut) = match choose_rising {
                true => (along_rising, [[a, c, b], [b, c, d]]),
                false => (along_falling, [[a, c, d], [a, d, b]]),
            };
            triangles.extend(cut.into_iter().zip(there).filter(|(_, there)| *there).map(|(one, _)| one));
        }
    }
    let normals = normals(cloud, &triangles);
    Mesh { triangles, normals }
}

/// The points' own normals; where one has none, the mean of the triangles around it, weighed by their areas.
fn normals(cloud: &Organised, triangles: &[[u32; 3]]) -> Vec<[f32; 3]> {
    let mut normals: Vec<[f32; 3]> = cloud.points.iter().map(|point| point.normal).collect();
    let own: Vec<bool> = normals.iter().map(|normal| *normal != [0.0; 3]).collect();
    for triangle in triangles {
        let corners = triangle.map(|corner| corner as usize);
        if corners.iter().all(|corner| own[*corner]) {
            continue;
        }
        let [a, b, c] = corners.map(|corner| cloud.points[corner].point_mm);
        let (u, v) = (difference(b, a), difference(c, a));
        let area = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        for corner in corners.into_iter().filter(|corner| !own[*corner]) {
            normals[corner].iter_mut().zip(area).for_each(|(sum, part)| *sum += part);
        }
    }
    for (normal, _) in normals.iter_mut().zip(own).filter(|(_, own)| !own) {
        let length = normal.iter().map(|part| part * part).sum::<f32>().sqrt();
        *normal = if length > 0.0 { normal.map(|part| part / length) } else { [0.0; 3] };
    }
    normals
}

fn difference(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}
