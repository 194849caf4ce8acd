//! Times of copying, packing and quantising one 1024 x 768 frame of 24 planes on one core, as text, and of what the CPU twin
//! of the pass `warp` takes for such a frame whose every mirror moves.
//!
//! `cargo run --release -p dpm-render --example pack_bench`, with a word of its name for one frame of the warp only

use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_render::pack::{pack, quantise, BitPlaneFrame, Kernel};
use dpm_render::warp::gather::{within, Drawn};
use dpm_render::warp::{plane_groups, Warper};
use dpm_shaders::structs::{Moved, Mover, PlaneGroup, OWNER_STILL, WORD_ROUGH};
use std::hint::black_box;
use std::time::Instant;

fn main() {
    let raster = Raster::new(1024, 768).expect("sides in range");
    let mut frame = BitPlaneFrame::new(raster, PlaneSchedule::rgb24());
    let mut codes: Vec<u32> =
        (0..raster.pixel_count() as u32).map(|i| i.wrapping_mul(2_654_435_761) >> 8).collect();
    let drive: Vec<[f32; 4]> = codes.iter().map(|&c| [c as f32 / 16_777_216.0; 4]).collect();
    let source = vec![0x5a_u8; frame.len_bytes()];
    let mut copy = source.clone();
    let copying = median_ms(|| {
        copy.copy_from_slice(black_box(&source));
        black_box(&mut copy);
    });
    println!("{:22} {copying:7.3} ms", "memcpy of 2.36 MB");
    // What a warp of every mirror reads at least.
    let moved = vec![<Moved as bytemuck::Zeroable>::zeroed(); raster.pixel_count()];
    let reading = median_ms(|| {
        black_box(black_box(&moved).iter().fold(0, |all, pixel| all | pixel.word | pixel.owner_and_depth));
    });
    println!("{:22} {reading:7.3} ms  {:5.2} x memcpy", "reading 9.4 MB", reading / copying);
    for &kernel in Kernel::available() {
        let ms = median_ms(|| {
            pack(kernel, black_box(&codes), &mut frame);
            black_box(&mut frame);
        });
        println!("{:22} {ms:7.3} ms  {:5.2} x memcpy", format!("pack {}", kernel.name()), ms / copying);
    }
    let ms = median_ms(|| {
        black_box(quantise(black_box(&drive), None, &mut codes));
    });
    println!("{:22} {ms:7.3} ms  {:5.2} x memcpy", "quantise", ms / copying);
    println!("warp of the mirrors of the areas in which bodies move, by turns with packing as many of them");
    println!("{:20}       warp ms           packing ms        warp / packing", "");
    println!("{:20}   median  fastest    median  fastest   medians  fastest", "");
    let wanted = std::env::args().nth(1).unwrap_or_default();
    for scene in scenes(raster).iter().filter(|scene| scene.name.contains(&wanted)) {
        print_warp(scene, &mut frame);
    }
}

/// Prints what the warp of a scene takes by each kernel, and packing by the same.
fn print_warp(scene: &WarpScene, frame: &mut BitPlaneFrame) {
    let Shot { raster, pixels, movers, groups, are_codes } = &scene.shot;
    let places = (0..raster.pixel_count() as u32).map(|i| place(*raster, i));
    let count = places.filter(|at| movers.iter().any(|m| within(m, *at))).count();
    let share = count as f64 / raster.pixel_count() as f64;
    let mut words: Vec<u32> = pixels.iter().map(|moved| moved.word).collect();
    println!("{} ({count} mirrors, {} groups)", scene.name, groups.len());
    for &kernel in Kernel::available() {
        let mut warper = Warper::new(kernel);
        let (mut warps, mut packs) = (Vec::new(), Vec::new());
        let begin = Instant::now();
        while warps.len() < 5 || begin.elapsed().as_millis() < 600 {
            let drawn = Drawn {
                raster: *raster,
                pixels: black_box(pixels),
                movers,
                are_codes: *are_codes,
                before: 0,
            };
            warps.push(time_ms(|| warper.warp(&drawn, groups, black_box(&mut words))));
            packs.push(share * time_ms(|| pack(kernel, black_box(&words), frame)));
        }
        let (warp, pack) = (Times::of(warps), Times::of(packs));
        print!("  {:18} {:8.4} {:8.4}", kernel.name(), warp.median, warp.fastest);
        print!("  {:8.4} {:8.4}", pack.median, pack.fastest);
        match count {
            0 => println!(),
            _ => println!("  {:8.1} {:8.1}", warp.median / pack.median, warp.fastest / pack.fastest),
        }
    }
}

/// What several runs took, ms.
struct Times {
    median: f64,
    fastest: f64,
}

impl Times {
    fn of(mut times: Vec<f64>) -> Self {
        times.sort_unstable_by(f64::total_cmp);
        Self { median: times[times.len() / 2], fastest: times[0] }
    }
}

fn time_ms(work: impl FnOnce()) -> f64 {
    let start = Instant::now();
    work();
    start.elapsed().as_secs_f64() * 1e3
}

fn place(raster: Raster, i: u32) -> [i32; 2] {
    [i % raster.width(), i / raster.width()].map(|c| c as i32)
}

