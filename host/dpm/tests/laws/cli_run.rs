//! `dpm demo` and `dpm run` from the user's point of view: report, files, hash of the light, bad input, signals, two
//! at once.
//!
//! Everything runs at a raster of 48 x 32, where software Vulkan needs milliseconds per frame.

use crate::cli_common::{code, dpm, err, out, start, TestFolder, NO_DRIVER};
use dpm_device::pose::Pose;
use dpm_device::time::{HostClock, HostTime};
use hil_mock::motion::{Motion, MotionSpec};
use hil_mock::natnet_host::NatNetHost;
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use hil_mock::tracker::{MockTrackerConfig, SampleSource};
use std::net::{Ipv4Addr, SocketAddrV4};
use std::sync::Arc;
use std::time::{Duration, Instant};

const SMALL: [&str; 5] = ["--json", "--raster", "48x32", "--frames", "6"];

/// Runs a command at the small raster with its output in `folder`; returns the report.
fn report(command: &[&str], folder: &TestFolder, more: &[&str]) -> serde_json::Value {
    let args = [command, &SMALL, &["--out", folder.text()], more].concat();
    let output = dpm(&args, &[("DPM_VALIDATION", "1")]);
    assert_eq!(code(&output), 0, "{args:?}: {}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output))
        .unwrap_or_else(|e| panic!("one JSON object: {e} in {}", out(&output)));
    assert!(!json["warnings"].to_string().contains("validation"), "{}", json["warnings"]);
    json
}

#[test]
fn the_demo_prints_one_object_with_the_agreed_keys_and_leaves_its_files() {
    let folder = TestFolder::new("demo");
    let json = report(&["demo"], &folder, &[]);
    for key in
        ["frames_lit", "frames_dropped", "frames_late", "raster", "frame_rate_hz", "pace", "gpu", "wall_s"]
    {
        assert!(!json[key].is_null(), "{key} in {json}");
    }
    assert_eq!((&json["frames_lit"], &json["frames_dropped"]), (&6.into(), &0.into()));
    assert_eq!((&json["raster"], &json["pace"]), (&serde_json::json!([48, 32]), &"virtual".into()));
    assert_eq!(json["frame_rate_hz"], 947.0);
    for key in ["p50", "p99", "max"] {
        assert!(json["registration_error_px"][key].is_f64(), "{key} in {json}");
        assert!(json["motion_to_light_ms"][key].is_f64(), "{key} in {json}");
    }
    assert!(json["motion_to_light_ms"]["p999"].is_f64());
    // Found in use (second look at latency, section 1): 5.2 ms of a demo at virtual pace are constants of the rig file.
    for key in [
        "motion_to_first_photon_ms",
        "motion_to_light_centre_ms",
        "motion_to_last_photon_ms",
        "motion_to_light_ms",
    ] {
        assert_eq!(json[key]["modelled"], true, "{key}");
        assert_eq!(json[key]["source"], "from real_time.stage_costs_us, not measured", "{key}");
    }
    assert_eq!(json["registration_error_at"], "light centre");
    // 48 columns in 30 degrees: a pixel is 11.2 mm wide at a metre, and the bodies are 1.1 m away.
    let pixel_mm = json["pixel_mm"].as_f64().expect("bodies before the projector");
    assert!((11.5..14.0).contains(&pixel_mm), "{pixel_mm}");
    assert_eq!(
        (&json["frames_dark"], &json["slots"], &json["missed_slots"]),
        (&0.into(), &6.into(), &0.into())
    );
    let stages = json["stages_ms"].as_object().expect("a map");
    assert!(
        stages.len() >= 4 && stages.values().all(|s| s["p50"].is_f64() && s["p99"].is_f64()),
        "{stages:?}"
    );
    for name in ["light.png", "viewer.png"] {
        let picture = image::open(folder.path(name)).unwrap_or_else(|e| panic!("{name}: {e}")).to_rgb8();
        assert_eq!(picture.dimensions(), (48, 32), "{name}");
        assert!(picture.pixels().any(|p| p.0 != [0; 3]), "{name} is black");
    }
    let kept = std::fs::read_to_string(folder.path("report.json")).expect("report.json");
    let kept: serde_json::Value = serde_json::from_str(&kept).expect("JSON");
    assert_eq!(kept["light_hash"], json["light_hash"]);
}

#[test]
fn a_film_shows_the_planes_of_the_run_and_lies_beside_a_strip() {
    let folder = TestFolder::new("film");
    let film = folder.path("film.gif");
    let path = film.to_str().expect("text");
    let small = ["--json", "--raster", "48x32", "--out", folder.text()];
    let done = dpm(&[&["demo", "--film", path, "--film-seconds", "1"], &small[..]].concat(), &[]);
    assert_eq!(code(&done), 0, "{}", err(&done));
    let json: serde_json::Value = serde_json::from_str(&out(&done)).expect("one JSON object");
    let files = json["files"].to_string();
    assert!(files.contains("film.gif") && files.contains("film-strip.png"), "{files}");
    let bytes = std::fs::read(&film).expect("the film");
    assert!(bytes.starts_with(b"GIF89a") && bytes.len() < 3_000_000, "{}", bytes.len());
    let strip = image::open(folder.path("film-strip.png")).expect("the strip").to_rgb8();
    let (width, height) = (strip.width() / 2, strip.height() / 2);
    // The mirrors are dark while the objects are bare, and one plane of one colour is shown in the end.
    let inset = |column: u32, row: u32| {
        let mut lit = [0u32; 3];
        for y in row * height + height * 6 / 10..(row + 1) * height - 6 {
            for x in column * width + width * 7 / 10..column * width + width * 9 / 10 {
                let pixel = strip.get_pixel(x, y).0;
                (0..3).for_each(|c| lit[c] += u32::from(pixel[c] > 128));
            }
        }
        lit
    };
    // Nothing but the label is bright.
    let [bare, lit] = [inset(0, 0), inset(0, 1)];
    assert!(lit[1] > bare[1] + 20, "{bare:?} {lit:?}");
    for (args, word) in [
        (&["--film", "film.avi"][..], "ends in .gif"),
        (&["--film", path, "--film-seconds", "0.01"], "lasts 1 to 60 s"),
        (&["--film", path, "--frames", "3"], "--frames"),
    ] {
        let refused = dpm(&[&["demo"], args].concat(), &[]);
        assert!(code(&refused) == 2 && err(&refused).contains(word), "{args:?}: {}", err(&refused));
    }
}

#[test]
fn the_rig_file_is_the_demo_and_the_same_seed_gives_the_same_light() {
    let folder = TestFolder::new("hash");
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/demo.toml");
    let no_pictures = ["--set", "output.images=false"];
    let demo = report(&["demo"], &folder, &no_pictures);
    let run = report(&["run", rig], &folder, &no_pictures);
    let other = report(&["demo"], &folder, &["--set", "output.images=false", "--set", "render.seed=2"]);
    assert_eq!(demo["light_hash"], run["light_hash"]);
    assert_ne!(demo["light_hash"], other["light_hash"]);
}

const RIG: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/demo.toml");

#[test]
fn bad_input_ends_with_2_and_names_the_place() {
    let folder = TestFolder::new("bad");
    let rig = folder.write("rig.toml", "[projector]\nwidth = 64\n\n[render]\n  smaples = 4\nspp = 0\n");
    let cut = folder.write("cut.glb", "glTF\u{2}\0\0\0");
    let in_the_way = folder.write("file", "");
    let cases: [(&[&str], &[&str]); 15] = [
        (
            &["run", &rig],
            &[
                "rig.toml:5:3: `render.smaples`: unknown key",
                "rig.toml:6:7: `render.spp`: is 0, must be 1 to 4096",
            ],
        ),
        (&["run", "/nonexistent/rig.toml"], &["/nonexistent/rig.toml: cannot read the rig file"]),
        (&["demo", "--raster", "0x32"], &["`projector.width`: is 0, must be 1 to 8192 px"]),
        (&["demo", "--raster", "100000x100000"], &["is 100000, must be 1 to 8192 px"]),
        (&["demo", "--scene", "/nonexistent/hare.glb"], &["/nonexistent/hare.glb: No such file"]),
        (&["demo", "--scene", &cut], &["cut.glb", "cut off"]),
        (
            &["demo", "--set", "projector.frame_rate=1200"],
            &["28800 planes/s", "at most 947 frames/s of 24 planes"],
        ),
        (&["demo", "--frames", "1", "--seconds", "1"], &["cannot be used with"]),
        (&["demo", "--out", &in_the_way], &["cannot lock output folder"]),
        (&["demo", "--scene", &in_the_way], &["is empty: no glTF document"]),
        (&["demo", "--scene", RIG], &["demo.toml: file", "this is not glTF"]),
        (&["demo", "--seconds", "1e300"], &["--seconds 1e300: must be above 0"]),
        (&["demo", "--frames", "0"], &["--frames or --seconds"]),
        // Before anything is drawn, which takes minutes.
        (&["error", RIG, "--quick", "--out", &in_the_way], &["cannot write to", "another folder with --out"]),
        (&["snapshot", "--out", &in_the_way], &["cannot write to", "another folder with --out"]),
    ];
    for (args, parts) in cases {
        let output = dpm(args, &[]);
        assert_eq!(code(&output), 2, "{args:?}: {}", err(&output));
        assert_eq!(out(&output), "", "{args:?}");
        for part in parts {
            assert!(err(&output).contains(part), "{args:?}: {part:?} in {}", err(&output));
        }
    }
}

#[test]
fn a_raster_beyond_the_machine_is_refused_not_attempted() {
    let folder = TestFolder::new("huge");
    let output = dpm(&["demo", "--raster", "8192x8192", "--frames", "1", "--out", folder.text()], &[]);
    // A large GPU may be able to do it; software Vulkan is not.
    if code(&output) != 0 {
        assert_eq!(code(&output), 2, "{}", err(&output));
        let told = err(&output);
        assert!(
            told.contains("too large for") && told.contains("--raster") || told.contains("memory"),
            "{told}"
        );
    }
}

#[test]
fn without_a_driver_the_demo_ends_with_4_and_says_what_to_install() {
    let folder = TestFolder::new("driver");
    let output = dpm(&["demo", "--json", "--out", folder.text()], &NO_DRIVER);
    assert_eq!((code(&output), out(&output).as_str()), (4, ""));
    assert!(
        err(&output).contains("mesa-vulkan-drivers") && err(&output).contains("VK_ICD_FILENAMES"),
        "{}",
        err(&output)
    );
}

#[test]
fn a_setting_in_the_environment_reaches_the_run() {
    let folder = TestFolder::new("variable");
    let output = dpm(&["demo", "--out", folder.text()], &[("DPM_SET_RENDER__SPP", "none")]);
    assert_eq!(code(&output), 2);
    assert!(
        err(&output).contains("environment variable DPM_SET_RENDER__SPP: `render.spp`"),
        "{}",
        err(&output)
    );
}

/// Found in use, R13: a report that could not be written at the end was lost. It is printed, and the exit code says
/// that the file is missing. A folder that cannot be written is detected before the run, with pictures or without.
/// cannot be written before the run stops it there, with pictures or without.
#[test]
fn a_report_that_cannot_be_written_is_printed_all_the_same() {
    let folder = TestFolder::new("lost");
    let dir = folder.path("out");
    let args =
        ["demo", "--json", "--raster", "48x32", "--frames", "10000000", "--set", "output.images=false"];
    let mut running = start(&[&args[..], &["--out", &dir.display().to_string()]].concat());
    running.wait_for_line(Duration::from_secs(120), |line| {
        let progress: serde_json::Value = serde_json::from_str(line).expect("each line of progress is JSON");
        progress["frames_lit"].as_u64() > Some(0)
    });
    std::fs::remove_dir_all(&dir).expect("the folder was made before the run");
    std::fs::write(&dir, b"in the way").expect("the temporary folder can be written");
    running.signal("TERM");
    let lines = running.rest_of_lines(Duration::from_secs(60));
    let (status, report) = running.finish();
    assert_eq!(status.code(), Some(2), "{lines:?}");
    let report: serde_json::Value = serde_json::from_str(&report).expect("the report of what was done");
    assert!(report["frames_lit"].as_u64() > Some(0), "{report}");
    assert_eq!(report["files"], serde_json::json!([]), "nothing was written");
    let told = lines.iter().any(|l| l.contains("cannot write") && l.contains("report.json"));
    assert!(told, "{lines:?}");

    let in_the_way = folder.write("file", "");
    for command in ["demo", "bench", "plan", "profile"] {
        let args = [command, "--raster", "48x32", "--set", "output.images=false", "--out", &in_the_way];
        let output = dpm(&args, &[]);
        assert_eq!((code(&output), out(&output).as_str()), (2, ""), "{command}: {}", err(&output));
        assert!(err(&output).contains("another folder with --out"), "{command}: {}", err(&output));
    }
}

/// Found in use, R13: `bench` and `plan` accepted `--out` and ignored it; O12: `plan` did not report what a scene
/// loses; and R17: what is scaled down.
#[test]
fn plan_tells_what_a_run_would_tell_and_writes_where_it_is_asked_to() {
    let folder = TestFolder::new("plan");
    // One row of a large picture in the plainest coding: 8192 x 2048 texels of the same light.
    let mut sky = b"Pf\n8192 2048\n-1\n".to_vec();
    sky.extend(0.5f32.to_le_bytes().repeat(8192 * 2048));
    std::fs::write(folder.path("sky.pfm"), sky).expect("the temporary folder can be written");
    let rig = folder.write(
        "rig.toml",
        "[scene.environment]\nkind = \"image\"\nfile = \"sky.pfm\"\n[real_time]\npace = \"virtual\"\n",
    );
    let output = dpm(&["plan", &rig, "--json", "--out", folder.text()], &NO_DRIVER);
    assert_eq!(code(&output), 0, "{}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    assert!(
        json["warnings"].to_string().contains("8192 x 2048 texels is scaled down"),
        "{}",
        json["warnings"]
    );
    let kept = std::fs::read_to_string(folder.path("plan.json")).expect("plan.json");
    assert_eq!(serde_json::from_str::<serde_json::Value>(&kept).expect("JSON"), json);
    for flag in [["--frames", "3"], ["--seconds", "3"]] {
        let output = dpm(&[&["plan", &rig][..], &flag].concat(), &NO_DRIVER);
        assert_eq!(code(&output), 2);
        assert!(err(&output).contains("means nothing to dpm plan"), "{}", err(&output));
    }
}

/// Found in use, R18: a named pipe in the place of a file was awaited forever.
#[test]
fn pipes_and_devices_are_refused_at_once() {
    let folder = TestFolder::new("pipe");
    let pipe = folder.path("pipe").display().to_string();
    let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo");
    assert!(made.success());
    let sky = format!("scene.environment={{kind=\"image\",file={pipe:?}}}");
    let recording = format!("tracker={{kind=\"replay\",file={pipe:?}}}");
    let calibration = format!("projector.calibration={pipe:?}");
    let metre = "projector.calibration_unit=metre";
    let start = Instant::now();
    let cases: [&[&str]; 7] = [
        &["plan", &pipe],
        &["plan", "--scene", &pipe],
        &["plan", "--set", &sky],
        &["plan", "--set", &recording],
        &["plan", "--set", &calibration, "--set", metre],
        &["profile", "--compare", &pipe, &pipe],
        &["dlpc900", "upload", &pipe],
    ];
    for args in cases {
        let output = dpm(args, &NO_DRIVER);
        // Without a controller the upload may not reach the file.
        if args[0] != "dlpc900" || err(&output).contains("pipe") {
            assert_eq!(code(&output), 2, "{args:?}: {}", err(&output));
            assert!(err(&output).contains("a named pipe"), "{args:?}: {}", err(&output));
        }
    }
    let output = dpm(&["plan", "/dev/zero"], &NO_DRIVER);
    assert!(code(&output) == 2 && err(&output).contains("a device file"), "{}", err(&output));
    assert!(start.elapsed() < Duration::from_secs(120), "{:?}", start.elapsed());
}

/// A NatNet server of one body, "bunny", that moves around `position_m`.
pub(crate) fn natnet(motion: &MotionSpec, position_m: [f64; 3]) -> NatNetHost {
    let epoch = Instant::now();
    let clock: Arc<dyn HostClock> = Arc::new(move || HostTime(epoch.elapsed().as_nanos() as i64));
    let motion = Motion::new(motion, Pose { position_m, ..Pose::IDENTITY }).expect("a motion");
    let source = SampleSource::new(MockTrackerConfig::default(), vec![motion]).expect("a source");
    let streaming = Streaming::Unicast(UnicastTo::CommandSocket);
    let config = NatNetServerConfig { streaming, ..NatNetServerConfig::new(&["bunny"]) };
    let server = NatNetServer::new(config, source).expect("a server");
    NatNetHost::start(server, streaming, SocketAddrV4::new(Ipv4Addr::LOCALHOST, 0), clock)
        .expect("a socket on the loopback")
}

/// A rig file for the body of `server`; `safety` are further lines of its last table.
fn natnet_rig(folder: &TestFolder, server: &NatNetHost, frame_rate: u32, safety: &str) -> String {
    let port = server.address().port();
    let text = format!(
        "[projector]\nframe_rate = {frame_rate}\n[tracker]\nkind = \"natnet\"\nserver = \"127.0.0.1\"\nlocal = \"127.0.0.1\"\n\
         command_port = {port}\n[[scene.bodies]]\nname = \"bunny\"\n[output]\nlight_window_ms = 200\n\
         [safety]\nwatchdog_ms = 2000\n{safety}"
    );
    folder.write("rig.toml", &text)
}

/// Every plane of a longer run, and every fault of the mock.
mod breadth {
    use super::*;

    /// Lanes share the samples of their workgroup, so that they are busy whether all pixels have as many samples or not.
    #[test]
    fn bench_counts_how_busy_lanes_are_and_marks_what_is_only_computed() {
        let args = ["bench", "--json", "--count", "3", "--raster", "96x64", "--set", "render.spp=4"];
        let output =
            dpm(&[&args[..], &["--method", "full", "--method", "dpm"]].concat(), &[("DPM_VALIDATION", "1")]);
        assert_eq!(code(&output), 0, "{}", err(&output));
        let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
        let lanes = |method: usize, width: usize| {
            let of = &json["methods"][method]["lanes"][width];
            (of["busy"].as_f64().expect("a share"), of["longest"].as_u64().expect("samples"))
        };
        for width in [0, 1] {
            let (full, dpm) = (lanes(0, width), lanes(1, width));
            for (busy, longest) in [full, dpm] {
                // A workgroup of this raster has few samples a lane, so that the last of them weigh.
                assert!(busy > 0.85 && busy <= 1.0, "{json:#}");
                assert!((2..=6).contains(&longest), "{json:#}");
            }
        }
        let rows = json["modelled_not_measured"].as_array().expect("a list");
        assert_eq!(rows.len(), 8, "four cards, two methods");
        for row in rows {
            let of = |name: &str| row[name].as_f64().expect("milliseconds");
            let sum = row["trace_ms"][0].as_f64().unwrap()
                + of("screen_ms")
                + of("barriers_ms")
                + of("readback_ms");
            assert!((row["frame_ms"][0].as_f64().unwrap() - sum).abs() < 1e-9, "{row}");
        }
        let text = dpm(
            &[&["bench", "--model", "--count", "3", "--raster", "48x32", "--method", "full"][..]].concat(),
            &[],
        );
        assert!(out(&text).contains("computed, not measured"), "{}", out(&text));
    }

    /// Found in use, R11: with 8 planes every run at virtual pace ended with "frames of light differ from what was
    /// rendered"; R20: faults of the mock projector had no effect.
    #[test]
    fn eight_planes_are_checked_exactly_and_faults_are_applied() {
        let folder = TestFolder::new("planes");
        for planes in ["8", "24"] {
            let json = report(&["demo"], &folder, &["--set", &format!("projector.planes={planes}")]);
            assert_eq!(
                (&json["frames_lit"], &json["planes"].to_string()),
                (&6.into(), &planes.to_owned()),
                "{json}"
            );
        }
        // Each frame is 24 planes and a commit: some frames lack one of them, and some do not.
        let run = |faults: &str, seed: &str| {
            let faults = format!("projector.backend={{kind=\"mock\",faults={faults:?}}}");
            let args =
                ["--set", &faults, "--set", seed, "--set", "run.frames=60", "--set", "output.images=false"];
            report(&["demo"], &folder, &args)
        };
        let sound = run("", "render.seed=1");
        assert_eq!((&sound["frames_lit"], &sound["frames_dropped"]), (&60.into(), &0.into()), "{sound}");
        let lossy = run("loss=0.02", "render.seed=1");
        let [lit, dropped] = ["frames_lit", "frames_dropped"].map(|k| lossy[k].as_u64().expect("a count"));
        assert_eq!(lit + dropped, 60, "{lossy}");
        assert!((5..55).contains(&dropped), "{dropped} of 60 dropped: {lossy}");
        assert_eq!(
            run("loss=0.02", "render.seed=1")["light_hash"],
            lossy["light_hash"],
            "the same seed, the same faults"
        );
        // Also at real pace, where the projector has a thread of its own.
        let faults = "projector.backend={kind=\"mock\",faults=\"loss=0.05\"}";
        let json = report(
            &["demo", "--pace", "real"],
            &folder,
            &[
                "--set",
                faults,
                "--set",
                "projector.frame_rate=20",
                "--set",
                "safety.watchdog_ms=2000",
                "--set",
                "safety.predict_ms=1000",
                "--set",
                "run.frames=40",
                "--set",
                "output.light_window_ms=100",
            ],
        );
        assert!(json["frames_dropped"].as_u64() > Some(0), "{json}");
        // Found in use, O13: a hash of the light that nothing had computed.
        assert!(json.get("light_hash").is_none(), "{json}");
    }
}

/// Rigs at real pace.
mod real_pace {
    use super::*;

    /// Found in use, O11: a rig of real devices could not be tried without them; O9: `--seconds` at real pace counted
    /// frames, however long they took.
    #[test]
    fn a_real_rig_runs_against_the_mocks_for_as_long_as_it_is_told() {
        let folder = TestFolder::new("simulate");
        let rig = folder.write(
            "rig.toml",
            "[projector]\nframe_rate = 20\n[projector.backend]\nkind = \"usb\"\n[tracker]\nkind = \"natnet\"\nserver = \"10.9.8.7\"\nrate_hz = 240\n\
             [safety]\nwatchdog_ms = 2000\npredict_ms = 1000\n[output]\nlight_window_ms = 100\n",
        );
        let args = ["run", &rig, "--simulate", "--json", "--raster", "48x32", "--out", folder.text()];
        for (pace, spp) in [("real", "render.spp=1"), ("virtual", "render.spp=1")] {
            let output = dpm(&[&args[..], &["--pace", pace, "--seconds", "2", "--set", spp]].concat(), &[]);
            assert_eq!(code(&output), 0, "{pace}: {}", err(&output));
            let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
            assert_eq!(json["pace"], pace);
            let [lit, dropped] = ["frames_lit", "frames_dropped"].map(|k| json[k].as_u64().expect("a count"));
            assert!(lit > 0 && lit + dropped <= 40, "{json}");
            // Two seconds of slots: frames that a slow machine cannot make are left out, and the run does not wait for
            // them.
            let wall = json["wall_s"].as_f64().expect("a time");
            assert!(pace == "virtual" || wall < 60.0, "{wall} s");
        }
        let output = dpm(
            &[
                "snapshot",
                &rig,
                "--simulate",
                "--pace",
                "virtual",
                "--raster",
                "48x32",
                "--frame",
                "2",
                "--out",
                folder.text(),
            ],
            &[],
        );
        assert_eq!(code(&output), 0, "{}", err(&output));
    }

    /// A deployed rig: poses come over UDP from a NatNet server with its own clock, and light is emitted at real pace.
    #[test]
    fn a_rig_with_a_networked_tracker_lights_what_the_tracker_sees() {
        let folder = TestFolder::new("natnet");
        let server = natnet(&MotionSpec::paper_translation(), [0.0, 0.1, 0.0]);
        let rig = natnet_rig(&folder, &server, 10, "predict_ms = 500\n");
        let json = report(&["run", &rig], &folder, &["--set", "output.images=true"]);
        assert_eq!(json["pace"], "real");
        // Found in use, O8: a run with a real tracker gave no picture.
        for name in ["light.png", "viewer.png"] {
            assert!(folder.path(name).exists(), "{name}: {json}");
        }
        assert!(json["frames_lit"].as_u64() > Some(0), "{json}");
        // The age of the newest sample is known only if samples arrived and the server's clock was mapped.
        let latency = json["motion_to_light_ms"]["p50"].as_f64().expect("samples arrived");
        // No tighter bound: software Vulkan compiles shaders in the first frames, and the other tests use the cores
        // meanwhile.
        assert!(latency > 0.0 && latency < 60_000.0, "{latency} ms");
        assert!(json["registration_error_px"].is_null(), "nobody knows the truth about a real tracker");
    }

    /// Found in use, R6 and C2: a rig whose light falls later than prediction may reach was black all the time, reported
    /// that its frames were lit, and ended with exit code 0.
    #[test]
    fn a_run_that_lights_nothing_ends_with_1_and_names_the_key() {
        let folder = TestFolder::new("nothing");
        // The latency from the tracker to the light is at least 5 ms.
        let args =
            [&["demo"][..], &SMALL, &["--out", folder.text(), "--set", "safety.predict_ms=4"]].concat();
        let output = dpm(&args, &[]);
        assert_eq!(code(&output), 1, "{}", err(&output));
        let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("the report all the same");
        assert_eq!(
            (&json["frames_lit"], &json["frames_dark"], &json["frames_dropped"]),
            (&0.into(), &6.into(), &0.into())
        );
        let bodies = json["dark_by_body"].as_array().expect("bodies");
        assert_eq!(bodies.len(), 2);
        for body in bodies {
            let of = |cause: &str| body[cause].as_u64();
            assert_eq!(
                (of("beyond_horizon"), of("silent"), of("never_seen")),
                (Some(6), Some(0), Some(0)),
                "{body}"
            );
        }
        assert!(json["motion_to_light_ms"].is_null() && json["registration_error_px"].is_null(), "{json}");
        assert!(err(&output).contains("raise safety.predict_ms"), "{}", err(&output));

        // A missing tracker.
        let rig = folder.write(
            "rig.toml",
            "[projector]\nframe_rate = 10\n[tracker]\nkind = \"serial\"\nport = \"/dev/nonexistent\"\n\
             [[scene.bodies]]\nname = \"bunny\"\n[safety]\nwatchdog_ms = 2000\n[output]\nimages = false\n",
        );
        let output = dpm(&[&["run", &rig][..], &SMALL, &["--out", folder.text()]].concat(), &[]);
        assert_eq!(code(&output), 1, "{}", err(&output));
        let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("the report all the same");
        assert_eq!(json["frames_lit"], 0);
        assert!(json["dark_by_body"][0]["never_seen"].as_u64() > Some(0), "{json}");
        assert!(err(&output).contains("\"bunny\" was dark"), "{}", err(&output));
        assert!(err(&output).contains("the tracker has never seen it"), "{}", err(&output));
    }

    /// A run that would take hours is stopped: it reports what it did and ends with 0. Meanwhile a second run is refused.
    #[test]
    fn signals_end_a_run_in_order_and_two_runs_do_not_share_a_folder() {
        let folder = TestFolder::new("signal");
        let args = ["demo", "--json", "--raster", "48x32", "--frames", "10000000", "--out", folder.text()];
        let mut running = start(&args);
        running.wait_for_line(Duration::from_secs(60), |line| {
            let progress: serde_json::Value =
                serde_json::from_str(line).expect("each line of progress is JSON");
            progress["frames_lit"].as_u64() > Some(0)
        });
        let second = dpm(&args, &[]);
        assert_eq!(code(&second), 3, "{}", err(&second));
        let holder = format!("in use by another dpm (process {})", running.id());
        assert!(err(&second).contains(&holder), "{}", err(&second));
        let asked = Instant::now();
        // Supervisors also send two signals; the second must not interrupt the orderly end.
        running.signal("TERM");
        running.signal("HUP");
        let (status, report) = running.finish();
        let took = asked.elapsed();
        assert_eq!(status.code(), Some(0), "ended with {status}");
        let report: serde_json::Value = serde_json::from_str(&report).expect("the report of what was done");
        let lit = report["frames_lit"].as_u64().expect("a count");
        assert!(lit > 0 && lit < 10_000_000, "{lit} frames");
        // The limit is 500 ms until dark. The rest is for pictures, the report and the other tests on this machine.
        assert!(took < Duration::from_secs(20), "took {took:?}");
        assert!(folder.path("report.json").exists());
    }

    /// Found in use, O4 and T17: a tracker that streams millimetres, or other axes, puts its bodies where no light can
    /// fall. The run reports this, whether or not the poses are new enough for light.
    #[test]
    fn wrong_units_of_a_real_tracker_are_told_at_the_end_of_a_run() {
        let folder = TestFolder::new("units");
        let server = natnet(&MotionSpec::Still {}, [150.0, 0.0, 0.0]);
        let rig = natnet_rig(&folder, &server, 50, "");
        // Less than a frame usually takes here: little is new enough to be lit, and formerly what was not lit was not
        // judged.
        let args = [
            "run",
            &rig,
            "--json",
            "--raster",
            "48x32",
            "--frames",
            "100",
            "--out",
            folder.text(),
            "--set",
            "safety.predict_ms=30",
            "--set",
            "output.images=true",
        ];
        let output = dpm(&args, &[]);
        let json: serde_json::Value =
            serde_json::from_str(&out(&output)).unwrap_or_else(|e| panic!("{e}: {}", err(&output)));
        let warnings = json["warnings"].to_string();
        assert!(warnings.contains("\\\"bunny\\\"") && warnings.contains("streams metres"), "{warnings}");
        assert!(warnings.contains("150.000"), "{warnings}");
        // Found in use, O8: a run with a real tracker gave no picture and no message about it.
        // A frame in which every body is dark is shown too, and is counted apart.
        let shown = |key: &str| json[key].as_u64().expect("a number");
        if shown("frames_lit") + shown("frames_dark") > 0 {
            assert!(folder.path("light.png").exists(), "{json}");
            assert!(folder.path("viewer.png").exists() || warnings.contains("viewer.png"), "{json}");
        } else {
            assert!(
                warnings.contains("no pictures") || warnings.contains("no light to make pictures of"),
                "{warnings}"
            );
        }
    }
}
