//! Accuracy on simulated scenes with known coordinates.

use polscan_patterns::{Axis, Mode, Role};

use crate::decode::synth::{Accuracy, Rig, Spot, accuracy, decode, erf, sequence, uniform};
use crate::decode::{CameraResponse, Class, DecodeSettings, Decoded, PairContext, pair_residual};

/// 15 % texture on patches of 5 px.
fn texture(x: f64, y: f64) -> f64 {
    let cell = ((x / 5.0).floor() as i64 as u64).wrapping_mul(7919) ^ ((y / 5.0).floor() as i64 as u64);
    1.0 + 0.15 * (2.0 * uniform(cell) - 1.0)
}

fn slanted(reflectance: f64, slope: f64) -> impl Fn(f64, f64) -> Spot + Sync {
    move |x, y| Spot {
        u: 300.2 + slope * x + 0.011 * y,
        v: 200.4 + 0.333 * y - 0.008 * x,
        reflectance: reflectance * texture(x, y) / 1.15,
        ..Spot::default()
    }
}

/// A sphere of 40 mm on the paper's rig (`bump` 1), or one whose depth counts `bump` times.
fn sphere(reflectance: f64, bump: f64) -> impl Fn(f64, f64) -> Spot + Sync {
    move |x, y| {
        let r2 = (x - 200.0).powi(2) + (y - 48.0).powi(2);
        let depth = (40.0f64.powi(2) - r2 * 0.2156 * 0.2156).max(0.0).sqrt();
        let inside = depth > 10.0;
        Spot {
            u: 300.0 + 0.331 * x - bump * depth / 12.0,
            v: 200.0 + 0.331 * y,
            reflectance: if inside { reflectance } else { 0.0 },
            surface: u32::from(inside),
            ..Spot::default()
        }
    }
}

/// Two slanted planes side by side, the right one `jump` columns further, along a border that leans by `lean`.
fn step(reflectance: f64, jump: f64, lean: f64) -> impl Fn(f64, f64) -> Spot + Sync {
    move |x, y| {
        let right = x > 160.3 + lean * (y - 48.0);
        Spot {
            u: 300.2 + 0.331 * x + 0.011 * y + if right { jump } else { 0.0 },
            v: 200.4 + 0.333 * y - 0.008 * x,
            reflectance,
            surface: u32::from(right),
            ..Spot::default()
        }
    }
}

/// Classes of the pixels of an image.
fn classes(decoded: &Decoded) -> String {
    Class::ALL
        .iter()
        .map(|class| (class, decoded.class.data().iter().filter(|c| *c == class).count()))
        .filter(|(_, count)| *count > 0)
        .map(|(class, count)| format!("{class:?} {count} "))
        .collect()
}

fn assert_accuracy(name: &str, a: Accuracy, rms: f64) {
    println!("{name}: {a:?}");
    assert!(a.coverage >= 0.999, "{name}: {a:?}");
    assert!(a.wrong == 0.0, "{name}: {a:?}");
    assert!(a.rms <= rms, "{name}: {a:?}");
    assert!((0.8..=1.25).contains(&a.normalised) && a.normalised_rms < 1.3, "{name}: {a:?}");
    assert!(a.fallback < 0.01, "{name}: {a:?}");
}

#[test]
fn planes_reach_the_aim_and_know_their_accuracy() {
    // Blur of the paper's rig, then sharper ones; columns are the axis that depth comes from.
    for (blur_px, reflectance, rms) in [
        (1.9, 1.0, 0.006),
        (1.9, 0.1, 0.015),
        (1.9, 0.03, 0.03),
        (0.7, 1.0, 0.006),
        (0.7, 0.03, 0.03),
        (0.2, 0.1, 0.03),
    ] {
        let rig = Rig { blur_px, ..Rig::default() };
        let scene = slanted(reflectance, 0.331);
        let decoded = rig.decode(&scene, &sequence(Mode::Pse));
        for axis in [Axis::Column, Axis::Row] {
            let name = format!("plane, blur {blur_px}, reflectance {reflectance}, {axis}");
            assert_accuracy(&name, accuracy(&rig, &scene, &decoded, axis, |_, _| true), rms);
        }
    }
}

