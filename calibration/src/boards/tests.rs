//! Boards drawn with known corners: found where they are, whatever is done to the picture, or refused by name.

use std::f64::consts::PI;

use nalgebra::Matrix3;
use polscan_reconstruction::{decode, grid::Grid};
use rand::{RngExt, SeedableRng, rngs::StdRng};

use super::{
    print::{Shape, dark_shapes},
    *,
};

fn charuco(legacy: bool) -> Board {
    let dictionary = Dictionary::Bits4;
    let board = Charuco { columns: 9, rows: 6, square_mm: 10.0, marker_mm: 7.5, dictionary, legacy };
    Board::new(Pattern::Charuco(board))
}

fn checkerboard(columns: u32, rows: u32) -> Board {
    Board::new(Pattern::Checkerboard(Checkerboard { columns, rows, square_mm: 10.0 }))
}

fn circles(columns: u32, rows: u32, asymmetric: bool) -> Board {
    let (pitch_mm, diameter_mm) = if asymmetric { (16.0, 7.0) } else { (10.0, 5.0) };
    Board::new(Pattern::Circles(Circles { columns, rows, pitch_mm, diameter_mm, asymmetric }))
}

/// How a board is seen.
struct Scene {
    to_picture: Matrix3<f64>,
    blur_px: f64,
    noise: f64,
    hidden: Option<[f64; 4]>,
}

const SIZE: [usize; 2] = [480, 360];

/// The board's middle in the middle of the picture, `scale` px per mm, turned in the plane and tilted.
fn scene(board: &Board, scale: f64, turn_deg: f64, tilt: [f64; 2]) -> Scene {
    let [width, height] = board.size_mm();
    let (sin, cos) = (turn_deg * PI / 180.0).sin_cos();
    let to_middle = Matrix3::new(1.0, 0.0, -0.5 * width, 0.0, 1.0, -0.5 * height, 0.0, 0.0, 1.0);
    let turn = Matrix3::new(scale * cos, -scale * sin, 0.0, scale * sin, scale * cos, 0.0, 0.0, 0.0, 1.0);
    let tilt = Matrix3::new(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, tilt[0], tilt[1], 1.0);
    let to_centre = Matrix3::new(1.0, 0.0, 239.3, 0.0, 1.0, 179.6, 0.0, 0.0, 1.0);
    Scene { to_picture: to_centre * tilt * turn * to_middle, blur_px: 0.7, noise: 1.0, hidden: None }
}

fn through(matrix: &Matrix3<f64>, [x, y]: [f64; 2]) -> [f64; 2] {
    let point = matrix * nalgebra::Vector3::new(x, y, 1.0);
    [point.x / point.z, point.y / point.z]
}

/// Draws by 6x6 samples in each pixel, then blurs and adds noise.
fn draw(board: &Board, scene: &Scene) -> Picture {
    let [width, height] = SIZE;
    let back = scene.to_picture.try_inverse().unwrap();
    let shapes = dark_shapes(board);
    let size = board.size_mm();
    // Shapes by 1 mm cell: a picture takes millions of look-ups.
    let mut cells: std::collections::HashMap<[i64; 2], Vec<Shape>> = Default::default();
    for shape in shapes {
        let [left, top, right, bottom] = match shape {
            Shape::Rectangle([x, y, w, h]) => [x, y, x + w, y + h],
            Shape::Disc([x, y, r]) => [x - r, y - r, x + r, y + r],
        };
        for v in top.floor() as i64..=bottom.floor() as i64 {
            for u in left.floor() as i64..=right.floor() as i64 {
                cells.entry([u, v]).or_default().push(shape);
            }
        }
    }
    let tone = |at: [f64; 2]| {
        // A sheet with a margin, before something darker than it but lighter than the ink.
        let margin = 6.0;
        if (0..2).any(|axis| at[axis] < -margin || at[axis] > size[axis] + margin) {
            return 120.0;
        }
        let cell = at.map(|value| value.floor() as i64);
        let dark = cells.get(&cell).is_some_and(|shapes| shapes.iter().any(|shape| shape.contains(at)));
        if dark { 200.0 * board.tones.dark } else { 200.0 * board.tones.light }
    };
    let mut data = vec![0.0f32; width * height];
    for (index, value) in data.iter_mut().enumerate() {
        let [x, y] = [(index % width) as f64, (index / width) as f64];
        let hidden = scene.hidden.is_some_and(|[l, t, r, b]| x >= l && x < r && y >= t && y < b);
        let mut sum = 0.0;
        for sample in 0..36 {
            // Elsewhere in each pixel: an edge along a row of samples would jump by a sixth of a pixel.
            let shift = (index as f64 * 0.618_033_988_7 + f64::from(sample) * 0.754_877_666_2).fract();
            let [u, v] = [f64::from(sample % 6) + shift, f64::from(sample / 6) + (shift * 7.0).fract()]
                .map(|at| at / 6.0 - 0.5);
            sum += if hidden { 90.0 } else { tone(through(&back, [x + u, y + v])) };
        }
        *value = (sum / 36.0) as f32;
    }
    let blurred = Picture::new(width, height, data).blurred(scene.blur_px);
    let mut random = StdRng::seed_from_u64(5);
    let noisy = blurred.data().iter().map(|value| {
        // Box-Muller.
        let (u, v): (f64, f64) = (random.random_range(1e-12..1.0), random.random_range(0.0..1.0));
        value + (scene.noise * (-2.0 * u.ln()).sqrt() * (2.0 * PI * v).cos()) as f32
    });
    Picture::new(width, height, noisy.collect())
}

