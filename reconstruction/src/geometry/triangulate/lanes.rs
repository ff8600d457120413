//! [`Triangulator::solve`] for neighbouring pixels of a row at once, one to a lane of vector registers. Each lane does the
//! same operations in the same order, so that results are equal to the bit.

#![allow(clippy::needless_range_loop, reason = "one index counts the lanes of several arrays")]

use super::{INTEGER_SIGMA, MAX_STEPS, MIN_INVERSE_DEPTH, MIN_SIGMA, STEP_TOLERANCE, Triangulator};

/// Pixels that are solved together.
pub(crate) const LANES: usize = 8;
/// One value of each pixel.
pub(crate) type Lane = [f64; LANES];
/// Which pixels something holds for.
type Mask = [bool; LANES];

const NONE: Mask = [false; LANES];

/// What the decoder measured, by projector axis (column, row); NaN where it did not.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Measurements {
    /// Projector coordinates in px.
    pub pixel: [Lane; 2],
    /// Their standard deviations in px; taken as 1/sqrt(12) unless positive and finite.
    pub sigma: [Lane; 2],
}

/// Depths, as in [`Solution`](super::Solution); what is not `found` means nothing.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Solutions {
    pub found: Mask,
    pub point_mm: [Lane; 3],
    pub sigma_z_mm: Lane,
    pub projector_px: [Lane; 2],
    pub row_error_px: Lane,
    pub row_error_sigma_px: Lane,
}

/// Projector pixels at inverse depths, their derivatives by it, and whether the points lie before the projector.
#[derive(Clone, Copy)]
struct Seen {
    ahead: Mask,
    pixel: [Lane; 2],
    slope: [Lane; 2],
}

impl Seen {
    /// Takes over the lanes for which `take` says so.
    #[inline(always)]
    fn select(&mut self, from: &Self, take: &Mask) {
        for axis in 0..2 {
            self.pixel[axis] = select(take, &from.pixel[axis], &self.pixel[axis]);
            self.slope[axis] = select(take, &from.slope[axis], &self.slope[axis]);
        }
    }
}

#[inline(always)]
fn select(mask: &Mask, yes: &Lane, no: &Lane) -> Lane {
    let mut out = [0.0; LANES];
    for l in 0..LANES {
        // Both are read first: a load that depends on the mask keeps the compiler from using vector registers.
        let (yes, no) = (yes[l], no[l]);
        out[l] = if mask[l] { yes } else { no };
    }
    out
}

impl Triangulator {
    /// Depths of the camera pixels from (x, y) on. Pixels beyond the row's end are not found.
    #[inline(always)]
    pub(crate) fn solve_lanes(&self, x: usize, y: usize, measured: &Measurements) -> Solutions {
        let (dx, dy, q) = self.directions(x, y);
        let pixel = &measured.pixel;
        let mut sigma = [[0.0; LANES]; 2];
        let mut coded = [NONE; 2];
        for axis in 0..2 {
            for l in 0..LANES {
                let given = measured.sigma[axis][l];
                let usable = given.is_finite() & (given > 0.0);
                let bounded = if given > MIN_SIGMA { given } else { MIN_SIGMA };
                sigma[axis][l] = if usable { bounded } else { INTEGER_SIGMA };
                coded[axis][l] = pixel[axis][l].is_finite();
            }
        }
        let (mut both, mut by_column, mut wanted) = (NONE, NONE, NONE);
        let t = &self.translation_mm;
        for l in 0..LANES {
            let gain = [
                self.projector.fx * (t.x * q[2][l] - q[0][l] * t.z),
                self.projector.fy * (t.y * q[2][l] - q[1][l] * t.z),
            ];
            let columns_say_more = (gain[0] / sigma[0][l]).abs() >= (gain[1] / sigma[1][l]).abs();
            both[l] = coded[0][l] & coded[1][l];
            wanted[l] = coded[0][l] | coded[1][l];
            by_column[l] = coded[0][l] & (!coded[1][l] | !self.rows_carry_depth() | columns_say_more);
        }
        let (mut w, mut seen, mut found) = self.meet_planes(&q, &by_column, pixel, &wanted);
        let slope = select(&by_column, &seen.slope[0], &seen.slope[1]);
        let of_slope = select(&by_column, &sigma[0], &sigma[1]);
        let mut information = [0.0; LANES];
        for l in 0..LANES {
            let ratio = slope[l] / of_slope[l];
            information[l] = ratio * ratio;
        }
        if self.rows_carry_depth() && both != NONE {
            self.weigh_lanes(&q, pixel, &sigma, &both, (&mut w, &mut seen, &mut information, &mut found));
        }
        let zero = [0.0; LANES];
        let mut out = Solutions {
            found: NONE,
            point_mm: [zero; 3],
            sigma_z_mm: zero,
            projector_px: seen.pixel,
            row_error_px: zero,
            row_error_sigma_px: zero,
        };
        for l in 0..LANES {
            let ahead = q[2][l] + w[l] * t.z > 0.0;
            out.found[l] = found[l] & (w[l] > MIN_INVERSE_DEPTH) & (information[l] > 0.0) & ahead;
            let z = 1.0 / w[l];
            out.point_mm[0][l] = dx[l] * z;
            out.point_mm[1][l] = dy[l] * z;
            out.point_mm[2][l] = z;
            out.sigma_z_mm[l] = z * z / information[l].sqrt();
            let (du, dv) = (seen.slope[0][l], seen.slope[1][l]);
            let norm = (du * du + dv * dv).sqrt();
            let missed = [pixel[0][l] - seen.pixel[0][l], pixel[1][l] - seen.pixel[1][l]];
            let error = 1.0f64.copysign(du) * (du * missed[1] - dv * missed[0]) / norm;
            let (along, across) = (du * sigma[1][l], dv * sigma[0][l]);
            out.row_error_px[l] = if both[l] { error } else { f64::NAN };
            out.row_error_sigma_px[l] =
                if both[l] { (along * along + across * across).sqrt() / norm } else { f64::NAN };
        }
        out
    }

