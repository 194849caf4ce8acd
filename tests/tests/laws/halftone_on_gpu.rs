//! Compares the halftoning shader with its CPU twin, bit for bit; and judges the light of a rig whose planes give equal
//! light against that of one whose planes are binary.

use bytemuck::Zeroable;
use dpm_device::planes::{Parts, PlaneSchedule, Raster};
use dpm_lab::reference::Sampler;
use dpm_render::blue_noise;
use dpm_render::gpu::{Buffer, Gpu};
use dpm_render::pack::{halftone, halftone_of_bodies, Halftone};
use dpm_render::Surface;
use dpm_rig::light::recorder::LightFrame;
use dpm_shaders::structs::{Frame, Instance, Mover, NO_HIT};
use dpm_shaders::Reading;
use dpm_tests::gpu::{run_shader, uploaded, with_gpu};
use dpm_tests::rigs::{demo_rig, run};
use std::sync::Arc;

/// What the pixels show: bodies by the numbers of their instances, and the centres of those that move.
#[derive(Default)]
struct Shows {
    ids: Vec<u32>,
    movers_of_instances: Vec<u32>,
    centres: Vec<[i32; 2]>,
}

impl Shows {
    /// To which point a pixel's noise is fixed.
    fn anchor(&self, pixel: usize) -> [i32; 2] {
        let id = self.ids.get(pixel).copied().unwrap_or(NO_HIT);
        let mover = if id == NO_HIT { 0 } else { self.movers_of_instances[(id >> 24) as usize] };
        if mover == 0 {
            [0, 0]
        } else {
            self.centres[mover as usize - 1]
        }
    }
}

/// Runs the shader alone over all tiles of the raster.
fn on_gpu(
    gpu: &Arc<Gpu>,
    how: Halftone,
    raster: Raster,
    number: u32,
    codes: &[u32],
    shows: &Shows,
) -> Vec<u32> {
    let (tiles_x, tiles_y) = (raster.width().div_ceil(16), raster.height().div_ceil(16));
    let frame = Frame {
        drawn: number,
        width: raster.width(),
        height: raster.height(),
        tiles_x,
        tile_count: tiles_x * tiles_y,
        mover_count: shows.centres.len() as u32,
        ..Frame::zeroed()
    };
    let tiles: Vec<u32> = (0..tiles_x * tiles_y).collect();
    let frame = uploaded(gpu, "frame", bytemuck::bytes_of(&frame));
    let tiles = uploaded(gpu, "tiles", bytemuck::cast_slice(&tiles));
    let noise = uploaded(gpu, "noise", blue_noise::MASK);
    let words = Buffer::from_slice(gpu, "codes", codes).unwrap();
    let constants = how.constants();
    let surfaces: Vec<Surface> = shows.ids.iter().map(|&id| Surface { id, ..Surface::zeroed() }).collect();
    let instances: Vec<Instance> =
        shows.movers_of_instances.iter().map(|&mover| Instance { mover, ..Instance::zeroed() }).collect();
    let movers: Vec<Mover> =
        shows.centres.iter().map(|&centre| Mover { centre, ..Mover::zeroed() }).collect();
    // Buffers are never empty.
    let table = |name, bytes: &[u8]| uploaded(gpu, name, if bytes.is_empty() { &[0; 16] } else { bytes });
    let surfaces = table("surfaces", &Surface::bytes_of(&surfaces));
    let instances = table("instances", bytemuck::cast_slice(&instances));
    let movers = table("movers", bytemuck::cast_slice(&movers));
    let buffers = [
        ("B_FRAME", &frame),
        ("B_TILES", &tiles),
        ("B_NOISE", &noise),
        ("B_CODES", &words),
        ("B_SURFACES", &surfaces),
        ("B_INSTANCES", &instances),
        ("B_MOVERS", &movers),
    ];
    let through = |reading| {
        let shader = dpm_shaders::HALFTONE.reading(reading);
        let len = codes.len() * 4;
        run_shader(gpu, (shader, &constants), [4 * tiles_x * tiles_y, 1, 1], &buffers, ("B_CODES", len))
    };
    bytemuck::pod_collect_to_vec(&through(Reading::Storage))
}

