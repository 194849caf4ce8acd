//! `dpm doctor RIG.toml` on rigs whose parts are there, missing, wrong or in use. Nothing that it does makes light.

use dpm_tests::programs::{program, RunFolder, Talk};
use dpm_tests::sensor_wand::SensorWandMock;
use std::process::Stdio;

/// A tracker with a body and a projector of 128 x 96 mirrors, and a folder with their rig file.
fn bench(name: &str, command_port: u16) -> (SensorWandMock, RunFolder) {
    let port = command_port.to_string();
    let bodies = ["--body", "bunny:0.03,0.02,0.05", "--body", "glasses:0.03,0.02,0.05"];
    let mock: Vec<&str> = ["--raster", "128x96", "--command-port", &port].into_iter().chain(bodies).collect();
    let mock = SensorWandMock::start(&mock);
    let folder = RunFolder::new(&format!("doctor-{name}"));
    let rig = mock.rig([128, 96], 60, command_port) + "[[scene.bodies]]\nname = \"bunny\"\n";
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    (mock, folder)
}

/// Exit code, what was found and what the last line says.
fn doctor(folder: &RunFolder, more: &[&str]) -> (Option<i32>, serde_json::Value, String) {
    let mut command = folder.command(program("dpm"));
    let output = command.args(["doctor", "rig.toml", "--json"]).args(more).output().unwrap();
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    let json = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {told}"));
    (output.status.code(), json, told)
}

/// State, what was found and the remedy of a part.
fn part<'a>(json: &'a serde_json::Value, name: &str) -> [&'a str; 3] {
    let findings = json["findings"].as_array().unwrap();
    let finding = findings.iter().find(|f| f["name"] == name).unwrap_or_else(|| panic!("{name} in {json}"));
    ["state", "found", "remedy"].map(|key| finding[key].as_str().unwrap())
}

#[test]
fn a_rig_that_can_run_is_told_from_one_that_cannot() {
    let (mut mock, folder) = bench("whole", 15760);
    let (code, json, told) = doctor(&folder, &[]);
    assert_eq!((code, &json["can_run"]), (Some(0), &true.into()), "{told}{json:#}");
    let [state, found, _] = part(&json, "tracker");
    assert!(state == "warning" && found.contains("\"bunny\" 2"), "the second body is not tracked: {found}");
    assert!(found.contains("\"venus\" is not seen"), "{found}");
    let [state, found, _] = part(&json, "projector");
    assert!(state == "ok" && found.contains("24 planes are within its limits"), "{found}");
    assert_eq!(part(&json, "calibration")[0], "warning");
    assert!(part(&json, "rig")[1].contains("width = 128, height = 96, frame_rate = 60, planes = 24"));

    // Who looks needs no node of the scene, and a head that the tracker does not tell of is named.
    let heads = ["--set", "observer.tracked=\"glasses\"", "--set", "safety.eyes.heads=[\"hat\"]"];
    let (code, json, _) = doctor(&folder, &heads);
    let [state, found, remedy] = part(&json, "observer");
    assert!(code == Some(0) && state == "warning", "{json:#}");
    assert!(
        found.contains("the eye is carried by \"glasses\"") && found.contains("\"hat\" by 0.15 m"),
        "{found}"
    );
    assert!(
        found.ends_with("the tracker does not tell of \"hat\"") && remedy.contains("stays dark"),
        "{found} {remedy}"
    );

    // Another raster, another address: each is named, and nothing else is.
    let (code, json, told) = doctor(&folder, &["--set", "projector.width=256"]);
    assert_eq!((code, &json["can_run"]), (Some(1), &false.into()), "{json:#}");
    assert!(told.contains("cannot run yet: projector (see"), "{told}");
    assert!(part(&json, "projector")[1].contains("128x96"), "{json:#}");
    let (code, json, _) = doctor(&folder, &["--set", "tracker.command_port=15769"]);
    assert_eq!((code, part(&json, "tracker")[0]), (Some(1), "missing"), "{json:#}");
    assert!(part(&json, "tracker")[2].contains("no server"), "{json:#}");

    // All of that was dark: no frame was lit, and the projector was never armed.
    let told = mock.said();
    assert!(told.contains("Configured, dark: 0 frames lit"), "{told}");
    assert!(!told.contains("Armed"), "{told}");
}

/// What else `dpm doctor` finds.
mod breadth {
    use super::*;

    #[test]
    fn a_projector_in_use_and_a_missing_one_are_named() {
        let (_mock, folder) = bench("use", 15770);
        let mut run = folder.command(program("dpm"));
        let run = run
            .args(["pattern", "grid", "rig.toml"])
            .stdin(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut run = Talk::with(run);
        run.until("projector: up");
        let (code, json, _) = doctor(&folder, &[]);
        let [state, found, _] = part(&json, "projector");
        assert!(code == Some(1) && state == "missing" && found.contains("in use"), "{found}");
        drop(run);
        let none = ["--set", "projector.backend.port=\"/dev/pts/none\""];
        let (code, json, _) = doctor(&folder, &none);
        let [state, found, _] = part(&json, "projector");
        assert!(
            code == Some(1) && state == "missing" && found.contains("/dev/pts/none: not found"),
            "{found}"
        );
        let scene = ["doctor", "rig.toml", "--set", "scene.file=\"gone.glb\""];
        let bad = folder.command(program("dpm")).args(scene).output().unwrap();
        let told = String::from_utf8_lossy(&bad.stderr);
        assert!(bad.status.code() == Some(2) && told.contains("gone.glb"), "{told}");
    }
}
