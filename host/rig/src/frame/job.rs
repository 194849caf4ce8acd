//! One frame on its way: what travels from thread to thread. Boxed once, recycled for ever.
//!
//! A frame is a big piece of memory and a small note. The memory goes straight back to planning when the link is done with it, so that few
//! of them go round and stay in the caches; the note goes on to the collector, which may be slow.

use crate::frame::dark::DarkCause;
use crate::frame::{FrameId, FrameTimeline};
use dpm_device::link::SendOutcome;
use dpm_device::time::{DeviceTicks, HostTime};
use dpm_render::pack::BitPlaneFrame;
use dpm_render::{FrameCost, FrameSlot};
use glam::{DAffine3, DVec3};

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

/// A frame without its memory: who it is and what happened to it.
pub(crate) struct FrameNote {
    /// Which frame.
    pub id: FrameId,
    /// Which slot of the projector it is for.
    pub slot: u64,
    /// Start of that slot on the projector's clock.
    pub target_at: DeviceTicks,
    /// From this instant of the projector's clock on there must be no light of it.
    pub dark_from: DeviceTicks,
    /// Longest time for which its bodies are carried on by prediction, nanoseconds.
    pub predict_ns: i64,
    /// Capture of the oldest newest sample among the bodies that are lit; `None` when all are dark.
    pub oldest_captured_at: Option<HostTime>,
    /// By body: why it is dark, `None` when it is lit.
    pub dark: Vec<Option<DarkCause>>,
    /// Planning waited for memory: a later stage held all of it.
    pub waited_for_memory: bool,
    /// When it should have been latched.
    pub latch_due_at: HostTime,
    /// Stamps.
    pub timeline: FrameTimeline,
    /// Predicted world-from-body of the tracked bodies.
    pub tracked_poses: Vec<DAffine3>,
    /// The same without prediction: where the newest sample put them.
    pub sampled_poses: Vec<DAffine3>,
    /// Which bodies the tracker has seen so far.
    pub seen: Vec<bool>,
    /// Eye, world.
    pub eye: DVec3,
    /// Thousandths of a sample that a pixel gets on average.
    pub budget_milli: u64,
    /// What the GPU said about it; `None` when frames are prepared instead of rendered.
    pub cost: Option<FrameCost>,
    /// Hash of the code values, to be compared with the light.
    pub code_hash: u64,
    /// What became of it.
    pub fate: Fate,
}

impl FrameNote {
    /// An empty note with room for `bodies` tracked bodies.
    pub(crate) fn new(bodies: usize) -> Self {
        Self {
            id: FrameId::default(),
            slot: 0,
            target_at: DeviceTicks(0),
            dark_from: DeviceTicks(0),
            predict_ns: 0,
            oldest_captured_at: None,
            dark: Vec::with_capacity(bodies),
            waited_for_memory: false,
            latch_due_at: HostTime(0),
            timeline: FrameTimeline::default(),
            tracked_poses: Vec::with_capacity(bodies),
            sampled_poses: Vec::with_capacity(bodies),
            seen: Vec::with_capacity(bodies),
            eye: DVec3::ZERO,
            budget_milli: 0,
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
    /// Bodies that are lost: no light falls on them.
    pub lost: Vec<bool>,
    /// world-from-body of every body of the scene.
    pub scene_poses: Vec<DAffine3>,
    /// Gaze point, world.
    pub gaze: DVec3,
    /// Degrees by which the zones about a gaze that is no longer tracked have grown.
    pub widen_deg: f32,
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
