//! The simulated rig against physics: what is on its frames, seen only through its camera.

#![allow(clippy::unwrap_used, reason = "helpers of tests are tests")]

mod common;

use std::time::Duration;

use common::{BLACK, Bench, H, METAL, V, WHITE, after, clean_rig, mean, paper_rig, region, samples, scene};
use polscan_drivers::{
    camera::PixelFormat,
    projector::Slide,
    sim::{FlickerDescription, PanelPolarization, Scene},
};

/// Mean over a few pixels in the middle of 200 x 150.
fn middle(values: &[f64]) -> f64 {
    mean((70..80).flat_map(|y| (95..105).map(move |x| values[y * 200 + x])))
}

fn seen(bench: &mut Bench, slide: Slide) -> f64 {
    // Many electrons, so that shot noise does not matter: its mean is taken over 100 pixels and 8 frames.
    let frames: Vec<f64> = (0..8).map(|_| middle(&bench.electrons(slide.clone()))).collect();
    mean(frames)
}

#[test]
fn malus_law_holds_for_a_turned_analyser() {
    for degrees in [0.0, 20.0, 45.0, 60.0, 75.0] {
        let mut rig = clean_rig();
        rig.analyser.as_mut().unwrap().azimuth_error_deg = degrees;
        rig.projector.response = [0.5, 1.0, 0.5];
        // Dim, so that V stays below the full well when the analyser is turned towards it.
        let mut bench = Bench::new(&rig, &scene(&METAL.replace("level = 0.5", "level = 0.05")));
        // The level pins H, so only ratios mean something.
        let ratio = seen(&mut bench, Slide::Uniform(V)) / seen(&mut bench, Slide::Uniform(H));
        let tan_sq = f64::to_radians(degrees).tan().powi(2);
        assert!((ratio - tan_sq).abs() < 0.02 * (tan_sq + 0.05), "{degrees}: {ratio} for {tan_sq}");
    }
}

#[test]
fn aluminium_shows_the_extinction_of_panel_and_analyser() {
    for (panel, analyser) in [(50.0, 500.0), (10.0, 500.0), (1e9, 20.0)] {
        let mut rig = clean_rig();
        rig.projector.extinction = [panel; 3];
        rig.projector.response = [0.5, 1.0, 0.5];
        rig.analyser.as_mut().unwrap().extinction = analyser;
        let mut bench = Bench::new(&rig, &scene(METAL));
        let ratio = seen(&mut bench, Slide::Uniform(H)) / seen(&mut bench, Slide::Uniform(V));
        let (x, a) = (1.0 / panel, 1.0 / analyser);
        // Both polarizers leak: (x along + 1 across a) over (1 along + x across a), seen at 1.5 degrees incidence.
        let expected = (1.0 + x * a) / (x + a);
        assert!((ratio / expected - 1.0).abs() < 0.02, "{panel} {analyser}: {ratio} for {expected}");
    }
}

#[test]
fn a_depolariser_gives_half_and_half_and_shows_the_response_of_the_sensor() {
    let mut rig = clean_rig();
    rig.projector.response = [0.6, 1.0, 0.7];
    let plaster =
        scene(&METAL.replace("index = [0.96, 6.7]", "diffuse = 0.8").replace("level = 0.5", "level = 0.3"));
    let mut bench = Bench::new(&rig, &plaster);
    let (h, v) = (seen(&mut bench, Slide::Uniform(H)), seen(&mut bench, Slide::Uniform(V)));
    // V brighter than H although the analyser blocks it on metal: the sign of the contrast is the sensor's.
    assert!((v / h - 1.3).abs() < 0.01, "{}", v / h);
    let white = seen(&mut bench, Slide::Uniform(WHITE));
    assert!((white / (h + v) - 1.0).abs() < 0.01);

    let level = |analyser: bool| {
        let mut rig = clean_rig();
        // Unpolarized light on a depolariser; the metal beside it keeps the scale.
        rig.projector.polarization = [PanelPolarization::None; 3];
        if !analyser {
            rig.analyser = None;
        }
        let mut bench = Bench::new(&rig, &plaster);
        seen(&mut bench, Slide::Uniform(H))
    };
    // The level is met with and without the analyser.
    assert!((level(true) / level(false) - 1.0).abs() < 0.01);
}

