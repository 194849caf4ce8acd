//! The rig on a driver of a GPU over a kernel that does nothing: everything that the host does for a frame is real, and no shader runs.
//!
//! The process has the driver and the kernel's stand-in already (see [`crate::targets`]).

use dpm_common::clock::{Clock, MonotonicClock};
use dpm_common::realtime::awake::CoresAwake;
use dpm_common::realtime::{enter_frame_path, ThreadRights};
use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_render::gpu::{validation_messages, CommandList, Gpu, GpuOptions};
use dpm_render::gpu::{Buffer, MemoryKind, MemoryPlace};
use dpm_render::{Output, Renderer, RendererSettings};
use dpm_rig::config::{Overrides, RenderMethod, RigConfig};
use dpm_rig::frame::FrameTimeline;
use dpm_rig::pipeline::{self, renderer_settings, RunOptions};
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use serde::{Deserialize, Serialize};
use std::sync::Arc;

/// Every method that a rig file can name.
pub const METHODS: [RenderMethod; 5] = [
    RenderMethod::Full,
    RenderMethod::Sequence,
    RenderMethod::Miyamoto,
    RenderMethod::Paper,
    RenderMethod::Dpm,
];

/// Most that the host may take of a slot, 99th percentile, milliseconds.
pub const MOST_OF_A_SLOT_MS: f64 = 0.25;

/// A slot of the projector, 947 a second.
const SLOT_NS: i64 = 1_000_000_000 / 947;

/// What the host took of a slot while frames were submitted at the projector's own pace.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Share {
    /// The method.
    pub method: String,
    /// Runs that were needed; these are the figures of the best one.
    pub runs: u32,
    /// Frames that were lit.
    pub frames: u64,
    /// Slots that were missed, for whatever reason.
    pub missed: u64,
    /// From the latch of the poses to the submission, median and 99th percentile, milliseconds.
    pub plan_ms: [f64; 2],
    /// From the submission to readable results; the GPU itself takes no time here.
    pub readable_ms: [f64; 2],
    /// Both together, frame by frame: what the host takes of a slot. Few frames wait in both parts, so the 99th percentile
    /// is less than the sum of those of the parts.
    pub taken_ms: [f64; 2],
}

fn rig(method: RenderMethod, settings: &[&str]) -> Result<Arc<Rig>, String> {
    let flags = settings.iter().map(|s| (*s).to_owned()).collect();
    let mut config = RigConfig::demo(&Overrides { variables: vec![], flags }).map_err(|e| e.to_string())?;
    config.render.method = method;
    Rig::build(&config, Raster::new(1024, 768)).map(Arc::new).map_err(|e| e.to_string())
}

fn open(validation: bool) -> Result<Arc<Gpu>, String> {
    let gpu = Gpu::open(&GpuOptions { validation, ..GpuOptions::default() }).map_err(|e| e.to_string())?;
    if gpu.summary().software {
        return Err(format!("{} is no GPU's driver", gpu.summary().name));
    }
    Ok(gpu)
}

fn silent(what: &str) -> Result<(), String> {
    match validation_messages() {
        (0, _) => Ok(()),
        (count, texts) => Err(format!("{what}: validation said {count} things:\n{}", texts.join("\n"))),
    }
}

/// What is wrong with the places of a slot's buffers on a GPU with memory of its own.
pub fn misplaced(places: &[(&str, MemoryPlace)]) -> Vec<String> {
    let wrong = |(name, place): &(&str, MemoryPlace)| {
        let fault = match name.ends_with(" of the host") {
            true if !place.host_visible => "the host cannot read it",
            true if !place.host_cached => "the host reads it without its caches",
            false if !place.on_device => "shaders read it across the bus",
            _ => return None,
        };
        Some(format!("{name}: {fault}"))
    };
    places.iter().filter_map(wrong).collect()
}

/// Leaves a barrier out on purpose, and returns whether validation says so.
fn misses_a_barrier(gpu: &Arc<Gpu>) -> Result<bool, String> {
    let buffer = |kind| Buffer::new(gpu, "planted fault", 256, kind).map_err(|e| e.to_string());
    let (from, to) = (buffer(MemoryKind::Device)?, buffer(MemoryKind::Readback)?);
    let record = |with: bool| {
        let before = validation_messages().0;
        let list = CommandList::record(gpu, 0, |r| {
            r.clear(&from);
            if with {
                r.barrier();
            }
            r.copy(&from, &to, 256);
            r.barrier_to_host();
        });
        list.map(|_| validation_messages().0 > before).map_err(|e| e.to_string())
    };
    if record(true)? {
        return Err("validation says something of two commands with a barrier between them".into());
    }
    record(false)
}

