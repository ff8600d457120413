//! From JSON to a manifest. Each key is read by itself, so that one fault does not hide the next.

use std::collections::BTreeMap;

use polscan_patterns::{ProjectorSize, Role};
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::{Camera, FrameFiles, Manifest, PerAxis, SCHEMA};
use crate::store::error::{Fault, Faults};

/// Most entries of a sequence: twice the longest sequence of the largest projector with every frame taken tenfold.
pub const MAX_FRAMES: usize = 1024;

/// A manifest and what was not understood of it.
#[derive(Debug, Clone, PartialEq)]
pub struct Parsed {
    /// The manifest.
    pub manifest: Manifest,
    /// Keys that this program does not know, as key paths. They are ignored, and the report should say so.
    pub unknown_keys: Vec<String>,
}

impl Manifest {
    /// Reads a manifest from JSON text. Only its form is checked; [`Manifest::check`] checks what it says.
    pub fn parse(bytes: &[u8]) -> Result<Parsed, Faults> {
        let value: Value = serde_json::from_slice(bytes)
            .map_err(|error| Faults(vec![Fault::new("", format!("is not JSON: {error}"))]))?;
        let Value::Object(map) = value else {
            return Err(Faults(vec![Fault::new("", "must be a JSON object")]));
        };
        let mut reader = Reader { map, prefix: String::new(), faults: Vec::new(), unknown: Vec::new() };
        // Keys of another schema mean something else, so nothing more is said about them.
        if let Err(fault) = reader.schema() {
            return Err(Faults(vec![fault]));
        }
        let manifest = reader.manifest();
        reader.leftovers();
        if reader.faults.is_empty() {
            Ok(Parsed { manifest, unknown_keys: reader.unknown })
        } else {
            Err(Faults(reader.faults))
        }
    }
}

/// One JSON object whose keys are taken out one by one.
struct Reader {
    map: Map<String, Value>,
    prefix: String,
    faults: Vec<Fault>,
    unknown: Vec<String>,
}

impl Reader {
    fn schema(&mut self) -> Result<(), Fault> {
        let Some(value) = self.map.remove("schema") else {
            return Err(Fault::new("schema", format!("is missing: give \"{SCHEMA}\"")));
        };
        if value == SCHEMA {
            return Ok(());
        }
        let newer = value
            .as_str()
            .and_then(|text| text.strip_prefix("polscan.bundle/"))
            .and_then(|version| version.parse::<u32>().ok())
            .is_some_and(|version| version > 1);
        Err(match newer {
            true => Fault::new(
                "schema",
                format!("{value} is newer than this program, which reads {SCHEMA}: update polscan"),
            ),
            false => Fault::new("schema", format!("is {value}, expected \"{SCHEMA}\"")),
        })
    }

    fn manifest(&mut self) -> Manifest {
        let frames = self.take("frames");
        if frames.is_none() && !self.faults.iter().any(|fault| fault.key == "frames") {
            self.fault("frames", "is missing: give a list of image paths or the name of one .npy".to_owned());
        }
        Manifest {
            schema: SCHEMA.to_owned(),
            id: self.take("id"),
            label: self.take("label"),
            tags: self.take("tags").unwrap_or_default(),
            mode: self.take("mode"),
            created: self.take("created"),
            software: self.take("software"),
            rig: self.take("rig"),
            settings: self.take("settings"),
            projector: self.projector(),
            code_offset: self.per_axis("code_offset"),
            code_bits: self.per_axis("code_bits"),
            sequence: self.sequence(),
            frames: frames.unwrap_or(FrameFiles::Images(Vec::new())),
            camera: self.camera(),
            calibration: self.take("calibration"),
            processing: self.take("processing"),
            capture: self.take("capture"),
            source: self.take("source"),
            truth_objects: self.take("truth_objects"),
            files: self.take::<BTreeMap<_, _>>("files").unwrap_or_default(),
        }
    }

    fn fault(&mut self, key: &str, message: String) {
        self.faults.push(Fault { key: format!("{}{key}", self.prefix), message });
    }

    /// Takes `key` out; null counts as absent.
    fn take<T: DeserializeOwned>(&mut self, key: &str) -> Option<T> {
        match self.map.remove(key)? {
            Value::Null => None,
            value => {
                serde_json::from_value(value).map_err(|error| self.fault(key, explain(key, &error))).ok()
            }
        }
    }

