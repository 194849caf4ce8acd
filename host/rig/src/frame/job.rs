//! A frame in progress: what travels from thread to thread. It is boxed once and recycled.
//!
//! A frame consists of a large block of memory and a small note. Both return to planning as soon as the link has
//! finished with them, so that a few blocks circulate and stay in the caches. What the note says goes on to the
//! collector, for which nobody on the way waits (`light/notes.rs`).

use crate::frame::slots::MissCause;
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
    /// Still in progress.
    #[default]
    UnderWay,
    /// Left out: its slot had begun, and a newer frame was waiting behind it. This keeps frames from queueing after a
    /// stall.
    Overtaken,
    /// Not sent: when lit, its poses would have been older than `predict_ms` plus one slot.
    TooOld,
    /// It was still in progress when the projector was ordered to go dark.
    Stopped,
    /// It was handed to the link; this is the link's answer.
    Offered(SendOutcome),
}

/// A frame without its memory: its plan, and what happened to it.
pub(crate) struct FrameNote {
    /// What it shows, where and when.
    pub plan: FramePlan,
    /// The collector did not get the notes of frames just before this one.
    pub is_after_gap: bool,
    /// What kept planning from beginning the frame earlier; `None` if nothing did.
    pub held_up_by: Option<MissCause>,
    /// When it should have been latched.
    pub latch_due_at: HostTime,
    /// Its stamps.
    pub timeline: FrameTimeline,
    /// The GPU's statistics; `None` when frames are prepared instead of rendered.
    pub cost: Option<FrameCost>,
    /// Hash of the code values, to be compared with the light.
    pub code_hash: u64,
    /// Bytes that the processor read and wrote to make its planes of what was read back.
    pub touched_bytes: u64,
    /// Mirrors that are dark in all its planes for the eyes of tracked people.
    pub cut_mirrors: u32,
    /// What became of it.
    pub fate: Fate,
}

impl FrameNote {
    /// An empty note with room for what `rig` has.
    pub(crate) fn new(rig: &Rig) -> Self {
        Self {
            plan: FramePlan::empty(rig),
            is_after_gap: false,
            held_up_by: None,
            latch_due_at: HostTime(0),
            timeline: FrameTimeline::default(),
            cost: None,
            code_hash: 0,
            touched_bytes: 0,
            cut_mirrors: 0,
            fate: Fate::UnderWay,
        }
    }

    /// GPU time of the frame, nanoseconds; `None` if the device has no time stamps.
    pub(crate) fn gpu_ns(&self) -> Option<i64> {
        let ns: u64 = self.cost?.pass_ns.iter().sum();
        i64::try_from(ns).ok().filter(|&ns| ns > 0)
    }

    /// For how long the frame kept the next one from the GPU if the two could overlap there, nanoseconds; `None` if they
    /// could not.
    pub(crate) fn occupied_ns(&self) -> Option<i64> {
        let cost = self.cost.filter(|cost| cost.overlaps)?;
        i64::try_from(cost.occupied_ns()).ok().filter(|&ns| ns > 0)
    }

    /// True if the link accepted it.
    pub(crate) fn is_sent(&self) -> bool {
        self.fate == Fate::Offered(SendOutcome::Sent)
    }
}

/// The memory of a frame.
pub(crate) struct FrameMemory {
    /// The GPU's part; `None` when frames are prepared instead of rendered.
    pub gpu: Option<FrameSlot>,
    /// Bit planes that the processor has packed or changed.
    pub planes: BitPlaneFrame,
    /// The planes are sent from where the GPU has put them.
    pub sends_from_gpu: bool,
    /// The picture of a pattern that the planes hold; `None` for every other content.
    pub picture: Option<u64>,
}

impl FrameMemory {
    /// The planes to be sent.
    pub(crate) fn outgoing(&self) -> &[u8] {
        let from_gpu = self.gpu.as_ref().filter(|_| self.sends_from_gpu).and_then(FrameSlot::planes);
        from_gpu.unwrap_or(self.planes.bytes())
    }
}

/// A frame and its memory.
pub(crate) struct FrameJob {
    /// The note.
    pub note: Box<FrameNote>,
    /// The memory.
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
