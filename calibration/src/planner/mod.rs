//! What a rig will do, from its data sheets, before anything is bolted down.
//!
//! Frame: the camera looks along z; the projector stands beside it along x, turned so that the middle of its picture meets
//! the camera's axis at the working distance. The object is a plane across the camera's axis there.

use nalgebra::{Rotation3, Vector3};
use polscan_patterns::{Mode, ProjectorSize, Sequence};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Camera pixels looked at along each axis for the overlap.
const OVERLAP_GRID: u32 = 81;
/// Standard deviation of a box one pixel wide.
const BOX_PX: f64 = 0.288_675_134_594_812_9;
/// Between two pixels, a crossing is found with this much of the variance of one pixel's, on average.
const BETWEEN_PIXELS: f64 = 2.0 / 3.0;
/// Safety of a trigger, and time to hand the next picture to the display, as in a scan.
const MARGIN_MS: f64 = 1.0;
const LEAD_MS: f64 = 2.0;
/// Incidence beyond which metal turns the polarization noticeably.
const OBLIQUE_DEG: f64 = 20.0;
/// Camera pixels per projector pixel below which fine stripes are lost.
const FEWEST_CAMERA_PIXELS: f64 = 1.5;
/// Overlap below which much of the camera's image is wasted.
const LEAST_OVERLAP: f64 = 0.8;

/// A rig on paper. The default is the rig of the simulated configuration that comes with the program.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Design {
    /// Focal length of the camera's lens.
    pub focal_mm: f64,
    /// Width of a camera pixel.
    pub pixel_um: f64,
    /// Camera pixels, width and height.
    pub sensor: [u32; 2],
    /// Blur of the camera's lens, one sigma.
    pub camera_blur_px: f64,
    /// Electrons of a full pixel.
    pub full_well_e: f64,
    /// Read noise.
    pub read_noise_e: f64,
    /// Bits of a sample.
    pub bits: u8,
    /// Projector pixels, width and height.
    pub projector: [u32; 2],
    /// Distance over width of the picture.
    pub throw_ratio: f64,
    /// How far the lens axis lies below the middle of the picture, as a share of its height.
    pub lens_shift: f64,
    /// Blur of the projector's lens in projector px, one sigma.
    pub projector_blur_px: f64,
    /// Refreshes per second.
    pub refresh_hz: f64,
    /// From flip to first light.
    pub latency_ms: f64,
    /// From first light until the picture has settled.
    pub settling_ms: f64,
    /// Between the lenses.
    pub baseline_mm: f64,
    /// From the camera to the object.
    pub distance_mm: f64,
    /// Exposure time.
    pub exposure_us: f64,
    /// From the end of exposure until the frame is there.
    pub readout_us: f64,
    /// Light of H on the bright surface, as a share of the full well.
    pub bright: f64,
    /// Light of H on the black one, likewise.
    pub black: f64,
    /// H over V on metal.
    pub extinction_ratio: f64,
    /// Ambient light in electrons.
    pub ambient_e: f64,
    /// Edges of the local fit.
    pub fit_edges: u32,
    /// Mode of the scan.
    pub mode: Mode,
}

impl Default for Design {
    fn default() -> Self {
        Self {
            focal_mm: 16.0,
            pixel_um: 3.45,
            sensor: [1600, 1200],
            camera_blur_px: 0.6,
            full_well_e: 10_500.0,
            read_noise_e: 2.3,
            bits: 12,
            projector: [1024, 768],
            throw_ratio: 1.504,
            lens_shift: 0.47,
            projector_blur_px: 0.6,
            refresh_hz: 60.0,
            latency_ms: 33.3,
            settling_ms: 18.9,
            baseline_mm: 52.4,
            distance_mm: 1000.0,
            exposure_us: 2000.0,
            readout_us: 6100.0,
            bright: 0.8,
            black: 0.024,
            extinction_ratio: 16.0,
            ambient_e: 20.0,
            fit_edges: 8,
            mode: Mode::Pse,
        }
    }
}

