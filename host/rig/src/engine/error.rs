//! Why a run ends early.

use super::connect::ConnectError;
use crate::rig::RigError;
use crate::trackers::SourceError;
use dpm_render::gpu::GpuError;
use dpm_render::RenderError;

/// Why a run ended early or never began.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// The rig cannot be built.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The tracker cannot be opened.
    #[error(transparent)]
    Tracker(#[from] SourceError),
    /// The renderer cannot be made.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The GPU failed during the run.
    #[error("frame {frame}: {source}")]
    Gpu {
        /// Which frame.
        frame: u64,
        /// What failed.
        source: GpuError,
    },
    /// The GPU does not finish a frame.
    #[error("frame {frame}: the GPU did not finish within {ms} ms")]
    GpuHangs {
        /// Which frame.
        frame: u64,
        /// How long the stage waited.
        ms: u64,
    },
    /// A thread does not answer and cannot be replaced. The projector went dark by itself, or was ordered to.
    #[error("the {stage} thread has not answered for {} ms longer than it should: the run ends in the dark; start it again, and if it happens again report it with the rig file", super::pulse::HUNG_AFTER_NS / 1_000_000)]
    Hung {
        /// Which thread.
        stage: &'static str,
    },
    /// The stages were restarted too often.
    #[error("more than {most} failures within a minute, the last: {last}; the run ends in the dark")]
    KeepsFailing {
        /// How many there may be.
        most: usize,
        /// The last failure.
        last: String,
    },
    /// The projector did not come up.
    #[error(transparent)]
    Connect(#[from] ConnectError),
    /// A stage panicked, which is a bug. The projector was ordered to go dark.
    #[error("the {0} stage stopped with a panic; this is a bug, please report it with the rig file")]
    Panicked(&'static str),
    /// The system could not start a thread.
    #[error("cannot start the {stage} thread: {source}")]
    Thread {
        /// Which stage.
        stage: &'static str,
        /// Why.
        source: std::io::Error,
    },
}
