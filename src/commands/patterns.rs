//! `polscan patterns`: the pictures of a mode as PNG, with the manifest of a capture of them.

use std::{path::Path, str::FromStr};

use polscan_patterns::{Mode, ProjectorSize, Sequence};

use crate::{
    config::Settings,
    engine::Failure,
    store::{BundleWriter, Manifest, error::StorageError, manifest::FrameFiles},
};

/// A projector size on the command line.
#[derive(Debug, Clone, Copy)]
pub struct Size(pub(super) ProjectorSize);

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let (width, height) = text.split_once('x').ok_or("expected WIDTHxHEIGHT, such as 1024x768")?;
        let side = |text: &str| match text.parse::<u32>() {
            Ok(side @ 1..=8192) => Ok(side),
            _ => Err(format!("`{text}` is not a side of 1 to 8192 pixels")),
        };
        Ok(Self(ProjectorSize { width: side(width)?, height: side(height)? }))
    }
}

/// Writes one PNG per frame, and a manifest under which the folder is itself a bundle that decodes to the identity.
pub fn patterns(
    settings: &Settings,
    mode: Mode,
    size: Option<Size>,
    out: &Path,
    json: bool,
) -> Result<u8, Failure> {
    let size = match size {
        Some(Size(size)) => size,
        None => configured_size(settings)?,
    };
    let sequence = Sequence::new(mode, size).map_err(|error| Failure::data("make the patterns", error))?;
    let failed = |error: StorageError| Failure::storage("write the patterns", error);
    let writer = BundleWriter::create(out, None, 0).map_err(failed)?;
    let mut names = Vec::new();
    for (number, role) in sequence.roles.iter().enumerate() {
        let name = format!("{number:02}_{}.png", role.to_string().replace(' ', "-"));
        let bytes = sequence.raster(*role, settings.polarization).to_rgb(size);
        let picture = image::RgbImage::from_raw(size.width, size.height, bytes)
            .expect("a raster holds three bytes for each pixel of its size");
        writer.png(&name, &picture).map_err(failed)?;
        names.push(name);
    }
    let mut manifest = Manifest::new(&sequence, FrameFiles::Images(names.clone()));
    manifest.stamp(std::time::SystemTime::now());
    writer.finish(manifest).map_err(failed)?;
    if json {
        let object = serde_json::json!({ "out": out, "mode": mode, "projector": size, "frames": names });
        super::say(object);
    } else {
        super::say(format_args!(
            "{} patterns of mode {mode} for {}x{} px, described by manifest.json, in {}",
            names.len(),
            size.width,
            size.height,
            out.display()
        ));
    }
    Ok(0)
}

/// Size of the configured projector.
fn configured_size(settings: &Settings) -> Result<ProjectorSize, Failure> {
    let rig = crate::app::Rig::open(settings).map_err(|error| Failure::NoDevice {
        operation: "choose the size of the patterns",
        message: format!("{error}; or give --size WIDTHxHEIGHT"),
    })?;
    let info = rig.projector.info();
    Ok(ProjectorSize { width: info.width, height: info.height })
}
