//! Polarization on the rig: the channels one by one at one angle of the polarizer, edges in both states, and drive levels.

use polscan_calibration::{
    noise::evenly_lit,
    polarization::{EdgeShift, Field, Turn, edge_shift, misregistration},
};
use polscan_drivers::{
    camera::CameraInfo,
    frame::Frame,
    projector::{ProjectorInfo, Rgb, Slide},
};
use polscan_patterns::Polarization;
use serde::{Deserialize, Serialize};

use super::{Bench, bench::mean, files::DeviceKey};
use crate::{
    app::Rig,
    config::Settings,
    engine::Failure,
    report::{NamedRegion, check_regions},
    sequencer::CancelFlag,
};

const OPERATION: &str = "measure the polarization";

/// Frames of each picture; the channel that the polarizer holds back is dark.
const FRAMES: usize = 12;
/// Frames of each picture with an edge.
const EDGE_FRAMES: usize = 4;
/// Edges between columns and between rows.
const EDGES: u32 = 7;
/// Pixels that take part where no region is given.
const PIXELS: usize = 200_000;
/// Light of a full picture, in its own sigma, below which a pixel says nothing of an edge.
const LEAST_SIGMA: f32 = 3.0;

/// What one angle of the polarizer shows, in DN.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Set {
    /// Light of the channels.
    pub turn: Turn,
    /// Light of the black picture above no light, of the white one above black, and likewise of H and V as configured.
    pub black: f64,
    /// See `black`.
    pub white: f64,
    /// See `black`.
    pub h: f64,
    /// See `black`.
    pub v: f64,
    /// White less the sum of its channels, as a share of white: what one panel does to the light of another.
    pub crosstalk: f64,
    /// What it was taken with; older reports do not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub taken: Option<Conditions>,
}

/// What decides the brightness of everything: angles that are joined must share it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Conditions {
    /// Camera.
    pub camera: DeviceKey,
    /// Projector.
    pub projector: DeviceKey,
    /// Exposure time in microseconds.
    pub exposure_us: f64,
    /// Gain in decibel.
    pub gain_db: f64,
}

impl Set {
    /// How many times brighter than V the rig shows H, the black picture's light in both.
    pub fn h_over_v(&self) -> f64 {
        (self.h + self.black) / (self.v + self.black).max(1e-9)
    }
}

/// What is measured at one angle.
#[derive(Debug, Clone)]
pub struct Task<'a> {
    /// Reading of the polarizer's mount.
    pub angle_deg: f64,
    /// Bare metal in the camera's image; what is evenly lit where there is none.
    pub coupon: Option<&'a NamedRegion>,
    /// A white card, for the drive levels.
    pub card: Option<&'a NamedRegion>,
    /// Whether edges are looked at.
    pub edges: bool,
}

/// What was measured at one angle.
#[derive(Debug, Clone)]
pub struct Measured {
    /// Camera.
    pub camera: CameraInfo,
    /// Projector.
    pub projector: ProjectorInfo,
    /// Light.
    pub set: Set,
    /// Misregistration of V against H, where enough edges were seen.
    pub field: Option<Field>,
    /// Code values of H and V that the card returns alike.
    pub drive: Option<Drive>,
}

/// Code values at which a card that scatters returns as much of H as of V.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drive {
    /// Of the channels of H.
    pub horizontal: u8,
    /// Of the channels of V.
    pub vertical: u8,
    /// H over V on the card at full drive.
    pub ratio_at_full: f64,
}

/// Measures the rig at the angle at which its polarizer stands. `progress` hears what is being done.
///
/// # Errors
/// Devices, regions, or a picture without light.
pub fn measure(
    rig: &mut Rig,
    settings: &Settings,
    task: &Task,
    cancel: &CancelFlag,
    progress: &mut dyn FnMut(&str),
) -> Result<Measured, Failure> {
    let mut bench = Bench::new(rig, OPERATION, cancel);
    let (camera, projector) = (bench.camera().clone(), bench.projector().clone());
    let mut stage = Stage::set_up(&mut bench, settings, task.coupon, task.card)?;
    progress("channels");
    let set = stage.set(task.angle_deg)?;
    let field = match task.edges {
        true => {
            progress("edges");
            stage.field()?
        }
        false => None,
    };
    let drive = match task.card {
        Some(card) => {
            progress("drive levels");
            Some(stage.drive(card)?)
        }
        None => None,
    };
    Ok(Measured { camera, projector, set, field, drive })
}

/// Watches V and H while somebody turns the polarizer: `seen` gets both above no light, in DN, until it says stop or
/// `cancel` does.
///
/// # Errors
/// As [`measure`].
pub fn watch(
    rig: &mut Rig,
    settings: &Settings,
    coupon: Option<&NamedRegion>,
    cancel: &CancelFlag,
    seen: &mut dyn FnMut(f64, f64) -> bool,
) -> Result<(), Failure> {
    let mut bench = Bench::new(rig, OPERATION, cancel);
    let mut stage = Stage::set_up(&mut bench, settings, coupon, None)?;
    loop {
        match (stage.light(5), stage.light(6)) {
            (Ok((h, _)), Ok((v, _))) => {
                if !seen(h, v) {
                    return Ok(());
                }
            }
            _ if cancel.is_cancelled() => return Ok(()),
            (Err(failure), _) | (_, Err(failure)) => return Err(failure),
        }
    }
}

