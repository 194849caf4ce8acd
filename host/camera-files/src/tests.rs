//! Files of other programs give the projector that those programs mean, whatever their form; whatever is wrong is named.

use super::*;
use dpm_scene::geometry::lens::{Lens, LensModel};
use glam::{DVec2, DVec4};
use std::path::{Path, PathBuf};

const YAML: &str = "%YAML:1.0\n---\nproj_K: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1.2e+03, 0., 511.5,\n       0., 1.1e+03, 383.5, 0., 0., 1. ]\nproj_kc: !!opencv-matrix\n   rows: 1\n   cols: 5\n   dt: d\n   data: [ -0.1, 0.01, 0., 0., 0. ]\nroration: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 0., -1., 0., 1., 0., 0., 0., 0., 1. ]\nT: !!opencv-matrix\n   rows: 3\n   cols: 1\n   dt: d\n   data: [ 100., 200., 300. ]\nerror: 0.4\n";

fn options(unit: LengthUnit) -> ReadOptions<'static> {
    ReadOptions {
        raster: Raster::new(1024, 768).unwrap(),
        unit,
        lens: LensKind::Auto,
        region: None,
        device: None,
    }
}

fn read_text(text: &str, unit: LengthUnit) -> Result<StoredCalibration, StorageError> {
    read(text.as_bytes(), &options(unit))
}

fn fault(text: &str) -> String {
    read_text(text, LengthUnit::Metre).unwrap_err().to_string()
}

/// Files that OpenCV wrote, and the pixels that it computed from them; `make.py` there says how.
fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/opencv")
}

fn made_by_opencv(name: &str) -> String {
    std::fs::read_to_string(folder().join(name)).unwrap()
}

const MODELS: [&str; 7] = ["none", "brown4", "brown5", "rational8", "prism12", "tilted14", "fisheye"];

/// World points and pixels (in this project's convention) of one model.
fn golden(model: &str) -> Vec<(DVec3, DVec2)> {
    let text = made_by_opencv(&format!("{model}.csv"));
    let rows = text.lines().skip(1).map(|line| {
        let v: Vec<f64> = line.split(',').map(|n| n.parse().unwrap()).collect();
        (DVec3::new(v[0], v[1], v[2]), DVec2::new(v[3] + 0.5, v[4] + 0.5))
    });
    rows.collect()
}

/// A camera that stands alone needs no pose: with and without one its lens is the same, and it stands at the origin.
#[test]
fn the_lens_of_a_camera_is_read_without_a_pose() {
    let begin = YAML.find("roration").unwrap();
    let end = YAML.find("error").unwrap();
    let alone = YAML[..begin].to_owned() + &YAML[end..];
    assert!(fault(&alone).contains("rotation"), "a projector needs its pose: {}", fault(&alone));
    let lens = |text: &str| read_lens(text.as_bytes(), &options(LengthUnit::Metre)).unwrap().camera;
    let (whole, alone) = (lens(YAML), lens(&alone));
    assert_eq!((whole, whole.world_from_projector), (alone, glam::DAffine3::IDENTITY));
    let placed = read_text(YAML, LengthUnit::Metre).unwrap().camera;
    assert_eq!((placed.fx, placed.cy), (alone.fx, alone.cy));
    // Straight ahead is -Z, and +Y is up: above the middle of the picture.
    let above = alone.project(DVec3::new(0.0, 0.1, -1.0)).unwrap();
    assert!(above.y < alone.cy - 50.0, "{above}");
}

#[test]
fn files_of_opencv_project_as_opencv_does() {
    for model in MODELS {
        let golden = golden(model);
        assert!(golden.len() > 200);
        for form in ["xml", "yml", "json"] {
            let stored = read_text(&made_by_opencv(&format!("{model}.{form}")), LengthUnit::Metre).unwrap();
            assert_eq!((stored.image_size, &stored.frame), (Some((1024, 768)), &PoseFrame::World));
            assert!(stored.unread.is_empty(), "{:?}", stored.unread);
            for (world, pixel) in &golden {
                let got = stored.camera.project(*world).unwrap();
                assert!((got - *pixel).length() < 1e-6, "{model}.{form}: {got} {pixel}");
            }
        }
    }
}

