//! One exposure: light on the scene, the camera's lens, electrons, samples.

use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;

use super::{
    description::{CameraDescription, RigDescription},
    noise::Stream,
    panel::{Channels, Illumination, Mixture, Panel, blurred_box, reach_px},
    script::Script,
    timeline::NEGLIGIBLE_SHARE,
    world::{View, World},
};
use crate::{
    camera::Region,
    frame::{PixelStore, Pixels},
    projector::Slide,
};

/// Stream of the sensor's own pattern; exposures count from 0 and do not reach it.
const SENSOR_STREAM: u64 = u64::MAX;
/// Frames whose memory is kept for the next ones.
const SPARE_BUFFERS: usize = 8;

/// How electrons become samples, under the applied settings.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Response {
    pub(crate) region: Region,
    pub(crate) bits: u8,
    /// System gain K.
    pub(crate) dn_per_electron: f64,
    pub(crate) black_dn: f64,
    pub(crate) gamma: f64,
    pub(crate) exposure_us: f64,
}

impl Response {
    /// Largest sample.
    pub(crate) fn full_scale_dn(&self) -> u16 {
        full_scale_dn(self.bits)
    }
}

/// Largest sample of a bit depth.
pub(crate) fn full_scale_dn(bits: u8) -> u16 {
    u16::MAX >> (16 - bits)
}

/// Light and identity of one exposure: all that its frame depends on besides the response.
#[derive(Debug, Clone)]
pub(crate) struct Exposure {
    /// Number since the rig was made: what its noise depends on.
    pub(crate) number: u64,
    /// Slides, weights in seconds of the mean lamp.
    pub(crate) light: Mixture,
    /// Ambient light, in electrons at the reference exposure.
    pub(crate) ambient_e: f64,
    /// Whether something has been bumped before it.
    pub(crate) bumped: bool,
}

impl Exposure {
    /// Whether the frames of both are the same, but for light that no slide is rendered for anyway.
    pub(crate) fn is_same_as(&self, other: &Self) -> bool {
        let total: f64 = self.light.iter().map(|(_, weight)| weight).sum();
        let weight_in = |light: &Mixture, slide: &Arc<Slide>| -> f64 {
            let of = |(its, _): &&(Arc<Slide>, f64)| Arc::ptr_eq(its, slide) || its == slide;
            light.iter().filter(of).map(|(_, weight)| weight).sum()
        };
        let same_light = |(slide, _): &(Arc<Slide>, f64)| {
            let difference = weight_in(&self.light, slide) - weight_in(&other.light, slide);
            difference.abs() <= NEGLIGIBLE_SHARE * total
        };
        (self.number, self.ambient_e, self.bumped) == (other.number, other.ambient_e, other.bumped)
            && self.light.iter().chain(&other.light).all(same_light)
    }
}

/// Renders exposures of one world.
#[derive(Debug)]
pub(crate) struct Renderer {
    world: World,
    /// The same after a bump.
    bumped: Option<World>,
    panel: Panel,
    camera: CameraDescription,
    script: Script,
    seed: u64,
    /// The camera's blur at whole pixels, symmetric, sum 1.
    kernel: Vec<f32>,
    /// Sensitivity and dark offset per pixel of the sensor, where it has a pattern.
    pattern: Option<Vec<[f32; 2]>>,
    spare: Arc<Spare>,
    /// Light between the two passes of the blur.
    plane: Mutex<Vec<f32>>,
}

impl Renderer {
    pub(crate) fn new(
        description: &RigDescription,
        world: World,
        bumped: Option<World>,
        panel: Panel,
        script: &Script,
    ) -> Self {
        let camera = description.camera.clone();
        let kernel = kernel(camera.blur_px);
        debug_assert_eq!(kernel.len(), 2 * world.border + 1);
        let pattern = (camera.prnu_share > 0.0 || camera.dsnu_e > 0.0).then(|| {
            let stream = Stream::new(description.seed, SENSOR_STREAM);
            let pixels = camera.size.map(u64::from).iter().product();
            (0..pixels)
                .into_par_iter()
                .map(|pixel| {
                    let (gain, offset) = stream.normals(pixel);
                    [1.0 + camera.prnu_share as f32 * gain, camera.dsnu_e as f32 * offset]
                })
                .collect()
        });
        Self {
            world,
            bumped,
            panel,
            camera,
            script: script.clone(),
            seed: description.seed,
            kernel,
            pattern,
            spare: Arc::default(),
            plane: Mutex::default(),
        }
    }

    /// The scene as the camera sees it.
    pub(crate) fn world(&self) -> &World {
        &self.world
    }

