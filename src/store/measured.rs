//! What a finished bundle holds of measurements: maps, points and the frame that they are in.

use std::{
    fs::File,
    io::{BufReader, ErrorKind},
    path::Path,
};

use super::{
    bundle::CALIBRATION_FILE_NAME,
    error::InputError,
    maps::{self, Maps},
    source::{CalibrationFileError, read_calibration},
};
use crate::{
    cloud::{PlyPoint, read_ply},
    geometry::{Pose, ReadHints},
};

/// Name of the cloud in a bundle.
pub const CLOUD_FILE_NAME: &str = "cloud.ply";

/// The maps of a bundle.
pub fn read_maps(bundle: &Path) -> Result<Maps, InputError> {
    let path = bundle.join(maps::FILE_NAME);
    let file = File::open(&path).map_err(|error| InputError::file("read", &path, error))?;
    Maps::read(BufReader::new(file)).map_err(|detail| InputError::content(&path, detail))
}

/// The points of a bundle, one for each measured pixel, row by row; `None` where it has no cloud.
pub fn read_points(bundle: &Path) -> Result<Option<Vec<PlyPoint>>, InputError> {
    let path = bundle.join(CLOUD_FILE_NAME);
    let bytes = match std::fs::read(&path) {
        Ok(bytes) => bytes,
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
        Err(error) => return Err(InputError::file("read", &path, error)),
    };
    read_ply(&bytes).map(Some).map_err(|error| InputError::content(&path, error.to_string()))
}

/// The frame that the points of a bundle are in: the world frame of its calibration, `None` where that has none and they are
/// in the camera frame.
pub fn read_world_from_camera(bundle: &Path) -> Result<Option<Pose>, CalibrationFileError> {
    Ok(read_calibration(&bundle.join(CALIBRATION_FILE_NAME), &ReadHints::default())?.world_from_camera)
}