#[test]
fn a_file_for_another_raster_of_the_same_shape_is_scaled_and_one_of_another_shape_is_refused() {
    for model in MODELS {
        let text = made_by_opencv(&format!("{model}.yml"));
        let at = |w, h| {
            let raster = Raster::new(w, h).unwrap();
            read(text.as_bytes(), &ReadOptions { raster, ..options(LengthUnit::Metre) })
        };
        let small = at(256, 192).unwrap();
        assert_eq!(small.image_size, Some((1024, 768)));
        // The corner of the raster stays the corner, so pixels divide by four in this project's convention.
        for (world, pixel) in golden(model) {
            assert!((small.camera.project(world).unwrap() - pixel / 4.0).length() < 1e-6);
        }
        let refused = at(1280, 800).unwrap_err();
        assert_eq!(refused, StorageError::ImageSize { file: (1024, 768), rig: (1280, 800) });
        let told = refused.to_string();
        assert!(told.contains("1024 x 768") && told.contains("1280 x 800"), "{told}");
    }
    let odd = made_by_opencv("none.yml").replace("image_width: 1024", "image_width: 1024.5");
    assert!(fault(&odd).contains("no size of a raster"));
}

#[test]
fn what_is_exported_is_read_back_in_every_form() {
    for model in MODELS {
        let first = read_text(&made_by_opencv(&format!("{model}.xml")), LengthUnit::Metre).unwrap().camera;
        for form in [StorageForm::Xml, StorageForm::Yaml, StorageForm::Json] {
            let text = export(&first, form);
            let back = read_text(&text, LengthUnit::Metre).unwrap();
            assert!(back.unread.is_empty() && back.frame == PoseFrame::World);
            let b = back.camera;
            assert_eq!(b.lens.model(), first.lens.model(), "{text}");
            let apart = DVec4::new(b.fx - first.fx, b.fy - first.fy, b.cx - first.cx, b.cy - first.cy);
            assert!(apart.abs().max_element() < 1e-9, "{apart}");
            for (world, _) in golden(model) {
                let pixels = [b, first].map(|c| c.project(world).unwrap());
                assert!((pixels[0] - pixels[1]).length() < 1e-9, "{model} {pixels:?}");
            }
        }
    }
}

/// Byte for byte what OpenCV 4 and 5 were seen to read; `tests/assets/opencv/check_export.py` asks them again.
#[test]
fn an_export_keeps_its_bytes() {
    for model in MODELS {
        let camera = read_text(&made_by_opencv(&format!("{model}.xml")), LengthUnit::Metre).unwrap().camera;
        for (form, extension) in
            [(StorageForm::Xml, "xml"), (StorageForm::Yaml, "yml"), (StorageForm::Json, "json")]
        {
            let path = folder().join(format!("exported/{model}.{extension}"));
            let text = export(&camera, form);
            if std::env::var_os("DPM_UPDATE_EXPORTS").is_some() {
                std::fs::create_dir_all(path.parent().unwrap()).unwrap();
                std::fs::write(&path, &text).unwrap();
            }
            assert_eq!(StorageForm::of(&path), Some(form));
            assert_eq!(std::fs::read_to_string(&path).unwrap(), text, "{}", path.display());
        }
    }
    assert_eq!(StorageForm::of(Path::new("a.YAML")), Some(StorageForm::Yaml));
    assert_eq!(StorageForm::of(Path::new("a.txt")), None);
}

