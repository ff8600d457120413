//! Validated settings: what the rest of the program works with.

use std::{
    net::SocketAddr,
    path::{Path, PathBuf},
};

use polscan_drivers::{
    camera::{ALLOWABLE, CameraSettings, Region},
    sim::{RigDescription, Scene},
};
use polscan_patterns::{ChannelSet, Mode, Polarization};

use super::{
    layers::read_text,
    raw::{self, DeviceDriver, Raw},
};
use crate::{
    decode::Thresholds,
    measure::files::{self, Document, RigFiles},
};

/// Where the calibration of the rig comes from.
#[derive(Debug, Clone, PartialEq)]
pub struct RigCalibration {
    /// File, resolved against the folder of the configuration.
    pub path: PathBuf,
    /// Whether the first (left) device of a stereo result is the projector.
    pub projector_left: bool,
    /// Millimetres per unit of length of the file.
    pub unit_mm: f64,
}

/// Typed settings that passed every check.
#[derive(Debug, Clone)]
pub struct Settings {
    /// The values as written, for the bundle.
    pub raw: Raw,
    /// Mode of a scan.
    pub mode: Mode,
    /// Calibration, if the rig has one.
    pub calibration: Option<RigCalibration>,
    /// What is asked of the camera.
    pub camera: CameraSettings,
    /// Channels of each polarization state.
    pub polarization: Polarization,
    /// Gates of the decoder.
    pub thresholds: Thresholds,
    /// Bundle to replay, where a driver needs it, resolved against the folder of the configuration.
    pub replay: Option<PathBuf>,
    /// Simulated rig and its scene, where a driver needs it.
    pub sim: Option<(RigDescription, Scene)>,
    /// Address of the REST interface.
    pub listen: SocketAddr,
    /// File of tokens, resolved against the folder of the configuration.
    pub tokens: Option<PathBuf>,
    /// Files of certificate and key, resolved against the folder of the configuration.
    pub tls: Option<(PathBuf, PathBuf)>,
    /// What was measured of the rig.
    pub measured: RigFiles,
}

impl Settings {
    /// H over V that the rig shows on metal, where it is known.
    pub fn extinction_ratio(&self) -> Option<f64> {
        let configured = Some(self.raw.rig.extinction_ratio).filter(|&ratio| ratio > 0.0);
        configured.or_else(|| Some(self.measured.polarization.as_ref()?.extinction_ratio))
    }
}

/// Collects `(key, message)`.
type Faults = Vec<(String, String)>;

impl Settings {
    /// Checks `raw`; paths are relative to `folder`. Pushes every fault; `None` where settings cannot be formed.
    pub fn validate(raw: Raw, folder: &Path, faults: &mut Faults) -> Option<Self> {
        check_ranges(&raw, faults);
        let polarization = polarization(&raw.projector, faults);
        let region = region(&raw.camera.region, faults);
        let sim = sim(&raw, folder, faults);
        let replay = replay(&raw, folder, faults);
        let calibration = calibration(&raw.rig, folder, faults);
        let tokens = (!raw.api.tokens.is_empty()).then(|| folder.join(&raw.api.tokens));
        let listen = listen(&raw.api, tokens.is_some(), faults);
        let tls = tls(&raw.api, folder, faults);
        let measured = RigFiles {
            noise: measured(&raw.rig.noise, folder, faults),
            sync: measured(&raw.rig.sync, folder, faults),
            polarization: measured(&raw.rig.polarization, folder, faults),
        };
        if !faults.is_empty() {
            return None;
        }
        Some(Self {
            mode: raw.scan.mode,
            calibration,
            camera: CameraSettings {
                exposure_us: raw.camera.exposure_us,
                gain_db: raw.camera.gain_db,
                gamma: raw.camera.gamma,
                region,
                format: raw.camera.format,
                trigger: raw.camera.trigger,
            },
            polarization: polarization?,
            thresholds: Thresholds {
                lit_sigma: raw.decode.lit_sigma,
                soft_bit_sigma: raw.decode.soft_bit_sigma,
                snap_px: raw.decode.snap_px,
                fit_edges: raw.decode.fit_edges,
            },
            replay,
            sim,
            listen: listen?,
            tokens,
            tls,
            measured,
            raw,
        })
    }
}

