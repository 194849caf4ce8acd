//! Holds SECURITY.md to the sources: every socket that listens, every decoder of bytes from outside and everything that runs
//! other code has its row; and the unit of the service to what it may reach.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

/// The most points of exposure that `systemd-analyze security` may give the unit.
const MOST_EXPOSURE: f64 = 2.5;

/// Folders of the programs that users run.
const PRODUCT: [&str; 3] = ["device/src", "hil-mock/src", "host"];

/// Packages by others that decode no bytes from outside. A new package is named here, or as a reader in SECURITY.md.
const NO_READERS: [&str; 28] = [
    "ash",
    "bytemuck",
    "clap",
    "clap_complete",
    "clap_mangen",
    "color_quant",
    "crossbeam",
    "getrandom",
    // They write films here, and read none.
    "gif",
    "glam",
    "half",
    "hdrhistogram",
    "hmac",
    "indicatif",
    "libc",
    // What it loads is under "What runs other code".
    "libloading",
    "libm",
    "loom",
    "obvhs",
    "plotters",
    "png",
    // It writes films here, and reads none.
    "rav1e",
    "rdst",
    "sha2",
    "thiserror",
    "tracing",
    "unicode-normalization",
    // A part of this workspace, as those that begin with "dpm-": their decoders have fuzz targets.
    "hil-mock",
];

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|e| panic!("{path}: {e}"))
}

/// Every word in backticks in the tables of a section of SECURITY.md.
fn rows(section: &str) -> BTreeSet<String> {
    let text = read("SECURITY.md");
    let begin = text.find(&format!("## {section}\n")).unwrap_or_else(|| panic!("no section {section}"));
    let of_section = text[begin + 3..].split("\n## ").next().unwrap_or_default();
    let table = of_section.lines().filter(|line| line.starts_with('|'));
    table.flat_map(|line| line.split('`').skip(1).step_by(2)).map(str::to_owned).collect()
}

/// The code of a file without its comments and without the module of tests at its end.
fn code(text: &str) -> String {
    let end = text.find("mod tests {").unwrap_or(text.len());
    let is_code = |line: &&str| !line.trim_start().starts_with("//");
    text[..end].lines().filter(is_code).collect::<Vec<_>>().join("\n")
}

/// The files of the product whose code has one of `marks`, as paths from the root.
fn files_with(marks: &[&str]) -> BTreeSet<String> {
    fn walk(folder: &Path, marks: &[&str], found: &mut BTreeSet<String>) {
        for entry in std::fs::read_dir(folder).unwrap_or_else(|e| panic!("{}: {e}", folder.display())) {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            if path.is_dir() {
                if !["tests", "examples", "target"].contains(&name.as_str()) {
                    walk(&path, marks, found);
                }
            } else if name.ends_with(".rs") && !name.ends_with("tests.rs") {
                let text = code(&std::fs::read_to_string(&path).unwrap());
                if marks.iter().any(|mark| text.contains(mark)) {
                    let below = path.strip_prefix(root()).expect("below the root");
                    found.insert(below.to_string_lossy().into_owned());
                }
            }
        }
    }
    let mut found = BTreeSet::new();
    PRODUCT.iter().for_each(|folder| walk(&root().join(folder), marks, &mut found));
    found
}

/// Found in use, R11: SECURITY.md was a round behind, and said that nothing else listens.
#[test]
fn every_socket_that_listens_has_its_row() {
    let marks = [
        "Listener::bind(",
        "UdpSocket::bind(",
        "UdpPort::bind(",
        "UnixDatagram::bind(",
        "UnixDatagram::bind_addr(",
        "libc::bind(",
        "net::bind(",
    ];
    let (opened, rows) = (files_with(&marks), rows("What listens"));
    assert!(opened.len() >= 7 && opened.contains("host/page/src/server.rs"), "{opened:?}");
    let missing: Vec<_> = opened.difference(&rows).collect();
    assert!(missing.is_empty(), "SECURITY.md, \"What listens\", has no row for {missing:?}");
    let gone: Vec<_> = rows.iter().filter(|row| row.ends_with(".rs") && !opened.contains(*row)).collect();
    // These are where the socket of another row is used.
    let known = ["device/src/tracker/natnet/client.rs", "host/mock/src/vrpn_host.rs"];
    assert!(gone.iter().all(|row| known.contains(&row.as_str())), "{gone:?} open no socket");
}

