//! NumPy's `.npz`: a ZIP of `.npy` files, here always stored, with fixed time stamps, so that equal arrays give equal
//! bytes.

use std::{
    collections::BTreeMap,
    io::{self, Read, Seek, Write},
};

use zip::{CompressionMethod, DateTime, ZipArchive, ZipWriter, write::SimpleFileOptions};

use super::npy::{Dtype, Header};
use crate::grid::Grid;

/// Most arrays of an archive that are read.
const MAX_ARRAYS: usize = 64;

/// A two-dimensional array to write.
#[derive(Debug, Clone, Copy)]
pub enum Array<'a> {
    /// Written as float32; every NaN as the same one.
    F32(&'a Grid<f32>),
    /// Written as uint8.
    U8(&'a Grid<u8>),
    /// Written as bool.
    Bool(&'a Grid<bool>),
}

impl Array<'_> {
    fn header(self) -> Vec<u8> {
        let (dtype, width, height) = match self {
            Self::F32(grid) => (Dtype::F32, grid.width(), grid.height()),
            Self::U8(grid) => (Dtype::U8, grid.width(), grid.height()),
            Self::Bool(grid) => (Dtype::Bool, grid.width(), grid.height()),
        };
        Header::to_bytes(dtype, &[height, width])
    }

    fn data_bytes(self) -> usize {
        match self {
            Self::F32(grid) => 4 * grid.len(),
            Self::U8(grid) => grid.len(),
            Self::Bool(grid) => grid.len(),
        }
    }

    fn write_data(self, out: &mut impl Write) -> io::Result<()> {
        match self {
            Self::U8(grid) => out.write_all(grid.data()),
            Self::Bool(grid) => out.write_all(bytemuck::cast_slice(grid.data())),
            Self::F32(grid) => {
                let mut buffer = Vec::with_capacity(1 << 18);
                for chunk in grid.data().chunks(1 << 16) {
                    buffer.clear();
                    // The bits of a NaN depend on how it arose, and equal maps must give equal bytes.
                    let canonical = |value: &f32| if value.is_nan() { f32::NAN } else { *value };
                    buffer.extend(chunk.iter().flat_map(|value| canonical(value).to_le_bytes()));
                    out.write_all(&buffer)?;
                }
                Ok(())
            }
        }
    }
}

/// Writes `arrays` under their names, in their order.
pub fn write(out: impl Write, arrays: &[(&str, Array<'_>)]) -> io::Result<()> {
    let mut zip = ZipWriter::new_stream(out);
    for &(name, array) in arrays {
        let header = array.header();
        let length = (header.len() + array.data_bytes()) as u64;
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .last_modified_time(DateTime::default())
            .unix_permissions(0o644)
            .large_file(length >= u64::from(u32::MAX));
        zip.start_file(format!("{name}.npy"), options).map_err(io::Error::from)?;
        zip.write_all(&header)?;
        array.write_data(&mut zip)?;
    }
    zip.finish().map_err(io::Error::from)?.into_inner().flush()
}

/// Arrays of an archive that were read.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Arrays {
    f32: BTreeMap<String, Grid<f32>>,
    u8: BTreeMap<String, Grid<u8>>,
    bool: BTreeMap<String, Grid<bool>>,
}

impl Arrays {
    /// Takes out the float32 array `name`.
    pub fn take_f32(&mut self, name: &str) -> Result<Grid<f32>, String> {
        self.f32.remove(name).ok_or_else(|| self.lacks(name, "float32"))
    }

    /// Takes out the uint8 array `name`.
    pub fn take_u8(&mut self, name: &str) -> Result<Grid<u8>, String> {
        self.u8.remove(name).ok_or_else(|| self.lacks(name, "uint8"))
    }

    /// Takes out the bool array `name`.
    pub fn take_bool(&mut self, name: &str) -> Result<Grid<bool>, String> {
        self.bool.remove(name).ok_or_else(|| self.lacks(name, "bool"))
    }

    /// Names of the arrays that have not been taken out.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.f32.keys().chain(self.u8.keys()).chain(self.bool.keys()).map(String::as_str)
    }

    fn lacks(&self, name: &str, dtype: &str) -> String {
        let names: Vec<&str> = self.names().collect();
        format!("has no {dtype} array `{name}` of two dimensions, only {}", names.join(", "))
    }
}

/// Reads all arrays of an archive as [`write`](fn@write) makes it: stored, of two dimensions. The error is a sentence that
/// follows the file's name.
pub fn read(file: impl Read + Seek) -> Result<Arrays, String> {
    let mut zip = ZipArchive::new(file).map_err(|error| format!("is not a .npz: {error}"))?;
    if zip.len() > MAX_ARRAYS {
        return Err(format!("has {} arrays, at most {MAX_ARRAYS} are read", zip.len()));
    }
    let mut arrays = Arrays::default();
    for index in 0..zip.len() {
        let mut entry =
            zip.by_index(index).map_err(|error| format!("has a damaged entry {index}: {error}"))?;
        let name = entry.name().map_err(|error| format!("has a damaged entry {index}: {error}"))?;
        let Some(name) = name.strip_suffix(".npy").map(str::to_owned) else {
            return Err(format!("has the entry {name:?}, which is not a .npy"));
        };
        if entry.compression() != CompressionMethod::Stored {
            return Err(format!("has the compressed array `{name}`: write it with numpy.savez"));
        }
        // Stored entries cannot be longer than the file, so this cannot grow beyond it; the checksum is checked.
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).map_err(|error| format!("has a damaged array `{name}`: {error}"))?;
        arrays.insert(name, &bytes)?;
    }
    Ok(arrays)
}

impl Arrays {
    fn insert(&mut self, name: String, bytes: &[u8]) -> Result<(), String> {
        let wrong = |detail: String| format!("has an array `{name}` that {detail}");
        let header = Header::parse(bytes).map_err(wrong)?;
        let data = &bytes[header.data_offset..];
        let &[height, width] = header.shape.as_slice() else {
            return Err(wrong(format!("has {} dimensions, expected 2", header.shape.len())));
        };
        if header.data_bytes() != Some(data.len()) {
            return Err(wrong(format!("has {} bytes of data for {height} x {width} elements", data.len())));
        }
        match header.dtype {
            Dtype::F32 => {
                let value = |bytes: &[u8]| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]);
                self.f32
                    .insert(name, Grid::from_vec(width, height, data.chunks_exact(4).map(value).collect()));
            }
            Dtype::U8 => {
                self.u8.insert(name, Grid::from_vec(width, height, data.to_vec()));
            }
            Dtype::Bool => {
                self.bool.insert(
                    name,
                    Grid::from_vec(width, height, data.iter().map(|&byte| byte != 0).collect()),
                );
            }
            Dtype::U16 | Dtype::U16BigEndian => {
                return Err(wrong("is uint16, expected float32, uint8 or bool".into()));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
