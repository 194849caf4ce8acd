//! Stop means dark, and the process ends, whichever of its threads hangs: ptrace stops each of them in turn.
#![allow(unsafe_code)]

use crate::cli_common::{code, command, dpm, err, out, start, ChildProgram};
use crate::link_common::{served_time, Projector};
use crate::rig_file::{rig, run_words, WATCHDOG};
use dpm_device::link::DeviceState;
use dpm_rig::telemetry::monitor::RunMonitor;
use std::io::Write;
use std::os::fd::AsRawFd;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(60);
/// From the signal to the end of the process.
const GONE: Duration = Duration::from_secs(2);
/// Time for the test's own checks, on a busy machine.
const LOOKING: Duration = Duration::from_millis(20);

/// A thread of another process that is stopped until this is dropped. Only the thread that made this can trace it.
struct FrozenThread {
    tid: i32,
}

impl FrozenThread {
    fn thread(pid: u32, name: &str) -> Self {
        let tid = thread_of(pid, name);
        // SAFETY: requests without addresses to a thread of our own child; waitpid writes to a place that outlives it.
        unsafe {
            let none = std::ptr::null_mut::<libc::c_void>();
            assert_eq!(
                libc::ptrace(libc::PTRACE_SEIZE, tid, none, none),
                0,
                "{}",
                std::io::Error::last_os_error()
            );
            assert_eq!(libc::ptrace(libc::PTRACE_INTERRUPT, tid, none, none), 0);
            let mut status = 0;
            assert_eq!(libc::waitpid(tid, &raw mut status, libc::__WALL), tid);
            assert!(libc::WIFSTOPPED(status), "{status:x}");
        }
        Self { tid }
    }

    /// Its end, if it has come. The process's own end is left to its parent.
    fn reap(&self, pid: u32) {
        if self.tid != pid as i32 {
            // SAFETY: a null status is allowed.
            unsafe { libc::waitpid(self.tid, std::ptr::null_mut(), libc::__WALL | libc::WNOHANG) };
        }
    }
}

impl Drop for FrozenThread {
    fn drop(&mut self) {
        let none = std::ptr::null_mut::<libc::c_void>();
        // SAFETY: a request without addresses; it fails if the thread is gone, and a null status is allowed. Nobody sees the
        // end of the process before the tracer has acknowledged that of the thread.
        unsafe {
            if libc::ptrace(libc::PTRACE_DETACH, self.tid, none, none) != 0 {
                libc::waitpid(self.tid, std::ptr::null_mut(), libc::__WALL | libc::WNOHANG);
            }
        }
    }
}

fn thread_of(pid: u32, name: &str) -> i32 {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    let mut seen = Vec::new();
    for task in tasks.filter_map(Result::ok) {
        let comm = std::fs::read_to_string(task.path().join("comm")).unwrap_or_default();
        let tid: i32 = task.file_name().to_str().unwrap().parse().unwrap();
        let is_main = tid == pid as i32;
        if name == "main" && is_main || name != "main" && !is_main && comm.trim() == name {
            return tid;
        }
        seen.push(comm);
    }
    panic!("no thread {name} in {seen:?}");
}

/// Waits for the end of `run` while `stopped` is traced; returns the time that counts.
fn gone(run: &mut ChildProgram, stopped: &FrozenThread) -> Duration {
    let pid = run.id();
    served_time("gone", || {
        stopped.reap(pid);
        run.try_wait().is_some()
    })
}

/// Found in use, R2: when a stage hung, SIGTERM and SIGINT left the frame lit and the process alive, and the
/// projector was armed again.
#[test]
fn r2_whichever_thread_hangs_a_stop_is_dark_and_the_process_goes() {
    for (name, signal) in [
        ("main", "TERM"),
        ("dpm-run", "INT"),
        ("dpm-plan", "TERM"),
        ("dpm-pack", "HUP"),
        ("dpm-tracking", "TERM"),
        ("dpm-control", "INT"),
        ("dpm-orders", "TERM"),
        ("dpm-tell", "TERM"),
        ("dpm-link", "TERM"),
    ] {
        let (_folder, path, far) = rig(&format!("hang-{name}"));
        let mut run = start(&run_words(&path));
        far.until(LONG, "light", &mut |s| s.lit && s.frames_lit >= 3);
        let stopped = FrozenThread::thread(run.id(), name);
        run.signal(signal);
        let dark = served_time("dark", || !far.is_lit());
        // The link's own thread is the one that can send orders to the projector; without it the watchdog acts.
        let limit = if name == "dpm-link" { WATCHDOG } else { Duration::from_millis(50) };
        assert!(dark <= limit + LOOKING, "{name}: dark after {dark:?}");
        let left = gone(&mut run, &stopped);
        assert!(dark + left <= GONE, "{name}: gone after {:?}", dark + left);
        assert!(!far.is_lit(), "{name}");
        drop(stopped);
        run.finish();
    }
}

