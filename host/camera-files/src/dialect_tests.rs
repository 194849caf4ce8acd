//! One projector in every dialect is the same projector, or it is refused with the right advice; nothing is taken for it in
//! silence.

use super::*;
use glam::DVec2;
use std::path::{Path, PathBuf};

const K: &str = "1500, 0, 512, 0, 1500, 700, 0, 0, 1";
const R: &str =
    "1, 0, 0, 0, -0.97513285579145981, 0.22162110358896811, 0, -0.22162110358896811, -0.97513285579145981";
const T: &str = "0, 0.097513285579145972, 1.1502135276267447";
const POSE: &str = "[[1, 0, 0, 0], [0, -0.97513285579145981, 0.22162110358896811, 0.097513285579145972], \
                    [0, -0.22162110358896811, -0.97513285579145981, 1.1502135276267447], [0, 0, 0, 1]]";

/// Where the projector of all files shows a point of the world, by hand: in this project's convention.
fn shown(p: DVec3, [k1, k2]: [f64; 2]) -> DVec2 {
    let (c, s) = (-0.975_132_855_791_459_8, 0.221_621_103_588_968_1);
    let seen = [p.x, c * p.y + s * p.z + 0.097_513_285_579_145_97, -s * p.y + c * p.z + 1.1502135276267447];
    let (x, y) = (seen[0] / seen[2], seen[1] / seen[2]);
    let r2 = x * x + y * y;
    let bent = 1.0 + k1 * r2 + k2 * r2 * r2;
    DVec2::new(1500.0 * x * bent + 512.5, 1500.0 * y * bent + 700.5)
}

fn options(unit: LengthUnit) -> ReadOptions<'static> {
    let raster = Raster::new(1024, 768).unwrap();
    ReadOptions { raster, unit, lens: LensKind::Auto, region: None, device: None }
}

fn check(stored: &StoredCalibration, lens: [f64; 2], what: &str) {
    for x in [-0.2, 0.0, 0.15] {
        for y in [-0.1, 0.05, 0.2] {
            for z in [-0.1, 0.12] {
                let world = DVec3::new(x, y, z);
                let got = stored.camera.project(world).unwrap();
                assert!((got - shown(world, lens)).length() < 0.01, "{what}: {got} {}", shown(world, lens));
            }
        }
    }
}

fn case(name: &str) -> Vec<u8> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/cases");
    let path: PathBuf = folder.join(name);
    std::fs::read(path).unwrap()
}

fn matrix(name: &str, (rows, cols): (usize, usize), data: &str) -> String {
    format!("{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n")
}

