//! Pictures of maps: values as colours, pixel by pixel.

use image::{RgbImage, Rgba, RgbaImage};
use rayon::prelude::*;

use super::{
    canvas::{self, INK, WHITE, blank},
    text::{self, Ink},
};
use crate::{
    decode::{Class, Plane},
    grid::Grid,
    report::colormap::{Colormap, Rgb, TABLE_STEPS},
};

/// Values beyond this many sigma have the colour of the end in pictures of residuals.
const RESIDUAL_RANGE_SIGMA: f32 = 5.0;

/// Share of the values at each end that the range of a depth picture leaves out.
const DEPTH_TAIL: f64 = 0.002;

/// Values from which to which colours go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Value of the first colour.
    pub low: f32,
    /// Value of the last colour.
    pub high: f32,
}

impl Range {
    /// Range of the finite values but for a share of `tail` of them at each end; 0 to 1 where there is none. Equal values
    /// get a range around them.
    pub fn of(values: &[f32], tail: f64) -> Self {
        let mut finite: Vec<f32> = values.iter().copied().filter(|value| value.is_finite()).collect();
        let Some(last) = finite.len().checked_sub(1) else { return Self { low: 0.0, high: 1.0 } };
        let cut = (last as f64 * tail.clamp(0.0, 0.5)) as usize;
        let mut at = |index: usize| *finite.select_nth_unstable_by(index, f32::total_cmp).1;
        let (low, high) = (at(cut), at(last - cut));
        if high > low {
            return Self { low, high };
        }
        let around = (1e-3 * low.abs()).max(1e-3);
        Self { low: low - around, high: high + around }
    }

    /// Where `value` lies, 0 at `low` and 1 at `high`.
    pub fn share(self, value: f32) -> f32 {
        (value - self.low) / (self.high - self.low)
    }
}

/// How a map is shown.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MapStyle<'a> {
    /// Colours.
    pub map: Colormap,
    /// Values of the colours.
    pub range: Range,
    /// Colour where the value is NaN; white in the paper.
    pub missing: Rgb,
    /// Unit or name above the colour bar; `None` for a picture without a bar.
    pub bar: Option<&'a str>,
}

/// Colours of `values`, with a colour bar at the right if the style has one.
pub fn map_picture(values: &Grid<f32>, style: MapStyle<'_>) -> RgbImage {
    let table = style.map.table();
    let color = |value: &f32| match value.is_nan() {
        true => style.missing,
        false => table[step(style.range.share(*value))],
    };
    let picture = colored(values, color);
    match style.bar {
        Some(unit) => with_bar(&picture, style.map, style.range, unit),
        None => picture,
    }
}

/// Colours of `values` without a bar, transparent where the value is NaN: to lay over another picture.
pub fn map_overlay(values: &Grid<f32>, map: Colormap, range: Range) -> RgbaImage {
    let table = map.table();
    RgbaImage::from_fn(side(values.width()), side(values.height()), |x, y| {
        let value = values.at(x as usize, y as usize);
        let [red, green, blue] = table[step(range.share(value))];
        Rgba(if value.is_nan() { [0; 4] } else { [red, green, blue, 255] })
    })
}

/// Index into a colour table; a share that is NaN gives the first.
fn step(share: f32) -> usize {
    (share.clamp(0.0, 1.0) * (TABLE_STEPS - 1) as f32).round() as usize
}

fn side(side: usize) -> u32 {
    u32::try_from(side).unwrap_or(u32::MAX)
}

fn colored<T: Sync>(values: &Grid<T>, color: impl Fn(&T) -> Rgb + Sync) -> RgbImage {
    let mut picture = RgbImage::new(side(values.width()), side(values.height()));
    picture
        .par_chunks_exact_mut(3 * values.width().max(1))
        .zip(values.data().par_chunks_exact(values.width().max(1)))
        .for_each(|(pixels, row)| {
            for (pixel, value) in pixels.chunks_exact_mut(3).zip(row) {
                pixel.copy_from_slice(&color(value));
            }
        });
    picture
}

