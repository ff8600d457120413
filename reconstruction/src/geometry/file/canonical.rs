//! `calibration.toml`: reading with every fault named, and writing in one canonical form.

use std::fmt::Write;

use nalgebra::{Matrix3, Vector3};
use sha2::{Digest, Sha256};
use toml::{Table, Value};

use super::value::{Draft, side};
use crate::geometry::{Calibration, Lens, Pose, Quality};

const SCHEMA: &str = "polscan.calibration/1";

impl Calibration {
    /// The file in its canonical form: equal calibrations give equal bytes, and reading them gives the same numbers
    /// to the last bit.
    pub fn to_toml(&self) -> String {
        let mut out = format!("schema = \"{SCHEMA}\"\n");
        let mut line = |text: &str| {
            out.push_str(text);
            out.push('\n');
        };
        let mut lens = |name: &str, lens: &Lens| {
            line(&format!("\n[{name}]"));
            line(&format!("size = [{}, {}]", lens.width, lens.height));
            line(&format!("matrix = {}", matrix(&lens.matrix())));
            line(&format!("distortion = {}", list(&lens.distortion)));
        };
        lens("camera", &self.camera);
        if let Some(projector) = &self.projector {
            lens("projector", &projector.lens);
        }
        let poses = [
            ("transform", self.projector.map(|p| p.projector_from_camera)),
            ("world", self.world_from_camera),
        ];
        for (name, pose) in poses {
            if let Some(pose) = pose {
                line(&format!("\n[{name}]"));
                line(&format!("rotation = {}", matrix(&pose.rotation)));
                line(&format!("translation_mm = {}", list(pose.translation_mm.as_slice())));
            }
        }
        out.push_str(&quality(&self.quality));
        out
    }

    /// SHA-256 of the canonical form in hexadecimal: the identity of a calibration in bundles and reports.
    pub fn id(&self) -> String {
        Sha256::digest(self.to_toml().as_bytes()).iter().fold(String::with_capacity(64), |mut hex, byte| {
            // Writing to a string cannot fail.
            let _ = write!(hex, "{byte:02x}");
            hex
        })
    }
}

/// Shortest decimal that reads back as the same number.
fn float(value: f64) -> String {
    if value.is_nan() { "nan".to_owned() } else { format!("{value:?}") }
}

fn list(values: &[f64]) -> String {
    format!("[{}]", values.iter().map(|v| float(*v)).collect::<Vec<_>>().join(", "))
}

fn matrix(m: &Matrix3<f64>) -> String {
    let rows: Vec<String> = m.row_iter().map(|row| list(&[row[0], row[1], row[2]])).collect();
    format!("[{}]", rows.join(", "))
}

fn quality(quality: &Quality) -> String {
    let mut out = String::new();
    let mut entry = |key: &str, value: Option<String>| {
        if let Some(value) = value {
            if out.is_empty() {
                out.push_str("\n[quality]\n");
            }
            out.push_str(&format!("{key} = {value}\n"));
        }
    };
    let text = |t: &String| Value::String(t.clone()).to_string();
    entry("camera_rms_px", quality.camera_rms_px.map(float));
    entry("projector_rms_px", quality.projector_rms_px.map(float));
    entry("views", quality.views.map(|v| v.to_string()));
    entry("date", quality.date.as_ref().map(text));
    entry("method", quality.method.as_ref().map(text));
    out
}

/// Reads the file; all faults of its form and of its numbers at once.
pub(super) fn read(text: &str) -> Result<Calibration, Vec<String>> {
    let mut root: Table = text.parse().map_err(|error: toml::de::Error| {
        vec![error.to_string().split_whitespace().collect::<Vec<_>>().join(" ")]
    })?;
    let mut reader = Reader::default();
    match root.remove("schema") {
        Some(Value::String(schema)) if schema == SCHEMA => {}
        Some(other) => reader.fault(format!("schema is {other}, expected \"{SCHEMA}\"")),
        None => reader.fault(format!("schema is missing, expected \"{SCHEMA}\"")),
    }
    let given = |root: &Table, name: &str| root.contains_key(name);
    if !given(&root, "camera") {
        reader.fault("[camera] is missing".into());
    }
    match (given(&root, "projector"), given(&root, "transform")) {
        (true, false) => reader.fault("[transform] is missing: projector_from_camera of [projector]".into()),
        (false, true) => reader.fault("[projector] is missing, but [transform] is there".into()),
        _ => {}
    }
    reader.draft.camera = reader.section(&mut root, "camera").and_then(|table| reader.lens("camera", table));
    reader.draft.projector =
        reader.section(&mut root, "projector").and_then(|table| reader.lens("projector", table));
    reader.draft.projector_from_camera =
        reader.section(&mut root, "transform").and_then(|table| reader.pose("transform", table));
    reader.draft.world_from_camera =
        reader.section(&mut root, "world").and_then(|table| reader.pose("world", table));
    if let Some(table) = reader.section(&mut root, "quality") {
        reader.draft.quality = reader.quality(table);
    }
    reader.leftover("", &root);
    reader.draft.finish()
}

