//! Files written here in the formats of the tools; captured ones where a folder of captures is at hand.

use std::{
    io::Write,
    path::{Path, PathBuf},
};

use flate2::{Compression, write::ZlibEncoder};
use nalgebra::{Matrix3, Vector3};
use proptest::prelude::*;

use super::*;
use crate::geometry::{
    Pose, Quality,
    fixtures::{rig, two_axis_rig},
};

fn read(text: &str, name: &str, hints: &ReadHints) -> Calibration {
    Calibration::from_bytes(text.as_bytes(), name, hints).unwrap()
}

fn refusal(bytes: &[u8], name: &str, hints: &ReadHints) -> String {
    Calibration::from_bytes(bytes, name, hints).unwrap_err().to_string()
}

fn full() -> Calibration {
    Calibration {
        world_from_camera: Some(Pose {
            rotation: Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0),
            translation_mm: Vector3::new(0.1, -2e-7, 1e16),
        }),
        quality: Quality {
            camera_rms_px: Some(0.21),
            projector_rms_px: Some(0.3),
            views: Some(14),
            date: Some("2026-11-22".to_owned()),
            method: Some("bundle adjustment, \"dense\"\nboards".to_owned()),
        },
        ..two_axis_rig(1.0)
    }
}

#[test]
fn our_own_file_round_trips_to_the_last_bit() {
    let mut calibration = full();
    calibration.world_from_camera.as_mut().unwrap().translation_mm.z = 123.456;
    for calibration in [calibration, rig(1.0), Calibration { projector: None, ..rig(1.0) }] {
        let text = calibration.to_toml();
        let back = read(&text, "calibration.toml", &ReadHints::default());
        assert_eq!(back, calibration);
        assert_eq!(back.to_toml(), text);
        assert_eq!(back.id(), calibration.id());
        assert!(calibration.id().len() == 64 && calibration.id().chars().all(|c| c.is_ascii_hexdigit()));
    }
    let mut other = rig(1.0);
    other.camera.fx = other.camera.fx.next_up();
    assert_ne!(other.id(), rig(1.0).id(), "one bit of one number is another calibration");
}

#[test]
fn what_is_written_for_opencv_reads_back_to_the_last_bit() {
    let mut written = full();
    (written.world_from_camera, written.quality.method) = (None, None);
    let alone = Calibration { projector: None, ..written.clone() };
    let unknown = Calibration { quality: Quality::default(), ..rig(1.0) };
    for mut calibration in [written, alone, unknown] {
        let text = calibration.to_opencv_yaml();
        if calibration.projector.is_none() {
            calibration.quality.projector_rms_px = None;
        }
        let back = read(&text, "calibration.yml", &ReadHints::default());
        calibration.quality.method = back.quality.method.clone();
        assert_eq!(back, calibration, "{text}");
    }
}

proptest! {
    #[test]
    fn any_usable_numbers_round_trip(fx in 1500.0..9000.0f64, k1 in -0.05..0.05f64, t in -500.0..-5.0f64, rms in 0.0..9.0f64) {
        let mut calibration = rig(1.0);
        calibration.camera.fx = fx;
        calibration.camera.fy = fx;
        calibration.camera.distortion = [k1, 0.0, -0.0, 1e-7, 0.0];
        calibration.projector.as_mut().unwrap().projector_from_camera.translation_mm.x = t;
        calibration.quality.camera_rms_px = Some(rms);
        let back = Calibration::from_bytes(calibration.to_toml().as_bytes(), "c.toml", &ReadHints::default()).unwrap();
        prop_assert_eq!(back.to_toml(), calibration.to_toml());
        prop_assert_eq!(back, calibration);
    }

    #[test]
    fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..300), head in 0usize..8, name in 0usize..6) {
        let heads: [&[u8]; 8] = [
            b"", b"%YAML:1.0\n", b"<?xml version=\"1.0\"?><opencv_storage>", b"fc = [ ", b"schema = ",
            b"M1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   data: [ ", b"% script\nom = ", b"---\n",
        ];
        let names = ["a.toml", "a.yml", "a.xml", "a.mat", "a.m", "a"];
        let bytes = [heads[head], &bytes].concat();
        let _ = Calibration::from_bytes(&bytes, names[name], &ReadHints::default());
    }

    /// Random text of the formats' own characters reaches deeper than random bytes.
    #[test]
    fn no_text_panics(text in "[-\\[\\]{}:;=,.!%# <>/a-cfKMRT0-9\n\"']{0,200}", name in 0usize..4) {
        let name = ["a.toml", "a.yml", "a.xml", "a.m"][name];
        let _ = Calibration::from_bytes(text.as_bytes(), name, &ReadHints::default());
    }

    /// Changed, cut and spliced MAT-files.
    #[test]
    fn no_mat_file_panics(at in 0usize..2000, value in any::<u8>(), cut in 0usize..2000, zip in any::<bool>(), big in any::<bool>()) {
        let mut bytes = stereo_mat(zip, big);
        let at = at % bytes.len();
        bytes[at] = value;
        let _ = Calibration::from_bytes(&bytes, "a.mat", &ReadHints::default());
        bytes.truncate(cut);
        let _ = Calibration::from_bytes(&bytes, "a.mat", &ReadHints::default());
    }
}

