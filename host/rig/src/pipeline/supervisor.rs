//! The supervisor's thread, which no stage can delay. It checks every other thread and carries out what
//! [`Supervision`] decides.

use super::crew::{Crew, CrewPort, CrewState};
use super::parts::CrewParts;
use super::threads::RunState;
use crate::engine::error::PipelineError;
use crate::engine::facts::Facts;
use crate::engine::pulse::Pulse;
use crate::engine::supervision::{CrewVerdict, Irreplaceable, Making, Remake, Supervision, Trouble};
use crossbeam::channel::{unbounded, Receiver, Sender, TryRecvError};
use dpm_common::clock::{Clock, Stopwatch};
use dpm_common::realtime::os::processor_pressure;
use dpm_common::realtime::starvation::{is_worker, Starvation};
use dpm_device::time::HostTime;
use dpm_handoff::channel::Sender as PortSender;
use dpm_render::gpu::devices_unfinished;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

/// Time between two checks.
const LOOK: Duration = Duration::from_millis(2);
/// How long the next crew waits for the tracker of an abandoned one, nanoseconds. A tracking thread that hangs keeps it.
const TRACKER_FREE_WITHIN_NS: u64 = 50_000_000;
/// Time between two looks at how the machine serves the run, nanoseconds.
const SHORTAGE_NS: i64 = 500_000_000;
/// When the link is over, how long to wait for threads that should end, nanoseconds.
const END_WITHIN_NS: u64 = 1_000_000_000;

/// Hung threads of a run were left behind; the process must not wait for them when it ends.
static LEFT_BEHIND: AtomicBool = AtomicBool::new(false);

/// True when a run of this process left hung threads behind, or a driver has not finished with a device that was given up. The
/// end of the process must not run destructors that could wait for them (`_exit`, not `exit`).
pub fn has_left_threads_behind() -> bool {
    LEFT_BEHIND.load(Ordering::Relaxed) || devices_unfinished() > 0
}

/// Records that threads are left behind.
pub fn leave_behind() {
    LEFT_BEHIND.store(true, Ordering::Relaxed);
}

/// Makes the parts of a new crew. Runs on a thread of its own.
pub(super) type Maker = Arc<dyn Fn(Remake) -> Result<CrewParts, PipelineError> + Send + Sync>;

/// The supervisor's state.
pub(super) struct Supervisor {
    pub(super) shared: Arc<RunState>,
    pub(super) mind: Supervision,
    /// Informs the link of a new crew.
    pub(super) ports: PortSender<CrewPort>,
    pub(super) maker: Maker,
    pub(super) workshop: Workshop,
    pub(super) wreckage: Wreckage,
}

/// Where crews are made that take over: a thread that begins with the first of them and lives as long as the run. A thread for
/// each would have memory of its own for all that it allocates (an arena of the C library), and each would keep some.
#[derive(Default)]
pub(super) struct Workshop(Option<(Sender<Order>, Receiver<Made>)>);

/// How to make a crew, and the one before it.
type Order = (Remake, Arc<CrewState>);
type Made = Result<CrewParts, PipelineError>;

impl Workshop {
    /// Orders a crew in the place of `before`.
    fn order(&mut self, maker: &Maker, remake: Remake, before: Arc<CrewState>) -> std::io::Result<()> {
        if self.0.is_none() {
            let ((orders, ordered), (done, made)) = (unbounded::<Order>(), unbounded());
            let maker = maker.clone();
            std::thread::Builder::new().name("dpm-remake".into()).spawn(move || {
                for (remake, before) in ordered {
                    // The next crew opens the same tracker, whose port has one owner.
                    let watch = Stopwatch::start();
                    while !before.has_left_tracker() && watch.elapsed_ns() < TRACKER_FREE_WITHIN_NS {
                        std::thread::sleep(LOOK);
                    }
                    drop(before);
                    if done.send(maker(remake)).is_err() {
                        break;
                    }
                }
            })?;
            self.0 = Some((orders, made));
        }
        if let Some((orders, _)) = &self.0 {
            // Where the thread has panicked, `made` tells.
            let _ = orders.send((remake, before));
        }
        Ok(())
    }