/// A value that no rig has.
#[derive(Debug, Clone, PartialEq, Error)]
#[error("{name} is {value}, it must be within {low} and {high}")]
pub struct DesignError {
    /// Key.
    name: &'static str,
    /// Its value.
    value: f64,
    /// Least.
    low: f64,
    /// Most.
    high: f64,
}

/// Angles at one point of the object.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Incidence {
    /// Camera pixel that sees it.
    pub camera_px: [f64; 2],
    /// Between the camera's ray and the plane's normal.
    pub camera_deg: f64,
    /// Between the projector's ray and the normal.
    pub projector_deg: f64,
    /// Between the two rays: what depth comes from.
    pub between_deg: f64,
}

/// Error of one surface.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Precision {
    /// H in electrons.
    pub h_e: f64,
    /// Noise of the normalised fringe.
    pub fringe_sigma: f64,
    /// Edge position in projector px, before the local fit.
    pub edge_rms_px: f64,
    /// Column after it.
    pub column_rms_px: f64,
    /// Depth.
    pub sigma_z_mm: f64,
}

/// What the rig will do.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Forecast {
    /// Width and height that the camera sees at the working distance.
    pub camera_field_mm: [f64; 2],
    /// Width and height of the picture there.
    pub projector_field_mm: [f64; 2],
    /// Share of the camera's image that the picture covers.
    pub overlap: f64,
    /// Size of a camera pixel on the object.
    pub camera_pixel_mm: f64,
    /// Size of a projector pixel on the object.
    pub projector_pixel_mm: f64,
    /// Depth that one projector column is.
    pub column_depth_mm: f64,
    /// On the bright surface.
    pub bright: Precision,
    /// On the black one.
    pub black: Precision,
    /// At the middle and the four corners of the camera's image.
    pub incidence: Vec<Incidence>,
    /// From flip to exposure.
    pub trigger_delay_ms: f64,
    /// Refreshes for which each picture is held.
    pub hold_refreshes: u32,
    /// Frames of a scan.
    pub frames: usize,
    /// Time of a scan.
    pub scan_s: f64,
    /// What a builder should think over.
    pub remarks: Vec<String>,
}

impl Design {
    /// Focal lengths of camera and projector in px.
    fn focal_px(&self) -> [f64; 2] {
        [1e3 * self.focal_mm / self.pixel_um, self.throw_ratio * f64::from(self.projector[0])]
    }

    fn check(&self) -> Result<(), DesignError> {
        let sides = |name, size: [u32; 2]| size.map(|side| (name, f64::from(side), 1.0, 8192.0));
        let values = [
            ("focal_mm", self.focal_mm, 0.1, 1e4),
            ("pixel_um", self.pixel_um, 0.1, 100.0),
            ("camera_blur_px", self.camera_blur_px, 0.0, 20.0),
            ("full_well_e", self.full_well_e, 10.0, 1e9),
            ("read_noise_e", self.read_noise_e, 0.0, 1e6),
            ("bits", f64::from(self.bits), 1.0, 24.0),
            ("throw_ratio", self.throw_ratio, 0.05, 100.0),
            ("lens_shift", self.lens_shift, -3.0, 3.0),
            ("projector_blur_px", self.projector_blur_px, 0.0, 20.0),
            ("refresh_hz", self.refresh_hz, 1.0, 1e4),
            ("latency_ms", self.latency_ms, 0.0, 1e4),
            ("settling_ms", self.settling_ms, 0.0, 1e4),
            ("distance_mm", self.distance_mm, 1.0, 1e6),
            ("exposure_us", self.exposure_us, 1.0, 3e7),
            ("readout_us", self.readout_us, 0.0, 3e7),
            ("bright", self.bright, 1e-6, 1.0),
            ("black", self.black, 1e-6, 1.0),
            ("extinction_ratio", self.extinction_ratio, 1.01, 1e6),
            ("ambient_e", self.ambient_e, 0.0, 1e9),
            ("fit_edges", f64::from(self.fit_edges), 2.0, 64.0),
            // Of either sign, but no baseline no depth.
            ("baseline_mm", self.baseline_mm.abs(), 1e-3, 1e6),
        ];
        let all =
            values.into_iter().chain(sides("sensor", self.sensor)).chain(sides("projector", self.projector));
        let wrong = all.into_iter().find(|(_, value, low, high)| !(low..=high).contains(&value));
        match wrong {
            Some((name, value, low, high)) => Err(DesignError { name, value, low, high }),
            None => Ok(()),
        }
    }

