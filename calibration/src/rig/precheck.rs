//! What can be refused before anything is solved.

use std::collections::BTreeSet;

use super::{
    report::Refusal,
    setup::{LensSetup, Setup},
};
use crate::observation::View;

/// No solution without so many views of a plane.
const FEWEST: usize = 3;
/// No pose without so many corners.
const FEWEST_CORNERS: usize = 6;

/// A smaller share of observations outside the image are single wrong ones, which the adjustment leaves out.
const STRAY_SHARE: f64 = 0.01;

/// All that is wrong with the views themselves.
pub(super) fn refusals(views: &[View], setup: &Setup) -> Vec<Refusal> {
    let mut refusals = Vec::new();
    let least = setup.gates.min_views.max(FEWEST);
    if views.len() < least {
        let message = format!(
            "too few views: {} given, at least {least} are needed; take more, with the board tilted differently",
            views.len()
        );
        refusals.push(Refusal::new("too-few-views", message).against(views.len() as f64, least as f64));
    }
    let camera = views.iter().flat_map(|v| v.corners.iter().map(move |c| (v, c.camera_px)));
    let seen = views.iter().flat_map(|v| v.plane_points.iter().map(move |p| (v, p.camera_px)));
    refusals.extend(outside("camera", &setup.camera, camera.chain(seen)));
    if let Some(lens) = &setup.projector {
        let lit = views.iter().flat_map(|v| v.plane_points.iter().map(move |p| (v, p.projector_px)));
        refusals.extend(outside("projector", lens, lit));
    }
    refusals.extend(views.iter().filter_map(|view| of_view(view, setup)));
    refusals
}

/// An observation that lies outside its image: the sizes are wrong, perhaps exchanged.
fn outside<'a>(
    who: &str,
    lens: &LensSetup,
    points: impl Iterator<Item = (&'a View, [f64; 2])> + Clone,
) -> Option<Refusal> {
    let (width, height) = lens.size;
    let within = |p: [f64; 2], width: u32, height: u32| {
        // Sub-pixel positions may lie half a pixel and a little noise beyond the last centre.
        (-2.0..f64::from(width) + 1.0).contains(&p[0]) && (-2.0..f64::from(height) + 1.0).contains(&p[1])
    };
    let (view, at) = points.clone().find(|(_, p)| !within(*p, width, height))?;
    let all = points.clone().count() as f64;
    if points.clone().filter(|(_, p)| !within(*p, width, height)).count() as f64 <= STRAY_SHARE * all {
        return None;
    }
    let exchanged = points.clone().all(|(_, p)| within(p, height, width));
    let place = format!(
        "view {}: ({:.1}, {:.1}) lies outside the {who}'s {width}x{height} px",
        view.name, at[0], at[1]
    );
    Some(if exchanged {
        let message = format!(
            "{place}, but all lie inside {height}x{width}: width and height are exchanged; give {height}x{width}"
        );
        Refusal::new("swapped-size", message)
    } else {
        Refusal::new("outside-image", format!("{place}; give the size of the image that was captured"))
            .of(&view.name)
    })
}

fn of_view(view: &View, setup: &Setup) -> Option<Refusal> {
    let (count, least) = (view.corners.len(), setup.gates.min_corners.max(FEWEST_CORNERS));
    let name = &view.name;
    let refusal = |slug, message, value: f64, limit: f64| {
        Some(Refusal::new(slug, message).of(name).against(value, limit))
    };
    if count < least {
        let message = format!(
            "view {name} has {count} corners, at least {least} are needed; drop it, or light the board better"
        );
        return refusal("few-corners", message, count as f64, least as f64);
    }
    if view.corners.iter().any(|c| c.camera_px.iter().chain(&c.board_mm).any(|v| !v.is_finite())) {
        return refusal(
            "few-corners",
            format!("view {name} has a corner that is not a number; drop it"),
            f64::NAN,
            0.0,
        );
    }
    setup.projector?;
    let share = lit_share(view);
    let limit = setup.gates.lit_share;
    if share >= limit {
        return None;
    }
    let message = if view.plane_points.is_empty() {
        format!("view {name} has no decoded points: the projector did not light the board; scan it again")
    } else {
        format!(
            "view {name}: only {:.0} % of the board is lit and decoded, at least {:.0} % must be: the board is partly \
             outside the projector's image; move it in, or drop the view",
            100.0 * share,
            100.0 * limit
        )
    };
    refusal("board-outside-projector", message, share, limit)
}

/// Share of a view's corners that have a plane point within three quarters of the corners' spacing.
fn lit_share(view: &View) -> f64 {
    let reach = 0.75 * spacing(view);
    let cell = |p: [f64; 2]| p.map(|v| (v / reach).floor() as i64);
    let points: BTreeSet<[i64; 2]> = view.plane_points.iter().map(|p| cell(p.camera_px)).collect();
    let lit = |p: [f64; 2]| {
        let [x, y] = cell(p);
        (x - 1..=x + 1).any(|x| (y - 1..=y + 1).any(|y| points.contains(&[x, y])))
    };
    view.corners.iter().filter(|c| lit(c.camera_px)).count() as f64 / view.corners.len().max(1) as f64
}

/// Median distance of a corner from the one nearest to it, in px.
fn spacing(view: &View) -> f64 {
    let away = |a: [f64; 2], b: [f64; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
    let nearest = |k: usize| {
        let at = view.corners[k].camera_px;
        let others = view.corners.iter().enumerate().filter(|(other, _)| *other != k);
        others.map(|(_, c)| away(at, c.camera_px)).fold(f64::INFINITY, f64::min)
    };
    let mut all: Vec<f64> = (0..view.corners.len()).map(nearest).collect();
    let middle = all.len() / 2;
    all.select_nth_unstable_by(middle, f64::total_cmp).1.max(1.0)
}
