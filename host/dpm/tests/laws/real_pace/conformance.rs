//! Checks `dpm link-test --conformance`: a device written from docs/PROTOCOL.md alone keeps every rule; the same
//! device made to break a rule is reported for exactly that rule; and the mock projector keeps them all.

use crate::cli_common::{code, dpm, err, out, own_folder};
use crate::peer::PeerLine;
use dpm_device::link::packet_bytes;
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_device::transport::serial::{SerialSettings, SerialTransport};
use dpm_lab::conformance::{judge, rules, Extent, Judgement, Medium, MediumKind, RuleVerdict};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

/// Rules that a serial line or this device cannot show, and why they need no planted fault.
const NOT_ON_SERIAL: [&str; 1] = ["lanes"];

fn judged(path: &str, raster: Raster, only: &[String]) -> Judgement {
    let start = Instant::now();
    let clock = move || HostTime(start.elapsed().as_nanos() as i64);
    let frame_bytes = packet_bytes(raster.plane_bytes()) * 8 + 200;
    let settings = SerialSettings { path: path.to_owned(), baud: 3_000_000, frame_bytes };
    let mut transport = SerialTransport::open(settings).expect("the pseudo-terminal");
    let medium = Medium {
        transport: &mut transport,
        kind: MediumKind::Serial,
        bytes_per_s: Some(300_000),
        clock: &clock,
        stop: &|| false,
    };
    judge(medium, Extent { only, flashes: true })
}

fn of_peer(fault: &str, only: &[String]) -> Judgement {
    let served = PeerLine::new(fault);
    judged(&served.path, Raster::new(40, 30).unwrap(), only)
}

/// It was written before sections 15 and 16 of the document, and offers nothing of them: it stands for such firmware.
const LATER: [&str; 8] = [
    "timing-unasked",
    "timing-slack",
    "timing-late",
    "timing-transfer",
    "shift-unasked",
    "shift-slot",
    "shift-far",
    "shift-dark",
];

#[test]
fn a_device_written_from_the_document_keeps_every_rule() {
    let judgement = of_peer("", &[]);
    println!("{}", judgement.to_table());
    assert!(judgement.passes(), "{}", judgement.to_table());
    assert_eq!(judgement.lines.len(), rules().count());
    let not_judged: Vec<&str> = judgement
        .lines
        .iter()
        .filter(|l| matches!(l.verdict, RuleVerdict::NotJudged(_)))
        .map(|l| l.rule)
        .filter(|rule| !LATER.contains(rule))
        .collect();
    // It reads every codec; that rule has its own device below.
    assert_eq!(not_judged, ["lanes", "codec-unnamed"], "{}", judgement.to_table());
    let other = of_peer("without-lz4", &["codec-unnamed".to_owned()]);
    assert_eq!(other.lines[0].verdict, RuleVerdict::Ok, "{}", other.to_table());
}

/// One device per rule, which breaks it: the check detects each. Several run at a time, because they mostly wait.
#[test]
fn a_device_that_breaks_a_rule_fails_it() {
    let all: Vec<&str> =
        rules().map(|r| r.id).filter(|id| !NOT_ON_SERIAL.contains(id) && !LATER.contains(id)).collect();
    let next = AtomicUsize::new(0);
    let judge_next = || {
        let mut unnoticed = Vec::new();
        while let Some(rule) = all.get(next.fetch_add(1, Ordering::Relaxed)) {
            let judgement = of_peer(rule, &[(*rule).to_owned()]);
            match judgement.lines.first().map(|l| &l.verdict) {
                Some(RuleVerdict::Failed(_)) => {}
                other => unnoticed.push(format!("{rule}: {other:?} {:?}", judgement.ended)),
            }
        }
        unnoticed
    };
    let unnoticed: Vec<String> = std::thread::scope(|scope| {
        let judges: Vec<_> = (0..6).map(|_| scope.spawn(judge_next)).collect();
        judges.into_iter().flat_map(|j| j.join().expect("no panic")).collect()
    });
    assert!(unnoticed.is_empty(), "faults that went unnoticed:\n{}", unnoticed.join("\n"));
}

/// Nothing ends a transfer to a device in this process, and it has no plug. It reads every codec, and nobody may be flashed at
/// unasked.
#[test]
fn the_mock_projector_keeps_every_rule() {
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/demo.toml");
    let folder = format!("output.dir={:?}", own_folder("mock-conformance"));
    let output = dpm(&["link-test", rig, "--conformance", "--json", "--set", &folder], &[]);
    assert_eq!(code(&output), 0, "{}{}", out(&output), err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one object");
    let lines = json["lines"].as_array().expect("lines");
    assert_eq!(lines.len(), rules().count());
    let not_judged: Vec<&str> = lines
        .iter()
        .filter(|line| line["verdict"] == "not_judged")
        .map(|line| line["rule"].as_str().unwrap_or(""))
        .collect();
    assert_eq!(not_judged, ["codec-unnamed", "cut-short", "flashes", "replug"], "{json:#}");
}

#[test]
fn every_rule_has_a_name_of_its_own_and_a_section_of_the_document() {
    let text = include_str!("../../../../../docs/PROTOCOL.md");
    let mut seen = Vec::new();
    for rule in rules() {
        assert!(!seen.contains(&rule.id), "{} stands twice", rule.id);
        seen.push(rule.id);
        assert!(text.contains(&format!("\n## {}. ", rule.section)), "{}: section {}", rule.id, rule.section);
    }
    let output = dpm(&["link-test", "--list-rules"], &[]);
    assert!(output.status.success());
    let listed = String::from_utf8_lossy(&output.stdout);
    let listed: Vec<&str> = listed.lines().filter_map(|line| line.split(' ').next()).collect();
    assert_eq!(listed, seen);
}

/// Found in use, as a new user: "no conformance run against my device". The program checks a device on a serial line,
/// and its exit code is the result.
#[test]
fn the_program_prints_a_line_a_rule_and_its_exit_code_is_the_judgement() {
    let rig = concat!(env!("CARGO_MANIFEST_DIR"), "/../../rigs/demo.toml");
    for (fault, expected) in [("", 0), ("black", 1)] {
        let served = PeerLine::new(fault);
        let backend = format!("projector.backend={{kind=\"serial\", port={:?}, baud=3000000}}", served.path);
        let mut args = vec!["link-test", rig, "--conformance", "--rule", "echo", "--rule", "black", "--json"];
        let sets = [
            "projector.width=40",
            "projector.height=30",
            "projector.planes=8",
            "projector.frame_rate=100",
            "real_time.pace=\"real\"",
        ];
        for set in sets.iter().copied().chain([backend.as_str()]) {
            args.extend(["--set", set]);
        }
        let output = dpm(&args, &[]);
        assert_eq!(code(&output), expected, "{fault}: {}{}", out(&output), err(&output));
        let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one object");
        let verdicts: Vec<(&str, &str)> = json["lines"]
            .as_array()
            .expect("lines")
            .iter()
            .map(|l| (l["rule"].as_str().unwrap_or(""), l["verdict"].as_str().unwrap_or("")))
            .collect();
        let black = if expected == 0 { "ok" } else { "failed" };
        assert_eq!(verdicts, [("black", black), ("echo", "ok")], "{json}");
        assert_eq!(json["device"]["raster"], serde_json::json!([40, 30]), "{json}");
    }
    let unknown = dpm(&["link-test", rig, "--conformance", "--rule", "nonsense"], &[]);
    assert_eq!(code(&unknown), 2);
    assert!(err(&unknown).contains("watchdog-fed"), "names the rules that there are: {}", err(&unknown));
}