/// Dialects whose pose is told in the world.
#[test]
fn every_dialect_gives_the_same_projector() {
    let lens = "-0.05, 0.02, 0, 0, 0";
    let (k, r, t) = (matrix("K", (3, 3), K), matrix("R", (3, 3), R), matrix("T", (3, 1), T));
    let nested = "{\"calibration\": {\"projector\": {\"intrinsics\": {\"fx\": 1500, \"fy\": 1500, \"cx\": 512, \"cy\": 700}, \
                  \"dist\": [-0.05, 0.02, 0, 0, 0], \"resolution\": [1024, 768]}, \"extrinsics\": POSE}}";
    let ros2 = format!(
        "image_width: 1024\nimage_height: 768\ncamera_name: projector\ncamera_matrix:\n  rows: 3\n  cols: 3\n  data: [{K}]\n\
         distortion_model: plumb_bob\ndistortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [{lens}]\n\
         projection_matrix:\n  rows: 3\n  cols: 4\n  data: [1500, 0, 512, 0, 0, 1500, 700, 0, 0, 0, 1, 0]\n\
         rvec: [-2.9181157, 0, 0]\ntvec: [{T}]\n"
    );
    let by_line = |name: &str, data: &str| {
        let rows: Vec<String> = data.split(", ").map(|v| format!("  - {v}\n")).collect();
        format!("{name}:\n{}", rows.concat())
    };
    let pyyaml = {
        let rows: Vec<&str> = K.split(", ").collect();
        let row = |i: usize| format!("- - {}\n  - {}\n  - {}\n", rows[i], rows[i + 1], rows[i + 2]);
        let mtx = format!("mtx:\n{}{}{}", row(0), row(3), row(6));
        let rvec = "rvec:\n- - -2.9181157\n- - 0.0\n- - 0.0\n";
        format!("{mtx}{}{rvec}{}", by_line("dist", lens), by_line("tvec", T))
    };
    // Its keys are sorted, so that the numbers stand before the rows: line by line, or in brackets.
    let sorted = |name: &str, rows: usize, cols: usize, data: &str| {
        let numbers = match cols {
            1 => format!("data: [{data}]"),
            _ => "data:\n".to_owned() + &data.split(", ").map(|v| format!("  - {v}\n")).collect::<String>(),
        };
        format!("{name}:\n  cols: {cols}\n  {}\n  rows: {rows}\n", numbers.trim_end())
    };
    let ros_by_pyyaml = format!(
        "{}{}distortion_model: plumb_bob\nimage_height: 768\nimage_width: 1024\n{}{}",
        sorted("camera_matrix", 3, 3, K),
        sorted("distortion_coefficients", 1, 5, lens),
        sorted("R", 3, 3, R),
        sorted("T", 3, 1, T),
    );
    let map = |text: &str| text.replace("POSE", POSE);
    let files: Vec<(&str, String)> = vec![
        ("OpenCV flat", format!("%YAML:1.0\n{k}{}{r}{t}", matrix("D", (1, 5), lens))),
        ("nested JSON", map(nested)),
        ("camera_info", ros2),
        ("PyYAML", pyyaml),
        ("camera_info by PyYAML", ros_by_pyyaml),
        (
            "kalibr",
            "cam0:\n  camera_model: pinhole\n  intrinsics: [1500.0, 1500.0, 512.0, 700.0]\n  distortion_model: radtan\n  \
                 distortion_coeffs: [-0.05, 0.02, 0, 0]\n  resolution: [1024, 768]\n  T_cam_imu:\n  - [1, 0, 0, 0]\n  \
                 - [0, -0.97513285579145981, 0.22162110358896811, 0.097513285579145972]\n  \
                 - [0, -0.22162110358896811, -0.97513285579145981, 1.1502135276267447]\n  - [0, 0, 0, 1]\n".to_string(),
        ),
        (
            "numbers one by one",
            map("{\"fx\": 1500, \"fy\": 1500, \"ppx\": 512, \"ppy\": 700, \"k1\": -0.05, \"k2\": 0.02, \"world_to_camera\": POSE}"),
        ),
        (
            "lists of nine",
            format!("{{\"k\": [{K}], \"d\": [{lens}], \"rotation\": [{R}], \"translation\": [{T}]}}"),
        ),
        (
            "sections of XML",
            format!(
                "<?xml version=\"1.0\"?><opencv_storage><Projector_0><imageWidth>1024</imageWidth><imageHeight>768</imageHeight>\
                 <cameraMatrix type_id=\"opencv-matrix\"><rows>3</rows><cols>3</cols><dt>d</dt><data>{}</data></cameraMatrix>\
                 <distortionCoeffs type_id=\"opencv-matrix\"><rows>1</rows><cols>5</cols><dt>d</dt><data>{}</data>\
                 </distortionCoeffs><R type_id=\"opencv-matrix\"><rows>3</rows><cols>3</cols><dt>d</dt><data>{}</data></R>\
                 <T type_id=\"opencv-matrix\"><rows>3</rows><cols>1</cols><dt>d</dt><data>{}</data></T></Projector_0>\
                 </opencv_storage>",
                K.replace(',', " "), lens.replace(',', " "), R.replace(',', " "), T.replace(',', " ")
            ),
        ),
        (
            "braces of YAML",
            format!("projector: {{ K: [{K}], dist: [{lens}], R: [{R}], t: [{T}] }}\nimage_size: [1024, 768]\n"),
        ),
    ];
    for (name, text) in files {
        let stored = read(text.as_bytes(), &options(LengthUnit::Metre));
        let stored = stored.unwrap_or_else(|e| panic!("{name}: {e}\n{text}"));
        check(&stored, [-0.05, 0.02], name);
        assert!(stored.unread.is_empty() && stored.frame == PoseFrame::World, "{name}: {stored:?}");
    }
}

