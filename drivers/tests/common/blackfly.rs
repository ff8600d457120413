//! A Blackfly-like camera in software.
#![allow(dead_code, reason = "each test binary uses its own part")]

use std::{fs, path::PathBuf, sync::LazyLock};

use polscan_drivers::aravis::fake::{Exposure, Fake};

/// Registers of the camera in software, as `blackfly.xml` lays them out.
pub mod register {
    pub const WIDTH: u32 = 0x100;
    pub const HEIGHT: u32 = 0x104;
    pub const SENSOR_HEIGHT: u32 = 0x118;
    pub const SENSOR_WIDTH: u32 = 0x11c;
    pub const EXPOSURE_US: u32 = 0x120;
    pub const PIXEL_FORMAT: u32 = 0x128;
    pub const OFFSET_X: u32 = 0x130;
    pub const OFFSET_Y: u32 = 0x134;
    pub const TRIGGER_MODE: u32 = 0x300;
    pub const TRIGGER_SOURCE: u32 = 0x304;
    pub const EXPOSURE_AUTO: u32 = 0x1000;
    pub const GAIN_AUTO: u32 = 0x1004;
    pub const EXPOSURE_MODE: u32 = 0x1008;
    pub const GAIN: u32 = 0x1010;
    pub const GAMMA_ENABLE: u32 = 0x1018;
    pub const GAMMA: u32 = 0x101c;
    pub const BLACK_LEVEL: u32 = 0x1020;
    pub const FRAME_RATE_ENABLE: u32 = 0x1024;
    pub const RESULTING_FRAME_RATE: u32 = 0x1028;
    pub const TRIGGER_OVERLAP: u32 = 0x102c;
    pub const TRIGGER_DELAY: u32 = 0x1030;
    pub const ISP_ENABLE: u32 = 0x1034;
    pub const USER_SET_LOAD: u32 = 0x1040;
    pub const LINE_SOURCE: u32 = 0x1050;
}

pub fn blackfly() -> PathBuf {
    [env!("CARGO_MANIFEST_DIR"), "tests", "data", "blackfly.xml"].iter().collect()
}

/// `blackfly.xml` with parts replaced.
pub fn variant(name: &str, replacements: &[(&str, &str)]) -> PathBuf {
    static FOLDER: LazyLock<tempfile::TempDir> = LazyLock::new(|| tempfile::tempdir().unwrap());
    let mut text = fs::read_to_string(blackfly()).unwrap();
    for (from, to) in replacements {
        assert!(text.contains(from), "{from}");
        text = text.replace(from, to);
    }
    let path = FOLDER.path().join(name);
    fs::write(&path, text).unwrap();
    path
}

/// Sample of an exposure in DN, different for all that can be mixed up.
pub fn dn(exposure: &Exposure, x: usize, y: usize, depth: u32) -> u16 {
    let mixed = x * 3 + y * 5 + exposure.number as usize * 17 + exposure.exposure_us as usize / 100;
    (mixed * 37 % 65521 % (1 << depth)) as u16
}

fn depth(format: u32) -> u32 {
    match format {
        0x0108_0001 => 8,
        0x0110_0007 => 16,
        _ => 12,
    }
}

/// Paints as a camera sends, one sample after the other.
pub fn paint(exposure: Exposure, bytes: &mut [u8]) {
    let depth = depth(exposure.format);
    let all = (0..exposure.height).flat_map(|y| (0..exposure.width).map(move |x| (x, y)));
    let all: Vec<u16> = all.map(|(x, y)| dn(&exposure, x, y, depth)).collect();
    match exposure.format {
        0x0108_0001 => bytes.iter_mut().zip(all).for_each(|(byte, dn)| *byte = dn as u8),
        0x0110_0007 => {
            bytes.chunks_exact_mut(2).zip(all).for_each(|(pair, dn)| pair.copy_from_slice(&dn.to_le_bytes()));
        }
        format => {
            let packed = format == 0x010c_0006;
            for (group, pair) in bytes.chunks_exact_mut(3).zip(all.chunks_exact(2)) {
                let [a, b] = [u32::from(pair[0]), u32::from(pair[1])];
                let word =
                    if packed { a >> 4 | (a & 15) << 8 | (b & 15) << 12 | b >> 4 << 16 } else { a | b << 12 };
                group.copy_from_slice(&word.to_le_bytes()[..3]);
            }
        }
    }
}

pub fn camera(genicam: Option<PathBuf>) -> Fake {
    let fake = Fake::new("PS-17", genicam.as_deref(), paint).unwrap();
    fake.poke(register::SENSOR_WIDTH, 1920);
    fake.poke(register::SENSOR_HEIGHT, 1200);
    fake.poke(register::GAMMA, 0.8f32.to_bits());
    fake.poke(register::BLACK_LEVEL, 1.0f32.to_bits());
    fake.poke(register::GAIN, 5.0f32.to_bits());
    fake.poke(register::RESULTING_FRAME_RATE, 163.0f32.to_bits());
    fake.poke(register::TRIGGER_DELAY, 100.0f32.to_bits());
    fake
}
