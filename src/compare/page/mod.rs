//! The page: one file without anything from elsewhere.

mod figures;
mod tables;

use super::{Comparison, Entry, Method, html::Markup};

/// The whole page.
pub fn write(comparison: &Comparison) -> String {
    let mut page = Markup::new();
    page.constant("<!DOCTYPE html>\n");
    page.element("html", &[("lang", "en")], |html| {
        html.element("head", &[], |head| {
            head.void("meta", &[("charset", "utf-8")]);
            head.void("meta", &[("name", "viewport"), ("content", "width=device-width, initial-scale=1")]);
            head.leaf("title", &[], "The paper, ordinary Gray code and pse on one scene");
            head.element("style", &[], |style| {
                style.constant(include_str!("style.css"));
            });
        });
        html.element("body", &[], |body| write_body(body, comparison));
    });
    page.finish()
}

fn write_body(body: &mut Markup, comparison: &Comparison) {
    body.element("header", &[], |header| {
        header.element("h1", &[], |h1| {
            h1.text("Polarization-coded against ordinary Gray code");
        });
        header.element("p", &[("class", "lead")], |p| {
            p.text(&comparison.scene).text(" ");
            if comparison.simulated {
                p.leaf("span", &[("class", "badge")], "simulated");
            }
        });
        if comparison.simulated {
            header.leaf(
                "p",
                &[("class", "note")],
                "The frames come from a simulated rig: no figure on this page is a measurement of anything real.",
            );
        }
    });
    tables::summary(body, comparison);
    findings(body, comparison, "summary");
    heading(body, "How the frames were made");
    tables::conditions(body, comparison);
    heading(body, "Contrast");
    tables::contrast(body, comparison);
    findings(body, comparison, "contrast");
    heading(body, "Frames and what is decoded from them");
    figures::frames(body, comparison);
    heading(body, "Stripe edges");
    figures::stripe_edges(body, comparison);
    heading(body, "Projector indices and points");
    figures::maps(body, comparison);
    heading(body, "Flatness");
    figures::sections(body, comparison);
    tables::sections(body, comparison);
    heading(body, "Agreement");
    tables::agreement(body, comparison);
    heading(body, "Figure by figure");
    for_each_figure(body, comparison);
    heading(body, "What each scan says of itself");
    tables::reasons(body, comparison);
    body.leaf(
        "p",
        &[("class", "note")],
        concat!("Made by polscan ", env!("CARGO_PKG_VERSION"), "; all figures are in compare.json."),
    );
}

fn heading(body: &mut Markup, text: &str) {
    body.leaf("h2", &[], text);
}

/// Text below a figure or a table.
fn caption(body: &mut Markup, name: &str, text: &str) {
    body.element("p", &[("class", "caption")], |p| {
        p.leaf("b", &[], name).text(" ").text(text);
    });
}

/// The findings about `about`; those of a summary in the colours of their methods.
fn findings(body: &mut Markup, comparison: &Comparison, about: &str) {
    let found: Vec<_> = comparison.findings.iter().filter(|finding| finding.about == about).collect();
    body.element("ul", &[("class", "findings")], |list| {
        for (index, finding) in found.iter().enumerate() {
            let method = comparison.entries.get(index).filter(|_| about == "summary").map(method_of);
            let class = method.map_or(String::new(), |method| format!("of-{}", method.name()));
            list.leaf("li", &[("class", &class)], &finding.text);
        }
    });
}

fn for_each_figure(body: &mut Markup, comparison: &Comparison) {
    let others =
        comparison.findings.iter().filter(|found| found.about != "summary" && found.about != "contrast");
    body.element("ul", &[("class", "findings")], |list| {
        for finding in others {
            let class = match finding.best[..] {
                [only] => format!("of-{}", only.name()),
                _ => String::new(),
            };
            list.leaf("li", &[("class", &class)], &finding.text);
        }
    });
}

fn method_of(entry: &Entry) -> Method {
    entry.figures.method
}

/// The name of a method in its colour.
fn method_name(out: &mut Markup, method: Method) {
    let class = format!("method of-{}", method.name());
    out.leaf("span", &[("class", &class)], method.title());
}
