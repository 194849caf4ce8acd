//! Detects which thread has fallen silent, and decides what to do.
//!
//! - A stage of the crew (tracking, plan, pack) hangs, or a GPU fails or does not finish: the crew is abandoned, so
//!   that nothing it still does reaches the light, and a new one is made. Meanwhile the projector goes dark, because
//!   every frame carries the instant at which its light ends.
//! - The link's thread or the collector hangs: nobody can replace it. The link may go on within two seconds, in which the
//!   projector goes dark by itself; otherwise the run ends. If the collector hangs the run ends, and the link darkens the
//!   projector.
//! - A stage panics: this is a bug. The run ends in the dark.

use super::error::PipelineError;
use super::facts::Facts;
use super::pulse::{Pulse, Silence, StandingOf};
use super::slowness::{told, SlowBy, Slowness, STARVED_MILLI};
use crate::telemetry::monitor::{ProjectorHealth, RunCounts};
use crate::telemetry::report::Recovery;
use crate::tracks::keys::told as contradicted;
use dpm_device::time::HostTime;
use dpm_render::gpu::{AfterLoss, Gpu, LossBudget};
use std::sync::atomic::Ordering;
use std::sync::Arc;

/// Crews that a minute may cost whose stages hang while the GPU is well: each is dark for less than a second.
const MOST_HUNG: usize = 20;
/// A link that hangs for longer does not come back: nobody can send orders to the projector meanwhile.
const LINK_RETURNS_NS: i64 = 2_000_000_000;
/// How long it may take to make a new crew, nanoseconds: drivers translate shaders for it.
const MADE_WITHIN_NS: i64 = 180_000_000_000;
/// The operator is informed that a frame stays on the GPU after this time, nanoseconds. A GPU that is still warming up
/// is given up later than that.
const STAYS_AFTER_NS: i64 = 1_000_000_000;
/// What the link's thread last told of the light counts for so long, nanoseconds.
const LINK_SILENT_NS: i64 = 900_000_000;
/// A frame that has been on the GPU for so long is what keeps the light away, nanoseconds.
const HOLDS_UP_NS: i64 = 100_000_000;
/// The operator is informed that frames are made and none is lit after [`STAYS_AFTER_NS`] and so many frames: a slow renderer
/// has fewer on the way.
const UNLIT_FRAMES: u64 = 8;

/// What is wrong with a crew.
#[derive(Debug)]
pub(crate) enum Trouble {
    /// A stage does not answer.
    Hung(&'static str),
    /// A stage panicked, which is a bug.
    Panicked(&'static str),
    /// The GPU failed or does not finish.
    Failed(PipelineError),
}

impl Trouble {
    /// A stage that hangs may do so in a call of the GPU's driver: whoever makes the next crew asks the GPU.
    fn remake(&self) -> Remake {
        match self {
            Self::Failed(PipelineError::Gpu { .. } | PipelineError::GpuHangs { .. }) => Remake::CrewAndGpu,
            Self::Failed(_) | Self::Panicked(_) | Self::Hung(_) => Remake::Crew,
        }
    }

    /// A description for the operator.
    fn in_words(&self) -> String {
        match self {
            Self::Hung(stage) => format!("the {stage} stage hangs and is abandoned"),
            Self::Failed(error) => error.to_string(),
            Self::Panicked(stage) => PipelineError::Panicked(stage).to_string(),
        }
    }

    fn into_error(self) -> PipelineError {
        match self {
            Self::Hung(stage) => PipelineError::Hung { stage },
            Self::Failed(error) => error,
            Self::Panicked(stage) => PipelineError::Panicked(stage),
        }
    }
}

/// How to make a new crew.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Remake {
    /// With the same GPU if it answers, and else as below.
    Crew,
    /// With the GPU reopened, or another one.
    CrewAndGpu,
}

/// What to do with a crew that is in trouble.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CrewVerdict {
    /// The run ends; the crew ends by itself.
    End,
    /// The crew is abandoned. Then a new crew is made, or with `None` the run ends.
    Abandon {
        /// How to make the next crew.
        remake: Option<Remake>,
    },
}

/// The state of making a new crew.
#[derive(Debug)]
pub(crate) enum Making {
    /// It is in progress.
    Waits,
    /// It ended with an error.
    Failed(PipelineError),
    /// The thread that makes it panicked.
    Panicked,
}