#[test]
fn all_faults_of_our_own_file_come_at_once() {
    let text = r#"
schema = "polscan.calibration/2"
colour = "red"
[camera]
size = [1600, -1200]
matrix = [[4638.0, 0, 799.5], [0, 4638.0, 599.5], [0, 0, 1]]
distortion = [0, 0, 0, 0]
[projector]
size = [1024, 768]
matrix = [[nan, 0, 511.5], [0, 1540, 745], [0, 0, 1]]
distortion = [0, 0, 0, 0, inf]
fov = 3
[transform]
rotation = [[1, 0, 0], [0, 1, 0], [0, 0.5, 1]]
translation_mm = [1, 2, "3"]
[world]
rotation = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
translation_mm = [0, 0, 0]
[quality]
views = -3
camera_rms_px = "good"
"#;
    let message = refusal(text.as_bytes(), "bench.toml", &ReadHints::default());
    for part in [
        "cannot use calibration bench.toml",
        "schema is \"polscan.calibration/2\", expected \"polscan.calibration/1\"",
        "colour is not a known key",
        "camera.size is [1600, -1200]",
        "camera.distortion is not 5 numbers",
        "projector.fov is not a known key",
        "projector fx is NaN",
        "projector k3 is inf",
        "transform.translation_mm is not 3 numbers",
        "world_from_camera rotation has determinant -1.000",
        "quality.views is -3",
        "quality.camera_rms_px is \"good\"",
    ] {
        assert!(message.contains(part), "{part:?} not in {message}");
    }
    let form = refusal(b"schema = [", "x.toml", &ReadHints::default());
    assert!(form.contains("cannot use calibration x.toml") && !form.contains('\n'), "{form}");
}

#[test]
fn poses_that_cannot_be_are_refused() {
    let with = |change: &dyn Fn(&mut Pose)| {
        let mut calibration = rig(1.0);
        change(&mut calibration.projector.as_mut().unwrap().projector_from_camera);
        refusal(calibration.to_toml().as_bytes(), "c.toml", &ReadHints::default())
    };
    assert!(with(&|p| p.rotation[(0, 1)] += 0.01).contains("not orthonormal"));
    assert!(with(&|p| p.rotation = Matrix3::zeros()).contains("not orthonormal"));
    assert!(with(&|p| p.translation_mm = Vector3::new(0.0524, 0.0, 0.0)).contains("is it in metres?"));
    assert!(with(&|p| p.translation_mm.y = f64::NAN).contains("translation holds NaN"));
    assert!(with(&|p| p.translation_mm.y = 1e9).contains("mm long"));
}

/// Numbers of a projector-camera tool that writes cam_int and its like, in its layout.
const PROCAM_XML: &str = r#"<?xml version="1.0"?>
<opencv_storage>
<img_shape type_id="opencv-matrix">
  <rows>2</rows>
  <cols>1</cols>
  <dt>d</dt>
  <data>
    1024. 1280.</data></img_shape>
<rms>0.404</rms>
<cam_int type_id="opencv-matrix">
  <rows>3</rows> <cols>3</cols> <dt>d</dt>
  <data> 3452.25 0. 587.125 0. 3449.5
    521.5 0. 0. 1.</data></cam_int>
