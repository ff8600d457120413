//! Circle grids: dark discs, their centres, and which is which.

use std::collections::{HashMap, VecDeque};

use nalgebra::Matrix3;

use super::{
    description::Circles,
    identify::{bounds, homography, project, turned},
    picture::Picture,
};

/// Least and most pixels of a disc.
const PIXELS: [usize; 2] = [20, 200_000];
/// A neighbour lies within this share of a step of where it is expected.
const NEAR: f64 = 0.3;

/// A dark spot that may be a disc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Disc {
    /// Centre of gravity of its darkness, in px.
    pub(super) at: [f64; 2],
    /// Standard deviation of the centre in px.
    pub(super) sigma_px: f64,
    /// Radius of a circle of as many pixels.
    pub(super) radius_px: f64,
}

/// Dark spots that are round as seen askew, in a lighter surround.
pub(super) fn discs(picture: &Picture) -> Vec<Disc> {
    let (width, height) = (picture.width(), picture.height());
    let threshold = local_threshold(picture);
    let dark: Vec<bool> = picture.data().iter().zip(&threshold).map(|(value, limit)| value < limit).collect();
    let mut seen = vec![false; width * height];
    let mut found = Vec::new();
    for start in 0..width * height {
        if !dark[start] || seen[start] {
            continue;
        }
        let mut pixels = vec![start];
        seen[start] = true;
        let mut next = 0;
        let mut at_border = false;
        while next < pixels.len() {
            let (x, y) = (pixels[next] % width, pixels[next] / width);
            next += 1;
            at_border |= x == 0 || y == 0 || x == width - 1 || y == height - 1;
            let around = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
            for (x, y) in around {
                if x < width && y < height && dark[y * width + x] && !seen[y * width + x] {
                    seen[y * width + x] = true;
                    pixels.push(y * width + x);
                }
            }
        }
        if !at_border && (PIXELS[0]..=PIXELS[1]).contains(&pixels.len()) {
            found.extend(disc(picture, &pixels));
        }
    }
    found
}

/// Midway between the darkest and the lightest of wide blocks, smoothly from block to block; where there is next to no
/// contrast, below everything.
fn local_threshold(picture: &Picture) -> Vec<f32> {
    let (width, height) = (picture.width(), picture.height());
    let block = (width.min(height) / 8).max(16);
    let (columns, rows) = (width.div_ceil(block), height.div_ceil(block));
    let extremes = |column: usize, row: usize| {
        let mut values = [f32::MAX, f32::MIN];
        // A block and its neighbours: some of the ground and some of the discs is in each.
        let range = |at: usize, length: usize| at.saturating_sub(1) * block..((at + 2) * block).min(length);
        for y in range(row, height).step_by(2) {
            for x in range(column, width).step_by(2) {
                let value = picture.at(x, y);
                values = [values[0].min(value), values[1].max(value)];
            }
        }
        values
    };
    let all = picture.data().iter().fold([f32::MAX, f32::MIN], |[a, b], &v| [a.min(v), b.max(v)]);
    let blocks: Vec<f64> = (0..columns * rows)
        .map(|at| {
            let [low, high] = extremes(at % columns, at / columns);
            let flat = high - low < 0.1 * (all[1] - all[0]);
            f64::from(if flat { low - 1.0 } else { 0.5 * (low + high) })
        })
        .collect();
    let coarse = Picture::new(columns, rows, blocks.into_iter().map(|value| value as f32).collect());
    let place = |at: usize| (at as f64 + 0.5) / block as f64 - 0.5;
    (0..width * height).map(|at| coarse.sample([place(at % width), place(at / width)]) as f32).collect()
}

