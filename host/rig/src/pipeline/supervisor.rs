//! Watches every thread of a run, on a thread of its own that no stage can hold up.
//!
//! - A stage of the crew (tracking, plan, pack) that hangs, or a GPU that fails or does not finish: the crew is abandoned, so that nothing it
//!   still does reaches the light, and a new one is made. The projector is dark meanwhile: every frame says itself from when on.
//! - The link's thread or the collector hangs: nobody can take its place, so the run ends. The projector goes dark by its watchdog in the
//!   first case, and is told to in the second.
//! - A stage panics: a mistake of this program. The run ends in the dark.
//!
//! At virtual pace nobody is late, so only failures and panics count, and both end the run.

use super::crew::{Crew, CrewParts, NotesBack, Port, Trouble};
use super::outcome::PipelineError;
use super::pulse::Silence;
use super::threads::Shared;
use crossbeam::channel::{unbounded, Receiver, TryRecvError};
use dpm_common::clock::{Clock, RunClock};
use dpm_device::time::HostTime;
use dpm_handoff::channel::Sender;
use dpm_render::gpu::{AfterLoss, LossBudget};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

/// Between two looks.
const LOOK: Duration = Duration::from_millis(2);
/// How long threads that should end are waited for when the link is over.
const END_WITHIN_NS: i64 = 1_000_000_000;
/// How long a new crew may take to be made: drivers translate shaders for it.
const MADE_WITHIN_NS: i64 = super::threads::FIRST_FRAME_TIMEOUT_NS as i64;
/// Slots from frame to frame, in thousandths, from which on the operator is told that the renderer is slower than its slots.
const SLOW_MILLI: u64 = 1_500;

/// Threads of a run were left behind because they hang: the process must not wait for them when it ends.
static LEFT_BEHIND: AtomicBool = AtomicBool::new(false);

/// True when a run of this process left threads behind that hang. Whoever ends the process must not run destructors that could wait for
/// them (`_exit`, not `exit`).
pub fn has_left_threads_behind() -> bool {
    LEFT_BEHIND.load(Ordering::Relaxed)
}

/// Notes that threads are left behind.
pub(super) fn leave_behind() {
    LEFT_BEHIND.store(true, Ordering::Relaxed);
}

/// How a new crew is to be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Remake {
    /// With the GPU as it is.
    Crew,
    /// With the GPU opened anew, or another one.
    CrewAndGpu,
}

/// Makes what a new crew works with. Runs on a thread of its own.
pub(super) type Maker = Arc<dyn Fn(Remake) -> Result<CrewParts, PipelineError> + Send + Sync>;

/// The supervisor's own.
pub(super) struct Supervisor {
    pub(super) shared: Arc<Shared>,
    /// Where the link learns of a new crew.
    pub(super) ports: Sender<Port>,
    pub(super) notes_back: NotesBack,
    /// `None` at virtual pace: failures end the run.
    pub(super) maker: Option<Maker>,
    pub(super) losses: LossBudget,
}

/// Who works.
enum Shift {
    /// A crew.
    Works(Crew),
    /// Nobody; a crew is being made.
    IsMade { result: Receiver<Result<CrewParts, PipelineError>>, until: HostTime },
    /// Nobody, and nobody will.
    Over,
}

impl Supervisor {
    /// Watches until the link is over. Returns what the tracker says of bodies that were never seen.
    pub(super) fn run(mut self, crew: Crew) -> Option<String> {
        let shared = self.shared.clone();
        let clock = sleeping(&shared.clock);
        let is_virtual = shared.is_virtual();
        let (mut link, mut collector) = (Silence::default(), Silence::default());
        let mut shift = Shift::Works(crew);
        let mut last = clock.now();
        let mut told_slow = false;
        while !shared.is_link_over.load(Ordering::Acquire) {
            std::thread::sleep(LOOK);
            let now = clock.now();
            let step_ns = now.ns_since(last);
            last = now;
            if !is_virtual {
                let hung = [(&mut link, &shared.link_pulse), (&mut collector, &shared.collector_pulse)]
                    .into_iter()
                    .find_map(|(silence, pulse)| silence.observe(pulse, now, step_ns).then(|| pulse.name()));
                if let Some(stage) = hung {
                    leave_behind();
                    shared.fail(PipelineError::Hung { stage });
                    if stage == shared.link_pulse.name() {
                        shared.is_broken.store(true, Ordering::Release);
                        break;
                    }
                    // The link still makes the projector dark; but the thread that would return from the run is the one that hangs.
                    shared.monitor.give_up(PipelineError::Hung { stage }.to_string());
                    collector = Silence::default();
                }
                self.tell_if_slow(&mut told_slow);
            }
            shift = self.look(shift, now, step_ns);
        }
        self.end(shift)
    }

    /// One look at whoever works.
    fn look(&mut self, shift: Shift, now: HostTime, step_ns: i64) -> Shift {
        let shared = self.shared.clone();
        match shift {
            Shift::Works(mut crew) => {
                let step_ns = if shared.is_virtual() { 0 } else { step_ns };
                match crew.trouble(now, step_ns) {
                    Some(trouble) => self.replace(crew, trouble, now),
                    None => {
                        shared.alive_at_ns.store(now.0, Ordering::Relaxed);
                        Shift::Works(crew)
                    }
                }
            }
            Shift::IsMade { result, until } => match result.try_recv() {
                Ok(Ok(parts)) => self.begin(parts),
                Ok(Err(error)) => {
                    shared.fail(error);
                    Shift::Over
                }
                Err(TryRecvError::Empty) if now < until && !shared.monitor.stop_requested() => {
                    Shift::IsMade { result, until }
                }
                Err(TryRecvError::Empty) => {
                    // Whoever makes it may hang in a driver.
                    leave_behind();
                    shared.fail(PipelineError::Hung { stage: "GPU" });
                    Shift::Over
                }
                Err(TryRecvError::Disconnected) => {
                    shared.fail(PipelineError::Panicked("GPU"));
                    Shift::Over
                }
            },
            Shift::Over => Shift::Over,
        }
    }

