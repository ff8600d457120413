//! Where a figure is taken: named rectangles, and pixels that keep away from silhouettes.

use std::str::FromStr;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::grid::Grid;

/// How far figures keep from silhouettes and shadow borders, in camera px: a 5x5 neighbourhood.
pub const MARGIN_PX: usize = 2;

/// Label of a pixel that belongs to nothing.
pub const NOTHING: u8 = u8::MAX;

/// A rectangle of the camera image with a name, as given by `--region NAME=x,y,w,h`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct NamedRegion {
    /// Name in the report.
    pub name: String,
    /// First column.
    pub x: usize,
    /// First row.
    pub y: usize,
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
}

/// Why a region cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum RegionError {
    /// Not of the form `NAME=x,y,w,h`.
    #[error(
        "region `{text}` is not of the form NAME=x,y,w,h with whole numbers, for example plate=100,80,640,480"
    )]
    Form {
        /// What was given.
        text: String,
    },
    /// Too small for any pixel to be away from its border.
    #[error(
        "region `{name}` is {width}x{height} px, too small to measure {MARGIN_PX} px off its border; make it larger"
    )]
    Small {
        /// Name.
        name: String,
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// Not within the image.
    #[error("region `{name}` reaches beyond the image of {width}x{height} px; make it smaller or move it")]
    Outside {
        /// Name.
        name: String,
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
    },
    /// Two regions that nobody could tell apart.
    #[error("two regions are named `{name}`; give each a name of its own")]
    Repeated {
        /// Name.
        name: String,
    },
}

impl FromStr for NamedRegion {
    type Err = RegionError;

    fn from_str(text: &str) -> Result<Self, RegionError> {
        let form = || RegionError::Form { text: text.to_owned() };
        let (name, numbers) = text.split_once('=').ok_or_else(form)?;
        let numbers: Vec<usize> =
            numbers.split(',').map(|n| n.trim().parse()).collect::<Result<_, _>>().map_err(|_| form())?;
        let [x, y, width, height] = numbers[..] else { return Err(form()) };
        if name.trim().is_empty() {
            return Err(form());
        }
        let name = name.trim().to_owned();
        if width.min(height) <= 2 * MARGIN_PX {
            return Err(RegionError::Small { name, width, height });
        }
        Ok(Self { name, x, y, width, height })
    }
}

/// Refuses regions that reach beyond an image of `size` (width, height), or share a name.
pub fn check_regions(regions: &[NamedRegion], (width, height): (usize, usize)) -> Result<(), RegionError> {
    for (number, region) in regions.iter().enumerate() {
        region.check(width, height)?;
        if regions[..number].iter().any(|other| other.name == region.name) {
            return Err(RegionError::Repeated { name: region.name.clone() });
        }
    }
    Ok(())
}

impl NamedRegion {
    /// Refuses a region that reaches beyond an image of `width` x `height`.
    fn check(&self, width: usize, height: usize) -> Result<(), RegionError> {
        let fits = |start: usize, size: usize, all| start.checked_add(size).is_some_and(|end| end <= all);
        if fits(self.x, self.width, width) && fits(self.y, self.height, height) {
            return Ok(());
        }
        Err(RegionError::Outside { name: self.name.clone(), width, height })
    }

    /// Whether a pixel lies in the region, 2 px off its border.
    pub fn contains(&self, x: usize, y: usize) -> bool {
        let inside =
            |at: usize, start: usize, size: usize| at >= start + MARGIN_PX && at + MARGIN_PX < start + size;
        inside(x, self.x, self.width) && inside(y, self.y, self.height)
    }
}

