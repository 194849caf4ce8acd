//! How a run may differ from its rig file, what it leaves behind, and why it may end early.

use super::connect::ConnectError;
use crate::light::collector::FrameRecord;
use crate::light::recorder::LightFrame;
use crate::realtime::standstill::Standstills;
use crate::rig::RigError;
use crate::telemetry::profile::Profiler;
use crate::telemetry::report::Report;
use crate::telemetry::slots::SlotCounts;
use crate::telemetry::trace::TracedFrame;
use crate::tracks::SourceError;
use dpm_render::gpu::GpuError;
use dpm_render::RenderError;

/// A thread of the host that a test may let stand still.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum StallIn {
    /// Samples into tracks.
    Tracking,
    /// Tracks into the poses of a frame.
    Plan,
    /// Code values into bit planes; where there is a GPU, waiting for it too.
    Pack,
    /// Bit planes to the transport.
    Link,
}

/// A stage that stands still once: for tests of what is left afterwards.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stall {
    /// Where.
    pub stage: StallIn,
    /// Before it works on this frame; tracking, which knows no frames: as soon as this one is planned.
    pub frame: u64,
    /// For this long.
    pub length: std::time::Duration,
}

/// How a run differs from what the rig file says.
#[derive(Clone, Copy, Debug)]
pub struct RunOptions {
    /// Frames to plan; 0: until asked to stop.
    pub frames: u64,
    /// Slots to plan for, whether frames make it into them or not; 0: no limit.
    pub slots: u64,
    /// Frames of light (and their records) kept for pictures.
    pub keep_frames: usize,
    /// Compare the light with what was rendered, frame by frame.
    pub verify: bool,
    /// Frames under way at once.
    pub in_flight: usize,
    /// A stage that stands still once.
    pub stall: Option<Stall>,
}

impl Default for RunOptions {
    fn default() -> Self {
        Self { frames: 0, slots: 0, keep_frames: 0, verify: true, in_flight: 4, stall: None }
    }
}

/// What a run leaves behind.
pub struct RunOutcome {
    /// Measurements.
    pub report: Report,
    /// The last lit frames, oldest first.
    pub recent: Vec<FrameRecord>,
    /// Their light, oldest first.
    pub light: Vec<LightFrame>,
    /// Lit frames whose light was not what was rendered.
    pub light_mismatches: u64,
    /// Distributions of every interval.
    pub profiler: Profiler,
    /// Slots by what became of them.
    pub slots: SlotCounts,
    /// Slots in which a frame was wanted and those missed, of equal batches of consecutive slots.
    pub slot_batches: Vec<(u64, u64)>,
    /// Lit frames with parts of another frame (looked for in prepared frames only).
    pub frames_torn: u64,
    /// Frames lit after a newer one, or twice.
    pub frames_reordered: u64,
    /// When the machine itself stood still (real pace).
    pub standstills: Standstills,
    /// The last frames, for a trace, where the rig file asks for one.
    pub traced: Vec<TracedFrame>,
}

/// Why a run ended early or never began.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The rig.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The tracker.
    #[error(transparent)]
    Tracker(#[from] SourceError),
    /// The renderer.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The GPU, while running.
    #[error("frame {frame}: {source}")]
    Gpu {
        /// Which frame.
        frame: u64,
        /// What happened.
        source: GpuError,
    },
    /// The GPU does not finish a frame.
    #[error("frame {frame}: the GPU did not finish within {ms} ms")]
    GpuHangs {
        /// Which frame.
        frame: u64,
        /// How long it was waited for.
        ms: u64,
    },
    /// A thread does not answer and cannot be replaced. The projector went dark by itself, or was told to.
    #[error("the {stage} thread has not answered for {} ms longer than it should: the run ends in the dark; start it again, and if it happens again report it with the rig file", super::pulse::HUNG_AFTER_NS / 1_000_000)]
    Hung {
        /// Which thread.
        stage: &'static str,
    },
    /// Stages were made anew too often.
    #[error(
        "more than {} failures within a minute, the last: {last}; the run ends in the dark",
        dpm_render::gpu::LossBudget::MOST
    )]
    KeepsFailing {
        /// The last one.
        last: String,
    },
    /// The projector.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// A stage panicked: a programmer's mistake. The projector was told to go dark.
    #[error("the {0} stage stopped with a panic; this is a bug, please report it with the rig file")]
    Panicked(&'static str),
    /// The system gave no thread.
    #[error("cannot start the {stage} thread: {source}")]
    Thread {
        /// Which stage.
        stage: &'static str,
        /// Why.
        source: std::io::Error,
    },
}
