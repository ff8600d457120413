//! Maps as TIFF and PNG. Both hold a JSON object that says how samples are read: TIFF as its ImageDescription, PNG as the text
//! `Description`.

use std::io::{self, Cursor, Write};

use tiff::{
    encoder::{TiffEncoder, TiffValue, colortype},
    tags::Tag,
};

use super::{
    PictureFormat,
    cloud::Origin,
    maps::{Key, MapName, Scale},
};
use crate::store::maps::Maps;

/// Sample of a measured pixel in a mask: what every viewer shows as white.
const MEASURED: u8 = 255;

/// The samples of a picture.
enum Samples<'a> {
    U8(Vec<u8>),
    U16(Vec<u16>),
    F32(&'a [f32]),
}

/// Writes a map and returns how its samples are read.
pub fn write(
    out: &mut dyn Write,
    maps: &Maps,
    map: MapName,
    format: PictureFormat,
    origin: &Origin,
) -> io::Result<Key> {
    let (samples, key) = samples(maps, map, format);
    let description = describe(&key, origin)?;
    let side = |side: usize| u32::try_from(side).map_err(io::Error::other);
    let size = (side(maps.mask.width())?, side(maps.mask.height())?);
    match format {
        PictureFormat::Png => png(out, size, &samples, &description)?,
        PictureFormat::Tiff | PictureFormat::TiffF32 => {
            out.write_all(&tiff(size, &samples, &description).map_err(io::Error::other)?)?;
        }
    }
    Ok(key)
}

fn samples(maps: &Maps, map: MapName, format: PictureFormat) -> (Samples<'_>, Key) {
    let same = Scale { scale: 1.0, offset: 0.0 };
    let key = Key {
        map: map.name(),
        unit: map.unit(),
        scale: same,
        no_value: None,
        bits: 8,
        values: maps.mask.len(),
    };
    let Some(values) = map.values(maps) else {
        let samples = match map {
            MapName::Mask => maps.mask.data().iter().map(|set| if *set { MEASURED } else { 0 }).collect(),
            _ => maps.class.data().to_vec(),
        };
        return (Samples::U8(samples), key);
    };
    let values = values.data();
    let key = Key { values: values.iter().filter(|value| value.is_finite()).count(), ..key };
    match format {
        PictureFormat::TiffF32 => (Samples::F32(values), Key { bits: 32, ..key }),
        PictureFormat::Tiff | PictureFormat::Png => {
            let scale = Scale::of(values);
            let samples = values.iter().map(|value| scale.sample(*value)).collect();
            (Samples::U16(samples), Key { scale, no_value: Some(0), bits: 16, ..key })
        }
    }
}

/// One line of ASCII, as TIFF wants it.
fn describe(key: &Key, origin: &Origin) -> io::Result<String> {
    let mut object = serde_json::to_value(key).map_err(io::Error::other)?;
    object["program"] = "polscan".into();
    let ascii = |letter: char| if letter.is_ascii() { letter } else { '?' };
    object["scan"] = origin.id.chars().map(ascii).collect::<String>().into();
    Ok(object.to_string())
}

fn tiff(size: (u32, u32), samples: &Samples<'_>, description: &str) -> tiff::TiffResult<Vec<u8>> {
    match samples {
        Samples::U8(samples) => tiff_of::<colortype::Gray8>(size, samples, description),
        Samples::U16(samples) => tiff_of::<colortype::Gray16>(size, samples, description),
        Samples::F32(samples) => tiff_of::<colortype::Gray32Float>(size, samples, description),
    }
}

/// Without compression, which every reader of TIFF can do without. Made in memory: the first bytes tell where the last ones are.
fn tiff_of<C: colortype::ColorType>(
    (width, height): (u32, u32),
    samples: &[C::Inner],
    description: &str,
) -> tiff::TiffResult<Vec<u8>>
where
    [C::Inner]: TiffValue,
{
    let mut file = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut file)?;
    let mut image = encoder.new_image::<C>(width, height)?;
    image.encoder().write_tag(Tag::ImageDescription, description)?;
    image.encoder().write_tag(Tag::Software, "polscan")?;
    image.write_data(samples)?;
    Ok(file.into_inner())
}

fn png(
    out: &mut dyn Write,
    (width, height): (u32, u32),
    samples: &Samples<'_>,
    description: &str,
) -> io::Result<()> {
    let (depth, bytes) = match samples {
        Samples::U8(samples) => (png::BitDepth::Eight, samples.clone()),
        Samples::U16(samples) => {
            (png::BitDepth::Sixteen, samples.iter().flat_map(|sample| sample.to_be_bytes()).collect())
        }
        Samples::F32(_) => {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "PNG has no floating-point samples"));
        }
    };
    let mut encoder = png::Encoder::new(out, width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    let failed = |error: png::EncodingError| match error {
        png::EncodingError::IoError(error) => error,
        other => io::Error::other(other),
    };
    for (keyword, text) in [("Description", description), ("Software", "polscan")] {
        encoder.add_text_chunk(keyword.to_owned(), text.to_owned()).map_err(failed)?;
    }
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(&bytes).map_err(failed)?;
    writer.finish().map_err(failed)
}
