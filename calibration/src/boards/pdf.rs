//! A board as a page to print: true to size, with a bar to check the printer by.

use std::fmt::Write;

use super::{
    description::{BAR_MM, Board},
    print::{Shape, dark_shapes},
};

/// Points of a PDF in a millimetre.
const POINTS_PER_MM: f64 = 72.0 / 25.4;
/// White around the pattern, in mm.
const MARGIN_MM: f64 = 12.0;
/// Height of the part below the pattern with bar and text, in mm.
const FOOTER_MM: f64 = 24.0;

/// Size of the page in mm: the smallest of A4 to A0 that holds it, upright or across; else as large as is needed.
pub fn page_mm(board: &Board) -> [f64; 2] {
    let [width, height] = board.size_mm();
    let need = [width.max(BAR_MM + 40.0) + 2.0 * MARGIN_MM, height + 2.0 * MARGIN_MM + FOOTER_MM];
    let sheets = [[210.0, 297.0], [297.0, 420.0], [420.0, 594.0], [594.0, 841.0], [841.0, 1189.0]];
    let ways = sheets.into_iter().flat_map(|[short, long]| [[short, long], [long, short]]);
    ways.into_iter().find(|page| page[0] >= need[0] && page[1] >= need[1]).unwrap_or(need)
}

/// The page as a PDF file of one page, vectors only.
pub fn pdf(board: &Board) -> Vec<u8> {
    let page = page_mm(board);
    let content = content(board, page);
    let [width, height] = page.map(|side| side * POINTS_PER_MM);
    // Not scaled to fit by viewers that heed it.
    let objects = [
        "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>".to_owned(),
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
        format!(
            "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4} {height:.4}] /Contents 4 0 R \
             /Resources << /Font << /F 5 0 R >> >> >>"
        ),
        format!("<< /Length {} >>\nstream\n{content}endstream", content.len()),
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>".to_owned(),
    ];
    let mut file = "%PDF-1.4\n".to_owned();
    let mut offsets = Vec::new();
    for (number, object) in (1..).zip(&objects) {
        offsets.push(file.len());
        file.push_str(&format!("{number} 0 obj\n{object}\nendobj\n"));
    }
    let table = file.len();
    file.push_str(&format!("xref\n0 {}\n0000000000 65535 f \n", objects.len() + 1));
    for offset in offsets {
        file.push_str(&format!("{offset:010} 00000 n \n"));
    }
    file.push_str(&format!(
        "trailer\n<< /Size {} /Root 1 0 R >>\nstartxref\n{table}\n%%EOF\n",
        objects.len() + 1
    ));
    file.into_bytes()
}

/// Drawing operators. One matrix makes millimetres from the top left corner of the pattern of them, y down.
fn content(board: &Board, [page_width, page_height]: [f64; 2]) -> String {
    let [width, height] = board.size_mm();
    let left = 0.5 * (page_width - width);
    let top = page_height - MARGIN_MM;
    let k = POINTS_PER_MM;
    let mut out = String::new();
    let mut draw = |text: String| writeln!(out, "{text}").expect("a string takes all that is written");
    draw(format!("q {k:.6} 0 0 {:.6} {:.6} {:.6} cm", -k, left * k, top * k));
    draw(format!("{:.4} g 0 0 {width:.4} {height:.4} re f", board.tones.light));
    draw(format!("{:.4} g", board.tones.dark));
    for shape in dark_shapes(board) {
        draw(match shape {
            Shape::Rectangle([x, y, w, h]) => format!("{x:.4} {y:.4} {w:.4} {h:.4} re f"),
            Shape::Disc(disc) => circle(disc),
        });
    }
    draw("Q".to_owned());
    let footer_top = top - height - 8.0;
    let bar_left = 0.5 * (page_width - BAR_MM);
    draw(format!("q {k:.6} 0 0 {k:.6} {:.6} {:.6} cm 0 g", bar_left * k, footer_top * k));
    // The bar ends where its outer ticks end: both are rectangles, since the ends of lines depend on line caps.
    draw(format!("0 -1 {BAR_MM:.4} 1 re f"));
    for tick in 0..=10 {
        let (at, long) = (f64::from(tick) * 0.1 * BAR_MM, if tick % 5 == 0 { 4.0 } else { 2.5 });
        let from = if tick == 10 { at - 0.2 } else { at };
        draw(format!("{from:.4} -{long:.1} 0.2 {long:.1} re f"));
    }
    let line = |y: f64, text: &str| format!("BT /F 3.2 Tf 0 {y:.2} Td ({text}) Tj ET");
    draw(line(-8.5, &format!("Bar: {BAR_MM:.0} mm from end to end. Print at 100 % and measure it;")));
    draw(line(-12.5, "give the length you measure as --measured-mm, or as measured_mm in the board's file."));
    draw(line(-16.5, &board.summary()));
    draw("Q".to_owned());
    out
}

/// A disc of four Bezier curves; they stay within 0.03 % of the radius.
fn circle([x, y, r]: [f64; 3]) -> String {
    const ARC: f64 = 0.552_284_749_8;
    let a = ARC * r;
    let (e, w, n, s) = (x + r, x - r, y - r, y + r);
    format!(
        "{e:.4} {y:.4} m {e:.4} {:.4} {:.4} {s:.4} {x:.4} {s:.4} c {:.4} {s:.4} {w:.4} {:.4} {w:.4} {y:.4} c \
         {w:.4} {:.4} {:.4} {n:.4} {x:.4} {n:.4} c {:.4} {n:.4} {e:.4} {:.4} {e:.4} {y:.4} c f",
        y + a,
        x + a,
        x - a,
        y + a,
        y - a,
        x - a,
        x + a,
        y - a
    )
}
