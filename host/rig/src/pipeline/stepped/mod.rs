//! A run at real pace without threads: whoever steps it moves the clock. For simulators.
//!
//! Tracking, plan, pack, link, the supervisor and the collector are the engine's own parts, as in `pipeline/real.rs`.
//! What is made up is the machine beneath them: a [`Machine`] says how long each step takes and whether it ever
//! returns, what the GPU does, and how samples arrive. Each part has one instant at which it is due.
//! [`SteppedRun::step`] runs what is due and returns the next such instant.

mod crew;
mod line;
mod orders;

use super::parts::CrewParts;
use super::projector::link_settings;
use super::settings::lead_estimator;
use crate::engine::connect::{Connecting, ENDED_WITH_THE_LAST_RUN};
use crate::engine::error::PipelineError;
use crate::engine::facts::Facts;
use crate::engine::keeper::LinkKeeper;
use crate::engine::link::LinkStage;
use crate::engine::options::RunOptions;
use crate::engine::pulse::Pulse;
use crate::engine::supervision::{CrewVerdict, Irreplaceable, Making, Remake, Supervision};
use crate::light::collector::{Collector, Inbox};
use crate::light::notes::note_channel;
use crate::light::recorder::light_channel;
use crate::plan::dark::DarkCause;
use crate::plan::link_time::LinkTime;
use crate::rig::Rig;
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::projector::ProjectorReport;
use crate::telemetry::report::Report;
use crate::tracks::SeenBodies;
use crew::SteppedCrew;
use dpm_device::link::HostLink;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_device::tracker::Tracker;
use dpm_device::transport::Transport;
use dpm_render::gpu::GpuError;
use glam::DAffine3;
use line::SteppedLink;
pub use orders::{SteppedOrders, StoredOrder};
use std::sync::Arc;

/// Later than any instant of a run.
const NEVER: HostTime = HostTime(i64::MAX);
/// Time between two polls of a link that is coming up, nanoseconds.
const CONNECT_STEP_NS: i64 = 200_000;
/// Time between two checks of the supervisor, nanoseconds.
const LOOK_NS: i64 = 2_000_000;
/// Time between two passes of the collector, nanoseconds.
const COLLECT_NS: i64 = 2_000_000;
/// Time that one pass of the collector may take, nanoseconds.
const COLLECT_WITHIN_NS: i64 = 5_000_000_000;

/// The parts of a run that a [`Machine`] gives time to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum RunPart {
    /// From samples to tracks.
    Tracking,
    /// From tracks to the poses of a frame.
    Plan,
    /// From code values to bit planes.
    Pack,
    /// From bit planes to the transport.
    Link,
    /// Beside the frame path: what was lit.
    Collector,
}

/// How long a step takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Takes {
    /// So many nanoseconds.
    Ns(i64),
    /// It never returns.
    Forever,
    /// It panics.
    Panics,
}

/// What the GPU does with a frame.
#[derive(Debug)]
pub enum GpuWork {
    /// It finishes the frame after this many nanoseconds of its own time.
    After(i64),
    /// It never finishes.
    Never,
    /// It is lost after this many nanoseconds.
    Lost(i64, GpuError),
}

/// A frame that the link accepted.
#[derive(Clone, Copy, Debug)]
pub struct SentFrame<'a> {
    /// Low 32 bits of its number.
    pub frame: u32,
    /// When it was sent.
    pub sent_at: HostTime,
    /// Begin of its slot, as the host sees it.
    pub due_at: HostTime,
    /// The same on the projector's clock.
    pub target_at: DeviceTicks,
    /// From then on there is no light of it, on the projector's clock.
    pub dark_from: DeviceTicks,
    /// Mid-exposure of the newest sample of the lit body that was seen longest ago; `None` if all bodies are dark.
    pub captured_at: Option<HostTime>,
    /// The longest time for which prediction may extend a track, nanoseconds.
    pub predict_ns: i64,
    /// Per tracked body: the pose for which it was drawn.
    pub poses: &'a [DAffine3],
    /// The instant of `poses`.
    pub centre_at: HostTime,
    /// Per tracked body: the poses for which its first and its last planes were drawn; empty if they are all `poses`.
    pub swept: [&'a [DAffine3]; 2],
    /// The instants of `swept`.
    pub swept_at: [HostTime; 2],
    /// Per tracked body: light falls on it.
    pub lit: &'a [bool],
    /// Its planes.
    pub planes: &'a [u8],
}

/// The machine and the devices beneath a run.
pub trait Machine {
    /// How long the next step of `part` takes, which works on `frame` (0 where there is none).
    fn takes(&mut self, part: RunPart, frame: u64, now: HostTime) -> Takes;

