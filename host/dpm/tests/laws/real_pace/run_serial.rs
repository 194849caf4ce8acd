//! `dpm run` on a projector behind a real serial line (a pseudo-terminal): light, reports, orders, faults,
//! unplugging, the dark at the end.

use crate::cli_common::{code, dpm, err, TestFolder};
use crate::link_common::{raster, rig, served_time, start, Projector, PtyProjector};
use dpm_device::link::{faults, DeviceState};
use dpm_rig::order::Order;
use dpm_rig::pipeline::PipelineError;
use dpm_rig::telemetry::monitor::ProjectorHealth;
use hil_mock::projector::MockConfig;
use std::time::Duration;

const LONG: Duration = Duration::from_secs(20);

/// Frames of a whole run: 1.2 s of them. A longer one is more often stopped by the watchdog on a machine that stands still.
const FRAMES: u64 = 120;

fn projector(name: &str) -> PtyProjector {
    PtyProjector::new(name, MockConfig::new(raster()))
}

#[test]
fn a_run_lights_whole_frames_reports_what_the_projector_said_and_ends_dark() {
    for compaction in ["raw", "auto"] {
        let far = projector(&format!("light-{compaction}"));
        let rig = rig(&far.backend(&format!(", compaction = \"{compaction}\"")), &[]);
        let run = start(&rig, FRAMES);
        run.until("most frames planned", |monitor| {
            far.check_whole();
            monitor.counts().frames_planned >= FRAMES - 10
        });
        let monitor = run.monitor.clone();
        let report = run.end().unwrap_or_else(|e| panic!("{e}")).report;
        assert!(!far.is_lit());
        let s = far.status();
        assert_eq!(s.state, DeviceState::Configured, "disarmed");
        assert_eq!((s.payload_errors, s.header_errors, s.frames_incomplete), (0, 0, 0));
        // The report contains what the projector counted.
        let p = report.projector.as_ref().expect("the link was used");
        let d = p.device.expect("an outside projector reports");
        assert_eq!(d.lit, u64::from(s.frames_lit));
        // A report that was merged into a later one may be missing from what the run counts.
        assert!((d.lit - d.lit_unseen..=d.lit).contains(&report.frames_lit), "{} {d:?}", report.frames_lit);
        assert_eq!(report.frames_lit + report.frames_dropped, FRAMES);
        assert_eq!(monitor.counts().frames_lit, report.frames_lit);
        // A machine that stands still, and tests beside this one, cost frames.
        assert!(report.frames_lit > FRAMES / 4, "{report:?}");
        assert_eq!(s.slots, s.frames_lit + s.slots_repeated + s.slots_blank, "{s:?}");
        // The projector was seen later than by the run: slots pass in the dark, too.
        let told = d.lit + d.repeated + d.blank;
        assert!(u64::from(s.slots) >= told && u64::from(s.slots_repeated) == d.repeated, "{d:?} {s:?}");
        assert_eq!(p.sessions, 1);
        // Nothing observed the light: there is no hash of it, and no cost of a mock.
        let json: serde_json::Value = serde_json::from_str(&report.to_json()).unwrap();
        assert!(json.get("light_hash").is_none(), "{json}");
        assert!(json["stages_ms"].get("light").is_none(), "{json}");
        assert!(json["motion_to_light_ms"]["p50"].as_f64() > Some(0.0), "{json}");
        let coded = p.planes[1] + p.planes[2];
        assert_eq!(coded > 0, compaction == "auto", "{p:?}");
    }
}

