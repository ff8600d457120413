//! What a simulated rig is made of: the `[sim]` part of a configuration.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{faults::Faults, panel::WIDEST_BLUR_PX, script::FaultDescription};
use crate::clock::{Clock, MonotonicClock, VirtualClock};

/// A simulated rig. Lengths in mm in the camera's frame (x right, y down, z forward), pixel centres at integers,
/// electrons at the camera's reference exposure.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RigDescription {
    /// Scene file, relative to the file that this description stands in. The caller reads it.
    pub scene: String,
    /// Whether time passes as on a real rig or as fast as frames can be computed.
    #[serde(default)]
    pub pacing: Pacing,
    /// Seed of noise and textures.
    #[serde(default = "one_seed")]
    pub seed: u64,
    /// Camera.
    pub camera: CameraDescription,
    /// Projector.
    pub projector: ProjectorDescription,
    /// Where the projector stands.
    pub pose: PoseDescription,
    /// Polarizer in front of the camera; absent for none.
    pub analyser: Option<AnalyserDescription>,
    /// Light that is not the projector's.
    #[serde(default)]
    pub ambient: AmbientDescription,
    /// Flicker of the projector's lamp; absent for none.
    pub flicker: Option<FlickerDescription>,
    /// What goes wrong; nothing by default.
    #[serde(default)]
    pub faults: Vec<FaultDescription>,
}

fn one_seed() -> u64 {
    1
}

/// How the rig's time passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pacing {
    /// As fast as frames can be computed, on a virtual clock.
    #[default]
    Fast,
    /// As on a real rig, on the monotonic clock.
    RealTime,
}

impl Pacing {
    /// A clock that this pacing runs on.
    pub fn clock(self) -> Arc<dyn Clock> {
        match self {
            Self::Fast => Arc::new(VirtualClock::default()),
            Self::RealTime => Arc::new(MonotonicClock::start()),
        }
    }
}

/// The simulated camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraDescription {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Focal length in pixels.
    pub focal_px: f64,
    /// Principal point in pixels; the middle of the sensor by default.
    pub principal_point_px: Option<[f64; 2]>,
    /// Radial distortion.
    #[serde(default)]
    pub k1: f64,
    /// Radial distortion.
    #[serde(default)]
    pub k2: f64,
    /// Tangential distortion.
    #[serde(default)]
    pub p1: f64,
    /// Tangential distortion.
    #[serde(default)]
    pub p2: f64,
    /// Radial distortion.
    #[serde(default)]
    pub k3: f64,
    /// Standard deviation of the lens blur in px; the box of the pixel comes on top.
    #[serde(default)]
    pub blur_px: f64,
    /// Electrons at which a pixel saturates.
    pub full_well_e: f64,
    /// Temporal dark noise in electrons.
    pub read_noise_e: f64,
    /// Dark current in electrons per second, with its shot noise.
    #[serde(default)]
    pub dark_current_e_per_s: f64,
    /// Standard deviation of the sensitivity between pixels, as a share.
    #[serde(default)]
    pub prnu_share: f64,
    /// Standard deviation of the dark level between pixels, in electrons.
    #[serde(default)]
    pub dsnu_e: f64,
    /// Bits of the deepest sample format: 8, 10, 12 or 16. Shallower formats are offered too.
    pub bits: u8,
    /// Dark level as a share of full scale.
    #[serde(default)]
    pub black_level_share: f64,
    /// Exponent of the response, `dn ~ signal^gamma`; settings that ask for another one are refused.
    #[serde(default = "one")]
    pub gamma: f64,
    /// Exposure time that electrons and levels of this description refer to.
    #[serde(default = "two_ms")]
    pub reference_exposure_us: f64,
    /// Time from the end of exposure until the frame has arrived. Readout overlaps the next exposure.
    #[serde(default = "imx392_readout")]
    pub readout_us: f64,
}

fn one() -> f64 {
    1.0
}

fn two_ms() -> f64 {
    2000.0
}

fn imx392_readout() -> f64 {
    6100.0
}

/// Polarization of one panel's light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PanelPolarization {
    /// Linear along the projector's rows.
    Horizontal,
    /// Linear along the projector's columns.
    Vertical,
    /// Natural light, as from a projector without liquid crystals.
    None,
}

