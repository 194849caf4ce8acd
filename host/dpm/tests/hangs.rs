//! Found in use, R1: any thread of a running rig may hang. The projector, which is no part of that process, is dark when the frame that it shows
//! says so, and what hung is replaced where it can be.
#![cfg(target_os = "linux")]
#![allow(unsafe_code)]

mod cli_common;
mod link_common;

use cli_common::{code, dpm, err, start, Folder, Running};
use hil_mock::projector::MockConfig;
use link_common::{raster, served_time, Projector, PtyProjector};
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(60);
/// The rig's: three slots at 60 frames a second and the longest prediction are shorter.
const PREDICT_MS: u64 = 100;
const SLOT_MS: u64 = 17;

/// A thread of another process that stands still for as long as this lives.
struct Stopped {
    thread: i32,
}

impl Stopped {
    /// Stops a thread where it is, as a debugger would.
    fn new(thread: i32) -> Option<Self> {
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

impl Stopped {
    /// Takes note of the thread's end: until whoever traces it does, the process is not gone for its parent.
    fn reap(&self, process: u32) {
        // The process's own end is its parent's to see.
        if self.thread as u32 != process {
            // SAFETY: waitpid changes nothing but the status, which is not asked for.
            unsafe { libc::waitpid(self.thread, std::ptr::null_mut(), libc::__WALL) };
        }
    }
}

impl Drop for Stopped {
    fn drop(&mut self) {
        let none = std::ptr::null_mut::<libc::c_void>();
        // SAFETY: as above; a thread that is gone is no harm.
        unsafe { libc::ptrace(libc::PTRACE_DETACH, self.thread, none, none) };
    }
}

/// Threads of a process with their names.
fn threads(id: u32) -> Vec<(i32, String)> {
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

fn rig(name: &str) -> (Folder, String, PtyProjector) {
    let folder = Folder::new(name);
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

fn lit_run(path: &str, far: &PtyProjector) -> Running {
    let run = start(&["run", path]);
    let lit = far.status().frames_lit;
    far.until(LONG, "light", &mut |s| s.lit && s.frames_lit >= lit.saturating_add(10));
    run
}

/// Threads without which no frame comes to the light. (What a stop does while any thread hangs is `stop.rs`'s matter.)
const NEEDED_FOR_LIGHT: [&str; 4] = ["dpm-plan", "dpm-pack", "dpm-link", "llvmpipe-0"];

#[test]
fn whichever_thread_of_the_frames_way_hangs_light_ends_by_itself() {
    let (_folder, path, far) = rig("hangs");
    for name in NEEDED_FOR_LIGHT {
        let run = lit_run(&path, &far);
        let all = threads(run.id());
        let Some((thread, _)) = all.iter().find(|(_, n)| n == name) else { panic!("{name}: {all:?}") };
        let stopped = Stopped::new(*thread).expect("it may be traced");
        let dark = served_time(name, || !far.is_lit());
        // A frame that had been sent may still be lit for its own slot first.
        let bound = Duration::from_millis(4 * SLOT_MS + PREDICT_MS + 20);
        assert!(dark <= bound, "{name}: dark after {dark:?}");
        run.signal("KILL");
        stopped.reap(run.id());
        drop(stopped);
    }
}

/// What hangs is abandoned, named and replaced; when it wakes up it changes nothing.
#[test]
fn a_stage_that_hangs_is_replaced_and_does_nothing_when_it_wakes_up() {
    let (_folder, path, far) = rig("replaced");
    for name in ["dpm-plan", "dpm-pack", "llvmpipe-0"] {
        let mut run = lit_run(&path, &far);
        let id = run.id();
        let (thread, _) = threads(id).into_iter().find(|(_, n)| n == name).expect("it runs");
        let stopped = Stopped::new(thread).expect("it may be traced");
        let hung = Instant::now();
        far.until(LONG, "dark", &mut |s| !s.lit);
        let lit = far.status().frames_lit;
        far.until(LONG, "light again", &mut |s| s.lit && s.frames_lit > lit);
        let back = hung.elapsed();
        // The making of pipelines takes what it takes on this machine; it must not be a matter of minutes.
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

/// A picture is held only while somebody could replace it.
#[test]
fn a_frozen_picture_goes_dark_when_a_stage_hangs() {
    let (_folder, path, far) = rig("frozen");
    let run = lit_run(&path, &far);
    let told = dpm(&["freeze", "--pid", &run.id().to_string()], &[]);
    assert_eq!(code(&told), 0, "{}", err(&told));
    // Longer than any frame's own word lasts.
    std::thread::sleep(Duration::from_millis(4 * SLOT_MS + 2 * PREDICT_MS));
    assert!(far.is_lit(), "held");
    let (thread, _) = threads(run.id()).into_iter().find(|(_, n)| n == "dpm-plan").expect("it runs");
    let stopped = Stopped::new(thread).expect("it may be traced");
    let dark = served_time("dark", || !far.is_lit());
    // What the stage had announced, 0.1 s more, and the supervisor's word that is missed.
    assert!(dark <= Duration::from_millis(500), "dark after {dark:?}");
    run.signal("KILL");
    stopped.reap(run.id());
}
