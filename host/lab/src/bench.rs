//! A rig into what each method costs on this device: rays, samples, and milliseconds of every pass.

use super::median::{median, median_ms};
use super::sequence::{draw, poses_at, submit, FRAME_WAIT_NS};
use super::stamp::Stamp;
use crate::error::plan::switched_method_of;
use crate::gpu_model::{modelled, CountedFrame, FrameWork, Modelled};
use crate::lanes::{Lanes, WIDTHS};
use dpm_render::gpu::Gpu;
use dpm_render::method::Method;
use dpm_render::{
    trace_groups, traffic, FrameCost, Keep, Output, RenderError, Renderer, RendererPlan, RendererSettings,
    PASSES,
};
use dpm_rig::config::RenderMethod;
use dpm_rig::pipeline::{output, renderer_settings};
use dpm_rig::rig::Rig;
use serde::Serialize;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// Frames drawn before those that count: histories fill, the driver settles.
const WARM_UP: u32 = 4;
/// Frames on their way to measure how fast they follow each other, as many as in a rig.
const IN_LINE: u32 = 3;
/// So many frames are measured however slow the device is ...
const FEWEST: usize = 3;
/// ... and no more once a method has taken this long.
const LONGEST: Duration = Duration::from_secs(20);

/// Milliseconds of one pass.
#[derive(Clone, Debug, Serialize)]
pub struct PassTime {
    /// Name as in [`PASSES`].
    pub pass: &'static str,
    /// Median over the frames, ms.
    pub ms: f64,
}

/// One method's cost. Counts are means over the frames, times are medians.
#[derive(Clone, Debug, Serialize)]
pub struct MethodCost {
    /// Name.
    pub method: &'static str,
    /// Frames measured.
    pub frames: usize,
    /// Closest-hit and shadow rays of a frame, with those that were proven to meet nothing.
    pub rays_per_frame: f64,
    /// Those of them that were walked through the scene.
    pub walked_rays_per_frame: f64,
    /// Paths of a frame.
    pub samples_per_frame: f64,
    /// Pixels that the frame lights.
    pub lit_pixels: f64,
    /// Paths by lit pixels.
    pub samples_per_lit_pixel: f64,
    /// What a GPU would have to do, of which one frame after the others was counted.
    #[serde(flatten)]
    pub work: FrameWork,
    /// GPU time of a frame, all passes, ms; `None` without time stamps.
    pub gpu_ms: Option<f64>,
    /// From recording to the end of waiting, ms.
    pub wall_ms: f64,
    /// From the end of a frame to the end of the next one while [`IN_LINE`] frames are on their way, ms. This is what bounds the frame rate.
    pub in_line_ms: f64,
    /// Rays by `gpu_ms`, or by `wall_ms` where there are no time stamps, 1/s.
    pub rays_per_s: f64,
    /// The same of the rays that were walked, 1/s.
    pub walked_rays_per_s: f64,
    /// Samples in the same way, 1/s.
    pub samples_per_s: f64,
    /// By pass; empty without time stamps.
    pub passes: Vec<PassTime>,
}

impl MethodCost {
    /// What the model of GPUs asks for.
    pub(crate) fn counted(&self) -> CountedFrame<'_> {
        (self.method, self.rays_per_frame, &self.work)
    }
}

/// What `dpm bench` tells.
#[derive(Clone, Debug, Serialize)]
pub struct BenchReport {
    /// With what it was measured.
    pub stamp: Stamp,
    /// Samples a pixel where no angle decides.
    pub spp: u32,
    /// The device finds itself what a ray meets, and not the shaders.
    pub ray_query: bool,
    /// One a method.
    pub methods: Vec<MethodCost>,
    /// What frames with these counts might take on GPUs that are not there; never measured.
    pub modelled_not_measured: Vec<Modelled>,
}

/// What is measured.
#[derive(Clone, Copy, Debug)]
pub struct BenchOptions<'a> {
    /// Frames of a method.
    pub frames: u32,
    /// Names of the methods; all if there is none.
    pub only: &'a [String],
    /// Frames with these counts are also modelled on GPUs that are not there. On software Vulkan this works out the horizons of the scene.
    pub modelled: bool,
}