fn with_bar(picture: &RgbImage, map: Colormap, range: Range, unit: &str) -> RgbImage {
    let (width, height) = picture.dimensions();
    let letters = canvas::text_height(height);
    let mut image = blank(width + canvas::bar_width(letters), height, WHITE);
    image::imageops::replace(&mut image, picture, 0, 0);
    canvas::color_bar(&mut image, (width, 0, height), canvas::ColorBar { map, range, unit, letters });
    image
}

/// Index maps as in the paper: jet over the projector's `size`, white where there is no index.
fn index_picture(values: &Grid<f32>, size: u32, name: &str) -> RgbImage {
    let range = Range { low: 0.0, high: size.saturating_sub(1).max(1) as f32 };
    map_picture(values, MapStyle { map: Colormap::Jet, range, missing: WHITE, bar: Some(name) })
}

/// Projector column in px of a projector of `width` columns.
pub fn column_picture(column: &Grid<f32>, width: u32) -> RgbImage {
    index_picture(column, width, "column")
}

/// Projector row in px of a projector of `height` rows.
pub fn row_picture(row: &Grid<f32>, height: u32) -> RgbImage {
    index_picture(row, height, "row")
}

/// Depth in mm; `range` defaults to what the values span, but for a few outliers.
pub fn depth_picture(depth_mm: &Grid<f32>, range: Option<Range>) -> RgbImage {
    let range = range.unwrap_or_else(|| Range::of(depth_mm.data(), DEPTH_TAIL));
    map_picture(depth_mm, MapStyle { map: Colormap::Parula, range, missing: WHITE, bar: Some("mm") })
}

/// Degree of linear polarization, 0 black to 1 white.
pub fn dolp_picture(dolp: &Grid<f32>) -> RgbImage {
    let range = Range { low: 0.0, high: 1.0 };
    map_picture(dolp, MapStyle { map: Colormap::Gray, range, missing: [0; 3], bar: Some("DOLP") })
}

/// Pair-sum residual in units of its own noise, 0 to 5.
pub fn residual_picture(residual: &Grid<f32>) -> RgbImage {
    let range = Range { low: 0.0, high: RESIDUAL_RANGE_SIGMA };
    map_picture(residual, MapStyle { map: Colormap::Parula, range, missing: WHITE, bar: Some("sigma") })
}

/// Grey levels as they are.
pub fn intensity_picture(intensity: &Grid<u8>) -> RgbImage {
    colored(intensity, |&level| [level; 3])
}

/// A captured frame of `width` columns, `saturation_dn` white, with a gamma of 2.2 so that dark parts are seen.
/// The number of samples must be a multiple of `width`; what is left over is not shown.
pub fn frame_picture(plane: Plane<'_>, width: usize, saturation_dn: u16) -> RgbImage {
    let white = f32::from(saturation_dn.max(1));
    let shown: Vec<u8> = (0..=u32::from(u16::MAX))
        .map(|level| (255.0 * (level as f32 / white).min(1.0).powf(1.0 / 2.2)).round() as u8)
        .collect();
    let levels: Vec<u8> = match plane {
        Plane::U8(samples) => samples.iter().map(|&sample| shown[usize::from(sample)]).collect(),
        Plane::U16(samples) => samples.iter().map(|&sample| shown[usize::from(sample)]).collect(),
    };
    let height = levels.len().checked_div(width).unwrap_or(0);
    let width = if height == 0 { 0 } else { width };
    let levels = levels.into_iter().take(width * height).collect();
    intensity_picture(&Grid::from_vec(width, height, levels))
}

/// Name of a class in legends.
pub fn class_name(class: Class) -> &'static str {
    match class {
        Class::Unlit => "unlit",
        Class::Valid => "valid",
        Class::Edge => "edge",
        Class::Inverted => "inverted",
        Class::Saturated => "saturated",
        Class::Ambiguous => "ambiguous",
        Class::OffBoundary => "off boundary",
        Class::OutOfProjector => "out of projector",
        Class::OutOfVolume => "out of volume",
        Class::RowGate => "row gate",
        Class::Vote => "vote",
        Class::Interreflection => "interreflection",
    }
}

