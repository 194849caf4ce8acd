//! A rig into rays of a real frame, and how fast each way walks them.

use super::sequence::{draw, poses_at};
use super::stamp::Stamp;
use dpm_common::realtime::os::thread_cpu_ns;
use dpm_render::gpu::{Gpu, GpuError, GpuOptions};
use dpm_render::walker::{Ray, WalkKernel};
use dpm_render::{RenderError, Renderer, RendererSettings, Tracing};
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_shaders::structs::{BodyNode, Instance, NO_HIT};
use serde::Serialize;
use std::sync::Arc;

/// Frames drawn before the one whose rays are recorded: histories fill.
const WARM_UP: u32 = 4;
/// Each way walks the rays so often, and the best counts.
const RUNS: u32 = 5;

/// How fast one way walks rays of one kind.
#[derive(Clone, Debug, Serialize)]
pub struct WalkRate {
    /// The kernel: of the processor, on one thread; or of the device, in the order of the samples.
    pub kernel: String,
    /// `nearest` (the next rays of paths) or `any` (rays to lamps, and last rays).
    pub kind: &'static str,
    /// Rays.
    pub rays: usize,
    /// Rays by the time of the device, or by the processor time of the thread, 1/s; 0 if the device has no time stamps.
    pub rays_per_s: f64,
    /// Share of the rays that meet a surface.
    pub hit: f64,
    /// Rays of which the first kernel says something else: another triangle for the nearest, or whether there is one.
    pub differ: usize,
}

/// What `dpm bench --walk` measures.
#[derive(Clone, Debug, Serialize)]
pub struct WalkReport {
    /// With what it was measured.
    pub stamp: Stamp,
    /// Rays of the frame's paths, those included that surely meet nothing.
    pub path_rays: u32,
    /// Of these the rays that were proven to meet nothing, by horizons and bounds of bodies, and not walked.
    pub proven_misses: u32,
    /// The others.
    pub walked: u32,
    /// Each way and kind.
    pub rates: Vec<WalkRate>,
}

/// The recorded rays, and the bodies through which they go.
type Recorded = (Vec<Ray>, Vec<Instance>, Vec<BodyNode>);

/// Records the rays that the paths of one frame of the rig have asked for last, and walks them by every kernel of this processor and by the kernel of
/// `gpu`. `Ok(None)`: the host cannot walk the rays of this scene, which a warning explains.
///
/// # Errors
/// The renderer's. There is no software Vulkan, which records the rays.
pub fn bench_walk(rig: &Rig, gpu: &Arc<Gpu>) -> Result<Option<WalkReport>, RenderError> {
    let software = match gpu.summary().software {
        true => gpu.clone(),
        false => Gpu::open(&GpuOptions { device: Some("llvmpipe".into()), ..GpuOptions::default() })?,
    };
    let settings = |tracing| RendererSettings { tracing, ..renderer_settings(rig) };
    let mut renderer = Renderer::new(&software, &rig.scene, settings(Tracing::Host))?;
    let mut slot = renderer.create_slot(false)?;
    let spp = rig.config.render.spp;
    let mut cost = None;
    for k in 0..=WARM_UP {
        cost = Some(draw(rig, &mut renderer, &mut slot, &poses_at(rig, u64::from(k)), k, spp as f32)?);
    }
    let counts = cost.and_then(|cost| slot.path_rays(&cost));
    let (Some((path_rays, walked)), Some(recorded)) = (counts, slot.last_rays()) else { return Ok(None) };
    let walks = Renderer::new(gpu, &rig.scene, settings(Tracing::Walk))?;
    let mut rates = Vec::new();
    for (kind, name) in [(Ray::CLOSEST, "nearest"), (Ray::ANY, "any")] {
        let rays: Vec<Ray> = recorded.0.iter().filter(|ray| ray.kind & 255 == kind).copied().collect();
        if !rays.is_empty() {
            rates.extend(rates_of(&renderer, &walks, (&rays, name), &recorded)?);
        }
    }
    let stamp = Stamp::new(rig, gpu.summary());
    Ok(Some(WalkReport { stamp, path_rays, proven_misses: path_rays - walked, walked, rates }))
}

/// The kernels of the processor and that of the device on rays of one kind.
fn rates_of(
    renderer: &Renderer,
    device: &Renderer,
    (rays, kind): (&[Ray], &'static str),
    (_, bodies, nodes): &Recorded,
) -> Result<Vec<WalkRate>, GpuError> {
    let mut first: Option<Vec<u32>> = None;
    let mut rate = |kernel: String, took_ns: f64, hits: Vec<u32>| {
        let hit = hits.iter().filter(|hit| **hit != NO_HIT).count() as f64 / rays.len() as f64;
        let same = |a: u32, b: u32| if kind == "any" { (a == NO_HIT) == (b == NO_HIT) } else { a == b };
        let of_first = first.get_or_insert_with(|| hits.clone());
        let differ = of_first.iter().zip(&hits).filter(|(a, b)| !same(**a, **b)).count();
        let rays_per_s = if took_ns > 0.0 { rays.len() as f64 / took_ns * 1e9 } else { 0.0 };
        WalkRate { kernel, kind, rays: rays.len(), rays_per_s, hit, differ }
    };
    let mut rates = Vec::new();
    for &kernel in WalkKernel::available() {
        let (mut hits, mut best) = (vec![NO_HIT; rays.len()], i64::MAX);
        for _ in 0..RUNS {
            let begin = thread_cpu_ns();
            renderer.walk_on_host(kernel, rays, (bodies, nodes), &mut hits);
            best = best.min(thread_cpu_ns() - begin);
        }
        rates.push(rate(format!("{}, one thread", kernel.name()), best as f64, hits));
    }
    let (hits, took_ns) = device.walk_on_device(rays, (bodies, nodes))?;
    rates.push(rate("device, in order".into(), took_ns as f64, hits));
    Ok(rates)
}
