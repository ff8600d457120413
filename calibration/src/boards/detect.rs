//! Finding a board in a picture.

use std::collections::HashMap;

use thiserror::Error;

use super::{
    crossings::{Crossing, crossings},
    description::{Board, Pattern, Point},
    discs::{board_homography, discs, eccentricity, identify as number_discs},
    identify::{Known, Mismatch, charuco, checkerboard},
    lattice::{Node, lattices},
    picture::Picture,
    refine::{Refined, edge_width, noise, refine},
};
use crate::observation::Corner;

/// Blur of the picture in which corners are looked for, in px: less than the lens's own, enough against noise.
const CALM_PX: f64 = 1.0;
/// Half-width of the window of a corner at most, in px, and as a share of the distance to its neighbour.
const WINDOW: (f64, f64) = (6.0, 0.2);
/// A corner whose edges miss it by as many times the median is not used.
const MOST_MISFIT: f64 = 1.5;
/// So is one whose window changes by half a turn: this share, or as many times the median where noise or shading does it.
const MOST_LOPSIDED: (f64, f64) = (0.2, 2.0);
/// Bits of a marker run into each other where edges are wider than this many bits.
const WIDEST_IN_BITS: f64 = 1.2;
/// Fewer corners of a board in pieces are not worth having.
const LEAST_CORNERS: usize = 6;

/// What is asked of a picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DetectSettings {
    /// Edges of the board that are wider are blurred; see [`Found::edge_width_px`].
    pub max_edge_width_px: f64,
}

impl Default for DetectSettings {
    fn default() -> Self {
        Self { max_edge_width_px: 8.0 }
    }
}

/// A marked point of the board, measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FoundCorner {
    /// Number and place on the board and in the picture.
    pub corner: Corner,
    /// Standard deviation of its place in the picture, in px, along the worse direction.
    pub sigma_px: f64,
}

/// A board that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Found {
    /// Its marked points that were seen, in order of their numbers.
    pub corners: Vec<FoundCorner>,
    /// Median width of edges: contrast over steepest slope, 2.5 standard deviations of a Gaussian blur. NaN where there
    /// is no edge to measure, as on circle grids.
    pub edge_width_px: f64,
}

/// Why a picture is of no use.
#[derive(Debug, Clone, Copy, PartialEq, Error)]
pub enum DetectError {
    /// Nothing like the board is there.
    #[error("no {board} was found; it must be in view, evenly lit and not saturated")]
    Nothing {
        /// Kind of board.
        board: &'static str,
    },
    /// Another number of squares, or a part of the board only.
    #[error(
        "a lattice of {} x {} inner corners was found, the board has {} x {}; a checkerboard must be seen whole: check \
         columns and rows of the board's file, and that nothing covers it",
        found[0], found[1], wanted[0], wanted[1]
    )]
    Extent {
        /// Columns and rows that were found.
        found: [u32; 2],
        /// Those of the board.
        wanted: [u32; 2],
    },
    /// A checkerboard whose markers are not those of the board.
    #[error(
        "{corners} corners were found, but no two markers of the board among them; check dictionary, marker_mm and \
         legacy (boards made before OpenCV 4.6) of the board's file"
    )]
    Markers {
        /// Corners in the largest piece.
        corners: usize,
    },
    /// Not all discs of a circle grid are there.
    #[error("{found} of {wanted} discs were found in one lattice; a circle grid must be seen whole")]
    Discs {
        /// Discs in the largest piece.
        found: usize,
        /// Those of the board.
        wanted: usize,
    },
    /// The picture is blurred.
    #[error(
        "the picture is blurred: edges of the board are {width_px:.1} px wide, at most {limit_px:.1} are allowed; \
             focus, or hold the board still"
    )]
    Blurred {
        /// Median width of edges.
        width_px: f64,
        /// What is allowed.
        limit_px: f64,
    },
}

/// Finds the board in a picture.
///
/// # Errors
/// Why the picture is of no use, with what to do.
pub fn detect(board: &Board, picture: &Picture, settings: DetectSettings) -> Result<Found, DetectError> {
    let found = match &board.pattern {
        Pattern::Circles(_) => circles(board, picture)?,
        _ => squares(board, picture, settings)?,
    };
    let width_px = found.edge_width_px;
    // NaN: there was no edge to measure.
    if width_px > settings.max_edge_width_px {
        return Err(DetectError::Blurred { width_px, limit_px: settings.max_edge_width_px });
    }
    Ok(found)
}

