//! What was measured of a rig, in files that a scan uses. Each says which device and settings it is for, and is refused
//! by name with any other.

use std::{fmt, path::Path, time::Duration};

use polscan_calibration::{
    polarization::{Channel, Field},
    synchrony::{BandTiming, Ripple, Timing},
};
use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo, CameraNoise, PixelFormat},
    projector::{ProjectorInfo, ProjectorTiming},
};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use thiserror::Error;

use super::polarization::Drive;

/// A file for another device or other settings than the rig's.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[error(
    "the {what} was measured with {of} {was}, but the rig has {is}: measure again with `polscan calibrate {command}`, or leave `{key}` empty"
)]
pub struct Stale {
    /// What was measured.
    what: &'static str,
    /// Property that differs.
    of: &'static str,
    /// As measured.
    was: String,
    /// As it is.
    is: String,
    /// How it is measured.
    command: &'static str,
    /// Configuration key that names the file.
    key: &'static str,
}

/// A kind of file.
pub trait Document: Serialize + DeserializeOwned {
    /// First line of such a file.
    const SCHEMA: &'static str;
    /// Usual name.
    const FILE_NAME: &'static str;
    /// What it says was measured.
    const WHAT: &'static str;
    /// Command that measures it: `polscan calibrate COMMAND`.
    const COMMAND: &'static str;
    /// Configuration key that names it.
    const KEY: &'static str;

    /// The schema that the file names.
    fn schema(&self) -> &str;

    /// The file's text.
    fn to_toml(&self) -> String {
        toml::to_string(self).expect("plain tables of numbers and text are TOML")
    }

    /// Reads a file's text; the error says what is wrong and what the file should be.
    fn from_toml(text: &str) -> Result<Self, String> {
        let wanted = || format!("a file that `polscan calibrate {}` wrote", Self::COMMAND);
        let file: Self =
            toml::from_str(text).map_err(|error| format!("{} (it must be {})", error.message(), wanted()))?;
        match file.schema() {
            schema if schema == Self::SCHEMA => Ok(file),
            schema => Err(format!("its schema is `{schema}`, it must be {}: {}", Self::SCHEMA, wanted())),
        }
    }

    /// Whether a property is as it was when the file was measured.
    fn same<T: PartialEq + fmt::Display>(of: &'static str, was: &T, is: &T) -> Result<(), Stale> {
        if was == is {
            return Ok(());
        }
        let (was, is) = (was.to_string(), is.to_string());
        Err(Stale { what: Self::WHAT, of, was, is, command: Self::COMMAND, key: Self::KEY })
    }
}

/// Which device a file is for.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DeviceKey {
    /// Driver.
    pub driver: String,
    /// Maker and model.
    pub model: String,
    /// Serial number or the like.
    pub serial: String,
}

impl From<&CameraInfo> for DeviceKey {
    fn from(info: &CameraInfo) -> Self {
        Self { driver: info.driver.clone(), model: info.model.clone(), serial: info.serial.clone() }
    }
}

impl From<&ProjectorInfo> for DeviceKey {
    fn from(info: &ProjectorInfo) -> Self {
        Self { driver: info.driver.clone(), model: info.model.clone(), serial: info.serial.clone() }
    }
}

impl fmt::Display for DeviceKey {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {} (driver {})", self.model, self.serial, self.driver)
    }
}

/// Settings that change a camera's noise.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseSettings {
    /// Sample format.
    pub format: PixelFormat,
    /// Gain in decibel.
    pub gain_db: f64,
    /// Exponent of the response.
    pub gamma: f64,
}

/// Figures of a camera; each with its sigma.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseFigures {
    /// System gain K.
    pub gain_dn_per_electron: f64,
    /// Its sigma.
    pub gain_sigma: f64,
    /// Temporal dark noise in DN.
    pub read_noise_dn: f64,
    /// Its sigma.
    pub read_noise_sigma_dn: f64,
    /// Level of no light in DN.
    pub black_level_dn: f64,
    /// Its sigma.
    pub black_level_sigma_dn: f64,
    /// Exponent of the response.
    pub exponent: f64,
    /// Its sigma.
    pub exponent_sigma: f64,
    /// Least value of a sample that may have been clipped; absent where no light got that far.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub saturation_dn: Option<u16>,
    /// Electrons from black to where samples end, likewise.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub full_well_e: Option<f64>,
}

/// `noise.toml`: what `polscan calibrate noise` found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseFile {
    /// `polscan.noise/1`.
    pub schema: String,
    /// When it was measured, RFC 3339.
    pub created: String,
    /// Camera.
    pub camera: DeviceKey,
    /// Its settings, without the exposure time, which does not matter.
    pub settings: NoiseSettings,
    /// Figures.
    pub noise: NoiseFigures,
}

