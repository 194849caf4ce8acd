//! A run at real pace: a thread each for the stages, the link, the supervisor and the mock projector. The caller's
//! thread collects.

use super::crew::{Crew, CrewPort, OnExit};
use super::link::{device_thread, link_thread, LinkThread};
use super::parts::{bring_up, mock_projector, CrewParts, Heritage, PictureOrigin};
use super::projector::{self, OpenMedium};
use super::rights::Rights;
use super::run::Ran;
use super::settings::lead_estimator;
use super::supervisor::{join_within, Maker, Supervisor, Workshop, Wreckage};
use super::threads::{policy, RunState, STAGE_THREADS};
use crate::engine::error::PipelineError;
use crate::engine::facts::Facts;
use crate::engine::keeper::LinkKeeper;
use crate::engine::link::LinkStage;
use crate::engine::options::RunOptions;
use crate::engine::supervision::{until_gpu_is_back, Remake, Supervision};
use crate::gaze_stream::GazeStream;
use crate::light::collector::{Collector, Inbox};
use crate::light::notes::note_channel;
use crate::light::recorder::{light_channel, LightNote, LightReceiver, LightRecorder, LightSender};
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::telemetry::projector::ProjectorReport;
use crate::tracks::SeenBodies;
use dpm_common::clock::{Clock, MonotonicClock, Stopwatch};
use dpm_common::realtime::os::{standing_of, thread_id, usable_cores};
use dpm_common::realtime::standstill::StandstillMonitor;
use dpm_device::transport::inproc::threaded;
use dpm_device::transport::Transport;
use dpm_handoff::channel::{channel, Sender};
use dpm_handoff::path::Lock;
use dpm_handoff::wake::WaitPolicy;
use dpm_render::RenderError;
use std::sync::atomic::Ordering;
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::Duration;

/// Buffers of the cable to a projector in this process: one is being filled, one is being read, and one is spare for
/// a late projector.
const CABLE_BUFFERS: usize = 3;
/// A step of a control thread that ends this late counts as a standstill of the machine, nanoseconds.
const STANDSTILL_NS: i64 = 1_000_000;
/// Time between two polls of a link that is coming up, nanoseconds.
const CONNECT_STEP_NS: i64 = 200_000;
/// Time that the collector may take for one pass, and for one note, nanoseconds. It is the only thread here with a
/// lower rank than all others, it allocates, and no light depends on it: frames of which it reads nothing are counted
/// as not recorded.
const LOOK_NS: i64 = 5_000_000_000;
/// Time between two passes of the collector. It is not woken for every frame, which would cost the frame path two
/// system calls per frame.
const REST: Duration = Duration::from_millis(2);
/// A GPU that is well runs an empty submission behind the frames that it still has within this time.
const ANSWERS_WITHIN: Duration = Duration::from_secs(2);
/// How long the end of a run waits for threads that have nothing left to do.
const END_WITHIN: Duration = Duration::from_secs(1);

pub(super) fn run_at_real_pace(
    rig: &Arc<Rig>,
    origin: &PictureOrigin,
    open: &OpenMedium,
    options: RunOptions,
    monitor: &Arc<RunMonitor>,
) -> Result<Ran, PipelineError> {
    // On a machine with fewer cores than stages, a spinning thread delays the very stages that it waits for.
    let spin_ns = if usable_cores() > STAGE_THREADS { 50_000 } else { 0 };
    let clock = origin.clock().map_or_else(|| MonotonicClock::new(spin_ns), |clock| clock.spinning(spin_ns));
    let seen = Arc::new(SeenBodies::new(rig.tracked_count()));
    let making = Stopwatch::start();
    let parts = crew_parts(rig, origin, options, clock, true)?.remembering(&seen);
    let (heritage, made_ns) = (parts.heritage(), making.elapsed_ns() as i64);
    let ray_walk = parts.ray_walk();
    let (lights_in, lights) = light_channel();
    let rights = Arc::new(Rights::new(&rig.config.real_time, monitor));
    let standstill =
        StandstillMonitor::start(Arc::new(clock.sleeping()), STANDSTILL_NS, rights.highest_priority()).ok();
    let watch = Stopwatch::start();
    monitor.end_set_up();
    let mut far = open_far_end(rig, open, lights_in, options, origin.is_marked(), clock, &rights, monitor)?;
    let (link, time) = bring_up(rig, far.medium.as_mut(), monitor, &mut || {
        clock.wait_until(clock.now().plus_ns(CONNECT_STEP_NS))
    })?;
    let _gaze = hear_gaze(rig, origin, monitor, clock);
    let lead = lead_estimator(rig, &link, parts.first.wall_ns);
    let facts = Arc::new(Facts::new(rig.clone(), monitor.clone(), options, &lead, clock.now()));
    facts.made_ns.store(made_ns, Ordering::Relaxed);
    tell_horizon(&facts);
    let lights_of = far.lights.map(|lights| (lights, rig.config.projector.light_delay_ns()));
    let keeper = LinkKeeper::new(time, &link, rig.bodies.len(), lights_of);
    let line = LinkThread { stage: LinkStage::new(facts.clone(), link, keeper, lead), medium: far.medium };
    let shared = Arc::new(RunState::new(&facts, clock, time, &rights));
    let mut collector =
        Collector::new(rig.clone(), options.keep_frames.max(options.keep_records), options.verify)
            .about(origin.gpu().is_none(), standstill.as_ref().map(StandstillMonitor::seen));

    // The supervisor tells this thread from those that the driver made.
    shared.collector_pulse.begin(thread_id());
    let maker = maker(&facts, origin.clone(), heritage, clock, seen);
    let (threads, mut inbox) = Threads::start(&shared, parts, line, maker, lights)?;
    // A panic before the end of this function ends the light.
    let stop_on_panic = OnExit(|| {
        if std::thread::panicking() {
            monitor.request_stop();
        }
    });
    collect(&shared, &mut collector, &mut inbox);
    let ended = threads.end();
    let slots = collector.finish(monitor);
    drop(stop_on_panic);
    if let Some(error) = facts.take_error() {
        return Err(error);
    }
    let Some(carried) = ended.carried else { return Err(PipelineError::Hung { stage: "link" }) };
    let recorder = far.device.map(recorder_of).transpose()?;
    let warnings = ended.unseen.into_iter().chain(far.warnings).chain(rights.warnings()).collect();
    Ok(Ran {
        facts,
        collector,
        slots,
        recorder,
        carried,
        wall_s: watch.elapsed_ns() as f64 * 1e-9,
        standstills: standstill.map(StandstillMonitor::finish).unwrap_or_default(),
        warnings,
        ray_walk,
    })
}