    /// Rays in the camera's frame, (dx, dy, 1), and turned into the projector's.
    #[inline(always)]
    fn directions(&self, x: usize, y: usize) -> (Lane, Lane, [Lane; 3]) {
        let row = self.rays.directions().row(y);
        let (mut dx, mut dy) = ([f64::NAN; LANES], [f64::NAN; LANES]);
        for (l, [to_x, to_y]) in row.iter().skip(x).take(LANES).enumerate() {
            (dx[l], dy[l]) = (*to_x, *to_y);
        }
        let mut q = [[0.0; LANES]; 3];
        let r = &self.rotation;
        for (axis, q) in q.iter_mut().enumerate() {
            for l in 0..LANES {
                q[l] = r[(axis, 0)] * dx[l] + r[(axis, 1)] * dy[l] + r[(axis, 2)];
            }
        }
        (dx, dy, q)
    }

    #[inline(always)]
    fn see_lanes(&self, q: &[Lane; 3], w: &Lane) -> Seen {
        let t = &self.translation_mm;
        let none = [[0.0; LANES]; 2];
        let mut seen = Seen { ahead: NONE, pixel: none, slope: none };
        for l in 0..LANES {
            let depth = q[2][l] + w[l] * t.z;
            seen.ahead[l] = (depth > 0.0) & depth.is_finite();
            let inverse = 1.0 / depth;
            let (x, y) = ((q[0][l] + w[l] * t.x) * inverse, (q[1][l] + w[l] * t.y) * inverse);
            let (slope_x, slope_y) = ((t.x - x * t.z) * inverse, (t.y - y * t.z) * inverse);
            let (distorted_x, distorted_y, [xx, xy, yy]) = self.projector.distort_with_jacobian(x, y);
            seen.pixel[0][l] = self.projector.fx * distorted_x + self.projector.cx;
            seen.pixel[1][l] = self.projector.fy * distorted_y + self.projector.cy;
            seen.slope[0][l] = self.projector.fx * (xx * slope_x + xy * slope_y);
            seen.slope[1][l] = self.projector.fy * (xy * slope_x + yy * slope_y);
        }
        seen
    }

    /// Inverse depths at which the rays meet the surfaces of the measured column, or row.
    #[inline(always)]
    fn meet_planes(
        &self,
        q: &[Lane; 3],
        by_column: &Mask,
        pixel: &[Lane; 2],
        wanted: &Mask,
    ) -> (Lane, Seen, Mask) {
        let t = &self.translation_mm;
        let value = select(by_column, &pixel[0], &pixel[1]);
        let of_axis = select(by_column, &q[0], &q[1]);
        let of_projector = |column: f64, row: f64| select(by_column, &[column; LANES], &[row; LANES]);
        let focal = of_projector(self.projector.fx, self.projector.fy);
        let centre = of_projector(self.projector.cx, self.projector.cy);
        let shift = of_projector(t.x, t.y);
        let mut w = [0.0; LANES];
        for l in 0..LANES {
            let plane = (value[l] - centre[l]) / focal[l];
            let start = (of_axis[l] - plane * q[2][l]) / (plane * t.z - shift[l]);
            let depth = q[2][l] + start * t.z;
            w[l] = if (depth > 0.0) & depth.is_finite() { start } else { 0.0 };
        }
        let mut seen = self.see_lanes(q, &w);
        let (mut found, mut active) = (NONE, NONE);
        for l in 0..LANES {
            active[l] = wanted[l] & seen.ahead[l];
        }
        for _ in 0..MAX_STEPS {
            if active == NONE {
                break;
            }
            let here = select(by_column, &seen.pixel[0], &seen.pixel[1]);
            let slope = select(by_column, &seen.slope[0], &seen.slope[1]);
            let mut step = [0.0; LANES];
            for l in 0..LANES {
                step[l] = (value[l] - here[l]) / slope[l];
            }
            self.step(q, &step, (&mut w, &mut seen), (&mut active, &mut found));
        }
        (w, seen, found)
    }

