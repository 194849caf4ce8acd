//! The record of one lit frame: what it was drawn for, and when its light fell.

use crate::frame::FrameTimeline;
use crate::plan::dark::DarkCause;
use crate::plan::frame::FrameId;
use dpm_device::time::HostTime;
use dpm_render::PASSES;
use glam::{DAffine3, DVec3};

/// The record of one lit frame, kept for pictures.
#[derive(Clone, Debug)]
pub struct FrameRecord {
    /// Which frame.
    pub id: FrameId,
    /// Its slot.
    pub slot: u64,
    /// Its stamps.
    pub timeline: FrameTimeline,
    /// The instant for which it was drawn: the planned centre of its light.
    pub drawn_for: HostTime,
    /// world-from-body of the tracked bodies for which it was drawn.
    pub tracked_poses: Vec<DAffine3>,
    /// The same at the first photon and at the last; empty if all planes were drawn for one instant.
    pub swept_poses: [Vec<DAffine3>; 2],
    /// world-from-body of the tracked bodies without prediction.
    pub sampled_poses: Vec<DAffine3>,
    /// Per tracked body: why no light fell on it; `None` if light fell on it.
    pub dark: Vec<Option<DarkCause>>,
    /// Mirrors that were dark in all its planes for the eyes of tracked people.
    pub cut_mirrors: u32,
    /// Radius of the largest sphere about one, metres; 0 if no head is guarded.
    pub guard_radius_m: f64,
    /// The head, among [`crate::rig::Rig::heads`], whose loss made it dark as a whole.
    pub head_lost: Option<usize>,
    /// The eye in world coordinates.
    pub eye: DVec3,
    /// What it looks at, in world coordinates.
    pub gaze: DVec3,
    /// Which version of the operator's parameters it was drawn with; 0 is the rig file's.
    pub parameters: u64,
    /// Hash of its code values.
    pub code_hash: u64,
    /// GPU time of each pass, nanoseconds.
    pub pass_ns: [u64; PASSES.len()],
}

impl FrameRecord {
    /// world-from-body for which the tracked body `i` was drawn in the planes of an instant, told as a share of the
    /// exposure from the frame's own.
    pub(super) fn pose_at(&self, i: usize, instant: f64) -> DAffine3 {
        let pose = self.tracked_poses[i];
        let [Some(first), Some(last)] = [0, 1].map(|end: usize| self.swept_poses[end].get(i)) else {
            return pose;
        };
        DAffine3 {
            matrix3: pose.matrix3 + (last.matrix3 - first.matrix3) * instant,
            translation: pose.translation + (last.translation - first.translation) * instant,
        }
    }
}