/// Files in the dialects of many programs, and the pixels by OpenCV itself: `tests/peers/calibrations.py` wrote both.
#[test]
fn dialects_project_as_opencv_does() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/dialects");
    let text = |name: &str| std::fs::read_to_string(folder.join(name)).unwrap();
    let pixels: Vec<Vec<f64>> = text("pixels.csv")
        .lines()
        .skip(1)
        .map(|line| line.split(',').map(|number| number.parse().unwrap()).collect())
        .collect();
    assert!(pixels.len() > 50);
    let (mut read_ones, mut refused) = (0, 0);
    for line in text("dialects.tsv").lines().skip(1) {
        let [file, unit, device, frame, right] = line.split('\t').collect::<Vec<_>>()[..] else {
            panic!("{line}")
        };
        let unit = if unit == "metre" { LengthUnit::Metre } else { LengthUnit::Millimetre };
        let device = Some(device).filter(|device| *device != "-");
        let bytes = std::fs::read(folder.join(file)).unwrap();
        let got = read(&bytes, &ReadOptions { device, ..options(unit) });
        if let Some(advice) = right.strip_prefix("refused: ") {
            let told = got.unwrap_err().to_string();
            assert!(advice.split(", ").all(|word| told.contains(word)), "{file}: {told}");
            refused += 1;
            continue;
        }
        let got = got.unwrap_or_else(|e| panic!("{file}: {e}"));
        let is_as_told = match (&got.frame, frame) {
            (PoseFrame::World, "world") | (PoseFrame::Camera { .. }, "camera") => true,
            (PoseFrame::WorldOfCamera { .. }, told) => told == "world of camera",
            _ => false,
        };
        assert!(is_as_told, "{file}: {:?}", got.frame);
        let first =
            ["lens", "lens of four", "no lens", "fisheye"].iter().position(|l| *l == right).unwrap() * 2 + 3;
        for row in &pixels {
            let pixel = got.camera.project(DVec3::new(row[0], row[1], row[2])).unwrap();
            // OpenCV's pixels have their centres at whole numbers.
            let off = pixel - DVec2::new(row[first] + 0.5, row[first + 1] + 0.5);
            assert!(off.length() < 0.01, "{file}: {pixel} {row:?}");
        }
        read_ones += 1;
    }
    assert_eq!((read_ones, refused), (27, 23));
}

#[test]
fn several_devices_are_a_question_whose_answer_is_the_projector() {
    for (name, unit, lens, answer) in [
        ("c01-two-devices-procamcalib.yml", LengthUnit::Millimetre, [-0.05, 0.02], "projector 0"),
        ("c02-two-devices.json", LengthUnit::Metre, [0.0; 2], "projector"),
    ] {
        let bytes = case(name);
        let told = read(&bytes, &options(unit)).unwrap_err().to_string();
        assert!(told.contains("2 devices") && told.contains("calibration_device"), "{told}");
        assert!(
            told.to_lowercase().contains("camera") && told.to_lowercase().contains("projector"),
            "{told}"
        );
        let stored = read(&bytes, &ReadOptions { device: Some(answer), ..options(unit) }).unwrap();
        check(&stored, lens, name);
        assert!(matches!(stored.frame, PoseFrame::WorldOfCamera { .. }), "{:?}", stored.frame);
        assert!(stored
            .unread
            .iter()
            .any(|u| u.starts_with("the device") && u.to_lowercase().contains("camera")));
        let other = read(&bytes, &ReadOptions { device: Some("nobody"), ..options(unit) }).unwrap_err();
        assert!(other.to_string().contains("\"nobody\""), "{other}");
    }
    // The gamma of a projector is a number that nothing uses.
    let stored = read(
        &case("c01-two-devices-procamcalib.yml"),
        &ReadOptions { device: Some("Projector  0"), ..options(LengthUnit::Millimetre) },
    );
    assert!(stored.unwrap().unread.contains(&"Projector  0/responseGamma".to_owned()));
    // Numbered matrices: the pose leads from the first device to the second.
    let stereo = ["M1", "M2"].map(|m| matrix(m, (3, 3), K)).concat();
    let stereo = format!("%YAML:1.0\n{stereo}{}{}", matrix("R", (3, 3), R), matrix("T", (3, 1), T));
    let told = |device| read(stereo.as_bytes(), &ReadOptions { device, ..options(LengthUnit::Metre) });
    assert!(told(None).unwrap_err().to_string().contains("2 devices"));
    assert!(matches!(told(Some("2")).unwrap().frame, PoseFrame::Camera { .. }));
    assert!(told(Some("1")).unwrap_err().to_string().contains("device 1"));
}

#[test]
fn the_files_by_other_programs_are_read_or_refused_with_advice() {
    let slstudio = read(&case("c04-slstudio-names.xml"), &options(LengthUnit::Millimetre)).unwrap();
    check(&slstudio, [-0.05, 0.02], "slstudio");
    assert!(matches!(slstudio.frame, PoseFrame::Camera { .. }) && slstudio.unread == ["the device camera"]);
    let metre = |name: &str| read(&case(name), &options(LengthUnit::Metre));
    check(&metre("c05-kalibr.yaml").unwrap(), [-0.05, 0.02], "kalibr");
    check(&metre("c08-pose-4x4.yml").unwrap(), [0.0; 2], "4 x 4");
    let packed = metre("c14-opencv.yml.gz").unwrap();
    assert!((packed.camera.cy - 922.1).abs() < 1e-9, "{}", packed.camera.cy);
    let scaled = metre("c16-size-imageWidth.yml").unwrap();
    assert_eq!(scaled.image_size, Some((1920, 1440)));
    assert!((scaled.camera.fx - 800.0).abs() < 1e-9, "{}", scaled.camera.fx);
    let mpcdi = metre("c10-mpcdi-zip-3d.mpcdi").unwrap_err().to_string();
    assert!(["2 regions", "\"r0\"", "\"r1\"", "\"3d\"", "sl"].iter().all(|w| mpcdi.contains(w)), "{mpcdi}");
    let numpy = metre("c11-numpy.npz").unwrap_err().to_string();
    assert!(numpy.contains("numpy") && numpy.contains("mtx, dist, rvec, tvec") && numpy.contains("JSON"));
}

