//! What the terminal says after a scan or a decode: narrow, aligned, in plain words.

use std::{fmt::Write, path::Path};

use super::{Accuracy, PlaneReport, Report, Verdict, statistics::share};

/// Lines are no longer than this, as far as names and paths allow.
const WIDTH: usize = 80;
/// Where the second column begins.
const INDENT: usize = 14;

/// Where the results are.
#[derive(Debug, Clone, Copy)]
pub struct Outputs<'a> {
    /// Folder that the results were written to.
    pub directory: &'a Path,
    /// Names in it that a person may want to open.
    pub files: &'a [&'a str],
}

/// Words for a report. Ends with a line break.
pub fn summary(report: &Report, outputs: Option<Outputs>) -> String {
    let mut text = Text::default();
    verdict(&mut text, report);
    if report.simulated {
        text.entry("simulated", "all figures below come from the simulated rig, none from a real one");
    }
    text.entry(
        "scan",
        &format!(
            "mode {}, {} frames of {} x {} px",
            report.mode, report.frames, report.size.width, report.size.height
        ),
    );
    coverage(&mut text, report);
    capture(&mut text, report);
    planes(&mut text, report);
    if let Some(truth) = &report.truth {
        text.entry("truth", &accuracy(&truth.interior));
        text.entry(
            "",
            &format!(
                "at borders {} of {} measured pixels wrong, {} measured in shadow",
                grouped(truth.border.wrong),
                grouped(truth.border.valid),
                grouped(truth.border.valid_in_shadow)
            ),
        );
    }
    // Said above already.
    for note in report.notes.iter().filter(|note| !(report.simulated && note.contains("simulated rig"))) {
        text.entry("note", note);
    }
    if let Some(outputs) = outputs {
        text.raw("results", &outputs.directory.display().to_string());
        if !outputs.files.is_empty() {
            text.entry("", &outputs.files.join("  "));
        }
    }
    text.0
}

/// The verdict first: it is what one looks for.
fn verdict(text: &mut Text, report: &Report) {
    text.entry(
        "verdict",
        match report.verdict {
            Verdict::Ok => "ok",
            Verdict::Degraded => "degraded: usable, but read this",
            Verdict::Failed => "FAILED: do not use this result",
        },
    );
    for reason in &report.reasons {
        text.entry(&format!("  {}", reason.severity), &format!("{}: {}", reason.diagnosis, reason.message));
    }
}

fn coverage(text: &mut Text, report: &Report) {
    let Some(pixels) = &report.pixels else { return };
    let coverage = share(pixels.valid, pixels.lit);
    text.entry(
        "coverage",
        &format!(
            "{} of {} pixels with projector light were measured",
            percent(coverage),
            grouped(pixels.lit)
        ),
    );
    text.entry(
        "points",
        &match report.points {
            Some(points) => grouped(points),
            None => "none without a calibration".to_owned(),
        },
    );
}

fn capture(text: &mut Text, report: &Report) {
    let capture = &report.capture;
    if let (Some(seconds), Some(limit)) = (capture.seconds, capture.limit_seconds) {
        let mut line = format!("{seconds:.2} s; {} frames take {limit:.2} s at this hold", report.frames);
        if !capture.retaken.is_empty() {
            let _ = write!(line, "; {} of the pairs captured again", capture.retaken.len());
        }
        text.entry("capture", &line);
    }
    if let Some(residual) = &capture.pair_residual_sigma {
        text.entry(
            "light check",
            &format!(
                "{:.2} x the camera's noise (ideal 1.00), worst {:.2}: {} bit {}",
                residual.median, residual.worst, residual.worst_pair.axis, residual.worst_pair.bit
            ),
        );
    }
    if let Some(drift) = capture.drift {
        text.entry("drift", &format!("{:+.2} % between the first and the last frames", 100.0 * drift));
    }
    if let Some(after) = report.timings_ms.after_last_frame {
        text.entry("computing", &format!("{after:.0} ms after the last frame"));
    }
}

/// A table, one region a line.
fn planes(text: &mut Text, report: &Report) {
    if report.planes.is_empty() {
        return;
    }
    let name_width = report.planes.iter().map(|plane| plane.name.chars().count()).max().unwrap_or(0);
    let name_width = name_width.clamp(4, 20);
    let heading = format!(
        "{:name_width$} {:>11} {:>8} {:>8} {:>8} {:>8}",
        "mm", "points", "measured", "rms", "95 %", "bow"
    );
    text.raw("flatness", &heading);
    for PlaneReport { name, points, coverage, rmse_mm, bow_mm, p95_mm, .. } in &report.planes {
        text.raw(
            "",
            &format!(
                "{name:name_width$} {:>11} {:>8} {:>8} {:>8} {:>8}",
                grouped(*points),
                percent(*coverage),
                millimetres(*rmse_mm),
                millimetres(*p95_mm),
                millimetres(*bow_mm),
            ),
        );
    }
}

fn accuracy(of: &Accuracy) -> String {
    let mut line =
        format!("{} measured, {} of {} wrong", percent(of.coverage), grouped(of.wrong), grouped(of.valid));
    if let Some(rms) = of.column_rms_px {
        let _ = write!(line, "; columns {rms:.3} px rms");
    }
    if let Some(rmse) = of.depth_rmse_mm {
        let _ = write!(line, ", depth {rmse:.2} mm rms");
    }
    line
}

fn percent(share: Option<f64>) -> String {
    // Rounding must not claim all of something that is not: 99.96 % is not 100.0 %.
    share.map_or("-".to_owned(), |share| {
        let percent = 100.0 * share;
        if share < 1.0 && percent >= 99.95 { "> 99.9 %".to_owned() } else { format!("{percent:.1} %") }
    })
}

