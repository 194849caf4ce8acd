//! Tracking, planning and packing as one crew: started together, watched by the supervisor, and abandoned together
//! when one of them hangs.
//!
//! A crew owns everything that it works with and passes frames to the link through a [`CrewPort`]. To abandon it, the
//! other end of the port is dropped. Whatever its threads still do when they wake up cannot reach the link, and so
//! cannot reach the light.

use super::parts::CrewParts;
use super::threads::{pack_thread, plan_thread, policy, tracking_thread, PackInbox, PlanInbox, RunState};
use crate::engine::error::PipelineError;
use crate::engine::facts::CrewFacts;
use crate::engine::pack::PackStage;
use crate::engine::pulse::{Pulse, Silence};
use crate::engine::supervision::Trouble;
use crate::frame::job::{FrameJob, FrameNote};
use crate::plan::link_time::LinkTime;
use crate::plan::scale::ScaleController;
use crate::tracks::TrackSnapshot;
use dpm_common::realtime::os::standing_of;
use dpm_device::time::HostTime;
use dpm_handoff::channel::{channel, Receiver, Sender};
use dpm_handoff::latest::{latest, Publisher, Reader};
use dpm_handoff::path::Lock;
use dpm_handoff::wake::Waiter;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::Arc;
use std::thread::JoinHandle;

/// Indices of the stages in [`CrewState::pulses`].
pub(super) const TRACKING: usize = 0;
/// See [`TRACKING`].
pub(super) const PLAN: usize = 1;
/// See [`TRACKING`].
pub(super) const PACK: usize = 2;

/// Where the link's thread receives the frames of a crew and returns them.
pub(super) struct CrewPort {
    pub(super) jobs: Receiver<FrameJob>,
    pub(super) free: Sender<FrameJob>,
    /// Publishes the projector's clock to the crew.
    pub(super) times: Publisher<LinkTime>,
    /// The newest tracks; `None` if the projector is told of none.
    pub(super) tracks: Option<Reader<TrackSnapshot>>,
}

/// What the threads of one crew share.
pub(super) struct CrewState {
    /// The crew is abandoned; nothing it does has an effect any more.
    pub(super) is_abandoned: AtomicBool,
    pub(super) tracking_over: AtomicBool,
    /// Number of the frame that is being planned.
    pub(super) planning: AtomicU64,
    /// What planning and packing share.
    pub(super) facts: Arc<CrewFacts>,
    /// Number of the frame for which packing waits, since when, nanoseconds, and by when the GPU should have finished it.
    pub(super) rendering: AtomicU64,
    pub(super) rendering_since: AtomicU64,
    pub(super) gpu: Pulse,
    pub(super) pulses: [Pulse; 3],
    /// Per stage: its thread has returned without a panic.
    pub(super) returned: [AtomicBool; 3],
    /// Why planning or packing cannot continue.
    failure: Lock<Option<PipelineError>>,
}

impl CrewState {
    /// Records that the crew cannot continue.
    pub(super) fn fail(&self, error: PipelineError) {
        if let Ok(mut first) = self.failure.lock() {
            first.get_or_insert(error);
        }
    }

    /// Tracking has ended and closed its tracker.
    pub(super) fn has_left_tracker(&self) -> bool {
        self.returned[TRACKING].load(Ordering::Acquire)
    }

    /// Packing waits for the GPU to finish `frame` from `now` on, which should take `limit_ns` at most.
    pub(super) fn waits_for_gpu(&self, frame: u64, now: HostTime, limit_ns: u64) {
        self.rendering.store(frame, Ordering::Relaxed);
        self.rendering_since.store(now.0 as u64, Ordering::Relaxed);
        self.gpu.beat(now, limit_ns as i64);
    }

    /// True when the crew's threads should end.
    pub(super) fn is_dismissed(&self, shared: &RunState) -> bool {
        self.is_abandoned.load(Ordering::Relaxed) || shared.facts.monitor.stop_requested()
    }
}

/// The threads of one crew.
pub(super) struct Crew {
    pub(super) state: Arc<CrewState>,
    tracking: JoinHandle<Option<String>>,
    others: [JoinHandle<()>; 2],
    silences: [Silence; 3],
    gpu_silence: Silence,
}

impl CrewState {
    fn new(facts: Arc<CrewFacts>) -> Self {
        Self {
            is_abandoned: AtomicBool::new(false),
            tracking_over: AtomicBool::new(false),
            planning: AtomicU64::new(0),
            facts,
            rendering: AtomicU64::new(0),
            rendering_since: AtomicU64::new(0),
            gpu: Pulse::new("GPU"),
            pulses: [Pulse::new("tracking"), Pulse::new("plan"), Pulse::new("pack")],
            returned: [const { AtomicBool::new(false) }; 3],
            failure: Lock::new(None),
        }
    }
}

