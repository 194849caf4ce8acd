//! The same frames with subgroups of 4, 8 and 16 lanes. Software Vulkan has as many lanes as its vectors are wide, and
//! reads the width once in a process, so every width is drawn by a process of its own.

use dpm_device::planes::Raster;
use dpm_lab::sequence::{draw, poses_at};
use dpm_render::gpu::{Gpu, GpuOptions};
use dpm_render::{Keep, Renderer, RendererSettings};
use dpm_rig::config::RenderMethod;
use dpm_rig::pipeline::renderer_settings;
use dpm_tests::gpu::with_gpu;
use dpm_tests::rigs::demo_rig;
use std::path::PathBuf;
use std::process::Command;

/// Lanes of a subgroup, and the width of vectors in bits that gives them.
const WIDTHS: [(u32, u32); 3] = [(4, 128), (8, 256), (16, 512)];
/// Begins the line that a process of one width prints.
const MARK: &str = "drawn with subgroups of ";

/// Code values of some frames, by method and way of reading tables.
fn codes() -> Vec<Vec<u32>> {
    let raster = Raster::new(64, 48).expect("a small raster");
    let rig = demo_rig(raster.width(), raster.height(), &[]);
    let mut all = Vec::new();
    with_gpu(|gpu| {
        for (which, storage_tables) in
            [(RenderMethod::Dpm, false), (RenderMethod::Dpm, true), (RenderMethod::Paper, false)]
        {
            let mut render = rig.config.render.clone();
            render.method = which;
            render.paper.zone_spp = [2, 2, 1];
            let settings = RendererSettings { method: render.to_method(), ..renderer_settings(&rig) };
            let keep = Keep { storage_tables, ..Keep::default() };
            let mut renderer =
                Renderer::keeping(gpu, &rig.scene, settings, keep).expect("the demo fits the GPU");
            let mut slot = renderer.create_slot(false).expect("memory for a small frame");
            for frame in 0..3 {
                let poses = poses_at(&rig, u64::from(frame));
                draw(&rig, &mut renderer, &mut slot, &poses, frame, 2.0).expect("the frame ends");
            }
            all.push(slot.codes().to_vec());
        }
        println!("{MARK}{}", gpu.summary().subgroup_size);
    });
    all
}

#[test]
#[ignore = "the other test runs it, once for each width"]
fn frames_of_this_width() {
    for codes in codes() {
        let words: Vec<String> = codes.iter().map(|c| format!("{c:06x}")).collect();
        println!("codes {}", words.join(" "));
    }
}

/// What a process with vectors of this width drew: lanes of its subgroups, and code values.
fn drawn(bits: u32) -> (u32, Vec<Vec<u32>>) {
    let caches = std::env::var_os("MESA_SHADER_CACHE_DIR").map_or_else(std::env::temp_dir, PathBuf::from);
    let cache = caches.join(format!("vectors-of-{bits}"));
    let program = std::env::current_exe().expect("the path of this test");
    let out = Command::new(program)
        .args(["--exact", "breadth::subgroup_widths::frames_of_this_width", "--ignored", "--nocapture"])
        .env("LP_NATIVE_VECTOR_WIDTH", bits.to_string())
        // Compiled shaders of one width must not serve another.
        .env("MESA_SHADER_CACHE_DIR", cache)
        .output()
        .expect("the test runs again");
    let text = String::from_utf8_lossy(&out.stdout).into_owned();
    assert!(out.status.success(), "{bits} bits: {text}{}", String::from_utf8_lossy(&out.stderr));
    let lanes = text.lines().find_map(|l| l.split(MARK).nth(1)).and_then(|n| n.trim().parse().ok());
    let code = |word: &str| u32::from_str_radix(word, 16).expect("a code value");
    let codes = text.lines().filter_map(|line| line.strip_prefix("codes "));
    let codes = codes.map(|line| line.split(' ').map(code).collect()).collect();
    (lanes.expect("the width is said"), codes)
}

#[test]
fn frames_are_the_same_whatever_the_width_of_a_subgroup() {
    let device = Gpu::open(&GpuOptions::default()).unwrap_or_else(|e| panic!("this test needs Vulkan: {e}"));
    if !device.summary().software {
        // A GPU has the width that it has.
        println!("ignored: {} is no software Vulkan", device.summary().name);
        return;
    }
    drop(device);
    // At the same time, because each keeps one core busy with compiling.
    let all: Vec<_> = std::thread::scope(|scope| {
        let processes = WIDTHS.map(|(_, bits)| scope.spawn(move || drawn(bits)));
        processes.into_iter().map(|process| process.join().expect("no panic")).collect()
    });
    for ((lanes, _), (said, codes)) in WIDTHS.iter().zip(&all) {
        assert_eq!(said, lanes);
        assert_eq!(codes.len(), 3);
        for codes in codes {
            let lit = codes.iter().filter(|c| **c != 0).count();
            assert!(lit > 50, "{lanes} lanes: {lit} pixels are lit");
        }
        assert_eq!(codes[0], codes[1], "{lanes} lanes: tables in storage");
        assert_eq!(*codes, all[0].1, "{lanes} lanes");
    }
}
