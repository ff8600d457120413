//! All reasons and notes of a report. The file is long because which reason silences which is told in one place.

use serde_json::{Value, json};

use super::{Diagnosis, Reason, Verdict, captured, dark, order, pairs, polarity, references, sensor};
use crate::{
    cloud::RowCheck,
    decode::{Class, Decoded},
    evidence::{Frames, settling},
    report::{
        CaptureSummary, PixelCounts, ReportInput,
        statistics::{self, share},
    },
};

/// Fewer lit pixels than this share of the image are none. Noise alone lights 0.00006 of it at a gate of 4 sigma.
const LIT: f64 = 0.001;
/// Image brightness, as a share of full scale, that says that there is light, if only not the projector's code.
const BRIGHT: f64 = 0.1;
/// Valid share of the lit pixels below which a result is poor, and below which there is none.
const POOR_COVERAGE: f64 = 0.25;
const NO_COVERAGE: f64 = 0.05;
/// Share of the lit pixels that may be lost to saturation: glints are small.
const SATURATED: f64 = 0.01;
/// Share of the lit pixels with one frame of a pair saturated, whose edges are biased.
const HALF_SATURATED: f64 = 0.05;
/// Above this share of exchanged polarity it is the rig that is exchanged, not a surface that depolarises.
const INVERTED: f64 = 0.5;
/// Below this share of the inverted pixels there is nothing to note.
const INVERTED_NOTE: f64 = 0.01;
/// Degree of polarization, weighed by brightness, that an analyser turned by 30 degrees or an extinction of 3:1 leaves:
/// then a half of the light carries no code.
const WEAK: f64 = 0.5;
/// The same as a share of that of the rig's extinction ratio, where it is known: an analyser turned by 12 degrees.
const TURNED: f64 = 0.91;
/// Share of the lit pixels with edges in illegal places: noise makes few, an order that is wrong makes most.
const OFF_BOUNDARY: f64 = 0.2;
/// Share of the measured pixels that the row gate may reject, and above which the calibration cannot be right.
const ROW_REJECTED: f64 = 0.1;
const ROW_WRONG: f64 = 0.5;
/// Offset of the rows as a share of their gate.
const ROW_OFFSET: f64 = 0.5;
/// All reasons why a scan is not `ok`, each diagnosis once.
pub fn diagnose(input: &ReportInput, pixels: Option<&PixelCounts>) -> Vec<Reason> {
    let mut reasons = input.capture.map(frames).unwrap_or_default();
    if let Some((decoded, pixels)) = input.decoded.zip(pixels) {
        match nothing_lit(input, decoded, pixels) {
            // All other evidence comes from lit pixels.
            Some(reason) => reasons.push(reason),
            None => reasons.extend(from_pixels(input, decoded, pixels)),
        }
    }
    // What the capture noticed of the light in single pairs, the whole scan names with more right.
    let whole = reasons.iter().any(|reason| OF_THE_LIGHT.contains(&reason.diagnosis));
    let superseded = |reason: &Reason| {
        whole && reason.severity != Verdict::Failed && OF_THE_LIGHT.contains(&reason.diagnosis)
    };
    // Last, so that of equals the one with the numbers of the whole scan is kept.
    reasons.extend(input.found.iter().filter(|reason| !superseded(reason)).cloned());
    let mut reasons = once_each(reasons);
    // The gravest first: it is what a person reads.
    reasons.sort_by_key(|reason| std::cmp::Reverse(reason.severity));
    reasons
}

/// Diagnoses that the pair sums of all frames tell apart better than those of one pair.
const OF_THE_LIGHT: [Diagnosis; 7] = [
    Diagnosis::Flicker,
    Diagnosis::ExposureDrift,
    Diagnosis::AmbientDrift,
    Diagnosis::UnsettledDisplay,
    Diagnosis::NonlinearResponse,
    Diagnosis::NoiseModel,
    Diagnosis::Saturated,
];

