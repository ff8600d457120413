//! What is varied, and the scans.

use std::error::Error;

use polscan::{config::Settings, report::Accuracy};
use polscan_drivers::{
    camera::PixelFormat,
    sim::{RigDescription, Scene, Shape},
};
use polscan_patterns::Mode;

use crate::{Figures, middle, of_plane, of_scene, report, scan};

/// One quantity varied, everything else as in `config/sim.toml`.
pub struct Sweep {
    /// Name of the plot's file.
    pub name: &'static str,
    /// Title of its section.
    pub title: &'static str,
    /// Name and unit of the quantity.
    pub axis: &'static str,
    /// Whether values differ by factors.
    pub log: bool,
    /// What a reader should know.
    pub text: &'static str,
    /// Surfaces that figures are given for.
    pub surfaces: Vec<&'static str>,
    /// Value, and figures of each surface.
    pub points: Vec<(f64, Vec<Option<Figures>>)>,
}

/// Figures of one strip of the wedge.
pub struct Strip {
    /// Level under uniform H over the full well; above 1 the frames that show it bright saturate.
    pub level: f64,
    /// Its figures.
    pub figures: Option<Figures>,
}

/// Everything that was measured.
pub struct Measured {
    /// Sweeps in order.
    pub sweeps: Vec<Sweep>,
    /// The wedge at extinction 10:1, 12 bit, by each mode.
    pub wedges: Vec<(Mode, Vec<Strip>)>,
    /// Position of single edges at reflectance 1 and 0.1, rms in projector px.
    pub edges: Vec<(f64, Option<f64>)>,
    /// Decades below the full well down to which a pixel of the wedge reaches the lit gate of 4 sigma on the mean: with
    /// the rig's ambient light, and without any.
    pub range_limits: [f64; 2],
    /// The pinned scene, whole.
    pub pinned: polscan::report::Report,
}

impl Measured {
    /// Number of scans behind it.
    pub fn scans(&self) -> usize {
        self.sweeps.iter().map(|sweep| sweep.points.len()).sum::<usize>()
            + self.wedges.len()
            + self.edges.len()
            + 1
    }
}

/// The simulated rig of the settings.
fn rig(settings: &mut Settings) -> Result<&mut RigDescription, Box<dyn Error>> {
    let (description, _) = settings.sim.as_mut().ok_or("the base configuration has no simulated rig")?;
    Ok(description)
}

fn set_scene(settings: &mut Settings, text: &str) -> Result<(), Box<dyn Error>> {
    let scene: Scene = toml::from_str(text)?;
    settings.sim.as_mut().ok_or("the base configuration has no simulated rig")?.1 = scene;
    Ok(())
}

const ALUMINIUM: &str =
    "[materials.aluminium]\nindex = [0.96, 6.7]\nroughness = 0.45\ndiffuse = 0.1\ntexture = 0.15\n";

/// One plane, its distance in mm, its tilt about the vertical in degrees, and its level.
fn plane(z_mm: f64, tilt_deg: f64, level: f64) -> String {
    let (sin, cos) = tilt_deg.to_radians().sin_cos();
    format!(
        "{ALUMINIUM}[[objects]]\nname = \"plane\"\nmaterial = \"aluminium\"\nlevel = {level}\n\
         shape = {{ plane = {{ point_mm = [0.0, 0.0, {z_mm:?}], normal = [{sin:?}, 0.02, {:?}] }} }}\n",
        -cos
    )
}

fn sphere(level: f64) -> String {
    format!(
        "{ALUMINIUM}[[objects]]\nname = \"sphere\"\nmaterial = \"aluminium\"\nlevel = {level}\n\
         shape = {{ sphere = {{ centre_mm = [0.0, 0.0, 1040.0], radius_mm = 55.0 }} }}\n"
    )
}

/// The paper's two plates with one thing changed for each value.
fn on_plates(
    base: &Settings,
    sweep: Sweep,
    values: &[f64],
    change: impl Fn(&mut Settings, f64) -> Result<(), Box<dyn Error>>,
) -> Result<Sweep, Box<dyn Error>> {
    let mut points = Vec::new();
    for &value in values {
        let mut settings = middle(base);
        change(&mut settings, value)?;
        let report = report(&settings)?;
        points.push((value, vec![of_plane(&report, "white"), of_plane(&report, "black")]));
        eprintln!("{} {value}", sweep.name);
    }
    Ok(Sweep { surfaces: vec!["white plate", "black plate"], points, ..sweep })
}

