//! Where in the image a fault lies, of frames that were not decoded: a capture that was given up.

use polscan_patterns::{Axis, Role};

use super::{Pair, worst_pair};
use crate::{
    decode::{DecodeSettings, PairContext, PairResidual, Plane, estimate_noise, pair_residual},
    grid::Grid,
};

/// Residual of the pair that adds up least, positive, in units of its noise, at every pixel; NaN where it says nothing. `None`
/// where no pair is conspicuous, or there is nothing to compare one with.
pub fn worst_residual(planes: &[(Role, Plane<'_>)], settings: &DecodeSettings) -> Option<Grid<f32>> {
    let first = |wanted: Role| planes.iter().find(|(role, _)| *role == wanted).map(|(_, plane)| *plane);
    let (bright, dark) = match settings.mode.is_polarized() {
        true => (first(Role::ReferenceH)?, first(Role::ReferenceV)?),
        false => (first(Role::White)?, first(Role::Black)?),
    };
    let pairs: Vec<(Axis, u8, [Plane<'_>; 2])> = planes
        .iter()
        .filter_map(|(role, plane)| match *role {
            Role::Code { axis, bit, inverse: false } => {
                Some((axis, bit, [*plane, first(Role::Code { axis, bit, inverse: true })?]))
            }
            _ => None,
        })
        .collect();
    let camera = settings.camera;
    let noise = camera.noise.or_else(|| {
        // The references are a pair as well.
        let alike: Vec<[Plane<'_>; 2]> =
            std::iter::once([bright, dark]).chain(pairs.iter().map(|(.., pair)| *pair)).collect();
        estimate_noise(&alike, settings.width, &camera)
    })?;
    let residuals: Vec<PairResidual> = pairs
        .iter()
        .filter_map(|&(axis, bit, [p, q])| {
            let context = PairContext {
                axis,
                bit,
                width: settings.width,
                high: &[bright],
                low: &[dark],
                camera,
                noise,
                lit_sigma: settings.thresholds.lit_sigma,
            };
            pair_residual(p, q, &context)
        })
        .collect();
    let worst = worst_pair(&residuals)?;
    let (.., frames) = pairs.iter().find(|(axis, bit, _)| (*axis, *bit) == (worst.axis, worst.bit))?;
    let pair = Pair {
        frames: *frames,
        references: [bright, dark],
        width: settings.width,
        saturation_dn: camera.saturation_dn,
        black_dn: camera.black_level_dn.unwrap_or(0.0),
        noise,
    };
    pair.residual_map()
}
