//! A body that moves, in the light of a DLPC900 that a display feeds: the whole chain at real pace, from the mock's tracker
//! over GPU, packing, link, display and video cable to the mirrors. What is judged is where the mirrors that are on lie, in
//! every pattern at its own instant. It is in a file of its own so that nothing else runs at the same time.

use std::path::Path;
use std::sync::{Arc, Mutex};

use dpm_device::planes::Raster;
use dpm_device::time::HostTime;
use dpm_display::fake::{display, FakeKms, ScanFrame};
use dpm_display::kms::Kms;
use dpm_display::mode::Timing;
use dpm_display::transport::{on_card, DisplayTransport};
use dpm_dlpc900::driver::Dlpc900;
use dpm_dlpc900::video::VideoPatterns;
use dpm_dlpc900_rig::behind::BehindConfig;
use dpm_dlpc900_rig::feed::behind;
use dpm_handoff::path::Lock;
use dpm_rig::config::{Overrides, RigConfig};
use dpm_rig::pipeline::projector::{panel, Medium, OpenMedium};
use dpm_rig::pipeline::{self, RunOptions};
use dpm_rig::projectors::display::DisplayConfig;
use dpm_rig::rig::Rig;
use dpm_rig::telemetry::monitor::RunMonitor;
use dpm_tests::files::container;
use dpm_tests::gpu::with_gpu;
use glam::{DVec2, DVec3};
use hil_mock::dlpc900::{Dlpc900Model, VirtualHid};

const WIDTH: u32 = 512;
const HEIGHT: u32 = 384;
/// The same at 60 Hz.
const MODE: Timing =
    Timing { clock_khz: 15_360, row: [512, 540, 580, 640], frame: [384, 388, 392, 400], flags: 5 };
const FRAMES: u64 = 240;
/// Frames in time that are enough for a judgement, and the most runs in which they are looked for.
const ENOUGH: usize = 30;
const MOST_RUNS: usize = 5;
/// In a run with more late frames than this the machine stood still. The frames after that were planned long before their light,
/// as far as the turns of the card: they judge the machine, and only the middle of such a run is judged.
const QUIET: u64 = FRAMES / 100;
/// A body whose speed has not changed for so long moves steadily, nanoseconds: the filter had learned its speed when the frame was
/// planned, which on a busy machine is 140 ms before its light.
const STEADY_NS: i64 = 230_000_000;
/// The corners of a card that no row or column of mirrors is parallel to, metres.
const CORNERS: [[f32; 3]; 4] =
    [[-0.05, -0.03, 0.0], [0.03, -0.05, 0.0], [0.05, 0.03, 0.0], [-0.03, 0.05, 0.0]];

const RIG: &str = r#"
[projector]
width = 1920
height = 1080
frame_rate = "60"
[projector.backend]
kind = "display"
mode = "512x384@60"
[projector.backend.dlpc900]
[tracker]
kind = "mock"
rate_hz = 500
[render]
method = "full"
spp = 1
depth = 1
exposure = 100.0
[run]
frames = 240
[[scene.bodies]]
name = "card"
node = "card"
motion = { kind = "translate", speed_m_s = 1.0, amplitude_m = 0.22, acceleration_m_s2 = 50.0 }
"#;

/// A white card as a GLB.
fn card() -> Vec<u8> {
    let positions: Vec<u8> = CORNERS.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
    let indices: Vec<u8> = [0u16, 1, 2, 0, 2, 3].iter().flat_map(|i| i.to_le_bytes()).collect();
    let document = r#"{"asset":{"version":"2.0"},"extensionsUsed":["KHR_materials_unlit"],"scenes":[{"nodes":[0]}],"scene":0,
"nodes":[{"name":"card","mesh":0}],"meshes":[{"primitives":[{"attributes":{"POSITION":0},"indices":1,"material":0}]}],
"materials":[{"doubleSided":true,"extensions":{"KHR_materials_unlit":{}}}],
"accessors":[{"bufferView":0,"componentType":5126,"count":4,"type":"VEC3","min":[-0.05,-0.05,0.0],"max":[0.05,0.05,0.0]},
{"bufferView":1,"componentType":5123,"count":6,"type":"SCALAR"}],
"bufferViews":[{"buffer":0,"byteOffset":0,"byteLength":48},{"buffer":0,"byteOffset":48,"byteLength":12}],
"buffers":[{"byteLength":60}]}"#;
    container(document.as_bytes(), &[positions, indices].concat())
}

