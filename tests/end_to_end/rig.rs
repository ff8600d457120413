//! A quarter-size copy of `config/sim.toml` in a folder of its own, and the program run on it.

use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output},
};

use serde_json::Value;
use toml::Table;

/// A plate of metal that scatters nothing, and a white card beside it.
const COUPON: &str = r#"
[materials.mirror]
index = [0.96, 6.7]
roughness = 0.45

[materials.paper]
diffuse = 0.8

[[objects]]
name = "coupon"
material = "mirror"
level = 0.7
shape = { plane = { point_mm = [0.0, 0.0, 1000.0], normal = [0.05, 0.02, -1.0] } }

[[objects]]
name = "card"
material = "paper"
level = 0.5
shape = { plane = { point_mm = [0.0, 0.0, 980.0], normal = [0.05, 0.02, -1.0], x_mm = [60.0, 140.0], y_mm = [-80.0, 80.0] } }
"#;

/// A configuration that a test may change before it runs the program.
pub struct Rig {
    folder: tempfile::TempDir,
    config: Table,
}

impl Rig {
    /// The paper's rig, a quarter of its size.
    pub fn small() -> Self {
        Self::scaled(4.0)
    }

    /// The rig before [`COUPON`], a fifth of its size.
    pub fn coupon() -> Self {
        let rig = Self::scaled(5.0).set("sim.scene", "coupon.toml");
        fs::write(rig.path("coupon.toml"), COUPON).expect("the scene is written");
        rig
    }

    /// The paper's rig with sizes and focal lengths divided by `scale`: the same camera pixels see one projector pixel.
    pub fn scaled(scale: f64) -> Self {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("config");
        let folder = tempfile::tempdir().expect("a folder for the rig");
        let mut config = table(&root.join("sim.toml"));
        let mut calibration = table(&root.join("sim-calibration.toml"));
        for device in ["camera", "projector"] {
            shrink_description(at(&mut config, &["sim", device]), scale);
            shrink_lens(at(&mut calibration, &[device]), scale);
        }
        let text = toml::to_string(&calibration).expect("a table is TOML");
        fs::write(folder.path().join("sim-calibration.toml"), text).expect("the calibration is written");
        fs::create_dir(folder.path().join("scenes")).expect("a folder for scenes");
        for scene in fs::read_dir(root.join("scenes")).expect("the scenes") {
            let path = scene.expect("a scene").path();
            let name = path.file_name().expect("a scene has a name");
            fs::copy(&path, folder.path().join("scenes").join(name)).expect("the scene is copied");
        }
        Self { folder, config }
    }

    /// Sets a key such as `sim.camera.bits`.
    pub fn set(mut self, key: &str, value: impl Into<toml::Value>) -> Self {
        self.change(key, value);
        self
    }

    /// Sets a key of the configuration.
    pub fn change(&mut self, key: &str, value: impl Into<toml::Value>) {
        let (path, name) = key.rsplit_once('.').expect("a key has a table");
        let path: Vec<&str> = path.split('.').collect();
        at(&mut self.config, &path).insert(name.into(), value.into());
    }

    /// Leaves a table such as `sim` out.
    pub fn without(mut self, table: &str) -> Self {
        self.config.remove(table).expect("the table is there");
        self
    }

    /// Adds an entry to `[[sim.faults]]`, given as an inline table.
    pub fn fault(mut self, entry: &str) -> Self {
        let entry: Table =
            toml::from_str::<Table>(&format!("fault = {{ {entry} }}")).expect("an inline table");
        let sim = at(&mut self.config, &["sim"]);
        let faults = sim.entry("faults").or_insert_with(|| toml::Value::Array(Vec::new()));
        faults.as_array_mut().expect("a list of faults").push(entry["fault"].clone());
        self
    }

    /// A path in the rig's folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Writes the configuration as it is now, and says where.
    pub fn config(&self) -> PathBuf {
        let config = self.path("rig.toml");
        fs::write(&config, toml::to_string(&self.config).expect("a table is TOML"))
            .expect("the configuration");
        config
    }

    /// Runs `polscan scan` into the folder `out`.
    pub fn scan(&self, out: &str, arguments: &[&str]) -> Run {
        let config = self.config();
        let mut all = vec!["scan", "--config", text(&config), "--out"];
        let out = self.path(out);
        all.push(text(&out));
        all.extend(arguments);
        polscan(&all)
    }

