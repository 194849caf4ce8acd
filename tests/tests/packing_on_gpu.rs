//! Compares the packing shader with the CPU's packer, byte for byte, at rasters of every alignment; and runs a rig
//! that packs on the GPU.

use dpm_device::planes::{Channel, PlaneSchedule, PlaneSpec, Raster};
use dpm_lab::reference::Sampler;
use dpm_render::gpu::{
    BindingKind, BindingSet, BindingTable, Buffer, CommandList, ComputePipeline, FrameFence, Gpu, MemoryKind,
};
use dpm_render::pack::{self, BitPlaneFrame, Kernel};
use dpm_shaders::structs::BINDINGS;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::{demo_rig, run};
use std::sync::Arc;

/// Runs the shader alone.
fn on_gpu(gpu: &Arc<Gpu>, raster: Raster, schedule: PlaneSchedule, values: &[u32]) -> BitPlaneFrame {
    let len = pack::gpu::len_bytes(raster, &schedule);
    let mut codes = Buffer::new(gpu, "codes", values.len() * 4, MemoryKind::Upload).unwrap();
    codes.bytes_mut()[..values.len() * 4].copy_from_slice(bytemuck::cast_slice(values));
    // Words that are not written would stay all ones and be visible.
    let ones = vec![u32::MAX; len.div_ceil(4)];
    let planes = Buffer::from_slice(gpu, "planes", &ones).unwrap();
    let planes_host = Buffer::new(gpu, "planes", len, MemoryKind::Readback).unwrap();
    let unused = Buffer::new(gpu, "unused", 16, MemoryKind::Device).unwrap();
    // As the renderer on a GPU: devices bind a limited number, and second bindings as texels are for software Vulkan.
    let bound = || BINDINGS.iter().filter(|(name, _)| !name.ends_with("_ROWS"));
    let kinds: Vec<_> = bound().map(|&(_, binding)| (binding, BindingKind::Storage)).collect();
    let table = BindingTable::new(gpu, &kinds).unwrap();
    let constants = pack::gpu::constants(raster, &schedule);
    let pipeline = ComputePipeline::new(&table, dpm_shaders::PACK, &constants).unwrap();
    let buffer_of = |name| match name {
        "B_CODES" => &codes,
        "B_PLANES" => &planes,
        _ => &unused,
    };
    let buffers: Vec<_> = bound().map(|&(name, binding)| (binding, buffer_of(name))).collect();
    let set = BindingSet::new(&table, &buffers).unwrap();
    let list = CommandList::record(gpu, 0, |r| {
        r.dispatch(&pipeline, &set, pack::gpu::workgroups(raster));
        r.barrier();
        r.copy(&planes, &planes_host, len);
        r.barrier_to_host();
    })
    .unwrap();
    let mut fence = FrameFence::new(gpu).unwrap();
    list.submit(&mut fence).unwrap();
    fence.wait(20_000_000_000).unwrap();
    let mut frame = BitPlaneFrame::new(raster, schedule);
    pack::gpu::take(planes_host.read(len), &mut frame);
    frame
}

#[test]
fn planes_of_gpu_and_cpu_are_the_same_bytes() {
    // Only two planes, in an unusual order: most bits are in no plane.
    let odd = [PlaneSpec { channel: Channel::Blue, bit: 7 }, PlaneSpec { channel: Channel::Red, bit: 0 }];
    let schedules = [PlaneSchedule::rgb24(), PlaneSchedule::mono8(), PlaneSchedule::new(&odd).unwrap()];
    let sizes = [
        (1, 1),
        (7, 3),
        (8, 1),
        (9, 5),
        (31, 33),
        (32, 2),
        (33, 7),
        (64, 48),
        (100, 37),
        (257, 19),
        (1024, 8),
    ];
    with_gpu(|gpu| {
        let mut random = Sampler::new(77, 0);
        for (width, height) in sizes {
            let raster = Raster::new(width, height).unwrap();
            // All 32 bits are random; the upper eight must have no effect.
            let codes: Vec<u32> = (0..raster.pixel_count()).map(|_| random.next_u64() as u32).collect();
            for schedule in schedules {
                let mut expected = BitPlaneFrame::new(raster, schedule);
                pack::pack(Kernel::Scalar, &codes, &mut expected);
                let got = on_gpu(gpu, raster, schedule, &codes);
                assert!(got.bytes() == expected.bytes(), "{width} x {height}, {} planes", schedule.len());
            }
        }
    });
}

#[test]
fn light_is_the_same_whoever_packs() {
    with_gpu(|gpu| {
        let light = |packer: &str| {
            // 70 is not a multiple of 8, so rows end within a byte.
            let rig = demo_rig(70, 48, &[&format!("render.packer=\"{packer}\"")]);
            let (outcome, _) = run(gpu, &rig, 20, 0);
            assert_eq!((outcome.light_mismatches, outcome.report.frames_lit), (0, 20));
            outcome.report.light_hash
        };
        assert_eq!(light("gpu"), light("cpu"));
    });
}