/// Planes of equal light, parts of more bits, and planes whose highest bit is split.
fn schedules() -> Vec<PlaneSchedule> {
    let parts =
        [(3, 8, true), (4, 6, true), (6, 4, true), (8, 3, true), (12, 2, true), (2, 4, false), (4, 2, false)];
    let of_parts = parts
        .map(|(count, depth, white)| PlaneSchedule::of_parts(Parts { count, depth, low: 0, white }).unwrap());
    let equal = [PlaneSchedule::equal_rgb24(), PlaneSchedule::equal_mono8(), PlaneSchedule::equal24()];
    let split = [PlaneSchedule::split_rgb24(), PlaneSchedule::split_mono8()];
    [&equal[..], &of_parts, &split].concat()
}

#[test]
fn halftones_of_gpu_and_cpu_are_the_same_bits() {
    let sizes = [(1, 1), (8, 8), (9, 5), (31, 33), (64, 48), (100, 37), (257, 19)];
    with_gpu(|gpu| {
        let mut random = Sampler::new(78, 0);
        for (i, (width, height)) in sizes.into_iter().enumerate() {
            let raster = Raster::new(width, height).unwrap();
            let noise: Vec<u32> =
                (0..raster.pixel_count()).map(|_| random.next_u64() as u32 & 0xff_ffff).collect();
            // Even fields, in which every mirror of a block has the same remainder.
            let even = vec![0x80_7f01; raster.pixel_count()];
            for (codes, number) in [(&noise, i as u32), (&even, 1_000_003)] {
                for schedule in schedules() {
                    let how = Halftone::of(&schedule).expect("parts");
                    let mut expected = vec![0; codes.len()];
                    halftone(how, raster, number, codes, &mut expected);
                    let got = on_gpu(gpu, how, raster, number, codes, &Shows::default());
                    assert!(got == expected, "{width} x {height}, {how:?}");
                }
            }
        }
    });
}

/// The noise is fixed to bodies that move, wherever their centres are; to the raster for those that rest and where nothing is.
#[test]
fn noise_goes_with_bodies_on_gpu_and_cpu_alike() {
    with_gpu(|gpu| {
        let mut random = Sampler::new(79, 0);
        let schedule = PlaneSchedule::equal_rgb24();
        let how = Halftone::of(&schedule).unwrap();
        for (width, height) in [(9, 5), (64, 48), (100, 37)] {
            let raster = Raster::new(width, height).unwrap();
            let codes: Vec<u32> =
                (0..raster.pixel_count()).map(|_| random.next_u64() as u32 & 0xff_ffff).collect();
            let id = |of: u64| [NO_HIT, 0, 1 << 24 | 7, 2 << 24, 3 << 24][(of % 5) as usize];
            let shows = Shows {
                ids: (0..raster.pixel_count()).map(|_| id(random.next_u64())).collect(),
                movers_of_instances: vec![2, 0, 1, 3],
                centres: vec![[5, -3], [-1000, 70], [31, 2047]],
            };
            let mut expected = vec![0; codes.len()];
            halftone_of_bodies(how, raster, 11, &codes, &|pixel| shows.anchor(pixel), &mut expected);
            let got = on_gpu(gpu, how, raster, 11, &codes, &shows);
            assert!(got == expected, "{width} x {height}");
            let mut fixed = vec![0; codes.len()];
            halftone(how, raster, 11, &codes, &mut fixed);
            assert!(fixed != expected, "the noise has moved");
        }
    });
}

