//! Frames of a scene of known geometry, and the times that their decode takes.

use std::{
    error::Error,
    fs,
    hint::black_box,
    path::{Path, PathBuf},
    process::Command,
    sync::Arc,
    time::Instant,
};

use polscan_patterns::{AxisCode, Mode, ProjectorSize, Role, Sequence};
use polscan_reconstruction::{
    cloud::{CloudFrame, ReconstructSettings, reconstruct_with, write_ply},
    decode::{
        Accumulator, DecodeSettings, Plane, SharedPlane, contrast, each_stage,
        synth::{Rig, Spot},
    },
    geometry::{Calibration, Lens, Pose, Projector, Quality, Triangulator},
};
use rayon::prelude::*;

/// What fails here fails the whole measurement.
pub type Outcome<T> = Result<T, Box<dyn Error + Send + Sync>>;

/// Frames of one scan with what a decode of them needs.
pub struct Bundle {
    /// What is measured, in words.
    pub name: &'static str,
    /// Frames.
    pub frames: Vec<(Role, SharedPlane)>,
    /// Settings of their decode.
    pub settings: DecodeSettings,
    /// Rig that saw them.
    pub calibration: Calibration,
}

/// Least times in ms of one bundle on one number of threads.
pub struct Times {
    /// Name of the bundle.
    pub name: &'static str,
    /// Bytes of all frames.
    pub bytes: usize,
    /// Threads of the pool.
    pub threads: usize,
    /// A plain read of all frames.
    pub read_ms: f64,
    /// Each stage by name, in the order of a decode.
    pub stages: Vec<(&'static str, f64)>,
    /// From frames to columns, rows, classes and quality, all gates passed, without sub-pixel.
    pub codes_ms: f64,
    /// From frames to sub-pixel maps.
    pub decode_ms: f64,
}

/// What others need for the same 8-bit frames.
#[derive(Debug)]
pub struct Others {
    /// OpenCV's decode of one camera, in ms.
    pub opencv_ms: f64,
    /// Vectorised numpy on one thread, in ms.
    pub numpy_ms: f64,
    /// Version and number of threads of OpenCV, version of numpy.
    pub versions: String,
}

/// The same scan as 8 bits and as 12 bits in `u16`: two plates, one behind the other and tilted, on a dark ground.
pub fn bundles((width, height): (usize, usize), projector: ProjectorSize) -> Outcome<[Bundle; 2]> {
    let mut sequence = Sequence::new(Mode::Pse, projector)?;
    // A plain code is one that OpenCV knows too.
    (sequence.column, sequence.row) = (AxisCode::plain(projector.width)?, AxisCode::plain(projector.height)?);
    let rig = Rig { width, height, ..Rig::default() };
    let focal = 2.0 * width as f64;
    let (cx, cy) = ((width as f64 - 1.0) / 2.0, (height as f64 - 1.0) / 2.0);
    let baseline_mm = 100.0;
    let share = f64::from(projector.width) / 1024.0;
    let projector_cy = (f64::from(projector.height) - 1.0) / 2.0;
    let (projector_focal, projector_cx) = (1700.0 * share, 682.0 * share - 0.5);
    let scene = |x: f64, y: f64| {
        let (a, b) = ((x - cx) / focal, (y - cy) / focal);
        let near = a > 0.05 && a < 0.15 && b.abs() < 0.1;
        let z = if near { 940.0 } else { 1000.0 / (1.0 - 0.3 * a) };
        let ground = a < -0.2;
        Spot {
            u: projector_focal * (a * z - baseline_mm) / z + projector_cx,
            v: projector_focal * b + projector_cy,
            reflectance: if ground { 0.0 } else { 0.7 },
            surface: if ground { 2 } else { u32::from(near) },
            ..Spot::default()
        }
    };
    let deep = rig.scan(&scene, &sequence);
    let settings = rig.settings(&sequence);
    let mut camera = settings.camera;
    (camera.bit_depth, camera.saturation_dn) = (8, 255);
    // The lower four bits are cut off, and with them half a step on average.
    camera.black_level_dn = Some(rig.black_dn / 16.0 - 0.5);
    camera.noise = camera.noise.map(|mut noise| {
        noise.gain_dn_per_electron /= 16.0;
        noise.read_noise_dn /= 16.0;
        noise
    });
    let lens = |width: usize, height: usize, focal: f64, cx: f64, cy: f64| Lens {
        width: width as u32,
        height: height as u32,
        fx: focal,
        fy: focal,
        cx,
        cy,
        distortion: [0.0; 5],
    };
    let mut pose =
        Pose { rotation: nalgebra::Matrix3::identity(), translation_mm: nalgebra::Vector3::zeros() };
    pose.translation_mm[0] = -baseline_mm;
    let calibration = Calibration {
        camera: lens(width, height, focal, cx, cy),
        projector: Some(Projector {
            lens: lens(
                projector.width as usize,
                projector.height as usize,
                projector_focal,
                projector_cx,
                projector_cy,
            ),
            projector_from_camera: pose,
        }),
        world_from_camera: None,
        quality: Quality::default(),
    };
    let bytes = deep
        .par_iter()
        .map(|(role, frame)| {
            let plane: SharedPlane = Arc::new(frame.iter().map(|&dn| (dn >> 4) as u8).collect::<Vec<u8>>());
            (*role, plane)
        })
        .collect();
    let words = deep.into_iter().map(|(role, frame)| (role, Arc::new(frame) as SharedPlane)).collect();
    Ok([
        Bundle {
            name: "8 bit",
            frames: bytes,
            settings: DecodeSettings { camera, ..settings.clone() },
            calibration: calibration.clone(),
        },
        Bundle { name: "12 bit in u16", frames: words, settings, calibration },
    ])
}

/// The same scan over and over, one below the other, `times` as many pixels in all.
pub fn stacked(bundle: &Bundle, times: usize) -> Bundle {
    let stack = |plane: &SharedPlane| -> SharedPlane {
        match plane.plane() {
            Plane::U8(samples) => Arc::new(samples.repeat(times)),
            Plane::U16(samples) => Arc::new(samples.repeat(times)),
        }
    };
    let settings = DecodeSettings { height: bundle.settings.height * times, ..bundle.settings.clone() };
    let frames = bundle.frames.iter().map(|(role, plane)| (*role, stack(plane))).collect();
    Bundle { name: bundle.name, frames, settings, calibration: bundle.calibration.clone() }
}

/// Least times of a plain read, of the codes, and of the decode up to complete maps, in ms, and the share of the pixels that
/// are decoded.
pub fn decode_times(bundle: &Bundle, threads: usize) -> Outcome<([f64; 3], f64)> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    pool.install(|| {
        let Bundle { frames, settings, .. } = bundle;
        let read_ms = least(|| {
            black_box(read(frames, settings.height));
        });
        let mut accumulator = Accumulator::new(settings.clone())?;
        for (role, plane) in frames {
            accumulator.push(*role, plane.clone())?;
        }
        let decoded = accumulator.clone().finish()?;
        let valid = decoded.class.data().iter().filter(|class| class.is_valid()).count();
        let [codes_ms, decode_ms] = whole(&accumulator);
        Ok(([read_ms, codes_ms, decode_ms], valid as f64 / decoded.class.len() as f64))
    })
}

