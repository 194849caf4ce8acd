//! `dpm pattern` from the user's point of view: light without GPU, scene and tracker, pictures as files, a stop, and
//! refusals.

use crate::cli_common::{code, dpm, err, out, start_with, TestFolder, NO_DRIVER};
use std::time::Duration;

/// A rig whose scene, tracker and calibration do not exist, and whose own run would be over after a frame.
const RIG: &str = "[projector]\nwidth = 64\nheight = 48\ncalibration = \"no.yml\"\ncalibration_unit = \"metre\"\n\
                   [scene]\nfile = \"no.glb\"\n[tracker]\nkind = \"natnet\"\nserver = \"192.0.2.1\"\nlocal = \"192.0.2.2\"\n\
                   [run]\nframes = 1\n[output]\nimages = true\n";

fn pixels(path: &std::path::Path) -> image::RgbImage {
    image::open(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())).to_rgb8()
}

#[test]
fn a_pattern_needs_neither_gpu_nor_scene_nor_tracker() {
    let folder = TestFolder::new("pattern-run");
    let rig = folder.write("rig.toml", RIG);
    for kind in ["full", "counter", "focus-star"] {
        let args = ["pattern", kind, &rig, "--frames", "20", "--pace", "virtual", "--json"];
        let output = dpm(&args, &NO_DRIVER);
        assert_eq!(code(&output), 0, "{}", err(&output));
        let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
        assert_eq!((&json["frames_lit"], &json["method"]), (&20.into(), &"pattern".into()));
        assert_eq!((&json["gpu"], &json["raster"]), (&"none".into(), &serde_json::json!([64, 48])));
    }
    // Virtual pace without an end would never end.
    let endless = dpm(&["pattern", "full", &rig, "--pace", "virtual"], &NO_DRIVER);
    assert!(code(&endless) == 2 && err(&endless).contains("would never end"), "{}", err(&endless));
}

#[test]
fn a_pattern_is_shown_until_it_is_stopped_and_ends_dark() {
    let folder = TestFolder::new("pattern-stop");
    let rig = folder.write("rig.toml", RIG);
    let args =
        ["pattern", "gray-columns", &rig, "--hold-ms", "20", "--json", "--set", "projector.frame_rate=60"];
    let mut run = start_with(&args, &NO_DRIVER);
    let is_lit = |line: &str| line.contains("\"frames_lit\":") && !line.contains("\"frames_lit\":0,");
    run.wait_for_line(Duration::from_secs(60), is_lit);
    run.signal("INT");
    let (status, report) = run.finish();
    assert_eq!(status.code(), Some(0), "{report}");
    let json: serde_json::Value = serde_json::from_str(&report).expect("one JSON object");
    assert_eq!(json["stopped"], true, "{report}");
    assert!(json["frames_lit"].as_u64() > Some(0));
}

#[test]
fn pictures_are_what_would_be_shown() {
    let folder = TestFolder::new("pattern-png");
    let rig = folder.write("rig.toml", RIG);
    let file = |name: &str| folder.path(name);
    let write = |words: &[&str], name: &str| {
        let path = file(name);
        let args = [&["pattern"], words, &[&rig, "--png", path.to_str().expect("UTF-8")]].concat();
        let output = dpm(&args, &NO_DRIVER);
        assert_eq!(code(&output), 0, "{words:?}: {}", err(&output));
        out(&output)
    };
    write(&["cross", "--at", "5,40", "--channel", "g", "--level", "90"], "cross.png");
    for (x, y, pixel) in pixels(&file("cross.png")).enumerate_pixels() {
        assert_eq!(pixel.0, if x == 5 || y == 40 { [0, 90, 0] } else { [0; 3] });
    }
    // 64 columns: six bits and their inverses.
    let told = write(&["gray-columns"], "gray.png");
    assert_eq!(told.lines().count(), 12);
    let steps: Vec<_> = (0..12).map(|k| pixels(&file(&format!("gray-{k:03}.png")))).collect();
    for x in 0..64 {
        let gray = (0..6).fold(0u32, |g, k| {
            let [on, inverse] = [0, 1].map(|i| steps[2 * k + i].get_pixel(x, 47).0[0]);
            assert_eq!(on ^ inverse, 255);
            g << 1 | u32::from(on / 255)
        });
        let number = (1..6).fold(gray, |n, shift| n ^ gray >> shift);
        assert_eq!(number, x);
    }
    write(&["phase", "--step", "1", "--axis", "rows"], "one.png");
    assert_eq!(pixels(&file("one.png")).dimensions(), (64, 48));
    let json = write(&["full", "--json"], "full.png");
    assert!(json.contains("\"files\"") && pixels(&file("full.png")).pixels().all(|p| p.0 == [255; 3]));
}

#[test]
fn bad_arguments_are_refused_by_name() {
    let folder = TestFolder::new("pattern-bad");
    let rig = folder.write("rig.toml", RIG);
    let told = |words: &[&str]| {
        let output = dpm(&[&["pattern"], words, &[&rig]].concat(), &NO_DRIVER);
        assert_eq!(code(&output), 2, "{words:?}: {}", err(&output));
        err(&output)
    };
    for (words, says) in [
        (&["cross"][..], "add --at X,Y"),
        (&["cross", "--at", "64,0"], "--at 64,0 lies outside the raster of 64 x 48"),
        (&["cross", "--at", "1;2"], "such as 512,384"),
        (&["full", "--at", "1,2"], "--at means nothing to dpm pattern full"),
        (&["full", "--hold-ms", "20"], "--hold-ms means nothing to dpm pattern full"),
        (&["full", "--level", "256"], "256"),
        (&["full", "--no-prediction"], "--no-prediction means nothing to dpm pattern"),
        (&["full", "--scene", "a.glb"], "--scene means nothing"),
        (&["full", "--channel", "r", "--set", "projector.planes=8"], "--channel r: no plane"),
        (&["gray-rows", "--step", "12"], "--step 12: must be 0 to 11"),
        (&["phase", "--shifts", "2"], "--shifts 2: must be 3 to 64"),
        (&["gray-columns", "--hold-ms", "0"], "--hold-ms 0"),
        (&["gray-columns", "--hold-ms", "50", "--set", "projector.width=9"], "hold each step for at least"),
        (&["stripes"], "focus-star"),
    ] {
        let text = told(words);
        assert!(text.contains(says), "{words:?}: {text}");
    }
    let nowhere = dpm(&["pattern", "full", &rig, "--png", "/proc/nowhere/a.png"], &NO_DRIVER);
    let text = err(&nowhere);
    assert!(code(&nowhere) == 2 && text.contains("/proc/nowhere") && text.contains("--png"), "{text}");
}
