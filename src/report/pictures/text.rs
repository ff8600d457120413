//! Small text: letters of 5 x 7 dots, drawn at any size with rounded edges.

use image::RgbImage;

use crate::report::colormap::Rgb;

/// Rows of a letter's dots: seven above the line and two below.
const ROWS: usize = 9;

/// Height of a capital in dots.
const CAPITAL_ROWS: f32 = 7.0;

/// Dots between letters.
const GAP: f32 = 1.0;

/// Each letter with its rows from the top, in groups of five dots, `#` for ink. Two further rows reach below the line.
const LETTERS: &[(char, &str)] = &[
    ('0', " ### #   ##  ### # ###  ##   # ### "),
    ('1', "  #   ##    #    #    #    #   ### "),
    ('2', " ### #   #    #   #   #   #   #####"),
    ('3', "#####   #   #     #     ##   # ### "),
    ('4', "   #   ##  # # #  # #####   #    # "),
    ('5', "######    ####     #    ##   # ### "),
    ('6', "  ##  #   #    #### #   ##   # ### "),
    ('7', "#####    #   #   #   #    #    #   "),
    ('8', " ### #   ##   # ### #   ##   # ### "),
    ('9', " ### #   ##   # ####    #   #  ##  "),
    ('A', " ### #   ##   #######   ##   ##   #"),
    ('B', "#### #   ##   ##### #   ##   ##### "),
    ('C', " ### #   ##    #    #    #   # ### "),
    ('D', "###  #  # #   ##   ##   ##  # ###  "),
    ('E', "######    #    #### #    #    #####"),
    ('F', "######    #    #### #    #    #    "),
    ('G', " ### #   ##    # ####   ##   # ####"),
    ('H', "#   ##   ##   #######   ##   ##   #"),
    ('I', " ###   #    #    #    #    #   ### "),
    ('J', "  ###   #    #    #    # #  #  ##  "),
    ('K', "#   ##  # # #  ##   # #  #  # #   #"),
    ('L', "#    #    #    #    #    #    #####"),
    ('M', "#   ### ### # ## # ##   ##   ##   #"),
    ('N', "#   ##   ###  ## # ##  ###   ##   #"),
    ('O', " ### #   ##   ##   ##   ##   # ### "),
    ('P', "#### #   ##   ##### #    #    #    "),
    ('Q', " ### #   ##   ##   ## # ##  #  ## #"),
    ('R', "#### #   ##   ##### # #  #  # #   #"),
    ('S', " #####    #     ###     #    ##### "),
    ('T', "#####  #    #    #    #    #    #  "),
    ('U', "#   ##   ##   ##   ##   ##   # ### "),
    ('V', "#   ##   ##   ##   ##   # # #   #  "),
    ('W', "#   ##   ##   ## # ## # ## # # # # "),
    ('X', "#   ##   # # #   #   # # #   ##   #"),
    ('Y', "#   ##   ##   # # #   #    #    #  "),
    ('Z', "#####    #   #   #   #   #    #####"),
    ('a', "           ###     # #####   # ####"),
    ('b', "#    #    # ## ##  ##   ##   ##### "),
    ('c', "           ### #    #    #   # ### "),
    ('d', "    #    # ## ##  ###   ##   # ####"),
    ('e', "           ### #   #######     ### "),
    ('f', "  ##  #  # #   ###   #    #    #   "),
    ('g', "           #####   ##   # ####    #    # ### "),
    ('h', "#    #    # ## ##  ##   ##   ##   #"),
    ('i', "  #        ##    #    #    #   ### "),
    ('j', "   #        ##    #    #    #    # #  #  ##  "),
    ('k', "#    #    #  # # #  ##   # #  #  # "),
    ('l', " ##    #    #    #    #    #   ### "),
    ('m', "          ## # # # ## # ## # ## # #"),
    ('n', "          # ## ##  ##   ##   ##   #"),
    ('o', "           ### #   ##   ##   # ### "),
    ('p', "          #### #   ##   ##   ##### #    #    "),
    ('q', "           #####   ##   ##   # ####    #    #"),
    ('r', "          # ## ##  ##    #    #    "),
    ('s', "           #####     ###     ##### "),
    ('t', " #    #   ###   #    #    #  #  ## "),
    ('u', "          #   ##   ##   ##  ## ## #"),
    ('v', "          #   ##   ##   # # #   #  "),
    ('w', "          #   ##   ## # ## # # # # "),
    ('x', "          #   # # #   #   # # #   #"),
    ('y', "          #   ##   ##   # ####    #    # ### "),
    ('z', "          #####   #   #   #   #####"),
    ('.', "                          ##   ##  "),
    (',', "                          ##   ##    #   #   "),
    (':', "      ##   ##        ##   ##       "),
    ('-', "               #####               "),
    ('+', "       #    #  #####  #    #       "),
    ('=', "          #####     #####          "),
    ('/', "         #   #   #   #   #         "),
    ('(', "   #   #   #    #    #     #     # "),
    (')', " #     #     #    #    #   #   #   "),
    ('%', "##   ##  #   #   #   #   #  ##   ##"),
    ('<', "   #   #   #   #     #     #     # "),
    ('>', " #     #     #     #   #   #   #   "),
    ('_', "                              #####"),
    ('°', " ##  #  # #  #  ##                 "),
    ('σ', "           #### #  # #  # #  #  ## "),
    ('×', "          #   # # #   #   # # #   #"),
    ('?', " ### #   #    #   #   #         #  "),
];