    /// Centre of the projector and its rotation into the camera's frame.
    fn pose(&self) -> (Vector3<f64>, Rotation3<f64>) {
        let focal = self.focal_px()[1];
        // The middle of the picture lies above the lens axis by the shift.
        let middle = Vector3::new(0.0, -self.lens_shift * f64::from(self.projector[1]) / focal, 1.0);
        let centre = Vector3::new(self.baseline_mm, 0.0, 0.0);
        let aim = Vector3::new(0.0, 0.0, self.distance_mm) - centre;
        // First up or down until the middle is level, then sideways; the projector does not roll.
        let level = Rotation3::from_axis_angle(&Vector3::x_axis(), -middle.y.atan2(middle.z));
        let turn = aim.x.atan2(aim.z);
        let pitch = [level, level.inverse()];
        let flat = |rotation: &Rotation3<f64>| (rotation * middle).y.abs();
        let level = if flat(&pitch[0]) < flat(&pitch[1]) { pitch[0] } else { pitch[1] };
        (centre, Rotation3::from_axis_angle(&Vector3::y_axis(), turn) * level)
    }

    /// Point of the object that a camera pixel sees.
    fn seen(&self, [x, y]: [f64; 2]) -> Vector3<f64> {
        let focal = self.focal_px()[0];
        let middle = self.sensor.map(|side| 0.5 * (f64::from(side) - 1.0));
        self.distance_mm * Vector3::new((x - middle[0]) / focal, (y - middle[1]) / focal, 1.0)
    }

    /// Projector pixel that lights a point, where the point lies before it.
    fn lit_by(&self, point: Vector3<f64>) -> Option<[f64; 2]> {
        let (centre, camera_from_projector) = self.pose();
        let ray = camera_from_projector.inverse() * (point - centre);
        let focal = self.focal_px()[1];
        let [width, height] = self.projector.map(f64::from);
        let axis = [0.5 * (width - 1.0), 0.5 * (height - 1.0) + self.lens_shift * height];
        (ray.z > 0.0).then(|| [axis[0] + focal * ray.x / ray.z, axis[1] + focal * ray.y / ray.z])
    }

    /// Camera pixel at shares of the image from its middle, each -1 to 1.
    fn pixel(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|axis| 0.5 * (f64::from(self.sensor[axis]) - 1.0) * (1.0 + [x, y][axis]))
    }
}

/// What a design will do.
///
/// # Errors
/// Values that no rig has.
pub fn forecast(design: &Design) -> Result<Forecast, DesignError> {
    design.check()?;
    let [camera_focal, projector_focal] = design.focal_px();
    let camera_pixel_mm = design.distance_mm / camera_focal;
    // Columns per mm across the object, at the middle: the slope of the projection itself.
    let middle = design.seen(design.pixel([0.0, 0.0]));
    let column_at = |offset: Vector3<f64>| design.lit_by(middle + offset).map_or(f64::NAN, |at| at[0]);
    let slope = |step: Vector3<f64>| 0.5 * (column_at(step) - column_at(-step)).abs();
    let projector_pixel_mm = 1.0 / slope(Vector3::new(1.0, 0.0, 0.0));
    let column_depth_mm = 1.0 / slope(Vector3::new(0.0, 0.0, 1.0));
    let precision =
        |share: f64| precision(design, share, camera_pixel_mm / projector_pixel_mm, column_depth_mm);
    let period_ms = 1e3 / design.refresh_hz;
    let trigger_delay_ms = design.latency_ms + design.settling_ms + MARGIN_MS;
    let busy_ms = trigger_delay_ms + 1e-3 * (design.exposure_us + design.readout_us) + LEAD_MS;
    let hold_refreshes = (busy_ms / period_ms).ceil().max(1.0) as u32;
    let size = ProjectorSize { width: design.projector[0], height: design.projector[1] };
    let frames = Sequence::new(design.mode, size).map_or(0, |sequence| sequence.roles.len());
    let places = [[0.0, 0.0], [-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]];
    let mut forecast = Forecast {
        camera_field_mm: design.sensor.map(|side| f64::from(side) * camera_pixel_mm),
        projector_field_mm: design
            .projector
            .map(|side| f64::from(side) * design.distance_mm / projector_focal),
        overlap: overlap(design),
        camera_pixel_mm,
        projector_pixel_mm,
        column_depth_mm,
        bright: precision(design.bright),
        black: precision(design.black),
        incidence: places.map(|place| incidence(design, design.pixel(place))).to_vec(),
        trigger_delay_ms,
        hold_refreshes,
        frames,
        scan_s: 1e-3 * (frames as f64 * f64::from(hold_refreshes) * period_ms),
        remarks: Vec::new(),
    };
    forecast.remarks = remarks(&forecast);
    Ok(forecast)
}

