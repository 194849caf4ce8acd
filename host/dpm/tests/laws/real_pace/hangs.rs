//! Found in use, R1: any thread of a running rig may hang. The projector, which is not part of that process, goes
//! dark at the instant that its current frame carries, and what hangs is replaced if possible.
#![cfg(target_os = "linux")]
#![allow(unsafe_code)]

use crate::cli_common::{code, dpm, err, start, ChildProgram, TestFolder};
use crate::link_common::{raster, served_time, Projector, PtyProjector};
use hil_mock::projector::MockConfig;
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(60);
/// The rig's `safety.predict_ms`, which is longer than three slots at 60 frames per second.
const PREDICT_MS: u64 = 100;
const SLOT_MS: u64 = 17;

/// A thread of another process that is stopped as long as this lives.
pub(super) struct HaltedThread {
    thread: i32,
}

impl HaltedThread {
    /// Stops a thread immediately, as a debugger would.
    pub(super) fn new(thread: i32) -> Option<Self> {
        let none = std::ptr::null_mut::<libc::c_void>();
        // SAFETY: ptrace and waitpid change nothing in this process; the status is written during the call.
        unsafe {
            if libc::ptrace(libc::PTRACE_SEIZE, thread, none, none) != 0 {
                return None;
            }
            let stopped = Self { thread };
            assert_eq!(libc::ptrace(libc::PTRACE_INTERRUPT, thread, none, none), 0);
            let mut status = 0;
            assert_eq!(libc::waitpid(thread, &mut status, libc::__WALL), thread);
            Some(stopped)
        }
    }
}

impl HaltedThread {
    /// Acknowledges the thread's end. Until the tracer does, the parent does not see the end of the process.
    fn reap(&self, process: u32) {
        // The process's own end is left to its parent.
        if self.thread as u32 != process {
            // SAFETY: waitpid changes nothing but the status, which is not requested.
            unsafe { libc::waitpid(self.thread, std::ptr::null_mut(), libc::__WALL) };
        }
    }
}

impl Drop for HaltedThread {
    fn drop(&mut self) {
        let none = std::ptr::null_mut::<libc::c_void>();
        // SAFETY: as above; it does no harm if the thread is gone. Nobody sees the end of the process before the tracer has
        // acknowledged that of the thread.
        unsafe {
            if libc::ptrace(libc::PTRACE_DETACH, self.thread, none, none) != 0 {
                libc::waitpid(self.thread, std::ptr::null_mut(), libc::__WALL | libc::WNOHANG);
            }
        }
    }
}

/// Threads of a process with their names.
pub(super) fn threads(id: u32) -> Vec<(i32, String)> {
    let tasks = std::fs::read_dir(format!("/proc/{id}/task")).expect("the process runs");
    let mut all: Vec<_> = tasks
        .filter_map(|task| {
            let path = task.ok()?.path();
            let name = std::fs::read_to_string(path.join("comm")).ok()?;
            Some((path.file_name()?.to_str()?.parse().ok()?, name.trim().to_owned()))
        })
        .collect();
    all.sort();
    all
}

fn rig(name: &str) -> (TestFolder, String, PtyProjector) {
    let folder = TestFolder::new(name);
    let far = PtyProjector::new(name, MockConfig::new(raster()));
    let text = format!(
        "[projector]\nwidth = {}\nheight = {}\nframe_rate = 60\nplanes = 8\nbackend = {}\n\
         [render]\nspp = 1\nmethod = \"full\"\n[safety]\npredict_ms = {PREDICT_MS}\n[output]\ndir = {:?}\n\
         [[scene.bodies]]\nname = \"bunny\"\n",
        raster().width(),
        raster().height(),
        far.backend(""),
        folder.text(),
    );
    let path = folder.write("rig.toml", &text);
    (folder, path, far)
}

fn lit_run(path: &str, far: &PtyProjector) -> ChildProgram {
    let run = start(&["run", path]);
    let lit = far.status().frames_lit;
    far.until(LONG, "light", &mut |s| s.lit && s.frames_lit >= lit.saturating_add(10));
    run
}

/// Threads without which no frame is lit. (`stop.rs` tests stopping while any thread hangs.)
const NEEDED_FOR_LIGHT: [&str; 4] = ["dpm-plan", "dpm-pack", "dpm-link", "llvmpipe-0"];

#[test]
fn whichever_thread_of_the_frames_way_hangs_light_ends_by_itself() {
    let (_folder, path, far) = rig("hangs");
    for name in NEEDED_FOR_LIGHT {
        let run = lit_run(&path, &far);
        let all = threads(run.id());
        let Some((thread, _)) = all.iter().find(|(_, n)| n == name) else { panic!("{name}: {all:?}") };
        let stopped = HaltedThread::new(*thread).expect("it may be traced");
        let dark = served_time(name, || !far.is_lit());
        // A frame that was already sent may still be lit for its own slot.
        let bound = Duration::from_millis(4 * SLOT_MS + PREDICT_MS + 20);
        assert!(dark <= bound, "{name}: dark after {dark:?}");
        run.signal("KILL");
        stopped.reap(run.id());
        drop(stopped);
    }
}

