//! Rig files that are accepted and refused.

use super::*;

fn parse(text: &str) -> Result<RigConfig, ConfigErrors> {
    RigConfig::parse("rig.toml", text, Path::new("/nonexistent"), &Overrides::default())
}

fn with_flags(text: &str, flags: &[&str]) -> Result<RigConfig, ConfigErrors> {
    let flags = flags.iter().map(|s| s.to_string()).collect();
    RigConfig::parse("rig.toml", text, Path::new("/nonexistent"), &Overrides { variables: vec![], flags })
}

/// Text, line, column, key, part of the message.
const BAD: &[(&str, usize, usize, &str, &str)] = &[
    // Syntax.
    ("[projector", 1, 11, "", "not valid TOML"),
    ("[projector]\nwidth = ", 2, 9, "", "not valid TOML"),
    ("[projector]\nwidth = 1\nwidth = 2", 3, 1, "", "not valid TOML"),
    ("[projector]\nwidth 5", 2, 7, "", "not valid TOML"),
    ("[a]\n[a]", 2, 2, "", "not valid TOML"),
    ("x = \"abc", 1, 9, "", "not valid TOML"),
    // Unknown keys.
    ("[projektor]\n", 1, 2, "projektor", "did you mean `projector`"),
    ("[projector]\nwdith = 3", 2, 1, "projector.wdith", "did you mean `width`"),
    ("[projector]\n  horizontal_fov = 3", 2, 3, "projector.horizontal_fov", "unknown key"),
    ("zzz = 1", 1, 1, "zzz", "known keys here: projector"),
    (
        "[projector.backend]\nkind = \"usb\"\nbaud = 3",
        3,
        1,
        "projector.backend.baud",
        "does not belong to kind = \"usb\"",
    ),
    ("[tracker]\nserver = \"a\"", 2, 1, "tracker.server", "natnet or vrpn"),
    ("[tracker]\nratehz = 5", 2, 1, "tracker.ratehz", "did you mean `rate_hz`"),
    ("[render.paper]\ntau = 1", 2, 1, "render.paper.tau", "unknown key"),
    ("[scene]\nbodies = [{ name = \"a\", nod = \"b\" }]", 2, 25, "scene.bodies.0.nod", "did you mean `node`"),
    (
        "[observer.gaze]\nkind = \"straight\"\npoint = [0, 0, 0]",
        3,
        1,
        "observer.gaze.point",
        "does not belong",
    ),
    // Wrong types.
    ("projector = 3", 1, 13, "projector", "is an integer, must be a table"),
    ("[projector]\nwidth = \"1024\"", 2, 9, "projector.width", "write 1024 without quotes"),
    ("[projector]\nwidth = 1024.0", 2, 9, "projector.width", "without the decimal point"),
    ("[projector]\nwidth = true", 2, 9, "projector.width", "is a boolean, must be a whole number"),
    ("[projector]\nwidth = 1979-05-27", 2, 9, "projector.width", "is a date"),
    ("[projector]\nwidth = 99999999999999999999", 2, 9, "projector.width", "beyond 64 bits"),
    ("[projector]\nposition = 1", 2, 12, "projector.position", "must be an array of 3"),
    ("[projector]\nposition = [1, 2]", 2, 12, "projector.position", "has 2 elements, must have 3"),
    ("[projector]\nposition = [1, 2, \"x\"]", 2, 19, "projector.position.2", "is a string, must be a number"),
    ("[projector]\nframe_rate = 59.94", 2, 14, "projector.frame_rate", "60000/1001"),
    ("[projector]\nframe_rate = \"fast\"", 2, 14, "projector.frame_rate", "fraction"),
    ("[projector]\nframe_rate = \"1/0\"", 2, 14, "projector.frame_rate", "above 0"),
    ("[projector]\nframe_rate = -5", 2, 14, "projector.frame_rate", "is -5"),
    ("[projector]\nframe_rate = []", 2, 14, "projector.frame_rate", "is an array"),
    ("[projector]\nbackend = \"usb\"", 2, 11, "projector.backend", "is a string, must be a table"),
    ("[projector.backend]\nkind = \"hdmi\"", 2, 8, "projector.backend.kind", "\"window\""),
    ("[projector.backend]\nkind = 3", 2, 8, "projector.backend.kind", "is an integer"),
    ("[render]\nmethod = \"fast\"", 2, 10, "render.method", "\"dpm\" | \"paper\""),
    ("[render]\nmethod = 2", 2, 10, "render.method", "is an integer"),
    ("[render.effects]\nrate_map = \"true\"", 2, 12, "render.effects.rate_map", "write true without quotes"),
    ("[render.effects]\nrate_map = 1", 2, 12, "render.effects.rate_map", "must be a boolean"),
    ("[scene]\nbodies = {}", 2, 10, "scene.bodies", "must be a list"),
    ("[scene]\nbodies = [\"hare\"]", 2, 11, "scene.bodies.0", "is a string, must be a table"),
    ("[scene]\nfile = 5", 2, 8, "scene.file", "must be a path"),
    ("[scene]\nfile = \"a\\u0000b\"", 2, 8, "scene.file", "NUL"),
    ("[output]\ndir = 5", 2, 7, "output.dir", "must be a path"),
    ("[observer]\nbody = 5", 2, 8, "observer.body", "must be a string"),
    // Out of range.
    ("[projector]\nwidth = 0", 2, 9, "projector.width", "must be 1 to 8192 px"),
    ("[projector]\nheight = 8193", 2, 10, "projector.height", "must be 1 to 8192 px"),
    ("[projector]\nwidth = -1", 2, 9, "projector.width", "is -1, must be 0 to 4294967295"),
    ("[projector]\nwidth = 5_000_000_000", 2, 9, "projector.width", "must be 0 to 4294967295"),
    ("[projector]\nplanes = 12", 2, 10, "projector.planes", "must be 8 or 24"),
    ("[projector]\nframe_rate = 200_000", 2, 14, "projector.frame_rate", "must be 1 to 100000 frames/s"),
    ("[projector]\nframe_rate = \"1/2\"", 2, 14, "projector.frame_rate", "must be 1 to 100000"),
    ("[projector]\nmax_intensity = 0", 2, 17, "projector.max_intensity", "scene units/sr"),
    ("[projector]\nmax_intensity = nan", 2, 17, "projector.max_intensity", "not finite"),
    ("[projector]\nhorizontal_fov_deg = 180", 2, 22, "projector.horizontal_fov_deg", "must be 0.1 to 170"),
    ("[projector]\nposition = [0, inf, 0]", 2, 16, "projector.position.1", "not finite"),
    ("[projector]\nposition = [0, 1e9, 0]", 2, 12, "projector.position", "each -1000000 to 1000000 m"),
    ("[tracker]\nrate_hz = 0", 2, 11, "tracker.rate_hz", "must be 1 to 10000 Hz"),
    ("[tracker]\ndrop_out = 1.5", 2, 12, "tracker.drop_out", "must be 0 to 1"),
    ("[tracker]\nnoise_m = -1", 2, 11, "tracker.noise_m", "must be 0 to 1 m"),
    ("[tracker]\nkind = \"natnet\"\nserver = \"\"", 3, 10, "tracker.server", "not empty"),
    ("[tracker]\nkind = \"natnet\"\ndata_port = 0", 3, 13, "tracker.data_port", "1 to 65535"),
    ("[render]\ndepth = 0", 2, 9, "render.depth", "must be 1 to 64"),
    ("[render]\nspp = 100_000", 2, 7, "render.spp", "must be 1 to 4096"),
    ("[render]\nsoftware_raster = [0, 240]", 2, 19, "render.software_raster", "each 1 to 8192 px"),
    ("[render]\nexposure = 0", 2, 12, "render.exposure", "must be"),
    (
        "[render.paper]\ntemporal_alpha = [0.2, 0, 0.05]",
        2,
        18,
        "render.paper.temporal_alpha",
        "each 0.001 to 1",
    ),
    ("[scene]\nsurface_albedo = 1.2", 2, 18, "scene.surface_albedo", "must be 0.01 to 1"),
    ("[scene]\nambient = [0, -1, 0]", 2, 11, "scene.ambient", "each 0"),
    ("[scene]\nfile = \"\"", 2, 8, "scene.file", "not empty"),
    ("[real_time]\npriority = 100", 2, 12, "real_time.priority", "must be 0 to 99"),
    ("[real_time.stage_costs_us]\nrender = 2_000_000", 2, 10, "real_time.stage_costs_us.render", "us"),
    ("[safety]\nwatchdog_ms = 0", 2, 15, "safety.watchdog_ms", "must be 1 to 10000 ms"),
    ("[safety]\nstart = \"by magic\"", 2, 9, "safety.start", "must be one of"),
    ("[safety.interlock]\nkind = \"key\"\nreset = \"by hand\"", 3, 1, "safety.interlock.reset", "does not belong to kind"),
    // Two names of one device.
    (
        "[projector.backend]\nkind = \"serial\"\nport = \"/proc/../dev/zero\"\n[safety.interlock]\nkind = \"line\"\nport = \"/dev/zero\"\n[real_time]\npace = \"real\"",
        6,
        8,
        "safety.interlock.port",
        "projector's own",
    ),
    ("[safety.limits]\nmean_level = 1.1", 2, 14, "safety.limits.mean_level", "must be 0 to 1"),
    ("[safety.limits]\nmean_level = 0.0005", 2, 14, "safety.limits.mean_level", "below a thousandth"),
    ("[safety.limits]\nmean_window_s = 0.1", 2, 17, "safety.limits.mean_window_s", "must be 0.5 to 3600 s"),
    ("[safety.limits]\nfull_white_s = 0.2", 2, 16, "safety.limits.full_white_s", "too short"),
    ("[safety.interlock]\nkind = \"process\"", 2, 8, "safety.interlock.kind", "names no process"),
    (
        "[safety.interlock]\nkind = \"process\"\nname = \"guard\"\npid_file = \"/run/guard.pid\"",
        2,
        8,
        "safety.interlock.kind",
        "or two",
    ),
    ("[safety.interlock]\nkind = \"process\"\npid_file = \"guard.pid\"", 3, 12, "safety.interlock.pid_file", "relative"),
    ("[safety.interlock]\nkind = \"line\"", 2, 8, "safety.interlock.kind", "names no line"),
    ("[safety.interlock]\nkind = \"line\"\nfile = \"v\"", 3, 8, "safety.interlock.file", "relative"),
    (
        "[projector.backend]\nkind = \"serial\"\nport = \"/dev/a\"\n[safety.interlock]\nkind = \"line\"\nport = \"/dev/a\"\n[real_time]\npace = \"real\"",
        6,
        8,
        "safety.interlock.port",
        "projector's own",
    ),
    ("[safety.interlock]\nkind = \"key\"\nkey = \"b\"", 3, 7, "safety.interlock.key", "gives an order"),
    ("[safety.interlock]\nkind = \"key\"\nkey = \"no\"", 3, 7, "safety.interlock.key", "not one printable"),
    ("[output]\nlight_window_ms = 0", 2, 19, "output.light_window_ms", "ms"),
    ("[prediction]\ngate_sigma = 0.5", 2, 14, "prediction.gate_sigma", "must be 1 to 100"),
    // Motions and faults, in the mock's notation.
    (
        "[[scene.bodies]]\nname = \"a\"\nmotion = { kind = \"fly\" }",
        3,
        10,
        "scene.bodies.0.motion",
        "unknown variant `fly`",
    ),
    (
        "[[scene.bodies]]\nname = \"a\"\nmotion = { kind = \"still\", speed_m_s = 1 }",
        3,
        28,
        "scene.bodies.0.motion.speed_m_s",
        "unknown field",
    ),
    ("[[scene.bodies]]\nname = \"a\"\nmotion = { speed_m_s = 1 }", 3, 10, "scene.bodies.0.motion", "kind"),
    ("[[scene.bodies]]\nname = \"a\"\nmotion = \"still\"", 3, 10, "scene.bodies.0.motion", "must be a table"),
    (
        "[[scene.bodies]]\nname = \"a\"\n[scene.bodies.motion]\nkind = \"rotate\"\nspin = 1",
        5,
        1,
        "scene.bodies.0.motion.spin",
        "unknown field",
    ),
    (
        "[[scene.bodies]]\nname = \"a\"\nmotion.kind = \"translate\"\nmotion.speed_m_s = 0",
        4,
        8,
        "scene.bodies.0.motion.speed_m_s",
        "speed_m_s",
    ),
    ("[tracker]\nfaults = \"gremlins\"", 2, 10, "tracker.faults", "unknown fault `gremlins`"),
    ("[tracker]\nfaults = \"loss=2\"", 2, 10, "tracker.faults", "0 to 1"),
    ("[tracker]\nfaults = \"unplug@1s+2s\"", 2, 10, "tracker.faults", "means nothing to the mock tracker"),
    // Found in use, R20: the faults of the mock projector were neither read nor applied.
    (
        "[projector.backend]\nfaults = \"utter nonsense\"",
        2,
        10,
        "projector.backend.faults",
        "unknown fault `utter nonsense`",
    ),
    (
        "[projector.backend]\nfaults = \"jump=1@1s\"",
        2,
        10,
        "projector.backend.faults",
        "means nothing to the mock projector",
    ),
    // Contradictions.
    ("[projector]\nframe_rate = 948", 2, 14, "projector.frame_rate", "at most 947 frames/s of 24 planes"),
    ("[projector]\nmax_planes_per_second = 9523", 2, 25, "projector.max_planes_per_second", "at most 396"),
    (
        "[projector]\nlook_at = [0, 0.35, 1.1]",
        2,
        11,
        "projector.look_at",
        "looks at the point where it stands",
    ),
    ("[projector]\nup = [0, 0, 0]", 2, 6, "projector.up", "no upper side"),
    ("[projector]\nlook_at = [0, 0, 0]\nposition = [0, 2, 0]", 2, 11, "projector.look_at", "no upper side"),
    (
        "[projector.backend]\nkind = \"usb\"\ncompaction = \"zip\"",
        3,
        14,
        "projector.backend.compaction",
        "\"auto\" | \"raw\"",
    ),
    ("[scene]\nbodies = [{ node = \"a\" }]", 2, 11, "scene.bodies.0", "has no `name`"),
    (
        "[[scene.bodies]]\nname = \"a\"\n[[scene.bodies]]\nname = \"a\"\nnode = \"b\"",
        4,
        8,
        "scene.bodies.1.name",
        "two bodies are called \"a\"",
    ),
    (
        "[[scene.bodies]]\nname = \"a\"\n[[scene.bodies]]\nname = \"b\"\nnode = \"a\"",
        5,
        8,
        "scene.bodies.1.node",
        "two bodies move the node \"a\"",
    ),
    (
        "[[scene.bodies]]\nname = \"a\"\nid = 1\n[[scene.bodies]]\nname = \"b\"\nid = 1",
        6,
        6,
        "scene.bodies.1.id",
        "same id",
    ),
    ("[observer]\nbody = \"glasses\"", 2, 8, "observer.body", "no body is called \"glasses\"; bodies: none"),
    (
        "[observer.gaze]\nkind = \"tracked\"\ntarget = \"x\"",
        3,
        10,
        "observer.gaze.target",
        "no body is called",
    ),
    ("[observer.gaze]\nkind = \"tracked\"", 1, 1, "observer.gaze.target", "no body is called"),
    ("[observer]\neye_offset = [0, 0, 1]", 2, 14, "observer.eye_offset", "without `observer.tracked`"),
    ("[observer]\ntracked = 5", 2, 11, "observer.tracked", "must be a name, or a table"),
    ("[observer]\ntracked = \"\"", 2, 11, "observer.tracked", "has no `name`"),
    ("[observer]\ntracked = { id = 3 }", 2, 11, "observer.tracked", "has no `name`"),
    (
        "[observer]\ntracked = \"a\"\n[[scene.bodies]]\nname = \"a\"",
        2,
        11,
        "observer.tracked",
        "is one of `scene.bodies`, on which light falls",
    ),
    (
        "[observer]\ntracked = \"g\"\nbody = \"a\"\n[[scene.bodies]]\nname = \"a\"",
        2,
        11,
        "observer.tracked",
        "one eye is carried by one of them",
    ),
    (
        "[observer]\ntracked = { name = \"g\", motion = { kind = \"still\" } }\n[tracker]\nkind = \"natnet\"",
        2,
        11,
        "observer.tracked",
        "which reports the poses itself",
    ),
    (
        "[safety.eyes]\nheads = [{ name = \"g\", id = 4 }]\n[[scene.bodies]]\nname = \"a\"\nid = 4",
        2,
        10,
        "safety.eyes.heads.0",
        "\"g\" and \"a\" have the same id 4",
    ),
    ("[scene]\nfile = \"a.glb\"\nbuiltin = \"demo\"", 3, 11, "scene.builtin", "together with `scene.file`"),
    ("[render.paper]\nphi_h_deg = 40", 2, 13, "render.paper.phi_h_deg", "`render.paper.phi_q_deg` = 30.0"),
    (
        "[render.paper]\nfilter_to_deg = 10",
        2,
        17,
        "render.paper.filter_to_deg",
        "must be at most `render.paper.filter_to_deg`",
    ),
    ("[real_time]\npace = \"virtual\"", 2, 8, "real_time.pace", "never end"),
    (
        "[real_time]\npace = \"virtual\"\n[run]\nframes = 9\n[tracker]\nkind = \"vrpn\"",
        6,
        8,
        "tracker.kind",
        "its own clock",
    ),
    (
        "[real_time]\npace = \"virtual\"\n[run]\nframes = 9\n[projector.backend]\nkind = \"usb\"",
        6,
        8,
        "projector.backend.kind",
        "its own clock",
    ),
    ("[real_time]\naffinity = [0, 5000]", 2, 12, "real_time.affinity", "core 5000"),
    ("[safety]\nwatchdog_ms = 2", 2, 15, "safety.watchdog_ms", "write at least 3 ms"),
    (
        "[safety]\npredict_ms = 3",
        2,
        14,
        "safety.predict_ms",
        "less than two samples at tracker.rate_hz = 500",
    ),
    ("[tracker]\nrate_hz = 50\n[safety]\npredict_ms = 20", 4, 14, "safety.predict_ms", "at least 40 ms"),
    // Found in use, O10: a first rig at an ordinary projector's rate, and the keys that have to be changed.
    (
        "[projector]\nframe_rate = 30\n[safety]\nwatchdog_ms = 50",
        4,
        15,
        "safety.watchdog_ms",
        "safety.watchdog_ms = 50 is less than two frames",
    ),
    (
        "[projector]\nframe_rate = 24\n[output]\nlight_window_ms = 33",
        4,
        19,
        "output.light_window_ms",
        "output.light_window_ms = 33 is shorter than one frame",
    ),
    (
        "[projector]\nframe_rate = 60\n[safety]\npredict_ms = 20",
        4,
        14,
        "safety.predict_ms",
        "less than a frame and a half of 16.667 ms",
    ),
    ("[output]\nlight_window_ms = 1", 2, 19, "output.light_window_ms", "shorter than one frame"),
    // Files.
    ("[scene]\nfile = \"none.glb\"", 2, 8, "scene.file", "/nonexistent/none.glb"),
    (
        "[projector]\ncalibration = \"cal.xml\"\ncalibration_unit = \"metre\"",
        2,
        15,
        "projector.calibration",
        "No such file",
    ),
    (
        "[projector]\ncalibration = \"cal.xml\"",
        2,
        15,
        "projector.calibration",
        "set projector.calibration_unit",
    ),
    (
        "[projector]\ncalibration_lens = \"fisheye\"",
        2,
        20,
        "projector.calibration_lens",
        "set projector.calibration or remove",
    ),
    (
        "[projector]\ncalibration_unit = \"inch\"",
        2,
        20,
        "projector.calibration_unit",
        "\"metre\" | \"centimetre\" | \"millimetre\"",
    ),
    ("[tracker]\nkind = \"natnet\"\nserver = \"motive.lab\"", 3, 10, "tracker.server", "not an IPv4 address"),
    (
        "[tracker]\nkind = \"natnet\"\nmulticast = \"10.0.0.1\"",
        3,
        13,
        "tracker.multicast",
        "not a multicast group",
    ),
    ("[scene.environment]\nkind = \"image\"\nfile = \"sky.pfm\"", 3, 8, "scene.environment.file", "sky.pfm"),
    ("[tracker]\nkind = \"replay\"\nfile = \"run.log\"", 3, 8, "tracker.file", "run.log"),
];