/// A thread that cannot be replaced hangs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Irreplaceable {
    /// The link's thread: nobody can send orders to the projector any more.
    Link,
    /// The collector's thread, which would return from the run.
    Collector,
}

/// The supervisor's decisions.
pub(crate) struct Supervision {
    facts: Arc<Facts>,
    losses: LossBudget,
    /// Of crews that are replaced on the same GPU.
    hung: LossBudget,
    /// Frames that had light on some body, and when the last of them was seen.
    lit: (u64, HostTime),
    /// What the last crew was replaced for, and when the last light before was seen, while none has followed.
    recovering: Option<(String, HostTime)>,
    /// The crew that took over works.
    is_back: bool,
    link: Silence,
    collector: Silence,
    /// The operator was told that the link hangs.
    link_hangs: bool,
    ask: StandingOf,
    made_by: HostTime,
    slowness: Slowness,
    /// Since when the GPU has had the frame of which the operator was last informed.
    told_of_ns: i64,
    unlit: Unlit,
    /// What the link's thread had told of the light when it last did, and when that was.
    link_told: (u64, HostTime),
    /// The last light after which the operator was informed that frames on the GPU hold it up.
    told_after: Option<HostTime>,
}

/// Frames are made, and none reaches the light: a cable that damages all of them looks like a link that is up.
#[derive(Debug, Default)]
struct Unlit {
    /// Frames that were lit, or dark as they were meant to be, until the last one was, as the collector and the projector
    /// count them: a collector that has fallen silent is another trouble. And frames planned then.
    results: u64,
    planned: u64,
    /// When that was; `None`: nothing has been looked at.
    ended_at: Option<HostTime>,
    /// The same, or later: when no frame had been planned since.
    at: HostTime,
    is_told: bool,
}

impl Unlit {
    /// Looks at the counters of a run, and at the projector's of `lit` frames. What the operator is to be told: `Some(true)`,
    /// no frame is lit; `Some(false)`, they are lit again.
    fn observe(&mut self, counts: &RunCounts, lit: u64, is_up: bool, now: HostTime) -> Option<bool> {
        let results = counts.frames_lit + counts.frames_dark + counts.frames_withheld + lit;
        if !is_up || results != self.results || self.ended_at.is_none() {
            let are_lit_again = self.is_told && results != self.results;
            let is_told = self.is_told && !are_lit_again;
            *self = Self { results, planned: counts.frames_planned, ended_at: Some(now), at: now, is_told };
            return are_lit_again.then_some(false);
        }
        if counts.frames_planned <= self.planned {
            self.at = now;
        }
        let is_long = now.ns_since(self.at) >= STAYS_AFTER_NS;
        if self.is_told || !is_long || counts.frames_planned < self.planned + UNLIT_FRAMES {
            return None;
        }
        self.is_told = true;
        Some(true)
    }

    /// True if nothing has been lit for a second.
    fn is_long(&self, now: HostTime) -> bool {
        self.ended_at.is_some_and(|at| now.ns_since(at) >= STAYS_AFTER_NS)
    }
}

/// Why the operator is told of the frame that the GPU works on.
#[derive(Debug, PartialEq, Eq)]
enum OnGpu {
    /// It has worked on this frame for a second.
    Stays,
    /// No frame has been lit for a second, and each of several took long, though less than that.
    HoldsUp,
}

impl OnGpu {
    /// For a frame that has been on the GPU for `held_ns`.
    fn told(held_ns: i64, unlit: &Unlit, now: HostTime) -> Option<Self> {
        match held_ns {
            STAYS_AFTER_NS.. => Some(Self::Stays),
            HOLDS_UP_NS.. if unlit.is_long(now) => Some(Self::HoldsUp),
            _ => None,
        }
    }
}

impl Supervision {
    /// For a run that begins. `ask` looks up what an overdue thread is doing.
    pub(crate) fn new(facts: Arc<Facts>, ask: StandingOf) -> Self {
        Self {
            facts,
            losses: LossBudget::default(),
            hung: LossBudget::new(MOST_HUNG, LossBudget::WITHIN_NS),
            lit: (0, HostTime(0)),
            recovering: None,
            is_back: false,
            link: Silence::default(),
            collector: Silence::default(),
            link_hangs: false,
            ask,
            made_by: HostTime(i64::MAX),
            slowness: Slowness::default(),
            told_of_ns: i64::MAX,
            unlit: Unlit::default(),
            link_told: (0, HostTime(i64::MAX)),
            told_after: None,
        }
    }

