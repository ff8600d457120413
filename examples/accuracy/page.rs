//! docs/accuracy.md and its plots.

use std::{error::Error, fmt::Write, fs, path::Path};

use polscan::{
    compare::plot::{Plot, Series},
    report::Accuracy,
};

use crate::{
    Figures,
    sweeps::{Measured, Strip, Sweep, WEDGE_EXTINCTION, decades, range},
};

/// Colours of the surfaces of a plot.
const COLOURS: [&str; 3] = ["pse", "raw", "paper"];

const HEAD: &str = "# Accuracy on the simulated rig\n\n\
    Everything on this page is **simulated**: it was measured on the twin of the paper's rig (`config/sim.toml`), which is\n\
    pinned and never tuned to these figures, with its true calibration. A real rig adds the errors of its calibration and\n\
    whatever the twin does not model (interreflection, a projector that does not respond linearly, vibration). Made by\n\
    `make accuracy`, which writes this page and its plots anew; do not edit it.\n\n\
    - **depth error**: root mean square of depth minus truth over all valid points, in mm.\n\
    - **plane RMSE**: root mean square distance from the plane that fits best, no outlier removed, in mm.\n\
    - **coverage**: valid share of the pixels that projector light reaches, 2 px off silhouettes and shadows.\n\
    - **wrong**: share of the valid pixels whose column is off by more than 1.5.\n\
    - **sigma ratio**: spread of depth errors over the sigma that is written with each point, `1.4826 MAD`; 1 is honest,\n\
      0.8 to 1.25 is aimed at, above 1 the scanner claims too much.\n\n";

/// Writes page and plots into the folder `docs`.
pub fn write(docs: &Path, measured: &Measured) -> Result<(), Box<dyn Error>> {
    let mut page = String::from(HEAD);
    let images = docs.join("images");
    aims(&mut page, measured)?;
    shortfalls(&mut page, measured)?;
    reflectance(&mut page, &images, measured)?;
    for sweep in &measured.sweeps {
        section(&mut page, &images, sweep)?;
    }
    fs::write(docs.join("accuracy.md"), page)?;
    Ok(())
}

fn number(value: Option<f64>, decimals: usize) -> String {
    value.map_or("–".into(), |value| format!("{value:.decimals$}"))
}

fn percent(value: Option<f64>) -> String {
    value.map_or("–".into(), |value| format!("{:.2} %", 100.0 * value))
}

fn rate(value: Option<f64>) -> String {
    match value {
        Some(0.0) => "0".into(),
        Some(value) => format!("{value:.1e}"),
        None => "–".into(),
    }
}

fn cells(figures: Option<Figures>) -> String {
    let figures = figures.unwrap_or_default();
    let Accuracy { coverage, wrong_code_rate, column_rms_px, depth_rmse_mm, sigma_z_ratio, .. } =
        figures.accuracy;
    format!(
        "{} | {} | {} | {} | {} | {}",
        number(depth_rmse_mm, 3),
        number(figures.plane_rmse_mm, 3),
        number(column_rms_px, 4),
        percent(coverage),
        rate(wrong_code_rate),
        number(sigma_z_ratio, 2)
    )
}

const COLUMNS: &str = "depth error, mm | plane RMSE, mm | column error, px | coverage | wrong | sigma ratio";

