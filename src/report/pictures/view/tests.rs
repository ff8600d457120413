use super::*;
use crate::grid::Grid;

const CLOUD_SIDE: usize = 120;

/// A plate with a step and a hole.
fn cloud(width: usize, height: usize, depth: impl Fn(f32, f32) -> Option<f32>) -> Cloud {
    let point = |index: usize| {
        let (x, y) = ((index % width) as f32 - 60.0, (index / width) as f32 - 60.0);
        depth(x, y).map_or([f32::NAN; 3], |z| [x, y, z])
    };
    Cloud {
        point_mm: Grid::from_vec(width, height, (0..width * height).map(point).collect()),
        normal: Grid::filled(width, height, [0.0; 3]),
        sigma_z_mm: Grid::filled(width, height, 0.1),
        flags: Grid::filled(width, height, 0),
    }
}

fn settings() -> ViewSettings {
    ViewSettings { width: 400, height: 300, ..ViewSettings::default() }
}

/// Pixels that are neither white nor grey.
fn colored(picture: &RgbImage, columns: u32) -> usize {
    let is = |pixel: &image::Rgb<u8>| pixel.0.iter().max().unwrap() - pixel.0.iter().min().unwrap() > 30;
    picture.enumerate_pixels().filter(|(x, _, pixel)| *x < columns && is(pixel)).count()
}

#[test]
fn points_along_the_axes_go_where_the_eye_expects_them() {
    let view = Projection::of_box([-1.0; 3], [1.0; 3], &settings(), 1.0, [0.0, 0.0, 400.0, 300.0]);
    let [origin, right, down, away] =
        [[0.0; 3], [0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]].map(|point| view.pixel(point));
    assert!(right[0] > origin[0] && down[1] > origin[1]);
    // Seen from above and from the right, what is far lies higher and to the right, and is farther.
    assert!(away[1] < origin[1] && away[0] > origin[0] && away[2] > origin[2]);
    // The box just fills the area.
    let all: Vec<Vector> = corners([-1.0; 3], [1.0; 3]).map(|corner| view.pixel(corner)).collect();
    let edge =
        |axis: usize, pick: fn(f32, f32) -> f32, start| all.iter().map(|at| at[axis]).fold(start, pick);
    let (top, bottom) = (edge(1, f32::min, f32::INFINITY), edge(1, f32::max, 0.0));
    assert!((top - 0.0).abs() < 0.1 && (bottom - 300.0).abs() < 0.1, "{top} {bottom}");
    assert!(edge(0, f32::min, f32::INFINITY) >= 0.0 && edge(0, f32::max, 0.0) <= 400.0);
}

#[test]
fn a_surface_shows_without_gaps_and_a_hole_shows_as_one() {
    let whole = cloud_view(&cloud(CLOUD_SIDE, CLOUD_SIDE, |x, _| Some(900.0 + 0.1 * x)), &settings());
    let holed = cloud_view(
        &cloud(CLOUD_SIDE, CLOUD_SIDE, |x, y| (x.hypot(y) > 25.0).then_some(900.0 + 0.1 * x)),
        &settings(),
    );
    // The bar at the right is coloured as well.
    let columns = 400 - canvas::bar_width(canvas::text_height(300));
    let (all, rest) = (colored(&whole, columns), colored(&holed, columns));
    assert!(all > 15_000, "{all}");
    let hole = std::f64::consts::PI * 25.0 * 25.0 / (120.0 * 120.0);
    let share = 1.0 - rest as f64 / all as f64;
    assert!((share - hole).abs() < 0.02, "{share} against {hole}");
}