/// Dots of a letter, and how many columns from which it takes.
struct Glyph {
    dots: [[bool; 5]; ROWS],
    first: usize,
    columns: usize,
}

fn glyph(letter: char) -> Glyph {
    let find = |wanted: char| LETTERS.iter().find(|(known, _)| *known == wanted);
    // A letter without a drawing shows as a question mark rather than as nothing.
    let rows = find(letter).or_else(|| find('?')).map_or("", |(_, rows)| rows);
    let mut dots = [[false; 5]; ROWS];
    for (index, dot) in rows.chars().enumerate() {
        dots[index / 5][index % 5] = dot == '#';
    }
    let inked = |column: &usize| dots.iter().any(|row| row[*column]);
    let first = (0..5).find(inked).unwrap_or(0);
    let last = (0..5).rev().find(inked).unwrap_or(2);
    // Digits keep one width, so that numbers stand below each other.
    match letter {
        ' ' => Glyph { dots: [[false; 5]; ROWS], first: 0, columns: 3 },
        '0'..='9' => Glyph { dots, first: 0, columns: 5 },
        _ => Glyph { dots, first, columns: last + 1 - first },
    }
}

/// How text is drawn.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ink {
    /// Height of a capital in px.
    pub height: f32,
    pub color: Rgb,
}

/// Width of `text` in px when capitals are `height` px high.
pub(super) fn width(text: &str, height: f32) -> f32 {
    let dots: f32 = text.chars().map(|letter| glyph(letter).columns as f32 + GAP).sum();
    (dots - GAP).max(0.0) * height / CAPITAL_ROWS
}

/// Draws `text` with its upper left corner at (`x`, `y`). What falls outside the image is left out.
pub(super) fn draw(image: &mut RgbImage, text: &str, (x, y): (f32, f32), ink: Ink) {
    let dot = ink.height / CAPITAL_ROWS;
    let mut left = x;
    for letter in text.chars() {
        let glyph = glyph(letter);
        let (right, bottom) = (left + glyph.columns as f32 * dot, y + ROWS as f32 * dot);
        let pixels = |low: f32, high: f32, side: u32| {
            ((low - dot).floor().max(0.0) as u32)..((high + dot).ceil().clamp(0.0, side as f32) as u32)
        };
        for row in pixels(y, bottom, image.height()) {
            for column in pixels(left, right, image.width()) {
                let at = ((column as f32 + 0.5 - left) / dot, (row as f32 + 0.5 - y) / dot);
                blend(image, (column, row), ink.color, coverage(&glyph, at, dot));
            }
        }
        left = right + GAP * dot;
    }
}