#[test]
fn every_bad_file_is_refused_at_the_right_place() {
    let mut wrong = String::new();
    for (text, line, column, key, part) in BAD {
        let told = match parse(text) {
            Ok(_) => "accepted".to_string(),
            Err(errors) => {
                let first = &errors.0[0];
                let place = Origin::File { file: "rig.toml".into(), line: *line, column: *column };
                let all = errors.to_string();
                if first.origin == place && first.key == *key && all.contains(part) {
                    continue;
                }
                all
            }
        };
        wrong += &format!("--- {text}\nwanted {line}:{column} `{key}` {part:?}, told:\n{told}\n");
    }
    assert!(wrong.is_empty(), "{wrong}");
}

#[test]
fn an_error_reads_file_line_column_key_range_and_remedy() {
    let error = parse("[projector]\nwidth = 0").unwrap_err().to_string();
    assert_eq!(error, "rig.toml:2:9: `projector.width`: is 0, must be 1 to 8192 px");
    let error = parse("[projector]\nwdith = 3").unwrap_err().to_string();
    assert_eq!(error, "rig.toml:2:1: `projector.wdith`: unknown key; did you mean `width`?");
}

#[test]
fn all_mistakes_are_told_at_once() {
    let text =
        "[projector]\nwidth = 0\nheight = \"x\"\nfoo = 1\n[render]\nspp = -1\n[tracker]\nkind = \"radar\"\n";
    let errors = parse(text).unwrap_err();
    let lines: Vec<usize> = errors
        .0
        .iter()
        .map(|e| match e.origin {
            Origin::File { line, .. } => line,
            _ => 0,
        })
        .collect();
    assert_eq!(lines, [4, 2, 3, 8, 6], "{errors}");
    let text = "[projector]\nframe_rate = 948\nup = [0, 0, 0]\n[safety]\nwatchdog_ms = 1\n";
    assert_eq!(parse(text).unwrap_err().0.len(), 3);
}

