//! What a run needs: the tracker, the renderer, the memory of frames, and the projector at the other end of the
//! cable.

use super::settings::{budget_controller, output, renderer_settings};
use crate::engine::connect::{connect, ENDED_WITH_THE_LAST_RUN};
use crate::engine::error::PipelineError;
use crate::engine::options::RunOptions;
use crate::frame::job::FrameMemory;
use crate::light::recorder::{LightRecorder, LightSender};
use crate::mock::{DeviceClock, EmulatedProjector, MockConfig, GREATEST_SHIFT};
use crate::pack::eye_mask::EyeMask;
use crate::pack::prepared::PreparedFrames;
use crate::pack::source::{FrameSource, PatternPainter, PatternSource};
use crate::pack::Packer;
use crate::pipeline::projector;
use crate::plan::budget::BudgetController;
use crate::plan::link_time::LinkTime;
use crate::plan::scale::{scale_of_run, ScaleController};
use crate::projectors::MockProjectorConfig;
use crate::render::WarmUp;
use crate::rig::{Rig, RigError};
use crate::telemetry::monitor::RunMonitor;
use crate::tracks::{open_for, NoTracker, SeenBodies, TrackingStage};
use dpm_common::clock::{MonotonicClock, Stopwatch};
use dpm_device::link::{HostLink, LinkSettings};
use dpm_device::time::{HostClock, HostTime};
use dpm_device::tracker::Tracker;
use dpm_device::transport::Transport;
use dpm_render::gpu::Gpu;
use dpm_render::pack::{BitPlaneFrame, Kernel};
use dpm_render::{PreparedScene, RayWalk, RenderError, Renderer, RendererSettings, Scale, LADDER};
use std::sync::Arc;
use std::time::Duration;

/// How long the first frame may take, nanoseconds. Drivers translate shaders for it, which takes minutes on a slow,
/// busy machine.
pub(super) const FIRST_FRAME_TIMEOUT_NS: u64 = 180_000_000_000;

/// Slots whose shifts wait in the mock to be recorded.
const MOVES_KEPT: usize = 64;

/// Where the pictures of a run come from.
#[derive(Clone)]
pub(super) enum PictureOrigin {
    /// A GPU traces them.
    Gpu(Arc<Gpu>),
    /// They are prepared and marked.
    Prepared,
    /// They are patterns: nothing is traced, and no tracker is asked but for heads that are guarded.
    Pattern(Arc<dyn PatternSource>, Option<MonotonicClock>),
}

impl PictureOrigin {
    /// The clock that stamps the run at real pace, if others compare its stamps with theirs.
    pub(super) fn clock(&self) -> Option<MonotonicClock> {
        match self {
            Self::Pattern(_, clock) => *clock,
            Self::Gpu(_) | Self::Prepared => None,
        }
    }
}

impl PictureOrigin {
    /// The GPU, if there is one.
    pub(super) fn gpu(&self) -> Option<&Arc<Gpu>> {
        match self {
            Self::Gpu(gpu) => Some(gpu),
            _ => None,
        }
    }

    /// The frames carry marks, by which torn light is found.
    pub(super) fn is_marked(&self) -> bool {
        matches!(self, Self::Prepared)
    }

    /// What gives the pictures if no GPU does.
    fn pictures(&self, raster: dpm_device::planes::Raster) -> Option<FrameSource> {
        match self {
            Self::Gpu(_) => None,
            Self::Prepared => Some(FrameSource::Marked(PreparedFrames::new(raster))),
            Self::Pattern(source, _) => Some(FrameSource::Drawn(PatternPainter::new(source.clone(), raster))),
        }
    }
}

/// What tracking, plan and pack need.
pub(super) struct CrewParts {
    pub(super) tracking: TrackingStage,
    /// `None` if nothing is rendered.
    pub(super) renderer: Option<Renderer>,
    pub(super) packer: Packer,
    /// `None` if every frame gets the rays that the rig file asks for.
    pub(super) budget: Option<BudgetController>,
    /// `None` if every frame traces the same share of the raster.
    pub(super) scale: Option<ScaleController>,
    /// Memory for the frames.
    pub(super) memory: Vec<FrameMemory>,
    /// Time that a frame took while the GPU was otherwise idle.
    pub(super) first: WarmUp,
    /// Samples with which a frame then fitted into its slot, in thousandths; `u64::MAX` if that is not known.
    pub(super) budget_milli: u64,
}

/// What crews leave to those that take over from them on the same device.
#[derive(Clone)]
pub(super) struct Heritage {
    /// `None` if nothing is rendered.
    scene: Option<PreparedScene>,
    budget: Option<BudgetController>,
    scale: Option<ScaleController>,
    first: WarmUp,
    budget_milli: u64,
}