/// How much of a pixel is ink. Between the centres of dots ink is interpolated, which rounds corners and joins diagonals.
fn coverage(glyph: &Glyph, (x, y): (f32, f32), dot: f32) -> f32 {
    let (x, y) = (x - 0.5, y - 0.5);
    let (column, row) = (x.floor(), y.floor());
    let at = |dx: f32, dy: f32| {
        let (column, row) = (column + dx, row + dy);
        let inside =
            column >= 0.0 && (column as usize) < glyph.columns && row >= 0.0 && (row as usize) < ROWS;
        f32::from(u8::from(inside && glyph.dots[row as usize][glyph.first + column as usize]))
    };
    let (u, v) = (x - column, y - row);
    let ink = (1.0 - v) * ((1.0 - u) * at(0.0, 0.0) + u * at(1.0, 0.0))
        + v * ((1.0 - u) * at(0.0, 1.0) + u * at(1.0, 1.0));
    // The level at half ink is the outline; one pixel is the width of its edge.
    ((ink - 0.46) * dot + 0.5).clamp(0.0, 1.0)
}

/// Mixes `color` into a pixel.
pub(super) fn blend(image: &mut RgbImage, (x, y): (u32, u32), color: Rgb, share: f32) {
    if share > 0.0
        && let Some(pixel) = image.get_pixel_mut_checked(x, y)
    {
        for (channel, value) in pixel.0.iter_mut().zip(color) {
            *channel = (f32::from(*channel) + share.min(1.0) * (f32::from(value) - f32::from(*channel)))
                .round() as u8;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_letter_has_all_its_rows_and_none_is_another() {
        for (index, (letter, rows)) in LETTERS.iter().enumerate() {
            assert!(matches!(rows.len(), 35 | 45), "{letter:?} has {} dots", rows.len());
            assert!(rows.chars().all(|dot| dot == '#' || dot == ' '), "{letter:?}");
            let twin = LETTERS[..index].iter().find(|(_, other)| other == rows);
            assert!(twin.is_none() || *letter == '×', "{letter:?} looks like {twin:?}");
        }
        for needed in ('0'..='9').chain('a'..='z').chain('A'..='Z') {
            assert!(LETTERS.iter().any(|(letter, _)| *letter == needed), "{needed:?}");
        }
    }

    #[test]
    fn ink_fills_the_size_that_was_asked_for() {
        for height in [7.0, 10.5, 28.0] {
            let mut image = RgbImage::new(300, 60);
            draw(&mut image, "H0", (10.0, 10.0), Ink { height, color: [255; 3] });
            let inked = |lit: &dyn Fn(u32) -> bool, side: u32| {
                let found: Vec<u32> = (0..side).filter(|&at| lit(at)).collect();
                (f64::from(found[0]), f64::from(*found.last().unwrap() + 1))
            };
            let bright = |x: u32, y: u32| image.get_pixel(x, y).0[0] > 127;
            let (top, bottom) = inked(&|y| (0..300).any(|x| bright(x, y)), 60);
            let (left, right) = inked(&|x| (0..60).any(|y| bright(x, y)), 300);
            let expected = width("H0", height);
            assert!((top - 10.0).abs() <= 1.5 && (bottom - 10.0 - f64::from(height)).abs() <= 1.5);
            assert!((left - 10.0).abs() <= 1.5 && (right - 10.0 - f64::from(expected)).abs() <= 1.5);
        }
    }

    #[test]
    fn text_beyond_the_image_is_left_out() {
        let mut image = RgbImage::new(10, 10);
        for at in [(-50.0, -50.0), (-3.0, 5.0), (8.0, 8.0), (500.0, 500.0)] {
            draw(&mut image, "Wide g", at, Ink { height: 14.0, color: [9; 3] });
        }
        draw(&mut RgbImage::new(0, 0), "x", (0.0, 0.0), Ink { height: 7.0, color: [9; 3] });
    }
}
