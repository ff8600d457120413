use std::io::Cursor;

use proptest::prelude::*;

use super::*;

fn archive(floats: &Grid<f32>, bytes: &Grid<u8>, flags: &Grid<bool>) -> Vec<u8> {
    let mut out = Vec::new();
    write(
        &mut out,
        &[("depth", Array::F32(floats)), ("class", Array::U8(bytes)), ("mask", Array::Bool(flags))],
    )
    .unwrap();
    out
}

fn grids(width: usize, height: usize, seed: u32) -> (Grid<f32>, Grid<u8>, Grid<bool>) {
    let value = |index: usize| (index as u32).wrapping_mul(2_654_435_761).wrapping_add(seed);
    let all = |index| value(index);
    let indices = || 0..width * height;
    (
        Grid::from_vec(width, height, indices().map(|index| f32::from_bits(all(index))).collect()),
        Grid::from_vec(width, height, indices().map(|index| (all(index) >> 8) as u8).collect()),
        Grid::from_vec(width, height, indices().map(|index| all(index) & 1 == 1).collect()),
    )
}

#[test]
fn entries_are_stored_with_the_first_time_stamp_of_the_format() {
    let (floats, bytes, flags) = grids(5, 3, 7);
    let mut zip = ZipArchive::new(Cursor::new(archive(&floats, &bytes, &flags))).unwrap();
    for index in 0..3 {
        let entry = zip.by_index(index).unwrap();
        assert_eq!(entry.compression(), CompressionMethod::Stored);
        assert_eq!(entry.last_modified(), Some(DateTime::default()));
    }
}

#[test]
fn all_nans_are_written_alike() {
    let quiet = Grid::from_vec(2, 1, vec![f32::NAN, 1.0]);
    let other = Grid::from_vec(2, 1, vec![f32::from_bits(0xffc0_1234), 1.0]);
    let write_one = |grid| {
        let mut out = Vec::new();
        write(&mut out, &[("a", Array::F32(grid))]).unwrap();
        out
    };
    assert_eq!(write_one(&quiet), write_one(&other));
}

#[test]
fn a_missing_array_is_named() {
    let (floats, bytes, flags) = grids(2, 2, 1);
    let mut arrays = read(Cursor::new(archive(&floats, &bytes, &flags))).unwrap();
    let error = arrays.take_f32("class").unwrap_err();
    assert!(error.contains("float32") && error.contains("`class`") && error.contains("depth"), "{error}");
}

proptest! {
    #[test]
    fn arrays_come_back_and_equal_arrays_give_equal_bytes(width in 0usize..9, height in 0usize..9, seed in any::<u32>()) {
        let (floats, bytes, flags) = grids(width, height, seed);
        let written = archive(&floats, &bytes, &flags);
        prop_assert_eq!(&written, &archive(&floats, &bytes, &flags));
        let mut arrays = read(Cursor::new(written)).unwrap();
        let same = |a: &f32, b: &f32| a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan());
        let depth = arrays.take_f32("depth").unwrap();
        prop_assert!(depth.data().iter().zip(floats.data()).all(|(a, b)| same(a, b)));
        prop_assert_eq!((depth.width(), depth.height()), (width, height));
        prop_assert_eq!(arrays.take_u8("class").unwrap(), bytes);
        prop_assert_eq!(arrays.take_bool("mask").unwrap(), flags);
        prop_assert_eq!(arrays.names().count(), 0);
    }

    #[test]
    fn damage_is_an_error_or_harmless(seed in any::<u32>(), at in 0.0f64..1.0, value in any::<u8>(), cut in 0.0f64..1.0) {
        let (floats, bytes, flags) = grids(4, 4, seed);
        let mut written = archive(&floats, &bytes, &flags);
        let at = (at * written.len() as f64) as usize;
        written[at] = value;
        let _ = read(Cursor::new(&written));
        written.truncate((cut * written.len() as f64) as usize);
        prop_assert!(read(Cursor::new(&written)).is_err());
    }
}
