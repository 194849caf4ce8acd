//! `docs/TUTORIAL.md`: its commands are executed as they stand, and what the page says they print is what they print.

use dpm_tests::programs::{program, RunFolder};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

/// Longer than the commands take on a busy machine.
const PATIENCE: Duration = Duration::from_secs(400);

/// Fenced blocks of a page whose fence says exactly `kind`.
fn blocks<'a>(page: &'a str, kind: &str) -> Vec<&'a str> {
    let fence = format!("\n```{kind}\n");
    page.split(&fence).skip(1).filter_map(|rest| rest.split("\n```").next()).collect()
}

/// A line without its figures: each number becomes `#`.
fn without_figures(line: &str) -> String {
    let mut kept = String::new();
    let mut chars = line.trim().chars().peekable();
    while let Some(c) = chars.next() {
        let begins = c.is_ascii_digit() || c == '-' && chars.peek().is_some_and(char::is_ascii_digit);
        if !begins {
            kept.push(c);
            continue;
        }
        kept.push('#');
        while chars.next_if(|c| c.is_ascii_digit() || *c == '.').is_some() {}
    }
    kept
}

/// Runs a script in a process group of its own, presses Enter whenever something waits for it, and gives all that was
/// printed. A script that goes on for too long is ended with all that it has started.
fn told_by(script: &Path, folder: &RunFolder) -> (bool, String) {
    use std::os::unix::process::CommandExt;
    let [programs, _] = ["dpm", "hil-mock"].map(|name| program(name).parent().unwrap().to_owned());
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap_or_default());
    let told = folder.path().join("told.txt");
    let log = std::fs::File::create(&told).unwrap();
    let mut child = folder
        .command("bash")
        .arg("-c")
        .arg("yes '' | bash -eu \"$0\"")
        .arg(script)
        .env("PATH", path)
        .env("RIGS", Path::new(env!("CARGO_MANIFEST_DIR")).join("../rigs").canonicalize().unwrap())
        // Tests share the machine with others; a projector that hears nothing for 50 ms goes dark.
        .env("DPM_SET_SAFETY__WATCHDOG_MS", "5000")
        .stdin(Stdio::null())
        .stdout(log.try_clone().unwrap())
        .stderr(log)
        .process_group(0)
        .spawn()
        .unwrap();
    let begin = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status.success();
        }
        if begin.elapsed() > PATIENCE {
            break false;
        }
        std::thread::sleep(Duration::from_millis(50));
    };
    // Whatever a script that failed has left in the background.
    let _ = Command::new("kill")
        .args(["-KILL", "--", &format!("-{}", child.id())])
        .stderr(Stdio::null())
        .status();
    let _ = child.wait();
    (status, std::fs::read_to_string(told).unwrap_or_default())
}

#[test]
fn the_tutorial_does_what_it_says() {
    let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/TUTORIAL.md")).unwrap();
    let commands = blocks(&page, "sh");
    let promised: Vec<&str> = blocks(&page, "text").into_iter().flat_map(str::lines).collect();
    assert!(commands.len() >= 10 && promised.len() >= 10, "the page was not understood");
    let folder = RunFolder::new("tutorial");
    let script = folder.path().join("tutorial.sh");
    std::fs::write(&script, commands.join("\n") + "\n").unwrap();
    let (done, told) = told_by(&script, &folder);
    assert!(done, "a command failed:\n{told}");
    let mut lines = told.lines().map(without_figures);
    for line in promised {
        // In the order of the page.
        let wanted = without_figures(line);
        assert!(
            lines.any(|line| line.contains(&wanted)),
            "the page promises \"{line}\", but what came was:\n{told}"
        );
    }
    let calibration = dpm_calibration::file::load(&folder.path().join("first-rig/calibration.toml"));
    let projector = calibration.unwrap_or_else(|e| panic!("{e}")).projector.expect("measured");
    for focal in projector.focal {
        assert!((focal - 450.0).abs() < 5.0, "{focal}");
    }
}

#[test]
fn blocks_are_told_apart_and_figures_are_left_out() {
    let page = "a\n```sh\nb\nc\n```\n```sh install\nd\n```\n\n```text\ne\n```\n";
    assert_eq!((blocks(page, "sh"), blocks(page, "text")), (vec!["b\nc"], vec!["e"]));
    assert_eq!(without_figures(" at (1.5, -2) x-y, 30 %"), "at (#, #) x-y, # %");
}