/// One object for each value.
fn on_scenes(
    base: &Settings,
    sweep: Sweep,
    values: &[f64],
    scene: impl Fn(f64, f64) -> String,
) -> Result<Sweep, Box<dyn Error>> {
    let mut points = Vec::new();
    for &value in values {
        let mut of = Vec::new();
        for level in [0.9, 0.027] {
            let mut settings = middle(base);
            set_scene(&mut settings, &scene(value, level))?;
            let report = report(&settings)?;
            of.push(of_plane(&report, "plane").or_else(|| of_scene(&report)));
        }
        points.push((value, of));
        eprintln!("{} {value}", sweep.name);
    }
    Ok(Sweep { surfaces: vec!["bright (0.9 of full well)", "dark (0.03 of it)"], points, ..sweep })
}

fn sweep(
    name: &'static str,
    title: &'static str,
    axis: &'static str,
    log: bool,
    text: &'static str,
) -> Sweep {
    Sweep { name, title, axis, log, text, surfaces: Vec::new(), points: Vec::new() }
}

/// All scans.
pub fn all(base: &Settings) -> Result<Measured, Box<dyn Error>> {
    let pinned = report(base)?;
    eprintln!("pinned scene");
    let mut wedges = Vec::new();
    for mode in [Mode::Pse, Mode::Paper] {
        wedges.push((mode, wedge(base, mode)?));
        eprintln!("wedge {mode}");
    }
    let mut edges = Vec::new();
    for reflectance in [1.0, 0.1] {
        edges.push((reflectance, edge_rms(base, reflectance)?));
    }
    let sweeps = vec![
        on_plates(
            base,
            sweep(
                "exposure",
                "Exposure",
                "exposure, us",
                true,
                "From 4000 us on the white plate is brighter than the full well.",
            ),
            &[125.0, 250.0, 500.0, 1000.0, 2000.0, 4000.0, 8000.0],
            |settings, value| {
                settings.camera.exposure_us = value;
                Ok(())
            },
        )?,
        on_plates(
            base,
            sweep(
                "bit-depth",
                "Bit depth",
                "bits of a sample",
                false,
                "The same sensor read out with fewer or more bits.",
            ),
            &[8.0, 10.0, 12.0, 16.0],
            |settings, value| {
                settings.camera.format = match value as u8 {
                    8 => PixelFormat::Mono8,
                    10 => PixelFormat::Mono10,
                    12 => PixelFormat::Mono12,
                    _ => PixelFormat::Mono16,
                };
                let camera = &mut rig(settings)?.camera;
                camera.bits = camera.bits.max(value as u8);
                Ok(())
            },
        )?,
        on_plates(
            base,
            sweep(
                "extinction",
                "Extinction of the projector",
                "extinction ratio of each channel",
                true,
                "Light of a channel along its polarization over light across it. The analyser stays at 500:1.",
            ),
            &[2.0, 3.0, 5.0, 10.0, 20.0, 50.0, 200.0],
            |settings, value| {
                rig(settings)?.projector.extinction = [value; 3];
                Ok(())
            },
        )?,
        on_plates(
            base,
            sweep(
                "blur",
                "Blur",
                "blur of the projector lens, projector px (standard deviation)",
                false,
                "One projector pixel is three camera pixels wide here; the camera's own blur stays at 0.6 px. Below 0.2 px \
                 sigma is far too small on this twin, which samples the projected picture at the middle of each camera \
                 pixel: a perfectly sharp stripe edge is then known to a pixel only, which the decoder does not expect.",
            ),
            &[0.0, 0.1, 0.2, 0.4, 0.6, 0.9, 1.2],
            |settings, value| {
                rig(settings)?.projector.blur_px = value;
                Ok(())
            },
        )?,
        on_plates(
            base,
            sweep(
                "ambient",
                "Ambient light",
                "ambient light, electrons per frame",
                true,
                "Where the sum of ambient light and signal reaches the full well the white plate saturates.",
            ),
            &[1.0, 20.0, 100.0, 500.0, 2000.0, 5000.0],
            |settings, value| {
                rig(settings)?.ambient.electrons = value;
                Ok(())
            },
        )?,
        on_scenes(
            base,
            sweep(
                "angle",
                "Angle",
                "tilt of a plane about the vertical, degrees",
                false,
                "Positive: towards the projector.",
            ),
            &[-60.0, -40.0, -20.0, 0.0, 20.0, 40.0, 60.0],
            |value, level| plane(1000.0, value, level),
        )?,
        on_scenes(
            base,
            sweep(
                "distance",
                "Distance",
                "distance of a plane, mm",
                false,
                "The projector is in focus at every distance.",
            ),
            &[750.0, 875.0, 1000.0, 1125.0, 1250.0],
            |value, level| plane(value, 3.0, level),
        )?,
        on_scenes(
            base,
            sweep(
                "sphere",
                "Sphere",
                "level of the brightest pixel, share of full well times",
                false,
                "A sphere of 55 mm.",
            ),
            &[1.0],
            |_, level| sphere(level),
        )?,
    ];
    let ambient = rig(&mut base.clone())?.ambient.electrons;
    let range_limits = [ambient, 0.0].map(|ambient| range_limit(base, ambient));
    Ok(Measured { sweeps, wedges, edges, range_limits, pinned })
}