fn from_pixels(input: &ReportInput, decoded: &Decoded, pixels: &PixelCounts) -> Vec<Reason> {
    let look = input.settings.filter(|_| !input.planes.is_empty());
    let mut look = look.map(|settings| Frames::new(input.planes, settings, decoded));
    if let Some(frames) = &mut look {
        frames.adjusts = pairs::is_automatic(*frames);
        frames.rest = settling::rest_of_all(*frames);
    }
    // References that were exposed otherwise, or carry rests of others, are no other pictures.
    let disagree =
        look.filter(|frames| !frames.adjusts && frames.rest.is_none()).and_then(references::disagree);
    if let (Some(frames), true) = (&mut look, disagree.is_some()) {
        frames.last_references = false;
    }
    let mut reasons = pairs::diagnose(decoded, look);
    if let Some(disagree) = disagree {
        // A drift between references that show different pictures is none.
        let repeated = look.is_some_and(references::is_repeated);
        reasons.retain(|reason| match reason.diagnosis {
            Diagnosis::ExposureDrift | Diagnosis::AmbientDrift => false,
            Diagnosis::Motion => !repeated,
            _ => true,
        });
        // Behind a lost frame the references are out of place as well.
        if !reasons.iter().any(|reason| reason.diagnosis == Diagnosis::LostFrame) {
            reasons.push(disagree);
        }
    }
    let names = [
        Diagnosis::StaleFrame,
        Diagnosis::LostFrame,
        Diagnosis::TornFrame,
        Diagnosis::SwappedFrames,
        Diagnosis::PolarizationInverted,
    ];
    let is_wrong = |reason: &Reason| reason.severity == Verdict::Failed && names.contains(&reason.diagnosis);
    reasons.extend(look.and_then(polarity::reference_exchanged));
    // A wrong frame puts edges in wrong places, too: that would be said twice.
    let wrong = reasons.iter().any(is_wrong);
    if !wrong || !reasons.iter().any(|reason| reason.diagnosis == Diagnosis::PolarizationInverted) {
        let found = wrong_order(input, decoded, pixels, !wrong);
        let changed = [Diagnosis::Motion, Diagnosis::AmbientDrift];
        let moved = reasons.iter_mut().find(|reason| changed.contains(&reason.diagnosis));
        match (found, moved) {
            // Pairs that were exchanged add up all the same: where something moved, or a light was switched on between the
            // frames of a pair, it is that which put edges, or words, where they cannot be.
            (Some(found), Some(moved)) => {
                moved.severity = Verdict::Failed;
                moved.evidence["order"] = found.evidence;
            }
            (found, _) => reasons.extend(found),
        }
    }
    reasons.extend(saturated(decoded, pixels));
    reasons.extend(polarization(input, decoded, pixels));
    reasons.extend(input.reconstruction.and_then(|made| made.row_check).and_then(row_mismatch));
    // Beside saturated pixels others fail, too, without being dead.
    let glares = reasons.iter().any(|reason| reason.diagnosis == Diagnosis::Saturated);
    let defect = sensor::defect(decoded, pixels);
    reasons.extend(defect.filter(|reason| !glares || has_lines(reason)));
    reasons.extend(low_coverage(pixels).or_else(|| dark::too_dark(look?, pixels)));
    if reasons.iter().any(is_wrong) {
        // What comes of words that are wrong says nothing of light, sensor or surface.
        let follows = [
            Diagnosis::Flicker,
            Diagnosis::UnsettledDisplay,
            Diagnosis::NonlinearResponse,
            Diagnosis::PolarizationWeak,
            Diagnosis::SensorDefect,
            Diagnosis::LowCoverage,
            Diagnosis::RowMismatch,
        ];
        reasons.retain(|reason| {
            let inverted = reason.diagnosis == Diagnosis::PolarizationInverted;
            !(follows.contains(&reason.diagnosis) || inverted && reason.severity != Verdict::Failed)
        });
    }
    reasons
}

/// Whether a defect of the sensor is one of whole lines.
fn has_lines(reason: &Reason) -> bool {
    ["columns", "rows"]
        .iter()
        .any(|key| reason.evidence[key].as_array().is_some_and(|lines| !lines.is_empty()))
}

/// Of several reasons with the same diagnosis keeps the gravest, of equals the first, with what the others say beside
/// it under `also`.
fn once_each(reasons: Vec<Reason>) -> Vec<Reason> {
    let mut kept: Vec<Reason> = Vec::new();
    for mut reason in reasons {
        let Some(other) = kept.iter_mut().find(|other| other.diagnosis == reason.diagnosis) else {
            kept.push(reason);
            continue;
        };
        if reason.severity > other.severity {
            std::mem::swap(other, &mut reason);
        }
        let mut also = match reason.evidence.as_object_mut().and_then(|evidence| evidence.remove("also")) {
            Some(Value::Array(also)) => also,
            _ => Vec::new(),
        };
        also.insert(0, json!({ "message": reason.message, "evidence": reason.evidence }));
        if !other.evidence.is_object() {
            other.evidence = json!({});
        }
        match other.evidence.get_mut("also").and_then(Value::as_array_mut) {
            Some(list) => list.extend(also),
            None => other.evidence["also"] = Value::Array(also),
        }
        if let Some(list) = other.evidence["also"].as_array_mut() {
            list.truncate(MOST_ALSO);
        }
    }
    kept
}

/// So many reasons of one kind are written out besides the first.
const MOST_ALSO: usize = 8;

