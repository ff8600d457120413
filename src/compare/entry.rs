//! What is shown of one method: figures, pictures and points, taken from its outcome.

use polscan_patterns::{Mode, Role};
use serde::Serialize;

use super::{
    Method, Places,
    images::{self, Picture},
    places::Plate,
    stripes::{self, AXIS, EdgeCount, Zoom},
};
use crate::{
    decode::{Class, Plane},
    engine::Results,
    grid::Grid,
    pipeline::{self, Outcome},
    report::{
        Report,
        colormap::Colormap,
        pictures::{Range, ViewSettings, cloud_view},
    },
};

/// Width of the stripes in the frames that are shown whole, and in the squares, in projector columns.
const WIDE_STRIPES: u32 = 32;
const NARROW_STRIPES: u32 = 8;

/// Rows above and below a section over which the median of the line fits is taken.
const SECTION_ROWS: usize = 20;

/// A method's outcome, and where it comes from.
pub struct Subject<'a> {
    /// Which method.
    pub method: Method,
    /// Where the frames come from.
    pub source: String,
    /// What a reader must know of how they were made.
    pub remarks: Vec<String>,
    /// Exposure time in microseconds, where it is known.
    pub exposure_us: Option<f64>,
    /// Frames, outcome and context.
    pub results: &'a Results<'a>,
}

/// Figures of one method, as in compare.json.
#[derive(Debug, Clone, Serialize)]
pub struct Figures {
    /// Which method.
    pub method: Method,
    /// Mode in which the frames were coded and decoded.
    pub mode: Mode,
    /// Where the frames come from.
    pub source: String,
    /// What a reader must know of how they were made.
    pub remarks: Vec<String>,
    /// Exposure time of each frame in microseconds, `null` where it is not known.
    pub exposure_us: Option<f64>,
    /// Line fits to sections of the cloud (Fig. 6 of the paper).
    pub sections: Vec<SectionFit>,
    /// Stripe edges (Fig. 4 of the paper).
    pub edges: Vec<EdgeCount>,
    /// What a decoder with fixed thresholds would keep.
    pub fixed_rule: Vec<FixedRule>,
    /// The report as `polscan decode` writes it.
    pub report: Report,
}

/// Share of the pixels of an object that a decoder with thresholds in grey levels would keep, instead of this one's in units
/// of noise: those whose bright and dark levels differ by more than 40 of 255, and pattern and inverse by at least 5 in
/// every pair. Peers decode like this.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FixedRule {
    /// Name of the object, `null` for the whole image.
    pub object: Option<String>,
    /// Share of its pixels that projector light reaches; of all pixels for the whole image without a truth.
    pub kept: Option<f64>,
}

/// A line fitted to depths along a row of the image.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SectionFit {
    /// Name of the plate.
    pub plate: String,
    /// Row of the image.
    pub row: usize,
    /// Points on it.
    pub points: usize,
    /// Pixels of the section, with a point or not.
    pub pixels: usize,
    /// Root of the sum of squared residuals over the degrees of freedom, in mm; `null` for less than three points.
    pub rmse_mm: Option<f64>,
    /// Median of the same over 41 rows around it: one row is a small sample.
    pub rmse_mm_median: Option<f64>,
}

/// Everything that is shown of one method.
#[derive(Debug, Clone)]
pub struct Entry {
    /// Figures.
    pub figures: Figures,
    /// Width and height of the projector in px.
    pub projector: (u32, u32),
    /// Columns after all gates, NaN where there is none.
    pub column: Grid<f32>,
    /// Level of a frame along a row, as a share of full scale, and of the image that is decoded from.
    pub profiles: [Vec<f32>; 2],
    /// Residuals of the line fits: x in mm, residual in mm.
    pub residuals: Vec<Vec<(f64, f64)>>,
    /// Squares with stripe edges: of each plate the frame and what is decoded from it.
    pub zooms: Vec<[Zoom; 2]>,
    /// A frame as it was captured.
    pub frame: Picture,
    /// What the method makes of it.
    pub signal: Picture,
    /// Columns, and rows where they were coded.
    pub columns: Picture,
    /// Rows, where they were coded.
    pub rows: Option<Picture>,
    /// Depth, with a calibration.
    pub depth: Option<Picture>,
    /// What became of each pixel.
    pub classes: Picture,
    /// The cloud, with a calibration.
    pub cloud: Option<Picture>,
}

