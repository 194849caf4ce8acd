//! The program from the user's point of view: exit codes, where output goes, what errors say.

use crate::cli_common::{code, command, command_of, dpm, err, out, NO_DRIVER};
use std::process::Command;

#[test]
fn version_and_help_go_to_standard_output() {
    let version = dpm(&["-V"], &[]);
    let told = out(&version);
    let begins = format!("dpm {} (", env!("CARGO_PKG_VERSION"));
    assert!(code(&version) == 0 && told.starts_with(&begins) && told.ends_with(")\n"), "{told}");
    let long = out(&dpm(&["--version"], &[]));
    let features = long.strip_prefix(&told).unwrap_or_else(|| panic!("{long} begins otherwise than {told}"));
    assert!(features.starts_with("features: usb, "), "{long}");
    let features: Vec<&str> = features.trim_end().split(", ").collect();
    for (name, is_asked_for) in [
        ("exr", cfg!(feature = "exr")),
        ("wayland", cfg!(feature = "wayland")),
        ("x11", cfg!(feature = "x11")),
        ("vendored-libusb", cfg!(feature = "vendored-libusb")),
    ] {
        assert_eq!(features.contains(&name), is_asked_for, "{name}: {long}");
    }
    let help = dpm(&["--help"], &[]);
    assert_eq!(code(&help), 0);
    for word in ["doctor", "Exit codes", "--set a.b=c"] {
        assert!(out(&help).contains(word), "{word} in {}", out(&help));
    }
}

#[test]
fn a_program_knows_its_commit_wherever_it_lies() {
    let known = out(&dpm(&["-V"], &[]));
    // In another project's work tree, far from the one in which it was built.
    let folder = std::env::temp_dir().join(format!("dpm-elsewhere-{}", std::process::id()));
    std::fs::create_dir_all(folder.join(".git")).unwrap();
    std::fs::write(folder.join(".git/HEAD"), "f".repeat(40)).unwrap();
    let program = folder.join("dpm");
    std::fs::copy(env!("CARGO_BIN_EXE_dpm"), &program).unwrap();
    // Another test that starts a program keeps the copy open for writing until that program runs.
    let mut tries = 0;
    let there = loop {
        match command_of(&program, &["-V"]).current_dir(&folder).output() {
            Err(e) if e.kind() == std::io::ErrorKind::ExecutableFileBusy && tries < 100 => {
                tries += 1;
                std::thread::sleep(std::time::Duration::from_millis(20));
            }
            told => break told.unwrap(),
        }
    };
    std::fs::remove_dir_all(&folder).unwrap();
    assert_eq!(String::from_utf8_lossy(&there.stdout), known);
    let (_, commit) = known.trim_end_matches(")\n").split_once('(').expect("a commit in parentheses");
    let top = concat!(env!("CARGO_MANIFEST_DIR"), "/../..");
    let head = Command::new("git").args(["rev-parse", "HEAD"]).current_dir(top).output();
    let head =
        head.ok().filter(|h| h.status.success()).map(|h| String::from_utf8_lossy(&h.stdout).into_owned());
    let commit = commit.trim_end_matches("-dirty");
    match head {
        // Packagers may set another commit.
        _ if option_env!("DPM_COMMIT").is_some() => {}
        _ if !std::path::Path::new(top).join(".git").exists() => assert_eq!(commit, "unknown"),
        Some(head) => assert_eq!(commit, &head[..12]),
        // A work tree without Git to ask.
        None => assert!(commit.len() == 12 && commit.chars().all(|c| c.is_ascii_hexdigit()), "{commit}"),
    }
}

#[test]
fn bad_usage_ends_with_2() {
    for args in [&["frobnicate"][..], &["doctor", "--frob"], &["doctor", "rig.toml", "surplus"], &[]] {
        let output = dpm(args, &[]);
        assert_eq!(code(&output), 2, "{args:?}: {}", err(&output));
        assert!(err(&output).contains("Usage"), "{args:?}: {}", err(&output));
        assert_eq!(out(&output), "", "{args:?}");
    }
}

#[test]
fn an_overview_of_rigs_refuses_what_it_cannot_show() {
    let many: Vec<String> = (1..=33).map(|port| format!("127.0.0.1:{port}")).collect();
    let many: Vec<&str> = many.iter().map(String::as_str).collect();
    for (args, why) in [
        (&["a=192.168.1.5:8947"][..], "192.168.1.5 is not an address of this machine"),
        (&["stage"], "write HOST:PORT"),
        (&["127.0.0.1:0"], "ports from 1 to 65535"),
        (&["a=127.0.0.1:1", "a=127.0.0.1:2"], "two rigs are called \"a\""),
        (&["a=127.0.0.1:1", "b=localhost:1"], "have the same address"),
        (&["a=127.0.0.1:8940"], "--listen 127.0.0.1:8940: this is the address of the rig \"a\""),
        (&["127.0.0.1:1", "--listen", "0.0.0.0:8940"], "listen on 127.0.0.1"),
        (&["127.0.0.1:1", "--listen", "8940"], "--listen"),
        (&many, "33 rigs are named; an overview shows 1 to 32"),
        (&[], "Usage"),
    ] {
        let output = dpm(&[&["rigs"], args].concat(), &[]);
        assert!(code(&output) == 2 && err(&output).contains(why), "{args:?}: {}", err(&output));
    }
}

