//! What the parts of the engine tell each other while they work, each from a thread of its own where there are threads.
//!
//! Accesses are relaxed: each number stands for itself, and a reader that sees it a frame late decides as well.

use super::error::PipelineError;
use super::options::RunOptions;
use crate::plan::horizon::Horizon;
use crate::plan::lead::LeadEstimator;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use dpm_device::time::HostTime;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};

/// What a projector outside this process needs to take a frame in and check it once the medium has all of it, nanoseconds. The host cannot
/// measure it.
pub(crate) const RECEIPT_NS: i64 = 500_000;

/// Facts of a whole run.
pub(crate) struct Facts {
    /// The rig.
    pub rig: Arc<Rig>,
    /// What the operator orders and what the run tells.
    pub monitor: Arc<RunMonitor>,
    /// What the run was asked for.
    pub options: RunOptions,
    /// How long before its slot a frame is latched, the projector's receipt and the medium's travel not counted, nanoseconds.
    pub lead_ns: AtomicI64,
    /// What most frames need from latch to sent, nanoseconds.
    pub typical_ns: AtomicI64,
    /// Learned time from sent to light, nanoseconds (projectors outside this process).
    pub travel_ns: AtomicI64,
    /// When every stage was last found alive.
    pub alive_at_ns: AtomicI64,
    /// Number of the next frame.
    pub next_frame: AtomicU64,
    /// Slot after the last one that the run was asked to plan for; 0 while it is not known.
    pub end_slot: AtomicU64,
    /// Slots from one planned frame to the next, in thousandths, as an average of the last frames.
    pub stride_milli: AtomicU64,
    /// Longest time for which a body is carried on by prediction, nanoseconds.
    pub predict_ns: AtomicI64,
    /// Every frame that the run was asked for is planned.
    pub is_complete: AtomicBool,
    error: Mutex<Option<PipelineError>>,
}

impl Facts {
    /// At the beginning of a run whose link is up, at `now`.
    pub(crate) fn new(
        rig: Arc<Rig>,
        monitor: Arc<RunMonitor>,
        options: RunOptions,
        lead: &LeadEstimator,
        now: HostTime,
    ) -> Self {
        let predict_ns = Horizon::of_rig(&rig.config).predict_ns(lead.lead_ns() + RECEIPT_NS, 0);
        Self {
            rig,
            monitor,
            options,
            lead_ns: AtomicI64::new(lead.lead_ns()),
            typical_ns: AtomicI64::new(lead.typical_ns()),
            travel_ns: AtomicI64::new(0),
            alive_at_ns: AtomicI64::new(now.0),
            next_frame: AtomicU64::new(0),
            end_slot: AtomicU64::new(0),
            stride_milli: AtomicU64::new(1000),
            predict_ns: AtomicI64::new(predict_ns),
            is_complete: AtomicBool::new(false),
            error: Mutex::new(None),
        }
    }

    /// The run ends, in the dark, with this error; the first one counts. Not on the frame path.
    pub(crate) fn fail(&self, error: PipelineError) {
        if let Ok(mut first) = self.error.lock() {
            first.get_or_insert(error);
        }
        self.monitor.request_stop();
    }

    /// Why the run failed.
    pub(crate) fn take_error(&self) -> Option<PipelineError> {
        self.error.lock().ok().and_then(|mut error| error.take())
    }

    /// What each of plan, render, pack and link is taken to cost at virtual pace, nanoseconds.
    pub(crate) fn modelled_costs(&self) -> [i64; 4] {
        let c = &self.rig.config.real_time.stage_costs_us;
        [c.plan, c.render, c.pack, c.send].map(|us| i64::from(us) * 1000)
    }
}

/// What the GPU has to do and how long it takes, shared by planning and packing.
#[derive(Debug, Default)]
pub(crate) struct GpuPace {
    submitted: AtomicU64,
    finished: AtomicU64,
    frame_ns: AtomicI64,
}

impl GpuPace {
    /// Share of a slot beyond which frames are begun one at a time: a GPU that needs longer than that would only queue them up, and each
    /// would be drawn for poses that grow old in the queue.
    const SLOW: f64 = 0.9;

    /// Of a GPU that took `frame_ns` for a frame while nobody was waiting.
    pub(crate) fn new(frame_ns: i64) -> Self {
        Self { frame_ns: AtomicI64::new(frame_ns), ..Self::default() }
    }

    /// A frame was handed to the GPU.
    pub(crate) fn submit(&self) {
        self.submitted.fetch_add(1, Ordering::Relaxed);
    }

    /// The GPU has finished a frame, for which it took `took_ns`.
    pub(crate) fn finish(&self, took_ns: i64) {
        let before = self.frame_ns.load(Ordering::Relaxed);
        let mean = if before == 0 { took_ns } else { before + (took_ns - before) / 8 };
        self.frame_ns.store(mean, Ordering::Relaxed);
        // Release: who sees the frame finished sees what it took.
        self.finished.fetch_add(1, Ordering::Release);
    }

    /// Frames that the GPU has not finished.
    pub(crate) fn in_flight(&self) -> u64 {
        let finished = self.finished.load(Ordering::Acquire);
        self.submitted.load(Ordering::Relaxed).saturating_sub(finished)
    }

    /// True when a frame takes about a slot or more.
    pub(crate) fn is_slow(&self, slot_ns: i64) -> bool {
        self.frame_ns.load(Ordering::Relaxed) as f64 > Self::SLOW * slot_ns as f64
    }
}

/// Facts of one crew: of the stages that are made anew together.
#[derive(Debug)]
pub(crate) struct CrewFacts {
    /// The GPU.
    pub gpu: GpuPace,
    /// Thousandths of a sample that a pixel gets on average.
    pub budget_milli: AtomicU64,
}

impl CrewFacts {
    /// Of a crew that begins, on a GPU that took `frame_ns` for a frame while nobody was waiting.
    pub(crate) fn new(rig: &Rig, frame_ns: i64) -> Self {
        let budget_milli = AtomicU64::new(u64::from(rig.config.render.spp) * 1000);
        Self { gpu: GpuPace::new(frame_ns), budget_milli }
    }
}
