//! Line and dot plots as SVG, drawn with the page's own colours.

use super::html::Markup;
use crate::report::pictures::ticks::labelled as ticks;

/// One set of points of a plot.
#[derive(Debug, Clone)]
pub struct Series {
    /// Name in the legend.
    pub name: String,
    /// Class of the page's style sheet that colours it: `raw`, `paper`, `pse`, `truth`.
    pub class: &'static str,
    /// Points; a NaN breaks the line.
    pub points: Vec<(f64, f64)>,
    /// Whether points are joined.
    pub joined: bool,
}

/// A plot.
#[derive(Debug, Clone)]
pub struct Plot {
    /// What a reader who cannot see it is told.
    pub label: String,
    /// Width and height in px.
    pub size: (f64, f64),
    /// Name and unit of the horizontal axis.
    pub x_name: String,
    /// Name and unit of the vertical axis.
    pub y_name: String,
    /// Ends of the vertical axis; those of the points where there are none.
    pub y_range: Option<(f64, f64)>,
    /// Whether both axes grow by factors of ten.
    pub log_x: bool,
    /// Points.
    pub series: Vec<Series>,
    /// Horizontal lines at these values, each with its label.
    pub marks: Vec<(f64, String)>,
}

impl Default for Plot {
    fn default() -> Self {
        Self {
            label: String::new(),
            size: (640.0, 240.0),
            x_name: String::new(),
            y_name: String::new(),
            y_range: None,
            log_x: false,
            series: Vec::new(),
            marks: Vec::new(),
        }
    }
}

/// Space around the axes in px: left, top, right, bottom.
const MARGIN: [f64; 4] = [58.0, 14.0, 14.0, 42.0];
/// Room for one line of the legend.
const LEGEND: f64 = 18.0;

/// Colours of a plot that stands alone; the page's are in its style sheet.
const FILE_STYLE: &str = "text{font:11px system-ui,sans-serif;fill:#5d6570}.name{fill:#1c1f24}.middle{text-anchor:middle}\
.end{text-anchor:end}.grid{stroke:#dfe3e8}.axis{stroke:#5d6570}.mark{stroke:#c2912b;stroke-dasharray:4 3}\
.line{fill:none;stroke-width:1.8;stroke-linejoin:round}.dots{fill:none;stroke-width:5;stroke-linecap:round}\
.raw{stroke:#b5532a}.paper{stroke:#6a4fb0}.pse{stroke:#0f7a6c}.truth{stroke:#8a8f98}\
@media(prefers-color-scheme:dark){text{fill:#9aa3ae}.name{fill:#e6e8eb}.grid{stroke:#30353c}.raw{stroke:#f08a5d}\
.paper{stroke:#b59cf5}.pse{stroke:#45cbb5}}";

/// Ends of the finite values, a little apart where they are equal.
fn span(values: impl Iterator<Item = f64>) -> Option<(f64, f64)> {
    let ends = values.filter(|value| value.is_finite()).fold(None, |ends: Option<(f64, f64)>, value| {
        Some(ends.map_or((value, value), |(low, high)| (low.min(value), high.max(value))))
    });
    ends.map(|(low, high)| if high > low { (low, high) } else { (low - 0.5, high + 0.5) })
}

impl Plot {
    /// The plot as an `svg` element.
    pub fn draw(&self) -> Markup {
        let (width, height) = self.size;
        let named = self.series.iter().filter(|series| !series.name.is_empty()).count();
        let top = MARGIN[1] + if named > 1 { LEGEND } else { 0.0 };
        let place = |x: f64| if self.log_x { x.log10() } else { x };
        let points = || self.series.iter().flat_map(|series| &series.points);
        let (x0, x1) = span(points().map(|point| place(point.0))).unwrap_or((0.0, 1.0));
        let found = span(points().map(|point| point.1).chain(self.marks.iter().map(|mark| mark.0)));
        let (y0, y1) = self
            .y_range
            .or_else(|| found.map(|(low, high)| (low - 0.05 * (high - low), high + 0.05 * (high - low))))
            .unwrap_or((0.0, 1.0));
        let (right, bottom) = (width - MARGIN[2], height - MARGIN[3]);
        let to_x = |x: f64| MARGIN[0] + (place(x) - x0) / (x1 - x0) * (right - MARGIN[0]);
        let to_y = |y: f64| bottom - (y.clamp(y0, y1) - y0) / (y1 - y0) * (bottom - top);
        let mut svg = Markup::new();
        let view = format!("0 0 {width} {height}");
        let frame =
            [("viewBox", view.as_str()), ("role", "img"), ("aria-label", &self.label), ("class", "plot")];
        svg.element("svg", &frame, |svg| {
            let y_ticks = ticks(y0, y1, ((bottom - top) / 36.0) as usize);
            for (value, text) in &y_ticks {
                line(svg, "grid", (MARGIN[0], to_y(*value)), (right, to_y(*value)));
                label(svg, "tick end", (MARGIN[0] - 6.0, to_y(*value) + 4.0), text);
            }
            let x_ticks = match self.log_x {
                true => (x0.ceil() as i32..=x1.floor() as i32)
                    .map(|power| (10f64.powi(power), decade(power)))
                    .collect(),
                false => ticks(x0, x1, ((right - MARGIN[0]) / 80.0) as usize),
            };
            for (value, text) in &x_ticks {
                line(svg, "grid", (to_x(*value), top), (to_x(*value), bottom));
                label(svg, "tick middle", (to_x(*value), bottom + 16.0), text);
            }
            line(svg, "axis", (MARGIN[0], bottom), (right, bottom));
            line(svg, "axis", (MARGIN[0], top), (MARGIN[0], bottom));
            label(svg, "name middle", ((MARGIN[0] + right) / 2.0, height - 6.0), &self.x_name);
            let (x, y) = (14.0, (top + bottom) / 2.0);
            let turn = format!("rotate(-90 {x} {y})");
            let (x, y) = (number(x), number(y));
            let at = [("class", "name middle"), ("x", x.as_str()), ("y", &y), ("transform", &turn)];
            svg.leaf("text", &at, &self.y_name);
            for (value, text) in &self.marks {
                line(svg, "mark", (MARGIN[0], to_y(*value)), (right, to_y(*value)));
                label(svg, "tick end", (right - 4.0, to_y(*value) - 5.0), text);
            }
            for series in &self.series {
                draw_series(svg, series, &to_x, &to_y);
            }
            if named > 1 {
                self.legend(svg);
            }
        });
        svg
    }

