//! What a scan is made with, from the settings and what the devices say of themselves.

use std::time::Duration;

use polscan_drivers::{
    camera::{AppliedSettings, CameraInfo},
    projector::ProjectorInfo,
};
use polscan_patterns::{ProjectorSize, Sequence};

use super::Failure;
use crate::{
    config::Settings,
    decode::{CameraResponse, NoiseModel},
    geometry::{Calibration, ReadHints},
    sequencer::{Plan, PlanError, PlanOptions},
    store::source::{SensorPart, read_calibration_for},
};

/// How the camera answers to light, with its noise where it is known.
pub(super) fn response(applied: &AppliedSettings) -> CameraResponse {
    CameraResponse {
        bit_depth: applied.settings.format.bit_depth(),
        black_level_dn: applied.black_level_dn,
        saturation_dn: applied.saturation_dn,
        noise: applied.noise.map(|noise| NoiseModel {
            gain_dn_per_electron: noise.gain_dn_per_electron,
            read_noise_dn: noise.read_noise_dn,
        }),
    }
}

/// When each frame is shown and taken.
pub(super) fn plan(
    settings: &Settings,
    sequence: Sequence,
    projector: &ProjectorInfo,
    camera: &CameraInfo,
    applied: AppliedSettings,
) -> Result<Plan, Failure> {
    let (timing, limits) = (&settings.raw.projector, &settings.raw.capture);
    let options = PlanOptions {
        hold_refreshes: (timing.hold_refreshes > 0).then_some(timing.hold_refreshes),
        trigger_delay: (timing.trigger_delay_ms > 0.0)
            .then(|| Duration::from_secs_f64(timing.trigger_delay_ms * 1e-3)),
        retakes_each: limits.retakes_per_pair,
        retakes_total: limits.retakes_per_scan,
        ..PlanOptions::default()
    };
    Plan::new(sequence, settings.polarization, projector, camera, applied, &options)
        .map_err(|error: PlanError| setup("plan the capture", error))
}

/// The rig's calibration, for the frames that the camera delivers: one of the whole sensor is cut to its region.
pub(super) fn calibration(
    settings: &Settings,
    applied: &AppliedSettings,
    camera: &CameraInfo,
    projector: ProjectorSize,
) -> Result<Option<Calibration>, Failure> {
    let Some(calibration) = &settings.calibration else {
        return Ok(None);
    };
    let frame = (applied.width, applied.height);
    let projector = (projector.width, projector.height);
    let fail = |error: Box<dyn std::error::Error + Send + Sync>| {
        Failure::data(format!("use the calibration {}", calibration.path.display()), error)
    };
    let hints = ReadHints {
        camera_size: Some(frame),
        projector_size: Some(projector),
        swap: calibration.projector_left,
        unit_mm: calibration.unit_mm,
    };
    let part = applied.settings.region.map(|region| SensorPart {
        sensor: (camera.sensor_width, camera.sensor_height),
        origin: (region.x, region.y),
    });
    let calibrated =
        read_calibration_for(&calibration.path, &hints, part).map_err(|error| fail(error.into()))?;
    calibrated.check_sizes(frame, projector).map_err(|e| fail(e.into()))?;
    Ok(Some(calibrated))
}

/// Settings that do not go together.
pub(super) fn setup(
    operation: &'static str,
    error: impl std::error::Error + Send + Sync + 'static,
) -> Failure {
    Failure::Setup { operation, source: Box::new(error) }
}