/// Draws frames of every method under synchronisation validation, looks at queue and memory, and plants a fault. Returns what was seen.
///
/// # Errors
/// What does not hold.
pub fn validated() -> Result<Vec<String>, String> {
    let gpu = open(true)?;
    let summary = gpu.summary();
    if !summary.own_queue {
        return Err(format!("{} gave a queue that draws", summary.name));
    }
    let queues = if gpu.has_two_queues() { "two queues" } else { "one queue" };
    let first = if gpu.goes_first() { ", before other programs" } else { "" };
    let mut seen =
        vec![format!("{} ({}), {queues} without graphics{first}", summary.name, summary.driver.trim())];
    for method in METHODS {
        let rig = rig(method, &[])?;
        let settings = RendererSettings { output: Output::Both(rig.schedule), ..renderer_settings(&rig) };
        let renderer = Renderer::new(&gpu, &rig.scene, settings).map_err(|e| e.to_string())?;
        let slot = renderer.create_slot(false).map_err(|e| e.to_string())?;
        let wrong = misplaced(&slot.places());
        if !wrong.is_empty() {
            return Err(format!("{method:?}: {}", wrong.join("; ")));
        }
        drop((renderer, slot));
        let monitor = Arc::new(RunMonitor::default());
        let options = RunOptions { frames: 30, verify: false, ..RunOptions::default() };
        pipeline::run(rig, &gpu, options, &monitor).map_err(|e| format!("{method:?}: {e}"))?;
        silent(&format!("{method:?}"))?;
        seen.push(format!("{}: 30 frames, memory in its places, validation is silent", method.word()));
    }
    if !misses_a_barrier(&gpu)? {
        return Err("a barrier was left out on purpose, and validation did not see it".into());
    }
    seen.push("a barrier that was left out on purpose is seen".into());
    // Large buffers that the host writes lie in its own memory, where no poses may lie.
    let staging =
        Buffer::new(&gpu, "planted fault", 1 << 20, MemoryKind::Upload).map_err(|e| e.to_string())?;
    if misplaced(&[("instances", staging.place())]).is_empty() {
        return Err(format!("poses in {:?} pass for poses in the GPU's memory", staging.place()));
    }
    seen.push("poses that lie in the wrong memory on purpose are seen".into());
    Ok(seen)
}

/// Median and 99th percentile of times in nanoseconds, as milliseconds; no number without any.
fn quantiles_ms(mut times_ns: Vec<i64>) -> [f64; 2] {
    times_ns.sort_unstable();
    let at = |q: f64| times_ns.get((times_ns.len().saturating_sub(1) as f64 * q).round() as usize);
    [0.5, 0.99].map(|q| at(q).map_or(f64::NAN, |&ns| ns as f64 * 1e-6))
}

/// How late this machine wakes a thread that has the frame path's priority and nothing to do, once a slot of 1.056 ms: median and 99th percentile,
/// milliseconds. A share of a slot that is hardly larger tells of the machine and not of the host's program. `is_awake`: idle cores are kept
/// awake for it, as a rig does.
///
/// # Errors
/// No thread can be started.
pub fn machine_wakes_late_ms(slots: u32, is_awake: bool) -> Result<[f64; 2], String> {
    let sleeper = move || {
        let _awake = is_awake.then(CoresAwake::hold);
        let priority = RigConfig::default().real_time.priority;
        let _ = enter_frame_path(ThreadRights { priority, core: None });
        let clock = MonotonicClock::new(0);
        let start = clock.now();
        let late = |slot: u32| {
            let due = start.plus_ns(i64::from(slot) * SLOT_NS);
            clock.wait_until(due).ns_since(due)
        };
        let late_ns: Vec<i64> = (1..=slots.max(1)).map(late).collect();
        quantiles_ms(late_ns)
    };
    let thread = std::thread::Builder::new().spawn(sleeper).map_err(|e| format!("a thread: {e}"))?;
    thread.join().map_err(|_| "a thread that only sleeps has failed".into())
}

/// Runs a method at the projector's pace for so many slots. Other programs may keep the threads from their cores in one run, but hardly in each of
/// three: a run that takes too much of a slot is repeated, and the best one counts. `settings` are keys of the rig file with their values.
///
/// # Errors
/// A run fails.
pub fn paced(method: RenderMethod, slots: u64, settings: &[String]) -> Result<Share, String> {
    let gpu = &open(false)?;
    let at_pace = ["real_time.pace=\"real\""].into_iter().chain(settings.iter().map(String::as_str));
    let rig = rig(method, &at_pace.collect::<Vec<_>>())?;
    let mut best: Option<Share> = None;
    for runs in 1..=3 {
        let share = Share { runs, ..run_at_pace(gpu, &rig, method, slots)? };
        if best.as_ref().is_none_or(|b| share.taken_ms[1] < b.taken_ms[1]) {
            best = Some(share);
        }
        if let Some(share) = best.take_if(|b| runs == 3 || b.taken_ms[1] <= MOST_OF_A_SLOT_MS) {
            return Ok(Share { runs, ..share });
        }
    }
    Err(format!("{method:?}: no run"))
}

fn run_at_pace(gpu: &Arc<Gpu>, rig: &Arc<Rig>, method: RenderMethod, slots: u64) -> Result<Share, String> {
    let monitor = Arc::new(RunMonitor::default());
    let options = RunOptions { slots, keep_records: slots as usize, verify: false, ..RunOptions::default() };
    let outcome =
        pipeline::run(rig.clone(), gpu, options, &monitor).map_err(|e| format!("{method:?}: {e}"))?;
    let of = |from: fn(&FrameTimeline) -> HostTime, to: fn(&FrameTimeline) -> HostTime| {
        let timelines = outcome.recent.iter().map(|frame| &frame.timeline);
        quantiles_ms(timelines.map(|t| to(t).ns_since(from(t))).collect())
    };
    Ok(Share {
        method: method.word().to_owned(),
        runs: 1,
        frames: outcome.profiler.frames_lit(),
        missed: outcome.slots.missed.iter().sum(),
        plan_ms: of(|t| t.latched_at, |t| t.submitted_at),
        readable_ms: of(|t| t.submitted_at, |t| t.rendered_at),
        taken_ms: of(|t| t.latched_at, |t| t.rendered_at),
    })
}

/// Shares that are larger than the host may take.
pub fn too_large(shares: &[Share]) -> Vec<String> {
    let over = shares.iter().filter(|s| s.taken_ms[1].is_nan() || s.taken_ms[1] > MOST_OF_A_SLOT_MS);
    over.map(|s| {
        format!(
            "{}: the host takes {:.3} ms of a slot (p99), at most {MOST_OF_A_SLOT_MS} are due",
            s.method, s.taken_ms[1]
        )
    })
    .collect()
}
