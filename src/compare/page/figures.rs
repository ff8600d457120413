//! Figures.

use super::{caption, method_name};
use crate::{
    compare::{
        Comparison, Entry, Method,
        html::Markup,
        images::Picture,
        places::SQUARE,
        plot::{Plot, Series},
        stripes::Zoom,
    },
    decode::Class,
    report::{
        colormap::Colormap,
        pictures::{Range, class_color, class_name, ticks::labelled},
    },
};

/// A picture with a caption that begins with the method's name.
fn picture(out: &mut Markup, picture: &Picture, method: Method, what: &str) {
    out.element("figure", &[], |figure| {
        image(figure, picture, &format!("{}: {what}", method.title()), "");
        figure.element("figcaption", &[], |caption| {
            method_name(caption, method);
            caption.text(". ").text(what);
        });
    });
}

fn image(out: &mut Markup, picture: &Picture, alt: &str, class: &str) {
    let [width, height] = [picture.width, picture.height].map(|side| side.to_string());
    let attributes = [
        ("src", picture.uri.as_str()),
        ("alt", alt),
        ("width", &width),
        ("height", &height),
        ("class", class),
    ];
    out.void("img", &attributes);
}

/// One row of the page: what each method has of something.
fn row(body: &mut Markup, comparison: &Comparison, mut cell: impl FnMut(&mut Markup, &Entry)) {
    let class = if comparison.entries.len() == 2 { "grid two" } else { "grid three" };
    body.element("div", &[("class", class)], |grid| {
        for entry in &comparison.entries {
            cell(grid, entry);
        }
    });
}

fn signal_name(method: Method) -> &'static str {
    match method {
        Method::Raw => "What it decides by: (P − Q) / (white − black)",
        Method::Paper => "What it decides by: degree of linear polarization",
        Method::Pse => "What it decides by: (P − Q) / (H − V)",
    }
}

/// The paper's Fig. 3.
pub fn frames(body: &mut Markup, comparison: &Comparison) {
    let at = comparison.places.row;
    row(body, comparison, |grid, entry| {
        picture(grid, &entry.frame, entry.figures.method, "A frame as captured, shown with a gamma of 2.2");
    });
    row(body, comparison, |grid, entry| {
        picture(grid, &entry.signal, entry.figures.method, signal_name(entry.figures.method));
    });
    row(body, comparison, |grid, entry| {
        let method = entry.figures.method;
        let points =
            |profile: &[f32]| profile.iter().enumerate().map(|(x, &y)| (x as f64, f64::from(y))).collect();
        let plot = |name: &str, class, profile: &[f32]| Plot {
            label: format!("{}: {name} along row {at}", method.title()),
            size: (460.0, 190.0),
            x_name: format!("camera column at row {at}, px"),
            y_name: name.to_owned(),
            y_range: Some((0.0, 1.0)),
            series: vec![Series { name: String::new(), class, points: points(profile), joined: true }],
            ..Plot::default()
        };
        grid.element("figure", &[], |figure| {
            figure.append(plot("frame", method.name(), &entry.profiles[0]).draw());
            figure.append(plot("decided by", method.name(), &entry.profiles[1]).draw());
        });
    });
    caption(
        body,
        "Figure 1 (the paper's Fig. 3).",
        &format!(
            "One column bit, stripes of 32 projector columns. Below, cross-sections along row {at}: the frame as a share of \
             full scale, and the image that the method decides bits by, 0 to 1 (a half is the threshold of raw and pse)."
        ),
    );
}

