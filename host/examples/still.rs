//! Draws one still of the built-in scene (or a glTF file) and writes it: a quick look and a quick timing.
use dpm_device::planes::Raster;
use dpm_host::{geometry::projector::ProjectorCamera, gpu::*, render::*, scene};
use glam::DVec3;
use std::time::Instant;
fn main() {
    let mut s = scene::builtin();
    if let scene::Environment::Constant(c) = &mut s.environment {
        if *c == glam::Vec3::ZERO {
            *c = glam::Vec3::ONE;
        }
    }
    let raster = Raster::new(320, 240).unwrap();
    let gpu =
        Gpu::open(&GpuOptions { validation: std::env::var("DPM_VALIDATION").is_ok(), device: None }).unwrap();
    println!("{:?}", gpu.summary());
    let camera = ProjectorCamera::look_at(
        raster,
        DVec3::new(0.0, 0.1, 1.0),
        DVec3::new(0.0, 0.03, -0.05),
        DVec3::Y,
        30f64.to_radians(),
    )
    .unwrap();
    let t = Instant::now();
    let r = Renderer::new(
        &gpu,
        &s,
        RendererSettings {
            raster,
            depth: 3,
            seed: 1,
            clamp_indirect: None,
            drive_gain: (std::f64::consts::PI / 0.8 / 8.0) as f32,
            ambient: [0.0; 3],
            camera_is_eye: false,
            leave_nothing_out: false,
        },
    )
    .unwrap();
    println!("build {:?} needs {:?}", t.elapsed(), r.needs());
    let mut slot = r.create_slot(true).unwrap();
    let poses: Vec<_> = s.bodies.iter().map(|b| b.world_from_body_rest).collect();
    for i in 0..6 {
        let spp = if i == 5 { 64 } else { 2 };
        let t = Instant::now();
        r.submit(
            &mut slot,
            &FrameInputs {
                frame: i,
                spp,
                camera: &camera,
                eye: DVec3::new(0.25, 0.35, 1.0),
                gaze: DVec3::ZERO,
                poses: &poses,
            },
        )
        .unwrap();
        let cost = slot.wait(60_000_000_000).unwrap();
        println!("{:?} {:?} {:?}", t.elapsed(), cost.pass_ns, cost.counters());
    }
    let px = slot.codes();
    let mut img = image::RgbImage::new(raster.width(), raster.height());
    for (p, c) in img.pixels_mut().zip(px) {
        let g = |v: u32| ((v & 255) as f32 / 255.0).powf(1.0 / 2.2) * 255.0;
        *p = image::Rgb([g(c & 255) as u8, g(c >> 8) as u8, g(c >> 16) as u8]);
    }
    img.save("/tmp/still.png").unwrap();
    println!("{:?}", validation_messages());
}
