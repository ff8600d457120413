//! A whole scan on one sheet.

use image::{RgbImage, imageops};
use polscan_patterns::ProjectorSize;

use super::{
    canvas::{self, FAINT, INK, WHITE, blank},
    maps::{MapStyle, Range, class_picture, map_picture, without_margin},
    text::{self, Ink},
};
use crate::{
    grid::Grid,
    report::colormap::{Colormap, Rgb},
};

/// Width of a tile's picture in px.
const TILE_WIDTH: u32 = 520;

/// Space around tiles in px.
const GAP: u32 = 26;

/// Height of titles in px.
const TITLE_HEIGHT: f32 = 15.0;

/// Height of numbers in px.
const NUMBER_HEIGHT: f32 = 11.0;

/// Width for a colour bar or a legend at the right of a tile, in px.
const MARGIN: u32 = 176;

/// Colour where a map has no value.
const MISSING: Rgb = WHITE;

/// What goes on the sheet. All maps are of one size.
#[derive(Debug, Clone, Copy)]
pub struct OverviewInput<'a> {
    /// Heading.
    pub title: &'a str,
    /// A captured frame, as [`frame_picture`](super::frame_picture) shows it, and what it is.
    pub frame: (&'a RgbImage, &'a str),
    /// Degree of linear polarization.
    pub dolp: &'a Grid<f32>,
    /// Projector column.
    pub column: &'a Grid<f32>,
    /// Projector row, where rows were coded.
    pub row: Option<&'a Grid<f32>>,
    /// Depth in mm, where there is a calibration.
    pub depth_mm: Option<&'a Grid<f32>>,
    /// Numbers of classes.
    pub class: &'a Grid<u8>,
    /// Size of the projector.
    pub projector: ProjectorSize,
}

