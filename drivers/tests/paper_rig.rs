//! The configurations that come with the scanner.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod common;

use common::{Bench, H, V, config_text, mean, paper_rig, scene};
use polscan_drivers::{
    clock::VirtualClock,
    projector::Slide,
    sim::{Rig, RigDescription, RigError, Scene, Truth},
};
use std::sync::Arc;

const SCENES: [&str; 5] = ["plates", "sphere-on-plaster", "v-groove", "wedge", "empty"];

fn scene_file(name: &str) -> Scene {
    scene(&config_text(&format!("scenes/{name}.toml")))
}

/// The paper's rig with fewer, larger camera pixels.
fn coarse(factor: u32) -> RigDescription {
    let mut rig = paper_rig();
    rig.camera.size = rig.camera.size.map(|side| side / factor);
    rig.camera.focal_px /= f64::from(factor);
    rig
}

/// Numbers of pixels: of an object, and lit of these.
fn count(truth: &Truth, object: u8) -> (usize, usize) {
    let of = |index: &usize| truth.object[*index] == object;
    let pixels: Vec<usize> = (0..truth.object.len()).filter(of).collect();
    (pixels.len(), pixels.iter().filter(|&&index| truth.column[index].is_finite()).count())
}

#[test]
fn all_scenes_are_valid_and_lit() {
    let rig = coarse(8);
    assert_eq!(rig.validate(), Vec::<String>::new());
    for name in SCENES {
        let scene = scene_file(name);
        assert_eq!(scene.validate(), Vec::<String>::new(), "{name}");
        let truth = Rig::new(&rig, &scene, Arc::new(VirtualClock::default())).unwrap().truth();
        for number in 0..truth.objects.len() {
            let (seen, lit) = count(&truth, number as u8);
            assert!(seen > 300 && lit * 10 > seen * 7, "{name}: {number}: {lit} of {seen}");
        }
    }
}

#[test]
fn the_plates_are_where_the_paper_has_them() {
    let mut bench = Bench::new(&coarse(4), &scene_file("plates"));
    let truth = bench.truth();
    let names: Vec<&str> = truth.objects.iter().map(|object| object.name.as_str()).collect();
    assert_eq!(names, ["white", "black"]);
    assert!(truth.objects.iter().all(|object| object.planar));
    let total = truth.width * truth.height;
    let ((white, white_lit), (black, black_lit)) = (count(&truth, 0), count(&truth, 1));
    assert_eq!(white + black, total);
    assert!((0.18..0.30).contains(&(black as f64 / total as f64)), "{black}");
    assert_eq!(black, black_lit);
    // The black plate casts a narrow shadow on the white one.
    let shadow = 1.0 - white_lit as f64 / white as f64;
    assert!((0.001..0.03).contains(&shadow), "{shadow}");
    for (object, point, normal) in [(0, 1000.0, [0.05, 0.02, -1.0]), (1, 965.0, [-0.12, 0.03, -1.0])] {
        for index in (0..total).filter(|&index| truth.object[index] == object).step_by(101) {
            // Rays of a lens without distortion are off by less than 0.3 mm sideways, 0.05 mm in depth.
            let z = f64::from(truth.depth_mm[index]);
            let x = ((index % truth.width) as f64 - 199.5) / 1159.5 * z;
            let y = ((index / truth.width) as f64 - 149.5) / 1159.5 * z;
            let off: f64 = normal[0] * x + normal[1] * y + normal[2] * (z - point);
            assert!(off.abs() < 0.1, "{off}");
        }
    }
    // One column is about 12 mm of depth: the plates differ by some columns.
    let h = bench.electrons(Slide::Uniform(H));
    let v = bench.electrons(Slide::Uniform(V));
    let lit = |number: u8, seen: &[f64]| {
        mean(
            (0..total).filter(|&i| truth.object[i] == number && truth.column[i].is_finite()).map(|i| seen[i]),
        )
    };
    let brightest = h.iter().copied().fold(0.0, f64::max);
    assert!(brightest > 0.89 * 10_500.0 && brightest < 0.96 * 10_500.0, "{brightest}");
    let (white, black) = (lit(0, &h) - 20.0, lit(1, &h) - 20.0);
    assert!(white > 0.6 * 10_500.0, "{white}");
    assert!((0.02..0.045).contains(&(black / white)), "{}", black / white);
    for number in [0, 1] {
        let contrast = (lit(number, &h) - lit(number, &v)) / (lit(number, &h) + lit(number, &v) - 40.0);
        assert!((0.7..0.98).contains(&contrast), "{number}: {contrast}");
    }
}

