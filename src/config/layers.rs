//! Joins defaults, file, environment and flags, and collects every fault on the way.

use std::{
    fmt,
    path::{Path, PathBuf},
};

use thiserror::Error;
use toml::{Table, Value};

use super::{Raw, Settings};
use crate::store::{Policy, source::read_bounded};

/// The commented defaults, which are also the manual.
const DEFAULTS: &str = include_str!("../../config/default.toml");

/// The shipped rig: values to go on with where `[sim]` has a fault.
const TWIN: &str = include_str!("../../config/sim.toml");

/// No configuration or scene is longer.
const MAX_BYTES: u64 = 1 << 20;

/// Bound on the faults that one configuration can report.
const MOST_FAULTS: usize = 200;

/// One thing wrong with a configuration.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Fault {
    /// Key path such as `camera.exposure_us`; empty where the whole file is meant.
    pub key: String,
    /// What is wrong and what is allowed.
    pub message: String,
    /// File, variable or flag that set the key, where it was not the default.
    pub origin: Option<String>,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.key.is_empty() {
            write!(f, "{}: ", self.key)?;
        }
        f.write_str(&self.message)?;
        match &self.origin {
            Some(origin) => write!(f, " (set by {origin})"),
            None => Ok(()),
        }
    }
}

/// A configuration that cannot be used.
#[derive(Debug, Error)]
#[error("{} of the configuration cannot be used:\n{}", count(faults.len()), lines(faults))]
pub struct ConfigError {
    /// Everything that is wrong with it.
    pub faults: Vec<Fault>,
}

fn count(faults: usize) -> String {
    if faults == 1 { "1 setting".into() } else { format!("{faults} settings") }
}

fn lines(faults: &[Fault]) -> String {
    faults.iter().map(|fault| format!("  {fault}")).collect::<Vec<_>>().join("\n")
}

/// One value from the environment or a flag.
#[derive(Debug, Clone, PartialEq)]
pub struct Override {
    /// Key path such as `scan.mode`.
    pub key: String,
    /// Value.
    pub value: Value,
    /// The text that `value` was read from, where it was text.
    pub text: Option<String>,
    /// Variable or flag, for messages.
    pub origin: String,
}

impl Override {
    /// An override by a command-line flag.
    pub fn flag(name: &str, key: &str, value: impl Into<Value>) -> Self {
        Self { key: key.into(), value: value.into(), text: None, origin: format!("flag {name}") }
    }

    /// The overrides among environment variables: those that start with `POLSCAN_` and hold two underscores.
    pub fn from_environment(variables: impl Iterator<Item = (String, String)>) -> Vec<Self> {
        let mut found: Vec<_> = variables
            .filter_map(|(name, text)| {
                let (table, key) = name.strip_prefix("POLSCAN_")?.split_once("__")?;
                let key = format!("{table}.{}", key.replace("__", ".")).to_lowercase();
                let value = value_of_text(&text);
                Some(Self { key, value, text: Some(text), origin: format!("variable {name}") })
            })
            .collect();
        found.sort_by(|a, b| a.key.cmp(&b.key));
        found
    }
}

/// A TOML value where the text is one (`2000`, `true`, `[1, 2]`), else the text itself.
fn value_of_text(text: &str) -> Value {
    toml::from_str::<Table>(&format!("value = {text}"))
        .ok()
        .and_then(|mut table| table.remove("value"))
        .unwrap_or_else(|| Value::String(text.into()))
}

/// The sources of a configuration.
#[derive(Debug, Default)]
pub struct Layers {
    /// File, if any.
    pub file: Option<PathBuf>,
    /// Environment, then flags.
    pub overrides: Vec<Override>,
}

impl Layers {
    /// Reads and joins all layers, or reports everything that is wrong with them.
    pub fn load(&self) -> Result<Settings, ConfigError> {
        let folder = self.file.as_deref().and_then(Path::parent).unwrap_or(Path::new(""));
        self.join(self.file.as_deref().map(read_table), folder)
    }

    /// The settings of a file's `text`, whose paths are relative to `folder`.
    pub fn parse(text: &str, folder: &Path) -> Result<Settings, ConfigError> {
        Self::default().join(Some(parse_table(text, None)), folder)
    }