/// Takes keys out of tables and collects what is wrong with them.
#[derive(Default)]
struct Reader {
    draft: Draft,
}

impl Reader {
    fn fault(&mut self, fault: String) {
        self.draft.fault(fault);
    }

    fn section(&mut self, root: &mut Table, name: &str) -> Option<Table> {
        match root.remove(name)? {
            Value::Table(table) => Some(table),
            other => {
                self.fault(format!("{name} is a {}, expected a table", other.type_str()));
                None
            }
        }
    }

    fn leftover(&mut self, section: &str, table: &Table) {
        let dot = if section.is_empty() { "" } else { "." };
        for key in table.keys() {
            self.fault(format!("{section}{dot}{key} is not a known key"));
        }
    }

    /// Takes `rows` rows of `columns` numbers out; `rows` 0 means one plain list.
    fn numbers<const N: usize>(
        &mut self,
        section: &str,
        table: &mut Table,
        key: &str,
        rows: usize,
    ) -> Option<[f64; N]> {
        let Some(value) = table.remove(key) else {
            self.fault(format!("{section}.{key} is missing"));
            return None;
        };
        let shape = match N.checked_div(rows) {
            None => format!("{N} numbers"),
            Some(columns) => format!("{rows} rows of {columns} numbers"),
        };
        let list = |value: Value, len: usize| match value {
            Value::Array(items) if items.len() == len => Some(items),
            _ => None,
        };
        let flat: Option<Vec<Value>> = if rows == 0 {
            list(value, N)
        } else {
            list(value, rows).and_then(|items| {
                items
                    .into_iter()
                    .map(|row| list(row, N / rows))
                    .collect::<Option<Vec<_>>>()
                    .map(|r| r.concat())
            })
        };
        let numbers = flat.and_then(|items| {
            items
                .iter()
                .map(|item| match item {
                    Value::Float(v) => Some(*v),
                    Value::Integer(v) => Some(*v as f64),
                    _ => None,
                })
                .collect::<Option<Vec<f64>>>()
        });
        let numbers = numbers.and_then(|numbers| <[f64; N]>::try_from(numbers).ok());
        if numbers.is_none() {
            self.fault(format!("{section}.{key} is not {shape}"));
        }
        numbers
    }

    fn lens(&mut self, section: &str, mut table: Table) -> Option<Lens> {
        let size = self.numbers::<2>(section, &mut table, "size", 0);
        let matrix = self.numbers::<9>(section, &mut table, "matrix", 3);
        let distortion = self.numbers::<5>(section, &mut table, "distortion", 0);
        self.leftover(section, &table);
        let size = size.and_then(|[width, height]| {
            let size = side(width).zip(side(height));
            if size.is_none() {
                self.fault(format!(
                    "{section}.size is [{width}, {height}], expected two positive whole numbers"
                ));
            }
            size
        });
        let matrix = matrix.and_then(|m| {
            let form = m[1] == 0.0 && m[3] == 0.0 && m[6..] == [0.0, 0.0, 1.0];
            if !form {
                self.fault(format!(
                    "{section}.matrix is not of the form [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
                ));
            }
            form.then_some(m)
        });
        let ((width, height), m) = size.zip(matrix)?;
        Some(Lens { width, height, fx: m[0], fy: m[4], cx: m[2], cy: m[5], distortion: distortion? })
    }

    fn pose(&mut self, section: &str, mut table: Table) -> Option<Pose> {
        let rotation = self.numbers::<9>(section, &mut table, "rotation", 3);
        let translation = self.numbers::<3>(section, &mut table, "translation_mm", 0);
        self.leftover(section, &table);
        Some(Pose {
            rotation: Matrix3::from_row_slice(&rotation?),
            translation_mm: Vector3::from(translation?),
        })
    }

    fn quality(&mut self, mut table: Table) -> Quality {
        let quality = Quality {
            camera_rms_px: self.rms(&mut table, "camera_rms_px"),
            projector_rms_px: self.rms(&mut table, "projector_rms_px"),
            views: self.optional(&mut table, "views", "a whole number", |value| {
                value.as_integer().and_then(|v| u32::try_from(v).ok())
            }),
            date: self.optional(&mut table, "date", "a date or a text", |value| match value {
                Value::Datetime(date) => Some(date.to_string()),
                value => value.as_str().map(str::to_owned),
            }),
            method: self.optional(&mut table, "method", "a text", |value| value.as_str().map(str::to_owned)),
        };
        self.leftover("quality", &table);
        quality
    }

    fn rms(&mut self, table: &mut Table, key: &str) -> Option<f64> {
        self.optional(table, key, "a number from 0 on", |value| {
            let number = value.as_float().or_else(|| value.as_integer().map(|v| v as f64))?;
            (number.is_finite() && number >= 0.0).then_some(number)
        })
    }

    fn optional<T>(
        &mut self,
        table: &mut Table,
        key: &str,
        expected: &str,
        take: impl Fn(&Value) -> Option<T>,
    ) -> Option<T> {
        let value = table.remove(key)?;
        let taken = take(&value);
        if taken.is_none() {
            self.fault(format!("quality.{key} is {value}, expected {expected}"));
        }
        taken
    }
}