/// The simulated projector. Values per channel are in the order red, green, blue.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProjectorDescription {
    /// Width and height in pixels.
    pub size: [u32; 2],
    /// Focal length in pixels.
    pub focal_px: f64,
    /// Principal point in pixels; the middle by default. Far off it is the lens shift.
    pub principal_point_px: Option<[f64; 2]>,
    /// Radial distortion.
    #[serde(default)]
    pub k1: f64,
    /// Radial distortion.
    #[serde(default)]
    pub k2: f64,
    /// Tangential distortion.
    #[serde(default)]
    pub p1: f64,
    /// Tangential distortion.
    #[serde(default)]
    pub p2: f64,
    /// Radial distortion.
    #[serde(default)]
    pub k3: f64,
    /// Standard deviation of the lens blur in projector px; the box of the pixel comes on top.
    #[serde(default)]
    pub blur_px: f64,
    /// Polarization of each channel.
    #[serde(default = "green_horizontal")]
    pub polarization: [PanelPolarization; 3],
    /// Light along over light across the channel's polarization, per channel.
    pub extinction: [f64; 3],
    /// What the camera's sensor makes of each channel at full drive: lamp spectrum times quantum efficiency, relative.
    #[serde(default = "equal_response")]
    pub response: [f64; 3],
    /// Light of a pixel at code 0 as a share of its light at code 255.
    #[serde(default)]
    pub black_leak: f64,
    /// Exponent between code value and light.
    #[serde(default = "display_gamma")]
    pub gamma: f64,
    /// How far the picture of each channel lies off the projector's nominal pixels, [x, y] in px.
    #[serde(default)]
    pub panel_shift_px: [[f64; 2]; 3],
    /// Time in which the liquid crystals do the middle 80 % of a change, in ms.
    #[serde(default)]
    pub lcd_10_90_ms: f64,
    /// Refreshes from flip to first light.
    #[serde(default)]
    pub latency_refreshes: u32,
    /// Refreshes per second.
    pub refresh_hz: f64,
    /// Whether the projector's info states latency and settling, or leaves them to be measured.
    #[serde(default = "yes")]
    pub states_timing: bool,
}

fn green_horizontal() -> [PanelPolarization; 3] {
    use PanelPolarization::{Horizontal, Vertical};
    [Vertical, Horizontal, Vertical]
}

fn equal_response() -> [f64; 3] {
    [1.0; 3]
}

fn display_gamma() -> f64 {
    2.2
}

fn yes() -> bool {
    true
}

/// Where the projector stands: either `baseline_mm` and `aim_mm`, or `rotation` and `translation_mm`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PoseDescription {
    /// The projector's centre lies this far right of the camera's.
    pub baseline_mm: Option<f64>,
    /// The middle of the projected picture meets the camera's axis at this distance; the projector does not roll.
    pub aim_mm: Option<f64>,
    /// Rows of the rotation from the camera's frame into the projector's.
    pub rotation: Option<[[f64; 3]; 3]>,
    /// The camera's centre in the projector's frame.
    pub translation_mm: Option<[f64; 3]>,
}

/// The polarizer in front of the camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AnalyserDescription {
    /// Angle of its axis from the camera's horizontal, counter-clockwise as the camera sees it.
    #[serde(default)]
    pub azimuth_error_deg: f64,
    /// Light passed along its axis over light passed across.
    pub extinction: f64,
}

/// Light that is not the projector's.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AmbientDescription {
    /// Electrons per pixel at the reference exposure, the same everywhere.
    pub electrons: f64,
}

/// Periodic change of the lamp.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlickerDescription {
    /// Amplitude of the sine as a share of the mean.
    pub share: f64,
    /// Frequency.
    pub hz: f64,
}

impl RigDescription {
    /// Every fault, each with its key path below `sim`. Empty where the rig can be built.
    pub fn validate(&self) -> Vec<String> {
        let mut faults = Faults::new("sim");
        if self.scene.is_empty() {
            faults.add("scene", "names no file");
        }
        self.camera.validate(&mut faults);
        self.projector.validate(&mut faults);
        self.pose.validate(&mut faults);
        if let Some(analyser) = &self.analyser {
            faults.finite("analyser.azimuth_error_deg", analyser.azimuth_error_deg);
            faults.at_least("analyser.extinction", analyser.extinction, 1.0);
        }
        faults.at_least("ambient.electrons", self.ambient.electrons, 0.0);
        if let Some(flicker) = &self.flicker {
            faults.within("flicker.share", flicker.share, 0.0, 1.0);
            faults.above("flicker.hz", flicker.hz, 0.0);
        }
        for (number, fault) in self.faults.iter().enumerate() {
            fault.validate(&mut faults, &format!("faults[{number}]"));
        }
        faults.into_list()
    }
}

fn validate_side(faults: &mut Faults, key: &str, size: [u32; 2]) {
    if size.iter().any(|side| !(1..=8192).contains(side)) {
        faults.add(key, &format!("is {size:?}, each side must be within 1 and 8192 px"));
    }
}

impl CameraDescription {
    /// Principal point, given or by default.
    pub(crate) fn centre_px(&self) -> [f64; 2] {
        self.principal_point_px.unwrap_or_else(|| middle_px(self.size))
    }