/// Least times of the codes, and of the decode up to complete maps, in ms.
fn whole(accumulator: &Accumulator) -> [f64; 2] {
    let mut codes_ms = f64::INFINITY;
    let decode_ms = least(|| {
        let start = Instant::now();
        let codes_done = || codes_ms = codes_ms.min(1e3 * start.elapsed().as_secs_f64());
        black_box(accumulator.clone().finish_telling(codes_done))
            .expect("frames that have just decoded do so again");
    });
    [codes_ms, decode_ms]
}

/// Least time of `work` in ms over at least three runs, more where they are short.
fn least(mut work: impl FnMut()) -> f64 {
    let begin = Instant::now();
    let mut best = f64::INFINITY;
    for run in 0..60 {
        let start = Instant::now();
        work();
        best = best.min(1e3 * start.elapsed().as_secs_f64());
        if run >= 2 && begin.elapsed().as_secs_f64() > 2.0 {
            break;
        }
    }
    best
}

/// Sum of the bytes of all frames, each thread its rows: nothing that looks at all samples is faster.
fn read(frames: &[(Role, SharedPlane)], rows: usize) -> u64 {
    (0..rows)
        .into_par_iter()
        .map(|row| frames.iter().map(|(_, plane)| sum_of_row(plane.plane(), row, rows)).sum::<u64>())
        .sum()
}

fn sum_of_row(plane: Plane<'_>, row: usize, rows: usize) -> u64 {
    let width = plane.len() / rows;
    let at = row * width..(row + 1) * width;
    // Short sums in 16 and 32 bits are what vector units add fastest.
    match plane {
        Plane::U8(samples) => samples[at]
            .chunks(256)
            .map(|part| u64::from(part.iter().fold(0u16, |sum, &dn| sum.wrapping_add(u16::from(dn)))))
            .sum(),
        Plane::U16(samples) => samples[at]
            .chunks(256)
            .map(|part| u64::from(part.iter().fold(0u32, |sum, &dn| sum.wrapping_add(u32::from(dn)))))
            .sum(),
    }
}

/// Times of a bundle on `threads` threads: of every stage, or of those whose name is `only`.
pub fn times(bundle: &Bundle, threads: usize, only: Option<&str>) -> Outcome<Times> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    pool.install(|| times_here(bundle, threads, only))
}