#[test]
fn levels_are_shares_of_the_full_well() {
    let text = METAL.to_owned()
        + r#"
        [[objects]]
        name = "dim"
        material = "aluminium"
        level = 0.1
        level_of = "plate"
        shape = { plane = { point_mm = [0.0, 0.0, 950.0], normal = [0.0, 0.0, -1.0], x_mm = [-60.0, 60.0], y_mm = [-40.0, 40.0] } }
        "#;
    let mut bench = Bench::new(&clean_rig(), &scene(&text));
    let mut sums = vec![0.0; 200 * 150];
    for _ in 0..40 {
        let electrons = bench.electrons(Slide::Uniform(H));
        sums.iter_mut().zip(electrons).for_each(|(sum, electrons)| *sum += electrons / 40.0);
    }
    let truth = bench.truth();
    let brightest = |number: u8| {
        sums.iter()
            .zip(&truth.object)
            .filter(|(_, object)| **object == number)
            .fold(0.0f64, |m, (e, _)| m.max(*e))
    };
    // The brightest of thousands of noisy means lies some sigma above the mean's brightest.
    let sigma = |level: f64| (level / 40.0).sqrt();
    for (number, level) in [(0, 5250.0), (1, 525.0)] {
        let above = brightest(number) - level;
        assert!(above > -3.0 * sigma(level) && above < 5.5 * sigma(level), "{number}: {above}");
    }
}

#[test]
fn photon_transfer_has_slope_k_and_the_read_noise_as_offset() {
    let mut rig = clean_rig();
    rig.camera.read_noise_e = 2.3;
    rig.camera.bits = 12;
    rig.camera.black_level_share = 0.01;
    let mut bench = Bench::new(&rig, &scene(METAL));
    bench.settings.format = PixelFormat::Mono12;
    let applied = bench.camera.apply(&bench.settings).unwrap();
    let (black, noise) = (applied.black_level_dn.unwrap(), applied.noise.unwrap());
    assert!((noise.gain_dn_per_electron - (4095.0 - 40.95) / 10_500.0).abs() < 1e-12);
    let mut points = vec![];
    for exposure_us in [1.0, 100.0, 400.0, 1000.0, 2000.0, 3500.0] {
        bench.settings.exposure_us = exposure_us;
        let frames = bench.settled_frames(Slide::Uniform(H), 12);
        let frames: Vec<Vec<u16>> = frames.iter().map(samples).collect();
        let mut differences = vec![];
        let mut level = vec![];
        for pair in frames.chunks(2) {
            for (a, b) in pair[0].iter().zip(&pair[1]) {
                differences.push((f64::from(*a) - f64::from(*b)).powi(2) / 2.0);
                level.push(f64::from(*a) - black);
            }
        }
        points.push((mean(level), mean(differences)));
    }
    for &(level, variance) in &points {
        let expected = noise.read_noise_dn.powi(2) + noise.gain_dn_per_electron * level + 1.0 / 12.0;
        // 180 000 differences: 0.33 % standard error.
        assert!((variance / expected - 1.0).abs() < 0.015, "{level}: {variance} for {expected}");
    }
    let (first, last) = (points[0], points[points.len() - 1]);
    let slope = (last.1 - first.1) / (last.0 - first.0);
    assert!((slope / noise.gain_dn_per_electron - 1.0).abs() < 0.015, "{slope}");
}

#[test]
fn light_scales_with_exposure_gain_and_drive() {
    let mut rig = clean_rig();
    rig.ambient.electrons = 100.0;
    let mut bench = Bench::new(&rig, &scene(METAL));
    let two = seen(&mut bench, Slide::Uniform(H));
    let dark = seen(&mut bench, Slide::Uniform(BLACK));
    assert!((dark - 100.0).abs() < 2.0, "{dark}");
    bench.settings.exposure_us = 1000.0;
    let one = seen(&mut bench, Slide::Uniform(H));
    assert!((one / two - 0.5).abs() < 0.003);
    bench.settings.gain_db = 20.0 * 1.5f64.log10();
    let applied = bench.camera.apply(&bench.settings).unwrap();
    assert!((applied.noise.unwrap().gain_dn_per_electron - 1.5 * 65_535.0 / 10_500.0).abs() < 1e-9);
    // Electrons are per the reported gain, so they stay.
    assert!((seen(&mut bench, Slide::Uniform(H)) / one - 1.0).abs() < 0.003);
    bench.settings.gain_db = 0.0;
    bench.settings.exposure_us = 2000.0;
    let half = seen(&mut bench, Slide::Uniform([0, 128, 0]));
    let expected = (128.0f64 / 255.0).powf(2.2);
    assert!(((half - 100.0) / (two - 100.0) - expected).abs() < 0.003);
}