/// A rig whose camera is set and whose pictures are loaded: black, red, green, blue, white, H, V.
struct Stage<'b, 'r> {
    bench: &'b mut Bench<'r>,
    states: Polarization,
    /// Columns of the camera's image.
    width: usize,
    pixels: Vec<u32>,
    /// Level of no light, or of the black picture where that is not known.
    black_dn: f64,
    conditions: Conditions,
}

/// Pictures of a stage.
fn pictures(states: Polarization) -> [Rgb; 7] {
    [[0; 3], [255, 0, 0], [0, 255, 0], [0, 0, 255], [255; 3], states.horizontal.rgb(), states.vertical.rgb()]
}

impl<'b, 'r> Stage<'b, 'r> {
    fn set_up(
        bench: &'b mut Bench<'r>,
        settings: &Settings,
        coupon: Option<&NamedRegion>,
        card: Option<&NamedRegion>,
    ) -> Result<Self, Failure> {
        bench.load(&pictures(settings.polarization).map(Slide::Uniform))?;
        let applied = bench.set(&settings.camera)?;
        let applied = settings.measured.camera(bench.camera(), applied).map_err(|stale| Failure::Setup {
            operation: "use the measured noise",
            source: Box::new(stale),
        })?;
        let (width, height) = (applied.width as usize, applied.height as usize);
        for region in [coupon, card].into_iter().flatten() {
            check_regions(std::slice::from_ref(region), (width, height))
                .map_err(|error| Failure::data(OPERATION, error))?;
        }
        bench.hold(0)?;
        let dark = mean(&bench.frames(2)?);
        bench.hold(4)?;
        let bright = mean(&bench.frames(2)?);
        let black = dark.iter().map(|&value| f64::from(value)).sum::<f64>() / dark.len().max(1) as f64;
        let pixels = match coupon {
            Some(region) => inside(region, width),
            None => evenly_lit(&bright, black, PIXELS),
        };
        let clipped = pixels
            .iter()
            .filter(|&&pixel| bright[pixel as usize] >= f32::from(applied.saturation_dn))
            .count();
        if pixels.is_empty() || clipped * 1000 > pixels.len() {
            return Err(Failure::data(
                OPERATION,
                format!(
                    "{clipped} of the {} chosen pixels are too bright: shorten the exposure, or choose a part that does not \
                     mirror the projector with --coupon",
                    pixels.len()
                ),
            ));
        }
        let black_dn = applied.black_level_dn.unwrap_or(black);
        let conditions = Conditions {
            camera: bench.camera().into(),
            projector: bench.projector().into(),
            exposure_us: applied.settings.exposure_us,
            gain_db: applied.settings.gain_db,
        };
        Ok(Self { bench, states: settings.polarization, width, pixels, black_dn, conditions })
    }

    /// Mean level of a picture over the chosen pixels, above no light, and its sigma.
    fn light(&mut self, picture: u32) -> Result<(f64, f64), Failure> {
        self.bench.hold(picture)?;
        let frames = self.bench.frames(FRAMES)?;
        let means: Vec<f64> = frames.iter().map(|frame| self.mean_of(frame, &self.pixels)).collect();
        let count = means.len() as f64;
        let light = means.iter().sum::<f64>() / count;
        let spread = means.iter().map(|mean| (mean - light).powi(2)).sum::<f64>() / (count - 1.0);
        let noise = self.bench.noise().variance(light - self.black_dn) / self.pixels.len() as f64;
        Ok((light - self.black_dn, (spread.max(noise) / count).sqrt()))
    }

    fn mean_of(&self, frame: &Frame, pixels: &[u32]) -> f64 {
        let samples = frame.pixels();
        pixels.iter().map(|&pixel| f64::from(samples.get(pixel as usize))).sum::<f64>() / pixels.len() as f64
    }

    fn set(&mut self, angle_deg: f64) -> Result<Set, Failure> {
        let mut lights = [(0.0, 0.0); 7];
        for (picture, light) in (0u32..).zip(&mut lights) {
            *light = self.light(picture)?;
        }
        let (black, black_sigma) = lights[0];
        let above = |picture: usize| lights[picture].0 - black;
        let turn = Turn {
            angle_deg,
            light: [1, 2, 3].map(above),
            sigma: [1, 2, 3].map(|picture| lights[picture].1.hypot(black_sigma)),
        };
        let white = above(4);
        let crosstalk = (white - turn.light.iter().sum::<f64>()) / white.max(1e-9);
        let taken = Some(self.conditions.clone());
        Ok(Set { turn, black, white, h: above(5), v: above(6), crosstalk, taken })
    }

