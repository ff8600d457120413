//! What is wrong with this machine for the configured rig, each with the next step.
//!
//! The machine itself is judged by files of its kernel and of udev; the devices by what their drivers say of them.

mod machine;

use std::path::Path;

use polscan_drivers::{camera::Listing, error::DeviceError};
use serde::Serialize;

use crate::{
    app::{self, Beam, RigError},
    config::{DeviceDriver, Settings},
    store::{Library, StorageError, library::chain},
};

pub use machine::Machine;

/// How bad it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Level {
    /// As it should be.
    Ok,
    /// Scans work, but not as well or as surely as they could.
    Warning,
    /// Scans do not work.
    Bad,
}

impl Level {
    /// Name for a person.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warning => "warning",
            Self::Bad => "bad",
        }
    }
}

/// What was found of one thing.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at, such as `usb-memory`.
    pub check: &'static str,
    /// How bad it is.
    pub level: Level,
    /// What it is like, and, where it is not well, what to do.
    pub message: String,
}

impl Finding {
    fn new(check: &'static str, level: Level, message: impl Into<String>) -> Self {
        Self { check, level, message: message.into() }
    }
}

/// Looks at everything that a scan with these settings needs.
///
/// # Errors
/// Where a simulated or recorded rig cannot be opened; a real one that cannot is a finding.
pub fn examine(settings: &Settings, machine: &Machine) -> Result<Vec<Finding>, RigError> {
    let (cameras, projectors) = app::list(settings)?;
    let raw = &settings.raw;
    let mut findings = vec![
        devices("camera", raw.camera.driver, &raw.camera.serial, &cameras),
        devices("projector", raw.projector.driver, &raw.projector.serial, &projectors),
    ];
    let folder = Path::new(&raw.store.dir);
    if raw.projector.driver == DeviceDriver::Window && findings[1].level == Level::Ok {
        findings.extend(display(Library::is_in_use(folder), || Ok(Beam::open(settings)?.findings())));
    }
    if raw.camera.driver == DeviceDriver::Aravis {
        findings.extend(machine.usb());
    }
    if raw.camera.driver == DeviceDriver::V4l2 {
        let message = "a V4L2 camera has no trigger: frames are chosen by their stamps; see docs/v4l2.md";
        findings.push(Finding::new("trigger", Level::Ok, message));
    }
    findings.push(calibration(settings));
    findings.push(machine.disk(folder, raw.store.min_free_gib));
    findings.push(machine.clock());
    Ok(findings)
}

/// Whether there is a device to use.
fn devices(kind: &'static str, driver: DeviceDriver, serial: &str, found: &[Listing]) -> Finding {
    let wanted: Vec<&Listing> =
        found.iter().filter(|device| serial.is_empty() || device.serial == serial).collect();
    let name = |device: &Listing| format!("{} {}", device.model, device.serial).trim().to_owned();
    let (level, message) = match wanted[..] {
        _ if driver == DeviceDriver::None => {
            (Level::Bad, format!("none is configured; set {kind}.driver in the file given with --config"))
        }
        [] if found.is_empty() => (Level::Bad, "none was found; check power and cable".to_owned()),
        // Some names, such as an address, only the driver knows; it says so when it is opened.
        [] => {
            let names = found.iter().map(name).collect::<Vec<_>>().join(", ");
            (
                Level::Warning,
                format!("none is called {serial}, there is {names}; correct {kind}.serial if that is it"),
            )
        }
        [device] => match &device.unusable {
            None => (Level::Ok, format!("{} is usable", name(device))),
            Some(why) => (Level::Bad, format!("{}: {why}", name(device))),
        },
        _ => {
            let usable: Vec<String> =
                wanted.iter().filter(|device| device.unusable.is_none()).map(|device| name(device)).collect();
            match &usable[..] {
                [one] => (Level::Ok, format!("{one} is usable")),
                [] => (Level::Bad, format!("none of {} is usable; see `polscan devices`", wanted.len())),
                several => {
                    let names = several.join(", ");
                    (Level::Bad, format!("there are several ({names}); name one in {kind}.serial"))
                }
            }
        }
    };
    Finding::new(kind, level, message)
}

