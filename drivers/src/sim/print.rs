//! What is printed on a plane: cells, dark or as light as the plane.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::faults::Faults;

/// A pattern of square cells, such as a calibration board, on an object of one plane. Around it the plane is bare.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Print {
    /// Top left corner of the pattern.
    pub origin_mm: [f64; 3],
    /// Along the rows, of any length.
    pub right: [f64; 3],
    /// Along the columns, of any length, across `right`.
    pub down: [f64; 3],
    /// Side of a cell.
    pub cell_mm: f64,
    /// Cells row by row: `#` is dark, anything else light.
    pub cells: Vec<String>,
    /// What a dark cell reflects, as a share of a light one.
    pub dark: f64,
}

/// A pixel's share of light and dark is found by as many samples along each side.
const SAMPLES: u32 = 8;

impl Print {
    pub(super) fn validate(&self, faults: &mut Faults, key: &str) {
        faults.above(&format!("{key}.cell_mm"), self.cell_mm, 0.0);
        faults.within(&format!("{key}.dark"), self.dark, 0.0, 1.0);
        let (right, down) = (Vector3::from(self.right), Vector3::from(self.down));
        let finite = self.origin_mm.iter().all(|value| value.is_finite());
        // NaN and zero lengths fail every comparison.
        let across = right.dot(&down).abs() <= 1e-6 * right.norm() * down.norm();
        if !(finite && right.norm() > 1e-9 && down.norm() > 1e-9 && across) {
            faults.add(key, "needs a finite origin_mm, and right and down that are across each other");
        }
        if self.cells.is_empty() || !self.cells.iter().all(|row| row.is_ascii()) {
            faults.add(&format!("{key}.cells"), "must be rows of `#` and other ASCII letters");
        }
    }

    /// Place of a point of the plane in cells.
    pub(super) fn place(&self, point: Vector3<f64>) -> [f64; 2] {
        let from = point - Vector3::from(self.origin_mm);
        [self.right, self.down].map(|axis| from.dot(&Vector3::from(axis).normalize()) / self.cell_mm)
    }

    /// Reflectance at a place, as a share of the bare plane's.
    fn tone(&self, [column, row]: [f64; 2]) -> f64 {
        if column < 0.0 || row < 0.0 {
            return 1.0;
        }
        let cell = self.cells.get(row as usize).and_then(|row| row.as_bytes().get(column as usize));
        if cell == Some(&b'#') { self.dark } else { 1.0 }
    }

    /// Mean reflectance over a pixel: its middle, and how far its neighbours to the right and below lie from it.
    pub(super) fn over(&self, middle: [f64; 2], right: [f64; 2], below: [f64; 2]) -> f64 {
        let offset = |sample: u32| (f64::from(sample) + 0.5) / f64::from(SAMPLES) - 0.5;
        let at = |u: f64, v: f64| [0, 1].map(|axis| middle[axis] + u * right[axis] + v * below[axis]);
        let whole = |cell: [f64; 2]| cell.map(f64::floor);
        let corners = [(-0.5, -0.5), (0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)].map(|(u, v)| whole(at(u, v)));
        if corners.iter().all(|corner| *corner == corners[0]) {
            return self.tone(middle);
        }
        let samples =
            (0..SAMPLES * SAMPLES).map(|sample| at(offset(sample % SAMPLES), offset(sample / SAMPLES)));
        samples.map(|at| self.tone(at)).sum::<f64>() / f64::from(SAMPLES * SAMPLES)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn print() -> Print {
        Print {
            origin_mm: [-2.0, -1.0, 100.0],
            right: [2.0, 0.0, 0.0],
            down: [0.0, 3.0, 0.0],
            cell_mm: 0.5,
            cells: vec!["#.".into(), ".#".into()],
            dark: 0.25,
        }
    }

    #[test]
    fn a_pixel_sees_the_mean_of_what_it_covers() {
        let print = print();
        let place = print.place(Vector3::new(-1.5, -0.5, 100.0));
        assert_eq!(place, [1.0, 1.0]);
        let small = |at| print.over(at, [0.1, 0.0], [0.0, 0.1]);
        assert_eq!(
            [small([0.5, 0.5]), small([1.5, 0.5]), small([-0.5, 0.5]), small([2.5, 1.5])],
            [0.25, 1.0, 1.0, 1.0]
        );
        // Two light and two dark cells meet in the middle.
        assert_eq!(print.over(place, [1.0, 0.0], [0.0, 1.0]), 0.625);
        // Turned by an eighth as well.
        assert!((print.over(place, [0.5, 0.5], [-0.5, 0.5]) - 0.625).abs() < 0.02);
    }

    #[test]
    fn a_print_that_cannot_be_is_refused() {
        let faults = |print: &Print| {
            let mut faults = Faults::new("");
            print.validate(&mut faults, "print");
            faults.into_list()
        };
        assert_eq!(faults(&print()), Vec::<String>::new());
        assert_eq!(faults(&Print { down: [1.0, 1.0, 0.0], ..print() }).len(), 1);
        assert_eq!(faults(&Print { cells: Vec::new(), dark: 2.0, ..print() }).len(), 2);
    }
}
