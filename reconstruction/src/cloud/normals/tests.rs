//! The fast loops against the plain ones, to the bit, with every set of vector instructions that this machine has.

use proptest::prelude::*;

use super::*;
use crate::{cloud::surface, geometry::RayTable, geometry::fixtures::rig};

/// Points of two surfaces with a jump between them, of every noise, with holes.
fn cloud(rays: &RayTable, seed: u64) -> (Grid<[f32; 3]>, Grid<f32>) {
    use crate::decode::synth::{random, uniform};
    let directions = rays.directions();
    let (width, height) = (directions.width(), directions.height());
    let jump = uniform(random(seed)) * width as f64;
    let tilt = uniform(random(seed ^ 1)) * 2.0 - 1.0;
    let holes = random(seed ^ 2) % 40 + 2;
    let noise_mm = 10f64.powf(uniform(random(seed ^ 3)) * 4.0 - 2.0);
    let mut points = Vec::new();
    let mut sigmas = Vec::new();
    for y in 0..height {
        for x in 0..width {
            let here = random(seed ^ random((y * width + x) as u64 + 7));
            let [dx, dy] = directions.at(x, y);
            let noise_mm = noise_mm * if y < height / 2 { 1.0 } else { 3.0 };
            let level = if x as f64 > jump { 1000.0 } else { 1030.0 };
            let z = level * (1.0 + tilt * dx + 0.3 * dy) + noise_mm * (uniform(here) - 0.5);
            let hole = random(here).is_multiple_of(holes);
            let point = if hole { [f64::NAN; 3] } else { [dx * z, dy * z, z] };
            points.push(point.map(|v| v as f32));
            sigmas.push(if hole { f32::NAN } else { noise_mm as f32 });
        }
    }
    (Grid::from_vec(width, height, points), Grid::from_vec(width, height, sigmas))
}

/// Whether a neighbour of the pixel lies on no common surface with it, as the definition has it.
fn breaks(points: &Grid<[f32; 3]>, sigma_z: &Grid<f32>, pitch: f32, x: usize, y: usize) -> bool {
    let (width, height) = (points.width(), points.height());
    let read = |x: usize, y: usize| {
        let z = points.at(x, y)[2];
        (1.0 / z, sigma_z.at(x, y) / (z * z))
    };
    let (w, sigma) = read(x, y);
    let mut broken = false;
    for j in y.saturating_sub(1)..=(y + 1).min(height - 1) {
        for i in x.saturating_sub(1)..=(x + 1).min(width - 1) {
            let (other, of_other) = read(i, j);
            let limit = w * pitch * STEEPEST * 1.5 + JUMP_SIGMAS * (sigma + of_other);
            let connected = (w - other).abs() <= limit;
            broken |= (i, j) != (x, y) && !connected;
        }
    }
    w.is_finite() && broken
}

proptest! {
    #[test]
    fn every_instruction_set_gives_what_the_plain_loops_give(seed: u64, width in 2u32..75, height in 2u32..40) {
        let mut lens = rig(16.0).camera;
        let scale = f64::from(width) / f64::from(lens.width);
        (lens.fx, lens.fy) = (lens.fx * scale, lens.fy * scale);
        (lens.cx, lens.cy) = (f64::from(width) / 2.0, f64::from(height) / 2.0);
        (lens.width, lens.height) = (width, height);
        let rays = RayTable::new(&lens);
        let (points, sigma) = cloud(&rays, seed);
        let surface = Surface::new(&points, &sigma, &rays);
        let (width, height) = surface.size();
        let border = |x: usize, y: usize| breaks(&points, &sigma, surface.pitch, x, y);
        for set in InstructionSet::available() {
            let normals = normals(set, &surface);
            let silhouettes = surface::silhouettes(set, &surface);
            for y in 0..height {
                for x in 0..width {
                    let plain = plain::normal_at(&surface, x, y).unwrap_or([0.0; 3]);
                    let bits = |normal: [f32; 3]| normal.map(f32::to_bits);
                    prop_assert_eq!(bits(normals.at(x, y)), bits(plain), "{:?} at {} {}", set, x, y);
                    let near = points.at(x, y)[2].is_finite()
                        && (y.saturating_sub(1)..=(y + 1).min(height - 1)).any(|j| {
                            (x.saturating_sub(1)..=(x + 1).min(width - 1)).any(|i| border(i, j))
                        });
                    prop_assert_eq!(silhouettes.at(x, y), near, "{:?} at {} {}", set, x, y);
                }
            }
        }
    }
}
