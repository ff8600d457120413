//! How steep the fringe is at edges, for their weights.

use super::Edge;

/// Edges on each side that the slope of an edge is compared with.
const NEIGHBOURS: usize = 12;
/// Fewest slopes that a mean is taken of.
const FEWEST: f64 = 3.0;
/// Relative variance of measured slopes at which an edge's own counts half. Measured weights that vary with the noise cost
/// precision: `1 + 6 r` of the variance for a relative variance `r` of the slopes. A mean in place of slopes that truly
/// differ costs some tenth of it whatever the noise.
const HALF: f64 = 0.06;

/// What was measured of one edge beside its place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Slope {
    /// Per px; 0 where the edge's variance does not follow from it.
    pub value: f64,
    /// What noise gives `value`.
    pub variance: f64,
    /// Of the edge's position in px^2, with this slope.
    pub of_position: f64,
}

/// Of the edges of a run, in their order.
#[derive(Debug, Default)]
pub(super) struct Slopes {
    pub measured: Vec<Slope>,
    /// Sums of value, variance and count of what is before each edge, apart for boundaries of even and odd number.
    sums: Vec<[[f64; 3]; 2]>,
}

impl Slopes {
    pub fn clear(&mut self) {
        self.measured.clear();
    }

    /// Gives edges, measured from `first` on, weights by the slopes of their neighbours where noise hides their own, and
    /// forgets the slopes. Every second boundary is one of the finest stripes, whose fringe is flatter, so that each is
    /// compared with its like. `zero` is the coordinate of boundary 0, `floor` what is added to each variance.
    pub fn weigh(&mut self, edges: &mut [Edge], zero: f64, floor: f64) {
        let like = |edge: &Edge| (edge.u - zero).round().rem_euclid(2.0) as usize;
        self.sums.clear();
        let mut sum = [[0.0; 3]; 2];
        self.sums.push(sum);
        for (edge, slope) in edges.iter().zip(&self.measured) {
            if slope.value > 0.0 {
                let of_like = &mut sum[like(edge)];
                for (sum, value) in of_like.iter_mut().zip([slope.value, slope.variance, 1.0]) {
                    *sum += value;
                }
            }
            self.sums.push(sum);
        }
        for (number, (edge, slope)) in edges.iter_mut().zip(&self.measured).enumerate() {
            let last = (number + NEIGHBOURS + 1).min(self.measured.len());
            let (before, until) = (&self.sums[number.saturating_sub(NEIGHBOURS)], &self.sums[last]);
            let [sum, noise, count]: [f64; 3] = {
                let like = like(edge);
                std::array::from_fn(|part| until[like][part] - before[like][part])
            };
            if slope.value > 0.0 && count >= FEWEST {
                let mean = sum / count;
                let relative = noise / count / (mean * mean * HALF);
                let own = 1.0 / (1.0 + relative * relative);
                let believed = mean + own * (slope.value - mean);
                let share = slope.value / believed;
                edge.weight = 1.0 / (slope.of_position * share * share + floor);
            }
        }
        self.measured.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::{
        subpixel::edges::two_point,
        synth::{erf, normal, random},
    };

    /// Boundaries that are `PITCH_PX` apart, seen through a blur of `BLUR_PX`, as a rig of the paper's kind shows them.
    const PITCH_PX: f64 = 2.94;
    const BLUR_PX: f64 = 2.06;

    /// Edges of one line under noise of `sigma`, with what was measured of them, and how far off each is.
    fn line(sigma: f64, seed: u64) -> (Vec<Edge>, Slopes, Vec<f64>) {
        let begin = random(seed) as f64 / u64::MAX as f64;
        let mut key = seed << 8;
        let (mut edges, mut slopes, mut off) = (Vec::new(), Slopes::default(), Vec::new());
        for number in 0..17 {
            let truth = begin + PITCH_PX * f64::from(number);
            let profile = |x: f64| erf((truth - x) / (BLUR_PX * std::f64::consts::SQRT_2));
            let pixels: Vec<(f64, f64)> = (-3..=4)
                .map(|step| {
                    key += 1;
                    (profile(truth.floor() + f64::from(step)) + sigma * normal(key), sigma * sigma)
                })
                .collect();
            // As words tell: between the two pixels where the fringe changes its sign.
            let Some(at) = pixels.windows(2).position(|two| two[0].0 > 0.0 && two[1].0 <= 0.0) else {
                continue;
            };
            let (position, slope) = two_point(at, pixels[at], pixels[at + 1]);
            let position = position + truth.floor() - 3.0;
            edges.push(Edge {
                position,
                weight: 1.0 / slope.of_position,
                u: f64::from(number) - 0.5,
                rising: true,
            });
            slopes.measured.push(slope);
            off.push(position - truth);
        }
        (edges, slopes, off)
    }

    fn weighted(off: &[f64], edges: &[Edge]) -> (f64, f64) {
        let weights: f64 = edges.iter().map(|edge| edge.weight).sum();
        (off.iter().zip(edges).map(|(off, edge)| off * edge.weight).sum::<f64>() / weights, 1.0 / weights)
    }

    /// Squares of the error of weighted means and the variances that they claim: before, after.
    fn trial(sigma: f64) -> [[f64; 2]; 2] {
        let mut sums = [[0.0; 2]; 2];
        for seed in 0..4000 {
            let (mut edges, mut slopes, off) = line(sigma, seed);
            for sums in &mut sums {
                let (error, claimed) = weighted(&off, &edges);
                sums[0] += error * error;
                sums[1] += claimed;
                slopes.weigh(&mut edges, -0.5, 0.0);
            }
        }
        sums
    }

    #[test]
    fn where_noise_hides_slopes_edges_are_the_better_and_their_variance_the_truer() {
        let [own, neighbours] = trial(0.0872);
        assert!(neighbours[0] < 0.85 * own[0], "{own:?} {neighbours:?}");
        let claims = |sums: [f64; 2]| (sums[0] / sums[1]).sqrt();
        // What is left comes of crossings that noise has moved to the next pair of pixels.
        assert!((1.0..1.2).contains(&claims(neighbours)), "{neighbours:?}");
        assert!(claims(own) > claims(neighbours) + 0.1, "{own:?} {neighbours:?}");
    }

    #[test]
    fn in_good_light_each_edge_keeps_its_own_slope() {
        let (before, mut slopes, _) = line(0.002, 1);
        let mut after = before.clone();
        slopes.weigh(&mut after, -0.5, 0.0);
        for (before, after) in before.iter().zip(&after) {
            assert!((after.weight / before.weight - 1.0).abs() < 1e-3, "{before:?} {after:?}");
        }
    }

    #[test]
    fn edges_of_other_forms_and_lonely_ones_are_left_alone() {
        let (before, mut slopes, _) = line(0.1, 2);
        slopes.measured.iter_mut().step_by(2).for_each(|slope| slope.value = 0.0);
        let mut after = before.clone();
        slopes.weigh(&mut after, -0.5, 0.0);
        assert!(slopes.measured.is_empty());
        assert!((0..before.len()).step_by(2).all(|number| after[number] == before[number]));
        assert!((1..before.len()).step_by(2).all(|number| after[number] != before[number]));
        let (before, mut slopes, _) = line(0.1, 2);
        slopes.measured.truncate(4);
        let mut after = before[..4].to_vec();
        slopes.weigh(&mut after, -0.5, 0.0);
        assert_eq!(after, before[..4]);
    }

    #[test]
    fn the_floor_stays_outside_the_slope() {
        let (plain, slopes, _) = line(0.1, 2);
        let weighed = |floor: f64| {
            let mut edges = plain.clone();
            let mut again = Slopes { measured: slopes.measured.clone(), sums: Vec::new() };
            again.weigh(&mut edges, -0.5, floor);
            edges
        };
        for (with, without) in weighed(0.25).iter().zip(weighed(0.0)) {
            assert!((1.0 / with.weight - 1.0 / without.weight - 0.25).abs() < 1e-9);
        }
    }
}
