//! Pictures of the page: small, and inside it.

use image::{
    DynamicImage, ExtendedColorType, ImageEncoder, RgbImage, RgbaImage,
    codecs::{
        jpeg::JpegEncoder,
        png::{CompressionType, FilterType, PngEncoder},
    },
    imageops,
};

use super::html::data_uri;
use crate::{
    decode::Class,
    grid::Grid,
    report::{
        colormap::Colormap,
        pictures::{Range, class_color, map_overlay},
    },
};

/// Width of the pictures in px; they are shown at about half of it.
const WIDTH: u32 = 760;

/// A picture and its address.
#[derive(Debug, Clone)]
pub struct Picture {
    /// A `data:` address.
    pub uri: String,
    /// Width in px.
    pub width: u32,
    /// Height in px.
    pub height: u32,
}

/// Bytes of an image that is as large as memory allows cannot fail to be encoded into memory.
const ENCODES: &str = "an image with sides above 0 is encoded into memory";

fn scaled(width: u32, height: u32) -> (u32, u32) {
    let shown = width.clamp(1, WIDTH);
    (shown, (u64::from(height) * u64::from(shown) / u64::from(width.max(1))).max(1) as u32)
}

/// A photograph: values in 0..=1 as grey levels, shown with a gamma of 2.2 where they are light.
pub fn photograph(values: &Grid<f32>, is_light: bool) -> Picture {
    let power = if is_light { 1.0 / 2.2 } else { 1.0 };
    let level = |value: &f32| (255.0 * value.clamp(0.0, 1.0).powf(power)).round() as u8;
    let levels = values.data().iter().map(level).collect();
    let image = image::GrayImage::from_raw(values.width() as u32, values.height() as u32, levels)
        .expect("a grid holds one value for each pixel");
    let (width, height) = scaled(image.width(), image.height());
    let small = imageops::resize(&image, width, height, imageops::FilterType::Triangle);
    jpeg(&DynamicImage::ImageLuma8(small))
}

fn jpeg(image: &DynamicImage) -> Picture {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, 88).encode_image(image).expect(ENCODES);
    Picture { uri: data_uri("image/jpeg", &bytes), width: image.width(), height: image.height() }
}

/// A part of an image, pixel by pixel.
pub fn pixels(values: &Grid<f32>, corner: (usize, usize), size: (usize, usize)) -> Picture {
    let part = RgbImage::from_fn(size.0 as u32, size.1 as u32, |x, y| {
        let (x, y) = (corner.0 + x as usize, corner.1 + y as usize);
        let inside = x < values.width() && y < values.height();
        let value = if inside { values.at(x, y) } else { 0.0 };
        image::Rgb([(255.0 * value.clamp(0.0, 1.0)).round() as u8; 3])
    });
    png(part.as_raw(), part.dimensions(), ExtendedColorType::Rgb8)
}

/// A map in colours, transparent where there is no value. Pixels are picked, not mixed: there is nothing between two
/// values of an index.
pub fn map(values: &Grid<f32>, map: Colormap, range: Range) -> Picture {
    overlay(&map_overlay(values, map, range))
}

/// Classes in their colours.
pub fn classes(class: &Grid<Class>) -> Picture {
    let image = RgbaImage::from_fn(class.width() as u32, class.height() as u32, |x, y| {
        let [red, green, blue] = class_color(class.at(x as usize, y as usize));
        image::Rgba([red, green, blue, 255])
    });
    overlay(&image)
}

fn overlay(image: &RgbaImage) -> Picture {
    let (width, height) = scaled(image.width(), image.height());
    let small = imageops::resize(image, width, height, imageops::FilterType::Nearest);
    png(small.as_raw(), small.dimensions(), ExtendedColorType::Rgba8)
}

/// A drawing as it is.
pub fn drawing(image: &RgbImage) -> Picture {
    png(image.as_raw(), image.dimensions(), ExtendedColorType::Rgb8)
}

fn png(bytes: &[u8], (width, height): (u32, u32), color: ExtendedColorType) -> Picture {
    let mut out = Vec::new();
    let encoder = PngEncoder::new_with_quality(&mut out, CompressionType::Best, FilterType::Adaptive);
    encoder.write_image(bytes, width, height, color).expect(ENCODES);
    Picture { uri: data_uri("image/png", &out), width, height }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_are_small_and_keep_their_shape() {
        let photo = photograph(&Grid::filled(1600, 1200, 0.4), true);
        assert_eq!((photo.width, photo.height), (760, 570));
        assert!(photo.uri.starts_with("data:image/jpeg;base64,"));
        let map = map(&Grid::filled(40, 3, f32::NAN), Colormap::Jet, Range { low: 0.0, high: 1.0 });
        assert_eq!((map.width, map.height), (40, 3));
        assert_eq!(
            pixels(&Grid::filled(4, 4, 0.0), (2, 2), (8, 6)).height,
            6,
            "beyond the image it is black"
        );
        assert_eq!(classes(&Grid::filled(2, 2, Class::Valid)).width, 2);
    }
}
