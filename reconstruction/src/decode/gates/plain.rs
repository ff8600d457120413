//! The gates as the text has them, pixel by pixel: what the fast ones are held against.

use super::{AxisShape, AxisView, BoundaryCheck, gray, is_outvoted, steps::Crossings, weak_threshold};
use crate::decode::{
    plan::Frames,
    types::{Class, Thresholds},
    words::{PixelMaps, WEAK_UNKNOWN},
};

/// As [`super::apply`].
pub(crate) fn apply<T>(
    frames: &Frames<'_, T>,
    maps: &mut PixelMaps,
    thresholds: &Thresholds,
) -> (Vec<BoundaryCheck>, Vec<AxisShape>) {
    let (width, height) = (frames.width, frames.height);
    let mut checks = Vec::new();
    let mut views = Vec::new();
    for (index, axis) in frames.axes.iter().enumerate() {
        let values = &maps.values[index][..];
        let snap = (2.0 * thresholds.snap_px / f64::from(1u32 << axis.code.shift)).floor() as i32;
        let shape = axis_shape(values, width, height, snap);
        let mut view = AxisView { values, width, height, shape, suspect: 0, jumps: Vec::new() };
        let crossings = count_crossings(&view, axis.code.bits);
        let rises = crossings.iter().map(|crossing| crossing.travel).sum::<i64>() >= 0;
        for (bit, crossing) in crossings.into_iter().enumerate() {
            let against = if rises { crossing.falling } else { crossing.rising };
            let (legal, illegal) = (crossing.legal, crossing.illegal);
            let check = BoundaryCheck { axis: axis.axis, bit: bit as u8, legal, illegal, against };
            if check.is_suspect() {
                view.suspect |= 1 << (usize::from(axis.code.bits) - 1 - bit);
            }
            checks.push(check);
        }
        views.push(view);
    }
    let weak_below = weak_threshold(&maps.weakest);
    let mut gated = maps.class.clone();
    for (at, class) in gated.iter_mut().enumerate().filter(|(_, class)| class.is_valid()) {
        let weakest = maps.weakest[at];
        if views.iter().any(|view| view.is_off_boundary(at % width, at / width)) {
            *class = Class::OffBoundary;
        } else if weakest != WEAK_UNKNOWN && f32::from(weakest) < weak_below {
            *class = Class::Interreflection;
        }
    }
    let before = gated.clone();
    for (at, class) in gated.iter_mut().enumerate().filter(|(_, class)| class.is_valid()) {
        if is_outvoted(&before, &views, at % width, at / width) {
            *class = Class::Vote;
        }
    }
    let shapes = views.iter().map(|view| view.shape).collect();
    maps.class = gated;
    (checks, shapes)
}

fn axis_shape(values: &[i32], width: usize, height: usize, snap: i32) -> AxisShape {
    let sorted = |offset: usize, columns: usize, rows: usize| {
        let mut steps = Vec::new();
        for at in (0..rows).flat_map(|y| y * width..y * width + columns) {
            if values[at] >= 0 && values[at + offset] >= 0 {
                steps.push(values[at].abs_diff(values[at + offset]).min(64));
            }
        }
        steps.sort_unstable();
        steps
    };
    let along_x = sorted(1, width.saturating_sub(1), height);
    let along_y = sorted(width, width, height.saturating_sub(1));
    // Mean of the smaller 95 %.
    let variation = |steps: &[u32]| {
        let kept = &steps[..steps.len() - steps.len() / 20];
        f64::from(kept.iter().sum::<u32>()) / steps.len().max(1) as f64
    };
    let vertical = variation(&along_y) > variation(&along_x);
    let steps = if vertical { &along_y } else { &along_x };
    // The least step that nine of ten do not exceed.
    let typical = (steps.len() * 9).div_ceil(10).checked_sub(1).map_or(0, |at| steps[at] as i32);
    AxisShape { along_y: vertical, step: snap.max(2 * typical).max(2) }
}

fn count_crossings(view: &AxisView<'_>, bits: u8) -> Vec<Crossings> {
    let mut counts = vec![Crossings::default(); usize::from(bits)];
    for y in 0..view.height {
        for x in 0..view.width {
            let at = y * view.width + x;
            if x + 1 < view.width {
                count(view, view.values[at], view.values[at + 1], !view.shape.along_y, &mut counts);
            }
            if y + 1 < view.height {
                count(view, view.values[at], view.values[at + view.width], view.shape.along_y, &mut counts);
            }
        }
    }
    counts
}

fn count(view: &AxisView<'_>, here: i32, there: i32, along: bool, counts: &mut [Crossings]) {
    if here < 0 || there < 0 || here == there {
        return;
    }
    let changed = gray(here) ^ gray(there);
    let legal = here.abs_diff(there) as i32 <= view.shape.step;
    if !legal && changed.count_ones() > 1 {
        return;
    }
    let last = counts.len() - 1;
    for place in (0..counts.len()).filter(|place| (changed >> place) & 1 == 1) {
        counts[last - place].add(Crossings {
            legal: u64::from(legal),
            illegal: u64::from(!legal),
            rising: u64::from(legal && along && there > here),
            falling: u64::from(legal && along && there < here),
            travel: if legal && along { i64::from(there - here) } else { 0 },
        });
    }
}