    /// Mean image of a slide of one state.
    fn image(&mut self, slide: Slide) -> Result<Vec<f32>, Failure> {
        self.bench.load(&[slide])?;
        self.bench.hold(0)?;
        Ok(mean(&self.bench.frames(EDGE_FRAMES)?))
    }

    /// Misregistration from edges that both states show at the same place of the picture.
    fn field(&mut self) -> Result<Option<Field>, Failure> {
        let info = self.bench.projector();
        let size = [info.width, info.height];
        let states = [self.states.horizontal.rgb(), self.states.vertical.rgb()];
        let black = self.image(Slide::Uniform([0; 3]))?;
        let full = [self.image(Slide::Uniform(states[0]))?, self.image(Slide::Uniform(states[1]))?];
        let mut found = [Vec::new(), Vec::new()];
        for axis in 0..2 {
            for edge in 1..=EDGES {
                let at = edge * size[axis] / (EDGES + 1);
                let mut shares = Vec::new();
                for (state, full) in states.iter().zip(&full) {
                    let line =
                        (0..size[axis]).map(|index| if index < at { *state } else { [0; 3] }).collect();
                    let seen =
                        self.image(if axis == 0 { Slide::Columns(line) } else { Slide::Rows(line) })?;
                    shares.push(self.shares(&seen, &black, full));
                }
                found[axis].extend(edges_of(&shares, self.width, axis, f64::from(at) - 0.5));
            }
        }
        let [columns, rows] = found;
        Ok(misregistration(size, &columns, &rows))
    }

    /// Light of an image as a share of the full picture's; NaN where that is lost in noise.
    fn shares(&self, seen: &[f32], black: &[f32], full: &[f32]) -> Vec<f64> {
        let noise = self.bench.noise();
        let black_dn = self.black_dn;
        seen.iter()
            .zip(black)
            .zip(full)
            .map(|((seen, black), full)| {
                let light = full - black;
                let sigma = (noise.variance(f64::from(*full) - black_dn) / EDGE_FRAMES as f64).sqrt() as f32;
                if light > LEAST_SIGMA * sigma { f64::from((seen - black) / light) } else { f64::NAN }
            })
            .collect()
    }

    /// Code values at which a card returns both states alike: the brighter one is driven down, halving the range.
    fn drive(&mut self, card: &NamedRegion) -> Result<Drive, Failure> {
        let pixels = inside(card, self.width);
        let states = [self.states.horizontal.rgb(), self.states.vertical.rgb()];
        let black = self.image(Slide::Uniform([0; 3]))?;
        let mut light = |state: Rgb, code: u8| -> Result<f64, Failure> {
            let seen = self.image(Slide::Uniform(state.map(|on| if on > 0 { code } else { 0 })))?;
            let sum: f64 = pixels.iter().map(|&at| f64::from(seen[at as usize] - black[at as usize])).sum();
            Ok(sum / pixels.len() as f64)
        };
        let (h, v) = (light(states[0], 255)?, light(states[1], 255)?);
        if h <= 1.0 || v <= 1.0 {
            let message = format!(
                "the card returns {h:.1} DN of H and {v:.1} DN of V: too little; lengthen the exposure"
            );
            return Err(Failure::data(OPERATION, message));
        }
        let (brighter, target) = if h > v { (states[0], v) } else { (states[1], h) };
        let (mut low, mut high) = (0u8, 255u8);
        while high - low > 1 {
            let code = low + (high - low) / 2;
            if light(brighter, code)? < target { low = code } else { high = code }
        }
        let (horizontal, vertical) = if h > v { (high, 255) } else { (255, high) };
        Ok(Drive { horizontal, vertical, ratio_at_full: h / v })
    }
}

/// Indices of the pixels of a region.
fn inside(region: &NamedRegion, width: usize) -> Vec<u32> {
    let rows = region.y..region.y + region.height;
    rows.flat_map(|y| (region.x..region.x + region.width).map(move |x| (y * width + x) as u32)).collect()
}

/// One edge, found in every line of the images of both states: rows for an edge between columns, columns else.
fn edges_of(shares: &[Vec<f64>], width: usize, axis: usize, projector_px: f64) -> Vec<EdgeShift> {
    let height = shares[0].len() / width.max(1);
    let (lines, length) = if axis == 0 { (height, width) } else { (width, height) };
    let pixel = |line: usize, at: usize| if axis == 0 { line * width + at } else { at * width + line };
    let found = (0..lines).filter_map(|line| {
        let [first, second] = [0, 1].map(|state: usize| -> Vec<f64> {
            (0..length).map(|at| shares[state][pixel(line, at)]).collect()
        });
        let (at, shift_px) = edge_shift(&first, &second)?;
        let camera_px = if axis == 0 { [at, line as f64] } else { [line as f64, at] };
        Some(EdgeShift { camera_px, projector_px, shift_px })
    });
    found.collect()
}
