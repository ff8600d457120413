//! Fits of windows together against one window at a time, to the bit, with every set of vector instructions.

use proptest::prelude::*;

use super::*;

/// Edges of a surface with noise, bends and jumps.
fn edges(seed: u64, count: usize) -> Vec<Edge> {
    use crate::decode::synth::{random, uniform};
    let at = |index: usize, salt: u64| uniform(random(seed ^ random(index as u64 * 8 + salt)));
    let noise = 10f64.powf(at(0, 7) * 3.0 - 3.0);
    let (mut position, mut u) = (20.0, 100.5);
    (0..count)
        .map(|index| {
            position += 1.0 + 2.0 * at(index, 0) * (0.2 + at(0, 6));
            u += if at(index, 1) < 0.03 { 1.0 + 9.0 * at(index, 2) } else { 1.0 };
            let bend = 1e-3 * at(0, 5) * position * position;
            Edge {
                position: position + noise * (at(index, 3) - 0.5),
                weight: (0.5 + at(index, 4)) / (noise * noise),
                u: (u + bend).round() + 0.5,
                rising: index % 2 == 0,
            }
        })
        .collect()
}

/// What [`Segments`] gives, made window by window: the segment of each edge, and the fits before it.
fn plainly(edges: &[Edge], fit_edges: usize) -> Vec<[Option<Cow<'static, Fit>>; 2]> {
    let mut starts = vec![0];
    for next in 1..edges.len() {
        if jumps(edges, starts[starts.len() - 1], next) {
            starts.push(next);
        }
    }
    let segment = |edge: usize| {
        let index = starts.partition_point(|&start| start <= edge) - 1;
        (starts[index], starts.get(index + 1).copied().unwrap_or(edges.len()))
    };
    let fit = |(start, end): (usize, usize), passed: usize| {
        fit_windows(edges, &Windows::around(start, end, passed, fit_edges), || None)
    };
    (0..=edges.len())
        .map(|passed| {
            let before = passed.checked_sub(1).map(segment);
            let after = (passed < edges.len()).then(|| segment(passed));
            if before == after {
                return [before.and_then(|of| fit(of, passed)), None];
            }
            [before.and_then(|of| fit(of, passed)), after.and_then(|of| fit(of, passed))]
        })
        .collect()
}

fn bits(fit: &Option<Cow<'_, Fit>>) -> Option<Vec<u64>> {
    fit.as_ref().map(|fit| {
        let numbers = [fit.origin].into_iter().chain(fit.coefficients).chain(fit.covariance);
        numbers.map(f64::to_bits).collect()
    })
}

proptest! {
    #[test]
    fn windows_together_are_fitted_as_windows_alone(seed: u64, count in 1usize..90, fit_edges in 2usize..12) {
        let edges = edges(seed, count);
        let plain = plainly(&edges, fit_edges);
        let mut segments = Segments::default();
        for set in InstructionSet::available() {
            // What was fitted before must leave nothing behind.
            segments.split(&edges[..count / 2], fit_edges, set);
            segments.split(&edges, fit_edges, set);
            for (passed, plain) in plain.iter().enumerate() {
                let fits = segments.fits(&edges, passed);
                prop_assert_eq!(fits.each_ref().map(bits), plain.each_ref().map(bits), "{:?} {}", set, passed);
            }
        }
    }
}

#[test]
fn any_number_of_edges_can_be_asked_for() {
    let edges: Vec<Edge> = (0..12)
        .map(|index| Edge {
            position: 3.0 * f64::from(index),
            weight: 100.0,
            u: f64::from(index) + 0.5,
            rising: index % 2 == 0,
        })
        .collect();
    let mut segments = Segments::default();
    for passed in 0..=edges.len() {
        let mut asked_for = |many| {
            segments.split(&edges, many, InstructionSet::widest());
            segments.fits(&edges, passed).map(|fit| fit.map(Cow::into_owned))
        };
        let all = asked_for(edges.len());
        assert!(all.iter().any(Option::is_some));
        for many in [usize::MAX, usize::MAX / 2 + 1, usize::MAX - 3] {
            assert_eq!(asked_for(many), all);
        }
    }
}
