//! From results to the report. Pure.

use polscan_patterns::{Mode, Role};

use super::{
    CaptureSummary, NamedRegion, Reason,
    accuracy::{self, Measured},
    diagnosis,
    region::{self, NOTHING},
    statistics,
    types::{
        CalibrationReport, CaptureReport, Contrast, NoiseReport, PairName, PairReport, PairResidualReport,
        PixelCounts, PlaneReport, Report, RowCheckReport, SCHEMA, Size, Timings,
    },
};
use crate::{
    cloud::{Reconstruction, RowCheck, fit_plane},
    decode::{Class, DecodeSettings, Decoded, PairResidual, Plane},
    geometry::Quality,
    grid::Grid,
    truth::Truth,
};

/// Everything a report is made of. What is not known is `None`, and the report leaves it out.
#[derive(Clone)]
pub struct ReportInput<'a> {
    /// Mode of the scan.
    pub mode: Mode,
    /// Frames that went into the decode, or that were captured where nothing was decoded.
    pub frames: usize,
    /// Size of the frames.
    pub size: Size,
    /// How the frames were decoded.
    pub settings: Option<&'a DecodeSettings>,
    /// What the decoder made of them.
    pub decoded: Option<&'a Decoded>,
    /// Points, where there is a calibration.
    pub reconstruction: Option<&'a Reconstruction>,
    /// Truth, on the simulated rig.
    pub truth: Option<&'a Truth>,
    /// Capture, where this program made it.
    pub capture: Option<&'a CaptureSummary>,
    /// What the capture itself found wrong.
    pub found: &'a [Reason],
    /// Contrast of the frames.
    pub contrast: Option<Contrast>,
    /// Regions whose flatness is wanted.
    pub regions: &'a [NamedRegion],
    /// Calibration that was used.
    pub calibration: Option<CalibrationReport>,
    /// The frames themselves, for a closer look at pairs that do not add up; may be empty.
    pub planes: &'a [(Role, Plane<'a>)],
    /// Where the time went.
    pub timings: Timings,
    /// Threads of the compute pool.
    pub threads: usize,
    /// Whether the frames come from the simulated rig.
    pub simulated: bool,
    /// H over V that the rig shows on metal, where it is known.
    pub extinction_ratio: Option<f64>,
}

impl<'a> ReportInput<'a> {
    /// A scan of which nothing but its mode, its size and the number of its frames is known.
    pub fn new(mode: Mode, size: Size, frames: usize) -> Self {
        Self {
            mode,
            frames,
            size,
            settings: None,
            decoded: None,
            reconstruction: None,
            truth: None,
            capture: None,
            found: &[],
            contrast: None,
            regions: &[],
            calibration: None,
            planes: &[],
            timings: Timings::default(),
            threads: 1,
            simulated: false,
            extinction_ratio: None,
        }
    }

    /// Class of each pixel after all gates.
    pub(super) fn class(&self) -> Option<&'a Grid<Class>> {
        self.reconstruction.map(|made| &made.class).or(self.decoded.map(|decoded| &decoded.class))
    }

    fn measured(&self) -> Option<Measured<'a>> {
        Some(Measured {
            decoded: self.decoded?,
            class: self.class()?,
            cloud: self.reconstruction.map(|made| &made.cloud),
        })
    }
}

impl CalibrationReport {
    /// From what a calibration says of itself.
    pub fn new(id: Option<String>, quality: &Quality) -> Self {
        let rms = |value: Option<f64>| value.and_then(statistics::finite);
        Self {
            id,
            camera_rms_px: rms(quality.camera_rms_px),
            projector_rms_px: rms(quality.projector_rms_px),
            views: quality.views,
            date: quality.date.clone(),
            method: quality.method.clone(),
        }
    }
}

