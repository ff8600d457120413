//! Views of a board from recorded scans and from pictures.

use std::path::{Path, PathBuf};

use polscan_patterns::{Mode, Role};
use serde::{Deserialize, Serialize};

use crate::{
    calibration::{
        boards::{Board, DetectSettings, Picture, PlaneInput, detect, plane_points},
        observation::View,
    },
    decode::{Decoded, Plane, SharedPlane},
    engine::{DecodeRequest, Failure, Recorded},
    pipeline::{self, PipelineError},
    store::{Bundle, Policy},
};

/// Plane points of a view that are kept: the solver takes fewer.
const MOST_POINTS: usize = 8000;

/// A view that is of no use, and why.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Unusable {
    /// What the user calls it.
    pub name: String,
    /// Why.
    pub reason: String,
}

/// How well a board was seen.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Seen {
    /// What the user calls the view.
    pub name: String,
    /// Corners found.
    pub corners: usize,
    /// Their standard deviation by the picture's noise, rms, in px, where the noise tells one.
    pub corner_sigma_px: Option<f64>,
    /// Median width of the board's edges in px.
    pub edge_width_px: Option<f64>,
    /// Plane points found.
    pub plane_points: usize,
}

/// What was seen in all pictures.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Views {
    /// Views of the board.
    pub views: Vec<View>,
    /// How each of those was seen.
    pub seen: Vec<Seen>,
    /// Others.
    pub unusable: Vec<Unusable>,
    /// (width, height) of the camera's images.
    pub camera: Option<(u32, u32)>,
    /// (width, height) of the projector.
    pub projector: Option<(u32, u32)>,
}

impl Views {
    /// Adds a picture in which a board should be, with the decoded maps where it is a scan.
    pub fn add(
        &mut self,
        name: &str,
        board: &Board,
        picture: &Picture,
        decoded: Option<&Decoded>,
        settings: DetectSettings,
    ) -> Result<(), Failure> {
        let size = (picture.width() as u32, picture.height() as u32);
        let before = *self.camera.get_or_insert(size);
        if before != size {
            let message = format!(
                "its pictures are {}x{} px, those of the views before it {}x{}; take all views with one camera",
                size.0, size.1, before.0, before.1
            );
            return Err(Failure::data(format!("use the view {name}"), message));
        }
        match detect(board, picture, settings) {
            Err(error) => self.unusable.push(Unusable { name: name.into(), reason: error.to_string() }),
            Ok(found) => {
                let sigma_sq: f64 = found.corners.iter().map(|corner| corner.sigma_px.powi(2)).sum();
                let corners: Vec<_> = found.corners.iter().map(|found| found.corner).collect();
                let points = decoded.map(|decoded| {
                    plane_points(&PlaneInput { decoded, corners: &corners, most: MOST_POINTS })
                });
                let plane_points = points.unwrap_or_default();
                self.seen.push(Seen {
                    name: name.into(),
                    corners: corners.len(),
                    corner_sigma_px: Some((sigma_sq / corners.len() as f64).sqrt())
                        .filter(|px| px.is_finite()),
                    edge_width_px: Some(found.edge_width_px).filter(|width| width.is_finite()),
                    plane_points: plane_points.len(),
                });
                self.views.push(View { name: name.into(), corners, plane_points });
            }
        }
        Ok(())
    }

    /// Adds a recorded scan.
    pub fn add_bundle(
        &mut self,
        name: &str,
        path: &Path,
        board: &Board,
        settings: DetectSettings,
    ) -> Result<(), Failure> {
        let operation = || format!("read the view {}", path.display());
        let bundle =
            Bundle::open(path, Policy::Local, None).map_err(|error| Failure::data(operation(), error))?;
        let mode = bundle.manifest().mode;
        if mode.is_some_and(|mode| mode != Mode::Gray) {
            let message = "it is no scan in mode gray: boards scatter light, which only intensities decode; \
                           take it again with --mode gray";
            return Err(Failure::data(operation(), message));
        }
        let request = DecodeRequest {
            bundle: path,
            calibration: None,
            projector_left: false,
            calibration_unit_mm: 1.0,
            mode: None,
            regions: &[],
        };
        let recorded = Recorded::read(&request, bundle)?;
        // What a calibration says of these frames is what is to be found out.
        let job = pipeline::Job { calibration: None, ..recorded.job() };
        let outcome =
            pipeline::run(&job).map_err(|error: PipelineError| Failure::data(operation(), error))?;
        self.set_projector(name, (job.decode.column.size(), job.decode.row.size()))?;
        let Some(picture) = white_picture(job.roles, job.planes, (job.decode.width, job.decode.height))
        else {
            return Err(Failure::data(operation(), "it has no white frame to find the board in; record one"));
        };
        self.add(name, board, &picture, Some(&outcome.decoded), settings)
    }

