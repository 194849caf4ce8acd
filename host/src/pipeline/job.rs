//! One frame on its way: everything that travels from thread to thread. Boxed once, recycled for ever.

use crate::frame::{FrameId, FrameTimeline};
use crate::pack::BitPlaneFrame;
use crate::render::{FrameCost, FrameSlot};
use dpm_device::link::SendOutcome;
use dpm_device::time::DeviceTicks;
use glam::{DAffine3, DVec3};

/// A frame and its memory.
pub struct FrameJob {
    /// Which frame.
    pub id: FrameId,
    /// Which slot of the projector it is for.
    pub slot: u64,
    /// Start of that slot on the projector's clock.
    pub target_at: DeviceTicks,
    /// Planning waited for this job's memory: a later stage held all of it.
    pub waited_for_memory: bool,
    /// Stamps.
    pub timeline: FrameTimeline,
    /// Predicted world-from-body of the tracked bodies.
    pub tracked_poses: Vec<DAffine3>,
    /// The same without prediction: where the newest sample put them.
    pub sampled_poses: Vec<DAffine3>,
    /// Bodies that are lost: no light falls on them.
    pub lost: Vec<bool>,
    /// world-from-body of every body of the scene.
    pub scene_poses: Vec<DAffine3>,
    /// Eye, world.
    pub eye: DVec3,
    /// Gaze point, world.
    pub gaze: DVec3,
    /// The GPU's part; `None` when frames are prepared instead of rendered.
    pub gpu: Option<FrameSlot>,
    /// What the GPU said about it.
    pub cost: FrameCost,
    /// Hash of the code values, to be compared with the light.
    pub code_hash: u64,
    /// Bit planes.
    pub planes: BitPlaneFrame,
    /// Fate on the link; `None` before it got there.
    pub outcome: Option<SendOutcome>,
}

/// A hash of a frame's code values that is cheap enough for every frame.
pub fn hash_codes(codes: impl Iterator<Item = u32>) -> u64 {
    let mut hash = 0x9e37_79b9_7f4a_7c15u64;
    for code in codes {
        hash = (hash ^ u64::from(code)).wrapping_mul(0xff51_afd7_ed55_8ccd);
        hash ^= hash >> 29;
    }
    hash
}
