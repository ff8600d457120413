//! Where stripe edges cross a line of the image.

mod slopes;

use std::ops::Range;

use polscan_patterns::Mode;

use self::slopes::{Slope, Slopes};
use crate::decode::{
    limits::Gates,
    plan::{BitFrames, Frames, PrefixCode},
    sample::Sample,
    types::Class,
    words::PixelMaps,
};

/// Invalid pixels that a surface may be interrupted by without ending.
const MAX_GAP: usize = 2;
/// Above this slope of the normalised fringe (per px, between the two pixels around an isolated edge of height 2) the
/// blur is below about 0.35 px rms: two pixels then often lie on both plateaus and say little about what is between.
const SHARP_SLOPE: f64 = 1.3;
/// Reach of the partial-area form beyond the two pixels around the crossing, in px: 4 pixels hold an edge that sharp.
const AREA_REACH: usize = 1;
/// Bits with stripes of at least this many projector px show the blur of an isolated edge.
const COARSE_STRIPE: u32 = 8;
/// Median of the square of a standard normal variable.
const MEDIAN_CHI2: f64 = 0.4549;

/// A row or a column of the image.
#[derive(Debug, Clone, Copy)]
pub(super) struct Line {
    pub start: usize,
    pub stride: usize,
    pub len: usize,
    /// Its place among its neighbours.
    pub number: usize,
    /// Number of lines.
    pub lines: usize,
    /// From a pixel to its neighbour on the next line.
    pub across: usize,
}

impl Line {
    pub fn at(self, position: usize) -> usize {
        self.start + position * self.stride
    }

    /// The pixel `y` lines and `t` pixels from the one at `position`; `None` beyond the image.
    pub fn beside(self, position: usize, y: i32, t: i32) -> Option<usize> {
        let number = self.number.checked_add_signed(y as isize).filter(|&number| number < self.lines)?;
        let position = position.checked_add_signed(t as isize).filter(|&position| position < self.len)?;
        let start = self.start + number * self.across - self.number * self.across;
        Some(start + position * self.stride)
    }
}

/// A stripe edge on a line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Edge {
    /// Position on the line in px.
    pub position: f64,
    /// Inverse variance of `position` in 1/px^2.
    pub weight: f64,
    /// Projector coordinate of the boundary.
    pub u: f64,
    /// Whether the value rises with the position.
    pub rising: bool,
}

/// Pixels of one line whose values go on without a jump, and the edges among them.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Run {
    pub pixels: Range<usize>,
    pub edges: Range<usize>,
}

/// A walk along a line, and what was found on the way.
#[derive(Debug, Default)]
pub(super) struct Walk {
    /// Value of each pixel; -1 where it is not valid.
    pub values: Vec<i32>,
    pub classes: Vec<Class>,
    /// In order.
    pub runs: Vec<Run>,
    pub edges: Vec<Edge>,
    /// Of the edges of the run that is under way.
    slopes: Slopes,
    /// Last valid pixel and its value.
    last: Option<(usize, i32)>,
    first_pixel: usize,
    first_edge: usize,
}

impl Walk {
    fn begin<T: Sample>(&mut self, line: Line, finder: &EdgeFinder<'_, T>) {
        self.values.clear();
        self.classes.clear();
        self.runs.clear();
        self.edges.clear();
        self.slopes.clear();
        (self.last, self.first_pixel, self.first_edge) = (None, 0, 0);
        let (values, classes) = (&finder.values[line.start..], &finder.maps.class[line.start..]);
        let known = |value: i32, class: Class| if class.is_valid() { value } else { -1 };
        if line.stride == 1 {
            let pixels = values.iter().zip(classes).take(line.len);
            self.values.extend(pixels.map(|(value, class)| known(*value, *class)));
            self.classes.extend_from_slice(&classes[..line.len]);
        } else {
            let pixels = values.iter().zip(classes).step_by(line.stride).take(line.len);
            self.values.extend(pixels.map(|(value, class)| known(*value, *class)));
            self.classes.extend(classes.iter().step_by(line.stride).take(line.len));
        }
    }

