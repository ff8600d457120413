//! Stripe edges in squares of an image, found as the paper does, and held against the truth where there is one.

use polscan_patterns::{Axis, AxisCode};
use serde::Serialize;

use super::places::{Plate, SQUARE};
use crate::{
    decode::{ImageEdge, edges_of_image},
    grid::Grid,
    truth::Truth,
};

/// Least change over two pixels that counts as an edge: 25 of 255 grey levels, for images of every kind.
pub const THRESHOLD: f32 = 25.0 / 255.0;

/// A found edge belongs to a true one up to this far from it, in camera px: degrees of polarization displace it by several.
const MATCH_PX: f64 = 6.0;

/// Edges of one image in the square of one plate.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EdgeCount {
    /// The plate.
    pub plate: String,
    /// `frame`: the captured image. `signal`: the image that the method decodes.
    pub image: &'static str,
    /// Places on edges that were found along x.
    pub found: usize,
    /// Places where a stripe truly ends, `null` without a truth, like the rest.
    pub expected: Option<usize>,
    /// Of those, places without a found edge within 6 px.
    pub missed: Option<usize>,
    /// Found ones that are none.
    pub extra: Option<usize>,
    /// Root mean square distance of the others from the truth, in camera px.
    pub rms_px: Option<f64>,
    /// How far they lie towards the dark side, on the mean, in camera px.
    pub towards_dark_px: Option<f64>,
}

/// A square of an image with its edges.
#[derive(Debug, Clone)]
pub struct Zoom {
    /// What was counted.
    pub count: EdgeCount,
    /// The square.
    pub picture: super::images::Picture,
    /// Places from its upper left pixel, in px.
    pub edges: Vec<(f64, f64)>,
}

/// Looks at the square of `plate` in `image`, whose levels are 0..=1 and which shows `bit` of the columns.
pub fn look(
    image: &Grid<f32>,
    kind: &'static str,
    plate: &Plate,
    (code, bit): (AxisCode, u8),
    truth: Option<&Truth>,
) -> Zoom {
    let (x0, y0) = plate.square;
    let (x1, y1) = ((x0 + SQUARE.0).min(image.width()), (y0 + SQUARE.1).min(image.height()));
    let edges = edges_of_image(image, x0..x1, y0..y1, THRESHOLD);
    let along_x: Vec<ImageEdge> = edges.iter().copied().filter(|edge| edge.along_x).collect();
    let mut count = EdgeCount {
        plate: plate.name.clone(),
        image: kind,
        found: along_x.len(),
        expected: None,
        missed: None,
        extra: None,
        rms_px: None,
        towards_dark_px: None,
    };
    if let Some(truth) = truth {
        let expected: Vec<(f64, usize)> =
            (y0..y1).flat_map(|y| true_edges(truth, (code, bit), y, x0..x1)).collect();
        compare(&mut count, &along_x, &expected, (x0, x1));
    }
    let relative = edges.iter().map(|edge| (edge.x - x0 as f64, edge.y - y0 as f64)).collect();
    Zoom { count, picture: super::images::pixels(image, plate.square, SQUARE), edges: relative }
}

/// Where stripes of a bit end along a row by the truth: (x, y).
fn true_edges(
    truth: &Truth,
    (code, bit): (AxisCode, u8),
    y: usize,
    columns: std::ops::Range<usize>,
) -> Vec<(f64, usize)> {
    let mut found = Vec::new();
    for x in columns.start..columns.end.saturating_sub(1) {
        let [here, there] = [x, x + 1].map(|x| f64::from(truth.column.at(x, y)));
        if truth.object.at(x, y) != truth.object.at(x + 1, y) || !here.is_finite() || !there.is_finite() {
            continue;
        }
        let (low, high) = (here.min(there), here.max(there));
        // The boundary behind column i lies at i + 0.5.
        for index in (low - 0.5).floor() as i64..=(high - 0.5).ceil() as i64 {
            let at = index as f64 + 0.5;
            let is_edge = index >= 0
                && index + 1 < i64::from(code.size())
                && code.bit(index as u32, bit) != code.bit(index as u32 + 1, bit);
            if is_edge && low <= at && at < high {
                found.push((x as f64 + (at - here) / (there - here), y));
            }
        }
    }
    found
}

