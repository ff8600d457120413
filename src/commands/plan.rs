//! `polscan plan`: what a rig will do, before anything is bolted down.

use std::path::PathBuf;

use polscan_calibration::planner::{Design, Forecast, Precision, forecast};
use serde_json::json;

use super::{Size, say};
use crate::{
    engine::Failure,
    store::{Policy, source::read_bounded},
};

const OPERATION: &str = "plan the rig";
/// No description of a rig is longer.
const MAX_BYTES: u64 = 1 << 16;

/// Arguments of `polscan plan`.
#[derive(Debug, clap::Args)]
pub struct PlanArgs {
    /// TOML file with the keys that `--json` prints under `design`; what it leaves out is as on the simulated rig. Flags
    /// come before it.
    #[arg(long, value_name = "FILE")]
    from: Option<PathBuf>,
    /// Focal length of the camera's lens.
    #[arg(long, value_name = "MM")]
    focal_mm: Option<f64>,
    /// Width of a camera pixel.
    #[arg(long, value_name = "UM")]
    pixel_um: Option<f64>,
    /// Camera pixels.
    #[arg(long, value_name = "WxH")]
    sensor: Option<Size>,
    /// Projector pixels.
    #[arg(long, value_name = "WxH")]
    projector: Option<Size>,
    /// Distance over width of the projector's picture.
    #[arg(long, value_name = "RATIO")]
    throw_ratio: Option<f64>,
    /// How far the projector's lens axis lies below the middle of its picture, as a share of its height.
    #[arg(long, value_name = "SHARE", allow_negative_numbers = true)]
    lens_shift: Option<f64>,
    /// Between the lenses.
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    baseline_mm: Option<f64>,
    /// From the camera to the object.
    #[arg(long, value_name = "MM")]
    distance_mm: Option<f64>,
    /// Exposure time.
    #[arg(long, value_name = "US")]
    exposure_us: Option<f64>,
    /// Light of H on the bright surface, as a share of the full well.
    #[arg(long, value_name = "SHARE")]
    bright: Option<f64>,
    /// Light of H on the black one, likewise.
    #[arg(long, value_name = "SHARE")]
    black: Option<f64>,
    /// H over V on metal.
    #[arg(long, value_name = "RATIO")]
    extinction_ratio: Option<f64>,
}

impl PlanArgs {
    /// The design of the file, changed by the flags.
    fn design(&self) -> Result<Design, Failure> {
        let mut design = match &self.from {
            Some(path) => {
                let bytes = read_bounded(path, Policy::Local, "read", MAX_BYTES)
                    .map_err(|error| Failure::data(OPERATION, error))?;
                let text = String::from_utf8(bytes).map_err(|error| Failure::data(OPERATION, error))?;
                toml::from_str(&text).map_err(|error| Failure::data(OPERATION, error))?
            }
            None => Design::default(),
        };
        let numbers = [
            (&mut design.focal_mm, self.focal_mm),
            (&mut design.pixel_um, self.pixel_um),
            (&mut design.throw_ratio, self.throw_ratio),
            (&mut design.lens_shift, self.lens_shift),
            (&mut design.baseline_mm, self.baseline_mm),
            (&mut design.distance_mm, self.distance_mm),
            (&mut design.exposure_us, self.exposure_us),
            (&mut design.bright, self.bright),
            (&mut design.black, self.black),
            (&mut design.extinction_ratio, self.extinction_ratio),
        ];
        numbers.into_iter().for_each(|(key, flag)| *key = flag.unwrap_or(*key));
        for (key, flag) in [(&mut design.sensor, self.sensor), (&mut design.projector, self.projector)] {
            *key = flag.map_or(*key, |size| [size.0.width, size.0.height]);
        }
        Ok(design)
    }
}

/// Prints the forecast; returns the exit code.
pub fn plan(args: &PlanArgs, json: bool) -> Result<u8, Failure> {
    let design = args.design()?;
    let found = forecast(&design).map_err(|error| Failure::data(OPERATION, error))?;
    if json {
        say(json!({ "design": design, "forecast": found }));
    } else {
        lines(&design, &found).iter().for_each(say);
    }
    Ok(0)
}

fn lines(design: &Design, found: &Forecast) -> Vec<String> {
    let field = |[width, height]: [f64; 2]| format!("{width:.0} x {height:.0} mm");
    let surface = |name: &str, of: &Precision| {
        format!(
            "{name} surface: {:.0} electrons of H, edges to {:.3} px, columns to {:.4} px, sigma_z {:.3} mm",
            of.h_e, of.edge_rms_px, of.column_rms_px, of.sigma_z_mm
        )
    };
    let mut lines = vec![
        format!("at {:.0} mm, {:.1} mm between the lenses:", design.distance_mm, design.baseline_mm),
        format!(
            "camera sees {}, the picture is {} and covers {:.0} % of the image",
            field(found.camera_field_mm),
            field(found.projector_field_mm),
            100.0 * found.overlap
        ),
        format!(
            "a camera pixel is {:.3} mm, a projector pixel {:.3} mm, one column {:.2} mm of depth",
            found.camera_pixel_mm, found.projector_pixel_mm, found.column_depth_mm
        ),
        surface("bright", &found.bright),
        surface("black ", &found.black),
    ];
    for (place, at) in
        ["middle", "top left", "top right", "bottom left", "bottom right"].iter().zip(&found.incidence)
    {
        lines.push(format!(
            "{place}: seen at {:.1}, lit at {:.1} degrees, {:.2} between",
            at.camera_deg, at.projector_deg, at.between_deg
        ));
    }
    lines.push(format!(
        "trigger after {:.1} ms, hold {} refreshes, {} frames of mode {} in {:.2} s",
        found.trigger_delay_ms, found.hold_refreshes, found.frames, design.mode, found.scan_s
    ));
    lines.extend(found.remarks.iter().map(|remark| format!("! {remark}")));
    lines
}
