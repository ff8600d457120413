//! A recorded bundle as a rig.

use std::{error::Error, path::Path, sync::Arc, time::Duration};

use polscan_drivers::{
    camera::{AppliedSettings, CameraNoise, CameraSettings, PixelFormat},
    clock::Clock,
    frame::{PixelStore, Pixels},
    projector::Slide,
    replay::{Recording, ReplayRig},
};

use crate::{
    config::Settings,
    decode::{Plane, SharedPlane},
    sequencer::slide,
    store::{Bundle, Limits, Policy},
    truth::Truth,
};

/// Refresh of a projector that the bundle says nothing of.
const REFRESH_PERIOD: Duration = Duration::from_nanos(16_666_667);

/// What a bundle says of its scene.
pub(super) struct Recorded {
    pub(super) simulated: bool,
    pub(super) truth: Option<Truth>,
}

/// Samples of a bundle as a camera's.
struct Samples(SharedPlane);

impl PixelStore for Samples {
    fn pixels(&self) -> Pixels<'_> {
        match self.0.plane() {
            Plane::U8(samples) => Pixels::U8(samples),
            Plane::U16(samples) => Pixels::U16(samples),
        }
    }
}

/// Opens the bundle in `path`. What it does not state is taken from the settings.
pub(super) fn open(
    path: &Path,
    settings: &Settings,
    clock: Arc<dyn Clock>,
) -> Result<(ReplayRig, Recorded), Box<dyn Error + Send + Sync>> {
    let bundle = Bundle::open(path, Policy::Local, None)?;
    let frames = bundle.frames(&Limits::default())?;
    bundle.verify(&frames)?;
    let manifest = bundle.manifest();
    let sequence = manifest.resolve_sequence(None, None)?;
    let size = (frames.width, frames.height);
    let rig = manifest.rig.as_ref();
    let polarization = rig.map_or(settings.polarization, |rig| rig.polarization);
    let pictures: Vec<Slide> =
        sequence.roles.iter().map(|&role| slide(sequence.raster(role, polarization))).collect();
    let applied = match &manifest.settings {
        Some(recorded) => recorded.applied.clone(),
        None => {
            let decode = manifest.decode_settings(&sequence, size, frames.sample_bits);
            let camera = decode.camera;
            AppliedSettings {
                settings: CameraSettings { format: format(camera.bit_depth)?, ..settings.camera.clone() },
                width: u32::try_from(size.0)?,
                height: u32::try_from(size.1)?,
                black_level_dn: camera.black_level_dn,
                saturation_dn: camera.saturation_dn,
                readout_us: 0.0,
                noise: camera.noise.map(|noise| CameraNoise {
                    gain_dn_per_electron: noise.gain_dn_per_electron,
                    read_noise_dn: noise.read_noise_dn,
                }),
            }
        }
    };
    let truth = bundle.truth(size)?;
    let simulated = truth.is_some() || rig.is_some_and(|rig| rig.camera.driver == "sim");
    let projector = sequence.size();
    let recording = Recording {
        width: applied.width,
        height: applied.height,
        bit_depth: applied.settings.format.bit_depth(),
        frames: frames.planes.iter().map(|plane| Arc::new(Samples(plane.clone())) as _).collect(),
        pictures,
        applied,
        projector_size: [projector.width, projector.height],
        refresh_period: rig.map_or(REFRESH_PERIOD, |rig| rig.projector.refresh_period),
    };
    Ok((ReplayRig::new(recording, clock)?, Recorded { simulated, truth }))
}

/// The camera format of frames with so many significant bits.
fn format(bit_depth: u8) -> Result<PixelFormat, String> {
    [PixelFormat::Mono8, PixelFormat::Mono10, PixelFormat::Mono12, PixelFormat::Mono16]
        .into_iter()
        .find(|format| format.bit_depth() == bit_depth)
        .ok_or_else(|| format!("its samples have {bit_depth} bits, a camera has 8, 10, 12 or 16"))
}