impl Entry {
    /// Takes from an outcome what is shown of it. Where `places` know no range of depths yet, this one's becomes it.
    pub fn new(subject: &Subject, places: &mut Places) -> Self {
        let results = subject.results;
        let (job, outcome) = (results.job, results.outcome);
        let report = pipeline::report(job, outcome, results.context, results.timings);
        let code = job.decode.column;
        let bits = [WIDE_STRIPES, NARROW_STRIPES].map(|columns| stripes::bit_with_stripes(code, columns));
        let [wide, narrow] = bits.map(|bit| (frame(results, bit), signal(results, subject.method, bit)));
        let profile = |image: &Grid<f32>| image.row(places.row.min(image.height() - 1)).to_vec();
        let zooms: Vec<[Zoom; 2]> = places
            .plates
            .iter()
            .map(|plate| {
                let look = |image: &Grid<f32>, kind| {
                    stripes::look(image, kind, plate, (code, bits[1]), results.context.truth)
                };
                [look(&narrow.0, "frame"), look(&narrow.1, "signal")]
            })
            .collect();
        let depth = outcome.depth_mm();
        if let Some(depth) = &depth {
            places.depth_mm.get_or_insert_with(|| Range::of(depth.data(), 0.002));
        }
        let cuts: Vec<_> = places.plates.iter().map(|plate| section(outcome, plate)).collect();
        let (sections, residuals) = cuts.into_iter().unzip();
        let valid = |map: &Grid<f32>| {
            let pairs = map.data().iter().zip(outcome.class().data());
            let kept = pairs.map(|(&value, class)| if class.is_valid() { value } else { f32::NAN });
            Grid::from_vec(map.width(), map.height(), kept.collect())
        };
        let column = valid(&outcome.decoded.column.coordinate);
        let index = |map: &Grid<f32>, size: u32| {
            images::map(map, Colormap::Jet, Range { low: 0.0, high: size.saturating_sub(1).max(1) as f32 })
        };
        let rows =
            outcome.decoded.row.as_ref().map(|row| index(&valid(&row.coordinate), job.decode.row.size()));
        let cloud = outcome.reconstruction.as_ref().map(|made| {
            images::drawing(&cloud_view(
                &made.cloud,
                &ViewSettings { width: 760, height: 560, ..ViewSettings::default() },
            ))
        });
        Self {
            frame: images::photograph(&wide.0, true),
            signal: images::photograph(&wide.1, false),
            profiles: [profile(&wide.0), profile(&wide.1)],
            columns: index(&column, code.size()),
            rows,
            depth: depth
                .zip(places.depth_mm)
                .map(|(depth, range)| images::map(&depth, Colormap::Parula, range)),
            classes: images::classes(outcome.class()),
            cloud,
            projector: (code.size(), job.decode.row.size()),
            column,
            residuals,
            figures: Figures {
                method: subject.method,
                mode: job.decode.mode,
                source: subject.source.clone(),
                remarks: subject.remarks.clone(),
                exposure_us: subject.exposure_us,
                sections,
                fixed_rule: fixed_rule(results),
                edges: zooms.iter().flatten().map(|zoom| zoom.count.clone()).collect(),
                report,
            },
            zooms,
        }
    }
}

fn level(plane: Plane<'_>, at: usize) -> f32 {
    match plane {
        Plane::U8(samples) => f32::from(samples[at]),
        Plane::U16(samples) => f32::from(samples[at]),
    }
}

