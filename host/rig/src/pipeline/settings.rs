//! Settings of a run, from the rig file: the renderer's settings, the first guess of the lead, the limits of the ray
//! budget.

use crate::config::{self, Packer};
use crate::plan::budget::{BudgetConfig, BudgetController, FEWEST_OF_MOST};
use crate::plan::lead::LeadEstimator;
use crate::plan::light_centre::groups_that_follow;
use crate::plan::scale::scale_of;
use crate::rig::Rig;
use dpm_device::link::HostLink;
use dpm_render::gpu::Gpu;
use dpm_render::pack::Halftone;
use dpm_render::{Output, Overlapping, RendererSettings, Tracing};

/// Spare time in the first guess of the lead, as a divisor of the time of an undisturbed frame: a quarter.
const GUESS_SPARE: i64 = 4;

/// The modelled time from latch to sent in the rig file, but for rendering, nanoseconds.
fn modelled_ns(rig: &Rig) -> i64 {
    let costs = &rig.config.real_time.stage_costs_us;
    (i64::from(costs.total()) - i64::from(costs.render)) * 1000
}

/// Estimates how early frames are latched. The first guess comes from the rig file and from `frame_ns`, the time of
/// an undisturbed frame; 0 if nothing is rendered.
pub(super) fn lead_estimator(rig: &Rig, link: &HostLink, frame_ns: i64) -> LeadEstimator {
    let slot_ns = rig.rate().slot_len_ns(0);
    // Sending earlier is useless: the device has no free buffer, and its credit message takes part of a slot to
    // arrive.
    let held = link.device().map_or(1, |hello| i64::from(hello.frame_buffers));
    let longest_wait_ns = held * slot_ns - slot_ns / 2;
    let rendered_ns = frame_ns + frame_ns / GUESS_SPARE;
    LeadEstimator::new(slot_ns, modelled_ns(rig) + rendered_ns, longest_wait_ns)
}

/// Keeps the GPU's time inside the slot by reducing samples. The unit is thousandths of a sample per pixel; the range
/// is from what the rig file asks for down to an eighth of it.
pub(super) fn budget_controller(rig: &Rig) -> Option<BudgetController> {
    let full = u64::from(rig.config.render.spp) * 1000;
    let config = BudgetConfig {
        slot_ns: rig.rate().slot_len_ns(0),
        aim: 0.8,
        limit: 0.92,
        min_rays: (full / FEWEST_OF_MOST).max(1),
        max_rays: full.max(1),
        initial_rays: full,
    };
    BudgetController::new(config).ok()
}

/// The renderer's settings from the rig file.
pub fn renderer_settings(rig: &Rig) -> RendererSettings {
    let r = &rig.config.render;
    RendererSettings {
        raster: rig.camera.raster,
        scale: scale_of(r),
        depth: r.depth,
        seed: r.seed as u32,
        clamp_indirect: (r.clamp_indirect > 0.0).then_some(r.clamp_indirect as f32),
        drive: rig.drive.clone(),
        lens: (!rig.camera.lens.is_pinhole()).then_some(rig.camera),
        camera_is_eye: false,
        leave_nothing_out: false,
        method: r.to_method(),
        halftone: Halftone::of(&rig.schedule),
        plane_groups: groups_that_follow(rig),
        output: Output::Codes,
        overlap: if r.overlap { Overlapping::WhereItCan } else { Overlapping::Never },
        tracing: match r.tracing {
            config::Tracing::Auto => Tracing::Auto,
            config::Tracing::Walk => Tracing::Walk,
            config::Tracing::Query => Tracing::RayQuery,
            config::Tracing::Host => Tracing::Host,
        },
        most_live_texels: most_live_texels(rig),
    }
}

/// Texels of live pictures that a frame brings to the GPU in a millisecond of its slot, 0.2 MB: a small part of what memory and
/// bus carry in this time. So a picture of 512 x 512 texels needs 11 ms, one of 1920 x 1080 85 ms.
const LIVE_TEXELS_PER_MS: i64 = 24_576;

fn most_live_texels(rig: &Rig) -> usize {
    (rig.rate().slot_len_ns(0) * LIVE_TEXELS_PER_MS / 1_000_000) as usize
}

/// What the rig file wants to read back from `gpu`; with `check`, the code values in any case.
pub fn output(rig: &Rig, gpu: &Gpu, check: bool) -> Output {
    let packs = match rig.config.render.packer {
        Packer::Auto => !gpu.summary().software,
        Packer::Gpu => true,
        Packer::Cpu => false,
    };
    let schedule = rig.schedule;
    match (packs, check) {
        (false, _) => Output::Codes,
        (true, false) => Output::Planes(schedule),
        (true, true) => Output::Both(schedule),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Overrides, RigConfig};
    use dpm_device::planes::Raster;

    /// As many texels a millisecond at every frame rate, so that a picture is there after the same time.
    #[test]
    fn live_texels_follow_the_length_of_a_slot() {
        for (rate, texels) in [("500", 49_152), ("50", 491_520), ("125", 196_608)] {
            let flags = vec![format!("projector.frame_rate=\"{rate}\"")];
            let config =
                RigConfig::demo(&Overrides { variables: vec![], flags }).unwrap_or_else(|e| panic!("{e}"));
            let rig = Rig::build(&config, Raster::new(8, 8)).unwrap_or_else(|e| panic!("{e}"));
            assert_eq!(renderer_settings(&rig).most_live_texels, texels, "{rate} frames/s");
        }
    }
}
