//! A display that does not settle, told by frames in the order in which they were taken. Each then is a mixture of its own
//! picture and of the frame before, `F = (1 - r) I + r B`, in about the same proportion everywhere. The own pictures of a
//! pair sum to the same light `C` in all pairs, so that `P + Q - r (B + P) = (1 - r) C`, and two pairs with the frames
//! before them give `r = (P1 + Q1 - P2 - Q2) / (B1 + P1 - B2 - P2)` without any reference. Where a frame shows another
//! picture, something moved or the light changed, no one `r` fits.

use polscan_patterns::Role;

use super::look::{Frames, sample};
use crate::{
    decode::{NoiseModel, Plane},
    report::statistics,
};

/// About so many pixels are looked at, and so many of a kind must tell.
const PIXELS: usize = 40_000;
const LEAST_PIXELS: usize = 100;
/// Difference of the frames before as a share of the light of a pair, over all pixels of a kind, from which on it tells.
const TELLING: f64 = 0.1;
/// How far P and Q must be apart, in units of the noise, to tell the bright one.
const APART_SIGMA: f64 = 4.0;
/// How far the rests of pixels of one kind may be from those of another, and the part of the rest that they may be apart
/// besides: between two exposures the display settles further than it had for the first of them, which the frames do not
/// show. Other causes leave one kind without any.
const TOLERANCE: f64 = 0.03;
const SETTLES_FURTHER: f64 = 1.0;
/// Rests that are a reason, and that are not the frame before itself.
const RESTS: std::ops::Range<f64> = 0.04..1.2;
/// Share of the neighbouring pairs that must tell of a rest, and their least number.
const FITTING: f64 = 0.7;
const LEAST_FITTING: usize = 3;

