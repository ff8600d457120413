use std::fs;

use image::{DynamicImage, ImageFormat, RgbImage};
use polscan_patterns::{Axis, Mode, ProjectorSize, Role, Sequence};
use proptest::prelude::*;
use tempfile::TempDir;

use super::*;
use crate::store::{
    manifest::Camera,
    npy::FrameStream,
    source::Policy::{Local, Upload},
};

const WIDTH: u32 = 6;
const HEIGHT: u32 = 5;

fn sample(frame: usize, pixel: usize) -> u16 {
    ((frame * 997 + pixel * 131) % 4096) as u16
}

fn manifest(frames: FrameFiles, count: usize) -> Manifest {
    let sequence = Sequence::new(Mode::Gray, ProjectorSize { width: 1024, height: 768 }).unwrap();
    let mut manifest = Manifest::new(&sequence, frames);
    manifest.sequence.truncate(count);
    manifest
}

fn pixels() -> usize {
    (WIDTH * HEIGHT) as usize
}

fn wide(frame: usize) -> Vec<u16> {
    (0..pixels()).map(|pixel| sample(frame, pixel)).collect()
}

fn narrow(frame: usize) -> Vec<u8> {
    (0..pixels()).map(|pixel| (sample(frame, pixel) >> 4) as u8).collect()
}

fn values(plane: &SharedPlane) -> Vec<u16> {
    match plane.plane() {
        Plane::U8(samples) => samples.iter().map(|&sample| u16::from(sample)).collect(),
        Plane::U16(samples) => samples.to_vec(),
    }
}

fn npy(count: usize) -> Vec<u8> {
    let mut stream = FrameStream::new(Vec::new(), count, HEIGHT as usize, WIDTH as usize, 12).unwrap();
    for frame in 0..count {
        stream.push(Plane::U16(&wide(frame))).unwrap();
    }
    stream.finish().unwrap()
}

/// A `.npy` whose header text and data are given.
fn raw_npy(dictionary: &str, data: &[u8]) -> Vec<u8> {
    let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
    bytes.extend((dictionary.len() as u16).to_le_bytes());
    bytes.extend(dictionary.as_bytes());
    bytes.extend(data);
    bytes
}

fn load_bytes(bytes: &[u8], count: usize) -> Result<FrameSet, InputError> {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("frames.npy"), bytes).unwrap();
    load(folder.path(), &manifest(FrameFiles::Npy("frames.npy".into()), count), Upload, &Limits::default())
}

/// Writes images and loads them; each is a name and what is in the file.
fn load_files(files: &[(&str, Vec<u8>)], camera: Option<Camera>) -> Result<FrameSet, InputError> {
    let folder = TempDir::new().unwrap();
    for (name, bytes) in files {
        fs::write(folder.path().join(name), bytes).unwrap();
    }
    let names = files.iter().map(|(name, _)| (*name).to_owned()).collect();
    let mut manifest = manifest(FrameFiles::Images(names), files.len());
    manifest.camera = camera;
    load(folder.path(), &manifest, Upload, &Limits::default())
}