#[test]
fn yaml_gives_the_projection_of_its_matrices() {
    let c = read_text(YAML, LengthUnit::Millimetre).unwrap();
    // x_proj = R x + T by hand: (0.5, 0.2, 2) -> (-0.2, 0.5, 2) + (0.1, 0.2, 0.3) = (-0.1, 0.7, 2.3).
    let pixel = c.camera.project(DVec3::new(0.5, 0.2, 2.0)).unwrap();
    let (x, y) = (-0.1 / 2.3, 0.7 / 2.3);
    let r2: f64 = x * x + y * y;
    let radial = 1.0 - 0.1 * r2 + 0.01 * r2 * r2;
    let want = DVec2::new(1200.0 * x * radial + 512.0, 1100.0 * y * radial + 384.0);
    assert!((pixel - want).length() < 1e-9, "{pixel} {want}");
    let lens = Lens::opencv(&[-0.1, 0.01, 0.0, 0.0, 0.0]).unwrap();
    assert_eq!(c.camera.lens.model(), lens.model());
    assert!(c.found.contains(&"rotation: roration".to_string()), "{:?}", c.found);
    // In metres the projector is a thousand times farther away.
    let m = read_text(YAML, LengthUnit::Metre).unwrap();
    assert!((m.camera.position() - c.camera.position() * 1000.0).length() < 1e-9);
}

fn xml_matrix(name: &str, rows: usize, columns: usize, kind: &str, data: &str) -> String {
    format!(
        "<{name} type_id=\"opencv-matrix\">\n <rows>{rows}</rows>\n <cols>{columns}</cols>\n <dt>{kind}</dt>\n \
         <data>\n {data}</data></{name}>\n"
    )
}

fn storage(inside: &str) -> String {
    format!("<?xml version=\"1.0\"?>\n<opencv_storage>\n{inside}</opencv_storage>\n")
}

#[test]
fn xml_reads_the_same() {
    let matrix = |name: &str, r, c, data: &str| xml_matrix(name, r, c, "d", data);
    let text = storage(&format!(
        "{}{}{}{}",
        matrix("camera_matrix", 3, 3, "1200. 0. 511.5 0. 1100.\n 383.5 0. 0. 1."),
        matrix("distortion_coefficients", 5, 1, "-0.1 0.01 0. 0. 0."),
        matrix("rotation", 3, 1, "0. 0. 1.5707963267948966"),
        matrix("translation", 1, 3, "100. 200. 300."),
    ));
    let (a, b) =
        (read_text(&text, LengthUnit::Millimetre).unwrap(), read_text(YAML, LengthUnit::Millimetre).unwrap());
    let p = DVec3::new(0.5, 0.2, 2.0);
    assert!((a.camera.project(p).unwrap() - b.camera.project(p).unwrap()).length() < 1e-9);
    assert_eq!(a.camera.lens, b.camera.lens);
}

/// The entries of procam-calibration, with its own spelling. Its origin is the camera.
#[test]
fn a_file_of_procam_calibration_is_in_its_cameras_frame() {
    let matrix = |name: &str, r, c, data: &str| xml_matrix(name, r, c, "d", data);
    let inside = [
        matrix("img_shape", 2, 1, "1024. 1280."),
        "<rms>4.25e-01</rms>\n".into(),
        matrix("cam_int", 3, 3, "3452. 0. 587. 0. 3450. 521. 0. 0. 1."),
        matrix("cam_dist", 1, 5, "-0.2 -0.8 0. 0. 3.1"),
        matrix("proj_int", 3, 3, "1947. 0. 449. 0. 1934. 720. 0. 0. 1."),
        matrix("proj_dist", 1, 5, "-0.09 0.11 -0.002 -0.009 0."),
        matrix("roration", 3, 3, "1. 0. 0. 0. 1. 0. 0. 0. 1."),
        matrix("translation", 3, 1, "39. -278. -61."),
    ];
    let stored = read_text(&storage(&inside.concat()), LengthUnit::Millimetre).unwrap();
    assert_eq!(stored.frame, PoseFrame::Camera { name: "roration".into() });
    assert!(stored.unread == ["the device camera"] && stored.image_size.is_none(), "{stored:?}");
    // The camera's picture is not the projector's raster, and its lens is not the projector's.
    assert!(matches!(stored.camera.lens.model(), LensModel::Brown(c) if c[0] == -0.09));
    // A point of the camera's frame, and the same point of the world in which the camera stands at (1, 2, 3) and looks
    // along +X with the world's Z up.
    let axes = DMat3::from_cols(-DVec3::Y, -DVec3::Z, DVec3::X);
    let place = DAffine3::from_mat3_translation(axes, DVec3::new(1.0, 2.0, 3.0));
    let seen = DVec3::new(0.1, 0.2, 1.5);
    let world = DVec3::new(1.0 + 1.5, 2.0 - 0.1, 3.0 - 0.2);
    let placed = stored.seen_from(place);
    assert!((placed.project(world).unwrap() - stored.camera.project(seen).unwrap()).length() < 1e-9);
    // With another spelling the camera's intrinsics still show whose frame it is.
    let spelled = storage(&inside.concat().replace("roration", "rotation"));
    let frame = read_text(&spelled, LengthUnit::Millimetre).unwrap().frame;
    assert_eq!(frame, PoseFrame::Camera { name: "cam_int".into() });
}