    /// Runs `polscan decode` on the bundle in `bundle` into the folder `out`.
    pub fn decode(&self, bundle: &str, out: &str, arguments: &[&str]) -> Run {
        let (bundle, out) = (self.path(bundle), self.path(out));
        polscan(&[&["decode", text(&bundle), "--out", text(&out)], arguments].concat())
    }

    /// report.json of the result in `out`.
    pub fn report(&self, out: &str) -> Value {
        json(&self.path(out).join("report.json"))
    }

    /// Bytes of a file of the result in `out`.
    pub fn bytes(&self, out: &str, name: &str) -> Vec<u8> {
        fs::read(self.path(out).join(name)).unwrap_or_else(|error| panic!("{out}/{name}: {error}"))
    }
}

impl Rig {
    /// Width and values of an array of an archive of the result in `out`.
    pub fn map(&self, out: &str, archive: &str, name: &str) -> (usize, Vec<f32>) {
        let bytes = self.bytes(out, archive);
        let mut arrays = polscan::store::npz::read(std::io::Cursor::new(bytes)).expect("an archive");
        let grid = arrays.take_f32(name).expect("an array of the archive");
        (grid.width(), grid.data().to_vec())
    }
}

/// What a run of the program came to.
pub struct Run {
    /// Exit code.
    pub code: i32,
    /// What it printed.
    pub stdout: String,
    /// What it complained of.
    pub stderr: String,
}

impl Run {
    /// Panics with everything that was printed unless the program ended with `code`.
    pub fn expect(self, code: i32) -> Self {
        assert_eq!(self.code, code, "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        assert!(!self.stderr.contains("panicked"), "{}", self.stderr);
        self
    }
}

/// Runs the program.
pub fn polscan(arguments: &[&str]) -> Run {
    let mut command = Command::new(env!("CARGO_BIN_EXE_polscan"));
    run(command.args(arguments))
}

/// Runs a prepared command.
pub fn run(command: &mut Command) -> Run {
    let Output { status, stdout, stderr } = command.output().expect("polscan starts");
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("output is text");
    Run { code: status.code().unwrap_or(-1), stdout: text(stdout), stderr: text(stderr) }
}

/// A path as an argument.
pub fn text(path: &Path) -> &str {
    path.to_str().expect("a path of plain text")
}

/// A JSON file.
pub fn json(path: &Path) -> Value {
    let bytes = fs::read(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    serde_json::from_slice(&bytes).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

/// Slugs of a report's reasons.
pub fn reasons(report: &Value) -> Vec<&str> {
    let list = report["reasons"].as_array().expect("report.reasons is a list");
    list.iter().map(|reason| reason["type"].as_str().expect("a reason has a type")).collect()
}

fn table(path: &Path) -> Table {
    let text = fs::read_to_string(path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    toml::from_str(&text).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn at<'a>(table: &'a mut Table, path: &[&str]) -> &'a mut Table {
    path.iter().fold(table, |table, name| {
        let entry = table.entry(*name).or_insert_with(|| toml::Value::Table(Table::new()));
        entry.as_table_mut().expect("a table")
    })
}

fn shrink_size(table: &mut Table, scale: f64) {
    for side in table["size"].as_array_mut().expect("a size has two sides") {
        *side = ((side.as_integer().expect("a side in pixels") as f64 / scale) as i64).into();
    }
}

/// Pixel centres lie at integers, so that a coordinate shrinks about -1/2.
fn shrink_coordinate(value: &mut toml::Value, scale: f64) {
    let number = value.as_float().expect("a coordinate in pixels");
    *value = ((number + 0.5) / scale - 0.5).into();
}

fn shrink_description(device: &mut Table, scale: f64) {
    shrink_size(device, scale);
    let focal_px = device["focal_px"].as_float().expect("a focal length");
    device.insert("focal_px".into(), (focal_px / scale).into());
    if let Some(point) = device.get_mut("principal_point_px") {
        point.as_array_mut().expect("a point").iter_mut().for_each(|value| shrink_coordinate(value, scale));
    }
}

fn shrink_lens(lens: &mut Table, scale: f64) {
    shrink_size(lens, scale);
    let rows = lens["matrix"].as_array_mut().expect("a matrix has rows");
    for (index, row) in rows.iter_mut().take(2).enumerate() {
        let row = row.as_array_mut().expect("a row of a matrix");
        let focal_px = row[index].as_float().expect("a focal length");
        row[index] = (focal_px / scale).into();
        shrink_coordinate(&mut row[2], scale);
    }
}