/// What a word does not settle is asked, and what cannot be is refused.
#[test]
fn what_is_ambiguous_is_not_guessed() {
    let fault = |text: &str| read(text.as_bytes(), &options(LengthUnit::Metre)).unwrap_err().to_string();
    let k = format!("\"K\": [{K}]");
    let pose = POSE.replace("0.097513285579145972", "9");
    for (text, told) in [
        (format!("{{{k}, \"pose\": {POSE}}}"), "camera_to_world"),
        (format!("{{{k}, \"rvec\": [1, 0, 0], \"R\": [{R}], \"T\": [{T}]}}"), "different rotations"),
        (format!("{{{k}, \"extrinsics\": {POSE}, \"w2c\": {pose}}}"), "different poses"),
        (format!("{{{k}, \"rvec\": [-90, 0, 0], \"tvec\": [{T}]}}"), "in degrees"),
        (
            format!("{{\"fx\": 1.46, \"fy\": 1.95, \"cx\": 0.5, \"cy\": 0.9, \"R\": [{R}], \"T\": [{T}]}}"),
            "normalised",
        ),
        (
            format!("{{\"K\": [[1500, 0, 0], [0, 1500, 0], [512, 700, 1]], \"R\": [{R}], \"T\": [{T}]}}"),
            "transpose",
        ),
        (format!("{{{k}, \"mtx\": [900, 900, 327, 235], \"R\": [{R}], \"T\": [{T}]}}"), "different lenses"),
        (
            format!(
                "{{{k}, \"R\": [{R}], \"T\": [{T}], \"width\": 1024, \"height\": 768, \"size\": [640, 480]}}"
            ),
            "different sizes",
        ),
        (
            format!("{{\"camera\": {{{k}}}, \"projector\": {{\"lens\": 3, \"R\": [{R}], \"T\": [{T}]}}}}"),
            "\"projector\"",
        ),
        (format!("{{{k}, \"distortion_model\": \"fov\", \"R\": [{R}], \"T\": [{T}]}}"), "\"fov\""),
    ] {
        let got = fault(&text);
        assert!(got.contains(told), "{told}: {got}\n{text}");
    }
    // A pose of the projector in the world is turned about.
    let inverse = "[[1, 0, 0, 0], [0, -0.97513285579145981, -0.22162110358896811, 0.35000], \
                   [0, 0.22162110358896811, -0.97513285579145981, 1.1], [0, 0, 0, 1]]";
    let text = format!("{{{k}, \"camera_to_world\": {inverse}}}");
    let stored = read(text.as_bytes(), &options(LengthUnit::Metre)).unwrap();
    check(&stored, [0.0; 2], "camera to world");
    let far =
        format!("{{\"K\": [1500, 0, 960, 0, 1500, 540, 0, 0, 1], \"R\": [{R}], \"T\": [{T}], \"gain\": 3}}");
    let stored = read(far.as_bytes(), &options(LengthUnit::Metre)).unwrap();
    assert!(stored.notes.iter().any(|n| n.contains("calibration_raster")), "{:?}", stored.notes);
    assert_eq!(stored.unread, ["gain"]);
}

#[test]
fn archives_of_any_bytes_end() {
    let whole = case("c10-mpcdi-zip-3d.mpcdi");
    let packed = case("c14-opencv.yml.gz");
    for bytes in [&whole, &packed] {
        for end in 0..bytes.len() {
            let _ = read(&bytes[..end], &options(LengthUnit::Metre));
            let mut damaged = bytes.clone();
            damaged[end] ^= 0x5a;
            let _ = read(&damaged, &options(LengthUnit::Metre));
        }
    }
    // A megabyte of zeros a thousand times is refused before it is unpacked.
    use std::io::Write;
    let mut bomb = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    bomb.write_all(&vec![0; 64 << 20]).unwrap();
    let told = read(&bomb.finish().unwrap(), &options(LengthUnit::Metre)).unwrap_err();
    assert!(matches!(told, StorageError::TooLarge(_)), "{told}");
}