/// Found in use, R9: an order is obeyed although the thread that receives orders hangs, and it is reported as obeyed
/// because the state file confirmed it.
#[test]
fn r9_black_and_safe_need_no_control_thread() {
    let (_folder, path, far) = rig("deaf");
    let mut run = start(&run_words(&path));
    far.until(LONG, "light", &mut |s| s.lit && s.frames_lit >= 3);
    let pid = run.id().to_string();
    for (word, state) in [("black", DeviceState::Black), ("safe", DeviceState::Faulted)] {
        let stopped = FrozenThread::thread(run.id(), "dpm-control");
        let told = dpm(&[word, "--pid", &pid], &[]);
        assert_eq!(code(&told), 0, "{}{}", out(&told), err(&told));
        assert!(out(&told).contains("by a signal") && out(&told).contains("rig.toml"), "{}", out(&told));
        assert!(out(&told).contains(&format!("{word} is kept")), "{}", out(&told));
        assert_eq!(far.status().state, state);
        drop(stopped);
        let told = dpm(&["arm", "--pid", &pid], &[]);
        assert_eq!(code(&told), 0, "{}{}", out(&told), err(&told));
        far.until(LONG, "light", &mut |s| s.lit);
    }
    // The whole process is stopped: nothing is confirmed, and the message says so.
    run.signal("STOP");
    let told = dpm(&["safe", "--pid", &pid], &[]);
    assert_eq!(code(&told), 3, "{}{}", out(&told), err(&told));
    assert!(out(&told).contains("delivered by a signal, NOT confirmed"), "{}", out(&told));
    assert!(out(&told).contains(&format!("kill -KILL {pid}")), "{}", out(&told));
    run.signal("CONT");
    far.until(LONG, "the signal is taken", &mut |s| s.state == DeviceState::Faulted && !s.lit);
    run.signal("TERM");
    let _ = served_time("gone", || run.try_wait().is_some());
}

/// The disk that keeps orders hangs: the projector goes dark all the same, and the order is not reported as kept.
#[test]
fn r4_an_order_is_obeyed_before_it_is_kept() {
    let (_folder, path, far) = rig("slow-disk");
    let run = start(&run_words(&path));
    far.until(LONG, "light", &mut |s| s.lit && s.frames_lit >= 3);
    let pid = run.id().to_string();
    let stopped = FrozenThread::thread(run.id(), "dpm-orders");
    let told = dpm(&["safe", "--pid", &pid], &[]);
    assert_eq!(far.status().state, DeviceState::Faulted);
    assert_eq!(code(&told), 3, "{}{}", out(&told), err(&told));
    assert!(out(&told).contains("NOT kept over a restart yet"), "{}", out(&told));
    drop(stopped);
    let told = dpm(&["safe", "--pid", &pid], &[]);
    assert_eq!(code(&told), 0, "{}{}", out(&told), err(&told));
    run.signal("TERM");
    run.finish();
}

/// A standard error stream without a reader delays neither orders nor the end.
#[test]
fn r2_a_stream_that_nobody_reads_holds_nothing_up() {
    let (_folder, path, far) = rig("unread");
    let (reader, mut writer) = std::io::pipe().unwrap();
    // SAFETY: plain numbers.
    unsafe { libc::fcntl(writer.as_raw_fd(), libc::F_SETFL, libc::O_NONBLOCK) };
    while writer.write(&[b'x'; 512]).is_ok() {}
    while writer.write(b"x").is_ok() {}
    // SAFETY: as above. The flag belongs to the pipe's end, which the program gets.
    unsafe { libc::fcntl(writer.as_raw_fd(), libc::F_SETFL, 0) };
    let mut child =
        command(&run_words(&path)).stdout(Stdio::null()).stderr(writer.try_clone().unwrap()).spawn().unwrap();
    far.until(LONG, "light", &mut |s| s.lit && s.frames_lit >= 3);
    let pid = child.id().to_string();
    for (word, wanted) in [("black", DeviceState::Black), ("arm", DeviceState::Armed)] {
        let told = dpm(&[word, "--pid", &pid], &[]);
        assert_eq!(code(&told), 0, "{}{}", out(&told), err(&told));
        assert_eq!(far.status().state, wanted);
    }
    let status = Command::new("sh").args(["-c", &format!("kill -TERM {pid}")]).status().unwrap();
    assert!(status.success());
    let dark = served_time("dark", || !far.is_lit());
    assert!(dark <= Duration::from_millis(50) + LOOKING, "{dark:?}");
    let mut ended = None;
    let left = served_time("gone", || {
        ended = child.try_wait().unwrap();
        ended.is_some()
    });
    assert!(left <= GONE, "{left:?}");
    assert_eq!(ended.unwrap().code(), Some(0), "ended in order");
    drop((reader, writer));
}

/// The next test runs this as a process of its own: a thread panics, and nothing else ends.
#[test]
#[ignore = "a part of the test below"]
fn panics_and_hangs() {
    if std::env::var_os("PANICS").is_none() {
        return;
    }
    dpm_common::signals::install().unwrap();
    let monitor = RunMonitor::default();
    assert!(!monitor.stop_requested());
    let thread = std::thread::spawn(|| panic!("as a stage might"));
    let _ = thread.join();
    assert!(monitor.stop_requested() && monitor.dark_is_ordered());
    println!("stopping");
    std::thread::sleep(LONG);
}

/// Found in use, R2 and related: a panic in any thread stops all others, and a process that does not end by itself is
/// ended, not with exit code 0.
#[test]
fn r2_a_panic_in_any_thread_is_a_stop() {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args([
        "--ignored",
        "--exact",
        "real_pace::stop::panics_and_hangs",
        "--nocapture",
        "--test-threads=1",
    ]);
    let begin = Instant::now();
    let output = command.env("PANICS", "1").env("RUST_BACKTRACE", "0").output().unwrap();
    assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
    assert!(out(&output).contains("stopping"), "{}{}", out(&output), err(&output));
    assert_eq!(output.status.code(), Some(101));
    assert!(err(&output).contains("did not end in time"), "{}", err(&output));
}
