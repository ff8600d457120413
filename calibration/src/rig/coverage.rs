//! Which parts of the image and which tilts the views show, and which are still missing.

use nalgebra::{Matrix3, Vector3};
use polscan_reconstruction::geometry::{Lens, Pose};
use serde::Serialize;

use super::{homography, setup::Setup};
use crate::observation::View;

/// Observations in each cell of a 3 x 3 grid over an image, rows from the top, and in its quarters.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Cells {
    /// Rows from the top, columns from the left.
    pub ninths: [[usize; 3]; 3],
    /// Top left, top right, bottom left, bottom right.
    pub quarters: [usize; 4],
}

/// Names of [`Cells::quarters`].
const QUARTERS: [&str; 4] = ["top left", "top right", "bottom left", "bottom right"];
/// A quarter with fewer observations is as good as empty.
const FEW: usize = 4;

impl Cells {
    fn of(points: impl Iterator<Item = [f64; 2]>, size: (u32, u32)) -> Self {
        let mut cells = Self::default();
        let cell = |at: f64, side: u32, count: f64| {
            (((at + 0.5) / f64::from(side) * count).clamp(0.0, count - 1.0)).floor() as usize
        };
        for [x, y] in points {
            cells.ninths[cell(y, size.1, 3.0)][cell(x, size.0, 3.0)] += 1;
            cells.quarters[2 * cell(y, size.1, 2.0) + cell(x, size.0, 2.0)] += 1;
        }
        cells
    }

    /// Quarters that hold next to nothing, by name.
    pub fn empty_quarters(&self) -> Vec<&'static str> {
        QUARTERS.iter().zip(self.quarters).filter(|(_, count)| *count < FEW).map(|(name, _)| *name).collect()
    }
}

/// Which parts of the images the views fill.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct Coverage {
    /// Corners over the camera's image.
    pub camera_corners: Cells,
    /// Plane points over the camera's image.
    pub camera_plane_points: Cells,
    /// Plane points over the projector's image.
    pub projector_plane_points: Cells,
}

impl Coverage {
    /// Of all views.
    pub fn of(views: &[View], setup: &Setup) -> Self {
        let corners = views.iter().flat_map(|v| v.corners.iter().map(|c| c.camera_px));
        let points = || views.iter().flat_map(|v| &v.plane_points);
        let projector = setup.projector.map_or((1, 1), |lens| lens.size);
        Self {
            camera_corners: Cells::of(corners, setup.camera.size),
            camera_plane_points: Cells::of(points().map(|p| p.camera_px), setup.camera.size),
            projector_plane_points: Cells::of(points().map(|p| p.projector_px), projector),
        }
    }
}

/// Tilt of a board about the image's x and y axis, in degrees.
pub(super) fn tilt(board: &Pose) -> [f64; 2] {
    let normal: Vector3<f64> = board.rotation.column(2).into_owned();
    let normal = if normal.z < 0.0 { -normal } else { normal };
    [(-normal.y).atan2(normal.z).to_degrees(), normal.x.atan2(normal.z).to_degrees()]
}

/// Range of tilts about both axes, in degrees.
pub(super) fn tilt_range(boards: &[Pose]) -> [f64; 2] {
    let range = |axis: usize| {
        let tilts = boards.iter().map(|b| tilt(b)[axis]);
        let (low, high) = tilts.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), t| (l.min(t), h.max(t)));
        (high - low).max(0.0)
    };
    [range(0), range(1)]
}

/// Largest angle between two boards' normals in degrees, whichever way round a board is.
pub(super) fn widest_angle(boards: &[Pose]) -> f64 {
    let normals: Vec<Vector3<f64>> = boards.iter().map(|b| b.rotation.column(2).into_owned()).collect();
    let pairs =
        normals.iter().enumerate().flat_map(|(k, a)| normals[k + 1..].iter().map(move |b| a.dot(b).abs()));
    pairs.fold(1.0, f64::min).clamp(-1.0, 1.0).acos().to_degrees()
}

/// What a session still needs.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct Guidance {
    /// Which parts are filled.
    pub coverage: Coverage,
    /// Tilt of each view about the image's x and y axis in degrees, by the lens that is known or guessed; `None` for a
    /// view whose corners do not fix it.
    pub tilts_deg: Vec<Option<[f64; 2]>>,
    /// Views still missing at least.
    pub views_missing: usize,
    /// What the next views should do, in words: parts of the image, tilts. Empty when nothing is missing.
    pub missing: Vec<String>,
}

/// What a session still needs after these views. Cheap: nothing is solved. `camera` is a lens known from before; else
/// it is guessed from the views.
pub fn guidance(views: &[View], setup: &Setup, camera: Option<&Lens>) -> Guidance {
    let coverage = Coverage::of(views, setup);
    let homographies: Vec<Option<Matrix3<f64>>> = views
        .iter()
        .map(|v| {
            homography::homography(&v.corners.iter().map(|c| (c.board_mm, c.camera_px)).collect::<Vec<_>>())
        })
        .collect();
    let (width, height) = (f64::from(setup.camera.size.0), f64::from(setup.camera.size.1));
    let centre = [0.5 * (width - 1.0), 0.5 * (height - 1.0)];
    let known: Vec<Matrix3<f64>> = homographies.iter().flatten().copied().collect();
    let matrix = camera.map_or_else(
        || {
            let plausible = |f: &[f64; 2]| f.iter().all(|f| (0.3 * width..20.0 * width).contains(f));
            let guess = homography::focal_lengths(&known, centre).filter(plausible);
            let [fx, fy] = guess.unwrap_or([2.0 * width; 2]);
            Matrix3::new(fx, 0.0, centre[0], 0.0, fy, centre[1], 0.0, 0.0, 1.0)
        },
        Lens::matrix,
    );
    let poses: Vec<Option<Pose>> =
        homographies.iter().map(|h| homography::pose(h.as_ref()?, &matrix)).collect();
    let gates = &setup.gates;
    let mut missing: Vec<String> = Vec::new();
    for quarter in coverage.camera_corners.empty_quarters() {
        missing.push(format!("a view with the board in the {quarter} of the image"));
    }
    let seen: Vec<[f64; 2]> = poses.iter().flatten().map(tilt).collect();
    for (axis, name, sides) in [(0, "x", ["top", "bottom"]), (1, "y", ["right", "left"])] {
        let least = 0.5 * gates.tilt_range_deg;
        let reached = [seen.iter().any(|t| t[axis] >= least), seen.iter().any(|t| t[axis] <= -least)];
        for (side, _) in sides.iter().zip(reached).filter(|(_, reached)| !reached) {
            missing.push(format!(
                "a view tilted about the image's {name} axis by {least:.0} degrees or more, with the board's {side} nearer"
            ));
        }
    }
    let views_missing = gates.min_views.max(3).saturating_sub(views.len());
    Guidance {
        coverage,
        tilts_deg: poses.iter().map(|p| p.as_ref().map(tilt)).collect(),
        views_missing,
        missing,
    }
}
