//! The light of a DLPC900 whose video input is fed: the mean of its mirrors is the picture, with every encoding.

use std::path::Path;
use std::sync::{Arc, Mutex};

use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_display::encoding::PixelMap;
use dpm_dlpc900::driver::Dlpc900;
use dpm_dlpc900::lut::led;
use dpm_dlpc900_rig::behind::BehindConfig;
use dpm_lab::reference::Sampler;
use dpm_render::pack::{halftone, pack, BitPlaneFrame, Halftone, Kernel};
use dpm_rig::config::{Overrides, ProjectorConfig, RigConfig};
use dpm_rig::pipeline::projector::panel;
use dpm_rig::projectors::display::DisplayConfig;
use hil_mock::dlpc900::{Dlpc900Model, VirtualHid};

/// Every encoding of a DLPC900.
const ENCODINGS: [&str; 11] = [
    "rgb8", "rgb4x2", "rgb2x4", "planes24", "binary24", "mono8x3", "mono6x4", "mono4x6", "mono3x8",
    "mono2x12", "mono1x24",
];

/// The template of a rig behind a controller, with another encoding.
fn rig(encoding: &str) -> RigConfig {
    const RIG: &str = include_str!("../../../../rigs/dlpc900-live.toml");
    dpm_dlpc900_rig::register();
    let flags = vec![format!("projector.backend.encoding={encoding:?}")];
    let overrides = Overrides { variables: vec![], flags };
    RigConfig::parse("rigs/dlpc900-live.toml", RIG, Path::new(""), &overrides)
        .unwrap_or_else(|e| panic!("{e}"))
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

/// The light of each mirror behind a controller that is set up as `projector` says, over two video frames of `codes`, as a
/// share of the light of a full pattern of the whole table.
fn light_of(config: &RigConfig, codes: &[u32]) -> Vec<[f64; 3]> {
    let projector: &ProjectorConfig = &config.projector;
    let display: &DisplayConfig = projector.backend.keys().expect("a display");
    let (raster, schedule) = (projector.raster(), projector.schedule());
    let model = Arc::new(Mutex::new(Dlpc900Model::default()));
    let mut driver = Dlpc900::new(VirtualHid::new(model.clone())).unwrap();
    let behind: &BehindConfig = display.dlpc900.keys().expect("a controller");
    let video = behind.video_patterns(display.encoding.parts(), projector.frame_rate, &schedule).unwrap();
    driver.start_video_patterns(&video).unwrap();
    let map = PixelMap::new(display.settings(&panel(config, raster)).unwrap().encoding, &schedule).unwrap();
    let mut light = vec![[0; 3]; raster.pixel_count()];
    for number in 0..2 {
        let mut words = codes.to_vec();
        if let Some(how) = Halftone::of(&schedule) {
            halftone(how, raster, number, codes, &mut words);
        }
        let mut frame = BitPlaneFrame::new(raster, schedule);
        pack(Kernel::best(), &words, &mut frame);
        let mut pixels = vec![0; 4 * raster.pixel_count()];
        map.write(raster, frame.bytes(), &mut pixels, 4 * raster.width() as usize);
        let mut model = model.lock().unwrap();
        model.video_frame(HostTime(0), [raster.width(), raster.height()], &pixels);
        for (sum, of) in light.iter_mut().zip(model.light_of_table()) {
            (0..3).for_each(|c| sum[c] += of[c]);
        }
    }
    let lit_us = |c: usize| -> f64 {
        video.entries.iter().filter(|e| e.leds >> c & 1 == 1).map(|e| 2.0 * f64::from(e.exposure_us)).sum()
    };
    let full = [0, 1, 2].map(lit_us);
    light.into_iter().map(|sum| [0, 1, 2].map(|c| sum[c] as f64 / full[c])).collect()
}

/// The mean light over blocks of mirrors and two video frames is the code value within half a level, with every encoding.
/// White patterns show the green code value.
#[test]
fn light_behind_the_controller_is_the_picture() {
    for encoding in ENCODINGS {
        let config = rig(encoding);
        let raster = config.projector.raster();
        let (codes, width) = (picture(raster), raster.width() as usize);
        let light = light_of(&config, &codes);
        let is_white = encoding.starts_with("mono");
        let mut worst = 0f64;
        for y in (0..raster.height() as usize).step_by(BLOCK) {
            for x in (0..width).step_by(BLOCK) {
                let mirrors = (0..BLOCK * BLOCK).map(|i| (y + i / BLOCK) * width + x + i % BLOCK);
                let sums = mirrors.fold([[0.0; 2]; 3], |mut sums, i| {
                    for (c, sum) in sums.iter_mut().enumerate() {
                        sum[0] += light[i][c];
                        sum[1] += f64::from(codes[i] >> (8 * if is_white { 1 } else { c }) & 0xff);
                    }
                    sums
                });
                for [shown, wanted] in sums {
                    worst = worst.max((shown - wanted).abs() / (BLOCK * BLOCK) as f64);
                }
            }
        }
        println!("{encoding}: a block's mean is off by {worst:.3} of 255 at most");
        assert!(worst <= 0.5, "{encoding}: {worst}");
    }
    assert_eq!(led::WHITE, 7, "red, green and blue are bits 0 to 2");
}
