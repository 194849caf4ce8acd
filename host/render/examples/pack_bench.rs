//! Times of copying, packing and quantising one 1024 x 768 frame of 24 planes on one core, as text.
//!
//! `cargo run --release -p dpm-render --example pack_bench`

use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_render::pack::{pack, quantise, BitPlaneFrame, Kernel};
use std::hint::black_box;
use std::time::Instant;

fn main() {
    let raster = Raster::new(1024, 768).expect("sides in range");
    let mut frame = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
    let mut codes: Vec<u32> =
        (0..raster.pixel_count() as u32).map(|i| i.wrapping_mul(2_654_435_761) >> 8).collect();
    let drive: Vec<[f32; 4]> = codes.iter().map(|&c| [c as f32 / 16_777_216.0; 4]).collect();
    let frame_bytes = frame.len_bytes();
    let source = vec![0x5a_u8; frame_bytes];
    let mut copy = source.clone();
    let copying = median_ms(|| {
        copy.copy_from_slice(black_box(&source));
        black_box(&mut copy);
    });
    // Copied or packed bytes a second say what the ratios hide: whether the buffers were in the caches.
    let gigabytes = |ms: f64| frame_bytes as f64 / ms / 1e6;
    println!("{:22} {copying:7.3} ms  {:13} {:5.1} GB/s", "memcpy of 2.36 MB", "", gigabytes(copying));
    for &kernel in Kernel::available() {
        let ms = median_ms(|| {
            pack(kernel, black_box(&codes), &mut frame);
            black_box(&mut frame);
        });
        let name = format!("pack {}", kernel.name());
        println!("{name:22} {ms:7.3} ms  {:5.2} x memcpy {:5.1} GB/s", ms / copying, gigabytes(ms));
    }
    let ms = median_ms(|| {
        black_box(quantise(black_box(&drive), None, &mut codes));
    });
    println!("{:22} {ms:7.3} ms  {:5.2} x memcpy", "quantise", ms / copying);
}

/// Median of about 300 ms of runs.
fn median_ms(mut work: impl FnMut()) -> f64 {
    let begin = Instant::now();
    let mut times = Vec::new();
    while times.len() < 5 || begin.elapsed().as_millis() < 300 {
        let start = Instant::now();
        work();
        times.push(start.elapsed().as_secs_f64() * 1e3);
    }
    times.sort_unstable_by(f64::total_cmp);
    times[times.len() / 2]
}
