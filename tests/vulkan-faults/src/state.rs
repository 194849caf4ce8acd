//! What the layer counts, the plan in force, and the log: one of each in a process.

use crate::plan::{Call, Fault, Plan};
use std::io::Write;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};

struct State {
    plan: Plan,
    counts: [u64; Call::ALL.len()],
    /// Where the plan may change while the process runs.
    file: Option<PathBuf>,
    /// Which version of the file was read last: inode, time of change, length.
    version: Option<(u64, i64, i64, u64)>,
    log: Option<PathBuf>,
}

/// A plan that is not understood ends the process: a test must not pass because its fault was misspelt.
fn parse(text: &str, from: &str) -> Plan {
    text.parse().unwrap_or_else(|e| {
        eprintln!("vulkan-faults: {from}: {e}");
        std::process::abort()
    })
}

fn state() -> MutexGuard<'static, State> {
    static STATE: OnceLock<Mutex<State>> = OnceLock::new();
    let state = STATE.get_or_init(|| {
        let text = std::env::var("DPM_VK_FAULTS").unwrap_or_default();
        Mutex::new(State {
            plan: parse(&text, "DPM_VK_FAULTS"),
            counts: [0; Call::ALL.len()],
            file: std::env::var_os("DPM_VK_FAULTS_FILE").map(PathBuf::from),
            version: None,
            log: std::env::var_os("DPM_VK_FAULTS_LOG").map(PathBuf::from),
        })
    });
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

impl State {
    /// Takes the plan of the file, if that changed: everything is counted anew then.
    fn refresh(&mut self) {
        let Some(file) = &self.file else { return };
        let Ok(seen) = std::fs::metadata(file) else { return };
        let version = (seen.ino(), seen.mtime(), seen.mtime_nsec(), seen.len());
        if self.version == Some(version) {
            return;
        }
        let Ok(text) = std::fs::read_to_string(file) else { return };
        self.version = Some(version);
        self.plan = parse(&text, "DPM_VK_FAULTS_FILE");
        self.counts = [0; Call::ALL.len()];
    }

    fn note(&self, what: &str, call: Call, number: u64) {
        if let Some(log) = &self.log {
            append(log, &format!("{} {what} {} {number}\n", monotonic_ns(), call.word()));
        }
    }
}

fn append(path: &Path, line: &str) {
    if let Ok(mut file) = std::fs::OpenOptions::new().create(true).append(true).open(path) {
        let _ = file.write_all(line.as_bytes());
    }
}

fn monotonic_ns() -> i64 {
    let mut t = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    crate::interface::read_monotonic_clock(&mut t);
    t.tv_sec * 1_000_000_000 + t.tv_nsec
}

/// Counts a call, under all its names, and gives the fault that strikes it.
pub(crate) fn arrive(calls: &[Call]) -> Option<Fault> {
    arrive_for(calls, None)
}

/// The same for a call that is for the `gpu`-th device of the loader's list, counted from 1.
pub(crate) fn arrive_for(calls: &[Call], gpu: Option<u64>) -> Option<Fault> {
    let mut state = state();
    state.refresh();
    let mut struck = None;
    for &call in calls {
        let count = &mut state.counts[call as usize];
        *count += 1;
        let number = *count;
        let fault = state.plan.fault(call, number, gpu);
        if let Some(fault) = fault.filter(|_| struck.is_none()) {
            state.note(fault.kind.word(), call, number);
            struck = Some(fault);
        }
    }
    struck
}

/// Counts a call that should not have come, and logs it.
pub(crate) fn tell(call: Call) {
    let mut state = state();
    let count = &mut state.counts[call as usize];
    *count += 1;
    let number = *count;
    state.note("noticed", call, number);
}

/// Puts a plan in force; everything is counted anew.
pub(crate) fn replace(text: &str) -> bool {
    let Ok(plan) = text.parse() else { return false };
    let mut state = state();
    state.plan = plan;
    state.counts = [0; Call::ALL.len()];
    true
}

/// Calls of this kind since the plan was given.
pub(crate) fn count(word: &str) -> Option<u64> {
    let call = Call::ALL.into_iter().find(|c| c.word() == word)?;
    Some(state().counts[call as usize])
}
