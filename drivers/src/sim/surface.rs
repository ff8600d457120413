//! Surfaces: where a ray meets them, and how much light a microfacet lobe sends which way.

use nalgebra::Vector3;

/// Rays start this far off the surface they leave, in mm.
const CLEARANCE_MM: f64 = 1e-6;

/// Box that bounds a plane.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Clip {
    low: Vector3<f64>,
    high: Vector3<f64>,
}

impl Clip {
    /// Extents along x, y and z, each unbounded where absent.
    pub(crate) fn new(x: Option<[f64; 2]>, y: Option<[f64; 2]>, z: Option<[f64; 2]>) -> Self {
        let bound = |extent: Option<[f64; 2]>| extent.unwrap_or([f64::NEG_INFINITY, f64::INFINITY]);
        let (x, y, z) = (bound(x), bound(y), bound(z));
        Self { low: Vector3::new(x[0], y[0], z[0]), high: Vector3::new(x[1], y[1], z[1]) }
    }

    fn contains(&self, point: Vector3<f64>) -> bool {
        (0..3).all(|axis| (self.low[axis]..=self.high[axis]).contains(&point[axis]))
    }
}

/// A shape that rays can meet.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Shape {
    /// Bounded plane.
    Plane {
        /// A point of it.
        point: Vector3<f64>,
        /// Unit normal.
        normal: Vector3<f64>,
        /// Bounds.
        clip: Clip,
    },
    /// Sphere.
    Sphere {
        /// Centre.
        centre: Vector3<f64>,
        /// Radius in mm.
        radius: f64,
    },
}

impl Shape {
    /// A plane from plain arrays.
    pub(crate) fn plane(point: [f64; 3], normal: [f64; 3], clip: Clip) -> Self {
        Self::Plane { point: Vector3::from(point), normal: Vector3::from(normal).normalize(), clip }
    }

    /// Distance along the unit direction to the first meeting beyond the clearance.
    pub(crate) fn meet(&self, origin: Vector3<f64>, along: Vector3<f64>) -> Option<f64> {
        match self {
            Self::Plane { point, normal, clip } => {
                let distance = (point - origin).dot(normal) / along.dot(normal);
                (distance.is_finite() && distance > CLEARANCE_MM && clip.contains(origin + along * distance))
                    .then_some(distance)
            }
            Self::Sphere { centre, radius } => {
                let to = centre - origin;
                let middle = to.dot(&along);
                let half_sq = radius * radius - (to - along * middle).norm_squared();
                if half_sq < 0.0 {
                    return None;
                }
                let half = half_sq.sqrt();
                [middle - half, middle + half].into_iter().find(|&distance| distance > CLEARANCE_MM)
            }
        }
    }

    /// Unit normal at a point of the surface, on the side that `along` comes from.
    pub(crate) fn normal_against(&self, point: Vector3<f64>, along: Vector3<f64>) -> Vector3<f64> {
        let normal = match self {
            Self::Plane { normal, .. } => *normal,
            Self::Sphere { centre, .. } => (point - centre).normalize(),
        };
        if normal.dot(&along) > 0.0 { -normal } else { normal }
    }

    /// Whether a plane can be fitted to it.
    pub(crate) fn is_planar(&self) -> bool {
        matches!(self, Self::Plane { .. })
    }
}

/// One face of an object.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Primitive {
    /// Name in the truth.
    pub(crate) name: String,
    /// Number of its object in the scene.
    pub(crate) object: usize,
    /// Shape and place.
    pub(crate) shape: Shape,
    /// Factor on its material's reflectance.
    pub(crate) reflectance: f64,
    /// How far it has been moved from where the scene puts it.
    pub(crate) shifted: Vector3<f64>,
}

impl Primitive {
    /// Moves it.
    pub(crate) fn shift(&mut self, by: Vector3<f64>) {
        self.shifted += by;
        match &mut self.shape {
            Shape::Plane { point, clip, .. } => {
                *point += by;
                clip.low += by;
                clip.high += by;
            }
            Shape::Sphere { centre, .. } => *centre += by,
        }
    }
}

/// The first face that a ray meets: its number and the distance.
pub(crate) fn nearest(
    primitives: &[Primitive],
    origin: Vector3<f64>,
    along: Vector3<f64>,
) -> Option<(usize, f64)> {
    primitives
        .iter()
        .enumerate()
        .filter_map(|(number, primitive)| {
            primitive.shape.meet(origin, along).map(|distance| (number, distance))
        })
        .min_by(|a, b| a.1.total_cmp(&b.1))
}

/// Whether anything stands between a point of a surface with normal `normal` and `target`.
pub(crate) fn is_shadowed(
    primitives: &[Primitive],
    point: Vector3<f64>,
    normal: Vector3<f64>,
    target: Vector3<f64>,
) -> bool {
    // Far enough off the surface that rounding at a few metres cannot put it in its own shadow.
    let origin = point + normal * 1e-5;
    let to = target - origin;
    let distance = to.norm();
    let along = to / distance;
    primitives
        .iter()
        .any(|primitive| primitive.shape.meet(origin, along).is_some_and(|blocked| blocked < distance))
}