/// Found in use, C2 and O10: with the defaults a rig may have any usual frame rate and any usual tracker.
#[test]
fn the_defaults_fit_every_frame_rate_and_every_tracker() {
    for (rate, planes, watchdog_us) in [
        (24, 24, 125_000),
        (30, 24, 100_000),
        (60, 24, 50_000),
        (100, 24, 50_000),
        (120, 24, 50_000),
        (240, 24, 50_000),
        (947, 24, 50_000),
        (2000, 8, 50_000),
    ] {
        for tracker in [30, 60, 120, 500, 1000] {
            let text = format!(
                "[projector]\nframe_rate = {rate}\nplanes = {planes}\n[tracker]\nrate_hz = {tracker}"
            );
            let rig = parse(&text).unwrap_or_else(|e| panic!("{rate} frames/s, {tracker} Hz: {e}"));
            assert_eq!(rig.watchdog_us(), watchdog_us);
            assert!(rig.light_window_ms() >= 33.0 && rig.light_window_ms() >= rig.frame_ms());
        }
    }
}

#[test]
fn defaults_are_accepted_and_so_is_the_demo() {
    assert_eq!(parse("").unwrap(), RigConfig::default());
    let demo = RigConfig::demo(&Overrides::default()).unwrap();
    assert_eq!((demo.projector.width, demo.projector.height, demo.projector.planes), (1024, 768, 24));
    assert_eq!(demo.projector.frame_rate.hz(), 947.0);
    assert_eq!(demo.projector.schedule().len(), 24);
    assert_eq!(demo.real_time.pace, Pace::Virtual);
}