/// What only the open window knows. While the service uses the display it is left alone, since a second window would cover the first.
fn display(
    in_use: Result<bool, StorageError>,
    open: impl FnOnce() -> Result<Vec<String>, RigError>,
) -> Vec<Finding> {
    let one = |level, message: String| vec![Finding::new("display", level, message)];
    match in_use {
        Ok(false) => {}
        Ok(true) => {
            let message = "the service has it; what it found is in /v1/status, under projector.display";
            return one(Level::Ok, message.to_owned());
        }
        Err(error) => {
            let message = format!(
                "not looked at, since it is not known whether the service has it: {}; run this as the service's user",
                chain(&error)
            );
            return one(Level::Warning, message);
        }
    }
    match open() {
        Ok(found) if found.is_empty() => {
            one(Level::Ok, "shows code values as they are, at known times".into())
        }
        Ok(found) => found.into_iter().flat_map(|text| one(Level::Warning, text)).collect(),
        Err(RigError::Device(error @ DeviceError::RefusedAll { .. })) => one(Level::Bad, error.to_string()),
        Err(error) => one(Level::Bad, crate::engine::rig_failure(error).chain()),
    }
}

fn calibration(settings: &Settings) -> Finding {
    let (level, message) = if settings.calibration.is_some() {
        (Level::Ok, format!("{} is used", settings.raw.rig.calibration))
    } else {
        let next = "run `polscan calibrate rig` and name its result in rig.calibration";
        (Level::Warning, format!("there is none, so that scans have no cloud; {next}"))
    };
    Finding::new("calibration", level, message)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn listing(serial: &str, unusable: Option<&str>) -> Listing {
        Listing {
            driver: "aravis".into(),
            model: "Maker M1".into(),
            serial: serial.into(),
            unusable: unusable.map(str::to_owned),
        }
    }

    #[test]
    fn devices_are_judged_by_the_one_that_is_meant() {
        let busy = listing("2", Some("is used by another program; close that first"));
        for (serial, found, level, words) in [
            ("", vec![], Level::Bad, "check power"),
            ("", vec![listing("1", None)], Level::Ok, "Maker M1 1 is usable"),
            ("", vec![listing("1", None), busy.clone()], Level::Ok, "Maker M1 1 is usable"),
            ("", vec![listing("1", None), listing("3", None)], Level::Bad, "camera.serial"),
            ("2", vec![listing("1", None), busy.clone()], Level::Bad, "close that first"),
            ("", vec![busy.clone(), busy.clone()], Level::Bad, "none of 2"),
            ("9", vec![listing("1", None)], Level::Warning, "there is Maker M1 1"),
        ] {
            let finding = devices("camera", DeviceDriver::Aravis, serial, &found);
            assert_eq!(finding.level, level, "{finding:?}");
            assert!(finding.message.contains(words), "{finding:?}");
        }
        assert_eq!(devices("camera", DeviceDriver::None, "", &[]).level, Level::Bad);
    }

    #[test]
    fn a_display_that_the_service_uses_is_left_alone() {
        let found = display(Ok(true), || panic!("it is left alone"));
        assert_eq!(found[0].level, Level::Ok);
        assert_eq!(display(Ok(false), || Ok(Vec::new()))[0].level, Level::Ok);
        let doubts = display(Ok(false), || Ok(vec!["a compositor".into(), "a gamma table".into()]));
        assert_eq!(doubts.iter().map(|found| found.level).collect::<Vec<_>>(), [Level::Warning; 2]);
        let lost = DeviceError::Unavailable { device: "screen".into(), detail: "is not there".into() };
        assert_eq!(display(Ok(false), || Err(lost.into()))[0].level, Level::Bad);
        let hidden =
            StorageError::file("open", Path::new("lock"), std::io::ErrorKind::PermissionDenied.into());
        let unknown = display(Err(hidden), || panic!("it is left alone"));
        assert_eq!(unknown[0].level, Level::Warning);
        assert!(unknown[0].message.contains("service's user"), "{unknown:?}");
    }
}