/// Keeps a label where the whole 5x5 neighbourhood carries it, and puts [`NOTHING`] elsewhere. What lies beyond the
/// image is not seen, so the outermost [`MARGIN_PX`] pixels keep none.
pub fn off_borders(labels: &Grid<u8>) -> Grid<u8> {
    let (width, height) = (labels.width(), labels.height());
    let reach = 2 * MARGIN_PX;
    // Equal in all rows and, within them, in all columns is equal in all: so one direction after the other.
    let mut along = Grid::filled(width, height, NOTHING);
    for (y, line) in along.data_mut().chunks_exact_mut(width.max(1)).enumerate() {
        for (x, window) in labels.row(y).windows(reach + 1).enumerate() {
            if window.iter().all(|&label| label == window[0]) {
                line[x + MARGIN_PX] = window[0];
            }
        }
    }
    let mut kept = Grid::filled(width, height, NOTHING);
    for y in MARGIN_PX..height.saturating_sub(MARGIN_PX) {
        let line = &mut kept.data_mut()[y * width..][..width];
        line.copy_from_slice(along.row(y));
        for near in (y - MARGIN_PX..=y + MARGIN_PX).filter(|&near| near != y) {
            for (label, &other) in line.iter_mut().zip(along.row(near)) {
                if *label != other {
                    *label = NOTHING;
                }
            }
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Looks at all 25 pixels.
    fn off_borders_slowly(labels: &Grid<u8>) -> Grid<u8> {
        let (w, h) = (labels.width() as i64, labels.height() as i64);
        let mut kept = Grid::filled(labels.width(), labels.height(), NOTHING);
        for y in 0..h {
            for x in 0..w {
                let label = labels.at(x as usize, y as usize);
                let all = (-2..=2).all(|dy| {
                    (-2..=2).all(|dx| {
                        let (x, y) = (x + dx, y + dy);
                        (0..w).contains(&x)
                            && (0..h).contains(&y)
                            && labels.at(x as usize, y as usize) == label
                    })
                });
                if all {
                    kept.data_mut()[(y * w + x) as usize] = label;
                }
            }
        }
        kept
    }

    proptest! {
        #[test]
        fn off_borders_is_the_slow_one(
            (width, height, cells) in (1usize..24, 1usize..24)
                .prop_flat_map(|(w, h)| (Just(w), Just(h), prop::collection::vec(0u8..4, w * h))),
            block in 1usize..9,
        ) {
            // Blocks of equal labels, or there would be no neighbourhood of one.
            let labels: Vec<u8> = (0..width * height)
                .map(|i| match cells[(i / width / block) * width + (i % width) / block] { 3 => NOTHING, label => label })
                .collect();
            let labels = Grid::from_vec(width, height, labels);
            prop_assert_eq!(off_borders(&labels), off_borders_slowly(&labels));
        }
    }

    #[test]
    fn a_block_keeps_its_inside() {
        let mut labels = Grid::filled(12, 10, NOTHING);
        for y in 2..9 {
            for x in 3..11 {
                labels.data_mut()[y * 12 + x] = 7;
            }
        }
        let kept = off_borders(&labels);
        assert_eq!(kept.data().iter().filter(|&&label| label == 7).count(), 4 * 3);
        assert_eq!((kept.at(5, 4), kept.at(4, 4), kept.at(5, 3)), (7, NOTHING, NOTHING));
    }

    #[test]
    fn regions_are_read_and_refused() {
        let region: NamedRegion = "plate=10,20,30,40".parse().unwrap();
        assert_eq!(region, NamedRegion { name: "plate".into(), x: 10, y: 20, width: 30, height: 40 });
        assert!(region.contains(12, 22) && !region.contains(11, 22) && !region.contains(12, 21));
        assert!(region.contains(37, 57) && !region.contains(38, 57) && !region.contains(37, 58));
        for text in ["plate", "=1,2,30,40", "a=1,2,30", "a=1,2,30,40,5", "a=-1,2,30,40", "a=1,2,x,40"] {
            assert!(matches!(text.parse::<NamedRegion>(), Err(RegionError::Form { .. })), "{text}");
        }
        assert!(matches!("a=0,0,4,9".parse::<NamedRegion>(), Err(RegionError::Small { .. })));
        assert_eq!(region.check(40, 60), Ok(()));
        assert!(region.check(39, 60).is_err() && region.check(40, 59).is_err());
        assert!(NamedRegion { x: usize::MAX, ..region.clone() }.check(40, 60).is_err());
        let twice = [region.clone(), NamedRegion { x: 0, ..region }];
        assert_eq!(check_regions(&twice[..1], (40, 60)), Ok(()));
        assert_eq!(check_regions(&twice, (40, 60)), Err(RegionError::Repeated { name: "plate".into() }));
    }
}
