//! Projector coordinates finer than a pixel: stripe edges are measured where they cross the lines of the image, and
//! the coordinate between them comes from a local fit through the edges of one surface.
//!
//! Lines run along x where the value varies more along x, else along y; lines are independent of each other, so the
//! result does not depend on how they are spread over threads. Pixels without a fit (no two edges on their surface
//! nearby, missing low bits) keep the centre of their code's span with the standard deviation of a uniform
//! distribution over it, as does a pixel whose fit contradicts its code.

pub(super) mod area;
mod degree;
mod edges;
mod fit;

use std::borrow::Cow;

use polscan_patterns::Mode;
use rayon::prelude::*;

use self::{
    edges::{Edge, EdgeFinder, EdgeForm, Line, Walk},
    fit::{Fit, Segments},
};
use super::{
    gates::AxisShape,
    limits::Gates,
    plan::{Frames, PrefixCode},
    sample::Sample,
    types::{AxisMap, Class, Thresholds},
    words::PixelMaps,
};
use crate::{grid::Grid, simd::InstructionSet};

/// Lines of one task: neighbours share cache lines where lines run along y.
const LINES_PER_TASK: usize = 32;
/// Lines that blur and the systematic error of edges are measured on.
const SAMPLED_LINES: usize = 120;
/// How far a coordinate may lie from the centre of its code, in projector px: half a pixel, and as much again for the
/// asymmetry of blurred fine stripes; an edge pixel may carry either of two codes.
const MAX_OFF_CODE: f64 = 1.0;
const MAX_OFF_EDGE: f64 = 1.5;
/// Variance of a code by itself in px^2 (uniform over one px; an edge pixel may carry the code on either side of the
/// boundary). A fit that knows no better is not used.
const CODE_VARIANCE: f64 = 1.0 / 12.0;
const EDGE_CODE_VARIANCE: f64 = 1.0 / 12.0 + 1.0 / 4.0;
/// A pixel counts as measured at an edge up to this far from one, in px.
const AT_EDGE: f64 = 1.0;

/// Coordinate, sigma and whether it was interpolated, of the pixels of a line.
type LineOut<'a> = (&'a mut [f32], &'a mut [f32], &'a mut [bool]);

/// What the finder and the fits share on one thread.
#[derive(Default)]
struct Scratch {
    walks: Vec<Walk>,
    segments: Segments,
}

/// Coordinates of the axis with `index` in the plan, and which pixels lie between edges rather than at one.
pub(crate) fn refine<T: Sample>(
    frames: &Frames<'_, T>,
    maps: &PixelMaps,
    gates: &Gates,
    thresholds: &Thresholds,
    (index, shape): (usize, AxisShape),
    set: InstructionSet,
) -> (AxisMap, Vec<bool>) {
    let (width, height) = (frames.width, frames.height);
    let code = frames.axes[index].code;
    let (lines, len) = if shape.along_y { (width, height) } else { (height, width) };
    let line = |number: usize| match shape.along_y {
        true => Line { start: number, stride: width, len: height, number, lines, across: 1 },
        false => Line { start: number * width, stride: 1, len: width, number, lines, across: width },
    };
    let mut coordinate = vec![f32::NAN; width * height];
    let mut sigma = vec![f32::NAN; width * height];
    let mut between = vec![false; width * height];
    let mut finder = EdgeFinder::new(frames, maps, gates, index, shape.step);
    let fitted = code.shift == 0 && code.bits > 0;
    if fitted {
        calibrate(&mut finder, lines, line);
    }
    let size = LINES_PER_TASK * len;
    coordinate
        .par_chunks_mut(size)
        .zip(sigma.par_chunks_mut(size))
        .zip(between.par_chunks_mut(size))
        .enumerate()
        .for_each_init(Scratch::default, |scratch, (task, ((coordinate, sigma), between))| {
            let numbers = task * LINES_PER_TASK..(task * LINES_PER_TASK + coordinate.len() / len);
            let lines: Vec<Line> = numbers.map(line).collect();
            scratch.walks.resize_with(lines.len(), Walk::default);
            // Lines along rows follow each other in memory as they are.
            let together = if shape.along_y { lines.len() } else { 1 };
            for (lines, walks) in lines.chunks(together).zip(scratch.walks.chunks_mut(together)) {
                finder.walk(lines, walks);
            }
            let out = coordinate.chunks_mut(len).zip(sigma.chunks_mut(len)).zip(between.chunks_mut(len));
            for (walk, ((coordinate, sigma), between)) in scratch.walks.iter().zip(out) {
                let mut out = (coordinate, sigma, between);
                fill_codes(code, walk, &mut out);
                if fitted {
                    fill_fits(code, walk, (thresholds.fit_edges, set), &mut scratch.segments, &mut out);
                }
            }
        });
    if shape.along_y {
        coordinate = transposed(&coordinate, height, width);
        sigma = transposed(&sigma, height, width);
        between = transposed(&between, height, width);
    }
    let codes = maps.values[index]
        .par_iter()
        .map(
            |&value| {
                if value < 0 { -1 } else { code.span(value).map_or(-1, |(first, last)| (first + last) / 2) }
            },
        )
        .collect();
    let map = AxisMap {
        code: Grid::from_vec(width, height, codes),
        coordinate: Grid::from_vec(width, height, coordinate),
        sigma: Grid::from_vec(width, height, sigma),
    };
    (map, between)
}

