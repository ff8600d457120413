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
    /// Of the valid ones, those whose column is off by more than 1.5.
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::report::testing;

    /// 20 x 12 pixels, all right; then `spoil`.
    fn judged(spoil: impl FnOnce(&mut Decoded, &mut Cloud, &mut Truth)) -> TruthReport {
        let mut decoded = testing::decoded(20, 12);
        let mut truth = testing::truth(&decoded);
        let mut made = testing::reconstruction(&decoded);
        spoil(&mut decoded, &mut made.cloud, &mut truth);
        let measured = Measured { decoded: &decoded, class: &decoded.class, cloud: Some(&made.cloud) };
        against_truth(measured, &truth, &interior(&truth))
    }

    /// Pixels 2 px off the border of the image.
    const INTERIOR: u64 = 16 * 8;

    #[test]
    fn a_perfect_decode_is_perfect() {
        let report = judged(|_, _, _| {});
        assert_eq!(
            report.interior,
            Accuracy {
                pixels: INTERIOR,
                valid: INTERIOR,
                wrong: 0,
                coverage: Some(1.0),
                wrong_code_rate: Some(0.0),
                wrong_code_rate_before_gates: Some(0.0),
                column_rms_px: Some(0.0),
                row_rms_px: Some(0.0),
                depth_rmse_mm: Some(0.0),
                sigma_z_ratio: Some(0.0),
            }
        );
        let all = 20 * 12;
        assert_eq!(
            report.border,
            BorderReport { pixels: all - INTERIOR, valid: all - INTERIOR, wrong: 0, valid_in_shadow: 0 }
        );
    }

    #[test]
    fn every_figure_has_its_known_value() {
        let at = |x: usize, y: usize| y * 20 + x;
        let report = judged(|decoded, cloud, _| {
            // Inside: one wrong column (off by 3), one rejected with a wrong word, one rejected without a word.
            decoded.column.coordinate.data_mut()[at(5, 5)] += 3.0;
            decoded.class.data_mut()[at(6, 5)] = Class::Vote;
            decoded.column.code.data_mut()[at(6, 5)] += 7;
            decoded.class.data_mut()[at(7, 5)] = Class::Ambiguous;
            decoded.column.code.data_mut()[at(7, 5)] = -1;
            // At the border: one wrong.
            decoded.column.coordinate.data_mut()[at(1, 5)] -= 2.0;
            // Rows off by half a pixel, depths by 0.8 mm at every other pixel: two sigma of 0.4 mm.
            decoded.row.as_mut().unwrap().coordinate.data_mut().iter_mut().for_each(|v| *v += 0.5);
            for (index, point) in cloud.point_mm.data_mut().iter_mut().enumerate() {
                point[2] += if index % 2 == 0 { 0.8 } else { -0.8 };
            }
        });
        let inside = report.interior;
        assert_eq!((inside.pixels, inside.valid, inside.wrong), (INTERIOR, INTERIOR - 2, 1));
        assert_eq!(inside.coverage, Some(126.0 / 128.0));
        assert_eq!(inside.wrong_code_rate, Some(1.0 / 126.0));
        assert_eq!(inside.wrong_code_rate_before_gates, Some(1.0 / 127.0));
        assert!((inside.column_rms_px.unwrap() - (9.0f64 / 126.0).sqrt()).abs() < 1e-6);
        assert!((inside.row_rms_px.unwrap() - 0.5).abs() < 1e-6);
        assert!((inside.depth_rmse_mm.unwrap() - 0.8).abs() < 1e-4);
        // Half at +2, half at -2: the median lies between, so the deviation is 2.
        assert!((inside.sigma_z_ratio.unwrap() - 1.4826 * 2.0).abs() < 1e-2, "{inside:?}");
        assert_eq!((report.border.pixels, report.border.valid, report.border.wrong), (112, 112, 1));
    }

    #[test]
    fn a_shadow_or_another_surface_keeps_two_pixels_clear() {
        // Left of column 8 another object; right of column 14 shadow.
        let report = judged(|decoded, _, truth| {
            for index in 0..240 {
                let x = index % 20;
                if x < 8 {
                    truth.object.data_mut()[index] = 1;
                }
                if x > 14 {
                    truth.column.data_mut()[index] = f32::NAN;
                    decoded.class.data_mut()[index] = if x == 15 { Class::Valid } else { Class::Unlit };
                }
            }
        });
        // Columns 2..=5 and 10..=12 of rows 2..=9.
        assert_eq!(report.interior.pixels, 7 * 8);
        assert_eq!(report.border.pixels, 15 * 12 - 7 * 8);
        assert_eq!(report.border.valid_in_shadow, 12);
        assert_eq!(report.border.wrong, 0);
    }

    #[test]
    fn off_by_one_and_a_half_is_not_wrong_yet_and_no_number_is() {
        assert!(!is_wrong(11.5, 10.0) && !is_wrong(8.5, 10.0));
        assert!(is_wrong(11.51, 10.0) && is_wrong(8.49, 10.0) && is_wrong(f32::NAN, 10.0));
    }

    #[test]
    fn nothing_seen_gives_no_figures() {
        let report = judged(|_, _, truth| truth.object.data_mut().fill(NOTHING));
        assert_eq!(report.interior, Accuracy::default());
    }

    proptest! {
        #[test]
        fn turning_the_image_over_changes_nothing(seed in prop::collection::vec(0u8..12, 240), off in prop::collection::vec(-3.0f32..3.0, 240)) {
            let judge = |over: bool| judged(|decoded, cloud, truth| {
                for index in 0..240 {
                    decoded.class.data_mut()[index] = Class::ALL[usize::from(seed[index])];
                    decoded.column.coordinate.data_mut()[index] += off[index];
                    truth.object.data_mut()[index] = if seed[index / 60 * 60] < 3 { 1 } else { 0 };
                }
                if over {
                    decoded.class.data_mut().reverse();
                    for axis in [&mut decoded.column, decoded.row.as_mut().unwrap()] {
                        axis.code.data_mut().reverse();
                        axis.coordinate.data_mut().reverse();
                    }
                    cloud.point_mm.data_mut().reverse();
                    for grid in [&mut truth.column, &mut truth.row, &mut truth.depth_mm] {
                        grid.data_mut().reverse();
                    }
                    truth.object.data_mut().reverse();
                }
            });
            let (plain, over) = (judge(false), judge(true));
            prop_assert_eq!(plain.border, over.border);
            let (a, b) = (plain.interior, over.interior);
            prop_assert_eq!((a.pixels, a.valid, a.wrong, a.coverage), (b.pixels, b.valid, b.wrong, b.coverage));
            prop_assert_eq!(a.wrong_code_rate_before_gates, b.wrong_code_rate_before_gates);
            prop_assert!((a.column_rms_px.unwrap_or(0.0) - b.column_rms_px.unwrap_or(0.0)).abs() < 1e-9);
        }
    }
}
