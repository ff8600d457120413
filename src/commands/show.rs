//! `polscan show`: one picture on the projector until an interrupt. `polscan projector`: the process with its window.

use std::{path::Path, time::Duration};

use super::scan::cancel_on_interrupt;
use crate::{
    app::{self, Beam},
    config::Settings,
    engine::{Failure, Shown, hold, rig_failure},
    sequencer::CancelFlag,
};

/// Pause between two looks for an interrupt.
const LOOK: Duration = Duration::from_millis(50);

/// Looks after which the picture is shown again: it comes back with a display that was unplugged.
const LOOKS: u32 = 20;

/// Holds a picture until an interrupt, then leaves black behind.
pub fn show(settings: &Settings, shown: Shown, name: &str, json: bool) -> Result<u8, Failure> {
    let cancel = CancelFlag::default();
    cancel_on_interrupt(&cancel);
    let Beam { mut projector, clock } = Beam::open(settings).map_err(rig_failure)?;
    hold(shown, settings, projector.as_mut(), clock.as_ref())?;
    let info = projector.info();
    if json {
        super::say(serde_json::json!({ "show": name, "projector": info }));
    } else {
        let (model, serial) = (&info.model, &info.serial);
        super::say(format_args!(
            "showing {name} on {model} {serial} ({}x{}); interrupt to end",
            info.width, info.height
        ));
        for finding in info.display.iter().flat_map(|display| &display.findings) {
            super::say(format_args!("  {finding}"));
        }
    }
    let mut failed = None;
    let mut looks = 0;
    while !cancel.is_cancelled() {
        std::thread::sleep(LOOK);
        looks = (looks + 1) % LOOKS;
        if looks == 0 {
            let now = projector.show(0).err().map(|error| error.to_string());
            if now != failed {
                match &now {
                    Some(error) => eprintln!("polscan: {error}; trying again"),
                    None => eprintln!("polscan: showing {name} again"),
                }
            }
            failed = now;
        }
    }
    projector.black().map_err(|source| Failure::Device { operation: "leave the projector black", source })?;
    Ok(0)
}

/// Owns the projector's window until its client has gone.
pub fn projector(listen: Option<&Path>) -> Result<u8, Failure> {
    app::serve_projector(listen).map_err(|error| {
        let cause = std::error::Error::source(&error).map(|cause| format!(": {cause}")).unwrap_or_default();
        Failure::NoDevice { operation: "show a window", message: format!("{error}{cause}") }
    })?;
    Ok(0)
}