/// A stage that hangs is abandoned, named and replaced; when it wakes up it has no effect.
#[test]
fn a_stage_that_hangs_is_replaced_and_does_nothing_when_it_wakes_up() {
    let (_folder, path, far) = rig("replaced");
    for name in ["dpm-plan", "dpm-pack", "llvmpipe-0"] {
        let mut run = lit_run(&path, &far);
        let id = run.id();
        let (thread, _) = threads(id).into_iter().find(|(_, n)| n == name).expect("it runs");
        let stopped = HaltedThread::new(thread).expect("it may be traced");
        let hung = Instant::now();
        far.until(LONG, "dark", &mut |s| !s.lit);
        let lit = far.status().frames_lit;
        far.until(LONG, "light again", &mut |s| s.lit && s.frames_lit > lit);
        let back = hung.elapsed();
        // Making pipelines takes an unknown time on this machine, but must not take minutes.
        assert!(back < Duration::from_secs(60), "{name}: {back:?}");
        run.wait_for_line(LONG, |line| line.contains("are restarted"));
        drop(stopped);
        let before = far.status();
        far.until(LONG, "light goes on", &mut |s| s.frames_lit >= before.frames_lit + 20);
        let after = far.status();
        assert_eq!(after.frames_incomplete, before.frames_incomplete, "{name}");
        run.signal("TERM");
        let status = run.finish().0;
        assert!(!far.is_lit(), "{name}: {status}");
    }
}

/// A frozen picture is held only while something could replace it.
#[test]
fn a_frozen_picture_goes_dark_when_a_stage_hangs() {
    let (_folder, path, far) = rig("frozen");
    let run = lit_run(&path, &far);
    let told = dpm(&["freeze", "--pid", &run.id().to_string()], &[]);
    assert_eq!(code(&told), 0, "{}", err(&told));
    // Longer than the light of any frame may last.
    std::thread::sleep(Duration::from_millis(4 * SLOT_MS + 2 * PREDICT_MS));
    assert!(far.is_lit(), "held");
    let (thread, _) = threads(run.id()).into_iter().find(|(_, n)| n == "dpm-plan").expect("it runs");
    let stopped = HaltedThread::new(thread).expect("it may be traced");
    let dark = served_time("dark", || !far.is_lit());
    // The stage's announcement, 0.1 s more, and the supervisor's confirmation that is missing.
    assert!(dark <= Duration::from_millis(500), "dark after {dark:?}");
    run.signal("KILL");
    stopped.reap(run.id());
}

/// Resident memory, bytes, and number of threads of a process.
fn held(id: u32) -> (u64, usize) {
    let status = std::fs::read_to_string(format!("/proc/{id}/status")).expect("the process runs");
    let number = |name: &str| -> u64 {
        let line = status.lines().find_map(|line| line.strip_prefix(name)).expect("Linux tells");
        line.split_whitespace().next().and_then(|word| word.parse().ok()).expect("a number")
    };
    (number("VmRSS:") * 1024, number("Threads:") as usize)
}

/// Stalls of a second each, and how long there is peace after one: as many as a minute may have.
const RECOVERIES: usize = 50;
const PEACE: Duration = Duration::from_millis(2_200);

/// Found in use, R2: each crew that was replaced left its renderer, its threads and its device behind. And O8: a stop during a recovery
/// writes the report.
#[test]
fn fifty_recoveries_leave_nothing_behind_and_a_stop_during_one_writes_the_report() {
    let folder = TestFolder::new("recoveries");
    let text = include_str!("../../../../../rigs/mock.toml")
        .replace("listen = \"127.0.0.1:8947\"", "listen = \"127.0.0.1:0\"");
    let path = folder.write("rig.toml", &text);
    let mut run = start(&["run", &path, "--out", folder.text()]);
    let id = run.id();
    let crew = ["dpm-plan", "dpm-pack", "dpm-tracking"];
    let newest = |name: &str| threads(id).into_iter().rfind(|(_, n)| n == name).map(|(thread, _)| thread);
    while newest("dpm-pack").is_none() {
        assert!(run.try_wait().is_none(), "{:?}", run.rest_of_lines(LONG));
        std::thread::sleep(Duration::from_millis(10));
    }
    std::thread::sleep(PEACE);
    let mut second = None;
    for k in 1..=RECOVERIES {
        let stopped = HaltedThread::new(newest(crew[k % 3]).expect("it runs")).expect("it may be traced");
        let hung = Instant::now();
        run.wait_for_line(LONG, |line| line.contains("light again after"));
        std::thread::sleep(Duration::from_secs(1).saturating_sub(hung.elapsed()));
        drop(stopped);
        std::thread::sleep(PEACE);
        let (bytes, count) = held(id);
        println!("{k}: {}: {} MB, {count} threads", crew[k % 3], bytes >> 20);
        if k == 2 {
            second = Some((bytes, count));
        }
        if let (Some((first_bytes, first_count)), RECOVERIES) = (second, k) {
            assert!(bytes <= first_bytes + first_bytes / 20, "{first_bytes}, then {bytes} bytes");
            assert!(count <= first_count + 2, "{first_count}, then {count}: {:?}", threads(id));
        }
    }
    let stopped = HaltedThread::new(newest("dpm-pack").expect("it runs")).expect("it may be traced");
    run.wait_for_line(LONG, |line| line.contains("are restarted"));
    run.signal("TERM");
    drop(stopped);
    let (status, _) = run.finish();
    assert!(status.success(), "{status}");
    let report = std::fs::read_to_string(folder.path("report.json")).expect("it was written");
    let report: serde_json::Value = serde_json::from_str(&report).expect("it is JSON");
    let recoveries = report["recoveries"].as_array().expect("a list");
    assert_eq!(recoveries.len(), RECOVERIES + 1);
    let mut dark: Vec<f64> = recoveries.iter().filter_map(|recovery| recovery["dark_s"].as_f64()).collect();
    dark.sort_by(f64::total_cmp);
    println!("dark for {:.2} s, at most {:.2} s", dark[dark.len() / 2], dark[dark.len() - 1]);
    // On an idle machine the stage is found hung after 0.14 s, and half a second later there is light.
    assert!(dark[dark.len() / 2] <= 0.64, "{dark:?}");
}