fn encode(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    image.into().write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn gray8(frame: usize) -> image::GrayImage {
    image::GrayImage::from_raw(WIDTH, HEIGHT, narrow(frame)).unwrap()
}

fn gray16(frame: usize) -> image::ImageBuffer<image::Luma<u16>, Vec<u16>> {
    image::ImageBuffer::from_raw(WIDTH, HEIGHT, wide(frame)).unwrap()
}

fn pgm16(frame: usize, maximum: u16) -> Vec<u8> {
    let mut bytes = format!("P5\n{WIDTH} {HEIGHT}\n{maximum}\n").into_bytes();
    bytes.extend(wide(frame).iter().flat_map(|sample| sample.to_be_bytes()));
    bytes
}

#[test]
fn a_mapped_array_holds_the_frames_and_its_hash() {
    let set = load_bytes(&npy(3), 3).unwrap();
    assert_eq!((set.width, set.height, set.sample_bits), (WIDTH as usize, HEIGHT as usize, 16));
    for frame in 0..3 {
        assert_eq!(values(&set.planes[frame]), wide(frame));
    }
    let hashes = set.hashes();
    assert_eq!(hashes[0].path, "frames.npy");
    assert_eq!(hashes[0].entry.sha256, hex(&Sha256::digest(npy(3))));
}

#[test]
fn planes_outlive_the_set_and_the_file() {
    let plane = {
        let set = load_bytes(&npy(2), 2).unwrap();
        Arc::clone(&set.planes[1])
    };
    assert_eq!(values(&plane), wide(1));
}

#[test]
fn every_byte_order_and_alignment_gives_the_same_samples() {
    let little: Vec<u8> = (0..2).flat_map(wide).flat_map(u16::to_le_bytes).collect();
    let big: Vec<u8> = (0..2).flat_map(wide).flat_map(u16::to_be_bytes).collect();
    for padding in 0..5 {
        for (descr, data) in [("<u2", &little), (">u2", &big)] {
            let text = format!(
                "{{'descr': '{descr}', 'fortran_order': False, 'shape': (2, {HEIGHT}, {WIDTH})}}{}\n",
                " ".repeat(padding)
            );
            let set = load_bytes(&raw_npy(&text, data), 2).unwrap();
            assert_eq!(values(&set.planes[0]), wide(0));
            assert_eq!(values(&set.planes[1]), wide(1));
        }
    }
}

#[test]
fn a_file_that_lies_is_refused_before_any_use() {
    let header = |shape: &str, descr: &str| {
        format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}}}\n")
    };
    let shape = format!("(2, {HEIGHT}, {WIDTH})");
    let data = vec![0; 2 * 2 * pixels()];
    let cases = [
        (npy(2)[..npy(2).len() - 1].to_vec(), "cut off"),
        ([npy(2), vec![0]].concat(), "cut off or damaged"),
        (npy(2)[..60].to_vec(), "ends within its header"),
        (Vec::new(), "is empty"),
        (npy(3), "`sequence` has 2 entries, the frames are 3"),
        (raw_npy(&header("(2, 60)", "<u2"), &data), "expected (frames, height, width)"),
        (raw_npy(&header(&shape, "<f4"), &[0; 240]), "expected uint8 or uint16"),
        (raw_npy(&header("(2, 0, 6)", "<u2"), &[]), "which is none"),
        (raw_npy(&header("(2, 1099511627776, 1099511627776)", "<u2"), &data), "header promises"),
        (raw_npy(&header("(99999999999999999999, 1, 1)", "<u2"), &data), "a size"),
    ];
    for (bytes, part) in cases {
        let error = load_bytes(&bytes, 2).unwrap_err().to_string();
        assert!(error.contains(part), "expected {part:?} in {error:?}");
    }
}

#[test]
fn images_of_every_kind_give_their_samples() {
    for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::Bmp] {
        let files: Vec<(&str, Vec<u8>)> =
            vec![("a", encode(gray8(0), format)), ("b", encode(gray8(1), format))];
        let set = load_files(&files, None).unwrap();
        assert_eq!(set.sample_bits, 8);
        assert_eq!(
            values(&set.planes[1]),
            narrow(1).into_iter().map(u16::from).collect::<Vec<_>>(),
            "{format:?}"
        );
        assert!(set.notes.is_empty(), "{format:?}: {:?}", set.notes);
        assert_eq!(set.hashes()[1].entry.sha256, hex(&Sha256::digest(&files[1].1)));
    }
    for format in [ImageFormat::Png, ImageFormat::Tiff] {
        let set = load_files(&[("a", encode(gray16(0), format))], None).unwrap();
        assert_eq!((set.sample_bits, values(&set.planes[0])), (16, wide(0)));
    }
    let mut pgm = format!("P5 {WIDTH} {HEIGHT} 255\n").into_bytes();
    pgm.extend(narrow(3));
    let set = load_files(&[("a.pgm", pgm)], None).unwrap();
    assert_eq!(values(&set.planes[0]), narrow(3).into_iter().map(u16::from).collect::<Vec<_>>());
    let flat = image::GrayImage::from_pixel(WIDTH, HEIGHT, image::Luma([77]));
    let set = load_files(&[("a.jpg", encode(flat, ImageFormat::Jpeg))], None).unwrap();
    assert_eq!(values(&set.planes[0]), vec![77; pixels()]);
}