/// Root mean square distance of corners from where they are, with their root mean square stated deviation.
fn misses(scene: &Scene, found: &Found) -> (f64, f64) {
    let mut sums = (0.0, 0.0);
    for corner in &found.corners {
        let true_px = through(&scene.to_picture, corner.corner.board_mm);
        let at = corner.corner.camera_px;
        sums.0 += (at[0] - true_px[0]).powi(2) + (at[1] - true_px[1]).powi(2);
        sums.1 += corner.sigma_px.powi(2);
    }
    let count = found.corners.len() as f64;
    ((sums.0 / count).sqrt(), (sums.1 / count).sqrt())
}

fn find(board: &Board, scene: &Scene) -> Result<Found, DetectError> {
    detect(board, &draw(board, scene), DetectSettings::default())
}

#[test]
fn boards_of_all_kinds_are_found_whole_and_right_side_up_however_they_lie() {
    // Each of these tells its ends apart.
    let boards = [checkerboard(8, 5), charuco(false), charuco(true), circles(4, 9, true)];
    for board in boards {
        for (turn, tilt) in
            [(0.0, [0.0, 0.0]), (100.0, [8e-4, -3e-4]), (181.0, [-9e-4, 5e-4]), (-75.0, [2e-4, 1e-3])]
        {
            let scene = scene(&board, 3.1, turn, tilt);
            let found = find(&board, &scene).unwrap_or_else(|error| panic!("{board:?} {turn}: {error}"));
            assert_eq!(found.corners.len(), board.points().len(), "{board:?} {turn}");
            let (miss, sigma) = misses(&scene, &found);
            assert!(miss < 0.08, "{board:?} {turn}: {miss} px");
            // What is stated is what noise does, a part of the whole.
            assert!(sigma > 0.1 * miss && sigma < 3.0 * miss, "{board:?} {turn}: {miss} {sigma}");
        }
    }
}

#[test]
fn a_perfect_picture_whose_edges_lie_between_pixels_is_no_trap() {
    // Every corner is amid four pixels that respond alike.
    for board in [checkerboard(8, 5), charuco(false)] {
        let mut scene = Scene { noise: 0.0, ..scene(&board, 3.0, 0.0, [0.0; 2]) };
        let [x, y] = through(&scene.to_picture, [0.0; 2]);
        let to_edge =
            Matrix3::new(1.0, 0.0, x.floor() + 0.5 - x, 0.0, 1.0, y.floor() + 0.5 - y, 0.0, 0.0, 1.0);
        scene.to_picture = to_edge * scene.to_picture;
        let found = find(&board, &scene).unwrap_or_else(|error| panic!("{board:?}: {error}"));
        assert_eq!(found.corners.len(), board.points().len(), "{board:?}");
        let (miss, _) = misses(&scene, &found);
        assert!(miss < 0.08, "{board:?}: {miss} px");
    }
}

#[test]
fn a_board_that_looks_the_same_after_half_a_turn_is_numbered_from_either_end() {
    for board in [checkerboard(8, 6), checkerboard(7, 7), circles(7, 5, false)] {
        let scene = scene(&board, 3.0, 12.0, [5e-4, 3e-4]);
        let found = find(&board, &scene).unwrap();
        assert_eq!(found.corners.len(), board.points().len());
        // Upright it is numbered from the top left.
        assert!(misses(&scene, &found).0 < 0.08, "{board:?}: {:?}", misses(&scene, &found));
    }
}

#[test]
fn noise_costs_no_corner_and_the_stated_deviation_grows_with_it() {
    let board = charuco(false);
    let mut before = 0.0;
    for noise in [0.5, 4.0] {
        let scene = Scene { noise, ..scene(&board, 3.3, 20.0, [5e-4, 0.0]) };
        let found = find(&board, &scene).unwrap();
        assert_eq!(found.corners.len(), 40);
        let (miss, sigma) = misses(&scene, &found);
        assert!(miss < 0.15, "{noise}: {miss}");
        assert!(sigma > before, "{noise}: {sigma}");
        before = sigma;
    }
}

