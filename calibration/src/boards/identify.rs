//! Which corner of the board a node of a lattice is.

use std::collections::HashMap;

use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::{
    crossings::Crossing,
    description::{Charuco, Checkerboard},
    lattice::Node,
    picture::Picture,
};

/// At most one marker in so many says otherwise, and at most one corner in so many is none of the board's.
const MOST_DISSENT: u32 = 10;

/// A node that is known: its crossing, the corner's number, the distance to its nearest neighbour.
pub(super) type Known = (usize, u32, f64);

/// Why a lattice is not the board.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Mismatch {
    /// Rows and columns that were found do not hold the board whole.
    Extent([u32; 2]),
    /// No two markers agree on where the board lies.
    Markers,
}

/// Rotates by quarter turns: what the board's axes make of a lattice's.
pub(super) fn turned([x, y]: [i32; 2], quarter: usize) -> [i32; 2] {
    match quarter % 4 {
        0 => [x, y],
        1 => [y, -x],
        2 => [-x, -y],
        _ => [-y, x],
    }
}

/// Bounds of places: least and most.
pub(super) fn bounds(cells: impl Iterator<Item = [i32; 2]>) -> Option<[[i32; 2]; 2]> {
    cells.fold(None, |bounds, [x, y]| {
        let [[left, top], [right, bottom]] = bounds.unwrap_or([[x, y]; 2]);
        Some([[left.min(x), top.min(y)], [right.max(x), bottom.max(y)]])
    })
}

/// Numbers the corners of a plain checkerboard, which must be there whole but for a few corners within.
///
/// A lattice may hold more than the board where something beside it looks like a corner: then the place that most
/// corners lie in is taken.
pub(super) fn checkerboard(
    board: &Checkerboard,
    crossings: &[Crossing],
    nodes: &[Node],
) -> Result<Vec<Known>, Mismatch> {
    let inner = [board.columns as i32 - 1, board.rows as i32 - 1];
    let mut best: Option<(i64, Vec<Known>)> = None;
    let mut extent = [0, 0];
    for quarter in 0..4 {
        let cells: Vec<[i32; 2]> = nodes.iter().map(|node| turned(node.cell, quarter)).collect();
        let Some([low, high]) = bounds(cells.iter().copied()) else { continue };
        if quarter == 0 {
            extent = [0, 1].map(|axis| (high[axis] - low[axis] + 1) as u32);
        }
        for top in low[1]..=high[1] - inner[1] + 1 {
            for left in low[0]..=high[0] - inner[0] + 1 {
                let known = window(crossings, nodes, &cells, [left, top], inner);
                if !is_whole(&known, inner) {
                    continue;
                }
                // The square left above the first corner is dark: the sector between its edges to the left and up.
                let right_parity = known.iter().all(|&(node, corner, _)| {
                    let crossing = &crossings[nodes[node].crossing];
                    let right = right_edge(crossing, nodes, &cells, node, crossings);
                    let column = corner as i32 % inner[0];
                    let row = corner as i32 / inner[0];
                    right.is_none_or(|edge| crossing.light_after(edge + 2) != ((column + row) % 2 == 0))
                });
                // Of equals the one whose first corner is nearest to the top left.
                let first = known.iter().min_by_key(|&&(_, corner, _)| corner);
                let nearness = first.map_or(0.0, |&(node, ..)| {
                    let [x, y] = crossings[nodes[node].crossing].at;
                    x + y
                });
                let score =
                    (known.len() as i64) * 1_000_000 + i64::from(right_parity) * 500_000 - nearness as i64;
                if best.as_ref().is_none_or(|(most, _)| score > *most) {
                    let known =
                        known.into_iter().map(|(node, id, spacing)| (nodes[node].crossing, id, spacing));
                    best = Some((score, known.collect()));
                }
            }
        }
    }
    best.map(|(_, known)| known).ok_or(Mismatch::Extent(extent))
}