/// Measures a spot; `None` where it is no ellipse or its surround is not lighter.
fn disc(picture: &Picture, pixels: &[usize]) -> Option<Disc> {
    let width = picture.width();
    let count = pixels.len() as f64;
    let place = |&at: &usize| [(at % width) as f64, (at / width) as f64];
    let mean = [0, 1].map(|axis| pixels.iter().map(|at| place(at)[axis]).sum::<f64>() / count);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for at in pixels {
        let [x, y] = place(at);
        let (dx, dy) = (x - mean[0], y - mean[1]);
        xx += dx * dx / count;
        xy += dx * dy / count;
        yy += dy * dy / count;
    }
    // An ellipse with these second moments has this area; squares are 5 % off, anything ragged more.
    let area = 4.0 * std::f64::consts::PI * (xx * yy - xy * xy).max(0.0).sqrt();
    let middle = 0.5 * (xx + yy);
    let spread = (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
    let radius_px = (count / std::f64::consts::PI).sqrt();
    let slack = 0.025 + 0.3 / radius_px;
    if (area / count - 1.0).abs() > slack || middle + spread > 25.0 * (middle - spread) {
        return None;
    }
    // Weighted by darkness within a box that reaches into the light ground: edge pixels count by their share.
    let reach = [xx, yy].map(|variance| (2.0 * variance.sqrt() + 3.0).ceil() as i64);
    let centre = mean.map(|value| value.round() as i64);
    let inside = |x: i64, y: i64| {
        (x >= 0 && y >= 0 && x < width as i64 && y < picture.height() as i64)
            .then(|| f64::from(picture.at(x as usize, y as usize)))
    };
    let box_of = |by: i64| {
        (-reach[1] - by..=reach[1] + by).flat_map(move |dy| {
            (-reach[0] - by..=reach[0] + by).map(move |dx| (centre[0] + dx, centre[1] + dy))
        })
    };
    let determinant = xx * yy - xy * xy;
    // Squared distance in units of the ellipse: 4 on its edge.
    let away = |x: i64, y: i64| {
        let (dx, dy) = (x as f64 - mean[0], y as f64 - mean[1]);
        (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / determinant
    };
    let beyond = 4.0 * (1.0 + 3.0 / radius_px).powi(2);
    let ring: Vec<f64> = box_of(2)
        .filter(|&(x, y)| (beyond..2.0 * beyond).contains(&away(x, y)))
        .filter_map(|(x, y)| inside(x, y))
        .collect();
    let inner: Vec<f64> =
        box_of(0).filter(|&(x, y)| away(x, y) < 2.0).filter_map(|(x, y)| inside(x, y)).collect();
    if ring.is_empty() || inner.is_empty() {
        return None;
    }
    let average = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
    let (light, dark) = (average(&ring), average(&inner));
    let noise = (ring.iter().map(|value| (value - light).powi(2)).sum::<f64>() / ring.len() as f64).sqrt();
    let contrast = light - dark;
    if contrast < 4.0 * noise.max(1e-6) {
        return None;
    }
    let (mut sum, mut at, mut spread_x) = (0.0, [0.0; 2], 0.0);
    for (x, y) in box_of(2).filter(|&(x, y)| away(x, y) < beyond) {
        let weight = (light - inside(x, y)?) / contrast;
        sum += weight;
        at[0] += weight * x as f64;
        at[1] += weight * y as f64;
        spread_x += (x as f64 - mean[0]).powi(2) + (y as f64 - mean[1]).powi(2);
    }
    let at = at.map(|value| value / sum);
    // Noise of the ground through the centre of gravity.
    let sigma_px = noise / contrast * (0.5 * spread_x).sqrt() / sum;
    ((at[0] - mean[0]).hypot(at[1] - mean[1]) < 1.0).then_some(Disc { at, sigma_px, radius_px })
}

/// Numbers the discs of the board: (disc, number). All must be there.
///
/// # Errors
/// How many of them were found in one piece.
pub(super) fn identify(board: &Circles, discs: &[Disc]) -> Result<Vec<(usize, u32)>, usize> {
    let wanted = (board.columns * board.rows) as usize;
    let mut most = 0;
    for start in 0..discs.len() {
        let Some(lattice) = grow(discs, start, wanted) else { continue };
        most = most.max(lattice.len());
        if lattice.len() == wanted
            && let Some(known) = number(board, discs, &lattice)
        {
            return Ok(known);
        }
    }
    Err(most)
}

/// Places of the discs of the board on a square lattice of nearest neighbours.
fn lattice_cells(board: &Circles) -> Vec<[i32; 2]> {
    let places =
        (0..board.rows as i32).flat_map(|row| (0..board.columns as i32).map(move |column| (column, row)));
    let cell = |(column, row): (i32, i32)| match board.asymmetric {
        // Staggered rows are a square lattice turned by an eighth: half steps x and y become (x + y) / 2, (y - x) / 2.
        true => {
            let x = 2 * column + row % 2;
            [(x + row).div_euclid(2), (row - x).div_euclid(2)]
        }
        false => [column, row],
    };
    places.map(cell).collect()
}

fn number(board: &Circles, discs: &[Disc], lattice: &HashMap<[i32; 2], usize>) -> Option<Vec<(usize, u32)>> {
    let cells = lattice_cells(board);
    let [low, _] = bounds(cells.iter().copied())?;
    let mut best: Option<(f64, Vec<(usize, u32)>)> = None;
    for quarter in 0..4 {
        let found: HashMap<[i32; 2], usize> =
            lattice.iter().map(|(&cell, &disc)| (turned(cell, quarter), disc)).collect();
        let [least, _] = bounds(found.keys().copied())?;
        let place =
            |cell: &[i32; 2]| found.get(&[cell[0] - low[0] + least[0], cell[1] - low[1] + least[1]]).copied();
        let Some(known) = cells.iter().map(place).collect::<Option<Vec<usize>>>() else { continue };
        // Of several ways the one whose first disc is nearest to the top left.
        let nearness = discs[known[0]].at[0] + discs[known[0]].at[1];
        if best.as_ref().is_none_or(|(least, _)| nearness < *least) {
            best = Some((nearness, known.into_iter().zip(0..).collect()));
        }
    }
    best.map(|(_, known)| known)
}

/// Joins neighbours from a disc on; `None` where it has no two neighbours that span a lattice.
fn grow(discs: &[Disc], start: usize, most: usize) -> Option<HashMap<[i32; 2], usize>> {
    let alike = |disc: &Disc| (0.4..2.5).contains(&(disc.radius_px / discs[start].radius_px));
    let offset =
        |from: usize, to: usize| [discs[to].at[0] - discs[from].at[0], discs[to].at[1] - discs[from].at[1]];
    let length = |[x, y]: [f64; 2]| x.hypot(y);
    let mut near: Vec<(f64, usize)> = (0..discs.len())
        .filter(|&other| other != start && alike(&discs[other]))
        .map(|other| (length(offset(start, other)), other))
        .collect();
    near.sort_by(|a, b| a.0.total_cmp(&b.0));
    let first = offset(start, near.first()?.1);
    // Second direction: the nearest that is not along the first.
    let second = near.iter().take(8).map(|&(_, other)| offset(start, other)).find(|second| {
        let cross = first[0] * second[1] - first[1] * second[0];
        cross.abs() > 0.6 * length(first) * length(*second)
    })?;
    let right_handed = first[0] * second[1] - first[1] * second[0] > 0.0;
    let axes = if right_handed { [first, second] } else { [second, first] };
    let mut taken = HashMap::from([([0, 0], start)]);
    let mut used = vec![false; discs.len()];
    used[start] = true;
    let mut open = VecDeque::from([([0, 0], start, axes)]);
    while let Some((cell, disc, axes)) = open.pop_front() {
        for (axis, sign) in [(0, 1), (0, -1), (1, 1), (1, -1)] {
            let mut there = cell;
            there[axis] += sign;
            if taken.contains_key(&there) || taken.len() > most {
                continue;
            }
            let step = axes[axis].map(|value| value * f64::from(sign));
            let wanted = [discs[disc].at[0] + step[0], discs[disc].at[1] + step[1]];
            let missed =
                |other: usize| length([discs[other].at[0] - wanted[0], discs[other].at[1] - wanted[1]]);
            let nearest = (0..discs.len())
                .filter(|&other| !used[other] && alike(&discs[other]))
                .min_by(|&a, &b| missed(a).total_cmp(&missed(b)));
            let Some(next) = nearest.filter(|&next| missed(next) < NEAR * length(step)) else { continue };
            used[next] = true;
            taken.insert(there, next);
            let mut axes = axes;
            axes[axis] = offset(disc, next).map(|value| value * f64::from(sign));
            open.push_back((there, next, axes));
        }
    }
    Some(taken)
}

/// What the centre of gravity of a disc seen askew is off the image of its centre: the centre of the ellipse that the
/// circle becomes is not where its centre goes. `at` is in mm, like `radius`.
pub(super) fn eccentricity(from_board: &Matrix3<f64>, at: [f64; 2], radius: f64) -> Option<[f64; 2]> {
    let [x, y] = at;
    let circle = Matrix3::new(1.0, 0.0, -x, 0.0, 1.0, -y, -x, -y, x * x + y * y - radius * radius);
    let back = from_board.try_inverse()?;
    let ellipse = back.transpose() * circle * back;
    let (a, b, c) = (ellipse[(0, 0)], ellipse[(0, 1)], ellipse[(1, 1)]);
    let (d, e) = (ellipse[(0, 2)], ellipse[(1, 2)]);
    let determinant = a * c - b * b;
    let centre = [(b * e - c * d) / determinant, (b * d - a * e) / determinant];
    let image = project(from_board, at);
    let off = [centre[0] - image[0], centre[1] - image[1]];
    off.iter().all(|value| value.is_finite()).then_some(off)
}

/// Board to picture, from numbered discs.
pub(super) fn board_homography(board_mm: &[[f64; 2]], camera_px: &[[f64; 2]]) -> Option<Matrix3<f64>> {
    homography(board_mm, camera_px)
}
