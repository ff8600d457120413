//! Acceptance of the simulated rig by artefacts whose truth is the scene's.

use std::fs;

use serde_json::Value;

use crate::rig::{Rig, polscan, text};

const MATERIAL: &str = "
[materials.aluminium]
index = [0.96, 6.7]
roughness = 0.45
diffuse = 0.1
texture = 0.15

[materials.blasted]
index = [0.96, 6.7]
roughness = 1.0
diffuse = 0.1
texture = 0.15
";

/// Two parallel planes, 15 mm apart along their normal (0.05, 0.02, -1) / 1.0014490.
const STEPS: &str = "
[[objects]]
name = \"bottom\"
material = \"aluminium\"
level = 0.9
shape = { plane = { point_mm = [0.0, 0.0, 1000.0], normal = [0.05, 0.02, -1.0] } }

[[objects]]
name = \"top\"
material = \"aluminium\"
level = 0.9
shape = { plane = { point_mm = [0.7489148, 0.2995659, 985.0217037], normal = [0.05, 0.02, -1.0], x_mm = [-150.0, -5.0], y_mm = [-120.0, 120.0] } }
";

const STEP_ARTEFACT: &str = "
name = \"gauge steps\"
plane = [
    { name = \"top\", region = [60, 100, 100, 100], bow_mm = 0.1 },
    { name = \"bottom\", region = [240, 100, 100, 100], bow_mm = 0.1 },
]
step = [{ name = \"15 mm\", upper = \"top\", lower = \"bottom\", height_mm = 15.0, tolerance_mm = 0.05 }]
";

const BALLS: &str = "
[[objects]]
name = \"wall\"
material = \"aluminium\"
level = 0.9
shape = { plane = { point_mm = [0.0, 0.0, 1040.0], normal = [0.0, 0.0, -1.0] } }

[[objects]]
name = \"left\"
material = \"blasted\"
level = 0.9
shape = { sphere = { centre_mm = [-60.0, 0.0, 970.0], radius_mm = 25.0 } }

[[objects]]
name = \"right\"
material = \"blasted\"
level = 0.9
shape = { sphere = { centre_mm = [60.0, 0.0, 970.0], radius_mm = 25.0 } }
";

const BALL_ARTEFACT: &str = "
name = \"ball bar\"
ball = [
    { name = \"left\", region = [198, 244, 112, 112], diameter_mm = 50.0, tolerance_mm = 0.3 },
    { name = \"right\", region = [488, 244, 112, 112], diameter_mm = 50.0, tolerance_mm = 0.3 },
]
distance = [{ name = \"bar\", between = [\"left\", \"right\"], distance_mm = 120.0, tolerance_mm = 0.1 }]
";

/// A rig before an artefact, its scan, and the same frames decoded as if the projector stood 1 % further away.
struct Bench {
    rig: Rig,
}

impl Bench {
    fn new(scale: f64, scene: &str, artefact: &str) -> Self {
        let rig = Rig::scaled(scale).set("sim.scene", "scenes/artefact.toml");
        fs::write(rig.path("scenes/artefact.toml"), format!("{MATERIAL}{scene}")).expect("the scene");
        fs::write(rig.path("artefact.toml"), artefact).expect("the artefact");
        rig.scan("right", &[]).expect(0);
        let file = rig.path("sim-calibration.toml");
        let mut wrong: toml::Table =
            fs::read_to_string(&file).expect("the calibration").parse().expect("a table");
        let pose = wrong["transform"].as_table_mut().expect("the pose");
        for component in pose["translation_mm"].as_array_mut().expect("three numbers") {
            *component = (1.01 * component.as_float().expect("a number")).into();
        }
        let path = rig.path("wrong.toml");
        fs::write(&path, toml::to_string(&wrong).expect("a table is TOML")).expect("a wrong calibration");
        rig.decode("right", "wrong", &["--calibration", text(&path)]).expect(0);
        Self { rig }
    }

    /// The answer to whether the rig of the result in `bundle` is accepted.
    fn verify(&self, bundle: &str, code: i32) -> Value {
        let path = |name: &str| self.rig.path(name);
        let run = polscan(&[
            "verify",
            "--json",
            "--artefact",
            text(&path("artefact.toml")),
            "--bundle",
            text(&path(bundle)),
            "--history",
            text(&path("history.jsonl")),
        ]);
        serde_json::from_str(&run.expect(code).stdout).expect("one object on stdout")
    }
}

fn checks(answer: &Value) -> impl Iterator<Item = f64> {
    let checks = answer["result"]["checks"].as_array().expect("checks");
    checks.iter().map(|check| check["measured_mm"].as_f64().expect("a length"))
}

fn failed(answer: &Value) -> Vec<&str> {
    let checks = answer["result"]["checks"].as_array().expect("checks");
    let failed = checks.iter().filter(|check| check["passed"] == false);
    failed.map(|check| check["name"].as_str().expect("a name")).collect()
}

#[test]
fn a_step_is_accepted_and_a_projector_that_moved_is_not() {
    let bench = Bench::new(4.0, STEPS, STEP_ARTEFACT);
    let right = bench.verify("right", 0);
    assert_eq!(failed(&right), Vec::<&str>::new(), "{right:#}");
    assert_eq!(right["earlier"].as_array().map(Vec::len), Some(0));
    let wrong = bench.verify("wrong", 1);
    assert_eq!(failed(&wrong), ["15 mm"], "{wrong:#}");
    assert_eq!(wrong["earlier"][0]["passed"], true, "{wrong:#}");
}

#[test]
fn balls_are_accepted_and_a_projector_that_moved_is_not() {
    let bench = Bench::new(2.0, BALLS, BALL_ARTEFACT);
    let right = bench.verify("right", 0);
    assert_eq!(failed(&right), Vec::<&str>::new(), "{right:#}");
    let wrong = bench.verify("wrong", 1);
    assert!(failed(&wrong).contains(&"bar"), "{wrong:#}");
    // In a world whose z points up, a metre below the camera, the same is measured.
    let rig = &bench.rig;
    let world = "\n[world]\nrotation = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]\ntranslation_mm = [0.0, 0.0, 1000.0]\n";
    let calibration = fs::read_to_string(rig.path("sim-calibration.toml")).expect("the calibration");
    fs::write(rig.path("world.toml"), calibration + world).expect("a calibration");
    rig.decode("right", "upright", &["--calibration", text(&rig.path("world.toml"))]).expect(0);
    let upright = bench.verify("upright", 0);
    for (check, same) in checks(&upright).zip(checks(&right)) {
        assert!((check - same).abs() < 1e-3, "{upright:#}");
    }
}

#[test]
fn a_scan_now_is_measured_and_remembered_in_the_store() {
    let rig = Rig::small().set("store.dir", "unused");
    let store = rig.path("store");
    let rig = rig.set("store.dir", text(&store));
    let artefact = STEP_ARTEFACT.replace("bow_mm = 0.1", "bow_mm = 5.0").replace(
        "step = [{ name = \"15 mm\", upper = \"top\", lower = \"bottom\", height_mm = 15.0, tolerance_mm = 0.05 }]",
        "",
    );
    fs::write(
        rig.path("artefact.toml"),
        artefact.replace("[60, 100,", "[20, 20,").replace("100, 100]", "60, 60]"),
    )
    .expect("the artefact");
    let (config, artefact, out) = (rig.config(), rig.path("artefact.toml"), rig.path("out"));
    let run =
        polscan(&["verify", "--artefact", text(&artefact), "--config", text(&config), "--out", text(&out)]);
    let run = run.expect(0);
    assert!(run.stdout.contains("top bow: "), "{}", run.stdout);
    assert!(out.join("cloud.ply").exists());
    let lines = fs::read_to_string(store.join("acceptance.jsonl")).expect("the history");
    assert_eq!(lines.lines().count(), 1);
}

#[test]
fn what_cannot_be_measured_is_refused_before_a_scan() {
    let rig = Rig::small();
    fs::write(rig.path("artefact.toml"), STEP_ARTEFACT.replace("\"bottom\", height", "\"floor\", height"))
        .expect("the artefact");
    let (artefact, out) = (rig.path("artefact.toml"), rig.path("out"));
    let run = polscan(&[
        "verify",
        "--artefact",
        text(&artefact),
        "--config",
        text(&rig.config()),
        "--out",
        text(&out),
    ]);
    let run = run.expect(65);
    assert!(run.stderr.contains("there is no plane `floor`"), "{}", run.stderr);
    assert!(!out.exists());
}