/// Share of the camera's image that the picture covers.
fn overlap(design: &Design) -> f64 {
    let place = |number: u32| 2.0 * f64::from(number) / f64::from(OVERLAP_GRID - 1) - 1.0;
    let places = (0..OVERLAP_GRID).flat_map(|y| (0..OVERLAP_GRID).map(move |x| [place(x), place(y)]));
    let lit = places.filter(|place| {
        let at = design.lit_by(design.seen(design.pixel(*place)));
        let within = |at: f64, side: u32| (-0.5..f64::from(side) - 0.5).contains(&at);
        at.is_some_and(|at| within(at[0], design.projector[0]) && within(at[1], design.projector[1]))
    });
    lit.count() as f64 / f64::from(OVERLAP_GRID * OVERLAP_GRID)
}

fn incidence(design: &Design, camera_px: [f64; 2]) -> Incidence {
    let point = design.seen(camera_px);
    let (centre, _) = design.pose();
    let degrees = |a: Vector3<f64>, b: Vector3<f64>| a.angle(&b).to_degrees();
    let (camera, projector) = (point, point - centre);
    Incidence {
        camera_px,
        camera_deg: degrees(camera, Vector3::z()),
        projector_deg: degrees(projector, Vector3::z()),
        between_deg: degrees(camera, projector),
    }
}

/// Error of a surface that returns `share` of the full well of H. The fringe `a = (P - Q) / (H - V)` crosses zero at an
/// edge, where both frames are midway between H and V; its slope there is that of a step from -1 to 1 under the blur of
/// both lenses and the boxes of both pixels.
fn precision(design: &Design, share: f64, columns_per_pixel: f64, column_depth_mm: f64) -> Precision {
    let h_e = share * design.full_well_e;
    let v_e = h_e / design.extinction_ratio;
    let step_e = design.full_well_e / f64::from(design.bits).exp2();
    let variance =
        design.read_noise_e.powi(2) + 0.5 * (h_e + v_e) + design.ambient_e + step_e * step_e / 12.0;
    let fringe_sigma = (2.0 * variance).sqrt() / (h_e - v_e);
    let projector = (design.projector_blur_px.powi(2) + BOX_PX * BOX_PX).sqrt() / columns_per_pixel;
    let blur_px = (design.camera_blur_px.powi(2) + BOX_PX * BOX_PX + projector * projector).sqrt();
    let slope = 2.0 / ((2.0 * std::f64::consts::PI).sqrt() * blur_px);
    let edge_rms_px = fringe_sigma / slope * BETWEEN_PIXELS.sqrt() * columns_per_pixel;
    // A line through so many edges, in their middle.
    let column_rms_px = edge_rms_px / f64::from(design.fit_edges).sqrt();
    Precision { h_e, fringe_sigma, edge_rms_px, column_rms_px, sigma_z_mm: column_rms_px * column_depth_mm }
}

