//! Frames in another order than their roles say: what pair sums cannot see.
//!
//! Exchanging a pair's two frames flips its bit everywhere. In a Gray code that reverses the count within every block of
//! that bit, so columns run backwards there: locally the projector's picture is mirrored, which no opaque surface that
//! both camera and projector see can do, however it is turned.

use polscan_patterns::{Axis, AxisCode};

use crate::{
    decode::{DecodeSettings, Decoded},
    grid::Grid,
    report::PixelCounts,
};

/// Distance in camera px over which slopes are taken: short of the blocks of all but the finest bits.
const STEP_PX: usize = 8;
/// An area of the projector, in px^2, that integer codes cannot feign.
const LEAST_AREA: i64 = 2;
/// Places that a judgement needs.
const LEAST_PLACES: u64 = 100;
/// Share of the places that must be mirrored. Depth jumps and noise mirror a few of any scene.
const MIRRORED_SHARE: f64 = 0.6;
/// About so many places are looked at.
const PLACES: usize = 20_000;

/// What the order of words in the image says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mirrored {
    /// Share of the places where the projector's picture is mirrored.
    pub share: f64,
    /// Places looked at.
    pub places: u64,
    /// Pair whose exchange explains it best.
    pub pair: Option<(Axis, u8)>,
}

/// Finds out whether the projector's picture is mirrored in the camera's.
pub fn mirrored(decoded: &Decoded, settings: Option<&DecodeSettings>) -> Option<Mirrored> {
    let columns = &decoded.column.code;
    let rows = &decoded.row.as_ref()?.code;
    let places = places(columns);
    let plain = judge(&places, |index| at(columns, index), |index| at(rows, index));
    let share = plain.mirrored as f64 / plain.places() as f64;
    if plain.places() < LEAST_PLACES || share < MIRRORED_SHARE {
        return None;
    }
    let pair = settings.and_then(|settings| explain(&places, columns, rows, settings));
    Some(Mirrored { share, places: plain.places(), pair })
}

/// The pair that has to be exchanged back for the picture to be whole, upright and continuous.
fn explain(
    places: &[[usize; 4]],
    columns: &Grid<i32>,
    rows: &Grid<i32>,
    settings: &DecodeSettings,
) -> Option<(Axis, u8)> {
    let hypotheses = [(Axis::Column, settings.column), (Axis::Row, settings.row)]
        .into_iter()
        .flat_map(|(axis, code)| (0..code.bits()).map(move |bit| (axis, bit, code)));
    let scored = hypotheses.map(|(axis, bit, code)| {
        let turned = |grid: &Grid<i32>, index: usize| exchange(at(grid, index)?, bit, code);
        let count = match axis {
            Axis::Column => judge(places, |i| turned(columns, i), |i| at(rows, i)),
            Axis::Row => judge(places, |i| at(columns, i), |i| turned(rows, i)),
        };
        (count.score(), (axis, bit))
    });
    scored.max_by(|a, b| a.0.cmp(&b.0)).map(|(_, pair)| pair)
}

/// The pair of the columns whose exchange makes the words of a scan without rows whole: where it removes jumps, or, of
/// the most significant pair, where words run backwards and most points lie out of the volume for it.
pub fn reversed(
    decoded: &Decoded,
    settings: Option<&DecodeSettings>,
    pixels: &PixelCounts,
) -> Option<(Axis, u8)> {
    if decoded.row.is_some() {
        return None;
    }
    let code = settings?.column;
    let columns = &decoded.column.code;
    let places = places(columns);
    let runs = |bit: Option<u8>| {
        let word = |index: usize| match bit {
            Some(bit) => exchange(at(columns, index)?, bit, code),
            None => at(columns, index),
        };
        let (mut seen, mut rising, mut jumps) = (0u64, 0u64, 0u64);
        for &[here, right, _, next] in &places {
            let (Some(here), Some(right), Some(next)) = (word(here), word(right), word(next)) else {
                continue;
            };
            seen += 1;
            rising += u64::from(right > here);
            jumps += u64::from((next - here).abs() > 2);
        }
        (seen >= LEAST_PLACES).then(|| [rising, jumps].map(|count| count as f64 / seen as f64))
    };
    let [rising, jumps] = runs(None)?;
    if rising > 1.0 - MIRRORED_SHARE {
        return None;
    }
    let candidates = (0..code.bits()).filter_map(|bit| Some((bit, runs(Some(bit))?)));
    let (bit, [turned, left]) = candidates.max_by(|a, b| (a.1[0] - a.1[1]).total_cmp(&(b.1[0] - b.1[1])))?;
    let out = pixels.out_of_volume as f64 > 0.5 * (pixels.out_of_volume + pixels.valid) as f64;
    let is_better = turned > MIRRORED_SHARE && left <= jumps && (out || (bit > 0 && left < 0.5 * jumps));
    is_better.then_some((Axis::Column, bit))
}