/// The paper's Fig. 4.
pub fn stripe_edges(body: &mut Markup, comparison: &Comparison) {
    for (index, plate) in comparison.places.plates.iter().enumerate() {
        for (side, what) in [(0, "frame"), (1, "what is decided by")] {
            row(body, comparison, |grid, entry| {
                if let Some(zooms) = entry.zooms.get(index) {
                    zoom(grid, &zooms[side], entry.figures.method, &format!("{}, {what}", plate.name));
                }
            });
        }
    }
    if comparison.places.plates.is_empty() {
        body.leaf("p", &[("class", "note")], "No plane is known in this scene: name one with --region.");
        return;
    }
    caption(
        body,
        "Figure 2 (the paper's Fig. 4).",
        &format!(
            "Squares of {}x{} px on each plate, one column bit with stripes of 8 projector columns, and the edges that the \
             partial-area method of Trujillo-Pino finds with one fixed threshold of 25 grey levels of 255. The upper row of \
             each plate shows frames, the lower one the images that methods decide by. A degree of polarization saturates \
             early in the light: its edges lie on the dark side of the true ones, those of pattern and inverse on opposite \
             sides of them. The decoder of mode paper takes the mean of both.",
            SQUARE.0, SQUARE.1
        ),
    );
}

fn zoom(grid: &mut Markup, zoom: &Zoom, method: Method, what: &str) {
    grid.element("figure", &[], |figure| {
        figure.element("div", &[("style", "position:relative")], |frame| {
            image(frame, &zoom.picture, &format!("{}: {what}", method.title()), "pixels");
            let view = format!("-0.5 -0.5 {} {}", SQUARE.0, SQUARE.1);
            frame.element("svg", &[("class", "zoom"), ("viewBox", &view), ("aria-hidden", "true")], |svg| {
                let path: String = zoom.edges.iter().map(|(x, y)| format!("M{x:.2} {y:.2}h0")).collect();
                svg.leaf("path", &[("class", "edge"), ("d", &path)], "");
            });
        });
        figure.element("figcaption", &[], |caption| {
            method_name(caption, method);
            caption.text(". ").text(what).text(". ").text(&counted(zoom));
        });
    });
}

fn counted(zoom: &Zoom) -> String {
    let count = &zoom.count;
    let (Some(expected), Some(missed), Some(extra)) = (count.expected, count.missed, count.extra) else {
        return format!("{} edge points", count.found);
    };
    let mut text =
        format!("{} of {expected} edge points found, {extra} false", expected - missed.min(expected));
    if let (Some(rms), Some(dark)) = (count.rms_px, count.towards_dark_px) {
        // No minus in front of nothing.
        let dark = if dark.abs() < 0.005 { 0.0 } else { dark };
        text.push_str(&format!("; off by rms {rms:.2} px, on the mean {dark:+.2} px towards the dark side"));
    }
    text
}

/// The paper's Fig. 5.
pub fn maps(body: &mut Markup, comparison: &Comparison) {
    let index = |size: u32| Range { low: 0.0, high: size.saturating_sub(1).max(1) as f32 };
    row(body, comparison, |grid, entry| {
        picture(grid, &entry.columns, entry.figures.method, "Projector column");
    });
    row(body, comparison, |grid, entry| match &entry.rows {
        Some(rows) => picture(grid, rows, entry.figures.method, "Projector row"),
        None => {
            grid.leaf("p", &[("class", "note")], "Rows were not coded.");
        }
    });
    let of_projector = comparison.entries.first().map_or(1024, |entry| entry.projector.0);
    bar(
        body,
        Colormap::Jet,
        index(of_projector),
        "projector column (rows likewise, over their own number), px",
    );
    if comparison.entries.iter().any(|entry| entry.depth.is_some()) {
        row(body, comparison, |grid, entry| match &entry.depth {
            Some(depth) => picture(grid, depth, entry.figures.method, "Depth"),
            None => {
                grid.leaf("p", &[("class", "note")], "No calibration, no depth.");
            }
        });
        if let Some(range) = comparison.places.depth_mm {
            bar(body, Colormap::Parula, range, "depth in the camera frame, mm");
        }
        row(body, comparison, |grid, entry| {
            if let Some(cloud) = &entry.cloud {
                picture(grid, cloud, entry.figures.method, "Cloud, depth stretched as it says, mm");
            }
        });
    }
    row(body, comparison, |grid, entry| {
        picture(grid, &entry.classes, entry.figures.method, "What became of each pixel");
    });
    body.element("div", &[("class", "legend")], |legend| {
        for class in Class::ALL {
            let [red, green, blue] = class_color(class);
            let style =
                format!("display:inline-block;width:.8em;height:.8em;background:rgb({red},{green},{blue})");
            legend.element("span", &[], |item| {
                item.leaf("i", &[("style", &style)], "").text(" ").text(class_name(class));
            });
        }
    });
    caption(
        body,
        "Figure 3 (the paper's Fig. 5).",
        "Projector indices, depth and points after all gates. Where a map shows the ground of the page there is no value.",
    );
}

