use std::io::Cursor;

use super::*;
use crate::decode::{AxisMap, NoiseModel};

fn decoded(column: Vec<f32>, class: Vec<Class>) -> Decoded {
    let (width, height) = (column.len(), 1);
    let grid = |values: Vec<f32>| Grid::from_vec(width, height, values);
    Decoded {
        column: AxisMap {
            code: Grid::filled(width, height, 0),
            coordinate: grid(column),
            sigma: Grid::filled(width, height, 0.1),
        },
        row: None,
        class: Grid::from_vec(width, height, class),
        half_saturated: Grid::filled(width, height, false),
        interpolated: Grid::filled(width, height, false),
        modulation: Grid::filled(width, height, 5.0),
        residual: Grid::filled(width, height, f32::NAN),
        dolp: Grid::filled(width, height, 0.5),
        intensity: Grid::filled(width, height, 9),
        noise: NoiseModel { gain_dn_per_electron: 1.0, read_noise_dn: 1.0 },
        noise_estimated: false,
        black_level_dn: 0.0,
        pairs: Vec::new(),
        boundaries: Vec::new(),
        drift: None,
        losses: Vec::new(),
    }
}

fn nans(grid: &Grid<f32>) -> Vec<bool> {
    grid.data().iter().map(|value| value.is_nan()).collect()
}

#[test]
fn values_are_there_exactly_where_the_mask_is() {
    let decoded = decoded(
        vec![1.0, 2.0, 3.0, f32::NAN],
        vec![Class::Valid, Class::Edge, Class::Inverted, Class::Unlit],
    );
    // A later gate takes the second pixel out again.
    let class = Grid::from_vec(4, 1, vec![Class::Valid, Class::RowGate, Class::Inverted, Class::Unlit]);
    let depth = Grid::from_vec(4, 1, vec![900.0, 901.0, 902.0, 903.0]);
    let maps = Maps::new(&decoded, &class, None, Some(&depth)).unwrap();
    assert_eq!(maps.mask.data(), [true, false, true, false]);
    assert_eq!(nans(&maps.column), [false, true, false, true]);
    assert_eq!(nans(&maps.depth_mm), [false, true, false, true]);
    assert_eq!(nans(&maps.row), [true; 4]);
    assert_eq!(maps.class.data(), [1, 9, 3, 0]);
    let row = Grid::from_vec(4, 1, vec![7.0; 4]);
    let with_row = Maps::new(&decoded, &class, Some(&row), None).unwrap();
    assert_eq!(nans(&with_row.row), [false, true, false, true]);
    let without = Maps::new(&decoded, &class, None, None).unwrap();
    assert_eq!(nans(&without.depth_mm), [true; 4]);
    let mut bytes = Vec::new();
    maps.write(&mut bytes).unwrap();
    let read = Maps::read(Cursor::new(bytes)).unwrap();
    assert_eq!((read.mask.data(), read.class.data()), (maps.mask.data(), maps.class.data()));
    assert_eq!(read.column.at(2, 0), 3.0);
    assert_eq!(nans(&read.column), nans(&maps.column));
}

#[test]
fn a_valid_pixel_without_a_value_is_a_defect() {
    let decoded = decoded(vec![f32::NAN, 1.0], vec![Class::Valid, Class::Valid]);
    let error = Maps::new(&decoded, &decoded.class, None, None).unwrap_err().to_string();
    assert!(error.contains("1 valid pixels have no column"), "{error}");
    let depth = Grid::filled(3, 1, 1.0);
    let error = Maps::new(&decoded, &decoded.class, None, Some(&depth)).unwrap_err().to_string();
    assert!(error.contains("column"), "{error}");
}