#[test]
fn nothing_is_spanned_across_a_depth_jump() {
    let step = cloud(CLOUD_SIDE, CLOUD_SIDE, |x, _| Some(if x < 0.0 { 900.0 } else { 960.0 }));
    let mesh = Mesh::new(&step.point_mm, 400);
    assert!(mesh.jump_mm < 30.0, "{}", mesh.jump_mm);
    // Seen from the camera itself the two halves meet; from the side a gap opens.
    let side = ViewSettings { azimuth_deg: 60.0, depth_scale: Some(1.0), ..settings() };
    let picture = cloud_view(&step, &side);
    let row = 150;
    let lit: Vec<bool> = (0..300)
        .map(|x| {
            let pixel = picture.get_pixel(x, row).0;
            pixel.iter().max().unwrap() - pixel.iter().min().unwrap() > 30
        })
        .collect();
    let first = lit.iter().position(|&lit| lit).unwrap();
    let last = lit.iter().rposition(|&lit| lit).unwrap();
    let gap = lit[first..=last].iter().filter(|&&lit| !lit).count();
    assert!(gap > 10, "{gap} px between the halves");
}

#[test]
fn the_nearer_surface_hides_the_farther_one() {
    let mut image = blank(20, 20, WHITE);
    let view = Projection::of_box(
        [-1.0; 3],
        [1.0; 3],
        &ViewSettings { azimuth_deg: 0.0, elevation_deg: 0.0, ..settings() },
        1.0,
        [0.0, 0.0, 20.0, 20.0],
    );
    let plane = |z: f32| {
        let points = vec![[-0.5, -0.5, z], [0.5, -0.5, z], [-0.5, 0.5, z], [0.5, 0.5, z]];
        Mesh {
            points: Grid::from_vec(2, 2, points),
            normals: Grid::filled(2, 2, [0.0, 0.0, -1.0]),
            jump_mm: 1.0,
        }
    };
    let range = Range { low: -1.0, high: 1.0 };
    // Both orders in one mesh: two strips that overlap in the picture.
    let mut points = plane(0.9).points.into_vec();
    points.extend(plane(-0.9).points.into_vec());
    points.extend(plane(0.8).points.into_vec());
    let both = Mesh {
        points: Grid::from_vec(2, 6, points),
        normals: Grid::filled(2, 6, [0.0, 0.0, -1.0]),
        jump_mm: 0.05,
    };
    raster::surface(&mut image, &both, &view, range);
    let mut alone = blank(20, 20, WHITE);
    raster::surface(&mut alone, &plane(-0.9), &view, range);
    assert_eq!(image.get_pixel(10, 10), alone.get_pixel(10, 10));
    assert_ne!(alone.get_pixel(10, 10).0, WHITE);
}

#[test]
fn normals_face_the_camera_and_follow_the_slope() {
    let tilted = cloud(CLOUD_SIDE, CLOUD_SIDE, |x, y| Some(900.0 + 0.3 * x - 0.2 * y));
    let mesh = Mesh::new(&tilted.point_mm, 60);
    let length = (0.3f32 * 0.3 + 0.2 * 0.2 + 1.0).sqrt();
    for normal in mesh.normals.data() {
        for (found, expected) in normal.iter().zip([0.3 / length, -0.2 / length, -1.0 / length]) {
            assert!((found - expected).abs() < 1e-3, "{normal:?}");
        }
    }
}

#[test]
fn thinning_keeps_surfaces_apart() {
    let step = cloud(CLOUD_SIDE, CLOUD_SIDE, |x, _| Some(if x < -0.5 { 900.0 } else { 960.0 }));
    let mesh = Mesh::new(&step.point_mm, 17);
    for point in mesh.points.data() {
        assert!(point[2] == 900.0 || point[2] == 960.0, "{point:?} lies on neither");
    }
}

#[test]
fn clouds_without_or_with_one_point_give_a_picture() {
    cloud_view(&cloud(10, 10, |_, _| None), &settings());
    cloud_view(&cloud(0, 0, |_, _| None), &settings());
    cloud_view(&cloud(1, 1, |_, _| Some(1000.0)), &settings());
    cloud_view(&cloud(30, 30, |_, _| Some(1000.0)), &ViewSettings { width: 1, height: 1, ..settings() });
}
