//! `dpm profile` from the user's point of view: without a GPU at the true rate, its files, and the comparison of two
//! profiles.

use crate::cli_common::{code, dpm, err, out, start, start_with, TestFolder, NO_DRIVER};
use crate::trace_check;
use std::time::Duration;

/// One second at the full rate and raster, without any Vulkan driver. Lateness depends on the machine here, because
/// other tests run at the same time. On any machine everything must be accounted for, and no frame may be torn, shown
/// twice or out of order.
#[test]
fn without_rendering_every_slot_is_accounted_for_and_no_frame_is_torn() {
    let folder = TestFolder::new("profile");
    let args = ["profile", "--no-render", "--seconds", "1", "--json", "--out", folder.text()];
    let output = dpm(&args, &NO_DRIVER);
    assert_eq!(code(&output), 0, "{}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    for key in
        ["frames_lit", "frames_dropped", "frames_late", "raster", "frame_rate_hz", "pace", "gpu", "wall_s"]
    {
        assert!(!json[key].is_null(), "{key} in {json}");
    }
    assert_eq!((&json["raster"], &json["planes"]), (&serde_json::json!([1024, 768]), &24.into()));
    assert_eq!(
        (&json["pace"], &json["gpu"], &json["method"]),
        (&"real".into(), &"none".into(), &"prepared".into())
    );
    assert_eq!((&json["frames_torn"], &json["frames_reordered"]), (&0.into(), &0.into()));
    let count = |v: &serde_json::Value| v.as_u64().unwrap_or_else(|| panic!("a count: {v}"));
    let (lit, slots) = (count(&json["frames_lit"]), count(&json["slots"]));
    assert!(lit > 0 && lit + count(&json["frames_dropped"]) <= 947, "{lit} lit in a second: {json}");
    assert!(slots <= 947, "{slots} slots in a second");
    // The raw number is every slot without a frame of its own. The part due to the machine is not subtracted from it.
    let missed = json["missed_by_cause"].as_object().expect("misses by cause");
    let all: u64 = missed.values().map(count).sum();
    assert_eq!(count(&json["missed_slots"]), all);
    assert_eq!(count(&json["excused_by_standstill"]), count(&missed["standstill"]));
    let share = json["missed_share"].as_f64().expect("a share");
    assert!((share - all as f64 / slots as f64).abs() < 1e-12);
    for key in ["slots", "missed_slots", "missed_share", "excused_by_standstill", "ordered_dark"] {
        assert_eq!(json[key], json["profile"][key], "{key}");
    }
    // Every slot showed its own frame, or was missed.
    assert_eq!(lit - count(&json["frames_late"]) + all, slots, "{missed:?}");
    // The report contains the bound of the projector's clock, also for the mock.
    assert!(count(&json["projector"]["clock_bound_ns"]) > 0, "{}", json["projector"]);
    assert_eq!(json["profile"]["clock_error_bound_ns"], json["projector"]["clock_bound_ns"]);
    // Real pace measures everything except the mock tracker's interval. A mock that lights on an ideal clock has no
    // jitter.
    let interval = |name: &str| &json["profile"]["intervals_ms"][name];
    assert_eq!(json["motion_to_light_centre_ms"]["modelled"], false);
    assert_eq!(
        (&interval("tracker")["modelled"], &interval("pack")["modelled"]),
        (&true.into(), &false.into())
    );
    assert!(json["profile"]["jitter_ms"].is_null() && json["light_hash"].is_null(), "{json}");
    let p50 = |key: &str| json[key]["p50"].as_f64().unwrap_or_else(|| panic!("{key} in {json}"));
    let (first, centre, last) =
        (p50("motion_to_first_photon_ms"), p50("motion_to_light_centre_ms"), p50("motion_to_last_photon_ms"));
    assert!(
        (centre - first - 0.3181).abs() < 0.02 && (last - first - 1.056).abs() < 0.02,
        "{first} {centre} {last}"
    );
    for stage in ["plan", "pack", "link"] {
        assert!(json["stages_ms"][stage]["p999"].is_f64(), "{stage} in {json}");
        assert_eq!(json["profile"]["intervals_ms"][stage]["count"], lit, "{stage}");
    }
    for name in [
        "profile.json",
        "profile.hlog",
        "trace.json",
        "work.svg",
        "waits.svg",
        "latency.svg",
        "histogram.svg",
    ] {
        assert!(std::fs::metadata(folder.path(name)).is_ok_and(|m| m.len() > 0), "{name}");
    }
    let trace = std::fs::read_to_string(folder.path("trace.json")).expect("trace.json");
    let journeys = trace_check::check(&trace);
    trace_check::every_frame_can_be_followed(&journeys);
    assert_eq!(journeys.len() as u64, lit, "every lit frame");

    // Nothing differs from itself.
    let kept = folder.path("profile.json").display().to_string();
    let output = dpm(&["profile", "--compare", &kept, &kept], &[]);
    assert_eq!(code(&output), 0, "{}", err(&output));
    let table = out(&output);
    assert!(table.contains("motion_to_centre") && !table.contains("WORSE"), "{table}");
    assert!(table.lines().nth(1).is_some_and(|l| l.starts_with("missed slots, %")), "{table}");
}

/// Found in use (second look at latency, section 2): BLACK for 1.5 s was counted as 1478 late slots of the link, 26 %
/// of a run of 6 s.
#[test]
fn slots_of_an_operators_black_are_not_late() {
    let folder = TestFolder::new("black");
    let args =
        ["profile", "--no-render", "--seconds", "6", "--raster", "64x48", "--json", "--out", folder.text()];
    // The order applies to every rig of this state folder with such a projector, including those of other tests.
    let state = folder.path("state").display().to_string();
    let own = [("DPM_STATE_DIR", state.as_str())];
    let mut running = start_with(&args, &own);
    running.wait_for_line(Duration::from_secs(60), |line| {
        serde_json::from_str::<serde_json::Value>(line)
            .is_ok_and(|told| told["frames_lit"].as_u64() > Some(0) && told["light"] == "lit")
    });
    let id = running.id().to_string();
    assert_eq!(code(&dpm(&["black", "--pid", &id], &own)), 0);
    std::thread::sleep(Duration::from_millis(1500));
    assert_eq!(code(&dpm(&["arm", "--pid", &id], &own)), 0);
    let (status, text) = running.finish();
    assert_eq!(status.code(), Some(0), "{status}");
    let json: serde_json::Value = serde_json::from_str(&text).expect("one JSON object");
    let count = |v: &serde_json::Value| v.as_u64().unwrap_or_else(|| panic!("a count: {v}"));
    let black = count(&json["ordered_dark"]["black"]);
    assert!(black >= 1_400, "{black} slots of 1420 in 1.5 s");
    let (slots, missed) = (count(&json["slots"]), count(&json["missed_slots"]));
    // Every slot of the run is in one class: BLACK's slots are not among those in which a frame was wanted.
    let ordered: u64 = json["ordered_dark"].as_object().expect("reasons").values().map(count).sum();
    assert!((5_600..=5_682).contains(&(slots + ordered)), "{slots} and {ordered}");
    assert_eq!(count(&json["frames_lit"]) - count(&json["frames_late"]) + missed, slots);
    // If BLACK's slots were among the missed ones, there would be more than its 1400, whatever else this machine
    // does.
    assert!(missed < 1_000, "{missed} missed of {slots}: {}", json["missed_by_cause"]);
    // Not every slot has a frame on a busy machine.
    assert!(2 * count(&json["frames_withheld"]) >= black, "{} of {black}", json["frames_withheld"]);
}

/// Two stored profiles of runs that differ only in the frames that they dropped.
#[test]
fn a_comparison_in_which_more_slots_are_missed_ends_with_1() {
    let folder = TestFolder::new("gate");
    let kept = |name: &str, slots: u64, missed: u64| {
        let report = serde_json::json!({
            "slots": slots, "missed_slots": missed, "missed_share": missed as f64 / slots as f64,
            "frames_lit": slots - missed, "frames_late": 0, "setup": {}, "frame_rate_hz": 947.0, "missed": {},
            "intervals_ms": {}, "standstill_ns": [0, 0],
        });
        folder.write(name, &report.to_string())
    };
    let (before, after) = (kept("before.json", 22_728, 84), kept("after.json", 18_940, 128));
    let worse = dpm(&["profile", "--compare", &before, &after], &[]);
    assert_eq!(code(&worse), 1, "{}", out(&worse));
    assert!(err(&worse).contains("missed slots") && out(&worse).contains("WORSE (gate)"), "{}", err(&worse));
    assert_eq!(code(&dpm(&["profile", "--compare", &after, &before], &[])), 0);
}

/// Software Vulkan at 947 fps: the GPU needs ten slots or more for a frame. Every frame is then late and is shown
/// late, as fast as frames come; and each can be followed through the GPU's passes to its light.
#[test]
fn a_gpu_too_slow_for_its_slots_shows_late_frames_not_none() {
    let folder = TestFolder::new("slow");
    // Light this late falls behind any reasonable horizon; without a longer one there would be none.
    let args = ["profile", "--seconds", "2", "--raster", "64x48", "--json", "--out", folder.text()];
    let output = dpm(&[&args[..], &["--set", "safety.predict_ms=1000"]].concat(), &[]);
    assert_eq!(code(&output), 0, "{}", err(&output));
    let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
    let count = |key: &str| json[key].as_u64().unwrap_or_else(|| panic!("{key} in {json}"));
    assert!(count("frames_lit") > 0, "{json}");
    let (lit, dropped) = (count("frames_lit") + count("frames_dark"), count("frames_dropped"));
    // A run whose every frame is late is not a run without misses.
    assert!(count("missed_slots") > count("slots") / 2, "{json}");
    assert!(lit >= 3 && lit >= dropped, "{lit} lit, {dropped} not");
    assert_eq!(count("frames_reordered"), 0);
    let trace = std::fs::read_to_string(folder.path("trace.json")).expect("trace.json");
    let journeys = trace_check::check(&trace);
    trace_check::every_frame_can_be_followed(&journeys);
    assert_eq!(journeys.len() as u64, lit, "every lit frame");
    assert!(trace.contains(r#""name":"trace","cat":"gpu""#), "the GPU's passes lie in its slices");
}

/// A missing tracker leaves the rig dark, but informs the operator.
#[test]
fn bodies_that_were_never_seen_are_named_with_the_trackers_word_on_why() {
    let folder = TestFolder::new("unseen");
    let bodies = "[[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n";
    for (tracker, told) in
        [("kind = \"mock\"", false), ("kind = \"serial\"\nport = \"/dev/nonexistent\"", true)]
    {
        let rig = folder.write("rig.toml", &format!("[tracker]\n{tracker}\n{bodies}"));
        let args = ["profile", &rig, "--no-render", "--seconds", "1", "--raster", "64x48", "--json"];
        let output = dpm(&[&args[..], &["--out", folder.text()]].concat(), &NO_DRIVER);
        assert_eq!(code(&output), 0, "{}", err(&output));
        let json: serde_json::Value = serde_json::from_str(&out(&output)).expect("one JSON object");
        let warnings = json["warnings"].as_array().expect("warnings");
        let unseen = warnings.iter().filter_map(|w| w.as_str()).find(|w| w.contains("never saw"));
        assert_eq!(unseen.is_some(), told, "{tracker}: {warnings:?}");
        let text = unseen.unwrap_or_default();
        assert!(
            !told || text.contains("\"bunny\", \"venus\"") && text.contains("/dev/nonexistent"),
            "{text}"
        );
    }
}

/// A run without an end reports it after its first second, once, long before the report, and continues.
#[test]
fn a_tracker_that_does_not_speak_is_told_within_the_first_seconds_of_a_run() {
    let folder = TestFolder::new("silent");
    let bodies = "[[scene.bodies]]\nname = \"bunny\"\n[[scene.bodies]]\nname = \"venus\"\n";
    let rig = folder
        .write("rig.toml", &format!("[tracker]\nkind = \"serial\"\nport = \"/dev/nonexistent\"\n{bodies}"));
    let args = ["profile", &rig, "--no-render", "--seconds", "600", "--raster", "64x48", "--json"];
    let mut running = start(&[&args[..], &["--out", folder.text()]].concat());
    let lit = std::cell::Cell::new(0);
    running.wait_for_line(Duration::from_secs(60), |line| {
        let told: serde_json::Value = serde_json::from_str(line).expect("each line is JSON");
        lit.set(told["frames_lit"].as_u64().unwrap_or(lit.get()));
        told["note"].as_str().is_some_and(|note| {
            let of_tracker = note.contains("has not seen");
            let parts = ["serial tracker", "\"bunny\", \"venus\"", "/dev/nonexistent", "tracker.port"];
            assert!(!of_tracker || parts.iter().all(|p| note.contains(p)), "{note}");
            of_tracker
        })
    });
    // One line of counts per second: the run was at most a few seconds old, on a busy machine.
    assert!(lit.get() < 5 * 947, "{} frames were lit before it was told", lit.get());
    running.signal("TERM");
    let rest = running.rest_of_lines(Duration::from_secs(60));
    assert_eq!(rest.iter().filter(|line| line.contains("has not seen")).count(), 0, "once: {rest:?}");
}

#[test]
fn what_is_no_profile_is_refused_with_its_name() {
    let folder = TestFolder::new("noprofile");
    let text = folder.write("a.json", "{\"setup\": 3}");
    let output = dpm(&["profile", "--compare", &text, "/nonexistent/b.json"], &[]);
    assert_eq!((code(&output), out(&output).as_str()), (2, ""));
    assert!(err(&output).contains("a.json: not a profile.json of dpm profile"), "{}", err(&output));
    // Any other JSON object, for example a report, is not a profile without figures.
    let report = folder.write("report.json", "{\"frames_lit\": 3, \"slots\": 9}");
    assert_eq!(code(&dpm(&["profile", "--compare", &report, &report], &[])), 2);
    let output = dpm(&["profile", "--compare", "/nonexistent/a.json", &text], &[]);
    assert!(err(&output).contains("/nonexistent/a.json: cannot read it: No such file"), "{}", err(&output));
    let output = dpm(&["profile", "--no-render", "--page=nowhere", "--out", folder.text()], &NO_DRIVER);
    assert_eq!(code(&output), 2);
    assert!(err(&output).contains("page.listen"), "{}", err(&output));
}
