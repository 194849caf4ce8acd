//! Why a run ends early.

use super::connect::ConnectError;
use crate::rig::RigError;
use crate::tracks::SourceError;
use dpm_render::gpu::GpuError;
use dpm_render::RenderError;

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