/// What receipts and counters of the capture say against it.
fn frames(capture: &CaptureSummary) -> Vec<Reason> {
    let mut reasons = Vec::new();
    if let Some(role) = capture.early.first() {
        reasons.push(Reason::failed(
            Diagnosis::StaleFrame,
            format!(
                "the exposure of {} ({role} first) began before the picture was on the glass; it shows the picture \
                 before: run `polscan calibrate sync`, and scan again",
                plural(capture.early.len() as u64, "frame"),
            ),
            json!({ "frames": capture.early.iter().map(ToString::to_string).collect::<Vec<_>>() }),
        ));
    }
    if let Some([one, other]) = capture.shared_slide.first() {
        reasons.push(Reason::failed(
            Diagnosis::SwappedFrames,
            format!(
                "by their receipts, frames {one} and {other} were taken of the same picture: scan again; if it comes \
                 back, check the projector with `polscan doctor`"
            ),
            json!({ "frames": capture.shared_slide.iter().map(|[a, b]| [a.to_string(), b.to_string()]).collect::<Vec<_>>() }),
        ));
    }
    // A lost frame that was noticed and taken again has cost time, nothing else: each asks for one take.
    let pairs = capture.retaken.iter().map(|retake| &retake.reason);
    let references = capture.references_retaken.iter().map(|retake| &retake.reason);
    let noticed =
        pairs.chain(references).filter(|reason| captured::diagnosis(reason) == Diagnosis::LostFrame);
    let retaken = noticed.count() as u64;
    let lost = capture.lost_frames();
    if lost > retaken {
        reasons.push(Reason::degraded(
            Diagnosis::LostFrame,
            format!(
                "the camera was triggered {} times and delivered {}; frames were lost on the way: check the cable, plug \
                 the camera into a port of its own, and raise the memory for USB transfers",
                capture.statistics.triggers,
                plural(capture.statistics.frames, "whole frame"),
            ),
            json!({ "lost": lost, "retaken": retaken, "triggers": capture.statistics.triggers, "frames": capture.statistics.frames,
                    "failed": capture.statistics.failed }),
        ));
    }
    reasons
}

fn nothing_lit(input: &ReportInput, decoded: &Decoded, pixels: &PixelCounts) -> Option<Reason> {
    if pixels.lit as f64 > LIT * pixels.total as f64 {
        return None;
    }
    let brightness = decoded.intensity.data().iter().map(|&value| f64::from(value) / 255.0).sum::<f64>()
        / pixels.total.max(1) as f64;
    let cause = match (brightness >= BRIGHT, input.mode.is_polarized()) {
        (true, true) => {
            "there is light, but H and V look the same: the polarizer in front of the camera is missing or turned by 45 \
             degrees, or only the room's light is seen; turn the polarizer, and shade the scene"
        }
        (true, false) => {
            "there is light, but bright and dark patterns look the same: the projector's picture does not reach the \
             scene; check with `polscan show white`"
        }
        (false, _) => {
            "the frames are dark: the projector is off or its shutter closed, the lens cap is on, or the exposure is too \
             short; check with `polscan show white`"
        }
    };
    Some(Reason::failed(
        Diagnosis::NothingLit,
        format!("{} of {} saw projector light; {cause}", pixels.lit, plural(pixels.total, "pixel")),
        json!({ "lit": pixels.lit, "total": pixels.total, "mean_brightness": brightness }),
    ))
}

fn wrong_order(
    input: &ReportInput,
    decoded: &Decoded,
    pixels: &PixelCounts,
    by_edges: bool,
) -> Option<Reason> {
    if let Some(found) = order::mirrored(decoded, input.settings) {
        let pair = match found.pair {
            Some((axis, bit)) => format!("most likely the two frames of pair {axis} bit {bit} are exchanged"),
            None => "most likely the two frames of a pair are exchanged".to_owned(),
        };
        let message = format!(
            "on {:.0} % of the image the projector's picture is mirrored, which no surface does; {pair}, or the projector \
             is set to rear projection: check the order of the frames and the projector's menu, and scan again",
            100.0 * found.share,
        );
        let evidence = json!({
            "mirrored_share": found.share, "places": found.places,
            "axis": found.pair.map(|pair| pair.0), "bit": found.pair.map(|pair| pair.1),
        });
        return Some(Reason::failed(Diagnosis::SwappedFrames, message, evidence));
    }
    if let Some((axis, bit)) = order::reversed(decoded, input.settings, pixels) {
        return Some(Reason::failed(
            Diagnosis::SwappedFrames,
            format!(
                "the words of the image run backwards or jump, and would not if the two frames of pair {axis} bit {bit} were \
                 exchanged; they are, or the projector is set to rear projection: check the order of the frames and the \
                 projector's menu, and scan again"
            ),
            json!({ "axis": axis, "bit": bit, "out_of_volume": pixels.out_of_volume, "valid": pixels.valid }),
        ));
    }
    if !by_edges {
        return None;
    }
    let suspect: Vec<_> = decoded.boundaries.iter().filter(|check| check.is_suspect()).collect();
    let off = share(pixels.off_boundary, pixels.lit).unwrap_or(0.0);
    let seen = match suspect.first() {
        Some(check) => format!(
            "{} of {} stripe edges of pair {} bit {} lie where its pattern has none",
            check.illegal,
            check.illegal + check.legal,
            check.axis,
            check.bit,
        ),
        None if off > OFF_BOUNDARY => {
            format!("on {:.0} % of the lit pixels stripe edges lie where their pattern has none", 100.0 * off)
        }
        None => return None,
    };
    let evidence = json!({
        "off_boundary": off,
        "pairs": suspect.iter().map(|check| json!({
            "axis": check.axis, "bit": check.bit, "legal": check.legal, "illegal": check.illegal,
        })).collect::<Vec<_>>(),
    });
    Some(Reason::failed(
        Diagnosis::SwappedFrames,
        format!(
            "{seen}; frames are in another order than their names say, or belong to another code: check sequence, code \
             offset and code bits"
        ),
        evidence,
    ))
}