<cam_dist type_id="opencv-matrix">
  <rows>1</rows> <cols>5</cols> <dt>d</dt>
  <data> -0.222 -0.866 -7.28e-04 -1.688e-03 3.125</data></cam_dist>
<proj_int type_id="opencv-matrix">
  <rows>3</rows> <cols>3</cols> <dt>d</dt>
  <data> 1942.5 0. 453.25 0. 1930.5 730.5 0. 0. 1.</data></proj_int>
<proj_dist type_id="opencv-matrix">
  <rows>1</rows> <cols>5</cols> <dt>d</dt>
  <data> -0.0969 1.0725 -1.8e-03 -8.67e-03 -6.821</data></proj_dist>
<rotation type_id="opencv-matrix">
  <rows>3</rows> <cols>3</cols> <dt>d</dt>
  <data> 0.998973 0.014813 -0.042809 -0.012416 0.998369 0.055721 0.043565 -0.055132 0.997528</data></rotation>
<translation type_id="opencv-matrix">
  <rows>3</rows> <cols>1</cols> <dt>d</dt>
  <data> 89.96 -637.61 -150.42</data></translation>
</opencv_storage>
"#;

const PROJECTOR_1024: ReadHints =
    ReadHints { camera_size: None, projector_size: Some((1024, 768)), swap: false, unit_mm: 1.0 };

#[test]
fn opencv_xml_of_a_projector_camera_pair() {
    let calibration = read(PROCAM_XML, "result.xml", &PROJECTOR_1024);
    assert_eq!(calibration.camera.size(), (1280, 1024), "img_shape is rows x columns");
    assert_eq!((calibration.camera.fx, calibration.camera.cy), (3452.25, 521.5));
    assert_eq!(calibration.camera.distortion, [-0.222, -0.866, -7.28e-4, -1.688e-3, 3.125]);
    let projector = calibration.projector.unwrap();
    assert_eq!((projector.lens.size(), projector.lens.cy), ((1024, 768), 730.5));
    let pose = projector.projector_from_camera;
    assert_eq!(pose.translation_mm, Vector3::new(89.96, -637.61, -150.42));
    // Six printed digits are brought back to a rotation, but not turned.
    assert!((pose.rotation.transpose() * pose.rotation - Matrix3::identity()).abs().max() < 1e-14);
    assert!((pose.rotation[(1, 2)] - 0.055721).abs() < 2e-6, "{}", pose.rotation);

    let swapped = read(
        PROCAM_XML,
        "result.xml",
        &ReadHints { camera_size: Some((1024, 768)), projector_size: None, swap: true, unit_mm: 10.0 },
    );
    assert_eq!(swapped.camera, projector.lens);
    let back = swapped.projector.unwrap();
    assert_eq!(back.lens, calibration.camera);
    let point = Vector3::new(12.0, -7.0, 900.0);
    let mut there = pose;
    there.translation_mm *= 10.0;
    assert!((back.projector_from_camera.transform(&there.transform(&point)) - point).norm() < 1e-9);
}

#[test]
fn what_is_missing_is_said() {
    let message = refusal(PROCAM_XML.as_bytes(), "r.xml", &ReadHints::default());
    assert!(message.contains("the projector size (width, height) is missing"), "{message}");
    let hints = ReadHints { camera_size: Some((1024, 1280)), ..PROJECTOR_1024 };
    let message = refusal(PROCAM_XML.as_bytes(), "r.xml", &hints);
    assert!(
        message
            .contains("a camera of 1280x1024 px, but 1024x1280 px was given: width and height are exchanged")
    );
    let misspelt = PROCAM_XML.replace("rotation", "roration").replace("cam_dist", "cam_dust");
    let message = refusal(misspelt.as_bytes(), "r.xml", &PROJECTOR_1024);
    assert!(
        message.contains("rotation is missing") && message.contains("camera distortion is missing"),
        "{message}"
    );
    let short = PROCAM_XML.replace("89.96 ", "");
    assert!(
        refusal(short.as_bytes(), "r.xml", &PROJECTOR_1024).contains("translation says 3x1, but its data")
    );
    let skewed = PROCAM_XML.replace("3452.25 0.", "3452.25 1.5");
    assert!(refusal(skewed.as_bytes(), "r.xml", &PROJECTOR_1024).contains("skew cannot be used"));
    let entity = "<!DOCTYPE a [<!ENTITY b \"c\">]><opencv_storage/>";
    assert!(refusal(entity.as_bytes(), "r.xml", &PROJECTOR_1024).contains("it is not XML"));
    let deep = format!("<opencv_storage>{}", "<a>".repeat(100_000));
    assert!(refusal(deep.as_bytes(), "r.xml", &PROJECTOR_1024).contains("nested more than"));
    let deep = format!("<opencv_storage>{}", "<\u{e9}>".repeat(90_000));
    assert!(refusal(deep.as_bytes(), "r.xml", &PROJECTOR_1024).contains("it is not XML"));
    let unknown = refusal(b"hello", "notes.txt", &PROJECTOR_1024);
    assert!(unknown.contains("its format is not known"), "{unknown}");
}

