//! Polarized light as Stokes vectors, and what reflection and an analyser do to it.
//!
//! Of a ray along `d` the first basis vector is `e1`, the second `e2 = d x e1`. S1 > 0 is linear along e1, S2 > 0 linear
//! half way from e1 to e2. Turning the basis by `a` from e1 towards e2 turns (S1, S2) by `-2 a`.

use nalgebra::{Complex, Vector3};

/// Intensity and polarization of a ray, relative to some basis across it.
pub(crate) type Stokes = [f64; 4];

/// Amplitude reflection coefficients (r_s, r_p) from vacuum onto an index `n + ik` (Hecht, Optics, 4.6). At normal
/// incidence r_p = -r_s: p is `s x d` on either side.
pub(crate) fn fresnel(index: Complex<f64>, cos_incidence: f64) -> (Complex<f64>, Complex<f64>) {
    let one = Complex::new(1.0, 0.0);
    let cos_i = Complex::new(cos_incidence, 0.0);
    let sin_sq = 1.0 - cos_incidence * cos_incidence;
    let mut cos_t = (one - Complex::new(sin_sq, 0.0) / (index * index)).sqrt();
    if (index * cos_t).im < 0.0 {
        cos_t = -cos_t;
    }
    let s = (cos_i - index * cos_t) / (cos_i + index * cos_t);
    let p = (index * cos_i - cos_t) / (index * cos_i + cos_t);
    (s, p)
}

/// The Mueller matrix of a reflection in its own plane of incidence, (p, s) as basis, in its four free values:
/// `[[a, b, 0, 0], [b, a, 0, 0], [0, 0, c, -d], [0, 0, d, c]]`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Reflection {
    a: f64,
    b: f64,
    c: f64,
    d: f64,
}

impl Reflection {
    /// Reflection off a smooth surface of complex index `index`.
    pub(crate) fn fresnel(index: Complex<f64>, cos_incidence: f64) -> Self {
        let (s, p) = fresnel(index, cos_incidence);
        let (rs, rp) = (s.norm_sqr(), p.norm_sqr());
        let mixed = p * s.conj();
        Self { a: 0.5 * (rp + rs), b: 0.5 * (rp - rs), c: mixed.re, d: mixed.im }
    }

    /// The reflected Stokes vector.
    pub(crate) fn apply(self, [i, q, u, v]: Stokes) -> Stokes {
        let Self { a, b, c, d } = self;
        [a * i + b * q, b * i + a * q, c * u - d * v, d * u + c * v]
    }
}

/// `stokes` in a basis turned from `from` to `to`, both unit vectors across the ray `along`.
fn turn_basis(stokes: Stokes, along: Vector3<f64>, from: Vector3<f64>, to: Vector3<f64>) -> Stokes {
    let cos = from.dot(&to);
    let sin = along.cross(&from).dot(&to);
    let (cos2, sin2) = (cos * cos - sin * sin, 2.0 * sin * cos);
    let [i, q, u, v] = stokes;
    [i, cos2 * q + sin2 * u, cos2 * u - sin2 * q, v]
}

/// A polarization-carrying ray: direction of travel, first basis vector, Stokes vector.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    /// Unit direction of travel.
    pub(crate) along: Vector3<f64>,
    /// Unit vector across, first of the basis.
    pub(crate) first: Vector3<f64>,
    /// State.
    pub(crate) stokes: Stokes,
}

impl Ray {
    /// Reflects at a facet of unit normal `normal`, which stands half way between `-along` and `out`.
    pub(crate) fn reflect(self, normal: Vector3<f64>, out: Vector3<f64>, index: Complex<f64>) -> Self {
        let across = self.along.cross(&normal);
        // Straight on, every plane is the plane of incidence.
        let s = if across.norm_squared() < 1e-24 { self.first } else { across.normalize() };
        let p_in = s.cross(&self.along);
        let cos = (-self.along.dot(&normal)).clamp(0.0, 1.0);
        let turned = turn_basis(self.stokes, self.along, self.first, p_in);
        Self {
            along: out,
            first: s.cross(&out).normalize(),
            stokes: Reflection::fresnel(index, cos).apply(turned),
        }
    }

