//! Drawing on images: rectangles, lines, pictures within pictures, colour bars.

use image::{Rgb as Pixel, RgbImage, imageops};

use super::{
    maps::Range,
    text::{self, Ink, blend},
    ticks,
};
use crate::report::colormap::{Colormap, Rgb};

pub(super) const WHITE: Rgb = [255; 3];
pub(super) const INK: Rgb = [38, 42, 48];
pub(super) const FAINT: Rgb = [206, 210, 216];

pub(super) fn blank(width: u32, height: u32, color: Rgb) -> RgbImage {
    RgbImage::from_pixel(width, height, Pixel(color))
}

/// Fills columns `x..x + width` and rows `y..y + height`, as far as they lie in the image.
pub(super) fn fill(image: &mut RgbImage, (x, y): (u32, u32), (width, height): (u32, u32), color: Rgb) {
    for row in y..y.saturating_add(height).min(image.height()) {
        for column in x..x.saturating_add(width).min(image.width()) {
            image.put_pixel(column, row, Pixel(color));
        }
    }
}

/// A frame of one pixel around the rectangle.
pub(super) fn outline(image: &mut RgbImage, (x, y): (u32, u32), (width, height): (u32, u32), color: Rgb) {
    fill(image, (x, y), (width, 1), color);
    fill(image, (x, y + height.saturating_sub(1)), (width, 1), color);
    fill(image, (x, y), (1, height), color);
    fill(image, (x + width.saturating_sub(1), y), (1, height), color);
}

/// A line with soft edges, `width` px wide.
pub(super) fn line(image: &mut RgbImage, from: (f32, f32), to: (f32, f32), width: f32, color: Rgb) {
    let (dx, dy) = (to.0 - from.0, to.1 - from.1);
    let length_squared = dx * dx + dy * dy;
    if !length_squared.is_finite() {
        return;
    }
    let reach = 0.5 * width + 1.0;
    let span = |a: f32, b: f32, side: u32| {
        ((a.min(b) - reach).floor().max(0.0) as u32)
            ..((a.max(b) + reach).ceil().clamp(0.0, side as f32) as u32)
    };
    for row in span(from.1, to.1, image.height()) {
        for column in span(from.0, to.0, image.width()) {
            let (px, py) = (column as f32 + 0.5 - from.0, row as f32 + 0.5 - from.1);
            let along = ((px * dx + py * dy) / length_squared.max(1e-12)).clamp(0.0, 1.0);
            let distance = (px - along * dx).hypot(py - along * dy);
            blend(image, (column, row), color, (0.5 * width + 0.5 - distance).clamp(0.0, 1.0));
        }
    }
}

/// Shrinks a picture to fit into `width` x `height`, by area, so that thin stripes turn grey rather than into moiré.
/// Smaller pictures grow by whole factors, so that pixels stay square.
pub(super) fn fit(picture: &RgbImage, width: u32, height: u32) -> RgbImage {
    if picture.width() == 0 || picture.height() == 0 || width == 0 || height == 0 {
        return RgbImage::new(width.max(1), height.max(1));
    }
    let factor = (width / picture.width()).min(height / picture.height());
    if factor >= 1 {
        let (wide, high) = (picture.width() * factor, picture.height() * factor);
        return RgbImage::from_fn(wide, high, |x, y| *picture.get_pixel(x / factor, y / factor));
    }
    let scale =
        (f64::from(width) / f64::from(picture.width())).min(f64::from(height) / f64::from(picture.height()));
    let side = |side: u32| ((f64::from(side) * scale).round() as u32).max(1);
    imageops::thumbnail(picture, side(picture.width()), side(picture.height()))
}

/// Width that [`color_bar`] needs with capitals of `letters` px.
pub(super) fn bar_width(letters: f32) -> u32 {
    (letters * 9.0) as u32
}

/// Height of capitals that suits a picture of `height` px.
pub(super) fn text_height(height: u32) -> f32 {
    (height as f32 / 50.0).clamp(7.0, 24.0)
}

/// A colour bar to draw.
#[derive(Debug, Clone, Copy)]
pub(super) struct ColorBar<'a> {
    pub map: Colormap,
    pub range: Range,
    pub unit: &'a str,
    /// Height of capitals in px.
    pub letters: f32,
}

/// Draws a colour bar with ticks and unit into the margin that begins at column `x`, beside rows `y..y + height`.
pub(super) fn color_bar(image: &mut RgbImage, (x, y, height): (u32, u32, u32), bar: ColorBar<'_>) {
    let ColorBar { map, range, unit, letters: gap } = bar;
    let ink = Ink { height: gap, color: INK };
    // The unit stands above the bar, and half a number above and below its ends.
    let (top, bottom) = (y as f32 + 3.2 * gap, (y + height) as f32 - 1.2 * gap);
    text::draw(image, unit, (x as f32 + gap, y as f32 + 0.6 * gap), ink);
    if bottom - top < 2.0 {
        return;
    }
    let (left, width) = (x + gap as u32, (1.4 * gap) as u32);
    for row in top as u32..bottom as u32 {
        let share = 1.0 - (row as f32 + 0.5 - top) / (bottom - top);
        fill(image, (left, row), (width, 1), map.color(share));
    }
    outline(image, (left, top as u32), (width, (bottom - top) as u32), INK);
    let wanted = ((bottom - top) / (4.0 * gap)).clamp(1.0, 10.0) as usize;
    let (values, decimals) = ticks::ticks(range.low, range.high, wanted);
    for value in values {
        let at = bottom - range.share(value) * (bottom - top);
        let end = (left + width) as f32;
        line(image, (end, at), (end + 0.4 * gap, at), 1.0, INK);
        text::draw(image, &ticks::label(value, decimals), (end + 0.8 * gap, at - 0.5 * gap), ink);
    }
}
