//! Calibration files that OpenCV wrote, end to end: `dpm run` reads one, traces small triangles through its lens, and the
//! mock projector's light lies where OpenCV's `projectPoints` puts these triangles.
//!
//! `tests/assets/opencv/make.py` made the files and the outlines. Every pixel whose centre lies farther than
//! [`TOLERANCE_PX`] from an outline must be lit inside and dark outside.

use crate::cli_common::{code, dpm, err, out, TestFolder};
use dpm_camera_files::{self as camera_files, LengthUnit, LensKind, ReadOptions};
use glam::{DVec2, DVec3};
use std::path::{Path, PathBuf};

const WIDTH: u32 = 1024;
const HEIGHT: u32 = 768;
/// The middles of the edges are known, so that what is left of their bend is below 0.003 px; the lens may be wrong by the
/// rest.
const TOLERANCE_PX: f64 = 0.01;

fn asset(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/assets/opencv").join(name)
}

/// A triangle in the world, and its outline on the raster as OpenCV sees it: corners and middles of the edges.
struct Triangle {
    corners: [DVec3; 3],
    outline: [DVec2; 6],
}

fn triangles(model: &str) -> Vec<Triangle> {
    let text = std::fs::read_to_string(asset(&format!("{model}.triangles.csv"))).expect("an asset");
    let lines = text.lines().skip(1).map(|line| {
        let v: Vec<f64> = line.split(',').map(|n| n.parse().expect("a number")).collect();
        Triangle {
            corners: [0, 3, 6].map(|i| DVec3::from_slice(&v[i..])),
            outline: [9, 11, 13, 15, 17, 19].map(|i| DVec2::from_slice(&v[i..])),
        }
    });
    lines.collect()
}

/// A scene of glowing triangles before a black wall, as binary glTF. All coordinates are the world's.
fn scene(triangles: &[Triangle], wall: [DVec3; 6]) -> Vec<u8> {
    let glowing: Vec<DVec3> = triangles.iter().flat_map(|t| t.corners).collect();
    let mut buffer = Vec::new();
    let mut accessors = Vec::new();
    let mut views = Vec::new();
    for points in [&glowing[..], &wall[..]] {
        let offset = buffer.len();
        let (low, high) = points.iter().fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| {
            buffer.extend(p.as_vec3().to_array().iter().flat_map(|v| v.to_le_bytes()));
            (low.min(*p), high.max(*p))
        });
        let (low, high) = (low.as_vec3().to_array(), high.as_vec3().to_array());
        accessors.push(
            serde_json::json!({"bufferView": views.len(), "componentType": 5126, "count": points.len(),
            "type": "VEC3", "min": low, "max": high}),
        );
        let length = buffer.len() - offset;
        views.push(serde_json::json!({"buffer": 0, "byteOffset": offset, "byteLength": length}));
    }
    // An unlit surface has no coat, so the wall does not mirror the triangles.
    let colour = |c: u32| serde_json::json!({"baseColorFactor": [c, c, c, 1]});
    let unlit = serde_json::json!({"KHR_materials_unlit": {}});
    let json = serde_json::json!({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"name": "targets", "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0},
            {"attributes": {"POSITION": 1}, "material": 1}]}],
        "materials": [
            {"emissiveFactor": [1, 1, 1], "pbrMetallicRoughness": colour(0), "doubleSided": true},
            {"pbrMetallicRoughness": colour(0), "extensions": unlit, "doubleSided": true}],
        "extensionsUsed": ["KHR_materials_unlit"],
        "accessors": accessors, "bufferViews": views, "buffers": [{"byteLength": buffer.len()}],
    });
    let mut text = json.to_string().into_bytes();
    text.resize(text.len().next_multiple_of(4), b' ');
    let mut glb = Vec::new();
    for word in [0x4654_6c67, 2, 12 + 8 + text.len() + 8 + buffer.len(), text.len(), 0x4e4f_534a] {
        glb.extend((word as u32).to_le_bytes());
    }
    glb.extend(text);
    for word in [buffer.len(), 0x004e_4942] {
        glb.extend((word as u32).to_le_bytes());
    }
    glb.extend(buffer);
    glb
}

