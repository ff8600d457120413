//! A scan that is prepared ahead, so that the first pattern follows at once.

use std::{sync::Arc, time::SystemTime};

use polscan_drivers::camera::AppliedSettings;
use polscan_patterns::Mode;

use crate::{
    app::Rig,
    config::Settings,
    engine::{Failure, Scan},
};

/// A scan that can begin at once.
pub struct Prepared {
    mode: Mode,
    exposure_us: Option<f64>,
    calibration_changed: Option<SystemTime>,
    /// Whether the camera may have other settings by now.
    stale: bool,
    /// The scan.
    pub scan: Arc<Scan>,
    /// What the camera was set to.
    pub applied: AppliedSettings,
}

impl Prepared {
    /// Sets the camera and checks all that can be checked.
    pub fn new(
        base: &Settings,
        mode: Mode,
        exposure_us: Option<f64>,
        rig: &mut Rig,
    ) -> Result<Self, Failure> {
        let mut settings = base.clone();
        settings.mode = mode;
        settings.raw.scan.mode = mode;
        if let Some(exposure_us) = exposure_us {
            settings.camera.exposure_us = exposure_us;
            settings.raw.camera.exposure_us = exposure_us;
        }
        let calibration_changed = changed(base);
        let scan = Arc::new(Scan::prepare(&settings, &[], rig)?);
        let applied = scan.applied().clone();
        Ok(Self { mode, exposure_us, calibration_changed, stale: false, scan, applied })
    }

    /// Sets the camera again after it was used for something else.
    pub fn restore(&mut self, base: &Settings, rig: &mut Rig) -> Result<(), Failure> {
        self.stale = true;
        self.renew(base, self.mode, self.exposure_us, rig)
    }

    /// Prepares anew where the last preparation was for something else.
    pub fn renew(
        &mut self,
        base: &Settings,
        mode: Mode,
        exposure_us: Option<f64>,
        rig: &mut Rig,
    ) -> Result<(), Failure> {
        let same = self.mode == mode && self.exposure_us == exposure_us;
        if self.stale || !same || self.calibration_changed != changed(base) {
            self.stale = true;
            *self = Self::new(base, mode, exposure_us, rig)?;
        }
        Ok(())
    }
}

/// When the calibration file was last changed.
fn changed(settings: &Settings) -> Option<SystemTime> {
    std::fs::metadata(&settings.calibration.as_ref()?.path).ok()?.modified().ok()
}