const CAMERA_YAML: &str = "%YAML:1.0
---
calibration_time: \"Sun 22 Nov 2026 10:00:00 AM\"
nframes: 13
image_width: 640
image_height: 480
# a comment
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 5.3591573396163199e+02, 0., 3.4228315473308373e+02, 0.,
       5.3591573396163199e+02, 2.3557082909788173e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 5
   cols: 1
   dt: d
   data: [ -2.6637260909660682e-01, -3.8588898922304653e-02,
       1.7831947042852964e-03, -2.8122100441115472e-04,
       2.3839153080878486e-01 ]
avg_reprojection_error: 3.9259098975581364e-01
flags: ~
names:
   - left01.jpg
   - left02.jpg
";

#[test]
fn opencv_yaml_of_one_camera() {
    let calibration = read(CAMERA_YAML, "left.yml", &ReadHints::default());
    assert_eq!(calibration.camera.size(), (640, 480));
    assert_eq!((calibration.camera.fx, calibration.camera.cx), (535.915_733_961_632, 342.28315473308373));
    assert_eq!(calibration.camera.distortion[4], 0.23839153080878486);
    assert!(calibration.projector.is_none());
    assert_eq!(calibration.quality.camera_rms_px, Some(0.39259098975581364));
    assert_eq!(calibration.quality.views, Some(13));
    assert_eq!(calibration.quality.date.as_deref(), Some("Sun 22 Nov 2026 10:00:00 AM"));
    // A camera alone is a usable file, but not a rig.
    let swap = ReadHints { swap: true, ..ReadHints::default() };
    assert!(refusal(CAMERA_YAML.as_bytes(), "left.yml", &swap).contains("nothing to swap"));
    let rational = CAMERA_YAML.replace("rows: 5", "rows: 8").replace("8486e-01 ]", "8486e-01, 1., 0., 0. ]");
    assert!(refusal(rational.as_bytes(), "l.yml", &ReadHints::default()).contains("has 8 coefficients"));
    let nan = CAMERA_YAML.replace("3.4228315473308373e+02", ".Nan");
    assert!(refusal(nan.as_bytes(), "l.yml", &ReadHints::default()).contains("camera cx is NaN"));
}

/// Matrices in matrices cost no stack.
#[test]
fn nested_yaml_is_bounded() {
    let text: String = (0..3000).fold("%YAML:1.0\nK1:\n".to_owned(), |mut text, level| {
        let indent = " ".repeat(level + 1);
        text.push_str(&format!("{indent}rows: 3\n{indent}cols: 3\n{indent}data:\n"));
        text
    });
    assert!(refusal(text.as_bytes(), "deep.yml", &PROJECTOR_1024).contains("K1 says 3x3, but its data"));
}