#[test]
fn later_sources_win() {
    let text = "[render]\nspp = 3\ndepth = 4\nseed = 5";
    let overrides = Overrides {
        variables: vec![
            ("DPM_SET_RENDER__SPP".into(), "7".into()),
            ("DPM_SET_RENDER__DEPTH".into(), "8".into()),
            ("HOME".into(), "/root".into()),
        ],
        flags: vec!["render.depth=9".into(), "render.depth = 10".into()],
    };
    let rig = RigConfig::parse("rig.toml", text, Path::new(""), &overrides).unwrap();
    assert_eq!((rig.render.seed, rig.render.spp, rig.render.depth), (5, 7, 10));
}

#[test]
fn flags_take_words_tables_and_steps_into_lists() {
    let text = "[[scene.bodies]]\nname = \"a\"\n[[scene.bodies]]\nname = \"b\"";
    let rig = with_flags(
        text,
        &["render.method=paper", "scene.bodies.1.node=Bust", "tracker={ kind = \"mock\", rate_hz = 250 }"],
    )
    .unwrap();
    assert_eq!(rig.render.method, RenderMethod::Paper);
    assert_eq!(rig.scene.bodies[1].node_name(), "Bust");
    assert_eq!(rig.tracker.rate_hz(), Some(250));
}

