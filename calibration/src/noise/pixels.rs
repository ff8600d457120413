//! Which pixels to look at, and which are ill.

/// Pixels beyond its neighbours by this many sigma of what neighbours differ by are ill.
const ILL_SIGMA: f64 = 8.0;
/// A dead pixel gets less than this share of what its neighbours get.
const DEAD_SHARE: f64 = 0.5;
/// Neighbours that may be as ill as the pixel itself: clusters have two or three.
const ILL_NEIGHBOURS: usize = 2;

/// Pixels that do not do as their neighbours.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct BadPixels {
    /// Column and row of pixels that are bright in the dark.
    pub hot: Vec<[u32; 2]>,
    /// Column and row of pixels that stay dark in the light.
    pub dead: Vec<[u32; 2]>,
}

/// Finds ill pixels in the mean of dark frames and the mean of bright ones, both row-major. `black_dn` is the level of no
/// light. Edges and corners of what is seen are none: there, at least three neighbours are alike.
pub fn bad_pixels(width: usize, dark: &[f32], bright: &[f32], black_dn: f64) -> BadPixels {
    let height = dark.len() / width.max(1);
    let mut differences: Vec<f32> = dark
        .chunks(width.max(1))
        .flat_map(|row| row.windows(2))
        .map(|pair| (pair[0] - pair[1]).abs())
        .collect();
    let spread = match differences.len() {
        0 => 0.0,
        count => *differences.select_nth_unstable_by(count / 2, f32::total_cmp).1,
    };
    // The median of |a - b| is 0.954 sigma of one of them. Rounded means may all be equal, hence the floor.
    let least = (ILL_SIGMA * f64::from(spread) / 0.954).max(1.0) as f32;
    let mut found = BadPixels::default();
    for y in 0..height {
        for x in 0..width {
            let at = y * width + x;
            let sorted = neighbours(width, height, x, y);
            let mut around: Vec<f32> = sorted.iter().map(|&index| dark[index]).collect();
            around.sort_unstable_by(f32::total_cmp);
            if around.len() > ILL_NEIGHBOURS && dark[at] > around[around.len() - 1 - ILL_NEIGHBOURS] + least {
                found.hot.push([x as u32, y as u32]);
            }
            let mut lit: Vec<f32> = sorted.iter().map(|&index| bright[index] - black_dn as f32).collect();
            lit.sort_unstable_by(f32::total_cmp);
            let light = bright[at] - black_dn as f32;
            if lit.len() > ILL_NEIGHBOURS
                && lit[ILL_NEIGHBOURS] > 4.0 * least
                && light < DEAD_SHARE as f32 * lit[ILL_NEIGHBOURS]
            {
                found.dead.push([x as u32, y as u32]);
            }
        }
    }
    found
}

fn neighbours(width: usize, height: usize, x: usize, y: usize) -> Vec<usize> {
    let rows = y.saturating_sub(1)..(y + 2).min(height);
    let columns = x.saturating_sub(1)..(x + 2).min(width);
    rows.flat_map(|row| columns.clone().map(move |column| row * width + column))
        .filter(|&index| index != y * width + x)
        .collect()
}

/// Indices of pixels that get between 0.4 and 1 times as much light as the brightest percent does; at most `most`, spread
/// evenly. `reference` must not be among the frames that are measured afterwards: choosing pixels by their own noise bends
/// the result.
pub fn evenly_lit(reference: &[f32], black_dn: f64, most: usize) -> Vec<u32> {
    if reference.is_empty() || most == 0 {
        return Vec::new();
    }
    let mut sorted = reference.to_vec();
    let rank = (sorted.len() - 1) * 99 / 100;
    let top = f64::from(*sorted.select_nth_unstable_by(rank, f32::total_cmp).1) - black_dn;
    let lit: Vec<u32> = (0u32..)
        .zip(reference)
        .filter(|(_, value)| {
            let light = f64::from(**value) - black_dn;
            light >= 0.4 * top && light <= top
        })
        .map(|(index, _)| index)
        .collect();
    let step = lit.len().div_ceil(most).max(1);
    lit.into_iter().step_by(step).collect()
}

/// Level at which over-exposed samples end, and the least that such a sample reads: `(mean, lowest)` in DN. `None` where
/// the samples still spread as light does, so that nothing has been clipped.
pub fn clip_level_dn(samples: &[u16]) -> Option<(f64, u16)> {
    if samples.len() < 100 {
        return None;
    }
    let mut sorted = samples.to_vec();
    sorted.sort_unstable();
    let at = |share: f64| sorted[((sorted.len() - 1) as f64 * share) as usize];
    let (median, low, high) = (at(0.5), at(0.05), at(0.95));
    // Light on a scene spreads by far more than the read noise that is left above a full well.
    let clipped = f64::from(high - low) <= (0.01 * f64::from(median)).max(1.0);
    let mean = sorted.iter().map(|&value| f64::from(value)).sum::<f64>() / sorted.len() as f64;
    clipped.then(|| (mean, at(0.001)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ill_pixels_are_found_and_edges_are_none() {
        let (width, height) = (40, 30);
        // A bright rectangle whose corners and edges must not count.
        let scene =
            |x: usize, y: usize| if (10..25).contains(&x) && (8..20).contains(&y) { 1000.0 } else { 100.0 };
        let hash = |at: usize| ((at * 2_654_435_761) >> 7) % 100;
        let mut dark: Vec<f32> = (0..width * height)
            .map(|at| 40.0 + 0.01 * scene(at % width, at / width) + hash(at) as f32 / 250.0)
            .collect();
        let mut bright: Vec<f32> =
            (0..width * height).map(|at| 40.0 + scene(at % width, at / width)).collect();
        assert_eq!(bad_pixels(width, &dark, &bright, 40.0), BadPixels::default());
        dark[5 * width + 7] += 30.0;
        dark[5 * width + 8] += 30.0;
        dark[0] += 30.0;
        bright[12 * width + 15] = 41.0;
        (0..width).for_each(|x| bright[25 * width + x] = 40.0);
        let found = bad_pixels(width, &dark, &bright, 40.0);
        assert_eq!(found.hot, [[0, 0], [7, 5], [8, 5]]);
        assert_eq!(found.dead.len(), 1 + width);
        assert!(found.dead.contains(&[15, 12]));
    }

    #[test]
    fn pixels_are_chosen_by_light_and_spread_evenly() {
        let reference: Vec<f32> = (0..1000).map(|at| 50.0 + at as f32).collect();
        let chosen = evenly_lit(&reference, 50.0, 60);
        assert!((50..=60).contains(&chosen.len()));
        assert!(chosen.iter().all(|&at| (390..=991).contains(&at)), "{chosen:?}");
        assert!(evenly_lit(&[], 0.0, 5).is_empty());
    }

    #[test]
    fn clipping_is_told_from_light() {
        let clipped: Vec<u16> = (0..1000).map(|at| 4080 + at % 3).collect();
        let (mean, low) = clip_level_dn(&clipped).unwrap();
        assert!((mean - 4081.0).abs() < 0.01 && low == 4080);
        let light: Vec<u16> = (0..1000).map(|at| 3000 + at % 500).collect();
        assert_eq!(clip_level_dn(&light), None);
    }
}
