//! Tables.

use super::{caption, method_name};
use crate::compare::{Comparison, Figures, PAPER, html::Markup};

/// A number with so many decimals, or a dash.
fn number(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or("–".to_owned(), |value| format!("{value:.decimals$}"))
}

fn percent(value: Option<f64>) -> String {
    value
        .filter(|value| value.is_finite())
        .map_or("–".to_owned(), |value| format!("{:.2} %", 100.0 * value))
}

/// A rate that may be very small.
fn rate(value: Option<f64>) -> String {
    match value {
        Some(0.0) => "0".to_owned(),
        Some(value) if value.is_finite() => format!("{value:.1e}"),
        _ => "–".to_owned(),
    }
}

fn count(value: Option<u64>) -> String {
    value.map_or("–".to_owned(), |value| value.to_string())
}

/// A table with a head and rows of text.
fn table(body: &mut Markup, head: &[&str], rows: &[Vec<String>]) {
    body.element("div", &[("class", "wide")], |div| {
        div.element("table", &[], |table| {
            table.element("thead", &[], |thead| {
                thead.element("tr", &[], |tr| {
                    for cell in head {
                        tr.leaf("th", &[("scope", "col")], cell);
                    }
                });
            });
            table.element("tbody", &[], |tbody| {
                for row in rows {
                    tbody.element("tr", &[], |tr| {
                        for (index, cell) in row.iter().enumerate() {
                            match index {
                                0 => tr.leaf("th", &[("scope", "row")], cell),
                                _ => tr.leaf("td", &[], cell),
                            };
                        }
                    });
                }
            });
        });
    });
}

/// Title of a row, and its cell for a method.
type Row<'a> = (String, &'a dyn Fn(&Figures) -> String);

