//! One picture held on the projector, for those who aim, focus and turn polarizers.

use std::{str::FromStr, time::Duration};

use polscan_drivers::{clock::Clock, error::DeviceError, projector::Projector};
use polscan_patterns::{Mode, Picture, Polarization, ProjectorSize, Raster, Role, Sequence};

use super::Failure;
use crate::{config::Settings, sequencer::slide};

/// From flip to steady light of a projector that was not measured.
const UNMEASURED: Duration = Duration::from_millis(100);

const OPERATION: &str = "hold a picture";

/// A picture to hold for set-up.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shown {
    /// One of the pictures made for it.
    Picture(Picture),
    /// A pattern of a sequence.
    Pattern(Role),
}

impl FromStr for Shown {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        match (text.parse(), text.parse()) {
            (Ok(picture), _) => Ok(Self::Picture(picture)),
            (_, Ok(role)) => Ok(Self::Pattern(role)),
            (Err(error), _) => Err(format!("{error}, nor a pattern such as column-0 or column-0-inverse")),
        }
    }
}

impl Shown {
    /// The picture for a projector of `size`. A pattern is that of `mode`, or of another one where `mode` has none.
    fn raster(self, size: ProjectorSize, mode: Mode, polarization: Polarization) -> Result<Raster, Failure> {
        let role = match self {
            Self::Picture(picture) => return Ok(picture.raster(size, polarization)),
            Self::Pattern(role) => role,
        };
        let sequences = [mode, Mode::Pse, Mode::Gray].into_iter().map(|mode| Sequence::new(mode, size));
        let able = sequences.filter_map(Result::ok).find(|sequence| sequence.can_show(role));
        let missing = || format!("no mode shows {role} on a projector of this size");
        let sequence = able.ok_or_else(|| Failure::data(OPERATION, missing()))?;
        Ok(sequence.raster(role, polarization))
    }
}

/// Shows a picture and returns when its light is steady.
pub fn hold(
    shown: Shown,
    settings: &Settings,
    projector: &mut dyn Projector,
    clock: &dyn Clock,
) -> Result<(), Failure> {
    let info = projector.info();
    let size = ProjectorSize { width: info.width, height: info.height };
    let raster = shown.raster(size, settings.mode, settings.polarization)?;
    let device = |source: DeviceError| Failure::Device { operation: OPERATION, source };
    projector.load(&[slide(raster)]).map_err(device)?;
    let receipt = projector.show(0).map_err(device)?;
    // Whoever asked may look at once.
    let timing = projector.info().timing;
    let light = timing.map_or(UNMEASURED, |timing| timing.latency + timing.settling);
    clock.sleep_until(receipt.flipped + light);
    Ok(())
}
