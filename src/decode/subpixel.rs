//! Projector coordinates finer than a pixel.

use super::{
    gates::AxisShape,
    plan::Frames,
    sample::Sample,
    types::{AxisMap, Thresholds},
    words::{Gates, PixelMaps},
};
use crate::grid::Grid;

pub(crate) fn refine<T: Sample>(
    frames: &Frames<'_, T>,
    maps: &PixelMaps,
    _gates: &Gates,
    _thresholds: &Thresholds,
    index: usize,
    _shape: AxisShape,
    _interpolated: &mut [bool],
) -> AxisMap {
    let (width, height) = (frames.width, frames.height);
    let code = frames.axes[index].code;
    let values = &maps.values[index];
    let span = |at: usize| code.span(values[at]).filter(|_| values[at] >= 0);
    let valid = |at: usize| maps.class[at].is_valid();
    let codes = (0..values.len()).map(|at| span(at).map_or(-1, |(a, b)| (a + b) / 2)).collect();
    let coordinate = (0..values.len())
        .map(|at| span(at).filter(|_| valid(at)).map_or(f32::NAN, |(a, b)| (a + b) as f32 / 2.0))
        .collect();
    let sigma = (0..values.len())
        .map(|at| span(at).filter(|_| valid(at)).map_or(f32::NAN, |(a, b)| (b - a + 1) as f32 / 12f32.sqrt()))
        .collect();
    AxisMap {
        code: Grid::from_vec(width, height, codes),
        coordinate: Grid::from_vec(width, height, coordinate),
        sigma: Grid::from_vec(width, height, sigma),
    }
}
