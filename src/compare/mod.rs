//! The paper against ordinary Gray code against mode `pse` on one scene: figures and a page. Pure: outcomes in, values and
//! markup out.
//!
//! Data flow: [`Places`] says where in the image one looks, [`Entry::new`] takes from one method's outcome what is shown of
//! it, so that its frames can be let go of, [`Comparison`] puts entries side by side, [`page::write`] makes the page.

mod entry;
mod findings;
pub mod html;
mod images;
pub mod page;
mod places;
pub mod plot;
mod stripes;

use serde::Serialize;

pub use entry::{Entry, Figures, FixedRule, SectionFit, Subject};
pub use findings::Finding;
pub use places::Places;
pub use stripes::EdgeCount;

/// Schema of compare.json.
pub const SCHEMA: &str = "polscan.compare/1";

/// One of the methods that are compared.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// Ordinary Gray code: black and white, no polarizer.
    Raw,
    /// The paper's: polarization-coded, decoded by the degree of linear polarization.
    Paper,
    /// Polarization-coded, with two references and decisions in units of noise.
    Pse,
}

impl Method {
    /// All of them in the order of the page.
    pub const ALL: [Self; 3] = [Self::Raw, Self::Paper, Self::Pse];

    /// Name in files and on the command line; also the class of its colour.
    pub fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Paper => "paper",
            Self::Pse => "pse",
        }
    }

    /// Name for people.
    pub fn title(self) -> &'static str {
        match self {
            Self::Raw => "Gray code, no polarizer",
            Self::Paper => "paper (DOLP)",
            Self::Pse => "pse",
        }
    }
}

/// How two methods agree on the columns of one scene, over all pixels.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Agreement {
    /// The two methods.
    pub methods: [Method; 2],
    /// Pixels that both have.
    pub both: u64,
    /// Pixels that only the first has.
    pub only_first: u64,
    /// Pixels that only the second has.
    pub only_second: u64,
    /// Share of `both` whose columns differ by more than 1.5; `null` where there are none.
    pub differ: Option<f64>,
    /// Root mean square difference of the others in projector px.
    pub rms_px: Option<f64>,
}

/// What the paper reports, for comparison.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PaperFigures {
    /// Contrast of DOLP images over that of raw Gray-code images (Table 1).
    pub contrast_ratio: f64,
    /// RMSE of the line fit on the white plate, raw Gray code (Fig. 6a).
    pub white_raw_rmse: f64,
    /// The same for DOLP.
    pub white_dolp_rmse: f64,
    /// RMSE of the line fit on the black plate, raw Gray code (Fig. 6b).
    pub black_raw_rmse: f64,
    /// The same for DOLP.
    pub black_dolp_rmse: f64,
}

/// The paper's own figures.
pub const PAPER: PaperFigures = PaperFigures {
    contrast_ratio: 5.0,
    white_raw_rmse: 0.6965,
    white_dolp_rmse: 0.6036,
    black_raw_rmse: 0.7356,
    black_dolp_rmse: 0.8035,
};

/// Ratios of contrast between methods: the paper's claim, asked in three ways.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ContrastRatios {
    /// DOLP images of mode paper over raw images of ordinary Gray code: the paper's definition.
    pub paper_dolp_over_raw: Option<f64>,
    /// The same between lit pixels.
    pub paper_dolp_over_raw_lit: Option<f64>,
    /// DOLP images of mode pse over raw images of ordinary Gray code.
    pub pse_dolp_over_raw: Option<f64>,
    /// The same between lit pixels.
    pub pse_dolp_over_raw_lit: Option<f64>,
    /// `(I - black) / (I + black)` of ordinary Gray code over its own raw images: what the formula does by itself, without
    /// any polarization.
    pub raw_same_formula: Option<f64>,
    /// The same between lit pixels.
    pub raw_same_formula_lit: Option<f64>,
}

