//! `polscan devices`: what the configured drivers find.

use crate::{
    app,
    config::{DeviceDriver, Settings},
    engine::{Failure, rig_failure},
};

/// Lists what the configured drivers find.
pub fn devices(settings: &Settings, json: bool) -> Result<u8, Failure> {
    let (cameras, projectors) = app::list(settings).map_err(rig_failure)?;
    if json {
        super::say(serde_json::json!({ "cameras": cameras, "projectors": projectors }));
        return Ok(0);
    }
    for (kind, found) in [("camera", cameras), ("projector", projectors)] {
        if found.is_empty() {
            let driver =
                if kind == "camera" { settings.raw.camera.driver } else { settings.raw.projector.driver };
            let next = match driver {
                DeviceDriver::None => format!("set {kind}.driver in the file given with --config"),
                _ => "check power and cable".to_owned(),
            };
            super::say(format_args!("{kind}: none; {next}"));
        }
        for device in found {
            let state = device.unusable.as_deref().unwrap_or("usable");
            super::say(format_args!(
                "{kind}: {} {} (driver {}): {state}",
                device.model, device.serial, device.driver
            ));
        }
    }
    Ok(0)
}