#[test]
fn a_bad_override_is_named_as_it_was_given() {
    let told = |flag: &str| with_flags("", &[flag]).unwrap_err().to_string();
    assert_eq!(
        told("projector.width=0"),
        "--set projector.width=0: `projector.width`: is 0, must be 1 to 8192 px"
    );
    assert!(told("nonsense").contains("has no `=`"));
    assert!(told("=4").contains("no key before the `=`"));
    assert!(told("a..b=4").contains("no key before"));
    assert!(told("render.nix=4").starts_with("--set render.nix=4: `render.nix`: unknown key"));
    assert!(told("scene.bodies=[{name='a', x=1}]").starts_with("--set scene.bodies"));
    let errors = with_flags("[[scene.bodies]]\nname = \"a\"", &["scene.bodies.1.name=x"]).unwrap_err();
    assert!(errors.to_string().contains("`scene.bodies` has 1 elements"), "{errors}");
    let errors = with_flags("[render]\nspp = 1", &["render.spp.x=1"]).unwrap_err();
    assert!(errors.to_string().contains("`render.spp` is an integer, not a table"), "{errors}");
    let overrides =
        Overrides { variables: vec![("DPM_SET_PROJECTOR__WIDTH".into(), "wide".into())], flags: vec![] };
    let errors = RigConfig::parse("rig.toml", "", Path::new(""), &overrides).unwrap_err().to_string();
    assert!(
        errors.starts_with("environment variable DPM_SET_PROJECTOR__WIDTH: `projector.width`"),
        "{errors}"
    );
}