    /// What the GPU does with `frame`, which it begins at `now`.
    fn renders(&mut self, frame: u64, now: HostTime) -> GpuWork;

    /// Opens the GPU (`with_gpu`) and prepares a crew's first frame: how long that takes, and the undisturbed time of
    /// a frame, both in nanoseconds.
    fn makes_crew(&mut self, with_gpu: bool, now: HostTime) -> (i64, Result<i64, GpuError>);

    /// Opens the tracker for a crew.
    fn opens_tracker(&mut self, now: HostTime) -> Box<dyn Tracker>;

    /// The earliest instant at which the tracker has something to read; far in the future if nothing is under way.
    fn next_sample_at(&self, now: HostTime) -> HostTime;

    /// The link accepted a frame.
    fn sent(&mut self, frame: &SentFrame<'_>);
}

/// What became of a run.
#[derive(Debug)]
pub struct SteppedEnd {
    /// Why it failed; `None` after an orderly end.
    pub error: Option<PipelineError>,
    /// The report, as far as the collector came.
    pub report: Report,
}

enum Phase {
    /// The GPU and the first frame are prepared.
    Prepares {
        until: HostTime,
        made: Result<i64, GpuError>,
    },
    /// The link comes up.
    Connects {
        connecting: Connecting,
        link: Box<HostLink>,
        at: HostTime,
        frame_ns: i64,
    },
    Runs(Box<LinkedRun>),
    Over(Option<Box<SteppedEnd>>),
}

/// See the module's documentation.
pub struct SteppedRun<M> {
    machine: M,
    rig: Arc<Rig>,
    monitor: Arc<RunMonitor>,
    medium: Box<dyn Transport>,
    phase: Phase,
}

/// The parts of a run whose link is up.
struct LinkedRun {
    facts: Arc<Facts>,
    /// The projector's clock as the handshake found it.
    time: LinkTime,
    crew: Option<SteppedCrew>,
    /// A new crew is being made: when it is ready, and what comes of it.
    making: Option<(HostTime, Result<i64, GpuError>)>,
    /// The bodies that any crew has seen.
    seen: Arc<SeenBodies>,
    line: SteppedLink,
    mind: Supervision,
    supervised_at: HostTime,
    look_at: HostTime,
    collector: Collector,
    collector_pulse: Pulse,
    collect_at: HostTime,
    /// Everything is collected.
    is_collected: bool,
    inbox: Inbox,
    /// Nothing can end the run in order any more.
    is_broken: bool,
}

impl<M: Machine> SteppedRun<M> {
    /// Begins a run of `rig` at `now` on `medium`, which is open.
    pub fn begin(
        rig: Arc<Rig>,
        monitor: Arc<RunMonitor>,
        medium: Box<dyn Transport>,
        mut machine: M,
        now: HostTime,
    ) -> Self {
        let (takes_ns, made) = machine.makes_crew(true, now);
        let phase = Phase::Prepares { until: now.plus_ns(takes_ns), made };
        Self { machine, rig, monitor, medium, phase }
    }

    /// The machine.
    pub fn machine(&mut self) -> &mut M {
        &mut self.machine
    }

    /// The medium.
    pub fn medium(&mut self) -> &mut dyn Transport {
        self.medium.as_mut()
    }

    /// True while the link comes up.
    pub fn is_connecting(&self) -> bool {
        matches!(self.phase, Phase::Connects { .. })
    }

    /// True once the link is up.
    pub fn is_running(&self) -> bool {
        matches!(self.phase, Phase::Runs(_))
    }

    /// The longest time for which prediction extends a body's track at present, nanoseconds; 0 before the link is up.
    pub fn predict_ns(&self) -> i64 {
        match &self.phase {
            Phase::Runs(run) => run.facts.predict_ns.load(std::sync::atomic::Ordering::Relaxed),
            _ => 0,
        }
    }

    /// What the link has carried; `None` before it is up.
    pub fn carried(&self) -> Option<ProjectorReport> {
        match &self.phase {
            Phase::Runs(run) => Some(run.line.stage.report(self.medium.name())),
            _ => None,
        }
    }

    /// What the tracker's client says of itself; empty before the link is up.
    pub fn tracker_status(&self) -> String {
        match &self.phase {
            Phase::Runs(run) => run.crew.as_ref().map_or(String::new(), SteppedCrew::tracker_status),
            _ => String::new(),
        }
    }

    /// Notes that wait between the parts: those that circulate, and frames in flight. Both are bounded.
    pub fn in_flight(&self) -> usize {
        match &self.phase {
            Phase::Runs(run) => run.crew.as_ref().map_or(0, SteppedCrew::in_flight),
            _ => 0,
        }
    }

