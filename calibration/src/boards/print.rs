//! Boards as plain shapes, for a printer and for whoever draws them.

use super::description::{Board, Charuco, Pattern};

/// A dark or light shape, in mm as intended, from the top left corner of the board, y down.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Shape {
    /// A rectangle: left, top, width, height.
    Rectangle([f64; 4]),
    /// A disc: centre and radius.
    Disc([f64; 3]),
}

impl Shape {
    /// Whether a point lies in it.
    pub fn contains(&self, [x, y]: [f64; 2]) -> bool {
        match *self {
            Self::Rectangle([left, top, width, height]) => {
                x >= left && x < left + width && y >= top && y < top + height
            }
            Self::Disc([cx, cy, radius]) => (x - cx).powi(2) + (y - cy).powi(2) <= radius * radius,
        }
    }
}

/// The dark shapes of a board. None overlaps another.
pub fn dark_shapes(board: &Board) -> Vec<Shape> {
    match &board.pattern {
        Pattern::Checkerboard(pattern) => {
            squares([pattern.columns, pattern.rows], pattern.square_mm, |column, row| (column + row) % 2 == 0)
        }
        Pattern::Charuco(pattern) => {
            let marked = pattern.marked_squares();
            let light = |column, row| marked.contains(&[column, row]);
            let mut shapes = squares([pattern.columns, pattern.rows], pattern.square_mm, |column, row| {
                !light(column, row)
            });
            for (&square, code) in marked.iter().zip(pattern.dictionary.codes()) {
                shapes.extend(marker(pattern, square, code));
            }
            shapes
        }
        Pattern::Circles(pattern) => {
            let places =
                (0..pattern.rows).flat_map(|row| (0..pattern.columns).map(move |column| (column, row)));
            let disc = |(column, row)| {
                let [x, y] = pattern.centre(column, row);
                Shape::Disc([x, y, 0.5 * pattern.diameter_mm])
            };
            places.map(disc).collect()
        }
    }
}

fn squares([columns, rows]: [u32; 2], side: f64, is_dark: impl Fn(u32, u32) -> bool) -> Vec<Shape> {
    let places = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
    let square =
        |(column, row)| Shape::Rectangle([f64::from(column) * side, f64::from(row) * side, side, side]);
    places.filter(|&(column, row)| is_dark(column, row)).map(square).collect()
}

/// Dark bits of a marker with its border, runs in a row joined: seams between rectangles can show in print.
fn marker(pattern: &Charuco, [column, row]: [u32; 2], code: u64) -> Vec<Shape> {
    let side = pattern.dictionary.side();
    let bit_mm = pattern.marker_mm / (side + 2) as f64;
    let margin = 0.5 * (pattern.square_mm - pattern.marker_mm);
    let left = f64::from(column) * pattern.square_mm + margin;
    let top = f64::from(row) * pattern.square_mm + margin;
    let dark = |x: usize, y: usize| {
        let inside = (1..=side).contains(&x) && (1..=side).contains(&y);
        !inside || code >> (side * side - 1 - ((y - 1) * side + x - 1)) & 1 == 0
    };
    let mut shapes = Vec::new();
    for y in 0..side + 2 {
        let mut x = 0;
        while x < side + 2 {
            let run = (x..side + 2).take_while(|&x| dark(x, y)).count();
            if run > 0 {
                let at = |bits: usize| bits as f64 * bit_mm;
                shapes.push(Shape::Rectangle([left + at(x), top + at(y), at(run), bit_mm]));
            }
            x += run.max(1);
        }
    }
    shapes
}