/// Extinction of the projector on the wedge.
pub const WEDGE_EXTINCTION: f64 = 10.0;

/// Decades from the full well down to the level where modulation equals 4 sigma of a pattern less its inverse:
/// `(1 - 1/e) H = 4 sqrt((1 + 1/e) H + 2 ambient + 2 read^2)` in electrons.
fn range_limit(base: &Settings, ambient: f64) -> f64 {
    let Some((description, _)) = &base.sim else { return f64::NAN };
    let (leak, gate) = (1.0 / WEDGE_EXTINCTION, 4.0);
    let fixed = 2.0 * ambient + 2.0 * description.camera.read_noise_e.powi(2);
    let (a, b, c) = ((1.0 - leak).powi(2), gate * gate * (1.0 + leak), gate * gate * fixed);
    let least = (b + (b * b + 4.0 * a * c).sqrt()) / (2.0 * a);
    (description.camera.full_well_e / least).log10()
}

/// Level of the brightest strip over the full well: with an extinction of 10:1 its dark state still fits.
const BRIGHTEST: f64 = 9.0;
/// Strips in a decade.
const STRIPS_PER_DECADE: u32 = 8;
/// Strips of the wedge.
const STRIPS: u32 = 4 * STRIPS_PER_DECADE + 3;

/// Strips of the wedge at extinction 10:1, over the whole sensor.
fn wedge(base: &Settings, mode: Mode) -> Result<Vec<Strip>, Box<dyn Error>> {
    let mut settings = base.clone();
    settings.mode = mode;
    rig(&mut settings)?.projector.extinction = [WEDGE_EXTINCTION; 3];
    let mut scene: Scene = toml::from_str(include_str!("../../config/scenes/wedge.toml"))?;
    let object = scene.objects.first_mut().ok_or("the wedge's scene is empty")?;
    object.level = Some(BRIGHTEST);
    let Shape::Wedge(shape) = &mut object.shape else {
        return Err("the wedge's scene holds no wedge".into());
    };
    shape.strips = STRIPS;
    shape.decades = f64::from(STRIPS - 1) / f64::from(STRIPS_PER_DECADE);
    settings.sim.as_mut().ok_or("the base configuration has no simulated rig")?.1 = scene;
    let report = report(&settings)?;
    let strip = |number: u32| Strip {
        level: BRIGHTEST * 10f64.powf(-f64::from(number) / f64::from(STRIPS_PER_DECADE)),
        figures: of_plane(&report, &format!("wedge-{number:02}")),
    };
    Ok((0..STRIPS).map(strip).collect())
}

/// Root mean square error of single edges: with fits through two edges only, a pixel beside an edge carries that edge's
/// error and no other.
fn edge_rms(base: &Settings, reflectance: f64) -> Result<Option<f64>, Box<dyn Error>> {
    let mut settings = middle(base);
    settings.thresholds.fit_edges = 2;
    set_scene(&mut settings, &plane(1000.0, 3.0, 0.9 * reflectance))?;
    scan(&settings, |results| {
        let (decoded, truth) = (&results.outcome.decoded, results.context.truth?);
        let (mut sum, mut count) = (0.0, 0u32);
        let pixels = decoded.column.coordinate.data().iter().zip(truth.column.data());
        for (index, (found, expected)) in pixels.enumerate() {
            let beside_edge = decoded.class.data()[index].is_valid() && !decoded.interpolated.data()[index];
            if beside_edge && expected.is_finite() {
                sum += f64::from(found - expected).powi(2);
                count += 1;
            }
        }
        (count > 0).then(|| (sum / f64::from(count)).sqrt())
    })
}

/// Level of the brightest and of the darkest strip of the longest run of strips that all have at least 95 % coverage and
/// at most 0.1 % wrong.
pub fn range(strips: &[Strip]) -> Option<(f64, f64)> {
    let good = |strip: &Strip| {
        let Some(Figures { accuracy: Accuracy { coverage, wrong_code_rate, .. }, .. }) = strip.figures else {
            return false;
        };
        coverage.is_some_and(|share| share >= 0.95) && wrong_code_rate.is_some_and(|rate| rate <= 1e-3)
    };
    let runs = strips.chunk_by(|one, next| good(one) == good(next)).filter(|run| good(&run[0]));
    runs.max_by_key(|run| run.len()).map(|run| (run[0].level, run[run.len() - 1].level))
}

/// Decades of [`range`].
pub fn decades(strips: &[Strip]) -> f64 {
    range(strips).map_or(0.0, |(brightest, darkest)| (brightest / darkest).log10())
}
