//! Compares the packing shader with the CPU's packer, byte for byte, at rasters of every alignment; and runs a rig
//! that packs on the GPU.

use dpm_device::planes::{Channel, Parts, PlaneSchedule, PlaneSpec, Raster};
use dpm_lab::reference::Sampler;
use dpm_render::gpu::{Buffer, Gpu};
use dpm_render::pack::{self, BitPlaneFrame, Kernel};
use dpm_tests::gpu::{run_shader, uploaded, with_gpu};
use dpm_tests::rigs::{demo_rig, run};
use std::sync::Arc;

/// Runs the shader alone.
fn on_gpu(gpu: &Arc<Gpu>, raster: Raster, schedule: PlaneSchedule, values: &[u32]) -> BitPlaneFrame {
    let len = pack::gpu::len_bytes(raster, &schedule);
    let codes = uploaded(gpu, "codes", bytemuck::cast_slice(values));
    // Words that are not written would stay all ones and be visible.
    let planes = Buffer::from_slice(gpu, "planes", &vec![u32::MAX; len.div_ceil(4)]).unwrap();
    let shader = (dpm_shaders::PACK, &pack::gpu::constants(raster, &schedule)[..]);
    let buffers = [("B_CODES", &codes), ("B_PLANES", &planes)];
    let bytes = run_shader(gpu, shader, pack::gpu::workgroups(raster), &buffers, ("B_PLANES", len));
    let mut frame = BitPlaneFrame::new(raster, schedule);
    pack::gpu::take(&bytes, &mut frame);
    frame
}

#[test]
fn planes_of_gpu_and_cpu_are_the_same_bytes() {
    // Only two planes, in an unusual order: most bits are in no plane.
    let odd = [PlaneSpec { channel: Channel::Blue, bit: 7 }, PlaneSpec { channel: Channel::Red, bit: 0 }];
    let schedules = [
        PlaneSchedule::rgb24(),
        PlaneSchedule::mono8(),
        PlaneSchedule::new(&odd).unwrap(),
        PlaneSchedule::equal_rgb24(),
        PlaneSchedule::equal24(),
        PlaneSchedule::of_parts(Parts { count: 3, depth: 8, low: 0, white: true }).unwrap(),
        PlaneSchedule::of_parts(Parts { count: 2, depth: 4, low: 0, white: false }).unwrap(),
        PlaneSchedule::split_rgb24(),
    ];
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

/// Whole runs.
mod breadth {
    use super::*;

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
}