fn check_ranges(raw: &Raw, faults: &mut Faults) {
    let mut within = |key: &str, value: f64, low: f64, high: f64, unit: &str| {
        if !(low <= value && value <= high) {
            faults.push((key.into(), format!("{value} is outside {low} to {high}{unit}")));
        }
    };
    within("camera.exposure_us", raw.camera.exposure_us, 1.0, 30e6, " us");
    within("camera.gain_db", raw.camera.gain_db, 0.0, 48.0, " dB");
    within("camera.gamma", raw.camera.gamma, 0.1, 5.0, "");
    within("projector.hold_refreshes", f64::from(raw.projector.hold_refreshes), 0.0, 600.0, " refreshes");
    within("projector.trigger_delay_ms", raw.projector.trigger_delay_ms, 0.0, 10_000.0, " ms");
    within("projector.refresh_hz", raw.projector.refresh_hz, 0.0, 1000.0, " Hz");
    within("rig.calibration_unit_mm", raw.rig.calibration_unit_mm, 1e-3, 1e6, " mm");
    within("capture.retakes_per_pair", f64::from(raw.capture.retakes_per_pair), 0.0, 100.0, "");
    within("capture.retakes_per_scan", f64::from(raw.capture.retakes_per_scan), 0.0, 1000.0, "");
    within("decode.lit_sigma", raw.decode.lit_sigma, 1.0, 100.0, " sigma");
    within("decode.soft_bit_sigma", raw.decode.soft_bit_sigma, 0.1, 100.0, " sigma");
    within("decode.snap_px", raw.decode.snap_px, 0.5, 16.0, " px");
    within("decode.fit_edges", raw.decode.fit_edges as f64, 2.0, 64.0, " edges");
    within("decode.row_gate_px", raw.decode.row_gate_px, 0.1, 1000.0, " px");
    within("rig.extinction_ratio", raw.rig.extinction_ratio, 0.0, 1e6, "");
    within("volume.near_mm", raw.volume.near_mm, 1.0, 1e6, " mm");
    within("volume.far_mm", raw.volume.far_mm, 1.0, 1e6, " mm");
    within("api.concurrency", raw.api.concurrency as f64, 1.0, 10_000.0, "");
    within("api.streams", raw.api.streams as f64, 1.0, 10_000.0, "");
    within("api.wait_limit_s", raw.api.wait_limit_s, 1.0, 86_400.0, " s");
    within("api.stop_grace_s", raw.api.stop_grace_s, 0.0, 3600.0, " s");
    within("api.idempotency_hours", raw.api.idempotency_hours, 0.01, 10_000.0, " h");
    within("store.quota_gib", raw.store.quota_gib, 0.0, 1e6, " GiB");
    within("store.min_free_gib", raw.store.min_free_gib, 0.0, 1e6, " GiB");
    within("store.keep_days", raw.store.keep_days, 0.0, 1e6, " days");
    within("scan.queue_capacity", raw.scan.queue_capacity as f64, 0.0, 10_000.0, " scans");
    if raw.volume.near_mm >= raw.volume.far_mm {
        let message = format!("{} is not beyond near_mm = {}", raw.volume.far_mm, raw.volume.near_mm);
        faults.push(("volume.far_mm".into(), message));
    }
    if raw.store.dir.is_empty() {
        faults.push(("store.dir".into(), "empty; name a folder".into()));
    }
    for name in raw.camera.allow.iter().filter(|name| !ALLOWABLE.contains(&name.as_str())) {
        let message = format!("`{name}` is none of {}", ALLOWABLE.join(", "));
        faults.push(("camera.allow".into(), message));
    }
    if let driver @ (DeviceDriver::Aravis | DeviceDriver::V4l2) = raw.projector.driver {
        faults.push(("projector.driver".into(), format!("{} drives cameras only", driver.name())));
    }
    if !matches!(raw.camera.frame_size[..], [] | [1..=16_384, 1..=16_384]) {
        let message =
            format!("{:?} is no size; give columns and rows, as [1280, 720], or []", raw.camera.frame_size);
        faults.push(("camera.frame_size".into(), message));
    }
    if raw.camera.skip_frames > 100 {
        faults.push(("camera.skip_frames".into(), format!("{} is more than 100", raw.camera.skip_frames)));
    }
    if raw.camera.fixed_exposure_us.is_some_and(|exposure| !(exposure > 0.0 && exposure.is_finite())) {
        faults.push(("camera.fixed_exposure_us".into(), "an exposure takes more than 0 us".into()));
    }
    if raw.camera.trigger_latency_ms.is_some_and(|latency| !(0.0..=1000.0).contains(&latency)) {
        faults.push(("camera.trigger_latency_ms".into(), "must be within 0 and 1000 ms".into()));
    }
    let size = &raw.projector.size;
    if !(size.is_empty() || size.len() == 2 && size.iter().all(|side| (1..=8192).contains(side))) {
        let message =
            format!("{size:?} is no size; give columns and rows of 1 to 8192, as [1024, 768], or []");
        faults.push(("projector.size".into(), message));
    }
    if raw.camera.driver == DeviceDriver::Window {
        faults.push(("camera.driver".into(), "`window` is the driver of projectors, not of cameras".into()));
    }
    let pair = [raw.camera.driver, raw.projector.driver];
    for (driver, name) in [(DeviceDriver::Sim, "simulated"), (DeviceDriver::Replay, "replaying")] {
        if pair.contains(&driver) && pair != [driver; 2] {
            let message =
                format!("a {name} camera sees only a {name} projector; set both drivers to the same");
            faults.push(("camera.driver".into(), message));
            break;
        }
    }
}