/// Draws up to so many frames with every method that is wanted, with the switches of the rig file. `each` is told about a method as soon as
/// it is measured.
///
/// # Errors
/// The renderer's.
pub fn bench(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    options: BenchOptions<'_>,
    each: &mut dyn FnMut(&MethodCost),
) -> Result<BenchReport, RenderError> {
    let BenchOptions { frames, only, modelled: wants_model } = options;
    let on_gpu = if wants_model { plan_on_gpu(rig, gpu)? } else { None };
    let mut methods = Vec::new();
    for which in
        RenderMethod::DRAWN.into_iter().filter(|m| only.is_empty() || only.iter().any(|o| o == m.word()))
    {
        let method = switched_method_of(&rig.config.render, which);
        let cost =
            measure(rig, gpu, frames, Measured { word: which.word(), method, on_gpu: on_gpu.as_ref() })?;
        each(&cost);
        methods.push(cost);
    }
    let modelled_not_measured =
        if wants_model { modelled(methods.iter().map(MethodCost::counted)) } else { Vec::new() };
    let (stamp, spp) = (Stamp::new(rig, gpu.summary()), rig.config.render.spp);
    let ray_query = renderer_settings(rig).tracing.asks_device(gpu.summary());
    Ok(BenchReport { stamp, spp, ray_query, methods, modelled_not_measured })
}

/// The plan of a renderer that draws on software Vulkan as a GPU does, with horizons; `None` on a GPU. Its scene serves all methods.
///
/// # Errors
/// The scene is too large.
pub(crate) fn plan_on_gpu(rig: &Rig, gpu: &Arc<Gpu>) -> Result<Option<RendererPlan>, RenderError> {
    if !gpu.summary().software {
        return Ok(None);
    }
    let keep = Keep { storage_tables: true, ..Keep::default() };
    Ok(Some(RendererPlan::new(&rig.scene, renderer_settings(rig), keep)?))
}

/// A method to be measured.
pub(crate) struct Measured<'a> {
    /// Its name.
    pub word: &'static str,
    /// With its switches.
    pub method: Method,
    /// See [`plan_on_gpu`].
    pub on_gpu: Option<&'a RendererPlan>,
}

/// Frames of one method with the rig's samples.
///
/// # Errors
/// The renderer's.
pub(crate) fn measure(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    frames: u32,
    which: Measured<'_>,
) -> Result<MethodCost, RenderError> {
    let spp = rig.config.render.spp;
    let settings = RendererSettings {
        method: which.method.clone(),
        output: output(rig, gpu, false),
        ..renderer_settings(rig)
    };
    wake(rig, gpu, settings.clone())?;
    let mut renderer = Renderer::new(gpu, &rig.scene, settings)?;
    let mut slot = renderer.create_slot(false)?;
    let (mut costs, mut walls): (Vec<FrameCost>, Vec<f64>) = (Vec::new(), Vec::new());
    let started = Instant::now();
    for k in 0..WARM_UP + frames.max(FEWEST as u32) {
        let poses = poses_at(rig, u64::from(k));
        let before = Instant::now();
        let cost = draw(rig, &mut renderer, &mut slot, &poses, k, spp as f32)?;
        if k >= WARM_UP {
            walls.push(before.elapsed().as_secs_f64() * 1e3);
            costs.push(cost);
            if costs.len() >= FEWEST && started.elapsed() > LONGEST {
                break;
            }
        }
    }
    let mut work = count_work(
        rig,
        &mut renderer,
        (costs.len() as u32 + WARM_UP, &which.method),
        trace_groups(gpu.summary()),
    )?;
    if let Some(plan) = which.on_gpu {
        work.proven_rays = proven_on_gpu(rig, gpu, plan, &which.method, work.path_rays)?;
    }
    let in_line_ms = in_line(rig, &mut renderer, costs.len() as u32)?;
    let n = costs.len() as f64;
    let mean = |of: &dyn Fn(&FrameCost) -> u64| costs.iter().map(of).sum::<u64>() as f64 / n;
    let rays_per_frame = mean(&|c| u64::from(c.counters().rays));
    let walked_rays_per_frame = mean(&|c| u64::from(c.counters().walked_rays()));
    let samples_per_frame = mean(&|c| u64::from(c.counters().samples));
    let lit_pixels = mean(&|c| u64::from(c.counters().lit_pixels));
    let wall_ms = median(walls);
    let total = median_ms(costs.iter().map(|c| c.pass_ns.iter().sum()));
    let gpu_ms = (total > 0.0).then_some(total);
    let seconds = gpu_ms.unwrap_or(wall_ms) * 1e-3;
    let time = |(i, &pass)| PassTime { pass, ms: median_ms(costs.iter().map(|c| c.pass_ns[i])) };
    Ok(MethodCost {
        method: which.word,
        frames: costs.len(),
        rays_per_frame,
        walked_rays_per_frame,
        samples_per_frame,
        lit_pixels,
        samples_per_lit_pixel: samples_per_frame / lit_pixels.max(1.0),
        work,
        gpu_ms,
        wall_ms,
        in_line_ms,
        rays_per_s: rays_per_frame / seconds,
        walked_rays_per_s: walked_rays_per_frame / seconds,
        samples_per_s: samples_per_frame / seconds,
        passes: gpu_ms.map_or_else(Vec::new, |_| PASSES.iter().enumerate().map(time).collect()),
    })
}

