//! One frame on its way: what travels from thread to thread. Boxed once, recycled for ever.
//!
//! A frame is a big piece of memory and a small note. The memory goes straight back to planning when the link is done with it, so that few
//! of them go round and stay in the caches; the note goes on to the collector, which may be slow.

use crate::frame::FrameTimeline;
use crate::plan::frame::FramePlan;
use crate::rig::Rig;
use dpm_device::link::SendOutcome;
use dpm_device::time::HostTime;
use dpm_render::pack::BitPlaneFrame;
use dpm_render::{FrameCost, FrameSlot};

/// What became of a frame on the host.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Fate {
    /// Still under way.
    #[default]
    UnderWay,
    /// Its slot had begun and a newer frame was waiting behind it: left out, so that nothing queues up after a stall.
    Overtaken,
    /// Its poses would have been older than `predict_ms` and one slot when it was lit: not sent.
    TooOld,
    /// It was still under way when the projector had been told to go dark.
    Stopped,
    /// The link took it or did not.
    Offered(SendOutcome),
}

/// A frame without its memory: what was planned and what happened to it.
pub(crate) struct FrameNote {
    /// What it is to show, where and when.
    pub plan: FramePlan,
    /// Planning waited for memory: a later stage held all of it.
    pub waited_for_memory: bool,
    /// When it should have been latched.
    pub latch_due_at: HostTime,
    /// Stamps.
    pub timeline: FrameTimeline,
    /// What the GPU said about it; `None` when frames are prepared instead of rendered.
    pub cost: Option<FrameCost>,
    /// Hash of the code values, to be compared with the light.
    pub code_hash: u64,
    /// What became of it.
    pub fate: Fate,
}

impl FrameNote {
    /// An empty note with room for what `rig` has.
    pub(crate) fn new(rig: &Rig) -> Self {
        Self {
            plan: FramePlan::empty(rig),
            waited_for_memory: false,
            latch_due_at: HostTime(0),
            timeline: FrameTimeline::default(),
            cost: None,
            code_hash: 0,
            fate: Fate::UnderWay,
        }
    }

    /// Time that the GPU worked on it, nanoseconds; `None` where the device has no time stamps.
    pub(crate) fn gpu_ns(&self) -> Option<i64> {
        let ns: u64 = self.cost?.pass_ns.iter().sum();
        i64::try_from(ns).ok().filter(|&ns| ns > 0)
    }

    /// True when the link took it.
    pub(crate) fn is_sent(&self) -> bool {
        self.fate == Fate::Offered(SendOutcome::Sent)
    }
}

/// The memory of a frame.
pub(crate) struct FrameMemory {
    /// The GPU's part; `None` when frames are prepared instead of rendered.
    pub gpu: Option<FrameSlot>,
    /// Bit planes.
    pub planes: BitPlaneFrame,
}

/// A frame and its memory.
pub(crate) struct FrameJob {
    /// Who it is.
    pub note: Box<FrameNote>,
    /// Where it is.
    pub memory: Box<FrameMemory>,
}

/// A hash of a frame's code values that is cheap enough for every frame.
pub(crate) fn hash_codes(codes: impl Iterator<Item = u32>) -> u64 {
    let mut hash = 0x9e37_79b9_7f4a_7c15u64;
    for code in codes {
        hash = (hash ^ u64::from(code)).wrapping_mul(0xff51_afd7_ed55_8ccd);
        hash ^= hash >> 29;
    }
    hash
}