/// How far inside an outline a point lies; negative outside.
fn depth_inside(outline: &[DVec2; 6], point: DVec2) -> f64 {
    let (mut nearest, mut inside) = (f64::INFINITY, false);
    for (i, a) in outline.iter().enumerate() {
        let b = outline[(i + 1) % outline.len()];
        let along = ((point - a).dot(b - a) / (b - a).length_squared()).clamp(0.0, 1.0);
        nearest = nearest.min((*a + (b - a) * along - point).length());
        let crosses = (a.y > point.y) != (b.y > point.y);
        if crosses && point.x < a.x + (b.x - a.x) * (point.y - a.y) / (b.y - a.y) {
            inside = !inside;
        }
    }
    if inside {
        nearest
    } else {
        -nearest
    }
}

/// What the light of one run says about outlines that are moved by `shift`.
#[derive(Debug, Default)]
struct OutlineVerdict {
    lit: u32,
    /// Pixels within 0.1 px of an outline, but not within the tolerance: what makes the test sharp.
    close: u32,
    wrong: u32,
    /// The largest distance from an outline at which a pixel is wrong.
    worst_px: f64,
}

fn judge(light: &image::RgbImage, triangles: &[Triangle], shift: DVec2) -> OutlineVerdict {
    let mut verdict = OutlineVerdict::default();
    for (x, y, pixel) in light.enumerate_pixels() {
        // OpenCV's pixel centres are at whole numbers.
        let centre = DVec2::new(f64::from(x), f64::from(y)) - shift;
        let near = triangles.iter().filter(|t| (t.outline[0] - centre).length() < 40.0);
        let depth = near.map(|t| depth_inside(&t.outline, centre)).fold(-40.0, f64::max);
        let lit = pixel.0[0] > 127;
        verdict.lit += u32::from(lit);
        verdict.close += u32::from(depth.abs() < 0.1 && depth.abs() > TOLERANCE_PX);
        if lit != (depth > 0.0) {
            verdict.wrong += u32::from(depth.abs() > TOLERANCE_PX);
            verdict.worst_px = verdict.worst_px.max(depth.abs());
        }
    }
    verdict
}

/// Runs `dpm run` with the calibration file of a model and returns the light.
fn light_of(model: &str, form: &str, method: &str, triangles: &[Triangle]) -> image::RgbImage {
    let calibration = asset(&format!("{model}.{form}"));
    let raster = dpm_device::planes::Raster::new(WIDTH, HEIGHT).expect("not zero");
    let options =
        ReadOptions { raster, unit: LengthUnit::Metre, lens: LensKind::Auto, region: None, device: None };
    let bytes = std::fs::read(&calibration).expect("an asset");
    let camera = camera_files::read(&bytes, &options).expect("a calibration").camera;
    // The wall only tells the picture's writer that there is a surface; it is far and wide.
    let at = |x: f64, y: f64| camera.world_from_projector.transform_point3(DVec3::new(x, y, -4.0));
    let [a, b, c, d] = [at(-8.0, -8.0), at(8.0, -8.0), at(8.0, 8.0), at(-8.0, 8.0)];
    let folder = TestFolder::new(&format!("opencv-{model}-{method}"));
    std::fs::write(folder.path("scene.glb"), scene(triangles, [a, b, c, a, c, d])).expect("written");
    // So little light that every glowing pixel is driven in full, and an eye in the lens, from which nothing is hidden.
    let eye = camera.position().to_array();
    let rig = format!(
        "[projector]\nwidth = {WIDTH}\nheight = {HEIGHT}\ncalibration = {:?}\ncalibration_unit = \"metre\"\n\
         max_intensity = 0.001\n[render]\nmethod = \"{method}\"\nspp = 1\nsoftware_raster = [{WIDTH}, {HEIGHT}]\n\
         [observer]\nposition = {eye:?}\n[tracker]\nkind = \"mock\"\nnoise_m = 0\n[real_time]\npace = \"virtual\"\n[scene]\nfile = \"scene.glb\"\n\
         environment = {{ kind = \"constant\", radiance = [0, 0, 0] }}\n[output]\nimages = true\n\
         [[scene.bodies]]\nname = \"targets\"\nnode = \"targets\"\nmotion = {{ kind = \"still\" }}\n",
        calibration.display().to_string()
    );
    let path = folder.write("rig.toml", &rig);
    let output = dpm(&["run", &path, "--json", "--frames", "2", "--out", folder.text()], &[]);
    assert_eq!(code(&output), 0, "{model}: {}", err(&output));
    let report: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    let told = (&report["frames_lit"], &report["raster"]);
    assert_eq!(told, (&2.into(), &serde_json::json!([WIDTH, HEIGHT])), "{report}");
    image::open(folder.path("light.png")).expect("the light").to_rgb8()
}