    /// Moves the active lanes on; those that arrive are found, those that leave the projector's front are given up.
    /// Returns which were moved.
    #[inline(always)]
    fn step(
        &self,
        q: &[Lane; 3],
        step: &Lane,
        (w, seen): (&mut Lane, &mut Seen),
        (active, found): (&mut Mask, &mut Mask),
    ) -> Mask {
        let mut next_w = [0.0; LANES];
        for l in 0..LANES {
            next_w[l] = w[l] + step[l];
        }
        let next = self.see_lanes(q, &next_w);
        let mut take = NONE;
        for l in 0..LANES {
            take[l] = active[l] & next.ahead[l];
        }
        *w = select(&take, &next_w, w);
        seen.select(&next, &take);
        for l in 0..LANES {
            let arrived = take[l] & (step[l].abs() <= STEP_TOLERANCE * next_w[l].abs());
            found[l] |= arrived;
            active[l] = take[l] & !arrived;
        }
        take
    }

    /// Inverse depths that fit column and row best, for the lanes that have `both`.
    #[inline(always)]
    fn weigh_lanes(
        &self,
        q: &[Lane; 3],
        pixel: &[Lane; 2],
        sigma: &[Lane; 2],
        both: &Mask,
        (w, seen, information, found): (&mut Lane, &mut Seen, &mut Lane, &mut Mask),
    ) {
        let mut active = NONE;
        for l in 0..LANES {
            active[l] = found[l] & both[l];
            found[l] &= !both[l];
        }
        for _ in 0..MAX_STEPS {
            if active == NONE {
                break;
            }
            let (mut step, mut known) = ([0.0; LANES], [0.0; LANES]);
            for l in 0..LANES {
                let (mut pull, mut information) = (0.0, 0.0);
                for axis in 0..2 {
                    let weight = seen.slope[axis][l] / (sigma[axis][l] * sigma[axis][l]);
                    pull += weight * (pixel[axis][l] - seen.pixel[axis][l]);
                    information += weight * seen.slope[axis][l];
                }
                (step[l], known[l]) = (pull / information, information);
            }
            let moved = self.step(q, &step, (&mut *w, &mut *seen), (&mut active, &mut *found));
            *information = select(&moved, &known, information);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{
        geometry::{Calibration, Measurement, triangulate::tests::any_rig},
        simd::{InstructionSet, Work},
    };

    struct Solve<'a>(&'a Triangulator, usize, usize, &'a Measurements);

    impl Work for Solve<'_> {
        type Output = Solutions;

        #[inline(always)]
        fn run(self) -> Solutions {
            self.0.solve_lanes(self.1, self.2, self.3)
        }
    }

    fn check(calibration: &Calibration, seed: u64) {
        use crate::decode::synth::{random, uniform};
        let triangulator = Triangulator::new(calibration).unwrap();
        let (width, height) = (calibration.camera.width as usize, calibration.camera.height as usize);
        for block in 0..64 {
            let random = |index: usize| random(seed ^ random((block * 100 + index) as u64));
            // Some blocks reach beyond the image.
            let (x, y) = (random(90) as usize % width, random(91) as usize % height);
            let value = |index: usize, scale: f64| match random(index) % 11 {
                0 => f64::NAN,
                1 => -scale * uniform(random(index + 50)),
                _ => scale * uniform(random(index + 50)),
            };
            let lane = |from: usize, scale: f64| std::array::from_fn(|l| value(from + l, scale));
            let measured = Measurements {
                pixel: [lane(0, 1100.0), lane(8, 800.0)],
                sigma: [lane(16, 0.3), lane(24, 0.3)],
            };
            for set in InstructionSet::available() {
                let found = set.run(Solve(&triangulator, x, y, &measured));
                for l in 0..LANES {
                    let one = Measurement {
                        column: measured.pixel[0][l],
                        sigma_column: measured.sigma[0][l],
                        row: measured.pixel[1][l],
                        sigma_row: measured.sigma[1][l],
                    };
                    let plain = (x + l < width).then(|| triangulator.solve(x + l, y, &one)).flatten();
                    assert_eq!(found.found[l], plain.is_some(), "{set:?} {one:?}: {plain:?}");
                    let Some(plain) = plain else { continue };
                    let bits = |values: &[f64]| {
                        values.iter().map(|v| if v.is_nan() { 0 } else { v.to_bits() }).collect::<Vec<_>>()
                    };
                    assert_eq!(bits(&found.point_mm.map(|v| v[l])), bits(&plain.point_mm), "{set:?} {one:?}");
                    assert_eq!(
                        bits(&found.projector_px.map(|v| v[l])),
                        bits(&plain.projector_px),
                        "{set:?} {one:?}"
                    );
                    let rest = [found.sigma_z_mm[l], found.row_error_px[l], found.row_error_sigma_px[l]];
                    let plain = [plain.sigma_z_mm, plain.row_error_px, plain.row_error_sigma_px];
                    assert_eq!(bits(&rest), bits(&plain), "{set:?} {one:?}");
                }
            }
        }
    }

    proptest! {
        #[test]
        fn every_instruction_set_solves_as_the_plain_loop_does(calibration in any_rig(), seed: u64) {
            check(&calibration, seed);
        }
    }
}