/// Everything that the page shows.
pub struct Comparison {
    /// What was looked at, in words.
    pub scene: String,
    /// Whether the frames come from the simulated rig.
    pub simulated: bool,
    /// Where it was looked.
    pub places: Places,
    /// The methods that there are, in order.
    pub entries: Vec<Entry>,
    /// Agreement of each two of them.
    pub agreement: Vec<Agreement>,
    /// Ratios of contrast.
    pub contrast: ContrastRatios,
    /// Who wins and who loses, in words.
    pub findings: Vec<Finding>,
}

impl Comparison {
    /// Puts entries side by side.
    pub fn new(scene: String, places: Places, mut entries: Vec<Entry>) -> Self {
        entries.sort_by_key(|entry| entry.figures.method);
        let simulated = entries.iter().any(|entry| entry.figures.report.simulated);
        let mut agreement = Vec::new();
        for (index, first) in entries.iter().enumerate() {
            agreement.extend(entries[index + 1..].iter().map(|second| agree(first, second)));
        }
        let contrast = ratios(&entries);
        let figures: Vec<&Figures> = entries.iter().map(|entry| &entry.figures).collect();
        let findings = findings::find(&figures, &contrast);
        Self { scene, simulated, places, entries, agreement, contrast, findings }
    }

    /// Figures of a method, if it takes part.
    pub fn entry(&self, method: Method) -> Option<&Entry> {
        self.entries.iter().find(|entry| entry.figures.method == method)
    }

    /// compare.json.
    pub fn to_json(&self) -> serde_json::Value {
        let methods: serde_json::Map<String, serde_json::Value> = self
            .entries
            .iter()
            .map(|entry| (entry.figures.method.name().to_owned(), serde_json::json!(entry.figures)))
            .collect();
        serde_json::json!({
            "schema": SCHEMA,
            "software": concat!("polscan ", env!("CARGO_PKG_VERSION")),
            "scene": self.scene,
            "simulated": self.simulated,
            "places": self.places,
            "methods": methods,
            "contrast": self.contrast,
            "agreement": self.agreement,
            "findings": self.findings,
            "paper": PAPER,
        })
    }
}

fn agree(first: &Entry, second: &Entry) -> Agreement {
    let (mut both, mut only_first, mut only_second, mut differ, mut squares) = (0u64, 0u64, 0u64, 0u64, 0.0);
    for (&a, &b) in first.column.data().iter().zip(second.column.data()) {
        match (a.is_finite(), b.is_finite()) {
            (true, true) => {
                both += 1;
                let off = f64::from(a - b);
                if off.abs() > 1.5 {
                    differ += 1;
                } else {
                    squares += off * off;
                }
            }
            (true, false) => only_first += 1,
            (false, true) => only_second += 1,
            (false, false) => {}
        }
    }
    let share = |part: f64, whole: u64| (whole > 0).then(|| part / whole as f64);
    Agreement {
        methods: [first.figures.method, second.figures.method],
        both,
        only_first,
        only_second,
        differ: share(differ as f64, both),
        rms_px: share(squares, both - differ).map(f64::sqrt),
    }
}

fn ratios(entries: &[Entry]) -> ContrastRatios {
    let of = |method: Method| {
        entries
            .iter()
            .find(|entry| entry.figures.method == method)
            .and_then(|entry| entry.figures.report.contrast)
    };
    let ratio =
        |over: Option<f64>, under: Option<f64>| over.zip(under).map(|(a, b)| a / b).filter(|r| r.is_finite());
    let (raw, paper, pse) = (of(Method::Raw), of(Method::Paper), of(Method::Pse));
    let (base, base_lit) = (raw.and_then(|c| c.raw), raw.and_then(|c| c.raw_lit));
    ContrastRatios {
        paper_dolp_over_raw: ratio(paper.and_then(|c| c.dolp), base),
        paper_dolp_over_raw_lit: ratio(paper.and_then(|c| c.dolp_lit), base_lit),
        pse_dolp_over_raw: ratio(pse.and_then(|c| c.dolp), base),
        pse_dolp_over_raw_lit: ratio(pse.and_then(|c| c.dolp_lit), base_lit),
        raw_same_formula: raw.and_then(|c| c.ratio),
        raw_same_formula_lit: raw.and_then(|c| c.ratio_lit),
    }
}