    /// Takes the object `key` out, whose keys are then read by themselves with `read`.
    fn nested<T>(&mut self, key: &str, read: impl FnOnce(&mut Reader) -> T) -> Option<T> {
        let map = match self.map.remove(key)? {
            Value::Null => return None,
            Value::Object(map) => map,
            other => {
                self.fault(key, format!("must be an object, is {other}"));
                return None;
            }
        };
        let prefix = format!("{}{key}.", self.prefix);
        let mut inner = Reader { map, prefix, faults: Vec::new(), unknown: Vec::new() };
        let value = read(&mut inner);
        inner.leftovers();
        self.faults.append(&mut inner.faults);
        self.unknown.append(&mut inner.unknown);
        Some(value)
    }

    fn projector(&mut self) -> Option<ProjectorSize> {
        self.nested("projector", |reader| {
            let sides = ["width", "height"].map(|side| {
                let known = reader.map.contains_key(side);
                let value = reader.take(side);
                if !known {
                    reader.fault(side, "is missing: give the projector's size in pixels".to_owned());
                }
                value
            });
            Some(ProjectorSize { width: sides[0]?, height: sides[1]? })
        })
        .flatten()
    }

    fn per_axis<T: DeserializeOwned + Default>(&mut self, key: &str) -> PerAxis<T> {
        self.nested(key, |reader| PerAxis { column: reader.take("column"), row: reader.take("row") })
            .unwrap_or_default()
    }

    fn camera(&mut self) -> Option<Camera> {
        self.nested("camera", |reader| Camera {
            width: reader.take("width"),
            height: reader.take("height"),
            bit_depth: reader.take("bit_depth"),
            black_level: reader.take("black_level"),
            saturation: reader.saturation(),
            gain_dn_per_electron: reader.take("gain_dn_per_electron"),
            read_noise_dn: reader.take("read_noise_dn"),
        })
    }

    /// Many programs write every number as a float, so 4095.0 is as good as 4095.
    fn saturation(&mut self) -> Option<u16> {
        let value: f64 = self.take("saturation")?;
        if value.fract() == 0.0 && (1.0..=65_535.0).contains(&value) {
            return Some(value as u16);
        }
        self.fault("saturation", format!("is {value}, expected a whole number of DN from 1 to 65535"));
        None
    }

    fn sequence(&mut self) -> Vec<Role> {
        let entries: Vec<Value> = match self.map.remove("sequence") {
            None | Some(Value::Null) => {
                self.fault("sequence", "is missing: say in order what each frame shows".to_owned());
                return Vec::new();
            }
            Some(Value::Array(entries)) => entries,
            Some(other) => {
                self.fault("sequence", format!("must be a list, is {}", kind(&other)));
                return Vec::new();
            }
        };
        if entries.len() > MAX_FRAMES {
            self.fault("sequence", format!("has {} entries, at most {MAX_FRAMES} are read", entries.len()));
            return Vec::new();
        }
        let mut roles = Vec::with_capacity(entries.len());
        for (index, entry) in entries.into_iter().enumerate() {
            match role(entry) {
                Ok(role) => roles.push(role),
                Err(message) => self.fault(&format!("sequence[{index}]"), message),
            }
        }
        roles
    }

    /// Notes the keys that nobody took.
    fn leftovers(&mut self) {
        let keys = std::mem::take(&mut self.map);
        self.unknown.extend(keys.iter().map(|(key, _)| format!("{}{key}", self.prefix)));
    }
}

/// One entry of the sequence. Unlike elsewhere, a key too many is a fault: a misspelt `inverse` would exchange light
/// and dark without a word.
fn role(entry: Value) -> Result<Role, String> {
    let Value::Object(map) = &entry else {
        return Err(format!("must be an object with `role`, is {}", kind(&entry)));
    };
    let is_code = map.get("role").is_some_and(|role| role == "code");
    let known: &[&str] = if is_code { &["role", "axis", "bit", "inverse"] } else { &["role"] };
    if let Some(key) = map.keys().find(|key| !known.contains(&key.as_str())) {
        return Err(format!("has the unknown key `{key}`, expected {}", known.join(", ")));
    }
    serde_json::from_value(entry).map_err(|error| error.to_string())
}

fn explain(key: &str, error: &serde_json::Error) -> String {
    match key {
        "frames" => "must be a list of image paths or the name of one .npy".to_owned(),
        _ => error.to_string(),
    }
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "a boolean",
        Value::Number(_) => "a number",
        Value::String(_) => "a string",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}
