//! A bounded number of plane points per view, spread evenly over the image.

use std::collections::BTreeMap;

use crate::observation::PlanePoint;

/// At most about `limit` of the points: of each cell of a square grid over them the one nearest to its middle.
///
/// Neighbouring pixels share the noise of the stripes that they were interpolated from, so that points apart say more
/// than as many points side by side, and their noise is independent, as the adjustment takes it to be.
pub(super) fn thinned(points: &[PlanePoint], limit: usize) -> Vec<PlanePoint> {
    let finite = |p: &&PlanePoint| p.camera_px.iter().chain(&p.projector_px).all(|v| v.is_finite());
    let points: Vec<&PlanePoint> = points.iter().filter(finite).collect();
    if points.len() <= limit || limit == 0 {
        return points.into_iter().take(limit).copied().collect();
    }
    // Boards seldom fill their bounding box, so a cell of an equal share of it gives too few points: count and correct.
    let mut cell = (area(&points) / limit as f64).sqrt().max(1e-9);
    let mut picked = pick(&points, cell);
    for _ in 0..8 {
        let share = picked.len() as f64 / limit as f64;
        if (0.9..=1.0).contains(&share) {
            break;
        }
        cell *= (share / 0.95).sqrt().clamp(0.5, 2.0);
        picked = pick(&points, cell);
    }
    picked.truncate(limit);
    picked
}

fn area(points: &[&PlanePoint]) -> f64 {
    let side = |axis: usize| {
        let values = points.iter().map(|p| p.camera_px[axis]);
        let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        high - low + 1.0
    };
    side(0) * side(1)
}

fn pick(points: &[&PlanePoint], cell: f64) -> Vec<PlanePoint> {
    let mut cells: BTreeMap<(i64, i64), (f64, &PlanePoint)> = BTreeMap::new();
    for point in points {
        let at = point.camera_px.map(|v| v / cell);
        let key = at.map(|v| v.floor() as i64);
        let off = (at[0] - key[0] as f64 - 0.5).hypot(at[1] - key[1] as f64 - 0.5);
        let entry = cells.entry((key[1], key[0])).or_insert((off, point));
        if off < entry.0 {
            *entry = (off, point);
        }
    }
    cells.into_values().map(|(_, point)| *point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn disc(radius: i32) -> Vec<PlanePoint> {
        let all = (-radius..=radius).flat_map(|y| (-radius..=radius).map(move |x| (x, y)));
        let inside = all.filter(|(x, y)| x * x + y * y <= radius * radius);
        let point = |(x, y)| PlanePoint { camera_px: [f64::from(x), f64::from(y)], projector_px: [0.0; 2] };
        inside.map(point).collect()
    }

    #[test]
    fn the_limit_is_nearly_reached_and_never_passed() {
        for (radius, limit) in [(200, 2000), (90, 500), (40, 300), (300, 64)] {
            let count = thinned(&disc(radius), limit).len();
            assert!(count <= limit && count as f64 > 0.8 * limit as f64, "{count} of {limit}");
        }
        let few = disc(5);
        assert_eq!(thinned(&few, 1000), few);
        assert!(thinned(&few, 0).is_empty());
    }

    #[test]
    fn what_is_kept_is_spread_evenly() {
        let kept = thinned(&disc(200), 2000);
        for (x, y) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
            let quarter = kept.iter().filter(|p| p.camera_px[0] * x > 0.0 && p.camera_px[1] * y > 0.0);
            let share = quarter.count() as f64 / kept.len() as f64;
            assert!((share - 0.25).abs() < 0.03, "{share}");
        }
    }

    #[test]
    fn numbers_that_are_none_are_left_out() {
        let mut points = disc(3);
        points[4].projector_px[1] = f64::NAN;
        assert_eq!(thinned(&points, 1000).len(), points.len() - 1);
    }
}