fn find<'a>(results: &'a Results, role: Role) -> Option<Plane<'a>> {
    let at = results.job.roles.iter().position(|found| *found == role)?;
    Some(results.job.planes[at].plane())
}

fn grid(results: &Results, value: impl Fn(usize) -> f32) -> Grid<f32> {
    let (width, height) = (results.job.decode.width, results.job.decode.height);
    Grid::from_vec(width, height, (0..width * height).map(value).collect())
}

/// The frame of a column bit as a share of full scale; black where it is missing.
fn frame(results: &Results, bit: u8) -> Grid<f32> {
    let full = ((1u32 << results.job.decode.camera.bit_depth) - 1) as f32;
    match find(results, Role::Code { axis: AXIS, bit, inverse: false }) {
        Some(plane) => grid(results, |at| level(plane, at) / full),
        None => grid(results, |_| 0.0),
    }
}

/// The image that a method decides a column bit by, 0 to 1: the degree of linear polarization for the paper's, the
/// normalised fringe `(1 + (P - Q) / C) / 2` for the others.
fn signal(results: &Results, method: Method, bit: u8) -> Grid<f32> {
    let role = |inverse| Role::Code { axis: AXIS, bit, inverse };
    let Some(pattern) = find(results, role(false)) else { return frame(results, bit) };
    let decoded = &results.outcome.decoded;
    let black = decoded.black_level_dn as f32;
    if method == Method::Paper {
        let dark: Vec<Plane<'_>> = results
            .job
            .roles
            .iter()
            .zip(results.job.planes)
            .filter(|(role, _)| **role == Role::ReferenceV)
            .map(|(_, plane)| plane.plane())
            .collect();
        return grid(results, |at| {
            let r =
                dark.iter().map(|plane| level(*plane, at)).sum::<f32>() / dark.len().max(1) as f32 - black;
            let i = level(pattern, at) - black;
            if i + r > 0.0 { ((i - r) / (i + r)).clamp(0.0, 1.0) } else { 0.0 }
        });
    }
    let Some(inverse) = find(results, role(true)) else { return frame(results, bit) };
    grid(results, |at| {
        if decoded.class.data()[at] == Class::Unlit {
            return 0.0;
        }
        let fringe = (level(pattern, at) - level(inverse, at)) / decoded.modulation.data()[at];
        ((1.0 + fringe) / 2.0).clamp(0.0, 1.0)
    })
}

fn fixed_rule(results: &Results) -> Vec<FixedRule> {
    const LEAST_LEVEL: f32 = 40.0;
    const LEAST_PAIR: f32 = 5.0;
    let scale = 255.0 / ((1u32 << results.job.decode.camera.bit_depth) - 1) as f32;
    let modulation = &results.outcome.decoded.modulation;
    let mut kept: Vec<bool> =
        modulation.data().iter().map(|level| level.abs() * scale > LEAST_LEVEL).collect();
    for role in results.job.roles {
        let Role::Code { inverse: false, .. } = *role else { continue };
        let Some((p, q)) = find(results, *role).zip(role.opposite().and_then(|role| find(results, role)))
        else {
            continue;
        };
        for (at, kept) in kept.iter_mut().enumerate().filter(|(_, kept)| **kept) {
            *kept = (level(p, at) - level(q, at)).abs() * scale >= LEAST_PAIR;
        }
    }
    let share = |belongs: &dyn Fn(usize) -> bool| {
        let of = kept.iter().enumerate().filter(|(at, _)| belongs(*at));
        let (all, good) = of.fold((0u64, 0u64), |(all, good), (_, kept)| (all + 1, good + u64::from(*kept)));
        (all > 0).then(|| good as f64 / all as f64)
    };
    let Some(truth) = results.context.truth else {
        return vec![FixedRule { object: None, kept: share(&|_| true) }];
    };
    let lit = |at: usize| truth.column.data()[at].is_finite();
    let mut rules = vec![FixedRule { object: None, kept: share(&lit) }];
    rules.extend((0u8..).zip(&truth.objects).map(|(label, object)| FixedRule {
        object: Some(object.name.clone()),
        kept: share(&|at| lit(at) && truth.object.data()[at] == label),
    }));
    rules
}

