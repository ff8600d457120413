//! Takes frames as they come and decodes them.

use polscan_patterns::{Axis, Role};

use super::{
    gates,
    limits::Gates,
    noise, pair_sum,
    plan::{Frames, plan},
    sample::Sample,
    subpixel,
    types::{Class, DecodeError, DecodeSettings, Decoded, Plane, SharedPlane},
    words::{PixelMaps, decode_pixels},
};
use crate::{grid::Grid, simd::InstructionSet};

/// Collects the frames of one scan and decodes them. Holds handles, so frames lie in memory once.
#[derive(Clone)]
pub struct Accumulator {
    settings: DecodeSettings,
    frames: Vec<(Role, SharedPlane)>,
}

impl Accumulator {
    /// An empty accumulator.
    ///
    /// # Errors
    /// [`DecodeError::Settings`] where no frame could be decoded with these settings.
    pub fn new(settings: DecodeSettings) -> Result<Self, DecodeError> {
        let refuse = |reason: String| Err(DecodeError::Settings { reason });
        let DecodeSettings { width, height, camera, thresholds, .. } = &settings;
        if *width == 0 || *height == 0 || width.checked_mul(*height).is_none_or(|len| len > i32::MAX as usize)
        {
            return refuse(format!("{width}x{height} is no frame size"));
        }
        if !(1..=16).contains(&camera.bit_depth) {
            return refuse(format!("bit depth {} is outside 1..=16", camera.bit_depth));
        }
        if camera.saturation_dn == 0 {
            return refuse("every sample would be saturated at level 0; give the level of full scale".into());
        }
        if camera.black_level_dn.is_some_and(|level| !level.is_finite()) {
            return refuse("the black level is not a number".into());
        }
        if let Some(noise) = camera.noise {
            let usable = |value: f64| value.is_finite() && value >= 0.0;
            if !usable(noise.gain_dn_per_electron) || !usable(noise.read_noise_dn) {
                return refuse(
                    "noise must be finite and not negative; leave it out to have it estimated".into(),
                );
            }
        }
        let usable = |value: f64| value.is_finite() && value > 0.0;
        if !usable(thresholds.lit_sigma) || !usable(thresholds.soft_bit_sigma) || !usable(thresholds.snap_px)
        {
            return refuse("thresholds must be finite and positive".into());
        }
        if !(2..=64).contains(&thresholds.fit_edges) {
            return refuse(format!("a fit takes 2 to 64 edges, not {}", thresholds.fit_edges));
        }
        Ok(Self { settings, frames: Vec::new() })
    }

    /// Adds a frame. Frames may come in any order; references may come again and are averaged, where the first and
    /// the last to come give the drift.
    ///
    /// # Errors
    /// [`DecodeError::Size`], [`DecodeError::Mixed`], [`DecodeError::UnknownBit`], [`DecodeError::Repeated`].
    pub fn push(&mut self, role: Role, plane: SharedPlane) -> Result<(), DecodeError> {
        let expected = self.settings.width * self.settings.height;
        let found = plane.plane().len();
        if found != expected {
            return Err(DecodeError::Size { role, found, expected });
        }
        if let Some((_, first)) = self.frames.first()
            && !first.plane().same_type(plane.plane())
        {
            return Err(DecodeError::Mixed { role });
        }
        if let Role::Code { axis, bit, .. } = role {
            let bits = match axis {
                Axis::Column => self.settings.column.bits(),
                Axis::Row => self.settings.row.bits(),
            };
            if bit >= bits {
                return Err(DecodeError::UnknownBit { role, bits });
            }
            if self.frames.iter().any(|(other, _)| *other == role) {
                return Err(DecodeError::Repeated { role });
            }
        }
        self.frames.push((role, plane));
        Ok(())
    }

    /// Number of frames so far.
    pub fn len(&self) -> usize {
        self.frames.len()
    }

    /// Whether no frame has come yet.
    pub fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Decodes what has come, in parallel over rows. The result is the same to the bit for any number of threads and
    /// any order of frames (but for the drift, which needs the order of the references).
    ///
    /// # Errors
    /// [`DecodeError::Missing`] where the mode cannot do without an absent frame.
    pub fn finish(self) -> Result<Decoded, DecodeError> {
        self.finish_telling(|| {})
    }