fn polarization(input: &ReportInput, decoded: &Decoded, pixels: &PixelCounts) -> Vec<Reason> {
    let mut reasons = Vec::new();
    if let Some(inverted) = share(pixels.inverted, pixels.lit).filter(|&inverted| inverted > INVERTED) {
        let evidence = json!({ "inverted": inverted });
        let percent = 100.0 * inverted;
        reasons.push(match input.mode.is_polarized() {
            true => Reason::degraded(
                Diagnosis::PolarizationInverted,
                format!(
                    "on {percent:.0} % of the lit pixels V is brighter than H; H and V are exchanged: turn the polarizer \
                     in front of the camera by 90 degrees, or exchange the projector's channels in the configuration; \
                     or all that is seen scatters light and absorbs the colour of H, as red paint does"
                ),
                evidence,
            ),
            false => Reason::degraded(
                Diagnosis::SwappedFrames,
                format!(
                    "on {percent:.0} % of the lit pixels black is brighter than white; the two references, or all frames \
                     and their inverses, are exchanged: check the sequence"
                ),
                evidence,
            ),
        });
    }
    if input.mode.is_polarized()
        && let Some(degree) = degree_of_polarization(decoded)
        && degree < input.extinction_ratio.map_or(WEAK, |ratio| TURNED * degree_of(ratio))
    {
        let usual = input.extinction_ratio.map_or(1.0, degree_of);
        reasons.push(Reason::degraded(
            Diagnosis::PolarizationWeak,
            format!(
                "the light of the lit pixels is polarized by {:.0} % only; the polarizer in front of the camera is \
                 turned by up to {:.0} degrees, the surface scatters (paper, matte paint), or the room is bright: turn \
                 the polarizer until `polscan show v` is darkest, and shade the scene",
                100.0 * degree,
                // H and V pass as cos^2 and sin^2 of the angle, so their contrast is the cosine of twice the angle.
                0.5 * (degree / usual).clamp(0.0, 1.0).acos().to_degrees(),
            ),
            json!({ "degree_of_polarization": degree, "extinction_ratio": input.extinction_ratio }),
        ));
    }
    reasons
}

/// Degree of polarization of light whose two parts have this ratio.
fn degree_of(extinction_ratio: f64) -> f64 {
    (extinction_ratio - 1.0) / (extinction_ratio + 1.0)
}

/// Mean over the lit, unsaturated pixels of the usual polarity, weighed by brightness: dark pixels say little.
pub fn degree_of_polarization(decoded: &Decoded) -> Option<f64> {
    let (mut sum, mut weight) = (0.0, 0.0);
    for (index, class) in decoded.class.data().iter().enumerate() {
        let degree = f64::from(decoded.dolp.data()[index]);
        let clipped = *class == Class::Saturated || decoded.half_saturated.data()[index];
        if !class.is_lit() || clipped || *class == Class::Inverted || !degree.is_finite() {
            continue;
        }
        let brightness = f64::from(decoded.intensity.data()[index]);
        sum += brightness * degree;
        weight += brightness;
    }
    statistics::finite(sum / weight)
}

fn saturated(decoded: &Decoded, pixels: &PixelCounts) -> Option<Reason> {
    let lit_half = decoded.class.data().iter().zip(decoded.half_saturated.data());
    let half = lit_half.filter(|(class, half)| class.is_lit() && **half).count() as u64;
    let (both, half) = (share(pixels.saturated, pixels.lit)?, share(half, pixels.lit)?);
    if both <= SATURATED && half <= HALF_SATURATED {
        return None;
    }
    Some(Reason::degraded(
        Diagnosis::Saturated,
        format!(
            "{:.1} % of the lit pixels are too bright to be measured, {:.1} % too bright in one frame of a pair; the \
             camera's range is exceeded there: shorten the exposure, or turn the object so that it does not mirror the \
             projector",
            100.0 * both,
            100.0 * half,
        ),
        json!({ "saturated": both, "half_saturated": half }),
    ))
}

