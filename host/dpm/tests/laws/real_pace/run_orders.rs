//! `dpm run` as a process, on a projector behind a pseudo-terminal: orders from other processes and from its
//! terminal, SIGTERM, SIGKILL.
#![allow(unsafe_code)]

use crate::cli_common;
use crate::cli_common::{code, dpm, err, out, start};
use crate::link_common::{served_time, Projector};
use crate::rig_file::{rig, WATCHDOG};
use dpm_device::link::{faults, DeviceState, Status};
use std::io::Write;
use std::os::fd::AsRawFd;
use std::os::unix::process::CommandExt;
use std::process::Stdio;
use std::time::{Duration, Instant};

const LONG: Duration = Duration::from_secs(60);

#[test]
fn another_process_darkens_freezes_and_arms_a_running_rig() {
    let (_folder, path, far) = rig("orders");
    let mut run = start(&["run", &path, "--json"]);
    run.wait_for_line(LONG, |line| line.contains("control: dpm black | freeze | safe | arm --pid"));
    far.until(LONG, "light", &mut |s| s.frames_lit >= 5);
    let id = run.id().to_string();
    for (word, state) in [
        ("black", DeviceState::Black),
        ("resume", DeviceState::Armed),
        ("freeze", DeviceState::Frozen),
        ("arm", DeviceState::Armed),
        ("safe", DeviceState::Faulted),
        ("arm", DeviceState::Armed),
    ] {
        let told = dpm(&[word, "--pid", &id], &[]);
        assert_eq!(code(&told), 0, "{word}: {}{}", out(&told), err(&told));
        assert_eq!(far.status().state, state, "{word}");
        if state == DeviceState::Armed {
            far.until(LONG, "light again", &mut |s| s.lit);
        } else {
            assert_eq!(far.is_lit(), state == DeviceState::Frozen, "{word}");
        }
    }
    let lit = far.status().frames_lit;
    far.until(LONG, "light again", &mut |s| s.frames_lit >= lit + 3);
    run.signal("TERM");
    // H6: dark within half a second; the rest is for the other tests on this machine.
    let dark = far.until(Duration::from_secs(5), "dark", &mut |s| s.state == DeviceState::Configured);
    assert!(dark < Duration::from_millis(1500), "{dark:?}");
    let (status, report) = run.finish();
    assert_eq!(status.code(), Some(0), "{status}");
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    assert!(report["projector"]["device"]["lit"].as_u64() > Some(5), "{report}");
    let gone = dpm(&["arm", "--pid", &id], &[]);
    assert_eq!(code(&gone), 3);
    assert!(err(&gone).contains("no running rig listens"), "{}", err(&gone));
}

#[test]
fn u15_a_killed_program_leaves_darkness_within_the_watchdog_and_the_next_one_lights() {
    let (_folder, path, far) = rig("kill");
    let run = start(&["run", &path]);
    far.until(LONG, "light", &mut |s| s.frames_lit >= 5 && s.lit);
    run.signal("KILL");
    let killed = Instant::now();
    far.until(Duration::from_secs(5), "dark", &mut |s| !s.lit);
    // The last packet was received before the kill; 20 ms are for this test's own checks and a shared machine.
    assert!(killed.elapsed() < WATCHDOG + Duration::from_millis(20), "{:?}", killed.elapsed());
    // Dark by the last frame's own instant or by the watchdog, whichever came first; the watchdog latches in any
    // case.
    far.until(Duration::from_secs(5), "the watchdog", &mut |s| s.faults == faults::WATCHDOG);
    let (status, _) = run.finish();
    assert_eq!(status.code(), None, "ended by the signal");
    // Locks and sockets of dead processes are no obstacle, nor is the latched watchdog.
    let run = start(&["run", &path]);
    far.until(LONG, "light of the next run", &mut |s| s.lit && s.faults == 0);
    run.signal("INT");
    let (status, _) = run.finish();
    assert_eq!(status.code(), Some(0), "{status}");
    assert!(!far.is_lit());
}

