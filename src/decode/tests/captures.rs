//! Real captures, where the variable `POLSCAN_CAPTURES` names the folder that holds them.

use std::{path::Path, sync::Arc, time::Instant};

use polscan_patterns::{Axis, AxisCode, Mode, Role};

use crate::decode::{Accumulator, CameraResponse, Class, DecodeSettings, Decoded, Thresholds};

struct Set {
    name: String,
    frames: Vec<(Role, String)>,
    size: (u32, u32),
    reference: [String; 2],
}

fn pairs(name: impl Fn(usize) -> String, bits: [u8; 2]) -> Vec<(Role, String)> {
    let mut number = 0;
    let mut frames = Vec::new();
    for (axis, bits) in [Axis::Column, Axis::Row].into_iter().zip(bits) {
        for bit in 0..bits {
            for inverse in [false, true] {
                frames.push((Role::Code { axis, bit, inverse }, name(number)));
                number += 1;
            }
        }
    }
    frames
}

fn sets() -> Vec<Set> {
    let mut sets = Vec::new();
    for capture in 0..5 {
        let name = move |n: usize| format!("procam-chess/sample_data/capture_{capture}/graycode_{n:02}.png");
        let mut frames = pairs(name, [10, 10]);
        frames.extend([(Role::White, name(40)), (Role::Black, name(41))]);
        let reference =
            ["col", "row"].map(|axis| format!("procam-chess/reference/capture_{capture}_{axis}_u16.png"));
        sets.push(Set { name: format!("procam-chess {capture}"), frames, size: (1024, 768), reference });
    }
    let name = |n: usize| format!("steve-cam0/data/steve/cam000_{n:04}.png");
    let mut frames = pairs(name, [11, 10]);
    frames.extend([(Role::Black, name(42)), (Role::White, name(43))]);
    let reference = ["col", "row"].map(|axis| format!("steve-cam0/reference/cam000_{axis}_u16.png"));
    sets.push(Set { name: "steve-cam0".into(), frames, size: (1280, 720), reference });
    sets
}

fn decode(folder: &Path, set: &Set) -> Decoded {
    let mut planes = Vec::new();
    let mut size = (0, 0);
    for (role, file) in &set.frames {
        let picture =
            image::open(folder.join(file)).unwrap_or_else(|error| panic!("{file}: {error}")).to_luma8();
        size = picture.dimensions();
        planes.push((*role, picture.into_raw()));
    }
    let mut accumulator = Accumulator::new(DecodeSettings {
        mode: Mode::Gray,
        column: AxisCode::plain(set.size.0).unwrap(),
        row: AxisCode::plain(set.size.1).unwrap(),
        width: size.0 as usize,
        height: size.1 as usize,
        camera: CameraResponse { bit_depth: 8, black_level_dn: None, saturation_dn: 255, noise: None },
        thresholds: Thresholds::default(),
    })
    .unwrap();
    for (role, plane) in planes {
        accumulator.push(role, Arc::new(plane)).unwrap();
    }
    let start = Instant::now();
    let decoded = accumulator.finish().unwrap();
    println!("{}: {:.0} ms", set.name, start.elapsed().as_secs_f64() * 1e3);
    decoded
}

#[test]
fn real_captures_keep_what_a_plain_decoder_gets_right() {
    let Some(folder) = std::env::var_os("POLSCAN_CAPTURES") else {
        println!("NOT RUN: POLSCAN_CAPTURES is not set, no real captures were decoded");
        return;
    };
    let folder = Path::new(&folder);
    for set in sets() {
        let decoded = decode(folder, &set);
        let [columns, rows] =
            set.reference.each_ref().map(|file| image::open(folder.join(file)).unwrap().to_luma16());
        let (mut reference, mut kept, mut equal, mut extra) = (0u64, 0u64, 0u64, 0u64);
        let mut lost = [0u64; 12];
        let row_map = decoded.row.as_ref().unwrap();
        for (at, (column, row)) in columns.as_raw().iter().zip(rows.as_raw()).enumerate() {
            let class = decoded.class.data()[at];
            if *column == u16::MAX || *row == u16::MAX {
                extra += u64::from(class.is_valid());
                continue;
            }
            reference += 1;
            if !class.is_valid() {
                lost[class as usize] += 1;
                continue;
            }
            kept += 1;
            let near = |code: i32, truth: u16| code.abs_diff(i32::from(truth)) <= 1;
            equal += u64::from(
                near(decoded.column.code.data()[at], *column) && near(row_map.code.data()[at], *row),
            );
        }
        let share = kept as f64 / reference as f64;
        let right = equal as f64 / kept as f64;
        println!(
            "  kept {:.3} % of {reference}, {:.4} % of them within one code, {:.1} % extra, noise K {:.4} read {:.3}",
            100.0 * share,
            100.0 * right,
            100.0 * extra as f64 / reference as f64,
            decoded.noise.gain_dn_per_electron,
            decoded.noise.read_noise_dn,
        );
        for class in Class::ALL {
            print!("  {class:?} {}", lost[class as usize]);
        }
        println!();
        for pair in &decoded.pairs {
            print!(
                "  {}{} {:.2}/{:.2} {:.3}/{:.3}",
                if pair.axis == Axis::Column { "c" } else { "r" },
                pair.bit,
                pair.sigma,
                pair.median,
                pair.flat_outliers,
                pair.edge_outliers
            );
        }
        println!();
        let suspect: Vec<_> = decoded.boundaries.iter().filter(|check| check.is_suspect()).collect();
        assert!(suspect.is_empty(), "{}: {suspect:?}", set.name);
        for (axis, map, [dx, dy]) in [("column", &decoded.column, [1, 0]), ("row", row_map, [0, 1])] {
            let mut sigmas: Vec<f32> =
                map.sigma.data().iter().copied().filter(|sigma| sigma.is_finite()).collect();
            sigmas.sort_by(f32::total_cmp);
            let codes_only =
                sigmas.iter().filter(|sigma| **sigma >= 0.288).count() as f64 / sigmas.len() as f64;
            // Bend over 40 px in all: edges shared by the three fits are few, so it shows the error of a coordinate.
            let mut bends = Vec::new();
            let (width, height) = (map.code.width(), map.code.height());
            for (x, y) in (20..height - 20).flat_map(|y| (20..width - 20).map(move |x| (x, y))) {
                let at = |step: isize| {
                    let (x, y) = (x.wrapping_add_signed(step * dx), y.wrapping_add_signed(step * dy));
                    (map.coordinate.at(x, y), map.sigma.at(x, y))
                };
                let three = [at(-20), at(0), at(20)];
                let bend = three[0].0 - 2.0 * three[1].0 + three[2].0;
                let sigma = (three[0].1.powi(2) + 4.0 * three[1].1.powi(2) + three[2].1.powi(2)).sqrt();
                if bend.is_finite() {
                    bends.push((bend / sigma).abs());
                }
            }
            bends.sort_by(f32::total_cmp);
            println!(
                "  {axis}: median sigma {:.4} px, codes only {:.2} %, bend over 40 px {:.2} sigma",
                sigmas[sigmas.len() / 2],
                100.0 * codes_only,
                1.4826 * bends[bends.len() / 2],
            );
        }
        assert!(share >= 0.97 && right >= 0.999, "{}", set.name);
    }
}