#[test]
fn an_unplugged_projector_is_taken_up_again_dark_first() {
    let far = projector("replug");
    let run = start(&rig(&far.backend(""), &[]), 0);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 10);
    far.unplug();
    let noticed = served_time("noticed", || run.monitor.projector() == ProjectorHealth::Lost);
    assert!(noticed < Duration::from_millis(100), "U1: {noticed:?}");
    let planned = run.monitor.counts().frames_planned;
    std::thread::sleep(Duration::from_millis(200));
    assert!(run.monitor.counts().frames_planned > planned + 5, "frames are made meanwhile");
    far.plug_in();
    let back = served_time("a new session", || {
        let s = far.status();
        s.frames_lit < 10 && s.state == DeviceState::Armed
    });
    assert!(back < Duration::from_secs(1), "U1: {back:?}");
    // The last reports before the plug was pulled never arrived.
    far.until(LONG, "light again", &mut |s| s.frames_lit >= 15);
    far.check_whole();
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    assert!(!far.is_lit());
    let p = report.projector.expect("the link was used");
    assert_eq!(p.sessions, 2);
    // The light of both sessions is in the report.
    assert!(p.device.expect("reports").lit >= 20, "{p:?}");
    assert!(report.frames_dropped > 5, "what was made while it was away");
}

#[test]
fn orders_act_on_a_running_rig_until_they_are_taken_back() {
    let far = projector("orders");
    let run = start(&rig(&far.backend(""), &[]), 0);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 5);
    let obeyed = |order: Order, state: DeviceState| {
        run.monitor.give_order(order);
        far.until(LONG, order.word(), &mut |s| s.state == state)
    };
    obeyed(Order::Black, DeviceState::Black);
    assert!(!far.is_lit());
    let lit = far.status().frames_lit;
    // This holds over many frames, and over an unplugging.
    std::thread::sleep(Duration::from_millis(150));
    assert_eq!((far.status().frames_lit, far.is_lit()), (lit, false));
    assert_eq!(run.monitor.projector(), ProjectorHealth::Black);
    far.unplug();
    std::thread::sleep(Duration::from_millis(150));
    far.plug_in();
    far.until(LONG, "configured", &mut |s| s.state == DeviceState::Configured);
    std::thread::sleep(Duration::from_millis(150));
    assert_eq!((far.status().state, far.is_lit()), (DeviceState::Configured, false), "black is black");
    obeyed(Order::Arm, DeviceState::Armed);
    far.until(LONG, "light again", &mut |s| s.frames_lit >= 5);
    obeyed(Order::Freeze, DeviceState::Frozen);
    let (lit, repeated) = (far.status().frames_lit, far.status().slots_repeated);
    far.until(LONG, "a held frame", &mut |s| s.slots_repeated >= repeated + 5);
    assert_eq!((far.status().frames_lit, far.is_lit()), (lit, true));
    obeyed(Order::Safe, DeviceState::Faulted);
    assert!(!far.is_lit());
    assert_eq!(far.status().faults, faults::HOST_SAFE);
    std::thread::sleep(Duration::from_millis(150));
    assert_eq!(far.status().state, DeviceState::Faulted, "latched until armed");
    obeyed(Order::Arm, DeviceState::Armed);
    let lit = far.status().frames_lit;
    far.until(LONG, "light again", &mut |s| s.frames_lit >= lit + 5);
    run.stop().unwrap_or_else(|e| panic!("{e}"));
    assert!(!far.is_lit());
}

#[test]
fn faults_of_a_host_pass_and_those_of_a_projector_wait_for_the_operator() {
    let far = projector("faults");
    let plain = rig(&far.backend(""), &[]);
    let latch = |fault: u32| {
        far.look(&mut |m| {
            let now = dpm_device::time::HostTime(i64::MIN);
            m.set_faults(now, fault);
            // The cause is gone, but the fault stays latched.
            m.set_faults(now, 0);
        });
    };
    // An earlier host was killed.
    latch(faults::WATCHDOG);
    let run = start(&plain, 0);
    far.until(LONG, "light in spite of the last run's watchdog", &mut |s| s.frames_lit >= 5);
    // Now this host falls silent for a moment, as seen by the projector.
    latch(faults::WATCHDOG);
    let lit = far.status().frames_lit;
    far.until(LONG, "light after the watchdog", &mut |s| s.frames_lit >= lit + 5);
    latch(faults::OVER_TEMPERATURE);
    far.until(LONG, "dark", &mut |s| !s.lit);
    let health = ProjectorHealth::Faulted(faults::OVER_TEMPERATURE);
    run.until("dark, called hot", |monitor| monitor.projector() == health);
    std::thread::sleep(Duration::from_millis(150));
    assert_eq!(far.status().state, DeviceState::Faulted, "heat waits for the operator");
    run.monitor.give_order(Order::Arm);
    let lit = far.status().frames_lit;
    far.until(LONG, "light after the operator's word", &mut |s| s.frames_lit >= lit + 5);
    let report = run.stop().unwrap_or_else(|e| panic!("{e}")).report;
    assert_eq!(report.projector.expect("a link").rearmed, 1);
    // A run does not start on a projector that was hot, unless the rig file acknowledges it.
    latch(faults::OVER_TEMPERATURE);
    let refused = start(&plain, 10).end().err().expect("refused").to_string();
    assert!(refused.contains("latched faults: over-temperature"), "{refused}");
    assert!(!far.is_lit());
    let told = rig(&far.backend(""), &["safety.acknowledge_faults=true"]);
    let run = start(&told, 0);
    far.until(LONG, "light, acknowledged", &mut |s| s.frames_lit >= 5);
    run.stop().unwrap_or_else(|e| panic!("{e}"));
}