#[test]
fn part_of_a_board_with_markers_is_enough_and_of_one_without_is_refused() {
    let hidden = Some([0.0, 0.0, 220.0, 360.0]);
    let board = charuco(true);
    let scene_of = |board: &Board| Scene { hidden, ..scene(board, 3.2, 5.0, [0.0; 2]) };
    let found = find(&board, &scene_of(&board)).unwrap();
    assert!((12..30).contains(&found.corners.len()), "{}", found.corners.len());
    let (miss, _) = misses(&scene_of(&board), &found);
    // Corners that the edge of what hides the board runs through are left out.
    assert!(miss < 0.08, "{miss}");
    let board = checkerboard(9, 6);
    let refused = find(&board, &scene_of(&board)).unwrap_err();
    assert!(matches!(refused, DetectError::Extent { wanted: [8, 5], .. }), "{refused}");
    let board = circles(7, 5, false);
    let refused = find(&board, &scene_of(&board)).unwrap_err();
    assert!(matches!(refused, DetectError::Discs { found: 3..30, wanted: 35 }), "{refused}");
}

#[test]
fn what_is_not_the_board_is_refused_by_name() {
    let drawn = checkerboard(9, 6);
    let picture = draw(&drawn, &scene(&drawn, 3.2, 0.0, [0.0; 2]));
    let settings = DetectSettings::default();
    let other = detect(&checkerboard(10, 7), &picture, settings).unwrap_err();
    assert_eq!(other, DetectError::Extent { found: [8, 5], wanted: [9, 6] });
    let markers = detect(&charuco(false), &picture, settings).unwrap_err();
    assert!(matches!(markers, DetectError::Markers { corners: 40 }), "{markers}");
    let discs = detect(&circles(7, 5, false), &picture, settings).unwrap_err();
    assert!(matches!(discs, DetectError::Nothing { .. } | DetectError::Discs { .. }), "{discs}");
    let empty = Picture::new(480, 360, vec![100.0; 480 * 360]);
    for board in [drawn, charuco(false), circles(7, 5, false)] {
        assert!(matches!(detect(&board, &empty, settings), Err(DetectError::Nothing { .. })));
    }
    // The other layout has most markers one square aside.
    let legacy = draw(&charuco(true), &scene(&charuco(true), 3.2, 2.0, [0.0; 2]));
    let refused = detect(&charuco(false), &legacy, settings).unwrap_err();
    assert!(matches!(refused, DetectError::Markers { .. }), "{refused}");
}

#[test]
fn a_blurred_picture_is_refused_with_the_width_of_its_edges() {
    for board in [checkerboard(9, 6), charuco(false)] {
        let sharp = find(&board, &scene(&board, 3.2, 3.0, [0.0; 2])).unwrap();
        // A pixel's box and the lens together.
        let expected = (2.0 * PI).sqrt() * (0.7f64.powi(2) + 1.0 / 12.0).sqrt();
        assert!((sharp.edge_width_px - expected).abs() < 0.4, "{} {expected}", sharp.edge_width_px);
        let blurred = Scene { blur_px: 4.0, ..scene(&board, 3.2, 3.0, [0.0; 2]) };
        let refused = find(&board, &blurred).unwrap_err();
        assert!(matches!(refused, DetectError::Blurred { width_px: 5.0..12.0, .. }), "{board:?}: {refused}");
    }
}

#[test]
fn markers_lie_where_opencv_has_them() {
    // Modern: the top left square is dark. Legacy: it bears marker 0 where the number of rows is even.
    let Pattern::Charuco(modern) = charuco(false).pattern else { unreachable!() };
    assert_eq!(modern.marked_squares()[..2], [[1, 0], [3, 0]]);
    let Pattern::Charuco(legacy) = charuco(true).pattern else { unreachable!() };
    assert_eq!(legacy.marked_squares()[..2], [[0, 0], [2, 0]]);
    assert_eq!(Charuco { rows: 7, ..legacy }.marked_squares()[..2], [[1, 0], [3, 0]]);
}

#[test]
fn a_board_scales_as_its_bar_was_measured_or_is_refused() {
    let measured = |mm| Board { measured_mm: Some(mm), ..checkerboard(9, 6) };
    assert!(measured(99.0).faults().is_empty());
    assert!((measured(99.0).points()[0].board_mm[0] - 9.9).abs() < 1e-12);
    for off in [94.0, 106.0, f64::NAN] {
        assert!(measured(off).faults()[0].starts_with("measured_mm"), "{:?}", measured(off).faults());
    }
}