#[test]
fn keys_on_its_terminal_are_orders() {
    let (_folder, path, far) = rig("keys");
    let (mut terminal, theirs) = serialport::TTYPort::pair().unwrap();
    let stdin = std::fs::OpenOptions::new()
        .read(true)
        .write(true)
        .open(serialport::SerialPort::name(&theirs).unwrap());
    let stdin = stdin.unwrap();
    drop(theirs);
    let descriptor = stdin.as_raw_fd();
    // The state that a login shell leaves: lines, echo, and Ctrl-C.
    // SAFETY: a zeroed termios is a valid place to write to, and the descriptor is open.
    unsafe {
        let mut line: libc::termios = std::mem::zeroed();
        assert_eq!(libc::tcgetattr(descriptor, &mut line), 0);
        line.c_lflag |= libc::ISIG | libc::ICANON | libc::ECHO;
        line.c_cc[libc::VINTR] = 3;
        assert_eq!(libc::tcsetattr(descriptor, libc::TCSANOW, &line), 0);
    }
    let mut command = cli_common::command(&["run", &path]);
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command.stdin(stdin.try_clone().unwrap());
    // SAFETY: between fork and exec only these two system calls are made.
    unsafe {
        command.pre_exec(move || {
            if libc::setsid() < 0 || libc::ioctl(descriptor, libc::TIOCSCTTY, 0) < 0 {
                return Err(std::io::Error::last_os_error());
            }
            Ok(())
        });
    }
    let mut child = command.spawn().unwrap();
    far.until(LONG, "light", &mut |s| s.frames_lit >= 3);
    for (key, state) in [(b"x", None), (b"b", Some(DeviceState::Black)), (b"A", Some(DeviceState::Armed))]
        .into_iter()
        .chain([(b"f", Some(DeviceState::Frozen)), (b"s", Some(DeviceState::Faulted))])
    {
        terminal.write_all(key).unwrap();
        if let Some(state) = state {
            far.until(Duration::from_secs(5), "obeyed", &mut |s| s.state == state);
        }
    }
    // The terminal's own interrupt key still works.
    terminal.write_all(&[3]).unwrap();
    let asked = Instant::now();
    let status = loop {
        if let Some(status) = child.try_wait().unwrap() {
            break status;
        }
        if asked.elapsed() > Duration::from_secs(20) {
            let _ = child.kill();
        }
        std::thread::sleep(Duration::from_millis(5));
    };
    assert_eq!(status.code(), Some(0), "{status}");
    // It restored the terminal.
    // SAFETY: as above.
    let flags = unsafe {
        let mut line: libc::termios = std::mem::zeroed();
        assert_eq!(libc::tcgetattr(descriptor, &mut line), 0);
        line.c_lflag
    };
    assert_eq!(flags & (libc::ICANON | libc::ECHO), libc::ICANON | libc::ECHO);
    assert!(!far.is_lit());
}

#[test]
fn the_link_test_prints_one_object_and_leaves_darkness() {
    let (_folder, path, far) = rig("link-test");
    let told = dpm(&["link-test", &path, "--prepared", "--for", "1", "--count", "3", "--json"], &[]);
    assert_eq!(code(&told), 0, "{}{}", out(&told), err(&told));
    let report: serde_json::Value = serde_json::from_str(&out(&told)).expect("one JSON object");
    let ways = report["ways"].as_array().expect("ways to send");
    assert_eq!(ways.len(), 2, "{report}");
    assert!(ways.iter().all(|w| w["frames_per_s"].as_f64() > Some(5.0)), "{report}");
    assert!(!far.is_lit() && far.status().frames_lit > 0);
}

/// A run that is stopped in the middle goes dark at once, reports what it found, and ends with 0.
#[test]
fn signals_end_the_link_test_in_the_dark() {
    for signal in ["INT", "TERM"] {
        // Where the machine stands still for longer than the watchdog bears, the projector ends the light before it is seen here.
        let lit = (0..3).find_map(|attempt| {
            let (folder, path, far) = rig(&format!("link-test-{signal}-{attempt}"));
            let run = start(&["link-test", &path, "--prepared", "--for", "600", "--count", "3", "--json"]);
            let faulted = |s: &Status| s.state == DeviceState::Faulted;
            far.until(LONG, "light", &mut |s| faulted(s) || s.frames_lit >= 3 && s.lit);
            (!faulted(&far.status())).then_some((folder, far, run))
        });
        let (_folder, far, run) = lit.expect("light for longer than the watchdog bears");
        run.signal(signal);
        let dark = served_time("dark", || !far.is_lit());
        assert!(dark < Duration::from_millis(500), "{dark:?}");
        let (status, told) = run.finish();
        assert_eq!(status.code(), Some(0), "{status}");
        assert_eq!(far.status().state, DeviceState::Configured, "stopped in order, not by the watchdog");
        let report: serde_json::Value = serde_json::from_str(&told).expect("one JSON object");
        assert_eq!(
            (report["stopped"].as_bool(), report["ways"].as_array().map(Vec::len)),
            (Some(true), Some(1))
        );
    }
}