fn row_mismatch(check: RowCheck) -> Option<Reason> {
    let offset = check.median_px.abs() > ROW_OFFSET * check.gate_px;
    if !offset && check.rejected_share <= ROW_REJECTED {
        return None;
    }
    let message = format!(
        "measured rows differ from those that the calibration predicts by {:+.2} px (spread {:.2} px), and {:.0} % of the \
         pixels were rejected for it; camera or projector moved, zoomed or refocused since it was made, or it belongs to \
         another rig or resolution: calibrate again with `polscan calibrate rig`",
        check.median_px,
        check.sigma_px,
        100.0 * check.rejected_share,
    );
    let evidence = json!({
        "median_px": check.median_px, "sigma_px": check.sigma_px, "gate_px": check.gate_px,
        "rejected_share": check.rejected_share,
    });
    Some(match check.rejected_share > ROW_WRONG {
        true => Reason::failed(Diagnosis::RowMismatch, message, evidence),
        false => Reason::degraded(Diagnosis::RowMismatch, message, evidence),
    })
}

fn low_coverage(pixels: &PixelCounts) -> Option<Reason> {
    let coverage = share(pixels.valid, pixels.lit).filter(|&coverage| coverage < POOR_COVERAGE)?;
    let causes = [
        (
            pixels.ambiguous,
            "ambiguous",
            "the fine stripes are blurred or the light is weak: focus the projector, or expose longer",
        ),
        (pixels.saturated, "saturated", "there is too much light: shorten the exposure"),
        (
            pixels.off_boundary,
            "off_boundary",
            "stripe edges lie in the wrong places: check the order of the frames",
        ),
        (
            pixels.out_of_projector,
            "out_of_projector",
            "words do not belong to this projector: check its size, the code offset and the code bits",
        ),
        (
            pixels.out_of_volume,
            "out_of_volume",
            "depths lie outside the working volume: check `near_mm` and `far_mm`, and the calibration",
        ),
        (pixels.rejected_by_row, "rejected_by_row", "rows disagree with the calibration: calibrate again"),
        (
            pixels.rejected_by_vote,
            "rejected_by_vote",
            "neighbouring pixels disagree: the image is noisy or something moved",
        ),
        (
            pixels.interreflection,
            "interreflection",
            "light comes by way of other surfaces: cover shiny things beside the object",
        ),
    ];
    let (lost, name, cause) = causes.into_iter().max_by_key(|(count, ..)| *count)?;
    let message = format!(
        "only {:.1} % of the lit pixels gave a measurement; most of the others ({:.0} % of the lit ones) fail because {cause}",
        100.0 * coverage,
        100.0 * lost as f64 / pixels.lit as f64,
    );
    let evidence = json!({ "coverage": coverage, "mostly": name, "pixels": lost });
    Some(match coverage < NO_COVERAGE {
        true => Reason::failed(Diagnosis::LowCoverage, message, evidence),
        false => Reason::degraded(Diagnosis::LowCoverage, message, evidence),
    })
}

/// What is worth knowing and no reason to doubt the result.
pub fn notes(input: &ReportInput, pixels: Option<&PixelCounts>) -> Vec<String> {
    let mut notes = Vec::new();
    if input.simulated {
        notes.push("all figures come from the simulated rig, none from a real one".to_owned());
    }
    let Some((decoded, pixels)) = input.decoded.zip(pixels) else {
        notes.push("nothing was decoded".to_owned());
        return notes;
    };
    notes.extend(decoded.losses.iter().map(|loss| format!("lost by missing frames: {loss}")));
    if decoded.noise_estimated {
        notes.push(
            "the camera's noise was estimated from these frames; `polscan calibrate noise` measures it"
                .to_owned(),
        );
    }
    if input.reconstruction.is_none() {
        notes.push("no calibration, so no depth and no points".to_owned());
    } else if decoded.row.is_none() {
        notes.push("rows were not coded: `row` holds what column and calibration predict".to_owned());
    }
    if let Some(capture) = input.capture {
        if !capture.timing_measured {
            notes.push(
                format!(
                    "the projector's timing was assumed, with a margin{}; `polscan calibrate sync` measures it and may \
                     make scans faster",
                    capture.synchrony.as_ref().map_or(String::new(), |assumed| format!(
                        ": light {:.1} ms after a flip, settled {:.1} ms later",
                        assumed.projector_latency_ms, assumed.projector_settling_ms
                    ))
                ),
            );
        }
        if !capture.retaken.is_empty() {
            notes.push(format!(
                "{} captured again, then sound ({})",
                plural(capture.retaken.len() as u64, "pair"),
                why(capture.retaken.iter().map(|retake| retake.reason.as_str())),
            ));
        }
        if !capture.references_retaken.is_empty() {
            notes.push(format!(
                "{} captured again ({})",
                plural(capture.references_retaken.len() as u64, "reference"),
                why(capture.references_retaken.iter().map(|retake| retake.reason.as_str())),
            ));
        }
        if !capture.discarded.is_empty() {
            notes.push(format!(
                "{} arrived that was not awaited, and was dropped ({})",
                plural(capture.discarded.len() as u64, "frame"),
                why(capture.discarded.iter().map(|found| found.reason.as_str())),
            ));
        }
    }
    let inverted = share(pixels.inverted, pixels.lit).unwrap_or(0.0);
    if input.mode.is_polarized() && inverted > INVERTED_NOTE && inverted <= INVERTED {
        notes.push(format!(
            "{:.0} % of the lit pixels lie on surfaces that scatter polarized light; they were decoded with H and V \
             exchanged",
            100.0 * inverted
        ));
    }
    notes
}