/// Makes the report.
pub fn build(input: &ReportInput) -> Report {
    let pixels = input.decoded.zip(input.class()).map(|(decoded, class)| count(decoded, class));
    let (planes, truth) = figures(input);
    let reasons = diagnosis::diagnose(input, pixels.as_ref());
    Report {
        schema: SCHEMA.to_owned(),
        software: concat!("polscan ", env!("CARGO_PKG_VERSION")).to_owned(),
        mode: input.mode,
        frames: input.frames,
        size: input.size,
        verdict: super::verdict(&reasons),
        notes: diagnosis::notes(input, pixels.as_ref()),
        reasons,
        simulated: input.simulated,
        pixels,
        points: input.reconstruction.map(|made| points(made, |_| true).count() as u64),
        capture: capture(input),
        contrast: input.contrast,
        planes,
        truth,
        row_check: input.reconstruction.and_then(|made| made.row_check).map(RowCheckReport::from),
        degree_of_polarization: input
            .decoded
            .filter(|_| input.mode.is_polarized())
            .and_then(diagnosis::degree_of_polarization),
        noise: input.decoded.map(|decoded| NoiseReport {
            model: decoded.noise,
            estimated: decoded.noise_estimated,
            black_level_dn: decoded.black_level_dn,
        }),
        losses: input.decoded.map(|decoded| decoded.losses.clone()).unwrap_or_default(),
        calibration: input.calibration.clone(),
        timings_ms: input.timings.finite(),
        threads: input.threads,
    }
}

/// Pixels by class.
fn count(decoded: &Decoded, class: &Grid<Class>) -> PixelCounts {
    let mut of = [0u64; Class::ALL.len()];
    for &class in class.data() {
        of[class as usize] += 1;
    }
    let of = |class: Class| of[class as usize];
    let total = class.len() as u64;
    PixelCounts {
        total,
        lit: total - of(Class::Unlit),
        valid: of(Class::Valid) + of(Class::Edge) + of(Class::Inverted),
        plain: of(Class::Valid),
        edge: of(Class::Edge),
        inverted: of(Class::Inverted),
        unlit: of(Class::Unlit),
        saturated: of(Class::Saturated),
        ambiguous: of(Class::Ambiguous),
        off_boundary: of(Class::OffBoundary),
        out_of_projector: of(Class::OutOfProjector),
        out_of_volume: of(Class::OutOfVolume),
        rejected_by_row: of(Class::RowGate),
        rejected_by_vote: of(Class::Vote),
        interreflection: of(Class::Interreflection),
        half_saturated: decoded.half_saturated.data().iter().filter(|&&half| half).count() as u64,
    }
}

/// Points of the valid pixels that `belongs` picks.
fn points(made: &Reconstruction, belongs: impl Fn(usize) -> bool) -> impl Iterator<Item = [f64; 3]> {
    let pixels = made.class.data().iter().zip(made.cloud.point_mm.data()).enumerate();
    pixels
        .filter(move |(index, (class, _))| class.is_valid() && belongs(*index))
        .map(|(_, (_, point))| point.map(f64::from))
        .filter(|point| point.iter().all(|value| value.is_finite()))
}

/// Flatness of all regions, and agreement with the truth where there is one.
fn figures(input: &ReportInput) -> (Vec<PlaneReport>, Option<super::TruthReport>) {
    let Some(measured) = input.measured() else { return (Vec::new(), None) };
    let truth = input.truth.map(|truth| (truth, accuracy::interior(truth)));
    let mut planes = match &truth {
        Some((truth, interior)) => objects(input, measured, truth, interior),
        None => Vec::new(),
    };
    planes.extend(input.regions.iter().map(|named| region_plane(input, measured, named)));
    (planes, truth.map(|(truth, interior)| accuracy::against_truth(measured, truth, &interior)))
}

/// The planar objects of a simulated scene that the camera sees.
fn objects(input: &ReportInput, measured: Measured, truth: &Truth, interior: &Grid<u8>) -> Vec<PlaneReport> {
    let clear = region::off_borders(&truth.object);
    let planar = truth.objects.iter().enumerate().filter(|(label, object)| {
        object.planar && *label < usize::from(NOTHING) && truth.object.data().contains(&(*label as u8))
    });
    planar
        .map(|(label, object)| {
            let label = label as u8;
            let lit = |index: usize| clear.data()[index] == label && truth.column.data()[index].is_finite();
            let off_shadow = |index: usize| interior.data()[index] == label;
            PlaneReport {
                truth: Some(accuracy::accuracy(measured, truth, off_shadow)),
                rmse_off_shadow_mm: input.reconstruction.and_then(|made| {
                    let points: Vec<_> = points(made, off_shadow).collect();
                    fit_plane(&points).ok().map(|fit| fit.rmse_mm)
                }),
                ..plane_of(&object.name, input, measured, |index| clear.data()[index] == label, lit)
            }
        })
        .collect()
}