/// Whoever adds a decoder adds a fuzz target (CONTRIBUTING.md), and with it a row.
#[test]
fn every_fuzz_target_has_its_row() {
    let listed = read("fuzz/Cargo.toml");
    let names = listed.split("[[bin]]").skip(1).filter_map(|bin| bin.split('"').nth(1));
    let targets: BTreeSet<String> = names.map(str::to_owned).collect();
    assert!(targets.len() > 30, "{targets:?}");
    let missing: Vec<_> = targets.difference(&rows("What is read")).cloned().collect();
    assert!(missing.is_empty(), "SECURITY.md, \"What is read\", has no row for {missing:?}");
    let run = read("fuzz/run");
    let idle: Vec<_> = targets.iter().filter(|name| !run.contains(&format!("    (\"{name}\", \""))).collect();
    assert!(idle.is_empty(), "fuzz/run does not run {idle:?}");
}

/// The packages by others that the crates of the product name as dependencies.
fn packages() -> BTreeSet<String> {
    let mut all = BTreeSet::new();
    let host = std::fs::read_dir(root().join("host")).unwrap().map(|e| e.unwrap().path());
    for folder in host.chain(["device", "hil-mock"].map(|name| root().join(name))) {
        let manifest = std::fs::read_to_string(folder.join("Cargo.toml")).unwrap();
        let mut is_dependency = false;
        for line in manifest.lines() {
            if line.starts_with('[') {
                is_dependency = line.ends_with("dependencies]") && !line.contains("dev-");
            } else if is_dependency && !line.starts_with('#') {
                let end = line.find(['.', ' ', '=']).unwrap_or(line.len());
                all.insert(line[..end].to_owned());
            }
        }
    }
    all.remove("");
    all
}

#[test]
fn every_package_that_decodes_bytes_from_outside_has_its_row() {
    let (packages, rows) = (packages(), rows("What is read"));
    assert!(packages.contains("draco-gltf") && packages.contains("hyper"), "{packages:?}");
    let is_ours = |name: &str| name.starts_with("dpm-") || NO_READERS.contains(&name);
    let missing: Vec<_> = packages.iter().filter(|name| !is_ours(name) && !rows.contains(*name)).collect();
    assert!(
        missing.is_empty(),
        "name {missing:?} in SECURITY.md, \"What is read\", or as packages that read nothing in this test"
    );
}

#[test]
fn everything_that_runs_other_code_has_its_row() {
    let (found, rows) = (files_with(&["Command::new(", "Library::new("]), rows("What runs other code"));
    assert!(found.contains("host/alp/src/library.rs"), "{found:?}");
    let missing: Vec<_> = found.difference(&rows).collect();
    assert!(missing.is_empty(), "SECURITY.md, \"What runs other code\", has no row for {missing:?}");
}

/// Found in use, R12: the unit had 8.5 points of exposure.
#[test]
fn the_service_reaches_little_beyond_what_light_needs() {
    let unit = read("packaging/dpm.service");
    let has = |line: &str| unit.lines().any(|found| found == line);
    // Without these no light: real-time scheduling, drivers that compile, and what the rig is plugged into.
    for line in
        ["RestrictRealtime=no", "MemoryDenyWriteExecute=no", "LimitRTPRIO=80", "DeviceAllow=char-drm rw"]
    {
        assert!(has(line), "{line}");
    }
    for key in ["MemoryMax=", "TasksMax="] {
        assert!(unit.lines().any(|line| line.starts_with(key)), "{key}");
    }
    let path = root().join("packaging/dpm.service");
    let args = ["security", "--offline=true", "--no-pager"];
    let output = match Command::new("systemd-analyze").args(args).arg(&path).env("LC_ALL", "C").output() {
        Ok(output) if output.status.success() || !output.stdout.is_empty() => output,
        _ => {
            eprintln!("systemd-analyze is not there or too old: the exposure of the unit is not measured");
            return;
        }
    };
    let told = String::from_utf8_lossy(&output.stdout).into_owned();
    let line = told.lines().find(|line| line.contains("Overall exposure level"));
    let line = line.unwrap_or_else(|| panic!("{told}{}", String::from_utf8_lossy(&output.stderr)));
    let points = line.split(": ").nth(1).and_then(|rest| rest.split(' ').next()?.parse::<f64>().ok());
    assert!(points.is_some_and(|points| points <= MOST_EXPOSURE), "{line}");
}
