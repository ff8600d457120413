//! Who wins and who loses, in words that are computed from the figures.

use serde::Serialize;

use super::{ContrastRatios, Figures, Method, PAPER};

/// Figures that differ by less than this share of the better one count as equal.
const TIE: f64 = 0.02;

/// One thing that was found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Finding {
    /// Stable name of the figure that it is about, or `summary` and `contrast` for what is about several.
    pub about: String,
    /// Methods that are best by it; two or more where they are equal.
    pub best: Vec<Method>,
    /// The words.
    pub text: String,
}

/// A figure that methods can be compared by.
struct Metric {
    about: String,
    title: String,
    unit: Unit,
    higher_is_better: bool,
    values: Vec<(Method, f64)>,
}

#[derive(Clone, Copy, PartialEq)]
enum Unit {
    Percent,
    Rate,
    Millimetres,
    Pixels,
    Count,
    Seconds,
}

impl Unit {
    fn show(self, value: f64) -> String {
        match self {
            Self::Percent => format!("{:.2} %", 100.0 * value),
            Self::Rate if value == 0.0 => "none".to_owned(),
            Self::Rate => format!("{value:.1e}"),
            Self::Millimetres => format!("{value:.3} mm"),
            Self::Pixels => format!("{value:.3} px"),
            Self::Count => format!("{value:.0}"),
            Self::Seconds => format!("{value:.2} s"),
        }
    }
}

impl Metric {
    /// Methods whose figure is as good as any.
    fn best(&self) -> Vec<Method> {
        let key = |value: f64| if self.higher_is_better { -value } else { value };
        let best = self.values.iter().map(|(_, value)| *value).min_by(|a, b| key(*a).total_cmp(&key(*b)));
        let Some(best) = best else { return Vec::new() };
        // A share that is all but whole leaves differences of the rest to be compared.
        let slack = if self.unit == Unit::Percent { TIE * (1.0 - best).max(0.001) } else { TIE * best.abs() };
        let is_best = |value: f64| (value - best).abs() <= slack;
        self.values.iter().filter(|(_, value)| is_best(*value)).map(|(method, _)| *method).collect()
    }

    fn list(&self) -> String {
        let each =
            self.values.iter().map(|(method, value)| format!("{} {}", method.name(), self.unit.show(*value)));
        each.collect::<Vec<_>>().join(", ")
    }
}

fn names(methods: &[Method]) -> String {
    let names: Vec<&str> = methods.iter().map(|method| method.name()).collect();
    match names.split_last() {
        Some((last, [])) => (*last).to_owned(),
        Some((last, others)) => format!("{} and {last}", others.join(", ")),
        None => "none".to_owned(),
    }
}

/// All findings: contrast, one per figure that two methods or more have, and what each method loses by.
pub fn find(figures: &[&Figures], contrast: &ContrastRatios) -> Vec<Finding> {
    let metrics: Vec<Metric> =
        metrics(figures).into_iter().filter(|metric| metric.values.len() > 1).collect();
    let mut findings: Vec<Finding> =
        figures.iter().map(|of| summary(of.method, figures.len(), &metrics)).collect();
    findings.extend(of_contrast(contrast));
    for metric in &metrics {
        let best = metric.best();
        let verdict = match best.len() == metric.values.len() {
            true => "no difference".to_owned(),
            false if best.len() == 1 => format!("{} is best", names(&best)),
            false => format!("{} are best", names(&best)),
        };
        let text = format!("{}: {}; {verdict}.", metric.title, metric.list());
        findings.push(Finding { about: metric.about.clone(), best, text });
    }
    findings
}