/// The entries that mapamok writes: `cv::Size` and `cv::Point2d` are lists, and the rotation is told three times.
#[test]
fn a_file_of_mapamok_is_read() {
    let matrix = |name: &str, r: usize, data: &str| {
        let c = if r == 3 && data.split(',').count() == 9 { 3 } else { 1 };
        format!("{name}: !!opencv-matrix\n   rows: {r}\n   cols: {c}\n   dt: d\n   data: [ {data} ]\n")
    };
    let text = [
        "%YAML:1.0\n".to_string(),
        matrix("cameraMatrix", 3, "1200., 0., 511.5, 0., 1100., 383.5, 0., 0., 1."),
        "focalLength: 1.6e+01\nfov: [ 4.6e+01, 3.8e+01 ]\nprincipalPoint: [ 0., 0. ]\nimageSize: [ 1024, 768 ]\n".into(),
        matrix("translationVector", 3, "0.1, 0.2, 0.3"),
        matrix("rotationVector", 3, "0., 0., 1.5707963267948966"),
        matrix("rotationMatrix", 3, "0., -1., 0., 1., 0., 0., 0., 0., 1."),
        "rotationAngleRadians: 1.5707963267948966e+00\n".into(),
        matrix("rotationAxis", 3, "0., 0., 1."),
        matrix("euler", 3, "0., 0., 90."),
    ]
    .concat();
    let stored = read_text(&text, LengthUnit::Metre).unwrap();
    assert_eq!((stored.image_size, stored.frame), (Some((1024, 768)), PoseFrame::World));
    assert!(stored.unread.is_empty(), "{:?}", stored.unread);
    let pixel = stored.camera.project(DVec3::new(0.5, 0.2, 2.0)).unwrap();
    let want = DVec2::new(512.0 - 1200.0 * 0.1 / 2.3, 384.0 + 1100.0 * 0.7 / 2.3);
    assert!((pixel - want).length() < 1e-9, "{pixel} {want}");
    let wide = text.replace("[ 1024, 768 ]", "[ 1280, 720 ]");
    assert!(fault(&wide).contains("1280 x 720"));
}

/// The entries of OpenCV's calibration sample: matrices with two channels and the poses of many views.
#[test]
fn a_file_of_opencvs_own_sample_says_what_it_lacks() {
    let views = "extrinsic_parameters: !!opencv-matrix\n   rows: 2\n   cols: 6\n   dt: d\n   data: [ 1., 2., 3., 4., 5., \
                 6., 1., 2., 3., 4., 5., 6. ]\nimage_points: !!opencv-matrix\n   rows: 2\n   cols: 1\n   dt: \"2f\"\n   \
                 data: [ 1., 2., 3., 4. ]\n";
    let text = made_by_opencv("brown5.yml");
    let both = read_text(&format!("{text}{views}"), LengthUnit::Metre).unwrap();
    assert!(both.unread.is_empty(), "{:?}", both.unread);
    let only = format!("{text}{views}").replace("rvec:", "rvec_of_one:").replace("tvec:", "tvec_of_one:");
    let told = fault(&only);
    assert!(
        told.contains("extrinsic_parameters") && told.contains("many views") && told.contains("rvec"),
        "{told}"
    );
    // A matrix that nobody knows is named.
    let other = read_text(
        &format!("{text}{}", views.replace("extrinsic_parameters", "dist_extra")),
        LengthUnit::Metre,
    );
    assert_eq!(other.unwrap().unread, ["dist_extra"]);
}