#[test]
fn another_panel_in_its_place_ends_the_run_with_both_sizes() {
    let far = projector("other");
    let run = start(&rig(&far.backend(""), &[]), 0);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 5);
    far.unplug();
    far.exchange(MockConfig::new(dpm_device::planes::Raster::new(32, 32).unwrap()));
    far.plug_in();
    let error = run.end().err().expect("the run ends");
    assert!(matches!(error, PipelineError::Connect(_)), "{error}");
    assert!(error.to_string().contains("32x32 mirrors, the rig is configured for 64x32"), "{error}");
}

#[test]
fn an_absent_a_taken_and_a_silent_port_are_told_apart() {
    let told = |backend: &str| {
        let error = start(&rig(backend, &[]), 5).end().err().expect("no run without a projector");
        assert!(matches!(error, PipelineError::Connect(_)), "{error}");
        error.to_string()
    };
    let absent = told(r#"{ kind = "serial", port = "/dev/dpm-no-such-port" }"#);
    assert!(absent.contains("/dev/dpm-no-such-port: not found"), "{absent}");
    let far = projector("taken");
    let run = start(&rig(&far.backend(""), &[]), 0);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 5);
    let taken = told(&far.backend(""));
    assert!(taken.contains("in use by another program"), "{taken}");
    run.stop().unwrap_or_else(|e| panic!("{e}"));
    // A line without a device.
    let (line, silent, _held) = hil_mock::serial_server::pseudo_terminal().unwrap();
    let quiet = told(&format!("{{ kind = \"serial\", port = {silent:?} }}"));
    assert!(quiet.contains("is switched on") && quiet.contains("the cable"), "{quiet}");
    drop(line);
}

/// `projector.weights = "auto"` takes the planes that the projector offers, and the report says where that are binary ones.
#[test]
fn a_projector_that_offers_no_split_planes_is_lit_by_binary_ones() {
    for exceeds in [false, true] {
        let name = format!("offers-{exceeds}");
        let far = PtyProjector::new(&name, MockConfig { exceeds, ..MockConfig::new(raster()) });
        let folder = TestFolder::new(&name);
        let text = format!(
            "[projector]\nwidth = {}\nheight = {}\nframe_rate = 60\nplanes = 8\nweights = \"auto\"\nbackend = {}\n\
             [render]\nspp = 1\nmethod = \"full\"\n[[scene.bodies]]\nname = \"bunny\"\n",
            raster().width(),
            raster().height(),
            far.backend(""),
        );
        let path = folder.write("rig.toml", &text);
        let told = dpm(&["run", &path, "--frames", "30", "--out", folder.text()], &[]);
        assert_eq!(code(&told), 0, "{}", err(&told));
        assert!(far.status().frames_lit > 0);
        let report = std::fs::read_to_string(folder.path("report.json")).expect("it was written");
        let report: serde_json::Value = serde_json::from_str(&report).expect("it is JSON");
        let is_noted = report["warnings"].to_string().contains("does not offer split planes");
        assert_eq!(is_noted, !exceeds, "{}", report["warnings"]);
    }
}
