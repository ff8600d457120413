//! `polscan verify`: does the rig still measure a known artefact as it should?

use std::{
    fs::{File, OpenOptions},
    io::{BufRead, BufReader, Write},
    path::{Path, PathBuf},
    time::SystemTime,
};

use polscan_calibration::artefact::{Accepted, Artefact, Check, Kind, PixelPoint, Point, judge};
use serde::{Deserialize, Serialize};
use serde_json::json;

use super::{failure::FAILED, say, scan::take};
use crate::{
    cloud::{PlyPoint, flag},
    config::{ConfigError, Settings},
    engine::Failure,
    export::Scan,
    store::{Policy, StorageError, measured::CLOUD_FILE_NAME, source::read_bounded, time::rfc3339_utc},
};

/// Name of the history in the store.
const HISTORY_FILE_NAME: &str = "acceptance.jsonl";

/// No description of an artefact is longer.
const MAX_BYTES: u64 = 1 << 16;

/// Earlier results that are shown.
const SHOWN: usize = 5;

/// Arguments of `polscan verify`.
#[derive(Debug, clap::Args)]
pub struct VerifyArgs {
    /// TOML file that says what the artefact is and what may be off; docs/verify.md describes it.
    #[arg(long, value_name = "FILE")]
    artefact: PathBuf,
    /// Scan to measure it in; without one, the configured rig scans now.
    #[arg(long, value_name = "DIR", conflicts_with = "out", required_unless_present = "out")]
    bundle: Option<PathBuf>,
    /// Folder for the scan that is made now; must be absent or empty.
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Configuration file of the rig; what it leaves out is as in config/default.toml.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// File that each result is added to; acceptance.jsonl in the configured store where none is named.
    #[arg(long, value_name = "FILE")]
    history: Option<PathBuf>,
}

/// One line of the history.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Entry {
    time: String,
    artefact: String,
    bundle: PathBuf,
    passed: bool,
    checks: Vec<Check>,
}

/// Measures, remembers and prints; returns the exit code. `load` reads the settings of a configuration file.
pub fn verify(
    args: &VerifyArgs,
    load: impl Fn(Option<&Path>) -> Result<Settings, ConfigError>,
    json: bool,
) -> Result<u8, Failure> {
    let artefact = read_artefact(&args.artefact)?;
    let settings = load(args.config.as_deref())?;
    let history =
        args.history.clone().unwrap_or_else(|| Path::new(&settings.raw.store.dir).join(HISTORY_FILE_NAME));
    // Read before the scan, so that a history of something else is refused before anything was done.
    let earlier = read_history(&history)?;
    let bundle = match (&args.bundle, &args.out) {
        (Some(bundle), _) => bundle.clone(),
        (None, Some(out)) => {
            take(&settings, &[], out)?;
            out.clone()
        }
        (None, None) => {
            return Err(Failure::data("verify", "give --bundle with a scan, or --out for a new one"));
        }
    };
    let accepted = judge(&artefact, &read_cloud(&bundle)?);
    let entry = Entry {
        time: rfc3339_utc(SystemTime::now()),
        artefact: artefact.name.clone(),
        bundle,
        passed: accepted.passed,
        checks: accepted.checks.clone(),
    };
    remember(&history, &entry)?;
    let same: Vec<&Entry> = earlier.iter().filter(|one| one.artefact == artefact.name).collect();
    if json {
        say(json!({ "passed": accepted.passed, "history": history, "result": entry, "earlier": same }));
    } else {
        lines(&artefact, &accepted, &same).iter().for_each(say);
        say(format_args!("remembered in {}", history.display()));
    }
    Ok(if accepted.passed { 0 } else { FAILED })
}

fn read_artefact(path: &Path) -> Result<Artefact, Failure> {
    let operation = || format!("read the artefact {}", path.display());
    let bytes = read_bounded(path, Policy::Local, "read", MAX_BYTES)
        .map_err(|error| Failure::data(operation(), error))?;
    let text = String::from_utf8(bytes).map_err(|error| Failure::data(operation(), error))?;
    let artefact: Artefact = toml::from_str(&text).map_err(|error| Failure::data(operation(), error))?;
    artefact.check().map_err(|error| Failure::data(operation(), error))?;
    Ok(artefact)
}

