//! `dpm snapshot` of a scene by itself: its pictures show the whole of it, whatever its size and place.

use crate::cli_common::{code, dpm, err, out, TestFolder};
use std::fmt::Write;
use std::path::Path;

const WIDTH: usize = 64;
const HEIGHT: usize = 48;

/// An OBJ file of a box with two opposite corners.
fn cuboid(from: [f64; 3], to: [f64; 3]) -> String {
    let mut text = String::from("o thing\n");
    for corner in 0..8 {
        let [x, y, z] = [0, 1, 2].map(|axis| if corner >> axis & 1 == 1 { to[axis] } else { from[axis] });
        let _ = writeln!(text, "v {x} {y} {z}");
    }
    text + "f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n"
}

/// Runs `dpm snapshot` at the small raster; returns its report.
fn snapshot(folder: &TestFolder, args: &[&str]) -> serde_json::Value {
    snapshot_at(2, folder, args)
}

fn snapshot_at(frame: u32, folder: &TestFolder, args: &[&str]) -> serde_json::Value {
    let raster = format!("{WIDTH}x{HEIGHT}");
    let frame = frame.to_string();
    let common = ["snapshot", "--json", "--raster", &raster, "--frame", &frame, "--out", folder.text()];
    let output = dpm(&[&common[..], args].concat(), &[("DPM_VALIDATION", "1")]);
    assert_eq!(code(&output), 0, "{args:?}: {}", err(&output));
    serde_json::from_str(&out(&output)).expect("one JSON object")
}

/// Radiance of every pixel, rows from below, from a portable float map.
fn radiance(path: &Path) -> Vec<f32> {
    let bytes = std::fs::read(path).expect("a picture");
    let texels = &bytes[bytes.len() - 12 * WIDTH * HEIGHT..];
    let value = |four: &[u8]| f32::from_le_bytes([four[0], four[1], four[2], four[3]]);
    texels.chunks_exact(12).map(|t| t.chunks_exact(4).map(value).fold(0.0, f32::max)).collect()
}

/// All of the asset is in the picture and is well lit: what is lit touches no border, fills half of a side, and is mid grey on
/// average with the exposure that was chosen.
fn shows_all(folder: &TestFolder, report: &serde_json::Value) {
    let pixels = radiance(&Path::new(folder.text()).join("radiance.pfm"));
    let lit: Vec<usize> = (0..pixels.len()).filter(|i| pixels[*i] > 0.0).collect();
    let range = |of: &dyn Fn(usize) -> usize| {
        let at = || lit.iter().map(|i| of(*i));
        (at().min().expect("lit pixels"), at().max().expect("lit pixels"))
    };
    let ((left, right), (low, high)) = (range(&|i| i % WIDTH), range(&|i| i / WIDTH));
    assert!(left > 0 && right < WIDTH - 1 && low > 0 && high < HEIGHT - 1, "{left} {right} {low} {high}");
    assert!(right - left > WIDTH / 2 || high - low > HEIGHT / 2, "{left} {right} {low} {high}");
    let exposure = report["view"]["exposure"].as_f64().expect("a number");
    let mean = lit.iter().map(|i| f64::from(pixels[*i])).sum::<f64>() / lit.len() as f64;
    assert!((0.15..=1.0).contains(&(mean * exposure)), "{mean} x {exposure}");
}

#[test]
fn what_cannot_be_shown_is_told() {
    let folder = TestFolder::new("snapshot-told");
    let lamp = "mtllib lamp.mtl\nusemtl lamp\n".to_owned() + &cuboid([0.0; 3], [1.0; 3]);
    let lamp = folder.write("lamp.obj", &lamp);
    folder.write("lamp.mtl", "newmtl lamp\nKe 1 1 1\n");
    for (args, told) in [
        (&[&lamp[..]][..], "no surface that light is projected on"),
        (&[&lamp, "--scene", &lamp], "there is a scene before it"),
        (&["nothing.glb"], "nothing.glb: No such file"),
    ] {
        let output = dpm(&[&["snapshot", "--out", folder.text()], args].concat(), &[]);
        assert_eq!(code(&output), 2, "{args:?}");
        assert!(err(&output).contains(told), "{}", err(&output));
    }
}

/// A scene that is too dark is shown brighter, and how much is told.
#[test]
fn a_far_greater_exposure_is_told() {
    let folder = TestFolder::new("snapshot-dark");
    let file = folder.write("thing.obj", &cuboid([0.0; 3], [1.0; 3]));
    let told = |radiance: &str| {
        let light = format!(
            "scene.environment={{ kind = \"constant\", radiance = [{radiance}, {radiance}, {radiance}] }}"
        );
        let output = dpm(
            &[
                "snapshot",
                &file,
                "--raster",
                "64x48",
                "--frame",
                "1",
                "--out",
                folder.text(),
                "--set",
                &light,
            ],
            &[],
        );
        assert_eq!(code(&output), 0, "{}", err(&output));
        out(&output)
    };
    let (dark, usual) = (told("0.01"), told("0.7"));
    assert!(dark.contains("the scene is dark, so its pictures are "), "{dark}");
    assert!(!usual.contains("the scene is dark"), "{usual}");
    // Found in use, O12: every success ended with two lines of pictures that its method does not have.
    assert!(!usual.contains("\nno "), "{usual}");
}