    /// Intensity behind `analyser`, whose horizontal is `horizontal`.
    pub(crate) fn through(self, analyser: Analyser, horizontal: Vector3<f64>) -> f64 {
        let reference = across(horizontal, self.along);
        analyser.intensity(turn_basis(self.stokes, self.along, self.first, reference))
    }
}

/// Unit vector across `along` that is nearest to `axis`.
pub(crate) fn across(axis: Vector3<f64>, along: Vector3<f64>) -> Vector3<f64> {
    (axis - along * axis.dot(&along)).normalize()
}

/// What stands in front of the camera: intensity = `share * (S0 + q S1 + u S2)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Analyser {
    share: f64,
    q: f64,
    u: f64,
}

impl Analyser {
    /// No polarizer.
    pub(crate) const NONE: Self = Self { share: 1.0, q: 0.0, u: 0.0 };

    /// A linear polarizer that passes 1 along its axis and `1 / extinction` across. `azimuth` turns the axis from the
    /// camera's horizontal, counter-clockwise as the camera sees it.
    pub(crate) fn linear(azimuth: f64, extinction: f64) -> Self {
        let leak = 1.0 / extinction;
        let contrast = (1.0 - leak) / (1.0 + leak);
        let (sin, cos) = (2.0 * azimuth).sin_cos();
        Self { share: 0.5 * (1.0 + leak), q: contrast * cos, u: contrast * sin }
    }