/// Each reason once, with how often it came.
fn why<'a>(reasons: impl Iterator<Item = &'a str>) -> String {
    let mut counts = std::collections::BTreeMap::<&str, u32>::new();
    reasons.for_each(|reason| *counts.entry(reason).or_default() += 1);
    let named: Vec<String> = counts
        .into_iter()
        .map(|(reason, count)| if count == 1 { reason.to_owned() } else { format!("{count} x {reason}") })
        .collect();
    named.join(", ")
}

/// `1 frame`, `3 frames`.
pub(super) fn plural(count: u64, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}

#[cfg(test)]
mod tests {
    use polscan_drivers::camera::StreamStatistics;
    use polscan_patterns::{Axis, Mode, Role};

    use super::*;
    use crate::{
        decode::BoundaryCheck,
        report::{Report, Size, Verdict, build, testing},
        sequencer::Retake,
    };

    /// Report of a sound decode, spoilt.
    fn report(spoil: impl FnOnce(&mut Decoded)) -> Report {
        report_with(spoil, |_| {})
    }

    fn report_with(spoil: impl FnOnce(&mut Decoded), change: impl FnOnce(&mut ReportInput)) -> Report {
        let mut decoded = testing::decoded(160, 120);
        let settings = testing::settings(160, 120);
        spoil(&mut decoded);
        let mut input = ReportInput { settings: Some(&settings), ..testing::input(&decoded) };
        change(&mut input);
        build(&input)
    }

    fn kinds(report: &Report) -> Vec<(Diagnosis, Verdict)> {
        for reason in &report.reasons {
            assert!(reason.message.len() > 60 && reason.evidence.is_object(), "{reason:?}");
        }
        report.reasons.iter().map(|reason| (reason.diagnosis, reason.severity)).collect()
    }

    fn classify(decoded: &mut Decoded, class: Class, which: impl Fn(usize, usize) -> bool) {
        let width = decoded.class.width();
        for (index, value) in decoded.class.data_mut().iter_mut().enumerate() {
            if which(index % width, index / width) {
                *value = class;
            }
        }
    }

    const DEGRADED: Verdict = Verdict::Degraded;
    const FAILED: Verdict = Verdict::Failed;

    #[test]
    fn a_sound_scan_has_no_reasons_and_only_true_notes() {
        let report = report(|_| {});
        assert_eq!((report.verdict, kinds(&report)), (Verdict::Ok, vec![]));
        assert_eq!(report.notes, ["no calibration, so no depth and no points"]);
    }

    #[test]
    fn no_light_is_told_by_what_there_is() {
        let dark = |decoded: &mut Decoded| {
            classify(decoded, Class::Unlit, |x, y| (x, y) != (3, 3));
            decoded.intensity.data_mut().fill(2);
            // Whatever else was seen was seen on nothing.
            decoded.pairs[2].flat_outliers = 0.9;
        };
        let bright = |decoded: &mut Decoded| {
            classify(decoded, Class::Unlit, |_, _| true);
        };
        let dark = report(dark);
        assert_eq!(kinds(&dark), [(Diagnosis::NothingLit, FAILED)]);
        assert!(dark.reasons[0].message.contains("dark"), "{}", dark.reasons[0].message);
        let turned = report(bright);
        assert_eq!(kinds(&turned), [(Diagnosis::NothingLit, FAILED)]);
        assert!(turned.reasons[0].message.contains("polarizer"), "{}", turned.reasons[0].message);
        let plain = report_with(bright, |input| input.mode = Mode::Gray);
        assert!(!plain.reasons[0].message.contains("polarizer"), "{}", plain.reasons[0].message);
        // A small object in a dark room is an object.
        let small = report(|decoded| classify(decoded, Class::Unlit, |x, y| x >= 10 || y >= 10));
        assert_eq!(kinds(&small), []);
    }

    #[test]
    fn exchanged_channels_are_told_apart_from_surfaces_that_scatter() {
        let invert = |columns: usize| {
            move |decoded: &mut Decoded| {
                classify(decoded, Class::Inverted, |x, _| x < columns);
                for y in 0..120 {
                    decoded.dolp.data_mut()[y * 160..][..columns].fill(0.0);
                }
            }
        };
        assert_eq!(kinds(&report(invert(160))), [(Diagnosis::PolarizationInverted, DEGRADED)]);
        let paper = report(invert(30));
        assert_eq!(kinds(&paper), []);
        assert!(paper.notes.iter().any(|note| note.contains("19 %")), "{:?}", paper.notes);
        let gray = report_with(invert(160), |input| input.mode = Mode::Gray);
        assert_eq!(kinds(&gray), [(Diagnosis::SwappedFrames, DEGRADED)]);
    }