fn times_here(bundle: &Bundle, threads: usize, only: Option<&str>) -> Outcome<Times> {
    let Bundle { frames, settings, .. } = bundle;
    let mut stages = Vec::new();
    let mut visit = |name: &'static str, work: &mut dyn FnMut()| {
        if only.is_none_or(|only| only == name) {
            stages.push((name, least(work)));
        }
    };
    let read_ms = least(|| {
        black_box(read(frames, settings.height));
    });
    each_stage(settings, frames, &mut visit)?;
    let mut accumulator = Accumulator::new(settings.clone())?;
    for (role, plane) in frames {
        accumulator.push(*role, plane.clone())?;
    }
    let decoded = accumulator.clone().finish()?;
    let triangulator = Triangulator::new(&bundle.calibration)?;
    let volume = ReconstructSettings::new(500.0, 1500.0);
    let found = reconstruct_with(&triangulator, &decoded, &volume)?;
    visit("triangulator", &mut || {
        black_box(Triangulator::new(&bundle.calibration))
            .expect("a rig that has just triangulated does so again");
    });
    visit("cloud", &mut || {
        black_box(reconstruct_with(&triangulator, &decoded, &volume))
            .expect("maps that have just passed pass again");
    });
    visit("ply", &mut || {
        let mut out = Vec::new();
        write_ply(&mut out, &found.cloud, &decoded.intensity, CloudFrame::Camera)
            .expect("memory takes every write");
        black_box(out);
    });
    let lit = decoded.class.map(|class| class.is_lit());
    let planes = |wanted: fn(&Role) -> bool| -> Vec<_> {
        frames.iter().filter(|(role, _)| wanted(role)).map(|(_, plane)| plane.plane()).collect()
    };
    let code = planes(|role| matches!(role, Role::Code { inverse: false, .. }));
    let dark = planes(|role| matches!(role, Role::ReferenceV));
    visit("contrast", &mut || {
        black_box(contrast(&code, &dark, settings.camera.bit_depth, 0.0, &lit));
    });
    let [codes_ms, decode_ms] = match only {
        Some(_) => [f64::INFINITY; 2],
        None => whole(&accumulator),
    };
    if found.cloud.points() < decoded.class.len() / 3 {
        return Err(format!("only {} points came of these frames", found.cloud.points()).into());
    }
    let bytes = frames.iter().map(|(_, plane)| byte_len(plane.plane())).sum();
    Ok(Times { name: bundle.name, bytes, threads, read_ms, stages, codes_ms, decode_ms })
}

fn byte_len(plane: Plane<'_>) -> usize {
    match plane {
        Plane::U8(samples) => samples.len(),
        Plane::U16(samples) => 2 * samples.len(),
    }
}

/// Has OpenCV and numpy decode the 8-bit frames, `repeats` times each.
pub fn others(root: &Path, bundle: &Bundle, repeats: usize) -> Outcome<Others> {
    let folder = std::env::temp_dir().join(format!("polscan-speed-{}", std::process::id()));
    fs::create_dir_all(&folder)?;
    let found = ask(root, &folder, bundle, repeats);
    fs::remove_dir_all(&folder)?;
    found
}

fn ask(root: &Path, folder: &PathBuf, bundle: &Bundle, repeats: usize) -> Outcome<Others> {
    let write = |number: usize, role: fn(&Role) -> bool| -> Outcome<()> {
        let (_, plane) =
            bundle.frames.iter().find(|(found, _)| role(found)).ok_or("a reference is missing")?;
        write_plane(folder, number, plane.plane())
    };
    write(0, |role| matches!(role, Role::ReferenceH))?;
    write(1, |role| matches!(role, Role::ReferenceV))?;
    let code = bundle.frames.iter().filter(|(role, _)| matches!(role, Role::Code { .. }));
    for (number, (_, plane)) in code.enumerate() {
        write_plane(folder, 2 + number, plane.plane())?;
    }
    let DecodeSettings { width, height, column, row, .. } = &bundle.settings;
    let numbers = [*width, *height, column.bits().into(), row.bits().into()];
    let sizes = [column.size() as usize, row.size() as usize, repeats];
    let run = Command::new(root.join(".cache/python/bin/python"))
        .arg(root.join("tests/python/speed.py"))
        .arg(folder)
        .args(numbers.iter().chain(&sizes).map(usize::to_string))
        .output()
        .map_err(|error| format!("cannot start the Python of the checks: {error}; run `make setup`"))?;
    if !run.status.success() {
        return Err(format!("OpenCV and numpy: {}", String::from_utf8_lossy(&run.stderr)).into());
    }
    let found: serde_json::Value = serde_json::from_slice(&run.stdout)?;
    let ms = |key: &str| found[key].as_f64().ok_or(format!("no {key} in {found}"));
    Ok(Others {
        opencv_ms: ms("opencv_ms")?,
        numpy_ms: ms("numpy_ms")?,
        versions: format!(
            "OpenCV {} on {} threads, numpy {} on one",
            found["opencv"].as_str().unwrap_or_default(),
            found["opencv_threads"],
            found["numpy"].as_str().unwrap_or_default(),
        ),
    })
}

fn write_plane(folder: &Path, number: usize, plane: Plane<'_>) -> Outcome<()> {
    let Plane::U8(samples) = plane else { return Err("only 8-bit frames are for others".into()) };
    fs::write(folder.join(format!("{number:02}.raw")), samples)?;
    Ok(())
}
