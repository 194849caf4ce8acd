//! Frames of known poses, drawn one at a time without a pipeline.

use crate::rig::{affine, Rig, RigBody};
use dpm_render::gpu::GpuError;
use dpm_render::{FrameCost, FrameInputs, FrameSlot, Renderer};
use glam::DAffine3;

/// Where the bodies of a scene are, and what shape they have.
#[derive(Clone, Debug, Default)]
pub struct BodyPlaces {
    /// world-from-body of each.
    pub poses: Vec<DAffine3>,
    /// The time of the shapes of those that deform, and of the pictures of clips, nanoseconds.
    pub animated_at_ns: i64,
}

impl std::ops::Deref for BodyPlaces {
    type Target = [DAffine3];

    fn deref(&self) -> &[DAffine3] {
        &self.poses
    }
}

/// All bodies of the scene in the middle of a slot.
pub fn poses_at(rig: &Rig, slot: u64) -> BodyPlaces {
    let rate = rig.rate();
    let t = rate.slot_start_ns(slot) + rate.slot_len_ns(slot) / 2;
    let tracked = rig.true_poses(t).unwrap_or_else(|| rig.tracked().map(|b| affine(&b.rest)).collect());
    let mut poses = Vec::new();
    rig.scene_poses(&tracked, t, &mut poses);
    BodyPlaces { poses, animated_at_ns: t }
}

/// Samples a pixel as a rational stream: a fraction becomes frames of either neighbour.
fn spp_of_frame(spp: f32, frame: u32) -> u32 {
    let at = |k: u32| (f64::from(spp) * f64::from(k)).floor() as u32;
    (at(frame + 1) - at(frame)).max(u32::from(spp > 0.0 && spp < 1.0 && frame == 0))
}

/// Poses of all that is tracked: the bodies among those of the scene's, and what people wear.
pub fn tracked_poses(rig: &Rig, poses: &BodyPlaces) -> Vec<DAffine3> {
    let carried = |i: usize| rig.scene.bodies.iter().position(|b| b.tracked == Some(i as u16));
    let bodies = (0..rig.bodies.len()).map(|i| carried(i).map_or(DAffine3::IDENTITY, |b| poses[b]));
    let place = |worn: &RigBody| {
        affine(&worn.motion.as_ref().map_or(worn.rest, |motion| motion.pose_at(poses.animated_at_ns)))
    };
    bodies.chain(rig.worn.iter().map(place)).collect()
}

/// Draws one frame of poses, with `spp` samples a pixel on average over the frames, and waits for it, at most two minutes.
///
/// # Errors
/// The GPU's.
pub fn draw(
    rig: &Rig,
    renderer: &mut Renderer,
    slot: &mut FrameSlot,
    bodies: &BodyPlaces,
    frame: u32,
    spp: f32,
) -> Result<FrameCost, GpuError> {
    submit(rig, renderer, slot, bodies, frame, spp)?;
    slot.wait(FRAME_WAIT_NS)
}

/// How long to wait for a frame, nanoseconds.
pub const FRAME_WAIT_NS: u64 = 120_000_000_000;

/// As [`draw`], but does not wait for the end.
///
/// # Errors
/// The renderer's.
pub fn submit(
    rig: &Rig,
    renderer: &mut Renderer,
    slot: &mut FrameSlot,
    bodies: &BodyPlaces,
    frame: u32,
    spp: f32,
) -> Result<(), GpuError> {
    let tracked = tracked_poses(rig, bodies);
    let drawn = FrameInputs {
        frame,
        spp: spp_of_frame(spp, frame),
        budget_spp: spp,
        animated_at_ns: bodies.animated_at_ns,
        ..FrameInputs::new(&rig.camera, rig.observer.eye_and_gaze(&tracked), bodies)
    };
    renderer.submit(slot, &drawn)
}