/// The numbers to beat.
fn aims(page: &mut String, measured: &Measured) -> Result<(), Box<dyn Error>> {
    page.push_str("## Aims\n\n| quantity | aim | measured | reached |\n|---|---|---|---|\n");
    let mut row = |what: &str, aim: &str, value: Option<f64>, decimals: usize, reached: bool| {
        let reached = if aim == "none" {
            "–"
        } else if reached {
            "yes"
        } else {
            "**no**"
        };
        writeln!(page, "| {what} | {aim} | {} | {reached} |", number(value, decimals))
    };
    for (name, limit) in [("white", 0.5), ("black", 0.7)] {
        let plane = measured.pinned.planes.iter().find(|plane| plane.name == name);
        let rmse = plane.and_then(|plane| plane.rmse_mm);
        let coverage = plane.and_then(|plane| plane.coverage);
        let what = format!("plane RMSE of the {name} plate, mm (coverage {})", percent(coverage));
        row(&what, &format!("<= {limit}"), rmse, 3, rmse.is_some_and(|rmse| rmse <= limit))?;
    }
    let wrong = measured.pinned.truth.as_ref().map(|truth| truth.interior);
    let before = wrong.and_then(|t| t.wrong_code_rate_before_gates);
    row(
        "wrong codes before gates, pinned scene",
        "<= 0.001",
        before,
        6,
        before.is_some_and(|rate| rate <= 1e-3),
    )?;
    let after = wrong.and_then(|t| t.wrong_code_rate);
    row(
        "wrong codes after gates, pinned scene",
        "<= 0.00001",
        after,
        6,
        after.is_some_and(|rate| rate <= 1e-5),
    )?;
    for (mode, strips) in &measured.wedges {
        let what = format!("range of reflectance at extinction 10:1, 12 bit, mode {mode}, decades");
        let found = decades(strips);
        let (aim, reached) = if mode.name() == "pse" { (">= 3.1", found >= 3.1) } else { ("none", true) };
        row(&what, aim, Some(found), 2, reached)?;
    }
    for (reflectance, rms) in &measured.edges {
        let what = format!("position of an edge at reflectance {reflectance}, rms in projector px");
        row(&what, "<= 0.05", *rms, 4, rms.is_some_and(|rms| rms <= 0.05))?;
    }
    for name in ["white", "black"] {
        let plane = measured.pinned.planes.iter().find(|plane| plane.name == name);
        let ratio = plane.and_then(|plane| plane.truth?.sigma_z_ratio);
        let within = ratio.is_some_and(|ratio| (0.8..=1.25).contains(&ratio));
        row(&format!("sigma ratio of the {name} plate"), "0.8 to 1.25", ratio, 2, within)?;
    }
    let sphere = measured.sweeps.iter().find(|sweep| sweep.name == "sphere");
    for (index, surface) in ["bright", "dark"].into_iter().enumerate() {
        let figures = sphere.and_then(|sweep| sweep.points.first()?.1.get(index).copied().flatten());
        let ratio = figures.and_then(|figures| figures.accuracy.sigma_z_ratio);
        let within = ratio.is_some_and(|ratio| (0.8..=1.25).contains(&ratio));
        row(&format!("sigma ratio of the {surface} sphere"), "0.8 to 1.25", ratio, 2, within)?;
    }
    page.push('\n');
    Ok(())
}

/// What falls short of an aim, and why.
fn shortfalls(page: &mut String, measured: &Measured) -> Result<(), Box<dyn Error>> {
    let [with, without] = measured.range_limits;
    let strips = measured.wedges.first().map_or(&[][..], |(_, strips)| strips);
    let (brightest, darkest) = range(strips).unwrap_or((f64::NAN, f64::NAN));
    let decades = decades(strips);
    let clipped = 2.0 / (1.0 + 1.0 / WEDGE_EXTINCTION);
    let reached = if decades >= 3.1 { "reaches the aim of 3.1" } else { "is short of the aim of 3.1" };
    let dishonest = |strip: &&Strip| {
        strip.figures.is_some_and(|figures| {
            let ratio = figures.accuracy.sigma_z_ratio.unwrap_or(1.0);
            figures.accuracy.coverage.is_some_and(|share| share >= 0.95) && !(0.8..=1.25).contains(&ratio)
        })
    };
    let weak: Vec<&Strip> = strips.iter().filter(dishonest).collect();
    writeln!(
        page,
        "## What falls short, and why\n\n\
         - **Range of reflectance**: {decades:.2} decades {reached}: from {brightest:.2} times the full well, down to \
         {darkest:.5} of it.\n  Downwards the lit gate ends it: modulation `(1 - 1/e) H` sinks to 4 sigma of a pattern less its \
         inverse, `sqrt((1 + 1/e) H + 2 ambient + 2 read^2)`\n  in electrons, {with:.2} decades below the full well \
         ({without:.2} without any ambient light), before any blur. Upwards pixels on the edge of a stripe end\n  it: both \
         frames of the pair show half of the light there, `(1 + 1/e) H / 2`, and are clipped together from {clipped:.2} times the \
         full well on; a pair that\n  is clipped twice carries no bit."
    )?;
    if !weak.is_empty() {
        let list: Vec<String> = weak
            .iter()
            .map(|strip| {
                let ratio = strip.figures.and_then(|figures| figures.accuracy.sigma_z_ratio);
                format!("{} at {:.4}", number(ratio, 2), strip.level)
            })
            .collect();
        writeln!(
            page,
            "- **Sigma on the wedge** (mode pse) is off where coverage is still at least 95 %: sigma ratio {} of the full well.",
            list.join(", ")
        )?;
    }
    page.push('\n');
    Ok(())
}