/// Boards of squares: looked for at full size, and where that fails in smaller pictures, in which blurred edges are sharp.
fn squares(board: &Board, picture: &Picture, settings: DetectSettings) -> Result<Found, DetectError> {
    let points = board.points();
    let mut first_error = None;
    let mut level = picture.clone();
    let mut scale = 1.0;
    for _ in 0..3 {
        let calm = level.blurred(CALM_PX);
        let crossings = crossings(&calm);
        let groups = lattices(&calm, &crossings);
        match known_corners(board, &calm, &crossings, &groups) {
            Ok(known) => {
                // Pixel (x, y) of a picture of 1/s the size is centred at s x + (s - 1) / 2.
                let up = |value: f64| value * scale + 0.5 * (scale - 1.0);
                let at: Vec<Seen> = known
                    .into_iter()
                    .map(|(crossing, id, spacing)| (crossings[crossing].at.map(up), id, spacing * scale))
                    .collect();
                let found = measured(board, picture, &at, &points);
                if found.corners.len() >= LEAST_CORNERS {
                    return Ok(found);
                }
            }
            Err(error) => {
                // Markers are unreadable long before the squares around them.
                let width_px = match (&error, groups.first()) {
                    (DetectError::Markers { corners: 12.. }, Some(nodes)) => {
                        lattice_width(picture, scale, &crossings, nodes)
                    }
                    _ => f64::NAN,
                };
                let limit_px = settings.max_edge_width_px.min(readable_px(board, &groups, scale));
                let blurred = DetectError::Blurred { width_px, limit_px };
                let error = if width_px > limit_px { blurred } else { error };
                first_error = Some(first_error.map_or(error, |first| better(first, error)));
            }
        }
        if level.width().min(level.height()) < 128 {
            break;
        }
        level = level.halved();
        scale *= 2.0;
    }
    Err(first_error.unwrap_or(DetectError::Nothing { board: kind(board) }))
}

/// The more telling of two reasons.
fn better(one: DetectError, other: DetectError) -> DetectError {
    let size = |error: &DetectError| match error {
        DetectError::Extent { found, .. } => (found[0] * found[1]) as usize,
        DetectError::Markers { corners } => *corners,
        DetectError::Blurred { .. } => usize::MAX,
        _ => 0,
    };
    if size(&other) > size(&one) { other } else { one }
}

/// A corner's place in the picture, its number, and the distance to its nearest neighbour in px.
type Seen = ([f64; 2], u32, f64);

fn known_corners(
    board: &Board,
    picture: &Picture,
    crossings: &[Crossing],
    groups: &[Vec<Node>],
) -> Result<Vec<Known>, DetectError> {
    let mut error = DetectError::Nothing { board: kind(board) };
    let mut all: Vec<Known> = Vec::new();
    for group in groups.iter().filter(|group| group.len() >= 4) {
        let known = match &board.pattern {
            Pattern::Checkerboard(pattern) => checkerboard(pattern, crossings, group),
            Pattern::Charuco(pattern) => charuco(pattern, picture, crossings, group),
            Pattern::Circles(_) => Err(Mismatch::Markers),
        };
        match (known, &board.pattern) {
            // Pieces of a board with markers add up.
            (Ok(known), Pattern::Charuco(_)) => {
                for corner in known {
                    if !all.iter().any(|other| other.1 == corner.1) {
                        all.push(corner);
                    }
                }
            }
            (Ok(known), _) => return Ok(known),
            (Err(Mismatch::Extent(found)), Pattern::Checkerboard(pattern)) => {
                let wanted = [pattern.columns - 1, pattern.rows - 1];
                // Which way a lattice lies is arbitrary: told as the board's file has it.
                let lies_across = (found[0] < found[1]) != (wanted[0] < wanted[1]);
                let found = if lies_across { [found[1], found[0]] } else { found };
                error = better(error, DetectError::Extent { found, wanted });
            }
            (Err(_), _) => error = better(error, DetectError::Markers { corners: group.len() }),
        }
    }
    if all.len() >= LEAST_CORNERS { Ok(all) } else { Err(error) }
}

fn kind(board: &Board) -> &'static str {
    match board.pattern {
        Pattern::Checkerboard(_) => "checkerboard",
        Pattern::Charuco(_) => "ChArUco board",
        Pattern::Circles(_) => "circle grid",
    }
}

/// Widest edge with which a marker of a lattice can be read, in px.
fn readable_px(board: &Board, groups: &[Vec<Node>], scale: f64) -> f64 {
    let Pattern::Charuco(pattern) = &board.pattern else { return f64::INFINITY };
    let spacing = median(groups.iter().flatten().map(|node| node.spacing * scale).collect());
    WIDEST_IN_BITS * spacing * pattern.marker_mm / pattern.square_mm / (pattern.dictionary.side() + 2) as f64
}

/// NaN of nothing.
fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}