    fn join(&self, file: Option<Result<Table, Fault>>, folder: &Path) -> Result<Settings, ConfigError> {
        let mut faults = Vec::new();
        let mut table = defaults();
        match file {
            Some(Ok(file)) => merge(&mut table, file),
            Some(Err(fault)) => faults.push(fault),
            None => {}
        }
        for change in &self.overrides {
            // A serial number of digits only is text all the same.
            let value = match (get(&table, &change.key), &change.text) {
                (Some(Value::String(_)), Some(text)) => Value::String(text.clone()),
                _ => change.value.clone(),
            };
            if let Err(message) = set(&mut table, &change.key, value) {
                faults.push(Fault { key: change.key.clone(), message, origin: Some(change.origin.clone()) });
            }
        }
        let raw = self.deserialize(table, &mut faults);
        let settings = raw.and_then(|raw| {
            let mut found = Vec::new();
            let settings = Settings::validate(raw, folder, &mut found);
            let unread = faults.len();
            for (key, message) in found {
                // A key that could not be read was put back to its default, so that what follows from it is noise.
                if !faults[..unread].iter().any(|fault| fault.key == key) {
                    let origin = self.origin_of(&key);
                    faults.push(Fault { key, message, origin });
                }
            }
            settings
        });
        match settings {
            Some(settings) if faults.is_empty() => Ok(settings),
            _ => Err(ConfigError { faults }),
        }
    }

    fn origin_of(&self, key: &str) -> Option<String> {
        self.overrides.iter().rev().find(|change| change.key == key).map(|change| change.origin.clone())
    }

    /// Deserializes the table; each faulty key is reported, put back to a sound value or removed, and the rest tried again.
    fn deserialize(&self, mut table: Table, faults: &mut Vec<Fault>) -> Option<Raw> {
        let sound = sound_values();
        for _ in 0..MOST_FAULTS {
            let error = match serde_path_to_error::deserialize::<_, Raw>(Value::Table(table.clone())) {
                Ok(raw) => return Some(raw),
                Err(error) => error,
            };
            let mut path = keys(error.path());
            let message = error.inner().to_string().lines().next().unwrap_or_default().trim().to_string();
            if let Some(field) =
                message.strip_prefix("missing field `").and_then(|rest| rest.strip_suffix('`'))
            {
                path.push(field.into());
            }
            let key = path.join(".");
            let origin = self.origin_of(&key);
            faults.push(Fault { key, message, origin });
            // An element of a list is put back with its whole list: the nearest key that has a sound value.
            let mended = (1..=path.len()).rev().any(|depth| match lookup(&sound, &path[..depth]) {
                Some(value) if lookup(&table, &path[..depth]) != Some(value) => {
                    put(&mut table, &path[..depth], value.clone())
                }
                _ => depth == path.len() && take(&mut table, &path),
            });
            if !mended {
                return None;
            }
        }
        None
    }
}

/// The keys of a path; an index into a list belongs to the list's key.
fn keys(path: &serde_path_to_error::Path) -> Vec<String> {
    path.iter()
        .filter_map(|segment| match segment {
            serde_path_to_error::Segment::Map { key } => Some(key.clone()),
            _ => None,
        })
        .collect()
}

/// A table in which every key that can be wrong has a sound value: the defaults, and the shipped rig below `sim`.
fn sound_values() -> Table {
    let mut table = defaults();
    if let Ok(mut twin) = toml::from_str::<Table>(TWIN)
        && let Some(sim) = twin.remove("sim")
    {
        table.insert("sim".into(), sim);
    }
    table
}

fn lookup<'a>(table: &'a Table, path: &[String]) -> Option<&'a Value> {
    let (first, rest) = path.split_first()?;
    rest.iter().try_fold(table.get(first)?, |value, part| value.as_table()?.get(part))
}

fn put(table: &mut Table, path: &[String], value: Value) -> bool {
    match path {
        [] => false,
        [key] => {
            table.insert(key.clone(), value);
            true
        }
        [head, rest @ ..] => {
            let inner = table.entry(head).or_insert_with(|| Value::Table(Table::new()));
            inner.as_table_mut().is_some_and(|inner| put(inner, rest, value))
        }
    }
}

fn take(table: &mut Table, path: &[String]) -> bool {
    match path {
        [] => false,
        [key] => table.remove(key).is_some(),
        [head, rest @ ..] => {
            table.get_mut(head).and_then(Value::as_table_mut).is_some_and(|inner| take(inner, rest))
        }
    }
}

fn defaults() -> Table {
    toml::from_str(DEFAULTS).expect("the built-in defaults are TOML, which a test holds")
}

fn read_table(path: &Path) -> Result<Table, Fault> {
    let origin = Some(path.display().to_string());
    let text =
        read_text(path).map_err(|message| Fault { key: String::new(), message, origin: origin.clone() })?;
    parse_table(&text, origin)
}

/// The text of a regular file that is not longer than any configuration.
pub(super) fn read_text(path: &Path) -> Result<String, String> {
    let bytes =
        read_bounded(path, Policy::Local, "read", MAX_BYTES).map_err(
            |error| match std::error::Error::source(&error) {
                Some(cause) => format!("{error}: {cause}"),
                None => error.to_string(),
            },
        )?;
    String::from_utf8(bytes).map_err(|_| format!("{} is not UTF-8 text", path.display()))
}