    /// As [`finish`](Self::finish); calls `codes_done` when all codes are there and only sub-pixel coordinates are
    /// missing, for a caller with a clock.
    ///
    /// # Errors
    /// As [`finish`](Self::finish).
    pub fn finish_telling(self, codes_done: impl FnOnce()) -> Result<Decoded, DecodeError> {
        match self.frames.first().map(|(_, plane)| plane.plane()) {
            Some(Plane::U16(_)) => decode::<u16>(&self.settings, &self.frames, codes_done),
            _ => decode::<u8>(&self.settings, &self.frames, codes_done),
        }
    }
}

impl std::fmt::Debug for Accumulator {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let roles: Vec<_> = self.frames.iter().map(|(role, _)| role).collect();
        f.debug_struct("Accumulator").field("settings", &self.settings).field("roles", &roles).finish()
    }
}

fn decode<T: Sample>(
    settings: &DecodeSettings,
    pushed: &[(Role, SharedPlane)],
    codes_done: impl FnOnce(),
) -> Result<Decoded, DecodeError> {
    let mut frames = plan::<T>(settings, pushed)?;
    let camera = settings.camera;
    let black_level_dn = camera.black_level_dn.unwrap_or(0.0);
    let (noise, noise_estimated) = match camera.noise {
        Some(noise) => (noise, false),
        None => match noise::estimate(&frames, camera.bit_depth, black_level_dn, camera.saturation_dn) {
            Some(noise) => (noise, true),
            None => {
                frames.losses.push(
                    "noise is neither given nor measurable in these frames: a full well of 10000 electrons and a \
                     read noise of 1/1000 of full scale are assumed"
                        .into(),
                );
                (noise::assumed(camera.bit_depth), true)
            }
        },
    };
    let gates = Gates::new(settings, noise);
    let mut maps = PixelMaps::new(settings.width * settings.height, frames.axes.len());
    let set = InstructionSet::widest();
    decode_pixels(&frames, &gates, set, &mut maps);
    let pairs = pair_sum::of_scan(&frames, &maps, &gates, set);
    let drift = drift(&frames, &maps);
    let (boundaries, shapes) = gates::apply(&frames, &mut maps, &settings.thresholds, set);
    codes_done();
    let mut refined = shapes.iter().enumerate().map(|(index, shape)| {
        subpixel::refine(&frames, &maps, &gates, &settings.thresholds, (index, *shape), set)
    });
    let (width, height) = (settings.width, settings.height);
    let Some((column, interpolated)) = refined.next() else {
        return Err(DecodeError::Missing {
            mode: settings.mode,
            missing: "the frames of the columns".into(),
        });
    };
    let row = refined.next().map(|(row, _)| row);
    drop(refined);
    Ok(Decoded {
        column,
        row,
        class: Grid::from_vec(width, height, maps.class),
        half_saturated: Grid::from_vec(width, height, maps.half_saturated),
        interpolated: Grid::from_vec(width, height, interpolated),
        modulation: Grid::from_vec(width, height, maps.modulation),
        residual: Grid::from_vec(width, height, maps.residual),
        dolp: Grid::from_vec(width, height, maps.dolp),
        intensity: Grid::from_vec(width, height, maps.intensity),
        noise,
        noise_estimated,
        black_level_dn,
        pairs,
        boundaries,
        drift,
        losses: frames.losses,
    })
}

/// Last less first bright reference (else dark one) as a share of the modulation, median over lit pixels.
fn drift<T: Sample>(frames: &Frames<'_, T>, maps: &PixelMaps) -> Option<f64> {
    let planes = [&frames.high, &frames.low].into_iter().find(|planes| planes.len() >= 2)?;
    let (first, last) = (planes.first()?, planes.last()?);
    let mut shares: Vec<f32> = (0..maps.class.len())
        .step_by(7)
        .filter(|&at| {
            maps.class[at].is_lit() && maps.class[at] != Class::Saturated && maps.modulation[at] != 0.0
        })
        .map(|at| (last[at].dn() - first[at].dn()) as f32 / maps.modulation[at].abs())
        .collect();
    if shares.is_empty() {
        return None;
    }
    let middle = shares.len() / 2;
    let (_, median, _) = shares.select_nth_unstable_by(middle, f32::total_cmp);
    Some(f64::from(*median))
}