/// A frame that was drawn.
struct Shot {
    raster: Raster,
    pixels: Vec<Moved>,
    movers: Vec<Mover>,
    groups: Vec<PlaneGroup>,
    are_codes: bool,
}

struct WarpScene {
    name: &'static str,
    shot: Shot,
}

impl Shot {
    /// A wall that stands, of a smooth picture.
    fn wall(raster: Raster, schedule: PlaneSchedule) -> Self {
        let instant = |i: usize| (i as f64 + 0.5) / schedule.len() as f64 - 0.18;
        let groups = plane_groups(&schedule, &(0..schedule.len()).map(instant).collect::<Vec<_>>());
        let of = |i: u32| {
            let [x, y] = place(raster, i).map(f64::from);
            let code = |k: f64| ((x * k / 90.0 + y * k / 70.0).sin() * 120.0 + 128.0) as u32;
            let word = code(1.0) | code(1.3) << 8 | code(0.7) << 16;
            Moved { word, motion: 0, owner_and_depth: OWNER_STILL << 24 | 1000 }
        };
        let pixels = (0..raster.pixel_count() as u32).map(of).collect();
        Self { raster, pixels, movers: Vec::new(), groups, are_codes: true }
    }

    /// Adds a body in `area`, left, top, right and bottom, in an ellipse or all of it, that moves by `start` in its middle and
    /// turns by `turn` of 2^-12 of 1/64 pixel a pixel.
    fn with(mut self, area: [i32; 4], is_round: bool, start: [i32; 2], turn: i32) -> Self {
        let [left, top, right, bottom] = area;
        let (centre, half) =
            ([(left + right) / 2, (top + bottom) / 2], [(right - left) / 2, (bottom - top) / 2]);
        // Bodies that come later are nearer.
        let depth = 900 - 100 * self.movers.len() as u32;
        let owner = OWNER_STILL + 1 + self.movers.len() as u32;
        // The area of a body that has margins for its motion.
        let margin = if is_round { 4 } else { 0 };
        self.movers.push(Mover {
            lower: [left - margin, top - margin],
            upper: [right + margin, bottom + margin],
            centre,
            start,
            slope: [0, -turn, turn, 0],
            ..bytemuck::Zeroable::zeroed()
        });
        for (pixel, i) in self.pixels.iter_mut().zip(0..) {
            let [x, y] = place(self.raster, i);
            let from = [x - centre[0], y - centre[1]];
            let is_in = x >= left && x < right && y >= top && y < bottom;
            let far = (0..2).map(|c| (f64::from(from[c]) / f64::from(half[c])).powi(2)).sum::<f64>();
            if is_in && (!is_round || far < 1.0) {
                let motion = [start[0] - ((turn * from[1]) >> 12), start[1] + ((turn * from[0]) >> 12)];
                pixel.motion = (motion[0] as u32 & 0xffff) | (motion[1] as u32) << 16;
                pixel.owner_and_depth = owner << 24 | depth;
                pixel.word ^= 0x3f_3f3f;
            }
        }
        self
    }

    /// Marks one of so many pixels, on lines, as rough.
    fn rough(mut self, every: usize) -> Self {
        let lines = self.pixels.iter_mut().skip(every / 2).step_by(every);
        lines.filter(|pixel| pixel.owner_and_depth >> 24 > OWNER_STILL).for_each(|p| p.word |= WORD_ROUGH);
        self
    }
}

/// What may move in a frame of 1024 x 768.
fn scenes(raster: Raster) -> Vec<WarpScene> {
    let rgb = || Shot::wall(raster, PlaneSchedule::rgb24());
    let all = [0, 0, 1024, 768];
    let two = || {
        let far = rgb().with([150, 150, 650, 650], true, [130, 40], 300);
        far.with([450, 200, 850, 600], true, [-200, 90], -900)
    };
    let halftone = Shot::wall(raster, PlaneSchedule::equal_rgb24());
    let scene = |name, shot| WarpScene { name, shot };
    vec![
        scene("every mirror moves along the rows", rgb().with(all, false, [128, 0], 0)),
        scene("every mirror moves aslant", rgb().with(all, false, [128, 45], 0)),
        scene("every mirror moves aslant, a tenth rough", rgb().with(all, false, [128, 45], 0).rough(10)),
        scene("every mirror turns", rgb().with(all, false, [30, 20], 1100)),
        scene("every mirror turns, a tenth rough", rgb().with(all, false, [30, 20], 1100).rough(10)),
        scene("two round bodies before a wall", two()),
        scene("two round bodies before a wall, a tenth rough", two().rough(10)),
        scene("a tenth of the raster moves aslant", rgb().with([400, 200, 680, 481], false, [128, 45], 0)),
        scene("nothing moves", rgb()),
        scene(
            "every mirror moves aslant, halftones",
            Shot { are_codes: false, ..halftone.with(all, false, [128, 45], 0) },
        ),
    ]
}

/// Median of about 300 ms of runs.
fn median_ms(mut work: impl FnMut()) -> f64 {
    let begin = Instant::now();
    let mut times = Vec::new();
    while times.len() < 5 || begin.elapsed().as_millis() < 300 {
        times.push(time_ms(&mut work));
    }
    Times::of(times).median
}
