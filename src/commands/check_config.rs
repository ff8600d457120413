//! `polscan check-config`: every fault of a configuration at once.

use std::path::Path;

use crate::{
    app::Rig,
    config::{ConfigError, DeviceDriver, Fault, Settings},
    engine::{Failure, Kind, Scan, rig_failure},
};

/// Checks what settings that are sound one by one name and need: the rig, the calibration, the plan of a scan. Devices
/// that are not simulated or recorded are left alone.
pub fn check_config(settings: &Settings, file: &Path, json: bool) -> Result<u8, Failure> {
    if matches!(settings.raw.camera.driver, DeviceDriver::Sim | DeviceDriver::Replay)
        && let Err(failure) = try_scan(settings)
    {
        let key = match failure.kind() {
            Kind::Data if settings.replay.is_none() => "rig.calibration",
            Kind::Unavailable => "camera",
            Kind::Config => "capture",
            _ => "rig",
        };
        let origin = Some(format!("file {}", file.display()));
        let fault = Fault { key: key.into(), message: failure.chain(), origin };
        return Err(Failure::Config(ConfigError { faults: vec![fault] }));
    }
    if json {
        super::say(serde_json::json!({ "file": file, "faults": [] }));
    } else {
        super::say(format_args!("{}: no fault", file.display()));
    }
    Ok(0)
}

fn try_scan(settings: &Settings) -> Result<(), Failure> {
    let mut rig = Rig::open(settings).map_err(rig_failure)?;
    Scan::prepare(settings, &[], &mut rig).map(drop)
}