/// A table with one column per method.
fn by_method(body: &mut Markup, comparison: &Comparison, rows: &[Row<'_>]) {
    body.element("div", &[("class", "wide")], |div| {
        div.element("table", &[], |table| {
            table.element("thead", &[], |thead| {
                thead.element("tr", &[], |tr| {
                    tr.leaf("th", &[], "");
                    for entry in &comparison.entries {
                        tr.element("th", &[("scope", "col")], |th| method_name(th, entry.figures.method));
                    }
                });
            });
            table.element("tbody", &[], |tbody| {
                for (title, value) in rows {
                    tbody.element("tr", &[], |tr| {
                        tr.leaf("th", &[("scope", "row")], title);
                        for entry in &comparison.entries {
                            tr.leaf("td", &[], &value(&entry.figures));
                        }
                    });
                }
            });
        });
    });
}

/// The figures that matter most.
pub fn summary(body: &mut Markup, comparison: &Comparison) {
    let interior = |figures: &Figures| figures.report.truth.as_ref().map(|truth| truth.interior);
    let coverage = |f: &Figures| percent(interior(f).and_then(|t| t.coverage));
    let valid = |f: &Figures| percent(f.report.pixels.map(|p| p.valid as f64 / p.total.max(1) as f64));
    let wrong = |f: &Figures| rate(interior(f).and_then(|t| t.wrong_code_rate));
    let before = |f: &Figures| rate(interior(f).and_then(|t| t.wrong_code_rate_before_gates));
    let column = |f: &Figures| number(interior(f).and_then(|t| t.column_rms_px), 4);
    let depth = |f: &Figures| number(interior(f).and_then(|t| t.depth_rmse_mm), 3);
    let sigma = |f: &Figures| number(interior(f).and_then(|t| t.sigma_z_ratio), 2);
    let frames = |f: &Figures| f.report.frames.to_string();
    let seconds = |f: &Figures| number(f.report.capture.seconds, 2);
    let mut rows: Vec<Row<'_>> = vec![("Valid share of all pixels".into(), &valid)];
    if comparison.entries.iter().any(|entry| entry.figures.report.truth.is_some()) {
        rows.push(("Coverage of the lit scene (truth)".into(), &coverage));
        rows.push(("Wrong codes among accepted".into(), &wrong));
        rows.push(("Wrong codes before gates".into(), &before));
        rows.push(("Error of columns, rms in projector px".into(), &column));
        rows.push(("Error of depth, rms in mm".into(), &depth));
        rows.push(("Error of depth over claimed sigma".into(), &sigma));
    }
    let planes: Vec<String> = plane_names(comparison);
    type Cell = Box<dyn Fn(&Figures) -> String>;
    let of_planes: Vec<(String, Cell)> = planes
        .into_iter()
        .flat_map(|name| {
            let pick = move |f: &Figures, name: &str| {
                f.report.planes.iter().find(|plane| plane.name == name).cloned()
            };
            let (one, other) = (name.clone(), name.clone());
            let coverage: Cell = Box::new(move |f| percent(pick(f, &one).and_then(|plane| plane.coverage)));
            let rmse: Cell = Box::new(move |f| number(pick(f, &other).and_then(|plane| plane.rmse_mm), 3));
            [(format!("Coverage of {name}"), coverage), (format!("Plane RMSE of {name}, mm"), rmse)]
        })
        .collect();
    rows.extend(of_planes.iter().map(|(title, cell)| (title.clone(), &**cell)));
    let of_rules: Vec<(String, Cell)> = rule_names(comparison)
        .into_iter()
        .map(|name| {
            let title = match &name {
                Some(name) => format!("A fixed rule would keep of {name}"),
                None => "A fixed rule would keep of all that is lit".to_owned(),
            };
            let cell: Cell = Box::new(move |f| {
                percent(f.fixed_rule.iter().find(|rule| rule.object == name).and_then(|rule| rule.kept))
            });
            (title, cell)
        })
        .collect();
    rows.extend(of_rules.iter().map(|(title, cell)| (title.clone(), &**cell)));
    rows.push(("Frames".into(), &frames));
    rows.push(("Capture time, s".into(), &seconds));
    by_method(body, comparison, &rows);
    caption(
        body,
        "Table A.",
        "Planes: total least squares over all valid points of the object, no outlier removed, 2 px off its silhouette. \
         Wrong: a column off by more than 1.5. Truth: over pixels whose 5x5 neighbourhood sees one surface, wholly lit; \
         before gates: all words, whatever the gates made of them. A fixed rule: thresholds in grey levels as common decoders \
         have them (white and black more than 40 of 255 apart, pattern and inverse at least 5); all else on this page is \
         decoded with thresholds in units of noise, for every method alike, so that it is the light that is compared and \
         not the decoder.",
    );
}

fn rule_names(comparison: &Comparison) -> Vec<Option<String>> {
    let first = comparison.entries.first();
    first
        .map(|entry| entry.figures.fixed_rule.iter().map(|rule| rule.object.clone()).collect())
        .unwrap_or_default()
}

fn plane_names(comparison: &Comparison) -> Vec<String> {
    let mut names: Vec<String> = Vec::new();
    for plane in comparison.entries.iter().flat_map(|entry| &entry.figures.report.planes) {
        if !names.contains(&plane.name) {
            names.push(plane.name.clone());
        }
    }
    names
}

/// Where frames come from and what must be known of them.
pub fn conditions(body: &mut Markup, comparison: &Comparison) {
    let source = |f: &Figures| f.source.clone();
    let mode = |f: &Figures| f.mode.to_string();
    let exposure = |f: &Figures| number(f.exposure_us, 0);
    by_method(
        body,
        comparison,
        &[
            ("Frames from".into(), &source),
            ("Mode".into(), &mode),
            ("Exposure of a frame, us".into(), &exposure),
        ],
    );
    body.element("ul", &[("class", "findings")], |list| {
        for entry in &comparison.entries {
            for remark in &entry.figures.remarks {
                let class = format!("of-{}", entry.figures.method.name());
                list.leaf("li", &[("class", &class)], remark);
            }
        }
    });
}

/// The paper's Table 1, and what else the same formula says.
pub fn contrast(body: &mut Markup, comparison: &Comparison) {
    let of = |pick: fn(&crate::report::Contrast) -> Option<f64>| {
        move |f: &Figures| number(f.report.contrast.as_ref().and_then(pick), 2)
    };
    let (raw, dolp, raw_lit, dolp_lit) =
        (of(|c| c.raw), of(|c| c.dolp), of(|c| c.raw_lit), of(|c| c.dolp_lit));
    by_method(
        body,
        comparison,
        &[
            ("Frames as captured, whole image".into(), &raw),
            ("(I − dark) / (I + dark), whole image".into(), &dolp),
            ("Frames as captured, lit pixels".into(), &raw_lit),
            ("(I − dark) / (I + dark), lit pixels".into(), &dolp_lit),
        ],
    );
    let ratio = &comparison.contrast;
    let row = |title: &str, whole: Option<f64>, lit: Option<f64>, paper: &str| {
        vec![title.to_owned(), number(whole, 2), number(lit, 2), paper.to_owned()]
    };
    let reported = number(Some(PAPER.contrast_ratio), 0);
    table(
        body,
        &["Ratio of contrasts", "whole image", "lit pixels", "paper"],
        &[
            row(
                "DOLP of mode paper over raw Gray code (the paper's definition)",
                ratio.paper_dolp_over_raw,
                ratio.paper_dolp_over_raw_lit,
                &reported,
            ),
            row(
                "DOLP of mode pse over raw Gray code",
                ratio.pse_dolp_over_raw,
                ratio.pse_dolp_over_raw_lit,
                "–",
            ),
            row(
                "The same formula on ordinary Gray code over its own frames",
                ratio.raw_same_formula,
                ratio.raw_same_formula_lit,
                "–",
            ),
        ],
    );
    caption(
        body,
        "Table B (the paper's Table 1).",
        "Contrast by Eq. 8: mean over pairs of 4-neighbours of the squared grey difference, edges replicated, frames and \
         degrees (clipped to 0..1) both on 0..255 of full scale, mean over the non-inverse code frames. Dark is the frame \
         under uniform vertical polarization, or black for ordinary Gray code. Unlit pixels turn noise into a degree of \
         polarization that a squared difference loves: hence the second pair of rows.",
    );
}

/// Line fits beside the paper's.
pub fn sections(body: &mut Markup, comparison: &Comparison) {
    let mut head = vec!["Line fit to a section, RMSE in mm".to_owned()];
    head.extend(comparison.entries.iter().map(|entry| entry.figures.method.title().to_owned()));
    head.extend(["paper, raw".to_owned(), "paper, DOLP".to_owned()]);
    let mut rows = Vec::new();
    for plate in &comparison.places.plates {
        let cell = |pick: &dyn Fn(&crate::compare::SectionFit) -> String| -> Vec<String> {
            let of = |figures: &Figures| figures.sections.iter().find(|s| s.plate == plate.name).map(pick);
            comparison.entries.iter().map(|e| of(&e.figures).unwrap_or("–".to_owned())).collect()
        };
        let papers = match plate.name.as_str() {
            "white" => [PAPER.white_raw_rmse, PAPER.white_dolp_rmse].map(|rmse| number(Some(rmse), 4)),
            "black" => [PAPER.black_raw_rmse, PAPER.black_dolp_rmse].map(|rmse| number(Some(rmse), 4)),
            _ => ["–".to_owned(), "–".to_owned()],
        };
        let none = || vec![String::new(), String::new()];
        let row =
            |title: String, cells: Vec<String>, papers: Vec<String>| [vec![title], cells, papers].concat();
        let one = cell(&|s| number(s.rmse_mm, 4));
        rows.push(row(format!("{}, row {}", plate.name, plate.row), one, papers.to_vec()));
        let median = cell(&|s| number(s.rmse_mm_median, 4));
        rows.push(row(format!("{}, median of 41 rows", plate.name), median, none()));
        rows.push(row(
            format!("{}, points of pixels", plate.name),
            cell(&|s| format!("{} / {}", s.points, s.pixels)),
            none(),
        ));
    }
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    table(body, &head, &rows);
    caption(
        body,
        "Table C (the paper's Fig. 6).",
        "Root of the sum of squared residuals of a straight line over the degrees of freedom, along one row of the image. \
         The paper's figures were measured on its own plates and rig; they stand here for scale.",
    );
}

/// Agreement of methods, and the border band.
pub fn agreement(body: &mut Markup, comparison: &Comparison) {
    let rows: Vec<Vec<String>> = comparison
        .agreement
        .iter()
        .map(|of| {
            vec![
                format!("{} and {}", of.methods[0].name(), of.methods[1].name()),
                of.both.to_string(),
                of.only_first.to_string(),
                of.only_second.to_string(),
                rate(of.differ),
                number(of.rms_px, 4),
            ]
        })
        .collect();
    let head = [
        "Columns of",
        "pixels of both",
        "only the first",
        "only the second",
        "differ by > 1.5",
        "rms of the rest, px",
    ];
    table(body, &head, &rows);
    caption(body, "Table D.", "Columns after all gates, over all pixels of the image, pixel by pixel.");
    if comparison.entries.iter().any(|entry| entry.figures.report.truth.is_some()) {
        let border = |f: &Figures| f.report.truth.as_ref().map(|truth| truth.border);
        let pixels = |f: &Figures| count(border(f).map(|b| b.pixels));
        let valid = |f: &Figures| count(border(f).map(|b| b.valid));
        let wrong = |f: &Figures| count(border(f).map(|b| b.wrong));
        let shadow = |f: &Figures| count(border(f).map(|b| b.valid_in_shadow));
        by_method(
            body,
            comparison,
            &[
                ("Lit pixels of the border band".into(), &pixels),
                ("of these with a measurement".into(), &valid),
                ("of these wrong".into(), &wrong),
                ("Measurements in shadow".into(), &shadow),
            ],
        );
        caption(
            body,
            "Table E.",
            "Pixels within 2 px of silhouettes, shadow borders and the rim of the image, which the figures above leave out.",
        );
    }
}

/// Verdicts, reasons and notes of the reports.
pub fn reasons(body: &mut Markup, comparison: &Comparison) {
    for entry in &comparison.entries {
        let report = &entry.figures.report;
        body.element("h3", &[], |h3| {
            method_name(h3, entry.figures.method);
            let verdict = serde_json::to_value(report.verdict).ok();
            h3.text(": ").text(verdict.as_ref().and_then(serde_json::Value::as_str).unwrap_or("unknown"));
        });
        body.element("ul", &[("class", "note")], |list| {
            for text in
                report.reasons.iter().map(|reason| &reason.message).chain(&report.losses).chain(&report.notes)
            {
                list.leaf("li", &[], text);
            }
        });
    }
}