#[test]
fn twelve_bits_in_a_pgm_stay_right_aligned() {
    let camera = Camera { bit_depth: Some(12), ..Camera::default() };
    let set = load_files(&[("a.pgm", pgm16(0, 4095))], Some(camera)).unwrap();
    assert_eq!(values(&set.planes[0]), wide(0));
    assert!(set.notes.is_empty());
}

#[test]
fn colour_is_reduced_to_green_and_told() {
    let coloured = |frame: usize| {
        let data = narrow(frame).into_iter().flat_map(|green| [7, green, 9]).collect();
        encode(RgbImage::from_raw(WIDTH, HEIGHT, data).unwrap(), ImageFormat::Png)
    };
    let grayish = |frame: usize| {
        let data = narrow(frame).into_iter().flat_map(|level| [level; 3]).collect();
        encode(RgbImage::from_raw(WIDTH, HEIGHT, data).unwrap(), ImageFormat::Png)
    };
    let expected = |frame| narrow(frame).into_iter().map(u16::from).collect::<Vec<_>>();
    let set =
        load_files(&[("a.png", grayish(0)), ("b.png", coloured(1)), ("c.png", grayish(2))], None).unwrap();
    assert_eq!(values(&set.planes[0]), expected(0));
    assert_eq!(values(&set.planes[1]), expected(1));
    assert_eq!(set.notes, ["1 of 3 frames are in colour and were reduced to green: b.png"]);
    let set = load_files(&[("a.png", coloured(0)), ("b.png", coloured(1))], None).unwrap();
    assert_eq!(set.notes, ["all 2 frames are in colour and were reduced to green"]);
    assert!(load_files(&[("a.png", grayish(0))], None).unwrap().notes.is_empty());
    // Alpha says nothing about light.
    let data = narrow(0).into_iter().flat_map(|green| [7, green, 9, 3]).collect();
    let transparent = encode(image::RgbaImage::from_raw(WIDTH, HEIGHT, data).unwrap(), ImageFormat::Png);
    assert_eq!(values(&load_files(&[("a.png", transparent)], None).unwrap().planes[0]), expected(0));
}

#[test]
fn mixed_frames_are_refused_by_name() {
    let other = image::GrayImage::new(WIDTH + 1, HEIGHT);
    let png = |image| encode(image, ImageFormat::Png);
    let error = load_files(&[("a.png", png(gray8(0))), ("b.png", png(other))], None).unwrap_err().to_string();
    assert!(error.contains("b.png") && error.contains("7 x 5") && error.contains("6 x 5"), "{error}");
    let wide = encode(gray16(0), ImageFormat::Png);
    let error = load_files(&[("a.png", png(gray8(0))), ("b.png", wide)], None).unwrap_err().to_string();
    assert!(error.contains("b.png") && error.contains("16 bits") && error.contains("8 bits"), "{error}");
    let error = load_files(&[("a.png", b"hello".to_vec())], None).unwrap_err().to_string();
    assert!(error.contains("a.png") && error.contains("no image of a known kind"), "{error}");
}

#[test]
fn levels_beyond_the_samples_are_refused_without_a_bit_depth_too() {
    let load = |bytes: Vec<u8>, saturation, black_level| {
        let camera = Camera { saturation, black_level, ..Camera::default() };
        load_files(&[("a.png", bytes)], Some(camera)).map(drop).map_err(|error| error.to_string())
    };
    let eight = || encode(gray8(0), ImageFormat::Png);
    let error = load(eight(), Some(4095), Some(256.0)).unwrap_err();
    for part in ["`camera.saturation`: is 4095 DN", "`camera.black_level`: is 256 DN", "end at 255"] {
        assert!(error.contains(part), "{error}");
    }
    load(eight(), Some(255), Some(200.0)).unwrap();
    load(encode(gray16(0), ImageFormat::Png), Some(4095), Some(256.0)).unwrap();
}

