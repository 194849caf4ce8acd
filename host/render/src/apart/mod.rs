//! Frames whose rays the host walks: on software Vulkan, where the memory of the device is that of the host.
//!
//! The pass `trace` is cut where rays are walked. A dispatch writes the rays into a queue; threads of the host walk them ([`crate::walker`]) and sort
//! the paths into those that have met a surface and those that have not; the next dispatch shades each kind. Device and host take turns by two
//! semaphores ([`crate::gpu::Relay`]), and everything is submitted at once, so a frame is as asynchronous as any other. The light is that of the
//! undivided pass, bit for bit: the walk finds the same triangles, and the shaders meet them by the same arithmetic. The pass `primary` stays whole:
//! its rays are neighbours, of which software Vulkan walks eight at once as fast as the host walks them alone.
//!
//! What a ray needs besides its triangle only the shaders know: holes and veils of surfaces. Scenes with those, and with bodies that deform, keep the
//! undivided pass ([`refusal`]), and so does a frame that may have more samples than there is room for.

mod crew;
mod frame;
mod layout;
mod lists;
#[cfg(test)]
mod tests;

pub(super) use crew::WalkCrew;
pub(super) use frame::ApartFrame;
pub(super) use layout::QueueLayout;
pub(super) use lists::{ApartLists, ApartPipelines, Side};

use super::scene_data::SceneData;
use super::scene_needs::SceneNeeds;
use super::settings::{Overlapping, RendererSettings, Tracing};
use crate::gpu::Gpu;
use dpm_shaders::Reading;

/// Why the host does not walk the rays of these frames; `None`: it does.
pub(super) fn refusal(
    gpu: &Gpu,
    reading: Reading,
    settings: &RendererSettings,
    data: &SceneData,
    needs: &SceneNeeds,
) -> Option<&'static str> {
    let reasons = [
        (reading != Reading::Texels, "the device has memory of its own"),
        (settings.tracing != Tracing::Host, "render.tracing is not \"host\""),
        (!gpu.has_timelines(), "the driver has no semaphores that count"),
        (settings.overlap == Overlapping::Always, "frames overlap"),
        (needs.alpha_mask, "a material has holes or is partly there, which only shaders know"),
        (!data.deforming.is_empty(), "a body deforms"),
    ];
    reasons.into_iter().find(|(is_so, _)| *is_so).map(|(_, reason)| reason)
}
