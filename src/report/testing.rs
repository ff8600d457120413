//! A small sound decode for tests, to be spoilt in one way each.

use polscan_patterns::{Axis, AxisCode, Mode, ProjectorSize};

use super::{ReportInput, Size};
use crate::{
    cloud::{Cloud, Reconstruction, RowCheck},
    decode::{AxisMap, CameraResponse, Class, DecodeSettings, Decoded, NoiseModel, PairResidual},
    grid::Grid,
    truth::{Truth, TruthObject},
};

pub const H_DN: f32 = 2000.0;
pub const V_DN: f32 = 40.0;
/// Camera pixels per projector pixel.
pub const SCALE: f32 = 1.6;

pub const PROJECTOR: ProjectorSize = ProjectorSize { width: 128, height: 96 };

pub fn settings(width: usize, height: usize) -> DecodeSettings {
    DecodeSettings {
        mode: Mode::Pse,
        column: AxisCode::centred(PROJECTOR.width).unwrap(),
        row: AxisCode::centred(PROJECTOR.height).unwrap(),
        width,
        height,
        camera: CameraResponse {
            bit_depth: 12,
            black_level_dn: Some(41.0),
            saturation_dn: 4095,
            noise: None,
        },
        thresholds: Default::default(),
    }
}

/// Every pixel lit, valid and exactly right.
pub fn decoded(width: usize, height: usize) -> Decoded {
    let axis = |of: fn(usize, usize) -> f32| {
        let mut coordinate = Vec::with_capacity(width * height);
        for y in 0..height {
            coordinate.extend((0..width).map(|x| of(x, y)));
        }
        AxisMap {
            code: Grid::from_vec(width, height, coordinate.iter().map(|u| u.round() as i32).collect()),
            coordinate: Grid::from_vec(width, height, coordinate),
            sigma: Grid::filled(width, height, 0.03),
        }
    };
    let pairs = [(Axis::Column, 10u8), (Axis::Row, 10)].into_iter().flat_map(|(axis, bits)| {
        (0..bits).map(move |bit| PairResidual {
            axis,
            bit,
            sigma: 1.0,
            median: 0.0,
            flat_outliers: 0.0,
            edge_outliers: 0.0,
            pixels: 100_000,
        })
    });
    Decoded {
        column: axis(|x, _| 3.0 + x as f32 / SCALE),
        row: Some(axis(|_, y| 5.0 + y as f32 / SCALE)),
        class: Grid::filled(width, height, Class::Valid),
        half_saturated: Grid::filled(width, height, false),
        interpolated: Grid::filled(width, height, true),
        modulation: Grid::filled(width, height, H_DN - V_DN),
        residual: Grid::filled(width, height, 1.0),
        dolp: Grid::filled(width, height, (H_DN - V_DN) / (H_DN + V_DN)),
        intensity: Grid::filled(width, height, 124),
        noise: NoiseModel { gain_dn_per_electron: 0.39, read_noise_dn: 0.9 },
        noise_estimated: false,
        black_level_dn: 41.0,
        pairs: pairs.collect(),
        boundaries: vec![],
        drift: Some(0.0),
        losses: vec![],
    }
}

/// Points of a plane 1 m away, one per pixel, 0.2 mm apart.
pub fn reconstruction(decoded: &Decoded) -> Reconstruction {
    let (width, height) = (decoded.class.width(), decoded.class.height());
    let points = (0..width * height).map(|i| {
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        [0.2 * x - 10.0, 0.2 * y - 5.0, 1000.0]
    });
    Reconstruction {
        cloud: Cloud {
            point_mm: Grid::from_vec(width, height, points.collect()),
            normal: Grid::filled(width, height, [0.0, 0.0, -1.0]),
            sigma_z_mm: Grid::filled(width, height, 0.4),
            flags: Grid::filled(width, height, 0),
        },
        class: decoded.class.clone(),
        predicted_row: None,
        row_check: Some(RowCheck {
            median_px: 0.01,
            sigma_px: 0.05,
            gate_px: 1.5,
            rejected_share: 0.0,
            rows_per_column: 0.01,
        }),
    }
}

/// What [`decoded`] and [`reconstruction`] should have found: one planar object.
pub fn truth(decoded: &Decoded) -> Truth {
    let (width, height) = (decoded.class.width(), decoded.class.height());
    Truth {
        column: decoded.column.coordinate.clone(),
        row: decoded.row.as_ref().map(|row| row.coordinate.clone()).unwrap(),
        depth_mm: Grid::filled(width, height, 1000.0),
        object: Grid::filled(width, height, 0),
        objects: vec![TruthObject { name: "plate".into(), planar: true }],
    }
}

pub fn input(decoded: &Decoded) -> ReportInput<'_> {
    let size = Size { width: decoded.class.width(), height: decoded.class.height() };
    ReportInput { decoded: Some(decoded), threads: 4, ..ReportInput::new(Mode::Pse, size, 44) }
}

/// The point of a pixel.
pub fn point(made: &Reconstruction, x: usize, y: usize) -> [f64; 3] {
    made.cloud.point_mm.at(x, y).map(f64::from)
}