/// By what a method loses and wins.
fn summary(method: Method, methods: usize, metrics: &[Metric]) -> Finding {
    let mut losses = Vec::new();
    let mut wins = Vec::new();
    for metric in metrics {
        let best = metric.best();
        let Some((_, own)) = metric.values.iter().find(|(other, _)| *other == method) else { continue };
        let Some(leader) = best.first().filter(|_| best.len() < metric.values.len()) else { continue };
        if best.contains(&method) {
            wins.push(metric.title.clone());
            continue;
        }
        let value =
            metric.values.iter().find(|(other, _)| other == leader).map_or(f64::NAN, |(_, value)| *value);
        let (own, other) = (metric.unit.show(*own), metric.unit.show(value));
        losses.push(format!("{} ({own} against {other} of {})", metric.title, leader.name()));
    }
    let text = match (methods > 1, losses.is_empty()) {
        (false, _) => format!("{} stands alone: nothing to compare it with.", method.name()),
        (true, true) => format!("{} loses by none of the figures that it can be compared by.", method.name()),
        (true, false) => {
            let leads = if wins.is_empty() { "nothing".to_owned() } else { wins.join("; ") };
            format!("{} loses by: {}. It leads by: {leads}.", method.name(), losses.join("; "))
        }
    };
    Finding { about: "summary".to_owned(), best: Vec::new(), text }
}

fn of_contrast(contrast: &ContrastRatios) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut say =
        |text: String| findings.push(Finding { about: "contrast".to_owned(), best: Vec::new(), text });
    if let (Some(ratio), Some(lit)) = (contrast.paper_dolp_over_raw, contrast.paper_dolp_over_raw_lit) {
        let than = match ratio / PAPER.contrast_ratio {
            share if share < 0.95 => "less than",
            share if share > 1.05 => "more than",
            _ => "about",
        };
        say(format!(
            "The contrast (Eq. 8) of DOLP images in mode paper is {ratio:.2} times that of raw Gray-code images over the \
             whole image and {lit:.2} times between lit pixels: {than} the {} times that the paper reports.",
            PAPER.contrast_ratio
        ));
    }
    if let (Some(ratio), Some(lit)) = (contrast.raw_same_formula, contrast.raw_same_formula_lit) {
        say(format!(
            "The same formula applied to ordinary Gray code, with the black frame in place of V and no polarizer at all, \
             gives {ratio:.2} times the contrast of its raw images ({lit:.2} between lit pixels): that much of the gain is \
             the formula's own scaling."
        ));
    }
    findings
}

fn metrics(figures: &[&Figures]) -> Vec<Metric> {
    let of = |value: &dyn Fn(&Figures) -> Option<f64>| -> Vec<(Method, f64)> {
        let values = figures.iter().filter_map(|figures| Some((figures.method, value(figures)?)));
        values.filter(|(_, value)| value.is_finite()).collect()
    };
    let mut metrics = Vec::new();
    let mut add = |about: &str, title: String, unit, higher_is_better, values| {
        metrics.push(Metric { about: about.to_owned(), title, unit, higher_is_better, values });
    };
    let truth = |pick: fn(&crate::report::Accuracy) -> Option<f64>| {
        move |figures: &Figures| pick(&figures.report.truth.as_ref()?.interior)
    };
    add("coverage", "coverage of the lit scene".into(), Unit::Percent, true, of(&truth(|t| t.coverage)));
    if figures.iter().any(|figures| figures.report.truth.is_none()) {
        let share = |figures: &Figures| figures.report.pixels.map(|p| p.valid as f64 / p.total.max(1) as f64);
        add("valid", "valid share of all pixels".into(), Unit::Percent, true, of(&share));
    }
    add(
        "wrong_code_rate",
        "wrong codes among accepted".into(),
        Unit::Rate,
        false,
        of(&truth(|t| t.wrong_code_rate)),
    );
    let before = of(&truth(|t| t.wrong_code_rate_before_gates));
    add("wrong_code_rate_before_gates", "wrong codes before gates".into(), Unit::Rate, false, before);
    add("column_rms_px", "error of columns".into(), Unit::Pixels, false, of(&truth(|t| t.column_rms_px)));
    add("depth_rmse_mm", "error of depth".into(), Unit::Millimetres, false, of(&truth(|t| t.depth_rmse_mm)));
    let mut plates: Vec<&str> = Vec::new();
    for plane in figures.iter().flat_map(|figures| &figures.report.planes) {
        if !plates.contains(&plane.name.as_str()) {
            plates.push(&plane.name);
        }
    }
    for name in plates {
        let plane =
            |figures: &Figures| figures.report.planes.iter().find(|plane| plane.name == name).cloned();
        let coverage = of(&|figures| plane(figures)?.coverage);
        add("plane_coverage", format!("coverage of {name}"), Unit::Percent, true, coverage);
        let rmse = of(&|figures| plane(figures)?.rmse_mm);
        add("plane_rmse_mm", format!("plane RMSE of {name}"), Unit::Millimetres, false, rmse);
        let section = of(&|figures: &Figures| {
            figures.sections.iter().find(|section| section.plate == name)?.rmse_mm_median
        });
        add("section_rmse_mm", format!("line-fit RMSE of {name}"), Unit::Millimetres, false, section);
    }
    add(
        "frames",
        "frames of a scan".into(),
        Unit::Count,
        false,
        of(&|figures| Some(figures.report.frames as f64)),
    );
    add(
        "seconds",
        "capture time".into(),
        Unit::Seconds,
        false,
        of(&|figures| figures.report.capture.seconds),
    );
    metrics
}