    fn step<T: Sample>(&mut self, finder: &EdgeFinder<'_, T>, line: Line, position: usize) {
        let value = self.values[position];
        if value < 0 {
            return;
        }
        match self.last {
            Some((before, previous))
                if position - before <= MAX_GAP + 1
                    && value.abs_diff(previous) as usize <= finder.step as usize * (position - before) =>
            {
                if position == before + 1 && value != previous {
                    finder.push_crossings(line, before, (previous, value), self);
                }
            }
            Some((before, _)) => {
                self.close_run(finder, before);
                (self.first_pixel, self.first_edge) = (position, self.edges.len());
            }
            None => self.first_pixel = position,
        }
        self.last = Some((position, value));
    }

    fn close_run<T: Sample>(&mut self, finder: &EdgeFinder<'_, T>, last_pixel: usize) {
        self.slopes.weigh(&mut self.edges[self.first_edge..], finder.code.boundary(0), finder.floor);
        join(&mut self.edges, self.first_edge);
        self.runs
            .push(Run { pixels: self.first_pixel..last_pixel + 1, edges: self.first_edge..self.edges.len() });
    }

    fn end<T: Sample>(&mut self, finder: &EdgeFinder<'_, T>) {
        if let Some((before, _)) = self.last {
            self.close_run(finder, before);
        }
    }
}

/// How an edge is measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum EdgeForm {
    /// Straight line between the two pixels around the crossing: for blurred edges.
    TwoPoint,
    /// Sum of partial areas over the pixels around the crossing: for sharp ones.
    PartialArea,
    /// The partial-area method of Trujillo-Pino on three lines of the degree of polarization: mode paper.
    ThreeLines,
}

impl EdgeForm {
    /// The form for the measured slopes of isolated edges.
    pub fn for_slopes(slopes: &mut [f64]) -> Self {
        match median(slopes) {
            Some(slope) if slope > SHARP_SLOPE => Self::PartialArea,
            _ => Self::TwoPoint,
        }
    }
}

fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Finds the edges of one axis.
pub(super) struct EdgeFinder<'a, T> {
    pub code: PrefixCode,
    pub form: EdgeForm,
    /// Variance in px^2 that is added to each edge for what noise does not explain.
    pub floor: f64,
    pub(super) frames: &'a Frames<'a, T>,
    pub(super) bits: &'a [BitFrames<'a, T>],
    values: &'a [i32],
    maps: &'a PixelMaps,
    pub(super) gates: &'a Gates,
    step: i32,
    /// Share of a pair's variance that the modulation has: its references' frames count inversely.
    modulation_share: f64,
}

impl<'a, T: Sample> EdgeFinder<'a, T> {
    pub fn new(
        frames: &'a Frames<'a, T>,
        maps: &'a PixelMaps,
        gates: &'a Gates,
        index: usize,
        step: i32,
    ) -> Self {
        let axis = &frames.axes[index];
        let per_frame = |count: usize| 1.0 / count.max(1) as f64;
        Self {
            code: axis.code,
            form: EdgeForm::TwoPoint,
            floor: 0.0,
            frames,
            bits: &axis.bits,
            values: &maps.values[index],
            maps,
            gates,
            step,
            modulation_share: (per_frame(frames.high.len()) + per_frame(frames.low.len())) / 2.0,
        }
    }

    /// Value of a valid pixel.
    pub fn value(&self, at: usize) -> Option<i32> {
        (self.maps.class[at].is_valid() && self.values[at] >= 0).then(|| self.values[at])
    }

    /// Normalised fringe of `bit` and its variance; `None` where a frame is saturated, which would bias the edge.
    fn fringe(&self, bit: u8, at: usize) -> Option<(f64, f64)> {
        let full = self.gates.saturation_dn;
        let modulation = f64::from(self.maps.modulation[at]);
        let (difference, variance) = match self.bits[usize::from(bit)] {
            BitFrames::Pair(p, q) => {
                let (p, q) = (p[at].dn(), q[at].dn());
                if p >= full || q >= full {
                    return None;
                }
                if self.gates.mode == Mode::Paper {
                    return Some(self.degree_fringe(p as f32, q as f32, at));
                }
                let sigma = f64::from(self.maps.sigma[at]);
                (f64::from(p - q), sigma * sigma)
            }
            BitFrames::Single(plane, inverse) => {
                let dn = plane[at].dn();
                if dn >= full {
                    return None;
                }
                let middle = self.mean(&self.frames.high, at) + self.mean(&self.frames.low, at);
                let sigma = f64::from(self.maps.sigma[at]);
                let variance =
                    4.0 * f64::from(self.gates.variance(dn as f32)) + sigma * sigma * self.modulation_share;
                let above = 2.0 * f64::from(dn) - middle;
                (if inverse { -above } else { above }, variance)
            }
        };
        let a = difference / modulation;
        let sigma = f64::from(self.maps.sigma[at]);
        let of_modulation = a * a * sigma * sigma * self.modulation_share;
        Some((a, (variance + of_modulation) / (modulation * modulation)))
    }