fn remarks(forecast: &Forecast) -> Vec<String> {
    let mut remarks = Vec::new();
    if forecast.overlap < LEAST_OVERLAP {
        remarks.push(format!(
            "the picture covers {:.0} % of the camera's image only: change the distance, the lens shift or a lens",
            100.0 * forecast.overlap
        ));
    }
    let pixels = forecast.projector_pixel_mm / forecast.camera_pixel_mm;
    if pixels < FEWEST_CAMERA_PIXELS {
        remarks.push(format!(
            "a projector pixel is {pixels:.1} camera pixels wide: the finest stripes are lost; take a longer camera lens"
        ));
    }
    let steepest =
        forecast.incidence.iter().map(|at| at.projector_deg.max(at.camera_deg)).fold(0.0, f64::max);
    if steepest > OBLIQUE_DEG {
        remarks.push(format!(
            "light meets the corners at up to {steepest:.0} degrees: metal turns its polarization there; stay farther away"
        ));
    }
    if forecast.black.fringe_sigma > 0.25 {
        remarks.push("the black surface returns too little light to decode: lengthen the exposure".into());
    }
    remarks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_rig_has_the_papers_figures() {
        let found = forecast(&Design::default()).unwrap();
        assert!((found.column_depth_mm - 12.1).abs() < 0.1, "{found:?}");
        assert!((found.incidence[0].between_deg - 3.0).abs() < 0.02, "{found:?}");
        assert!((found.camera_field_mm[0] - 345.0).abs() < 1.0 && found.overlap > 0.99, "{found:?}");
        assert_eq!((found.frames, found.hold_refreshes), (44, 4), "{found:?}");
        assert!(found.remarks.is_empty(), "{found:?}");
    }

    #[test]
    fn the_middle_of_the_picture_meets_the_axis() {
        for (lens_shift, baseline_mm) in [(0.0, 50.0), (0.47, 52.4), (-0.6, -300.0), (1.2, 400.0)] {
            let design = Design { lens_shift, baseline_mm, ..Design::default() };
            let at = design.lit_by(Vector3::new(0.0, 0.0, 1000.0)).unwrap();
            assert!((at[0] - 511.5).abs() < 1e-6 && (at[1] - 383.5).abs() < 1e-6, "{lens_shift}: {at:?}");
        }
    }

    #[test]
    fn figures_scale_as_they_must() {
        let base = forecast(&Design::default()).unwrap();
        let wide = forecast(&Design { baseline_mm: 104.8, ..Design::default() }).unwrap();
        assert!((wide.bright.sigma_z_mm / base.bright.sigma_z_mm - 0.5).abs() < 0.01);
        let far = forecast(&Design { distance_mm: 2000.0, ..Design::default() }).unwrap();
        assert!((far.column_depth_mm / base.column_depth_mm - 4.0).abs() < 0.02);
        // Shot noise alone: four times the light, half the noise.
        let quiet = Design {
            read_noise_e: 0.0,
            ambient_e: 0.0,
            bits: 24,
            bright: 0.8,
            black: 0.2,
            ..Design::default()
        };
        let quiet = forecast(&quiet).unwrap();
        assert!((quiet.black.edge_rms_px / quiet.bright.edge_rms_px - 2.0).abs() < 1e-6);
    }

    #[test]
    fn poor_designs_are_remarked_on_and_impossible_ones_refused() {
        let remarks = |design: Design| forecast(&design).unwrap().remarks.join("; ");
        assert!(remarks(Design { focal_mm: 6.0, ..Design::default() }).contains("finest stripes"));
        assert!(remarks(Design { throw_ratio: 6.0, ..Design::default() }).contains("covers"));
        assert!(remarks(Design { baseline_mm: 600.0, ..Design::default() }).contains("degrees"));
        assert!(remarks(Design { black: 0.001, ..Design::default() }).contains("too little light"));
        for design in [
            Design { focal_mm: f64::NAN, ..Design::default() },
            Design { baseline_mm: 0.0, ..Design::default() },
            Design { sensor: [0, 5], ..Design::default() },
        ] {
            assert!(forecast(&design).is_err(), "{design:?}");
        }
    }
}
