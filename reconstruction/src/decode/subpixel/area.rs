//! Sub-pixel edges from the areas that they cut off, after A. Trujillo-Pino, K. Krissian, M. Alemán-Flores and
//! D. Santana-Cedrés, "Accurate subpixel edge location based on partial area effect", Image and Vision Computing 31
//! (2013) 72-90. Pure arithmetic on a window of numbers.
//!
//! A pixel that an edge runs through holds `B + (A - B) s`, where `s` is the share of its area on the side of A. So the
//! sum along a line of n pixels, `S = n B + (A - B) l`, gives the length `l` on the side of A, averaged over the width
//! of the line, and with it the mean place `p` of the edge there. For an edge `t = a + b y + c y^2`, `y` counting lines
//! from the middle one,
//!
//! ```text
//! p_-1 = a - b + 13/12 c,   p_0 = a + 1/12 c,   p_1 = a + b + 13/12 c
//! ```
//!
//! which is solved for a, b and c. Of first order, c is 0. In an image that was smoothed by a kernel of 3x3 with centre
//! `k00`, sides `k01` and corners `k11`, the sums of three lines are mixed, and `1/12 c` becomes
//! `(1 + 24 k01 + 48 k11) / 12 c`. The result is exact where all pixels that the edge cuts lie inside the window and
//! A and B are the levels beside it.

/// Longest reach of a window from its middle pixel along the lines.
pub(in crate::decode) const MAX_REACH: usize = 4;
/// Lines of a window.
const LINES: usize = 3;
/// Pixels of a line, with one more at each end for smoothing.
const SIDE: usize = 2 * MAX_REACH + 3;

/// Shape of the edge.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::decode) enum Order {
    /// Straight.
    First,
    /// A parabola, which curved edges and silhouettes need.
    Second,
}

/// What is asked of a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::decode) struct Form {
    pub order: Order,
    /// Whether the image is first averaged over 3x3 pixels, as the method does with noisy ones.
    pub smoothed: bool,
    /// Of each line, how many pixels before and behind the middle one are in the window: each 1 to [`MAX_REACH`].
    pub reach: [[usize; 2]; LINES],
}

impl Form {
    /// Reach of line `y` before and behind the middle, in px.
    fn ends(self, y: i32) -> [i32; 2] {
        self.reach[(y + 1) as usize].map(|reach| reach as i32)
    }

    /// Lines, and for each the pixels, that are read: those of the window, and their neighbours where it is smoothed.
    fn pixels(self) -> impl Iterator<Item = (i32, i32)> {
        let more = i32::from(self.smoothed);
        (-1 - more..=1 + more).flat_map(move |y| {
            let near = (y - more).max(-1)..=(y + more).min(1);
            let [before, behind] =
                near.map(|y| self.ends(y)).fold([0; 2], |a, b| [a[0].max(b[0]), a[1].max(b[1])]);
            (-before - more..=behind + more).map(move |t| (y, t))
        })
    }
}

/// An edge `t = position + slope y + curvature y^2` about the middle of a window, t along the lines, in px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::decode) struct AreaEdge {
    pub position: f64,
    /// The position of first order, whatever was asked for.
    pub of_first_order: f64,
    /// In px per line.
    pub slope: f64,
    /// Coefficient of the square, half the second derivative.
    pub curvature: f64,
    /// Level before the edge (lower t), A of the method.
    pub before: f64,
    /// Level behind it, B.
    pub after: f64,
    /// Variance of `position` in px^2, for the variances given with the samples.
    pub variance: f64,
}

/// Values and variances around the middle, and the values of the (smoothed) image.
struct Window {
    image: [[f64; SIDE]; LINES + 2],
    variances: [[f64; SIDE]; LINES + 2],
}

/// Index of the middle pixel of a [`Window`].
const MIDDLE: i32 = SIDE as i32 / 2;
const MIDDLE_LINE: i32 = (LINES as i32 + 2) / 2;

impl Window {
    fn read(form: Form, sample: &mut impl FnMut(i32, i32) -> Option<(f64, f64)>) -> Option<Self> {
        let mut values = [[0.0; SIDE]; LINES + 2];
        let mut variances = values;
        for (y, t) in form.pixels() {
            let (line, at) = ((y + MIDDLE_LINE) as usize, (t + MIDDLE) as usize);
            (values[line][at], variances[line][at]) = sample(y, t)?;
        }
        let mut image = values;
        if form.smoothed {
            for line in 1..=LINES {
                let sum: [f64; SIDE] =
                    std::array::from_fn(|at| values[line - 1][at] + values[line][at] + values[line + 1][at]);
                for at in 1..SIDE - 1 {
                    image[line][at] = (sum[at - 1] + sum[at] + sum[at + 1]) / 9.0;
                }
            }
        }
        Some(Self { image, variances })
    }

    /// Value of the (smoothed) image.
    fn at(&self, y: i32, t: i32) -> f64 {
        self.image[(y + MIDDLE_LINE) as usize][(t + MIDDLE) as usize]
    }
}

/// The pixels, as (line, place along it), whose means are the levels before and behind an edge of this slope: the
/// outermost of the middle line and of that line on whose end the edge leaves more room.
fn level_pixels(form: Form, slope: f64) -> [[(i32, i32); 2]; 2] {
    let side = if slope > 0.0 { 1 } else { -1 };
    let [before, behind] = form.ends(0);
    [[(0, -before), (side, -form.ends(side)[0])], [(0, behind), (-side, form.ends(-side)[1])]]
}