/// Measures blur, chooses the form of the edge estimate by it, then measures the systematic error that it leaves.
fn calibrate<T: Sample>(finder: &mut EdgeFinder<'_, T>, lines: usize, line: impl Fn(usize) -> Line) {
    let stride = (lines / SAMPLED_LINES).max(1);
    let sampled = (stride / 2..lines).step_by(stride);
    let mut slopes = Vec::new();
    for number in sampled.clone() {
        finder.coarse_slopes(line(number), &mut slopes);
    }
    finder.form = match finder.gates.mode {
        Mode::Paper => EdgeForm::ThreeLines,
        _ => EdgeForm::for_slopes(&mut slopes),
    };
    let mut walk = [Walk::default()];
    let mut triples = Vec::new();
    for number in sampled {
        finder.walk(&[line(number)], &mut walk);
        let [walk] = &walk;
        for run in &walk.runs {
            edges::straightness(&walk.edges[run.edges.clone()], &mut triples);
        }
    }
    finder.floor = edges::systematic_variance(&mut triples);
}

/// The centre of the code's span at each valid pixel.
fn fill_codes(code: PrefixCode, walk: &Walk, (coordinate, sigma, _): &mut LineOut<'_>) {
    let (of_code, of_edge) = (CODE_VARIANCE.sqrt(), EDGE_CODE_VARIANCE.sqrt());
    let pixels = walk.values.iter().zip(&walk.classes);
    for ((&value, class), (coordinate, sigma)) in pixels.zip(coordinate.iter_mut().zip(sigma.iter_mut())) {
        if value < 0 {
            continue;
        }
        if let Some((first, last)) = code.span(value) {
            *coordinate = (first + last) as f32 / 2.0;
            let of_code = if *class == Class::Edge { of_edge } else { of_code };
            *sigma = (f64::from(last - first + 1) * of_code) as f32;
        }
    }
}

/// Fits along one line wherever there are edges.
fn fill_fits(
    code: PrefixCode,
    walk: &Walk,
    (fit_edges, set): (usize, InstructionSet),
    segments: &mut Segments,
    (coordinate, sigma, between): &mut LineOut<'_>,
) {
    for run in &walk.runs {
        let edges = &walk.edges[run.edges.clone()];
        segments.split(edges, fit_edges, set);
        let mut passed = 0;
        let mut known = usize::MAX;
        let mut fits: [Option<Cow<'_, Fit>>; 2] = [None, None];
        for position in run.pixels.clone() {
            let place = position as f64;
            while passed < edges.len() && edges[passed].position <= place {
                passed += 1;
            }
            let value = walk.values[position];
            if value < 0 {
                continue;
            }
            if known != passed {
                fits = segments.fits(edges, passed);
                known = passed;
            }
            let centre = code.boundary(value) - 0.5;
            let (limit, of_code) = match walk.classes[position] {
                Class::Edge => (MAX_OFF_EDGE, EDGE_CODE_VARIANCE),
                _ => (MAX_OFF_CODE, CODE_VARIANCE),
            };
            let best = fits
                .iter()
                .flatten()
                .map(|fit| fit.at(place))
                .filter(|&(u, variance)| (u - centre).abs() <= limit && variance > 0.0 && variance < of_code)
                .min_by(|a, b| (a.0 - centre).abs().total_cmp(&(b.0 - centre).abs()));
            let Some((u, variance)) = best else { continue };
            let near = |edge: Option<&Edge>| edge.is_some_and(|e| (e.position - place).abs() <= AT_EDGE);
            coordinate[position] = u as f32;
            sigma[position] = variance.sqrt() as f32;
            between[position] =
                !near(edges.get(passed)) && !near(passed.checked_sub(1).and_then(|i| edges.get(i)));
        }
    }
}

/// Rows become columns: `data` holds `rows.len() / width` lines of `width` values; the result has lines of `lines`.
fn transposed<V: Copy + Send + Sync>(data: &[V], len: usize, lines: usize) -> Vec<V> {
    const BLOCK: usize = 32;
    let mut out = data.to_vec();
    out.par_chunks_mut(BLOCK * lines).enumerate().for_each(|(block, rows)| {
        for first in (0..lines).step_by(BLOCK) {
            for (row, out) in rows.chunks_mut(lines).enumerate() {
                let position = block * BLOCK + row;
                for number in first..(first + BLOCK).min(lines) {
                    out[number] = data[number * len + position];
                }
            }
        }
    });
    out
}