#[test]
fn coarser_and_finer_sampling_of_the_projector_hold_too() {
    for (slope, blur_px, rms) in [(0.21, 1.9, 0.02), (0.5, 1.2, 0.03), (0.75, 0.8, 0.03), (-0.331, 1.9, 0.03)]
    {
        let rig = Rig { blur_px, height: 60, ..Rig::default() };
        let scene = slanted(0.05, slope);
        let decoded = rig.decode(&scene, &sequence(Mode::Fast));
        let name = format!("plane, {slope} columns per px");
        assert_accuracy(&name, accuracy(&rig, &scene, &decoded, Axis::Column, |_, _| true), rms);
    }
}

#[test]
fn a_camera_on_its_side_is_decoded_along_the_other_direction() {
    let rig = Rig { width: 100, height: 160, ..Rig::default() };
    let scene = |x: f64, y: f64| Spot { u: 300.0 + 0.331 * y, v: 200.0 + 0.331 * x, ..Spot::default() };
    let decoded = rig.decode(&scene, &sequence(Mode::Pse));
    for axis in [Axis::Column, Axis::Row] {
        assert_accuracy("turned plane", accuracy(&rig, &scene, &decoded, axis, |_, _| true), 0.006);
    }
}

#[test]
fn spheres_are_not_flattened() {
    for (bump, reflectance) in [(1.0, 1.0), (1.0, 0.03), (3.0, 1.0), (3.0, 0.1)] {
        let rig = Rig { width: 400, ..Rig::default() };
        let scene = sphere(reflectance, bump);
        let decoded = rig.decode(&scene, &sequence(Mode::Pse));
        let a = accuracy(&rig, &scene, &decoded, Axis::Column, |_, _| true);
        assert_accuracy(&format!("sphere {bump} at {reflectance}"), a, 0.03);
        assert!(a.bias.abs() < 0.2 * a.median_sigma.max(0.01), "{a:?}");
    }
}

#[test]
fn depth_jumps_are_kept_and_not_smeared() {
    // Jumps whose words differ in one bit (odd ones, powers of two less one) and in many, along straight and
    // leaning borders.
    for (jump, lean) in
        [(1.0, 0.5), (3.0, 0.0), (5.0, 0.0), (7.0, 0.5), (20.0, 0.5), (-20.0, 0.0), (63.0, 0.0), (100.3, 0.5)]
    {
        let rig = Rig { height: 64, ..Rig::default() };
        let scene = step(0.3, jump, lean);
        let decoded = rig.decode(&scene, &sequence(Mode::Pse));
        let near = |x: usize, y: usize| (x as f64 - (160.3 + lean * (y as f64 - 48.0))).abs() < 12.0;
        let a = accuracy(&rig, &scene, &decoded, Axis::Column, near);
        println!("jump {jump} lean {lean}: {a:?} {}", classes(&decoded));
        assert!(a.coverage >= 0.99 && a.wrong == 0.0, "jump {jump}: {a:?}");
        // Where the jump is large enough to be seen at once, the edge next to it is as good as any.
        assert!(a.rms < if jump.abs() > 4.0 { 0.02 } else { 0.15 }, "jump {jump}: {a:?}");
        let gated = [Class::OffBoundary, Class::Vote].map(|class| count(&decoded, class));
        assert_eq!(gated, [0, 0], "jump {jump}");
    }
}

fn count(decoded: &Decoded, class: Class) -> usize {
    decoded.class.data().iter().filter(|found| **found == class).count()
}

#[test]
fn eight_to_sixteen_bits_behave_the_same() {
    for (bit_depth, black_dn) in [(8u8, 3.0), (10, 10.0), (12, 41.0), (16, 655.0)] {
        let rig = Rig { bit_depth, black_dn, width: 160, height: 60, ..Rig::default() };
        let scene = slanted(0.1, 0.331);
        let decoded = rig.decode(&scene, &sequence(Mode::Pse));
        let a = accuracy(&rig, &scene, &decoded, Axis::Column, |_, _| true);
        assert_accuracy(&format!("{bit_depth} bits"), a, 0.025);
    }
}