/// How far the window of the pixel in the middle reaches: on each line and to each side as long as the change from pixel to
/// pixel falls and keeps its sign, up to [`MAX_REACH`]. `value(y, t)` is the smoothed image.
pub(in crate::decode) fn reach(value: impl Fn(i32, i32) -> Option<f64>) -> Option<[[usize; 2]; LINES]> {
    let one = |line: i32, way: i32| {
        let value = |t: usize| value(line, way * t as i32);
        let mut last = value(1)? - value(0)?;
        let mut reach = 1;
        while reach < MAX_REACH {
            let Some(next) = value(reach + 1).zip(value(reach)).map(|(a, b)| a - b) else { break };
            if next * last <= 0.0 || (reach > 1 && next.abs() >= last.abs()) {
                break;
            }
            last = next;
            reach += 1;
        }
        Some(reach)
    };
    let line = |y| Some([one(y, -1)?, one(y, 1)?]);
    Some([line(-1)?, line(0)?, line(1)?])
}

/// Finds the edge that runs across the lines near the middle of a window. `sample(y, t)` gives value and variance of the
/// pixel `y` lines and `t` pixels from the middle one. `None` where a sample is missing or the levels are equal.
pub(in crate::decode) fn locate(
    form: Form,
    mut sample: impl FnMut(i32, i32) -> Option<(f64, f64)>,
) -> Option<AreaEdge> {
    let window = Window::read(form, &mut sample)?;
    let line = |y: i32| -form.ends(y)[0]..=form.ends(y)[1];
    let sums = [-1, 0, 1].map(|y| line(y).map(|t| window.at(y, t)).sum::<f64>());
    let counts = [-1, 0, 1].map(|y| line(y).count() as f64);
    // Which way it leans follows from the levels that it leans between, but these from that: the ends will do.
    let [low, high] = [-form.ends(0)[0], form.ends(0)[1]].map(|t| window.at(0, t));
    let place = |y: usize, before: f64, after: f64| {
        (sums[y] - counts[y] * after) / (before - after) - form.reach[y][0] as f64 - 0.5
    };
    let slope = place(2, low, high) - place(0, low, high);
    let sets = level_pixels(form, slope);
    let [before, after] = sets.map(|set| set.iter().map(|&(y, t)| window.at(y, t)).sum::<f64>() / 2.0);
    let step = before - after;
    if step == 0.0 || !step.is_finite() {
        return None;
    }
    let offsets = [0, 1, 2].map(|y| place(y, before, after));
    let curvature = match form.order {
        Order::First => 0.0,
        Order::Second => (offsets[0] + offsets[2] - 2.0 * offsets[1]) / 2.0,
    };
    let shift = if form.smoothed { (1.0 + 24.0 / 9.0 + 48.0 / 9.0) / 12.0 } else { 1.0 / 12.0 };
    let position = offsets[1] - shift * curvature;
    // Weight of each line's offset in the position.
    let of_line = match form.order {
        Order::First => [0.0, 1.0, 0.0],
        Order::Second => [-shift / 2.0, 1.0 + shift, -shift / 2.0],
    };
    // Of all pixels in the sums, how many lie before the edge and how many behind it, as they enter the position.
    let weighed = |values: [f64; LINES]| -> f64 { values.iter().zip(of_line).map(|(v, w)| v * w).sum() };
    let length = position + weighed(form.reach.map(|[before, _]| before as f64 + 0.5));
    let lengths = [length, weighed(counts) - length];
    let variance = variance(form, &window, &sets, of_line, lengths) / (step * step);
    let slope = (offsets[2] - offsets[0]) / 2.0;
    Some(AreaEdge { position, of_first_order: offsets[1], slope, curvature, before, after, variance })
}

/// Variance of `position * (A - B)`: the position falls by the length before the edge over `A - B` per level of A, and by
/// the length behind it per level of B.
fn variance(
    form: Form,
    window: &Window,
    sets: &[[(i32, i32); 2]; 2],
    of_line: [f64; LINES],
    lengths: [f64; 2],
) -> f64 {
    let mut weights = [[0.0f64; SIDE]; LINES + 2];
    let mut add = |y: i32, t: i32, weight: f64| {
        let reach = i32::from(form.smoothed);
        let share = weight / f64::from((2 * reach + 1) * (2 * reach + 1));
        for dy in -reach..=reach {
            for dt in -reach..=reach {
                weights[(y + dy + MIDDLE_LINE) as usize][(t + dt + MIDDLE) as usize] += share;
            }
        }
    };
    for (y, weight) in (-1..=1).zip(of_line) {
        for t in -form.ends(y)[0]..=form.ends(y)[1] {
            add(y, t, weight);
        }
    }
    for (set, length) in sets.iter().zip(lengths) {
        for &(y, t) in set {
            add(y, t, -length / 2.0);
        }
    }
    let pairs = weights.iter().flatten().zip(window.variances.iter().flatten());
    pairs.map(|(weight, variance)| weight * weight * variance).sum()
}

#[cfg(test)]
mod tests;