/// Where to listen. Without tokens nobody but this machine is served, whatever stands before it.
fn listen(api: &raw::Api, tokens: bool, faults: &mut Faults) -> Option<SocketAddr> {
    let Ok(address) = api.listen.parse::<SocketAddr>() else {
        let message = format!("`{}` is not an address and port such as 127.0.0.1:8631", api.listen);
        faults.push(("api.listen".into(), message));
        return None;
    };
    if !address.ip().is_loopback() && !tokens {
        let message =
            format!("{address} can be reached from other machines: name a file of tokens in api.tokens");
        faults.push(("api.listen".into(), message));
    }
    Some(address)
}

/// Files of certificate and key: both or none.
fn tls(api: &raw::Api, folder: &Path, faults: &mut Faults) -> Option<(PathBuf, PathBuf)> {
    let keys = [("api.tls_certificate", &api.tls_certificate), ("api.tls_key", &api.tls_key)];
    if keys.iter().all(|(_, name)| name.is_empty()) {
        return None;
    }
    for (key, name) in keys {
        let path = folder.join(name);
        if name.is_empty() {
            faults.push((key.into(), "empty; certificate and key are needed together".into()));
        } else if !path.is_file() {
            let message =
                format!("no file at {}; the path is relative to the configuration file", path.display());
            faults.push((key.into(), message));
        }
    }
    Some((folder.join(&api.tls_certificate), folder.join(&api.tls_key)))
}

