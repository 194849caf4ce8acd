//! `dpm doctor RIG.toml` on rigs whose parts are there, missing, wrong or in use. Nothing that it does makes light.

use dpm_tests::programs::{program, RunFolder, Talk};
use std::process::{Command, Stdio};

/// `hil-mock serve sensor-wand` with a body: a tracker and a projector of 128 x 96 mirrors in a process of their own.
fn mock(command_port: &str) -> (Talk, String) {
    let child = Command::new(program("hil-mock"))
        .args([
            "serve",
            "sensor-wand",
            "--port",
            "pty",
            "--raster",
            "128x96",
            "--body",
            "bunny:0.03,0.02,0.05",
        ])
        .args(["--command-port", command_port, "--orders"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut talk = Talk::with(child);
    talk.until("bit-plane projector on ");
    let port = talk.until("\n").trim().to_owned();
    (talk, port)
}

/// A folder with the rig file of that mock.
fn folder(name: &str, projector: &str, command_port: u16) -> RunFolder {
    let folder = RunFolder::new(&format!("doctor-{name}"));
    let rig = format!(
        "[projector]\nwidth = 128\nheight = 96\nframe_rate = \"60\"\n\
         backend = {{ kind = \"serial\", port = {projector:?} }}\n\
         [tracker]\nkind = \"natnet\"\ncommand_port = {command_port}\ndata_port = {}\n\
         [real_time]\npace = \"real\"\n[[scene.bodies]]\nname = \"bunny\"\n",
        command_port + 1
    );
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    folder
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
    let (mut mock, port) = mock("15760");
    let folder = folder("whole", &port, 15760);
    let (code, json, told) = doctor(&folder, &[]);
    assert_eq!((code, &json["can_run"]), (Some(0), &true.into()), "{told}{json:#}");
    let [state, found, _] = part(&json, "tracker");
    assert!(state == "warning" && found.contains("\"bunny\" 2"), "the second body is not tracked: {found}");
    assert!(found.contains("\"venus\" is not seen"), "{found}");
    let [state, found, _] = part(&json, "projector");
    assert!(state == "ok" && found.contains("24 planes are within its limits"), "{found}");
    assert_eq!(part(&json, "calibration")[0], "warning");
    assert!(part(&json, "rig")[1].contains("width = 128, height = 96, frame_rate = 60, planes = 24"));

    // Another raster, another address: each is named, and nothing else is.
    let (code, json, told) = doctor(&folder, &["--set", "projector.width=256"]);
    assert_eq!((code, &json["can_run"]), (Some(1), &false.into()), "{json:#}");
    assert!(told.contains("cannot run yet: projector (see"), "{told}");
    assert!(part(&json, "projector")[1].contains("128x96"), "{json:#}");
    let (code, json, _) = doctor(&folder, &["--set", "tracker.command_port=15769"]);
    assert_eq!((code, part(&json, "tracker")[0]), (Some(1), "missing"), "{json:#}");
    assert!(part(&json, "tracker")[2].contains("no server"), "{json:#}");

    // All of that was dark: no frame was lit, and the projector was never armed.
    mock.say("tip 0 0 0");
    let told = mock.until("the tip is at");
    assert!(told.contains("Configured, dark: 0 frames lit"), "{told}");
    assert!(!told.contains("Armed"), "{told}");
}

#[test]
fn a_projector_in_use_and_a_missing_one_are_named() {
    let (_mock, port) = mock("15770");
    let folder = folder("use", &port, 15770);
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
    assert!(code == Some(1) && state == "missing" && found.contains("/dev/pts/none: not found"), "{found}");
    let bad = folder
        .command(program("dpm"))
        .args(["doctor", "rig.toml", "--set", "scene.file=\"gone.glb\""])
        .output();
    let bad = bad.unwrap();
    assert!(bad.status.code() != Some(0), "{}", String::from_utf8_lossy(&bad.stderr));
    assert!(
        String::from_utf8_lossy(&bad.stderr).contains("gone.glb")
            || String::from_utf8_lossy(&bad.stdout).contains("gone.glb")
    );
}