impl Document for NoiseFile {
    const SCHEMA: &'static str = "polscan.noise/1";
    const FILE_NAME: &'static str = "noise.toml";
    const WHAT: &'static str = "camera's noise";
    const COMMAND: &'static str = "noise";
    const KEY: &'static str = "rig.noise";

    fn schema(&self) -> &str {
        &self.schema
    }
}

impl NoiseFile {
    /// What a camera reports, with the measured figures in place of its own.
    ///
    /// # Errors
    /// Where they were measured with another camera or with settings that change them.
    pub fn amend(&self, camera: &CameraInfo, mut applied: AppliedSettings) -> Result<AppliedSettings, Stale> {
        let now = &applied.settings;
        Self::same("the camera", &self.camera, &camera.into())?;
        let format = |format: PixelFormat| format!("{format:?}");
        Self::same("the format", &format(self.settings.format), &format(now.format))?;
        Self::same("a gain in dB of", &self.settings.gain_db, &now.gain_db)?;
        Self::same("a gamma of", &self.settings.gamma, &now.gamma)?;
        applied.black_level_dn = Some(self.noise.black_level_dn);
        applied.saturation_dn = self.noise.saturation_dn.unwrap_or(u16::MAX).min(applied.saturation_dn);
        applied.noise = Some(CameraNoise {
            gain_dn_per_electron: self.noise.gain_dn_per_electron,
            read_noise_dn: self.noise.read_noise_dn,
        });
        Ok(applied)
    }
}

/// What a projector shows when it is measured: another picture size or refresh rate has another timing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DisplayMode {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Time between refreshes.
    pub refresh_period_ms: f64,
}

impl From<&ProjectorInfo> for DisplayMode {
    fn from(info: &ProjectorInfo) -> Self {
        let refresh_period_ms = 1e3 * info.refresh_period.as_secs_f64();
        Self { width: info.width, height: info.height, refresh_period_ms }
    }
}

impl fmt::Display for DisplayMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{} at {:.2} Hz", self.width, self.height, 1e3 / self.refresh_period_ms)
    }
}

/// Trigger delay and hold of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Chosen {
    /// Exposure time for which they are.
    pub exposure_us: f64,
    /// From flip to exposure.
    pub trigger_delay_ms: f64,
    /// Refreshes for which each picture is held.
    pub hold_refreshes: u32,
    /// From this delay on ...
    pub safe_from_ms: f64,
    /// ... to this one, held so long, the light is steady.
    pub safe_until_ms: f64,
}

/// `sync.toml`: what `polscan calibrate sync` found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SyncFile {
    /// `polscan.sync/1`.
    pub schema: String,
    /// When it was measured, RFC 3339.
    pub created: String,
    /// Projector.
    pub projector: DeviceKey,
    /// What it showed.
    pub mode: DisplayMode,
    /// Measured timing.
    pub timing: Timing,
    /// What a scan with the configured exposure makes of it.
    pub chosen: Chosen,
    /// The lamp, where the light was enough to tell.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub ripple: Option<Ripple>,
    /// Timing of each channel in bands of the picture's height.
    pub bands: Vec<BandTiming>,
}

impl Document for SyncFile {
    const SCHEMA: &'static str = "polscan.sync/1";
    const FILE_NAME: &'static str = "sync.toml";
    const WHAT: &'static str = "projector's timing";
    const COMMAND: &'static str = "sync";
    const KEY: &'static str = "rig.sync";

    fn schema(&self) -> &str {
        &self.schema
    }
}

impl SyncFile {
    /// What a projector says of itself, with the measured timing where it states none.
    ///
    /// # Errors
    /// Where the timing was measured with another projector or picture.
    pub fn amend(&self, mut projector: ProjectorInfo) -> Result<ProjectorInfo, Stale> {
        Self::same("the projector", &self.projector, &(&projector).into())?;
        let mode = |mode: DisplayMode| mode.to_string();
        Self::same("a picture of", &mode(self.mode), &mode((&projector).into()))?;
        // Numbers of a file may be anything.
        let duration = |ms: f64| Duration::try_from_secs_f64(1e-3 * ms).unwrap_or_default();
        projector.timing.get_or_insert(ProjectorTiming {
            latency: duration(self.timing.latency_ms),
            settling: duration(self.timing.settling_ms),
        });
        Ok(projector)
    }
}