    /// Samples of an exposure.
    pub(crate) fn render(&self, exposure: &Exposure, response: &Response) -> Arc<dyn PixelStore> {
        if response.bits <= 8 {
            let mut samples = self.spare.take_u8(response.region);
            self.render_into(exposure, response, &mut samples, |dn| dn as u8);
            Arc::new(Recycled { samples: Samples::U8(samples), spare: self.spare.clone() })
        } else {
            let mut samples = self.spare.take_u16(response.region);
            self.render_into(exposure, response, &mut samples, |dn| dn as u16);
            Arc::new(Recycled { samples: Samples::U16(samples), spare: self.spare.clone() })
        }
    }

    fn render_into<T: Send>(
        &self,
        exposure: &Exposure,
        response: &Response,
        samples: &mut [T],
        sample: impl Fn(f32) -> T + Sync,
    ) {
        let mut plane = self.plane.lock().unwrap_or_else(PoisonError::into_inner);
        self.blurred_rows(exposure, response, &mut plane);
        let width = response.region.width as usize;
        let stream = Stream::new(self.seed, exposure.number);
        let developer = Developer::new(&self.camera, exposure.ambient_e, response);
        samples.par_chunks_mut(width).enumerate().for_each_init(
            || vec![0.0f32; width],
            |row, (y, out)| {
                row.fill(0.0);
                for (offset, weight) in self.kernel.iter().enumerate() {
                    let source = &plane[(y + offset) * width..(y + offset + 1) * width];
                    row.iter_mut().zip(source).for_each(|(sum, light)| *sum += weight * light);
                }
                let sensor_row = response.region.y + y as u32;
                let first =
                    u64::from(sensor_row) * u64::from(self.camera.size[0]) + u64::from(response.region.x);
                let pattern = self.pattern.as_ref().map(|pattern| &pattern[first as usize..][..width]);
                developer.develop(stream, first, row, pattern, self.script.is_dead(sensor_row));
                out.iter_mut().zip(row.iter()).for_each(|(out, dn)| *out = sample(*dn));
            },
        );
    }

    /// Light of all rows that the region needs, blurred along x.
    fn blurred_rows(&self, exposure: &Exposure, response: &Response, plane: &mut Vec<f32>) {
        let Region { x, y, width, height } = response.region;
        let [x, y, width, height] = [x, y, width, height].map(|value| value as usize);
        let world = match (&self.bumped, exposure.bumped) {
            (Some(bumped), true) => bumped,
            _ => &self.world,
        };
        let border = world.border;
        let (wide, tall) = (width + 2 * border, height + 2 * border);
        let reference_s = 1e-6 * self.camera.reference_exposure_us;
        let light: Mixture =
            exposure.light.iter().map(|(slide, weight)| (slide.clone(), weight / reference_s)).collect();
        let illumination = self.panel.illuminate(&light);
        plane.resize(width * tall, 0.0);
        plane.par_chunks_mut(width).enumerate().for_each_init(
            || vec![0.0f32; wide],
            |row, (line, out)| {
                let start = (y + line) * world.width + x;
                light_row(&illumination, &world.views[start..start + wide], row);
                out.fill(0.0);
                for (offset, weight) in self.kernel.iter().enumerate() {
                    out.iter_mut().zip(&row[offset..]).for_each(|(sum, light)| *sum += weight * light);
                }
            },
        );
    }
}

/// Blur of the lens and box of the pixel at whole pixels.
fn kernel(blur_px: f64) -> Vec<f32> {
    if blur_px == 0.0 {
        return vec![1.0];
    }
    let reach = reach_px(blur_px) as i32;
    let weights: Vec<f64> = (-reach..=reach).map(|offset| blurred_box(f64::from(offset), blur_px)).collect();
    let total: f64 = weights.iter().sum();
    weights.into_iter().map(|weight| (weight / total) as f32).collect()
}

fn dot(gain: [f32; 3], light: Channels) -> f32 {
    gain[0] * light[0] + gain[1] * light[1] + gain[2] * light[2]
}

/// Light of a row of views; the common kinds of slides have loops of their own.
fn light_row(illumination: &Illumination, views: &[View], row: &mut [f32]) {
    let constant = illumination.constant;
    let plus =
        |light: Channels| -> Channels { std::array::from_fn(|channel| light[channel] + constant[channel]) };
    let views = views.iter().zip(row);
    match (&illumination.columns, &illumination.rows, &illumination.full) {
        (None, None, None) => views.for_each(|(view, light)| *light = dot(view.gain, constant)),
        (Some(table), None, None) => {
            views.for_each(|(view, light)| *light = dot(view.gain, plus(table.at(view.column))));
        }
        (None, Some(table), None) => {
            views.for_each(|(view, light)| *light = dot(view.gain, plus(table.at(view.row))));
        }
        _ => views.for_each(|(view, light)| {
            let dark = view.gain == [0.0; 3];
            *light = if dark { 0.0 } else { dot(view.gain, illumination.at(view.column, view.row)) };
        }),
    }
}