    pub(super) fn mean(&self, planes: &[&[T]], at: usize) -> f64 {
        planes.iter().map(|plane| f64::from(plane[at].dn())).sum::<f64>() / planes.len().max(1) as f64
    }

    /// Slopes of the fringe at the crossings of coarse bits on a line.
    pub fn coarse_slopes(&self, line: Line, slopes: &mut Vec<f64>) {
        for position in 0..line.len.saturating_sub(1) {
            let (at, next) = (line.at(position), line.at(position + 1));
            let (Some(here), Some(there)) = (self.value(at), self.value(next)) else { continue };
            if here.abs_diff(there) != 1 {
                continue;
            }
            let bit = self.code.bit_of_boundary(here.min(there));
            if (1u32 << (self.code.bits - bit)) < COARSE_STRIPE {
                continue;
            }
            if let (Some((a, _)), Some((b, _))) = (self.fringe(bit, at), self.fringe(bit, next)) {
                slopes.push((a - b).abs());
            }
        }
    }

    /// Walks along neighbouring lines at once, so that lines across the rows of the image share what is loaded.
    pub fn walk(&self, lines: &[Line], walks: &mut [Walk]) {
        lines.iter().zip(&mut *walks).for_each(|(line, walk)| walk.begin(*line, self));
        let len = lines.first().map_or(0, |line| line.len);
        for position in 0..len {
            for (line, walk) in lines.iter().zip(&mut *walks) {
                walk.step(self, *line, position);
            }
        }
        walks.iter_mut().for_each(|walk| walk.end(self));
    }

    /// Edges between two neighbouring pixels whose values differ.
    fn push_crossings(&self, line: Line, position: usize, (from, to): (i32, i32), walk: &mut Walk) {
        let first = walk.edges.len();
        for value in from.min(to)..from.max(to) {
            let bit = self.code.bit_of_boundary(value);
            let (at, next) = (line.at(position), line.at(position + 1));
            let (Some(a), Some(b)) = (self.fringe(bit, at), self.fringe(bit, next)) else { continue };
            // A bit that crosses twice between two pixels leaves no sign change and cannot be placed.
            if a.0 * b.0 > 0.0 || a.0 == b.0 {
                continue;
            }
            let (two_point, slope) = two_point(position, a, b);
            let other_form = match self.form {
                EdgeForm::TwoPoint => None,
                EdgeForm::PartialArea => self.partial_area(line, position, value, bit),
                EdgeForm::ThreeLines => self.three_lines(line, position, two_point, (value, bit)),
            };
            let (place, variance) = other_form.unwrap_or((two_point, slope.of_position));
            // The variance of the other forms does not follow from the slope between two pixels.
            let slope = if other_form.is_some() { Slope { value: 0.0, ..slope } } else { slope };
            let u = self.code.boundary(value);
            let edge = Edge { position: place, weight: 1.0 / (variance + self.floor), u, rising: to > from };
            let at = first + walk.edges[first..].partition_point(|edge| edge.position <= place);
            walk.edges.insert(at, edge);
            walk.slopes.measured.insert(at - walk.first_edge, slope);
        }
    }

    /// Partial-area form over the pixels around a crossing that belong to this edge alone: up to the middle of the
    /// stripes on both sides. `None` where there are too few.
    fn partial_area(&self, line: Line, position: usize, value: i32, bit: u8) -> Option<(f64, f64)> {
        let reach = 1i32 << (self.code.bits - 1 - bit);
        let fringe = |position: usize| {
            let at = line.at(position);
            // Twice the distance from the boundary, so that it is whole.
            let off = (2 * self.value(at)? - 2 * value - 1).abs();
            (off <= 2 * reach).then(|| self.fringe(bit, at)).flatten()
        };
        let left = (1..=AREA_REACH).map_while(|step| fringe(position.checked_sub(step)?)).collect::<Vec<_>>();
        let right = (2..=AREA_REACH + 1)
            .map_while(|step| (position + step < line.len).then(|| fringe(position + step)).flatten())
            .collect::<Vec<_>>();
        let (&start, &end) = (left.last()?, right.last()?);
        let inner = [fringe(position)?, fringe(position + 1)?];
        let height = start.0 - end.0;
        // Both ends must have left the edge: without plateaus the area says nothing.
        if start.0.abs() < 0.5 || end.0.abs() < 0.5 || start.0 * end.0 > 0.0 {
            return None;
        }
        let (mut area, mut variance) = (0.0, 0.0);
        for &(a, of_a) in left.iter().chain(&inner).chain(&right) {
            area += (a - end.0) / height;
            variance += of_a / (height * height);
        }
        let left_end = (position - left.len()) as f64 - 0.5;
        Some((left_end + area, variance))
    }
}