/// Sums of 8 x 8 mirrors, block after block, of each channel.
fn block_sums(raster: Raster, codes: &[[u8; 3]]) -> Vec<[u32; 3]> {
    let (width, columns) = (raster.width() as usize, raster.width() as usize / 8);
    let mut sums = vec![[0; 3]; columns * (raster.height() as usize / 8)];
    for (i, code) in codes.iter().enumerate() {
        let sum = &mut sums[i / width / 8 * columns + i % width / 8];
        (0..3).for_each(|c| sum[c] += u32::from(code[c]));
    }
    sums
}

/// The light of the whole chain.
mod breadth {
    use super::*;

    /// Sums of blocks in the 24 frames of a rig whose bodies stand still.
    fn light(gpu: &Arc<Gpu>, flags: &[&str]) -> Vec<Vec<[u32; 3]>> {
        let still = [0, 1].map(|i| format!("scene.bodies.{i}.motion={{kind=\"still\"}}"));
        let flags = [&still.each_ref().map(String::as_str)[..], flags].concat();
        let rig = demo_rig(128, 96, &flags);
        let (outcome, _) = run(gpu, &rig, 24, 24);
        assert_eq!((outcome.light_mismatches, outcome.report.frames_lit), (0, 24));
        let sums = |frame: &LightFrame| block_sums(rig.camera.raster, &frame.codes);
        outcome.light.iter().map(sums).collect()
    }

    /// Split planes whose projector is as much darker as they are brighter give the picture of binary ones, also where that
    /// clips. Their steps are two levels of 255, which the halftone spreads.
    #[test]
    fn light_of_split_planes_is_that_of_binary_ones() {
        with_gpu(|gpu| {
            let binary = light(gpu, &["projector.max_intensity=8"]);
            let dark = format!("projector.max_intensity={}", 8.0 * 255.0 / 508.0);
            let split = light(gpu, &["projector.weights=\"split\"", &dark]);
            let (mut worst, mut off, mut lit) = (0.0f64, 0.0, 0);
            for (a, b) in binary.iter().flatten().zip(split.iter().flatten()) {
                for c in (0..3).filter(|c| a[*c] > 0) {
                    let [a, b] = [a[c], b[c]].map(|sum| f64::from(sum) / 64.0);
                    worst = worst.max((a - b).abs());
                    off += a - b;
                    lit += 1;
                }
            }
            assert!(lit > 1_000, "{lit} blocks are lit");
            let off = off / f64::from(lit);
            println!("blocks of split planes differ by {off:.3} levels on average, by {worst:.2} at most");
            assert!(worst <= 0.40 && off.abs() <= 0.10, "{worst} levels, {off} on average");
        });
    }

    /// In the light of the whole chain the mean level of 8 x 8 mirrors is that of binary planes, to 0.38 levels of 255 in
    /// every frame. Equal planes give 128 / 255 of full white, so their projector is that much brighter here. The bodies stand
    /// still, because the centres of the two kinds of light are not at the same instant.
    #[test]
    fn light_of_equal_planes_is_that_of_binary_ones() {
        with_gpu(|gpu| {
            let binary = light(gpu, &["projector.max_intensity=8"]);
            let bright = format!("projector.max_intensity={}", 8.0 * 255.0 / 128.0);
            let equal = light(gpu, &["projector.weights=\"equal\"", &bright]);
            let (mut worst, mut lit) = (0.0f64, 0);
            for (a, b) in binary.iter().flatten().zip(equal.iter().flatten()) {
                for c in 0..3 {
                    let [a, b] = [f64::from(a[c]), f64::from(b[c]) * 255.0 / 128.0].map(|sum| sum / 64.0);
                    worst = worst.max((a - b).abs());
                    lit += u32::from(a > 0.0);
                }
            }
            assert!(lit > 1_000, "{lit} blocks are lit");
            // A projector's brightness that is not exactly twice another's may round single code values otherwise.
            assert!(worst <= 0.40, "{worst} levels");
        });
    }
}