    /// The result, once the run is over.
    pub fn end(&mut self) -> Option<Box<SteppedEnd>> {
        match &mut self.phase {
            Phase::Over(end) => end.take(),
            _ => None,
        }
    }

    /// True when the run is over.
    pub fn is_over(&self) -> bool {
        matches!(self.phase, Phase::Over(_))
    }

    /// Runs everything that is due at `now`. Returns when something is due next.
    pub fn step(&mut self, now: HostTime) -> HostTime {
        loop {
            let due = self.due();
            if due > now {
                return due;
            }
            self.advance(now);
        }
    }

    fn due(&self) -> HostTime {
        match &self.phase {
            Phase::Prepares { until, .. } => *until,
            Phase::Connects { at, .. } => *at,
            Phase::Runs(run) => run.due(),
            Phase::Over(_) => NEVER,
        }
    }

    fn advance(&mut self, now: HostTime) {
        match std::mem::replace(&mut self.phase, Phase::Over(None)) {
            Phase::Prepares { made, .. } => self.phase = self.prepared(made, now),
            Phase::Connects { connecting, link, frame_ns, .. } => {
                self.phase = self.connect(connecting, link, frame_ns, now);
            }
            Phase::Runs(mut run) => {
                run.advance(now, &mut self.machine, self.medium.as_mut());
                self.phase = match run.is_over() {
                    true => Phase::Over(Some(Box::new(run.finish(self.medium.as_ref())))),
                    false => Phase::Runs(run),
                };
            }
            over @ Phase::Over(_) => self.phase = over,
        }
    }

    fn failed(error: PipelineError) -> Phase {
        Phase::Over(Some(Box::new(SteppedEnd { error: Some(error), report: Report::default() })))
    }

    fn prepared(&mut self, made: Result<i64, GpuError>, now: HostTime) -> Phase {
        let frame_ns = match made {
            Ok(frame_ns) => frame_ns,
            Err(e) => return Self::failed(PipelineError::Render(e.into())),
        };
        let mut link = Box::new(HostLink::new(link_settings(&self.rig.config, self.rig.camera.raster)));
        if self.rig.wants_tracks() {
            link.want_tracks();
        }
        link.want_shifts();
        let acknowledged =
            if self.rig.config.safety.acknowledge_faults { u32::MAX } else { ENDED_WITH_THE_LAST_RUN };
        let connecting = Connecting::begin(&mut link, acknowledged, now);
        Phase::Connects { connecting, link, at: now, frame_ns }
    }

    fn connect(
        &mut self,
        mut connecting: Connecting,
        mut link: Box<HostLink>,
        frame_ns: i64,
        now: HostTime,
    ) -> Phase {
        let stop = self.monitor.stop_requested();
        match connecting.step(now, &mut link, self.medium.as_mut(), &self.monitor, stop) {
            Err(e) => Self::failed(e.into()),
            Ok(None) => Phase::Connects { connecting, link, at: now.plus_ns(CONNECT_STEP_NS), frame_ns },
            Ok(Some(time)) => Phase::Runs(Box::new(LinkedRun::new(self, *link, time, frame_ns, now))),
        }
    }
}

impl LinkedRun {
    fn new<M: Machine>(
        run: &mut SteppedRun<M>,
        link: HostLink,
        time: LinkTime,
        frame_ns: i64,
        now: HostTime,
    ) -> Self {
        let (rig, monitor) = (run.rig.clone(), run.monitor.clone());
        let lead = lead_estimator(&rig, &link, frame_ns);
        let options = RunOptions { verify: false, ..RunOptions::default() };
        let facts = Arc::new(Facts::new(rig.clone(), monitor, options, &lead, now));
        let (lights_in, lights) = light_channel();
        let (notes_in, notes) = note_channel(&rig, &run.monitor);
        let told = (lights_in.notes, rig.config.projector.light_delay_ns());
        let keeper = LinkKeeper::new(time, &link, rig.bodies.len(), Some(told));
        let stage = LinkStage::new(facts.clone(), link, keeper, lead);
        let mut line = SteppedLink::new(stage, notes_in, now);
        let tracker = run.machine.opens_tracker(now);
        let seen = Arc::new(SeenBodies::new(rig.tracked_count()));
        let parts = CrewParts::stepped(&rig, tracker, options.in_flight, frame_ns).remembering(&seen);
        let crew = SteppedCrew::new(&facts, parts, time, &mut line, now);
        Self {
            mind: Supervision::new(facts.clone(), |_| None),
            supervised_at: now,
            look_at: now.plus_ns(LOOK_NS),
            collector: Collector::new(rig.clone(), 0, false).about(false, None),
            collector_pulse: Pulse::new("collector"),
            collect_at: now.plus_ns(COLLECT_NS),
            is_collected: false,
            inbox: Inbox { notes, lights },
            is_broken: false,
            facts,
            time,
            crew: Some(crew),
            making: None,
            seen,
            line,
        }
    }