fn parse_table(text: &str, origin: Option<String>) -> Result<Table, Fault> {
    toml::from_str(text).map_err(|error| {
        let line = error.span().map(|span| text[..span.start.min(text.len())].lines().count().max(1));
        let place = line.map(|line| format!("line {line}: ")).unwrap_or_default();
        Fault { key: String::new(), message: format!("not TOML: {place}{}", error.message()), origin }
    })
}

fn merge(base: &mut Table, over: Table) {
    for (key, value) in over {
        match (base.get_mut(&key), value) {
            (Some(Value::Table(base)), Value::Table(over)) => merge(base, over),
            (_, value) => {
                base.insert(key, value);
            }
        }
    }
}

fn get<'a>(table: &'a Table, key: &str) -> Option<&'a Value> {
    let mut parts = key.split('.');
    let first = table.get(parts.next()?)?;
    parts.try_fold(first, |value, part| value.as_table()?.get(part))
}

fn set(table: &mut Table, key: &str, value: Value) -> Result<(), String> {
    match key.split_once('.') {
        None => {
            table.insert(key.into(), value);
            Ok(())
        }
        Some((head, rest)) => table
            .entry(head)
            .or_insert_with(|| Value::Table(Table::new()))
            .as_table_mut()
            .ok_or_else(|| format!("`{head}` is a value, not a table"))
            .and_then(|inner| set(inner, rest, value)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(file: &str, overrides: Vec<Override>) -> Result<Settings, Vec<String>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, file).unwrap();
        Layers { file: Some(path), overrides }
            .load()
            .map_err(|error| error.faults.iter().map(|fault| fault.key.clone()).collect())
    }

    fn variable(name: &str, value: &str) -> Vec<Override> {
        Override::from_environment([(name.to_string(), value.to_string())].into_iter())
    }

    #[test]
    fn defaults_alone_are_valid() {
        let settings = Layers::default().load().unwrap();
        assert_eq!(settings.raw.api.listen, "127.0.0.1:8631");
        assert_eq!(settings.mode.name(), "pse");
    }

    #[test]
    fn file_then_environment_then_flags() {
        let file = "[scan]\nmode = \"gray\"\n[camera]\nexposure_us = 1000";
        let settings = load(file, Vec::new());
        // An integer where a float is meant is what people write.
        assert_eq!(settings.unwrap().camera.exposure_us, 1000.0);
        let mut overrides = variable("POLSCAN_SCAN__MODE", "fast");
        overrides.extend(variable("POLSCAN_CAMERA__EXPOSURE_US", "500.5"));
        overrides.push(Override::flag("--mode", "scan.mode", "paper"));
        let settings = load(file, overrides).unwrap();
        assert_eq!(settings.mode.name(), "paper");
        assert_eq!(settings.camera.exposure_us, 500.5);
    }

    #[test]
    fn a_window_is_a_projector_of_a_whole_size() {
        let rig = |camera: &str, size: &str| {
            format!("[camera]\ndriver = \"{camera}\"\n[projector]\ndriver = \"window\"\nsize = {size}")
        };
        for size in ["[]", "[1024, 768]"] {
            assert!(load(&rig("none", size), Vec::new()).is_ok(), "{size}");
        }
        for size in ["[1024]", "[0, 768]", "[1024, 768, 3]", "[9000, 768]"] {
            assert_eq!(load(&rig("none", size), Vec::new()).unwrap_err(), ["projector.size"], "{size}");
        }
        for camera in ["window", "sim"] {
            let faults = load(&rig(camera, "[]"), Vec::new()).unwrap_err();
            assert!(faults.contains(&"camera.driver".to_string()), "{camera}: {faults:?}");
        }
        let named = variable("POLSCAN_PROJECTOR__X11_DISPLAY", ":7");
        assert_eq!(load(&rig("none", "[]"), named).unwrap().raw.projector.x11_display, ":7");
    }

    #[test]
    fn all_faults_are_reported_at_once() {
        let file = r#"
            typo = 1
            [scan]
            mode = "fringe"
            [camera]
            exposure_us = -5.0
            gian_db = 3.0
            region = { x = 1, y = 2 }
            [volume]
            near_mm = 900.0
            far_mm = 800.0
            [projector]
            vertical = "rgb"
        "#;
        let mut faults = load(file, Vec::new()).unwrap_err();
        faults.sort();
        let expected = [
            "camera.exposure_us",
            "camera.gian_db",
            "camera.region",
            "projector.vertical",
            "scan.mode",
            "typo",
            "volume.far_mm",
        ];
        assert_eq!(faults, expected);
    }

    #[test]
    fn faults_below_sim_and_keys_with_dots_hide_no_others() {
        let twin = include_str!("../../config/sim.toml");
        let file = twin
            .replace("size = [1600, 1200]", "size = [0, 3]\n\"od.d\" = 1")
            .replace("focal_px = 4638.0", "focal_px = \"x\"")
            .replace("latency_refreshes = 2", "latency_refreshes = -2")
            .replace("near_mm = 700.0", "near_mm = 7000.0");
        let mut faults = load(&format!("typo = 1\n{file}"), Vec::new()).unwrap_err();
        faults.sort();
        let expected = [
            "rig.calibration",
            "sim.camera.focal_px",
            "sim.camera.od.d",
            "sim.camera.size",
            "sim.projector.latency_refreshes",
            "sim.scene",
            "typo",
            "volume.far_mm",
        ];
        assert_eq!(faults, expected);
    }

    #[test]
    fn unknown_variables_of_our_form_are_errors_and_others_are_ignored() {
        assert_eq!(load("", variable("POLSCAN_SCAN__MOOD", "gray")).unwrap_err(), ["scan.mood"]);
        assert!(load("", variable("POLSCAN_LOG", "debug")).is_ok());
        assert!(load("", variable("OTHER__THING", "1")).is_ok());
    }

    #[test]
    fn a_text_of_digits_stays_text() {
        let settings = load("", variable("POLSCAN_CAMERA__SERIAL", "12345678")).unwrap();
        assert_eq!(settings.raw.camera.serial, "12345678");
        let settings = load("", variable("POLSCAN_RIG__NAME", "\"seven\"")).unwrap();
        assert_eq!(settings.raw.rig.name, "\"seven\"");
    }

    #[test]
    fn what_a_camera_may_have_otherwise_is_checked_by_name() {
        let camera = |allow: &str| format!("[camera]\ndriver = \"aravis\"\nallow = {allow}\n");
        let settings = load(&camera("[\"gamma\"]\ngain_raw = 0\ntrigger = \"line0\""), Vec::new()).unwrap();
        assert_eq!(settings.raw.camera.allow, ["gamma"]);
        assert_eq!((settings.raw.camera.gain_raw, settings.raw.camera.black_level), (Some(0.0), None));
        assert_eq!(settings.camera.trigger, polscan_drivers::camera::TriggerSource::Line0);
        // Without a format there is no frame, so that nothing but a mistake allows another.
        assert_eq!(load(&camera("[\"gama\", \"format\"]"), Vec::new()).unwrap_err(), ["camera.allow"; 2]);
        for driver in ["aravis", "v4l2"] {
            let projector = format!("[projector]\ndriver = \"{driver}\"");
            assert_eq!(load(&projector, Vec::new()).unwrap_err(), ["projector.driver"]);
        }
    }

    #[test]
    fn what_only_a_camera_without_a_trigger_needs_is_checked() {
        let camera = |keys: &str| load(&format!("[camera]\ndriver = \"v4l2\"\n{keys}\n"), Vec::new());
        let settings = camera("frame_size = [1280, 720]\nfixed_exposure_us = 2000\nskip_frames = 0").unwrap();
        assert_eq!(settings.raw.camera.frame_size, [1280, 720]);
        assert_eq!(settings.raw.camera.fixed_exposure_us, Some(2000.0));
        for (keys, fault) in [
            ("frame_size = [1280]", "camera.frame_size"),
            ("frame_size = [1280, 0]", "camera.frame_size"),
            ("skip_frames = 101", "camera.skip_frames"),
            ("fixed_exposure_us = 0", "camera.fixed_exposure_us"),
        ] {
            assert_eq!(camera(keys).unwrap_err(), [fault]);
        }
    }

    #[test]
    fn defaults_of_file_and_code_agree() {
        let settings = Layers::default().load().unwrap();
        assert_eq!(settings.thresholds, crate::decode::Thresholds::default());
        assert_eq!(settings.raw.decode.row_gate_px, crate::cloud::DEFAULT_ROW_GATE_PX);
    }

    #[test]
    fn a_file_that_is_no_toml_names_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("rig.toml");
        std::fs::write(&path, "[scan]\nmode = \n").unwrap();
        let error = Layers { file: Some(path), overrides: Vec::new() }.load().unwrap_err();
        assert_eq!(error.faults.len(), 1);
        assert!(error.to_string().contains("line 2"), "{error}");
    }

    #[test]
    fn a_fault_of_a_variable_names_the_variable() {
        let error =
            Layers { file: None, overrides: variable("POLSCAN_SCAN__MODE", "loud") }.load().unwrap_err();
        assert!(error.to_string().contains("POLSCAN_SCAN__MODE"), "{error}");
    }

    #[test]
    fn a_missing_file_is_one_fault() {
        let error = Layers { file: Some("/nowhere/rig.toml".into()), overrides: Vec::new() }.load();
        assert_eq!(error.unwrap_err().faults.len(), 1);
    }
}
