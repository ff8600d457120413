//! `maps.npz` and `truth.npz`: which arrays they hold, and where these are NaN.

use std::io::{self, Write};

use super::{
    error::StorageError,
    npz::{self, Array},
};
use crate::{
    decode::{Class, Decoded},
    grid::Grid,
    truth::Truth,
};

/// Name of the maps in a bundle.
pub const FILE_NAME: &str = "maps.npz";

/// Name of a simulated rig's truth in a bundle.
pub const TRUTH_FILE_NAME: &str = "truth.npz";

/// Final maps of a scan, as written to `maps.npz`: NaN exactly where `mask` is false.
#[derive(Debug, Clone)]
pub struct Maps {
    /// Projector column.
    pub column: Grid<f32>,
    /// Projector row; all NaN where rows were neither coded nor predicted by a calibration.
    pub row: Grid<f32>,
    /// z in the camera frame in mm; all NaN without a calibration.
    pub depth_mm: Grid<f32>,
    /// Modulation in DN.
    pub modulation: Grid<f32>,
    /// Pair-sum residual in sigma.
    pub residual: Grid<f32>,
    /// Numbers of [`Class`].
    pub class: Grid<u8>,
    /// Where there is a measurement.
    pub mask: Grid<bool>,
}

impl Maps {
    /// The maps of `decoded` after all gates, which `class` tells of. `row` is there where rows were coded
    /// or a calibration predicts them, `depth_mm` where a calibration is.
    /// Refuses, as a defect, valid pixels without a column, or without a row or depth where there are rows or depths.
    pub fn new(
        decoded: &Decoded,
        class: &Grid<Class>,
        row: Option<&Grid<f32>>,
        depth_mm: Option<&Grid<f32>>,
    ) -> Result<Self, StorageError> {
        let mask = class.map(|class| class.is_valid());
        let size = (class.width(), class.height());
        let masked = |name: &str, values: &Grid<f32>| {
            if (values.width(), values.height()) != size {
                let detail = format!(
                    "{name} is {} x {}, class {} x {}",
                    values.width(),
                    values.height(),
                    size.0,
                    size.1
                );
                return Err(StorageError::refused(FILE_NAME, detail));
            }
            let data = values.data().iter().zip(mask.data());
            let data: Vec<f32> = data.map(|(value, set)| if *set { *value } else { f32::NAN }).collect();
            let lost = data.iter().zip(mask.data()).filter(|(value, set)| **set && value.is_nan()).count();
            if lost > 0 {
                return Err(StorageError::refused(FILE_NAME, format!("{lost} valid pixels have no {name}")));
            }
            Ok(Grid::from_vec(size.0, size.1, data))
        };
        let nowhere = || Grid::filled(size.0, size.1, f32::NAN);
        let column = masked("column", &decoded.column.coordinate)?;
        let row = match row {
            Some(row) => masked("row", row)?,
            None => nowhere(),
        };
        let depth_mm = match depth_mm {
            Some(depth_mm) => masked("depth", depth_mm)?,
            None => nowhere(),
        };
        Ok(Self {
            column,
            row,
            depth_mm,
            modulation: decoded.modulation.clone(),
            residual: decoded.residual.clone(),
            class: class.map(|class| *class as u8),
            mask,
        })
    }

    /// Writes the archive.
    pub fn write(&self, out: impl Write) -> io::Result<()> {
        npz::write(
            out,
            &[
                ("column", Array::F32(&self.column)),
                ("row", Array::F32(&self.row)),
                ("depth", Array::F32(&self.depth_mm)),
                ("modulation", Array::F32(&self.modulation)),
                ("residual", Array::F32(&self.residual)),
                ("class", Array::U8(&self.class)),
                ("mask", Array::Bool(&self.mask)),
            ],
        )
    }

    /// Reads an archive back. The error is a sentence that follows the file's name.
    pub fn read(file: impl io::Read + io::Seek) -> Result<Self, String> {
        let mut arrays = npz::read(file)?;
        let maps = Self {
            column: arrays.take_f32("column")?,
            row: arrays.take_f32("row")?,
            depth_mm: arrays.take_f32("depth")?,
            modulation: arrays.take_f32("modulation")?,
            residual: arrays.take_f32("residual")?,
            class: arrays.take_u8("class")?,
            mask: arrays.take_bool("mask")?,
        };
        let size = (maps.mask.width(), maps.mask.height());
        let floats = [&maps.column, &maps.row, &maps.depth_mm, &maps.modulation, &maps.residual];
        let same = floats.iter().all(|grid| (grid.width(), grid.height()) == size)
            && (maps.class.width(), maps.class.height()) == size;
        if same { Ok(maps) } else { Err("has arrays of different sizes".to_owned()) }
    }
}

/// Writes `truth.npz`; the names of the objects go into the manifest.
pub fn write_truth(out: impl Write, truth: &Truth) -> io::Result<()> {
    npz::write(
        out,
        &[
            ("column", Array::F32(&truth.column)),
            ("row", Array::F32(&truth.row)),
            ("depth", Array::F32(&truth.depth_mm)),
            ("object", Array::U8(&truth.object)),
        ],
    )
}

#[cfg(test)]
mod tests;