    /// The crew that was ordered, if it is ready.
    fn made(&self) -> Result<Made, TryRecvError> {
        self.0.as_ref().map_or(Err(TryRecvError::Disconnected), |(_, made)| made.try_recv())
    }
}

/// Crews that were abandoned and have not ended. What a crew owns is freed by its own threads, each when it ends, so nothing
/// here has to be done for that.
#[derive(Default)]
pub(super) struct Wreckage {
    crews: Vec<Crew>,
}

impl Wreckage {
    /// Abandons a crew.
    fn take(&mut self, crew: Crew) {
        crew.abandon();
        self.crews.push(crew);
    }

    /// Forgets those that have ended.
    fn look(&mut self) {
        self.crews.retain(|crew| !crew.is_over());
    }
}

/// Whether the machine has too little processor time for this run.
struct Shortage {
    /// Workers of drivers, looked at while a stage is overdue.
    workers: Starvation,
    /// All threads that frames need, looked at now and then.
    needed: Starvation,
    looked_at: Option<HostTime>,
}

impl Shortage {
    /// For a run whose collector, which draws nothing, is the thread of this pulse.
    fn new(collector: &Pulse) -> Self {
        let [workers, needed] =
            [is_worker, is_needed].map(|wanted| Starvation::of(wanted, collector.thread()));
        Self { workers, needed, looked_at: None }
    }
}

/// Threads without which no frame is lit.
fn is_needed(name: &str) -> bool {
    ["dpm-tracking", "dpm-plan", "dpm-pack", "dpm-link"].contains(&name) || is_worker(name)
}

impl Shortage {
    /// Tells the run for which share of the last half second a thread that frames need starved.
    fn look(&mut self, facts: &Facts, now: HostTime) {
        let span_ns = self.looked_at.map_or(SHORTAGE_NS, |at| now.ns_since(at));
        if span_ns < SHORTAGE_NS {
            return;
        }
        self.looked_at = Some(now);
        let milli = self.needed.share_milli(now.0);
        facts.starved_milli.store(milli as u64, Ordering::Relaxed);
        let pressure = processor_pressure().map_or(0, |share| (share * 1000.0) as u64);
        facts.pressure_milli.store(pressure, Ordering::Relaxed);
        facts.starved_ns.fetch_add(span_ns / 1000 * milli, Ordering::Relaxed);
    }

    /// For how long of the last `step_ns` a worker starved for which a stage may wait, nanoseconds.
    fn of_workers_ns(&mut self, now: HostTime, step_ns: i64) -> i64 {
        step_ns.max(0) / 1000 * self.workers.share_milli(now.0)
    }
}

/// Who is working.
enum Shift {
    /// A crew.
    Works(Box<Crew>),
    /// Nobody; a new crew is being made, by a thread that may hang in a driver.
    IsMade,
    /// Nobody, and no crew will follow.
    Over,
}

impl Supervisor {
    /// Supervises until the link is over. Returns what the tracker reports about bodies that were never seen.
    pub(super) fn run(mut self, crew: Crew) -> Option<String> {
        let shared = self.shared.clone();
        let clock = shared.clock.sleeping();
        let mut shortage = Shortage::new(&shared.collector_pulse);
        let mut shift = Shift::Works(Box::new(crew));
        let mut last = clock.now();
        while !shared.is_link_over.load(Ordering::Acquire) {
            std::thread::sleep(LOOK);
            let now = clock.now();
            let step_ns = now.ns_since(last);
            last = now;
            let hung = self.mind.watch(&shared.link_pulse, &shared.collector_pulse, now, step_ns);
            if hung.is_some() {
                leave_behind();
            }
            self.wreckage.look();
            shortage.look(&shared.facts, now);
            if hung == Some(Irreplaceable::Link) {
                shared.is_broken.store(true, Ordering::Release);
                break;
            }
            shift = self.look(shift, now, step_ns, &mut shortage);
        }
        self.end(shift)
    }