    /// Adds views of the same camera and projector.
    ///
    /// # Errors
    /// Sizes differ.
    pub fn join(&mut self, other: &Self) -> Result<(), Failure> {
        let differ = |one: Option<(u32, u32)>, other: Option<(u32, u32)>| matches!((one, other), (Some(one), Some(other)) if one != other);
        if differ(self.camera, other.camera) || differ(self.projector, other.projector) {
            let message = "its pictures have another size than those of the views before it; take all views of a session \
                           with one camera and one projector";
            return Err(Failure::data("use the view", message));
        }
        (self.camera, self.projector) = (self.camera.or(other.camera), self.projector.or(other.projector));
        self.views.extend(other.views.iter().cloned());
        self.seen.extend(other.seen.iter().cloned());
        self.unusable.extend(other.unusable.iter().cloned());
        Ok(())
    }

    /// Notes the size of the projector, which all views share.
    pub fn set_projector(&mut self, name: &str, size: (u32, u32)) -> Result<(), Failure> {
        let before = *self.projector.get_or_insert(size);
        if before == size {
            return Ok(());
        }
        let message = format!(
            "its projector has {}x{} px, that of the views before it {}x{}",
            size.0, size.1, before.0, before.1
        );
        Err(Failure::data(format!("use the view {name}"), message))
    }
}

/// Mean of the white frames.
pub fn white_picture(
    roles: &[Role],
    planes: &[SharedPlane],
    (width, height): (usize, usize),
) -> Option<Picture> {
    let white: Vec<_> = roles.iter().zip(planes).filter(|(role, _)| **role == Role::White).collect();
    let mut sum = vec![0.0f32; width * height];
    for (_, plane) in &white {
        match plane.plane() {
            Plane::U8(values) => {
                sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += f32::from(*value))
            }
            Plane::U16(values) => {
                sum.iter_mut().zip(values).for_each(|(sum, value)| *sum += f32::from(*value))
            }
        }
    }
    let count = white.len() as f32;
    sum.iter_mut().for_each(|sum| *sum /= count);
    (!white.is_empty()).then(|| Picture::new(width, height, sum))
}

/// Reads one picture as grey values.
pub fn read_picture(path: &Path) -> Result<Picture, Failure> {
    let operation = || format!("read the picture {}", path.display());
    let reader = image::ImageReader::open(path).and_then(image::ImageReader::with_guessed_format);
    let image = reader.map_err(|error| Failure::data(operation(), error))?;
    let grey = image.decode().map_err(|error| Failure::data(operation(), error))?;
    // 8 bits stay 8 bits: the noise of rounding is judged by them.
    let (width, height) = (grey.width() as usize, grey.height() as usize);
    let data = match grey {
        image::DynamicImage::ImageLuma16(_) | image::DynamicImage::ImageRgb16(_) => {
            grey.to_luma16().into_raw().into_iter().map(f32::from).collect()
        }
        grey => grey.to_luma8().into_raw().into_iter().map(f32::from).collect(),
    };
    Ok(Picture::new(width, height, data))
}

/// The number in the name of a view of a session.
pub fn number_of(name: &str) -> Option<u32> {
    let digits = name.strip_prefix("view-")?.trim_end_matches(".json");
    digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse().ok()).flatten()
}

/// What a file or folder is called in messages.
pub fn name_of(path: &Path, among: &[PathBuf]) -> String {
    let short = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
    let own = short(path);
    let alone = among.iter().filter(|other| short(other) == own).count() == 1;
    own.filter(|_| alone).unwrap_or_else(|| path.display().to_string())
}