/// Which edge of a node's crossing leads to its neighbour to the right; `None` where that one is missing.
fn right_edge(
    crossing: &Crossing,
    nodes: &[Node],
    cells: &[[i32; 2]],
    node: usize,
    crossings: &[Crossing],
) -> Option<usize> {
    let [x, y] = cells[node];
    let neighbour = cells.iter().position(|&cell| cell == [x + 1, y])?;
    let other = crossings[nodes[neighbour].crossing].at;
    let angle = (other[1] - crossing.at[1]).atan2(other[0] - crossing.at[0]);
    let off = |edge: &usize| (angle - crossing.edges[*edge]).cos();
    (0..4).max_by(|a, b| off(a).total_cmp(&off(b)))
}

/// Nodes inside a window, by their index, with the number of the corner there.
fn window(
    crossings: &[Crossing],
    nodes: &[Node],
    cells: &[[i32; 2]],
    [left, top]: [i32; 2],
    [columns, rows]: [i32; 2],
) -> Vec<Known> {
    debug_assert!(nodes.iter().all(|node| node.crossing < crossings.len()));
    let inside = |&[x, y]: &[i32; 2]| (0..columns).contains(&(x - left)) && (0..rows).contains(&(y - top));
    let found = cells.iter().enumerate().filter(|(_, cell)| inside(cell));
    found.map(|(node, [x, y])| (node, ((y - top) * columns + x - left) as u32, nodes[node].spacing)).collect()
}

/// Nine of ten corners are there, and some of every row and column: otherwise it is not known which ones these are.
fn is_whole(known: &[Known], [columns, rows]: [i32; 2]) -> bool {
    let has = |wanted: &dyn Fn(i32) -> bool| known.iter().any(|&(_, corner, _)| wanted(corner as i32));
    10 * known.len() as i32 >= 9 * columns * rows
        && (0..columns).all(|column| has(&|corner| corner % columns == column))
        && (0..rows).all(|row| has(&|corner| corner / columns == row))
}

/// Numbers the corners of a board with markers, by what most of its markers say.
pub(super) fn charuco(
    board: &Charuco,
    picture: &Picture,
    crossings: &[Crossing],
    nodes: &[Node],
) -> Result<Vec<Known>, Mismatch> {
    let at: HashMap<[i32; 2], &Crossing> =
        nodes.iter().map(|node| (node.cell, &crossings[node.crossing])).collect();
    let squares = board.marked_squares();
    let codes = board.dictionary.codes();
    let side = board.dictionary.side();
    // By turn and twice the shift: squares have their middles between corners.
    let mut votes: HashMap<(usize, [i32; 2]), u32> = HashMap::new();
    for node in nodes {
        let [x, y] = node.cell;
        let corners = [[x, y], [x + 1, y], [x + 1, y + 1], [x, y + 1]].map(|cell| at.get(&cell).copied());
        let [Some(a), Some(b), Some(c), Some(d)] = corners else { continue };
        let Some(bits) = read_bits(board, picture, [a, b, c, d]) else { continue };
        for quarter in 0..4 {
            let code = board_code(&bits, side, quarter);
            let found = squares.iter().zip(&codes).find(|(_, known)| (*known ^ code).count_ones() <= 1);
            if let Some(([column, row], _)) = found {
                let middle = turned([2 * x + 1, 2 * y + 1], quarter);
                let shift = [2 * *column as i32 + 1 - middle[0], 2 * *row as i32 + 1 - middle[1]];
                *votes.entry((quarter, shift)).or_default() += 1;
            }
        }
    }
    let winner = votes.iter().max_by_key(|&(key, count)| (count, key));
    let Some((&(quarter, shift), &count)) = winner else { return Err(Mismatch::Markers) };
    let others: u32 = votes.values().sum::<u32>() - count;
    if count < 2 || MOST_DISSENT * others > count {
        return Err(Mismatch::Markers);
    }
    let inner = [board.columns as i32 - 1, board.rows as i32 - 1];
    let corner = |node: &Node| {
        let twice = turned(node.cell.map(|value| 2 * value), quarter);
        let [column, row] = [0, 1].map(|axis| (twice[axis] + shift[axis]) / 2 - 1);
        let inside = (0..inner[0]).contains(&column) && (0..inner[1]).contains(&row);
        inside.then_some((node.crossing, (row * inner[0] + column) as u32, node.spacing))
    };
    let known: Vec<Known> = nodes.iter().filter_map(corner).collect();
    // The other of the two layouts has most markers in the same order, one square aside: then corners lie off the board.
    let off_board = (nodes.len() - known.len()) as u32;
    if MOST_DISSENT * off_board > known.len() as u32 { Err(Mismatch::Markers) } else { Ok(known) }
}