fn crew_parts(
    rig: &Rig,
    origin: &PictureOrigin,
    options: RunOptions,
    clock: MonotonicClock,
    wakes: bool,
) -> Result<CrewParts, PipelineError> {
    CrewParts::new(rig, origin, options, Arc::new(move || clock.now()))?.at_real_pace(rig, origin, wakes)
}

/// Makes crews that take over: on the same GPU, with what was prepared there, as long as it answers. A GPU that failed or does not answer is reopened
/// with the same options.
fn maker(
    facts: &Arc<Facts>,
    origin: PictureOrigin,
    heritage: Heritage,
    clock: MonotonicClock,
    seen: Arc<SeenBodies>,
) -> Maker {
    let facts = facts.clone();
    let state = Lock::new((origin, Some(heritage)));
    Arc::new(move |remake| {
        let mut state = state.lock().map_err(|_| PipelineError::Panicked("remake"))?;
        let (origin, heritage) = &mut *state;
        if let PictureOrigin::Gpu(gpu) = origin {
            let answers = remake == Remake::Crew && gpu.answers(ANSWERS_WITHIN);
            if remake == Remake::Crew && !answers {
                facts.monitor.note(format!("the GPU does not answer either; {}", until_gpu_is_back(&facts)));
            }
            if !answers {
                // What lies on a device that failed is of no use to the next one.
                *heritage = None;
                *gpu = gpu.reopen().map_err(RenderError::from)?;
            }
        }
        let (rig, options) = (&facts.rig, facts.options);
        let parts = match heritage {
            Some(heritage) => {
                CrewParts::taking_over(heritage, rig, origin, options, Arc::new(move || clock.now()))?
            }
            None => crew_parts(rig, origin, options, clock, false)?,
        };
        *heritage = Some(parts.heritage());
        Ok(parts.remembering(&seen))
    })
}

/// Begins to hear where the observer looks, if a scene is drawn.
fn hear_gaze(
    rig: &Rig,
    origin: &PictureOrigin,
    monitor: &Arc<RunMonitor>,
    clock: MonotonicClock,
) -> Option<GazeStream> {
    let is_drawn = !matches!(origin, PictureOrigin::Pattern(..));
    is_drawn.then(|| GazeStream::start(rig, monitor, Arc::new(move || clock.now())))
}

/// Reports how long prediction may extend a body's track if the rig file leaves it open.
fn tell_horizon(facts: &Facts) {
    // Without a body there is nothing to predict.
    if facts.rig.config.safety.predict_ms.is_none() && !facts.rig.bodies.is_empty() {
        let ms = facts.predict_ns.load(Ordering::Relaxed) as f64 / 1e6;
        facts.monitor.note(format!(
            "safety.predict_ms is not set: prediction may extend a body's track for {ms:.0} ms plus the tracker's latency; the value follows \
             the time that frames need"
        ));
    }
}

/// The connection to the projector, and what is at its other end.
struct FarEnd {
    medium: Box<dyn Transport>,
    /// The thread of a mock in this process.
    device: Option<JoinHandle<LightRecorder>>,
    /// Receives reports of light from a projector outside this process.
    lights: Option<Sender<LightNote>>,
    /// Warnings about the medium for the operator.
    warnings: Vec<String>,
}