/// The points of a scan with their camera pixels, in the camera's frame, in which each point is uncertain along its ray.
fn read_cloud(bundle: &Path) -> Result<Vec<PixelPoint>, Failure> {
    let scan = Scan::read(bundle)?;
    let Some(cloud) = scan.cloud else {
        let operation = format!("read {}", bundle.join(CLOUD_FILE_NAME).display());
        return Err(Failure::data(operation, "there is none; a scan without a calibration has no cloud"));
    };
    let at = |((pixel, point), (mm, _)): ((&usize, &PlyPoint), ([f64; 3], _))| PixelPoint {
        x: (pixel % cloud.width) as u32,
        y: (pixel / cloud.width) as u32,
        point: Point { mm, sigma_z_mm: f64::from(point.sigma_z_mm) },
    };
    // At a silhouette a pixel sees two surfaces, and its depth is that of neither.
    let one_surface = |one: &((_, &PlyPoint), _)| one.0.1.flags & flag::SILHOUETTE == 0;
    Ok(cloud.pixels.iter().zip(&cloud.points).zip(cloud.in_camera()).filter(one_surface).map(at).collect())
}

fn read_history(path: &Path) -> Result<Vec<Entry>, Failure> {
    let operation = || format!("read the history {}", path.display());
    let file = match File::open(path) {
        Ok(file) => file,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(Failure::data(operation(), error)),
    };
    let mut entries = Vec::new();
    for (index, line) in BufReader::new(file).lines().enumerate() {
        let line = line.map_err(|error| Failure::data(operation(), error))?;
        let entry = serde_json::from_str(&line).map_err(|error| {
            let detail =
                format!("line {} is no result of an acceptance ({error}); move the file away", index + 1);
            Failure::data(operation(), detail)
        })?;
        entries.push(entry);
    }
    Ok(entries)
}

/// Adds a line and sees to it that it is on the disk.
fn remember(path: &Path, entry: &Entry) -> Result<(), Failure> {
    let failed = |error| {
        Failure::storage("remember the result", StorageError::file("add to the history", path, error))
    };
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder).map_err(failed)?;
    }
    let mut line = serde_json::to_vec(entry).expect("numbers and text are JSON");
    line.push(b'\n');
    let mut file = OpenOptions::new().create(true).append(true).open(path).map_err(failed)?;
    // One call, so that two programs at once do not mix their lines.
    file.write_all(&line).map_err(failed)?;
    file.sync_all().map_err(failed)
}

fn lines(artefact: &Artefact, accepted: &Accepted, earlier: &[&Entry]) -> Vec<String> {
    let mut lines = vec![format!("artefact: {}", artefact.name)];
    for check in &accepted.checks {
        let what = match check.kind {
            Kind::Bow => "bow",
            Kind::Rms => "rms",
            Kind::Height => "height",
            Kind::Diameter => "diameter",
            Kind::Distance => "distance",
        };
        let measured = match (check.measured_mm, check.sigma_mm) {
            (Some(measured), Some(sigma)) if sigma > 0.0 => format!("{measured:.3} mm (sigma {sigma:.3})"),
            (Some(measured), _) => format!("{measured:.3} mm"),
            _ => "not measured".into(),
        };
        let asked = match check.kind {
            Kind::Bow | Kind::Rms => format!("at most {:.3}", check.tolerance_mm),
            _ => format!("{:.3} +- {:.3}", check.nominal_mm, check.tolerance_mm),
        };
        let verdict = check.reason.as_ref().map_or("ok".to_owned(), |reason| format!("FAILED: {reason}"));
        let before: Vec<String> = earlier
            .iter()
            .rev()
            .filter_map(|entry| {
                entry.checks.iter().find(|one| (&one.name, one.kind) == (&check.name, check.kind))
            })
            .filter_map(|one| one.measured_mm)
            .take(SHOWN)
            .map(|value| format!("{value:.3}"))
            .collect();
        let before =
            if before.is_empty() { String::new() } else { format!("; before: {}", before.join(", ")) };
        lines.push(format!("{} {what}: {measured}, asked {asked}{before}: {verdict}", check.name));
    }
    let failures = earlier.iter().filter(|entry| !entry.passed).count();
    if let Some(last) = earlier.last() {
        lines.push(format!(
            "history: {} before, {failures} of them failed, the last on {}",
            earlier.len(),
            last.time
        ));
    }
    lines.push(if accepted.passed { "accepted".into() } else { "not accepted".into() });
    lines
}