/// Bits of a marker in the axes of the board, where those lie `quarter` turns from the lattice's.
fn board_code(bits: &[bool], side: usize, quarter: usize) -> u64 {
    let last = side as i32 - 1;
    let mut code = 0;
    for y in 0..side {
        for x in 0..side {
            let [u, v] = turned([2 * x as i32 - last, 2 * y as i32 - last], quarter);
            let (column, row) = (((u + last) / 2) as usize, ((v + last) / 2) as usize);
            if bits[y * side + x] {
                code |= 1 << (side * side - 1 - (row * side + column));
            }
        }
    }
    code
}

/// Reads the bits of the marker in a square whose corners are given in turn; `None` where there is no marker.
fn read_bits(board: &Charuco, picture: &Picture, corners: [&Crossing; 4]) -> Option<Vec<bool>> {
    let square =
        homography(&[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], &corners.map(|crossing| crossing.at))?;
    let side = board.dictionary.side();
    let bit = board.marker_mm / board.square_mm / (side + 2) as f64;
    let margin = 0.5 * (1.0 - board.marker_mm / board.square_mm);
    let value = |x: f64, y: f64| {
        let offsets = [[0.0, 0.0], [0.2, 0.0], [-0.2, 0.0], [0.0, 0.2], [0.0, -0.2]];
        let sample = |[u, v]: [f64; 2]| picture.sample(project(&square, [x + u * bit, y + v * bit]));
        offsets.map(sample).iter().sum::<f64>() / 5.0
    };
    let cell = |column: usize, row: usize| {
        value(margin + (column as f64 + 0.5) * bit, margin + (row as f64 + 0.5) * bit)
    };
    let edge = side + 1;
    let border: Vec<f64> =
        (0..=edge).flat_map(|at| [cell(at, 0), cell(at, edge), cell(0, at), cell(edge, at)]).collect();
    // The margin around the marker is as light as it gets there.
    let quiet = 0.5 * margin;
    let along = (0..8).map(|at| (f64::from(at) + 0.5) / 8.0);
    let light: Vec<f64> = along
        .flat_map(|at| [[at, quiet], [at, 1.0 - quiet], [quiet, at], [1.0 - quiet, at]])
        .map(|at| picture.sample(project(&square, at)))
        .collect();
    let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (dark, light) = (mean(&border), mean(&light));
    let contrast = corners.iter().map(|crossing| crossing.contrast).fold(f64::MAX, f64::min);
    let middle = 0.5 * (dark + light);
    let wrong = border.iter().filter(|&&value| value > middle).count();
    if light - dark < 0.3 * contrast || 8 * wrong > border.len() {
        return None;
    }
    Some((0..side * side).map(|at| cell(1 + at % side, 1 + at / side) > middle).collect())
}

/// The homography that takes four or more points onto others, by least squares with its last element 1.
pub(super) fn homography(from: &[[f64; 2]], to: &[[f64; 2]]) -> Option<Matrix3<f64>> {
    let mut normal = SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (&[x, y], &[u, v]) in from.iter().zip(to) {
        for (row, value) in
            [([x, y, 1.0, 0.0, 0.0, 0.0, -u * x, -u * y], u), ([0.0, 0.0, 0.0, x, y, 1.0, -v * x, -v * y], v)]
        {
            let row = SVector::<f64, 8>::from(row);
            normal += row * row.transpose();
            right += row * value;
        }
    }
    let h = normal.lu().solve(&right)?;
    let matrix = Matrix3::new(h[0], h[1], h[2], h[3], h[4], h[5], h[6], h[7], 1.0);
    matrix.iter().all(|value| value.is_finite()).then_some(matrix)
}

/// A point through a homography.
pub(super) fn project(homography: &Matrix3<f64>, [x, y]: [f64; 2]) -> [f64; 2] {
    let point = homography * Vector3::new(x, y, 1.0);
    [point.x / point.z, point.y / point.z]
}