    #[test]
    fn an_analyser_turned_by_thirty_degrees_is_weak_and_by_twenty_is_not() {
        let turned = |degrees: f32| {
            move |decoded: &mut Decoded| {
                decoded.dolp.data_mut().fill(0.96 * (2.0 * degrees.to_radians()).cos());
            }
        };
        let report_30 = report(turned(30.0));
        assert_eq!(kinds(&report_30), [(Diagnosis::PolarizationWeak, DEGRADED)]);
        assert!(report_30.reasons[0].message.contains("31 degrees"), "{}", report_30.reasons[0].message);
        assert_eq!(kinds(&report(turned(20.0))), []);
        assert_eq!(kinds(&report_with(turned(30.0), |input| input.mode = Mode::Gray)), []);
        // A dark half of the scene, where the room's light counts, says nothing of the polarizer.
        let dark = report(|decoded| {
            for y in 0..120 {
                decoded.dolp.data_mut()[y * 160..][..110].fill(0.1);
                decoded.intensity.data_mut()[y * 160..][..110].fill(3);
            }
        });
        assert_eq!(kinds(&dark), []);
    }

    #[test]
    fn glints_are_not_saturation_and_a_mirror_is() {
        let glare = |columns: usize| {
            move |decoded: &mut Decoded| {
                classify(decoded, Class::Saturated, |x, _| x < columns);
            }
        };
        assert_eq!(kinds(&report(glare(1))), []);
        assert_eq!(kinds(&report(glare(3))), [(Diagnosis::Saturated, DEGRADED)]);
        let half = |count: usize| {
            move |decoded: &mut Decoded| {
                decoded.half_saturated.data_mut()[..count].fill(true);
            }
        };
        assert_eq!(kinds(&report(half(160 * 5))), []);
        assert_eq!(kinds(&report(half(160 * 7))), [(Diagnosis::Saturated, DEGRADED)]);
    }

    #[test]
    fn rows_that_disagree_speak_against_the_calibration() {
        let judged = |median_px: f64, rejected_share: f64| {
            let decoded = testing::decoded(160, 120);
            let mut made = testing::reconstruction(&decoded);
            let check = made.row_check.as_mut().unwrap();
            (check.median_px, check.rejected_share) = (median_px, rejected_share);
            kinds(&build(&ReportInput { reconstruction: Some(&made), ..testing::input(&decoded) }))
        };
        assert_eq!(judged(0.3, 0.02), []);
        assert_eq!(judged(-0.8, 0.02), [(Diagnosis::RowMismatch, DEGRADED)]);
        assert_eq!(judged(0.1, 0.2), [(Diagnosis::RowMismatch, DEGRADED)]);
        assert_eq!(judged(2.0, 0.6), [(Diagnosis::RowMismatch, FAILED)]);
    }

    #[test]
    fn frames_in_another_order_mirror_the_picture_or_put_edges_in_the_wrong_places() {
        let mirrored = report(|decoded| {
            for value in decoded.column.code.data_mut() {
                *value = 127 - *value;
            }
        });
        assert_eq!(kinds(&mirrored), [(Diagnosis::SwappedFrames, FAILED)]);
        assert!(mirrored.reasons[0].message.contains("column bit 0"), "{}", mirrored.reasons[0].message);
        let displaced = |columns: usize| {
            kinds(&report(|decoded| classify(decoded, Class::OffBoundary, |x, _| x < columns)))
        };
        assert_eq!(displaced(60), [(Diagnosis::SwappedFrames, FAILED)]);
        assert_eq!(displaced(20), []);
        let crossings = |illegal: u64| {
            report(move |decoded| {
                decoded.boundaries =
                    vec![BoundaryCheck { axis: Axis::Row, bit: 3, legal: 900, illegal, against: 0 }];
            })
        };
        assert_eq!(kinds(&crossings(30)), []);
        assert_eq!(kinds(&crossings(2700)), [(Diagnosis::SwappedFrames, FAILED)]);
        let message = &crossings(2700).reasons[0].message;
        assert!(message.contains("2700 of 3600") && message.contains("row bit 3"), "{message}");
    }