/// A rectangle that the user named.
fn region_plane(input: &ReportInput, measured: Measured, named: &NamedRegion) -> PlaneReport {
    let width = input.size.width.max(1);
    let inside = |index: usize| named.contains(index % width, index / width);
    let lit = |index: usize| inside(index) && measured.class.data()[index].is_lit();
    plane_of(&named.name, input, measured, inside, lit)
}

fn plane_of(
    name: &str,
    input: &ReportInput,
    measured: Measured,
    inside: impl Fn(usize) -> bool,
    lit: impl Fn(usize) -> bool,
) -> PlaneReport {
    let (mut lit_pixels, mut valid) = (0, 0);
    for (index, class) in measured.class.data().iter().enumerate() {
        if lit(index) {
            lit_pixels += 1;
            valid += u64::from(class.is_valid());
        }
    }
    let points: Vec<_> = input.reconstruction.map(|made| points(made, inside).collect()).unwrap_or_default();
    let fit = fit_plane(&points).ok();
    PlaneReport {
        name: name.to_owned(),
        points: points.len() as u64,
        coverage: statistics::share(valid, lit_pixels),
        rmse_mm: fit.map(|fit| fit.rmse_mm),
        bow_mm: fit.map(|fit| fit.bow_mm),
        p95_mm: fit.map(|fit| fit.p95_mm),
        lit: lit_pixels,
        rmse_off_shadow_mm: None,
        truth: None,
    }
}

fn capture(input: &ReportInput) -> CaptureReport {
    let known = input.capture;
    let seconds = |of: fn(&CaptureSummary) -> f64| known.map(of).and_then(statistics::finite);
    CaptureReport {
        seconds: seconds(|capture| capture.seconds),
        limit_seconds: seconds(|capture| capture.limit_seconds),
        latency_ms: seconds(|capture| capture.latency_ms),
        hold_frames: known.map(|capture| capture.hold_frames),
        timing_measured: known.map(|capture| capture.timing_measured),
        synchrony: known.and_then(|capture| capture.synchrony.clone()),
        retaken: known.map(|capture| capture.retaken.clone()).unwrap_or_default(),
        references_retaken: known.map(|capture| capture.references_retaken.clone()).unwrap_or_default(),
        discarded: known.map(|capture| capture.discarded.clone()).unwrap_or_default(),
        pair_residual_sigma: input.decoded.and_then(|decoded| pair_residual(&decoded.pairs)),
        drift: input.decoded.and_then(|decoded| decoded.drift).and_then(statistics::finite),
    }
}

fn pair_residual(pairs: &[PairResidual]) -> Option<PairResidualReport> {
    let worst =
        pairs.iter().filter(|pair| pair.sigma.is_finite()).max_by(|a, b| a.sigma.total_cmp(&b.sigma))?;
    let mut sigmas: Vec<f64> = pairs.iter().filter_map(|pair| statistics::finite(pair.sigma)).collect();
    Some(PairResidualReport {
        median: statistics::median(&mut sigmas)?,
        worst: worst.sigma,
        worst_pair: PairName { axis: worst.axis, bit: worst.bit },
        per_pair: pairs.iter().map(PairReport::from).collect(),
    })
}

impl From<RowCheck> for RowCheckReport {
    fn from(check: RowCheck) -> Self {
        Self {
            median_px: statistics::finite(check.median_px),
            sigma_px: statistics::finite(check.sigma_px),
            gate_px: statistics::finite(check.gate_px),
            rejected_share: statistics::finite(check.rejected_share),
            rows_per_column: statistics::finite(check.rows_per_column),
        }
    }
}