#[test]
fn no_colour_is_honoured_and_a_pipe_gets_none() {
    for variables in [&[][..], &[("NO_COLOR", "1")]] {
        let output = dpm(&["frobnicate"], variables);
        assert!(!err(&output).contains('\u{1b}'), "{:?}", err(&output));
    }
}

#[test]
fn doctor_reports_on_every_topic_and_ends_with_4_without_a_gpu() {
    let output = dpm(&["doctor", "--json"], &NO_DRIVER);
    assert_eq!(code(&output), 4, "{}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    assert_eq!(json["can_render"], false);
    let findings = json["findings"].as_array().expect("a list");
    let named = |name: &str| findings.iter().find(|f| f["name"] == name);
    for name in
        ["Vulkan", "cores", "bit-plane packing", "real-time priority", "locked memory", "serial ports"]
    {
        assert!(named(name).is_some(), "{name} in {json}");
    }
    assert_eq!(named("Vulkan").expect("just looked")["state"], "missing");
    for finding in findings.iter().filter(|f| f["state"] == "warning") {
        assert_ne!(finding["remedy"], "", "a warning without advice: {finding}");
    }
    let table = dpm(&["doctor"], &NO_DRIVER);
    assert_eq!(code(&table), 4);
    assert!(out(&table).contains("mesa-vulkan-drivers"), "{}", out(&table));
    assert!(err(&table).starts_with("error: no usable Vulkan device"), "{}", err(&table));
}

#[test]
fn a_reader_that_goes_away_is_no_error() {
    use std::process::Stdio;
    let mut child = command(&["doctor", "--json"])
        .envs(NO_DRIVER)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("the program starts");
    drop(child.stdout.take());
    let output = child.wait_with_output().expect("it ends");
    assert_eq!(output.status.code(), Some(4), "{}", err(&output));
    assert!(!err(&output).contains("panicked"), "{}", err(&output));
}

#[test]
fn stability_without_vulkan_runs_what_it_can_and_says_what_it_could_not() {
    let output = dpm(&["stability", "--json", "--only", "gpu-no-light"], &NO_DRIVER);
    assert_eq!(code(&output), 4, "{}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    assert_eq!((&json["passed"], &json["failed"], &json["not_run"]), (&0.into(), &0.into(), &1.into()));
    assert_eq!((&json["cases"][0]["verdict"], &json["cases"][0]["error"]), (&"not run".into(), &().into()));
    assert!(json["cases"][0]["note"].as_str().is_some_and(|n| n.contains("no Vulkan device")), "{json}");
    assert!(err(&output).contains("1 stability cases were not run"), "{}", err(&output));
    // What needs no device is checked as usual.
    let output = dpm(&["stability", "--json", "--only", "quantiser-extremes"], &NO_DRIVER);
    assert_eq!(code(&output), 0, "{}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    assert_eq!(json["cases"][0]["verdict"], "pass");
}

#[test]
fn error_lists_its_groups_and_refuses_budgets_and_numbers_that_are_none() {
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/demo.toml");
    let list = dpm(&["error", rig, "--list", "--budgets", "1/4,18"], &[]);
    assert_eq!(
        (code(&list), out(&list)),
        (0, "0 still-0.25\n1 still-18\n2 moving-0.25\n3 moving-18\n".into())
    );
    let listed = dpm(&["error", rig, "--list", "--budgets", "1/4,18", "--json"], &[]);
    let listed: serde_json::Value = serde_json::from_str(&out(&listed)).expect("one JSON object");
    assert_eq!(listed["groups"], serde_json::json!(["still-0.25", "still-18", "moving-0.25", "moving-18"]));
    let figure = dpm(&["error", rig, "--list", "--preset", "figure3"], &[]);
    assert_eq!(out(&figure).lines().count(), 8);
    for bad in [&["--budgets", "0"][..], &["--budgets", "1/0"], &["--budgets", "nan"], &["--index", "99"]] {
        let output = dpm(&[&["error", rig][..], bad].concat(), &[]);
        assert_eq!(code(&output), 2, "{bad:?}: {}", err(&output));
    }
    let nothing = dpm(&["error", "merge", "--out", "/nonexistent"], &[]);
    assert!(code(&nothing) == 2 && err(&nothing).contains("--index"), "{}", err(&nothing));
}

/// Found in use, O12: clap advised "-- -3", and a picture that is not there was told as a rig file.
#[test]
fn what_was_meant_is_what_the_message_speaks_of() {
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/mock.toml");
    for (args, told) in [
        (&["run", rig, "--seconds", "-3"][..], "--seconds -3.0: must be above 0 and at most 1e9"),
        (&["calibrate", "wand", rig, "--seconds", "-3"][..], "write seconds, 0.1 to 3600"),
        (&["snapshot", "gone.fbx"][..], "gone.fbx: there is no such file"),
    ] {
        let output = dpm(args, &[]);
        assert_eq!(code(&output), 2, "{args:?}: {}", err(&output));
        assert!(err(&output).contains(told), "{args:?}: {}", err(&output));
        assert!(
            !err(&output).contains("rig file: No such") && !err(&output).contains("-- -3"),
            "{}",
            err(&output)
        );
    }
}