#[test]
fn a_fisheye_lens_is_known_by_the_file_or_by_the_operator() {
    let text = made_by_opencv("fisheye.yml");
    let with = |text: &str, lens| read(text.as_bytes(), &ReadOptions { lens, ..options(LengthUnit::Metre) });
    let model = |text: &str, lens| with(text, lens).unwrap().camera.lens.model();
    let fisheye = LensModel::Fisheye([-0.08, 0.03, -0.015, 0.004]);
    assert_eq!(model(&text, LensKind::Auto), fisheye);
    let silent = text.replace("fisheye_model: 1\n", "");
    assert_eq!(model(&silent, LensKind::Fisheye), fisheye);
    assert!(matches!(model(&silent, LensKind::Auto), LensModel::Brown(_)));
    for word in ["fisheye", "equidistant", "\"equidistant\""] {
        let named = text.replace("fisheye_model: 1", &format!("distortion_model: {word}"));
        assert_eq!(model(&named, LensKind::Auto), fisheye);
    }
    let named = |word: &str| text.replace("fisheye_model: 1", word);
    assert!(matches!(model(&named("fisheye_model: 0"), LensKind::Auto), LensModel::Brown(_)));
    let told = |text: &str, lens| with(text, lens).unwrap_err().to_string();
    assert!(told(&named("fisheye_model: 0"), LensKind::Fisheye).contains("no fisheye"));
    assert!(told(&named("distortion_model: omni"), LensKind::Auto).contains("\"omni\""));
    assert!(told(&made_by_opencv("brown5.xml"), LensKind::Fisheye).contains("has 5 numbers, but a fisheye"));
}

/// ROS's `camera_info` files have no tags; Python's `json.dump` has no matrices, only lists of lists.
#[test]
fn plain_yaml_and_plain_json_are_read() {
    let want = read_text(&made_by_opencv("brown5.yml"), LengthUnit::Metre).unwrap().camera;
    let ros = made_by_opencv("brown5.yml").replace(" !!opencv-matrix", "").replace("%YAML 1.2\n---\n", "");
    assert_eq!(read_text(&ros, LengthUnit::Metre).unwrap().camera, want);
    let json = made_by_opencv("brown5.json");
    let commented = json.replacen('{', "{ // made by hand\n /* twice */", 1);
    assert_eq!(read_text(&commented, LengthUnit::Metre).unwrap().camera, want);
    let plain = "{\"image_width\": 1024, \"image_height\": 768,\n\"K\": [[1100.0, 0, 530.25], [0, 1085.0, 610.75], [0, 0, 1]],\n\
                 \"D\": [[-0.24, 0.12, 0.003, -0.004, -0.03]],\n\"rvec\": [-2.7691727200697627, 0.019437076135295189, \
                 0.32667933506030994],\n\"tvec\": [[-0.043271503033100789], [0.092464344194582909], [1.8005771080622797]]}";
    let stored = read_text(plain, LengthUnit::Metre).unwrap();
    assert_eq!(stored.camera, want);
}