/// The rig with `settings`, on a raster that software can trace in time.
fn rig(folder: &Path, settings: &[&str]) -> Arc<Rig> {
    let file = folder.join("card.glb");
    std::fs::write(&file, card()).unwrap();
    let flags = [
        &[format!("scene.file={:?}", file.to_str().unwrap())][..],
        &settings.iter().map(|s| (*s).to_owned()).collect::<Vec<_>>(),
    ];
    dpm_dlpc900_rig::register();
    let overrides = Overrides { variables: vec![], flags: flags.concat() };
    let mut config =
        RigConfig::parse("rig.toml", RIG, Path::new(""), &overrides).unwrap_or_else(|e| panic!("{e}"));
    // A small part of the panel: the picture is in its corner.
    (config.projector.width, config.projector.height) = (WIDTH, HEIGHT);
    Arc::new(Rig::build(&config, None).unwrap_or_else(|e| panic!("{e}")))
}

fn display_of(config: &RigConfig) -> &DisplayConfig {
    config.projector.backend.keys().expect("a display")
}

fn video_of(rig: &Rig) -> VideoPatterns {
    let display = display_of(&rig.config);
    let behind: &BehindConfig = display.dlpc900.keys().expect("a controller");
    behind.video_patterns(display.encoding.parts(), rig.rate(), &rig.schedule).unwrap()
}

/// Runs the rig, and returns what the graphics card sent, and how many frames were late by the report.
fn sent(rig: &Arc<Rig>, gpu: &Arc<dpm_render::gpu::Gpu>) -> (Vec<ScanFrame>, u64) {
    let card = Arc::new(Lock::new(display(&[MODE])));
    let (shared, video) = (card.clone(), video_of(rig));
    let open: Box<OpenMedium> = Box::new(move |config, raster, surroundings| {
        let settings = display_of(config).settings(&panel(config, raster)).unwrap();
        let (card, clock) = (shared.clone(), surroundings.clock.clone());
        let kms = move || Ok(Box::new(FakeKms::new(card.clone(), clock.clone())) as Box<dyn Kms>);
        let model = Arc::new(Mutex::new(Dlpc900Model::default()));
        let controller = move || Dlpc900::new(VirtualHid::new(model.clone()));
        let opener =
            behind(on_card(kms, settings), Arc::new(controller), video.clone(), surroundings.stop.clone());
        let transport = DisplayTransport::open(opener, surroundings.wait, 0).unwrap();
        Ok(Some(Medium { transport: Box::new(transport), warnings: Vec::new() }))
    });
    let monitor = Arc::new(RunMonitor::default());
    let options = RunOptions { frames: FRAMES, ..RunOptions::default() };
    let outcome =
        pipeline::run_over(rig.clone(), gpu, &*open, options, &monitor).unwrap_or_else(|e| panic!("{e}"));
    let scanned = std::mem::take(&mut card.lock().unwrap().scanned);
    (scanned, FRAMES - outcome.report.frames_lit.min(FRAMES) + outcome.report.frames_late)
}

