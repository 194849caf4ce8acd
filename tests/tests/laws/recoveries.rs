//! Found in use, R2: crews that were replaced because a stage hung leave nothing behind, and the device and its pipelines are
//! kept. (`host/dpm/tests/laws/real_pace/hangs.rs` has fifty of them in the program itself.)
#![cfg(target_os = "linux")]

use dpm_render::gpu::{memory_given_up, Gpu};
use dpm_rig::pipeline::{self, RunOptions, Stall, StallIn};
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(240);
/// Crews that are replaced.
const RECOVERIES: u64 = 6;
/// Longer than the supervisor needs to find a stage hung, on a busy machine too.
const STALL: Duration = Duration::from_millis(1_500);
/// Frames from one stall to the next: more than are planned while one lasts.
const EVERY: u64 = 60;

/// Threads of this process by name, and its resident memory, bytes.
fn held() -> (BTreeMap<String, usize>, u64) {
    let mut threads = BTreeMap::new();
    for task in std::fs::read_dir("/proc/self/task").unwrap().flatten() {
        if let Ok(name) = std::fs::read_to_string(task.path().join("comm")) {
            *threads.entry(name.trim().to_owned()).or_default() += 1;
        }
    }
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let kib = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    (threads, kib.split_whitespace().next().unwrap().parse::<u64>().unwrap() * 1024)
}

/// Waits until `crews` took over and the threads of all earlier ones have ended; returns what is held then: the number of
/// threads, and bytes.
fn after(crews: usize, monitor: &RunMonitor, notes: &mut Vec<String>) -> (usize, u64) {
    let begin = Instant::now();
    loop {
        notes.extend(monitor.take_notes());
        let (threads, bytes) = held();
        let alone =
            ["dpm-tracking", "dpm-plan", "dpm-pack"].iter().all(|name| threads.get(*name) == Some(&1));
        let made = notes.iter().filter(|note| note.contains("light again after")).count();
        if made >= crews && alone {
            return (threads.values().sum(), bytes);
        }
        assert!(begin.elapsed() < PATIENCE, "{made} recoveries: {threads:?}, {notes:#?}");
        std::thread::sleep(Duration::from_millis(50));
    }
}

fn recovers(gpu: &Arc<Gpu>) {
    let flags =
        ["real_time.pace=\"real\"", "projector.frame_rate=30", "render.method=\"full\"", "render.spp=1"];
    let rig = demo_rig(24, 16, &flags);
    let stall = Stall { stage: StallIn::Crew, frame: 30, length: STALL, times: RECOVERIES, every: EVERY };
    let options = RunOptions { stall: Some(stall), ..RunOptions::default() };
    let monitor = Arc::new(RunMonitor::default());
    let run = {
        let (gpu, monitor) = (gpu.clone(), monitor.clone());
        std::thread::spawn(move || pipeline::run(rig, &gpu, options, &monitor))
    };
    let mut notes = Vec::new();
    let (threads, bytes) = after(2, &monitor, &mut notes);
    let (threads_in_the_end, bytes_in_the_end) = after(RECOVERIES as usize, &monitor, &mut notes);
    monitor.request_stop();
    let report = run.join().expect("no panic").unwrap_or_else(|e| panic!("{e}: {notes:#?}")).report;
    for (recovery, stage) in report.recoveries.iter().zip(["plan", "pack", "tracking"].iter().cycle()) {
        assert!(recovery.cause.contains(stage) && recovery.dark_s.is_some(), "{recovery:?}");
    }
    assert_eq!(report.recoveries.len() as u64, RECOVERIES);
    assert!(threads_in_the_end <= threads + 2, "{threads}, then {threads_in_the_end} threads");
    assert!(bytes_in_the_end <= bytes + bytes / 20, "{bytes}, then {bytes_in_the_end} bytes");
    assert!(!gpu.is_lost(), "the device is kept");
    assert_eq!(memory_given_up().devices, 0);
}

#[test]
fn crews_that_hung_leave_neither_memory_nor_threads_behind_and_the_device_stays() {
    with_gpu(recovers);
}