    /// The plot as a file of its own, light or dark as the reader's screen is.
    pub fn file(&self) -> String {
        let mut svg = Markup::new();
        let [width, height] = [self.size.0, self.size.1].map(|side| format!("{side}"));
        let outer = [("xmlns", "http://www.w3.org/2000/svg"), ("width", width.as_str()), ("height", &height)];
        svg.element("svg", &outer, |svg| {
            svg.element("style", &[], |style| {
                style.constant(FILE_STYLE);
            });
            svg.append(self.draw());
        });
        svg.finish()
    }

    fn legend(&self, svg: &mut Markup) {
        let mut x = MARGIN[0];
        for series in self.series.iter().filter(|series| !series.name.is_empty()) {
            let class = format!("line {}", series.class);
            line(svg, &class, (x, 10.0), (x + 18.0, 10.0));
            label(svg, "tick", (x + 24.0, 14.0), &series.name);
            // About the mean width of a letter at this size.
            x += 44.0 + 6.6 * series.name.chars().count() as f64;
        }
    }
}

fn draw_series(svg: &mut Markup, series: &Series, to_x: &impl Fn(f64) -> f64, to_y: &impl Fn(f64) -> f64) {
    let mut path = String::new();
    let mut pen_down = false;
    for &(x, y) in &series.points {
        if !x.is_finite() || !y.is_finite() {
            pen_down = false;
            continue;
        }
        let (x, y) = (number(to_x(x)), number(to_y(y)));
        match (series.joined, pen_down) {
            (true, true) => path.push_str(&format!("L{x} {y}")),
            (true, false) => path.push_str(&format!("M{x} {y}")),
            // A line of no length with a round cap is a dot.
            (false, _) => path.push_str(&format!("M{x} {y}h0")),
        }
        pen_down = true;
    }
    let class = format!("{} {}", if series.joined { "line" } else { "dots" }, series.class);
    svg.leaf("path", &[("class", &class), ("d", &path)], "");
}

fn line(svg: &mut Markup, class: &str, from: (f64, f64), to: (f64, f64)) {
    let [x1, y1, x2, y2] = [from.0, from.1, to.0, to.1].map(number);
    svg.leaf("line", &[("class", class), ("x1", &x1), ("y1", &y1), ("x2", &x2), ("y2", &y2)], "");
}

fn label(svg: &mut Markup, class: &str, at: (f64, f64), text: &str) {
    let [x, y] = [at.0, at.1].map(number);
    svg.leaf("text", &[("class", class), ("x", &x), ("y", &y)], text);
}

/// A coordinate: a tenth of a pixel is enough.
fn number(value: f64) -> String {
    format!("{value:.1}")
}

fn decade(power: i32) -> String {
    match power {
        -3..=-1 => format!("{:.*}", -power as usize, 10f64.powi(power)),
        0..=4 => format!("{}", 10i64.pow(power as u32)),
        _ => format!("1e{power}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<(f64, f64)>) -> String {
        let series = Series { name: "a".into(), class: "raw", points, joined: true };
        Plot { label: "b".into(), series: vec![series], ..Plot::default() }.draw().finish()
    }

    #[test]
    fn lines_break_where_there_is_no_value() {
        let svg = plot(vec![(0.0, 0.0), (1.0, 1.0), (2.0, f64::NAN), (3.0, 0.5), (4.0, 0.7)]);
        let path = svg.split("d=\"").nth(1).unwrap().split('"').next().unwrap();
        assert_eq!((path.matches('M').count(), path.matches('L').count()), (2, 2), "{path}");
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
    }

    #[test]
    fn no_points_and_equal_points_give_a_plot() {
        for points in
            [vec![], vec![(1.0, 1.0)], vec![(2.0, 3.0), (2.0, 3.0)], vec![(f64::NAN, f64::INFINITY)]]
        {
            let svg = plot(points);
            assert!(svg.starts_with("<svg") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }

    #[test]
    fn decades_are_written_plainly() {
        assert_eq!([-3, -1, 0, 2].map(decade), ["0.001", "0.1", "1", "100"]);
    }
}