#[test]
fn columns_count_characters() {
    let errors = parse("[output]\n\"äöü\" = 1 \n dir = 5").unwrap_err();
    assert_eq!(errors.0[1].origin, Origin::File { file: "rig.toml".into(), line: 3, column: 8 }, "{errors}");
}

#[test]
fn an_unreadable_or_huge_file_is_one_error() {
    let load = |path: &Path| RigConfig::load(path, &Overrides::default()).unwrap_err().to_string();
    assert!(
        load(Path::new("/nonexistent/rig.toml")).contains("/nonexistent/rig.toml: cannot read the rig file")
    );
    assert!(load(Path::new("/")).contains("cannot read"));
    let here = std::env::current_dir().unwrap().display().to_string();
    assert!(load(Path::new("no-such-rig.toml")).contains(&format!("looked for in {here};")));
    assert!(!load(Path::new("/nonexistent/rig.toml")).contains("looked for"));
    let huge = std::env::temp_dir().join(format!("dpm-huge-{}.toml", std::process::id()));
    std::fs::write(&huge, vec![b'#'; MAX_FILE_BYTES as usize + 1]).unwrap();
    let told = load(&huge);
    std::fs::write(&huge, [0xff, 0xfe, 0x00]).unwrap();
    let not_text = load(&huge);
    std::fs::remove_file(&huge).unwrap();
    assert!(told.contains("more than 1048576 bytes"), "{told}");
    assert!(not_text.contains("cannot read"), "{not_text}");
}