    #[test]
    fn dead_pixels_and_lines_are_a_defect_of_the_sensor() {
        let specks = |count: usize| {
            report(move |decoded| {
                classify(decoded, Class::Unlit, |x, y| x % 10 == 5 && y == 30 && x / 10 < count)
            })
        };
        assert_eq!(kinds(&specks(5)), []);
        assert_eq!(kinds(&specks(12)), [(Diagnosis::SensorDefect, DEGRADED)]);
        let column = report(|decoded| classify(decoded, Class::Unlit, |x, _| x == 77));
        assert_eq!(kinds(&column), [(Diagnosis::SensorDefect, DEGRADED)]);
        assert_eq!(column.reasons[0].evidence["columns"], json!([77]));
        let row = report(|decoded| classify(decoded, Class::Unlit, |_, y| y == 11));
        assert_eq!(row.reasons[0].evidence["rows"], json!([11]));
        let stripe = report(|decoded| classify(decoded, Class::Ambiguous, |x, _| x == 77));
        assert_eq!(kinds(&stripe), []);
        // A wide gap is a hole or a shadow.
        let gap = report(|decoded| classify(decoded, Class::Unlit, |x, _| (70..73).contains(&x)));
        assert_eq!(kinds(&gap), []);
    }

    #[test]
    fn low_coverage_names_what_most_pixels_failed_for() {
        let covered = |columns: usize| {
            report(move |decoded| {
                classify(decoded, Class::Ambiguous, |x, _| x >= columns);
                classify(decoded, Class::OutOfVolume, |x, _| x >= columns + 20);
            })
        };
        assert_eq!(kinds(&covered(60)), []);
        let poor = covered(30);
        assert_eq!(kinds(&poor), [(Diagnosis::LowCoverage, DEGRADED)]);
        assert_eq!(poor.reasons[0].evidence["mostly"], "out_of_volume");
        assert_eq!(kinds(&covered(5)), [(Diagnosis::LowCoverage, FAILED)]);
        assert_eq!(covered(5).verdict, FAILED);
    }

    fn captured(change: impl FnOnce(&mut CaptureSummary)) -> Report {
        let decoded = testing::decoded(40, 30);
        let mut capture = CaptureSummary {
            timing_measured: true,
            statistics: StreamStatistics { triggers: 44, frames: 44, ..StreamStatistics::default() },
            ..CaptureSummary::default()
        };
        change(&mut capture);
        build(&ReportInput { capture: Some(&capture), ..testing::input(&decoded) })
    }

    #[test]
    fn receipts_and_counters_speak() {
        assert_eq!(kinds(&captured(|_| {})), []);
        let role = Role::Code { axis: Axis::Row, bit: 2, inverse: true };
        let early = captured(|capture| capture.early.push(role));
        assert_eq!(kinds(&early), [(Diagnosis::StaleFrame, FAILED)]);
        assert!(early.reasons[0].message.contains("row bit 2 inverse"));
        let shared = captured(|capture| capture.shared_slide.push([role, Role::White]));
        assert_eq!(kinds(&shared), [(Diagnosis::SwappedFrames, FAILED)]);
        let lost = |capture: &mut CaptureSummary| capture.statistics.frames = 43;
        assert_eq!(kinds(&captured(lost)), [(Diagnosis::LostFrame, DEGRADED)]);
        let retake = Retake {
            axis: Axis::Row,
            bit: 2,
            reason: "lost-frame".into(),
            evidence: String::new(),
            attempt: 1,
        };
        let recovered = captured(|capture| {
            lost(capture);
            capture.retaken.push(retake);
        });
        assert_eq!(kinds(&recovered), []);
        assert!(
            recovered.notes.iter().any(|note| note.contains("1 pair captured again")),
            "{:?}",
            recovered.notes
        );
    }

    #[test]
    fn each_diagnosis_comes_once_and_as_grave_as_it_was_found() {
        let reason =
            |severity| Reason { severity, ..Reason::degraded(Diagnosis::Motion, "moved", json!({})) };
        let found = [reason(DEGRADED), reason(FAILED), reason(DEGRADED)];
        let input =
            ReportInput { found: &found, ..ReportInput::new(Mode::Pse, Size { width: 1, height: 1 }, 0) };
        let [kept] = &diagnose(&input, None)[..] else { panic!("one reason") };
        assert_eq!(
            (kept.diagnosis, kept.severity, kept.message.as_str()),
            (Diagnosis::Motion, FAILED, "moved")
        );
        // What the others say is kept beside it.
        assert_eq!(kept.evidence["also"].as_array().map(Vec::len), Some(2));
    }

    #[test]
    fn notes_say_what_was_estimated_assumed_and_lost() {
        let noted = report_with(
            |decoded| {
                decoded.noise_estimated = true;
                decoded.losses.push("no inverse frames".into());
            },
            |input| input.simulated = true,
        );
        let all = noted.notes.join("\n");
        for part in ["estimated", "no inverse frames", "simulated"] {
            assert!(all.contains(part), "{all}");
        }
        assert!(
            captured(|capture| capture.timing_measured = false)
                .notes
                .iter()
                .any(|note| note.contains("timing"))
        );
        let nothing = build(&ReportInput::new(Mode::Pse, Size { width: 1, height: 1 }, 0));
        assert_eq!(nothing.notes, ["nothing was decoded"]);
    }
}