    /// Checks the threads that cannot be replaced, `step_ns` after the last check. Ends the run when one of them
    /// hangs.
    pub(crate) fn watch(
        &mut self,
        link: &Pulse,
        collector: &Pulse,
        now: HostTime,
        step_ns: i64,
    ) -> Option<Irreplaceable> {
        self.watch_light(now);
        self.tell_if_slow(now);
        let frames_lit = self.facts.monitor.counts().frames_lit;
        if frames_lit != self.lit.0 {
            self.lit = (frames_lit, now);
            self.tell_of_recovery(Some(now));
        }
        self.tell_if_nothing_is_lit(now);
        self.tell_if_gpu_stays(now);
        self.tell_of_keys();
        let link_hangs = self.link.observe(link, now, step_ns, self.ask, 0);
        if link_hangs && (self.facts.monitor.stop_requested() || self.link.silent_ns() > LINK_RETURNS_NS) {
            self.facts.fail(PipelineError::Hung { stage: link.name() });
            return Some(Irreplaceable::Link);
        }
        if link_hangs != self.link_hangs && (link_hangs || !link.is_overdue(now)) {
            self.link_hangs = link_hangs;
            self.facts.monitor.note(match link_hangs {
                true => format!(
                    "the link's thread hangs; the projector is dark by itself meanwhile, no order reaches it, and the run ends if the \
                     thread does not go on within {} s",
                    LINK_RETURNS_NS / 1_000_000_000
                ),
                false => "the link's thread goes on".into(),
            });
        }
        if self.collector.observe(collector, now, step_ns, self.ask, 0) {
            let hung = PipelineError::Hung { stage: collector.name() };
            // The link still darkens the projector, but the thread that would return from the run is the one that
            // hangs.
            self.facts.monitor.give_up(hung.to_string());
            self.facts.fail(hung);
            self.collector = Silence::default();
            return Some(Irreplaceable::Collector);
        }
        None
    }

    /// What the link's thread told of the light holds while it goes on, whether it hangs or gets no core. The light
    /// itself grows old in any case: what was seen last may have been seen long before the thread fell silent.
    fn watch_light(&mut self, now: HostTime) {
        let gauge = self.facts.monitor.light_gauge();
        gauge.pass(now);
        let tellings = gauge.tellings();
        if tellings != self.link_told.0 || self.link_told.1 > now {
            self.link_told = (tellings, now);
        }
        gauge.set_link_silent(tellings > 0 && now.ns_since(self.link_told.1) >= LINK_SILENT_NS);
    }

    /// The crew was found working at `now`.
    pub(crate) fn is_well(&self, now: HostTime) {
        self.facts.monitor.light_gauge().set_restarts(false);
        self.facts.alive_at_ns.store(now.0, Ordering::Relaxed);
    }

    /// Decides what to do with a crew in `trouble`.
    pub(crate) fn judge(&mut self, trouble: Trouble, now: HostTime) -> CrewVerdict {
        let facts = self.facts.clone();
        facts.gpu_since_ns.store(i64::MAX, Ordering::Relaxed);
        facts.crew_lost.store(true, Ordering::Relaxed);
        if let Trouble::Panicked(_) = trouble {
            facts.fail(trouble.into_error());
            return CrewVerdict::End;
        }
        let remake = trouble.remake();
        if facts.monitor.stop_requested() {
            // The light ends anyway, and nothing of the run is lost by it.
            facts.monitor.note(format!("{}, while the run ends", trouble.in_words()));
            return CrewVerdict::Abandon { remake: None };
        }
        if facts.is_complete.load(Ordering::Acquire) {
            facts.fail(trouble.into_error());
            return CrewVerdict::Abandon { remake: None };
        }
        let (budget, most) = match remake {
            Remake::Crew => (&mut self.hung, MOST_HUNG),
            Remake::CrewAndGpu => (&mut self.losses, LossBudget::MOST),
        };
        if budget.lost(now) == AfterLoss::GiveUp {
            facts.fail(PipelineError::KeepsFailing { most, last: trouble.into_error().to_string() });
            return CrewVerdict::Abandon { remake: None };
        }
        let bound = match remake {
            Remake::Crew => String::new(),
            Remake::CrewAndGpu => format!("; {}", until_gpu_is_back(&facts)),
        };
        facts.monitor.note(format!(
            "{}; the stages are restarted, and the projector is dark meanwhile{bound}",
            trouble.in_words()
        ));
        let mut since = if self.lit.0 == 0 { now } else { self.lit.1 };
        if let Some((cause, before)) = self.recovering.take() {
            facts.recovered(Recovery { cause, dark_s: None });
            since = before;
        }
        self.recovering = Some((trouble.in_words(), since));
        self.is_back = false;
        facts.monitor.light_gauge().set_restarts(true);
        self.made_by = now.plus_ns(MADE_WITHIN_NS);
        CrewVerdict::Abandon { remake: Some(remake) }
    }