/// Found in use, O10: an error about several keys named only the key at which it was reported, and not always the one
/// that had to be changed. Whichever key is written, the message names all keys that are involved, with their values.
#[test]
fn contradictions_name_every_key_with_its_value() {
    for (text, parts) in [
        (
            "[projector]\nmax_planes_per_second = 9523",
            &[
                "max_planes_per_second`: is 9523",
                "`projector.frame_rate` = \"947\"",
                "`projector.planes` = 24",
            ][..],
        ),
        (
            "[projector]\nframe_rate = 948",
            &["`projector.max_planes_per_second` = 22728", "`projector.planes` = 24"],
        ),
        (
            "[projector]\nlook_at = [0, 0, 0]\nposition = [0, 2, 0]",
            &[
                "look_at`: is [0.0, 0.0, 0.0]",
                "`projector.up` = [0.0, 1.0, 0.0]",
                "`projector.position` = [0.0, 2.0, 0.0]",
            ],
        ),
        ("[render.paper]\nphi_q_deg = 3", &["phi_q_deg`: is 3.0", "`render.paper.phi_h_deg` = 15.0"]),
        (
            "[[scene.bodies]]\nname = \"a\"\n[[scene.bodies]]\nname = \"a\"\nnode = \"b\"",
            &["`scene.bodies.1.name`", "`scene.bodies.0`"],
        ),
    ] {
        let told = parse(text).unwrap_err().to_string();
        for part in parts {
            assert!(told.contains(part), "{text}: {part} in {told}");
        }
    }
}