#[test]
fn noise_is_found_in_the_frames() {
    for bit_depth in [8u8, 12] {
        let black_dn = if bit_depth == 8 { 4.0 } else { 41.0 };
        let rig = Rig { bit_depth, black_dn, height: 160, ..Rig::default() };
        let scene = |x: f64, y: f64| Spot {
            reflectance: 0.02 + 0.9 * (x / 320.0).powi(2),
            ..slanted(1.0, 0.331)(x, y)
        };
        let sequence = sequence(Mode::Pse);
        let camera = CameraResponse { noise: None, ..rig.camera() };
        let settings = DecodeSettings { camera, ..rig.settings(&sequence) };
        let decoded = decode(settings, rig.scan(&scene, &sequence)).unwrap();
        let truth = rig.noise();
        println!("{bit_depth} bits: {:?}, truth {truth:?}", decoded.noise);
        assert!(decoded.noise_estimated);
        for level in [0.03, 0.2, 0.8].map(|share| share * f64::from((1u32 << bit_depth) - 1)) {
            let ratio = (decoded.noise.variance(level) / truth.variance(level)).sqrt();
            assert!((0.93..=1.07).contains(&ratio), "{bit_depth} bits at {level}: {ratio}");
        }
        for pair in &decoded.pairs {
            assert!((0.9..=1.1).contains(&pair.sigma), "{pair:?}");
        }
    }
}

/// Coordinates of row `y` once more: crossings by the inverse of the normal distribution (bisection) and a weighted
/// parabola through sixteen edges by a general solver.
fn slow_row(rig: &Rig, frames: &[(Role, Vec<u16>)], decoded: &Decoded, y: usize) -> Vec<f64> {
    let sequence = sequence(Mode::Pse);
    let sample = |role: Role, x: usize| {
        let found: Vec<f64> =
            frames.iter().filter(|(r, _)| *r == role).map(|(_, f)| f64::from(f[y * rig.width + x])).collect();
        found.iter().sum::<f64>() / found.len() as f64
    };
    let fringe = |bit: u8, x: usize| {
        let [p, q] = [false, true].map(|inverse| sample(Role::Code { axis: Axis::Column, bit, inverse }, x));
        let (h, v) = (sample(Role::ReferenceH, x), sample(Role::ReferenceV, x));
        let noise = rig.noise();
        let pair = noise.variance(h - rig.black_dn) + noise.variance(v - rig.black_dn);
        let a = (p - q) / (h - v);
        (a, pair * (1.0 + a * a / 2.0) / (h - v).powi(2))
    };
    let quantile = |a: f64| {
        let (mut low, mut high) = (-2.0, 2.0);
        for _ in 0..60 {
            let middle = (low + high) / 2.0;
            if erf(middle / std::f64::consts::SQRT_2) < a { low = middle } else { high = middle }
        }
        (low + high) / 2.0
    };
    let code = |x: usize| decoded.column.code.at(x, y);
    let mut edges = Vec::new();
    for x in 0..rig.width - 1 {
        if code(x + 1) == code(x) + 1 {
            let bit = sequence.column.bit_of_boundary(code(x) as u32);
            let (a, b) = (fringe(bit, x), fringe(bit, x + 1));
            let (s, t) = (quantile(a.0), quantile(b.0));
            // Derivative of the quantile: one over the density, which is that of erf.
            let per = |s: f64| (s * s / 2.0).exp() * (std::f64::consts::PI / 2.0).sqrt();
            let variance = (t * t * a.1 * per(s).powi(2) + s * s * b.1 * per(t).powi(2)) / (s - t).powi(4);
            edges.push((x as f64 + s / (s - t), f64::from(code(x)) + 0.5, variance));
        }
    }
    let at = |x: usize| {
        let passed = edges.iter().filter(|edge| edge.0 <= x as f64).count();
        let first = passed.saturating_sub(8).min(edges.len() - 16);
        let used = &edges[first..first + 16];
        let row = |(place, _, variance): &(f64, f64, f64)| {
            let t = place - x as f64;
            [1.0, t, t * t].map(|power| power / variance.sqrt())
        };
        let matrix = nalgebra::DMatrix::from_row_iterator(16, 3, used.iter().flat_map(row));
        let wanted = nalgebra::DVector::from_iterator(16, used.iter().map(|edge| edge.1 / edge.2.sqrt()));
        matrix.svd(true, true).solve(&wanted, 1e-14).unwrap()[0]
    };
    (0..rig.width).map(at).collect()
}