impl CrewParts {
    /// Trackers outside this process stamp their packets with `clock`.
    ///
    /// # Errors
    /// The tracker cannot be opened, or the GPU refuses.
    pub(super) fn new(
        rig: &Rig,
        origin: &PictureOrigin,
        options: RunOptions,
        clock: Arc<dyn HostClock>,
    ) -> Result<Self, PipelineError> {
        let settings = |gpu: &Gpu| RendererSettings {
            output: output(rig, gpu, options.verify),
            scale: scale_of_run(rig),
            ..renderer_settings(rig)
        };
        let renderer = || origin.gpu().map(|gpu| Renderer::new(gpu, &rig.scene, settings(gpu))).transpose();
        Self::drawn_by(renderer, rig, origin, options, clock)
    }

    /// The same for a crew that takes over on the same device, at real pace: nothing is compiled, no frame is drawn that is never shown, and what
    /// was learned of the device at the start holds.
    ///
    /// # Errors
    /// As [`CrewParts::new`].
    pub(super) fn taking_over(
        heritage: &Heritage,
        rig: &Rig,
        origin: &PictureOrigin,
        options: RunOptions,
        clock: Arc<dyn HostClock>,
    ) -> Result<Self, PipelineError> {
        let Heritage { scene, budget, scale, first, budget_milli } = heritage.clone();
        let renderer = || scene.as_ref().map(Renderer::from_prepared).transpose();
        let parts = Self::drawn_by(renderer, rig, origin, options, clock)?;
        Ok(Self { budget, scale, first, budget_milli, ..parts })
    }

    /// Who finds what rays meet, if a GPU draws.
    pub(super) fn ray_walk(&self) -> Option<RayWalk> {
        self.renderer.as_ref().and_then(Renderer::ray_walk)
    }

    /// What a crew that takes over on the same device needs of this one.
    pub(super) fn heritage(&self) -> Heritage {
        Heritage {
            scene: self.renderer.as_ref().map(|renderer| renderer.prepared().clone()),
            budget: self.budget.clone(),
            scale: self.scale.clone(),
            first: self.first,
            budget_milli: self.budget_milli,
        }
    }

    fn drawn_by<E>(
        renderer: impl FnOnce() -> Result<Option<Renderer>, E>,
        rig: &Rig,
        origin: &PictureOrigin,
        options: RunOptions,
        clock: Arc<dyn HostClock>,
    ) -> Result<Self, PipelineError>
    where
        PipelineError: From<E>,
    {
        // The tracker first: to open it takes a moment, and shaders may take a minute.
        let tracker: Box<dyn Tracker> = match origin {
            PictureOrigin::Pattern(..) if rig.heads.is_empty() => Box::new(NoTracker),
            _ => open_for(rig, clock, HostTime(0))?,
        };
        let mut renderer = renderer()?;
        let memory = (0..options.in_flight.max(2))
            .map(|_| frame_memory(rig, renderer.as_mut()))
            .collect::<Result<_, _>>()?;
        Ok(Self {
            tracking: TrackingStage::new(rig, tracker),
            renderer,
            packer: Packer {
                kernel: Kernel::best(),
                pictures: origin.pictures(rig.camera.raster),
                eyes: EyeMask::of_rig(rig),
            },
            budget: None,
            scale: None,
            memory,
            first: WarmUp::default(),
            budget_milli: u64::MAX,
        })
    }

    /// Prepares the parts for real pace. They draw frames that are never shown: the first one absorbs one-time work of
    /// the driver before a slot depends on it, and the last one measures the time of a frame. From then on the ray budget
    /// follows the frame times. At virtual pace it must not, because there the pictures may not depend on the machine's
    /// speed. `wakes`: a GPU draws for as long as it needs to raise its clock, and the budget finds what fits. A crew that
    /// takes over finds the GPU awake, and is in a hurry.
    ///
    /// # Errors
    /// The GPU does not finish, or is lost.
    pub(super) fn at_real_pace(
        mut self,
        rig: &Rig,
        origin: &PictureOrigin,
        wakes: bool,
    ) -> Result<Self, PipelineError> {
        if rig.config.render.method.takes_a_budget() && self.renderer.is_some() {
            self.budget = budget_controller(rig);
        }
        self.draw_unseen(rig)?;
        self.fit_scale(rig)?;
        let watch = Stopwatch::start();
        let wake = origin.gpu().map_or(Duration::ZERO, |gpu| gpu.summary().wakes_within());
        // A GPU that needs a small part of a slot keeps up at any clock.
        let small_ns = rig.rate().slot_len_ns(0) / 4;
        loop {
            let given = self.draw_unseen(rig)?;
            let is_awake = watch.elapsed_ns() >= wake.as_nanos() as u64 || self.first.wall_ns < small_ns;
            if !wakes || is_awake {
                break;
            }
            if let (Some(budget), Some(gpu_ns)) = (&mut self.budget, self.first.gpu_ns) {
                budget.measured(given, gpu_ns);
                self.budget_milli = budget.rays();
            }
        }
        Ok(self)
    }