/// The renderer distinguishes as many bodies as an 8-bit number can. The first body beyond that is named in the
/// error.
#[test]
fn two_hundred_and_fifty_six_bodies_are_the_most() {
    let bodies = |n: usize| {
        (0..n).map(|i| format!("[[scene.bodies]]\nname = \"b{i}\"\nid = {i}\n")).collect::<String>()
    };
    assert_eq!(parse(&bodies(256)).unwrap().scene.bodies.len(), 256);
    let told = parse(&bodies(300)).unwrap_err().to_string();
    assert!(told.contains("300 bodies, 44 more than the 256") && told.contains("\"b256\""), "{told}");
    assert_eq!(dpm_render::scene_data::MAX_BODIES, 256);
}

/// Product code under `dir` as one text, without tests and without the declarations and checks of the keys.
fn product_code(dir: &Path, out: &mut String) {
    for entry in std::fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        if path.is_dir() && name != "tests" {
            product_code(&path, out);
        } else if name.ends_with(".rs") && !name.ends_with("tests.rs") && !path.ends_with("config/check.rs") {
            let text = std::fs::read_to_string(&path).unwrap();
            out.push_str(text.split("#[cfg(test)]\nmod tests {").next().unwrap());
        }
    }
}

/// Found in use, R20: a key of the manual that nothing reads. A field is read as `.name`. A name that several
/// sections declare must be read as often. Keys that only the check reads limit other keys.
#[test]
fn every_key_is_read_somewhere() {
    const LIMITS: [&str; 1] = ["projector.max_planes_per_second"];
    let mut code = String::new();
    for crate_src in ["src", "../dpm/src", "../rehearsal/src"] {
        product_code(&Path::new(env!("CARGO_MANIFEST_DIR")).join(crate_src), &mut code);
    }
    let reads = |name: &str| {
        let field = format!(".{name}");
        let ends = |rest: &str| !rest.starts_with(|c: char| c.is_alphanumeric() || c == '_' || c == '(');
        code.match_indices(&field).filter(|(at, _)| ends(&code[at + field.len()..])).count()
    };
    let docs = RigConfig::key_docs();
    let mut unread = Vec::new();
    for key in docs.iter().filter(|k| !LIMITS.contains(&k.key.as_str())) {
        let name = key.key.rsplit('.').next().unwrap();
        let declared = docs.iter().filter(|k| k.key.rsplit('.').next() == Some(name));
        // One table under several kinds of a part is read in one place.
        let shared = |key: &str| {
            key.split_once(").").filter(|(_, rest)| rest.contains('.')).map(|(_, rest)| rest.to_owned())
        };
        let declared = declared.map(|k| shared(&k.key).unwrap_or_else(|| k.key.clone()));
        let declared = declared.collect::<std::collections::BTreeSet<_>>().len();
        if name != "kind" && reads(name) < declared {
            unread.push(&key.key);
        }
    }
    assert!(unread.is_empty(), "nothing reads {unread:?}");
    assert_eq!(reads("no_such_key"), 0);
}

#[test]
fn every_key_is_explained() {
    let docs = RigConfig::key_docs();
    assert!(docs.len() > 80);
    for key in &docs {
        assert!(key.doc.len() > 8, "{}: {:?}", key.key, key.doc);
    }
}

#[test]
fn effects_follow_the_method_unless_switched() {
    let on = |flags: &[&str]| with_flags("", flags).unwrap().render.effects_on();
    assert!(on(&["render.method=paper"]).rate_map);
    let miyamoto = on(&["render.method=miyamoto"]);
    assert!(!miyamoto.rate_map && !miyamoto.spatial_filter && miyamoto.checkerboard);
    let full = on(&["render.method=full", "render.effects.blue_noise=true"]);
    assert!(full.blue_noise && !full.checkerboard && !full.temporal_filter);
}