    /// Transmitted intensity of a Stokes vector whose first basis vector is the camera's horizontal.
    pub(crate) fn intensity(self, [i, q, u, _]: Stokes) -> f64 {
        self.share * (i + self.q * q + self.u * u)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ALUMINIUM: Complex<f64> = Complex::new(0.96, 6.7);
    const GLASS: Complex<f64> = Complex::new(1.5, 0.0);

    fn reflectances(index: Complex<f64>, degrees: f64) -> (f64, f64) {
        let (s, p) = fresnel(index, degrees.to_radians().cos());
        (s.norm_sqr(), p.norm_sqr())
    }

    #[test]
    fn reflectances_are_those_of_textbooks() {
        // R = ((n - 1)^2 + k^2) / ((n + 1)^2 + k^2) at normal incidence.
        let (s, p) = reflectances(ALUMINIUM, 0.0);
        let expected = (0.04f64.powi(2) + 6.7f64.powi(2)) / (1.96f64.powi(2) + 6.7f64.powi(2));
        assert!((s - expected).abs() < 1e-12 && (p - expected).abs() < 1e-12);
        assert!((s - 0.92).abs() < 0.005, "{s}");
        let (s, p) = reflectances(GLASS, 0.0);
        assert!((s - 0.04).abs() < 1e-12 && (p - 0.04).abs() < 1e-12);
        // Brewster's angle of glass, and the s reflectance there: ((1 - n^2) / (1 + n^2))^2 = 0.1479.
        let (s, p) = reflectances(GLASS, 1.5f64.atan().to_degrees());
        assert!(p < 1e-20 && (s - 0.147_928_994).abs() < 1e-8, "{s} {p}");
        // Glass at 45 degrees (Hecht): R_s = 0.0920, R_p = 0.0085.
        let (s, p) = reflectances(GLASS, 45.0);
        assert!((s - 0.0920).abs() < 5e-5 && (p - 0.0085).abs() < 5e-5, "{s} {p}");
        let (s, p) = reflectances(ALUMINIUM, 90.0);
        assert!((s - 1.0).abs() < 1e-9 && (p - 1.0).abs() < 1e-9);
    }

    #[test]
    fn the_goldstein_matrix_of_a_dielectric_agrees() {
        // Goldstein, Polarized Light, eq. 8-37: reflection Mueller matrix in angles theta- and theta+ for s first;
        // here p comes first, which exchanges the sign of the off-diagonal terms.
        for degrees in [3.0f64, 20.0, 50.0, 75.0] {
            let incidence = degrees.to_radians();
            let refracted = (incidence.sin() / 1.5).asin();
            let (minus, plus) = (incidence - refracted, incidence + refracted);
            let front = 0.5 * (minus.tan() / plus.sin()).powi(2);
            let (cm, cp) = (minus.cos().powi(2), plus.cos().powi(2));
            let ours = Reflection::fresnel(GLASS, incidence.cos());
            assert!((ours.a - front * (cm + cp)).abs() < 1e-12);
            assert!((ours.b + front * (cm - cp)).abs() < 1e-12);
            assert!((ours.c + front * 2.0 * plus.cos() * minus.cos()).abs() < 1e-12, "{degrees}");
            assert!(ours.d.abs() < 1e-15);
        }
    }

    #[test]
    fn malus() {
        for extinction in [5.0, 500.0, 1e9] {
            for degrees in [0.0f64, 10.0, 45.0, 89.0, 135.0] {
                let analyser = Analyser::linear(degrees.to_radians(), extinction);
                let cos_sq = degrees.to_radians().cos().powi(2);
                let expected = cos_sq + (1.0 - cos_sq) / extinction;
                assert!((analyser.intensity([1.0, 1.0, 0.0, 0.0]) - expected).abs() < 1e-12);
                // Natural light is halved whatever the azimuth.
                let half = 0.5 * (1.0 + 1.0 / extinction);
                assert!((analyser.intensity([1.0, 0.0, 0.0, 0.0]) - half).abs() < 1e-12);
            }
        }
        assert_eq!(Analyser::NONE.intensity([0.7, -0.7, 0.0, 0.0]), 0.7);
    }

    proptest! {
        /// The Stokes path against Jones vectors carried through space as plain electric fields.
        #[test]
        fn reflection_agrees_with_electric_fields(
            azimuth in 0.0f64..3.2, nx in -0.6f64..0.6, ny in -0.6f64..0.6, analyser in 0.0f64..3.2,
            n in 0.1f64..3.0, k in 0.0f64..8.0,
        ) {
            let along = Vector3::new(0.05, -0.02, 1.0).normalize();
            let normal = Vector3::new(nx, ny, -1.0).normalize();
            let out = along - normal * (2.0 * along.dot(&normal));
            prop_assume!(along.dot(&normal) < -0.1 && along.cross(&normal).norm() > 1e-3);
            let index = Complex::new(n, k);
            let first = across(Vector3::x(), along);
            let second = along.cross(&first);
            let ray = Ray { along, first, stokes: [1.0, (2.0 * azimuth).cos(), (2.0 * azimuth).sin(), 0.0] };
            let ours = ray.reflect(normal, out, index).through(Analyser::linear(analyser, 1e12), Vector3::x());

            let field = first * azimuth.cos() + second * azimuth.sin();
            let s = along.cross(&normal).normalize();
            let (rs, rp) = fresnel(index, -along.dot(&normal));
            let horizontal = across(Vector3::x(), out);
            let axis = horizontal * analyser.cos() + out.cross(&horizontal) * analyser.sin();
            let amplitude = rs * (field.dot(&s) * s.dot(&axis))
                + rp * (field.dot(&s.cross(&along)) * s.cross(&out).dot(&axis));
            prop_assert!((ours - amplitude.norm_sqr()).abs() < 1e-9, "{ours} {}", amplitude.norm_sqr());
        }
    }

    #[test]
    fn a_metal_mirror_keeps_h_and_v_at_normal_incidence() {
        let along = Vector3::z();
        let reflectance = (0.04f64.powi(2) + 6.7f64.powi(2)) / (1.96f64.powi(2) + 6.7f64.powi(2));
        for (q, passes) in [(1.0, reflectance), (-1.0, 0.0)] {
            let ray = Ray { along, first: Vector3::x(), stokes: [1.0, q, 0.0, 0.0] };
            let seen =
                ray.reflect(-along, -along, ALUMINIUM).through(Analyser::linear(0.0, 1e12), Vector3::x());
            assert!((seen - passes).abs() < 1e-9, "{seen}");
        }
    }
}