fn polarization(raw: &raw::Projector, faults: &mut Faults) -> Option<Polarization> {
    let before = faults.len();
    let mut channels = |key: &str, letters: &str| {
        let mut set = ChannelSet { red: false, green: false, blue: false };
        for letter in letters.chars() {
            let channel = match letter {
                'r' => &mut set.red,
                'g' => &mut set.green,
                'b' => &mut set.blue,
                _ => {
                    faults.push((key.into(), format!("`{letter}` is none of the channels r, g, b")));
                    continue;
                }
            };
            if std::mem::replace(channel, true) {
                faults.push((key.into(), format!("channel `{letter}` is named twice")));
            }
        }
        if letters.is_empty() {
            faults.push((key.into(), "no channel; name at least one of r, g, b".into()));
        }
        set
    };
    let horizontal = channels("projector.horizontal", &raw.horizontal);
    let vertical = channels("projector.vertical", &raw.vertical);
    if let Some(both) = raw.horizontal.chars().find(|letter| raw.vertical.contains(*letter)) {
        let message =
            format!("channel `{both}` is in projector.horizontal too; a channel has one polarization");
        faults.push(("projector.vertical".into(), message));
    }
    (faults.len() == before).then_some(Polarization { horizontal, vertical })
}

fn region(raw: &raw::RegionTable, faults: &mut Faults) -> Option<Region> {
    match (raw.x, raw.y, raw.width, raw.height) {
        (None, None, None, None) => None,
        (Some(x), Some(y), Some(width), Some(height)) if width > 0 && height > 0 => {
            Some(Region { x, y, width, height })
        }
        _ => {
            faults
                .push(("camera.region".into(), "needs x, y, width and height, the last two above 0".into()));
            None
        }
    }
}

fn calibration(rig: &raw::Rig, folder: &Path, faults: &mut Faults) -> Option<RigCalibration> {
    if rig.calibration.is_empty() {
        return None;
    }
    let path = folder.join(&rig.calibration);
    if !path.is_file() {
        let message =
            format!("no file at {}; the path is relative to the configuration file", path.display());
        faults.push(("rig.calibration".into(), message));
    }
    Some(RigCalibration {
        path,
        projector_left: rig.calibration_projector_left,
        unit_mm: rig.calibration_unit_mm,
    })
}

/// A file of what was measured.
fn measured<T: Document>(name: &str, folder: &Path, faults: &mut Faults) -> Option<T> {
    files::load(name, folder, read_text).unwrap_or_else(|fault| {
        faults.push((T::KEY.into(), fault));
        None
    })
}

fn replay(raw: &Raw, folder: &Path, faults: &mut Faults) -> Option<PathBuf> {
    if raw.camera.driver != DeviceDriver::Replay {
        return None;
    }
    let path = folder.join(&raw.replay.bundle);
    if raw.replay.bundle.is_empty() || !path.exists() {
        let message = format!(
            "the replay drivers need a bundle, and there is none at {}; the path is relative to the configuration file",
            path.display()
        );
        faults.push(("replay.bundle".into(), message));
    }
    Some(path)
}

/// A fault of the rig's description, which begins with its key path.
fn split_key(fault: String) -> (String, String) {
    match fault.split_once(": ") {
        Some((key, message)) => (key.into(), message.into()),
        None => ("sim".into(), fault),
    }
}

fn sim(raw: &Raw, folder: &Path, faults: &mut Faults) -> Option<(RigDescription, Scene)> {
    let needed = raw.camera.driver == DeviceDriver::Sim;
    let Some(description) = &raw.sim else {
        if needed {
            faults.push(("sim".into(), "missing; the sim drivers need the table [sim]".into()));
        }
        return None;
    };
    faults.extend(description.validate().into_iter().map(split_key));
    let path = folder.join(&description.scene);
    let text = match read_text(&path) {
        Ok(text) => text,
        Err(message) => {
            faults.push(("sim.scene".into(), message));
            return None;
        }
    };
    match toml::from_str::<Scene>(&text) {
        Ok(scene) => {
            let found = scene.validate().into_iter();
            faults.extend(found.map(|fault| ("sim.scene".into(), format!("{}: {fault}", path.display()))));
            Some((description.clone(), scene))
        }
        Err(error) => {
            let message = format!("{} is not a scene: {}", path.display(), error.message());
            faults.push(("sim.scene".into(), message));
            None
        }
    }
}