#[test]
fn yaml_of_a_stereo_pair_in_other_spellings() {
    let text = "K1: [[1200.5, 0, 640], [0, 1201, 512], [0, 0, 1]]   # lists in lists
D1: [0.01, -0.02, 0, 0]
K2:
- [1500, 0, 512]
- [0, 1500, 700]
- [0, 0, 1]
D2:
  - 0.
  - 0.
  - 0.
  - 0.
  - 0.
R: [1, 0, 0, 0, 1, 0, 0, 0, 1]
T: [ -0.1,
     0.02, 0 ]
image_size: [1280, 1024]
";
    let calibration = read(text, "stereo.yaml", &ReadHints { unit_mm: 1000.0, ..PROJECTOR_1024 });
    assert_eq!((calibration.camera.size(), calibration.camera.fy), ((1280, 1024), 1201.0));
    assert_eq!(calibration.camera.distortion, [0.01, -0.02, 0.0, 0.0, 0.0]);
    let projector = calibration.projector.unwrap();
    assert_eq!((projector.lens.fx, projector.lens.cy), (1500.0, 700.0));
    assert!(
        (projector.projector_from_camera.translation_mm - Vector3::new(-100.0, 20.0, 0.0)).norm() < 1e-12
    );
    let metres = refusal(text.as_bytes(), "stereo.yaml", &PROJECTOR_1024);
    assert!(metres.contains("is it in metres?"), "{metres}");
    let twice = format!("{text}\nK1: 3\n");
    assert!(refusal(twice.as_bytes(), "s.yaml", &PROJECTOR_1024).contains("K1 occurs twice"));
    let cut = &text[..text.find("image_size").unwrap() - 4];
    assert!(refusal(cut.as_bytes(), "s.yaml", &PROJECTOR_1024).contains("T has a list that does not end"));
    let intrinsics = text.split("R:").next().unwrap();
    let message = refusal(intrinsics.as_bytes(), "intrinsics.yml", &PROJECTOR_1024);
    assert!(
        message.contains("rotation is missing") && message.contains("translation is missing"),
        "{message}"
    );
}

const CAMERA_SCRIPT: &str = "% Intrinsic and Extrinsic Camera Parameters

%-- Focal length:
fc = [ 657.395533244027660 ; 657.763354105897410 ];
cc = [ 302.982165186368150 ; 242.617826054137170 ];
alpha_c = 0.000000000000000;
kc = [ -0.255839278890099 ; 0.127576291849909 ; -0.000208190479883 ; 0.000033307713496 ; 0.000000000000000 ];
nx = 640;
ny = 480;
n_ima = 20;\t\t\t\t% Number of calibration images
omc_4 = [ NaN ; NaN ; NaN ];
";

const STEREO_SCRIPT: &str = "%-- Left Camera:
fc_left = [ 1723.2647 ; 1738.9459 ];
cc_left = [ 305.3895 ; 404.2190 ];
alpha_c_left = [ 0.0 ];
kc_left = [ 0.0886 ; -0.9746 ; 0.0308 ; -0.0008 ; 0.0 ];
%-- Right Camera:
fc_right = [ 1110.2694 ; 1112.1833 ];
cc_right = [ 323.5473 ; 292.3072 ];
alpha_c_right = [ 0.0 ];
kc_right = [ -0.0079 ; -0.9838 ; 0.0070 ; -0.0006 ; 0.0 ];
%-- Extrinsic parameters (position of right camera wrt left camera):
om = [ 0.13918944155353752 ; 0.08136114051073316 ; 0.02428753498202132 ]; % Rotation vector
T = [ -14.6134   441.8618   358.7819 ]; % Translation vector
";

#[test]
fn scripts_of_the_toolbox() {
    let camera = read(CAMERA_SCRIPT, "Calib_Results.m", &ReadHints::default());
    assert_eq!((camera.camera.fx, camera.camera.size()), (657.395_533_244_027_7, (640, 480)));
    assert_eq!(camera.camera.distortion[3], 0.000033307713496);
    assert!(camera.projector.is_none());
    // The format is known by its content when the name says nothing.
    assert_eq!(read(CAMERA_SCRIPT, "result", &ReadHints::default()), camera);

    let sizes =
        ReadHints { camera_size: Some((648, 488)), projector_size: Some((608, 684)), ..ReadHints::default() };
    let stereo = read(STEREO_SCRIPT, "Calib_Results_stereo.m", &sizes);
    let projector = stereo.projector.unwrap();
    assert_eq!((stereo.camera.fx, projector.lens.fx), (1723.2647, 1110.2694));
    check_rodrigues(&projector.projector_from_camera.rotation);
    assert_eq!(projector.projector_from_camera.translation_mm, Vector3::new(-14.6134, 441.8618, 358.7819));

    let missing = refusal(STEREO_SCRIPT.as_bytes(), "s.m", &ReadHints::default());
    assert!(missing.contains("the camera size") && missing.contains("the projector size"), "{missing}");
    let partial = STEREO_SCRIPT.replace("om =", "omm =").replace("kc_right =", "x =");
    let message = refusal(partial.as_bytes(), "s.m", &sizes);
    assert!(message.contains("om is missing") && message.contains("kc_right is missing"), "{message}");
    let skew = CAMERA_SCRIPT.replace("alpha_c = 0.000", "alpha_c = 0.002");
    assert!(refusal(skew.as_bytes(), "c.m", &ReadHints::default()).contains("skew cannot be used"));
}

