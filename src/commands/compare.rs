//! `polscan compare`: the paper against ordinary Gray code against `pse` on one scene, as one page and one file of figures.

use std::path::{Path, PathBuf};

use polscan_patterns::Mode;

use super::{failure::FAILED, progress::Bar, say, scan::cancel_on_interrupt};
use crate::{
    app::{Rig, without_analyser},
    compare::{Comparison, Entry, Method, Places, Subject, page},
    config::Settings,
    engine::{DecodeRequest, Failure, Recorded, Results, Scan, rig_failure},
    pipeline::{self, PipelineError},
    report::NamedRegion,
    sequencer::{CancelFlag, Progress},
    store::{Bundle, BundleWriter, Policy, error::StorageError},
};

/// The page.
const PAGE_FILE_NAME: &str = "index.html";
/// The figures.
const FIGURES_FILE_NAME: &str = "compare.json";

/// What is compared.
pub enum CompareArgs {
    /// Scans of the simulated rig.
    Twin {
        /// The rig.
        settings: Box<Settings>,
        /// What names it.
        name: String,
    },
    /// Recorded bundles.
    Bundles(Vec<(Method, PathBuf)>),
}

/// Compares and writes; returns the exit code.
pub fn compare(args: &CompareArgs, regions: &[NamedRegion], out: &Path, json: bool) -> Result<u8, Failure> {
    let failed = |error: StorageError| Failure::storage("write the comparison", error);
    if let CompareArgs::Bundles(bundles) = args {
        // What is not there is refused when it is read.
        for (_, path) in bundles.iter().filter(|(_, path)| path.exists()) {
            refuse_inside(path, out)?;
        }
    }
    let writer = BundleWriter::create(out, None, 64 << 20).map_err(failed)?;
    let made = match args {
        CompareArgs::Twin { settings, name } => twin(settings, name, regions)?,
        CompareArgs::Bundles(bundles) => recorded(bundles, regions)?,
    };
    let comparison = match made {
        Made::Compared(comparison) => comparison,
        Made::Failed { method, reason } => {
            eprintln!("polscan: the scan for `{}` failed: {reason}", method.name());
            if json {
                say(
                    serde_json::json!({ "out": out, "verdict": "failed", "method": method, "reason": reason }),
                );
            }
            return Ok(FAILED);
        }
    };
    let figures = comparison.to_json();
    let text = serde_json::to_vec_pretty(&figures)
        .map_err(|error| Failure::storage("write the comparison", error))?;
    writer.bytes(FIGURES_FILE_NAME, &text).map_err(failed)?;
    writer.bytes(PAGE_FILE_NAME, page::write(&comparison).as_bytes()).map_err(failed)?;
    writer.finish_plain().map_err(failed)?;
    if json {
        say(serde_json::json!({ "out": out, "page": out.join(PAGE_FILE_NAME), "compare": figures }));
    } else {
        for finding in
            comparison.findings.iter().filter(|found| found.about == "summary" || found.about == "contrast")
        {
            say(&finding.text);
        }
        say(format_args!("page: {}", out.join(PAGE_FILE_NAME).display()));
        say(format_args!("figures: {}", out.join(FIGURES_FILE_NAME).display()));
    }
    Ok(0)
}

/// The result must be no part of a bundle that is read.
fn refuse_inside(bundle: &Path, out: &Path) -> Result<(), Failure> {
    let folder = if bundle.is_dir() { bundle } else { bundle.parent().unwrap_or(Path::new(".")) };
    BundleWriter::create(out, Some(folder), 0)
        .map(drop)
        .map_err(|error| Failure::storage("write the comparison", error))
}

/// What came of it.
enum Made {
    Compared(Box<Comparison>),
    Failed { method: Method, reason: String },
}

