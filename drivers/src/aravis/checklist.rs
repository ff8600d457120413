//! Makes a camera answer light linearly, one exposure a trigger, and proves it by reading every setting back.
//!
//! Settings are written in the order in which cameras unlock them, then all are read, since a later one may have changed
//! an earlier one. Features that a camera does not have are left out where their absence cannot bend the response.
//! Binning comes before the region, unlike in the usual order: it decides how large the region can be.
//!
//! The file is long because each setting has its own way of being absent, locked or in another unit.

use super::{
    features::{Features, Trouble, Value},
    options::Options,
    unpack::WireFormat,
};
use crate::{
    camera::{AppliedSettings, CameraSettings, Region, TriggerSource},
    error::{DeviceError, Difference},
};

/// Deviation of an exposure time that is taken for the camera's own step, as a share, where it does not state its step.
const EXPOSURE_SHARE: f64 = 0.005;

/// Likewise of a gain, in its unit.
const GAIN_STEP: f64 = 0.02;

/// Likewise of gamma.
const GAMMA_STEP: f64 = 0.005;

/// Time to read a frame out and send it where the camera does not say how many it takes in a second, in microseconds.
const UNKNOWN_READOUT_US: f64 = 10_000.0;

/// Processing in the camera that changes samples: switched off where it is there.
const PROCESSING: [(&str, &str); 7] = [
    ("isp", "IspEnable"),
    ("sharpening", "SharpeningEnable"),
    ("sharpening_auto", "SharpeningAuto"),
    ("saturation", "SaturationEnable"),
    ("lut", "LUTEnable"),
    ("reverse_x", "ReverseX"),
    ("reverse_y", "ReverseY"),
];

/// What a camera was set to.
#[derive(Debug, Clone, PartialEq)]
pub struct Applied {
    /// As the scanner sees it.
    pub settings: AppliedSettings,
    /// How samples travel.
    pub wire: WireFormat,
    /// Where the frames lie on the sensor.
    pub region: Region,
}

/// A setting that was written and is to be read.
struct Expected {
    setting: &'static str,
    feature: &'static str,
    value: Value,
    tolerance: f64,
    /// Why it could not be written.
    refused: Option<String>,
}

struct Checklist<'a> {
    features: &'a Features,
    options: &'a Options,
    expected: Vec<Expected>,
    differences: Vec<Difference>,
}

/// Applies `settings` to the camera called `device`; refuses with all differences that `options` does not allow.
pub fn apply(
    device: &str,
    features: &Features,
    settings: &CameraSettings,
    options: &Options,
) -> Result<Applied, DeviceError> {
    let mut list = Checklist { features, options, expected: Vec::new(), differences: Vec::new() };
    let applied = list.run(settings).map_err(|detail| DeviceError::Unavailable {
        device: device.to_owned(),
        detail: format!("stopped answering while it was set up ({detail}); check power and cable"),
    })?;
    let mut differences = list.differences;
    differences.retain(|difference| !options.allow.iter().any(|allowed| allowed == difference.setting));
    match (DeviceError::refused(device, differences), applied) {
        (Some(refusal), _) => Err(refusal),
        (None, Some(applied)) => Ok(applied),
        (None, None) => Err(DeviceError::Unavailable {
            device: device.to_owned(),
            detail: "its frames cannot be taken with what camera.allow lets pass; take format and region out of it"
                .to_owned(),
        }),
    }
}

/// A camera that does not answer, in words.
type Gone = String;