fn millimetres(value: Option<f64>) -> String {
    value.map_or("-".to_owned(), |value| format!("{value:.3}"))
}

/// `1 920 000`.
fn grouped(number: u64) -> String {
    let digits = number.to_string();
    let mut text = String::with_capacity(digits.len() + digits.len() / 3);
    for (index, digit) in digits.chars().enumerate() {
        if index > 0 && (digits.len() - index).is_multiple_of(3) {
            text.push(' ');
        }
        text.push(digit);
    }
    text
}

/// Two columns: what, and words about it.
#[derive(Default)]
struct Text(String);

impl Text {
    /// An entry with its words wrapped.
    fn entry(&mut self, what: &str, words: &str) {
        let mut line = format!("{what:INDENT$}");
        let mut empty = true;
        for word in words.split(' ').filter(|word| !word.is_empty()) {
            if !empty && line.chars().count() + 1 + word.chars().count() > WIDTH {
                self.line(&line);
                line = " ".repeat(INDENT);
                empty = true;
            }
            if !empty {
                line.push(' ');
            }
            line.push_str(word);
            empty = false;
        }
        self.line(&line);
    }

    /// An entry as it is.
    fn raw(&mut self, what: &str, words: &str) {
        self.line(&format!("{what:INDENT$}{words}"));
    }

    fn line(&mut self, line: &str) {
        self.0.push_str(line.trim_end());
        self.0.push('\n');
    }
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::report::{CaptureSummary, Diagnosis, Reason, ReportInput, build, testing};

    fn report(simulated: bool, found: &[Reason]) -> Report {
        let decoded = testing::decoded(160, 120);
        let (truth, made) = (testing::truth(&decoded), testing::reconstruction(&decoded));
        let capture = CaptureSummary {
            seconds: 1.5,
            limit_seconds: 1.47,
            hold_frames: 2,
            timing_measured: true,
            ..CaptureSummary::default()
        };
        let regions = ["table top=10,10,40,30".parse().unwrap()];
        build(&ReportInput {
            reconstruction: Some(&made),
            truth: simulated.then_some(&truth),
            capture: Some(&capture),
            regions: &regions,
            simulated,
            found,
            ..testing::input(&decoded)
        })
    }

    #[test]
    fn a_sound_scan_is_told_in_a_few_lines() {
        let directory = Path::new("/data/scans/7");
        let text =
            summary(&report(false, &[]), Some(Outputs { directory, files: &["cloud.ply", "report.json"] }));
        let expected = "\
verdict       ok
scan          mode pse, 44 frames of 160 x 120 px
coverage      100.0 % of 19 200 pixels with projector light were measured
points        19 200
capture       1.50 s; 44 frames take 1.47 s at this hold
light check   1.00 x the camera's noise (ideal 1.00), worst 1.00: row bit 9
drift         +0.00 % between the first and the last frames
flatness      mm             points measured      rms     95 %      bow
              table top         936  100.0 %    0.000    0.000    0.000
results       /data/scans/7
              cloud.ply report.json
";
        assert_eq!(text, expected);
    }

    #[test]
    fn simulated_figures_are_marked_once_and_before_them() {
        let text = summary(&report(true, &[]), None);
        assert_eq!(text.matches("simulated").count(), 2, "{text}");
        assert!(text.find("simulated").unwrap() < text.find("coverage").unwrap());
        assert!(text.contains("truth         100.0 % measured, 0 of 18 096 wrong"), "{text}");
        assert!(!summary(&report(false, &[]), None).contains("simulated"));
    }

    #[test]
    fn reasons_come_first_and_wrapped() {
        let long =
            "in pair column bit 3 half of the pixels do not add up to the references: scan again, and again";
        let found = [Reason::failed(Diagnosis::StaleFrame, long, json!({}))];
        let text = summary(&report(false, &found), None);
        assert!(text.starts_with("verdict       FAILED"), "{text}");
        assert!(
            text.lines().nth(1).unwrap().starts_with("  failed      stale-frame: in pair column bit 3"),
            "{text}"
        );
        assert!(text.lines().nth(2).unwrap().starts_with("              "), "{text}");
        let joined = text.split_whitespace().collect::<Vec<_>>().join(" ");
        assert!(joined.contains(long), "{text}");
    }

    #[test]
    fn lines_are_narrow() {
        let words = "word ".repeat(100);
        let found = [Reason::degraded(Diagnosis::Motion, words, json!({}))];
        for line in summary(&report(true, &found), None).lines() {
            assert!(line.chars().count() <= WIDTH, "{line}");
            assert_eq!(line, line.trim_end());
        }
    }

    #[test]
    fn nothing_known_is_nothing_said() {
        let size = crate::report::Size { width: 4, height: 3 };
        let text = summary(&build(&ReportInput::new(polscan_patterns::Mode::Fast, size, 0)), None);
        assert!(
            text.contains("nothing was decoded") && !text.contains("coverage") && !text.contains("NaN"),
            "{text}"
        );
    }

    #[test]
    fn numbers_are_told_honestly() {
        assert_eq!(percent(Some(1.0)), "100.0 %");
        assert_eq!(percent(Some(0.99996)), "> 99.9 %");
        assert_eq!(percent(Some(0.9994)), "99.9 %");
        assert_eq!(percent(None), "-");
        assert_eq!(grouped(0), "0");
        assert_eq!(grouped(999), "999");
        assert_eq!(grouped(1_920_000), "1 920 000");
    }
}