#[test]
fn an_empty_scene_has_ambient_light_only_and_no_truth() {
    let mut bench = Bench::new(&coarse(8), &scene_file("empty"));
    let electrons = bench.electrons(Slide::Uniform(H));
    assert!((mean(electrons) - 20.0).abs() < 0.5);
    let truth = bench.truth();
    assert!(truth.objects.is_empty() && truth.object.iter().all(|&object| object == 255));
    assert!(truth.column.iter().chain(&truth.row).chain(&truth.depth_mm).all(|value| value.is_nan()));
}

#[test]
fn the_wedge_falls_over_four_decades() {
    let mut rig = coarse(4);
    rig.ambient.electrons = 0.0;
    let mut bench = Bench::new(&rig, &scene_file("wedge"));
    let truth = bench.truth();
    assert_eq!(truth.objects.len(), 17);
    let mut sums = vec![0.0; truth.object.len()];
    for _ in 0..4 {
        bench.electrons(Slide::Uniform(H)).iter().zip(&mut sums).for_each(|(e, sum)| *sum += e / 4.0);
    }
    // Strip edges are blurred, so compare the middle of strips, below the level at which rounding counts.
    let level = |number: u8| {
        let columns: Vec<usize> =
            (0..truth.width).filter(|&x| truth.object[150 * truth.width + x] == number).collect();
        let inner = &columns[columns.len() / 2 - 2..columns.len() / 2 + 2];
        mean(
            (50..250).flat_map(|y| inner.iter().map(move |x| (x, y))).map(|(x, y)| sums[y * truth.width + x]),
        )
    };
    let reference = level(0);
    for number in 1..=12u8 {
        let decades = (reference / level(number)).log10();
        // The lobe changes the level a little from strip to strip.
        assert!((decades - 0.25 * f64::from(number)).abs() < 0.12, "{number}: {decades}");
    }
}

#[test]
fn all_faults_are_named_at_once() {
    let text = config_text("sim.toml");
    let table: toml::Table = text.parse().unwrap();
    let mut rig: RigDescription = table["sim"].clone().try_into().unwrap();
    rig.camera.focal_px = 0.0;
    rig.camera.bits = 11;
    rig.projector.extinction[1] = 0.5;
    rig.projector.refresh_hz = f64::NAN;
    rig.pose.aim_mm = None;
    rig.analyser.as_mut().unwrap().extinction = 0.0;
    let faults = rig.validate();
    let keys: Vec<&str> = faults.iter().map(|fault| fault.split(':').next().unwrap()).collect();
    assert_eq!(
        keys,
        [
            "sim.camera.focal_px",
            "sim.camera.bits",
            "sim.projector.extinction[1]",
            "sim.projector.refresh_hz",
            "sim.pose",
            "sim.analyser.extinction"
        ]
    );
    let error = Rig::new(&rig, &scene_file("empty"), Arc::new(VirtualClock::default())).unwrap_err();
    assert_eq!(error, RigError::Description(faults));
    // Unknown keys are refused by the parser.
    let unknown = text.replace("seed = 1", "sede = 1").parse::<toml::Table>().unwrap();
    assert!(unknown["sim"].clone().try_into::<RigDescription>().is_err());

    let mut plates = scene_file("plates");
    plates.objects[0].material = "gold".to_owned();
    plates.objects[1].level_of = Some("grey".to_owned());
    plates.objects[1].name = "white".to_owned();
    plates.materials.get_mut("aluminium").unwrap().roughness = 0.0;
    let keys: Vec<String> =
        plates.validate().iter().map(|fault| fault.split(':').next().unwrap().to_owned()).collect();
    assert_eq!(
        keys,
        ["materials.aluminium.roughness", "objects[0].material", "objects[1].name", "objects[1].level_of"]
    );
}

#[test]
fn objects_that_cannot_be_lit_and_lenses_that_fold_are_refused() {
    let clock: Arc<dyn polscan_drivers::clock::Clock> = Arc::new(VirtualClock::default());
    let behind = scene(&common::METAL.replace("1000.0]", "-1000.0]"));
    let error = Rig::new(&coarse(8), &behind, clock.clone()).unwrap_err();
    assert_eq!(error, RigError::Dark { object: "plate".to_owned() });
    let mut folding = coarse(8);
    folding.camera.k1 = -30.0;
    folding.camera.k2 = 0.0;
    let error = Rig::new(&folding, &scene_file("empty"), clock).unwrap_err();
    assert_eq!(error, RigError::Lens { which: "camera" });
}