/// Share of the frame before that is left in the frames of two pairs, each `[before, frame, inverse]`; `None` where they do
/// not say so. `usable`: pixels that may be looked at.
pub fn rest(
    [one, other]: [[Plane<'_>; 3]; 2],
    noise: NoiseModel,
    black_dn: f64,
    saturation_dn: u16,
    usable: impl Fn(usize) -> bool,
) -> Option<f64> {
    let len = one.iter().chain(&other).map(|plane| plane.len()).min()?;
    let saturation = f64::from(saturation_dn);
    // Sums of numerator, denominator and light, and the count, of pixels by which frames of the two pairs are the bright ones:
    // the denominator has one sign in each.
    let mut kinds = [([0.0; 3], 0); 4];
    for at in (0..len).step_by((len / PIXELS).max(1)).filter(|&at| usable(at)) {
        let [[before, p, q], [other_before, other_p, other_q]] =
            [one, other].map(|planes| planes.map(|plane| sample(plane, at)));
        let all = [before, p, q, other_before, other_p, other_q];
        let apart =
            |a: f64, b: f64| (a - b).abs() > APART_SIGMA * (2.0 * noise.variance(a.max(b) - black_dn)).sqrt();
        if all.iter().any(|&dn| dn >= saturation) || !apart(p, q) || !apart(other_p, other_q) {
            continue;
        }
        let (sums, count) = &mut kinds[2 * usize::from(p > q) + usize::from(other_p > other_q)];
        let terms = [p + q - other_p - other_q, before + p - other_before - other_p, p + q - 2.0 * black_dn];
        sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
        *count += 1;
    }
    let middles = kinds.map(|([rest, difference, light], count)| {
        (count >= LEAST_PIXELS && difference.abs() > TELLING * light).then(|| rest / difference)
    });
    // What the frame before brightens and what it darkens: a change of the light goes one way.
    let both_ways = middles[..2].iter().any(Option::is_some) && middles[2..].iter().any(Option::is_some);
    let middles = || middles.iter().flatten().copied();
    let (low, high) = (middles().fold(f64::MAX, f64::min), middles().fold(f64::MIN, f64::max));
    let rest = 0.5 * (low + high);
    (both_ways && high - low <= TOLERANCE + SETTLES_FURTHER * rest && RESTS.contains(&rest)).then_some(rest)
}

/// The rest that most neighbouring pairs of a scan agree to have, the frames being in the order of the capture.
pub fn rest_of_all(frames: Frames) -> Option<f64> {
    let pairs = frames.all.windows(3).filter_map(|three| match three[1].0 {
        Role::Code { inverse: false, .. } => Some([three[0].1, three[1].1, three[2].1]),
        _ => None,
    });
    let pairs: Vec<_> = pairs.collect();
    let class = frames.decoded.class.data();
    let saturation_dn = frames.settings.camera.saturation_dn;
    let rests = pairs.windows(2).map(|two| {
        let (noise, black_dn) = (frames.decoded.noise, frames.decoded.black_level_dn);
        rest([two[0], two[1]], noise, black_dn, saturation_dn, |at| class[at].is_lit())
    });
    let mut rests: Vec<f64> = rests.flatten().collect();
    let fitting = rests.len() as f64 >= FITTING * pairs.len().saturating_sub(1) as f64;
    if fitting && rests.len() >= LEAST_FITTING { statistics::median(&mut rests) } else { None }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::decode::synth::{normal, random};

    const NOISE: NoiseModel = NoiseModel { gain_dn_per_electron: 0.4, read_noise_dn: 2.0 };
    const LEN: usize = 4096;

    /// What the projector shows in frame `frame` of a Gray code with inverses: 1000 DN where it is bright.
    fn own(frame: usize, at: usize) -> f64 {
        let gray = at ^ (at >> 1);
        let bright = (gray >> (11 - frame / 2)) & 1 == 1;
        100.0 + if bright == frame.is_multiple_of(2) { 1000.0 } else { 0.0 }
    }

    /// Frames of which each is what `mix` makes of its own picture and of the frame before, with noise.
    fn taken(mut mix: impl FnMut(usize, usize, f64, f64) -> f64) -> Vec<Vec<u16>> {
        let mut before = vec![100.0; LEN];
        (0..6)
            .map(|frame| {
                let seen: Vec<f64> = (0..LEN).map(|at| mix(frame, at, own(frame, at), before[at])).collect();
                let noisy = seen.iter().enumerate().map(|(at, dn)| {
                    let seed = random(frame as u64 + 9) ^ random(at as u64);
                    (dn + NOISE.variance(*dn).sqrt() * normal(seed)).max(0.0).round() as u16
                });
                let noisy = noisy.collect();
                before = seen;
                noisy
            })
            .collect()
    }

    /// The rest by the second pair and the third.
    fn found(frames: &[Vec<u16>]) -> Option<f64> {
        let planes = |from: usize| [0, 1, 2].map(|next| Plane::U16(&frames[from + next]));
        rest([planes(1), planes(3)], NOISE, 0.0, 4095, |_| true)
    }

    #[test]
    fn a_rest_of_any_size_is_measured() {
        for share in [0.06, 0.2, 0.45, 0.7] {
            let rest = found(&taken(|_, _, own, before| own + share * (before - own)));
            assert!(rest.is_some_and(|rest| (rest - share).abs() < 0.02), "{share}: {rest:?}");
        }
    }

    #[test]
    fn a_rest_of_what_settled_further_between_the_exposures_is_found() {
        for share in [0.1, 0.3, 0.5] {
            for further in [0.2, 0.7] {
                let mut picture = vec![100.0; LEN];
                let frames = taken(|_, at, own, before| {
                    let left = before + further * (picture[at] - before);
                    picture[at] = own;
                    own + share * (left - own)
                });
                // As a share of the frame before, which has less contrast than the picture that is left.
                let rest = found(&frames);
                assert!(
                    rest.is_some_and(|rest| (0.9..2.0).contains(&(rest / share))),
                    "{share} {further}: {rest:?}"
                );
            }
        }
    }

    #[test]
    fn nothing_else_is_a_rest() {
        assert_eq!(found(&taken(|_, _, own, _| own)), None, "nothing");
        for stale in 1..5 {
            let frames = taken(|frame, _, own, before| if frame == stale { before } else { own });
            assert_eq!(found(&frames), None, "frame {stale} stale");
        }
        for brighter in 1..5 {
            for gain in [0.8, 1.2] {
                let frames = taken(|frame, _, own, _| if frame == brighter { gain * own } else { own });
                assert_eq!(found(&frames), None, "frame {brighter} by {gain}");
            }
        }
    }
}