#[cfg(test)]
mod tests {
    use super::*;

    fn metric(unit: Unit, higher_is_better: bool, values: [f64; 3]) -> Metric {
        let values = Method::ALL.into_iter().zip(values).collect();
        Metric { about: "a".into(), title: "thing".into(), unit, higher_is_better, values }
    }

    #[test]
    fn ties_are_ties_and_winners_win() {
        let best = |unit, higher, values| metric(unit, higher, values).best();
        assert_eq!(best(Unit::Millimetres, false, [0.5, 0.2, 0.203]), [Method::Paper, Method::Pse]);
        assert_eq!(best(Unit::Percent, true, [0.9, 0.99, 0.999]), [Method::Pse]);
        assert_eq!(best(Unit::Percent, true, [1.0, 1.0, 1.0]), Method::ALL);
        assert_eq!(best(Unit::Rate, false, [0.0, 1e-5, 0.0]), [Method::Raw, Method::Pse]);
    }

    #[test]
    fn a_loser_is_told_by_what_and_to_whom() {
        let metrics = [
            metric(Unit::Millimetres, false, [0.1, 0.4, 0.2]),
            metric(Unit::Percent, true, [0.5, 0.98, 0.999]),
            metric(Unit::Count, false, [44.0, 44.0, 44.0]),
        ];
        let pse = summary(Method::Pse, 3, &metrics).text;
        assert_eq!(pse, "pse loses by: thing (0.200 mm against 0.100 mm of raw). It leads by: thing.");
        let paper = summary(Method::Paper, 3, &metrics).text;
        assert!(
            paper.contains("98.00 % against 99.90 % of pse") && paper.ends_with("It leads by: nothing."),
            "{paper}"
        );
        assert!(summary(Method::Raw, 3, &metrics[2..]).text.contains("loses by none"));
    }

    #[test]
    fn contrast_is_held_against_the_papers() {
        let contrast = ContrastRatios {
            paper_dolp_over_raw: Some(4.0),
            paper_dolp_over_raw_lit: Some(3.5),
            raw_same_formula: Some(2.0),
            raw_same_formula_lit: Some(1.8),
            ..ContrastRatios::default()
        };
        let found = of_contrast(&contrast);
        assert!(found[0].text.contains("4.00 times") && found[0].text.contains("less than the 5 times"));
        assert!(found[1].text.contains("2.00 times"));
        assert!(of_contrast(&ContrastRatios::default()).is_empty());
    }
}