#[test]
fn faults_are_named() {
    assert!(fault("hello").contains("neither"));
    assert!(
        fault("%YAML:1.0\n---\n").contains("no intrinsics")
            && fault("%YAML:1.0\n---\n").contains("no matrix")
    );
    assert!(fault(&YAML.replace("roration", "turn")).contains("no rotation"));
    assert!(fault(&YAML.replace("   rows: 3\n   cols: 1", "   rows: 9\n   cols: 1"))
        .contains("9 x 1 but 3 numbers"));
    assert!(fault(&YAML.replace("   rows: 3\n   cols: 1", "   rows: 3000000000\n   cols: 1"))
        .contains("rows is missing"));
    assert!(fault(&YAML.replace("0., -1., 0., 1.", "0., -2., 0., 1.")).contains("not a rotation"));
    assert!(fault(&YAML.replace("0., -1., 0., 1.", "0., 1., 0., 1.")).contains("not a rotation"));
    assert!(fault(&YAML.replace("1.2e+03", "-1.2e+03")).contains("focal"));
    assert!(fault(&YAML.replace("1.2e+03", "abc")).contains("\"abc\" is not a number"));
    assert!(fault(&YAML.replace("1.2e+03", ".Nan")).contains("not finite"));
    assert!(fault(&YAML.replace("1.2e+03, 0.", "1.2e+03, 5.")).contains("skew"));
    assert!(fault(&YAML.replace("-0.1, 0.01", ".Inf, 0.01")).contains("proj_kc"));
    assert!(fault(&YAML.replace("200., 300. ]", "200., 300.")).contains("does not end"));
    assert!(fault(&YAML.replace("cols: 5", "cols: 3").replace("-0.1, 0.01, 0., 0., 0.", "0., 0., 0."))
        .contains("has 3 numbers"));
    assert!(fault(&YAML.replace("-0.1, 0.01", "-9.0, 0.0")).contains("cannot be inverted"));
    assert!(fault(&"x".repeat(MAX_BYTES + 1)).contains("at most"));
    let bytes = |bytes: &[u8]| read(bytes, &options(LengthUnit::Metre)).unwrap_err().to_string();
    assert!(bytes(b"PK\x03\x04....").contains("damaged or cut off"));
    assert!(bytes(b"vwf1....").contains("VIOSO"));
    assert!(bytes(b"\xff\xfe").contains("UTF-8"));
    let xml = made_by_opencv("brown5.xml");
    assert!(fault(&xml.replace("</camera_matrix>", "")).contains("closes"));
    assert!(fault(xml.trim_end().trim_end_matches("</opencv_storage>")).contains("not closed"));
    let json = made_by_opencv("brown5.json");
    assert!(fault(&json.replacen("1100.0", ".Nan", 1)).contains("not finite"));
    assert!(fault(&json.replacen("\"rows\": 3", "\"rows\": 4", 1)).contains("4 x 3 but 9"));
    assert!(fault(&json.replacen(']', "", 1)).contains("line"));
    assert!(fault(&format!("{json}{json}")).contains("follows the end"));
    assert!(fault(&"[".repeat(100_000)).contains("nested"));
    let deep = format!("<opencv_storage>{}", "<a>".repeat(100_000));
    assert!(fault(&deep).contains("nested"));
}

#[test]
fn cut_off_files_never_panic() {
    let seeds =
        [YAML.to_string(), made_by_opencv("tilted14.json"), made_by_opencv("fisheye.xml"), MPCDI.into()];
    for text in seeds {
        for end in (0..text.len()).filter(|end| text.is_char_boundary(*end)) {
            let _ = read_text(&text[..end], LengthUnit::Metre);
            let _ = read_text(&text[end..], LengthUnit::Metre);
        }
    }
}

/// Texts of the largest size that would take hours if any part of the readers took the square of their length.
#[test]
fn the_largest_texts_are_read_in_a_moment() {
    let begun = std::time::Instant::now();
    for (start, unit) in [
        ("%YAML:1.0\n", "a: [\n"),
        ("%YAML:1.0\n", "a: [1]\n"),
        ("%YAML:1.0\n", "a: !!opencv-matrix\n"),
        ("%YAML:1.0\n", "- - - -"),
        ("<opencv_storage a='", "=''='"),
        ("<opencv_storage>", "<a/>"),
        ("<opencv_storage>", "<!--"),
        ("<opencv_storage>", "&amp;"),
        ("{", "\"a\":1,"),
        ("{", "//"),
        ("{", "/*\n*/"),
        ("{\"a\":[", "[1],"),
        ("<MPCDI profile=\"sl\"><display><buffer>", "<region id='a'/>"),
    ] {
        let text = format!("{start}{}", unit.repeat((MAX_BYTES - start.len()) / unit.len()));
        let _ = read_text(&text, LengthUnit::Metre);
    }
    assert!(begun.elapsed().as_secs() < 20, "{:?}", begun.elapsed());
}

