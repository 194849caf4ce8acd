//! Submits a planned frame to the GPU and waits for its end.

use crate::frame::job::FrameJob;
use crate::frame::Stage;
use crate::plan::frame::FramePlan;
use crate::rig::{affine, Rig};
use dpm_common::clock::Stopwatch;
use dpm_render::gpu::GpuError;
use dpm_render::{FrameInputs, FrameSlot, Renderer};

/// Starts the GPU on a planned frame.
///
/// # Errors
/// The device was lost.
pub(crate) fn submit(
    plan: &FramePlan,
    slot: &mut FrameSlot,
    renderer: &mut Renderer,
) -> Result<(), GpuError> {
    renderer.submit(
        slot,
        &FrameInputs {
            frame: plan.id.0 as u32,
            spp: plan.samples,
            budget_spp: plan.budget_milli as f32 * 1e-3,
            camera: &plan.camera,
            brighter: plan.brighter,
            eye: plan.eye,
            gaze: plan.gaze,
            widen_deg: plan.widen_deg,
            poses: &plan.scene_poses,
            animated_at_ns: plan.centre_at.0,
            sweep: plan.sweep(),
            lost: &plan.lost,
            rung: plan.rung,
        },
    )
}

/// What a frame that is never shown took, nanoseconds.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct WarmUp {
    /// From its beginning until the host had it.
    pub wall_ns: i64,
    /// The GPU's own time for it; `None` if the device has no time stamps.
    pub gpu_ns: Option<i64>,
}

/// Renders one frame that is never shown, with at most `budget_milli` thousandths of a sample per pixel on this share of
/// the raster, so that one-time
/// work of the driver (translating shaders) is done before a slot depends on it.
///
/// # Errors
/// The GPU did not finish within `timeout_ns`, or was lost.
pub(crate) fn warm_up(
    slot: &mut FrameSlot,
    rig: &Rig,
    renderer: &mut Renderer,
    (budget_milli, rung): (u64, usize),
    timeout_ns: u64,
) -> Result<WarmUp, GpuError> {
    let watch = Stopwatch::start();
    let mut plan = FramePlan::empty(rig);
    plan.tracked_poses.extend(rig.tracked().map(|b| affine(&b.rest)));
    rig.scene_poses(&plan.tracked_poses, 0, &mut plan.scene_poses);
    (plan.eye, plan.gaze) = rig.observer.eye_and_gaze(&plan.tracked_poses);
    (plan.budget_milli, plan.rung) = (budget_milli, rung);
    submit(&plan, slot, renderer)?;
    let cost = slot.wait(timeout_ns)?;
    let gpu_ns = cost.pass_ns.iter().sum::<u64>() as i64;
    Ok(WarmUp { wall_ns: watch.elapsed_ns() as i64, gpu_ns: Some(gpu_ns).filter(|&ns| ns > 0) })
}

/// The longest single wait for the GPU.
const GPU_STEP_NS: u64 = 5_000_000;

/// Waits for the GPU, if the job uses one, in steps of 5 ms, as long as `goes_on`, which is asked before each step.
///
/// Returns false if the GPU has not finished then.
///
/// # Errors
/// The GPU was lost.
pub(crate) fn finish(job: &mut FrameJob, mut goes_on: impl FnMut() -> bool) -> Result<bool, GpuError> {
    let Some(slot) = job.memory.gpu.as_mut() else { return Ok(true) };
    let watch = Stopwatch::start();
    let cost = loop {
        if !goes_on() {
            return Ok(false);
        }
        if let Some(cost) = slot.poll_done(GPU_STEP_NS)? {
            break cost;
        }
    };
    let gpu: u64 = cost.pass_ns.iter().sum();
    job.note.cost = Some(cost);
    // The wait for the fence overlaps other frames. The stage's cost is the GPU's own time where that is known.
    job.note.timeline.wall_ns[Stage::Render as usize] = if gpu > 0 { gpu } else { watch.elapsed_ns() };
    Ok(true)
}

/// Drops a frame that nobody wants any more, once the GPU has finished it or was given up: until then the GPU uses its memory.
pub(crate) fn dismiss(mut job: FrameJob) {
    if let Some(slot) = job.memory.gpu.as_mut() {
        while let Ok(None) = slot.poll_done(GPU_STEP_NS) {}
    }
}