impl Crew {
    /// Starts the threads. Frames come out of the port and return through it.
    ///
    /// # Errors
    /// The system cannot start a thread.
    pub(super) fn start(shared: &Arc<RunState>, parts: CrewParts) -> Result<(Self, CrewPort), PipelineError> {
        let CrewParts { tracking, renderer, packer, budget, scale, memory, first, budget_milli } = parts;
        let rig = &shared.facts.rig;
        let policy = policy(rig);
        let frame_ns = first.gpu_ns.unwrap_or(first.wall_ns);
        let facts = Arc::new(CrewFacts::new(frame_ns, rig.rate().slot_len_ns(0)));
        facts.budget_milli.store(budget_milli, Ordering::Relaxed);
        facts.rung.store(scale.as_ref().map_or(0, ScaleController::rung), Ordering::Relaxed);
        let is_software = renderer.as_ref().is_some_and(|r| r.prepared().gpu().summary().software);
        let stage = PackStage::new(shared.facts.clone(), facts.clone(), budget)
            .on_software(is_software)
            .scaling(scale);
        // There is room for all of them: no stage ever finds the next one's channel full.
        let jobs = memory.len();
        let (mut free_in, free) = channel(jobs, policy);
        let (to_pack_in, to_pack_out) = channel(jobs, policy);
        let (to_link_in, to_link_out) = channel(jobs, policy);
        for memory in memory {
            let _ = free_in.push(FrameJob { note: Box::new(FrameNote::new(rig)), memory: Box::new(memory) });
        }
        let state = Arc::new(CrewState::new(facts));
        let (publisher, reader) = latest(TrackSnapshot::empty(rig.tracked_count()));
        let (to_link, tracks) =
            rig.wants_tracks().then(|| latest(TrackSnapshot::empty(rig.tracked_count()))).unzip();
        let (times, time) = latest(shared.time);
        let gpu_free = Waiter::new(policy);
        let gpu_waker = gpu_free.waker();
        let named = |name: &'static str| std::thread::Builder::new().name(format!("dpm-{name}"));
        let refused = |stage| move |source| PipelineError::Thread { stage, source };
        // A stage that returns or panics drops its senders, which ends the next stage: nobody waits forever.
        let tracking = {
            let (shared, state) = (shared.clone(), state.clone());
            named("tracking")
                .spawn(move || {
                    let unseen = tracking_thread(&shared, &state, tracking, publisher, to_link);
                    state.returned[TRACKING].store(true, Ordering::Release);
                    unseen
                })
                .map_err(refused("tracking"))?
        };
        let plan = {
            let (shared, state) = (shared.clone(), state.clone());
            named("plan")
                .spawn(move || {
                    let _close = OnExit(|| state.tracking_over.store(true, Ordering::Release));
                    let inbox = PlanInbox { latest: reader, time, free, gpu_free };
                    plan_thread(&shared, &state, renderer, inbox, to_pack_in);
                    state.returned[PLAN].store(true, Ordering::Release);
                })
                .map_err(refused("plan"))?
        };
        let pack = {
            let (shared, state) = (shared.clone(), state.clone());
            named("pack")
                .spawn(move || {
                    let inbox = PackInbox { jobs: to_pack_out, gpu_waker };
                    pack_thread(&shared, &state, stage, packer, inbox, to_link_in);
                    state.returned[PACK].store(true, Ordering::Release);
                })
                .map_err(refused("pack"))?
        };
        let crew = Self {
            state,
            tracking,
            others: [plan, pack],
            silences: Default::default(),
            gpu_silence: Silence::default(),
        };
        Ok((crew, CrewPort { jobs: to_link_out, free: free_in, times, tracks }))
    }

    /// Checks the crew, `step_ns` after the last check. `starved_ns` looks for how long of such a step a worker got no core for which a stage may
    /// wait; it is asked only while something is overdue.
    pub(super) fn trouble(
        &mut self,
        now: HostTime,
        step_ns: i64,
        starved_ns: impl FnOnce(i64) -> i64,
    ) -> Option<Trouble> {
        let failure = self.state.failure.lock().ok().and_then(|mut f| f.take());
        if let Some(error) = failure {
            return Some(Trouble::Failed(error));
        }
        let finished =
            [self.tracking.is_finished(), self.others[0].is_finished(), self.others[1].is_finished()];
        let state = &self.state;
        let is_late = state.gpu.is_overdue(now) || state.pulses.iter().any(|pulse| pulse.is_overdue(now));
        let starved_ns = if is_late { starved_ns(step_ns) } else { 0 };
        for (i, pulse) in state.pulses.iter().enumerate() {
            if finished[i] && !state.returned[i].load(Ordering::Acquire) {
                return Some(Trouble::Panicked(pulse.name()));
            }
            if self.silences[i].observe(pulse, now, step_ns, standing_of, starved_ns) {
                return Some(Trouble::Hung(pulse.name()));
            }
        }
        if self.gpu_silence.observe(&state.gpu, now, step_ns, |_| None, starved_ns) {
            let [frame, since] =
                [&state.rendering, &state.rendering_since].map(|n| n.load(Ordering::Relaxed));
            let ms = (now.0 as u64).saturating_sub(since) / 1_000_000;
            return Some(Trouble::Failed(PipelineError::GpuHangs { frame, ms }));
        }
        None
    }

    /// Abandons the crew. Its threads end when they notice it, or with the process; each drops what is its own.
    pub(super) fn abandon(&self) {
        self.state.is_abandoned.store(true, Ordering::Relaxed);
        self.state.tracking_over.store(true, Ordering::Release);
    }

    /// True when all threads have ended.
    pub(super) fn is_over(&self) -> bool {
        self.tracking.is_finished() && self.others.iter().all(JoinHandle::is_finished)
    }

    /// Collects the result when all threads have ended: what the tracker reports about bodies that were never seen,
    /// or which stage panicked.
    pub(super) fn join(self) -> Result<Option<String>, &'static str> {
        let names = ["plan", "pack"];
        for (thread, name) in self.others.into_iter().zip(names) {
            thread.join().map_err(|_| name)?;
        }
        self.tracking.join().map_err(|_| "tracking")
    }
}

/// Calls its function when dropped, also during a panic.
pub(super) struct OnExit<F: FnMut()>(pub(super) F);

impl<F: FnMut()> Drop for OnExit<F> {
    fn drop(&mut self) {
        (self.0)();
    }
}