#[test]
fn coordinates_of_a_row_equal_the_slow_way() {
    let rig = Rig { height: 20, ..Rig::default() };
    let scene = |x: f64, y: f64| {
        let spot = slanted(0.2, 0.331)(x, y);
        Spot { u: spot.u + 3.0 * (x / 90.0).sin(), ..spot }
    };
    let frames = rig.scan(&scene, &sequence(Mode::Pse));
    let decoded = decode(rig.settings(&sequence(Mode::Pse)), frames.clone()).unwrap();
    let (mut near, mut all) = (0, 0);
    for y in [3, 10, 17] {
        for (x, slow) in slow_row(&rig, &frames, &decoded, y).into_iter().enumerate() {
            let sigma = f64::from(decoded.column.sigma.at(x, y));
            near += u32::from((f64::from(decoded.column.coordinate.at(x, y)) - slow).abs() < 0.1 * sigma);
            all += 1;
        }
    }
    // The rest are windows whose residuals call for another model than the wide parabola.
    assert!(f64::from(near) / f64::from(all) > 0.95, "{near} of {all}");
}

/// Time of a decode of the size of the paper's rig. Run with `--release -- --ignored --nocapture`.
#[test]
#[ignore = "a measurement, not a check"]
fn timing_at_full_size() {
    let rig = Rig { width: 1600, height: 1200, ..Rig::default() };
    let scene = slanted(0.3, 0.331);
    let sequence = sequence(Mode::Pse);
    let frames: Vec<(Role, crate::decode::SharedPlane)> = rig
        .scan(&scene, &sequence)
        .into_iter()
        .map(|(role, frame)| (role, std::sync::Arc::new(frame) as crate::decode::SharedPlane))
        .collect();
    let plane = |wanted: Role| frames.iter().find(|(role, _)| *role == wanted).unwrap().1.plane();
    let pair = |inverse| plane(Role::Code { axis: Axis::Column, bit: 3, inverse });
    let context = PairContext {
        axis: Axis::Column,
        bit: 3,
        width: rig.width,
        high: &[plane(Role::ReferenceH)],
        low: &[plane(Role::ReferenceV)],
        camera: rig.camera(),
        noise: rig.noise(),
        lit_sigma: 4.0,
    };
    for _ in 0..3 {
        let start = std::time::Instant::now();
        let residual = pair_residual(pair(false), pair(true), &context).unwrap();
        println!("one pair: {:.1} ms, {residual:?}", start.elapsed().as_secs_f64() * 1e3);
    }
    for round in 0..6 {
        let mut accumulator = crate::decode::Accumulator::new(rig.settings(&sequence)).unwrap();
        for (role, plane) in &frames {
            accumulator.push(*role, plane.clone()).unwrap();
        }
        // Processor time too (fields 14 and 15 in ticks of 10 ms): machines are shared.
        let ticks = || {
            let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
            stat.split(' ').skip(13).take(2).filter_map(|field| field.parse::<u64>().ok()).sum::<u64>()
        };
        let (start, before) = (std::time::Instant::now(), ticks());
        let decoded = accumulator.finish().unwrap();
        let wall = start.elapsed().as_secs_f64() * 1e3;
        println!(
            "round {round}: {wall:.0} ms, processor {} ms, {}",
            (ticks() - before) * 10,
            classes(&decoded)
        );
    }
}