#[test]
fn a_pair_adds_up_to_the_references() {
    // Light is linear: column stripes and their inverse sum up to uniform H and V.
    let mut rig = clean_rig();
    rig.projector.black_leak = 0.003;
    rig.projector.extinction = [50.0; 3];
    rig.projector.blur_px = 0.6;
    rig.camera.blur_px = 0.6;
    rig.ambient.electrons = 20.0;
    let stripes =
        |high, low| Slide::Columns((0..128).map(|u| if u / 4 % 2 == 0 { high } else { low }).collect());
    let mut bench = Bench::new(&rig, &scene(METAL));
    let sum = |bench: &mut Bench, a: Slide, b: Slide| -> Vec<f64> {
        let (a, b) = (bench.electrons(a), bench.electrons(b));
        a.iter().zip(&b).map(|(a, b)| a + b).collect()
    };
    let pair = sum(&mut bench, stripes(H, V), stripes(V, H));
    let references = sum(&mut bench, Slide::Uniform(H), Slide::Uniform(V));
    let residual: Vec<f64> = pair
        .iter()
        .zip(&references)
        .map(|(pair, reference)| (pair - reference) / (pair.abs() + reference.abs()).sqrt())
        .collect();
    let variance = mean(residual.iter().map(|r| r * r));
    assert!((variance - 1.0).abs() < 0.03 && mean(residual).abs() < 0.02, "{variance}");
}

#[test]
fn saturation_and_formats_clip() {
    let mut rig = clean_rig();
    rig.camera.bits = 12;
    rig.camera.black_level_share = 0.01;
    let bright = scene(&METAL.replace("level = 0.5", "level = 3.0"));
    let mut bench = Bench::new(&rig, &bright);
    for (format, most) in
        [(PixelFormat::Mono8, 255), (PixelFormat::Mono10, 1023), (PixelFormat::Mono12, 4095)]
    {
        bench.settings.format = format;
        let applied = bench.camera.apply(&bench.settings).unwrap();
        assert_eq!(applied.saturation_dn, most);
        let frame = bench.settled(Slide::Uniform(H));
        assert_eq!(frame.bit_depth, format.bit_depth());
        let highest = samples(&frame).into_iter().max().unwrap();
        assert_eq!(highest, most);
        let dark = mean(samples(&bench.settled(Slide::Uniform(BLACK))).into_iter().map(f64::from));
        assert!((dark - applied.black_level_dn.unwrap()).abs() < 0.51, "{dark}");
    }
}

#[test]
fn the_response_has_the_gamma_of_the_description() {
    let mut rig = clean_rig();
    rig.camera.gamma = 0.5;
    let mut bench = Bench::new(&rig, &scene(METAL));
    let level = mean(samples(&bench.settled(Slide::Uniform(H))).into_iter().map(f64::from)) / 65_535.0;
    bench.settings.exposure_us = 500.0;
    let quarter = mean(samples(&bench.settled(Slide::Uniform(H))).into_iter().map(f64::from)) / 65_535.0;
    assert!((quarter / level - 0.5).abs() < 0.005, "{}", quarter / level);
    assert!(bench.camera.apply(&bench.settings).unwrap().noise.is_none());
}

#[test]
fn regions_are_crops() {
    let mut rig = paper_rig();
    rig.camera.size = [160, 120];
    rig.camera.focal_px = 463.8;
    let plates: Scene = scene(&common::config_text("scenes/plates.toml"));
    let stripes = Slide::Columns((0..1024).map(|u| if u / 16 % 2 == 0 { H } else { V }).collect());
    let mut whole = Bench::new(&rig, &plates);
    let whole_frame = whole.settled(stripes.clone());
    let mut cropped = Bench::new(&rig, &plates);
    cropped.settings.region = Some(region(31, 17, 64, 50));
    let cropped_frame = cropped.settled(stripes);
    assert_eq!((cropped_frame.width, cropped_frame.height), (64, 50));
    let (a, b) = (samples(&whole_frame), samples(&cropped_frame));
    let (truth, part) = (whole.truth(), cropped.truth());
    assert_eq!((part.width, part.height), (64, 50));
    for y in 0..50 {
        for x in 0..64 {
            let (from, to) = ((y + 17) * 160 + x + 31, y * 64 + x);
            assert_eq!(b[to], a[from]);
            assert_eq!(part.column[to].to_bits(), truth.column[from].to_bits());
            assert_eq!(part.object[to], truth.object[from]);
        }
    }
}

