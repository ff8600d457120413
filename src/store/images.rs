//! One image file as one channel of samples.

use std::io::{BufRead, Cursor, Seek};

use image::{ColorType, DynamicImage, ImageDecoder, ImageReader};

use super::{frames::Limits, pnm};

/// What an image's header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Info {
    pub width: u32,
    pub height: u32,
    /// 8 or 16.
    pub sample_bits: u8,
}

/// Samples of one channel.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Samples {
    U8(Vec<u8>),
    U16(Vec<u16>),
}

/// How an image became one channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Reduction {
    /// It had one, or all were equal.
    None,
    /// Its channels differ, and the green one was taken.
    Green,
}

fn limited<R: BufRead + Seek>(source: R, limits: &Limits) -> Result<ImageReader<R>, String> {
    let mut reader = ImageReader::new(source).with_guessed_format().map_err(|error| error.to_string())?;
    if reader.format().is_none() {
        return Err("is no image of a known kind: give PNG, TIFF, PGM, BMP or JPEG".to_owned());
    }
    let mut bounds = image::Limits::no_limits();
    bounds.max_image_width = Some(limits.max_side);
    bounds.max_image_height = Some(limits.max_side);
    // Four channels of 16 bits, and as much again for a decoder's own needs.
    bounds.max_alloc = Some(limits.max_frame_samples.saturating_mul(16));
    reader.limits(bounds);
    Ok(reader)
}

fn damaged(error: image::ImageError) -> String {
    format!("cannot be read as an image: {error}")
}

/// Reads the header only. Errors are sentences that follow the file's name.
pub(super) fn probe(mut source: impl BufRead + Seek, limits: &Limits) -> Result<Info, String> {
    let start = source.fill_buf().map_err(|error| format!("cannot be read: {error}"))?;
    let info = if pnm::is_pnm(start) {
        let header = pnm::Header::parse(start)?;
        Info {
            width: header.width,
            height: header.height,
            sample_bits: if header.maximum > 255 { 16 } else { 8 },
        }
    } else {
        let decoder = limited(source, limits)?.into_decoder().map_err(damaged)?;
        let (width, height) = decoder.dimensions();
        Info { width, height, sample_bits: sample_bits(decoder.color_type())? }
    };
    if u64::from(info.width) * u64::from(info.height) > limits.max_frame_samples
        || info.width.max(info.height) > limits.max_side
    {
        return Err(format!("is {} x {} pixels, which is more than is read", info.width, info.height));
    }
    Ok(info)
}

fn sample_bits(colour: ColorType) -> Result<u8, String> {
    match colour {
        ColorType::L8 | ColorType::La8 | ColorType::Rgb8 | ColorType::Rgba8 => Ok(8),
        ColorType::L16 | ColorType::La16 | ColorType::Rgb16 | ColorType::Rgba16 => Ok(16),
        other => Err(format!(
            "has samples of type {other:?}, expected 8 or 16 bits: save it as 16-bit TIFF or PNG"
        )),
    }
}

/// Decodes a whole file whose header [`probe`] has passed.
pub(super) fn decode(bytes: &[u8], limits: &Limits) -> Result<(Samples, Reduction), String> {
    if pnm::is_pnm(bytes) {
        let header = pnm::Header::parse(bytes)?;
        let (samples, reduction) = green(header.samples(bytes)?, header.channels, header.channels);
        // The samples of a narrow file are at most 255 by its own maximum, which was checked.
        return Ok(match header.maximum > 255 {
            true => (Samples::U16(samples), reduction),
            false => (Samples::U8(samples.into_iter().map(|sample| sample as u8).collect()), reduction),
        });
    }
    let decoder = limited(Cursor::new(bytes), limits)?.into_decoder().map_err(damaged)?;
    let image = DynamicImage::from_decoder(decoder).map_err(damaged)?;
    let wide = |(samples, reduction)| (Samples::U16(samples), reduction);
    let narrow = |(samples, reduction)| (Samples::U8(samples), reduction);
    // An alpha channel says nothing about light and is left out.
    Ok(match image {
        DynamicImage::ImageLuma8(image) => (Samples::U8(image.into_raw()), Reduction::None),
        DynamicImage::ImageLuma16(image) => (Samples::U16(image.into_raw()), Reduction::None),
        DynamicImage::ImageLumaA8(image) => narrow(green(image.into_raw(), 2, 1)),
        DynamicImage::ImageLumaA16(image) => wide(green(image.into_raw(), 2, 1)),
        DynamicImage::ImageRgb8(image) => narrow(green(image.into_raw(), 3, 3)),
        DynamicImage::ImageRgb16(image) => wide(green(image.into_raw(), 3, 3)),
        DynamicImage::ImageRgba8(image) => narrow(green(image.into_raw(), 4, 3)),
        DynamicImage::ImageRgba16(image) => wide(green(image.into_raw(), 4, 3)),
        other => return Err(format!("has samples of type {:?}, expected 8 or 16 bits", other.color())),
    })
}

/// The green channel of pixels of `stride` samples, the first `colours` of which are colours.
fn green<T: Copy + PartialEq>(samples: Vec<T>, stride: usize, colours: usize) -> (Vec<T>, Reduction) {
    if stride == 1 {
        return (samples, Reduction::None);
    }
    let chosen = usize::from(colours == 3);
    let equal = colours == 1
        || samples.chunks_exact(stride).all(|pixel| pixel[0] == pixel[1] && pixel[1] == pixel[2]);
    let plane = samples.chunks_exact(stride).map(|pixel| pixel[chosen]).collect();
    (plane, if equal { Reduction::None } else { Reduction::Green })
}