/// Draws frames that do not count, until the GPU has the clock at which it will draw those that do.
fn wake(rig: &Rig, gpu: &Arc<Gpu>, settings: RendererSettings) -> Result<(), RenderError> {
    let (spp, wake) = (rig.config.render.spp, gpu.summary().wakes_within());
    if wake.is_zero() {
        return Ok(());
    }
    let mut renderer = Renderer::new(gpu, &rig.scene, settings)?;
    let mut slot = renderer.create_slot(false)?;
    let started = Instant::now();
    for k in (0..).take_while(|_| started.elapsed() < wake) {
        draw(rig, &mut renderer, &mut slot, &poses_at(rig, u64::from(k)), k, spp as f32)?;
    }
    Ok(())
}

/// Mean distance of so many frames that stand in line, ms. They are of the first poses, and continue the renderer's histories.
fn in_line(rig: &Rig, renderer: &mut Renderer, frames: u32) -> Result<f64, RenderError> {
    let spp = rig.config.render.spp;
    let mut slots = (0..IN_LINE).map(|_| renderer.create_slot(false)).collect::<Result<Vec<_>, _>>()?;
    let mut started = Instant::now();
    for k in 0..frames + IN_LINE {
        if k == IN_LINE {
            started = Instant::now();
        }
        let slot = &mut slots[(k % IN_LINE) as usize];
        if k >= IN_LINE {
            slot.wait(FRAME_WAIT_NS)?;
        }
        submit(rig, renderer, slot, &poses_at(rig, u64::from(k)), WARM_UP + frames + k, spp as f32)?;
    }
    let seconds = started.elapsed().as_secs_f64();
    slots.iter_mut().try_for_each(|slot| slot.wait(FRAME_WAIT_NS).map(drop))?;
    Ok(seconds * 1e3 / f64::from(frames))
}

/// Draws one more frame and counts its work. Its time does not count.
fn count_work(
    rig: &Rig,
    renderer: &mut Renderer,
    (frame, method): (u32, &Method),
    wanted: u32,
) -> Result<FrameWork, RenderError> {
    let spp = rig.config.render.spp;
    let mut slot = renderer.create_slot(true)?;
    let cost = draw(rig, renderer, &mut slot, &poses_at(rig, u64::from(frame)), frame, spp as f32)?;
    let counted = cost.counters();
    let (items, samples) = slot.work().unwrap_or((&[], 0));
    let traffic = traffic(&settings_of_planes(rig, method.clone()), Keep::default());
    Ok(FrameWork {
        lanes: WIDTHS.iter().filter_map(|width| Lanes::of(items, samples, *width, wanted)).collect(),
        listed_pixels: slot.listed_pixels(),
        paths: u64::from(counted.samples),
        bytes_per_pixel: traffic.iter().map(|t| t.read + t.written).sum(),
        recorded_passes: traffic.len() as u32,
        path_rays: u64::from(counted.rays - counted.camera_rays),
        proven_rays: u64::from(counted.proven_rays),
        readback_bytes: (rig.camera.raster.plane_bytes() * rig.schedule.len()) as u64,
    })
}

/// How many of so many rays of paths a GPU would prove to meet nothing, from a few frames that are drawn as a GPU draws them.
fn proven_on_gpu(
    rig: &Rig,
    gpu: &Arc<Gpu>,
    plan: &RendererPlan,
    method: &Method,
    path_rays: u64,
) -> Result<u64, RenderError> {
    let settings = RendererSettings { method: method.clone(), ..renderer_settings(rig) };
    let mut renderer = Renderer::from_plan(gpu, &plan.with_settings(settings))?;
    let mut slot = renderer.create_slot(false)?;
    let mut share = 0.0;
    for k in 0..=WARM_UP {
        let poses = poses_at(rig, u64::from(k));
        let counted =
            draw(rig, &mut renderer, &mut slot, &poses, k, rig.config.render.spp as f32)?.counters();
        share = f64::from(counted.proven_rays) / f64::from((counted.rays - counted.camera_rays).max(1));
    }
    Ok((share * path_rays as f64).round() as u64)
}

/// The settings by which a GPU would draw: it packs the planes itself, whatever this machine does.
fn settings_of_planes(rig: &Rig, method: Method) -> RendererSettings {
    RendererSettings { method, output: Output::Planes(rig.schedule), ..renderer_settings(rig) }
}
