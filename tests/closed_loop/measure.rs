//! How far a result is from the twin's truth, computed here from its maps and its points alone.

use std::{collections::BTreeMap, io::Cursor};

use polscan::{
    cloud::{fit_plane, read_ply},
    store::maps::Maps,
};
use polscan_drivers::sim::Truth;

/// A column further off than this is wrong: beyond what sits between two neighbouring columns.
const WRONG_COLUMN: f32 = 1.5;

/// Pixels around one that must see the same surface, wholly lit, for it to count: off silhouettes and shadows.
const REACH: usize = 2;

/// Agreement on one object of the scene.
#[derive(Debug, Default)]
pub struct Plate {
    /// Pixels of the object off its borders.
    pub pixels: usize,
    /// Of those, pixels with a measurement.
    pub valid: usize,
    /// Of these, wrong columns.
    pub wrong: usize,
    /// Root mean square distance of the points from the plane that fits them best, in mm.
    pub plane_rms_mm: f64,
    /// Root mean square of depth minus truth in mm.
    pub depth_rms_mm: f64,
}

impl Plate {
    /// Share of the pixels with a measurement.
    pub fn coverage(&self) -> f64 {
        self.valid as f64 / self.pixels as f64
    }
}

/// Agreement with the truth per object, of `maps.npz` and `cloud.ply`.
pub fn plates(truth: &Truth, maps: &[u8], cloud: &[u8]) -> BTreeMap<String, Plate> {
    let maps = Maps::read(Cursor::new(maps)).expect("maps");
    let points = read_ply(cloud).expect("a cloud");
    let valid = maps.mask.data();
    assert_eq!(valid.len(), truth.depth_mm.len());
    assert_eq!(points.len(), valid.iter().filter(|valid| **valid).count(), "one point a measurement");
    let mut points = points.into_iter();
    let mut plates: BTreeMap<String, Plate> = BTreeMap::new();
    let mut fits: BTreeMap<String, Vec<[f64; 3]>> = BTreeMap::new();
    for (pixel, valid) in valid.iter().enumerate() {
        // Points lie in the order of the pixels that have one.
        let point = valid.then(|| points.next().expect("a point").point_mm);
        if !is_inside(truth, pixel) {
            continue;
        }
        let name = truth.objects[usize::from(truth.object[pixel])].name.clone();
        let plate = plates.entry(name.clone()).or_default();
        plate.pixels += 1;
        let Some(point) = point else { continue };
        plate.valid += 1;
        let off = (maps.column.data()[pixel] - truth.column[pixel]).abs();
        plate.wrong += usize::from(off > WRONG_COLUMN);
        fits.entry(name).or_default().push(point.map(f64::from));
        plate.depth_rms_mm += f64::from(point[2] - truth.depth_mm[pixel]).powi(2);
    }
    for (name, plate) in &mut plates {
        plate.depth_rms_mm = (plate.depth_rms_mm / plate.valid as f64).sqrt();
        plate.plane_rms_mm = fit_plane(&fits[name]).expect("a plane").rmse_mm;
    }
    plates
}

/// Whether everything around a pixel is the same surface in the projector's light.
fn is_inside(truth: &Truth, pixel: usize) -> bool {
    let (x, y) = (pixel % truth.width, pixel / truth.width);
    let inner = |at: usize, size: usize| (REACH..size - REACH).contains(&at);
    inner(x, truth.width)
        && inner(y, truth.height)
        && (y - REACH..=y + REACH).all(|row| {
            let around = row * truth.width + x - REACH..=row * truth.width + x + REACH;
            around
                .into_iter()
                .all(|near| truth.object[near] == truth.object[pixel] && truth.column[near].is_finite())
        })
}