fn compare(count: &mut EdgeCount, found: &[ImageEdge], expected: &[(f64, usize)], (x0, x1): (usize, usize)) {
    // Near the border of the square the other half of a pair may lie outside.
    let inside = |x: f64| x >= x0 as f64 + MATCH_PX && x <= x1 as f64 - 1.0 - MATCH_PX;
    let nearest = |x: f64, y: usize| {
        let off = expected.iter().filter(|edge| edge.1 == y).map(|edge| x - edge.0);
        off.min_by(|a, b| a.abs().total_cmp(&b.abs())).filter(|off| off.abs() <= MATCH_PX)
    };
    let (mut extra, mut squares, mut dark, mut matched) = (0, 0.0, 0.0, 0usize);
    for edge in found.iter().filter(|edge| inside(edge.x)) {
        match nearest(edge.x, edge.y.round() as usize) {
            Some(off) => {
                matched += 1;
                squares += off * off;
                // Where it is bright behind the edge, the dark side lies before it.
                dark -= edge.step.signum() * off;
            }
            None => extra += 1,
        }
    }
    let is_found = |x: f64, y: usize| {
        found.iter().any(|edge| edge.y.round() as usize == y && (edge.x - x).abs() <= MATCH_PX)
    };
    let of_inside: Vec<_> = expected.iter().filter(|edge| inside(edge.0)).collect();
    count.expected = Some(of_inside.len());
    count.missed = Some(of_inside.iter().filter(|edge| !is_found(edge.0, edge.1)).count());
    count.extra = Some(extra);
    if matched > 0 {
        count.rms_px = Some((squares / matched as f64).sqrt());
        count.towards_dark_px = Some(dark / matched as f64);
    }
}

/// Bit of an axis whose stripes are `columns` wide, or the nearest that there is.
pub fn bit_with_stripes(code: AxisCode, columns: u32) -> u8 {
    let bits = code.bits();
    bits.saturating_sub(columns.ilog2() as u8).min(bits.saturating_sub(1))
}

/// The axis whose stripes are shown.
pub const AXIS: Axis = Axis::Column;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::truth::TruthObject;

    #[test]
    fn stripes_of_a_bit_have_the_width_asked_for() {
        let code = AxisCode::plain(1024).unwrap();
        for columns in [2, 8, 32] {
            let bit = bit_with_stripes(code, columns);
            let edges: Vec<u32> = (0..1023).filter(|&i| code.bit(i, bit) != code.bit(i + 1, bit)).collect();
            assert!(edges.windows(2).all(|two| two[1] - two[0] == columns), "{columns}: bit {bit}");
        }
        assert_eq!(bit_with_stripes(AxisCode::plain(2).unwrap(), 32), 0);
    }

    /// Stripes on a slanted plane, one column every 3 px, drawn by area; `power` bends the levels as a degree of
    /// polarization does.
    fn scene(power: f32) -> (Grid<f32>, Truth, AxisCode, u8) {
        let (width, height) = (160, 120);
        let code = AxisCode::plain(64).unwrap();
        let bit = bit_with_stripes(code, 8);
        let column = |x: f64, y: f64| 4.2 + x / 3.0 + 0.01 * y;
        let level = |x: usize, y: usize| {
            let lit = (0..256).filter(|k| {
                let at = column(
                    x as f64 - 0.5 + (f64::from(k % 16) + 0.5) / 16.0,
                    y as f64 - 0.5 + (f64::from(k / 16) + 0.5) / 16.0,
                );
                code.bit(at.round().clamp(0.0, 63.0) as u32, bit)
            });
            (0.05 + 0.9 * lit.count() as f32 / 256.0).powf(power)
        };
        let pixels = || (0..width * height).map(|i| (i % width, i / width));
        let truth = Truth {
            column: Grid::from_vec(
                width,
                height,
                pixels().map(|(x, y)| column(x as f64, y as f64) as f32).collect(),
            ),
            row: Grid::filled(width, height, 0.0),
            depth_mm: Grid::filled(width, height, 1.0),
            object: Grid::filled(width, height, 0),
            objects: vec![TruthObject { name: "plane".into(), planar: true }],
        };
        (Grid::from_vec(width, height, pixels().map(|(x, y)| level(x, y)).collect()), truth, code, bit)
    }

    #[test]
    fn true_stripes_are_found_where_they_are() {
        let (image, truth, code, bit) = scene(1.0);
        let plate = Plate { name: "plane".into(), row: 60, start: 0, end: 160, square: (24, 18) };
        let count = look(&image, "frame", &plate, (code, bit), Some(&truth)).count;
        println!("{count:?}");
        // A stripe ends every 24 px: four or five in 100 px, on each of 84 rows.
        assert!((4 * 84..=5 * 84).contains(&count.expected.unwrap()));
        assert_eq!((count.missed, count.extra), (Some(0), Some(0)));
        assert!(count.rms_px.unwrap() < 0.03 && count.towards_dark_px.unwrap().abs() < 0.01);
        // Bent levels push edges to the dark side: by up to 0.35 px for a power of 1/4 (the level of a half becomes 0.8).
        let (bent, ..) = scene(0.25);
        let bent = look(&bent, "frame", &plate, (code, bit), Some(&truth)).count;
        println!("{bent:?}");
        assert!(bent.towards_dark_px.unwrap() > 0.05, "{bent:?}");
        let blind = look(&image, "frame", &plate, (code, bit), None);
        assert_eq!((blind.count.expected, blind.edges.is_empty()), (None, false));
        let dark = image.map(|level| 0.03 * level);
        let dark = look(&dark, "frame", &plate, (code, bit), Some(&truth)).count;
        assert_eq!((dark.found, dark.missed), (0, dark.expected));
    }
}
