//! Where in the image one looks: the same places for all methods.

use serde::Serialize;

use crate::{
    report::{NamedRegion, pictures::Range},
    truth::Truth,
};

/// Width and height of the squares in which stripe edges are shown, in px.
pub const SQUARE: (usize, usize) = (112, 84);

/// A flat part of the scene and the row that it is cut along.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Plate {
    /// Name of the object or region.
    pub name: String,
    /// Row of the image.
    pub row: usize,
    /// First column of the section.
    pub start: usize,
    /// One past its last column.
    pub end: usize,
    /// Upper left corner of the square in which stripe edges are shown.
    pub square: (usize, usize),
}

/// Where all methods are looked at.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Places {
    /// Width and height of the frames.
    pub size: (usize, usize),
    /// Row of the cross-sections of frames.
    pub row: usize,
    /// Flat parts.
    pub plates: Vec<Plate>,
    /// Depths from which to which colours go, in mm.
    #[serde(skip)]
    pub depth_mm: Option<Range>,
}

impl Places {
    /// Places in frames of `size`: planar objects of the truth where there is one, and the named regions.
    pub fn new(size: (usize, usize), truth: Option<&Truth>, regions: &[NamedRegion]) -> Self {
        let mut plates: Vec<Plate> = Vec::new();
        for (label, object) in truth.iter().flat_map(|truth| truth.objects.iter().enumerate()) {
            let seen = truth.filter(|_| object.planar).and_then(|truth| longest_run(truth, label as u8));
            plates.extend(seen.map(|(row, start, end)| plate(&object.name, size, (row, start, end))));
        }
        for region in regions {
            let run = (region.y + region.height / 2, region.x, region.x + region.width);
            plates.push(plate(&region.name, size, run));
        }
        let row = truth.map_or(size.1 / 2, |truth| most_objects(truth, &plates).unwrap_or(size.1 / 2));
        Self { size, row, plates, depth_mm: truth.map(|truth| Range::of(truth.depth_mm.data(), 0.002)) }
    }
}

fn plate(name: &str, (width, height): (usize, usize), (row, start, end): (usize, usize, usize)) -> Plate {
    let corner = |middle: usize, side: usize, all: usize| {
        middle.saturating_sub(side / 2).min(all.saturating_sub(side))
    };
    let square = (corner((start + end) / 2, SQUARE.0, width), corner(row, SQUARE.1, height));
    Plate { name: name.to_owned(), row, start, end, square }
}

/// Whether the truth sees the lit object `label` at each pixel.
fn is_lit(truth: &Truth, label: u8, x: usize, y: usize) -> bool {
    truth.object.at(x, y) == label && truth.column.at(x, y).is_finite()
}

/// Longest stretch of a row that sees one object, lit, less 3 px at each end; of equal ones the middle one.
fn longest_run(truth: &Truth, label: u8) -> Option<(usize, usize, usize)> {
    const MARGIN: usize = 3;
    let width = truth.object.width();
    let mut best: Vec<(usize, usize, usize)> = Vec::new();
    for y in 0..truth.object.height() {
        let mut start = 0;
        for x in 0..=width {
            if x < width && is_lit(truth, label, x, y) {
                continue;
            }
            let longest = best.first().map_or(2 * MARGIN + 8, |run| run.2 - run.1);
            if x - start > longest {
                best.clear();
            }
            if x - start >= longest {
                best.push((y, start, x));
            }
            start = x + 1;
        }
    }
    let (row, start, end) = *best.get(best.len() / 2)?;
    Some((row, start + MARGIN, end - MARGIN))
}

/// The row in which the plate that has the fewest pixels there has the most.
fn most_objects(truth: &Truth, plates: &[Plate]) -> Option<usize> {
    let labels: Vec<u8> = (0u8..)
        .zip(&truth.objects)
        .filter(|(_, object)| plates.iter().any(|plate| plate.name == object.name))
        .map(|(label, _)| label)
        .collect();
    let least = |y: usize| {
        let count = |label: &u8| (0..truth.object.width()).filter(|&x| is_lit(truth, *label, x, y)).count();
        labels.iter().map(count).min().unwrap_or(0)
    };
    let counts: Vec<usize> = (0..truth.object.height()).map(least).collect();
    let most = counts.iter().copied().max().filter(|&most| most > 0)?;
    let rows: Vec<usize> = (0..counts.len()).filter(|&y| counts[y] == most).collect();
    rows.get(rows.len() / 2).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{grid::Grid, truth::TruthObject};

    /// A dark plate of 20 x 10 px before a bright one of 60 x 40; its right quarter in shadow.
    fn truth() -> Truth {
        let (width, height) = (60, 40);
        let inside = |x: usize, y: usize| (5..25).contains(&x) && (20..30).contains(&y);
        let object = Grid::from_vec(
            width,
            height,
            (0..width * height).map(|i| u8::from(inside(i % width, i / width))).collect(),
        );
        let column = (0..width * height).map(|i| if i % width >= 45 { f32::NAN } else { (i % width) as f32 });
        let objects = ["bright", "dark"].map(|name| TruthObject { name: name.into(), planar: true });
        Truth {
            column: Grid::from_vec(width, height, column.collect()),
            row: Grid::filled(width, height, 1.0),
            depth_mm: Grid::filled(width, height, 1000.0),
            object,
            objects: objects.to_vec(),
        }
    }

    #[test]
    fn plates_are_cut_along_their_longest_lit_run() {
        let places = Places::new((60, 40), Some(&truth()), &[]);
        let [bright, dark] = &places.plates[..] else { panic!("{places:?}") };
        assert_eq!((bright.start, bright.end), (3, 42));
        assert!(!(20..30).contains(&bright.row));
        assert_eq!((dark.start, dark.end, (20..30).contains(&dark.row)), (8, 22, true));
        assert!((20..30).contains(&places.row), "the row that sees both: {}", places.row);
        assert_eq!(dark.square, (0, 0), "a square larger than the image begins at its corner");
    }

    #[test]
    fn regions_stand_in_for_a_truth() {
        let region: NamedRegion = "plate=10,6,30,20".parse().unwrap();
        let places = Places::new((640, 480), None, &[region]);
        assert_eq!((places.plates[0].row, places.plates[0].start, places.plates[0].end), (16, 10, 40));
        assert_eq!((places.row, places.depth_mm), (240, None));
    }
}
