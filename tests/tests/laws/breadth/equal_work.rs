//! The pass `trace` on a GPU: its lanes share the samples of a workgroup, whichever pixels they belong to. The pictures
//! are those of software Vulkan, where a lane takes a pixel, bit for bit.

use dpm_device::planes::Raster;
use dpm_lab::lanes::{Lanes, WIDTHS};
use dpm_lab::sequence::{draw, poses_at};
use dpm_render::{trace_groups, FrameCost, Keep, Renderer, RendererSettings};
use dpm_rig::config::RenderMethod;
use dpm_rig::pipeline::renderer_settings;
use dpm_rig::rig::Rig;
use dpm_shaders::structs::{group_samples, WorkItem};
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;
use std::collections::BTreeSet;

/// A frame: radiance as bits, the work list with its samples, and what was counted.
struct Drawn {
    radiance: Vec<[u32; 4]>,
    work: Vec<WorkItem>,
    samples: u32,
    cost: FrameCost,
    /// Workgroups that keep the device busy, and those that were asked for.
    wanted: u32,
    asked: u32,
}

/// The fourth frame of `rig` by a method, with `spp` samples a pixel or on average; `storage_tables`: as GPUs draw it.
fn drawn(rig: &Rig, which: RenderMethod, spp: u32, storage_tables: bool) -> Drawn {
    let mut frame = None;
    with_gpu(|gpu| {
        let mut render = rig.config.render.clone();
        (render.method, render.spp) = (which, spp);
        let settings = RendererSettings { method: render.to_method(), ..renderer_settings(rig) };
        let keep = Keep { storage_tables, ..Keep::default() };
        let mut renderer = Renderer::keeping(gpu, &rig.scene, settings, keep).expect("the demo fits the GPU");
        let mut slot = renderer.create_slot(true).expect("memory for a small frame");
        for k in 0..4 {
            let poses = poses_at(rig, u64::from(k));
            let cost = draw(rig, &mut renderer, &mut slot, &poses, k, spp as f32).expect("the frame ends");
            let radiance = slot.radiance().expect("a debug slot");
            let (work, samples) = slot.work().expect("a debug slot");
            frame = Some(Drawn {
                radiance: radiance.iter().map(|r| r.map(f32::to_bits)).collect(),
                work: work.to_vec(),
                samples,
                cost,
                wanted: trace_groups(gpu.summary()),
                asked: slot.asked_groups().expect("a debug slot"),
            });
        }
    });
    frame.expect("four frames")
}

#[test]
fn every_sample_is_traced_once_and_lanes_are_busy() {
    let rig = demo_rig(96, 72, &[]);
    for (which, spp) in
        [(RenderMethod::Full, 2), (RenderMethod::Paper, 2), (RenderMethod::Dpm, 2), (RenderMethod::Dpm, 18)]
    {
        let what = format!("{which:?} with {spp} samples");
        let [software, gpu] = [false, true].map(|storage| drawn(&rig, which, spp, storage));
        assert!(software.radiance == gpu.radiance, "{what}: the pictures differ");
        let pixels: BTreeSet<u32> = gpu.work.iter().map(|item| item.pixel).collect();
        assert!(pixels.len() == gpu.work.len() && pixels.len() > 300, "{what}: {} items", gpu.work.len());
        assert_eq!(gpu.work[0].first, 0, "{what}");
        assert!(gpu.work.is_sorted_by(|a, b| a.first < b.first), "{what}: samples in the order of items");
        // Where the first sample has all light, the others are not traced; on a GPU they are in the pixel's first frame.
        let traced = [&software, &gpu].map(|drawn| drawn.cost.counters().samples);
        assert!(traced[0] <= traced[1] && traced[1] <= gpu.samples, "{what}: {traced:?} of {}", gpu.samples);
        if which != RenderMethod::Dpm {
            assert_eq!(traced, [gpu.samples; 2], "{what}");
        }
        // A range for each workgroup, and not fewer workgroups where the list was shorter when they were asked for.
        let length = group_samples([gpu.work.len() as u32, gpu.samples], gpu.wanted);
        let least = gpu.samples.div_ceil(length);
        assert!(gpu.asked >= least, "{what}: {} workgroups for {least} ranges", gpu.asked);
        if which == RenderMethod::Full {
            assert_eq!(gpu.asked, least, "{what}: every pixel has as many samples");
        }
        for lanes in
            WIDTHS.map(|width| Lanes::of(&gpu.work, gpu.samples, width, gpu.wanted).expect("there is work"))
        {
            assert!(lanes.busy >= 0.8 && lanes.longest <= 8, "{what}: {lanes:?}");
        }
    }
}

/// More samples than a workgroup has room for, so that it takes two rounds, of which the second is not full. Software Vulkan
/// itself ends the loops of a lane that takes many more (docs/lab/SOFTWARE-VULKAN.md).
#[test]
fn a_pixel_with_very_many_samples_is_added_up_over_rounds() {
    let rig = demo_rig(24, 18, &[]);
    let raster = Raster::new(24, 18).expect("a small raster");
    for which in [RenderMethod::Full, RenderMethod::Dpm] {
        let [software, gpu] = [false, true].map(|storage| drawn(&rig, which, 400, storage));
        let most = gpu.work.windows(2).map(|w| w[1].first - w[0].first).max().expect("some items");
        assert!(most > 320, "{which:?}: {most} samples at most");
        let lit = gpu.radiance.iter().filter(|r| r[0] != 0).count();
        assert!(lit > 20 && gpu.radiance.len() == raster.pixel_count(), "{which:?}: {lit} pixels");
        assert!(software.radiance == gpu.radiance, "{which:?}: the pictures differ");
    }
}