    fn begin(&mut self, parts: CrewParts) -> Shift {
        match Crew::start(&self.shared, parts, &self.notes_back) {
            Ok((crew, port)) => {
                // There is room: the link takes ports within a millisecond, and crews come seconds apart.
                let _ = self.ports.push(port);
                self.shared.monitor.note("new stages are at work; the picture is back".into());
                Shift::Works(crew)
            }
            Err(error) => {
                self.shared.fail(error);
                Shift::Over
            }
        }
    }

    /// Abandons a crew that is in trouble and has a new one made, if that can help.
    fn replace(&mut self, crew: Crew, trouble: Trouble, now: HostTime) -> Shift {
        let shared = &self.shared;
        let (error, remake) = match trouble {
            Trouble::Panicked(stage) => {
                shared.fail(PipelineError::Panicked(stage));
                return Shift::Works(crew);
            }
            Trouble::Failed(error @ (PipelineError::Gpu { .. } | PipelineError::GpuHangs { .. })) => {
                (error, Remake::CrewAndGpu)
            }
            Trouble::Failed(error) => (error, Remake::Crew),
            // Planning and packing call the GPU's driver, which may be what hangs.
            Trouble::Hung(stage @ "tracking") => (PipelineError::Hung { stage }, Remake::Crew),
            Trouble::Hung(stage) => (PipelineError::Hung { stage }, Remake::CrewAndGpu),
        };
        let hangs = matches!(error, PipelineError::Hung { .. } | PipelineError::GpuHangs { .. });
        if hangs {
            leave_behind();
        }
        let is_ending = shared.monitor.stop_requested() || shared.is_complete.load(Ordering::Acquire);
        let Some(maker) = self.maker.clone().filter(|_| !is_ending) else {
            crew.abandon();
            shared.fail(error);
            return Shift::Over;
        };
        crew.abandon();
        if self.losses.lost(now) == AfterLoss::GiveUp {
            shared.fail(PipelineError::KeepsFailing { last: error.to_string() });
            return Shift::Over;
        }
        shared
            .monitor
            .note(format!("{}; the stages are made anew, dark meanwhile", trouble_in_words(&error)));
        let (done, result) = unbounded();
        let made = std::thread::Builder::new().name("dpm-remake".into()).spawn(move || {
            let _ = done.send(maker(remake));
        });
        match made {
            Ok(_) => Shift::IsMade { result, until: now.plus_ns(MADE_WITHIN_NS) },
            Err(source) => {
                shared.fail(PipelineError::Thread { stage: "remake", source });
                Shift::Over
            }
        }
    }

    /// Says once when the renderer turns out slower than its slots, and when it is quick again.
    fn tell_if_slow(&self, told: &mut bool) {
        let stride = self.shared.stride_milli.load(Ordering::Relaxed);
        let is_slow = stride >= SLOW_MILLI;
        if is_slow == *told {
            return;
        }
        *told = is_slow;
        let hz = self.shared.rig.rate().hz();
        self.shared.monitor.note(if is_slow {
            let every = stride as f64 / 1e3;
            format!(
                "the renderer is slower than its slots: every {every:.1}th slot gets a frame, {:.1} of {hz:.1} a second; \
                 a smaller raster, fewer samples (render.spp) or another method make it faster",
                hz / every
            )
        } else {
            format!("the renderer keeps up: every slot of {hz:.1} a second gets a frame")
        });
    }

    /// Waits a little for the threads that should end now.
    fn end(self, shift: Shift) -> Option<String> {
        let Shift::Works(crew) = shift else { return None };
        crew.state.tracking_over.store(true, Ordering::Release);
        let (begin, mut waited_ns) = (dpm_common::clock::Stopwatch::start(), 0);
        while !crew.is_over() && (waited_ns < END_WITHIN_NS || self.shared.is_virtual()) {
            std::thread::sleep(LOOK);
            waited_ns = begin.elapsed_ns() as i64;
        }
        if !crew.is_over() {
            leave_behind();
            crew.abandon();
            return None;
        }
        crew.join().unwrap_or_else(|stage| {
            self.shared.fail(PipelineError::Panicked(stage));
            None
        })
    }
}

/// What happened, for the operator.
fn trouble_in_words(error: &PipelineError) -> String {
    match error {
        PipelineError::Hung { stage } => format!("the {stage} stage hangs and is abandoned"),
        error => error.to_string(),
    }
}

/// The run's clock for a thread that must not spin.
fn sleeping(clock: &Arc<RunClock>) -> Arc<dyn Clock> {
    match &**clock {
        RunClock::Real(clock) => Arc::new(clock.sleeping()),
        RunClock::Virtual(_) => clock.clone(),
    }
}

/// Waits for the end of a thread for at most `limit`; `None` when it goes on.
pub(super) fn join_within<T>(
    thread: std::thread::JoinHandle<T>,
    limit: Duration,
) -> Option<std::thread::Result<T>> {
    let watch = dpm_common::clock::Stopwatch::start();
    while !thread.is_finished() {
        if u128::from(watch.elapsed_ns()) >= limit.as_nanos() {
            leave_behind();
            return None;
        }
        std::thread::sleep(LOOK);
    }
    Some(thread.join())
}