/// One picture of the sheet: the map and what stands at its right.
struct Tile {
    title: String,
    picture: RgbImage,
    bar: Option<(Colormap, Range, &'static str)>,
}

impl Tile {
    fn of_map(title: String, values: &Grid<f32>, map: Colormap, range: Range, unit: &'static str) -> Self {
        let missing = if map == Colormap::Gray { [0; 3] } else { MISSING };
        let picture = map_picture(values, MapStyle { map, range, missing, bar: None });
        Self { title, picture, bar: Some((map, range, unit)) }
    }
}

/// Frame, polarization, column, row, depth and class side by side, with titles and colour bars.
pub fn overview(input: &OverviewInput<'_>) -> RgbImage {
    let tiles = tiles(input);
    let height = |picture: &RgbImage| canvas::fit(picture, TILE_WIDTH, 2 * TILE_WIDTH).height();
    let tile_height = tiles.iter().map(|tile| height(&tile.picture)).max().unwrap_or(1);
    let (cell_width, cell_height) =
        (TILE_WIDTH + MARGIN + GAP, tile_height + GAP + (2.2 * TITLE_HEIGHT) as u32);
    let columns = 3;
    let rows = (tiles.len() as u32).div_ceil(columns);
    let heading = (4.4 * TITLE_HEIGHT) as u32;
    let width = columns * cell_width + GAP;
    let mut sheet = blank(width, heading + rows * cell_height, WHITE);
    let ink = Ink { height: 1.4 * TITLE_HEIGHT, color: INK };
    text::draw(&mut sheet, input.title, (GAP as f32, 1.5 * TITLE_HEIGHT), ink);
    canvas::fill(&mut sheet, (GAP, (3.7 * TITLE_HEIGHT) as u32), (width - 2 * GAP, 1), FAINT);
    for (index, tile) in (0..).zip(&tiles) {
        let at = (GAP + index % columns * cell_width, heading + index / columns * cell_height);
        place(&mut sheet, tile, at, input.class);
    }
    sheet
}

fn tiles(input: &OverviewInput<'_>) -> Vec<Tile> {
    let index_range = |size: u32| Range { low: 0.0, high: size.saturating_sub(1).max(1) as f32 };
    let mut tiles = vec![
        Tile { title: input.frame.1.to_owned(), picture: input.frame.0.clone(), bar: None },
        Tile::of_map(
            "degree of linear polarization".to_owned(),
            input.dolp,
            Colormap::Gray,
            Range { low: 0.0, high: 1.0 },
            "DOLP",
        ),
        Tile::of_map(
            "projector column".to_owned(),
            input.column,
            Colormap::Jet,
            index_range(input.projector.width),
            "px",
        ),
    ];
    if let Some(row) = input.row {
        let range = index_range(input.projector.height);
        tiles.push(Tile::of_map("projector row".to_owned(), row, Colormap::Jet, range, "px"));
    }
    if let Some(depth_mm) = input.depth_mm {
        let range = Range::of(depth_mm.data(), 0.002);
        tiles.push(Tile::of_map("depth".to_owned(), depth_mm, Colormap::Parula, range, "mm"));
    }
    let classes = class_picture(input.class);
    let picture = without_margin(&classes, input.class.width() as u32);
    tiles.push(Tile { title: "class".to_owned(), picture, bar: None });
    tiles
}

fn place(sheet: &mut RgbImage, tile: &Tile, (x, y): (u32, u32), class: &Grid<u8>) {
    let ink = Ink { height: TITLE_HEIGHT, color: INK };
    text::draw(sheet, &tile.title, (x as f32, y as f32), ink);
    let y = y + (1.8 * TITLE_HEIGHT) as u32;
    let picture = canvas::fit(&tile.picture, TILE_WIDTH, 2 * TILE_WIDTH);
    let (width, height) = picture.dimensions();
    imageops::replace(sheet, &picture, i64::from(x), i64::from(y));
    canvas::outline(sheet, (x.saturating_sub(1), y.saturating_sub(1)), (width + 2, height + 2), FAINT);
    if let Some((map, range, unit)) = tile.bar {
        let bar = canvas::ColorBar { map, range, unit, letters: NUMBER_HEIGHT };
        canvas::color_bar(sheet, (x + width, y, height), bar);
    } else if tile.title == "class" {
        super::maps::class_legend(sheet, class, (x + width, y), NUMBER_HEIGHT);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn input<'a>(frame: &'a RgbImage, map: &'a Grid<f32>, class: &'a Grid<u8>) -> OverviewInput<'a> {
        OverviewInput {
            title: "a scan",
            frame: (frame, "captured frame"),
            dolp: map,
            column: map,
            row: Some(map),
            depth_mm: Some(map),
            class,
            projector: ProjectorSize { width: 1024, height: 768 },
        }
    }

    #[test]
    fn the_sheet_holds_every_picture() {
        let red = RgbImage::from_pixel(800, 600, image::Rgb([250, 10, 10]));
        let map = Grid::filled(800, 600, 1023.0);
        let class = Grid::filled(800, 600, 1u8);
        let all = overview(&input(&red, &map, &class));
        let count = |sheet: &RgbImage, color: Rgb| sheet.pixels().filter(|pixel| pixel.0 == color).count();
        let area = (TILE_WIDTH * TILE_WIDTH * 3 / 4) as usize;
        assert_eq!(count(&all, [250, 10, 10]), area);
        // Column and row at the far end of jet; bars add a little.
        assert!(count(&all, Colormap::Jet.color(1.0)) >= 2 * area);
        assert!(count(&all, super::super::class_color(crate::decode::Class::Valid)) >= area);
        let fewer = overview(&OverviewInput { row: None, depth_mm: None, ..input(&red, &map, &class) });
        assert!(count(&fewer, Colormap::Jet.color(1.0)) >= area);
        assert!(count(&fewer, Colormap::Jet.color(1.0)) < 2 * area);
    }

    #[test]
    fn tiny_and_tall_scans_give_a_sheet() {
        for (width, height) in [(1, 1), (3, 700), (700, 3)] {
            let map = Grid::filled(width, height, f32::NAN);
            let class = Grid::filled(width, height, 0u8);
            let frame = RgbImage::new(width as u32, height as u32);
            overview(&input(&frame, &map, &class));
        }
    }
}
