//! All reasons and notes of a report.

use serde_json::json;

use super::{Diagnosis, Reason, order, pairs};
use crate::{
    cloud::RowCheck,
    decode::{Class, Decoded},
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
/// Share of the lit pixels with edges in illegal places: noise makes few, an order that is wrong makes most.
const OFF_BOUNDARY: f64 = 0.2;
/// Share of the measured pixels that the row gate may reject, and above which the calibration cannot be right.
const ROW_REJECTED: f64 = 0.1;
const ROW_WRONG: f64 = 0.5;
/// Offset of the rows as a share of their gate.
const ROW_OFFSET: f64 = 0.5;
/// Dead pixels among the valid ones: sensors as sold have fewer.
const DEAD: f64 = 1e-4;
const LEAST_DEAD: u64 = 10;
/// A line of the sensor counts where it crosses this many pixels with valid neighbours, and is dead where it fails on
/// most of them.
const LINE_PIXELS: u32 = 50;
const LINE_DEAD: f64 = 0.9;

/// All reasons why a scan is not `ok`, each diagnosis once.
pub fn diagnose(input: &ReportInput, pixels: Option<&PixelCounts>) -> Vec<Reason> {
    let mut reasons = input.found.to_vec();
    reasons.extend(input.capture.map(frames).unwrap_or_default());
    if let Some((decoded, pixels)) = input.decoded.zip(pixels) {
        match nothing_lit(input, decoded, pixels) {
            // All other evidence comes from lit pixels.
            Some(reason) => reasons.push(reason),
            None => {
                reasons.extend(pairs::diagnose(decoded, input.modulation_drift));
                reasons.extend(wrong_order(input, decoded, pixels));
                reasons.extend(polarization(input, decoded, pixels));
                reasons.extend(saturated(decoded, pixels));
                reasons.extend(input.reconstruction.and_then(|made| made.row_check).and_then(row_mismatch));
                reasons.extend(sensor_defect(decoded, pixels));
                reasons.extend(low_coverage(pixels));
            }
        }
    }
    once_each(reasons)
}

/// Of several reasons with the same diagnosis keeps the gravest, of equals the first.
fn once_each(reasons: Vec<Reason>) -> Vec<Reason> {
    let mut kept: Vec<Reason> = Vec::new();
    for reason in reasons {
        match kept.iter_mut().find(|other| other.diagnosis == reason.diagnosis) {
            Some(other) if reason.severity > other.severity => *other = reason,
            Some(_) => {}
            None => kept.push(reason),
        }
    }
    kept
}

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
    // A lost frame that was noticed and taken again has cost time, nothing else.
    let retaken =
        capture.retaken.iter().filter(|retake| retake.reason == Diagnosis::LostFrame.slug()).count();
    let lost = capture.lost_frames();
    if lost > 2 * retaken as u64 {
        reasons.push(Reason::degraded(
            Diagnosis::LostFrame,
            format!(
                "the camera was triggered {} times and delivered {}; frames were lost on the way: check the cable, plug \
                 the camera into a port of its own, and raise the memory for USB transfers",
                capture.statistics.triggers,
                plural(capture.statistics.frames, "whole frame"),
            ),
            json!({ "lost": lost, "triggers": capture.statistics.triggers, "frames": capture.statistics.frames,
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

fn wrong_order(input: &ReportInput, decoded: &Decoded, pixels: &PixelCounts) -> Option<Reason> {
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
    let off = share(pixels.off_boundary, pixels.lit).filter(|&off| off > OFF_BOUNDARY)?;
    Some(Reason::failed(
        Diagnosis::SwappedFrames,
        format!(
            "on {:.0} % of the lit pixels stripe edges lie where their pattern has none; frames are in another order \
             than their names say, or belong to another code: check sequence, code offset and code bits",
            100.0 * off,
        ),
        json!({ "off_boundary": off }),
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
                     in front of the camera by 90 degrees, or exchange the projector's channels in the configuration"
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
        && let Some(degree) = degree_of_polarization(decoded).filter(|&degree| degree < WEAK)
    {
        reasons.push(Reason::degraded(
            Diagnosis::PolarizationWeak,
            format!(
                "the light of the lit pixels is polarized by {:.0} % only; the polarizer in front of the camera is \
                 turned by up to {:.0} degrees, the surface scatters (paper, matte paint), or the room is bright: turn \
                 the polarizer until `polscan show v` is darkest, and shade the scene",
                100.0 * degree,
                // H and V pass as cos^2 and sin^2 of the angle, so their contrast is the cosine of twice the angle.
                0.5 * degree.clamp(0.0, 1.0).acos().to_degrees(),
            ),
            json!({ "degree_of_polarization": degree }),
        ));
    }
    reasons
}

/// Mean over the lit, unsaturated pixels of the usual polarity, weighed by brightness: dark pixels say little.
fn degree_of_polarization(decoded: &Decoded) -> Option<f64> {
    let (mut sum, mut weight) = (0.0, 0.0);
    for (index, class) in decoded.class.data().iter().enumerate() {
        let degree = f64::from(decoded.dolp.data()[index]);
        if !class.is_lit() || matches!(class, Class::Inverted | Class::Saturated) || !degree.is_finite() {
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

/// Pixels that stay dark amid valid ones, and lines of them.
fn sensor_defect(decoded: &Decoded, pixels: &PixelCounts) -> Option<Reason> {
    let class = &decoded.class;
    let (width, height) = (class.width(), class.height());
    let valid = |x: usize, y: usize| class.at(x, y).is_valid();
    let mut dead = 0u64;
    // Crossed and dead pixels of each column and row of the sensor.
    let (mut columns, mut rows) = (vec![[0u32; 2]; width], vec![[0u32; 2]; height]);
    for y in 1..height.saturating_sub(1) {
        for x in 1..width.saturating_sub(1) {
            let failed = u32::from(!valid(x, y));
            let (beside, above) = (valid(x - 1, y) && valid(x + 1, y), valid(x, y - 1) && valid(x, y + 1));
            if beside {
                columns[x][0] += 1;
                columns[x][1] += failed;
            }
            if above {
                rows[y][0] += 1;
                rows[y][1] += failed;
            }
            let corners =
                || valid(x - 1, y - 1) && valid(x + 1, y - 1) && valid(x - 1, y + 1) && valid(x + 1, y + 1);
            dead += u64::from(class.at(x, y) == Class::Unlit && beside && above && corners());
        }
    }
    let lines = |counts: &[[u32; 2]]| {
        let is_dead = |[crossed, failed]: &[u32; 2]| {
            *crossed >= LINE_PIXELS && f64::from(*failed) > LINE_DEAD * f64::from(*crossed)
        };
        counts.iter().enumerate().filter(|(_, count)| is_dead(count)).map(|(at, _)| at).collect::<Vec<_>>()
    };
    let (columns, rows) = (lines(&columns), lines(&rows));
    let many = dead >= LEAST_DEAD && dead as f64 > DEAD * pixels.valid as f64;
    if !many && columns.is_empty() && rows.is_empty() {
        return None;
    }
    Some(Reason::degraded(
        Diagnosis::SensorDefect,
        format!(
            "{} amid good ones, {} and {} of the sensor do not answer to light; clean the sensor's window, and \
             check the camera with `polscan show white`; the pixels are left out",
            plural(dead, "single pixel"),
            plural(columns.len() as u64, "column"),
            plural(rows.len() as u64, "row"),
        ),
        json!({ "pixels": dead, "columns": columns, "rows": rows }),
    ))
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
    }
    if let Some(capture) = input.capture {
        if !capture.timing_measured {
            notes.push(
                "the projector's timing was assumed, with a margin; `polscan calibrate sync` measures it and may make \
                 scans faster"
                    .to_owned(),
            );
        }
        if !capture.retaken.is_empty() {
            notes
                .push(format!("{} captured again, then sound", plural(capture.retaken.len() as u64, "pair")));
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

/// `1 frame`, `3 frames`.
fn plural(count: u64, noun: &str) -> String {
    format!("{count} {noun}{}", if count == 1 { "" } else { "s" })
}