/// `cv2.Rodrigues([0.13918944155353752, 0.08136114051073316, 0.02428753498202132])` of opencv-python-headless 5.0.0.
fn check_rodrigues(rotation: &Matrix3<f64>) {
    let expected = Matrix3::new(
        0.9964032186672065,
        -0.01853029766467987,
        0.08268768891491284,
        0.0298298445419178,
        0.9900403002666199,
        -0.1375877328201392,
        -0.07931460271750755,
        0.13955942073697264,
        0.9870320976945606,
    );
    assert!((rotation - expected).abs().max() < 1e-14, "{rotation}");
}

#[test]
fn a_diverged_calibration_is_refused_with_its_number() {
    let text = "% diverged\nfc = [ 217143.875712604260000 ; 168591.855939185010000 ];\ncc = [ 255.5 ; 74.5 ];\n\
                kc = [ 418.880830610554430 ; -618437.684367173820000 ; -1.846700341639232 ; -1.485004890224938 ; 0 ];\n\
                nx = 512;\nny = 150;\n";
    let message = refusal(text.as_bytes(), "Calib_Results.m", &ReadHints::default());
    assert!(message.contains("fx is 217143.9 px") && message.contains("diverged"), "{message}");
}

/// A MAT-file of level 5 with the given arrays (column-major as MATLAB has them), stored as MATLAB would store them.
fn mat_file(arrays: &[(&str, usize, usize, &[f64])], zip: bool, big_endian: bool) -> Vec<u8> {
    let word = |v: u32| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() };
    let pad = |mut bytes: Vec<u8>| {
        bytes.resize(bytes.len().next_multiple_of(8), 0);
        bytes
    };
    let element = |kind: u32, data: &[u8]| {
        if !data.is_empty() && data.len() <= 4 {
            return pad([&word(kind | (data.len() as u32) << 16)[..], data].concat());
        }
        pad([&word(kind)[..], &word(data.len() as u32), data].concat())
    };
    let mut file = b"MATLAB 5.0 MAT-file, written by a test".to_vec();
    file.resize(124, b' ');
    file.extend_from_slice(if big_endian { b"\x01\x00MI" } else { b"\x00\x01IM" });
    for (name, rows, columns, data) in arrays {
        // Small whole numbers are stored as bytes, whatever the class.
        let small = data.iter().all(|v| v.fract() == 0.0 && (0.0..256.0).contains(v));
        let values: Vec<u8> = if small {
            data.iter().map(|v| *v as u8).collect()
        } else {
            data.iter().flat_map(|v| if big_endian { v.to_be_bytes() } else { v.to_le_bytes() }).collect()
        };
        let body = [
            element(6, &[word(6), word(0)].concat()),
            element(5, &[word(*rows as u32), word(*columns as u32)].concat()),
            element(1, name.as_bytes()),
            element(if small { 2 } else { 9 }, &values),
        ]
        .concat();
        let matrix = element(14, &body);
        if zip {
            let mut encoder = ZlibEncoder::new(Vec::new(), Compression::default());
            encoder.write_all(&matrix).unwrap();
            let zipped = encoder.finish().unwrap();
            file.extend([&word(15)[..], &word(zipped.len() as u32), &zipped].concat());
        } else {
            file.extend(matrix);
        }
    }
    file
}

