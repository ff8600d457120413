//! How far a decode is from the truth of a simulated scene.

use serde::{Deserialize, Serialize};

use super::{
    region::{self, NOTHING},
    statistics,
    types::{BorderReport, TruthReport},
};
use crate::{
    cloud::Cloud,
    decode::{Class, Decoded},
    grid::Grid,
    truth::Truth,
};

/// A column further off than this is wrong: beyond what sits between two neighbouring columns.
pub const WRONG_COLUMN: f64 = 1.5;

/// Agreement with the truth over a set of pixels that projector light reaches.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Accuracy {
    /// Pixels of the set.
    pub pixels: u64,
    /// Of those, pixels with a measurement.
    pub valid: u64,
    /// Of the valid ones, those whose column is off by more than [`WRONG_COLUMN`].
    pub wrong: u64,
    /// `valid / pixels`.
    pub coverage: Option<f64>,
    /// `wrong / valid`.
    pub wrong_code_rate: Option<f64>,
    /// Share of wrong ones among the words of all pixels that gave one, whatever the gates made of it later.
    pub wrong_code_rate_before_gates: Option<f64>,
    /// Root mean square of column minus truth over all valid pixels.
    pub column_rms_px: Option<f64>,
    /// The same for rows; `null` where rows were not coded.
    pub row_rms_px: Option<f64>,
    /// Root mean square of depth minus truth over all points, in mm; `null` without a calibration, as the next.
    pub depth_rmse_mm: Option<f64>,
    /// `1.4826 MAD((z - truth) / sigma_z)`: 1 where the claimed uncertainty is honest.
    pub sigma_z_ratio: Option<f64>,
}

/// Everything that an agreement is computed from.
#[derive(Clone, Copy)]
pub struct Measured<'a> {
    /// Columns and rows.
    pub decoded: &'a Decoded,
    /// Class after all gates.
    pub class: &'a Grid<Class>,
    /// Points, with a calibration.
    pub cloud: Option<&'a Cloud>,
}

/// Label of the object that a pixel's whole 5x5 neighbourhood sees, wholly lit; [`NOTHING`] elsewhere.
pub fn interior(truth: &Truth) -> Grid<u8> {
    let lit = truth.object.data().iter().zip(truth.column.data());
    let labels = lit.map(|(&object, column)| if column.is_finite() { object } else { NOTHING }).collect();
    region::off_borders(&Grid::from_vec(truth.object.width(), truth.object.height(), labels))
}

/// Agreement over `interior` (from [`interior`]) and over the rest.
pub fn against_truth(measured: Measured, truth: &Truth, interior: &Grid<u8>) -> TruthReport {
    let mut border = BorderReport { pixels: 0, valid: 0, wrong: 0, valid_in_shadow: 0 };
    for (index, &label) in interior.data().iter().enumerate() {
        if label != NOTHING {
            continue;
        }
        let expected = truth.column.data()[index];
        let valid = measured.class.data()[index].is_valid();
        if expected.is_finite() {
            border.pixels += 1;
            border.valid += u64::from(valid);
            border.wrong +=
                u64::from(valid && is_wrong(measured.decoded.column.coordinate.data()[index], expected));
        } else {
            border.valid_in_shadow += u64::from(valid);
        }
    }
    TruthReport { interior: accuracy(measured, truth, |index| interior.data()[index] != NOTHING), border }
}

/// Agreement over the pixels that `belongs` picks, which must be lit by the truth.
pub fn accuracy(measured: Measured, truth: &Truth, belongs: impl Fn(usize) -> bool) -> Accuracy {
    let Measured { decoded, class, cloud } = measured;
    let (mut pixels, mut valid, mut wrong, mut words, mut wrong_words) = (0, 0, 0, 0, 0);
    let (mut column, mut row, mut depth) = (Squares::default(), Squares::default(), Squares::default());
    let mut scaled = Vec::new();
    for index in (0..class.len()).filter(|&index| belongs(index)) {
        pixels += 1;
        let expected = truth.column.data()[index];
        let code = decoded.column.code.data()[index];
        if code >= 0 {
            words += 1;
            wrong_words += u64::from(is_wrong(code as f32, expected));
        }
        if !class.data()[index].is_valid() {
            continue;
        }
        valid += 1;
        let found = decoded.column.coordinate.data()[index];
        wrong += u64::from(is_wrong(found, expected));
        column.add(f64::from(found) - f64::from(expected));
        if let Some(rows) = &decoded.row {
            row.add(f64::from(rows.coordinate.data()[index]) - f64::from(truth.row.data()[index]));
        }
        if let Some(cloud) = cloud {
            let error = f64::from(cloud.point_mm.data()[index][2]) - f64::from(truth.depth_mm.data()[index]);
            depth.add(error);
            let ratio = error / f64::from(cloud.sigma_z_mm.data()[index]);
            scaled.extend(statistics::finite(ratio));
        }
    }
    Accuracy {
        pixels,
        valid,
        wrong,
        coverage: statistics::share(valid, pixels),
        wrong_code_rate: statistics::share(wrong, valid),
        wrong_code_rate_before_gates: statistics::share(wrong_words, words),
        column_rms_px: column.root_mean(),
        row_rms_px: row.root_mean(),
        depth_rmse_mm: depth.root_mean(),
        sigma_z_ratio: statistics::robust_sigma(&mut scaled),
    }
}

/// NaN is wrong too: a pixel that claims a measurement must have one.
fn is_wrong(column: f32, expected: f32) -> bool {
    let off = (f64::from(column) - f64::from(expected)).abs();
    off > WRONG_COLUMN || off.is_nan()
}

/// Sum of the squares of the finite samples.
#[derive(Default)]
struct Squares {
    sum: f64,
    count: u64,
}

impl Squares {
    fn add(&mut self, value: f64) {
        if value.is_finite() {
            self.sum += value * value;
            self.count += 1;
        }
    }

    fn root_mean(&self) -> Option<f64> {
        statistics::root_mean(self.sum, self.count)
    }
}