    fn validate(&self, faults: &mut Faults) {
        validate_side(faults, "camera.size", self.size);
        faults.above("camera.focal_px", self.focal_px, 0.0);
        for (axis, value) in self.principal_point_px.unwrap_or_default().into_iter().enumerate() {
            faults.finite(&format!("camera.principal_point_px[{axis}]"), value);
        }
        for (name, value) in
            [("k1", self.k1), ("k2", self.k2), ("p1", self.p1), ("p2", self.p2), ("k3", self.k3)]
        {
            faults.finite(&format!("camera.{name}"), value);
        }
        faults.within("camera.blur_px", self.blur_px, 0.0, WIDEST_BLUR_PX);
        faults.above("camera.full_well_e", self.full_well_e, 0.0);
        faults.at_least("camera.read_noise_e", self.read_noise_e, 0.0);
        faults.at_least("camera.dark_current_e_per_s", self.dark_current_e_per_s, 0.0);
        faults.within("camera.prnu_share", self.prnu_share, 0.0, 0.2);
        faults.at_least("camera.dsnu_e", self.dsnu_e, 0.0);
        if ![8, 10, 12, 16].contains(&self.bits) {
            faults.add("camera.bits", &format!("is {}, must be 8, 10, 12 or 16", self.bits));
        }
        faults.within("camera.black_level_share", self.black_level_share, 0.0, 0.5);
        faults.within("camera.gamma", self.gamma, 0.1, 5.0);
        faults.within("camera.reference_exposure_us", self.reference_exposure_us, 1.0, 1e7);
        faults.within("camera.readout_us", self.readout_us, 0.0, 1e7);
    }
}

impl ProjectorDescription {
    /// Principal point, given or by default.
    pub(crate) fn centre_px(&self) -> [f64; 2] {
        self.principal_point_px.unwrap_or_else(|| middle_px(self.size))
    }

    fn validate(&self, faults: &mut Faults) {
        validate_side(faults, "projector.size", self.size);
        faults.above("projector.focal_px", self.focal_px, 0.0);
        for (axis, value) in self.principal_point_px.unwrap_or_default().into_iter().enumerate() {
            faults.finite(&format!("projector.principal_point_px[{axis}]"), value);
        }
        for (name, value) in
            [("k1", self.k1), ("k2", self.k2), ("p1", self.p1), ("p2", self.p2), ("k3", self.k3)]
        {
            faults.finite(&format!("projector.{name}"), value);
        }
        faults.within("projector.blur_px", self.blur_px, 0.0, WIDEST_BLUR_PX);
        for (channel, &value) in self.extinction.iter().enumerate() {
            faults.at_least(&format!("projector.extinction[{channel}]"), value, 1.0);
        }
        for (channel, &value) in self.response.iter().enumerate() {
            faults.at_least(&format!("projector.response[{channel}]"), value, 0.0);
        }
        faults.within("projector.black_leak", self.black_leak, 0.0, 1.0);
        faults.within("projector.gamma", self.gamma, 0.1, 5.0);
        for (channel, shift) in self.panel_shift_px.iter().enumerate() {
            for (axis, &value) in shift.iter().enumerate() {
                faults.within(&format!("projector.panel_shift_px[{channel}][{axis}]"), value, -20.0, 20.0);
            }
        }
        faults.within("projector.lcd_10_90_ms", self.lcd_10_90_ms, 0.0, 1e4);
        if self.latency_refreshes > 1000 {
            faults.add(
                "projector.latency_refreshes",
                &format!("is {}, must be at most 1000", self.latency_refreshes),
            );
        }
        faults.within("projector.refresh_hz", self.refresh_hz, 1.0, 10_000.0);
    }
}

impl PoseDescription {
    fn validate(&self, faults: &mut Faults) {
        match (self.baseline_mm, self.aim_mm, self.rotation, self.translation_mm) {
            (Some(baseline), Some(aim), None, None) => {
                faults.finite("pose.baseline_mm", baseline);
                faults.above("pose.aim_mm", aim, 0.0);
            }
            (None, None, Some(rotation), Some(translation)) => {
                let rotation = nalgebra::Matrix3::from_fn(|row, column| rotation[row][column]);
                let error = (rotation * rotation.transpose() - nalgebra::Matrix3::identity()).norm();
                // Not `>`: a NaN must fail too.
                if !(error <= 1e-6 && rotation.determinant() > 0.0) {
                    faults
                        .add("pose.rotation", "is not a rotation: rows must be orthonormal and right-handed");
                }
                for (axis, &value) in translation.iter().enumerate() {
                    faults.finite(&format!("pose.translation_mm[{axis}]"), value);
                }
            }
            _ => faults.add("pose", "needs either baseline_mm and aim_mm, or rotation and translation_mm"),
        }
    }
}

/// Middle of a picture: half a pixel before the middle of its size, because pixel centres lie at integers.
pub(crate) fn middle_px([width, height]: [u32; 2]) -> [f64; 2] {
    [0.5 * (f64::from(width) - 1.0), 0.5 * (f64::from(height) - 1.0)]
}
