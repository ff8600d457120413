//! Pictures that are held, and single frames for the preview.

use std::time::Duration;

use polscan_drivers::error::DeviceError;

use super::{Open, Shared};
use crate::{
    app::Rig,
    engine::{Failure, Shown, hold},
};

/// How long a frame for the preview is waited for, beyond its exposure and what the camera needs to deliver it.
const PREVIEW_SLACK: Duration = Duration::from_millis(500);

impl Open {
    pub(super) fn show(&mut self, shared: &Shared, shown: Shown) -> Result<(), Failure> {
        let Rig { projector, clock, .. } = &mut self.rig;
        let held = hold(shown, &shared.settings, projector.as_mut(), clock.as_ref());
        self.tell_projector(shared);
        held
    }

    pub(super) fn preview(&mut self, shared: &Shared) -> Result<(), DeviceError> {
        let Rig { camera, clock, .. } = &mut self.rig;
        camera.arm(1)?;
        let applied = &self.prepared.applied;
        let frame = Duration::from_secs_f64(1e-6 * (applied.settings.exposure_us + applied.readout_us));
        let taken = camera.trigger(clock.now()).and_then(|_| camera.next_frame(frame + PREVIEW_SLACK));
        let disarmed = camera.disarm();
        match taken {
            Ok(frame) => shared.preview.offer(&frame, applied),
            // One frame more or less does not matter here, nor one that lost a packet.
            Err(DeviceError::Timeout { .. } | DeviceError::BadData { .. }) => {}
            Err(error) => return Err(error),
        }
        disarmed.map(|_| ())
    }
}