#[test]
fn faults_of_a_description_are_all_named() {
    let mut board = charuco(false);
    board.tones = Tones { dark: 0.5, light: 0.6 };
    board.pattern = Pattern::Charuco(Charuco {
        columns: 2,
        rows: 6,
        square_mm: 10.0,
        marker_mm: 10.0,
        dictionary: Dictionary::Bits5,
        legacy: false,
    });
    let faults = board.faults();
    assert_eq!(faults.len(), 3, "{faults:?}");
    for (fault, key) in faults.iter().zip(["tones.light", "pattern.columns", "pattern.marker_mm"]) {
        assert!(fault.starts_with(key), "{fault}");
    }
}

#[test]
fn the_page_is_true_to_size() {
    let board = charuco(false);
    let text = String::from_utf8(pdf::pdf(&board)).unwrap();
    // One A4 page, in points.
    let [width, height] = pdf::page_mm(&board);
    assert_eq!([width, height], [210.0, 297.0]);
    assert!(text.contains("/MediaBox [0 0 595.2756 841.8898]"), "{text}");
    // The matrix makes millimetres of units: 72 points are 25.4 mm.
    let scale: f64 = text.split("q ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    assert!((scale * 25.4 - 72.0).abs() < 1e-4);
    for shape in dark_shapes(&board) {
        let Shape::Rectangle([x, y, w, h]) = shape else { panic!("{shape:?}") };
        assert!(text.contains(&format!("{x:.4} {y:.4} {w:.4} {h:.4} re f")));
    }
    assert!(text.contains("0 -1 100.0000 1 re f"));
    // Every offset of the table of objects is where its object begins.
    let table = text.rfind("xref\n0 ").unwrap();
    let offsets = text[table..].lines().skip(3).take(5).map(|line| line[..10].parse::<usize>().unwrap());
    for (number, offset) in (1..).zip(offsets) {
        assert!(text[offset..].starts_with(&format!("{number} 0 obj")), "{number}");
    }
    let start: usize = text.lines().rev().nth(1).unwrap().parse().unwrap();
    assert!(text[start..].starts_with("xref"));
}

#[test]
fn plane_points_lie_inside_the_corners_and_away_from_printed_edges() {
    let (width, height) = (60, 40);
    let grid = |value: fn(usize, usize) -> f32| {
        Grid::from_vec(width, height, (0..width * height).map(|at| value(at % width, at / width)).collect())
    };
    let axis = |coordinate: Grid<f32>| decode::AxisMap {
        code: coordinate.map(|value| *value as i32),
        sigma: coordinate.map(|_| 0.1),
        coordinate,
    };
    let mut class = Grid::filled(width, height, decode::Class::Valid);
    class.data_mut()[20 * width + 20] = decode::Class::Ambiguous;
    let decoded = decode::Decoded {
        column: axis(grid(|x, _| 2.0 * x as f32)),
        row: Some(axis(grid(|_, y| 3.0 * y as f32))),
        class,
        half_saturated: Grid::filled(width, height, false),
        interpolated: Grid::filled(width, height, false),
        // A printed edge between columns 29 and 30.
        modulation: grid(|x, _| if x < 30 { 100.0 } else { 40.0 }),
        residual: grid(|_, _| 0.0),
        dolp: grid(|_, _| 0.0),
        intensity: Grid::filled(width, height, 0),
        noise: decode::NoiseModel { gain_dn_per_electron: 0.1, read_noise_dn: 1.0 },
        noise_estimated: false,
        black_level_dn: 0.0,
        pairs: Vec::new(),
        boundaries: Vec::new(),
        drift: None,
        losses: Vec::new(),
    };
    let corner = |id, camera_px| crate::observation::Corner { id, board_mm: [0.0; 2], camera_px };
    let corners =
        [corner(0, [10.0, 5.0]), corner(1, [50.0, 5.0]), corner(2, [50.0, 35.0]), corner(3, [10.0, 35.0])];
    let input = |most| PlaneInput { decoded: &decoded, corners: &corners, most };
    let points = plane_points(&input(usize::MAX));
    // 41 x 31 pixels, less four columns at the edge, less the one that was not decoded.
    assert_eq!(points.len(), 41 * 31 - 4 * 31 - 1);
    for point in &points {
        let [x, y] = point.camera_px;
        assert!(
            (10.0..=50.0).contains(&x) && (5.0..=35.0).contains(&y) && !(28.0..=31.0).contains(&x),
            "{x} {y}"
        );
        assert_eq!(point.projector_px, [2.0 * x, 3.0 * y]);
    }
    let few = plane_points(&input(100)).len();
    assert!((50..=130).contains(&few), "{few}");
}
