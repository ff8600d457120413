//! Where one edge lies in the light of two states.

/// Pixels to both sides of an edge over which its light is summed: beyond the blur of lens and projector.
const REACH: usize = 10;
/// Light beside the edge, on its lit and on its dark side, as a share of the full picture's.
const LIT: f64 = 0.85;
const DARK: f64 = 0.15;

/// An edge of one pattern, seen in both states.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EdgeShift {
    /// Where the camera sees it in the first state, in px.
    pub camera_px: [f64; 2],
    /// Where on the projector it is drawn: column or row in px, a half between two pixels.
    pub projector_px: f64,
    /// How much farther along the camera's row (or column) the second state has it, in px.
    pub shift_px: f64,
}

/// Position along a line of pixels at which the first state's light goes from lit to dark or the other way, and how much
/// farther on the second's does. Lines hold the pattern's light as a share of the full picture's, `NaN` where there is
/// none. `None` without just one clear edge.
///
/// The position is the partial area: as far from the window's lit end as the sum of its shares. It is linear in the
/// light, so that noise in the second, darker state averages out over many lines.
pub fn edge_shift(first: &[f64], second: &[f64]) -> Option<(f64, f64)> {
    let count = first.len().min(second.len());
    let mut found = None;
    for at in REACH..count.saturating_sub(REACH + 1) {
        let crosses = (first[at] - 0.5) * (first[at + 1] - 0.5) <= 0.0 && first[at] != first[at + 1];
        if !crosses {
            continue;
        }
        let window = at - REACH..at + REACH + 1;
        let (begin, end) = (first[window.start], first[window.end - 1]);
        let falls = begin > LIT && end < DARK;
        if !(falls || begin < DARK && end > LIT) {
            continue;
        }
        let place = |line: &[f64]| -> f64 {
            let sum: f64 = line[window.clone()].iter().sum();
            if falls { window.start as f64 - 0.5 + sum } else { window.end as f64 - 0.5 - sum }
        };
        let (here, there) = (place(first), place(second));
        if !(here.is_finite() && there.is_finite()) {
            continue;
        }
        // Noise may cross twice at one edge; two edges are a line that is not understood.
        match found {
            Some((other, _)) if here - other > REACH as f64 => return None,
            Some(_) => {}
            None => found = Some((here, there - here)),
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A blurred step at `x`, lit before it, and its mirror image.
    fn step(x: f64, falls: bool) -> Vec<f64> {
        let rising = |at: usize| {
            // A box of a pixel and a ramp of four: its area is exact.
            let parts = 200;
            let light = |place: f64| ((place - x) / 4.0 + 0.5).clamp(0.0, 1.0);
            (0..parts)
                .map(|part| light(at as f64 - 0.5 + (f64::from(part) + 0.5) / f64::from(parts)))
                .sum::<f64>()
                / f64::from(parts)
        };
        (0..60).map(|at| if falls { 1.0 - rising(at) } else { rising(at) }).collect()
    }

    #[test]
    fn shifts_are_found_to_a_hundredth() {
        for falls in [true, false] {
            for (x, shift) in [(30.0, 0.0), (29.37, 0.8), (25.5, -1.3)] {
                let (at, found) = edge_shift(&step(x, falls), &step(x + shift, falls)).unwrap();
                assert!((at - x).abs() < 0.01 && (found - shift).abs() < 0.01, "{x} {shift}: {at} {found}");
            }
        }
    }

    #[test]
    fn lines_without_just_one_edge_say_nothing() {
        let edge = step(30.0, true);
        assert_eq!(edge_shift(&vec![1.0; 60], &edge), None);
        assert_eq!(edge_shift(&vec![f64::NAN; 60], &edge), None);
        let two = [step(30.0, true), step(30.0, false)].concat();
        assert_eq!(edge_shift(&two, &two), None);
        assert_eq!(edge_shift(&[], &[]), None);
        let mut hidden = edge.clone();
        hidden[33] = f64::NAN;
        assert_eq!(edge_shift(&edge, &hidden), None);
    }
}
