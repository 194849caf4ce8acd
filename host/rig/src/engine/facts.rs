//! Facts that the parts of the engine share while they work, each in a thread of its own at real pace.
//!
//! Accesses are relaxed: each number is independent of the others, and a reader that sees it a frame late decides
//! equally well.

use super::error::PipelineError;
use super::options::RunOptions;
use crate::plan::horizon::Horizon;
use crate::plan::lead::LeadEstimator;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::report::Recovery;
use crate::tracks::SampleRhythm;
use dpm_device::time::HostTime;
use dpm_handoff::path::Lock;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, AtomicUsize, Ordering};
use std::sync::Arc;

/// Time that a projector needs to receive and check a frame after the medium has accepted all of it, nanoseconds, for one
/// that does not report how early frames are whole.
pub(crate) const RECEIPT_NS: i64 = 500_000;

/// Most recoveries that a report lists.
const RECOVERIES_KEPT: usize = 256;

/// Facts of a whole run.
pub(crate) struct Facts {
    /// The rig.
    pub rig: Arc<Rig>,
    /// Carries the operator's orders and the run's status.
    pub monitor: Arc<RunMonitor>,
    /// The run's options.
    pub options: RunOptions,
    /// How long before its slot a frame is latched, nanoseconds, not counting the projector's receipt and the
    /// medium's travel.
    pub lead_ns: AtomicI64,
    /// Time that most frames need from latch to sent, nanoseconds.
    pub typical_ns: AtomicI64,
    /// Time from sent to whole in the device, nanoseconds, that the lead must add to what it has learned: 0 where the
    /// device reports slack, because what was learned from slack contains it.
    pub travel_ns: AtomicI64,
    /// When all stages were last found alive.
    pub alive_at_ns: AtomicI64,
    /// A crew was replaced, and the link has not seen it: however soon the next one works, a frozen picture is not held.
    pub crew_lost: AtomicBool,
    /// Number of the next frame.
    pub next_frame: AtomicU64,
    /// The slot after the last one to be planned; 0 while it is not known.
    pub end_slot: AtomicU64,
    /// Slots that each frame gets: more than one if renderer, packing or link is slower than the slots.
    pub slots_a_frame: AtomicU64,
    /// Slots for which the light of a frame must last at least, because the next may come as late.
    pub light_slots: AtomicU64,
    /// The tracker's newest exposure on the host's clock, and how long after one its sample can be read.
    sample_captured_ns: AtomicI64,
    sample_takes_ns: AtomicI64,
    /// From one sample to the next, nanoseconds; 0 while that is not known.
    sample_period_ns: AtomicI64,
    /// The slots follow the tracker.
    pub in_step: AtomicBool,
    /// Slots from one planned frame to the next, in thousandths, averaged over the last frames.
    pub stride_milli: AtomicU64,
    /// Frames wait for busy stages, and none has found a stage idle for long.
    pub queue_stands: AtomicBool,
    /// The frame that was sent last is on the medium, as far as the projector's reports tell.
    pub is_on_the_way: AtomicBool,
    /// The GPU needs about a slot or more for a frame.
    pub gpu_is_slow: AtomicBool,
    /// The longest time for which prediction may extend a body's track, nanoseconds.
    pub predict_ns: AtomicI64,
    /// Since when packing has been waiting for the GPU to finish a frame; `i64::MAX` while it does not wait.
    pub gpu_since_ns: AtomicI64,
    /// All frames of the run are planned.
    pub is_complete: AtomicBool,
    /// Stalls of the run's options that have struck.
    pub stalls: AtomicU64,
    /// Share of the last half second in which a thread that frames need was ready to run and got no core, in thousandths.
    pub starved_milli: AtomicU64,
    /// The same for any program of the machine, lately, in thousandths; 0 if the system does not say.
    pub pressure_milli: AtomicU64,
    /// For how long threads of frames got no core during the run, nanoseconds.
    pub starved_ns: AtomicI64,
    /// How long the first crew took to be made, nanoseconds; 0 if that was not measured.
    pub made_ns: AtomicI64,
    recoveries: Lock<Vec<Recovery>>,
    error: Lock<Option<PipelineError>>,
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
        monitor.samples().begin(rig.tracked_count());
        let predict_ns = Horizon::of_rig(&rig.config).predict_ns(lead.lead_ns() + RECEIPT_NS, 0, 1);
        Self {
            rig,
            monitor,
            options,
            lead_ns: AtomicI64::new(lead.lead_ns()),
            typical_ns: AtomicI64::new(lead.typical_ns()),
            travel_ns: AtomicI64::new(RECEIPT_NS),
            alive_at_ns: AtomicI64::new(now.0),
            crew_lost: AtomicBool::new(false),
            next_frame: AtomicU64::new(0),
            end_slot: AtomicU64::new(0),
            slots_a_frame: AtomicU64::new(1),
            light_slots: AtomicU64::new(1),
            stride_milli: AtomicU64::new(1000),
            queue_stands: AtomicBool::new(false),
            is_on_the_way: AtomicBool::new(false),
            gpu_is_slow: AtomicBool::new(false),
            predict_ns: AtomicI64::new(predict_ns),
            gpu_since_ns: AtomicI64::new(i64::MAX),
            is_complete: AtomicBool::new(false),
            stalls: AtomicU64::new(0),
            starved_milli: AtomicU64::new(0),
            pressure_milli: AtomicU64::new(0),
            starved_ns: AtomicI64::new(0),
            sample_captured_ns: AtomicI64::new(0),
            sample_takes_ns: AtomicI64::new(0),
            sample_period_ns: AtomicI64::new(0),
            in_step: AtomicBool::new(false),
            made_ns: AtomicI64::new(0),
            recoveries: Lock::new(Vec::new()),
            error: Lock::new(None),
        }
    }

    /// When the tracker's samples are ready; `None` while that is not known.
    pub(crate) fn rhythm(&self) -> Option<SampleRhythm> {
        let period_ns = self.sample_period_ns.load(Ordering::Relaxed);
        let captured_at = HostTime(self.sample_captured_ns.load(Ordering::Relaxed));
        let takes_ns = self.sample_takes_ns.load(Ordering::Relaxed);
        (period_ns > 0).then_some(SampleRhythm { captured_at, takes_ns, period_ns })
    }

    /// Tells when samples are ready.
    pub(crate) fn tell_rhythm(&self, rhythm: Option<SampleRhythm>) {
        if let Some(rhythm) = rhythm {
            self.sample_captured_ns.store(rhythm.captured_at.0, Ordering::Relaxed);
            self.sample_takes_ns.store(rhythm.takes_ns, Ordering::Relaxed);
        }
        self.sample_period_ns.store(rhythm.map_or(0, |rhythm| rhythm.period_ns), Ordering::Relaxed);
    }

    /// Ends the run in the dark with this error; the first error counts. Not for the frame path.
    pub(crate) fn fail(&self, error: PipelineError) {
        if let Ok(mut first) = self.error.lock() {
            first.get_or_insert(error);
        }
        self.monitor.request_stop();
    }

    /// Adds a crew that was replaced. Not for the frame path.
    pub(crate) fn recovered(&self, recovery: Recovery) {
        if let Ok(mut all) = self.recoveries.lock() {
            if all.len() < RECOVERIES_KEPT {
                all.push(recovery);
            }
        }
    }

    /// The first crews that were replaced.
    pub(crate) fn recoveries(&self) -> Vec<Recovery> {
        self.recoveries.lock().map(|all| all.clone()).unwrap_or_default()
    }

    /// Why the run failed.
    pub(crate) fn take_error(&self) -> Option<PipelineError> {
        self.error.lock().ok().and_then(|mut error| error.take())
    }

    /// The modelled costs of plan, render, pack and link at virtual pace, nanoseconds.
    pub(crate) fn modelled_costs(&self) -> [i64; 4] {
        let c = &self.rig.config.real_time.stage_costs_us;
        [c.plan, c.render, c.pack, c.send].map(|us| i64::from(us) * 1000)
    }
}