fn open_far_end(
    rig: &Rig,
    open: &OpenMedium,
    lights: LightSender,
    options: RunOptions,
    marked: bool,
    clock: MonotonicClock,
    rights: &Arc<Rights>,
    monitor: &Arc<RunMonitor>,
) -> Result<FarEnd, PipelineError> {
    let (config, raster) = (&rig.config, rig.camera.raster);
    let backend = &config.projector.backend;
    if let Some(mock) = backend.as_mock() {
        let (mock, recorder) = mock_projector(rig, mock, lights, options, marked, clock.now())?;
        let recorder = recorder.seen_by(monitor);
        let frame_bytes = projector::frame_bytes(raster, rig.schedule.len());
        let (host_end, device_end) = threaded(frame_bytes, CABLE_BUFFERS, policy(rig));
        let rights = rights.clone();
        let device =
            spawn("mock projector", move || device_thread(device_end, mock, recorder, clock, &rights))?;
        return Ok(FarEnd {
            medium: Box::new(host_end),
            device: Some(device),
            lights: None,
            warnings: Vec::new(),
        });
    }
    let (its_rights, its_monitor) = (rights.clone(), monitor.clone());
    let surroundings = projector::Surroundings {
        clock: Arc::new(move || clock.now()),
        enter: Arc::new(move || its_rights.enter_projector()),
        wait: policy(rig),
        stop: Arc::new(move || its_monitor.stop_requested()),
    };
    let medium = open(config, raster, &surroundings)?.ok_or_else(|| {
        let word = backend.word();
        RigError::Unsupported(format!("projector.backend.kind = {word:?} takes no frames over a link"))
    })?;
    let (mut transport, warnings) = (medium.transport, medium.warnings);
    // Replies are stamped when they arrive, not when they are read.
    transport.set_clock(Arc::new(move || clock.now()));
    Ok(FarEnd { medium: transport, device: None, lights: Some(lights.notes), warnings })
}

/// Returns the recorder of the mock's thread, which ends when its cable is unplugged.
fn recorder_of(device: JoinHandle<LightRecorder>) -> Result<LightRecorder, PipelineError> {
    match join_within(device, END_WITHIN) {
        Some(ended) => ended.map_err(|_| PipelineError::Panicked("mock projector")),
        None => Err(PipelineError::Hung { stage: "mock projector" }),
    }
}

/// The threads of a run except the collector's.
struct Threads {
    link: JoinHandle<ProjectorReport>,
    supervisor: JoinHandle<Option<String>>,
}

/// What the threads returned.
struct ThreadResults {
    /// `None` if the link's thread hangs.
    carried: Option<ProjectorReport>,
    /// What the tracker reports about bodies that were never seen.
    unseen: Option<String>,
}

impl Threads {
    fn start(
        shared: &Arc<RunState>,
        parts: CrewParts,
        line: LinkThread,
        maker: Maker,
        lights: LightReceiver,
    ) -> Result<(Self, Inbox), PipelineError> {
        let (crew, port) = Crew::start(shared, parts)?;
        let (mut ports_in, ports) = channel::<CrewPort>(4, WaitPolicy::Park);
        let _ = ports_in.push(port);
        let (notes_in, notes) = note_channel(&shared.facts.rig, &shared.facts.monitor);
        let on_link = shared.clone();
        let link = spawn("link", move || link_thread(&on_link, line, ports, notes_in))?;
        let supervisor = Supervisor {
            shared: shared.clone(),
            mind: Supervision::new(shared.facts.clone(), standing_of),
            ports: ports_in,
            maker,
            workshop: Workshop::default(),
            wreckage: Wreckage::default(),
        };
        let rights = shared.rights.clone();
        let supervisor = spawn("supervisor", move || {
            rights.enter_supervisor();
            supervisor.run(crew)
        })
        .inspect_err(|_| {
            // Nobody would supervise the link, so it ends, and with it the light.
            shared.facts.monitor.request_stop();
        })?;
        Ok((Self { link, supervisor }, Inbox { notes, lights }))
    }

    fn end(self) -> ThreadResults {
        let unseen =
            join_within(self.supervisor, END_WITHIN.saturating_mul(2)).and_then(Result::ok).flatten();
        ThreadResults { carried: join_within(self.link, END_WITHIN).and_then(Result::ok), unseen }
    }
}

/// Collects until the run is over, or until nothing can end it any more.
fn collect(shared: &RunState, collector: &mut Collector, inbox: &mut Inbox) {
    let pulse = &shared.collector_pulse;
    pulse.begin(thread_id());
    let mut alive = || pulse.beat(shared.clock.now(), LOOK_NS);
    while !shared.is_broken.load(Ordering::Acquire) {
        alive();
        if collector.look(inbox, &shared.facts.monitor, &mut alive) {
            break;
        }
        std::thread::sleep(REST);
    }
    pulse.end();
}

/// Starts a thread of the run.
fn spawn<T: Send + 'static>(
    stage: &'static str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<JoinHandle<T>, PipelineError> {
    let name = stage.split(' ').next().unwrap_or(stage);
    std::thread::Builder::new()
        .name(format!("dpm-{name}"))
        .spawn(work)
        .map_err(|source| PipelineError::Thread { stage, source })
}