fn check(model: &str, form: &str, method: &str) {
    let triangles = triangles(model);
    let light = light_of(model, form, method, &triangles);
    let verdict = judge(&light, &triangles, DVec2::ZERO);
    println!("{model}.{form} {method}: {verdict:?}");
    assert!(verdict.lit > 2000 && verdict.close > 100, "{model}: {verdict:?}");
    assert_eq!(verdict.wrong, 0, "{model}.{form} with {method}: {verdict:?}");
    // The test would see a tenth of a pixel.
    for shift in [DVec2::X, DVec2::NEG_X, DVec2::Y, DVec2::NEG_Y] {
        let moved = judge(&light, &triangles, shift * 0.1);
        assert!(moved.wrong > 10, "{model}: {moved:?}");
    }
}

#[test]
fn a_pinhole_of_opencv_lights_what_opencv_projects() {
    check("none", "xml", "full");
}

/// The rays of such a lens cross inside the raster, so no single ray belongs to a mirror there.
#[test]
fn a_lens_that_folds_is_refused_before_there_is_light() {
    let folder = TestFolder::new("fold");
    let text = std::fs::read_to_string(asset("brown5.yml")).expect("an asset");
    let k1 = "data: [ -0.23999999999999999,";
    assert!(text.contains(k1), "{text}");
    let file = folder.path("fold.yml");
    std::fs::write(&file, text.replace(k1, "data: [ -2.0,")).expect("a file");
    let calibration = format!("projector.calibration={:?}", file.display().to_string());
    let keys = ["--set", &calibration, "--set", "projector.calibration_unit=metre"];
    for command in [&["plan"][..], &["demo", "--frames", "2"], &["snapshot"]] {
        let output = dpm(&[command, &keys].concat(), &[]);
        assert_eq!(code(&output), 2, "{command:?}: {}", err(&output));
        let told = err(&output);
        assert!(told.contains("cannot be inverted") && told.contains("projector.calibration"), "{told}");
    }
}

/// Every model of a lens.
mod breadth {
    use super::*;

    #[test]
    fn a_lens_of_brown_lights_what_opencv_projects() {
        check("brown4", "yml", "full");
        check("brown5", "json", "dpm");
    }

    #[test]
    fn a_fisheye_lens_lights_what_opencv_projects() {
        check("fisheye", "xml", "full");
    }

    #[test]
    fn a_tilted_panel_lights_what_opencv_projects() {
        check("tilted14", "json", "dpm");
    }

    #[test]
    fn a_rational_lens_lights_what_opencv_projects() {
        check("rational8", "xml", "dpm");
    }

    #[test]
    fn a_thin_prism_lights_what_opencv_projects() {
        check("prism12", "yml", "full");
    }
}