/// By the public example of Christie: Z is up and Y is forward.
const MPCDI: &str = include_str!("../../../tests/assets/mpcdi/shader_lamp.mpcdi.xml");

#[test]
fn a_region_of_mpcdi_looks_where_its_angles_say() {
    let raster = Raster::new(1400, 1050).unwrap();
    let at = |text: &str, region| {
        read(text.as_bytes(), &ReadOptions { raster, region, ..options(LengthUnit::Metre) })
    };
    let stored = at(MPCDI, None).unwrap();
    assert_eq!((stored.image_size, &stored.frame), (Some((1400, 1050)), &PoseFrame::World));
    assert!(stored.unread.is_empty());
    let c = stored.camera;
    assert!((c.position() - DVec3::new(1.0, -1.0, -0.5)).length() < 1e-12);
    // Turned 45 degrees to the left of +Y, then 30 degrees up: by hand.
    let (flat, rise) = (30f64.to_radians().cos(), 30f64.to_radians().sin());
    let half = std::f64::consts::FRAC_1_SQRT_2;
    let ahead = DVec3::new(-half * flat, half * flat, rise);
    let axis = c.project(c.position() + ahead * 2.0).unwrap();
    assert!((axis.x - 700.0).abs() < 1e-9, "{axis}");
    // The edges are seen under their angles; the picture's right is to the right of the one who looks along.
    let right = DVec3::new(half, half, 0.0);
    let tan = |deg: f64| deg.to_radians().tan();
    let up = right.cross(ahead);
    let edge = |x: f64, y: f64| c.project(c.position() + ahead + right * tan(x) + up * tan(y)).unwrap();
    assert!((edge(26.5, 0.0).x - 1400.0).abs() < 1e-9 && edge(-26.5, 0.0).x.abs() < 1e-9);
    assert!(edge(0.0, 30.0).y.abs() < 1e-9 && (edge(0.0, -5.0).y - 1050.0).abs() < 1e-9);
    // A positive roll lowers the right wing: what lay to the right is now above the axis's row.
    let rolled = at(&MPCDI.replace("<roll>0", "<roll>20"), None).unwrap().camera;
    assert!(rolled.project(c.position() + ahead + right * 0.3).unwrap().y < axis.y - 50.0);
}

#[test]
fn what_is_not_read_of_mpcdi_is_named() {
    let raster = Raster::new(1400, 1050).unwrap();
    let at = |text: &str, region| {
        read(text.as_bytes(), &ReadOptions { raster, region, ..options(LengthUnit::Metre) })
    };
    let told = |from: &str, to: &str| at(&MPCDI.replace(from, to), None).unwrap_err().to_string();
    assert!(told("\"sl\"", "\"3d\"").contains("profile \"sl\""));
    assert!(told("<leftAngle>-26.5", "<leftAngle>27").contains("frustum"));
    assert!(told("<upAngle>30", "<upAngle>NaN").contains("upAngle"));
    assert!(told("<pitchx>1", "<pitchx>-1").contains("right-handed"));
    assert!(told("<geometricUnit>m<", "<geometricUnit>mm<").contains("\"mm\""));
    assert!(told("xResolution=\"1400\"", "xResolution=\"0\"").contains("xResolution"));
    let lens =
        "</files><extensionSet><extension><buffer id=\"b\"><region id=\"left &amp; low\"><fisheye/></region>\
                </buffer></extension></extensionSet>";
    assert!(told("</files>", lens).contains("fisheye"));
    let mapped = at(&MPCDI.replace("<distortionMap><path>", "<distortionMap><path>d.pfm"), None).unwrap();
    assert_eq!(mapped.unread, ["distortionMap d.pfm"]);
    let two = MPCDI.replace("</buffer>", "<region id=\"other\"/></buffer>");
    let refused = at(&two, None).unwrap_err().to_string();
    assert!(refused.contains("\"other\"") && refused.contains("calibration_region"), "{refused}");
    assert!(at(&two, Some("left & low")).is_ok());
    assert!(at(MPCDI, Some("nobody")).is_err());
}