fn stereo_mat(zip: bool, big_endian: bool) -> Vec<u8> {
    let corners = vec![0.5; 9000];
    mat_file(
        &[
            ("nx", 1, 1, &[648.0]),
            ("ny", 1, 1, &[488.0]),
            ("x_1", 2, 4500, &corners),
            ("n_ima", 1, 1, &[25.0]),
            ("fc_left", 2, 1, &[1723.2647, 1738.9459]),
            ("cc_left", 2, 1, &[305.3895, 404.219]),
            ("kc_left", 5, 1, &[0.0886, -0.9746, 0.0308, -0.0008, 0.0]),
            ("alpha_c_left", 1, 1, &[0.0]),
            ("fc_right", 2, 1, &[1110.2694, 1112.1833]),
            ("cc_right", 2, 1, &[323.5473, 292.3072]),
            ("kc_right", 5, 1, &[-0.0079, -0.9838, 0.007, -0.0006, 0.0]),
            ("om", 3, 1, &[0.13918944155353752, 0.08136114051073316, 0.02428753498202132]),
            ("T", 3, 1, &[-14.6134, 441.8618, 358.7819]),
        ],
        zip,
        big_endian,
    )
}

#[test]
fn mat_files_of_both_byte_orders_with_and_without_compression() {
    let hints = ReadHints { projector_size: Some((608, 684)), ..ReadHints::default() };
    let mut first = None;
    for (zip, big_endian) in [(false, false), (true, false), (false, true), (true, true)] {
        let calibration = Calibration::from_bytes(&stereo_mat(zip, big_endian), "s.mat", &hints).unwrap();
        assert_eq!(calibration.camera.size(), (648, 488));
        assert_eq!(calibration.quality.views, Some(25));
        check_rodrigues(&calibration.projector.unwrap().projector_from_camera.rotation);
        assert_eq!(*first.get_or_insert_with(|| calibration.clone()), calibration);
    }
    // R alone, in MATLAB's order of columns, says the same as om.
    let r = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0];
    let mut nodes = mat::read(&stereo_mat(true, false)).unwrap();
    nodes.extend(mat::read(&mat_file(&[("R", 3, 3, &r)], true, false)).unwrap());
    nodes.remove("om");
    let calibration = bouguet::interpret(&nodes, &hints).unwrap();
    let rotation = calibration.projector.unwrap().projector_from_camera.rotation;
    assert_eq!(rotation * Vector3::y(), Vector3::z(), "second column of R");
}

#[test]
fn mat_files_cannot_lie_about_lengths() {
    let hints = ReadHints::default();
    let good = stereo_mat(false, false);
    let mut long = good.clone();
    long[132..136].copy_from_slice(&u32::MAX.to_le_bytes());
    assert!(refusal(&long, "s.mat", &hints).contains("the element at byte 128 is longer than the file"));
    assert!(refusal(&good[..128], "s.mat", &hints).contains("holds no array"));
    let mut hdf = good.clone();
    hdf[125] = 2;
    assert!(refusal(&hdf, "s.mat", &hints).contains("save it with -v7"));
    // 1 GiB of zeros in a megabyte is inflated no further than a small array reaches.
    let mut encoder = ZlibEncoder::new(Vec::new(), Compression::best());
    let mut bomb = vec![0; 1 << 20];
    bomb[..4].copy_from_slice(&14_u32.to_le_bytes());
    bomb[4..8].copy_from_slice(&1000_u32.to_le_bytes());
    for _ in 0..1024 {
        encoder.write_all(&bomb).unwrap();
    }
    let zipped = encoder.finish().unwrap();
    let mut file = good[..128].to_vec();
    file.extend([&15_u32.to_le_bytes()[..], &(zipped.len() as u32).to_le_bytes(), &zipped].concat());
    let before = std::time::Instant::now();
    assert!(refusal(&file, "s.mat", &hints).contains("holds no array"));
    assert!(before.elapsed().as_millis() < 500);
}

fn read_file_with(path: &Path, hints: &ReadHints) -> Result<Calibration, CalibrationError> {
    Calibration::from_bytes(&std::fs::read(path).unwrap(), &path.display().to_string(), hints)
}

fn read_file(path: &Path) -> Result<Calibration, CalibrationError> {
    read_file_with(path, &ReadHints::default())
}

#[test]
fn sizes_are_compared_with_the_scan() {
    let calibration = rig(1.0);
    assert_eq!(calibration.check_sizes((1600, 1200), (1024, 768)), Ok(()));
    let message = calibration.check_sizes((1200, 1600), (1920, 1080)).unwrap_err().to_string();
    assert!(
        message
            .contains("a camera of 1600x1200 px, the scan of 1200x1600 px: width and height are exchanged")
    );
    assert!(message.contains("a projector of 1024x768 px, the scan of 1920x1080 px"), "{message}");
}