/// What a GGX lobe without its Fresnel factor returns of irradiance across the light: `D G / (4 cos_o)`, that is the
/// BRDF times `cos_i` (Walter et al. 2007, eq. 20, 33, 34). All vectors unit, away from the surface.
pub(crate) fn lobe(alpha: f64, normal: Vector3<f64>, light: Vector3<f64>, view: Vector3<f64>) -> f64 {
    let (cos_i, cos_o) = (normal.dot(&light), normal.dot(&view));
    if cos_i <= 0.0 || cos_o <= 0.0 {
        return 0.0;
    }
    let cos_h = normal.dot(&(light + view).normalize());
    let alpha_sq = alpha * alpha;
    let spread = cos_h * cos_h * (alpha_sq - 1.0) + 1.0;
    let density = alpha_sq / (std::f64::consts::PI * spread * spread);
    let smith = |cos: f64| 2.0 * cos / (cos + (alpha_sq + (1.0 - alpha_sq) * cos * cos).sqrt());
    density * smith(cos_i) * smith(cos_o) / (4.0 * cos_o)
}

/// Smooth noise within 0 and 1 at a point, features of `size_mm` with a finer half-weight octave.
pub(crate) fn texture(seed: u64, point: Vector3<f64>, size_mm: f64) -> f64 {
    (2.0 * lattice_noise(seed, point / size_mm) + lattice_noise(!seed, point * (2.0 / size_mm))) / 3.0
}

/// Trilinear interpolation, with smooth weights, of random values at integer points.
fn lattice_noise(seed: u64, point: Vector3<f64>) -> f64 {
    let cell = point.map(f64::floor);
    let weight = (point - cell).map(|share| share * share * (3.0 - 2.0 * share));
    let mut sum = 0.0;
    for corner in 0..8u32 {
        let mut key = seed;
        let mut share = 1.0;
        for axis in 0..3 {
            let upper = corner >> axis & 1 == 1;
            let index = cell[axis] as i64 + i64::from(upper);
            key = super::noise::mix(key.wrapping_add(index as u64));
            share *= if upper { weight[axis] } else { 1.0 - weight[axis] };
        }
        sum += share * (key >> 11) as f64 * (1.0 / (1u64 << 53) as f64);
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lobe_reflects_no_more_than_it_gets_and_nearly_all_where_smooth() {
        let normal = Vector3::z();
        for alpha in [0.1f64, 0.3, 0.6] {
            // Facets steeper than 45 degrees send light down to others, which the model counts as lost.
            let least = 1.0 - 2.0 * alpha * alpha / (1.0 + alpha * alpha);
            let light = Vector3::new(0.3, 0.0, 1.0).normalize();
            let (rings, spokes) = (800, 400);
            let mut sum = 0.0;
            for ring in 0..rings {
                let theta = (f64::from(ring) + 0.5) / f64::from(rings) * std::f64::consts::FRAC_PI_2;
                for spoke in 0..spokes {
                    let phi = (f64::from(spoke) + 0.5) / f64::from(spokes) * std::f64::consts::TAU;
                    let view = Vector3::new(theta.sin() * phi.cos(), theta.sin() * phi.sin(), theta.cos());
                    // Reflected share of the irradiance: BRDF cos_o over the hemisphere.
                    sum += lobe(alpha, normal, light, view) / normal.dot(&light) * theta.cos() * theta.sin();
                }
            }
            let albedo = sum * std::f64::consts::FRAC_PI_2 / f64::from(rings) * std::f64::consts::TAU
                / f64::from(spokes);
            assert!(albedo < 1.005 && albedo > least, "{alpha}: {albedo}");
        }
    }

    #[test]
    fn texture_spans_its_range_and_is_smooth() {
        let mut values = Vec::new();
        for step in 0..20_000 {
            values.push(texture(7, Vector3::new(0.03 * f64::from(step), 1.3, 900.0), 6.0));
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let (low, high) = values.iter().fold((1.0f64, 0.0f64), |(l, h), &v| (l.min(v), h.max(v)));
        assert!(low > 0.0 && low < 0.2 && high < 1.0 && high > 0.8, "{low} {high}");
        assert!((mean - 0.5).abs() < 0.05, "{mean}");
        assert!(values.windows(2).all(|pair| (pair[1] - pair[0]).abs() < 0.02));
        assert_ne!(texture(7, Vector3::zeros(), 6.0), texture(8, Vector3::zeros(), 6.0));
    }

    #[test]
    fn planes_and_spheres_are_met_where_they_are() {
        let clip = Clip::new(Some([-10.0, 10.0]), None, None);
        let plane = Shape::plane([0.0, 0.0, 100.0], [0.0, 0.0, -2.0], clip);
        assert_eq!(plane.meet(Vector3::zeros(), Vector3::z()), Some(100.0));
        assert_eq!(plane.meet(Vector3::new(11.0, 0.0, 0.0), Vector3::z()), None);
        assert_eq!(plane.meet(Vector3::zeros(), -Vector3::z()), None);
        assert_eq!(plane.meet(Vector3::zeros(), Vector3::x()), None);
        let sphere = Shape::Sphere { centre: Vector3::new(0.0, 0.0, 100.0), radius: 10.0 };
        assert_eq!(sphere.meet(Vector3::zeros(), Vector3::z()), Some(90.0));
        assert_eq!(sphere.meet(Vector3::new(0.0, 0.0, 100.0), Vector3::z()), Some(10.0));
        assert_eq!(sphere.normal_against(Vector3::new(0.0, 0.0, 90.0), Vector3::z()), -Vector3::z());
    }
}
