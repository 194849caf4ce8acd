//! What is missing is said before scene and shaders take their time, and a run that is stopped before it has lit anything
//! ends at once.
#![allow(unsafe_code)]

use crate::cli_common::{code, command, dpm, err, out, start_with, TestFolder, NO_DRIVER};
use std::io::Read;
use std::process::Stdio;
use std::time::Duration;

/// Processor time that a run may take to find out what is missing, seconds.
const MOST_S: f64 = 0.3;
const LONG: Duration = Duration::from_secs(120);

/// Runs the program to its end; its exit code, the processor time of the process with all its threads in seconds, and its
/// standard error stream.
// wait4 takes its end, with what it cost.
#[allow(clippy::zombie_processes)]
fn costs(args: &[&str], variables: &[(&str, &str)]) -> (i32, f64, String) {
    let mut command = command(args);
    command.envs(variables.iter().copied()).env_remove("DISPLAY").env_remove("WAYLAND_DISPLAY");
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let mut told = String::new();
    child.stderr.take().unwrap().read_to_string(&mut told).unwrap();
    let mut status = 0;
    // SAFETY: an all-zero rusage is valid, and both places outlive the call, which waits for our own child alone.
    let (waited, usage) = unsafe {
        let mut usage: libc::rusage = std::mem::zeroed();
        (libc::wait4(child.id() as i32, &raw mut status, 0, &raw mut usage), usage)
    };
    assert_eq!(waited, child.id() as i32);
    assert!(libc::WIFEXITED(status), "{status:x} {told}");
    let seconds = |t: libc::timeval| t.tv_sec as f64 + 1e-6 * t.tv_usec as f64;
    (libc::WEXITSTATUS(status), seconds(usage.ru_utime) + seconds(usage.ru_stime), told)
}

/// Found in use, O4: a run compiled its shaders and built its scene, and then said that the cable is unplugged.
#[test]
fn what_is_missing_ends_a_run_before_anything_is_prepared_and_the_doctor_says_the_same() {
    let folder = TestFolder::new("missing");
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/mock.toml");
    for (key, exit, word) in [
        (
            "projector.backend={kind=\"display\",card=\"/nowhere/card9\",mode=\"640x480@60\"}",
            3,
            "/nowhere/card9",
        ),
        ("projector.backend={kind=\"usb\",vendor_id=57005,product_id=48879}", 3, "dead:beef"),
        (
            "projector.backend={kind=\"serial\",port=\"/nowhere/tty9\"}",
            3,
            "serial port /nowhere/tty9: not found",
        ),
        ("projector.backend={kind=\"alp\",library=\"/nowhere/libalp.so\"}", 3, "/nowhere/libalp.so"),
        ("projector.backend={kind=\"window\",server=\":4095\"}", 3, "window"),
        ("render.gpu=\"nobody's\"", 4, "nobody's"),
    ] {
        let more =
            ["--set", key, "--set", "projector.frame_rate=\"60\"", "--set", "page.listen=\"127.0.0.1:0\""];
        let run = [&["run", rig, "--out", folder.text()], &more[..]].concat();
        let (code, seconds, told) = costs(&run, &[]);
        assert_eq!(code, exit, "{key}: {told}");
        assert!(told.contains(word), "{key}: {told}");
        assert!(seconds <= MOST_S, "{key}: {seconds} s of processor time; {told}");
        // Software Vulkan says first that it takes the place of a GPU.
        assert!(!told.contains("no GPU: software"), "{key}: {told}");
        let last =
            told.lines().rfind(|line| line.starts_with("error: ")).unwrap().trim_start_matches("error: ");
        let doctor = dpm(&[&["doctor", rig, "--json"], &more[..]].concat(), &[]);
        let json: serde_json::Value = serde_json::from_str(&out(&doctor)).unwrap();
        let findings = json["findings"].as_array().unwrap();
        let is_there = findings.iter().any(|f| f["state"] == "missing" && f["found"] == last);
        assert!(is_there, "{key}: {last} in {findings:#?}");
        assert_eq!(self::code(&doctor), 1, "{key}");
    }
    let (code, seconds, told) = costs(&["run", rig, "--out", folder.text()], &NO_DRIVER);
    assert!(code == 4 && seconds <= MOST_S, "{code}, {seconds} s: {told}");
}

/// Found in use, O4: SIGTERM while shaders are compiled ended with "the rig did not end in time" and without a report.
#[test]
fn a_stop_while_the_run_sets_up_ends_at_once_with_its_report() {
    let folder = TestFolder::new("early");
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/mock.toml");
    // Shaders that no run has compiled before.
    let cache = folder.path("shaders").display().to_string();
    let args = ["run", rig, "--json", "--out", folder.text(), "--set", "page.listen=\"127.0.0.1:0\""];
    let mut run = start_with(&args, &[("MESA_SHADER_CACHE_DIR", &cache)]);
    run.wait_for_line(LONG, |line| line.contains("no GPU: software") || line.contains("calibration"));
    run.signal("TERM");
    let rest = run.rest_of_lines(LONG);
    let (status, printed) = run.finish();
    assert_eq!(status.code(), Some(0), "{rest:#?}");
    assert!(rest.iter().all(|line| !line.contains("did not end in time")), "{rest:#?}");
    let printed: serde_json::Value = serde_json::from_str(&printed).unwrap();
    let kept = std::fs::read_to_string(folder.path("report.json")).unwrap();
    let kept: serde_json::Value = serde_json::from_str(&kept).unwrap();
    for report in [printed, kept] {
        assert_eq!((&report["stopped"], &report["frames_lit"]), (&true.into(), &0.into()), "{report}");
        assert!(report["warnings"].to_string().contains("nothing was lit"), "{report}");
    }
}

/// Found in use, O6: a mistake in the scene silenced the tracker.
#[test]
fn a_mistake_in_the_scene_hides_no_other_part() {
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/mock.toml");
    let scene = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/sim/assets/triangle.gltf");
    let file = format!("scene.file={scene:?}");
    let words = [
        "doctor",
        rig,
        "--json",
        "--set",
        &file,
        "--set",
        "scene.bodies=[{name=\"hare\",node=\"b\"},{name=\"bust\"}]",
        "--set",
        "tracker={kind=\"serial\",port=\"/nowhere/tty8\"}",
        "--set",
        "render.gpu=\"nobody's\"",
    ];
    let output = dpm(&words, &[]);
    let json: serde_json::Value =
        serde_json::from_str(&out(&output)).unwrap_or_else(|e| panic!("{e}: {}", err(&output)));
    let part = |name: &str| {
        let all = json["findings"].as_array().unwrap();
        let found = all.iter().find(|f| f["name"] == name).unwrap_or_else(|| panic!("{name} in {all:#?}"));
        ["state", "found", "remedy"].map(|key| found[key].as_str().unwrap().to_owned())
    };
    let [state, found, remedy] = part("scene");
    assert_eq!(state, "missing");
    assert!(found.contains("scene.bodies.0.node") && found.contains("did you mean 'a'?"), "{found}");
    assert!(remedy.contains("at scene.bodies.0.node in the rig file"), "{remedy}");
    let [state, found, remedy] = part("tracker");
    assert!(state == "missing" && found.contains("\"hare\" is not seen"), "{found}");
    assert!(remedy.contains("/nowhere/tty8"), "{remedy}");
    assert_eq!(part("GPU")[0], "missing");
    assert_eq!(part("projector")[0], "info");
    assert!(err(&output).contains("scene, tracker, GPU"), "{}", err(&output));
}