    /// Finds the largest share of the raster at which a frame with the fewest samples fits into a slot, if the rig file leaves that to the device.
    fn fit_scale(&mut self, rig: &Rig) -> Result<(), PipelineError> {
        if self.renderer.is_none() || scale_of_run(rig) != Scale::Ladder {
            return Ok(());
        }
        let mut scale = ScaleController::new(rig.rate().slot_len_ns(0), &LADDER);
        loop {
            self.scale = Some(scale.clone());
            let fewest = self.budget.as_ref().map(BudgetController::fewest);
            self.draw_with(rig, fewest.unwrap_or(u64::from(rig.config.render.spp) * 1000))?;
            if !scale.tried(self.first.gpu_ns.unwrap_or(self.first.wall_ns)) {
                return Ok(());
            }
        }
    }

    /// The same, in a run that has seen the bodies of `seen` before.
    pub(super) fn remembering(self, seen: &Arc<SeenBodies>) -> Self {
        Self { tracking: self.tracking.remembering(seen.clone()), ..self }
    }

    /// Draws a frame that is never shown, if a GPU draws, and keeps what it took. Returns the samples that it had, in
    /// thousandths.
    fn draw_unseen(&mut self, rig: &Rig) -> Result<u64, PipelineError> {
        let full = u64::from(rig.config.render.spp) * 1000;
        let budget_milli = self.budget.as_ref().map_or(full, BudgetController::rays);
        self.draw_with(rig, budget_milli)?;
        Ok(budget_milli)
    }

    /// The same with so many samples.
    fn draw_with(&mut self, rig: &Rig, budget_milli: u64) -> Result<(), PipelineError> {
        let rung = self.scale.as_ref().map_or(0, ScaleController::rung);
        let slot = self.memory.first_mut().and_then(|memory| memory.gpu.as_mut());
        if let (Some(renderer), Some(slot)) = (&mut self.renderer, slot) {
            self.first =
                crate::render::warm_up(slot, rig, renderer, (budget_milli, rung), FIRST_FRAME_TIMEOUT_NS)
                    .map_err(RenderError::from)?;
        }
        Ok(())
    }
}

/// Memory for one frame, with its slot on the GPU if a GPU renders.
fn frame_memory(rig: &Rig, renderer: Option<&mut Renderer>) -> Result<FrameMemory, PipelineError> {
    let gpu = renderer.map(|renderer| renderer.create_slot(false)).transpose().map_err(RenderError::from)?;
    let planes = BitPlaneFrame::new(rig.camera.raster, rig.schedule);
    Ok(FrameMemory { gpu, planes, sends_from_gpu: false, picture: None })
}

/// The mock projector that the rig file describes in `mock`, dark, with a recorder that reports its light to
/// `lights`. `marked`: frames carry marks to be checked. Times of injected faults count from `start`.
///
/// # Errors
/// The rig file injects faults that no projector has.
pub(super) fn mock_projector(
    rig: &Rig,
    mock: &MockProjectorConfig,
    lights: LightSender,
    options: RunOptions,
    marked: bool,
    start: HostTime,
) -> Result<(EmulatedProjector, LightRecorder), PipelineError> {
    let config = &rig.config;
    let mut setup = MockConfig::new(rig.camera.raster);
    setup.frame_buffers = mock.buffer_frames.min(64) as u8;
    setup.clock = DeviceClock { skew_ppb: (mock.clock_ppm * 1000.0) as i32, ..DeviceClock::IDEAL };
    setup.flash_limit = projector::flash_limit(config);
    setup.shifts_slots = true;
    setup.exceeds = true;
    (setup.greatest_shift, setup.moves_kept) = (Some(GREATEST_SHIFT), MOVES_KEPT);
    let emulated = EmulatedProjector::new(setup, &mock.faults, config.render.seed, start)
        .map_err(|e| RigError::Unsupported(format!("projector.backend.faults: {e}")))?;
    let kept = [options.keep_frames, options.keep_frames.max(options.keep_records)];
    // The eye guard cuts marks too, and a frame without one would count as torn.
    let marked = marked && rig.heads.is_empty();
    let recorder = LightRecorder::new(lights, kept, options.verify, rig.schedule, marked);
    Ok((emulated, recorder))
}

/// Brings the link to the rig's projector up. `now` reads the clock and lets a little time pass with every call.
///
/// # Errors
/// See [`connect`].
pub(super) fn bring_up(
    rig: &Rig,
    medium: &mut dyn Transport,
    monitor: &RunMonitor,
    now: &mut dyn FnMut() -> HostTime,
) -> Result<(HostLink, LinkTime), PipelineError> {
    let settings = projector::link_settings(&rig.config, rig.camera.raster);
    let mut link = HostLink::new(LinkSettings { schedule: rig.schedule, ..settings });
    if rig.wants_tracks() {
        link.want_tracks();
    }
    link.want_shifts();
    let acknowledged = if rig.config.safety.acknowledge_faults { u32::MAX } else { ENDED_WITH_THE_LAST_RUN };
    let time = connect(&mut link, medium, acknowledged, monitor, now, &|| monitor.stop_requested())?;
    Ok((link, time))
}
