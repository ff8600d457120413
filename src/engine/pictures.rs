//! The pictures of a result: one per map, one sheet of all, and a view of the cloud.

use polscan_patterns::{ProjectorSize, Role};
use rayon::prelude::*;

use super::results::Results;
use crate::{
    decode::{DecodeSettings, Plane, SharedPlane},
    evidence,
    grid::Grid,
    report::pictures::{
        OverviewInput, ViewSettings, class_picture, cloud_view, column_picture, depth_picture, dolp_picture,
        frame_picture, overview, residual_picture, row_picture,
    },
    store::{BundleWriter, error::StorageError, maps::Maps},
};

/// Bit whose frame stands for all on the sheet: stripes wide enough to be seen at a fifth of the size.
const SHOWN_BIT: u8 = 4;

type Picture<'a> = (&'static str, Box<dyn Fn() -> image::RgbImage + Sync + Send + 'a>);

/// Draws and writes all pictures, several at a time.
pub fn write(writer: &BundleWriter, results: &Results, maps: &Maps) -> Result<(), StorageError> {
    let (job, decoded) = (results.job, &results.outcome.decoded);
    let (columns, rows) = (job.decode.column.size(), job.decode.row.size());
    let mut pictures: Vec<Picture> = vec![
        ("overview.png", Box::new(|| sheet(results, maps))),
        ("maps/class.png", Box::new(|| class_picture(&maps.class))),
        ("maps/column.png", Box::new(move || column_picture(&maps.column, columns))),
        ("maps/dolp.png", Box::new(|| dolp_picture(&decoded.dolp))),
        ("maps/residual.png", Box::new(|| residual_picture(&maps.residual))),
    ];
    if decoded.row.is_some() {
        pictures.push(("maps/row.png", Box::new(move || row_picture(&maps.row, rows))));
    }
    if let Some(reconstruction) = &results.outcome.reconstruction {
        pictures.push(("maps/depth.png", Box::new(|| depth_picture(&maps.depth_mm, None))));
        let view = || cloud_view(&reconstruction.cloud, &ViewSettings::default());
        pictures.push(("cloud.png", Box::new(view)));
    }
    if let Some(residual) = worst_pair(results) {
        pictures.push(("maps/worst-pair.png", Box::new(move || residual_picture(&residual))));
    }
    pictures.par_iter().try_for_each(|(name, draw)| writer.png(name, &draw()))
}

/// Draws and writes where in the image a fault lies, of frames that were not decoded.
pub fn write_unfinished(
    writer: &BundleWriter,
    roles: &[Role],
    frames: &[SharedPlane],
    settings: &DecodeSettings,
) -> Result<(), StorageError> {
    let planes: Vec<(Role, Plane<'_>)> =
        roles.iter().copied().zip(frames.iter().map(|frame| frame.plane())).collect();
    match evidence::worst_residual(&planes, settings) {
        Some(residual) => writer.png("maps/worst-pair.png", &residual_picture(&residual)),
        None => Ok(()),
    }
}

/// Residual of the pair that adds up least, where any is conspicuous: where in the image a fault lies.
fn worst_pair(results: &Results) -> Option<Grid<f32>> {
    let (job, decoded) = (results.job, &results.outcome.decoded);
    let planes: Vec<(Role, Plane<'_>)> =
        job.roles.iter().copied().zip(job.planes.iter().map(|plane| plane.plane())).collect();
    let frames = evidence::Frames::new(&planes, &job.decode, decoded);
    let pair = evidence::worst_pair(&decoded.pairs)?;
    frames.residual_map(pair.axis, pair.bit)
}

fn sheet(results: &Results, maps: &Maps) -> image::RgbImage {
    let (job, decoded) = (results.job, &results.outcome.decoded);
    let coded = |role: &Role| matches!(role, Role::Code { bit: SHOWN_BIT, inverse: false, .. });
    let shown = job.roles.iter().position(coded).unwrap_or(0);
    let frame = frame_picture(job.planes[shown].plane(), job.decode.width, job.decode.camera.saturation_dn);
    let title = format!("mode {}, {} frames", job.decode.mode, job.planes.len());
    let frame_title = format!("frame {}: {}", shown + 1, job.roles[shown]);
    overview(&OverviewInput {
        title: &title,
        frame: (&frame, &frame_title),
        dolp: &decoded.dolp,
        column: &maps.column,
        row: decoded.row.is_some().then_some(&maps.row),
        depth_mm: results.outcome.reconstruction.is_some().then_some(&maps.depth_mm),
        class: &maps.class,
        projector: ProjectorSize { width: job.decode.column.size(), height: job.decode.row.size() },
    })
}