    /// One check of the current shift.
    fn look(&mut self, shift: Shift, now: HostTime, step_ns: i64, shortage: &mut Shortage) -> Shift {
        match shift {
            Shift::Works(mut crew) => {
                match crew.trouble(now, step_ns, |ns| shortage.of_workers_ns(now, ns)) {
                    Some(trouble) => self.replace(crew, trouble, now),
                    None => {
                        self.mind.is_well(now);
                        Shift::Works(crew)
                    }
                }
            }
            Shift::IsMade => match self.workshop.made() {
                Ok(Ok(parts)) => self.begin(parts),
                Ok(Err(error)) => self.waits(Making::Failed(error), now),
                Err(TryRecvError::Empty) => self.waits(Making::Waits, now),
                Err(TryRecvError::Disconnected) => self.waits(Making::Panicked, now),
            },
            Shift::Over => Shift::Over,
        }
    }

    /// No new crew is ready yet.
    fn waits(&self, making: Making, now: HostTime) -> Shift {
        // The thread that makes the crew may hang in a driver.
        let may_hang = matches!(making, Making::Waits);
        if self.mind.waits_for(making, now) {
            return Shift::IsMade;
        }
        if may_hang {
            leave_behind();
        }
        Shift::Over
    }

    fn begin(&mut self, parts: CrewParts) -> Shift {
        match Crew::start(&self.shared, parts) {
            Ok((crew, port)) => {
                // There is room: the link takes ports within a millisecond, and crews are seconds apart.
                let _ = self.ports.push(port);
                self.mind.is_remade();
                Shift::Works(Box::new(crew))
            }
            Err(error) => {
                self.shared.facts.fail(error);
                Shift::Over
            }
        }
    }

    /// Abandons a crew that is in trouble and starts making a new one, if that can help.
    fn replace(&mut self, crew: Box<Crew>, trouble: Trouble, now: HostTime) -> Shift {
        let remake = match self.mind.judge(trouble, now) {
            CrewVerdict::End => return Shift::Works(crew),
            CrewVerdict::Abandon { remake } => remake,
        };
        let state = crew.state.clone();
        self.wreckage.take(*crew);
        let Some(remake) = remake else { return Shift::Over };
        match self.workshop.order(&self.maker, remake, state) {
            Ok(()) => Shift::IsMade,
            Err(source) => {
                self.shared.facts.fail(PipelineError::Thread { stage: "remake", source });
                Shift::Over
            }
        }
    }

    /// Waits briefly for the threads that should end now.
    fn end(mut self, shift: Shift) -> Option<String> {
        self.mind.tell_of_recovery(None);
        let crew = match shift {
            Shift::Works(crew) => Some(crew),
            Shift::IsMade => {
                leave_behind();
                None
            }
            Shift::Over => None,
        };
        if let Some(crew) = &crew {
            crew.state.tracking_over.store(true, Ordering::Release);
        }
        let begin = Stopwatch::start();
        // Nobody waits for crews that were abandoned: the report must be written in time.
        while crew.as_ref().is_some_and(|crew| !crew.is_over()) && begin.elapsed_ns() < END_WITHIN_NS {
            std::thread::sleep(LOOK);
        }
        self.wreckage.look();
        if !self.wreckage.crews.is_empty() {
            leave_behind();
        }
        let crew = crew?;
        if !crew.is_over() {
            leave_behind();
            crew.abandon();
            return None;
        }
        crew.join().unwrap_or_else(|stage| {
            self.shared.facts.fail(PipelineError::Panicked(stage));
            None
        })
    }
}

/// Waits at most `limit` for the end of a thread; `None` if it is still running.
pub(super) fn join_within<T>(
    thread: std::thread::JoinHandle<T>,
    limit: Duration,
) -> Option<std::thread::Result<T>> {
    let watch = Stopwatch::start();
    while !thread.is_finished() {
        if u128::from(watch.elapsed_ns()) >= limit.as_nanos() {
            leave_behind();
            return None;
        }
        std::thread::sleep(LOOK);
    }
    Some(thread.join())
}