/// Line fit and residuals of the section of a plate.
fn section(outcome: &Outcome, plate: &Plate) -> (SectionFit, Vec<(f64, f64)>) {
    let mut fit = SectionFit {
        plate: plate.name.clone(),
        row: plate.row,
        points: 0,
        pixels: plate.end - plate.start,
        rmse_mm: None,
        rmse_mm_median: None,
    };
    let Some(made) = &outcome.reconstruction else { return (fit, Vec::new()) };
    let height = made.class.height();
    let on_row = |y: usize| -> Vec<(f64, f64)> {
        let points = (plate.start..plate.end.min(made.class.width()))
            .filter(|&x| made.class.at(x, y).is_valid())
            .map(|x| made.cloud.point_mm.at(x, y));
        points
            .map(|[x, _, z]| (f64::from(x), f64::from(z)))
            .filter(|(x, z)| x.is_finite() && z.is_finite())
            .collect()
    };
    let (residuals, rmse_mm) = line_fit(&on_row(plate.row.min(height - 1)));
    fit.points = residuals.len();
    fit.rmse_mm = rmse_mm;
    let near = plate.row.saturating_sub(SECTION_ROWS)..=(plate.row + SECTION_ROWS).min(height - 1);
    let mut all: Vec<f64> = near.filter_map(|y| line_fit(&on_row(y)).1).collect();
    all.sort_by(f64::total_cmp);
    fit.rmse_mm_median = all.get(all.len() / 2).copied();
    (fit, residuals)
}

/// Residuals of a least-squares line through points, and their root mean square over the degrees of freedom.
fn line_fit(points: &[(f64, f64)]) -> (Vec<(f64, f64)>, Option<f64>) {
    let count = points.len() as f64;
    if points.len() < 3 {
        return (Vec::new(), None);
    }
    let (mean_x, mean_z) =
        (points.iter().map(|p| p.0).sum::<f64>() / count, points.iter().map(|p| p.1).sum::<f64>() / count);
    let (mut xx, mut xz) = (0.0, 0.0);
    for (x, z) in points {
        xx += (x - mean_x) * (x - mean_x);
        xz += (x - mean_x) * (z - mean_z);
    }
    if xx <= 0.0 {
        return (Vec::new(), None);
    }
    let residuals: Vec<(f64, f64)> =
        points.iter().map(|&(x, z)| (x, z - mean_z - xz / xx * (x - mean_x))).collect();
    let sum: f64 = residuals.iter().map(|residual| residual.1 * residual.1).sum();
    (residuals, Some((sum / (count - 2.0)).sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn line_fits_leave_what_no_line_explains() {
        let (residuals, rmse) = line_fit(&[(0.0, 1.0), (1.0, 3.0), (2.0, 5.0), (3.0, 7.0)]);
        assert!(rmse.unwrap() < 1e-12 && residuals.len() == 4);
        // Residuals +1, -1, -1, +1 of the line z = 1: no slope, two degrees of freedom.
        let (_, rmse) = line_fit(&[(0.0, 2.0), (1.0, 0.0), (2.0, 0.0), (3.0, 2.0)]);
        assert!((rmse.unwrap() - 2f64.sqrt()).abs() < 1e-12);
        assert_eq!(line_fit(&[(1.0, 1.0), (1.0, 2.0), (1.0, 3.0)]).1, None, "a line across is none along x");
        assert_eq!(line_fit(&[(1.0, 1.0), (2.0, 2.0)]).1, None);
    }
}
