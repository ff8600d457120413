//! `polscan compare` from outside: page, figures and refusals.

use std::fs;

use crate::rig::{Rig, json, polscan, text};

#[test]
fn three_scans_of_the_twin_become_a_page_and_figures() {
    let rig = Rig::small();
    let config = rig.config();
    let out = rig.path("compared");
    let run = polscan(&["compare", "--config", text(&config), "--out", text(&out), "--json"]).expect(0);
    let printed: serde_json::Value = serde_json::from_str(&run.stdout).expect("one object");
    let figures = json(&out.join("compare.json"));
    assert_eq!(printed["compare"], figures);
    assert_eq!((&figures["schema"], &figures["simulated"]), (&"polscan.compare/1".into(), &true.into()));
    for (method, mode, frames) in [("raw", "gray", 36), ("paper", "paper", 33), ("pse", "pse", 36)] {
        let of = &figures["methods"][method];
        assert_eq!((&of["mode"], &of["report"]["frames"]), (&mode.into(), &frames.into()), "{method}");
        let truth = &of["report"]["truth"];
        assert!(truth["coverage"].as_f64().is_some_and(|share| share > 0.98), "{method}: {truth}");
        assert!(truth["wrong_code_rate"].as_f64().is_some_and(|rate| rate < 1e-3), "{method}: {truth}");
        let sections = of["sections"].as_array().expect("sections");
        assert_eq!(sections.len(), 2, "the two plates");
        assert!(
            sections.iter().all(|section| section["rmse_mm"].as_f64().is_some_and(|rmse| rmse < 3.0)),
            "{sections:?}"
        );
    }
    // The same light: without a polarizer the exposure is shorter by what white is brighter than H.
    let exposure = |method: &str| figures["methods"][method]["exposure_us"].as_f64().expect("an exposure");
    assert!((exposure("pse") / exposure("raw") - 1.8).abs() < 1e-6);
    assert!(figures["contrast"]["paper_dolp_over_raw"].as_f64().is_some_and(|ratio| ratio > 1.0));
    assert_eq!(figures["agreement"].as_array().map(Vec::len), Some(3));
    let about = |about: &str| {
        figures["findings"].as_array().expect("findings").iter().filter(|f| f["about"] == about).count()
    };
    assert_eq!(about("summary"), 3, "each method is told what it loses by");

    let page = fs::read_to_string(out.join("index.html")).expect("a page");
    assert!(page.starts_with("<!DOCTYPE html>") && page.ends_with("</html>"));
    // Nothing from elsewhere: no scripts, and every address holds its own data.
    assert!(!page.contains("<script") && !page.contains("http:") && !page.contains("https:"));
    assert_eq!(page.matches("src=\"").count(), page.matches("src=\"data:image/").count());
    assert!(page.contains("simulated") && page.matches("<svg").count() > 10);
    // Between the pictures, whose letters may spell anything.
    let words: String =
        page.split("base64,").map(|part| part.split_once('"').map_or(part, |(_, rest)| rest)).collect();
    assert!(!words.contains("NaN") && words.contains("pse loses by"));

    // A second comparison goes nowhere, and says so before anything is scanned.
    polscan(&["compare", "--config", text(&config), "--out", text(&out)]).expect(74);
}

#[test]
fn bundles_are_compared_with_what_they_have() {
    let rig = Rig::small();
    rig.scan("polarized", &[]).expect(0);
    let (bundle, out) = (rig.path("polarized"), rig.path("compared"));
    // One capture in mode pse serves both methods: the paper's needs less.
    let arguments = [
        "compare",
        "--paper",
        text(&bundle),
        "--pse",
        text(&bundle),
        "--region",
        "part=180,40,120,90",
        "--out",
        text(&out),
    ];
    polscan(&arguments).expect(0);
    let figures = json(&out.join("compare.json"));
    assert_eq!(figures["methods"].as_object().map(serde_json::Map::len), Some(2));
    let remarks = figures["methods"]["paper"]["remarks"].to_string();
    assert!(remarks.contains("recorded in mode pse, decoded in mode paper"), "{remarks}");
    let names: Vec<_> =
        figures["places"]["plates"].as_array().expect("plates").iter().map(|p| &p["name"]).collect();
    assert!(names.iter().any(|name| **name == "part"), "{names:?}");

    let inside = bundle.join("inside");
    polscan(&["compare", "--pse", text(&bundle), "--out", text(&inside)]).expect(74);
    let none = rig.path("none");
    polscan(&["compare", "--raw", text(&none), "--out", text(&rig.path("other"))]).expect(65);
    let config = rig.config();
    let both = ["compare", "--config", text(&config), "--pse", text(&bundle), "--out", text(&none)];
    polscan(&both).expect(2);
    polscan(&["compare", "--out", text(&none)]).expect(64);
}