/// Colour of a class: greens and blues where there is a measurement, warm colours where one was rejected.
pub fn class_color(class: Class) -> Rgb {
    match class {
        Class::Unlit => [44, 46, 52],
        Class::Valid => [92, 184, 122],
        Class::Edge => [168, 222, 160],
        Class::Inverted => [72, 140, 214],
        Class::Saturated => [250, 240, 190],
        Class::Ambiguous => [242, 196, 58],
        Class::OffBoundary => [240, 140, 46],
        Class::OutOfProjector => [214, 80, 60],
        Class::OutOfVolume => [150, 44, 66],
        Class::RowGate => [202, 92, 186],
        Class::Vote => [126, 84, 200],
        Class::Interreflection => [128, 96, 66],
    }
}

/// The class of a number; numbers that are no class show as unlit.
fn class_of(number: u8) -> Class {
    Class::ALL.get(usize::from(number)).copied().unwrap_or(Class::Unlit)
}

/// Classes, with a legend of those that occur and their shares. Numbers that are no class show as unlit.
pub fn class_picture(class: &Grid<u8>) -> RgbImage {
    let picture = colored(class, |&number| class_color(class_of(number)));
    let (width, height) = picture.dimensions();
    let letters = canvas::text_height(height);
    let labels = class_labels(class);
    let widest = labels.iter().map(|(_, label)| text::width(label, letters)).fold(0.0, f32::max);
    let mut image = blank(width + (widest + 5.0 * letters) as u32, height, WHITE);
    image::imageops::replace(&mut image, &picture, 0, 0);
    class_legend(&mut image, class, (width, 0), letters);
    image
}

/// The classes that occur, with names and shares.
fn class_labels(class: &Grid<u8>) -> Vec<(Class, String)> {
    let mut counts = [0usize; Class::ALL.len()];
    for &number in class.data() {
        counts[class_of(number) as usize] += 1;
    }
    let occurring = Class::ALL.into_iter().filter(|&class| counts[class as usize] > 0);
    occurring
        .map(|of| {
            let percent = 100.0 * counts[of as usize] as f64 / class.len() as f64;
            let share = if percent < 0.05 { "< 0.1 %".to_owned() } else { format!("{percent:.1} %") };
            (of, format!("{} {share}", class_name(of)))
        })
        .collect()
}

/// Draws the legend of [`class_picture`] at (`x`, `y`) with capitals of `letters` px.
pub(super) fn class_legend(image: &mut RgbImage, class: &Grid<u8>, (x, y): (u32, u32), letters: f32) {
    let ink = Ink { height: letters, color: INK };
    for (index, (class, label)) in class_labels(class).iter().enumerate() {
        let (x, y) = (x as f32 + letters, y as f32 + (2.2 * index as f32 + 1.2) * letters);
        let (at, size) = ((x as u32, y as u32), ((1.4 * letters) as u32, (1.2 * letters) as u32));
        canvas::fill(image, at, size, class_color(*class));
        canvas::outline(image, at, size, INK);
        text::draw(image, label, (x + 2.2 * letters, y + 0.1 * letters), ink);
    }
}