/// Median width of the edges of a lattice that is not known to be the board, in px of the whole picture.
fn lattice_width(picture: &Picture, scale: f64, crossings: &[Crossing], nodes: &[Node]) -> f64 {
    let up = |value: f64| value * scale + 0.5 * (scale - 1.0);
    let at: HashMap<[i32; 2], [f64; 2]> =
        nodes.iter().map(|node| (node.cell, crossings[node.crossing].at.map(up))).collect();
    let width =
        |(cell, &from): (&[i32; 2], &[f64; 2])| edge_width(picture, from, *at.get(&[cell[0] + 1, cell[1]])?);
    median(at.iter().filter_map(width).collect())
}

/// Corners to a part of a pixel, and how sharp the edges between them are.
fn measured(board: &Board, picture: &Picture, seen: &[Seen], points: &[Point]) -> Found {
    // A window must not reach into a marker.
    let room = match &board.pattern {
        Pattern::Charuco(pattern) => (0.4 * (1.0 - pattern.marker_mm / pattern.square_mm)).max(0.07),
        _ => WINDOW.1,
    };
    let window = |spacing: f64| (spacing * room.min(WINDOW.1)).clamp(2.0, WINDOW.0);
    let noise = noise(picture);
    let refined: Vec<(u32, Refined)> = seen
        .iter()
        .filter_map(|&(at, id, spacing)| Some((id, refine(picture, at, window(spacing), noise)?)))
        .collect();
    // Where a finger, a shadow or the end of the projector's light crosses the window, edges miss the point.
    let limit = MOST_MISFIT * median(refined.iter().map(|(_, refined)| refined.misfit_px).collect());
    let lopsided = median(refined.iter().map(|(_, refined)| refined.lopsided).collect());
    let most_lopsided = MOST_LOPSIDED.0.max(MOST_LOPSIDED.1 * lopsided);
    let mut corners: Vec<FoundCorner> = refined
        .into_iter()
        .filter(|(_, refined)| refined.misfit_px <= limit && refined.lopsided <= most_lopsided)
        .filter_map(|(id, refined)| {
            let board_mm = points.get(id as usize)?.board_mm;
            let corner = Corner { id, board_mm, camera_px: refined.at };
            Some(FoundCorner { corner, sigma_px: refined.sigma_px })
        })
        .collect();
    corners.sort_by_key(|found| found.corner.id);
    let at: HashMap<u32, [f64; 2]> =
        corners.iter().map(|found| (found.corner.id, found.corner.camera_px)).collect();
    let columns = match &board.pattern {
        Pattern::Checkerboard(pattern) => pattern.columns - 1,
        Pattern::Charuco(pattern) => pattern.columns - 1,
        Pattern::Circles(pattern) => pattern.columns,
    };
    let widths: Vec<f64> = corners
        .iter()
        .filter(|found| (found.corner.id + 1) % columns != 0)
        .filter_map(|found| edge_width(picture, found.corner.camera_px, *at.get(&(found.corner.id + 1))?))
        .collect();
    Found { corners, edge_width_px: median(widths) }
}

fn circles(board: &Board, picture: &Picture) -> Result<Found, DetectError> {
    let Pattern::Circles(pattern) = &board.pattern else {
        return Err(DetectError::Nothing { board: kind(board) });
    };
    let spots = discs(picture);
    let wanted = (pattern.columns * pattern.rows) as usize;
    let known = number_discs(pattern, &spots).map_err(|found| match found {
        0..3 => DetectError::Nothing { board: kind(board) },
        found => DetectError::Discs { found, wanted },
    })?;
    let points = board.points();
    let board_mm: Vec<[f64; 2]> = known.iter().map(|&(_, id)| points[id as usize].board_mm).collect();
    let camera_px: Vec<[f64; 2]> = known.iter().map(|&(disc, _)| spots[disc].at).collect();
    let from_board = board_homography(&board_mm, &camera_px);
    let radius = 0.5 * pattern.diameter_mm * board.scale();
    let corners = known
        .iter()
        .zip(&board_mm)
        .map(|(&(disc, id), &board_mm)| {
            let off = from_board.as_ref().and_then(|matrix| eccentricity(matrix, board_mm, radius));
            let [dx, dy] = off.unwrap_or_default();
            let spot = &spots[disc];
            let corner = Corner { id, board_mm, camera_px: [spot.at[0] - dx, spot.at[1] - dy] };
            FoundCorner { corner, sigma_px: spot.sigma_px }
        })
        .collect();
    let edges = known.iter().map(|&(disc, _)| &spots[disc]);
    let widths: Vec<f64> = edges
        .filter_map(|spot| {
            // Both sides of the disc's right edge, as if that were an edge between two corners above and below it.
            let [x, y] = [spot.at[0] + spot.radius_px, spot.at[1]];
            let half = spot.radius_px;
            edge_width(picture, [x, y - half], [x, y + half])
        })
        .collect();
    Ok(Found { corners, edge_width_px: median(widths) })
}