/// The GPU's queue and its time per frame, shared by planning and packing.
#[derive(Debug)]
pub(crate) struct GpuPace {
    slot_ns: i64,
    submitted: AtomicU64,
    finished: AtomicU64,
    frame_ns: AtomicI64,
    is_slow: AtomicBool,
}

impl GpuPace {
    /// Share of a slot beyond which frames are begun one at a time. A slower GPU would only queue frames up, and each
    /// frame's poses would grow old in the queue. It is above the share beyond which the budget cuts samples: a GPU
    /// that the budget holds in its slot never counts as slow.
    const SLOW: f64 = 0.96;
    /// Share below which a slow GPU is quick again.
    const QUICK: f64 = 0.9;

    /// For a GPU that took `frame_ns` for a frame while it was otherwise idle, with slots of `slot_ns`.
    pub(crate) fn new(frame_ns: i64, slot_ns: i64) -> Self {
        Self {
            slot_ns,
            submitted: AtomicU64::new(0),
            finished: AtomicU64::new(0),
            frame_ns: AtomicI64::new(frame_ns),
            is_slow: AtomicBool::new(frame_ns as f64 > Self::SLOW * slot_ns as f64),
        }
    }

    /// A frame was handed to the GPU.
    pub(crate) fn submit(&self) {
        self.submitted.fetch_add(1, Ordering::Relaxed);
    }

    /// The GPU has finished a frame, which kept it busy for `took_ns`.
    pub(crate) fn finish(&self, took_ns: i64) {
        let before = self.frame_ns.load(Ordering::Relaxed);
        let mean = if before == 0 { took_ns } else { before + (took_ns - before) / 8 };
        self.frame_ns.store(mean, Ordering::Relaxed);
        let share = if self.is_slow() { Self::QUICK } else { Self::SLOW };
        self.is_slow.store(mean as f64 > share * self.slot_ns as f64, Ordering::Relaxed);
        // Release: a reader that sees the frame finished also sees its time.
        self.finished.fetch_add(1, Ordering::Release);
    }

    /// Frames that the GPU has not finished.
    pub(crate) fn in_flight(&self) -> u64 {
        let finished = self.finished.load(Ordering::Acquire);
        self.submitted.load(Ordering::Relaxed).saturating_sub(finished)
    }

    /// True when a frame takes about a slot or more.
    pub(crate) fn is_slow(&self) -> bool {
        self.is_slow.load(Ordering::Relaxed)
    }
}

/// Facts of one crew, that is, of the stages that are restarted together.
#[derive(Debug)]
pub(crate) struct CrewFacts {
    /// The GPU.
    pub gpu: GpuPace,
    /// Largest average of samples per pixel that the GPU's times allow, in thousandths; `u64::MAX` while nothing is
    /// known of them.
    pub budget_milli: AtomicU64,
    /// Which of the shares of the raster the next frames trace.
    pub rung: AtomicUsize,
}

impl CrewFacts {
    /// For a crew that begins, on a GPU that took `frame_ns` for a frame while it was otherwise idle, with slots of `slot_ns`.
    pub(crate) fn new(frame_ns: i64, slot_ns: i64) -> Self {
        Self {
            gpu: GpuPace::new(frame_ns, slot_ns),
            budget_milli: AtomicU64::new(u64::MAX),
            rung: AtomicUsize::new(0),
        }
    }
}
