//! A scan in the formats of other programs. Pure: an organised cloud or a map goes in, bytes come out.

mod cloud;
mod e57;
mod maps;
mod mesh;
mod obj;
mod pcd;
mod picture;
mod read;
mod xyz;

use std::io::{self, Write};

use serde::Serialize;

use crate::store::maps::Maps;

pub use cloud::{Organised, Origin};
pub use maps::{MapName, Scale};
pub use mesh::{Mesh, mesh};

/// Points, or a surface through them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum PointFormat {
    /// ASTM E2807: metres.
    E57,
    /// Point Cloud Library, binary, one place per camera pixel.
    Pcd,
    /// Text, one point a line.
    Xyz,
    /// Triangles, as text.
    Obj,
}

/// A map as a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum PictureFormat {
    /// 16 bits with scale and offset; 8 bits for class and mask.
    Tiff,
    /// 32-bit floating point, the values themselves.
    TiffF32,
    /// As [`PictureFormat::Tiff`].
    Png,
}

/// One file that can be made of a scan.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Item {
    /// Of the cloud.
    Cloud(PointFormat),
    /// Of one of the maps.
    Map(MapName, PictureFormat),
}

impl Item {
    /// All of them, in the order in which they are listed.
    pub fn all() -> impl Iterator<Item = Self> {
        let points = [PointFormat::E57, PointFormat::Pcd, PointFormat::Xyz, PointFormat::Obj];
        let pictures = [PictureFormat::Tiff, PictureFormat::TiffF32, PictureFormat::Png];
        let maps = pictures
            .into_iter()
            .flat_map(|format| MapName::ALL.into_iter().map(move |map| Self::Map(map, format)));
        points.into_iter().map(Self::Cloud).chain(maps.filter(|item| item.exists()))
    }

    /// Whether there is such a file: class and mask have no fractions to keep.
    pub fn exists(self) -> bool {
        !matches!(self, Self::Map(MapName::Class | MapName::Mask, PictureFormat::TiffF32))
    }

    /// Its file name: `cloud.e57`, `mesh.obj`, `depth.tiff`, `depth.f32.tiff`.
    pub fn file_name(self) -> String {
        match self {
            Self::Cloud(PointFormat::E57) => "cloud.e57".to_owned(),
            Self::Cloud(PointFormat::Pcd) => "cloud.pcd".to_owned(),
            Self::Cloud(PointFormat::Xyz) => "cloud.xyz".to_owned(),
            Self::Cloud(PointFormat::Obj) => "mesh.obj".to_owned(),
            Self::Map(map, PictureFormat::Tiff) => format!("{}.tiff", map.name()),
            Self::Map(map, PictureFormat::TiffF32) => format!("{}.f32.tiff", map.name()),
            Self::Map(map, PictureFormat::Png) => format!("{}.png", map.name()),
        }
    }

    /// The item of a file name.
    pub fn from_file_name(name: &str) -> Option<Self> {
        Self::all().find(|item| item.file_name() == name)
    }

    /// Media type of the file.
    pub fn media_type(self) -> &'static str {
        match self {
            Self::Cloud(PointFormat::E57) => "model/e57",
            Self::Cloud(PointFormat::Pcd) => "application/octet-stream",
            Self::Cloud(PointFormat::Xyz) => "text/plain; charset=utf-8",
            Self::Cloud(PointFormat::Obj) => "model/obj",
            Self::Map(_, PictureFormat::Tiff | PictureFormat::TiffF32) => "image/tiff",
            Self::Map(_, PictureFormat::Png) => "image/png",
        }
    }
}

/// What a file holds besides its bytes.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Content {
    /// Number of points.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub points: Option<usize>,
    /// Number of triangles.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub triangles: Option<usize>,
    /// How samples are read as values.
    #[serde(flatten, skip_serializing_if = "Option::is_none")]
    pub map: Option<maps::Key>,
}

/// What files are made from.
#[derive(Debug)]
pub struct Scan {
    /// What the files say of where they come from.
    pub origin: Origin,
    /// The maps.
    pub maps: Maps,
    /// The points; `None` for a scan without calibration.
    pub cloud: Option<Organised>,
}

impl Scan {
    /// Why `item` cannot be made of this scan; `None` where it can.
    pub fn lacks(&self, item: Item) -> Option<String> {
        match item {
            Item::Cloud(_) if self.cloud.is_none() => Some(
                "the scan has no cloud.ply because it was decoded without a calibration; `polscan decode \
                      --calibration FILE` makes one"
                    .to_owned(),
            ),
            Item::Map(map, _) if !map.has_values(&self.maps) => {
                Some(format!("the map `{}` of the scan holds no value", map.name()))
            }
            _ => None,
        }
    }

    /// Writes `item`, which must not be lacking.
    ///
    /// # Errors
    /// Those of `out`; `InvalidInput` where the item is lacking.
    pub fn write(&self, item: Item, out: &mut dyn Write) -> io::Result<Content> {
        if let Some(reason) = self.lacks(item) {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        match (item, &self.cloud) {
            (Item::Cloud(format), Some(cloud)) => write_cloud(format, cloud, &self.origin, out),
            (Item::Cloud(_), None) => Err(io::ErrorKind::InvalidInput.into()),
            (Item::Map(map, format), _) => {
                let key = picture::write(out, &self.maps, map, format, &self.origin)?;
                Ok(Content { map: Some(key), ..Content::default() })
            }
        }
    }
}

fn write_cloud(
    format: PointFormat,
    cloud: &Organised,
    origin: &Origin,
    out: &mut dyn Write,
) -> io::Result<Content> {
    let mut triangles = None;
    match format {
        PointFormat::E57 => e57::write(out, cloud, origin)?,
        PointFormat::Pcd => pcd::write(out, cloud, origin)?,
        PointFormat::Xyz => xyz::write(out, cloud)?,
        PointFormat::Obj => {
            let mesh = mesh(cloud);
            obj::write(out, cloud, &mesh, origin)?;
            triangles = Some(mesh.triangles.len());
        }
    }
    Ok(Content { points: Some(cloud.points.len()), triangles, map: None })
}

#[cfg(test)]
mod tests;