/// The index whose word differs from that of `index` in `bit`.
fn exchange(index: i64, bit: u8, code: AxisCode) -> Option<i64> {
    let index = u32::try_from(index).ok().filter(|&index| index < code.size())?;
    code.decode(code.encode(index) ^ (1 << (code.bits() - 1 - bit))).map(i64::from)
}

fn at(grid: &Grid<i32>, index: usize) -> Option<i64> {
    Some(i64::from(grid.data()[index])).filter(|&code| code >= 0)
}

/// Pixels to look at: each with those [`STEP_PX`] to the right and below, and its right neighbour.
fn places(grid: &Grid<i32>) -> Vec<[usize; 4]> {
    let (width, height) = (grid.width(), grid.height());
    let (across, down) = (width.saturating_sub(STEP_PX), height.saturating_sub(STEP_PX));
    let stride = (across * down / PLACES).isqrt().max(1);
    let mut places = Vec::new();
    for y in (0..down).step_by(stride) {
        for x in (0..across).step_by(stride) {
            let index = y * width + x;
            places.push([index, index + STEP_PX, index + STEP_PX * width, index + 1]);
        }
    }
    places
}

#[derive(Default)]
struct Count {
    upright: u64,
    mirrored: u64,
    /// Upright places where columns also grow to the right and rows downwards, as on a rig that is not turned.
    straight: u64,
    /// Places whose right neighbour carries nearly the same word.
    smooth: u64,
}

impl Count {
    fn places(&self) -> u64 {
        self.upright + self.mirrored
    }

    fn score(&self) -> (u64, u64) {
        // Whole first; of equals, the one that is not turned.
        (self.upright + self.smooth, self.straight)
    }
}

fn judge(
    places: &[[usize; 4]],
    column: impl Fn(usize) -> Option<i64>,
    row: impl Fn(usize) -> Option<i64>,
) -> Count {
    let mut count = Count::default();
    for &[here, right, below, next] in places {
        let word = |index| Some((column(index)?, row(index)?));
        let (Some(here), Some(right), Some(below)) = (word(here), word(right), word(below)) else { continue };
        let (across, down) = ((right.0 - here.0, right.1 - here.1), (below.0 - here.0, below.1 - here.1));
        let area = across.0 * down.1 - across.1 * down.0;
        if area.abs() < LEAST_AREA {
            continue;
        }
        if area < 0 {
            count.mirrored += 1;
        } else {
            count.upright += 1;
            count.straight += u64::from(across.0 > 0 && down.1 > 0);
        }
        if let Some(next) = word(next) {
            count.smooth += u64::from((next.0 - here.0).abs() <= 2 && (next.1 - here.1).abs() <= 2);
        }
    }
    count
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::testing;

    /// Exchanges the frames of one pair of a sound decode.
    fn exchanged(axis: Axis, bit: u8, turn: bool) -> Option<Mirrored> {
        let settings = testing::settings(160, 120);
        let mut decoded = testing::decoded(160, 120);
        if turn {
            // The camera upside down: both axes run backwards, and nothing is mirrored.
            decoded.column.code.data_mut().reverse();
            decoded.row.as_mut().unwrap().code.data_mut().reverse();
        }
        let (grid, code) = match axis {
            Axis::Column => (&mut decoded.column.code, settings.column),
            Axis::Row => (&mut decoded.row.as_mut().unwrap().code, settings.row),
        };
        for value in grid.data_mut() {
            *value = exchange(i64::from(*value), bit, code).map_or(-1, |index| index as i32);
        }
        mirrored(&decoded, Some(&settings))
    }

    #[test]
    fn a_sound_decode_is_not_mirrored_whichever_way_up() {
        let settings = testing::settings(160, 120);
        let mut decoded = testing::decoded(160, 120);
        assert_eq!(mirrored(&decoded, Some(&settings)), None);
        decoded.column.code.data_mut().reverse();
        decoded.row.as_mut().unwrap().code.data_mut().reverse();
        assert_eq!(mirrored(&decoded, Some(&settings)), None);
    }

    #[test]
    fn each_exchanged_pair_is_named() {
        for axis in [Axis::Column, Axis::Row] {
            for bit in 0..4 {
                let found = exchanged(axis, bit, false).unwrap_or_else(|| panic!("{axis} bit {bit}"));
                assert_eq!(found.pair, Some((axis, bit)));
            }
        }
    }

    #[test]
    fn an_exchanged_pair_is_seen_by_a_camera_upside_down() {
        for bit in 1..4 {
            let found = exchanged(Axis::Column, bit, true).unwrap_or_else(|| panic!("bit {bit}"));
            assert_eq!(found.pair, Some((Axis::Column, bit)));
        }
    }

    #[test]
    fn without_rows_or_words_nothing_is_claimed() {
        let settings = testing::settings(160, 120);
        let mut decoded = testing::decoded(160, 120);
        decoded.column.code.data_mut().fill(-1);
        assert_eq!(mirrored(&decoded, Some(&settings)), None);
        decoded.row = None;
        assert_eq!(mirrored(&decoded, Some(&settings)), None);
        assert_eq!(mirrored(&testing::decoded(4, 4), None), None);
    }
}