/// Scenes and rig files of other kinds.
mod breadth {
    use super::*;

    #[test]
    fn an_asset_of_any_size_and_place_is_shown_whole_and_lit() {
        let folder = TestFolder::new("snapshot-any");
        let assets = [
            ("tiny", cuboid([0.0; 3], [1e-4, 2e-4, 1e-4])),
            ("huge", cuboid([-1e5, 0.0, -1e5], [1e5, 2e5, 1e5])),
            ("far", cuboid([4e3, 20.0, -3e3], [4e3 + 0.5, 20.5, -3e3 + 0.5])),
            ("floor", cuboid([0.0; 3], [3.0, 1e-3, 2.0])),
            ("wall", cuboid([0.0; 3], [1e-3, 2.0, 3.0])),
        ];
        for (name, text) in assets {
            let asset = folder.write(&format!("{name}.obj"), &text);
            let report = snapshot(&folder, &[&asset, "--set", "scene.scale=1", "--what", "radiance,light"]);
            shows_all(&folder, &report);
            // Nothing was said of how it moves.
            let again =
                snapshot_at(60, &folder, &["--scene", &asset, "--set", "scene.scale=1", "--what", "light"]);
            assert_eq!(report["view"]["position"], again["view"]["position"], "{name}");
        }
    }

    #[test]
    fn a_rig_file_that_places_its_projector_keeps_its_view() {
        let folder = TestFolder::new("snapshot-rig");
        let asset = folder.write("box.obj", &cuboid([7.0, 0.0, 0.0], [8.0, 1.0, 1.0]));
        let body = "[[scene.bodies]]\nname = \"thing\"\nmotion = { kind = \"translate\", speed_m_s = 1.0, amplitude_m = 0.5 }\n";
        let scene = format!("[scene]\nfile = {asset:?}\n{body}");
        let open = folder.write("open.toml", &scene);
        let placed =
            folder.write("placed.toml", &format!("[projector]\nposition = [0.0, 0.0, 9.0]\n{scene}"));
        shows_all(&folder, &snapshot(&folder, &[&open]));
        assert!(snapshot(&folder, &[&placed])["view"].is_null());
        assert!(snapshot(&folder, &[&open, "--view", "rig"])["view"].is_null());
        shows_all(&folder, &snapshot(&folder, &[&placed, "--view", "fit"]));
        assert!(snapshot(&folder, &[])["view"].is_null(), "the demo has its own view");
    }
}

/// What another program takes time for.
mod real_pace {
    use super::*;

    /// A snapshot keeps the first picture of another program; without one the body is black, which is told.
    #[test]
    fn a_picture_of_another_program_is_waited_for_and_kept() {
        let folder = TestFolder::new("snapshot-live");
        let pipe = Path::new(folder.text()).join("pictures");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo").success());
        let bodies = format!(
            "scene.bodies=[{{ name = \"bunny\", texture = \"pipe:{}\", texture_size = [2, 2], motion = {{ kind = \"still\" }} }}, \
             {{ name = \"venus\", motion = {{ kind = \"still\" }} }}]",
            pipe.display()
        );
        let args = ["--set", &bodies, "--set", "render.exposure=2"];
        let shown = |report: &serde_json::Value| -> (f32, String) {
            let pixels = radiance(&Path::new(folder.text()).join("radiance.pfm"));
            (pixels.iter().sum(), report["warnings"].to_string())
        };
        let (black, told) = shown(&snapshot(&folder, &args));
        assert!(told.contains("not every picture of another program has come within 3 s"), "{told}");
        let writer = std::thread::spawn({
            let pipe = pipe.clone();
            move || {
                let mut pipe = std::fs::File::options().write(true).open(pipe).expect("the pipe");
                std::io::Write::write_all(&mut pipe, b"P6 2 2 255 aaaabbbbcccc").expect("a reader");
                // It is closed when the snapshot has been made.
                std::thread::sleep(std::time::Duration::from_secs(2));
            }
        });
        let (red, told) = shown(&snapshot(&folder, &args));
        writer.join().expect("it wrote");
        assert!(
            told.contains("pictures of 2 x 2 have begun") && !told.contains("not every picture"),
            "{told}"
        );
        assert!(red > 1.1 * black, "{red} of light, and {black} without a picture");
    }
}