    fn due(&self) -> HostTime {
        let crew = self.crew.as_ref().map_or(NEVER, SteppedCrew::due);
        crew.min(self.line.due()).min(self.look_at).min(self.collect_at)
    }

    fn advance<M: Machine>(&mut self, now: HostTime, machine: &mut M, medium: &mut dyn Transport) {
        if let Some(crew) = &mut self.crew {
            crew.advance(now, &self.facts, machine, &mut self.line);
        }
        if self.line.due() <= now {
            self.line.advance(now, &self.facts, machine, medium, self.crew.as_mut());
        }
        if self.look_at <= now {
            self.supervise(now, machine);
        }
        if self.collect_at <= now {
            self.collect(now, machine);
        }
    }

    fn collect<M: Machine>(&mut self, now: HostTime, machine: &mut M) {
        self.collect_at = match machine.takes(RunPart::Collector, 0, now) {
            Takes::Ns(ns) => now.plus_ns(COLLECT_NS + ns),
            Takes::Forever => NEVER,
            Takes::Panics => {
                // This thread would return from the run: the run ends, and nothing more is collected.
                self.facts.fail(PipelineError::Panicked("collector"));
                self.is_collected = true;
                NEVER
            }
        };
        let Self { collector, collector_pulse: pulse, inbox, facts, .. } = self;
        pulse.beat(now, COLLECT_WITHIN_NS);
        if self.collect_at == NEVER {
            return;
        }
        // What the link has not told by now, it will not tell.
        let is_last = self.line.is_over();
        if collector.look(inbox, &facts.monitor, &mut || ()) || is_last {
            (self.collect_at, self.is_collected) = (NEVER, true);
            pulse.end();
        }
    }

    /// One check of the supervisor.
    fn supervise<M: Machine>(&mut self, now: HostTime, machine: &mut M) {
        self.look_at = now.plus_ns(LOOK_NS);
        let step_ns = now.ns_since(std::mem::replace(&mut self.supervised_at, now));
        match self.mind.watch(&self.line.pulse, &self.collector_pulse, now, step_ns) {
            // The process ends without these threads.
            Some(Irreplaceable::Link | Irreplaceable::Collector) => {
                self.is_broken = true;
                return;
            }
            None => {}
        }
        let Some(crew) = &mut self.crew else { return self.remake(now, machine) };
        let Some(trouble) = crew.trouble(now, step_ns) else { return self.mind.is_well(now) };
        match self.mind.judge(trouble, now) {
            CrewVerdict::End => crew.ends(),
            CrewVerdict::Abandon { remake } => {
                self.line.abandoned();
                self.crew = None;
                self.making = remake.map(|remake| {
                    let (takes_ns, made) = machine.makes_crew(remake == Remake::CrewAndGpu, now);
                    (now.plus_ns(takes_ns), made)
                });
            }
        }
    }

    /// A new crew is being made.
    fn remake<M: Machine>(&mut self, now: HostTime, machine: &mut M) {
        match self.making.take() {
            None => {}
            Some(unfinished) if unfinished.0 > now => {
                let waits = self.mind.waits_for(Making::Waits, now);
                self.making = waits.then_some(unfinished);
            }
            Some((_, Err(e))) => {
                self.mind.waits_for(Making::Failed(PipelineError::Render(e.into())), now);
            }
            Some((_, Ok(frame_ns))) => {
                let tracker = machine.opens_tracker(now);
                let parts =
                    CrewParts::stepped(&self.facts.rig, tracker, self.facts.options.in_flight, frame_ns)
                        .remembering(&self.seen);
                self.crew = Some(SteppedCrew::new(&self.facts, parts, self.time, &mut self.line, now));
                self.mind.is_remade();
            }
        }
    }

    fn is_over(&self) -> bool {
        self.is_broken || self.line.is_over() && self.is_collected
    }

    fn finish(mut self: Box<Self>, medium: &dyn Transport) -> SteppedEnd {
        let mut report = Report::default();
        self.collector.finish(&self.facts.monitor);
        self.collector.fill(&mut report);
        report.projector = Some(self.line.stage.report(medium.name()));
        SteppedEnd { error: self.facts.take_error(), report }
    }
}

/// Why a body is dark, for observers.
pub(super) fn is_lit(dark: &Option<DarkCause>) -> bool {
    dark.is_none()
}

#[cfg(test)]
mod tests;