/// A scale of colours with numbers.
fn bar(body: &mut Markup, map: Colormap, range: Range, unit: &str) {
    const STEPS: u32 = 96;
    body.element("div", &[("class", "bar")], |div| {
        div.element(
            "svg",
            &[
                ("viewBox", "0 0 420 44"),
                ("role", "img"),
                ("aria-label", unit),
                ("shape-rendering", "crispEdges"),
            ],
            |svg| {
                for step in 0..STEPS {
                    let [red, green, blue] = map.color(step as f32 / (STEPS - 1) as f32);
                    let (x, fill) = (
                        format!("{:.2}", 10.0 + 4.0 * f64::from(step)),
                        format!("rgb({red},{green},{blue})"),
                    );
                    svg.leaf(
                        "rect",
                        &[("x", &x), ("y", "2"), ("width", "4.3"), ("height", "11"), ("fill", &fill)],
                        "",
                    );
                }
                let (low, high) = (f64::from(range.low), f64::from(range.high));
                for (value, text) in labelled(low, high, 5) {
                    let x = format!("{:.1}", 10.0 + 384.0 * (value - low) / (high - low));
                    svg.leaf("text", &[("class", "tick middle"), ("x", &x), ("y", "26")], &text);
                }
                svg.leaf("text", &[("class", "name middle"), ("x", "202"), ("y", "41")], unit);
            },
        );
    });
}

/// The paper's Fig. 6.
pub fn sections(body: &mut Markup, comparison: &Comparison) {
    let of_plate = |entry: &Entry, index: usize| entry.residuals.get(index).cloned().unwrap_or_default();
    let mut drawn = false;
    for (index, plate) in comparison.places.plates.iter().enumerate() {
        let all = comparison.entries.iter().flat_map(|entry| of_plate(entry, index));
        let mut sizes: Vec<f64> = all.map(|(_, residual)| residual.abs()).collect();
        if sizes.is_empty() {
            continue;
        }
        drawn = true;
        sizes.sort_by(f64::total_cmp);
        // A few outliers would leave the rest a line; they are drawn at the rim.
        let limit = (1.6 * sizes[(sizes.len() - 1) * 99 / 100]).max(1e-3);
        row(body, comparison, |grid, entry| {
            let method = entry.figures.method;
            let fit = entry.figures.sections.get(index).and_then(|section| section.rmse_mm);
            let plot = Plot {
                label: format!("{}: residuals of a line fit on {}", method.title(), plate.name),
                size: (460.0, 220.0),
                x_name: format!("x on {}, row {}, mm", plate.name, plate.row),
                y_name: "off the line, mm".to_owned(),
                y_range: Some((-limit, limit)),
                series: vec![Series {
                    name: String::new(),
                    class: method.name(),
                    points: of_plate(entry, index),
                    joined: false,
                }],
                marks: vec![(0.0, String::new())],
                ..Plot::default()
            };
            grid.element("figure", &[], |figure| {
                figure.append(plot.draw());
                figure.element("figcaption", &[], |caption| {
                    method_name(caption, method);
                    let rmse = fit.map_or("no fit".to_owned(), |rmse| format!("RMSE {rmse:.4} mm"));
                    caption.text(". ").text(&plate.name).text(": ").text(&rmse);
                });
            });
        });
    }
    if drawn {
        let text =
            "Depth along one row of the image less the straight line that fits it best. One scale per plate.";
        caption(body, "Figure 4 (the paper's Fig. 6).", text);
    } else {
        body.leaf("p", &[("class", "note")], "No plane is known in this scene, or no calibration.");
    }
}