/// The centre of the light of mirrors that are on, each weighted with its light: `None` where all are off.
fn centre(model: &Dlpc900Model, place: usize, depth: u8) -> Option<DVec2> {
    let panel = model.options().dmd.raster();
    let (mut sum, mut light) = (DVec2::ZERO, 0.0);
    for bit in 0..depth {
        let plane = model.projected_bit(place, bit)?;
        for (y, row) in plane.chunks(panel.row_bytes()).take(HEIGHT as usize).enumerate() {
            for (i, byte) in row.iter().enumerate().take(WIDTH as usize / 8).filter(|(_, byte)| **byte != 0) {
                for x in (0..8).filter(|x| byte << x & 0x80 != 0) {
                    let weight = f64::from(1u32 << bit);
                    sum += weight * DVec2::new((8 * i + x) as f64 + 0.5, y as f64 + 0.5);
                    light += weight;
                }
            }
        }
    }
    (light > 0.0).then(|| sum / light)
}

/// The centre of the card's picture at an instant of the run, pixels.
fn true_centre(rig: &Rig, at_ns: i64) -> DVec2 {
    let pose = rig.true_poses(at_ns).expect("the mock's motion")[0];
    let corners = CORNERS.map(|[x, y, z]| {
        let world = pose.transform_point3(DVec3::new(x.into(), y.into(), z.into()));
        rig.camera.project(world).expect("in view")
    });
    // The centroid of a quadrilateral, by its two triangles.
    let [a, b, c, d] = corners;
    let triangle = |p: DVec2, q: DVec2, r: DVec2| ((q - p).perp_dot(r - p).abs(), (p + q + r) / 3.0);
    let [(one, at_one), (two, at_two)] = [triangle(a, b, c), triangle(a, c, d)];
    (one * at_one + two * at_two) / (one + two)
}

/// True if the card has moved evenly for [`STEADY_NS`], and does until `until_ns`.
fn is_steady(rig: &Rig, from_ns: i64, until_ns: i64) -> bool {
    let at = |ns: i64| rig.true_poses(ns).expect("the mock's motion")[0].translation;
    let begin_ns = from_ns - STEADY_NS;
    let speed = (at(until_ns) - at(begin_ns)) / (until_ns - begin_ns) as f64;
    let expected = |ns: i64| at(begin_ns) + speed * (ns - begin_ns) as f64;
    (begin_ns..until_ns).step_by(5_000_000).all(|ns| at(ns).distance(expected(ns)) < 1e-5)
}

/// Distances from light to body in pixels: of the mean of a frame, and of its patterns from that mean.
#[derive(Clone, Copy, Debug)]
struct Seen {
    offset_px: f64,
    smear_px: f64,
}

/// What an eye sees that follows the card, in every new frame while the card moves steadily.
fn seen(rig: &Rig, scanned: &[ScanFrame]) -> Vec<Seen> {
    let video = video_of(rig);
    let model = Arc::new(Mutex::new(Dlpc900Model::default()));
    Dlpc900::new(VirtualHid::new(model.clone())).unwrap().start_video_patterns(&video).unwrap();
    let frame_ns = rig.rate().slot_len_ns(0);
    let mut all = Vec::new();
    for pair in
        scanned.windows(2).filter(|pair| !pair[1].pixels.is_empty() && pair[0].pixels != pair[1].pixels)
    {
        // The controller shows a frame from the vertical pulse on that follows its last row.
        let begin_ns = pair[1].at_ns + MODE.pulse_ns();
        if !is_steady(rig, begin_ns, begin_ns + frame_ns) {
            continue;
        }
        let mut model = model.lock().unwrap();
        model.video_frame(HostTime(begin_ns), [WIDTH, HEIGHT], &pair[1].pixels);
        let mut at_ns = begin_ns;
        let mut off = Vec::new();
        for (place, entry) in video.entries.iter().enumerate() {
            let exposure_ns = i64::from(entry.exposure_us) * 1000;
            if let Some(centre) = centre(&model, place, entry.depth) {
                off.push(centre - true_centre(rig, at_ns + exposure_ns / 2));
            }
            at_ns += exposure_ns + i64::from(entry.dark_us) * 1000;
        }
        if off.len() == video.entries.len() {
            let mean = off.iter().sum::<DVec2>() / off.len() as f64;
            let spread = off.iter().map(|o| o.distance_squared(mean)).sum::<f64>() / off.len() as f64;
            all.push(Seen { offset_px: mean.length(), smear_px: spread.sqrt() });
        }
    }
    all
}

fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

/// At 1 m/s the light is where the body is: below 0.3 px in 99 of 100 frames, with each pattern at its own place, and smeared
/// by all patterns of a frame if they show one pose.
#[test]
fn every_pattern_of_a_moving_body_is_where_the_body_is() {
    let folder = std::env::temp_dir().join(format!("dpm-dlpc900-motion-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    with_gpu(|gpu| {
        for (encoding, poses, smear_px) in [
            ("binary24", "own", 0.0..0.5),
            ("mono8x3", "own", 0.0..0.5),
            ("rgb8", "own", 0.0..0.5),
            ("binary24", "frame", 3.0..5.0),
        ] {
            let settings = [
                format!("projector.backend.encoding={encoding:?}"),
                format!("projector.plane_poses={poses:?}"),
            ];
            let rig = rig(&folder, &settings.each_ref().map(String::as_str));
            // Of quiet runs, and of all.
            let (mut quiet, mut all, mut late) = (Vec::new(), Vec::new(), [0, 0]);
            for _ in 0..MOST_RUNS {
                // A device that was kept from finishing at the end of a run is opened anew.
                let (scanned, told) = sent(&rig, &gpu.reopen().unwrap());
                // A frame that comes a blank late is off by the 15 px that the card moves in a frame; the report has told of it.
                let (right, wrong): (Vec<_>, Vec<_>) =
                    seen(&rig, &scanned).into_iter().partition(|s| s.offset_px < 7.0);
                assert!(wrong.len() as u64 <= told, "{} of {told} that were told: {wrong:?}", wrong.len());
                late = [late[0] + wrong.len() as u64, late[1] + told];
                if told <= QUIET {
                    quiet.extend(right.iter().copied());
                }
                all.extend(right);
                if quiet.len() >= ENOUGH {
                    break;
                }
            }
            assert!(all.len() >= ENOUGH, "{} frames in time, {} late", all.len(), late[0]);
            let of = |seen: &[Seen], share| {
                [|s: &Seen| s.offset_px, |s: &Seen| s.smear_px]
                    .map(|value| quantile(seen.iter().map(value), share))
            };
            let [off50, smear50] = of(&all, 0.5);
            println!(
                "{encoding}, poses {poses}: {} frames while the card moves evenly, offset p50 {off50:.3} px, smear p50 {smear50:.3} px; \
                 {} a blank late, {} told",
                all.len(),
                late[0],
                late[1],
            );
            assert!(off50 < 0.1 && smear_px.contains(&smear50));
            if quiet.len() < ENOUGH {
                println!("no run was quiet, so the 99th percentiles are not judged");
                continue;
            }
            let [off99, smear99] = of(&quiet, 0.99);
            println!(
                "{} of them in quiet runs, offset p99 {off99:.3} px, smear p99 {smear99:.3} px",
                quiet.len()
            );
            assert!(off99 < 0.3 && smear99 < smear_px.end + 0.1);
        }
    });
    let _ = std::fs::remove_dir_all(&folder);
}

/// The judge's own arithmetic: the picture of the card lies in the raster, and a mirror's centre is half a pixel from its corner.
#[test]
fn the_judge_knows_where_the_card_is() {
    let raster = Raster::new(WIDTH, HEIGHT).unwrap();
    let folder = std::env::temp_dir().join(format!("dpm-dlpc900-judge-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    let rig = rig(&folder, &[]);
    assert_eq!(rig.camera.raster, raster);
    for at_ns in (0..2_000_000_000).step_by(50_000_000) {
        let centre = true_centre(&rig, at_ns);
        assert!((20.0..492.0).contains(&centre.x) && (20.0..364.0).contains(&centre.y), "{centre}");
    }
    let _ = std::fs::remove_dir_all(&folder);
}