/// Crossing between two pixels: straight line through the two fringes, each stretched as the profile of a blurred
/// edge asks for. An isolated edge of height +-1 is `a = 2 Phi(t) - 1`; `t(a)` makes it straight, and the width of the
/// blur cancels. Where neighbouring stripes weaken the fringe, `a` is small and `t` as good as linear.
fn two_point(position: usize, (a, of_a): (f64, f64), (b, of_b): (f64, f64)) -> (f64, Slope) {
    let ((a, per_a), (b, per_b)) = (straightened(a), straightened(b));
    let slope = a - b;
    let (of_a, of_b) = (of_a * per_a * per_a, of_b * per_b * per_b);
    let of_position = (b * b * of_a + a * a * of_b) / slope.powi(4);
    (position as f64 + a / slope, Slope { value: slope.abs(), variance: of_a + of_b, of_position })
}

/// Quantile of the normal distribution at `(1 + a) / 2` up to a constant factor, and its derivative: its series to
/// a^7, with a last term that holds it within 1 % up to 0.9. Beyond 0.95 noise decides and `a` is held.
fn straightened(a: f64) -> (f64, f64) {
    const C: [f64; 4] = [0.2618, 0.1439, 0.0977, 0.232];
    let a = a.clamp(-0.95, 0.95);
    let s = a * a;
    let value = a * (1.0 + s * (C[0] + s * (C[1] + s * (C[2] + s * C[3]))));
    let slope = 1.0 + s * (3.0 * C[0] + s * (5.0 * C[1] + s * (7.0 * C[2] + s * 9.0 * C[3])));
    (value, slope)
}

/// Joins what noise has multiplied: the crossings of one boundary in a row count as one, `x1 - x2 + x3`, or as none
/// where they cancel.
fn join(edges: &mut Vec<Edge>, first: usize) {
    let mut kept = first;
    let mut at = first;
    while at < edges.len() {
        let u = edges[at].u;
        let group = edges[at..].iter().take_while(|edge| edge.u == u).count();
        if group == 1 {
            edges[kept] = edges[at];
            kept += 1;
        } else if group % 2 == 1 {
            let rising = edges[at].rising;
            let signed = |edge: &Edge| if edge.rising == rising { edge.position } else { -edge.position };
            let position = edges[at..at + group].iter().map(signed).sum();
            let variance: f64 = edges[at..at + group].iter().map(|edge| 1.0 / edge.weight).sum();
            edges[kept] = Edge { position, weight: 1.0 / variance, u, rising };
            kept += 1;
        }
        at += group;
    }
    edges.truncate(kept);
}

/// Second differences of three consecutive boundaries, with the variance that noise gives them.
pub(super) fn straightness(edges: &[Edge], triples: &mut Vec<(f64, f64)>) {
    for three in edges.windows(3) {
        let [a, b, c] = [three[0], three[1], three[2]];
        if b.u - a.u == c.u - b.u && (b.u - a.u).abs() == 1.0 {
            let bend = a.position - 2.0 * b.position + c.position;
            triples.push((1.0 / a.weight + 4.0 / b.weight + 1.0 / c.weight, bend * bend));
        }
    }
}

/// Variance of an edge's position beyond noise, in px^2: from the better measured half of the second differences, in
/// which it is counted six times.
pub(super) fn systematic_variance(triples: &mut [(f64, f64)]) -> f64 {
    triples.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)));
    let half = &triples[..triples.len().div_ceil(2)];
    let mut bends: Vec<f64> = half.iter().map(|triple| triple.1).collect();
    let Some(bend) = median(&mut bends) else { return 0.0 };
    let noise = half[half.len() / 2].0;
    ((bend / MEDIAN_CHI2 - noise) / 6.0).max(0.0)
}