    /// A new crew is not ready yet. True while the run waits for it. Otherwise the run ends or has ended, and `Making::Waits`
    /// means that the thread that makes the crew may hang in a driver.
    pub(crate) fn waits_for(&self, making: Making, now: HostTime) -> bool {
        let error = match making {
            Making::Panicked => PipelineError::Panicked("GPU"),
            // Whoever makes the crew is left behind. The projector is dark, and the run ends in order.
            _ if self.facts.monitor.stop_requested() => return false,
            Making::Waits if now < self.made_by => return true,
            Making::Waits => PipelineError::Hung { stage: "GPU" },
            Making::Failed(error) => error,
        };
        self.facts.fail(error);
        false
    }

    /// Informs the operator that the GPU has had a frame for long: once for each frame, and of frames that are shorter
    /// once until one is lit.
    fn tell_if_gpu_stays(&mut self, now: HostTime) {
        let since_ns = self.facts.gpu_since_ns.load(Ordering::Relaxed);
        let held_ns = now.0.saturating_sub(since_ns);
        let Some(why) = OnGpu::told(held_ns, &self.unlit, now) else { return };
        let is_told = match why {
            OnGpu::Stays => std::mem::replace(&mut self.told_of_ns, since_ns) == since_ns,
            OnGpu::HoldsUp => {
                let after = self.unlit.ended_at;
                std::mem::replace(&mut self.told_after, after) == after
            }
        };
        if is_told {
            return;
        }
        self.facts.monitor.note(match why {
            OnGpu::Stays => {
                "the GPU has worked on one frame for a second, and nothing new is lit meanwhile; if it does not finish \
                 it is given up and opened again"
                    .into()
            }
            OnGpu::HoldsUp => format!(
                "no frame has been lit for a second, because the GPU takes long: it has worked on this one for {} ms",
                held_ns / 1_000_000
            ),
        });
    }

    /// Informs the operator once when frames are made and none is lit for a second, and when they are lit again.
    fn tell_if_nothing_is_lit(&mut self, now: HostTime) {
        let monitor = &self.facts.monitor;
        let is_up = monitor.projector() == ProjectorHealth::Up;
        let lit = monitor.link().lit_by_device();
        let Some(is_unlit) = self.unlit.observe(&monitor.counts(), lit, is_up, now) else { return };
        if !is_unlit {
            return monitor.note("frames are lit again".into());
        }
        let why = monitor.carried().device.map_or_else(String::new, |d| {
            format!(
                "; so far {} packets came damaged to the projector, {} frames incomplete, and {} too late; is the cable \
                 whole and fast enough? `dpm link-test` measures it",
                d.damaged_packets, d.incomplete, d.too_late
            )
        });
        monitor.note(format!("no frame has been lit for a second, although frames are made{why}"));
    }

    /// Keeps what the last crew was replaced for, with the time until light followed: at `lit_at`, or `None` if the run ends before.
    pub(crate) fn tell_of_recovery(&mut self, lit_at: Option<HostTime>) {
        if let (Some((_, since)), Some(at), false) = (&mut self.recovering, lit_at, self.is_back) {
            // A frame that the old crew had still sent.
            *since = at;
            return;
        }
        let Some((cause, since)) = self.recovering.take() else { return };
        let dark_s = lit_at.map(|at| at.ns_since(since) as f64 * 1e-9);
        if let Some(dark_s) = dark_s {
            self.facts.monitor.note(format!("light again after {dark_s:.2} s"));
        }
        self.facts.recovered(Recovery { cause, dark_s });
    }

    /// A new crew works.
    pub(crate) fn is_remade(&mut self) {
        self.is_back = true;
        self.facts.monitor.note("the stages are running again; the picture is back".into());
    }

