//! The light of a DLPC900 whose video input is fed: the mean of its mirrors is the picture, with every encoding.

use std::sync::{Arc, Mutex};

use dpm_device::dlpc900::driver::Dlpc900;
use dpm_device::dlpc900::lut::Dmd;
use dpm_device::dlpc900::video::{exposure_us, Receiver, VideoBits, VideoPatterns};
use dpm_device::planes::{PlaneSchedule, Raster};
use dpm_device::time::{FrameRate, HostTime};
use dpm_display::encoding::{Encoding, PixelMap};
use dpm_lab::reference::Sampler;
use dpm_render::pack::{halftone, pack, BitPlaneFrame, Halftone, Kernel};
use hil_mock::dlpc900::{Dlpc900Model, VirtualHid};

const DMD: Dmd = Dmd::Dlp6500;

fn rate() -> FrameRate {
    FrameRate::new(60, 1).unwrap()
}

fn encodings() -> [(Encoding, VideoBits, PlaneSchedule); 2] {
    [
        (Encoding::Planes24, VideoBits::Planes, PlaneSchedule::equal_rgb24()),
        (Encoding::Rgb8, VideoBits::Colours, PlaneSchedule::rgb24()),
    ]
}

fn video(bits: VideoBits, schedule: &PlaneSchedule) -> VideoPatterns {
    let us = exposure_us(bits, DMD, rate(), None).unwrap();
    VideoPatterns::of_rig(DMD, Receiver::Hdmi, rate(), schedule, bits, us)
}

/// Columns and rows of the blocks whose mean light is judged.
const BLOCK: usize = 8;

/// Code values 0x00BBGGRR: each block of mirrors has three of its own, in some of them with a slope.
fn picture(raster: Raster) -> Vec<u32> {
    let mut random = Sampler::new(5, 0);
    let (width, height) = (raster.width() as usize, raster.height() as usize);
    let blocks: Vec<u64> =
        (0..width.div_ceil(BLOCK) * height.div_ceil(BLOCK)).map(|_| random.next_u64()).collect();
    let code = |x: usize, y: usize| {
        let block = blocks[y / BLOCK * width.div_ceil(BLOCK) + x / BLOCK];
        let slope = if block >> 40 & 1 == 1 { (x % BLOCK + y % BLOCK) as u64 } else { 0 };
        (0..3).map(|c| ((block >> (8 * c) & 0xff).saturating_sub(slope) as u32) << (8 * c)).sum()
    };
    (0..width * height).map(|i| code(i % width, i / width)).collect()
}

/// The mean light over blocks of mirrors and two video frames is the code value within half a level, with every encoding.
#[test]
fn light_behind_the_controller_is_the_picture() {
    let raster = DMD.raster();
    let codes = picture(raster);
    let width = raster.width() as usize;
    for (encoding, bits, schedule) in encodings() {
        let model = Arc::new(Mutex::new(Dlpc900Model::default()));
        let mut driver = Dlpc900::new(VirtualHid::new(model.clone())).unwrap();
        driver.start_video_patterns(&video(bits, &schedule)).unwrap();
        let map = PixelMap::new(encoding, &schedule).unwrap();
        let mut light = vec![[0; 3]; raster.pixel_count()];
        for number in 0..2 {
            let mut words = codes.clone();
            if let Some(how) = Halftone::of(&schedule) {
                halftone(how, raster, number, &codes, &mut words);
            }
            let mut frame = BitPlaneFrame::new(raster, schedule);
            pack(Kernel::best(), &words, &mut frame);
            let mut pixels = vec![0; 4 * raster.pixel_count()];
            map.write(raster, frame.bytes(), &mut pixels, 4 * width);
            let mut model = model.lock().unwrap();
            model.video_frame(HostTime(0), [raster.width(), raster.height()], &pixels);
            for (sum, of) in light.iter_mut().zip(model.light_of_table()) {
                (0..3).for_each(|c| sum[c] += of[c]);
            }
        }
        let full = 2.0 * f64::from(exposure_us(bits, DMD, rate(), None).unwrap() * bits.patterns() / 3);
        let mut worst = 0f64;
        for y in (0..raster.height() as usize).step_by(BLOCK) {
            for x in (0..width).step_by(BLOCK) {
                let mirrors = (0..BLOCK * BLOCK).map(|i| (y + i / BLOCK) * width + x + i % BLOCK);
                let sums = mirrors.fold([[0.0; 2]; 3], |mut sums, i| {
                    for (c, sum) in sums.iter_mut().enumerate() {
                        sum[0] += light[i][c] as f64 / full;
                        sum[1] += f64::from(codes[i] >> (8 * c) & 0xff);
                    }
                    sums
                });
                for [shown, wanted] in sums {
                    worst = worst.max((shown - wanted).abs() / (BLOCK * BLOCK) as f64);
                }
            }
        }
        println!("{encoding:?}: a block's mean is off by {worst:.3} of 255 at most");
        assert!(worst <= 0.5, "{encoding:?}: {worst}");
    }
}