impl Timings {
    fn finite(self) -> Self {
        let keep = |value: Option<f64>| value.and_then(statistics::finite);
        Self {
            load: keep(self.load),
            decode: keep(self.decode),
            subpixel: keep(self.subpixel),
            triangulate: keep(self.triangulate),
            write: keep(self.write),
            after_last_frame: keep(self.after_last_frame),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use serde_json::Value;

    use super::*;
    use crate::report::{Diagnosis, Verdict, testing};

    /// Keys of the contract, by object.
    const KEYS: &[(&str, &[&str])] = &[
        (
            "",
            &[
                "schema",
                "mode",
                "frames",
                "size",
                "verdict",
                "reasons",
                "pixels",
                "capture",
                "contrast",
                "planes",
                "truth",
                "timings_ms",
                "threads",
            ],
        ),
        ("/size", &["width", "height"]),
        (
            "/pixels",
            &[
                "total",
                "lit",
                "valid",
                "edge",
                "saturated",
                "unlit",
                "inverted",
                "ambiguous",
                "rejected_by_row",
            ],
        ),
        (
            "/capture",
            &[
                "seconds",
                "limit_seconds",
                "latency_ms",
                "hold_frames",
                "synchrony",
                "retaken",
                "pair_residual_sigma",
                "drift",
            ],
        ),
        ("/capture/pair_residual_sigma", &["median", "worst", "worst_pair", "per_pair"]),
        ("/contrast", &["raw", "dolp", "ratio", "raw_lit", "dolp_lit", "ratio_lit"]),
        ("/planes/0", &["name", "points", "coverage", "rmse_mm", "bow_mm", "p95_mm"]),
        (
            "/truth",
            &[
                "coverage",
                "wrong_code_rate",
                "wrong_code_rate_before_gates",
                "column_rms_px",
                "depth_rmse_mm",
                "sigma_z_ratio",
                "border",
            ],
        ),
        ("/truth/border", &["pixels", "wrong"]),
        ("/timings_ms", &["load", "decode", "subpixel", "triangulate", "write", "after_last_frame"]),
    ];

    fn capture() -> CaptureSummary {
        CaptureSummary {
            seconds: 1.5,
            limit_seconds: 1.47,
            latency_ms: 33.0,
            hold_frames: 2,
            timing_measured: true,
            synchrony: Some(crate::sequencer::Synchrony::default()),
            ..Default::default()
        }
    }

    #[test]
    fn a_sound_scan_is_ok_and_has_every_key_of_the_contract() {
        let decoded = testing::decoded(160, 120);
        let (truth, made, capture) = (testing::truth(&decoded), testing::reconstruction(&decoded), capture());
        let settings = testing::settings(160, 120);
        let report = build(&ReportInput {
            settings: Some(&settings),
            reconstruction: Some(&made),
            truth: Some(&truth),
            capture: Some(&capture),
            contrast: Some(Contrast::new(100.0, 500.0, 120.0, 480.0)),
            timings: Timings {
                load: Some(1.0),
                decode: Some(2.0),
                subpixel: Some(3.0),
                triangulate: Some(4.0),
                write: Some(5.0),
                after_last_frame: Some(6.0),
            },
            ..testing::input(&decoded)
        });
        assert_eq!((report.verdict, &report.reasons[..]), (Verdict::Ok, &[][..]));
        let json = serde_json::to_value(&report).unwrap();
        for (object, keys) in KEYS {
            for key in *keys {
                let value = json.pointer(object).unwrap_or_else(|| panic!("{object}")).get(key);
                assert!(value.is_some_and(|value| !value.is_null()), "{object}/{key}");
            }
        }
        assert_eq!(json["schema"], "polscan.report/1");
        assert_eq!(json["mode"], "pse");
        assert_eq!(json["contrast"]["ratio"], 5.0);
        assert_eq!(json["capture"]["hold_frames"], 2);
        assert_eq!(json["capture"]["pair_residual_sigma"]["worst_pair"]["axis"], "row");
        assert_eq!(serde_json::from_value::<Report>(json).unwrap(), report);
    }

    #[test]
    fn without_anything_each_key_is_there_and_null() {
        let report = build(&ReportInput::new(Mode::Fast, Size { width: 4, height: 3 }, 0));
        let json = serde_json::to_value(&report).unwrap();
        for key in KEYS[0].1 {
            assert!(json.get(key).is_some(), "{key}");
        }
        for pointer in [
            "/pixels",
            "/points",
            "/truth",
            "/contrast",
            "/noise",
            "/row_check",
            "/calibration",
            "/capture/seconds",
            "/capture/drift",
            "/capture/pair_residual_sigma",
            "/timings_ms/load",
        ] {
            assert_eq!(json.pointer(pointer), Some(&Value::Null), "{pointer}");
        }
        assert_eq!(json["planes"], serde_json::json!([]));
        assert_eq!(serde_json::from_value::<Report>(json).unwrap(), report);
    }

    #[test]
    fn no_number_is_left_that_json_has_no_word_for() {
        let mut decoded = testing::decoded(40, 30);
        for pair in &mut decoded.pairs {
            (pair.flat_outliers, pair.median) = (f64::NAN, f64::INFINITY);
        }
        decoded.drift = Some(f64::NAN);
        decoded.dolp.data_mut().fill(f32::NAN);
        let mut made = testing::reconstruction(&decoded);
        made.cloud.point_mm.data_mut()[5] = [f32::NAN; 3];
        made.row_check.as_mut().unwrap().median_px = f64::NAN;
        let timings = Timings { load: Some(f64::NAN), decode: Some(3.0), ..Timings::default() };
        let contrast = Some(Contrast::new(0.0, 0.0, f64::NAN, 3.0));
        let report = build(&ReportInput {
            reconstruction: Some(&made),
            timings,
            contrast,
            ..testing::input(&decoded)
        });
        // What survives the way through JSON held nothing that became `null` on it.
        let json = serde_json::to_string(&report).unwrap();
        assert_eq!(serde_json::from_str::<Report>(&json).unwrap(), report);
        assert_eq!((report.timings_ms.load, report.timings_ms.decode), (None, Some(3.0)));
        assert_eq!(report.points, Some(40 * 30 - 1));
    }

    #[test]
    fn what_the_capture_found_is_in_the_report() {
        let found = [Reason::failed(Diagnosis::TornFrame, "torn", Value::Null)];
        let input =
            ReportInput { found: &found, ..ReportInput::new(Mode::Pse, Size { width: 4, height: 3 }, 7) };
        let report = build(&input);
        assert_eq!((report.verdict, &report.reasons[..], report.frames), (Verdict::Failed, &found[..], 7));
    }

    #[test]
    fn classes_are_counted_after_all_gates() {
        let mut decoded = testing::decoded(12, 1);
        decoded.class = Grid::from_vec(12, 1, Class::ALL.to_vec());
        decoded.half_saturated.data_mut()[3] = true;
        let mut made = testing::reconstruction(&decoded);
        made.class.data_mut()[1] = Class::RowGate;
        let counts =
            build(&ReportInput { reconstruction: Some(&made), ..testing::input(&decoded) }).pixels.unwrap();
        let expected = PixelCounts {
            total: 12,
            lit: 11,
            valid: 2,
            plain: 0,
            edge: 1,
            inverted: 1,
            unlit: 1,
            saturated: 1,
            ambiguous: 1,
            off_boundary: 1,
            out_of_projector: 1,
            out_of_volume: 1,
            rejected_by_row: 2,
            rejected_by_vote: 1,
            interreflection: 1,
            half_saturated: 1,
        };
        assert_eq!(counts, expected);
        assert_eq!(build(&testing::input(&decoded)).pixels.unwrap().plain, 1);
    }

    proptest! {
        #[test]
        fn counts_add_up_and_do_not_depend_on_the_order_of_rows(classes in prop::collection::vec(0usize..12, 96), turn in 1usize..8) {
            let mut decoded = testing::decoded(12, 8);
            decoded.class = Grid::from_vec(12, 8, classes.iter().map(|&class| Class::ALL[class]).collect());
            let counts = count(&decoded, &decoded.class);
            prop_assert_eq!(counts.total, 96);
            prop_assert_eq!(counts.lit + counts.unlit, counts.total);
            prop_assert_eq!(counts.plain + counts.edge + counts.inverted, counts.valid);
            let lost = counts.saturated + counts.ambiguous + counts.off_boundary + counts.out_of_projector
                + counts.out_of_volume + counts.rejected_by_row + counts.rejected_by_vote + counts.interreflection;
            prop_assert_eq!(counts.valid + lost, counts.lit);
            decoded.class.data_mut().rotate_left(12 * turn);
            prop_assert_eq!(count(&decoded, &decoded.class), counts);
        }
    }

    #[test]
    fn a_region_takes_all_its_valid_points_two_pixels_off_its_border() {
        let mut decoded = testing::decoded(60, 40);
        // Rejected and unlit inside; whatever happens on the border does not count.
        decoded.class.data_mut()[20 * 60 + 20] = Class::Ambiguous;
        decoded.class.data_mut()[20 * 60 + 21] = Class::Unlit;
        let mut made = testing::reconstruction(&decoded);
        made.cloud.point_mm.data_mut()[11 * 60 + 11][2] = 2000.0;
        // One outlier inside stays in.
        made.cloud.point_mm.data_mut()[22 * 60 + 30][2] += 5.0;
        let regions = ["box=10,10,30,20".parse().unwrap()];
        let report = build(&ReportInput {
            reconstruction: Some(&made),
            regions: &regions,
            ..testing::input(&decoded)
        });
        let [plane] = &report.planes[..] else { panic!("one plane") };
        let pixels = 26 * 16;
        assert_eq!((plane.name.as_str(), plane.points, plane.lit), ("box", pixels - 2, pixels - 1));
        assert_eq!(plane.coverage, Some((pixels - 2) as f64 / (pixels - 1) as f64));
        let oracle: Vec<_> = (12..28)
            .flat_map(|y| (12..38).map(move |x| (x, y)))
            .filter(|&(x, y)| made.class.at(x, y).is_valid())
            .map(|(x, y)| testing::point(&made, x, y))
            .collect();
        let fit = fit_plane(&oracle).unwrap();
        assert_eq!(
            (plane.rmse_mm, plane.p95_mm, plane.bow_mm),
            (Some(fit.rmse_mm), Some(fit.p95_mm), Some(fit.bow_mm))
        );
        assert!(fit.rmse_mm > 0.2, "{}", fit.rmse_mm);
        assert_eq!(plane.truth, None);
    }

    #[test]
    fn a_region_without_calibration_has_its_coverage_and_no_millimetres() {
        let decoded = testing::decoded(60, 40);
        let regions = ["box=10,10,30,20".parse().unwrap()];
        let report = build(&ReportInput { regions: &regions, ..testing::input(&decoded) });
        let plane = &report.planes[0];
        assert_eq!((plane.points, plane.coverage, plane.rmse_mm), (0, Some(1.0), None));
    }

    #[test]
    fn planar_objects_of_a_simulated_scene_are_measured_by_its_truth() {
        let mut decoded = testing::decoded(60, 40);
        let mut truth = testing::truth(&decoded);
        truth.objects = ["plate", "ball", "step", "hidden"]
            .into_iter()
            .map(|name| crate::truth::TruthObject { name: name.into(), planar: name != "ball" })
            .collect();
        // Three stripes of 20 columns; the lower half of the step lies in shadow, and one pixel there claims a value.
        for index in 0..60 * 40 {
            let (x, y) = (index % 60, index / 60);
            truth.object.data_mut()[index] = (x / 20) as u8;
            if x >= 40 && y >= 20 {
                truth.column.data_mut()[index] = f32::NAN;
                decoded.class.data_mut()[index] =
                    if (x, y) == (50, 30) { Class::Valid } else { Class::Unlit };
            }
        }
        // A lit pixel of the step that the decoder calls unlit: no way to look better.
        decoded.class.data_mut()[10 * 60 + 50] = Class::Unlit;
        let mut made = testing::reconstruction(&decoded);
        made.cloud.point_mm.data_mut()[30 * 60 + 50][2] += 5.0;
        let report = build(&ReportInput {
            reconstruction: Some(&made),
            truth: Some(&truth),
            ..testing::input(&decoded)
        });
        let names: Vec<_> = report.planes.iter().map(|plane| plane.name.as_str()).collect();
        assert_eq!(names, ["plate", "step"]);
        let [plate, step] = &report.planes[..] else { panic!("two planes") };
        assert_eq!((plate.points, plate.lit, plate.coverage), (16 * 36, 16 * 36, Some(1.0)));
        assert!(plate.rmse_mm.unwrap() < 1e-4);
        // 16 columns, rows 2..20 lit.
        assert_eq!((step.lit, step.points), (16 * 18, 16 * 18 - 1 + 1));
        assert_eq!(step.coverage, Some((16.0 * 18.0 - 1.0) / (16.0 * 18.0)));
        assert!(step.rmse_mm.unwrap() > 0.2, "a point in shadow is a point");
        assert!(step.rmse_off_shadow_mm.unwrap() < 1e-4);
        assert_eq!(step.truth.as_ref().unwrap().pixels, 16 * 16);
        let truth = report.truth.unwrap();
        assert_eq!(truth.interior.pixels, 16 * 36 * 2 + 16 * 16);
        assert_eq!(truth.border.valid_in_shadow, 1);
    }
}