impl Checklist<'_> {
    fn run(&mut self, settings: &CameraSettings) -> Result<Option<Applied>, Gone> {
        self.reset()?;
        self.whole("binning", &["BinningHorizontal"], 1.0)?;
        self.whole("binning", &["BinningVertical"], 1.0)?;
        self.whole("decimation", &["DecimationHorizontal"], 1.0)?;
        self.whole("decimation", &["DecimationVertical"], 1.0)?;
        let wire = self.format(settings)?;
        let region = self.region(settings.region)?;
        for (setting, feature) in PROCESSING {
            if self.features.has(feature) {
                self.set(setting, feature, Value::Switch(false), 0.0)?;
            }
        }
        self.choose("exposure_auto", "ExposureAuto", "Off")?;
        self.choose("gain_auto", "GainAuto", "Off")?;
        self.choose("exposure_mode", "ExposureMode", "Timed")?;
        let exposure = self.exposure(settings.exposure_us)?;
        let gain = self.gain(settings.gain_db)?;
        let gamma = self.gamma(settings.gamma)?;
        self.black_level()?;
        for feature in
            ["AcquisitionFrameRateAuto", "AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"]
        {
            self.off("frame_rate", feature)?;
        }
        self.choose("acquisition_mode", "AcquisitionMode", "Continuous")?;
        self.trigger(settings.trigger)?;
        self.verify()?;
        let (Some(wire), Some(region)) = (wire, region) else { return Ok(None) };
        let read = |feature: Option<&str>, otherwise: f64| match feature {
            Some(feature) => self.number(feature).map(|value| value.unwrap_or(otherwise)),
            None => Ok(otherwise),
        };
        let exposure_us = read(exposure, settings.exposure_us)?;
        let gain_db = if gain == Some("Gain") { read(gain, settings.gain_db)? } else { settings.gain_db };
        let applied = AppliedSettings {
            settings: CameraSettings {
                exposure_us: self.close("exposure_us", exposure_us, settings.exposure_us),
                gain_db: self.close("gain_db", gain_db, settings.gain_db),
                gamma: self.close("gamma", read(gamma, 1.0)?, settings.gamma),
                region: settings.region.map(|_| region),
                ..settings.clone()
            },
            width: region.width,
            height: region.height,
            black_level_dn: self.black_level_dn(settings)?,
            saturation_dn: self.saturation_dn(settings)?,
            readout_us: self.readout_us()?,
            noise: None,
        };
        Ok(Some(Applied { settings: applied, wire, region }))
    }

    /// What was asked for where the camera's answer is only rounding away from it, so that a setting written down can
    /// be asked for again; the exposure is measured with, so its exact value counts.
    fn close(&self, setting: &str, read: f64, asked: f64) -> f64 {
        let rounding = if setting == "exposure_us" { 1e-3 } else { GAMMA_STEP };
        if (read - asked).abs() <= rounding { asked } else { read }
    }

    fn gone<T>(&self, result: Result<T, Trouble>) -> Result<Result<T, String>, Gone> {
        match result {
            Ok(value) => Ok(Ok(value)),
            Err(Trouble::Feature(message)) => Ok(Err(message)),
            Err(Trouble::Camera(message)) => Err(message),
        }
    }

    fn number(&self, feature: &str) -> Result<Option<f64>, Gone> {
        Ok(self.gone(self.features.number(feature))?.ok())
    }

    fn set(
        &mut self,
        setting: &'static str,
        feature: &'static str,
        value: Value,
        tolerance: f64,
    ) -> Result<(), Gone> {
        let written = self.features.write(feature, &value);
        let refused = self.gone(written)?.err();
        self.expected.retain(|before| before.feature != feature);
        self.expected.push(Expected { setting, feature, value, tolerance, refused });
        Ok(())
    }

    /// Writes what need not be honoured.
    fn hint(&self, feature: &str, value: &Value) -> Result<(), Gone> {
        if self.features.has(feature) {
            // Whatever the camera makes of it does no harm.
            let _ = self.gone(self.features.write(feature, value))?;
        }
        Ok(())
    }

    fn choose(&mut self, setting: &'static str, feature: &'static str, entry: &str) -> Result<(), Gone> {
        if !self.features.has(feature) {
            return Ok(());
        }
        self.set(setting, feature, Value::Entry(entry.to_owned()), 0.0)
    }

    fn whole(&mut self, setting: &'static str, features: &[&'static str], value: f64) -> Result<(), Gone> {
        match self.features.first(features) {
            Some(feature) => self.set(setting, feature, Value::Number(value), 0.0),
            None => Ok(()),
        }
    }

    /// Switches off what may be a switch or an enumeration.
    fn off(&mut self, setting: &'static str, feature: &'static str) -> Result<(), Gone> {
        if !self.features.has(feature) {
            return Ok(());
        }
        let off = if self.features.is_switch(feature) {
            Value::Switch(false)
        } else {
            Value::Entry("Off".to_owned())
        };
        self.set(setting, feature, off, 0.0)
    }

    fn differs(&mut self, setting: &'static str, requested: impl ToString, offered: impl ToString) {
        let (requested, offered) = (requested.to_string(), offered.to_string());
        self.differences.push(Difference { setting, requested, offered });
    }

    /// Whatever the last user left, in a camera that may still be running.
    fn reset(&mut self) -> Result<(), Gone> {
        let _ = self.gone(self.features.execute("AcquisitionStop"))?;
        if self.features.has("UserSetLoad") {
            self.hint("UserSetSelector", &Value::Entry("Default".to_owned()))?;
            let _ = self.gone(self.features.execute("UserSetLoad"))?;
        }
        for selector in self.features.entries("TriggerSelector") {
            self.hint("TriggerSelector", &Value::Entry(selector))?;
            self.hint("TriggerMode", &Value::Entry("Off".to_owned()))?;
        }
        Ok(())
    }

    fn format(&mut self, settings: &CameraSettings) -> Result<Option<WireFormat>, Gone> {
        let offered = self.features.entries("PixelFormat");
        let carrying = WireFormat::carrying(settings.format).iter().copied();
        let Some(wire) = carrying.into_iter().find(|wire| offered.iter().any(|name| name == wire.name()))
        else {
            self.differs("format", format!("{:?}", settings.format), offered.join(", "));
            return Ok(None);
        };
        self.set("format", "PixelFormat", Value::Entry(wire.name().to_owned()), 0.0)?;
        Ok(Some(wire))
    }

    fn region(&mut self, asked: Option<Region>) -> Result<Option<Region>, Gone> {
        let zero = Value::Number(0.0);
        // The largest width depends on the offset and the other way round.
        self.hint("OffsetX", &zero)?;
        self.hint("OffsetY", &zero)?;
        let largest = |size: &str| self.features.bounds(size).map_or(0, |(_, high)| high as u32);
        let (width, height) = (largest("Width"), largest("Height"));
        let region = asked.unwrap_or(Region { x: 0, y: 0, width, height });
        let sides = [
            ("Width", region.width),
            ("Height", region.height),
            ("OffsetX", region.x),
            ("OffsetY", region.y),
        ];
        let mut refused = None;
        for (feature, value) in sides {
            if self.features.has(feature) || value > 0 {
                let written = self.features.write(feature, &Value::Number(f64::from(value)));
                refused = refused.or(self.gone(written)?.err());
            }
        }
        let mut read = [0; 4];
        for (read, (feature, value)) in read.iter_mut().zip(sides) {
            let missing = if feature.starts_with("Offset") { 0 } else { value };
            *read = match self.features.has(feature) {
                true => self.number(feature)?.map_or(missing, |number| number as u32),
                false => missing,
            };
        }
        let [width_read, height_read, x, y] = read;
        let got = Region { x, y, width: width_read, height: height_read };
        let empty = region.width == 0 || region.height == 0;
        // Not every camera refuses what is not a multiple of its steps.
        let uneven = sides.into_iter().find_map(|(feature, value)| {
            let step = self.features.increment(feature)?;
            (f64::from(value) % step != 0.0).then(|| format!("{feature} in steps of {step}"))
        });
        if got != region || empty || uneven.is_some() {
            let text = |r: Region| format!("{} x {} at ({}, {})", r.width, r.height, r.x, r.y);
            let why = uneven.or(refused).map(|why| format!(": {why}")).unwrap_or_default();
            self.differs("region", text(region), format!("{} of {width} x {height}{why}", text(got)));
        }
        Ok((!empty).then_some(got))
    }

    fn exposure(&mut self, asked_us: f64) -> Result<Option<&'static str>, Gone> {
        let Some(feature) = self.features.first(&["ExposureTime", "ExposureTimeAbs"]) else {
            self.differs("exposure_us", asked_us, "no exposure time that can be set");
            return Ok(None);
        };
        if let Some((low, high)) = self.features.bounds(feature)
            && !(low..=high).contains(&asked_us)
        {
            self.differs("exposure_us", asked_us, format!("{low} to {high}"));
            return Ok(Some(feature));
        }
        let step = self.features.increment(feature).unwrap_or(asked_us * EXPOSURE_SHARE);
        self.set("exposure_us", feature, Value::Number(asked_us), step)?;
        Ok(Some(feature))
    }

    /// Sets the gain in decibel, or in the camera's own unit where the configuration says which value it is.
    fn gain(&mut self, asked_db: f64) -> Result<Option<&'static str>, Gone> {
        self.hint("GainSelector", &Value::Entry("All".to_owned()))?;
        let Some(feature) = self.features.first(&["Gain", "GainRaw"]) else {
            if asked_db != 0.0 {
                self.differs("gain_db", asked_db, "no gain");
            }
            return Ok(None);
        };
        let unit = self.features.unit(feature);
        let in_db = feature == "Gain" && unit.eq_ignore_ascii_case("db");
        let value = match (in_db, self.options.gain_raw) {
            (true, _) => asked_db,
            (false, Some(raw)) => raw,
            (false, None) => {
                let (low, high) = self.features.bounds(feature).unwrap_or((0.0, 0.0));
                let unit = if unit.is_empty() { "a unit of its own".to_owned() } else { unit };
                let offered = format!(
                    "{feature} from {low} to {high} in {unit}; camera.gain_raw says which of these is meant"
                );
                self.differs("gain_db", asked_db, offered);
                return Ok(None);
            }
        };
        if let Some((low, high)) = self.features.bounds(feature)
            && !(low..=high).contains(&value)
        {
            self.differs("gain_db", value, format!("{low} to {high}"));
            return Ok(in_db.then_some(feature));
        }
        let step = self.features.increment(feature).unwrap_or(0.0).clamp(GAIN_STEP, 0.5);
        self.set("gain_db", feature, Value::Number(value), step)?;
        Ok(in_db.then_some(feature))
    }

    /// Sets gamma; the feature that says what it is, `None` where there is none or it is switched off.
    fn gamma(&mut self, asked: f64) -> Result<Option<&'static str>, Gone> {
        let switch = self.features.first(&["GammaEnable", "GammaEnabled"]);
        if let Some(switch) = switch {
            // A gamma that is not enabled is locked.
            self.hint(switch, &Value::Switch(true))?;
        }
        if self.features.has("Gamma") {
            let written = self.gone(self.features.write("Gamma", &Value::Number(asked)))?;
            let read = self.number("Gamma")?;
            let honoured = read.is_some_and(|read| (read - asked).abs() <= GAMMA_STEP);
            if honoured || asked != 1.0 || switch.is_none() {
                let (value, tolerance) = (Value::Number(asked), GAMMA_STEP);
                let refused = written.err();
                self.expected.push(Expected {
                    setting: "gamma",
                    feature: "Gamma",
                    value,
                    tolerance,
                    refused,
                });
                return Ok(Some("Gamma"));
            }
        } else if asked != 1.0 {
            self.differs("gamma", asked, "no gamma");
            return Ok(None);
        }
        if let Some(switch) = switch {
            self.set("gamma", switch, Value::Switch(false), 0.0)?;
        }
        Ok(None)
    }

    /// Holds the black level; the configuration may set it.
    fn black_level(&mut self) -> Result<(), Gone> {
        self.hint("BlackLevelSelector", &Value::Entry("All".to_owned()))?;
        self.choose("black_level_auto", "BlackLevelAuto", "Off")?;
        if let Some(level) = self.options.black_level {
            match self.features.first(&["BlackLevel", "BlackLevelRaw"]) {
                Some(feature) => {
                    let step = self.features.increment(feature).unwrap_or(0.0).max(GAIN_STEP);
                    self.set("black_level", feature, Value::Number(level), step)?;
                }
                None => self.differs("black_level", level, "no black level"),
            }
        }
        Ok(())
    }

    /// One exposure a trigger, as soon as the sensor can.
    fn trigger(&mut self, source: TriggerSource) -> Result<(), Gone> {
        self.choose("trigger", "TriggerSelector", "FrameStart")?;
        let source = match source {
            TriggerSource::Software => "Software",
            TriggerSource::Line0 => "Line0",
        };
        if !self.features.has("TriggerMode") || !self.features.has("TriggerSource") {
            self.differs("trigger", source, "no triggers");
            return Ok(());
        }
        self.choose("trigger", "TriggerSource", source)?;
        self.hint("TriggerActivation", &Value::Entry("RisingEdge".to_owned()))?;
        self.choose("trigger_overlap", "TriggerOverlap", "ReadOut")?;
        if let Some((least, _)) =
            self.features.bounds("TriggerDelay").filter(|_| self.features.has("TriggerDelay"))
        {
            self.set("trigger_delay", "TriggerDelay", Value::Number(least), 1.0)?;
        }
        if self.features.entries("LineSelector").iter().any(|line| line == "Line1") {
            for (feature, entry) in
                [("LineSelector", "Line1"), ("LineMode", "Output"), ("LineSource", "ExposureActive")]
            {
                self.hint(feature, &Value::Entry(entry.to_owned()))?;
            }
        }
        self.choose("trigger", "TriggerMode", "On")
    }

    /// Reads everything that was written.
    fn verify(&mut self) -> Result<(), Gone> {
        let mut found = Vec::new();
        for expected in &self.expected {
            let Expected { setting, feature, value, tolerance, refused } = expected;
            let read = self.gone(self.features.read(feature, value))?;
            let equal = match (&read, value) {
                (Ok(Value::Number(read)), Value::Number(asked)) => (read - asked).abs() <= *tolerance,
                (Ok(read), asked) => read == asked,
                (Err(_), _) => false,
            };
            if equal {
                continue;
            }
            let text = |value: &Value| match value {
                Value::Entry(entry) => entry.clone(),
                Value::Switch(on) => (if *on { "on" } else { "off" }).to_owned(),
                Value::Number(number) => number.to_string(),
            };
            let mut offered = match &read {
                Ok(read) => text(read),
                Err(why) => format!("nothing to be read: {why}"),
            };
            if let Some(why) = refused {
                offered = format!("{offered} ({feature}: {why})");
            }
            found.push(Difference { setting, requested: text(value), offered });
        }
        self.differences.extend(found);
        Ok(())
    }

    fn full_scale(settings: &CameraSettings) -> f64 {
        (1u64 << settings.format.bit_depth()) as f64 - 1.0
    }

    /// The level of a dark pixel, where the camera states it in a unit that has a meaning.
    fn black_level_dn(&self, settings: &CameraSettings) -> Result<Option<f64>, Gone> {
        if !self.features.has("BlackLevel") {
            return Ok(None);
        }
        let level = self.number("BlackLevel")?;
        let scale = match self.features.unit("BlackLevel").as_str() {
            "%" => Self::full_scale(settings) / 100.0,
            "DN" | "dn" => 1.0,
            _ => return Ok(None),
        };
        Ok(level.map(|level| level * scale))
    }

    /// Samples that are wider than the converter have their low bits empty, so that full scale is never reached.
    fn saturation_dn(&self, settings: &CameraSettings) -> Result<u16, Gone> {
        let full_scale = Self::full_scale(settings);
        let bits = settings.format.bit_depth();
        if self.features.has("PixelDynamicRangeMax") {
            let largest = self.number("PixelDynamicRangeMax")?;
            if let Some(largest) = largest.filter(|largest| (full_scale / 2.0..=full_scale).contains(largest))
            {
                return Ok(largest as u16);
            }
        }
        let converter = match self.features.has("AdcBitDepth") {
            true => self.gone(self.features.text("AdcBitDepth"))?.ok(),
            false => None,
        };
        let converter = converter.and_then(|entry| entry.trim_start_matches("Bit").parse::<u8>().ok());
        let empty = converter.map_or(0, |converter| bits.saturating_sub(converter));
        Ok((full_scale as u16 >> empty) << empty)
    }

    fn readout_us(&self) -> Result<f64, Gone> {
        let rates = ["AcquisitionResultingFrameRate", "ResultingFrameRate"];
        let rate = match self.features.first(&rates) {
            Some(feature) => self.number(feature)?,
            None => None,
        };
        let plausible = rate.filter(|rate| (0.1..=10_000.0).contains(rate));
        Ok(plausible.map_or(UNKNOWN_READOUT_US, |rate| 1e6 / rate))
    }
}