#[test]
fn camera_and_frames_must_agree() {
    let png = || encode(gray16(0), ImageFormat::Png);
    let camera = |change: fn(&mut Camera)| {
        let mut camera = Camera::default();
        change(&mut camera);
        load_files(&[("a.png", png())], Some(camera)).unwrap_err().to_string()
    };
    let error = camera(|camera| camera.width = Some(7));
    assert!(error.contains("`camera.width` is 7 px, the frames have 6"), "{error}");
    let error = camera(|camera| camera.bit_depth = Some(8));
    assert!(error.contains("right-aligned"), "{error}");
    let eight = encode(gray8(0), ImageFormat::Png);
    let camera = Camera { bit_depth: Some(12), ..Camera::default() };
    let error = load_files(&[("a.png", eight)], Some(camera)).unwrap_err().to_string();
    assert!(error.contains("samples of 8 bits"), "{error}");
    // Sixteen bits that are never used would hide saturation, so that is told.
    let set = load_files(&[("a.png", png())], None).unwrap();
    assert!(set.notes[0].contains("no sample is above"), "{:?}", set.notes);
}

#[test]
fn vast_images_are_refused_by_their_headers() {
    let mut pgm = b"P5\n30000 30000\n255\n".to_vec();
    pgm.extend([0; 100]);
    let error = load_files(&[("a.pgm", pgm)], None).unwrap_err().to_string();
    assert!(error.contains("more than is read"), "{error}");
    // A PNG header that promises 65536 x 65536 pixels.
    let mut png = encode(gray8(0), ImageFormat::Png);
    png[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
    assert!(load_files(&[("a.png", png)], None).is_err());
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("a.png"), encode(gray8(0), ImageFormat::Png)).unwrap();
    let manifest = manifest(FrameFiles::Images(vec!["a.png".into(); 3]), 3);
    let small = Limits { max_total_bytes: 60, ..Limits::default() };
    let error = load(folder.path(), &manifest, Local, &small).unwrap_err().to_string();
    assert!(error.contains("take 90 bytes, at most 60"), "{error}");
}

#[test]
fn the_note_about_bits_names_what_to_give() {
    assert!(matches!(
        manifest(FrameFiles::Npy(String::new()), 3).sequence[2],
        Role::Code { axis: Axis::Column, .. }
    ));
    let set = load_bytes(&npy(1), 1).unwrap();
    assert!(set.notes[0].contains("`camera.bit_depth`"), "{:?}", set.notes);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn damaged_images_give_an_answer(kind in 0usize..6, at in 0.0f64..1.0, value in any::<u8>(), cut in 0.2f64..1.2) {
        let mut bytes = match kind {
            0 => encode(gray8(0), ImageFormat::Png),
            1 => encode(gray16(0), ImageFormat::Png),
            2 => encode(gray16(0), ImageFormat::Tiff),
            3 => encode(gray8(0), ImageFormat::Bmp),
            4 => encode(gray8(0), ImageFormat::Jpeg),
            _ => pgm16(0, 4095),
        };
        let at = (at * bytes.len() as f64) as usize;
        bytes[at] = value;
        bytes.truncate((cut * bytes.len() as f64) as usize);
        if let Ok(set) = load_files(&[("a", bytes)], None) {
            prop_assert_eq!(values(&set.planes[0]).len(), set.width * set.height);
        }
    }

    #[test]
    fn damaged_arrays_give_an_answer(at in 0.0f64..1.0, value in any::<u8>(), cut in 0.2f64..1.2) {
        let mut bytes = npy(2);
        let at = (at * bytes.len() as f64) as usize;
        bytes[at] = value;
        bytes.truncate((cut * bytes.len() as f64) as usize);
        if let Ok(set) = load_bytes(&bytes, 2) {
            prop_assert_eq!(values(&set.planes[1]).len(), set.width * set.height);
        }
    }
}