/// The folder of captures.
fn captures() -> PathBuf {
    std::env::var_os("POLSCAN_CAPTURES")
        .map(PathBuf::from)
        .expect("POLSCAN_CAPTURES names the folder of captures")
}

#[test]
#[ignore = "needs the captures of `make captures`"]
fn captured_bouguet_files() {
    let folder = captures();
    let folder = folder.join("bouguet-example");
    for name in ["Calib_Results_old0.m", "Calib_Results_old0.mat"] {
        let calibration = read_file(&folder.join(name)).unwrap();
        let camera = calibration.camera;
        let near = |a: f64, b: f64, digits: f64| assert!((a - b).abs() <= digits, "{name}: {a} against {b}");
        near(camera.fx, 657.3955, 5e-5);
        near(camera.fy, 657.7634, 5e-5);
        near(camera.cx, 302.982, 5e-4);
        near(camera.cy, 242.618, 5e-4);
        let kc = [-0.25584, 0.12758, -0.00021, 0.00003, 0.0];
        camera.distortion.iter().zip(kc).for_each(|(a, b)| near(*a, b, 5e-6));
        assert_eq!(camera.size(), (640, 480));
        if name.ends_with("mat") {
            near(calibration.quality.camera_rms_px.unwrap(), 0.178_71, 5e-5);
        }
    }
    for name in ["Calib_Results.m", "Calib_Results.mat"] {
        let error = read_file(&folder.join("malformed_bouguet").join(name)).unwrap_err().to_string();
        assert!(error.contains("fx is 217143.9 px") && error.contains("diverged"), "{error}");
    }
    let other = folder.join("other_bouguet_mat");
    let camera = read_file(&other.join("Calib_Results_basler.mat")).unwrap();
    assert_eq!((camera.camera.size(), camera.projector), ((640, 480), None));
    assert_eq!((camera.camera.fx, camera.camera.distortion[2]), (1649.5396195413653, 0.030809728893972453));
    let stereo = other.join("Calib_Results_stereo.mat");
    let error = read_file(&stereo).unwrap_err().to_string();
    assert!(error.contains("the projector size (width, height) is missing"), "{error}");
    let hints = ReadHints { projector_size: Some((608, 684)), ..ReadHints::default() };
    let calibration = read_file_with(&stereo, &hints).unwrap();
    let projector = calibration.projector.unwrap();
    assert_eq!(calibration.camera.fx, 1723.2647114544782);
    assert_eq!(projector.lens.fx, 1110.2694226160738);
    assert_eq!(projector.projector_from_camera.translation_mm.y, 441.8617998892318);
    check_rodrigues(&projector.projector_from_camera.rotation);
}

#[test]
#[ignore = "needs the captures of `make captures`"]
fn captured_opencv_files() {
    let folder = captures();
    let left = read_file(&folder.join("opencv-stereo/left_intrinsics.yml")).unwrap();
    assert!((left.camera.fx - 535.916).abs() < 5e-4 && (left.camera.cx - 342.283).abs() < 5e-4);
    assert_eq!(left.camera.size(), (640, 480));
    let pair = read_file(&folder.join("opencv-stereo/intrinsics.yml")).unwrap_err().to_string();
    assert!(
        pair.contains("rotation is missing") && pair.contains("size (width, height) is missing"),
        "{pair}"
    );

    let procam = folder.join("procam-chess/reference/calibration_result_opencv4.11.xml");
    let calibration = read_file_with(&procam, &PROJECTOR_1024).unwrap();
    assert_eq!(calibration.camera.size(), (1280, 1024));
    let projector = calibration.projector.unwrap();
    assert_eq!(projector.lens.cy, 730.502_892_919_613);
    assert_eq!(projector.projector_from_camera.translation_mm.x, 89.96542723785457);
    let stale = folder.join("procam-chess/sample_data/calibration_result.xml");
    let error = read_file_with(&stale, &PROJECTOR_1024).unwrap_err().to_string();
    assert!(error.contains("rotation is missing"), "{error}");
}