/// The part of a picture that shows the map itself.
pub(super) fn without_margin(picture: &RgbImage, width: u32) -> RgbImage {
    image::imageops::crop_imm(picture, 0, 0, width.min(picture.width()), picture.height()).to_image()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp(width: usize, height: usize) -> Grid<f32> {
        Grid::from_vec(width, height, (0..width * height).map(|index| (index % width) as f32).collect())
    }

    #[test]
    fn pixels_have_the_colour_of_their_value_and_white_where_there_is_none() {
        let mut values = ramp(101, 60);
        values.data_mut()[5] = f32::NAN;
        let picture = column_picture(&values, 101);
        assert_eq!(picture.height(), 60);
        assert!(picture.width() > 101 + 40);
        for x in 0..101u32 {
            let expected = if x == 5 { WHITE } else { Colormap::Jet.color(x as f32 / 100.0) };
            let found = picture.get_pixel(x, 0).0;
            let distance = found.iter().zip(expected).map(|(a, b)| a.abs_diff(b)).max().unwrap();
            assert!(distance <= 2, "{x}: {found:?} {expected:?}");
        }
    }

    #[test]
    fn the_bar_shows_low_below_and_high_above() {
        let picture = dolp_picture(&Grid::filled(10, 400, 0.5));
        let column = 10 + canvas::text_height(400) as u32 + 4;
        let levels: Vec<u8> = (40..380).map(|y| picture.get_pixel(column, y).0[0]).collect();
        assert!(levels.windows(2).all(|pair| pair[0] >= pair[1]));
        assert!(levels[0] > 225 && levels[339] < 30, "{} {}", levels[0], levels[339]);
    }

    #[test]
    fn ranges_leave_outliers_out_and_never_collapse() {
        let mut values: Vec<f32> = (0..1000).map(|index| 900.0 + index as f32 * 0.1).collect();
        values.extend([f32::NAN, f32::INFINITY]);
        assert_eq!(Range::of(&values, 0.0), Range { low: 900.0, high: 999.9 });
        values[3] = 9e9;
        let range = Range::of(&values, 0.01);
        assert!(range.low > 900.0 && range.high < 1000.0, "{range:?}");
        assert_eq!(Range::of(&[f32::NAN], 0.0), Range { low: 0.0, high: 1.0 });
        let flat = Range::of(&[5.0; 9], 0.1);
        assert!(flat.low < 5.0 && flat.high > 5.0);
    }

    #[test]
    fn classes_have_colours_and_names_of_their_own_and_a_legend_of_what_occurs() {
        for (index, class) in Class::ALL.into_iter().enumerate() {
            for other in &Class::ALL[..index] {
                let distance: i32 = class_color(class)
                    .iter()
                    .zip(class_color(*other))
                    .map(|(&a, b)| (i32::from(a) - i32::from(b)).pow(2))
                    .sum();
                assert!(distance > 1500, "{class:?} looks like {other:?}");
                assert_ne!(class_name(class), class_name(*other));
            }
        }
        let one = class_picture(&Grid::filled(50, 200, 1));
        let all =
            class_picture(&Grid::from_vec(50, 200, (0..10_000).map(|index| (index % 13) as u8).collect()));
        assert!(all.width() > one.width());
        assert_eq!(one.get_pixel(7, 7).0, class_color(Class::Valid));
        assert_eq!(all.get_pixel(12, 0).0, class_color(Class::Unlit), "a number that is no class");
    }

    #[test]
    fn overlays_are_transparent_where_there_is_no_value() {
        let values = Grid::from_vec(2, 1, vec![f32::NAN, 1.0]);
        let overlay = map_overlay(&values, Colormap::Gray, Range { low: 0.0, high: 1.0 });
        assert_eq!((overlay.get_pixel(0, 0).0[3], overlay.get_pixel(1, 0).0), (0, [255; 4]));
    }

    #[test]
    fn empty_and_tiny_maps_give_pictures() {
        for (width, height) in [(0, 0), (1, 1), (3, 0), (2, 5)] {
            column_picture(&Grid::filled(width, height, f32::NAN), 1);
            depth_picture(&Grid::filled(width, height, 1.0), None);
            class_picture(&Grid::filled(width, height, 0));
            residual_picture(&Grid::filled(width, height, f32::INFINITY));
        }
        assert_eq!(frame_picture(Plane::U16(&[0, 4095, 5000, 7]), 3, 4095).dimensions(), (3, 1));
        assert_eq!(frame_picture(Plane::U8(&[]), 0, 255).dimensions(), (0, 0));
        assert_eq!(frame_picture(Plane::U16(&[4095, 0]), 2, 4095).into_raw(), [255, 255, 255, 0, 0, 0]);
    }

    #[test]
    fn margins_can_be_cut_off_again() {
        let values = ramp(20, 10);
        let plain = map_picture(
            &values,
            MapStyle { map: Colormap::Jet, range: Range { low: 0.0, high: 19.0 }, missing: WHITE, bar: None },
        );
        assert_eq!(without_margin(&column_picture(&values, 20), 20), plain);
        assert_eq!(plain.get_pixel(0, 0).0, Colormap::Jet.color(0.0));
    }
}