#[test]
fn liquid_crystals_lag_and_the_lamp_flickers() {
    let mut rig = clean_rig();
    rig.projector.lcd_10_90_ms = 6.0;
    rig.projector.latency_refreshes = 2;
    rig.flicker = Some(FlickerDescription { share: 0.2, hz: 100.0 });
    let mut bench = Bench::new(&rig, &scene(METAL));
    let period = bench.projector.info().refresh_period;
    bench.projector.load(&[Slide::Uniform(H), Slide::Uniform(BLACK)]).unwrap();
    bench.camera.apply(&bench.settings).unwrap();
    bench.camera.arm(0).unwrap();
    let full = 5250.0;
    let tau = 6e-3 / 9f64.ln();
    for delay_ms in [-5.0, -1.0, 0.5, 3.0, 10.0, 30.0] {
        bench.projector.show(0).unwrap();
        bench.clock.sleep_until(after(bench.clock.now(), 500.0));
        let shown = bench.projector.show(1).unwrap();
        let light = shown.flipped + 2 * period;
        let start = after(light, 0.0).0 as f64 + 1e6 * delay_ms;
        let at = polscan_drivers::clock::Timestamp(start as u64);
        assert_eq!(bench.camera.trigger(at).unwrap(), at);
        let frame = bench.camera.next_frame(Duration::from_secs(1)).unwrap();
        let seen = samples(&frame).into_iter().map(f64::from).fold(0.0, f64::max) * 10_500.0 / 65_535.0;
        // The integral by small steps, independent of the closed form.
        let steps = 20_000;
        let expected = full
            * mean((0..steps).map(|step| {
                let t = 2e-3 * (f64::from(step) + 0.5) / f64::from(steps);
                let since = 1e-3 * delay_ms + t;
                let drive = if since < 0.0 { 1.0 } else { (-since / tau).exp() };
                drive * (1.0 + 0.2 * (std::f64::consts::TAU * 100.0 * (at.seconds() + t)).sin())
            }));
        // The brightest of 30 000 pixels: about 4 sigma of shot noise above the brightest mean.
        let sigma = expected.max(0.01).sqrt();
        assert!(
            seen < expected + 6.0 * sigma + 3.0 && seen > expected - sigma - 1.0,
            "{delay_ms}: {seen} {expected}"
        );
    }
}

#[test]
fn noise_repeats_on_a_fresh_rig_and_differs_between_takes() {
    let mut rig = clean_rig();
    rig.camera.read_noise_e = 2.0;
    let take = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut bench = Bench::new(&rig, &scene(METAL));
            bench.settled_frames(Slide::Uniform(H), 2).iter().map(samples).collect::<Vec<_>>()
        })
    };
    let (one, three) = (take(1), take(3));
    assert_eq!(one, three);
    assert_ne!(one[0], one[1]);
    rig.seed = 2;
    let mut bench = Bench::new(&rig, &scene(METAL));
    assert_ne!(samples(&bench.settled(Slide::Uniform(H))), one[0]);
}

#[test]
fn sensor_patterns_stay_while_noise_goes() {
    let mut rig = clean_rig();
    rig.camera.prnu_share = 0.02;
    rig.camera.dsnu_e = 30.0;
    rig.camera.black_level_share = 0.05;
    let mut bench = Bench::new(&rig, &scene(METAL));
    let dark = bench.electrons(Slide::Uniform(BLACK));
    let spread = (mean(dark.iter().map(|e| e * e)) - mean(dark.iter().copied()).powi(2)).sqrt();
    assert!((spread - 30.0).abs() < 1.0, "{spread}");
    let again = bench.electrons(Slide::Uniform(BLACK));
    assert!(dark.iter().zip(&again).all(|(a, b)| (a - b).abs() < 0.5));
}
