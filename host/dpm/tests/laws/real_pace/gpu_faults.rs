//! The program `dpm` on a GPU that fails: it ends with a clear message, the projector is dark, and nothing hangs.
//!
//! Found in use, R12 and R18.

use crate::cli_common::{code, command_after, dpm, err, out, TestFolder};
use std::process::Output;
use std::time::{Duration, Instant};
use vulkan_faults::FaultLayer;

const SMALL: [&str; 7] = ["demo", "--json", "--raster", "48x32", "--set", "output.images=false", "--out"];
/// A bound for runs that must end; it includes starting software Vulkan and translating shaders on a busy machine.
const LIMIT: Duration = Duration::from_secs(90);

/// Runs the demo for this many frames at virtual pace on a GPU that fails as given.
fn demo(layer: &FaultLayer, plan: &str, folder: &TestFolder, frames: &str) -> Output {
    let args = [&SMALL[..], &[folder.text(), "--frames", frames]].concat();
    let mut variables = layer.variables(plan);
    variables.push(("DPM_VALIDATION".into(), "1".into()));
    let variables: Vec<_> = variables.iter().map(|(n, v)| (n.as_str(), v.as_str())).collect();
    let begin = Instant::now();
    let output = dpm(&args, &variables);
    assert!(begin.elapsed() < LIMIT, "{plan}: {:?}", begin.elapsed());
    assert!(!err(&output).contains("panicked"), "{plan}: {}", err(&output));
    output
}

/// The last line of its output: the error.
fn error(output: &Output) -> String {
    err(output).lines().filter(|l| l.starts_with("error:")).collect()
}

fn light_hash(output: &Output) -> String {
    let json: serde_json::Value = serde_json::from_str(&out(output)).expect("one JSON object");
    json["light_hash"].as_str().expect("a hash").to_owned()
}

/// A GPU that is lost again and again, and so is each one that is opened instead.
#[test]
fn a_gpu_that_is_lost_for_good_ends_the_run_clearly_and_nothing_more_is_submitted() {
    let (layer, folder) = (FaultLayer::new("lost").unwrap(), TestFolder::new("gpu-lost"));
    for plan in ["lost@frame=3..", "lost@wait=60.."] {
        let output = demo(&layer, plan, &folder, "40");
        assert_eq!(code(&output), 4, "{plan}: {}", err(&output));
        let text = error(&output);
        assert!(text.contains("lost") && text.contains("dmesg"), "{plan}: {text}");
        let events = layer.events();
        assert!(events.iter().any(|e| e.what == "lost"), "the plan struck: {events:?}");
        // One thread waits for frames and another one submits them, and a submission that has begun cannot be
        // revoked.
        let count = |what: &dyn Fn(&vulkan_faults::Event) -> bool| events.iter().filter(|e| what(e)).count();
        let late = count(&|e| e.call == "submit-after-loss");
        assert!(late <= count(&|e| e.what == "lost"), "{plan}: {events:?}");
    }
}

#[test]
fn a_gpu_that_hangs_ends_the_run_clearly() {
    let (layer, folder) = (FaultLayer::new("hang").unwrap(), TestFolder::new("gpu-hang"));
    let output = demo(&layer, "submit-hang@frame=3..", &folder, "40");
    assert_eq!(code(&output), 4, "{}", err(&output));
    assert!(error(&output).contains("did not finish"), "{}", err(&output));
}

#[test]
fn a_late_gpu_changes_no_light() {
    let (layer, folder) = (FaultLayer::new("late").unwrap(), TestFolder::new("gpu-late"));
    let hash = |plan: &str| {
        let output = demo(&layer, plan, &folder, "6");
        assert_eq!(code(&output), 0, "{plan}: {}", err(&output));
        light_hash(&output)
    };
    let wanted = hash("");
    assert!(layer.events().is_empty());
    assert_eq!(hash("late@frame=2..,ms=50; submit-block@frame=4,ms=300"), wanted);
    assert!(layer.events().iter().any(|e| e.what == "late"));
}

/// One of each kind of call that a start makes. (`tests/vulkan-faults/tests/laws/failing_calls.rs` has every single call.)
#[test]
fn a_start_that_finds_no_memory_or_no_device_is_refused_clearly() {
    let (layer, folder) = (FaultLayer::new("start").unwrap(), TestFolder::new("gpu-start"));
    for (plan, word) in [
        ("oom-host@instance=1", "out of main memory"),
        ("init-failed@device=1..", "opening the Vulkan device"),
        ("oom-device@device=1..", "out of GPU memory"),
        ("oom-device@memory=5..", "MiB"),
        ("oom-host@buffer=9", "out of main memory"),
        ("oom-device@pipeline=2", "compiling a compute pipeline"),
        ("oom-host@submit=1", "out of main memory"),
        ("lost@submit=4..", "was lost"),
    ] {
        let output = demo(&layer, plan, &folder, "4");
        assert!([2, 4].contains(&code(&output)), "{plan}: {}", err(&output));
        let text = error(&output);
        assert!(text.contains(word), "{plan}: {text}");
        assert!(!text.contains("panic"), "{plan}: {text}");
        assert!(!layer.events().is_empty(), "{plan}: the plan struck nothing");
    }
}

/// Found in use, R18: software Vulkan crashed in a process with too little address space.
#[test]
fn too_little_address_space_for_software_vulkan_is_refused_before_it_crashes() {
    let folder = TestFolder::new("gpu-space");
    // Only if software Vulkan would be used.
    let plain = dpm(&[&SMALL[..], &[folder.text(), "--frames", "1"]].concat(), &[]);
    assert_eq!(code(&plain), 0, "{}", err(&plain));
    let report: serde_json::Value = serde_json::from_str(&out(&plain)).expect("one JSON object");
    if report["software_gpu"] != true {
        return eprintln!("a hardware GPU is used here: nothing to be seen");
    }
    for limit_kb in [600_000, 700_000, 800_000, 900_000] {
        let args = [&SMALL[..], &[folder.text(), "--frames", "1"]].concat();
        let mut limited = command_after(&format!("ulimit -v {limit_kb}"), &args);
        let output = limited.output().expect("a shell starts");
        assert_eq!(output.status.code(), Some(4), "{limit_kb} kB: {:?} {}", output.status, err(&output));
        let text = error(&output);
        assert!(text.contains("address space") && text.contains("ulimit -v"), "{limit_kb} kB: {text}");
    }
}