/// From light to samples.
struct Developer {
    background_e: f32,
    full_well_e: f32,
    read_noise_e: f32,
    dn_per_electron: f32,
    black_dn: f32,
    full_scale_dn: f32,
    /// Exponent, and the electrons that give full scale; `None` where the response is linear.
    curve: Option<(f32, f32)>,
}

impl Developer {
    fn new(camera: &CameraDescription, ambient_e: f64, response: &Response) -> Self {
        let background = ambient_e * response.exposure_us / camera.reference_exposure_us
            + camera.dark_current_e_per_s * 1e-6 * response.exposure_us;
        let full_scale = f64::from(response.full_scale_dn());
        let white_e = (full_scale - response.black_dn) / response.dn_per_electron;
        Self {
            background_e: background as f32,
            full_well_e: camera.full_well_e as f32,
            read_noise_e: camera.read_noise_e as f32,
            dn_per_electron: response.dn_per_electron as f32,
            black_dn: response.black_dn as f32,
            full_scale_dn: full_scale as f32,
            curve: (response.gamma != 1.0).then_some((response.gamma as f32, white_e as f32)),
        }
    }

    /// Turns mean electrons of light into samples in DN, clipped but not yet cut to whole numbers. A `dead` row collects
    /// none.
    fn develop(
        &self,
        stream: Stream,
        first_pixel: u64,
        row: &mut [f32],
        pattern: Option<&[[f32; 2]]>,
        dead: bool,
    ) {
        match pattern {
            _ if dead => row.fill(0.0),
            None => row.iter_mut().for_each(|light| *light = (*light + self.background_e).max(0.0)),
            Some(pattern) => row.iter_mut().zip(pattern).for_each(|(light, [sensitivity, _])| {
                *light = (*light * sensitivity + self.background_e).max(0.0);
            }),
        }
        stream.expose(first_pixel, row, self.full_well_e, self.read_noise_e);
        if let Some(pattern) = pattern {
            row.iter_mut().zip(pattern).for_each(|(electrons, [_, offset])| *electrons += offset);
        }
        if let Some((gamma, white_e)) = self.curve {
            for electrons in row.iter_mut() {
                let share = *electrons / white_e;
                *electrons = white_e * libm::powf(share.abs(), gamma).copysign(share);
            }
        }
        for value in row {
            // With the half, cutting off the fraction rounds.
            *value = (*value * self.dn_per_electron + (self.black_dn + 0.5)).clamp(0.0, self.full_scale_dn);
        }
    }
}

/// Memory of frames that were dropped.
#[derive(Debug, Default)]
struct Spare {
    bytes: Mutex<Vec<Vec<u8>>>,
    words: Mutex<Vec<Vec<u16>>>,
}

impl Spare {
    fn take_u8(&self, region: Region) -> Vec<u8> {
        take(&self.bytes, region)
    }

    fn take_u16(&self, region: Region) -> Vec<u16> {
        take(&self.words, region)
    }
}

fn take<T: Clone + Default>(spare: &Mutex<Vec<Vec<T>>>, region: Region) -> Vec<T> {
    let mut samples = spare.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default();
    samples.resize(region.width as usize * region.height as usize, T::default());
    samples
}

fn give_back<T>(spare: &Mutex<Vec<Vec<T>>>, samples: &mut Vec<T>) {
    let mut spare = spare.lock().unwrap_or_else(PoisonError::into_inner);
    if spare.len() < SPARE_BUFFERS {
        spare.push(std::mem::take(samples));
    }
}

#[derive(Debug)]
enum Samples {
    U8(Vec<u8>),
    U16(Vec<u16>),
}

/// A frame's memory, given back when dropped.
#[derive(Debug)]
struct Recycled {
    samples: Samples,
    spare: Arc<Spare>,
}

impl PixelStore for Recycled {
    fn pixels(&self) -> Pixels<'_> {
        match &self.samples {
            Samples::U8(samples) => Pixels::U8(samples),
            Samples::U16(samples) => Pixels::U16(samples),
        }
    }
}

impl Drop for Recycled {
    fn drop(&mut self) {
        match &mut self.samples {
            Samples::U8(samples) => give_back(&self.spare.bytes, samples),
            Samples::U16(samples) => give_back(&self.spare.words, samples),
        }
    }
}