/// `polarization.toml`: what `polscan calibrate polarization` found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PolarizationFile {
    /// `polscan.polarization/1`.
    pub schema: String,
    /// When it was measured, RFC 3339.
    pub created: String,
    /// Letters of the channels that carry H, and V, as found.
    pub horizontal: String,
    /// See `horizontal`.
    pub vertical: String,
    /// How many times brighter than V the rig shows H on metal, the polarizer where it stood best.
    pub extinction_ratio: f64,
    /// How far the polarizer's axis stands from H where its mount reads 0, counter-clockwise as the camera sees it.
    pub azimuth_error_deg: f64,
    /// Its sigma.
    pub azimuth_sigma_deg: f64,
    /// Light of the black picture as a share of white.
    pub black_share: f64,
    /// Camera.
    pub camera: DeviceKey,
    /// Projector.
    pub projector: DeviceKey,
    /// Code values at which a white card returns H and V alike.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub drive: Option<Drive>,
    /// Misregistration of V against H.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub misregistration: Option<Field>,
    /// Red, green, blue.
    pub channels: [Channel; 3],
}

impl Document for PolarizationFile {
    const SCHEMA: &'static str = "polscan.polarization/1";
    const FILE_NAME: &'static str = "polarization.toml";
    const WHAT: &'static str = "polarization";
    const COMMAND: &'static str = "polarization";
    const KEY: &'static str = "rig.polarization";

    fn schema(&self) -> &str {
        &self.schema
    }
}

impl PolarizationFile {
    /// Whether the file is for these devices, and these channels.
    ///
    /// # Errors
    /// Where it is for others.
    pub fn check(
        &self,
        camera: &CameraInfo,
        projector: &ProjectorInfo,
        [horizontal, vertical]: [&str; 2],
    ) -> Result<(), Stale> {
        Self::same("the camera", &self.camera, &camera.into())?;
        Self::same("the projector", &self.projector, &projector.into())?;
        let letters = |text: &str| "rgb".chars().filter(|letter| text.contains(*letter)).collect::<String>();
        Self::same("horizontal channels", &letters(&self.horizontal), &letters(horizontal))?;
        Self::same("vertical channels", &letters(&self.vertical), &letters(vertical))
    }
}

/// All that was measured of a rig, as far as the configuration names it.
#[derive(Debug, Clone, Default)]
pub struct RigFiles {
    /// The camera's noise.
    pub noise: Option<NoiseFile>,
    /// The projector's timing.
    pub sync: Option<SyncFile>,
    /// What becomes of polarized light.
    pub polarization: Option<PolarizationFile>,
}

impl RigFiles {
    /// What the camera reports, with what was measured of it.
    ///
    /// # Errors
    /// Where it was measured with another camera or settings.
    pub fn camera(&self, camera: &CameraInfo, applied: AppliedSettings) -> Result<AppliedSettings, Stale> {
        match &self.noise {
            Some(noise) => noise.amend(camera, applied),
            None => Ok(applied),
        }
    }

    /// What the projector says of itself, with what was measured of it.
    ///
    /// # Errors
    /// Where it was measured with another projector or picture.
    pub fn projector(&self, projector: ProjectorInfo) -> Result<ProjectorInfo, Stale> {
        match &self.sync {
            Some(sync) => sync.amend(projector),
            None => Ok(projector),
        }
    }
}

/// Reads the file that a key of the configuration names, relative to `folder`; `None` where it names none.
pub fn load<T: Document>(
    name: &str,
    folder: &Path,
    read: impl Fn(&Path) -> Result<String, String>,
) -> Result<Option<T>, String> {
    if name.is_empty() {
        return Ok(None);
    }
    let path = folder.join(name);
    let text = read(&path)?;
    T::from_toml(&text).map(Some).map_err(|fault| format!("{}: {fault}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noise() -> NoiseFile {
        NoiseFile {
            schema: NoiseFile::SCHEMA.into(),
            created: "2026-01-01T00:00:00.000Z".into(),
            camera: DeviceKey { driver: "sim".into(), model: "m".into(), serial: "s".into() },
            settings: NoiseSettings { format: PixelFormat::Mono12, gain_db: 0.0, gamma: 1.0 },
            noise: NoiseFigures {
                gain_dn_per_electron: 0.4,
                gain_sigma: 0.001,
                read_noise_dn: 0.9,
                read_noise_sigma_dn: 0.01,
                black_level_dn: 41.0,
                black_level_sigma_dn: 0.02,
                exponent: 1.0,
                exponent_sigma: 0.001,
                saturation_dn: None,
                full_well_e: None,
            },
        }
    }

    #[test]
    fn files_come_back_as_they_were_written() {
        assert_eq!(NoiseFile::from_toml(&noise().to_toml()), Ok(noise()));
    }

    #[test]
    fn other_files_are_refused_by_name() {
        let other = noise().to_toml().replace("noise/1", "noise/2");
        assert!(NoiseFile::from_toml(&other).unwrap_err().contains("polscan.noise/1"));
        assert!(NoiseFile::from_toml("a = 1").unwrap_err().contains("polscan calibrate noise"));
    }
}