    /// Informs the operator of keys that the motion of a body contradicts.
    fn tell_of_keys(&self) {
        let Facts { monitor, rig, .. } = &*self.facts;
        let prediction = &rig.config.prediction;
        let keys = [
            ("prediction.acceleration", prediction.acceleration, "m/s^2"),
            ("prediction.angular_acceleration", prediction.angular_acceleration, "rad/s^2"),
        ];
        for (body, key, level) in monitor.samples().take_contradicted() {
            if let Some(body) = rig.bodies.get(body) {
                monitor.note(contradicted(&body.name, level, keys[key]));
            }
        }
    }

    /// Informs the operator when frames come for every n-th slot only, and when they come for each slot again.
    fn tell_if_slow(&mut self, now: HostTime) {
        let facts = &self.facts;
        if !facts.options.tells_slow {
            return;
        }
        let stride_milli = facts.stride_milli.load(Ordering::Relaxed);
        if let Some(is_slow) = self.slowness.observe(stride_milli, now) {
            let starved = facts.starved_milli.load(Ordering::Relaxed);
            let by = if starved >= STARVED_MILLI {
                SlowBy::Machine {
                    starved_milli: starved,
                    pressure_milli: facts.pressure_milli.load(Ordering::Relaxed),
                }
            } else if facts.gpu_is_slow.load(Ordering::Relaxed) {
                SlowBy::Renderer
            } else {
                SlowBy::Rest
            };
            facts.monitor.note(told(is_slow, stride_milli, facts.rig.rate().hz(), by));
        }
    }
}

/// How long the light may stay away while a GPU is opened again, for the operator.
pub(crate) fn until_gpu_is_back(facts: &Facts) -> String {
    let made_s = facts.made_ns.load(Ordering::Relaxed) as f64 * 1e-9;
    format!(
        "the GPU is opened again within {} s or another one is tried, its programs and the first frames took {made_s:.1} s at \
         the start of the run, and after {} s the run ends",
        Gpu::COMES_BACK_WITHIN.as_secs(),
        MADE_WITHIN_NS / 1_000_000_000
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_of_frames_of_which_none_is_lit_is_told_once_and_its_end_too() {
        let mut unlit = Unlit::default();
        let mut look = |ms: i64, planned: u64, lit: u64, is_up: bool| {
            // The collector has fallen silent: the projector alone tells what is lit.
            let counts = RunCounts { frames_planned: planned, ..RunCounts::default() };
            unlit.observe(&counts, lit, is_up, HostTime(ms * 1_000_000))
        };
        // The first frames are on their way.
        assert_eq!((look(50_000, 0, 0, true), look(50_100, 9, 0, true)), (None, None));
        assert_eq!((look(50_200, 12, 10, true), look(51_190, 40, 10, true)), (None, None));
        assert_eq!((look(51_200, 40, 10, true), look(53_000, 90, 10, true)), (Some(true), None));
        assert_eq!((look(53_100, 93, 11, true), look(53_200, 96, 14, true)), (Some(false), None));
        // Few frames, or a projector that is dark by order, are no reason.
        assert_eq!((look(55_000, 99, 14, true), look(56_000, 200, 14, false)), (None, None));
        assert_eq!((look(56_900, 230, 14, true), look(57_000, 230, 14, true)), (None, Some(true)));
    }

    #[test]
    fn frames_that_take_long_one_behind_the_other_are_told_though_none_takes_a_second() {
        let mut unlit = Unlit::default();
        let at = |ms: i64| HostTime(ms * 1_000_000);
        let counts = |planned: u64| RunCounts { frames_planned: planned, ..RunCounts::default() };
        let mut look = |ms: i64, planned: u64, lit: u64, held_ms: i64| {
            unlit.observe(&counts(planned), lit, true, at(ms));
            OnGpu::told(held_ms * 1_000_000, &unlit, at(ms))
        };
        // The last light is at 50 s. One frame takes 0.8 s, the next one as long.
        assert_eq!(
            (look(50_000, 9, 9, 2), look(50_800, 11, 9, 800), look(50_900, 12, 9, 99)),
            (None, None, None)
        );
        assert_eq!((look(50_999, 12, 9, 198), look(51_000, 12, 9, 199)), (None, Some(OnGpu::HoldsUp)));
        // A GPU that is quick is not the reason, and neither is one whose frames are lit.
        assert_eq!((look(51_100, 13, 9, 20), look(51_200, 14, 10, 300)), (None, None));
        assert_eq!(look(51_300, 14, 10, 1_000), Some(OnGpu::Stays));
    }
}