/// Scans the twin three times: without a polarizer, and with one in the two modes.
fn twin(settings: &Settings, name: &str, regions: &[NamedRegion]) -> Result<Made, Failure> {
    let Some((raw, remarks)) = without_analyser(settings) else {
        return Err(Failure::Setup {
            operation: "compare on this rig",
            source: "only a simulated rig can take its own polarizer off; record one bundle per method and give them \
                     with --raw, --paper and --pse"
                .into(),
        });
    };
    let with = |mode| Settings { mode, ..settings.clone() };
    let behind = |settings: &Settings| {
        vec![format!("behind the polarizer, {:.0} us a frame as configured", settings.camera.exposure_us)]
    };
    let runs = [
        (Method::Raw, raw, remarks),
        (Method::Paper, with(Mode::Paper), behind(settings)),
        (Method::Pse, with(Mode::Pse), behind(settings)),
    ];
    let cancel = CancelFlag::default();
    cancel_on_interrupt(&cancel);
    let mut places = None;
    let mut entries = Vec::new();
    for (method, settings, remarks) in runs {
        let mut rig = Rig::open(&settings).map_err(rig_failure)?;
        let scan = Scan::prepare(&settings, regions, &mut rig)?;
        let bar = Bar::new(scan.frames() as u64);
        bar.say(format!("projecting {}", method.name()));
        let mut progress = |progress: Progress<'_>| {
            if let Progress::Captured { done, .. } = progress {
                bar.frames(done as u64);
            }
        };
        let taken = scan.capture(&mut rig, &mut progress, &cancel);
        if let Some(reason) = taken.failure() {
            return Ok(Made::Failed { method, reason: reason.message.clone() });
        }
        bar.say(format!("decoding {}", method.name()));
        let exposure_us = Some(settings.camera.exposure_us);
        let look = |results: &Results| {
            let subject =
                Subject { method, source: "the simulated rig".into(), remarks, exposure_us, results };
            entry(&subject, &mut places)
        };
        let made = scan.examine(&taken, look).map_err(|error: PipelineError| {
            Failure::data(format!("decode the scan for {}", method.name()), error)
        })?;
        entries.push(made?);
    }
    Ok(Made::Compared(compared(
        format!("Scans of the simulated rig {name}, one per method."),
        places,
        entries,
    )))
}

fn compared(scene: String, places: Option<Places>, entries: Vec<Entry>) -> Box<Comparison> {
    let places = places.unwrap_or_else(|| Places::new((0, 0), None, &[]));
    Box::new(Comparison::new(scene, places, entries))
}

/// What is shown of one outcome. The first one chooses the places.
fn entry(subject: &Subject, places: &mut Option<Places>) -> Result<Entry, Failure> {
    let (job, context) = (subject.results.job, subject.results.context);
    let size = (job.decode.width, job.decode.height);
    let places = places.get_or_insert_with(|| Places::new(size, context.truth, context.regions));
    if places.size != size {
        let (width, height) = places.size;
        let message = format!(
            "its frames are {}x{} px, those of the bundle before it {width}x{height} px; compare captures of one camera",
            size.0, size.1
        );
        return Err(Failure::data(format!("compare the bundle for {}", subject.method.name()), message));
    }
    Ok(Entry::new(subject, places))
}

/// Decodes the bundles, one after the other.
fn recorded(bundles: &[(Method, PathBuf)], regions: &[NamedRegion]) -> Result<Made, Failure> {
    let mut places = None;
    let mut entries = Vec::new();
    for (method, path) in bundles {
        let mode = match method {
            Method::Raw => Mode::Gray,
            Method::Paper => Mode::Paper,
            Method::Pse => Mode::Pse,
        };
        let args = DecodeRequest {
            bundle: path,
            calibration: None,
            projector_left: false,
            calibration_unit_mm: 1.0,
            mode: None,
            regions,
        };
        let operation = || format!("decode {}", path.display());
        let open =
            |mode| Bundle::open(path, Policy::Local, mode).map_err(|error| Failure::data(operation(), error));
        // A pse capture holds all that mode paper needs and more, so each bundle may be read in the mode asked for.
        let own = open(None).ok().and_then(|bundle| bundle.manifest().mode);
        let as_recorded = own == Some(mode) || (*method == Method::Pse && own == Some(Mode::Fast));
        let remarks =
            own.filter(|_| !as_recorded).map(|own| format!("recorded in mode {own}, decoded in mode {mode}"));
        let remarks: Vec<String> = remarks.into_iter().collect();
        let mode = (!as_recorded).then_some(mode);
        let args = DecodeRequest { mode, ..args };
        let recorded = Recorded::read(&args, open(mode)?)?;
        let (job, context) = (recorded.job(), recorded.context());
        let outcome =
            pipeline::run(&job).map_err(|error: PipelineError| Failure::data(operation(), error))?;
        let results = Results {
            job: &job,
            outcome: &outcome,
            context: &context,
            timings: outcome.timings,
            frames: None,
        };
        let settings = recorded.bundle.manifest().settings.as_ref();
        let subject = Subject {
            method: *method,
            source: path.display().to_string(),
            remarks,
            exposure_us: settings.map(|settings| settings.applied.settings.exposure_us),
            results: &results,
        };
        entries.push(entry(&subject, &mut places)?);
    }
    Ok(Made::Compared(compared("Recorded captures.".into(), places, entries)))
}