fn reflectance(page: &mut String, images: &Path, measured: &Measured) -> Result<(), Box<dyn Error>> {
    page.push_str(
        "## Reflectance\n\nStrips of one metal plane, eight to a decade, in one exposure of mode pse and one of mode paper \
         (the wedge of `config/scenes/wedge.toml` with\nmore strips and more light, extinction 10:1, 12 bit). A strip counts as decoded \
         where coverage is at least 95 % and at most 0.1 % of the codes\nare wrong; the range is the longest run of such strips.\n\n",
    );
    let series = |value: fn(&Accuracy) -> Option<f64>| -> Vec<Series> {
        let one = |((mode, strips), class): (&(_, Vec<Strip>), &'static str)| {
            let mode: &polscan_patterns::Mode = mode;
            let point = |strip: &Strip| {
                let value = strip.figures.and_then(|figures| value(&figures.accuracy));
                (strip.level, value.unwrap_or(f64::NAN))
            };
            Series {
                name: format!("mode {mode}"),
                class,
                points: strips.iter().map(point).collect(),
                joined: true,
            }
        };
        measured.wedges.iter().zip(["pse", "paper"]).map(one).collect()
    };
    let x = "level under uniform H over the full well";
    plot(
        page,
        images,
        "reflectance-coverage",
        x,
        "coverage",
        true,
        Some((0.0, 1.0)),
        series(|a| a.coverage),
    )?;
    plot(
        page,
        images,
        "reflectance-column",
        x,
        "column error, px",
        true,
        Some((0.0, 0.3)),
        series(|a| a.column_rms_px),
    )?;
    for (mode, strips) in &measured.wedges {
        writeln!(
            page,
            "\nMode {mode}:\n\n| level over full well | {COLUMNS} |\n|---|---|---|---|---|---|---|"
        )?;
        for strip in strips {
            writeln!(page, "| {:.5} | {} |", strip.level, cells(strip.figures))?;
        }
    }
    page.push('\n');
    Ok(())
}

fn section(page: &mut String, images: &Path, sweep: &Sweep) -> Result<(), Box<dyn Error>> {
    writeln!(page, "## {}\n\n{}\n", sweep.title, sweep.text)?;
    if sweep.points.len() > 1 {
        let series = |value: fn(&Figures) -> Option<f64>| -> Vec<Series> {
            let one = |(index, (surface, class)): (usize, (&&str, &'static str))| {
                let point = |(x, of): &(f64, Vec<Option<Figures>>)| {
                    (*x, of[index].as_ref().and_then(value).unwrap_or(f64::NAN))
                };
                let points = sweep.points.iter().map(point).collect();
                Series { name: (*surface).into(), class, points, joined: true }
            };
            sweep.surfaces.iter().zip(COLOURS).enumerate().map(one).collect()
        };
        let file = |what: &str| format!("{}-{what}", sweep.name);
        let (axis, log) = (sweep.axis, sweep.log);
        plot(
            page,
            images,
            &file("depth"),
            axis,
            "depth error, mm",
            log,
            None,
            series(|f| f.accuracy.depth_rmse_mm),
        )?;
        let coverage = series(|f| f.accuracy.coverage);
        plot(page, images, &file("coverage"), axis, "coverage", log, Some((0.0, 1.0)), coverage)?;
        let sigma = series(|f| f.accuracy.sigma_z_ratio);
        plot(page, images, &file("sigma"), axis, "sigma ratio", log, Some((0.0, 2.0)), sigma)?;
    }
    for (index, surface) in sweep.surfaces.iter().enumerate() {
        writeln!(page, "\n{surface}:\n\n| {} | {COLUMNS} |\n|---|---|---|---|---|---|---|", sweep.axis)?;
        for (value, of) in &sweep.points {
            writeln!(page, "| {value} | {} |", cells(of[index]))?;
        }
    }
    page.push('\n');
    Ok(())
}

#[expect(clippy::too_many_arguments, reason = "a plot has that many parts")]
fn plot(
    page: &mut String,
    images: &Path,
    name: &str,
    x_name: &str,
    y_name: &str,
    log_x: bool,
    y_range: Option<(f64, f64)>,
    series: Vec<Series>,
) -> Result<(), Box<dyn Error>> {
    let plot = Plot {
        label: format!("{y_name} against {x_name}, simulated"),
        size: (620.0, 220.0),
        x_name: x_name.into(),
        y_name: y_name.into(),
        y_range,
        log_x,
        series,
        ..Plot::default()
    };
    let file = format!("accuracy-{name}.svg");
    fs::write(images.join(&file), plot.file())?;
    writeln!(page, "![{} (simulated)](images/{file})", plot.label)?;
    Ok(())
}
